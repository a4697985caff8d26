"""The columns of the candidates of a monitor, as arrays, and the window that the search keeps of them."""

from dataclasses import dataclass, field

import numpy as np

from optid.arrays import Array
from optid.faults.monitor.search_kernel import DEPENDENT, DRIFT, DRIVEN, JUMP, LASTING, search
from optid.faults.signatures import Candidate
from optid.faults.whitening import Predictor
from optid.models import HammersteinSS

Matrices = tuple[Array, Array, Array, Array]  # transition, output, gain and root of the search

COURSES = {"bias": LASTING, "drift": DRIFT, "jump": JUMP, "spike": JUMP, "loss": DRIVEN, "stuck": LASTING}
"""The course of the columns of a kind; the loss of a stuck actuator, its last column, is driven."""

SPARE = 8
"""Carried directions for which the search has room, beside twice the widest candidate."""


def search_matrices(steady: Predictor) -> Matrices:
    """Return what the search needs of a steady predictor."""
    return (np.ascontiguousarray(steady.A), np.ascontiguousarray(steady.C), np.ascontiguousarray(steady.K),
            np.ascontiguousarray(steady.root))


@dataclass(frozen=True, eq=False)
class Columns:
    """D columns of C candidates; a stuck actuator has its constants first and the loss last.

    Attributes:
        candidates: (C,).
        into_state: (D, n) what a column adds to the state, per unit of its course.
        into_output: (D, l) what it adds to the output.
        course: (D,) of `search_kernel`.
        driven: (D,) number of the loss, -1 for the others.
        moving: (D,) whether the column belongs to a candidate with a loss.
        losses: per loss (n, r) and (l, r), what the functions of the inputs add to state and output.
        first: (C,) first column of a candidate.
        size: (C,) its columns.
        least: (C,) samples that it needs.
    """

    candidates: tuple[Candidate, ...]
    into_state: Array
    into_output: Array
    course: np.ndarray
    driven: np.ndarray
    moving: np.ndarray
    losses: tuple[tuple[Array, Array], ...]
    first: np.ndarray
    size: np.ndarray
    least: np.ndarray

    @property
    def count(self) -> int:
        """Number D of columns."""
        return len(self.course)

    @property
    def pairs(self) -> np.ndarray:
        """(C,) products of the columns of a candidate with one another; the kernel keeps them in this order."""
        return self.size * (self.size + 1) // 2

    def of(self, number: int) -> slice:
        """Columns of a candidate."""
        return slice(int(self.first[number]), int(self.first[number] + self.size[number]))

    def signals(self, before: Array, f: Array) -> tuple[Array, Array]:
        """Return what losses add to the state (T, M, n) and to the output (T, M, l).

        Args:
            before: (T, r) functions of the inputs one sample earlier.
            f: (T, r) functions of the inputs.
        """
        n, l = self.into_state.shape[1], self.into_output.shape[1]  # noqa: E741
        state, output = np.empty((len(f), len(self.losses), n)), np.empty((len(f), len(self.losses), l))
        for number, (into_state, into_output) in enumerate(self.losses):
            np.einsum("ir,tr->ti", into_state, before, out=state[:, number])
            np.einsum("or,tr->to", into_output, f, out=output[:, number])
        return state, output

    def units(self, before: Array, f: Array) -> tuple[Array, Array]:
        """Return what each column adds to the state (D, n) and output (D, l) at one sample, per unit of its course."""
        into_state, into_output = self.into_state.copy(), self.into_output.copy()
        for j, number in enumerate(self.driven):
            if number >= 0:
                into_state[j] = self.losses[number][0] @ before
                into_output[j] = self.losses[number][1] @ f
        return into_state, into_output

    def in_order(self, number: int, sizes: Array) -> tuple[float, ...]:
        """Return magnitudes in the order of `Dictionary.signature`: the share lost first."""
        last = self.candidates[number].kind == "stuck"
        return tuple(float(v) for v in (np.roll(sizes, 1) if last else sizes))


def columns_of(model: HammersteinSS, candidates: tuple[Candidate, ...]) -> Columns:
    """Tabulate the candidates of a dictionary of a model."""
    r, rows_state, rows_output, course, driven, losses, moves = model.B.shape[1], [], [], [], [], [], []
    for c in candidates:
        moves += [bool(c.columns)] * c.dimension
        if c.kind != "loss":
            rows_state += list(c.into_state.T)
            rows_output += list(c.into_output.T)
            course += [COURSES[c.kind]] * c.into_state.shape[1]
            driven += [-1] * c.into_state.shape[1]
        if c.columns:
            rows_state.append(np.zeros(model.nx))
            rows_output.append(np.zeros(model.l))
            course.append(DRIVEN)
            driven.append(len(losses))
            parts = []
            for into in (c.into_state, c.into_output):
                parts.append(np.zeros((len(into), r)))
                parts[-1][:, list(c.columns)] = -into
            losses.append((parts[0], parts[1]))
    size = np.array([c.dimension for c in candidates])
    return Columns(candidates, np.array(rows_state), np.array(rows_output), np.array(course), np.array(driven),
                   np.array(moves), tuple(losses), np.cumsum([0, *size[:-1]]), size, -(-size // model.l))


@dataclass(eq=False)
class Window:
    """What the search keeps of the last W samples; see `search_kernel.search`.

    Attributes:
        columns: the candidates.
        length: samples W.
        room: largest number of states, carried faults included.
        steady: the predictor.
        clock: (1,) samples searched.
        clean: (1,) samples searched by the steady predictor since another one was used.
        directions: (l, l) unit vectors along which the noise of each sensor enters the whitened innovations.
        whitened: (W, l) innovations, by sample.
        readings: (W,) numbers of readings, by sample.
        statistic: (C,) of the last sample.
        peak: (C,) samples since the best onset, counting its own; 0 without.
        weight: (C,) what the loss of a candidate has of its own in a whole window; -1 before there is one.
    """

    columns: Columns
    length: int
    room: int
    directions: Array
    steady: Predictor
    clock: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        D, C, W = self.columns.count, len(self.columns.size), self.length
        self.xi, self.b, self.grown = np.zeros((D, self.room, W)), np.zeros((D, W)), np.zeros(W)
        self.gram = np.zeros((int(self.columns.pairs.sum()), W))
        self.whitened, self.readings = np.zeros((W, self.columns.into_output.shape[1])), np.zeros(W)
        self.statistic, self.peak, self.weight = np.zeros(C), np.zeros(C, dtype=np.int64), np.full(C, -1.0)
        self.clock, self.clean = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
        self._tabulate()

    KEPT = "xi", "b", "grown", "gram", "whitened", "readings", "statistic", "peak", "weight", "clock", "clean"

    def restart(self) -> None:
        """Forget all onsets before the next sample."""
        self.clock[0] = self.clean[0] = 0
        self.statistic[:], self.peak[:], self.weight[:] = 0.0, 0, -1.0

    def _tabulate(self) -> None:
        """Follow every column from one onset through the steady predictor; the tables have the oldest onset first."""
        parts, W, steady = self.columns, self.length, self.steady
        n, l = steady.K.shape  # noqa: E741
        xi, course = np.zeros((parts.count, n)), parts.course
        self.table, self.deviations = np.zeros((parts.count, l, 2 * W)), np.zeros((parts.count, n, W))
        self.products = np.zeros((len(self.gram), 2 * W))
        pairs = [(j, h) for first, d in zip(parts.first, parts.size) for i in range(d) for j in [first + i]
                 for h in range(first, j + 1)]
        left, right = (np.array(part) for part in zip(*pairs))
        total = np.zeros(len(pairs))
        for age in range(W):
            size = np.where(course == DRIFT, age + 1.0, np.where((course == JUMP) & (age > 0), 0.0, 1.0))[:, None]
            xi = xi + size * parts.into_state
            raw = xi @ steady.C.T + size * parts.into_output
            sig, place = raw @ steady.root.T, W - 1 - age
            xi = xi @ steady.A.T - raw @ steady.K.T
            total = total + np.sum(sig[left] * sig[right], axis=1)
            self.table[:, :, [place, place + W]] = sig[:, :, None]
            self.products[:, [place, place + W]] = total[:, None]
            self.deviations[:, :, place] = xi
        self.factors, self.inverses = np.zeros_like(self.products), np.zeros((parts.count, 2 * W))
        for number, d in enumerate(parts.size):
            own, start = int(parts.first[number]), int(parts.pairs[:number].sum())
            at = {(i, h): start + i * (i + 1) // 2 + h for i in range(d) for h in range(i + 1)}
            for (i, h), row in at.items():
                left_over = self.products[row] - sum(
                    (self.factors[at[i, q]] * self.factors[at[h, q]] for q in range(h)), np.zeros(2 * W))
                if h < i:
                    self.factors[row] = left_over * self.inverses[own + h]
                else:
                    enough = left_over > np.maximum(DEPENDENT * self.products[row], 0.0)
                    self.inverses[own + i, enough] = 1 / np.sqrt(left_over[enough])
                    self.factors[row] = left_over * self.inverses[own + i]

    def _leave_tables(self) -> None:
        """Write what the tables stand for to the deviations and products that are followed."""
        still, shift = ~self.columns.moving, self.length - 1 - int(self.clock[0] - 1) % self.length
        at = (shift + np.arange(self.length)) % self.length
        n = self.deviations.shape[1]
        self.xi[still] = 0.0
        self.xi[still, :n] = self.deviations[still][:, :, at]
        rows = np.repeat(still[self.columns.first], self.columns.pairs)
        self.gram[rows] = self.products[rows][:, at]

    def advance(self, matrices: Matrices, signals: tuple[Array, Array], r: Array, limit: Array,
                shown: int | None = None) -> tuple[int, Array, Array]:
        """Search samples until one exceeds a limit; return how many, their statistics and weights (T, C).

        Args:
            matrices: transition, output, gain and root; the steady ones where `shown` is not given.
            signals: of the losses.
            r: (T, l) whitened innovations.
            limit: (C,).
            shown: readings of the one sample that is not searched by the steady predictor.
        """
        parts, count = self.columns, len(r)
        statistic, weight = np.empty((count, len(limit))), np.empty((count, len(limit)))
        start, steady = int(self.clock[0]), shown is None
        tabled = steady and bool(self.clean[0] >= min(start, self.length))
        if not steady and self.clean[0] >= min(start, self.length) and start:
            self._leave_tables()
        done = search(*matrices, parts.into_state, parts.into_output, parts.course, parts.driven, parts.moving,
                      *signals, r, parts.first, parts.size, parts.least, limit, tabled, self.table, self.factors,
                      self.inverses, self.xi, self.b, self.gram, self.grown, self.clock, statistic, self.peak, weight)
        self.clean[0] = self.clean[0] + done if steady else 0
        recent = np.arange(max(done - self.length, 0), done)
        at = (start + recent) % self.length
        self.whitened[at] = r[recent]
        self.readings[at] = r.shape[1] if shown is None else shown
        self.statistic, self.weight = statistic[done - 1].copy(), weight[done - 1].copy()
        return done, statistic[:done], weight[:done]

    def slot(self, number: int) -> int:
        """Place of the best onset of a candidate."""
        return int(self.clock[0] - self.peak[number]) % self.length

    def estimate(self, number: int) -> tuple[Array, Array, Array]:
        """Return magnitudes (d,) of a candidate at its best onset, their covariance, and deviations (room, d)."""
        own, slot = self.columns.of(number), self.slot(number)
        if self.clean[0] >= min(int(self.clock[0]), self.length):
            self._leave_tables()
        d = own.stop - own.start
        start = int(self.columns.pairs[:number].sum())
        whole = np.zeros((d, d))
        whole[np.tril_indices(d)] = self.gram[start : start + d * (d + 1) // 2, slot]
        whole = whole + np.tril(whole, -1).T
        covariance = np.linalg.pinv(whole, rcond=1e-9, hermitian=True)
        return covariance @ self.b[own, slot], covariance, self.xi[own, :, slot].T.copy()

    def since(self, number: int) -> tuple[float, float]:
        """Return energy of the innovations and number of readings since the best onset of a candidate."""
        at = (self.clock[0] - 1 - np.arange(self.peak[number])) % self.length
        return float(np.sum(self.whitened[at] ** 2)), float(self.readings[at].sum())

    def recent(self, count: int) -> Array:
        """Return the whitened innovations of the last samples, (count, l)."""
        return self.whitened[(self.clock[0] - 1 - np.arange(count)) % self.length]

    def drop(self, row: int) -> None:
        """Take a carried direction out of the deviations."""
        self.xi[:, row:-1] = self.xi[:, row + 1 :].copy()
        self.xi[:, -1] = 0.0
