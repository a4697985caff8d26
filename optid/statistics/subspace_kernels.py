"""Compiled recursions of the subspace steps."""

import numpy as np
from numba import njit

from optid.arrays import Array


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def window_products(flat: Array, count: int, d: int, out: Array) -> None:
    """Add sum_t s(t) [s(t); s(t + 1); ...]^T to out for the first `count` samples of a few signals.

    Args:
        flat: samples of the d signals, one after the other; the windows of sample t begin at t d.
        count: number of samples t.
        d: number of signals.
        out: (d, width).
    """
    width = out.shape[1]
    whole = count - count % 4
    for t in range(0, whole, 4):  # four samples at a time: the sums are read and written a quarter as often
        first = flat[t * d : t * d + width]
        second = flat[(t + 1) * d : (t + 1) * d + width]
        third = flat[(t + 2) * d : (t + 2) * d + width]
        fourth = flat[(t + 3) * d : (t + 3) * d + width]
        for i in range(d):
            a, b, c, e = flat[t * d + i], flat[(t + 1) * d + i], flat[(t + 2) * d + i], flat[(t + 3) * d + i]
            row = out[i]
            for k in range(width):
                row[k] += a * first[k] + b * second[k] + c * third[k] + e * fourth[k]
    for t in range(whole, count):
        for i in range(d):
            for k in range(width):
                out[i, k] += flat[t * d + i] * flat[t * d + k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def adjoint_responses(inner: Array, outputs: Array, signals: Array, state: Array, out: Array) -> None:
    """Write the regressors of y_o(k) = sum_{i<k} C_o F^(k-1-i) M s(i), linear in the matrix M (n, d).

    The regressor of output o is the matrix X_o(k) (d, n), like M transposed, with X_o(k + 1) = X_o(k) F + s(k) C_o.

    Args:
        inner: (n, n) F.
        outputs: (l, n) C.
        signals: (T, d) s.
        state: (l, d, n) X at the first sample, for every output; left at the sample after the last.
        out: (T, l, d, n) X, written.
    """
    l, d, n = state.shape  # noqa: E741
    width = l * d
    x, before = np.empty((n, width)), np.empty((n, width))  # states outermost: the inner loops are long
    for i in range(n):
        for o in range(l):
            for j in range(d):
                x[i, o * d + j] = state[o, j, i]
    for t in range(signals.shape[0]):
        for i in range(n):
            for o in range(l):
                for j in range(d):
                    place = o * d + j
                    out[t, o, j, i] = x[i, place]
                    before[i, place] = x[i, place]
                    x[i, place] = outputs[o, i] * signals[t, j]
        for h in range(n):
            for i in range(n):
                weight = inner[h, i]
                for j in range(width):
                    x[i, j] += weight * before[h, j]
    for i in range(n):
        for o in range(l):
            for j in range(d):
                state[o, j, i] = x[i, o * d + j]


@njit(cache=True, nogil=True, error_model="numpy")
def clipped_run(
    a: Array, c: Array, drive: Array, direct: Array, tables: Array, injection: Array, low: Array, high: Array,
    x: Array, out: Array
) -> None:
    """Simulate x+ = A x + drive + sum_o table_o(y_o) + injection y, y = C x + direct, with y clipped to [low, high].

    Args:
        a: (n, n).
        c: (l, n).
        drive: (T, n) what the inputs add to the state.
        direct: (T, l) what they add to the outputs.
        tables: (l, G, n) feedback of output o at G points spread evenly over [low, high]; read with straight lines.
        injection: (n, l).
        low: (l,).
        high: (l,).
        x: (n,) state at the first sample; left at the sample after the last.
        out: (T, l) clipped outputs, written.
    """
    n, l, last = x.size, low.size, tables.shape[1] - 1  # noqa: E741
    following = np.empty(n)
    for t in range(drive.shape[0]):
        for i in range(n):
            following[i] = drive[t, i]
            for h in range(n):
                following[i] += a[i, h] * x[h]
        for o in range(l):
            y = direct[t, o]
            for i in range(n):
                y += c[o, i] * x[i]
            y = min(max(y, low[o]), high[o])
            out[t, o] = y
            place = (y - low[o]) / (high[o] - low[o]) * last
            cell = min(int(place), last - 1)
            share = place - cell
            for i in range(n):
                following[i] += (1 - share) * tables[o, cell, i] + share * tables[o, cell + 1, i] + injection[i, o] * y
        size = 0.0
        for i in range(n):
            size = max(size, abs(following[i]))
        scale = 1.0 if size < 1e12 else 1e12 / size  # a diverging run stays finite; its outputs sit at the limits
        for i in range(n):
            x[i] = following[i] * scale


@njit(cache=True, nogil=True, error_model="numpy")
def state_run(a: Array, drive: Array, x: Array, out: Array) -> None:
    """Write the states of x+ = A x + drive.

    Args:
        a: (n, n).
        drive: (T, n).
        x: (n,) state at the first sample; left at the sample after the last.
        out: (T, n), written.
    """
    n = x.size
    following = np.empty(n)
    for t in range(drive.shape[0]):
        for i in range(n):
            out[t, i] = x[i]
            following[i] = drive[t, i]
            for h in range(n):
                following[i] += a[i, h] * x[h]
        for i in range(n):
            x[i] = following[i]
