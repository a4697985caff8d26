"""How many sinusoids a record consists of: the order to which it excites whatever is driven by it.

A signal of L sinusoids satisfies a difference equation of order 2 L (2 L + 1 with a mean), so the windows of it span no
more than 2 L + 1 dimensions, however long they are.
"""

from typing import Any

import numpy as np

from optid.bases.basis import Array

LONGEST = 8192
"""Samples looked at; more would tell nothing new about a few lines."""

LOBE = 3
"""Half width in bins of the main lobe of the Hann window, with a margin."""


def longest_run(signals: Array) -> Array:
    """Return the longest stretch of rows (N, s) without NaN, at most `LONGEST` rows of it."""
    present = ~np.isnan(signals).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(np.int8))).reshape(-1, 2)
    if not len(edges):
        return signals[:0]
    start, stop = edges[np.argmax(edges[:, 1] - edges[:, 0])]
    return signals[start : min(stop, start + LONGEST)]


def many_lines(x: Array, most: int, tolerance: float) -> bool:
    """Whether x (N,) certainly needs more than `most` sinusoids: a quick test in the frequency domain.

    Args:
        x: signal without missing samples.
        most: number of sinusoids.
        tolerance: share of its variance that may remain.
    """
    centred = x - x.mean()
    energy = np.abs(np.fft.rfft(centred * np.hanning(x.size))) ** 2
    total = energy.sum()
    if total == 0:
        return False
    width = 2 * LOBE + 1
    # No choice of `most` lobes holds more than the `most * width` largest bins.
    largest = np.sort(energy)[::-1][: most * width]
    return bool(largest.sum() < (1 - tolerance) * total)


def remaining_shares(signals: Array, most: int, enough: float) -> Array:
    """Return the share of variance that 0, 1, 2, ... common sinusoids leave, greedily chosen and fitted jointly.

    Each step takes the frequency that explains most of all signals together, refined between the bins of the Fourier
    transform (orthogonal matching pursuit; Pati, Rezaiifar, Krishnaprasad, Asilomar 1993).

    Args:
        signals: (N, s) without missing samples; every one counts alike.
        most: largest number of sinusoids.
        enough: share at which to stop.

    Returns:
        (L + 1,) decreasing; L <= most.
    """
    x = signals - signals.mean(axis=0)
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    shares = [1.0]
    if not x.shape[1]:
        return np.zeros(1)
    n, count = x.shape
    total = float(count)
    k, window = np.arange(n), np.hanning(n)[:, None]
    basis = np.full((n, 1), n**-0.5)
    residual = x
    while len(shares) <= most and shares[-1] > enough and basis.shape[1] + 2 <= n:
        spectrum = np.sum(np.abs(np.fft.rfft(residual * window, 4 * n, axis=0)) ** 2, axis=1)
        spectrum[:2] = 0.0  # a fraction of a period is the mean
        frequency = _refined(residual, k, int(np.argmax(spectrum)) / (4 * n), 0.5 / n)
        pair = np.column_stack([np.cos(2 * np.pi * frequency * k), np.sin(2 * np.pi * frequency * k)])
        for _ in range(2):  # twice: once leaves what rounding left of the earlier lines
            pair -= basis @ (basis.T @ pair)
        new, triangle = np.linalg.qr(pair)
        basis = np.column_stack([basis, new[:, np.abs(np.diag(triangle)) > 1e-8 * n**0.5]])
        residual = residual - new @ (new.T @ residual)
        shares.append(float(np.sum(residual**2)) / total)
    return np.array(shares)


def _refined(x: Array, k: Array, start: float, reach: float) -> float:
    """Return the frequency (per sample) within reach of start whose sine and cosine take most out of x."""
    from scipy.optimize import minimize_scalar

    def explained(frequency: float) -> float:
        wave = np.exp(-2j * np.pi * frequency * k)
        mean, half = wave.sum() / k.size, (wave * wave).sum() / k.size
        projected = wave @ x
        # Gram matrix of (wave, conjugate), their means left in: exact least squares of two columns.
        gram = np.array([[1.0, half], [np.conj(half), 1.0]]) - np.outer([mean, np.conj(mean)],
                                                                        [np.conj(mean), mean])
        right = np.stack([projected, np.conj(projected)])
        return -float(np.real(np.sum(np.conj(right) * np.linalg.solve(gram + 1e-12 * np.eye(2), right))))

    low, high = max(start - reach, 0.25 / k.size), min(start + reach, 0.5)
    found: Any = minimize_scalar(explained, bounds=(low, high), method="bounded", options={"xatol": 1e-7 / k.size})
    return float(found.x)
