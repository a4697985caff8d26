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
def exponential(F, h):  # noqa: N803 - the field's letter
    """Return exp(F h), found by scaling, a Taylor series and squaring."""
    doublings, size = 0, np.sum(np.abs(F), axis=1).max() * h
    while size > 0.5:
        size, doublings = size / 2.0, doublings + 1
    term, found = np.eye(len(F)), np.eye(len(F))
    for order in range(1, 18):
        term = F @ term * (h / 2.0**doublings / order)
        found += term
    for _ in range(doublings):
        found = found @ found
    return found


@cached_njit
def _multiply(E, z, into):  # noqa: N803
    for i in range(len(into)):
        for c in range(z.shape[1]):
            total = 0.0
            for k in range(len(z)):
                total += E[i, k] * z[k, c]
            into[i, c] = total


@cached_njit
def _series(F, h, norm, z, term, into):  # noqa: N803
    """Move the state by the series of exp(F h), in steps of norm one."""
    steps = max(1, int(np.ceil(norm * h)))
    for _ in range(steps):
        term[:] = z
        for order in range(1, TERMS):
            _multiply(F, term, into)
            largest, reached = 0.0, 0.0
            for i in range(len(z)):
                for c in range(z.shape[1]):
                    term[i, c] = into[i, c] * (h / steps / order)
                    z[i, c] += term[i, c]
                    largest = max(largest, abs(term[i, c]))
                    reached = max(reached, abs(z[i, c]))
            if largest <= 1e-18 * reached:
                break


@cached_njit
def _find(lengths, h, close):
    for one in range(SLOTS):
        if abs(lengths[one] - h) <= close:
            return one
    return -1


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
    n, m, count = len(F), inputs.shape[1], len(instants)
    out, z, into, term = np.zeros((count, len(C), m)), start.copy(), np.zeros((n, m)), np.zeros((n, m))
    kept, lengths, recent = np.zeros((SLOTS, n, n)), np.full(SLOTS, -1.0), np.full(SLOTS, -1.0)
    if not count or not len(changes):
        return out
    used, noted, norm = 0, 0, np.sum(np.abs(F), axis=1).max()
    # a few times the rounding of a difference of two times
    close = 1e-15 * max(abs(instants[0]), abs(instants[-1]), abs(changes[0]), abs(changes[-1]))
    k = 0
    while k < count and (instants[k] < changes[0] - close or (not late and instants[k] <= changes[0] + close)):
        k += 1
    for j in range(len(changes)):
        now, last = changes[j], j + 1 == len(changes)
        z[0], z[1] = inputs[j], 0.0
        if straight and not last:
            z[1] = (inputs[j + 1] - inputs[j]) / (changes[j + 1] - changes[j])
        while True:
            reads = k < count and (last or instants[k] < changes[j + 1] - close or (
                not late and instants[k] <= changes[j + 1] + close))
            if not reads and (last or k == count):
                break
            to = instants[k] if reads else changes[j + 1]
            h = to - now
            if h > close:
                slot = _find(lengths, h, close)
                if slot < 0:
                    if norm * h > REACH or _find(recent, h, close) >= 0:
                        slot, used = used, (used + 1) % SLOTS
                        kept[slot] = exponential(F, h)
                        lengths[slot] = h
                    else:
                        recent[noted], noted = h, (noted + 1) % SLOTS
                if slot >= 0:
                    _multiply(kept[slot], z, into)
                    z[:] = into
                else:
                    _series(F, h, norm, z, term, into)
                now = to
            if not reads:
                break
            _multiply(C, z, out[k])
            k += 1
    return out


def thin_out(changes: Array, inputs: Array, straight: bool) -> tuple[Array, Array]:
    """Leave out the times (J,) at which inputs (J, M) take no new value; where they go straight, all are kept."""
    if straight or len(changes) < 2:
        return changes, inputs
    moves = np.concatenate([[True], np.any(np.diff(inputs, axis=0) != 0, axis=1)])
    return changes[moves], inputs[moves]
