"""Compiled recursions of the innovations under a gain."""

import numpy as np
from numba import njit

from optid.bases.basis import Array


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
    normal, right = np.zeros((q, q)), np.zeros(q)
    e, taken, white = np.zeros(l), np.zeros(l), np.zeros(l)
    seen, rows = np.zeros((l, q)), np.zeros((l, q))
    missing = np.zeros(l, dtype=np.bool_)
    for k in range(r.shape[0]):
        for o in range(l):
            predicted = 0.0
            for j in range(n):
                predicted += C[o, j] * x[j]
            missing[o] = np.isnan(r[k, o])
            taken[o] = predicted if missing[o] else r[k, o]
            e[o] = taken[o] - predicted
            for p in range(q):
                seen[o, p] = 0.0
                for j in range(n):
                    seen[o, p] += C[o, j] * turn[j, p]
        for o in range(l):
            white[o] = 0.0
            for c in range(l):
                white[o] += weight[o, c] * e[c]
            for p in range(q):
                rows[o, p] = 0.0
                for c in range(l):
                    if not missing[c]:
                        rows[o, p] += weight[o, c] * seen[c, p]
        for o in range(l):
            for p in range(q):
                right[p] += rows[o, p] * white[o]
                for s in range(p + 1):
                    normal[p, s] += rows[o, p] * rows[o, s]
        # d x+ = A dx + K de + dK e with de = -C dx where the residual is there
        for i in range(n):
            later[i] = 0.0
            for j in range(n):
                later[i] += F[i, j] * x[j]
            for o in range(l):
                later[i] += gain[i, o] * taken[o]
            for p in range(q):
                turned[i, p] = 0.0
                for j in range(n):
                    turned[i, p] += F[i, j] * turn[j, p]
            for o in range(l):
                turned[i, o * n + i] += e[o]
                if missing[o]:
                    for p in range(q):
                        turned[i, p] += gain[i, o] * seen[o, p]
        x, later = later, x
        turn, turned = turned, turn
    for p in range(q):
        for s in range(p):
            normal[s, p] = normal[p, s]
    return normal, right
