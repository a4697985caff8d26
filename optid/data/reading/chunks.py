"""Chunks of a record from blocks of columns, with finite samples and a uniform clock."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import check_finite, check_integers
from optid.data.channels import Transform
from optid.data.reading.clock import TimeColumn, over_midnight, seconds
from optid.data.reading.columns import cell_error, to_numbers, without_marks
from optid.data.reading.format import Format
from optid.data.reading.uniform import uniform_step
from optid.errors import DataError

Block = Mapping[str, np.ndarray]
"""Samples of some columns, (n,) each."""

Chunk = tuple[np.ndarray, np.ndarray, np.ndarray | None]
"""Inputs u (n, m), outputs y (n, l), time stamps (n,) or None."""


class End(NamedTuple):
    """The first or last stamp (1,) of successive parts, with its part and experiment."""

    label: str
    experiment: int
    stamp: np.ndarray


@dataclass(frozen=True)
class Channels:
    """Which columns of a source are its channels and its clock."""

    inputs: Mapping[str, str]  # {channel: column}
    outputs: Mapping[str, str]  # {channel: column}
    clock: TimeColumn | None  # how the time stamps are read, or None
    step: float  # sampling time that the stamps are compared with
    how: Format = Format()  # how the source is written
    # in which the samples are given, raw = value * scale + offset; None for those of the source
    units: Transform | None = None

    def read(self, part: Any) -> Iterator[Chunk]:
        """Start a pass over a part.

        `DataError` for an infinite sample, integers beyond the digits of float64, or a non-uniform clock.
        """
        done, last = 0, None
        texts = dict.fromkeys(self.clock.columns if self.clock else (), "clock")
        columns = [*self.inputs.values(), *self.outputs.values(), *texts]
        for block in part.blocks(columns, texts):
            u, y = (_gathered(block, pairs, part.label, done, self.how) for pairs in (self.inputs, self.outputs))
            done += len(u)
            if self.units is not None:
                u, y = self.units.apply_u(u), self.units.apply_y(y)
            if self.clock is None:
                yield u, y, None
                continue
            stamps = self.clock.stamps(block, part.label)
            if self.clock.kind == "times of day":
                stamps = over_midnight(stamps)
            if last is not None and self.clock.kind == "times of day":
                day = np.timedelta64(86400 * 10**9, "ns")
                stamps = stamps + day * np.round(seconds(last - stamps[:1])[0] / 86400 + 0.49)
            since = stamps if last is None else np.concatenate([last, stamps])
            uniform_step(since, self.how.time_tolerance, part.label, self.step, done - since.size)
            last = stamps[-1:] if stamps.size else last
            yield u, y, stamps

    def check_border(self, last: End | None, first: End | None) -> None:
        """Raise a `DataError` if a part does not follow the previous one of the same experiment in time."""
        if last is None or first is None or last.experiment != first.experiment:
            return
        if last.stamp.dtype.kind != first.stamp.dtype.kind:
            raise DataError(f"{last.label} and {first.label} have time stamps of different types: {last.stamp.dtype}, "
                            f"{first.stamp.dtype}.")
        step = float(seconds(first.stamp - last.stamp)[0])
        if not abs(step - self.step) <= self.how.time_tolerance * self.step:
            raise DataError(
                f"{first.label} begins {step:.6g} after the last sample of {last.label}, the sampling time is "
                f"{self.step:.6g}. Parts must follow one another: sort them by time (files are taken in the order of "
                "their names), pass the part after a gap as a separate experiment (a list of sources), or "
                "pass time=False and dt=.")


def _gathered(block: Block, pairs: Mapping[str, str], label: str, done: int, how: Format) -> np.ndarray:
    columns = [block[column] for column in pairs.values()]
    samples = np.empty((columns[0].shape[0], len(columns)))
    labels = [f"{label}, column {column!r}" for column in pairs.values()]
    for c, column in enumerate(columns):
        if column.dtype.kind == "O":
            column, row = to_numbers(column.tolist(), how)
            if row is not None:
                raise cell_error(f"{labels[c]}, row {done + row + 1}", block[list(pairs.values())[c]][row], how)
        if column.dtype.kind in "iu" and column.dtype.itemsize == 8:
            check_integers(column[:, None], labels[c : c + 1], done, limits=False)
        samples[:, c] = without_marks(column, how)
    check_finite(samples, labels, done)
    return samples


@dataclass(frozen=True)
class Survey:
    """Lengths, ranges and ends of neighbouring parts."""

    lengths: Mapping[int, int]  # samples by experiment
    lo: np.ndarray  # (m,) smallest sample of each input, NaN where every one is missing; without samples one NaN
    hi: np.ndarray  # (m,) largest sample of each input
    first: End | None = None  # where the run begins; None without a clock, or without samples
    last: End | None = None  # where it ends


def survey_part(part: Any, chunks: Iterable[Chunk]) -> Survey:
    """Survey one part."""
    count, first, last = 0, None, None
    lo = hi = np.asarray(np.nan)
    for u, _, stamps in chunks:
        count += len(u)
        lo = np.fmin(lo, np.fmin.reduce(u, axis=0, initial=np.nan))
        hi = np.fmax(hi, np.fmax.reduce(u, axis=0, initial=np.nan))
        if stamps is not None and stamps.size:
            first = first or End(part.label, part.experiment, stamps[:1].copy())
            last = End(part.label, part.experiment, stamps[-1:].copy())
    return Survey({part.experiment: count}, lo, hi, first, last)


def join_surveys(channels: Channels, surveys: Sequence[Survey]) -> Survey:
    """Join the surveys of neighbours; `DataError` if the clock does not continue from one to the next."""
    lengths: Counter[int] = Counter()
    lo = hi = np.asarray(np.nan)
    first, last = None, None
    for survey in surveys:
        lengths.update(survey.lengths)
        lo, hi = np.fmin(lo, survey.lo), np.fmax(hi, survey.hi)
        channels.check_border(last, survey.first)
        first, last = first or survey.first, survey.last or last
    return Survey(dict(lengths), lo, hi, first, last)
