"""Linear recursions, from rest, and the predictor of a noise model, without a Python loop over samples.

Innovations and predictions of s = g + H e with H = C/D:
``s(k) = g(k) - sum_i d_i s(k-i) + sum_i c_i e(k-i) + e(k)``. An innovation that cannot be computed, because the sample
or its prediction is missing, counts as zero; a missing sample is then replaced by its prediction. This is the
stationary predictor: it forgets the larger uncertainty after a gap at the rate of the zeros of C.

Before the recursion has its first prediction, and after a missing drive, a missing sample has no replacement: nothing
is predicted until as many samples follow one another as D reaches back. A record in which they never do is begun with
the last sample held in the gaps, and its first innovations count as zero while that is forgotten.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import get_lapack_funcs

from optid.arrays import Array, compact

SHORT = 5000  # samples up to which a triangular solution takes less time than the import of scipy.signal
PRESENT, MISSING, DEAD = 0, 1, 2

WARMING = 10  # times the lags of a record that is begun with held samples, during which its innovations count as zero


@cache
def late_njit(function: Callable[..., Any]) -> Any:
    """Compile a function at its first use, so that a module with a kernel does not import numba."""
    from optid.kernel_cache import cached_njit

    return cached_njit(function)


def lfilter(b: ArrayLike, a: ArrayLike, x: ArrayLike) -> Array:
    """Filter the columns of x, (N,) or (N, m), from rest: a(q) y = b(q) x, with leading one in a.

    y is not finite where the recursion leaves the range of numbers.
    """
    x, a = np.asarray(x, dtype=float), np.asarray(a, dtype=float)
    if len(x) > SHORT:
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


def propagate(matrix: Array, drive: Array) -> Array:
    """Return the states (N, n, d) of x(k) = matrix x(k-1) + drive(k), from rest; N is at most `SHORT`.

    They solve a banded triangular system.
    """
    count, n, d = drive.shape
    if not drive.size:  # LAPACK crashes without a right-hand side
        return drive.copy()
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


class Filtered(NamedTuple):
    """What one pass of the noise filter over a record finds, each (N,)."""

    innovations: Array  # zero where they cannot be computed
    filled: Array  # the samples, the missing ones replaced by their predictions
    predicted: Array  # one step ahead; NaN where that is impossible
    # PRESENT where there is an innovation, MISSING where the prediction stands for the sample, DEAD elsewhere
    state: Any


def innovations(s: Array, drive: Array | None, c: Array, d: Array, start: int = 0) -> Filtered:
    """Run the noise filter over one record s (N,) from rest; c and d are the coefficients after the leading ones.

    drive (N,) is what is known besides, None for zero; NaN is a missing sample of either. The innovations of the first
    `start` samples count as zero, and these samples are not predicted.
    """
    known = np.zeros(len(s)) if drive is None else compact(drive)
    samples, c, d = compact(s), np.array(c, dtype=float), np.array(d, dtype=float)
    if not start and np.isfinite(samples).all() and np.isfinite(known).all():  # C e = D s - drive, nothing to compile
        whole = np.concatenate([[1.0], c])
        e = lfilter(np.concatenate([[1.0], d]), whole, samples) - lfilter(np.ones(1), whole, known)
        return Filtered(e, samples.copy(), samples - e, np.full(len(s), PRESENT, dtype=np.int8))
    with np.errstate(all="ignore"):
        found = Filtered(*late_njit(_march_noise)(samples, known, c, d, start, -1))
        if np.all(found.state != PRESENT) and np.isnan(samples).any():
            found = Filtered(*late_njit(_march_noise)(samples, known, c, d, WARMING * start, start))
    return found


def predict(found: Filtered, c: Array, d: Array, horizon: int) -> Array:
    """Predict ``horizon`` samples ahead, (N,): the sample less what the last innovations added; NaN without them."""
    used = np.where(np.isnan(found.predicted), np.nan, found.innovations)
    response = lfilter(np.concatenate([[1.0], c]), np.concatenate([[1.0], d]), np.eye(1, horizon)[0])
    prediction = found.filled.copy()
    for i, weight in enumerate(response):
        prediction[i:] -= weight * used[: len(used) - i]
    return prediction


def _march_noise(s: Array, drive: Array, c: Array, d: Array, start: int, held: int) -> tuple[Array, Array, Array, Any]:
    count = s.shape[0]
    e, filled, predicted = np.zeros(count), np.empty(count), np.empty(count)
    state = np.full(count, 2, dtype=np.int8)
    last = 0.0
    for k in range(count):
        value = drive[k]
        for i in range(min(d.shape[0], k)):
            value -= d[i] * filled[k - 1 - i]
        for i in range(min(c.shape[0], k)):
            value += c[i] * e[k - 1 - i]
        predicted[k] = value if k >= start else np.nan
        if np.isnan(s[k]):
            filled[k] = predicted[k] if held < 0 else value
            if held >= 0 and (k < held or np.isnan(value)):
                filled[k] = last
            elif not np.isnan(filled[k]):
                state[k] = 1
        else:
            filled[k] = s[k]
            if k >= start and not np.isnan(value):
                e[k] = s[k] - value
                state[k] = 0
        last = filled[k]
    return e, filled, predicted, state
