"""A bank of poles, and the correlation of an output with the response of an input behind each, at every delay.

The least-squares fit of y by level and one delayed response needs a few sums of products for every delay: correlations
by fast Fourier transforms, energies by running sums. A pair of real poles is a combination of two single ones.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from optid.arrays import Array
from optid.identify.informativity.signals import WhitenedRegression, delay, respond, whiten_rows

SLOWEST, FASTEST, COUNT = 0.5, 0.8, 15  # time constants: share of the longest experiment, samples, their number
TAUS, DELAYS, POWERS = (2.0, 6.0, 18.0, 54.0), (0, 3, 8, 16, 32), (1, 2, 3)  # of several inputs together, in samples
RIDGE = 0.1  # weight of their coefficients, of columns of norm one
FLAT = 1e-9  # share of its energy that a response must keep beside the level to count


@dataclass(frozen=True)
class Start:
    """Poles, delay and zeros that reduce the sum of squares of the output to `energy`."""

    energy: float
    poles: tuple[float, ...]
    lag: int
    zeros: int = 0


def bank(longest: int) -> Array:
    """Return the poles of the bank for records of a length: 0, and those of so many time constants."""
    taus = np.geomspace(FASTEST, max(SLOWEST * longest, 2 * FASTEST), COUNT)
    return np.concatenate([[0.0], np.exp(-1 / taus)])


def scan(regression: WhitenedRegression, drive: Sequence[Array], longest: int, pairs: bool = True
         ) -> Iterator[list[Start]]:
    """Yield the best pole of the bank for every delay up to `longest`, the best delay first.

    With `pairs` also the best two poles, and then the best two whose weights are free: with a zero, for responses that
    first go the wrong way.
    """
    poles = bank(max(len(u) for u in drive))
    single_poles, (first, second) = np.arange(poles.size), np.triu_indices(poles.size if pairs else 0, 1)
    inner, own = np.zeros((poles.size, longest + 1)), np.zeros((poles.size, longest + 1))
    both, whole = np.zeros((first.size, longest + 1)), 0.0
    for u, y in zip(drive, regression.y):
        white = whiten_rows(regression.noise, y)
        if len(white) < 2:
            continue
        white = white - white.mean()
        whole += float(white @ white)
        single = np.array([whiten_rows(regression.noise, respond((p,), u)) for p in poles])
        lags = min(longest, len(white) - 1) + 1
        inner[:, :lags] += _correlations(white, single, lags)
        own[:, :lags] += _energies(single, single_poles, single_poles, lags)
        if pairs:
            both[:, :lags] += _energies(single, first, second, lags)

    def best(reached: Array, size: Array, full: Array, *places: NDArray[np.intp], zeros: int = 0) -> list[Start]:
        gain = np.where(size > FLAT * full + 1e-300, reached / np.maximum(size, 1e-300), 0.0)
        chosen = np.argmax(gain, axis=0)
        return sorted((Start(whole - float(gain[b, lag]), tuple(float(poles[i[b]]) for i in places), lag, zeros)
                       for lag, b in enumerate(chosen.tolist())), key=lambda one: one.energy)

    yield best(inner**2, own, own[:, :1], single_poles)
    if pairs:
        x, y, xx, yy = inner[first], inner[second], own[first], own[second]
        a, b = _weights(poles[first], poles[second])[:, :, None]
        size = a**2 * xx + 2 * a * b * both + b**2 * yy
        yield best((a * x + b * y) ** 2, size, size[:, :1], first, second)
        yield best(x**2 * yy - 2 * x * y * both + y**2 * xx, xx * yy - both**2, xx[:, :1] * yy[:, :1], first, second,
                   zeros=1)


def _correlations(white: Array, single: Array, lags: int) -> Array:
    """Return sum y(k) v(k - d) for every row v and delay d."""
    size = next_fast_len(2 * len(white), real=True)
    spectra = np.asarray(rfft(single, size, axis=1))
    return np.asarray(irfft(np.asarray(rfft(white, size)) * np.conj(spectra), size, axis=1))[:, :lags]


def _energies(single: Array, first: NDArray[np.intp], second: NDArray[np.intp], lags: int) -> Array:
    """Return the sums of products v(k - d) w(k - d) beside their means for pairs of rows and every delay d."""
    samples = single.shape[1]
    early, late = single[:, : samples - lags], single[:, samples - lags :]
    sums = early.sum(axis=1)[:, None] + np.cumsum(late, axis=1)
    products = (early @ early.T)[first, second][:, None] + np.cumsum(late[first] * late[second], axis=1)
    return np.asarray(products - sums[first] * sums[second] / samples)[:, ::-1]


def _weights(p: Array, q: Array) -> Array:
    """Return what combines the responses of two poles to that of both, all of unit static gain, (2, n)."""
    return np.stack([p * (1 - q) / (p - q), -q * (1 - p) / (p - q)])


def responses(signals: Sequence[Array], taus: Sequence[float], delays: Sequence[int], least: int, longest: int
              ) -> Array:
    """Return signals (T,) behind poles of so many time constants after so many delays, from `least` to `longest`."""
    lags = sorted({max(lag, least) for lag in delays if lag <= max(longest, least)})
    behind = [respond((float(np.exp(-1 / tau)),), one) for one in signals for tau in taus]
    return np.column_stack([delay(v, lag) for v in behind for lag in lags])


def apart(regression: WhitenedRegression, inputs: Sequence[Array], least: int, longest: int) -> list[tuple[Array, ...]]:
    """Return a first response to each of several inputs, fitted together behind a few poles and delays.

    The inputs are (T, m) per experiment; the responses, (T,) per experiment, are those of powers of the input.
    """
    columns = [[responses([u[:, c] ** power for power in POWERS], TAUS, DELAYS, least, longest) for u in inputs]
               for c in range(inputs[0].shape[1])]
    both, _ = regression.project_columns([np.hstack(several) for several in zip(*columns)], 1.0)
    size = np.linalg.norm(both[:, :-1], axis=0) + 1e-300
    x = both[:, :-1] / size
    theta = np.linalg.solve(x.T @ x + RIDGE * np.eye(size.size), x.T @ both[:, -1]) / size
    parts = np.split(theta, len(columns))
    return [tuple(x @ part for x in own) for own, part in zip(columns, parts)]
