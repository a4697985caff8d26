"""Compiled decisions of the monitor: what a sample means, and the loop over the samples."""

import numpy as np
from numba import njit

from optid.faults.monitor.carry_kernels import carry, estimate, lose_state, review
from optid.faults.monitor.layout import (
    ACTIVE,
    ADDITIVE,
    AGAIN,
    ALARM,
    ALARMED,
    BEFORE,
    BEGUN,
    CANDIDATES,
    CERTAINTY,
    CLEARED,
    DIRTY,
    FIRST,
    INPUT,
    ISOLATED,
    LOST,
    NAMED,
    NAMED_AT,
    NAMING,
    NOTHING,
    NOW,
    NY,
    ODD,
    PAIR,
    PATIENCE,
    PEAK,
    PHASE,
    PLACE,
    QUIET,
    READING,
    RELEASE,
    RULE,
    S_ENERGY,
    S_GRAM,
    S_SHOWN,
    SETTLE,
    SETTLING,
    SIZE,
    SIZES,
    STATISTIC,
    STILL,
    STRANGE,
    TESTABLE,
    TESTED,
    THRESHOLD,
    UNTESTABLE,
    WATCHING,
    WINDOW,
    D,
    M,
)
from optid.faults.monitor.predict_kernels import innovate
from optid.faults.monitor.search_kernels import begin, factor, search


@njit(cache=True, nogil=True, error_model="numpy")
def excited(t, s, k):
    """What a whole loss would leave in the window that no constant of the same actuator can leave."""
    dim, d = t.i[0], t.i[SIZE, k]
    pair, place = dim[S_GRAM] + t.i[PAIR, k], s.counts[PLACE] - dim[WINDOW] + 1
    for i in range(d):  # the loss last, so that its pivot is what the constants leave of it
        for j in range(i + 1):
            a, b = d - 1 - i, d - 1 - j
            s.m[M, i, j] = s.w[pair + b * (b + 1) // 2 + a, place]
    factor(s.m[M], d)
    return s.m[M, d - 1, d - 1] ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def left_over(t, s, k):
    """Return how many deviations more than noise a candidate leaves since its onset, and on how many readings."""
    dim, energy, free = t.i[0], 0.0, -float(t.i[SIZE, k])
    for back in range(s.counts[NOW] - s.i[PEAK, k] + 1):
        at = s.counts[PLACE] - back
        energy += s.w[dim[S_ENERGY], at]
        for o in range(dim[NY]):
            free += s.w[dim[S_SHOWN] + o, at]
    if free < 1:
        return 0.0, free
    # Wilson and Hilferty: the cube root of chi2 / free is nearly Gaussian
    spread = 2.0 / (9.0 * free)
    return ((max(energy - s.v[STATISTIC, k], 0.0) / free) ** (1.0 / 3.0) - 1.0 + spread) / np.sqrt(spread), free


@njit(cache=True, nogil=True, error_model="numpy")
def watch(t, s, best, count):
    """Decide while there is no alarm; return the kind of the event, -1 for none, and its candidate."""
    dim, counts, now = t.i[0], s.counts, s.counts[NOW]
    if s.v[STATISTIC, best] > t.v[THRESHOLD, best]:
        counts[PHASE], counts[ALARM] = NAMING, now
        return ALARMED, best
    if counts[ACTIVE] > 0:
        gone = review(t, s)
        if gone >= 0:
            return CLEARED, gone
    if count == dim[WINDOW] and now - counts[BEGUN] >= dim[WINDOW]:
        for k in range(dim[CANDIDATES]):
            if t.i[ADDITIVE, k]:
                continue
            weight = excited(t, s, k)
            if s.i[TESTED, k] == 1 and weight < t.v[THRESHOLD, k]:
                s.i[TESTED, k] = 0
                return UNTESTABLE, k
            if s.i[TESTED, k] == 0 and weight > 1.2 * t.v[THRESHOLD, k]:
                s.i[TESTED, k] = 1
                return TESTABLE, k
    return -1, best


@njit(cache=True, nogil=True, error_model="numpy")
def name(t, s, best, gain):
    """Decide while an alarm has no name; return the kind of the event, -1 for none, and its candidate."""
    dim, counts, now, rule = t.i[0], s.counts, s.counts[NOW], t.v[RULE]
    rivals = 0.0
    for k in range(dim[CANDIDATES]):
        if s.i[PEAK, k] >= 0:
            rivals += np.exp((s.v[STATISTIC, k] - t.v[THRESHOLD, k] - gain) / 2.0)
    sure = 1.0 / rivals >= rule[CERTAINTY]
    chosen, old = best, now - s.i[PEAK, best] + 2  # an onset must not leave the window before it is named
    if counts[PHASE] == NAMING:
        odd, free = left_over(t, s, best)
        waited = now - counts[ALARM]
        late = waited >= rule[PATIENCE] or (waited >= rule[SETTLE] and old + rule[SETTLE] >= dim[WINDOW])
        testable = t.i[ADDITIVE, best] == 1 or s.i[TESTED, best] == 1
        if counts[QUIET] >= rule[STILL] or (late and gain <= 0.0):
            counts[PHASE], counts[NAMED] = WATCHING, NOTHING
            return CLEARED, -1
        if not late and not (sure and gain > 0.0 and free >= 4 and testable):
            return -1, best
    else:
        if now - counts[NAMED_AT] < rule[SETTLE] and old < dim[WINDOW]:
            return -1, best
        chosen = best if sure else counts[NAMED]
        if s.i[PEAK, chosen] < 0:
            counts[PHASE], counts[NAMED] = WATCHING, NOTHING
            return CLEARED, -1
        odd, free = left_over(t, s, chosen)
    if odd > rule[ODD]:
        said = counts[NAMED] == AGAIN
        counts[PHASE], counts[NAMED], counts[FIRST], counts[QUIET] = LOST, AGAIN, now + 1, 0
        return (-1 if said else STRANGE), chosen
    if counts[PHASE] == NAMING or chosen != counts[NAMED]:
        counts[PHASE], counts[NAMED], counts[NAMED_AT] = SETTLING, chosen, now
        return ISOLATED, chosen
    carry(t, s, chosen)
    counts[PHASE], counts[NAMED], counts[QUIET] = WATCHING, NOTHING, 0
    return -1, best


@njit(cache=True, nogil=True, error_model="numpy")
def judge(t, s, count):
    """Decide what this sample means; return the kind of the event, -1 for none, and its candidate."""
    dim, counts = t.i[0], s.counts
    best, quiet = -1, True
    for k in range(dim[CANDIDATES]):
        if s.i[PEAK, k] >= 0:
            if best < 0 or s.v[STATISTIC, k] - t.v[THRESHOLD, k] > s.v[STATISTIC, best] - t.v[THRESHOLD, best]:
                best = k
            quiet = quiet and s.v[STATISTIC, k] <= t.v[RULE, RELEASE] * t.v[THRESHOLD, k]
    if best < 0:
        return -1, best
    gain = s.v[STATISTIC, best] - t.v[THRESHOLD, best]
    counts[QUIET] = counts[QUIET] + 1 if quiet else 0
    if counts[PHASE] == WATCHING:
        return watch(t, s, best, count)
    if counts[PHASE] == LOST:
        if gain > 0.0:
            counts[PHASE], counts[ALARM] = NAMING, counts[NOW]
        elif counts[QUIET] >= t.v[RULE, STILL]:
            counts[PHASE], counts[NAMED] = WATCHING, NOTHING
            return CLEARED, -1
        return -1, best
    return name(t, s, best, gain)


@njit(cache=True, nogil=True, error_model="numpy")
def record(t, s, kind, k, line):
    """Write one event: kind, sample, candidate, onset, statistic, gains of all, magnitudes, whether it is testable."""
    candidates = t.i[0, CANDIDATES]
    line[:] = 0.0
    line[0], line[1], line[2], line[3] = kind, s.counts[NOW], k, -1.0
    if k >= 0:
        line[3], line[4], line[-1] = s.i[PEAK, k], s.v[STATISTIC, k], s.i[TESTED, k]
    if kind == UNTESTABLE or kind == TESTABLE:
        line[4] = excited(t, s, k)
    for i in range(candidates):
        line[5 + i] = s.v[STATISTIC, i] - t.v[THRESHOLD, i]
    if (kind == ALARMED or kind == ISOLATED) and s.i[PEAK, k] >= 0:
        estimate(t, s, k)
        for i in range(t.i[SIZE, k]):
            line[5 + candidates + i] = s.v[SIZES, i]


@njit(cache=True, nogil=True, error_model="numpy")
def march(t, s, functions, f, y, events):
    """Take in samples until all are done or the table of events is full.

    Args:
        t: tables, `optid.faults.monitor.layout.Tables`.
        s: state, `optid.faults.monitor.layout.State`, changed in place.
        functions: of the feedback.
        f: (T, r) functions of the inputs, NaN where an input is missing.
        y: (T, l) readings, NaN where one is missing.
        events: (M, 6 + C + d) written.

    Returns:
        samples taken in, events written, whether the feedback refused an output.
    """
    l, counts, used, reading = y.shape[1], s.counts, s.v[INPUT], s.v[READING]  # noqa: E741
    found = 0
    for step in range(y.shape[0]):
        blind, complete = False, True
        for j in range(f.shape[1]):
            missing = np.isnan(f[step, j])
            blind = blind or missing
            used[j] = s.v[BEFORE, j] if missing else f[step, j]
        for o in range(l):
            reading[o] = y[step, o]
            for j in range(f.shape[1]):
                if t.m[D, o, j] != 0.0 and np.isnan(f[step, j]):
                    reading[o] = np.nan
            complete = complete and not np.isnan(reading[o])
        if not complete or counts[ACTIVE] > 0:
            counts[DIRTY] = counts[NOW]
        begin(t, s, used)
        if not innovate(t, s, functions, used, reading):
            return step, found, True
        count = search(t, s)
        if blind:
            lose_state(t, s)
            counts[BEGUN] = counts[NOW] + 1
        kind, k = judge(t, s, count)
        if kind >= 0:
            record(t, s, kind, k, events[found])
            found += 1
        counts[NOW] += 1
        if found == events.shape[0]:
            return step + 1, found, False
    return y.shape[0], found, False
