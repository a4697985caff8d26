"""A first pass over a record in parts: lengths of its experiments, ranges of its inputs, parts that join in time."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optid.data.reading.chunks import Channels, Chunk
from optid.data.reading.parts import Part


@dataclass(frozen=True)
class End:
    """Where a run of parts begins or ends: the part, its experiment and the stamp (1,)."""

    label: str
    experiment: int
    stamp: np.ndarray


@dataclass(frozen=True)
class Survey:
    """What a pass over neighbouring parts found.

    Attributes:
        lengths: samples by experiment.
        lo: (m,) smallest sample of each input, NaN where every one is missing.
        hi: (m,) largest sample of each input.
        first: where the run begins; None without a clock, or without samples.
        last: where it ends.
    """

    lengths: Mapping[int, int]
    lo: np.ndarray
    hi: np.ndarray
    first: End | None = None
    last: End | None = None


def widened(lo: np.ndarray, hi: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Widen ranges (m,) by the samples u (n, m) that are not missing."""
    return (np.fmin(lo, np.fmin.reduce(u, axis=0, initial=np.nan)),
            np.fmax(hi, np.fmax.reduce(u, axis=0, initial=np.nan)))


def surveyed(part: Part, chunks: Iterable[Chunk]) -> Survey:
    """Survey one part."""
    count, first, last = 0, None, None
    lo = hi = np.asarray(np.nan)
    for u, _, stamps in chunks:
        count += len(u)
        lo, hi = widened(lo, hi, u)
        if stamps is not None and stamps.size:
            first = first or End(part.label, part.experiment, stamps[:1].copy())
            last = End(part.label, part.experiment, stamps[-1:].copy())
    return Survey({part.experiment: count}, lo, hi, first, last)


def joined(channels: Channels, surveys: Sequence[Survey]) -> Survey:
    """Join the surveys of neighbours.

    Raises:
        DataError: the clock does not run on from one part to the next of the same experiment.
    """
    lengths: Counter[int] = Counter()
    lo = hi = np.asarray(np.nan)
    first, last = None, None
    for survey in surveys:
        lengths.update(survey.lengths)
        lo, hi = np.fmin(lo, survey.lo), np.fmax(hi, survey.hi)
        if survey.first is not None:
            if last is not None and last.experiment == survey.first.experiment:
                channels.check_border(last.stamp, last.label, survey.first.stamp, survey.first.label)
            first, last = first or survey.first, survey.last
    return Survey(dict(lengths), lo, hi, first, last)
