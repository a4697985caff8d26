"""A bank of poles, and the correlation of an output with the response of an input behind each, at every delay.

The least-squares fit of y by level and one delayed response needs a few sums of products for every delay: correlations
by fast Fourier transforms, energies by running sums. A pair of real poles is a combination of two single ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from optid.arrays import Array
from optid.identify.informativity.signals import WhitenedRegression, delayed, respond, whitened

SLOWEST, FASTEST, COUNT = 0.5, 0.8, 15  # time constants: share of the longest experiment, samples, their number
TAUS, DELAYS, POWERS = (2.0, 6.0, 18.0, 54.0), (0, 3, 8, 16, 32), (1, 2, 3)  # of several inputs together, in samples
RIDGE = 0.1  # weight of their coefficients, of columns of norm one
FLAT = 1e-9  # share of its energy that a response must keep beside the level to count


@dataclass(frozen=True)
class Start:
    """Poles and delay that reduce the sum of squares of the output to `energy`."""

    energy: float
    poles: tuple[float, ...]
    lag: int


def bank(longest: int) -> Array:
    """Return the poles of the bank for records of a length: 0, and those of so many time constants."""
    taus = np.geomspace(FASTEST, max(SLOWEST * longest, 2 * FASTEST), COUNT)
    return np.concatenate([[0.0], np.exp(-1 / taus)])


def scan(regression: WhitenedRegression, drive: Sequence[Array], longest: int, order: int) -> list[Start]:
    """Return for every delay up to `longest` the best one or two poles of the bank, the best delay first."""
    poles = bank(max(len(u) for u in drive))
    if order == 2:
        first, second = np.triu_indices(poles.size, 1)
        weights = _weights(poles[first], poles[second])
    else:
        first = second = np.arange(poles.size)
        weights = np.array([[1.0], [0.0]])
    inner, squares, whole = np.zeros((first.size, longest + 1)), np.zeros((first.size, longest + 1)), 0.0
    for u, y in zip(drive, regression.y):
        white = whitened(regression.noise, y)
        if len(white) < 2:
            continue
        white = white - white.mean()
        whole += float(white @ white)
        single = np.array([whitened(regression.noise, respond((p,), u)) for p in poles])
        found, energy = _products(white, single, first, second, weights, longest)
        inner += found
        squares += energy
    full = squares[:, :1]
    gain = np.where(squares > FLAT * full + 1e-300, inner**2 / np.maximum(squares, 1e-300), 0.0)
    best = np.argmax(gain, axis=0)
    starts = [Start(whole - float(gain[b, lag]), tuple(float(poles[i]) for i in (first[b], second[b])[:order]), lag)
              for lag, b in enumerate(best.tolist())]
    return sorted(starts, key=lambda one: one.energy)


def _products(white: Array, single: Array, first: NDArray[np.intp], second: NDArray[np.intp], weights: Array,
              longest: int) -> tuple[Array, Array]:
    """Return sum y(k) v(k - d), and the energy of v(k - d) beside its mean, for every combination v and delay d."""
    samples = len(white)
    size = next_fast_len(2 * samples, real=True)
    spectra = np.asarray(rfft(single, size, axis=1))
    correlation = np.asarray(irfft(np.asarray(rfft(white, size)) * np.conj(spectra), size, axis=1))
    lags = np.arange(min(longest, samples - 1) + 1)
    shape = (first.size, longest + 1)
    inner, energy = np.zeros(shape), np.zeros(shape)
    places = samples - 1 - lags
    total = np.cumsum(single, axis=1)[:, places]
    own = np.cumsum(single**2, axis=1)[:, places]
    a, b = weights[0][:, None], weights[1][:, None]
    inner[:, lags] = a * correlation[first][:, lags] + b * correlation[second][:, lags]
    mean = a * total[first] + b * total[second]
    both = own[first]
    if weights[1].any():
        cross = np.array([np.cumsum(single[i] * single[j])[places] for i, j in zip(first, second)])
        both = a**2 * own[first] + 2 * a * b * cross + b**2 * own[second]
    energy[:, lags] = both - mean**2 / samples
    return inner, energy


def _weights(p: Array, q: Array) -> Array:
    """Return what combines the responses of two poles to that of both, all of unit static gain, (2, n)."""
    return np.stack([p * (1 - q) / (p - q), -q * (1 - p) / (p - q)])


def apart(regression: WhitenedRegression, inputs: Sequence[Array], least: int, longest: int
          ) -> list[tuple[Array, ...]]:
    """Return a first response to each of several inputs, fitted together behind a few poles and delays.

    The inputs are (T, m) per experiment; the responses, (T,) per experiment, are those of powers of the input.
    """
    lags = sorted({max(lag, least) for lag in DELAYS if lag <= max(longest, least)})
    columns = [[np.column_stack([delayed(v, lag) for power in POWERS for tau in TAUS
                                 for v in (respond((float(np.exp(-1 / tau)),), u[:, c] ** power),) for lag in lags])
                for u in inputs] for c in range(inputs[0].shape[1])]
    both, _ = regression.projected([np.hstack(several) for several in zip(*columns)], 1.0)
    size = np.linalg.norm(both[:, :-1], axis=0) + 1e-300
    x = both[:, :-1] / size
    theta = np.linalg.solve(x.T @ x + RIDGE * np.eye(size.size), x.T @ both[:, -1]) / size
    parts = np.split(theta, len(columns))
    return [tuple(x @ part for x in own) for own, part in zip(columns, parts)]
