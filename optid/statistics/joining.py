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

Ends = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class Run:
    """Neighbouring parts: their sums, and the samples at their ends that joining them takes.

    Attributes:
        total: sums over the rows inside.
        first: experiment in which the run begins.
        last: experiment in which it ends.
        head: u and y of the first samples of its first experiment, as many as the lags reach back, or all there are.
        tail: u and y of the last samples of its last experiment likewise.
    """

    total: Total
    first: int
    last: int
    head: Ends
    tail: Ends


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
    nothing = np.empty((0, layout.m)), np.empty((0, layout.l))
    head, tail = nothing, nothing

    def watched() -> Iterable[Sequence[Array]]:
        nonlocal head, tail
        for u, y, _ in chunks:
            head, tail = _first(head, (u, y), reach), _last(tail, (u, y), reach)
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
            u, y = (np.concatenate(pair) for pair in zip(whole.tail, run.head))
            if len(u) > reach:
                total.add(make_block(u, y, None, layout))
            if whole.first == whole.last:
                head = _first(head, run.head, reach)
            if run.first == run.last:
                tail = _last(whole.tail, tail, reach)
        whole = Run(total, whole.first, run.last, head, tail)
    return whole


def _first(before: Ends, behind: Ends, count: int) -> Ends:
    u, y = (np.concatenate([a, b[:count]])[:count] for a, b in zip(before, behind))
    return u, y


def _last(before: Ends, behind: Ends, count: int) -> Ends:
    # copies: a view would keep the whole chunk in memory
    joints = (np.concatenate([a, b[max(len(b) - count, 0) :]]) for a, b in zip(before, behind))
    u, y = (joint[max(len(joint) - count, 0) :] for joint in joints)
    return u, y
