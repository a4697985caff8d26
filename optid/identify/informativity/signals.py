"""The signals of a record as its tests read them, and the regressions of one output behind low-order dynamics.

Every experiment has its own level. What is left of its state from before the first sample is a decay at the
slowest pole; with a pole at 1 it is a slope. Both are projected out, with the level.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from optid.arrays import Array
from optid.data.record import Data, Experiment
from optid.data.stretches import interpolate_missing
from optid.identify.outliers import LONGEST, find_outliers
from optid.models.recursions import lfilter

SAMPLES, EXPERIMENTS = 30_000, 40  # that are read, from the beginning of a record
LATEST = 500  # samples after a move of an input within which its responses are looked for
CHANCE = 0.01  # probability that pulses follow moves equally late by chance
DISTINCT = 1e-6  # share of its length that a decay must keep beside the level to count
Poles = NDArray[np.complex128]


def beginning(data: Data) -> list[Experiment]:
    """Return the experiments that are read of a record, in its raw units."""
    data = data.raw()
    if data.n_samples > 1.1 * SAMPLES:
        data = data.split(SAMPLES / data.n_samples)[0]
    return [e for e in data.experiments if e.n_samples > 1][:EXPERIMENTS]


@dataclass(frozen=True, eq=False)
class RecordSignals:
    """Inputs and outputs of a record, each centred and over its spread, one array per experiment.

    Attributes:
        u: inputs (T, m), the last value held where one is missing.
        y: outputs (T, l), interpolated where one is missing or an isolated outlier.
        present: whether an output was measured, (T, l), and is no outlier.
        lost: whether an input is missing, (T, m).
        u_scale, y_scale: spread of every channel, (m,) and (l,).
    """

    u: tuple[Array, ...]
    y: tuple[Array, ...]
    present: tuple[NDArray[np.bool_], ...]
    lost: tuple[NDArray[np.bool_], ...]
    u_scale: Array
    y_scale: Array

    @classmethod
    def of(cls, data: Data) -> "RecordSignals":
        """Read the beginning of a record."""
        experiments = beginning(data)
        u = [hold_last(e.u) for e in experiments]
        measured = _without_outliers([e.y for e in experiments], u)
        y = [interpolate_missing(one) for one in measured]
        scales = []
        for i, several in enumerate((u, y)):
            whole = np.vstack(several)
            middle, spread = whole.mean(axis=0), whole.std(axis=0)
            spread = np.where(spread > 1e-14 * np.abs(middle), spread, 1.0)
            (u, y)[i][:] = [(x - middle) / spread for x in several]
            scales.append(spread)
        return cls(tuple(u), tuple(y), tuple(np.isfinite(one) for one in measured),
                   tuple(np.isnan(e.u) for e in experiments), *scales)

    @cached_property
    def samples(self) -> int:
        """Number of samples."""
        return sum(len(y) for y in self.y)

    @property
    def longest(self) -> int:
        """Samples of the longest experiment."""
        return max(len(y) for y in self.y)

    def inputs(self, c: int) -> tuple[Array, ...]:
        """Return input c, (T,) per experiment."""
        return tuple(u[:, c] for u in self.u)

    def outputs(self, o: int) -> tuple[Array, ...]:
        """Return output o, (T,) per experiment."""
        return tuple(y[:, o] for y in self.y)

    def levels(self, c: int) -> int:
        """Count the distinct values of an input."""
        return np.unique(np.round(np.concatenate(self.inputs(c)), 9)).size


def _without_outliers(outputs: Sequence[Array], inputs: Sequence[Array]) -> list[Array]:
    """Return outputs (T, l) of every experiment, missing at isolated outliers: a single one may hide the dynamics.

    Pulses that may answer the inputs (T, m) are none.
    """
    kept = [np.array(y, dtype=float) for y in outputs]
    for o in range(kept[0].shape[1] if kept else 0):
        found = find_outliers([y[:, o] for y in kept])
        if any(map(len, found)) and not _may_answer(found, inputs):
            for y, samples in zip(kept, found):
                y[samples, o] = np.nan
    return kept


def _may_answer(found: Sequence[NDArray[np.intp]], inputs: Sequence[Array]) -> bool:
    """Whether pulses at these samples of every experiment may be the responses to inputs that move now and then.

    They may where an input has pulses itself, or where more of them begin equally long after its moves than by chance.
    """
    begun = [samples[np.diff(samples, prepend=-2) > 1] for samples in found]
    runs, count = sum(map(len, begun)), sum(map(len, inputs))
    for c in range(inputs[0].shape[1]):
        own = [u[:, c] for u in inputs]
        moves: list[NDArray[np.bool_]] = [np.append(False, np.diff(u) != 0) for u in own]
        share = sum(map(np.sum, moves)) / count
        if any(map(_is_pulsed, own)) or any(map(len, find_outliers(own))):
            return True
        lags = min(max(map(len, own)) // 4, LATEST)
        hits = [sum(int(np.sum(m[k[k >= lag] - lag])) for k, m in zip(begun, moves)) for lag in range(lags)]
        most = max(hits, default=0)
        if 2 * most >= runs and most and lags * bdtrc(most - 1, runs, share) < CHANCE:
            return True
    return False


def _is_pulsed(u: Array) -> bool:
    """Whether an input (T,) leaves its usual value for a few samples at a time."""
    values, counts = np.unique(u, return_counts=True)
    off = np.asarray(u != values[np.argmax(counts)])
    away = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]])))
    lengths = away[1::2] - away[::2]
    return lengths.size > 0 and int(lengths.max()) <= LONGEST


def hold_last(samples: Array) -> Array:
    """Repeat the last value where samples (N, c) are missing, and the first one before it."""
    filled = np.array(samples, dtype=float)
    if np.isfinite(filled).all():
        return filled
    for column in filled.T:
        present = np.isfinite(column)
        if present.any() and not present.all():
            places = np.maximum.accumulate(np.where(present, np.arange(column.size), -1))
            column[:] = column[np.where(places < 0, int(np.argmax(present)), places)]
    return np.nan_to_num(filled)


def respond(poles: Sequence[complex] | Poles, drive: Array) -> Array:
    """Return the response of 1 / A(q) to a drive (T,) from its first value, with unit static gain beside poles at 1."""
    factors = np.asarray(poles, dtype=complex)
    gain = float(np.prod(np.abs(1 - factors[factors != 1])))
    x = (drive - drive[0]) * gain
    if not factors.size:
        return x
    a = np.ones(1, dtype=complex)
    for p in factors:  # np.poly, without its search for conjugates
        a = np.append(a, 0.0) - np.append(0.0, p * a)
    return lfilter([1.0], np.real(a), x)


def delay(x: Array, lag: int) -> Array:
    """Return x(k - lag), zero before the record."""
    return np.concatenate([np.zeros(min(lag, len(x))), x[: max(len(x) - lag, 0)]])


def whiten_rows(noise: Array, x: Array) -> Array:
    """Filter the rows of x, (T,) or (T, k), by the polynomial of a noise model, where it fits."""
    past = noise.size - 1
    return sum((a * x[past - j : len(x) - j] for j, a in enumerate(noise)), np.zeros((len(x) - past, *x.shape[1:])))


@dataclass(frozen=True, eq=False)
class WhitenedRegression:
    """Least squares of one output on columns, with a noise model and what is projected out of every experiment.

    Attributes:
        y: output, (T,) per experiment.
        present: whether it was measured.
        noise: polynomial [1, a1, ...] that whitens the errors.
    """

    y: tuple[Array, ...]
    present: tuple[NDArray[np.bool_], ...]
    noise: Array

    @cached_property
    def rows(self) -> tuple[NDArray[np.bool_], ...]:
        """Rows whose whitened error can be formed."""
        past = self.noise.size - 1
        return tuple(np.convolve(~there, np.ones(past + 1))[past : len(there)] < 0.5 for there in self.present)

    @cached_property
    def count(self) -> int:
        """Number of rows."""
        return sum(int(one.sum()) for one in self.rows)

    @cached_property
    def white(self) -> tuple[Array, ...]:
        """The whitened output."""
        return tuple(whiten_rows(self.noise, y)[rows] for y, rows in zip(self.y, self.rows))

    def project_columns(self, columns: Sequence[Array], slowest: float) -> tuple[Array, int]:
        """Return [columns | output], (rows, k + 1), whitened and beside level and decay, and their free parameters."""
        found: list[Array] = []
        free = 0
        for x, y, rows in zip(columns, self.white, self.rows):
            white = whiten_rows(self.noise, x)
            both = np.empty((y.size, x.shape[1] + 1))
            both[:, :-1], both[:, -1] = white if rows.all() else white[rows], y
            k = np.arange(rows.size, dtype=float)[rows]
            decay = k if slowest == 1 else np.exp(k * np.log(max(abs(slowest), 1e-300)))
            out = [np.ones(y.size), decay - decay.mean() if decay.size else decay]
            sizes, whole = [float(one @ one) for one in out], max(float(decay @ decay), 1.0)
            basis = [one / np.sqrt(size) for one, size in zip(out, sizes) if size > DISTINCT**2 * whole]
            if basis:
                q = np.array(basis)
                both -= q.T @ (q @ both)
            free += len(basis)
            found.append(both)
        return np.vstack(found), free

    def solve(self, columns: Sequence[Array], slowest: float) -> tuple[float, Array, Array, int]:
        """Return sum of squares, coefficients, whitened errors, and the parameters that were projected out."""
        both, free = self.project_columns(columns, slowest)
        theta = np.linalg.lstsq(both[:, :-1], both[:, -1], rcond=1e-9)[0] if both.shape[1] > 1 else np.zeros(0)
        errors = both[:, -1] - both[:, :-1] @ theta
        return float(errors @ errors), theta, errors, free

    def residuals(self, columns: Sequence[Array], theta: Array, slowest: float) -> list[Array]:
        """Return the errors before whitening, without level and decay, NaN where the output is missing."""
        plain = replace(self, noise=np.ones(1), present=tuple(np.ones_like(there) for there in self.present))
        both, _ = plain.project_columns(columns, slowest)
        errors = both[:, -1] - both[:, :-1] @ theta
        ends = np.cumsum([len(y) for y in self.y])[:-1]
        return [np.where(there, e, np.nan) for e, there in zip(np.split(errors, ends), self.present)]
