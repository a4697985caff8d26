"""Linear recursions, from rest."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import get_lapack_funcs

from optid.arrays import Array, compact

SHORT = 5000
"""Samples up to which a triangular solution takes less time than the import of scipy.signal."""


@cache
def late_njit(function: Callable[..., Any]) -> Any:
    """Compile a function at its first use, so that a module with a kernel does not import numba."""
    from numba import njit

    return njit(cache=True, nogil=True, error_model="numpy")(function)


def lfilter(b: ArrayLike, a: ArrayLike, x: ArrayLike) -> Array:
    """Filter the columns of x, (N,) or (N, m), from rest: a(q) y = b(q) x, with leading one in a.

    y is not finite where the recursion leaves the range of numbers.
    """
    x, a = np.asarray(x, dtype=float), np.asarray(a, dtype=float)
    if x.size > SHORT:
        from scipy import signal

        return np.asarray(signal.lfilter(b, a, x, axis=0))
    y = np.zeros_like(x)
    for lag, weight in enumerate(np.asarray(b, dtype=float)[: len(x)]):
        y[lag:] += weight * x[: len(x) - lag]
    return all_pole(a[1:], y) if a.size > 1 and x.size else y


def all_pole(a: Array, x: Array) -> Array:
    """Filter the columns of x, (N,) or (N, m), from rest by 1 / (1 + a_1 q^-1 + ...): a banded triangular system."""
    (solve,) = get_lapack_funcs(("tbtrs",), (x,))
    band = np.repeat(np.concatenate([[1.0], a])[:, None], len(x), axis=1)
    with np.errstate(all="ignore"):
        return solve(band, x, uplo="L", diag="U")[0]


def propagated(matrix: Array, drive: Array) -> Array:
    """Return the states (N, n, d) of x(k) = matrix x(k-1) + drive(k), from rest; N is at most `SHORT`.

    They solve a banded triangular system.
    """
    count, n, d = drive.shape
    band = np.zeros((2 * n, count * n))
    band[0] = 1.0
    for i, j in np.ndindex(n, n):
        band[n + i - j, j::n] = -matrix[i, j]
    (solve,) = get_lapack_funcs(("tbtrs",), (band,))
    return solve(band, drive.reshape(count * n, d), uplo="L", diag="U")[0].reshape(drive.shape)


def autoregression(a: Array, right: Array) -> Array:
    """Solve y(k) + sum_i A_i y(k-i) = right(k), (N, l), from rest, with the matrices A_i in a (na, l, l).

    y is not finite where the recursion leaves the range of numbers.
    """
    if not len(a):
        return right
    if right.shape[1] == 1:
        return lfilter([1.0], np.concatenate([[1.0], a.ravel()]), right)
    with np.errstate(all="ignore"):
        return late_njit(_march)(compact(a), compact(right))


def predict_regression(a: Array, right: Array, y: Array, horizon: int, memory: int) -> Array:
    """Predict y (N, l) of y(k) + sum_i A_i y(k-i) = right(k) from the outputs `horizon` and more samples before.

    a (na, l, l) holds the matrices A_i; the first `memory` + `horizon` - 1 samples are not predicted.
    """
    right[:memory] = np.nan
    shorter: list[Array] = []  # predictions 1, 2, ... samples ahead, as far back as A looks
    for ahead in range(1, horizon + 1):
        prediction = right.copy()
        if len(a):
            prediction[: memory + ahead - 1] = np.nan
        for i, matrix in enumerate(a, start=1):
            known = y if i >= ahead else shorter[-i]
            prediction[i:] -= known[: len(known) - i] @ matrix.T
        shorter = [*shorter[-max(len(a), 1) :], prediction]
    return shorter[-1]


def _march(a: Array, right: Array) -> Array:
    y = right.copy()
    for k in range(y.shape[0]):
        for i in range(min(a.shape[0], k)):
            for o in range(y.shape[1]):
                for p in range(y.shape[1]):
                    y[k, o] -= a[i, o, p] * y[k - 1 - i, p]
    return y
