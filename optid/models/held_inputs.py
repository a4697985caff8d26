"""Linear state equations between samples: exact for inputs that are held, at any instants, behind any dead time.

A dead time only moves the instants at which a held drive changes. Between two changes the course is
exp(t [A B; 0 0]) of the state and the drive; the matrix logarithm takes such a step back to the equations.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm, logm, matrix_balance

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.recursions import late_njit

SAME = 1e-9  # share of the shortest sampling interval within which two instants are one
ALIKE = 1e-12  # share of the longest interval within which two intervals are one
AMBIGUOUS = 1e-6  # angle from the negative real axis, in radians, within which a logarithm has no certain branch
INVERSE = 1e-9  # relative error up to which exp(log(step)) counts as the step
CHUNK = 1024  # matrix exponentials taken at a time


def held_step(A: Array, B: Array, interval: float | Array) -> tuple[Array, Array]:
    """Return Phi (.., n, n) and Gamma (.., n, r): x(t + interval) = Phi x(t) + Gamma w while w is held."""
    n, r = B.shape  # exponentials keep their digits where states and drives have units of one size
    block, scale = np.zeros((n + r, n + r)), np.ones(n + r)
    if n:
        block[:n, :n], (scale[:n], _) = matrix_balance(A, permute=False, separate=True)
    block[:n, n:] = B / scale[:n, None]
    size, own = np.abs(block[:n, n:]).max(axis=0, initial=0.0), np.abs(block[:n, :n]).max(initial=0.0)
    scale[n:] = np.where(size > 0, (own or 1.0) / np.where(size > 0, size, 1.0), 1.0)  # of the drives
    block[:n, n:] *= scale[n:]
    steps = expm(np.asarray(interval, dtype=float)[..., None, None] * block) * scale[:, None] / scale
    return steps[..., :n, :n], steps[..., :n, n:]


def held_equations(Phi: Array, Gamma: Array, interval: float) -> tuple[Array, Array]:
    """Return A and B of x' = A x + B w, of which Phi (n, n) and Gamma (n, r) are a step; the inverse of `held_step`.

    Raises:
        StructureError: no such equations exist or they are not unique: a pole at 0, a negative real pole; or the
            logarithm cannot be computed.
    """
    n, r = Gamma.shape
    if n == 0:
        return np.zeros((0, 0)), np.zeros((0, r))
    poles: Any = np.linalg.eigvals(Phi).astype(complex)
    for pole in poles:
        if pole.imag == 0 and pole.real < 0:
            raise StructureError(
                f"The negative real pole {pole.real:.4g} has no continuous counterpart: no held input makes a "
                "plant alternate from sample to sample. It describes noise, or a faster oscillation than half the "
                "sampling rate: lower the order, or sample faster.")
        if np.pi - abs(np.angle(pole)) <= AMBIGUOUS:
            raise StructureError(
                f"The poles {pole.real:.4g} +- {abs(pole.imag):.2g}i lie at half the sampling rate, where the "
                "logarithm changes its branch: their frequency is not determined. Sample faster.")
    block = np.vstack([np.hstack([Phi, Gamma]), np.eye(r, n + r, k=n)])
    size = np.abs(Gamma).max(axis=0)
    block[:n, n:] /= np.where(size > 0, size, 1.0)
    balanced, (scale, _) = matrix_balance(block, permute=False, separate=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # its accuracy is judged below
        log: Any = logm(balanced)
    back = expm(log)
    error = np.abs(back - balanced).max() + np.abs(log.imag).max()
    if not error <= INVERSE * np.abs(balanced).max():
        raise StructureError(
            f"The matrix logarithm of the sampled equations is not accurate (relative error {error:.1e}): poles nearly "
            "coincide, or one is almost 0. Lower the order.")
    equations = (log.real * scale[:, None] / scale)[:n] / interval
    return equations[:, :n], equations[:, n:] * np.where(size > 0, size, 1.0)


class Course(NamedTuple):
    """Intervals between the instants at which a held drive changes or an output is read."""

    lengths: Array  # (S,) of the intervals
    drives: np.ndarray  # (S, r) the sample of every drive in an interval; -1 before the first one
    reads: np.ndarray  # (N,) the interval at whose beginning every output is read


def regular_course(count: int, dt: float, delays: Array) -> Course:
    """Return the course of samples at 0, dt, 2 dt, .. with the delays (r,) of the drives."""
    whole, rest = split_delays(delays, dt)
    starts = np.unique(np.concatenate([[0.0], rest]))
    late = rest > starts[:, None]  # in these parts of a sampling interval the drive is still the previous one
    lengths = np.diff(np.concatenate([starts, [dt]]))
    samples = np.arange(count)[:, None, None] - whole - late
    return Course(np.tile(lengths, count), np.maximum(samples.reshape(-1, delays.size), -1),
                  np.arange(count) * starts.size)


def irregular_course(times: Array, delays: Array) -> Course:
    """Return the course of samples at ascending times (N,) with the delays (r,) of the drives."""
    shortest = float(np.min(np.diff(times), initial=np.inf))
    same = SAME * (shortest if np.isfinite(shortest) else 1.0)
    changes = times[:, None] + delays
    near = np.clip(np.searchsorted(times, changes - same), 0, times.size - 1)
    changes = np.where(np.abs(times[near] - changes) <= same, times[near], changes)
    instants = np.unique(np.concatenate([times, changes[changes < times[-1]]]))
    drives = np.column_stack([np.searchsorted(column, instants, side="right") - 1 for column in changes.T]
                             ) if delays.size else np.zeros((instants.size, 0), dtype=int)
    return Course(np.append(np.diff(instants), 0.0), drives, np.searchsorted(instants, times))


def split_delays(delays: Array, dt: float) -> tuple[Array, Array]:
    """Split delays (r,) into numbers of whole sampling times and rests in [0, dt), exact where they are multiples."""
    whole = np.floor(delays / dt + SAME)
    rest = delays - whole * dt
    return whole.astype(int), np.where(rest > SAME * dt, rest, 0.0)


def run_course(A: Array, B: Array, x0: Array, course: Course, w: Array, before: Array) -> tuple[Array, Array]:
    """Run x' = A x + B w over a course; return the states (N, n) and the drives (N, r) where outputs are read.

    w (N, r) are the samples of the drives, `before` (r,) their values before the first one. A last column of B without
    a drive is a constant.
    """
    r, drives = w.shape[1], np.vstack([w, before])  # the sample -1 is the last row
    driven = np.take_along_axis(drives, course.drives, axis=0) if r else np.zeros((len(course.lengths), 0))
    held = np.hstack([driven, np.ones((len(driven), B.shape[1] - r))])
    grid = np.round(course.lengths / max(course.lengths.max(), 1e-300) / ALIKE)
    _, index, counts = np.unique(grid, return_inverse=True, return_counts=True)
    lengths = np.bincount(index, course.lengths) / counts
    states = np.empty((len(index), len(A)))
    x, march = np.array(x0, dtype=float), late_njit(_march)
    if lengths.size <= CHUNK:
        march(*map(np.ascontiguousarray, held_step(A, B, lengths)), index, held, x, states)
        return states[course.reads], driven[course.reads]
    for first in range(0, len(index), CHUNK):
        part = slice(first, first + CHUNK)
        steps = map(np.ascontiguousarray, held_step(A, B, course.lengths[part]))
        x = march(*steps, np.arange(len(index[part])), held[part], x, states[part])
    return states[course.reads], driven[course.reads]


def _march(Phi, Gamma, index, held, x, states):
    """Write the state at the beginning of every interval, and return that at the end of the last one."""
    n, r = x.size, held.shape[1]
    following = np.empty(n)
    for s in range(index.size):
        k = index[s]
        for i in range(n):
            states[s, i] = x[i]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += Phi[k, i, j] * x[j]
            for j in range(r):
                total += Gamma[k, i, j] * held[s, j]
            following[i] = total
        for i in range(n):
            x[i] = following[i]
    return x
