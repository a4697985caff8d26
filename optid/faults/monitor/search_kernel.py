"""Compiled search of a running window: the energy that every candidate explains from every onset.

A fault leaves a deviation in the state of the predictor, which is followed for every column of every candidate and
every onset of the window. The arrays are indexed by onset last and used as rings, so that every loop over the onsets
runs over contiguous numbers; the onsets in use are the first ones of the ring.
"""

import numpy as np
from numba import njit

from optid.models.state_kernels import value_and_slope

LASTING, DRIFT, JUMP, DRIVEN = range(4)
"""The course of a column after its onset: 1, 1 2 3 .., 1 0 0 .., given by the signals of the plant."""

DEPENDENT = 1e-9
"""A column with less than this share of its energy beside the columns before it explains nothing of its own."""


@njit(cache=True, nogil=True, error_model="numpy")
def expand(functions, channels, signals, values):
    """Write functions (T, r) of signals (T, m), NaN where a signal is missing; return the sample refused or -1."""
    for k in range(signals.shape[0]):
        for j in range(channels.size):
            v = signals[k, channels[j]]
            values[k, j] = np.nan
            if not np.isnan(v):
                value, _, refused = value_and_slope(functions, j, v)
                if refused:
                    return k
                values[k, j] = value
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def add_product(M, v, out):
    """Add M v(k) to out(k) for every sample; the same digits for blocks of any length."""
    for k in range(v.shape[0]):
        for i in range(M.shape[0]):
            total = 0.0
            for j in range(M.shape[1]):
                total += M[i, j] * v[k, j]
            out[k, i] += total


@njit(cache=True, nogil=True, error_model="numpy")
def predict(A, C, K, root, drive, y, direct, x, r):
    """Run the steady predictor; write states x (T + 1, n) from x[0] on and whitened innovations r (T, l)."""
    n, l = A.shape[0], C.shape[0]  # noqa: E741
    e = np.empty(l)
    for k in range(y.shape[0]):
        for o in range(l):
            e[o] = y[k, o] - direct[k, o]
            for i in range(n):
                e[o] -= C[o, i] * x[k, i]
        for o in range(l):
            r[k, o] = 0.0
            for p in range(o + 1):
                r[k, o] += root[o, p] * e[p]
        for i in range(n):
            total = drive[k, i]
            for j in range(n):
                total += A[i, j] * x[k, j]
            for o in range(l):
                total += K[i, o] * e[o]
            x[k + 1, i] = total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def accumulate(v, source, target, count):
    """Add v times the first entries of source to those of target."""
    if v != 0.0:
        for a in range(count):
            target[a] += v * source[a]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def search(A, C, gain, root, into_state, into_output, course, driven, moving, moving_state, moving_output, r,
           first, size, least, limit, tabled, table, factors, inverses, xi, b, gram, grown, clock, statistic, peak,
           weight):
    """Search the windows that end with each of T samples; stop after the first that exceeds a limit.

    Args:
        A: (N, N) transition of the predictor, carried faults included.
        C: (l, N).
        gain: (N, l); minus the output injection for a reading that is missing.
        root: (l, l) lower triangular; zero rows for missing readings.
        into_state: (D, n) what a column adds to the first n states.
        into_output: (D, l).
        course: (D,).
        driven: (D,) row of the moving signals, -1 without.
        moving: (D,) whether the column belongs to a candidate with a driven one.
        moving_state: (T, M, n) what driven columns add to the state.
        moving_output: (T, M, l).
        r: (T, l) whitened innovations.
        first: (C,) first column of a candidate.
        size: (C,) its columns.
        least: (C,) samples that it needs.
        limit: (C,) thresholds.
        tabled: whether signatures and products of the other columns are those of the tables.
        table: (D, l, 2 W) signatures, the oldest onset first, twice.
        factors: (pairs, 2 W) Cholesky factors of the products of a candidate, in the same order.
        inverses: (D, 2 W) of their diagonals, zero for a column that explains nothing of its own.
        xi: (D, room, W) deviations, changed.
        b: (D, W) correlations with the innovations, changed.
        gram: (pairs, W) products of the columns of a candidate, changed.
        grown: (W,) samples since the onset, the first counted, changed.
        clock: (1,) samples searched, changed.
        statistic: (T, C) written.
        peak: (C,) samples since the best onset of the last sample, 0 without one; written.
        weight: (T, C) what the last column of a candidate with a driven one has beside the others in a whole window.

    Returns:
        samples searched.
    """
    N, l, n, D, W = A.shape[0], C.shape[0], into_state.shape[1], xi.shape[0], xi.shape[2]  # noqa: E741
    widest = 0
    for c in range(size.size):
        widest = max(widest, size[c])
    raw, sig, later = np.empty((l, W)), np.empty((D, l, W)), np.empty((N, W))
    low, inverse, z, total = (np.empty((widest * widest, W)), np.empty((widest, W)), np.empty((widest, W)), np.empty(W))
    for t in range(r.shape[0]):
        k = clock[0]
        slot, valid = k % W, min(k + 1, W)
        shift = W - 1 - slot
        grown[slot] = 0.0
        for p in range(gram.shape[0]):
            gram[p, slot] = 0.0
        for a in range(valid):
            grown[a] += 1.0
        for j in range(D):
            b[j, slot] = 0.0
            for i in range(N):
                xi[j, i, slot] = 0.0
            kind, row = course[j], driven[j]
            if tabled and not moving[j]:
                for o in range(l):
                    v, line, target = r[t, o], table[j, o], b[j]
                    for a in range(valid):
                        target[a] += line[shift + a] * v
                continue
            for i in range(n):
                v = moving_state[t, row, i] if kind == DRIVEN else into_state[j, i]
                if v == 0.0:
                    continue
                if kind == JUMP:
                    xi[j, i, slot] = v
                elif kind == DRIFT:
                    for a in range(valid):
                        xi[j, i, a] += v * grown[a]
                else:
                    for a in range(valid):
                        xi[j, i, a] += v
            for o in range(l):
                v, line = moving_output[t, row, o] if kind == DRIVEN else into_output[j, o], raw[o]
                for a in range(valid):
                    line[a] = v * grown[a] if kind == DRIFT else 0.0 if kind == JUMP else v
                if kind == JUMP:
                    line[slot] = v
                for i in range(N):
                    accumulate(C[o, i], xi[j, i], line, valid)
            for o in range(l):
                line = sig[j, o]
                for a in range(valid):
                    line[a] = 0.0
                for p in range(o + 1):
                    accumulate(root[o, p], raw[p], line, valid)
                accumulate(r[t, o], line, b[j], valid)
            for i in range(N):
                line = later[i]
                for a in range(valid):
                    line[a] = 0.0
                for h in range(N):
                    accumulate(A[i, h], xi[j, h], line, valid)
                for o in range(l):
                    accumulate(-gain[i, o], raw[o], line, valid)
            for i in range(N):
                for a in range(valid):
                    xi[j, i, a] = later[i, a]
        pair, over = 0, False
        oldest = (k + 1) % W
        for c in range(size.size):
            d, own = size[c], first[c]
            for a in range(valid):
                total[a] = 0.0
            moves = moving[own]
            if tabled and not moves:
                for i in range(d):
                    target, source = z[i], b[own + i]
                    for a in range(valid):
                        target[a] = source[a]
                    for h in range(i):
                        x, y = factors[pair + h], z[h]
                        for a in range(valid):
                            target[a] -= x[shift + a] * y[a]
                    pair += i + 1
                    line = inverses[own + i]
                    for a in range(valid):
                        target[a] *= line[shift + a]
                        total[a] += target[a] * target[a]
            for i in range(0 if tabled and not moves else d):
                for a in range(valid):
                    z[i, a] = b[own + i, a]
                for h in range(i + 1):
                    for o in range(l):
                        x, y, line = sig[own + i, o], sig[own + h, o], gram[pair]
                        for a in range(valid):
                            line[a] += x[a] * y[a]
                    at = i * widest + h
                    for a in range(valid):
                        low[at, a] = gram[pair, a]
                    for q in range(h):
                        one, two = i * widest + q, h * widest + q
                        for a in range(valid):
                            low[at, a] -= low[one, a] * low[two, a]
                    if h < i:
                        for a in range(valid):
                            low[at, a] *= inverse[h, a]
                            z[i, a] -= low[at, a] * z[h, a]
                    else:
                        weight[t, c] = low[at, oldest] if k + 1 >= W else -1.0
                        for a in range(valid):
                            v = low[at, a]
                            inverse[i, a] = 1.0 / np.sqrt(v) if v > DEPENDENT * gram[pair, a] and v > 0.0 else 0.0
                            low[at, a] = v * inverse[i, a]
                    pair += 1
                for a in range(valid):
                    z[i, a] *= inverse[i, a]
                    total[a] += z[i, a] * z[i, a]
            best, where = 0.0, 0.0
            for a in range(valid):
                if total[a] > best and grown[a] >= least[c] and not (moves and grown[a] > k):
                    best, where = total[a], grown[a]
            statistic[t, c], peak[c] = best, int(where)
            over = over or best > limit[c]
        clock[0] = k + 1
        if over:
            return t + 1
    return r.shape[0]
