"""Compiled recursions of the search for one fault and for two, over all onsets.

A column j of a fault adds h_j(k) to the innovation of sample k and e_j(k) to the state of the predictor error at k + 1,
from its onset on. Columns are ordered by their course: those that last, drifts, jumps of one sample. Every drift has a
helper among those that last: an earlier drift is, from k on, a drift of onset k plus a constant.
"""

import numpy as np

from optid.kernel_cache import cached_njit


@cached_njit(fastmath={"contract", "reassoc", "nsz"})
def correlate(tables, r, found):
    """Write the correlations (N, D) of a window (N, l) with all columns at all onsets, by one backward sweep."""
    of, F, C, W, h, e = tables.of, tables.F, tables.C, tables.W, tables.h, tables.e
    lasting, drifts, helpers = tables.lasting, tables.drifts, tables.helpers
    count, l = r.shape  # noqa: E741
    n, columns = F.shape[1], h.shape[2]
    costate, later, s = np.zeros(n), np.zeros(n), np.zeros(l)
    for step in range(count):
        k = count - 1 - step
        t = of[k]
        for o in range(l):
            s[o] = 0.0
            for a in range(o, l):  # W is lower triangular
                s[o] += W[t, a, o] * r[k, a]
        for j in range(columns):
            found[k, j] = found[k + 1, j] if step > 0 and j < lasting + drifts else 0.0
        for o in range(l):
            for j in range(lasting):
                found[k, j] += h[t, o, j] * s[o]
            for j in range(lasting + drifts, columns):
                found[k, j] += h[t, o, j] * s[o]
        for i in range(n):
            for j in range(lasting):
                found[k, j] += e[t, i, j] * costate[i]
            for j in range(lasting + drifts, columns):
                found[k, j] += e[t, i, j] * costate[i]
        for j in range(drifts):
            found[k, lasting + j] += found[k, helpers + j]
        for i in range(n):
            later[i] = 0.0
        for o in range(l):
            for i in range(n):
                later[i] += C[o, i] * s[o]
        for j in range(n):
            for i in range(n):
                later[i] += F[t, j, i] * costate[j]
        for i in range(n):
            costate[i] = later[i]


@cached_njit
def clear(matrix):
    """Set a matrix to zero."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] = 0.0


@cached_njit
def add(result, first, second):
    """Add first' second to a matrix."""
    for a in range(first.shape[0]):
        for i in range(first.shape[1]):
            for j in range(second.shape[1]):
                result[i, j] += first[a, i] * second[a, j]


@cached_njit
def grams(tables, slots, products, states):
    """Products of the signatures of columns with the same onset, for all onsets, by one backward sweep.

    Args:
        tables: `optid.faults.search.sweeps.SweepTables`.
        slots: (D, D) where in a row of products that of two columns is written, -1 for nowhere; those of columns of
            different candidates are computed only with states.
        products: (N, R) written.
        states: (N, n, D) product of a column with the response to a unit state at its onset, written; or (0, n, D).
    """
    whole = states.shape[0] > 0
    of, F, C, W, h, e, group = tables.of, tables.F, tables.C, tables.W, tables.h, tables.e, tables.group
    lasting, drifts, helpers = tables.lasting, tables.drifts, tables.helpers
    count, n, columns, l = of.size, F.shape[1], h.shape[2], C.shape[0]  # noqa: E741
    M, moved = np.zeros((n, n)), np.zeros((n, n))
    P, carried, pushed = np.zeros((n, columns)), np.zeros((n, columns)), np.zeros((n, columns))
    H, kept = np.zeros((columns, columns)), np.zeros((columns, columns))
    S, weighed, seen = np.zeros((l, l)), np.zeros((l, columns)), np.zeros((l, n))
    for step in range(count):
        k = count - 1 - step
        t = of[k]
        # after this sample a lasting column continues, a drift continues on top of its helper, a jump has ended
        for j in range(columns):
            for i in range(n):
                carried[i, j] = P[i, j] if j < lasting + drifts else 0.0
        for j in range(drifts):
            for i in range(n):
                carried[i, lasting + j] += P[i, helpers + j]
        for i in range(columns):
            for j in range(columns):
                kept[i, j] = 0.0
                if (whole or group[i] == group[j]) and i < lasting + drifts and j < lasting + drifts:
                    kept[i, j] = H[i, j]
                    if i >= lasting:
                        kept[i, j] += H[helpers + i - lasting, j]
                    if j >= lasting:
                        kept[i, j] += H[i, helpers + j - lasting]
                    if i >= lasting and j >= lasting:
                        kept[i, j] += H[helpers + i - lasting, helpers + j - lasting]
        # S = W'W, weighed = S h, seen = S C, pushed = carried + M e; S and M are symmetric
        for matrix in (S, weighed, seen, moved):
            clear(matrix)
        add(S, W[t], W[t])
        add(weighed, S, h[t])
        add(seen, S, C)
        for i in range(n):
            for j in range(columns):
                pushed[i, j] = carried[i, j]
        add(pushed, M, e[t])
        for i in range(columns):
            for j in range(columns):
                if whole or group[i] == group[j]:
                    total = kept[i, j]
                    for o in range(l):
                        total += h[t, o, i] * weighed[o, j]
                    for a in range(n):
                        total += e[t, a, i] * pushed[a, j] + carried[a, i] * e[t, a, j]
                    H[i, j] = total
                    if slots[i, j] >= 0:
                        products[k, slots[i, j]] = total
        # P = C' weighed + F' pushed, M = C' seen + F' M F
        clear(P)
        add(P, C, weighed)
        add(P, F[t], pushed)
        for i in range(n if whole else 0):
            for j in range(columns):
                states[k, i, j] = P[i, j]
        add(moved, M, F[t])
        clear(M)
        add(M, C, seen)
        add(M, F[t], moved)


@cached_njit
def explained(tables, correlations, roots, statistic):
    """Write the energies (C, N) that the candidates explain at all onsets, from correlations (N, D) and their roots."""
    for c in range(tables.first.size):
        d, begin, place = tables.sizes[c], tables.first[c], tables.places[c]
        for k in range(correlations.shape[0] if d > 0 else 0):
            total = 0.0
            for q in range(d):
                z = 0.0
                for p in range(d):
                    z += roots[k, place + q * d + p] * correlations[k, begin + p]
                total += z * z
            statistic[c, k] = total
