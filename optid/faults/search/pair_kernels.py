"""The compiled search for two faults over all candidates and onsets.

The product of the signature of an earlier fault with one of onset k is a bilinear form in the state of the prediction
error that the earlier one causes at k, in its later course, and in the quantities that
`optid.faults.search.sweep_kernels.grams` stores for every onset. So no signature is computed explicitly, and all
products of N onsets and D columns cost O(N^2 D^2 n).
"""

from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.kernel_cache import cached_njit


class Grams(NamedTuple):
    """What the products of signatures of any two onsets follow from, with the tables of a sweep."""

    products: Array  # (N, D, D) of columns with the same onset
    states: Array  # (N, n, D) of a unit state with the columns
    along: Array  # (N, Q, D) the reduction of the products by an uncertain model, and by axes projected out
    roots: Array  # (N, R) inverse roots of the products of every candidate


@cached_njit
def joint_energy(first, second, cosines, floor, work):
    """Return the energy that two subspaces explain together; -1 where the larger one contains the smaller one.

    Coordinates (a,) and (b,) of the window are along the axes of the larger and of the smaller one, with products
    `cosines` (a, b); below `floor` a direction beside the other subspace is part of it; `work` (b, b + 1) is scratch.
    """
    a, b = cosines.shape
    energy = 0.0
    for i in range(a):
        energy += first[i] * first[i]
    for j in range(b):  # the smaller one, and the window along it, orthogonal to the larger one
        left = second[j]
        for i in range(a):
            left -= cosines[i, j] * first[i]
        work[j, b] = left
        for p in range(j + 1):
            total = 1.0 if p == j else 0.0
            for i in range(a):
                total -= cosines[i, j] * cosines[i, p]
            work[j, p] = total
            work[p, j] = total
    kept = 0
    for step in range(b):  # Cholesky factor with pivots
        pivot = step
        for j in range(step + 1, b):
            if work[j, j] > work[pivot, pivot]:
                pivot = j
        if not work[pivot, pivot] > floor:
            break
        if pivot != step:
            for p in range(b + 1):
                work[step, p], work[pivot, p] = work[pivot, p], work[step, p]
            for p in range(b):
                work[p, step], work[p, pivot] = work[p, pivot], work[p, step]
        kept += 1
        energy += work[step, b] * work[step, b] / work[step, step]
        for j in range(step + 1, b):
            share = work[j, step] / work[step, step]
            work[j, b] -= share * work[step, b]
            for p in range(step + 1, b):
                work[j, p] -= share * work[step, p]
    return energy if kept > 0 else -1.0


@cached_njit
def search(tables, grams, tested, z, q, floor):
    """Find the best pair of onsets for every pair of candidates.

    Args:
        tables: `optid.faults.search.sweeps.SweepTables`.
        grams: `Grams`.
        tested: (C, N) which onsets count.
        z: (N, D) coordinates of the window along the axes of every candidate.
        q: (C,) thresholds.
        floor: see `joint_energy`.

    Returns:
        best: (C, C) above the diagonal and on it, largest energy less both thresholds, -inf where none.
        onsets: (C, C, 2) of the first and of the second candidate, -1 where none.
        alike: number of pairs of which only one is seen.
    """
    products, states, along, roots = grams
    of, F, e = tables.of, tables.F, tables.e
    lasting, drifts, helpers = tables.lasting, tables.drifts, tables.helpers
    count, n, columns, candidates = of.size, F.shape[1], e.shape[2], tables.first.size
    most = 1
    for c in range(candidates):
        most = max(most, tables.sizes[c])
    x, later = np.zeros((n, columns)), np.zeros((n, columns))
    cross, cosines = np.zeros((columns, columns)), np.zeros((most, most))
    work = np.zeros((most, most + 1))
    best, onsets = np.empty((candidates, candidates)), np.empty((candidates, candidates, 2), dtype=np.int64)
    for c in range(candidates):
        for other in range(candidates):
            best[c, other], onsets[c, other, 0], onsets[c, other, 1] = -np.inf, -1, -1
    alike, last = 0, 0
    for k in range(count):
        for c in range(candidates):
            if tested[c, k]:
                last = k
    for theta in range(count):
        any_here = False
        for c in range(candidates):
            any_here = any_here or tested[c, theta]
        if not any_here:
            continue
        for a in range(n):
            for i in range(columns):
                x[a, i] = 0.0
        for k in range(theta, last + 1):
            t = of[k]
            age = k - theta
            for i in range(columns):
                goes_on = age == 0 or i < lasting + drifts
                for j in range(columns):
                    cross[i, j] = products[k, i, j] if goes_on else 0.0
                if lasting <= i < lasting + drifts and age > 0:
                    for j in range(columns):
                        cross[i, j] += age * products[k, helpers + i - lasting, j]
                if age > 0:
                    for a in range(n):
                        for j in range(columns):
                            cross[i, j] += x[a, i] * states[k, a, j]
            for p in range(along.shape[1]):
                for i in range(columns):
                    for j in range(columns):
                        cross[i, j] -= along[theta, p, i] * along[k, p, j]
            for c in range(candidates):
                if not tested[c, theta]:
                    continue
                for other in range(candidates):
                    if not tested[other, k] or (age == 0 and other <= c):
                        continue
                    dc, bc, pc = tables.sizes[c], tables.first[c], tables.places[c]
                    do, bo, po = tables.sizes[other], tables.first[other], tables.places[other]
                    if dc == 1 and do == 1:
                        rho = roots[theta, pc] * cross[bc, bo] * roots[k, po]
                        left, beside = z[k, bo] - rho * z[theta, bc], 1.0 - rho * rho
                        energy = z[theta, bc] * z[theta, bc] + left * left / beside if beside > floor else -1.0
                    else:
                        swap = dc < do  # the larger one comes first
                        first, second = (k, theta) if swap else (theta, k)
                        d1, b1, p1, d2, b2, p2 = (do, bo, po, dc, bc, pc) if swap else (dc, bc, pc, do, bo, po)
                        for i in range(d1):
                            for j in range(d2):
                                total = 0.0
                                for a in range(d1):
                                    for b in range(d2):
                                        shared = cross[b2 + b, b1 + a] if swap else cross[b1 + a, b2 + b]
                                        total += roots[first, p1 + i * d1 + a] * shared * roots[second, p2 + j * d2 + b]
                                cosines[i, j] = total
                        energy = joint_energy(z[first, b1 : b1 + d1], z[second, b2 : b2 + d2], cosines[:d1, :d2],
                                              floor, work[:d2, : d2 + 1])
                    if energy < 0:
                        alike += 1
                        continue
                    gain = energy - q[c] - q[other]
                    low, high = min(c, other), max(c, other)
                    if gain > best[low, high]:
                        best[low, high] = gain
                        onsets[low, high, 0], onsets[low, high, 1] = (theta, k) if c <= other else (k, theta)
            if k < last:
                for i in range(columns):
                    share = 1.0 if age == 0 or i < lasting else age + 1.0 if i < lasting + drifts else 0.0
                    for a in range(n):
                        later[a, i] = share * e[t, a, i]
                for a in range(n):
                    for b in range(n):
                        for i in range(columns):
                            later[a, i] += F[t, a, b] * x[b, i]
                for a in range(n):
                    for i in range(columns):
                        x[a, i] = later[a, i]
    return best, onsets, alike
