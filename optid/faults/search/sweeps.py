"""All correlations of a window with the signatures of a dictionary, over all onsets, by one sweep backwards in time.

A fault of any kind adds to the error of the steady predictor, in the step from k to k + 1 and to the innovation of k, a
combination of known columns. So the correlation of a window with an impulse at k follows from the costate of the
predictor, and that with a lasting fault, a drift, a loss or a stuck actuator from running sums of it: O(N n^2) for all
onsets and all candidates together, missing readings included. The products of the signatures with themselves obey a
backward recursion of the same kind.

An uncertain model (`optid.faults.nuisance`) multiplies window and signatures by S = (I + M M')^(-1/2). S is symmetric,
so that correlations are those of the plain signatures with S r, and products lose a term of low rank.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from optid.arrays import Array, compact
from optid.errors import DataError, StructureError
from optid.faults.kinds import DRIFT, JUMP
from optid.faults.places import matrices_of
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened
from optid.models.experiments import samples_of

SHARE = 1e-9  # directions of a signature with less than this share of the energy of the largest one explain nothing
BATCH = 2_000_000  # numbers of a batch of simulated windows
SMALL = 10_000  # products of columns up to which a single run takes less time than to compile it


class SweepTables(NamedTuple):
    """Input of the kernels of `optid.faults.search.sweep_kernels`."""

    of: np.ndarray  # (N,) which of the T tables governs a sample
    F: Array  # (T, n, n) transition of the error of the predictor
    C: Array  # (l, n)
    W: Array  # (T, l, l) whitening, lower triangular; zero rows and columns where a reading is missing
    h: Array  # (T, l, D) additions of the columns to the innovation
    e: Array  # (T, n, D) their additions to the state of the next sample
    lasting: int  # number of columns that last, which come first
    drifts: int  # number of drifts, which follow; the others are jumps
    helpers: int  # index of the helper of the first drift
    group: np.ndarray  # (D,) candidate of every column, helpers included
    first: np.ndarray  # (C,) first column of every candidate
    sizes: np.ndarray  # (C,) number of its columns; 0 for a candidate without a signature
    places: np.ndarray  # (C,) where its inverse roots begin in a row of `Sweep.roots`


@dataclass(frozen=True, eq=False)
class Sweep:
    """The search for one fault, ready for windows of one length, pattern of missing readings and input."""

    found: Dictionary  # the dictionary
    white: Whitened  # a window like those to be searched: its predictor, missing readings, uncertain model and states
    u: Array | None  # (N, m) inputs; None where they were not given
    tables: SweepTables  # of the recursions and of the columns
    # (N, R) inverse roots of the products, row by row and candidate after candidate; zero rows for directions that have
    # no effect
    roots: Array
    tested: np.ndarray  # (C, N) whether the candidate is tested at the onset
    # V (N, q, D): an uncertain model, and axes projected out, take V' V off the products of the columns; q is zero
    # without them
    along: Array

    @property
    def window(self) -> int:
        """Samples N of a window."""
        return len(self.white.r)

    def roots_of(self, c: int) -> Array:
        """Return R (N, d, d) of a candidate: R' R is the inverse of the products of its columns."""
        d, place = int(self.tables.sizes[c]), int(self.tables.places[c])
        return self.roots[:, place : place + d * d].reshape(-1, d, d)

    def columns(self, c: int) -> slice:
        """Return the columns of a candidate among the correlations."""
        return slice(int(self.tables.first[c]), int(self.tables.first[c] + self.tables.sizes[c]))

    def without(self, axes: Array, share: float) -> "Sweep":
        """Project axes (N l, q), orthonormal, out of all signatures, like a nuisance of infinite variance.

        Directions of which less than this share of their energy is left explain nothing.
        """
        taken = np.empty((self.window, axes.shape[1], self.tables.group.size))
        for i, axis in enumerate(axes.T):
            taken[:, i] = self.correlations(axis.reshape(self.white.r.shape))
        roots, tested = np.zeros_like(self.roots), np.zeros_like(self.tested)
        for c in np.flatnonzero(self.tables.sizes).tolist():
            root, place = self.roots_of(c), int(self.tables.places[c])
            shared = root @ np.swapaxes(taken[:, :, self.columns(c)], 1, 2)
            own = np.any(root, axis=2)[:, :, None] * np.eye(root.shape[1])  # zero for a direction without effect
            left = inverse_roots(own - shared @ np.swapaxes(shared, 1, 2), np.ones(self.window), share)
            roots[:, place : place + root[0].size] = (left @ root).reshape(self.window, -1)
            tested[c] = self.tested[c] & np.any(left, axis=(1, 2))
        return replace(self, roots=roots, tested=tested, along=np.concatenate([self.along, taken], axis=1))

    def signature(self, c: int, onset: int) -> Array:
        """Return the whitened signature (N, l, d) of a candidate that has one."""
        candidate, white, A = self.found.candidates[c], self.white, None
        if candidate.schedule is None:
            into_state, into_output = self.found.additions(candidate, self.window, onset, self.u)
        else:
            into_state, A = _change(self.found, candidate, white.states, self.u)
            into_state[:onset] = 0.0
            into_output = np.zeros((*white.r.shape, 1))
        return white.whiten_signature(white.predictor.respond(into_state, into_output, white.present, A))

    def correlations(self, r: Array) -> Array:
        """Return the correlations (N, D) of a window (N, l) with the signatures."""
        from optid.faults.search.sweep_kernels import correlate

        seen = r if self.white.nuisance is None else self.white.nuisance(r)
        result = np.empty((self.window, self.tables.group.size))
        correlate(self.tables, compact(seen), result)
        return result

    def coordinates(self, correlations: Array, c: int) -> Array:
        """Return the coordinates (..., N, d) of windows along the orthonormal axes of a candidate at every onset."""
        return np.einsum("kqp,...kp->...kq", self.roots_of(c), correlations[..., self.columns(c)])

    def statistic(self, correlations: Array) -> Array:
        """Return the energies (C, N) explained, NaN where a candidate is not tested."""
        from optid.faults.search.sweep_kernels import explained

        result = np.full(self.tested.shape, np.nan)
        explained(self.tables, correlations, self.roots, result)
        result[~self.tested] = np.nan
        return result

    def largest(self, windows: Array) -> Array:
        """Return the largest energy over the onsets for windows (M, N, l), (M, C); NaN where not tested."""
        from optid.faults.search.sweep_kernels import correlate, explained

        shown = np.where(self.white.present, windows, 0.0)
        if self.white.nuisance is not None:
            shown = np.moveaxis(self.white.nuisance(np.moveaxis(shown, 0, 2)), 2, 0)
        correlations = np.empty((self.window, self.tables.group.size))
        statistic, result = np.full(self.tested.shape, np.nan), np.empty((len(windows), len(self.tested)))
        for window, row in zip(compact(shown), result):
            correlate(self.tables, window, correlations)
            explained(self.tables, correlations, self.roots, statistic)
            np.fmax.reduce(statistic, axis=1, where=self.tested, initial=-np.inf, out=row)
        result[:, ~self.tested.any(axis=1)] = np.nan
        return result

    def simulated(self, draws: int, rng: np.random.Generator) -> Iterator[Array]:
        """Yield `draws` windows (M, N, l) of a healthy plant in batches."""
        size = max(1, BATCH // (self.window * self.found.model.l))
        for start in range(0, draws, size):
            yield rng.standard_normal((min(size, draws - start), self.window, self.found.model.l))


_KEPT: "WeakKeyDictionary[Dictionary, dict[Any, Sweep]]" = WeakKeyDictionary()
_MOST = 4


def sweep(found: Dictionary, window: int | Whitened, u: Any = None) -> Sweep:
    """Prepare the search for one fault.

    Tables that depend on the model alone are cached with the dictionary for the next window of the same length.

    Args:
        found: the dictionary.
        window: samples N, or a window with its predictor, missing readings, uncertain model and states.
        u: (N, m) inputs, for losses and stuck actuators, which are not tested without it; scheduled changes need the
            states of the window, too.

    Raises:
        DataError: inputs of another length, or missing.
        StructureError: a window that is too short, or no candidate with a signature.
    """
    if isinstance(window, Whitened):
        white = window
    else:
        empty = np.zeros((int(window), found.model.l))
        white = Whitened(empty, empty, np.ones(empty.shape, dtype=bool), found.predictor, found.model.outputs)
    count, least = len(white.r), 2 * found.model.nx + 2
    if count < least:
        raise StructureError(f"window={count}: {found.model.nx} states require at least {least} samples.")
    inputs = None if u is None else _inputs(found, u, count)
    states = None if inputs is None else white.states
    able = tuple(
        c.additive or bool(c.columns) and inputs is not None or c.schedule is not None and states is not None
        for c in found.candidates)
    if states is not None and len(states) != count and any(c.schedule for c in found.candidates):
        raise DataError(f"The states have {len(states)} samples; the window has {count}: cut them like the rest.")
    if not any(able):
        raise StructureError("No candidate has a signature: add the kind 'bias', 'drift' or a state jump, or pass the "
                             "input u for losses and stuck actuators.")
    driven = any(a and not c.additive for c, a in zip(found.candidates, able))
    if driven or white.nuisance is not None or not white.present.all():
        return _prepared(found, white, inputs, able)
    steady = white.predictor
    key = (count, able, *(part.tobytes() for part in (steady.A, steady.C, steady.K, steady.L, steady.root)))
    kept = _KEPT.setdefault(found, {})
    if key not in kept:
        if len(kept) >= _MOST:
            kept.pop(next(iter(kept)))
        kept[key] = _prepared(found, white, None, able, once=True)
    return kept[key]


def _inputs(found: Dictionary, u: Any, window: int) -> Array:
    inputs = samples_of(u, "u", found.model.m)
    if len(inputs) != window:
        raise DataError(f"u has {len(inputs)} samples; the window has {window}.")
    bad = ~np.isfinite(inputs)
    if bad.any():
        k, c = np.argwhere(bad)[0]
        raise DataError(
            f"Input {found.model.inputs[c]!r} is missing at sample {k}: the signature of a loss requires every input.")
    return inputs


def _prepared(found: Dictionary, white: Whitened, u: Array | None, able: tuple[bool, ...], once: bool = False) -> Sweep:
    from optid.faults.search.sweep_kernels import correlate, grams

    tables, window, nuisance = _tables(found, white, u, able), len(white.r), white.nuisance
    if any(a and c.schedule for a, c in zip(able, found.candidates)):
        tables = _with_schedules(found, white, tables, u)
    columns, size = tables.group.size, int(np.sum(tables.sizes**2))
    slots = np.full((columns, columns), -1, dtype=np.int64)
    for d, place, begin in zip(tables.sizes, tables.places, tables.first):
        slots[begin : begin + d, begin : begin + d] = place + np.arange(d * d).reshape(d, d)
    products = np.zeros((window, size))
    multiply: Any = grams.py_func if once and window * columns**2 <= SMALL else grams
    multiply(tables, slots, products, np.empty((0, tables.F.shape[1], columns)))
    along = np.zeros((window, 0 if nuisance is None else nuisance.s.size, columns))
    if nuisance is not None:
        one = np.empty((window, columns))
        for i, (axis, s) in enumerate(zip(nuisance.U.T, nuisance.s)):
            correlate(tables, compact(axis.reshape(window, -1)), one)
            along[:, i] = np.sqrt(1 - 1 / (1 + s**2)) * one
    roots, tested = np.zeros((window, size)), np.zeros((len(able), window), dtype=bool)
    for c, (d, place, begin) in enumerate(zip(tables.sizes, tables.places, tables.first)):
        if d:
            own = products[:, place : place + d * d].reshape(window, d, d)
            largest = own[:, 0, 0] if d == 1 else np.asarray(np.linalg.eigvalsh(own)[:, -1], dtype=float)
            part = along[:, :, begin : begin + d]
            root = inverse_roots(own - np.einsum("kqi,kqj->kij", part, part, optimize=True), largest)
            roots[:, place : place + d * d] = root.reshape(window, -1)
            tested[c] = np.any(root, axis=(1, 2))
            tested[c, window - (-(-int(d) // found.model.l)) + 1 :] = False
    return Sweep(found, white, u, tables, roots, tested, along)


def inverse_roots(products: Array, largest: Array, share: float = SHARE) -> Array:
    """Return R (T, d, d) with R' R the inverse of the products, zero in directions below that share of the largest."""
    floor = share * np.maximum(largest, 1e-300)
    if products.shape[1] == 1:
        there = products > floor[:, None, None]
        return np.where(there, 1 / np.sqrt(np.where(there, products, 1.0)), 0.0)
    values, axes = np.linalg.eigh(products)
    there = values > floor[:, None]
    inverse = np.where(there, 1 / np.sqrt(np.where(there, values, 1.0)), 0.0)
    return np.asarray(inverse[:, :, None] * np.swapaxes(axes, 1, 2))


def _tables(found: Dictionary, white: Whitened, u: Array | None, able: tuple[bool, ...]) -> SweepTables:
    steady, window, l = white.predictor, len(white.r), found.model.l  # noqa: E741
    patterns, which = np.unique(white.present, axis=0, return_inverse=True)
    of = np.asarray(which, dtype=np.int64).ravel()
    gains = np.where(patterns[:, None, :], -steady.K, steady.L)
    whitening = np.stack([steady.whiten(np.eye(l)[None], pattern[None])[0] for pattern in patterns])
    candidates = found.candidates
    tested = [i for i, a in enumerate(able) if a]
    drifts, jumps = ([i for i in tested if candidates[i].fault_kind.course == course] for course in (DRIFT, JUMP))
    lasting = [i for i in tested if i not in drifts and i not in jumps]
    line = lasting + drifts + drifts + jumps  # the helpers of the drifts are the last of the columns that last
    into = [
        found.additions(c, window, 0, u) if c.columns else (c.into_state[None], c.into_output[None])
        for c in (candidates[i] for i in line)]
    if not all(candidates[i].additive for i in line):
        into = [tuple(np.broadcast_to(part, (window, *part.shape[1:])) for part in pair) for pair in into]
        gains, whitening, of = gains[of], whitening[of], np.arange(window)
    x, z = (np.concatenate([pair[i] for pair in into], axis=2) for i in (0, 1))
    h = steady.C @ x + z
    e = steady.A @ x + gains @ h
    h = np.broadcast_to(h, (len(gains), *h.shape[1:]))
    sizes = [pair[0].shape[2] for pair in into]
    first, dimensions = np.zeros(len(able), dtype=np.int64), np.zeros(len(able), dtype=np.int64)
    for i, begin, d in zip(line, np.cumsum([0, *sizes]), sizes):  # of a drift, its own columns after its helpers
        first[i], dimensions[i] = begin, d
    places = np.concatenate([[0], np.cumsum(dimensions**2)[:-1]])
    helpers, drifting = (sum(candidates[i].dimension for i in part) for part in (lasting, drifts))
    return SweepTables(
        of, compact(steady.A + gains @ steady.C), compact(steady.C), compact(whitening), compact(h), compact(e),
        helpers + drifting, drifting, helpers, np.repeat(line, sizes), first, dimensions, places,
    )


def _with_schedules(found: Dictionary, white: Whitened, tables: SweepTables, u: Array | None) -> SweepTables:
    """Append the states of one more predictor for every scheduled change: it has matrices of its own."""
    steady, n = white.predictor, found.model.nx
    chosen = [(i, c) for i, c in enumerate(found.candidates) if c.schedule is not None and tables.sizes[i]]
    wide = n * (1 + len(chosen))
    count, _, columns = tables.e.shape
    F, h, e = np.zeros((count, wide, wide)), np.array(tables.h), np.zeros((count, wide, columns))
    F[:, :n, :n], e[:, :n] = tables.F, tables.e
    for place, (i, candidate) in enumerate(chosen, 1):
        own, column = slice(n * place, n * (place + 1)), tables.first[i]
        added, A = _change(found, candidate, white.states, u)
        F[:, own, own] = tables.F + A - steady.A
        h[:, :, column] = added[:, :, 0] @ steady.C.T
        e[:, own, column] = np.einsum("kij,kj->ki", F[:, own, own], added[:, :, 0])
    return tables._replace(F=F, C=np.tile(tables.C, 1 + len(chosen)), h=h, e=e)


def _change(found: Dictionary, candidate: Candidate, states: Any, u: Any) -> tuple[Array, Array]:
    """Return the additions (N, n, 1) of a scheduled change, (1.8) and (1.10), to the states, and its A(k) (N, n, n).

    Its signature is the difference between the predictions of the healthy predictor, with states x, and of one with
    the changed matrices: e+ = (A(k) - K C) e + (A(k) - A) x + (B(k) - B) f(u), for all onsets. Its magnitude is one
    where the plant changes as described, and linear where B alone changes.
    """
    fault, count, model = candidate.schedule, len(u), found.model
    assert fault is not None
    A, B = (matrices_of(candidate.label, word, given, range(count), healthy, count)
            for word, given, healthy in (("A", fault.A, model.A), ("B", fault.B, model.B)))
    step = np.einsum("kij,kj->ki", A - model.A, states) + np.einsum("kij,kj->ki", B - model.B, model.expand_inputs(u))
    return np.vstack([np.zeros((1, model.nx)), step[:-1]])[:, :, None], A
