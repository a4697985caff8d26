"""The columns of the candidates of a monitor, as arrays, and the window of the search."""

from dataclasses import dataclass

import numpy as np

from optid.arrays import Array, compact
from optid.faults.kinds import DRIVEN, LASTING
from optid.faults.monitor.search_kernel import SearchMemory, Signatures, search
from optid.faults.signatures import Candidate
from optid.faults.whitening import Predictor
from optid.models import HammersteinSS

Matrices = tuple[Array, ...]  # transition, output, gain and root of the search

SPARE = 8  # carried directions that the search has room for, beside twice the widest candidate


@dataclass(frozen=True, eq=False)
class Columns:
    """D columns of C candidates; a stuck actuator has its constants first and the loss last."""

    candidates: tuple[Candidate, ...]  # (C,)
    losses: tuple[tuple[Array, Array], ...]  # per loss (n, r) and (l, r), from the functions of the inputs
    rest: tuple[Array, ...]  # per loss (r,) the functions at the input without effect
    into_state: Array  # (D, n) what a column adds to the state, per unit of its course
    into_output: Array  # (D, l) what it adds to the output
    course: np.ndarray  # (D,) of `search_kernel`
    driven: np.ndarray  # (D,) number of the loss, -1 for the others
    moving: np.ndarray  # (D,) whether the column belongs to a candidate with a loss
    first: np.ndarray  # (C,) first column of a candidate
    size: np.ndarray  # (C,) number of its columns
    least: np.ndarray  # (C,) fewest samples since its onset

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """The arguments of the search."""
        return (self.into_state, self.into_output, self.course, self.driven, self.moving, self.first, self.size,
                self.least)

    @property
    def pairs(self) -> np.ndarray:
        """(C,) number of products of the columns of a candidate with one another, in the order of the kernel."""
        return self.size * (self.size + 1) // 2

    def of(self, number: int) -> slice:
        """Columns of a candidate."""
        return slice(int(self.first[number]), int(self.first[number] + self.size[number]))

    def signals(self, before: Array, f: Array) -> tuple[Array, Array]:
        """Return what losses add to the state (T, M, n) and to the output (T, M, l).

        The functions (T, r) of the inputs are those one sample earlier, for the state, and those of the sample.
        """
        state, output = (np.empty((len(f), len(self.losses), part.shape[1]))
                         for part in (self.into_state, self.into_output))
        for number, ((into_state, into_output), rest) in enumerate(zip(self.losses, self.rest)):
            np.einsum("ir,tr->ti", into_state, before - rest, out=state[:, number])
            np.einsum("or,tr->to", into_output, f - rest, out=output[:, number])
        return state, output

    def units(self, before: Array, f: Array) -> tuple[Array, Array]:
        """Return what each column adds to the state (D, n) and output (D, l) at one sample, per unit of its course."""
        into_state, into_output, lost = self.into_state.copy(), self.into_output.copy(), self.driven >= 0
        for part, signal in zip((into_state, into_output), self.signals(before[None], f[None])):
            part[lost] = signal[0, self.driven[lost]]
        return into_state, into_output

    def in_order(self, number: int, sizes: Array) -> tuple[float, ...]:
        """Return magnitudes in the order of `Dictionary.signature`: the share lost first."""
        first = int(self.candidates[number].has_constants)
        found = np.roll(sizes, first)
        if self.candidates[number].fault_kind.loses:  # a share lost lies between 0 and 1
            found[0] = np.clip(found[0], 0.0, 1.0)
        return tuple(found.tolist())


def columns_of(model: HammersteinSS, candidates: tuple[Candidate, ...]) -> Columns:
    """Tabulate the candidates of a dictionary of a model."""
    into_state, into_output, course, driven, losses, rest = [], [], [], [], [], []
    for c in candidates:
        if c.additive or c.has_constants:
            into_state += list(c.into_state.T)
            into_output += list(c.into_output.T)
            course += [c.fault_kind.course if c.additive else LASTING] * c.into_state.shape[1]
            driven += [-1] * c.into_state.shape[1]
        if c.columns:
            into_state.append(np.zeros(model.nx))
            into_output.append(np.zeros(model.l))
            course.append(DRIVEN)
            driven.append(len(losses))
            lost = np.zeros((model.nx + model.l, model.B.shape[1]))
            lost[:, list(c.columns)] = c.fault_kind.effect * np.vstack([c.into_state, c.into_output])
            losses.append((lost[: model.nx], lost[model.nx :]))
            rest.append(c.rest_values(model))
    size = np.array([c.dimension for c in candidates])
    moving = np.repeat([bool(c.columns) for c in candidates], size)
    return Columns(candidates, tuple(losses), tuple(rest), np.array(into_state), np.array(into_output),
                   np.array(course), np.array(driven), moving, np.cumsum([0, *size[:-1]]), size, -(-size // model.l))


class Window:
    """The memory of the search over the last W samples; see `search_kernel.search`.

    Attributes:
        columns, length, steady: the candidates, the samples W, the predictor.
        xi, b, gram, grown, clock, peak: memory of the search.
        clean: (1,) samples searched by the steady predictor since another one was used.
        whitened: (W, l) innovations, by sample.
        readings: (W,) numbers of readings, by sample.
        statistic, weight: of the last sample (C,).
    """

    KEPT = "xi", "b", "grown", "gram", "whitened", "readings", "statistic", "peak", "weight", "clock", "clean"

    def __init__(self, columns: Columns, length: int, room: int, steady: Predictor) -> None:
        """Set up an empty window with room for so many states, carried faults included."""
        self.columns, self.length, self.steady = columns, length, steady
        D, C, l = len(columns.course), len(columns.size), len(steady.C)  # noqa: E741
        pairs = int(columns.pairs.sum())
        self.matrices = tuple(compact(part) for part in (steady.A, steady.C, steady.K, steady.root))
        self.xi, self.b, self.gram = (np.zeros((*shape, length)) for shape in ((D, room), (D,), (pairs,)))
        self.grown, self.whitened, self.readings = np.zeros(length), np.zeros((length, l)), np.zeros(length)
        self.peak, self.clock, self.clean = (np.zeros(size, dtype=np.int64) for size in (C, 1, 1))
        self.work = Signatures._make([np.zeros((*shape, length)) for shape in ((D, l), (pairs,), (D,))])
        self.table = self._tabulate()
        # every onset is followed through the steady predictor once, the oldest first; only losses differ later
        still = tuple(np.zeros((length, len(columns.losses), size)) for size in (len(steady.A), l))
        self._search(self.matrices, still, np.zeros((length, l)), np.full(C, np.inf), False)
        self.table = self._tabulate()
        self.deviations, self.products = self.xi[:, : len(steady.A)].copy(), self.gram.copy()
        self.restart()

    def _tabulate(self) -> Signatures:
        return Signatures._make([np.concatenate([part, part], axis=-1) for part in self.work])

    def restart(self) -> None:
        """Discard all onsets before the next sample."""
        self.clock[0] = self.clean[0] = 0
        self.statistic, self.weight = np.zeros(len(self.peak)), np.full(len(self.peak), -1.0)
        self.peak[:] = 0

    def _search(self, matrices: Matrices, signals: tuple[Array, ...], r: Array, limit: Array, tabled: bool
                ) -> tuple[int, Array, Array]:
        memory = SearchMemory(self.table, self.work, self.xi, self.b, self.gram, self.grown, self.clock, self.peak)
        done, statistic, weight = search(matrices, self.columns.arrays, signals, r, limit, tabled, memory)
        return done, statistic[:done], weight[:done]

    def _leave_tables(self) -> None:
        """Copy the tables to the deviations and products that are followed."""
        still, shift = ~self.columns.moving, self.length - 1 - int(self.clock[0] - 1) % self.length
        at = (shift + np.arange(self.length)) % self.length
        self.xi[still] = 0.0
        self.xi[still, : self.deviations.shape[1]] = self.deviations[still][:, :, at]
        rows = np.repeat(still[self.columns.first], self.columns.pairs)
        self.gram[rows] = self.products[rows][:, at]

    def advance(self, signals: tuple[Array, ...], r: Array, limit: Array, matrices: Matrices | None = None,
                shown: int = 0) -> tuple[int, Array, Array]:
        """Search samples until one exceeds a limit; return how many, their statistics and weights (T, C).

        Args:
            signals: of the losses.
            r: (T, l) whitened innovations.
            limit: (C,).
            matrices: transition, output, gain and root of one sample without the steady predictor.
            shown: readings of that sample.
        """
        start = int(self.clock[0])
        tabled = bool(self.clean[0] >= min(start, self.length))
        if matrices is not None and tabled and start:
            self._leave_tables()
        done, statistic, weight = self._search(matrices or self.matrices, signals, r, limit,
                                               matrices is None and tabled)
        self.clean[0] = self.clean[0] + done if matrices is None else 0
        recent = np.arange(max(done - self.length, 0), done)
        at = (start + recent) % self.length
        self.whitened[at] = r[recent]
        self.readings[at] = r.shape[1] - self.steady.silent if matrices is None else shown
        self.statistic, self.weight = statistic[-1].copy(), weight[-1].copy()
        return done, statistic, weight

    def estimate(self, number: int) -> tuple[Array, Array, Array]:
        """Return magnitudes (d,) of a candidate at its best onset, their covariance, and deviations (room, d)."""
        own, slot = self.columns.of(number), int(self.clock[0] - self.peak[number]) % self.length
        if self.clean[0] >= min(int(self.clock[0]), self.length):
            self._leave_tables()
        d, start = own.stop - own.start, int(self.columns.pairs[:number].sum())
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
        """Remove a carried direction from the deviations."""
        self.xi[:, row:-1] = self.xi[:, row + 1 :].copy()
        self.xi[:, -1] = 0.0
