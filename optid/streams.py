"""Records larger than memory: CSV, Parquet and npy files read chunk by chunk, again on every pass."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from optid.channels import Transform, channel_names, channel_units, check_distinct, sampling_time
from optid.errors import DataError
from optid.reading.arrays import check_finite, check_integers
from optid.reading.columns import TIME_TOLERANCE, Wanted, agreed_step, as_stamps, choose, time_column, uniform_step
from optid.reading.csvfile import open_csv
from optid.reading.npyfile import NpyFile, open_npy
from optid.reading.tables import TABLES, existing, position_names

CHUNK = 131072
"""Samples read at a time: two channels of float64 fit into the second-level cache of a common processor."""

Block = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class _Source:
    """Named columns of a file in blocks: `blocks(columns)` starts a new pass each time it is called."""

    label: str
    names: list[str]
    n_samples: int | None
    blocks: Callable[[Sequence[str], str | None], Iterator[Block]]


@dataclass(frozen=True)
class Stream:
    """One experiment that is read chunk by chunk; every iteration is a new pass over the file.

    Iterating yields (u (n, m), y (n, l)), float64, in time order; NaN = missing. An infinite sample raises a
    `DataError` that names the channel and the sample when its chunk is reached.

    Attributes:
        inputs: names of the m inputs.
        outputs: names of the l outputs.
        dt: sampling time.
        input_units: their units, "" where unknown.
        output_units: their units, "" where unknown.
        name: name of the data set.
        n_samples: number of samples, None where only a pass can tell (CSV).
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    name: str
    n_samples: int | None
    _chunks: Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]] = field(repr=False, compare=False)

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        return self._chunks()

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs."""
        return len(self.outputs)

    @property
    def transform(self) -> Transform:
        """Identity: a stream is in raw units."""
        return Transform.identity(self.m, self.l)

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and the largest sample (m,) of each input, from one pass that is made once.

        Raises:
            DataError: every sample of an input is missing.
        """
        lo, hi = self._ranges
        return lo.copy(), hi.copy()

    @cached_property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        lo, hi = np.full(self.m, np.nan), np.full(self.m, np.nan)
        for u, _ in self:
            lo, hi = np.fmin(lo, np.fmin.reduce(u, axis=0)), np.fmax(hi, np.fmax.reduce(u, axis=0))
        for name, value in zip(self.inputs, lo):
            if np.isnan(value):
                raise DataError(f"channel {name!r}: every sample is missing. Check the column, or leave it out.")
        return lo, hi


def open_stream(
    source: str | Path | Mapping[str, str | Path],
    inputs: Wanted = None,
    outputs: Wanted = None,
    dt: float | None = None,
    chunk: int = CHUNK,
    *,
    time: str | int | bool | None = None,
    columns: Sequence[str] | None = None,
    input_units: str | Sequence[str] | None = None,
    output_units: str | Sequence[str] | None = None,
    name: str | None = None,
    delimiter: str = ",",
    decimal: str = ".",
    time_tolerance: float = TIME_TOLERANCE,
) -> Stream:
    """Open a record that need not fit into memory; nothing but the header is read yet.

    Args:
        source: path of a .csv, .txt, .parquet or .npy file, or {channel: path of an .npy file (N,)}. An npy file holds
            (N, channels) numbers; it is read, not mapped, because mapped pages count as resident memory.
        inputs: columns by name or position, or {channel name: column}; u, or u1, u2, ..., when not given.
        outputs: likewise; y, or y1, y2, ..., when not given.
        dt: sampling time; from the first time stamps when not given, 1 without stamps.
        chunk: samples read at a time.
        time: column of time stamps, checked on every pass; a column t or time when not given; False ignores it.
        columns: names of the columns of an npy file, or of a CSV file without a header.
        input_units: one unit per input.
        output_units: one unit per output.
        name: name of the data set; the file's when not given.
        delimiter: character between the cells of a CSV file.
        decimal: decimal mark of a CSV file.
        time_tolerance: largest deviation of a time step from the first chunk's median step, relative to it.

    Raises:
        DataError: as `read`, here or when the chunk is reached.
    """
    if isinstance(chunk, bool) or not isinstance(chunk, int | np.integer) or chunk < 1:
        raise DataError(f"chunk = {chunk!r}: a positive number of samples is needed.")
    opened = _open(source, int(chunk), columns, delimiter, decimal)
    ins, outs = (choose(opened.names, wanted, c, opened.label) for wanted, c in ((inputs, "u"), (outputs, "y")))
    check_distinct((*ins, *outs))
    clock = time_column(opened.names, time, [*ins.values(), *outs.values()], opened.label)
    dt = None if dt is None else sampling_time(dt)
    if clock is not None:
        stamps = next(opened.blocks([clock], clock), {clock: np.empty(0)})[clock]
        stamps = as_stamps(stamps, f"{opened.label}, column {clock!r}")
        dt = agreed_step(uniform_step(stamps, time_tolerance, opened.label), dt, time_tolerance, opened.label)
    step = 1.0 if dt is None else dt

    def chunks() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        done, last = 0, None
        for block in opened.blocks([*ins.values(), *outs.values(), *([clock] if clock else [])], clock):
            u = _gathered(block, ins, opened.label, done)
            y = _gathered(block, outs, opened.label, done)
            if clock is not None:
                stamps = as_stamps(block[clock], f"{opened.label}, column {clock!r}")
                since = stamps if last is None else np.concatenate([last, stamps])
                uniform_step(since, time_tolerance, opened.label, step, done + stamps.size - since.size)
                last = stamps[-1:]
            done += u.shape[0]
            yield u, y
        if not done:
            raise DataError(f"{opened.label} has no rows.")

    label = Path(source).stem if isinstance(source, str | Path) else ""
    return Stream(
        inputs=channel_names(list(ins), "u", len(ins), "inputs"),
        outputs=channel_names(list(outs), "y", len(outs), "outputs"),
        dt=step,
        input_units=channel_units(input_units, len(ins), "input_units"),
        output_units=channel_units(output_units, len(outs), "output_units"),
        name=label if name is None else name,
        n_samples=opened.n_samples,
        _chunks=chunks,
    )


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


def _open(source: Any, chunk: int, columns: Sequence[str] | None, delimiter: str, decimal: str) -> _Source:
    if isinstance(source, Mapping):
        return _of_npy({str(name): open_npy(existing(Path(path))) for name, path in source.items()}, chunk)
    path = existing(Path(source))
    kind = path.suffix.lower()
    if kind in (".csv", ".txt", ".tsv"):
        return _of_csv(path, chunk, columns, "\t" if kind == ".tsv" else delimiter, decimal)
    if kind == ".parquet":
        return _of_parquet(path, chunk)
    if kind == ".npy":
        file = open_npy(path)
        names = position_names(columns, file.width, path.name)
        return _Source(path.name, names, file.rows, lambda wanted, _: (
            {name: block[:, names.index(name)] for name in wanted} for block in file.blocks(chunk)))
    raise DataError(f"{path.name}: streams are read from .csv, .txt, .tsv, .parquet and .npy files; use read.")


def _of_npy(files: Mapping[str, NpyFile], chunk: int) -> _Source:
    lengths = {name: file.rows for name, file in files.items()}
    for name, file in files.items():
        if file.width != 1:
            raise DataError(f"channel {name!r}: {file.path.name} has {file.width} columns, one is needed.")
    if len(set(lengths.values())) != 1:
        raise DataError(f"the channels have different lengths: {lengths}. Cut them to the common part.")

    def blocks(wanted: Sequence[str], _: str | None) -> Iterator[Block]:
        for parts in zip(*(files[name].blocks(chunk) for name in wanted), strict=True):
            yield {name: part[:, 0] for name, part in zip(wanted, parts)}

    return _Source("the npy files", list(files), next(iter(lengths.values())), blocks)


def _of_csv(path: Path, chunk: int, columns: Sequence[str] | None, delimiter: str, decimal: str) -> _Source:
    file = open_csv(path, columns, delimiter, decimal)

    def blocks(wanted: Sequence[str], clock: str | None) -> Iterator[Block]:
        done = 0
        for block in file.blocks(wanted, chunk):
            yield {
                name: np.array(cells) if name == clock else file.numbers(cells, name, done)
                for name, cells in block.items()
            }
            done += len(block[wanted[0]])

    return _Source(path.name, file.names, None, blocks)


def _of_parquet(path: Path, chunk: int) -> _Source:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise DataError(f"{path.name}: streaming Parquet needs pyarrow: {TABLES}") from None
    try:
        schema, rows = pq.read_schema(path), pq.read_metadata(path).num_rows
    except (ValueError, OSError) as error:
        raise DataError(f"{path.name} is not a Parquet file, or it is damaged: {error}") from error

    def blocks(wanted: Sequence[str], clock: str | None) -> Iterator[Block]:
        for name in wanted:
            kind = schema.field(name).type
            if name != clock and not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                raise DataError(f"{path.name}: column {name!r} is of type {kind}; convert it to numbers first.")
        # Both settings bound the memory: by default pyarrow fetches the whole file ahead, or a whole row group.
        with pq.ParquetFile(path, buffer_size=1 << 20, pre_buffer=False) as file:
            for batch in file.iter_batches(chunk, columns=list(dict.fromkeys(wanted))):
                yield {name: batch.column(name).to_numpy(zero_copy_only=False) for name in wanted}

    return _Source(path.name, list(schema.names), rows, blocks)
