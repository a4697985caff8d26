"""Sums of outer products of rows of lagged signals, from samples in time order and without forming the rows.

A row holds the samples of every signal at its lags, so a block of the sum over *all* rows depends on the difference of
two lags only: one product of the signals per difference replaces one per pair of lags. Samples that are missing or lie
beyond the ends are set to zero, and the rows that touch one are subtracted afterwards; where these are many, the valid
rows are added directly.

A part of a record that is read separately keeps the samples at its ends; when the sums of all parts are joined, the
rows that reach across their borders are added. Every row is added exactly once, so that parts may be joined in any tree
and may be shorter than the lags. Sums of different trees differ by rounding alone: a sum of n products in any order is
off by at most n rounding errors of the sum of their magnitudes (Higham, Accuracy and Stability of Numerical Algorithms,
section 4.2), in practice by far less, and a tree over parts by less than one pass.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.models.layout import Layout
from optid.statistics.blocks import Block, BlockSignals, Frame, blocks_of, check_lengths, cut, make_block
from optid.statistics.factors import add_to_root

if TYPE_CHECKING:
    from optid.data.reading.chunks import Chunk
    from optid.data.reading.parts import Part

FORMED = 2048  # rows that are formed at once where a dense product is the cheapest way
WIDE = 128  # signals times samples of the blocks of dense signals whose products are taken at once
SMALL = 3e7  # products in a sum of dense rows up to which loading compiled loops (half a second) does not pay
TINY = 5e6  # products in a sum of dense rows up to which nothing is faster
SAFE = 1e3  # energy subtracted from a column over energy left: beyond it more than three digits would be lost


def windows_of(signals: Array, rows: int) -> Array:
    """View the windows of signals (T, d) as (T - rows + 1, rows, d), nothing copied."""
    return np.lib.stride_tricks.sliding_window_view(signals, rows, axis=0).transpose(0, 2, 1)


def lagged_products(g: BlockSignals, h: BlockSignals, lags: range, reach: int) -> Array:
    """Sum g(t) h(t - d)^T over the inner samples t for every d in lags: (g.size, lags, h.size)."""
    start, stop = reach, len(g.weights) - reach
    if h.local and not g.local:
        return lagged_products(h, g, range(-lags[-1], 1 - lags[0]), reach)[:, ::-1].transpose(2, 1, 0)
    if not g.local:
        return _dense_products(g.weights[start:stop], h.weights[start - lags[-1] : stop - lags[0]], len(lags))[:, ::-1]
    from optid.statistics import kernels

    sums = np.zeros((g.size, len(lags), h.size))
    if not h.local:  # the values of h at all these lags are neighbours in memory, the oldest first
        windows = h.weights.reshape(-1)[(start - lags[-1]) * h.size :]
        inner = kernels.LocalFamily(g.first[start:stop], g.weights[start:stop])
        kernels.local_by_dense(inner, windows, h.size, sums.reshape(g.size, -1))
        return sums[:, ::-1]
    families = (kernels.LocalFamily(one.first, one.weights) for one in (g, h))
    kernels.local_by_local(*families, start, stop, lags[0], sums)
    return sums


def _dense_products(g: Array, h: Array, count: int) -> Array:
    """Sum g(t) h(t + i)^T over the samples of g (T, p) for i < count: (p, count, q)."""
    (samples, p), q = g.shape, h.shape[1]
    step = min(count, max(1, WIDE // max(p, q)))  # samples of a block: large products are fast, their diagonals add up
    following = -(-(count - 1) // step)  # blocks that the largest lag reaches
    blocks = max((samples + count - 1) // step - following, 0)
    left = g[: blocks * step].reshape(blocks, step * p).T
    views = [h[i * step : (i + blocks) * step].reshape(blocks, step * q) for i in range(following + 1)]
    products = np.concatenate([(left @ view).reshape(step, p, step, q) for view in views], axis=2)
    sums = sum((products[i, :, i : i + count] for i in range(step)), np.zeros((p, count, q)))
    if blocks * step == samples:
        return sums
    rest = windows_of(h[blocks * step : samples + count - 1], count)
    return sums + (g[blocks * step :].T @ rest.reshape(len(rest), -1)).reshape(p, count, q)


class Total:
    """Running sums over blocks of one frame: rows used, and those that would have been, had no sample been missing."""

    rows = candidates = 0

    def add(self, block: Block) -> None:
        """Add the valid rows of a block."""
        self.rows += int(np.count_nonzero(block.valid))
        self.candidates += block.candidates

    def add_all(self, blocks: Iterable[Block]) -> Self:
        """Add the valid rows of some blocks, and return the sums."""
        for block in blocks:
            self.add(block)
        return self

    def merge(self, other: Self) -> None:
        """Add the sums of other blocks, of the same frame."""
        self.rows += other.rows
        self.candidates += other.candidates


class Factor(Total):
    """Running triangular factor ``root`` (n, n) of the rows, by tall and skinny QR decomposition."""

    def __init__(self, n: int, contrast: Callable[[Array], Array] | None = None) -> None:
        """Start from no rows of length n; `contrast` makes them from complete ones."""
        self.root, self._contrast = np.zeros((n, n)), contrast

    def add(self, block: Block) -> None:
        """Add the valid rows of a block."""
        super().add(block)
        used = np.flatnonzero(block.valid)
        size = max(FORMED, 2 * len(self.root))
        for start in range(0, used.size, size):
            part = used[start : start + size]
            formed = block.dense_rows(part)
            if self._contrast is not None:
                formed = self._contrast(formed)
            if block.weights is not None:
                formed *= np.sqrt(block.weights[part])[:, None]
            self.root = add_to_root(self.root, formed)

    def merge(self, other: Self) -> None:
        """Add the rows of another factor."""
        super().merge(other)
        self.root = add_to_root(self.root, other.root)


class Sums(Total):
    """The Gram matrix of the rows."""

    def __init__(self, frame: Frame) -> None:
        """Start from no rows."""
        self.frame = frame
        self._gram = np.zeros((frame.n, frame.n))  # upper triangle
        self._products: dict[tuple[int, int], Array] = {}
        self._totals = [np.zeros(columns.shape[1]) for columns in frame.columns]
        self._stretched = 0  # rows, with those around the ends, that were added by lag difference

    def add(self, block: Block) -> None:
        """Add the valid rows of a block."""
        super().add(block)
        others = np.flatnonzero(~block.valid)
        if not self._direct_is_cheaper(block, block.valid.size - others.size):
            removed = self._of_rows(block, others)
            if self._add_by_difference(block, np.diag(removed)):
                self._gram -= removed
                return
        self._gram += self._of_rows(block, np.flatnonzero(block.valid))

    def merge(self, other: Self) -> None:
        """Add the sums of other blocks."""
        super().merge(other)
        self._gram += other._gram
        for pair, products in other._products.items():
            self._products[pair] = self._products.get(pair, 0.0) + products
        for total, part in zip(self._totals, other._totals):
            total += part
        self._stretched += other._stretched

    def complete(self) -> Array:
        """Return the Gram matrix (n, n), symmetric."""
        gram, at, constant = self._gram.copy(), self.frame.columns, self.frame.constant
        for (g, h), sums in self._products.items():
            lags_g, lags_h = self.frame.lags[g], self.frame.lags[h]
            if g == h:  # the product at -d is the transpose of that at d
                sums = np.concatenate([sums[:, :0:-1].transpose(2, 1, 0), sums], axis=1)
            own, others = at[g].ravel(), at[h].ravel()
            latest = np.lib.stride_tricks.sliding_window_view(sums, len(lags_h), axis=1)[:, len(lags_g) - 1 :: -1]
            part = latest.transpose(1, 0, 3, 2).reshape(own.size, others.size)
            gram[np.ix_(own, others)] += part
            if g != h:  # outputs at lag 0 stand behind the inputs
                gram[np.ix_(others, own)] += part.T
        for columns, total in zip(at, self._totals):
            gram[columns, constant] += total
            gram[constant, columns] += total
        gram[constant, constant] += self._stretched
        upper = np.triu(gram)
        whole = upper + upper.T
        whole.flat[:: len(whole) + 1] /= 2
        return whole

    def _is_small(self, rows: int, products: float) -> bool:
        return rows * self.frame.n**2 <= products

    def _direct_is_cheaper(self, block: Block, used: int) -> bool:
        small = SMALL if any(group.local for group in block.groups) else TINY
        if block.weights is not None or self._is_small(used, small):
            return True
        widths = [group.weights.shape[1] for group in block.groups]
        row = sum(width * len(lags) for width, lags in zip(widths, self.frame.lags)) ** 2 / 2
        step = sum(widths[g] * widths[h] * len(self.frame.differences(g, h))
                   for g, h in combinations_with_replacement(range(len(widths)), 2))
        return used * row < block.valid.size * step + (block.valid.size - used) * row

    def _add_by_difference(self, block: Block, removed: Array) -> bool:
        """Add all rows of a block, unless so much energy is to be removed from a column that it would cost digits."""
        pairs = combinations_with_replacement(range(len(block.groups)), 2)
        reach, energy = self.frame.reach, np.full(self.frame.n, np.inf)
        found = {(g, h): lagged_products(block.groups[g], block.groups[h], self.frame.differences(g, h), reach)
                 for g, h in pairs}
        for g, columns in enumerate(self.frame.columns):
            energy[columns] = np.diag(found[g, g][:, 0])
        if np.any(removed > SAFE * (energy - removed)):
            return False
        for pair, products in found.items():
            self._products[pair] = self._products.get(pair, 0.0) + products
        for total, group in zip(self._totals, block.groups):
            total += group.totals(slice(reach, len(group.weights) - reach))
        self._stretched += block.valid.size
        return True

    def _of_rows(self, block: Block, rows: NDArray[np.intp]) -> Array:
        """Return the upper triangle, at least, of the weighted sum over some rows."""
        gram, n = np.zeros_like(self._gram), self.frame.n
        entries = 1 + sum(group.weights.shape[1] * len(lags) for group, lags in zip(block.groups, self.frame.lags))
        sparse = 3 * entries**2 < n**2 and not self._is_small(rows.size, SMALL)
        for part in (rows[start : start + FORMED] for start in range(0, rows.size, FORMED)):
            weights = np.ones(part.size) if block.weights is None else block.weights[part]
            if sparse:
                from optid.statistics import kernels

                kernels.add_outer(*block.sparse_rows(part), weights, gram)
            else:
                formed = block.dense_rows(part)
                gram += formed.T @ (formed if block.weights is None else formed * weights[:, None])
        return gram


@dataclass(frozen=True, eq=False)
class SampleRun:
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
    whole = _joined(start, [stream.reduce(partial(_run_of, layout, start, chunk), partial(_joined, start), threads)])
    last, before = -1, np.empty((0, layout.m + layout.l))
    for experiment, head, tail in whole.ends:
        before = before if experiment == last else before[:0]
        across = np.concatenate([before, head])
        if len(across) > layout.first_row:
            whole.total.add(make_block(across[:, : layout.m], across[:, layout.m :], None, layout))
        last, before = experiment, _last(np.concatenate([before, tail]), layout.first_row)
    return whole.total


def _run_of(layout: Layout, start: Callable[[], Total], chunk: int, part: "Part", chunks: Iterable["Chunk"]
            ) -> SampleRun:
    reach, total = layout.first_row, start()
    head = tail = np.empty((0, layout.m + layout.l))

    def watch() -> Iterable[Sequence[Array]]:
        nonlocal head, tail
        for u, y, _ in chunks:
            head = np.concatenate([head, np.hstack([u[:reach], y[:reach]])])[:reach]
            tail = _last(np.concatenate([tail, np.hstack([_last(u, reach), _last(y, reach)])]), reach)
            yield u, y

    for stretch in cut(watch(), f"{part.label}, ", layout, chunk):
        total.add_all(blocks_of(stretch, layout, chunk))
    return SampleRun(total, ((part.experiment, head, tail),))


def _joined(start: Callable[[], Total], runs: Sequence[SampleRun]) -> SampleRun:
    """Join runs into a new one: Dask may use those given again."""
    total = start()
    for run in runs:
        total.merge(run.total)
    return SampleRun(total, tuple(end for run in runs for end in run.ends))


def _last(samples: Array, count: int) -> Array:
    return samples[max(len(samples) - count, 0) :]
