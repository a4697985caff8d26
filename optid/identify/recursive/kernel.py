"""Compiled loop of the recursive least squares: rows are rotated into a triangular factor, one sample after the other.

Square-root information form (Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter V). The
factor R of [Phi | Y] replaces the covariance P = (R^T R)^-1 of the textbook recursion: rotations are orthogonal, so P
stays symmetric and positive definite, and P_0 = infinity is R = 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.kernel_cache import cached_njit

FADED = 1e-120  # diagonal entry of R below which forgetting stops: a direction without excitation keeps its estimate
NOTHING = 1e-250  # entries of R below this are set to zero: subnormal numbers are slow
UNDETERMINED = 1e-12  # share of a column, or of a row, outside the span of those before that counts as rounding


@cached_njit
def rotate(root: Array, row: Array, first: int, last: int, fade: float) -> float:
    """Rotate a row (s,) into rows `first` to `last` - 1 of an upper triangular factor (s, s) after scaling by `fade`.

    Both change in place; the row keeps its part orthogonal to these columns. The product of the cosines is returned,
    (1 + phi^T P phi)^(-1/2) for a regressor phi and P after forgetting.
    """
    kept, size = 1.0, row.size
    for i in range(first, last):
        factor = fade if root[i, i] > FADED else 1.0
        old, new = factor * root[i, i], row[i]
        if new == 0.0:
            if factor != 1.0:
                for j in range(i, size):
                    root[i, j] *= factor
            continue
        diagonal = np.sqrt(old * old + new * new)
        cosine, sine = old / diagonal, new / diagonal
        root[i, i] = diagonal
        kept *= cosine
        for j in range(i + 1, size):
            above = factor * root[i, j]
            root[i, j] = cosine * above + sine * row[j]
            row[j] = cosine * row[j] - sine * above
    return kept


class LaggedColumns(NamedTuple):
    """The n columns of Phi but the last, the constant: each is a signal at a lag."""

    signal: NDArray[np.intp]  # (n - 1,) of [-y | functions of the inputs]
    lag: NDArray[np.intp]  # (n - 1,)


@cached_njit
def absorb(
    root: Array, signals: Array, columns: LaggedColumns, weights: Array, forgetting: float, rows: int,
    marks: NDArray[np.bool_],
) -> tuple[int, Array, Array]:
    """Rotate the rows of one stretch into the factor.

    Args:
        root: (n + l, n + l) upper triangular, diagonal >= 0; changed in place.
        signals: (reach + T, s) what the columns of Phi are made of, minus the l outputs first.
        columns: signal and lag of every column.
        weights: (T,) of the rows; zero where a row is not used.
        forgetting: factor on all earlier information at every row used.
        rows: rows used before.
        marks: (T,) samples after which the estimate is recorded.

    Returns:
        the rows used so far, the prediction errors (T, l) before each update, NaN where a row is not used, and the
        recorded estimates (number of marks, n, l).
    """
    source, lag = columns
    n, size = source.size + 1, len(root)
    l, reach = size - n, len(signals) - len(weights)  # noqa: E741 - the field's letter
    fade = np.sqrt(forgetting)
    recorded = 0
    for t in range(marks.size):
        recorded += marks[t]
    innovations, traced = np.empty((weights.size, l)), np.empty((recorded, n, l))
    row, recorded = np.empty(size), 0
    for t in range(weights.size):
        if weights[t] > 0.0:
            now, scale = reach + t, np.sqrt(weights[t])
            for j in range(n - 1):
                row[j] = scale * signals[now - lag[j], source[j]]
            row[n - 1] = scale
            for o in range(l):
                row[n + o] = -scale * signals[now, o]
            kept = rotate(root, row, 0, n, fade)
            for o in range(l):
                innovations[t, o] = row[n + o] / (kept * scale) if kept > UNDETERMINED else np.nan
            rotate(root, row, n, size, fade)
            rows += 1
            if forgetting < 1.0 and rows % 256 == 0:
                for i in range(size):
                    for j in range(i, size):
                        if abs(root[i, j]) < NOTHING:
                            root[i, j] = 0.0
        else:
            for o in range(l):
                innovations[t, o] = np.nan
        if marks[t]:
            solve(root, n, traced[recorded])
            recorded += 1
    return rows, innovations, traced


@cached_njit
def solve(root: Array, n: int, theta: Array) -> None:
    """Solve R theta = z for the estimate (n, l); NaN while a column depends on those before it."""
    theta[:] = np.nan
    for j in range(n):
        energy = 0.0
        for i in range(j + 1):
            energy += root[i, j] ** 2
        if not root[j, j] > UNDETERMINED * np.sqrt(energy):
            return
    for o in range(theta.shape[1]):
        for i in range(n - 1, -1, -1):
            total = root[i, n + o]
            for j in range(i + 1, n):
                total -= root[i, j] * theta[j, o]
            theta[i, o] = total / root[i, i]
