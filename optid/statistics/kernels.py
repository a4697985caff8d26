"""Compiled inner loops: lagged products of families of functions of which few differ from zero, sparse outer products.

Compiled at the first call and cached on disk. Every function is single threaded, so that the answer does not depend on
the machine. Indices are unsigned: signed ones are tested for counting from the end, which takes half of the time.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.kernel_cache import cached_njit

Indices = NDArray[np.int32]
unsigned = np.uintp
ONE = unsigned(1)


class LocalFamily(NamedTuple):
    """Functions of which at most s neighbours differ from zero at any sample."""

    first: Indices  # (T,) position of the first of them
    weights: Array  # (T, s) their values


@cached_njit
def local_by_local(g: LocalFamily, h: LocalFamily, start: int, stop: int, lag: int, out: Array) -> None:
    """Add sum_t g(t) h(t - lag - d)^T to out[:, d, :] for samples start <= t < stop.

    Every t - lag - d must lie in the arrays. out is (functions of g, differences, functions of h).
    """
    first, weights = g
    other, others = h
    if weights.shape[1] == 2 and others.shape[1] == 2:  # hats: unrolled, more than twice as fast
        for t in range(unsigned(start), unsigned(stop)):
            left, right, row = weights[t, 0], weights[t, 1], unsigned(first[t])
            s = unsigned(t - lag)
            for d in range(unsigned(out.shape[1])):
                near, far, column = others[s, 0], others[s, 1], unsigned(other[s])
                out[row, d, column] += left * near
                out[row, d, column + ONE] += left * far
                out[row + ONE, d, column] += right * near
                out[row + ONE, d, column + ONE] += right * far
                s -= ONE
        return
    for t in range(unsigned(start), unsigned(stop)):
        for i in range(unsigned(weights.shape[1])):
            weight, row = weights[t, i], unsigned(first[t]) + i
            s = unsigned(t - lag)
            for d in range(unsigned(out.shape[1])):
                column = unsigned(other[s])
                for j in range(unsigned(others.shape[1])):
                    out[row, d, column + j] += weight * others[s, j]
                s -= ONE


@cached_njit
def local_by_dense(g: LocalFamily, flat: Array, step: int, out: Array) -> None:
    """Add g(t) * flat[t * step : t * step + width] to the rows of out (functions of g, width).

    The samples of ``step`` dense signals are one after the other in ``flat``.
    """
    first, weights = g
    if weights.shape[1] == 2:
        for t in range(unsigned(first.size)):
            start, left, right, row = t * unsigned(step), weights[t, 0], weights[t, 1], unsigned(first[t])
            for d in range(unsigned(out.shape[1])):
                value = flat[start + d]
                out[row, d] += left * value
                out[row + ONE, d] += right * value
        return
    for t in range(unsigned(first.size)):
        start = t * unsigned(step)
        for i in range(unsigned(weights.shape[1])):
            weight, row = weights[t, i], unsigned(first[t]) + i
            for d in range(unsigned(out.shape[1])):
                out[row, d] += weight * flat[start + d]


@cached_njit
def add_outer(columns: Indices, values: Array, scale: Array, gram: Array) -> None:
    """Add scale[k] * x_k x_k^T to the upper triangle of gram (n, n), x_k sparse: increasing columns (K, z), values."""
    for k in range(unsigned(columns.shape[0])):
        for i in range(unsigned(columns.shape[1])):
            weight, row = scale[k] * values[k, i], unsigned(columns[k, i])
            for j in range(i, unsigned(columns.shape[1])):
                gram[row, unsigned(columns[k, j])] += weight * values[k, j]
