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


@cached_njit(inline="always")  # a call counts references to its arrays, which takes as long as the product
def _multiply(left, right, into):
    """Write the product of two matrices; many entries of the left one are zero."""
    for i in range(left.shape[0]):
        for c in range(right.shape[1]):
            total = 0.0
            for k in range(right.shape[0]):
                if left[i, k] != 0.0:
                    total += left[i, k] * right[k, c]
            into[i, c] = total


@cached_njit(inline="always")
def _copy(matrix, into):
    for i in range(matrix.shape[0]):
        for c in range(matrix.shape[1]):
            into[i, c] = matrix[i, c]


@cached_njit
def _exponential(F, h, norm, found):  # noqa: N803 - the field's letter
    """Write exp(F h), found by scaling, a Taylor series and squaring."""
    doublings = 0
    while norm * h > 0.5 * 2.0**doublings:
        doublings += 1
    n, part = len(F), h / 2.0**doublings
    term, following = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            term[i, j] = found[i, j] = 1.0 if i == j else 0.0
    for order in range(1, 18):
        _multiply(F, term, following)
        for i in range(n):
            for j in range(n):
                term[i, j] = following[i, j] * (part / order)
                found[i, j] += term[i, j]
    for _ in range(doublings):
        _multiply(found, found, following)
        _copy(following, found)


@cached_njit
def _series(F, h, norm, z, term, into):  # noqa: N803
    """Move the state by the series of exp(F h), in steps of norm one."""
    n, m = z.shape
    steps = max(1, int(np.ceil(norm * h)))
    g = h / steps
    for _ in range(steps):
        _copy(z, term)
        for order in range(1, TERMS):
            _multiply(F, term, into)
            largest, reached = 0.0, 0.0
            for i in range(n):
                for c in range(m):
                    term[i, c] = into[i, c] * (g / order)
                    z[i, c] += term[i, c]
                    largest = max(largest, abs(term[i, c]))
                    reached = max(reached, abs(z[i, c]))
            if largest <= 1e-18 * reached:
                break


@cached_njit
def _place(lengths, h, close):
    """Return where a length is among others, -1 where it is not."""
    for one in range(len(lengths)):
        if abs(lengths[one] - h) <= close:
            return one
    return -1


@cached_njit
def _is_before(instant, change, close, late):
    """Whether a change does not act yet at an instant; one that is not late acts right after its own instant."""
    return instant < change - close or (not late and instant <= change + close)


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
    while k < count and _is_before(instants[k], changes[0], close, late):
        k += 1
    for j in range(len(changes)):
        now, last = changes[j], j + 1 == len(changes)
        for c in range(m):
            z[0, c] = inputs[j, c]
            z[1, c] = 0.0
            if straight and not last:
                z[1, c] = (inputs[j + 1, c] - inputs[j, c]) / (changes[j + 1] - changes[j])
        while True:
            reads = k < count and (last or _is_before(instants[k], changes[j + 1], close, late))
            if not reads and (last or k == count):
                break
            to = instants[k] if reads else changes[j + 1]
            h = to - now
            if h > close:
                slot = _place(lengths, h, close)
                if slot < 0 and (norm * h > REACH or _place(recent, h, close) >= 0):
                    slot, used = used, (used + 1) % SLOTS
                    _exponential(F, h, norm, kept[slot])
                    lengths[slot] = h
                if slot >= 0:
                    _multiply(kept[slot], z, into)
                    _copy(into, z)
                else:
                    recent[noted], noted = h, (noted + 1) % SLOTS
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
