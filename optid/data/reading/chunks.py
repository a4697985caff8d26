"""From blocks of columns to checked chunks of a record: numbers that are finite, and a clock that is uniform."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import check_finite, check_integers
from optid.data.channels import Transform
from optid.data.reading.columns import as_stamps, seconds, uniform_step
from optid.errors import DataError

Block = Mapping[str, np.ndarray]
"""Samples of some columns, (n,) each."""

Chunk = tuple[np.ndarray, np.ndarray, np.ndarray | None]
"""Inputs u (n, m), outputs y (n, l), time stamps (n,) or None."""


@dataclass(frozen=True)
class Channels:
    """Which columns of a source are its channels and its clock.

    Attributes:
        inputs: {channel: column}.
        outputs: {channel: column}.
        clock: column of time stamps, or None.
        step: sampling time that the stamps are compared with.
        tolerance: largest deviation of a time step, relative to the sampling time.
        units: in which the samples are given, raw = value * scale + offset; None for those of the source.
    """

    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    clock: str | None
    step: float
    tolerance: float
    units: Transform | None = None

    def read(self, source: Any) -> Iterator[Chunk]:
        """Start a pass over a source or a part: what has a `label` and `blocks`.

        Raises:
            DataError: an infinite sample, integers beyond the digits of float64, or a clock that is not uniform.
        """
        return self._checked(source.blocks(self.columns, self.clock), source.label)

    @property
    def columns(self) -> list[str]:
        """All columns that are read."""
        return [*self.inputs.values(), *self.outputs.values(), *([self.clock] if self.clock else [])]

    def check_border(self, last: np.ndarray, before: str, first: np.ndarray, behind: str) -> None:
        """Refuse a part whose first stamp (1,) does not follow the last one (1,) of the part before it.

        Args:
            last: last stamp of the part before.
            before: name of the part before.
            first: first stamp of the part behind.
            behind: name of the part behind.

        Raises:
            DataError: samples are lost between the parts, or they are not in the order of time.
        """
        if last.dtype.kind != first.dtype.kind:
            raise DataError(f"{before} and {behind} have time stamps of different types: {last.dtype}, {first.dtype}.")
        step = float(seconds(first - last)[0])
        if not abs(step - self.step) <= self.tolerance * self.step:
            raise DataError(
                f"{behind} begins {step:.6g} after the last sample of {before}, the sampling time is {self.step:.6g}. "
                "Parts must follow one another: sort them by time (files are taken in the order of their names), give "
                "what is behind a gap as an experiment of its own (a list of sources), or pass time=False and dt=.")

    def _checked(self, blocks: Iterable[Block], label: str) -> Iterator[Chunk]:
        done, last = 0, None
        for block in blocks:
            u, y = (_gathered(block, pairs, label, done) for pairs in (self.inputs, self.outputs))
            done += len(u)
            if self.units is not None:
                u, y = self.units.apply_u(u), self.units.apply_y(y)
            if self.clock is None:
                yield u, y, None
                continue
            stamps = as_stamps(block[self.clock], f"{label}, column {self.clock!r}")
            since = stamps if last is None else np.concatenate([last, stamps])
            uniform_step(since, self.tolerance, label, self.step, done - since.size)
            last = stamps[-1:] if stamps.size else last
            yield u, y, stamps


def _gathered(block: Block, pairs: Mapping[str, str], label: str, done: int) -> np.ndarray:
    columns = [block[column] for column in pairs.values()]
    samples = np.empty((columns[0].shape[0], len(columns)))
    labels = [f"{label}, column {column!r}" for column in pairs.values()]
    for c, column in enumerate(columns):
        if column.dtype.kind in "iu" and column.dtype.itemsize == 8:
            check_integers(column[:, None], labels[c : c + 1], done, limits=False)
        samples[:, c] = column
    check_finite(samples, labels, done)
    return samples
