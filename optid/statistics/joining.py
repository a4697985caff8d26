"""Sums over the parts of a record that are read separately.

A part keeps the samples at its ends, and joining two adds the rows that reach across their border. Joining is
associative and every row is added exactly once, so that parts may be joined in any tree and may be shorter than the
lags. Sums of different trees differ by rounding alone: a sum of n products in any order is off by at most n
rounding errors of the sum of their magnitudes (Higham, Accuracy and Stability of Numerical Algorithms, section 4.2),
in practice by far less, and a tree over parts by less than one pass.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
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
    """Neighbouring parts: their sums, and the samples at their ends that joining them takes.

    Attributes:
        total: sums over the rows inside.
        first: experiment in which the run begins.
        last: experiment in which it ends.
        head: the first samples [u | y] of its first experiment, as many as the lags reach back, or all there are.
        tail: the last samples [u | y] of its last experiment likewise.
    """

    total: Total
    first: int
    last: int
    head: Array
    tail: Array


def total_of_parts(stream: Any, layout: Layout, start: Callable[[], Total], chunk: int, threads: int
                   ) -> Any:
    """Return the sums over all parts of a stream, each added up where it is read.

    Args:
        stream: a `Stream` in parts.
        layout: the columns.
        start: returns empty sums.
        chunk: samples evaluated at a time.
        threads: threads that read parts on this machine.

    Raises:
        RankError: an experiment shorter than the lags.
    """
    check_lengths(stream.lengths, layout)
    return stream.reduced(partial(_run_of, layout, start, chunk), partial(_joined, layout, start), threads).total


def _run_of(layout: Layout, start: Callable[[], Total], chunk: int, part: Part, chunks: Iterable[Chunk]) -> Run:
    reach = layout.first_row
    head = tail = np.empty((0, layout.m + layout.l))

    def watched() -> Iterable[Sequence[Array]]:
        nonlocal head, tail
        for u, y, _ in chunks:
            head = _first(head, np.hstack([u[:reach], y[:reach]]), reach)
            tail = _last(tail, np.hstack([_end(u, reach), _end(y, reach)]), reach)
            yield u, y

    total = start()
    for stretch in cut(watched(), f"{part.label}, ", layout, chunk):
        for block in blocks_of(stretch, layout, chunk):
            total.add(block)
    return Run(total, part.experiment, part.experiment, head, tail)


def _joined(layout: Layout, start: Callable[[], Total], runs: Sequence[Run]) -> Run:
    total, reach = start(), layout.first_row
    total.merge(runs[0].total)
    whole = replace(runs[0], total=total)
    for run in runs[1:]:
        total.merge(run.total)
        head, tail = whole.head, run.tail
        if run.first == whole.last:
            rows = np.concatenate([whole.tail, run.head])
            if len(rows) > reach:
                total.add(make_block(rows[:, : layout.m], rows[:, layout.m :], None, layout))
            if whole.first == whole.last:
                head = _first(head, run.head, reach)
            if run.first == run.last:
                tail = _last(whole.tail, tail, reach)
        whole = Run(total, whole.first, run.last, head, tail)
    return whole


def _first(before: Array, behind: Array, count: int) -> Array:
    return np.concatenate([before, behind])[:count]


def _last(before: Array, behind: Array, count: int) -> Array:
    return _end(np.concatenate([before, behind]), count)


def _end(samples: Array, count: int) -> Array:
    return samples[max(len(samples) - count, 0) :]
