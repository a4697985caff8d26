"""Sums of outer products of regressor rows, from samples in time order and without forming the rows.

A row holds the samples of every signal at its lags, so a block of the sum over *all* rows depends on the difference of
two lags only: one product of the signals per difference replaces one per pair of lags. Samples that are missing or lie
beyond the ends are set to zero, and the rows that touch one are subtracted afterwards; where these are many, the valid
rows are added directly.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.layout import Layout
from optid.statistics.factors import add_to_root

FORMED = 2048
"""Rows that are formed at once where a dense product is the cheapest way."""

NARROW = 16
"""Products of dense signals at one lag up to which starting the threads of a matrix product does not pay."""

SMALL = 3e7
"""Products in a sum of dense rows up to which loading compiled loops (half a second) does not pay."""

SAFE = 1e3
"""Energy subtracted from a column over energy left: beyond it more than three digits would be lost."""


@dataclass(frozen=True)
class Signals:
    """Signals that enter the rows at the same lags: the outputs, or the functions of one input.

    Attributes:
        first: (T,) position of the first function that does not vanish.
        weights: (T, s) values from there on.
        size: number of signals.
        lags: the lags at which they enter.
        columns: (lags, size) where they stand in a complete row.
    """

    first: NDArray[np.int32]
    weights: Array
    size: int
    lags: range
    columns: NDArray[np.int32]

    @property
    def local(self) -> bool:
        """Whether some functions vanish at every sample."""
        return self.weights.shape[1] < self.size

    def dense(self, at: NDArray[np.intp]) -> Array:
        """Return all values at some samples, (K, size)."""
        if not self.local:
            return self.weights[at]
        values = np.zeros((at.size, self.size))
        np.put_along_axis(values, self.first[at, None] + np.arange(self.weights.shape[1]), self.weights[at], axis=1)
        return values

    def total(self) -> Array:
        """Return the sum over time, (size,)."""
        if not self.local:
            return np.ones(len(self.weights)) @ self.weights
        from optid.statistics import kernels

        sums = np.zeros(self.size)
        kernels.local_total(self.first, self.weights, sums)
        return sums


@dataclass(frozen=True)
class Block:
    """Samples of a stretch of time, with zeros before, behind and in place of missing ones.

    Attributes:
        groups: the outputs, then the functions of each input.
        reach: largest lag; row r looks back from sample reach + r of the arrays.
        valid: (R,) rows that touch neither a missing sample nor the zeros around.
        weights: (R,) weights of the rows, or None for ones.
        candidates: rows that would be used, were no sample missing.
    """

    groups: tuple[Signals, ...]
    reach: int
    valid: NDArray[np.bool_]
    weights: Array | None
    candidates: int


def stretches(chunks: Iterable[Sequence[Array]], reach: int, size: int) -> Iterator[list[Array]]:
    """Cut chunks of parallel arrays into stretches of `size` samples, each with the `reach` samples before it.

    Args:
        chunks: arrays with the same first axis, in time order, of any length.
        reach: samples carried over from one stretch to the next.
        size: new samples of each stretch; the last one has fewer.

    Yields:
        Arrays of at most reach + size samples; nothing when there are no more than `reach` in all.
    """
    carried: list[Array] | None = None
    for chunk in chunks:
        parts = list(chunk) if carried is None else [np.concatenate(pair) for pair in zip(carried, chunk)]
        start = 0
        while len(parts[0]) - start >= reach + size:
            yield [part[start : start + reach + size] for part in parts]
            start += size
        carried = [part[start:] for part in parts]
    if carried is not None and len(carried[0]) > reach:
        yield carried


def rows_present(u: Array, y: Array, layout: Layout) -> NDArray[np.bool_]:
    """Mark the rows in which every sample is present.

    Args:
        u: (reach + R, m) inputs, NaN = missing.
        y: (reach + R, l) outputs, NaN = missing.
        layout: the lags; reach is its `first_row`.

    Returns:
        (R,) marks of the rows from sample `reach` on.
    """
    reach, count = layout.first_row, len(u) - layout.first_row
    present = np.ones(count, dtype=bool)
    missing = [np.logical_or.reduce(np.isnan(y), axis=1), *np.isnan(u).T]
    for lost, lags in zip(missing, layout.group_lags):
        for lag in lags if lost.any() else ():
            present &= ~lost[reach - lag : reach - lag + count]
    return present


def make_block(u: Array, y: Array, weights: Array | None, layout: Layout) -> Block:
    """Evaluate the bases on one stretch: u (reach + R, m), y (reach + R, l), weights (reach + R,) or None."""
    reach, inner = layout.first_row, slice(layout.first_row, layout.first_row + len(u))
    valid = np.zeros(len(u) + reach, dtype=bool)
    valid[reach : len(u)] = rows_present(u, y, layout)
    outputs = np.zeros((len(y) + 2 * reach, layout.l))
    outputs[inner] = y
    outputs[np.isnan(outputs)] = 0.0
    always = np.zeros(len(outputs), dtype=np.int32)
    groups = [Signals(always, outputs, layout.l, layout.group_lags[0], layout.complete_columns[0])]
    for c, basis in enumerate(layout.bases):
        channel = np.full(len(u) + 2 * reach, np.nan)  # a missing sample evaluates to zeros
        channel[inner] = u[:, c]
        first, values = basis.local(channel)
        first, values = np.ascontiguousarray(first), np.ascontiguousarray(values)
        if first.min() < 0 or first.max() + values.shape[1] > basis.full_size:  # compiled loops do not look
            raise StructureError(f"{basis!r}: local() names functions outside the family of {basis.full_size}.")
        groups.append(Signals(first, values, basis.full_size, layout.lags[c], layout.complete_columns[c + 1]))
    candidates = len(u) - reach
    if weights is not None:
        candidates = int(np.count_nonzero(weights[reach:]))
        weights = np.pad(weights, (0, reach))
        valid &= weights > 0
    return Block(tuple(groups), reach, valid, weights, candidates)


def sparse_rows(block: Block, rows: NDArray[np.intp], n: int) -> tuple[NDArray[np.int32], Array]:
    """List the entries of some rows of length n that may differ from zero: columns (K, z), increasing, and values."""
    outputs, *inputs = block.groups
    constant = np.full((rows.size, 1), n - 1 - outputs.size, dtype=np.int32), np.ones((rows.size, 1))
    past = [_entries(outputs, rows + (block.reach - lag), lag) for lag in outputs.lags[1:]]
    present = [_entries(group, rows + (block.reach - lag), lag) for group in inputs for lag in group.lags]
    columns, values = zip(*past, *present, constant, _entries(outputs, rows + block.reach, 0))
    return np.concatenate(columns, axis=1), np.concatenate(values, axis=1)


def _entries(group: Signals, at: NDArray[np.intp], lag: int) -> tuple[NDArray[np.int32], Array]:
    """Columns and values (K, s) that a group contributes at one lag, from samples `at`."""
    width = np.arange(group.weights.shape[1], dtype=np.int32)
    return group.columns[lag - group.lags[0], 0] + group.first[at, None] + width, group.weights[at]


def dense_rows(block: Block, rows: NDArray[np.intp], n: int) -> Array:
    """Form some complete rows, (K, n)."""
    formed = np.empty((rows.size, n))
    for group in block.groups:
        for lag, where in zip(group.lags, group.columns):
            formed[:, where[0] : where[-1] + 1] = group.dense(rows + (block.reach - lag))
    formed[:, n - 1 - block.groups[0].size] = 1.0
    return formed


def differences(g: Signals, h: Signals) -> range:
    """Differences of a lag of h and a lag of g; one sign of them is enough for the products of a group with itself."""
    return range(0 if g is h else h.lags[0] - g.lags[-1], h.lags[-1] - g.lags[0] + 1)


def lagged_products(g: Signals, h: Signals, lags: range, reach: int) -> Array:
    """Sum g(t) h(t - d)^T over the inner samples t for every d in lags: (g.size, lags, h.size)."""
    from optid.statistics import kernels

    start, stop = reach, len(g.weights) - reach
    if h.local and not g.local:
        return lagged_products(h, g, range(-lags[-1], 1 - lags[0]), reach)[:, ::-1].transpose(2, 1, 0)
    sums = np.zeros((g.size, len(lags), h.size))
    if not g.local and g.size * h.size > NARROW:
        for d, lag in enumerate(lags):
            sums[:, d] = g.weights[start:stop].T @ h.weights[start - lag : stop - lag]
    elif not g.local:
        for i, j in np.ndindex(g.size, h.size):
            ahead = h.weights[start - lags[-1] : stop - lags[0], j]
            sums[i, :, j] = np.correlate(ahead, g.weights[start:stop, i], "valid")[::-1]
    elif not h.local:  # the values of h at all these lags are neighbours in memory, the oldest first
        windows = h.weights.reshape(-1)[(start - lags[-1]) * h.size :]
        kernels.local_by_dense(g.first[start:stop], g.weights[start:stop], windows, h.size, sums.reshape(g.size, -1))
        sums = sums[:, ::-1]
    else:
        kernels.local_by_local(g.first, g.weights, h.first, h.weights, start, stop, lags[0], sums)
    return sums


class Total:
    """Running sums over blocks of one layout.

    Attributes:
        rows: rows used so far.
        candidates: rows that would have been used, had no sample been missing.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.rows = self.candidates = 0

    def add(self, block: Block) -> None:
        """Add the valid rows of a block."""
        count = int(np.count_nonzero(block.valid))
        self.rows += count
        self.candidates += block.candidates
        self._add(block, count)

    def merge(self, other: Self) -> None:
        """Add the sums of other blocks, of the same layout."""
        self.rows += other.rows
        self.candidates += other.candidates
        self._merge(other)

    def _add(self, block: Block, count: int) -> None:
        raise NotImplementedError

    def _merge(self, other: Any) -> None:
        raise NotImplementedError


class Factor(Total):
    """Running triangular factor of the rows of [Phi | Y], by tall and skinny QR decomposition.

    Attributes:
        root: (n + l, n + l) upper triangular.
    """

    def __init__(self, layout: Layout) -> None:
        super().__init__(layout)
        self.root = np.zeros((layout.n_columns + layout.l,) * 2)

    def _add(self, block: Block, count: int) -> None:
        used = np.flatnonzero(block.valid)
        for start in range(0, used.size, FORMED):
            part = used[start : start + FORMED]
            formed = self.layout.contrasted(dense_rows(block, part, self.layout.n_complete))
            if block.weights is not None:
                formed *= np.sqrt(block.weights[part])[:, None]
            self.root = add_to_root(self.root, formed)

    def _merge(self, other: "Factor") -> None:
        self.root = add_to_root(self.root, other.root)


class Sums(Total):
    """The complete Gram matrix of [Phi | Y] with redundant functions, y not negated."""

    def __init__(self, layout: Layout, direct: bool = False) -> None:
        super().__init__(layout)
        self.direct = direct
        n = layout.n_complete
        self._gram = np.zeros((n, n))  # upper triangle
        self._removed = np.zeros(n)  # energy of the rows that were subtracted
        self._products: dict[tuple[int, int], Array] = {}
        self._totals = [np.zeros(columns.shape[1]) for columns in layout.complete_columns]
        self._stretched = 0  # rows, with those around the ends, that were added by lag difference

    def _add(self, block: Block, count: int) -> None:
        if block.weights is not None or self.direct or self._is_small(count) or self._direct_is_cheaper(block, count):
            used = np.flatnonzero(block.valid)
            self._add_rows(block, used, np.ones(count) if block.weights is None else block.weights[used])
        else:
            self._add_by_difference(block)
            others = np.flatnonzero(~block.valid)
            self._add_rows(block, others, np.full(others.size, -1.0))

    def _merge(self, other: "Sums") -> None:
        self._gram += other._gram
        self._removed += other._removed
        for pair, products in other._products.items():
            self._products[pair] = self._products.get(pair, 0.0) + products
        for total, part in zip(self._totals, other._totals):
            total += part
        self._stretched += other._stretched

    def cancelled(self, complete: Array) -> bool:
        """Say whether the subtraction of rows cost digits; the sums should then be taken again with direct=True."""
        return bool((self._removed > SAFE * np.maximum(np.diag(complete), 0.0)).any())

    def complete(self) -> Array:
        """Return the complete Gram matrix, symmetric, (n_complete, n_complete)."""
        gram, at = self._gram.copy(), self.layout.complete_columns
        constant = self.layout.n_complete - 1 - self.layout.l
        for (g, h), sums in self._products.items():
            lags_g, lags_h = self.layout.group_lags[g], self.layout.group_lags[h]
            if g == h:  # the product at -d is the transpose of that at d
                sums = np.concatenate([sums[:, :0:-1].transpose(2, 1, 0), sums], axis=1)
            index = np.subtract.outer(-np.array(lags_g), -np.array(lags_h)) + lags_g[-1] - lags_h[0]
            spread = sums[:, index].transpose(1, 0, 2, 3).reshape(at[g].size, at[h].size)
            rows, columns = at[g].reshape(-1, 1), at[h].reshape(1, -1)
            gram[rows, columns] += spread
            if g != h:  # outputs at lag 0 stand behind the inputs
                gram[columns.T, rows.T] += spread.T
        for columns, total in zip(at, self._totals):
            gram[columns, constant] += total
            gram[constant, columns] += total
        gram[constant, constant] += self._stretched
        return np.triu(gram) + np.triu(gram, 1).T

    def _is_small(self, rows: int) -> bool:
        return rows * self.layout.n_complete**2 <= SMALL

    def _direct_is_cheaper(self, block: Block, used: int) -> bool:
        widths = [group.weights.shape[1] for group in block.groups]
        row = sum(width * len(group.lags) for width, group in zip(widths, block.groups)) ** 2 / 2
        step = sum(widths[g] * widths[h] * len(differences(block.groups[g], block.groups[h]))
                   for g, h in combinations_with_replacement(range(len(widths)), 2))
        return used * row < block.valid.size * step + (block.valid.size - used) * row

    def _add_by_difference(self, block: Block) -> None:
        for pair in combinations_with_replacement(range(len(block.groups)), 2):
            g, h = (block.groups[i] for i in pair)
            products = lagged_products(g, h, differences(g, h), block.reach)
            self._products[pair] = self._products.get(pair, 0.0) + products
        for total, group in zip(self._totals, block.groups):
            total += group.total()
        self._stretched += block.valid.size

    def _add_rows(self, block: Block, rows: NDArray[np.intp], scale: Array) -> None:
        n = self.layout.n_complete
        entries = 1 + sum(group.weights.shape[1] * len(group.lags) for group in block.groups)
        sparse = 3 * entries**2 < n**2 and not self._is_small(rows.size)
        for start in range(0, rows.size, FORMED):
            part, weights = rows[start : start + FORMED], scale[start : start + FORMED]
            if sparse:
                from optid.statistics import kernels

                columns, values = sparse_rows(block, part, n)
                kernels.add_outer(columns, values, weights, self._gram)
                energy = np.bincount(columns.ravel(), (values**2 * weights[:, None]).ravel(), n)
            else:
                formed = dense_rows(block, part, n)
                self._gram += formed.T @ (formed * weights[:, None])
                energy = weights @ formed**2
            self._removed += np.maximum(-energy, 0.0)
