"""Blocked cross-validation: contiguous blocks of a record, each left out of the fit once and simulated by it.

Neighbouring samples are not independent, so that single samples left out would test nothing. What is left on both
sides of a block are experiments of their own, and so is the block: its initial state is fitted to it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer
from optid.data.record import Data, as_list
from optid.data.stretches import between_gaps
from optid.errors import DataError, OptidError, RankError

SHORTEST = 10
"""Samples of a part of an experiment at least: shorter ones say more of their initial state than of the plant."""

LEAD = 0.33
"""Share of a block to which its initial state is fitted."""

LEAST = 30
"""Samples of that part at least."""

NEAR = 0.15
"""A border of experiments this near to the border of two blocks, as a share of their length, takes its place."""

RUNAWAY = 10.0
"""A run diverges where it leaves so many times the range of the outputs."""


@dataclass(frozen=True)
class Part:
    """Samples first to last - 1 of one experiment."""

    experiment: int
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Blocks:
    """A record cut into blocks.

    Attributes:
        data: the record.
        parts: the parts of experiments that make each block.
    """

    data: Data
    parts: tuple[tuple[Part, ...], ...]

    @classmethod
    def of(cls, data: Data, count: int = 4) -> "Blocks":
        """Cut a record into blocks of nearly equal length.

        Raises:
            RankError: a record too short for so many blocks.
        """
        check_integer(count, "blocks", 2)
        lengths = [e.n_samples for e in data.experiments]
        ends = np.cumsum(lengths)
        total = int(ends[-1])
        if total < count * SHORTEST:
            raise RankError(f"{total} samples are too few for cross-validation in {count} blocks of at least "
                            f"{SHORTEST}: record more, or name the orders and use `optid.fit`")
        cuts = [0, *(_snapped(round(k * total / count), ends, NEAR * total / count) for k in range(1, count)), total]
        starts = ends - lengths
        parts = []
        for low, high in zip(cuts, cuts[1:]):
            inside = [Part(i, max(low - s, 0), min(high, e) - s) for i, (s, e) in enumerate(zip(starts, ends))
                      if s < high and e > low]
            parts.append(tuple(p for p in inside if p.last - p.first >= SHORTEST) or tuple(inside))
        return cls(data, tuple(parts))

    def __len__(self) -> int:
        return len(self.parts)

    def without(self, block: int) -> Data:
        """Return the record without a block; what is left on its two sides are experiments of their own."""
        cut: dict[int, list[Part]] = {}
        for part in self.parts[block]:
            cut.setdefault(part.experiment, []).append(part)
        kept = []
        for i, e in enumerate(self.data.experiments):
            borders = [0, *(x for part in cut.get(i, []) for x in (part.first, part.last)), e.n_samples]
            kept += [Part(i, int(a), int(b)) for a, b in zip(borders[::2], borders[1::2]) if b - a >= SHORTEST]
        return self._joined(kept)

    def block(self, block: int) -> Data:
        """Return a block, cut where an input is missing: a simulation needs every one of them."""
        return between_gaps(self._joined(self.parts[block]), 2)

    def _joined(self, parts: Any) -> Data:
        return Data.join(*(self.data.select(experiments=p.experiment).window(p.first, p.last) for p in parts))

    @cached_property
    def outputs(self) -> tuple[Array, Array]:
        """Mean squared deviation of the outputs from their means (l,), and their range (l,)."""
        y = np.vstack([e.y for e in self.data.raw().experiments])
        return np.nanvar(y, axis=0), np.nanmax(y, axis=0) - np.nanmin(y, axis=0)

    @staticmethod
    def _free_run(model: Any, part: Data) -> list[Array]:
        """Simulate a block from states fitted to its beginning: more would let slow modes follow what they cannot."""
        states = [model.initial_state(start) for start in _led(part)]
        return as_list(model.simulate(part, x0=states if len(states) > 1 else states[0]))

    def errors(self, model: Any, block: int, horizon: int | None = None) -> tuple[Array, Array]:
        """Return the energy of the errors of a model on a block, and what it is measured by, by output: (l,), (l,).

        The measure is the variance of the output in the whole record times the samples that were compared; the energy
        is infinite where the model runs away.

        Args:
            model: the model.
            block: number of the block.
            horizon: samples ahead of the prediction; None for the free run.
        """
        part, (variance, span) = self.block(block).raw(), self.outputs
        try:  # what runs away is told by its energy
            found = self._free_run(model, part) if horizon is None else as_list(model.predict(part, horizon))
        except OptidError:
            return np.full(self.data.l, np.inf), np.zeros(self.data.l)
        y, run = np.vstack([e.y for e in part.experiments]), np.vstack(found)
        here = np.isfinite(y) & (np.isfinite(run) if horizon is not None else True)
        error = np.where(here, run - y, 0.0)
        with np.errstate(over="ignore", invalid="ignore"):
            energy = np.sum(error**2, axis=0)
        wild = ~np.isfinite(energy) | (np.max(np.abs(error), axis=0) > RUNAWAY * span)
        if not here.any(axis=0).all():
            raise DataError(f"block {block + 1} has no sample of an output that can be compared: use fewer blocks")
        return np.where(wild, np.inf, energy), variance * here.sum(axis=0)


def _led(part: Data) -> list[Data]:
    """Return the beginning of every experiment, to which its initial state is fitted."""
    return [part.select(experiments=i).window(0, min(max(round(LEAD * e.n_samples), LEAST), e.n_samples))
            for i, e in enumerate(part.experiments)]


def pooled_fit(energy: Array, measure: Array) -> float:
    """Return 100 (1 - |e| / |y - mean y|) in %, over some blocks (b, l), as a mean over the outputs."""
    if not np.isfinite(energy).all():
        return -np.inf
    return float(100 * np.mean(1 - np.sqrt(energy.sum(axis=0) / np.maximum(measure.sum(axis=0), 1e-300))))


def _snapped(cut: int, ends: Array, near: float) -> int:
    nearest = int(ends[np.argmin(np.abs(ends - cut))])
    return nearest if abs(nearest - cut) <= near else cut
