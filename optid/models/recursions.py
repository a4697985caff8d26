"""Linear recursions, from rest."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import get_lapack_funcs

from optid.arrays import Array

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
    if a.size > 1 and x.size:
        (solve,) = get_lapack_funcs(("tbtrs",), (y,))
        with np.errstate(all="ignore"):
            y = solve(np.repeat(a[:, None], len(x), axis=1), y, uplo="L", diag="U")[0]
    return y


def autoregression(a: Array, right: Array) -> Array:
    """Solve y(k) + sum_i A_i y(k-i) = right(k), (N, l), from rest, with the matrices A_i in a (na, l, l).

    y is not finite where the recursion leaves the range of numbers.
    """
    if not len(a):
        return right
    if right.shape[1] == 1:
        return lfilter([1.0], np.concatenate([[1.0], a.ravel()]), right)
    with np.errstate(all="ignore"):
        return late_njit(_march)(np.ascontiguousarray(a), np.ascontiguousarray(right))


def _march(a: Array, right: Array) -> Array:
    y = right.copy()
    for k in range(y.shape[0]):
        for i in range(min(a.shape[0], k)):
            for o in range(y.shape[1]):
                for p in range(y.shape[1]):
                    y[k, o] -= a[i, o, p] * y[k - 1 - i, p]
    return y
