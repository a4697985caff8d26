"""Compiled search of a running window: the energy that every candidate explains from every onset.

The deviation of the state of the predictor is propagated for every column of every candidate and every onset of the
window. The arrays are ring buffers with the onset as last index, so that every loop over the onsets runs over
contiguous numbers; the onsets in use are the first ones of the ring.
"""

from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.faults.kinds import DRIFT, DRIVEN, JUMP
from optid.kernel_cache import cached_njit
from optid.models.state_kernels import value_and_slope

DEPENDENT = 1e-9  # a column with less than this share of its energy beside the columns before it counts as dependent


class Signatures(NamedTuple):
    """Whitened signatures of D columns for W onsets, or for 2 W: the oldest onset first, twice."""

    lines: Array  # (D, l, W)
    factors: Array  # (pairs, W) Cholesky factors of the products of the columns of a candidate
    inverses: Array  # (D, W) inverses of the diagonals of the factors, zero for a dependent column


class SearchMemory(NamedTuple):
    """What a running search keeps from one sample to the next; the search changes all but the table."""

    table: Signatures  # (..., 2 W) of the steady predictor
    work: Signatures  # (..., W) of the window, for the columns that are propagated
    deviations: Array  # (D, room, W)
    correlations: Array  # (D, W) of the columns with the innovations
    products: Array  # (pairs, W) of the columns of a candidate
    since: Array  # (W,) samples since the onset, the first counted
    clock: np.ndarray  # (1,) samples searched
    peak: np.ndarray  # (C,) samples since the best onset of the last sample, 0 without one


@cached_njit
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


@cached_njit(fastmath={"contract", "reassoc", "nsz"})
def accumulate(v, source, target, count):
    """Add v times the first entries of source to those of target."""
    if v != 0.0:
        for a in range(count):
            target[a] += v * source[a]


@cached_njit(fastmath={"contract", "reassoc", "nsz"})
def search(matrices, parts, signals, r, limit, tabled, memory):
    """Search the windows that end with each of T samples, until one exceeds a limit.

    Args:
        matrices: of the predictor, carried faults included: transition (N, N), output (l, N), gain (N, l), which is
            minus the output injection for a missing reading, root (l, l) lower triangular, its rows zero for those.
        parts: the arrays of `Columns`.
        signals: what driven columns add to the state (T, M, n) and to the output (T, M, l).
        r: (T, l) whitened innovations.
        limit: (C,) thresholds.
        tabled: whether the columns of candidates without a driven one are those of the table.
        memory: a `SearchMemory`, changed.

    Returns:
        the samples searched, their statistics (T, C), and the energy (T, C) of the last column of a candidate with a
        driven one beside the others in a whole window.
    """
    A, C, gain, root = matrices
    into_state, into_output, course, driven, moving, first, size, least = parts
    moving_state, moving_output = signals
    table, work, xi, b, gram, grown, clock, peak = memory
    lines, all_factors, all_inverses = table
    sig, factors, inverses = work
    statistic, weight = np.empty((r.shape[0], size.size)), np.empty((r.shape[0], size.size))
    N, l, n, D, W = A.shape[0], C.shape[0], into_state.shape[1], xi.shape[0], xi.shape[2]  # noqa: E741
    raw, later, z, total = np.empty((l, W)), np.empty((N, W)), np.empty((D, W)), np.empty(W)
    for t in range(r.shape[0]):
        k = clock[0]
        slot, valid = k % W, min(k + 1, W)
        shift, oldest = W - 1 - slot, (k + 1) % W
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
                    v, line, target = r[t, o], lines[j, o], b[j]
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
                    accumulate(v, grown, xi[j, i], valid)
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
        for c in range(size.size):
            d, own, start, moves = size[c], first[c], pair, moving[first[c]]
            fixed = tabled and not moves
            for i in range(0 if fixed else d):
                for h in range(i + 1):
                    line, low, diagonal = gram[pair], factors[pair], inverses[own + h]
                    for o in range(l):
                        x, y = sig[own + i, o], sig[own + h, o]
                        for a in range(valid):
                            line[a] += x[a] * y[a]
                    for a in range(valid):
                        low[a] = line[a]
                    for q in range(h):
                        x, y = factors[start + i * (i + 1) // 2 + q], factors[start + h * (h + 1) // 2 + q]
                        for a in range(valid):
                            low[a] -= x[a] * y[a]
                    if h == i:
                        weight[t, c] = low[oldest] if k + 1 >= W else -1.0
                        for a in range(valid):
                            v = low[a]
                            diagonal[a] = 1.0 / np.sqrt(v) if v > DEPENDENT * line[a] and v > 0.0 else 0.0
                    for a in range(valid):
                        low[a] *= diagonal[a]
                    pair += 1
            pair = start
            rows, diagonals, at = (all_factors, all_inverses, shift) if fixed else (factors, inverses, 0)
            for a in range(valid):
                total[a] = 0.0
            for i in range(d):
                target, source, diagonal = z[i], b[own + i], diagonals[own + i]
                for a in range(valid):
                    target[a] = source[a]
                for h in range(i):
                    x, y = rows[pair + h], z[h]
                    for a in range(valid):
                        target[a] -= x[at + a] * y[a]
                pair += i + 1
                for a in range(valid):
                    target[a] *= diagonal[at + a]
                    total[a] += target[a] * target[a]
            best, where = 0.0, 0.0
            for a in range(valid):
                if total[a] > best and grown[a] >= least[c] and not (moves and grown[a] > k):
                    best, where = total[a], grown[a]
            statistic[t, c], peak[c] = best, int(where)
            over = over or best > limit[c]
        clock[0] = k + 1
        if over:
            return t + 1, statistic, weight
    return r.shape[0], statistic, weight
