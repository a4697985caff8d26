"""Compiled steps of the monitor: the predictor with its carried faults, and the search of one window, sample by sample.

The search holds, for every onset of the window, the correlation b and the product G of every signature with itself;
each sample adds to them. What a unit jolt of the state at sample k - j leaves in the whitened innovation of sample k is
H[j] = W C F^j, and what one of the output leaves is N[j]; the signature of a lasting fault is the sum of its jolts from
the onset to k, that of a drift the sum of lasting ones. All arrays over onsets have the onset last and grow to the
right, so that the loops run over contiguous numbers; when they are full the window moves back to the left end.

Faults that were named are carried as unknown constants beside the state (B. Friedland, Treatment of bias in recursive
filtering, IEEE Trans. Automatic Control 14, 1969): the estimate nu with covariance P corrects the state of the
predictor by V nu at every sample (A. S. Willsky, H. L. Jones, A generalized likelihood ratio approach..., IEEE Trans.
Automatic Control 21, 1976), and the signatures of later faults lose what that estimate would take of them, `beta`.
"""

import numpy as np
from numba import njit

from optid.models.state_kernels import value_and_slope

LASTING, DRIFT, JUMP, DRIVEN = 0, 1, 2, 3
"""The course of a column after its onset: 1, 1 2 3 .., 1 0 0 .., minus f of the input."""

K, FIRST, DIRTY, PHASE, ALARM, NAMED, NAMED_AT, QUIET, ACTIVE, PLACE, BEGUN, FOUND = range(12)
"""Places of `State.counts`: samples seen, first onset of the window, last sample with a missing reading or a carried
fault, phase, sample of the alarm, candidate named, when, samples below the release level, number of carried directions,
place of the newest onset in the arrays, first sample after the last missing input, samples of `FIRST` that count."""

WATCHING, NAMING, SETTLING, LOST = 0, 1, 2, 3
"""Phases: no alarm; alarm, not named; named, size still growing sharp; alarm that no candidate explains."""

ALARMED, ISOLATED, CLEARED, UNTESTABLE, TESTABLE, STRANGE = 0, 1, 2, 3, 4, 5
"""Kinds of events."""

START = -1
"""Owner of the directions of an unknown state."""

CERTAINTY, RELEASE, PATIENCE, SETTLE, STILL, FADED, LEARNED, FORGIVEN, WIDE, ODD = range(10)
"""Places of `Tables.rules`; see `optid.faults.monitoring`."""

SHARE = 1e-9
"""Directions of a product below this share of the largest one explain nothing; as in `optid.faults.sweeps`."""


@njit(cache=True, nogil=True, error_model="numpy")
def expand(tables, input_of, u, f):
    """Write the functions (T, r) of the inputs (T, m); return the first sample refused, or -1."""
    for k in range(u.shape[0]):
        for j in range(input_of.size):
            v = u[k, input_of[j]]
            if np.isnan(v):
                f[k, j] = np.nan
                continue
            value, _, refused = value_and_slope(tables, j, v)
            if refused:
                return k
            f[k, j] = value
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def factor(M, d):
    """Replace the lower triangle of a symmetric (d, d) by its Cholesky factor, zero columns for what is nothing."""
    largest = 0.0
    for i in range(d):
        largest = max(largest, M[i, i])
    for j in range(d):
        pivot = M[j, j]
        for a in range(j):
            pivot -= M[j, a] * M[j, a]
        there = pivot > SHARE * largest and pivot > 1e-300
        root = np.sqrt(pivot) if there else 0.0
        M[j, j] = root
        for i in range(j + 1, d):
            total = M[i, j]
            for a in range(j):
                total -= M[i, a] * M[j, a]
            M[i, j] = total / root if there else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def onset_of_window(t, s):
    """Take in one more onset: the newest sample becomes one, the oldest leaves a full window."""
    W, size = t.H.shape[2], s.b.shape[1]
    place = s.counts[PLACE] + 1
    if place == size:
        keep = W - 1
        for part in (s.b, s.G):
            for j in range(part.shape[0]):
                for a in range(keep):
                    part[j, a] = part[j, size - keep + a]
        for part in (s.g, s.h, s.beta):
            for i in range(part.shape[0]):
                for j in range(part.shape[1]):
                    for a in range(keep):
                        part[i, j, a] = part[i, j, size - keep + a]
        for o in range(s.shown.shape[0]):
            for a in range(keep):
                s.shown[o, a] = s.shown[o, size - keep + a]
        for a in range(keep):
            s.energy[a] = s.energy[size - keep + a]
        place = keep
    s.counts[PLACE] = place
    for j in range(s.b.shape[0]):
        s.b[j, place] = 0.0
        for q in range(s.beta.shape[0]):
            s.beta[q, j, place] = 0.0
    for j in range(s.G.shape[0]):
        s.G[j, place] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def drives(t, s, f):
    """Write what the driven columns add at this sample."""
    place = s.counts[PLACE]
    for m in range(t.driven.size):
        for i in range(s.g.shape[1]):
            total = 0.0
            for j in range(f.size):
                total += t.drive_state[m, i, j] * s.before[j]
            s.g[m, i, place] = total
        for o in range(s.h.shape[1]):
            total = 0.0
            for j in range(f.size):
                total += t.drive_output[m, o, j] * f[j]
            s.h[m, o, place] = total


@njit(cache=True, nogil=True, error_model="numpy")
def added(t, s, j, i, place):
    """What column j adds to state i at a place of the window, per unit of its course."""
    return t.into_state[i, j] if t.course[j] != DRIVEN else s.g[t.which[j], i, place]


@njit(cache=True, nogil=True, error_model="numpy")
def shown(t, s, j, o, place):
    """What column j adds to output o at a place of the window, per unit of its course."""
    return t.into_output[o, j] if t.course[j] != DRIVEN else s.h[t.which[j], o, place]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def chain(t, s, count):
    """Responses H and N of a window with missing readings, written to the scratch, newest onset last."""
    W, (l, n) = t.H.shape[2], t.C.shape  # noqa: E741
    place = s.counts[PLACE]
    R, H, N, moved = s.whitening, s.H, s.N, s.moved
    for o in range(l):
        for a in range(l):
            N[o, a, W - 1] = R[o, a]
        for i in range(n):
            total = 0.0
            for a in range(l):
                total += R[o, a] * t.C[a, i]
            H[o, i, W - 1] = total
    for back in range(1, count):
        at = W - 1 - back
        for o in range(l):
            for a in range(l):
                there = s.shown[a, place - back]
                total = 0.0
                for i in range(n):
                    total += H[o, i, at + 1] * (-t.K[i, a] if there else t.L[i, a])
                N[o, a, at] = total
            for i in range(n):
                total = 0.0
                for j in range(n):
                    total += H[o, j, at + 1] * t.A[j, i]
                for a in range(l):
                    total += N[o, a, at] * t.C[a, i]
                moved[i] = total
            for i in range(n):
                H[o, i, at] = moved[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def signatures(t, s, count, clean):
    """Write the signatures of this sample of all onsets to the scratch; of a clean window only the driven columns."""
    W, (l, n) = t.H.shape[2], t.C.shape  # noqa: E741
    begin, left = W - count, s.counts[PLACE] - count + 1
    H, N = (t.H, t.N) if clean else (s.H, s.N)
    for j in range(t.course.size):
        driven = t.course[j] == DRIVEN
        if clean and not driven:
            continue
        m = t.which[j]
        for o in range(l):
            row = s.S[j, o]
            for a in range(begin, W):
                row[a] = 0.0
            for i in range(n):
                if driven:
                    for a in range(count):
                        row[begin + a] += H[o, i, begin + a] * s.g[m, i, left + a]
                elif t.into_state[i, j] != 0.0:
                    for a in range(count):
                        row[begin + a] += H[o, i, begin + a] * t.into_state[i, j]
            for i in range(l):
                if driven:
                    for a in range(count):
                        row[begin + a] += N[o, i, begin + a] * s.h[m, i, left + a]
                elif t.into_output[i, j] != 0.0:
                    for a in range(count):
                        row[begin + a] += N[o, i, begin + a] * t.into_output[i, j]
            sums = 0 if t.course[j] == JUMP else 2 if t.course[j] == DRIFT else 1
            for _ in range(sums):
                for a in range(W - 2, begin - 1, -1):
                    row[a] += row[a + 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def learned(t, s, count):
    """Take out of the signatures what the estimates of the carried faults take of them at this sample."""
    W, l = t.H.shape[2], t.C.shape[0]  # noqa: E741
    begin, left = W - count, s.counts[PLACE] - count + 1
    active = s.counts[ACTIVE]
    for j in range(t.course.size):
        for o in range(l):
            for q in range(active):
                weight = s.S0[o, q]
                for a in range(count):
                    s.S[j, o, begin + a] -= weight * s.beta[q, j, left + a]
        for q in range(active):
            for o in range(l):
                weight = s.gain[q, o]
                for a in range(count):
                    s.beta[q, j, left + a] += weight * s.S[j, o, begin + a]
        for o in range(l - 1, -1, -1):  # lower triangular
            for a in range(count):
                s.S[j, o, begin + a] *= s.turn[o, o]
            for i in range(o):
                weight = s.turn[o, i]
                for a in range(count):
                    s.S[j, o, begin + a] += weight * s.S[j, i, begin + a]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def absorb(t, s, count, clean):
    """Add one sample to the correlations and products of all onsets, and write the statistics of the candidates."""
    W, l = t.H.shape[2], t.C.shape[0]  # noqa: E741
    begin, left = W - count, s.counts[PLACE] - count + 1
    for j in range(t.course.size):
        source = t.trace if clean and t.course[j] != DRIVEN else s.S
        for o in range(l):
            weight = s.r[o]
            for a in range(count):
                s.b[j, left + a] += weight * source[j, o, begin + a]
    for c in range(t.size.size):
        d, own, pair = t.size[c], t.first[c], t.pair[c]
        tabulated = clean and t.additive[c]
        if not tabulated:
            for i in range(d):
                for j in range(i + 1):
                    first, second = (t.trace if clean and t.course[own + i] != DRIVEN else s.S,
                                     t.trace if clean and t.course[own + j] != DRIVEN else s.S)
                    for o in range(l):
                        for a in range(count):
                            s.G[pair, left + a] += first[own + i, o, begin + a] * second[own + j, o, begin + a]
                    pair += 1
        pair = t.pair[c]
        line = s.line
        since = max(t.least[c] - 1, 0)
        # a loss needs the input of the sample before its onset
        early = max(0, s.counts[BEGUN] + 1 - (s.counts[K] - count + 1)) if not t.additive[c] else 0
        stop = count - since
        if d == 1:
            if tabulated:
                for a in range(early, stop):
                    z = s.b[own, left + a] * t.roots[t.place[c], begin + a]
                    line[a] = z * z
            else:
                for a in range(early, stop):
                    line[a] = s.b[own, left + a] * s.b[own, left + a] / max(s.G[pair, left + a], 1e-300)
        elif tabulated:
            for a in range(early, stop):
                line[a] = 0.0
            for i in range(d):
                for a in range(early, stop):
                    s.other[a] = 0.0
                for j in range(d):
                    row = t.roots[t.place[c] + i * d + j]
                    for a in range(early, stop):
                        s.other[a] += row[begin + a] * s.b[own + j, left + a]
                for a in range(early, stop):
                    line[a] += s.other[a] * s.other[a]
        elif d == 2:
            for a in range(early, stop):
                x, y = s.b[own, left + a], s.b[own + 1, left + a]
                g, cross, h = s.G[pair, left + a], s.G[pair + 1, left + a], s.G[pair + 2, left + a]
                total, rest = g + h, g * h - cross * cross
                if rest > SHARE * total * total:
                    line[a] = (h * x * x - 2 * cross * x * y + g * y * y) / rest
                elif total > 1e-300:
                    line[a] = (g * x * x + 2 * cross * x * y + h * y * y) / (total * total)
                else:
                    line[a] = 0.0
        else:
            for a in range(early, stop):
                load(t, s, c, left + a, begin + a, False)
                total = 0.0
                for i in range(d):
                    z = s.b[own + i, left + a]
                    for j in range(i):
                        z -= s.M[i, j] * s.z[j]
                    s.z[i] = z / s.M[i, i] if s.M[i, i] > 0.0 else 0.0
                    total += s.z[i] * s.z[i]
                line[a] = total
        best, where = -1.0, -1
        for a in range(early, stop):
            if line[a] > best:
                best, where = line[a], a
        s.statistic[c] = max(best, 0.0)
        s.peak[c] = s.counts[K] - count + 1 + where if where >= 0 else -1


@njit(cache=True, nogil=True, error_model="numpy")
def load(t, s, c, place, column, clean):
    """Write the Cholesky factor of the product of a candidate at an onset to the scratch."""
    d, pair = t.size[c], t.pair[c]
    for i in range(d):
        for j in range(i + 1):
            s.M[i, j] = t.gram[pair, column] if clean else s.G[pair, place]
            pair += 1
    factor(s.M, d)


@njit(cache=True, nogil=True, error_model="numpy")
def search(t, s):
    """One step of the search: the innovation of this sample is s.r, its whitening s.whitening."""
    W = t.H.shape[2]
    k = s.counts[K]
    count = min(k - s.counts[FIRST] + 1, W)
    if count < 1:
        for c in range(t.size.size):
            s.statistic[c], s.peak[c] = 0.0, -1
        return count
    clean = k - s.counts[DIRTY] >= W
    if not clean:
        if k - s.counts[DIRTY] == 0 and s.counts[FOUND] == 0:  # the products have been read from the tables so far
            place = s.counts[PLACE]
            for c in range(t.size.size):
                if t.additive[c]:
                    for p in range(t.pair[c], t.pair[c] + t.size[c] * (t.size[c] + 1) // 2):
                        for back in range(1, count):
                            s.G[p, place - back] = t.gram[p, W - back]
        s.counts[FOUND] = 1
        chain(t, s, count)
    else:
        s.counts[FOUND] = 0
    signatures(t, s, count, clean)
    if s.counts[ACTIVE] > 0:
        learned(t, s, count)
    absorb(t, s, count, clean)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def whiten(t, s, place):
    """Write the whitening of the readings present to the scratch."""
    l = t.C.shape[0]  # noqa: E741
    complete, index = True, s.index
    count = 0
    for o in range(l):
        if s.shown[o, place]:
            index[count] = o
            count += 1
        else:
            complete = False
    for o in range(l):
        for a in range(l):
            s.whitening[o, a] = t.root[o, a] if complete else 0.0
    if complete:
        return
    for i in range(count):
        for j in range(i + 1):
            s.M[i, j] = t.covariance[index[i], index[j]]
    factor(s.M, count)
    for column in range(count):  # the inverse of the factor
        for i in range(column, count):
            total = 1.0 if i == column else 0.0
            for j in range(column, i):
                total -= s.M[i, j] * s.whitening[index[j], index[column]]
            s.whitening[index[i], index[column]] = total / s.M[i, i]


@njit(cache=True, nogil=True, error_model="numpy")
def innovate(t, s, f, y):
    """Predict this sample with the faults that are carried, correct state and faults, write the innovation."""
    (l, n), place, active = t.C.shape, s.counts[PLACE], s.counts[ACTIVE]  # noqa: E741
    x, V, P = s.x, s.V, s.P
    for q in range(active):
        j = s.column[q]
        if j >= 0 and t.course[j] != JUMP:
            if t.course[j] == DRIFT:
                s.grown[q] += 1.0
            for i in range(n):
                step = added(t, s, j, i, place) * s.grown[q]
                V[i, q] += step
                x[i] += step * s.nu[q]
    for j in range(t.course.size):
        s.held[j] += s.slope[j]
        if s.held[j] != 0.0:
            for i in range(n):
                x[i] += added(t, s, j, i, place) * s.held[j]
    for o in range(l):
        total = t.offset_y[o]
        for i in range(n):
            total += t.C[o, i] * x[i]
        for j in range(f.size):
            total += t.D[o, j] * f[j]
        for j in range(t.course.size):
            if s.held[j] != 0.0:
                total += shown(t, s, j, o, place) * s.held[j]
        for q in range(active):
            deviation = 0.0
            for i in range(n):
                deviation += t.C[o, i] * V[i, q]
            j = s.column[q]
            if j >= 0 and t.course[j] != JUMP:
                step = shown(t, s, j, o, place) * s.grown[q]
                deviation += step
                total += step * s.nu[q]
            s.raw[o, q] = deviation
        s.predicted[o] = total
        s.shown[o, place] = not np.isnan(y[o])
    whiten(t, s, place)
    for o in range(l):
        s.r[o] = 0.0
        for a in range(l):
            if s.shown[a, place]:
                s.r[o] += s.whitening[o, a] * (y[a] - s.predicted[a])
    if active > 0:
        correct(t, s)
    s.energy[place] = 0.0
    for o in range(l):
        s.energy[place] += s.r[o] * s.r[o]
    later = s.later
    for i in range(n):
        total = t.offset_x[i]
        for j in range(n):
            total += t.A[i, j] * x[j]
        for j in range(f.size):
            total += t.B[i, j] * f[j]
        for o in range(l):
            if s.shown[o, place]:
                total += t.L[i, o] * y[o] + t.K[i, o] * (y[o] - s.predicted[o])
            else:
                total += t.L[i, o] * s.predicted[o]
        later[i] = total
    for j in range(t.output_of.size):
        o = t.output_of[j]
        fed, _, refused = value_and_slope(t.feedback, j, y[o] if s.shown[o, place] else s.predicted[o])
        if refused:
            return False
        for i in range(n):
            later[i] += t.E[i, j] * fed
    for i in range(n):
        x[i] = later[i]
    for q in range(active):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += t.A[i, j] * V[j, q]
            for o in range(l):
                total += (-t.K[i, o] if s.shown[o, place] else t.L[i, o]) * s.raw[o, q]
            later[i] = total
        for i in range(n):
            V[i, q] = later[i]
    for j in range(f.size):
        s.before[j] = f[j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def correct(t, s):
    """Correct the estimates of the carried faults and the state by the innovation, and whiten it anew."""
    (l, n), active, W = t.C.shape, s.counts[ACTIVE], t.H.shape[2]  # noqa: E741
    P, S0, Z = s.P, s.S0, s.Z
    for o in range(l):
        for q in range(active):
            total = 0.0
            for a in range(l):
                total += s.whitening[o, a] * s.raw[a, q]
            S0[o, q] = total
        for q in range(active):
            total = 0.0
            for p in range(active):
                total += S0[o, p] * P[p, q]
            Z[o, q] = total
    for o in range(l):
        for a in range(o + 1):
            total = 1.0 if a == o else 0.0
            for q in range(active):
                total += Z[o, q] * S0[a, q]
            s.M[o, a] = total
    factor(s.M, l)
    for column in range(l):
        for o in range(l):
            s.turn[o, column] = 0.0
        for o in range(column, l):
            total = 1.0 if o == column else 0.0
            for a in range(column, o):
                total -= s.M[o, a] * s.turn[a, column]
            s.turn[o, column] = total / s.M[o, o]
    for q in range(active):  # Z becomes turn S0 P, whose transpose times itself leaves P
        for o in range(l - 1, -1, -1):
            total = 0.0
            for a in range(o + 1):
                total += s.turn[o, a] * Z[a, q]
            Z[o, q] = total
    for q in range(active):
        for a in range(l):
            total = 0.0
            for o in range(a, l):
                total += Z[o, q] * s.turn[o, a]
            s.gain[q, a] = total
        change = 0.0
        for a in range(l):
            change += s.gain[q, a] * s.r[a]
        s.nu[q] += change
        for i in range(n):
            s.x[i] += s.V[i, q] * change
        for o in range(l):
            s.predicted[o] += s.raw[o, q] * change
        energy = 0.0
        for o in range(l):
            energy += S0[o, q] * S0[o, q]
        s.power[q] += (energy - s.power[q]) / W
    for p in range(active):
        for q in range(active):
            for o in range(l):
                P[p, q] -= Z[o, p] * Z[o, q]
    for o in range(l - 1, -1, -1):
        total = 0.0
        for a in range(o + 1):
            total += s.turn[o, a] * s.r[a]
        s.r[o] = total


@njit(cache=True, nogil=True, error_model="numpy")
def estimate(t, s, c, sizes, covariance):
    """Write the magnitudes of a candidate at its peak, and their covariance."""
    W, d, own = t.H.shape[2], t.size[c], t.first[c]
    back = s.counts[K] - s.peak[c]
    place = s.counts[PLACE] - back
    load(t, s, c, place, W - 1 - back, t.additive[c] and s.counts[FOUND] == 0)
    M = s.M
    for column in range(d):  # the inverse of the factor, row by row
        for i in range(d):
            s.T[i, column] = 0.0
        for i in range(column, d):
            if M[i, i] > 0.0:
                total = 1.0 if i == column else 0.0
                for j in range(column, i):
                    total -= M[i, j] * s.T[j, column]
                s.T[i, column] = total / M[i, i]
    for i in range(d):
        sizes[i] = 0.0
        for j in range(d):
            total = 0.0
            if M[i, i] > 0.0 and M[j, j] > 0.0:
                for a in range(d):
                    total += s.T[a, i] * s.T[a, j]
            covariance[i, j] = total
        for j in range(d):
            sizes[i] += covariance[i, j] * s.b[own + j, place]


@njit(cache=True, nogil=True, error_model="numpy")
def forget(s, q):
    """Take a carried direction out; state and the other estimates stay as they are."""
    last = s.counts[ACTIVE] - 1
    for p in range(q, last):
        for i in range(s.V.shape[0]):
            s.V[i, p] = s.V[i, p + 1]
        s.nu[p], s.grown[p], s.power[p] = s.nu[p + 1], s.grown[p + 1], s.power[p + 1]
        s.column[p], s.owner[p] = s.column[p + 1], s.owner[p + 1]
        for j in range(s.beta.shape[1]):
            for a in range(s.beta.shape[2]):
                s.beta[p, j, a] = s.beta[p + 1, j, a]
    for p in range(q, last):
        for i in range(last + 1):
            s.P[p, i] = s.P[p + 1, i]
    for p in range(q, last):
        for i in range(last):
            s.P[i, p] = s.P[i, p + 1]
    for j in range(s.beta.shape[1]):
        for a in range(s.beta.shape[2]):
            s.beta[last, j, a] = 0.0
    s.counts[ACTIVE] = last


@njit(cache=True, nogil=True, error_model="numpy")
def settle(t, s, q):
    """Keep the estimate of a carried direction as it is, and stop estimating it."""
    j = s.column[q]
    if j >= 0 and t.course[j] != JUMP:
        s.held[j] += s.nu[q] * s.grown[q]
        if t.course[j] == DRIFT:
            s.slope[j] += s.nu[q]
    forget(s, q)


@njit(cache=True, nogil=True, error_model="numpy")
def take_up(t, s, owner, count):
    """Make room for directions of one owner; return the place of the first."""
    while s.counts[ACTIVE] + count > s.nu.size:
        settle(t, s, 0)
    begin = s.counts[ACTIVE]
    for q in range(begin, begin + count):
        s.owner[q] = owner
        s.column[q] = -1 if owner == START else t.first[owner] + q - begin
        s.nu[q], s.grown[q], s.power[q] = 0.0, 1.0, 0.0
        for i in range(s.V.shape[0]):
            s.V[i, q] = 0.0
        for p in range(begin + count):
            s.P[p, q] = 0.0
            s.P[q, p] = 0.0
    s.counts[ACTIVE] = begin + count
    return begin


@njit(cache=True, nogil=True, error_model="numpy")
def lose_state(t, s):
    """From the next sample on the state is unknown: whatever was known of it is left as a very wide prior."""
    q = 0
    while q < s.counts[ACTIVE]:
        if s.owner[q] == START:
            forget(s, q)
        else:
            q += 1
    n = s.x.size
    begin = take_up(t, s, START, n)
    for i in range(n):
        s.V[i, begin + i] = 1.0
        s.P[begin + i, begin + i] = t.rules[WIDE]


@njit(cache=True, nogil=True, error_model="numpy")
def carry(t, s, c):
    """Correct the state by the estimate of a candidate at its peak and carry it; the search begins anew."""
    (l, n), d, k = t.C.shape, t.size[c], s.counts[K]  # noqa: E741
    estimate(t, s, c, s.sizes, s.spread)
    onset, place = s.peak[c], s.counts[PLACE] - (k - s.peak[c])
    room = s.counts[ACTIVE]
    while room + d > s.nu.size:
        settle(t, s, 0)
        room = s.counts[ACTIVE]
    for p in range(room):
        for i in range(d):
            s.taken[p, i] = s.beta[p, t.first[c] + i, place]
    begin = take_up(t, s, c, d)
    later = s.later
    for i in range(d):  # what the candidate has done to the state from its onset to the next sample
        j, q = t.first[c] + i, begin + i
        grown = 0.0
        for tau in range(onset, k + 1):
            at = place + tau - onset
            grown = grown + 1.0 if t.course[j] == DRIFT else 1.0
            if t.course[j] == JUMP and tau > onset:
                grown = 0.0
            for a in range(n):
                s.V[a, q] += added(t, s, j, a, at) * grown
                later[a] = 0.0
            for a in range(n):
                for b in range(n):
                    later[a] += t.A[a, b] * s.V[b, q]
            for o in range(l):
                deviation = shown(t, s, j, o, at) * grown
                for b in range(n):
                    deviation += t.C[o, b] * s.V[b, q]
                for a in range(n):
                    later[a] += (-t.K[a, o] if s.shown[o, at] else t.L[a, o]) * deviation
            for a in range(n):
                s.V[a, q] = later[a]
        s.grown[q] = grown
    for i in range(d):
        q = begin + i
        s.nu[q] = s.sizes[i]
        for a in range(n):
            s.x[a] += s.V[a, q] * s.sizes[i]
        for p in range(begin):
            change = -s.taken[p, i] * s.sizes[i]
            s.nu[p] += change
            for a in range(n):
                s.x[a] += s.V[a, p] * change
        for j in range(d):
            s.P[q, begin + j] = s.spread[i, j]
    for p in range(begin):
        for i in range(d):
            total = 0.0
            for j in range(d):
                total -= s.taken[p, j] * s.spread[j, i]
            s.P[p, begin + i] = total
            s.P[begin + i, p] = total
    for p in range(begin):
        for q in range(begin):
            for i in range(d):
                s.P[p, q] -= s.P[p, begin + i] * s.taken[q, i]
    s.counts[FIRST] = k + 1


@njit(cache=True, nogil=True, error_model="numpy")
def total_of(t, s, c):
    """Write the whole of what is carried of a candidate, and return its significance; -1 where nothing is estimated."""
    d, active = t.size[c], 0
    for i in range(d):
        j = t.first[c] + i
        s.sizes[i] = s.slope[j] if t.course[j] == DRIFT else s.held[j]
        for a in range(d):
            s.M[i, a] = 0.0
    for q in range(s.counts[ACTIVE]):
        if s.owner[q] == c:
            active += 1
            s.sizes[s.column[q] - t.first[c]] += s.nu[q]
            for p in range(s.counts[ACTIVE]):
                if s.owner[p] == c:
                    s.M[s.column[q] - t.first[c], s.column[p] - t.first[c]] += s.P[q, p]
    if active == 0:
        return -1.0
    factor(s.M, d)
    total = 0.0
    for i in range(d):
        z = s.sizes[i]
        for j in range(i):
            z -= s.M[i, j] * s.z[j]
        s.z[i] = z / s.M[i, i] if s.M[i, i] > 0.0 else 0.0
        total += s.z[i] * s.z[i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def review(t, s):
    """Drop carried faults that have died out or gone, stop estimating those known well; return one that is gone."""
    W, n = t.H.shape[2], s.x.size
    strength = 0.0
    for o in range(t.C.shape[0]):
        for i in range(n):
            total = 0.0
            for a in range(t.C.shape[0]):
                total += t.root[o, a] * t.C[a, i]
            strength += total * total
    begin = 0
    while begin < s.counts[ACTIVE]:
        end = begin + 1  # directions that were taken up together
        while end < s.counts[ACTIVE] and s.owner[end] == s.owner[begin] and s.column[end] != s.column[begin] and (
            s.owner[end] == START or s.column[end] == s.column[end - 1] + 1
        ) and (s.owner[end] != START or end - begin < n):
            end += 1
        c = s.owner[begin]
        passing = c == START or t.course[s.column[begin]] == JUMP
        left = 0.0
        for q in range(begin, end):
            size = 0.0
            if passing:
                for i in range(n):
                    size += s.V[i, q] * s.V[i, q]
                left += strength * size * (s.P[q, q] + s.nu[q] * s.nu[q])
            else:
                left += W * s.power[q] * s.P[q, q]
        if passing and left < t.rules[FADED]:
            for q in range(end - 1, begin - 1, -1):
                forget(s, q)
            if c != START:
                return c
            continue
        if not passing and t.course[s.column[begin]] != DRIFT and total_of(t, s, c) < t.rules[FORGIVEN] * t.q[c]:
            for q in range(s.counts[ACTIVE] - 1, -1, -1):
                if s.owner[q] == c:
                    forget(s, q)
            for i in range(t.size[c]):
                s.held[t.first[c] + i] = 0.0
            return c
        if not passing and s.power[begin] > 0.0 and left < t.rules[LEARNED]:
            for q in range(end - 1, begin - 1, -1):
                settle(t, s, q)
            continue
        begin = end
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def excited(t, s, c):
    """What a whole loss would leave in the window that no constant of the same actuator can leave."""
    d, pair = t.size[c], t.pair[c]
    place = s.counts[PLACE] - t.H.shape[2] + 1
    if d == 1:
        return s.G[pair, place]
    for i in range(d):  # the loss last, so that its pivot is what the constants leave of it
        for j in range(i + 1):
            a, b = d - 1 - i, d - 1 - j
            s.M[i, j] = s.G[pair + b * (b + 1) // 2 + a, place]
    factor(s.M, d)
    return s.M[d - 1, d - 1] ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def record(t, s, kind, c, events, row):
    """Write one event: kind, sample, candidate, onset, statistic, gains of all candidates, magnitudes."""
    line = events[row]
    line[:] = 0.0
    line[0], line[1], line[2], line[3], line[4] = kind, s.counts[K], c, -1.0, 0.0
    if c >= 0:
        line[3], line[4] = s.peak[c], s.statistic[c]
    for i in range(t.size.size):
        line[5 + i] = s.statistic[i] - t.q[i]
    if c >= 0 and (kind == ALARMED or kind == ISOLATED) and s.peak[c] >= 0:
        estimate(t, s, c, s.sizes, s.spread)
        for i in range(t.size[c]):
            line[5 + t.size.size + i] = s.sizes[i]


@njit(cache=True, nogil=True, error_model="numpy")
def strange(t, s, c):
    """Whether the best candidate leaves more than noise since its onset, and on how many readings that rests."""
    l, readings, energy = t.C.shape[0], 0, 0.0  # noqa: E741
    for back in range(s.counts[K] - s.peak[c] + 1):
        at = s.counts[PLACE] - back
        energy += s.energy[at]
        for o in range(l):
            readings += s.shown[o, at]
    free = readings - t.size[c]
    if free < 1:
        return False, free
    # Wilson and Hilferty: the cube root of chi2 / free is nearly Gaussian
    spread = 2.0 / (9.0 * free)
    z = ((max(energy - s.statistic[c], 0.0) / free) ** (1.0 / 3.0) - 1.0 + spread) / np.sqrt(spread)
    return z > t.rules[ODD], free


@njit(cache=True, nogil=True, error_model="numpy")
def judge(t, s, count, events, row):
    """Decide what this sample means; return whether an event was written."""
    counts, k, W = s.counts, s.counts[K], t.H.shape[2]
    best, quiet = -1, True
    for c in range(t.size.size):
        if s.peak[c] >= 0:
            if best < 0 or s.statistic[c] - t.q[c] > s.statistic[best] - t.q[best]:
                best = c
            if s.statistic[c] > t.rules[RELEASE] * t.q[c]:
                quiet = False
    if best < 0:
        return False
    gain = s.statistic[best] - t.q[best]
    counts[QUIET] = counts[QUIET] + 1 if quiet else 0
    if counts[PHASE] == WATCHING:
        if gain > 0.0:
            counts[PHASE], counts[ALARM] = NAMING, k
            record(t, s, ALARMED, best, events, row)
            return True
        if counts[ACTIVE] > 0:
            gone = review(t, s)
            if gone >= 0:
                record(t, s, CLEARED, gone, events, row)
                return True
        if count == W:
            for c in range(t.size.size):
                if not t.additive[c] and k - counts[BEGUN] >= W:
                    weight = excited(t, s, c)
                    if s.tested[c] and weight < t.q[c]:
                        s.tested[c] = False
                        record(t, s, UNTESTABLE, c, events, row)
                        events[row, 4] = weight
                        return True
                    if not s.tested[c] and weight > 1.2 * t.q[c]:
                        s.tested[c] = True
                        record(t, s, TESTABLE, c, events, row)
                        events[row, 4] = weight
                        return True
        return False
    if counts[PHASE] == LOST:
        if gain > 0.0:
            counts[PHASE], counts[ALARM] = NAMING, k
        elif counts[QUIET] >= t.rules[STILL]:
            counts[PHASE], counts[NAMED] = WATCHING, -1
            record(t, s, CLEARED, -1, events, row)
            return True
        return False
    if counts[PHASE] == NAMING and counts[QUIET] >= t.rules[STILL]:
        counts[PHASE], counts[NAMED] = WATCHING, -1
        record(t, s, CLEARED, -1, events, row)
        return True
    rivals = 0.0
    for c in range(t.size.size):
        if s.peak[c] >= 0:
            rivals += np.exp((s.statistic[c] - t.q[c] - gain) / 2.0)
    sure = 1.0 / rivals >= t.rules[CERTAINTY]
    late = k - counts[ALARM] >= t.rules[PATIENCE]
    if counts[PHASE] == NAMING:
        odd, free = strange(t, s, best)
        if not late and not (sure and gain > 0.0 and free >= 4 and (t.additive[best] or s.tested[best])):
            return False
        if gain <= 0.0:
            counts[PHASE], counts[NAMED] = WATCHING, -1
            record(t, s, CLEARED, -1, events, row)
            return True
    elif k - counts[NAMED_AT] < t.rules[SETTLE]:
        return False
    elif s.peak[counts[NAMED]] < 0:
        counts[PHASE], counts[NAMED] = WATCHING, -1
        record(t, s, CLEARED, -1, events, row)
        return True
    else:
        odd, free = strange(t, s, best if sure else counts[NAMED])
    if odd:
        known = counts[NAMED] == -2
        counts[PHASE], counts[NAMED], counts[FIRST], counts[QUIET] = LOST, -2, k + 1, 0
        if known:
            return False
        record(t, s, STRANGE, best, events, row)
        return True
    if counts[PHASE] == NAMING or (sure and best != counts[NAMED]):
        counts[PHASE], counts[NAMED], counts[NAMED_AT] = SETTLING, best, k
        record(t, s, ISOLATED, best, events, row)
        return True
    carry(t, s, counts[NAMED])
    counts[PHASE], counts[NAMED], counts[QUIET] = WATCHING, -1, 0
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def march(t, s, f, y, events):
    """Take in samples until all are done or the table of events is full.

    Args:
        t: tables of the monitor, `optid.faults.monitor_tables.Tables`.
        s: its state, `optid.faults.monitor_tables.State`, changed in place.
        f: (T, r) functions of the inputs, NaN where an input is missing.
        y: (T, l) readings, NaN where one is missing.
        events: (M, 5 + C + d) written.

    Returns:
        samples taken in, events written, whether the feedback was refused.
    """
    l, W = y.shape[1], t.H.shape[2]  # noqa: E741
    found = 0
    for step in range(y.shape[0]):
        k = s.counts[K]
        blind = False
        for j in range(f.shape[1]):
            missing = np.isnan(f[step, j])
            blind = blind or missing
            s.now[j] = s.before[j] if missing else f[step, j]
        complete = True
        for o in range(l):
            s.reading[o] = y[step, o]
            for j in range(f.shape[1]):
                if t.D[o, j] != 0.0 and np.isnan(f[step, j]):
                    s.reading[o] = np.nan
            complete = complete and not np.isnan(s.reading[o])
        if not complete or s.counts[ACTIVE] > 0:
            s.counts[DIRTY] = k
        onset_of_window(t, s)
        drives(t, s, s.now)
        if not innovate(t, s, s.now, s.reading):
            return step, found, True
        count = search(t, s)
        if blind:
            lose_state(t, s)
            s.counts[BEGUN] = k + 1
        found += judge(t, s, count, events, found)
        s.counts[K] = k + 1
        if found == events.shape[0]:
            return step + 1, found, False
    return y.shape[0], found, False


@njit(cache=True, nogil=True, error_model="numpy")
def rehearse(t, s, f, r, largest):
    """Run the search alone over whitened innovations; write the largest statistics of blocks of samples.

    Args:
        t: tables.
        s: state.
        f: (T, r) functions of the inputs.
        r: (T, l) whitened innovations.
        largest: (B, C) written; a block has T / B samples.
    """
    long = r.shape[0] // largest.shape[0]
    largest[:] = 0.0
    for k in range(long * largest.shape[0]):
        onset_of_window(t, s)
        drives(t, s, f[k])
        for o in range(r.shape[1]):
            s.r[o] = r[k, o]
        search(t, s)
        block = k // long
        for c in range(largest.shape[1]):
            if s.statistic[c] > largest[block, c]:
                largest[block, c] = s.statistic[c]
        for j in range(f.shape[1]):
            s.before[j] = f[k, j]
        s.counts[K] += 1
