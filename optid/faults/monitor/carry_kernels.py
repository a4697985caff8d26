"""Compiled steps that take up faults to be carried, review them and drop them.

The state is corrected by the estimated fault (A. S. Willsky, H. L. Jones, A generalized likelihood ratio approach to
the detection and estimation of jumps in linear systems, IEEE Trans. Automatic Control 21, 1976), and the estimate goes
on in `optid.faults.monitor.predict_kernels`. A state of which nothing is known is a jump of wide prior at the first
sample.
"""

from numba import njit

from optid.faults.monitor.layout import (
    ACTIVE,
    COLUMN,
    COLUMNS,
    COURSE,
    DRIFT,
    FADED,
    FIRST,
    FIRST_OF,
    FORGIVEN,
    GAIN,
    GROWN,
    GROWTH,
    HELD,
    JUMP,
    LATER,
    LEARNED,
    LENGTH,
    NOW,
    NU,
    NX,
    NY,
    OWNER,
    PEAK,
    PLACE,
    POWER,
    ROOM,
    ROOT,
    RULE,
    S_SHOWN,
    S_TAKEN,
    SIZE,
    SIZES,
    SLOPE,
    SPREAD,
    START,
    TAKEN,
    THRESHOLD,
    WIDE,
    WINDOW,
    Z1,
    A,
    C,
    L,
    M,
    P,
    T,
    V,
    X,
)
from optid.faults.monitor.predict_kernels import jolt, shift
from optid.faults.monitor.search_kernels import factor, load


@njit(cache=True, nogil=True, error_model="numpy")
def estimate(t, s, k):
    """Write the magnitudes of a candidate at its peak, and their covariance."""
    d, own = t.i[SIZE, k], t.i[FIRST_OF, k]
    place = s.counts[PLACE] - (s.counts[NOW] - s.i[PEAK, k])
    load(t, s, k, place)
    m, sizes = s.m, s.v[SIZES]
    for column in range(d):  # the inverse of the factor
        for i in range(d):
            m[T, i, column] = 0.0
        for i in range(column, d):
            if m[M, i, i] > 0.0:
                total = 1.0 if i == column else 0.0
                for j in range(column, i):
                    total -= m[M, i, j] * m[T, j, column]
                m[T, i, column] = total / m[M, i, i]
    for i in range(d):
        sizes[i] = 0.0
        for j in range(d):
            total = 0.0
            for a in range(d):
                total += m[T, a, i] * m[T, a, j]
            m[SPREAD, i, j] = total
            sizes[i] += total * s.w[own + j, place]


@njit(cache=True, nogil=True, error_model="numpy")
def forget(t, s, q):
    """Take a carried direction out; state and the other estimates stay as they are."""
    dim, last, m, v, w = t.i[0], s.counts[ACTIVE] - 1, s.m, s.v, s.w
    rows, taken = dim[COLUMNS], dim[S_TAKEN]
    for p in range(q, last):
        for i in range(dim[NX]):
            m[V, i, p] = m[V, i, p + 1]
        for number in (NU, GROWN, GROWTH, POWER):
            v[number, p] = v[number, p + 1]
        s.i[COLUMN, p], s.i[OWNER, p] = s.i[COLUMN, p + 1], s.i[OWNER, p + 1]
        for j in range(rows):
            for a in range(dim[LENGTH]):
                w[taken + p * rows + j, a] = w[taken + (p + 1) * rows + j, a]
        for i in range(last + 1):
            m[P, p, i] = m[P, p + 1, i]
    for p in range(q, last):
        for i in range(last):
            m[P, i, p] = m[P, i, p + 1]
    s.counts[ACTIVE] = last


@njit(cache=True, nogil=True, error_model="numpy")
def settle(t, s, q):
    """Keep the estimate of a carried direction as it is, and stop estimating it."""
    j = s.i[COLUMN, q]
    if j >= 0:
        s.v[HELD, j] += s.v[NU, q] * s.v[GROWN, q]
        s.v[SLOPE, j] += s.v[NU, q] * s.v[GROWTH, q]
    forget(t, s, q)


@njit(cache=True, nogil=True, error_model="numpy")
def take_up(t, s, owner, count):
    """Add directions of one owner to those carried, settling the oldest where there is no room; return the first."""
    dim = t.i[0]
    while s.counts[ACTIVE] + count > dim[ROOM]:
        settle(t, s, s.counts[ACTIVE] * 0)
    first = s.counts[ACTIVE]
    for q in range(first, first + count):
        s.i[OWNER, q] = owner
        s.i[COLUMN, q] = -1 if owner == START else t.i[FIRST_OF, owner] + (q - first) % t.i[SIZE, owner]
        s.v[NU, q], s.v[GROWN, q], s.v[GROWTH, q], s.v[POWER, q] = 0.0, 0.0, 0.0, 0.0
        for i in range(dim[NX]):
            s.m[V, i, q] = 0.0
        for p in range(first + count):
            s.m[P, p, q] = 0.0
            s.m[P, q, p] = 0.0
        for j in range(dim[COLUMNS]):
            for a in range(dim[LENGTH]):
                s.w[dim[S_TAKEN] + q * dim[COLUMNS] + j, a] = 0.0
    s.counts[ACTIVE] = first + count
    return first


@njit(cache=True, nogil=True, error_model="numpy")
def lose_state(t, s):
    """From the next sample on the state is unknown."""
    q, n = 0, t.i[0, NX]
    while q < s.counts[ACTIVE]:
        if s.i[OWNER, q] == START:
            forget(t, s, q)
        else:
            q += 1
    owner = s.counts[ACTIVE] * 0 + START
    first = take_up(t, s, owner, n)
    for i in range(n):
        s.m[V, i, first + i] = 1.0
        s.m[P, first + i, first + i] = t.v[RULE, WIDE]


@njit(cache=True, nogil=True, error_model="numpy")
def carry(t, s, k):
    """Correct the state by the estimate of a candidate at its peak and carry it; the search begins anew.

    What an onset that is a little off leaves of a drift is a constant: it is carried, too, its variance being guessed.
    """
    dim, now, m, v = t.i[0], s.counts[NOW], s.m, s.v
    n, l, d, own = dim[NX], dim[NY], t.i[SIZE, k], t.i[FIRST_OF, k]  # noqa: E741
    estimate(t, s, k)
    onset = s.i[PEAK, k]
    place = s.counts[PLACE] - (now - onset)
    drifting = t.i[COURSE, own] == DRIFT
    count = 2 * d if drifting else d
    while s.counts[ACTIVE] + count > dim[ROOM]:
        settle(t, s, s.counts[ACTIVE] * 0)
    for p in range(s.counts[ACTIVE]):
        for i in range(d):
            m[TAKEN, p, i] = s.w[dim[S_TAKEN] + p * dim[COLUMNS] + own + i, place]
    first, later = take_up(t, s, k, count), v[LATER]
    for q in range(first, first + count):  # what the candidate has done to the state from its onset to the next sample
        j = s.i[COLUMN, q]
        growth = 1.0 if drifting and q < first + d else 0.0
        grown = 1.0 - growth
        for at in range(place, place + now - onset + 1):
            grown += growth
            if t.i[COURSE, j] == JUMP and at > place:
                grown = 0.0
            for i in range(n):
                m[V, i, q] += jolt(t, s, j, i, at) * grown
            for i in range(n):
                later[i] = 0.0
                for b in range(n):
                    later[i] += t.m[A, i, b] * m[V, b, q]
            for o in range(l):
                deviation = shift(t, s, j, o, at) * grown
                for b in range(n):
                    deviation += t.m[C, o, b] * m[V, b, q]
                there = s.w[dim[S_SHOWN] + o, at] > 0.0
                for i in range(n):
                    later[i] += (-t.m[GAIN, i, o] if there else t.m[L, i, o]) * deviation
            for i in range(n):
                m[V, i, q] = later[i]
        v[GROWN, q], v[GROWTH, q] = grown, growth
    for i in range(d):
        q = first + i
        v[NU, q] = v[SIZES, i]
        for a in range(n):
            v[X, a] += m[V, a, q] * v[SIZES, i]
        for p in range(first):
            change = -m[TAKEN, p, i] * v[SIZES, i]
            v[NU, p] += change
            for a in range(n):
                v[X, a] += m[V, a, p] * change
        for j in range(d):
            m[P, q, first + j] = m[SPREAD, i, j]
    for p in range(first):
        for i in range(d):
            total = 0.0
            for j in range(d):
                total -= m[TAKEN, p, j] * m[SPREAD, j, i]
            m[P, p, first + i] = total
            m[P, first + i, p] = total
    for p in range(first):
        for q in range(first):
            for i in range(d):
                m[P, p, q] -= m[P, p, first + i] * m[TAKEN, q, i]
    if drifting:
        for i in range(d):
            m[P, first + i, first + i] *= 4.0
            m[P, first + d + i, first + d + i] = m[SPREAD, i, i] * (2.0 * (now - onset + 1)) ** 2
    s.counts[FIRST] = now + 1


@njit(cache=True, nogil=True, error_model="numpy")
def significance(t, s, k):
    """Write the whole of what is carried of a candidate and the covariance of what is estimated; return its energy."""
    d, m, sizes, active = t.i[SIZE, k], s.m, s.v[SIZES], s.counts[ACTIVE]
    for i in range(d):
        j = t.i[FIRST_OF, k] + i
        sizes[i] = s.v[SLOPE, j] if t.i[COURSE, j] == DRIFT else s.v[HELD, j]
        for a in range(d):
            m[M, i, a] = 0.0
    for q in range(active):
        if s.i[OWNER, q] == k:
            i = s.i[COLUMN, q] - t.i[FIRST_OF, k]
            sizes[i] += s.v[NU, q]
            for p in range(active):
                if s.i[OWNER, p] == k:
                    m[M, i, s.i[COLUMN, p] - t.i[FIRST_OF, k]] += m[P, q, p]
    for i in range(d):
        for j in range(d):
            m[SPREAD, i, j] = m[M, i, j]
    factor(m[M], d)
    total = 0.0
    for i in range(d):
        z = sizes[i]
        for j in range(i):
            z -= m[M, i, j] * s.v[Z1, j]
        s.v[Z1, i] = z / m[M, i, i] if m[M, i, i] > 0.0 else 0.0
        total += s.v[Z1, i] * s.v[Z1, i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def review(t, s):
    """Drop carried faults that have died out or gone, stop estimating those known well; return one gone, or -1."""
    dim, m, v = t.i[0], s.m, s.v
    n, l = dim[NX], dim[NY]  # noqa: E741
    strength, first = 0.0, 0
    for o in range(l):
        for i in range(n):
            total = 0.0
            for a in range(l):
                total += t.m[ROOT, o, a] * t.m[C, a, i]
            strength += total * total
    while first < s.counts[ACTIVE]:
        k = s.i[OWNER, first]
        passing = k == START or t.i[COURSE, t.i[FIRST_OF, k]] == JUMP
        drifting = not passing and t.i[COURSE, t.i[FIRST_OF, k]] == DRIFT
        # directions stay beside those they were taken up with
        end = first + (n if k == START else 2 * t.i[SIZE, k] if drifting else t.i[SIZE, k])
        left, power = 0.0, 0.0
        for q in range(first, end):
            if passing:
                for i in range(n):
                    left += strength * m[V, i, q] * m[V, i, q] * (m[P, q, q] + v[NU, q] * v[NU, q])
            else:
                left += dim[WINDOW] * v[POWER, q] * m[P, q, q]
                power += v[POWER, q]
        if passing and left < t.v[RULE, FADED]:
            for q in range(end - 1, first - 1, -1):
                forget(t, s, q)
            if k != START:
                return k
        elif not passing and not drifting and significance(t, s, k) < t.v[RULE, FORGIVEN] * t.v[THRESHOLD, k]:
            for q in range(s.counts[ACTIVE] - 1, -1, -1):
                if s.i[OWNER, q] == k:
                    forget(t, s, q)
            for i in range(t.i[SIZE, k]):
                v[HELD, t.i[FIRST_OF, k] + i] = 0.0
            return k
        elif not passing and power > 0.0 and left < t.v[RULE, LEARNED]:
            for q in range(end - 1, first - 1, -1):
                settle(t, s, q)
        else:
            first = end
    return -1
