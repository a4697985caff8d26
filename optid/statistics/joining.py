"""Sums over the parts of a record that are read separately.

A part keeps the samples at its ends; when the sums of all parts are joined, the rows that reach across their borders
are added. Every row is added exactly once, so that parts may be joined in any tree and may be shorter than the lags.
Sums of different trees differ by rounding alone: a sum of n products in any order is off by at most n rounding errors
of the sum of their magnitudes (Higham, Accuracy and Stability of Numerical Algorithms, section 4.2), in practice by far
less, and a tree over parts by less than one pass.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.reading.chunks import Chunk
from optid.data.reading.parts import Part
from optid.models.layout import Layout
from optid.statistics.blocks import blocks_of, check_lengths, cut, make_block
from optid.statistics.sums import Total


@dataclass(frozen=True, eq=False)
class Run:
    """Neighbouring parts: the sums over the rows inside them, and their ends."""

    total: Total  # the sums
    # experiment, first and last samples [u | y] of every part; as many samples as the lags reach back, or all there are
    ends: tuple[tuple[int, Array, Array], ...]


def total_of_parts(stream: Any, layout: Layout, start: Callable[[], Total], chunk: int, threads: int) -> Any:
    """Return the sums over all parts of a `Stream`, each added up where it is read; ``start`` returns empty ones.

    ``chunk`` samples are evaluated at a time by so many threads. An experiment shorter than the lags is refused
    (`RankError`).
    """
    check_lengths(stream.lengths, layout)
    whole = _joined(start, [stream.reduced(partial(_run_of, layout, start, chunk), partial(_joined, start), threads)])
    last, before = -1, np.empty((0, layout.m + layout.l))
    for experiment, head, tail in whole.ends:
        before = before if experiment == last else before[:0]
        across = np.concatenate([before, head])
        if len(across) > layout.first_row:
            whole.total.add(make_block(across[:, : layout.m], across[:, layout.m :], None, layout))
        last, before = experiment, _last(np.concatenate([before, tail]), layout.first_row)
    return whole.total


def _run_of(layout: Layout, start: Callable[[], Total], chunk: int, part: Part, chunks: Iterable[Chunk]) -> Run:
    reach, total = layout.first_row, start()
    head = tail = np.empty((0, layout.m + layout.l))

    def watched() -> Iterable[Sequence[Array]]:
        nonlocal head, tail
        for u, y, _ in chunks:
            head = np.concatenate([head, np.hstack([u[:reach], y[:reach]])])[:reach]
            tail = _last(np.concatenate([tail, np.hstack([_last(u, reach), _last(y, reach)])]), reach)
            yield u, y

    for stretch in cut(watched(), f"{part.label}, ", layout, chunk):
        for block in blocks_of(stretch, layout, chunk):
            total.add(block)
    return Run(total, ((part.experiment, head, tail),))


def _joined(start: Callable[[], Total], runs: Sequence[Run]) -> Run:
    """Join runs into a new one: Dask may use those given again."""
    total = start()
    for run in runs:
        total.merge(run.total)
    return Run(total, tuple(end for run in runs for end in run.ends))


def _last(samples: Array, count: int) -> Array:
    return samples[max(len(samples) - count, 0) :]
