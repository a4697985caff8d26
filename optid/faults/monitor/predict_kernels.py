"""Compiled steps of the predictor of the monitor, with the faults that it carries.

Faults that were named are carried as unknown constants beside the state (B. Friedland, Treatment of bias in recursive
filtering, IEEE Trans. Automatic Control 14, 1969): their estimate nu with covariance P corrects the state of the
predictor by V nu at every sample. The innovations stay white.
"""

import numpy as np
from numba import njit

from optid.faults.monitor.layout import (
    ACTIVE,
    BEFORE,
    COLUMN,
    COLUMNS,
    COURSE,
    COVARIANCE,
    DRIVEN,
    GAIN,
    GROWN,
    GROWTH,
    HELD,
    INDEX,
    INTO_OUTPUT,
    INTO_STATE,
    LATER,
    NF,
    NFED,
    NU,
    NX,
    NY,
    OFFSET_X,
    OFFSET_Y,
    OUTPUT_OF,
    PLACE,
    POWER,
    PREDICTED,
    RAW,
    ROOT,
    S0,
    S_ENERGY,
    S_OUTPUT,
    S_SHOWN,
    S_STATE,
    SLOPE,
    TAKE,
    TURN,
    WHICH,
    WHITENING,
    WINDOW,
    A,
    B,
    C,
    D,
    E,
    L,
    M,
    P,
    R,
    V,
    X,
    Z,
)
from optid.faults.monitor.search_kernels import factor
from optid.models.state_kernels import value_and_slope


@njit(cache=True, nogil=True, error_model="numpy")
def expand(functions, input_of, u, f):
    """Write the functions (T, r) of the inputs (T, m); return the first sample refused, or -1."""
    for k in range(u.shape[0]):
        for j in range(input_of.size):
            v = u[k, input_of[j]]
            if np.isnan(v):
                f[k, j] = np.nan
                continue
            value, _, refused = value_and_slope(functions, j, v)
            if refused:
                return k
            f[k, j] = value
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def jolt(t, s, j, i, place):
    """What column j adds to state i at a place of the window, per unit of its course."""
    if t.i[COURSE, j] != DRIVEN:
        return t.m[INTO_STATE, i, j]
    return s.w[t.i[0, S_STATE] + t.i[WHICH, j] * t.i[0, NX] + i, place]


@njit(cache=True, nogil=True, error_model="numpy")
def shift(t, s, j, o, place):
    """What column j adds to output o at a place of the window, per unit of its course."""
    if t.i[COURSE, j] != DRIVEN:
        return t.m[INTO_OUTPUT, o, j]
    return s.w[t.i[0, S_OUTPUT] + t.i[WHICH, j] * t.i[0, NY] + o, place]


@njit(cache=True, nogil=True, error_model="numpy")
def whiten(t, s, place):
    """Write the whitening of the readings that are there."""
    l, shown, m, index = t.i[0, NY], t.i[0, S_SHOWN], s.m, s.i[INDEX]  # noqa: E741
    count = 0
    for o in range(l):
        if s.w[shown + o, place] > 0.0:
            index[count] = o
            count += 1
    for o in range(l):
        for a in range(l):
            m[WHITENING, o, a] = t.m[ROOT, o, a] if count == l else 0.0
    if count == l:
        return
    for i in range(count):
        for j in range(i + 1):
            m[M, i, j] = t.m[COVARIANCE, index[i], index[j]]
    factor(m[M], count)
    for column in range(count):  # the inverse of the factor
        for i in range(column, count):
            total = 1.0 if i == column else 0.0
            for j in range(column, i):
                total -= m[M, i, j] * m[WHITENING, index[j], index[column]]
            m[WHITENING, index[i], index[column]] = total / m[M, i, i]


@njit(cache=True, nogil=True, error_model="numpy")
def expect(t, s, f):
    """Add to the state what the carried faults add at this sample, and predict the readings."""
    dim, place, active, m, v = t.i[0], s.counts[PLACE], s.counts[ACTIVE], s.m, s.v
    n, l = dim[NX], dim[NY]  # noqa: E741
    for q in range(active):
        j = s.i[COLUMN, q]
        if j >= 0:
            v[GROWN, q] += v[GROWTH, q]
            for i in range(n):
                step = jolt(t, s, j, i, place) * v[GROWN, q]
                m[V, i, q] += step
                v[X, i] += step * v[NU, q]
    for j in range(dim[COLUMNS]):
        v[HELD, j] += v[SLOPE, j]
        if v[HELD, j] != 0.0:
            for i in range(n):
                v[X, i] += jolt(t, s, j, i, place) * v[HELD, j]
    for o in range(l):
        total = t.v[OFFSET_Y, o]
        for i in range(n):
            total += t.m[C, o, i] * v[X, i]
        for j in range(dim[NF]):
            total += t.m[D, o, j] * f[j]
        for j in range(dim[COLUMNS]):
            if v[HELD, j] != 0.0:
                total += shift(t, s, j, o, place) * v[HELD, j]
        for q in range(active):
            deviation = 0.0
            for i in range(n):
                deviation += t.m[C, o, i] * m[V, i, q]
            j = s.i[COLUMN, q]
            if j >= 0:
                step = shift(t, s, j, o, place) * v[GROWN, q]
                deviation += step
                total += step * v[NU, q]
            m[RAW, o, q] = deviation
        v[PREDICTED, o] = total


@njit(cache=True, nogil=True, error_model="numpy")
def correct(t, s):
    """Correct the estimates of the carried faults and the state by the innovation, and whiten it anew."""
    dim, active, m, v = t.i[0], s.counts[ACTIVE], s.m, s.v
    n, l = dim[NX], dim[NY]  # noqa: E741
    for o in range(l):
        for q in range(active):
            m[S0, o, q] = 0.0
            for a in range(l):
                m[S0, o, q] += m[WHITENING, o, a] * m[RAW, a, q]
        for q in range(active):
            m[Z, o, q] = 0.0
            for p in range(active):
                m[Z, o, q] += m[S0, o, p] * m[P, p, q]
    for o in range(l):
        for a in range(o + 1):
            total = 1.0 if a == o else 0.0
            for q in range(active):
                total += m[Z, o, q] * m[S0, a, q]
            m[M, o, a] = total
    factor(m[M], l)
    for column in range(l):
        for o in range(l):
            m[TURN, o, column] = 0.0
        for o in range(column, l):
            total = 1.0 if o == column else 0.0
            for a in range(column, o):
                total -= m[M, o, a] * m[TURN, a, column]
            m[TURN, o, column] = total / m[M, o, o]
    for q in range(active):  # Z becomes turn S0 P, whose transpose times itself leaves P
        for o in range(l - 1, -1, -1):
            total = 0.0
            for a in range(o + 1):
                total += m[TURN, o, a] * m[Z, a, q]
            m[Z, o, q] = total
    for q in range(active):
        change, energy = 0.0, 0.0
        for a in range(l):
            total = 0.0
            for o in range(a, l):
                total += m[Z, o, q] * m[TURN, o, a]
            m[TAKE, q, a] = total
            change += total * v[R, a]
            energy += m[S0, a, q] * m[S0, a, q]
        v[NU, q] += change
        v[POWER, q] += (energy - v[POWER, q]) / dim[WINDOW]
        for i in range(n):
            v[X, i] += m[V, i, q] * change
        for o in range(l):
            v[PREDICTED, o] += m[RAW, o, q] * change
    for p in range(active):
        for q in range(active):
            for o in range(l):
                m[P, p, q] -= m[Z, o, p] * m[Z, o, q]
    for o in range(l - 1, -1, -1):
        total = 0.0
        for a in range(o + 1):
            total += m[TURN, o, a] * v[R, a]
        v[R, o] = total


@njit(cache=True, nogil=True, error_model="numpy")
def proceed(t, s, functions, f, y):
    """Take state and carried faults to the next sample; return whether the feedback took the outputs."""
    dim, place, m, v = t.i[0], s.counts[PLACE], s.m, s.v
    n, l, later = dim[NX], dim[NY], v[LATER]  # noqa: E741
    for i in range(n):
        total = t.v[OFFSET_X, i]
        for j in range(n):
            total += t.m[A, i, j] * v[X, j]
        for j in range(dim[NF]):
            total += t.m[B, i, j] * f[j]
        for o in range(l):
            if s.w[dim[S_SHOWN] + o, place] > 0.0:
                total += t.m[L, i, o] * y[o] + t.m[GAIN, i, o] * (y[o] - v[PREDICTED, o])
            else:
                total += t.m[L, i, o] * v[PREDICTED, o]
        later[i] = total
    for j in range(dim[NFED]):
        o = t.i[OUTPUT_OF, j]
        there = s.w[dim[S_SHOWN] + o, place] > 0.0
        fed, _, refused = value_and_slope(functions, j, y[o] if there else v[PREDICTED, o])
        if refused:
            return False
        for i in range(n):
            later[i] += t.m[E, i, j] * fed
    for i in range(n):
        v[X, i] = later[i]
    for q in range(s.counts[ACTIVE]):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += t.m[A, i, j] * m[V, j, q]
            for o in range(l):
                there = s.w[dim[S_SHOWN] + o, place] > 0.0
                total += (-t.m[GAIN, i, o] if there else t.m[L, i, o]) * m[RAW, o, q]
            later[i] = total
        for i in range(n):
            m[V, i, q] = later[i]
    for j in range(dim[NF]):
        v[BEFORE, j] = f[j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def innovate(t, s, functions, f, y):
    """Predict this sample, correct state and carried faults, write the innovation; return whether that went well."""
    dim, place, v = t.i[0], s.counts[PLACE], s.v
    l = dim[NY]  # noqa: E741
    expect(t, s, f)
    for o in range(l):
        s.w[dim[S_SHOWN] + o, place] = 0.0 if np.isnan(y[o]) else 1.0
    whiten(t, s, place)
    for o in range(l):
        v[R, o] = 0.0
        for a in range(l):
            if s.w[dim[S_SHOWN] + a, place] > 0.0:
                v[R, o] += s.m[WHITENING, o, a] * (y[a] - v[PREDICTED, a])
    if s.counts[ACTIVE] > 0:
        correct(t, s)
    for o in range(l):
        s.w[dim[S_ENERGY], place] += v[R, o] * v[R, o]
    return proceed(t, s, functions, f, y)
