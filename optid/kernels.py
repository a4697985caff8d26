"""Compiled inner loops: hats at a sample, lagged products of local families, outer products of sparse rows.

Compiled at the first call and cached on disk. Every function is single threaded, so that the answer does not depend on
the machine; the callers give contiguous arrays.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int32]


@njit(cache=True, nogil=True, error_model="numpy")
def hat_local(u: Array, lo: float, width: float, p: int, extrapolate: bool) -> tuple[Indices, Array]:
    """Evaluate the two hats that do not vanish at each sample.

    Args:
        u: (N,) input; NaN gets weights 0 at position 0.
        lo: first node.
        width: distance of the nodes.
        p: number of cells; there are p + 1 hats.
        extrapolate: continue the outer cells; otherwise clamp to the end nodes.

    Returns:
        first (N,) left node of the cell, weights (N, 2) of that node and the next.
    """
    first = np.empty(u.size, np.int32)
    weights = np.empty((u.size, 2))
    for k in range(u.size):
        x = (u[k] - lo) / width
        present = x == x  # false for NaN
        x = x if present else 0.0
        cell = np.int32(min(max(x, 0.0), p - 1.0))
        right = x - cell
        if not extrapolate:
            right = min(max(right, 0.0), 1.0)
        first[k] = cell
        weights[k, 0] = 1.0 - right if present else 0.0
        weights[k, 1] = right if present else 0.0
    return first, weights


@njit(cache=True, nogil=True, error_model="numpy")
def local_by_local(
    first: Indices, weights: Array, other: Indices, others: Array, start: int, stop: int, lag: int, out: Array
) -> None:
    """Add sum_t g(t) h(t - lag - d)^T to out[:, d, :] for samples start <= t < stop of two local families g and h.

    Args:
        first: (T,) position of the first function of g.
        weights: (T, s) values of g from there on.
        other: (T,) the same of h.
        others: (T, r) the same of h.
        start: first sample; every t - lag - d must lie in the arrays.
        stop: one after the last sample.
        lag: smallest lag difference.
        out: (functions of g, differences, functions of h).
    """
    if weights.shape[1] == 2 and others.shape[1] == 2:  # hats: unrolled, twice as fast
        for t in range(start, stop):
            left, right, row = weights[t, 0], weights[t, 1], first[t]
            for d in range(out.shape[1]):
                s = t - lag - d
                column, near, far = other[s], others[s, 0], others[s, 1]
                out[row, d, column] += left * near
                out[row, d, column + 1] += left * far
                out[row + 1, d, column] += right * near
                out[row + 1, d, column + 1] += right * far
        return
    for t in range(start, stop):
        for i in range(weights.shape[1]):
            row, weight = first[t] + i, weights[t, i]
            for d in range(out.shape[1]):
                s = t - lag - d
                for j in range(others.shape[1]):
                    out[row, d, other[s] + j] += weight * others[s, j]


@njit(cache=True, nogil=True, error_model="numpy")
def local_by_dense(first: Indices, weights: Array, flat: Array, step: int, out: Array) -> None:
    """Add w(t) * flat[t * step : t * step + width] to the rows of out where the local family does not vanish.

    Args:
        first: (T,) position of the first function.
        weights: (T, s) values from there on.
        flat: samples of the dense signals, one after the other; sample t meets the window that begins at t * step.
        step: number of dense signals.
        out: (functions, width).
    """
    width = out.shape[1]
    for t in range(first.size):
        window = flat[t * step : t * step + width]
        for i in range(weights.shape[1]):
            row, weight = out[first[t] + i], weights[t, i]
            for d in range(width):
                row[d] += weight * window[d]


@njit(cache=True, nogil=True, error_model="numpy")
def add_outer(columns: Indices, values: Array, scale: Array, gram: Array) -> None:
    """Add scale[k] * x_k x_k^T to the upper triangle of gram for sparse rows x_k.

    Args:
        columns: (K, z) increasing column numbers of each row.
        values: (K, z) entries there.
        scale: (K,) weights of the rows, of any sign.
        gram: (n, n).
    """
    for k in range(columns.shape[0]):
        for i in range(columns.shape[1]):
            weight = scale[k] * values[k, i]
            row = gram[columns[k, i]]
            for j in range(i, columns.shape[1]):
                row[columns[k, j]] += weight * values[k, j]
