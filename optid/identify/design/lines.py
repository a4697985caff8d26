"""How many sinusoids a record consists of: the order to which it excites whatever is driven by it.

A signal of L sinusoids satisfies a difference equation of order 2 L (2 L + 1 with a mean), so the windows of it span no
more than 2 L + 1 dimensions, however long they are.
"""

import numpy as np

from optid.arrays import Array
from optid.statistics.hankel import complete_runs

LONGEST = 4096  # samples looked at; more would tell nothing new about a few lines
LOBE = 5  # bins that hold a line: all but a thousandth of it, after a Hann window
JOINT, STEPS = 6, 3
"""The first few frequencies are refined together after each new one, so many times; later ones stay where they are."""


def longest_run(signals: Array) -> Array:
    """Return the longest stretch of rows (N, s) without NaN, at most `LONGEST` rows of it."""
    return max(complete_runs(signals, 1), key=len, default=signals[:0])[:LONGEST]


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
    # No choice of `most` lobes holds more than as many of the largest bins.
    largest = np.sort(energy)[::-1][: most * LOBE]
    return bool(largest.sum() < (1 - tolerance) * total)


def remaining_shares(signals: Array, most: int, enough: float) -> Array:
    """Return the share of variance that 0, 1, 2, ... common sinusoids leave, greedily chosen and fitted jointly.

    Each step adds the frequency that explains most of what is left of all signals together (orthogonal matching
    pursuit; Pati, Rezaiifar, Krishnaprasad, Asilomar 1993) and refines all frequencies between the bins.

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
    n, total = len(x), float(x.shape[1])
    window, frequencies = np.hanning(n)[:, None], np.zeros(0)
    basis, residual = np.full((n, 1), n**-0.5), x
    while len(shares) <= most and shares[-1] > enough and 2 * len(shares) + 1 < n:
        frequencies = np.append(frequencies, _strongest(residual * window))
        if frequencies.size <= JOINT:
            for _ in range(STEPS):
                frequencies, basis, residual = _refined(x, frequencies)
        else:
            pair = _waves(n, frequencies[-1:])
            for _ in range(2):  # twice: once leaves what rounding left of the earlier lines
                pair -= basis @ (basis.T @ pair)
            new = np.linalg.qr(pair)[0]
            basis, residual = np.column_stack([basis, new]), residual - new @ (new.T @ residual)
        shares.append(min(float(np.sum(residual**2)) / total, shares[-1]))
    return np.array(shares)


def _strongest(x: Array) -> float:
    """Return the frequency (1/sample) of the highest common peak of signals (N, s), by a parabola between the bins."""
    n = 4 * len(x)
    spectrum = np.sum(np.abs(np.fft.rfft(x, n, axis=0)) ** 2, axis=1)
    spectrum[:2] = 0.0  # a fraction of a period is the mean
    peak = min(max(int(np.argmax(spectrum)), 1), spectrum.size - 2)
    left, top, right = np.log(spectrum[peak - 1 : peak + 2] + 1e-300)
    bend = left - 2 * top + right
    return (peak + (0.5 * (left - right) / bend if bend < 0 else 0.0)) / n


def _waves(n: int, frequencies: Array) -> Array:
    """Return cosines, then sines, (n, 2 L), about the middle, where frequency and phase are nearly independent."""
    angles = 2 * np.pi * (np.arange(n) - (n - 1) / 2)[:, None] * frequencies
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _refined(x: Array, frequencies: Array) -> tuple[Array, Array, Array]:
    """Return frequencies (L,) after a Gauss-Newton step, and what the old ones span and leave of x (N, s).

    The amplitudes are projected out: variable projection, Golub and Pereyra 1973, without the second-order term.
    """
    n, count = len(x), frequencies.size
    waves = _waves(n, frequencies)
    basis, triangle = np.linalg.qr(np.column_stack([np.ones(n), waves]))
    projections = basis.T @ x
    residual = x - basis @ projections
    scale = np.abs(np.diag(triangle))
    if scale.min() < 1e-6 * scale.max():  # two of them have met
        return frequencies, basis, residual
    amplitudes = np.linalg.solve(triangle, projections)[1:]
    times, slopes = 2 * np.pi * (np.arange(n) - (n - 1) / 2)[:, None], []
    for a, b in zip(amplitudes[:count].T, amplitudes[count:].T):  # signal by signal
        slope = times * (b * waves[:, :count] - a * waves[:, count:])
        slopes.append(slope - basis @ (basis.T @ slope))
    step = np.linalg.lstsq(np.vstack(slopes), residual.T.ravel(), rcond=1e-8)[0]
    moved = np.clip(frequencies + np.clip(step, -0.25 / n, 0.25 / n), 0.25 / n, 0.5)
    return moved, basis, residual
