"""Compiled steps of the running search for faults in one window.

The search holds, for every onset of the window, the correlation of the innovations with every signature and the
products of the signatures; each sample adds to them. What a jolt of the state at sample k - j leaves in the whitened
innovation of sample k is H[j] = W C F^j, what one of the output leaves is N[j]. The signature of a lasting fault is the
sum of its jolts from the onset to k, that of a drift the sum of lasting ones. Arrays over onsets grow to the right;
when they are full the window moves back to their left end.
"""

import numpy as np
from numba import njit

from optid.faults.monitor.layout import (
    ACTIVE,
    ADDITIVE,
    BEFORE,
    BEGUN,
    C_H,
    C_LINE,
    C_N,
    C_OTHER,
    CANDIDATES,
    COLUMNS,
    COURSE,
    DIRTY,
    DRIFT,
    DRIVEN,
    DRIVES,
    FIRST,
    FIRST_OF,
    GAIN,
    INTO_OUTPUT,
    INTO_STATE,
    JUMP,
    LEAST,
    LENGTH,
    MOVED,
    NDRIVEN,
    NF,
    NOW,
    NX,
    NY,
    PAIR,
    PEAK,
    PLACE,
    ROOT_AT,
    S0,
    S_GRAM,
    S_OUTPUT,
    S_SHOWN,
    S_STATE,
    S_TAKEN,
    SIZE,
    STATISTIC,
    SUMMED,
    T_GRAM,
    T_N,
    T_ROOT,
    T_TRACE,
    TAKE,
    TURN,
    WHICH,
    WHITENING,
    WINDOW,
    Z1,
    A,
    C,
    L,
    M,
    R,
)

SHARE = 1e-9
"""Directions of a product below this share of the largest one explain nothing; as in `optid.faults.search.sweeps`."""


@njit(cache=True, nogil=True, error_model="numpy")
def factor(m, d):
    """Replace the lower triangle of a symmetric (d, d) by its Cholesky factor, zero columns for what is nothing."""
    largest = 0.0
    for i in range(d):
        largest = max(largest, m[i, i])
    for j in range(d):
        pivot = m[j, j]
        for a in range(j):
            pivot -= m[j, a] * m[j, a]
        there = pivot > SHARE * largest and pivot > 1e-300
        root = np.sqrt(pivot) if there else 0.0
        m[j, j] = root
        for i in range(j + 1, d):
            total = m[i, j]
            for a in range(j):
                total -= m[i, a] * m[j, a]
            m[i, j] = total / root if there else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def begin(t, s, f):
    """Make this sample, with functions f of its inputs, the newest onset of the window."""
    dim, w = t.i[0], s.w
    keep, place = dim[WINDOW] - 1, s.counts[PLACE] + 1
    rows = dim[S_TAKEN] + s.counts[ACTIVE] * dim[COLUMNS]
    if place == dim[LENGTH]:
        for row in range(rows):
            for a in range(keep):
                w[row, a] = w[row, dim[LENGTH] - keep + a]
        place = keep
    s.counts[PLACE] = place
    for row in range(rows):
        w[row, place] = 0.0
    for m in range(dim[NDRIVEN]):
        for i in range(dim[NX]):
            for j in range(dim[NF]):
                w[dim[S_STATE] + m * dim[NX] + i, place] += t.m[DRIVES + m, i, j] * s.v[BEFORE, j]
        for o in range(dim[NY]):
            for j in range(dim[NF]):
                w[dim[S_OUTPUT] + m * dim[NY] + o, place] += t.m[DRIVES + dim[NDRIVEN] + m, o, j] * f[j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def chain(t, s, count):
    """Write H and N of a window with missing readings to the scratch."""
    dim, place, c, w = t.i[0], s.counts[PLACE], s.c, s.w
    n, l, W = dim[NX], dim[NY], dim[WINDOW]  # noqa: E741
    h, direct, moved = dim[C_H], dim[C_N], s.v[MOVED]
    for o in range(l):
        for a in range(l):
            c[direct + o * l + a, W - 1] = s.m[WHITENING, o, a]
        for i in range(n):
            total = 0.0
            for a in range(l):
                total += s.m[WHITENING, o, a] * t.m[C, a, i]
            c[h + o * n + i, W - 1] = total
    for back in range(1, count):
        at = W - 1 - back
        for o in range(l):
            for a in range(l):
                gain = w[dim[S_SHOWN] + a, place - back]
                total = 0.0
                for i in range(n):
                    total += c[h + o * n + i, at + 1] * (t.m[L, i, a] - gain * (t.m[L, i, a] + t.m[GAIN, i, a]))
                c[direct + o * l + a, at] = total
            for i in range(n):
                total = 0.0
                for j in range(n):
                    total += c[h + o * n + j, at + 1] * t.m[A, j, i]
                for a in range(l):
                    total += c[direct + o * l + a, at] * t.m[C, a, i]
                moved[i] = total
            for i in range(n):
                c[h + o * n + i, at] = moved[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def signatures(t, s, count, clean):
    """Write the signatures of this sample of all onsets to the scratch; of a clean window only the driven columns."""
    dim, c, w = t.i[0], s.c, s.w
    n, l, W = dim[NX], dim[NY], dim[WINDOW]  # noqa: E741
    start, left = W - count, s.counts[PLACE] - count + 1
    source, h, direct = (t.w, 0, dim[T_N]) if clean else (c, dim[C_H], dim[C_N])
    for j in range(dim[COLUMNS]):
        course, m = t.i[COURSE, j], t.i[WHICH, j]
        if clean and course != DRIVEN:
            continue
        for o in range(l):
            row = c[j * l + o, start:W]
            for a in range(count):
                row[a] = 0.0
            for i in range(n + l):
                response = source[h + o * n + i if i < n else direct + o * l + i - n, start:W]
                if course == DRIVEN:
                    drive = w[dim[S_STATE] + m * n + i if i < n else dim[S_OUTPUT] + m * l + i - n, left : left + count]
                    for a in range(count):
                        row[a] += response[a] * drive[a]
                else:
                    weight = t.m[INTO_STATE, i, j] if i < n else t.m[INTO_OUTPUT, i - n, j]
                    if weight != 0.0:
                        for a in range(count):
                            row[a] += weight * response[a]
            for _ in range(0 if course == JUMP else 2 if course == DRIFT else 1):
                total = 0.0
                for back in range(count):
                    total += row[count - 1 - back]
                    row[count - 1 - back] = total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def take(t, s, count):
    """Take out of the signatures what the estimates of the carried faults take of them at this sample."""
    dim, c, w = t.i[0], s.c, s.w
    l, W = dim[NY], dim[WINDOW]  # noqa: E741
    start, left = W - count, s.counts[PLACE] - count + 1
    for j in range(dim[COLUMNS]):
        for q in range(s.counts[ACTIVE]):
            taken = w[dim[S_TAKEN] + q * dim[COLUMNS] + j, left : left + count]
            for o in range(l):
                row, weight = c[j * l + o, start:W], s.m[S0, o, q]
                for a in range(count):
                    row[a] -= weight * taken[a]
        for q in range(s.counts[ACTIVE]):
            taken = w[dim[S_TAKEN] + q * dim[COLUMNS] + j, left : left + count]
            for o in range(l):
                row, weight = c[j * l + o, start:W], s.m[TAKE, q, o]
                for a in range(count):
                    taken[a] += weight * row[a]
        for o in range(l - 1, -1, -1):  # lower triangular, in place from below
            row, weight = c[j * l + o, start:W], s.m[TURN, o, o]
            for a in range(count):
                row[a] *= weight
            for i in range(o):
                other, weight = c[j * l + i, start:W], s.m[TURN, o, i]
                for a in range(count):
                    row[a] += weight * other[a]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def add(t, s, count, clean):
    """Add this sample to the correlations and products of all onsets."""
    dim, w = t.i[0], s.w
    l, W = dim[NY], dim[WINDOW]  # noqa: E741
    start, left = W - count, s.counts[PLACE] - count + 1
    for j in range(dim[COLUMNS]):
        source, row = (t.w, dim[T_TRACE] + j * l) if clean and t.i[COURSE, j] != DRIVEN else (s.c, j * l)
        b = w[j, left : left + count]
        for o in range(l):
            weight, line = s.v[R, o], source[row + o, start:W]
            for a in range(count):
                b[a] += weight * line[a]
    for k in range(dim[CANDIDATES]):
        if clean and t.i[ADDITIVE, k]:
            continue  # its products are those of the tables
        own, pair = t.i[FIRST_OF, k], dim[S_GRAM] + t.i[PAIR, k]
        for i in range(own, own + t.i[SIZE, k]):
            first, row = (t.w, dim[T_TRACE] + i * l) if clean and t.i[COURSE, i] != DRIVEN else (s.c, i * l)
            for j in range(own, i + 1):
                second, at = (t.w, dim[T_TRACE] + j * l) if clean and t.i[COURSE, j] != DRIVEN else (s.c, j * l)
                product = w[pair, left : left + count]
                for o in range(l):
                    x, y = first[row + o, start:W], second[at + o, start:W]
                    for a in range(count):
                        product[a] += x[a] * y[a]
                pair += 1


@njit(cache=True, nogil=True, error_model="numpy")
def load(t, s, k, place):
    """Write the Cholesky factor of the products of a candidate at an onset to the scratch."""
    dim, m = t.i[0], s.m[M]
    clean = s.counts[SUMMED] == 0 and t.i[ADDITIVE, k] == 1
    pair = t.i[PAIR, k]
    column = dim[WINDOW] - 1 - (s.counts[PLACE] - place)
    for i in range(t.i[SIZE, k]):
        for j in range(i + 1):
            m[i, j] = t.w[dim[T_GRAM] + pair, column] if clean else s.w[dim[S_GRAM] + pair, place]
            pair += 1
    factor(m, t.i[SIZE, k])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def explain(t, s, count, clean):
    """Write the largest energy that every candidate explains, and its onset."""
    dim, w, now = t.i[0], s.w, s.counts[NOW]
    W, line, other = dim[WINDOW], s.c[dim[C_LINE]], s.c[dim[C_OTHER]]
    start, left = W - count, s.counts[PLACE] - count + 1
    for k in range(dim[CANDIDATES]):
        d, own, pair = t.i[SIZE, k], t.i[FIRST_OF, k], dim[S_GRAM] + t.i[PAIR, k]
        stop = count - max(t.i[LEAST, k] - 1, 0)
        # a loss needs the input of the sample before its onset
        early = 0 if t.i[ADDITIVE, k] else max(0, s.counts[BEGUN] + 1 - (now - count + 1))
        tested, at, age = max(stop - early, 0), left + early, start + early
        b = w[own, at : at + tested]
        if clean and t.i[ADDITIVE, k]:
            for a in range(tested):
                line[a] = 0.0
            for i in range(d):
                for a in range(tested):
                    other[a] = 0.0
                for j in range(d):
                    root = t.w[dim[T_ROOT] + t.i[ROOT_AT, k] + i * d + j, age : age + tested]
                    correlation = w[own + j, at : at + tested]
                    for a in range(tested):
                        other[a] += root[a] * correlation[a]
                for a in range(tested):
                    line[a] += other[a] * other[a]
        elif d == 1:
            product = w[pair, at : at + tested]
            for a in range(tested):
                line[a] = b[a] * b[a] / max(product[a], 1e-300)
        elif d == 2:
            second, first = w[own + 1, at : at + tested], w[pair, at : at + tested]
            cross, last = w[pair + 1, at : at + tested], w[pair + 2, at : at + tested]
            for a in range(tested):
                x, y, g, h, z = b[a], second[a], first[a], last[a], cross[a]
                total, rest = max(g + h, 1e-150), g * h - z * z
                full = rest > SHARE * total * total
                along = (g * x * x + 2 * z * x * y + h * y * y) / (total * total)
                line[a] = (h * x * x - 2 * z * x * y + g * y * y) / rest if full else along
        else:
            for a in range(tested):
                load(t, s, k, at + a)
                line[a] = 0.0
                for i in range(d):
                    if s.m[M, i, i] > 0.0:
                        z = w[own + i, at + a]
                        for j in range(i):
                            z -= s.m[M, i, j] * s.v[Z1, j]
                        s.v[Z1, i] = z / s.m[M, i, i]
                        line[a] += s.v[Z1, i] * s.v[Z1, i]
                    else:
                        s.v[Z1, i] = 0.0
        best, where = 0.0, -1
        for a in range(tested):
            if line[a] > best:
                best, where = line[a], early + a
        s.v[STATISTIC, k] = best
        s.i[PEAK, k] = now - count + 1 + where if where >= 0 else -1


@njit(cache=True, nogil=True, error_model="numpy")
def search(t, s):
    """Search the window that ends with this sample, whose innovation and whitening are in the state; return its length.

    `DIRTY` must be this sample when a reading is missing or a fault is carried.
    """
    dim, now = t.i[0], s.counts[NOW]
    count = min(now - s.counts[FIRST] + 1, dim[WINDOW])
    clean = now - s.counts[DIRTY] >= dim[WINDOW]
    if not clean:
        if s.counts[SUMMED] == 0:  # so far the products were those of the tables
            place, pairs = s.counts[PLACE], dim[S_STATE] - dim[S_GRAM]
            for k in range(dim[CANDIDATES]):
                if t.i[ADDITIVE, k]:
                    stop = t.i[PAIR, k + 1] if k + 1 < dim[CANDIDATES] else pairs
                    for pair in range(t.i[PAIR, k], stop):
                        for back in range(1, count):
                            s.w[dim[S_GRAM] + pair, place - back] = t.w[dim[T_GRAM] + pair, dim[WINDOW] - back]
        chain(t, s, count)
    s.counts[SUMMED] = 0 if clean else 1
    signatures(t, s, count, clean)
    if s.counts[ACTIVE] > 0:
        take(t, s, count)
    add(t, s, count, clean)
    explain(t, s, count, clean)
    return count


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
        begin(t, s, f[k])
        for o in range(r.shape[1]):
            s.v[R, o] = r[k, o]
        search(t, s)
        block = k // long
        for c in range(largest.shape[1]):
            largest[block, c] = max(largest[block, c], s.v[STATISTIC, c])
        for j in range(f.shape[1]):
            s.v[BEFORE, j] = f[k, j]
        s.counts[NOW] += 1
