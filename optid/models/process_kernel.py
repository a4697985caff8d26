"""Exact runs of a linear system in continuous time whose inputs are held, or straight, between their changes.

The state is [inputs; slope; sections]; it is moved from event to event, an event being a change of the input or an
instant at which the output is read, by exp(F h). Steps of a length that comes again use a matrix exponential that is
kept; the others its series applied to the state, so that irregular instants cost little more than regular ones. A dead
time is no part of the system: it moves the changes of the input against the instants.
"""

import numpy as np

from optid.arrays import Array
from optid.kernel_cache import cached_njit

SLOTS = 32  # exponentials that are kept; regular records have few lengths of steps
REACH = 4.0  # norm of F h up to which the series is applied to the state itself
TERMS = 24  # of a series, at most, for a norm of one


@cached_njit
def _product(left, right, into):
    """Multiply square matrices."""
    n = len(left)
    for i in range(n):
        for j in range(n):
            into[i, j] = 0.0
        for k in range(n):
            if left[i, k] != 0.0:
                for j in range(n):
                    into[i, j] += left[i, k] * right[k, j]


@cached_njit
def exponential(F, h, found):  # noqa: N803 - the field's letter
    """Write exp(F h), found by scaling, a Taylor series and squaring."""
    n = len(F)
    size = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(F[i, j])
        size = max(size, row * h)
    doublings = 0
    while size > 0.5:
        size /= 2.0
        doublings += 1
    part = h / 2.0**doublings
    term, following = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            term[i, j] = found[i, j] = 1.0 if i == j else 0.0
    for order in range(1, 18):
        _product(F, term, following)
        for i in range(n):
            for j in range(n):
                term[i, j] = following[i, j] * (part / order)
                found[i, j] += term[i, j]
    for _ in range(doublings):
        _product(found, found, following)
        for i in range(n):
            for j in range(n):
                found[i, j] = following[i, j]


@cached_njit
def _apply(E, z, into):  # noqa: N803
    n, m = z.shape
    for i in range(n):
        for c in range(m):
            total = 0.0
            for k in range(n):
                total += E[i, k] * z[k, c]
            into[i, c] = total
    for i in range(n):
        for c in range(m):
            z[i, c] = into[i, c]


@cached_njit
def _series(F, h, norm, z, term, into):  # noqa: N803
    """Move the state by the series of exp(F h), in steps of norm one."""
    n, m = z.shape
    steps = max(1, int(np.ceil(norm * h)))
    g = h / steps
    for _ in range(steps):
        for i in range(n):
            for c in range(m):
                term[i, c] = z[i, c]
        for order in range(1, TERMS):
            largest, reached = 0.0, 0.0
            for i in range(n):
                for c in range(m):
                    total = 0.0
                    for k in range(n):
                        if F[i, k] != 0.0:
                            total += F[i, k] * term[k, c]
                    into[i, c] = total * (g / order)
            for i in range(n):
                for c in range(m):
                    term[i, c] = into[i, c]
                    z[i, c] += into[i, c]
                    largest = max(largest, abs(into[i, c]))
                    reached = max(reached, abs(z[i, c]))
            if largest <= 1e-18 * reached:
                break


@cached_njit
def run(F, C, instants, changes, inputs, sides, start):  # noqa: N803
    """Run a system over the changes of its input, and read it at instants.

    Args:
        F: (n, n) with rows [input; slope; sections]; the slope drives the input.
        C: (o, n) what is read.
        instants: (N,) not decreasing.
        changes: (J,) times at which the input takes its values, increasing; before the first the state is zero.
        inputs: (J, M) values of the input from there on, of M runs.
        sides: two marks: whether the input goes straight to its next value, and stays at the last, or is held; and
            whether a change at an instant counts for what is read there: the state is continuous, its slope is not.
        start: (n, M) state at the first change, without its input.

    Returns:
        (N, o, M).
    """
    straight, late = sides
    n, m, outputs, count = len(F), inputs.shape[1], len(C), len(instants)
    out, z, into, term = np.zeros((count, outputs, m)), start.copy(), np.zeros((n, m)), np.zeros((n, m))
    kept, lengths, recent = np.zeros((SLOTS, n, n)), np.full(SLOTS, -1.0), np.full(SLOTS, -1.0)
    used, noted, norm, largest = 0, 0, 0.0, 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(F[i, j])
        norm = max(norm, row)
    if count:
        largest = max(abs(instants[0]), abs(instants[-1]))
    if len(changes):
        largest = max(largest, abs(changes[0]), abs(changes[-1]))
    close = 1e-15 * largest  # a few times the rounding of a difference of two times
    k = 0
    while k < count and (instants[k] < changes[0] - close or (not late and instants[k] <= changes[0] + close)):
        k += 1
    for j in range(len(changes)):
        now, last = changes[j], j + 1 == len(changes)
        for c in range(m):
            z[0, c] = inputs[j, c]
            z[1, c] = 0.0
            if straight and not last:
                z[1, c] = (inputs[j + 1, c] - inputs[j, c]) / (changes[j + 1] - changes[j])
        while True:
            reads = k < count and (last or instants[k] < changes[j + 1] - close or (
                not late and instants[k] <= changes[j + 1] + close))
            if not reads and (last or k == count):
                break
            to = instants[k] if reads else changes[j + 1]
            h = to - now
            if h > close:
                slot = -1
                for one in range(SLOTS):
                    if abs(lengths[one] - h) <= close:
                        slot = one
                        break
                if slot < 0:
                    again = norm * h > REACH
                    for one in range(SLOTS):
                        again = again or abs(recent[one] - h) <= close
                    if again:
                        slot, used = used, (used + 1) % SLOTS
                        exponential(F, h, kept[slot])
                        lengths[slot] = h
                    else:
                        recent[noted], noted = h, (noted + 1) % SLOTS
                if slot >= 0:
                    _apply(kept[slot], z, into)
                else:
                    _series(F, h, norm, z, term, into)
                now = to
            if not reads:
                break
            for o in range(outputs):
                for c in range(m):
                    total = 0.0
                    for i in range(n):
                        total += C[o, i] * z[i, c]
                    out[k, o, c] = total
            k += 1
    return out


def thin_out(changes: Array, inputs: Array, straight: bool) -> tuple[Array, Array]:
    """Leave out the times (J,) at which inputs (J, M) take no new value; where they go straight, all are kept."""
    if straight or len(changes) < 2:
        return changes, inputs
    moves = np.concatenate([[True], np.any(np.diff(inputs, axis=0) != 0, axis=1)])
    return changes[moves], inputs[moves]
