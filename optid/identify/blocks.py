"""Blocked cross-validation: contiguous blocks of a record, each left out of the fit once and simulated by it.

Neighbouring samples are not independent, so that leaving out single samples would test nothing. The parts on both sides
of a block become experiments of their own; the model fitted to them is simulated over the block. Where inputs repeat
their moves, in experiments or periods, a block is the same piece of all of them.
"""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from optid.arrays import Array, as_list, check_integer
from optid.data.record import Data
from optid.data.repeats import RepeatedPart, copies
from optid.data.stretches import between_gaps
from optid.errors import DataError, OptidError, RankError

SHORTEST = 10  # samples of a part of an experiment: the output of shorter ones is mostly that of the initial state
PHASE, MOVES = 50, 4  # samples and moves of inputs in a block of what is repeated; shorter repetitions are kept whole
SEVERAL = 100  # experiments, each compared with all others, beyond which they are folds as they are
NEAR = 0.15  # an experiment that ends this near to the border of two blocks, as a share of their length, moves it
LEAD, LEAST = 0.33, 30  # share of a block that the initial state of unstable models is fitted to; samples at least
PIECES = 20  # stretches of a record at most: every one costs time of its own
LEAST_LEFT = 0.1  # share of the samples of a part that a fitted state leaves, for this correction
RUNAWAY = 10.0  # a simulation diverges where its error exceeds so many times the range of the outputs
WIDER = 2
"""Length of the simulation around a block, as a multiple of that of the block, where the experiment is so long.

An initial state fitted to the block alone absorbs slow disturbances, as it cannot on a longer validation record; one
fitted to the beginning of the block is too inaccurate for plants that integrate.
"""


@dataclass(frozen=True, eq=False)
class Blocks:
    """A record divided into blocks, each made of parts of experiments."""

    data: Data
    parts: tuple[tuple[RepeatedPart, ...], ...]

    @classmethod
    def of(cls, data: Data, count: int = 4) -> "Blocks":
        """Divide a record into blocks of nearly equal length; a `RankError` where it is too short."""
        check_integer(count, "blocks", 2)
        repeated = _repeated(data, count)
        lengths = [group[0].last - group[0].first for group in repeated]
        ends = np.cumsum(lengths)
        total = int(ends[-1])
        if total < count * SHORTEST:
            raise RankError(f"{total} samples are too few for cross-validation in {count} blocks of at least "
                            f"{SHORTEST}: record more, or name the orders and use `optid.fit`")
        cuts = [0]
        for cut in (round(k * total / count) for k in range(1, count)):
            border = int(ends[np.argmin(np.abs(ends - cut))])
            cuts.append(border if abs(border - cut) <= NEAR * total / count else cut)
        parts = []
        for low, high in zip(cuts, [*cuts[1:], total]):
            inside = [RepeatedPart(one.experiment, one.first + max(low - s, 0),
                                   min(one.first + min(high, e) - s, one.last))
                      for group, s, e in zip(repeated, ends - lengths, ends) if s < high and e > low
                      for one in group if one.first + max(low - s, 0) < one.last]
            parts.append(tuple(p for p in inside if p.last - p.first >= SHORTEST) or tuple(inside))
        return cls(data, tuple(parts))

    def __len__(self) -> int:
        return len(self.parts)

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """The blocks in which an input moves: the others tell little about a model."""
        def moves(part: RepeatedPart) -> bool:
            u = self.data.experiments[part.experiment].u[part.first : part.last]
            return bool(np.any(np.nanmax(u, axis=0) > np.nanmin(u, axis=0)))

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of an input that is missing throughout
            return tuple(b for b, parts in enumerate(self.parts) if any(map(moves, parts)))

    def without(self, block: int) -> Data:
        """Return the record without a block; the parts on its two sides are experiments of their own."""
        kept = []
        for i, e in enumerate(self.data.experiments):
            cut = [x for part in self.parts[block] if part.experiment == i for x in part[1:]]
            borders = [0, *cut, e.n_samples]
            kept += [RepeatedPart(i, int(a), int(b)) for a, b in zip(borders[::2], borders[1::2]) if b - a >= SHORTEST]
        return join_parts(self.data, kept)

    @cached_property
    def outputs(self) -> tuple[Array, Array]:
        """Mean squared deviation of the outputs from their means (l,), and their range (l,)."""
        y = np.vstack([e.y for e in self.data.raw().experiments])
        return np.nanvar(y, axis=0), np.nanmax(y, axis=0) - np.nanmin(y, axis=0)

    def errors(self, model: Any, block: int, horizon: int | None = None) -> tuple[Array, Array]:
        """Return the energy of the errors of a model on a block, and what it is measured by, by output: (l,), (l,).

        The measure is the variance of the output in the whole record times the number of compared samples. The energy
        is infinite where the simulation diverges; that of an unstable model is also judged from a state fitted to a
        third of the block. The horizon counts samples; None simulates, with the initial state fitted to the block and
        its surroundings, see `WIDER`.
        """
        variance, span = self.outputs
        if horizon is None and not model.is_stable and self._diverges(model, block):
            return np.full(self.data.l, np.inf), np.zeros(self.data.l)
        energy, count = np.zeros(self.data.l), np.zeros(self.data.l)
        for part in self.parts[block]:
            try:
                around = self._around(part)
            except DataError:  # it has no sample to compare
                continue
            try:  # divergence is an infinite energy
                runs = as_list(model.simulate(around, x0="fit") if horizon is None else model.predict(around, horizon))
            except OptidError:
                return np.full(self.data.l, np.inf), np.zeros(self.data.l)
            for e, run in zip(around.experiments, runs):
                begin = self._sample(part.experiment, e.start)
                rows = slice(max(part.first - begin, 0), max(part.last - begin, 0))
                y, run = e.y[rows], run[rows]
                here = np.isfinite(y) & (np.isfinite(run) if horizon is not None else True)
                error = np.where(here, run - y, 0.0)
                with np.errstate(over="ignore", invalid="ignore"):
                    wild = ~np.all(np.abs(error) <= RUNAWAY * span, axis=0)
                    # a state fitted to the first samples takes as many errors away as it has numbers
                    taken = model.n_states if horizon is None and begin == part.first else 0
                    left = max(1 - taken / max(here.sum(), 1), LEAST_LEFT)
                    energy += np.where(wild, np.inf, np.sum(error**2, axis=0)) / left
                count += here.sum(axis=0)
        if not count.all():
            raise DataError(f"block {block + 1} has no sample of an output that can be compared: use fewer blocks")
        return energy, variance * count

    def _sample(self, experiment: int, time: float) -> int:
        """Return the number of the sample of an experiment at a time."""
        whole = self.data.experiments[experiment]
        if whole.stamps is None:
            return round((time - whole.start) / self.data.dt)
        return int(np.argmin(np.abs(whole.stamps - (time - whole.start))))

    def _around(self, part: RepeatedPart) -> Data:
        """Return a part and its surroundings, split where an input is missing: a simulation needs all inputs."""
        samples = self.data.experiments[part.experiment].n_samples
        length = min(WIDER * (part.last - part.first), samples)
        first = min(max((part.first + part.last - length) // 2, 0), samples - length)
        return between_gaps(join_parts(self.data, [RepeatedPart(part.experiment, first, first + length)]), 2).raw()

    def _diverges(self, model: Any, block: int) -> bool:
        """Whether a model with a state fitted to the first third of a block diverges in the rest of it.

        A state fitted to the whole simulation hides an unstable mode.
        """
        try:
            part = between_gaps(join_parts(self.data, self.parts[block]), 2).raw()
            states = [_leading_state(model, part, i) for i in range(part.n_experiments)]
            runs = as_list(model.simulate(part, x0=states if len(states) > 1 else states[0]))
        except OptidError:
            return True
        return any(np.any(np.abs(run - e.y) > RUNAWAY * self.outputs[1]) for run, e in zip(runs, part.experiments))

    def excursion(self, model: Any) -> float:
        """Return how far a free run leaves the range of an output when the inputs come in other orders, in ranges.

        After every experiment, from a state fitted to its first third, come its inputs backwards, and then from the
        middle on: what a function of a latent signal does beside the samples it was fitted to shows in no block, and
        a plant meets it with the next record.
        """
        whole = between_gaps(self.data.raw(), 2).raw()
        y = np.vstack([e.y for e in whole.experiments])
        low, high = np.nanmin(y, axis=0), np.nanmax(y, axis=0)
        largest = 0.0
        for i, e in enumerate(whole.experiments):
            n = e.n_samples
            try:
                state = _leading_state(model, whole, i)
                run = model.simulate(np.concatenate([e.u, e.u[::-1], np.roll(e.u, n // 2, axis=0)]), x0=state)[n:]
            except OptidError:
                return np.inf
            with np.errstate(over="ignore", invalid="ignore"):
                beyond = np.maximum(low - run, run - high) / np.maximum(high - low, 1e-300)
            largest = max(largest, float(np.max(np.where(np.isfinite(beyond), beyond, np.inf))))
        return largest

    def fit(self, model: Any, horizon: int | None = None) -> float:
        """Return the fit in % of one model over all blocks; minus infinity where it diverges in one."""
        return pooled_fit(*map(np.array, zip(*(self.errors(model, b, horizon) for b in range(len(self))))))


def _leading_state(model: Any, data: Data, experiment: int) -> Array:
    """Return the state at the first sample of an experiment, fitted to its beginning."""
    n = data.experiments[experiment].n_samples
    return model.initial_state(data.select(experiments=experiment).window(0, min(max(round(LEAD * n), LEAST), n)))


def _repeated(data: Data, count: int) -> list[list[RepeatedPart]]:
    """Return the experiments, one list each, or where long sequences of moves come again all copies of each."""
    u = [e.u for e in data.experiments]
    whole = [[RepeatedPart(i, 0, len(one))] for i, one in enumerate(u)]
    if len(u) > SEVERAL:
        return whole
    groups = copies(u)
    for group in groups:
        i, first, last = group[0]
        moving = np.any(np.diff(u[i][first:last], axis=0) != 0, axis=1)
        if len(group) > 1 and (last - first < count * PHASE or np.sum(moving) < count * MOVES):
            return whole
    return groups if len(groups) < sum(map(len, groups)) else whole


def stretches(data: Data, most: int, count: int = 5) -> Data:
    """Return a long record cut to so many samples in all, in stretches spread over its whole length, else the same.

    Of more than `PIECES` experiments so many are taken.
    """
    total = data.n_samples
    if total <= most and data.n_experiments <= PIECES:
        return data
    lengths = [e.n_samples for e in data.experiments]
    ends, kept = np.cumsum(lengths), list[RepeatedPart]()
    count = min(max(count, round(most / float(np.median(lengths)))), PIECES)  # of short experiments there are more
    for middle in (np.arange(count) + 0.5) * total / count:
        i = int(np.searchsorted(ends, middle, side="right"))
        n = lengths[i]
        length = min(most // count, n)
        first = int(np.clip(middle - (ends[i] - n) - length / 2, 0, n - length))
        part = RepeatedPart(i, first, first + length)
        if part not in kept:
            kept.append(part)
    return join_parts(data, kept)


def join_parts(data: Data, parts: Iterable[RepeatedPart]) -> Data:
    """Return parts of a record as experiments."""
    return Data.join(*(data.select(experiments=p.experiment).window(p.first, p.last) for p in parts))


def pooled_fit(energy: Array, measure: Array) -> float:
    """Return 100 (1 - |e| / |y - mean y|) in %, over some blocks (b, l), as a mean over the outputs."""
    if not np.isfinite(energy).all():
        return -np.inf
    return float(100 * np.mean(1 - np.sqrt(energy.sum(axis=0) / np.maximum(measure.sum(axis=0), 1e-300))))
