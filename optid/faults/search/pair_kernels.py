"""The compiled search for two faults over all candidates and onsets.

The product of the signature of a fault that began earlier with one of onset k depends on what the earlier one has left
in the state of the predictor error at k and on how it goes on: a bilinear form in the quantities that
`optid.faults.search.sweep_kernels.grams` keeps for every onset. So no signature is written out, and all products of N
onsets and D columns cost O(N^2 D^2 n).
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def joint_energy(first, second, cosines, floor, work):
    """Return the energy that two subspaces explain together; -1 where nothing of the smaller one is left beside it.

    `first` (a,) and `second` (b,) are coordinates of the window along the axes of the larger and of the smaller one,
    `cosines` (a, b) the products of the axes, `floor` the share of a direction beside the other subspace below which it
    is part of it; `work` (b, b + 1) is overwritten.
    """
    a, b = cosines.shape
    energy = 0.0
    for i in range(a):
        energy += first[i] * first[i]
    for j in range(b):  # what is left of the smaller one beside the larger one, and of the window along it
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


@njit(cache=True, nogil=True, error_model="numpy")
def search(tables, products, states, along, blocks, roots, tested, z, q, same, floor, best, onsets, alike):
    """Find the best pair of onsets for every pair of candidates; return how many pairs cannot be told apart.

    Args:
        tables: `optid.faults.search.sweeps.Tables`.
        products: (N, D, D) of columns with the same onset.
        states: (N, n, D) of a unit state with the columns.
        along: (N, Q, D) what an uncertain model takes off the products.
        blocks: `optid.faults.search.sweeps.Blocks`.
        roots: (N, R) inverse roots of the products.
        tested: (C, N) which onsets count.
        z: (N, D) coordinates of the window along the axes of every candidate.
        q: (C,) thresholds.
        same: whether both faults may be of one candidate.
        floor: see `joint_energy`.
        best: (C, C) written above the diagonal and on it: largest energy less both thresholds, -inf where none.
        onsets: (C, C, 2) written: onsets of the first and of the second candidate.
        alike: (K, 4) written: candidate, onset, candidate, onset of the first K pairs of which only one is seen.
    """
    of, F, e = tables.of, tables.F, tables.e
    lasting, drifts, helpers = tables.lasting, tables.drifts, tables.helpers
    count, n, columns, candidates = of.size, F.shape[1], e.shape[2], blocks.first.size
    most = 1
    for c in range(candidates):
        most = max(most, blocks.sizes[c])
    x, later = np.zeros((n, columns)), np.zeros((n, columns))
    cross, half, cosines = np.zeros((columns, columns)), np.zeros((most, most)), np.zeros((most, most))
    work = np.zeros((most, most + 1))
    found = 0
    for theta in range(count):
        any_here = False
        for c in range(candidates):
            any_here = any_here or tested[c, theta]
        if not any_here:
            continue
        for a in range(n):
            for i in range(columns):
                x[a, i] = 0.0
        for k in range(theta, count):
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
                    if not tested[other, k] or (age == 0 and other <= c) or (other == c and not same):
                        continue
                    dc, bc, pc = blocks.sizes[c], blocks.first[c], blocks.places[c]
                    do, bo, po = blocks.sizes[other], blocks.first[other], blocks.places[other]
                    if dc == 1 and do == 1:
                        rho = roots[theta, pc] * cross[bc, bo] * roots[k, po]
                        left, beside = z[k, bo] - rho * z[theta, bc], 1.0 - rho * rho
                        energy = z[theta, bc] * z[theta, bc] + left * left / beside if beside > floor else -1.0
                    else:
                        for i in range(dc):
                            for j in range(do):
                                half[i, j] = 0.0
                                for a in range(dc):
                                    half[i, j] += roots[theta, pc + i * dc + a] * cross[bc + a, bo + j]
                        for i in range(dc):
                            for j in range(do):
                                total = 0.0
                                for a in range(do):
                                    total += half[i, a] * roots[k, po + j * do + a]
                                if dc >= do:
                                    cosines[i, j] = total
                                else:
                                    cosines[j, i] = total
                        if dc >= do:
                            energy = joint_energy(z[theta, bc : bc + dc], z[k, bo : bo + do], cosines[:dc, :do], floor,
                                                  work[:do, : do + 1])
                        else:
                            energy = joint_energy(z[k, bo : bo + do], z[theta, bc : bc + dc], cosines[:do, :dc], floor,
                                                  work[:dc, : dc + 1])
                    if energy < 0:
                        if found < alike.shape[0]:
                            alike[found, 0], alike[found, 1], alike[found, 2], alike[found, 3] = c, theta, other, k
                        found += 1
                        continue
                    gain = energy - q[c] - q[other]
                    low, high = min(c, other), max(c, other)
                    if gain > best[low, high]:
                        best[low, high] = gain
                        onsets[low, high, 0], onsets[low, high, 1] = (theta, k) if c <= other else (k, theta)
            if k + 1 < count:
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
    return found
