"""Compiled recursions of the innovations under a gain."""

import numpy as np
from numba import njit

from optid.arrays import Array


@njit(cache=True, nogil=True, error_model="numpy")
def innovate(F: Array, C: Array, gain: Array, r: Array, x0: Array) -> Array:
    """Return the innovations e = r - C x, x+ = F x + K r with F = A - K C; a missing residual corrects nothing.

    Args:
        F: (n, n).
        C: (l, n).
        gain: (n, l) K.
        r: (N, l) residuals, NaN = missing.
        x0: (n,).
    """
    n, l = gain.shape  # noqa: E741
    e = np.empty_like(r)
    x, later = x0.copy(), np.empty(n)
    for k in range(r.shape[0]):
        for i in range(n):
            later[i] = 0.0
            for j in range(n):
                later[i] += F[i, j] * x[j]
        for o in range(l):
            seen = 0.0
            for j in range(n):
                seen += C[o, j] * x[j]
            e[k, o] = r[k, o] - seen
            taken = seen if np.isnan(r[k, o]) else r[k, o]
            for i in range(n):
                later[i] += gain[i, o] * taken
        x, later = later, x
    return e


@njit(cache=True, nogil=True, error_model="numpy")
def innovation_slope(F: Array, C: Array, gain: Array, e: Array, weight: Array) -> Array:
    """Return the derivative (n, l) of half the sum of e' weight e by the gain, with its sign turned, in one run back.

    Args:
        F: (n, n) A - K C.
        C: (l, n).
        gain: (n, l) K.
        e: (N, l) innovations under the gain, NaN = missing.
        weight: (l, l), symmetric.
    """
    n, l = gain.shape  # noqa: E741
    slope, adjoint, earlier = np.zeros((n, l)), np.zeros(n), np.empty(n)
    for k in range(e.shape[0] - 1, -1, -1):
        earlier[:] = 0.0
        for j in range(n):
            for i in range(n):
                earlier[i] += F[j, i] * adjoint[j]
        for o in range(l):
            pull = 0.0
            if np.isnan(e[k, o]):  # the state was not corrected
                for j in range(n):
                    pull += gain[j, o] * adjoint[j]
            else:
                for c in range(l):
                    if not np.isnan(e[k, c]):
                        pull += weight[o, c] * e[k, c]
                for j in range(n):
                    slope[j, o] += adjoint[j] * e[k, o]
            for i in range(n):
                earlier[i] += C[o, i] * pull
        adjoint, earlier = earlier, adjoint
    return slope


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def innovation_moments(F: Array, C: Array, gain: Array, r: Array, x0: Array, weight: Array) -> tuple[Array, Array]:
    """Return the sums of J'J and J'e over a record, J the derivative of -e by the gain (column by column) and x0.

    Args:
        F: (n, n) A - K C.
        C: (l, n).
        gain: (n, l) K.
        r: (N, l) residuals, NaN = missing.
        x0: (n,).
        weight: (l, l) by which J and e are multiplied.
    """
    n, l = gain.shape  # noqa: E741
    q = n * l + n
    x, later = x0.copy(), np.zeros(n)
    turn, turned = np.zeros((n, q)), np.zeros((n, q))
    for i in range(n):
        turn[i, n * l + i] = 1.0
    sums, rows, filled = np.zeros((q, q + 1)), np.empty((4, q + 1)), 0  # [J'J | J'e], and [J | e] of four rows
    e, taken, seen = np.zeros(l), np.zeros(l), np.zeros((l, q))
    missing = np.zeros(l, dtype=np.bool_)
    for k in range(r.shape[0]):
        for o in range(l):
            predicted = 0.0
            for p in range(q):
                seen[o, p] = 0.0
            for j in range(n):
                predicted += C[o, j] * x[j]
                for p in range(q):
                    seen[o, p] += C[o, j] * turn[j, p]
            missing[o] = np.isnan(r[k, o])
            taken[o] = predicted if missing[o] else r[k, o]
            e[o] = taken[o] - predicted
        # d x+ = A dx + K de + dK e with de = -C dx where the residual is there
        for i in range(n):
            later[i] = 0.0
            for p in range(q):
                turned[i, p] = 0.0
            for j in range(n):
                later[i] += F[i, j] * x[j]
                for p in range(q):
                    turned[i, p] += F[i, j] * turn[j, p]
            for o in range(l):
                later[i] += gain[i, o] * taken[o]
                turned[i, o * n + i] += e[o]
                if missing[o]:
                    for p in range(q):
                        turned[i, p] += gain[i, o] * seen[o, p]
        for o in range(l):
            for p in range(q + 1):
                rows[filled, p] = 0.0
            for c in range(l):
                if not missing[c]:
                    rows[filled, q] += weight[o, c] * e[c]
                    for p in range(q):
                        rows[filled, p] += weight[o, c] * seen[c, p]
            filled += 1
            if filled == 4 or (k == r.shape[0] - 1 and o == l - 1):
                for f in range(filled, 4):
                    for p in range(q + 1):
                        rows[f, p] = 0.0
                filled = 0
                for i in range(q):  # four rows at a time: the sums are read and written a quarter as often
                    u, v, w, z = rows[0, i], rows[1, i], rows[2, i], rows[3, i]
                    for p in range(q + 1):
                        sums[i, p] += u * rows[0, p] + v * rows[1, p] + w * rows[2, p] + z * rows[3, p]
        x, later = later, x
        turn, turned = turned, turn
    return sums[:, :q], sums[:, q]
