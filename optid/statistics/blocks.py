"""Blocks of a record, evaluated one at a time: the rows they add are all that is ever formed."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, RankError
from optid.models.layout import Layout
from optid.statistics.sums import Block, make_block, stretches

CHUNK = 32768
"""Samples evaluated at a time: their basis functions stay in the processor's cache."""

BLOCKS = 4
"""Chunks, at least, that one thread takes at a time: longer ones do not occupy all threads in a common record."""

NO_WEIGHTS = "weights are for records in memory; a stream has none."


@dataclass(frozen=True)
class Stretch:
    """Part of a record: [u, y] or [u, y, weights] with the samples before its rows, and where it begins."""

    arrays: list[Array]
    record: str
    position: int


def cut(data: Any, layout: Layout, weights: Sequence[Array] | None, chunk: int) -> Iterator[Stretch]:
    """Cut a record into stretches that threads take one at a time."""
    length = length_of_stretches(layout, chunk)
    for name, chunks in _records(data, layout, weights):
        for i, arrays in enumerate(stretches(chunks, layout.first_row, length)):
            yield Stretch(arrays, name, i * length)


def length_of_stretches(layout: Layout, chunk: int) -> int:
    """Return the new samples of a stretch."""
    size = _block_size(layout, chunk)
    return size * max(BLOCKS, layout.n_complete**2 // (4 * size))  # merging the sums must not cost much


def blocks_of(part: Stretch, layout: Layout, chunk: int) -> Iterator[Block]:
    """Evaluate the bases on a stretch, block by block.

    Raises:
        DataError: a sample outside a basis with outside="error".
    """
    size = _block_size(layout, chunk)
    for i, (u, y, *weights) in enumerate(stretches([part.arrays], layout.first_row, size)):
        check_inside(u, layout, part.record, part.position + i * size)
        yield make_block(u, y, weights[0] if weights else None, layout)


def _block_size(layout: Layout, chunk: int) -> int:
    """New samples of a block; with those before them they are a chunk, so that chunks of a file are cut evenly."""
    return max(chunk - layout.first_row, 32 * layout.first_row, 1)


def _records(data: Any, layout: Layout, weights: Sequence[Array] | None
             ) -> Iterator[tuple[str, Iterable[Sequence[Array]]]]:
    """Yield the name and the chunks (u, y) or (u, y, weights) of every experiment."""
    check_channels(data, layout)
    if not hasattr(data, "experiments"):
        if weights is not None:
            raise DataError(NO_WEIGHTS)
        yield "", data
        return
    if weights is not None and len(weights) != len(data.experiments):
        raise DataError(f"{len(weights)} arrays of weights for {len(data.experiments)} experiments: give one each.")
    for i, experiment in enumerate(data.experiments):
        name = f"experiment {i + 1}: " if len(data.experiments) > 1 else ""
        count = len(experiment.y)
        if count <= layout.first_row:
            raise too_short(name, count, layout)
        if weights is None:
            yield name, [(experiment.u, experiment.y)]
        else:
            yield name, [(experiment.u, experiment.y, _checked_weights(weights[i], count, name))]


def too_short(name: str, count: int, layout: Layout) -> RankError:
    """Return the refusal of an experiment without a complete row."""
    return RankError(f"{name}{count} samples, but the lags reach back {layout.first_row}: no row is complete. Leave it "
                     "out, or use fewer lags.")


def _checked_weights(weights: Any, count: int, name: str) -> Array:
    weights = np.asarray(weights, dtype=float)
    if weights.shape != (count,):
        raise DataError(f"{name}weights have shape {weights.shape}; one per sample is needed, ({count},).")
    bad = ~(np.isfinite(weights) & (weights >= 0))
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(f"{name}weight of sample {k} is {weights[k]}: weights are finite and not negative.")
    return weights


def check_channels(data: Any, layout: Layout) -> None:
    """Refuse a record with another number of channels than the layout.

    Raises:
        DataError: the channels of both.
    """
    for kind, given, wanted in (("inputs", data.inputs, layout.inputs), ("outputs", data.outputs, layout.outputs)):
        if len(given) != len(wanted):
            raise DataError(f"The data have {len(given)} {kind} ({', '.join(given)}), the model {len(wanted)} "
                            f"({', '.join(wanted)}).")


def check_inside(u: Array, layout: Layout, name: str, position: int) -> None:
    """Refuse samples (N, m) outside a basis with outside="error"; the first of them has number `position`.

    Raises:
        DataError: names the input and the sample.
    """
    for c, basis in enumerate(layout.bases):
        if basis.outside == "error" and (out := basis.is_outside(u[:, c])).any():
            k = int(np.argmax(out))
            raise DataError(f"{name}input {layout.inputs[c]!r}, sample {position + k}: {u[k, c]:g} is outside the "
                            f"interval {basis.interval} of the basis. Use data inside it, or outside='clamp' or "
                            "'extrapolate'.")
