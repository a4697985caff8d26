"""Linear recursions."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import get_lapack_funcs

from optid.arrays import Array

SHORT = 5000
"""Samples up to which a triangular solution takes less time than the import of scipy.signal."""


def lfilter(b: ArrayLike, a: ArrayLike, x: ArrayLike) -> Array:
    """Filter the columns of x from rest: a(q) y = b(q) x.

    Args:
        b: (nb,) numerator, the coefficient of the present sample first.
        a: (na + 1,) denominator with leading one.
        x: (N,) or (N, m) samples.

    Returns:
        As x; not finite where the recursion leaves the range of numbers.
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
