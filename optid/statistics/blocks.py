"""Rows of lagged signals, evaluated in blocks: those of one stretch of a record are all that is ever formed."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases.basis import spread
from optid.errors import DataError, RankError, StructureError
from optid.models.layout import Layout

CHUNK = 32768  # samples summed up at a time: their basis functions stay in the processor's cache
PIECE = 4096  # samples evaluated at a time: so do the intermediate results
# chunks, at least, that one thread takes at a time: longer ones do not occupy all threads in a common record
BLOCKS = 4


@dataclass(frozen=True, eq=False)
class Frame:
    """The places of the samples of groups of signals in a row; every group has its own lags."""

    lags: tuple[range, ...]  # lags of every group
    columns: tuple[NDArray[np.int32], ...]  # (lags, signals) columns of every group
    constant: int  # column of the constant

    @classmethod
    def of(cls, layout: Layout) -> "Frame":
        """Return the complete rows of a layout: outputs, complete families of every input, 1, outputs at lag 0."""
        return cls(layout.group_lags, layout.complete_columns, layout.n_complete - 1 - layout.l)

    @cached_property
    def n(self) -> int:
        """Length of a row."""
        return 1 + sum(columns.size for columns in self.columns)

    @cached_property
    def reach(self) -> int:
        """Largest lag."""
        return max(lags[-1] for lags in self.lags)

    def differences(self, g: int, h: int) -> range:
        """Differences of a lag of group h and a lag of group g; of a group with itself one sign of them is enough."""
        return range(0 if g == h else self.lags[h][0] - self.lags[g][-1], self.lags[h][-1] - self.lags[g][0] + 1)


@dataclass(frozen=True)
class BlockSignals:
    """Signals that enter the rows at the same lags: the outputs, or the functions of one input."""

    first: NDArray[np.int32]  # (T,) position of the first function that does not vanish
    weights: Array  # (T, s) values from there on
    size: int  # number of signals

    @classmethod
    def dense(cls, values: Array) -> "BlockSignals":
        """Return signals that vanish nowhere in particular, (T, size)."""
        return cls(np.zeros(len(values), dtype=np.int32), values, values.shape[1])

    @property
    def local(self) -> bool:
        """Whether some functions vanish at every sample."""
        return self.weights.shape[1] < self.size

    def totals(self, samples: slice) -> Array:
        """Return the sum (size,) of every signal over some samples."""
        weights = self.weights[samples]
        if not self.local:
            return np.ones(len(weights)) @ weights
        places = self.first[samples, None] + np.arange(weights.shape[1])
        return np.asarray(np.bincount(places.ravel(), weights.ravel(), self.size), dtype=float)


@dataclass(frozen=True)
class Block:
    """Samples of a stretch of time, with zeros before, behind and in place of missing ones."""

    frame: Frame  # the rows
    groups: tuple[BlockSignals, ...]  # the signals of every group
    # (R,) rows that touch neither a missing sample nor the zeros around; row r looks back from sample reach + r of the
    # signals
    valid: NDArray[np.bool_]
    weights: Array | None  # (R,) weights of the rows, or None for ones
    candidates: int  # rows that would be used, were no sample missing

    def entries(self, rows: NDArray[np.intp]) -> Iterator[tuple[BlockSignals, NDArray[np.int32], NDArray[np.intp]]]:
        """Yield every group at every lag: its signals, its columns (size,) and its samples (K,) in some rows."""
        for group, lags, columns in zip(self.groups, self.frame.lags, self.frame.columns):
            for lag, where in zip(lags, columns):
                yield group, where, rows + (self.frame.reach - lag)

    def dense_rows(self, rows: NDArray[np.intp]) -> Array:
        """Form some rows, (K, n)."""
        formed = np.empty((rows.size, self.frame.n))
        for group, where, at in self.entries(rows):
            formed[:, where[0] : where[-1] + 1] = spread(group.first[at], group.weights[at], group.size)
        formed[:, self.frame.constant] = 1.0
        return formed

    def sparse_rows(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.int32], Array]:
        """List the entries of some rows that may differ from zero: columns (K, z), increasing, and values."""
        found: list[Any] = [(np.full((rows.size, 1), self.frame.constant, dtype=np.int32), np.ones((rows.size, 1)))]
        for group, where, at in self.entries(rows):
            width = np.arange(group.weights.shape[1], dtype=np.int32)
            found.append((where[0] + group.first[at, None] + width, group.weights[at]))
        columns, values = zip(*sorted(found, key=lambda entry: entry[0][0, 0]))
        return np.concatenate(columns, axis=1), np.concatenate(values, axis=1)


def stretches(chunks: Iterable[Sequence[Array]], reach: int, size: int) -> Iterator[list[Array]]:
    """Cut chunks of parallel arrays, in time order, into stretches of `size` samples and the `reach` before them.

    The last one has fewer; there is none when there are no more than `reach` samples in all.
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


def rows_present(missing: Sequence[NDArray[np.bool_]], lags: Sequence[range], reach: int) -> NDArray[np.bool_]:
    """Mark the rows (R,), from sample `reach` on, in which every sample of all groups is present.

    Every group has its marks of missing samples (reach + R,) and its lags; `reach` is the largest lag.
    """
    count = len(missing[0]) - reach
    present = np.ones(count, dtype=bool)
    for lost, delays in zip(missing, lags):
        for lag in delays if lost.any() else ():
            present &= ~lost[reach - lag : reach - lag + count]
    return present


def used_rows(u: Array, y: Array, layout: Layout) -> NDArray[np.bool_]:
    """Mark the rows (R,) of a layout in which every sample of u (reach + R, m) and y (reach + R, l) is present."""
    missing = [np.logical_or.reduce(np.isnan(y), axis=1), *np.isnan(u).T]
    return rows_present(missing, layout.group_lags, layout.first_row)


def make_block(u: Array, y: Array, weights: Array | None, layout: Layout) -> Block:
    """Evaluate the bases on one stretch: u (reach + R, m), y (reach + R, l), weights (reach + R,) or None."""
    frame, reach = Frame.of(layout), layout.first_row
    valid = np.zeros(len(u) + reach, dtype=bool)
    valid[reach : len(u)] = used_rows(u, y, layout)
    outputs = np.zeros((len(y) + 2 * reach, layout.l))
    outputs[reach : reach + len(y)] = np.where(np.isnan(y), 0.0, y)
    groups = [BlockSignals.dense(outputs)]
    for c, basis in enumerate(layout.bases):
        first, values = np.zeros(len(outputs), dtype=np.int32), np.zeros((0, 0))
        for start in range(0, len(u), PIECE):
            piece = slice(reach + start, reach + min(start + PIECE, len(u)))
            found, weighted = basis.local(u[start : start + PIECE, c])
            values = values if start else np.zeros((len(outputs), weighted.shape[1]))
            first[piece], values[piece] = found, weighted
        if first.min() < 0 or first.max() + values.shape[1] > basis.full_size:  # compiled loops do not look
            raise StructureError(f"{basis!r}: local() names functions outside the family of {basis.full_size}.")
        groups.append(BlockSignals(first, values, basis.full_size))
    candidates = len(u) - reach
    if weights is not None:
        candidates = int(np.count_nonzero(weights[reach:]))
        weights = np.pad(weights, (0, reach))
        valid &= weights > 0
    return Block(frame, tuple(groups), valid, weights, candidates)


def cut(chunks: Iterable[Sequence[Array]], record: str, layout: Layout, chunk: int) -> Iterator[list[Array]]:
    """Cut chunks [u, y] or [u, y, weights] of one record into stretches that threads take one at a time.

    A sample outside a basis with outside="error" is refused (`DataError`).
    """
    size = _block_size(layout, chunk)
    length = size * max(BLOCKS, layout.n_complete**2 // (4 * size))  # merging the sums must not cost much
    for i, arrays in enumerate(stretches(chunks, layout.first_row, length)):
        check_inside(arrays[0], layout, record, i * length)
        yield arrays


def blocks_of(stretch: Sequence[Array], layout: Layout, chunk: int) -> Iterator[Block]:
    """Evaluate the bases on a stretch, block by block."""
    for u, y, *weights in stretches([stretch], layout.first_row, _block_size(layout, chunk)):
        yield make_block(u, y, weights[0] if weights else None, layout)


def _block_size(layout: Layout, chunk: int) -> int:
    """New samples of a block; with those before them they are a chunk, so that chunks of a file are cut evenly."""
    return max(chunk - layout.first_row, 32 * layout.first_row, 1)


def records(data: Any, layout: Layout, weights: Sequence[Array] | None
            ) -> Iterator[tuple[str, Iterable[Sequence[Array]]]]:
    """Yield the name and the chunks (u, y) or (u, y, weights) of every experiment."""
    if not hasattr(data, "experiments"):
        yield "", data
        return
    names = check_lengths([len(experiment.y) for experiment in data.experiments], layout)
    if weights is not None and len(weights) != len(names):
        raise DataError(f"{len(weights)} arrays of weights for {len(names)} experiments: give one each.")
    for i, (name, experiment) in enumerate(zip(names, data.experiments)):
        own = () if weights is None else (row_weights(weights[i], len(experiment.y), name),)
        yield name, [(experiment.u, experiment.y, *own)]


def check_lengths(lengths: Sequence[int], layout: Layout) -> list[str]:
    """Return the name of every experiment in messages, or refuse one without a complete row (`RankError`)."""
    names = [f"experiment {i + 1}: " for i in range(len(lengths))] if len(lengths) > 1 else [""]
    for name, count in zip(names, lengths):
        if count <= layout.first_row:
            raise RankError(f"{name}{count} samples, but the lags reach back {layout.first_row}: no row is complete. "
                            "Leave it out, or use fewer lags.")
    return names


def row_weights(weights: Any, count: int, name: str = "") -> Array:
    """Return the weights of rows as (count,), from one number or one per sample; refuse others (`DataError`)."""
    given = np.asarray(weights, dtype=float)
    if given.shape not in ((), (count,)):
        raise DataError(f"{name}weights have shape {given.shape}: one number, or one for each of the {count} samples.")
    weights = np.array(np.broadcast_to(given, count))
    bad = ~(np.isfinite(weights) & (weights >= 0))
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(f"{name}weight of sample {k} is {weights[k]}: weights must be finite and not negative; 0 "
                        "leaves a row out.")
    return weights


def check_channels(data: Any, layout: Layout) -> None:
    """Refuse a record with another number of channels than the layout (`DataError`)."""
    for kind, given, wanted in (("inputs", data.inputs, layout.inputs), ("outputs", data.outputs, layout.outputs)):
        if len(given) != len(wanted):
            raise DataError(f"The data have {len(given)} {kind} ({', '.join(given)}), the model {len(wanted)} "
                            f"({', '.join(wanted)}).")


def check_inside(u: Array, layout: Layout, name: str, position: int) -> None:
    """Refuse samples (N, m) outside a basis with outside="error" (`DataError`); the first has number `position`."""
    for c, basis in enumerate(layout.bases):
        if basis.outside == "error" and (out := basis.is_outside(u[:, c])).any():
            k = int(np.argmax(out))
            raise DataError(f"{name}input {layout.inputs[c]!r}, sample {position + k}: {u[k, c]:g} is outside the "
                            f"interval {basis.interval} of the basis. Use data inside it, or outside='clamp' or "
                            "'extrapolate'.")
