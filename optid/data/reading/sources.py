"""Sources of records larger than memory: named columns of a file in blocks, and the parts that can be read apart."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optid.data.reading.chunks import Block
from optid.data.reading.csvfile import open_csv
from optid.data.reading.npyfile import NpyFile, open_npy
from optid.data.reading.parts import (
    FilePart,
    FramePart,
    Part,
    RowGroups,
    damaged_parquet,
    is_dask,
    parquet_parts,
    pyarrow_parquet,
)
from optid.data.reading.tables import existing, position_names
from optid.errors import DataError


@dataclass(frozen=True)
class Source:
    """Named columns of one experiment.

    Attributes:
        label: name of the source, for messages.
        names: names of its columns.
        n_samples: number of samples, None where only a pass can tell.
        blocks: function of (columns, the one of them that is the clock) that starts a new pass each time; None where
            the source exists in parts only.
        parts: function of the columns that will be read; returns what can be read apart, in the order of time.
    """

    label: str
    names: list[str]
    n_samples: int | None
    blocks: Callable[[Sequence[str], str | None], Iterator[Block]] | None
    parts: Callable[[Sequence[str]], Iterable[Part]]


def open_source(source: Any, chunk: int, columns: Sequence[str] | None, delimiter: str, decimal: str) -> Source:
    """Open a file, a folder of Parquet files, a mapping {channel: npy file or Dask array} or a Dask collection.

    Raises:
        DataError: no such file, unknown format, a file that cannot be read, or a missing extra with its pip line.
    """
    if is_dask(source):
        return _of_dask(source, chunk, columns)
    if isinstance(source, Mapping):
        if source and all(is_dask(item) for item in source.values()):
            return _of_dask(_stacked(source), chunk, list(map(str, source)))
        if not source:
            raise DataError("the mapping {channel: path of an npy file, or Dask array} is empty; give every channel.")
        for name, item in source.items():
            if not isinstance(item, str | Path):
                raise DataError(f"channel {str(name)!r} is of type {type(item).__name__}: a stream takes paths of npy "
                                "files for all channels, or Dask arrays for all; use read for what is in memory.")
        return _of_npy({str(name): open_npy(existing(Path(path))) for name, path in source.items()}, chunk)
    if not isinstance(source, str | Path):
        raise DataError(f"a stream is opened from a path or a Dask collection, not from {type(source).__name__}; "
                        "use read for what is in memory.")
    if Path(source).is_dir():
        return _of_folder(Path(source), chunk)
    return _of_file(existing(Path(source)), chunk, columns, delimiter, decimal)


def _of_file(path: Path, chunk: int, columns: Sequence[str] | None, delimiter: str, decimal: str) -> Source:
    kind = path.suffix.lower()
    if kind == ".parquet":
        names, rows = _parquet_footer(path)
        return Source(path.name, names, rows, RowGroups(path, None, chunk), lambda _: parquet_parts(path, chunk))
    if kind in (".csv", ".txt", ".tsv"):
        file = open_csv(path, columns, "\t" if kind == ".tsv" else delimiter, decimal)
        names, rows, blocks = file.names, None, _CsvBlocks(file, chunk)
    elif kind == ".npy":
        opened = open_npy(path)
        names, rows = position_names(columns, opened.width, path.name), opened.rows
        blocks = _NpyBlocks(opened, tuple(names), chunk)
    else:
        raise DataError(f"{path.name}: streams are read from .csv, .txt, .tsv, .parquet and .npy files, and from "
                        "folders of .parquet files; use read.")
    return Source(path.name, names, rows, blocks, lambda _: [FilePart.of((path,), rows, blocks)])


@dataclass(frozen=True)
class _CsvBlocks:
    file: Any
    chunk: int

    def __call__(self, wanted: Sequence[str], clock: str | None) -> Iterator[Block]:
        return self.file.blocks(wanted, clock, None, self.chunk)


@dataclass(frozen=True)
class _NpyBlocks:
    file: NpyFile
    names: tuple[str, ...]
    chunk: int

    def __call__(self, wanted: Sequence[str], _: str | None) -> Iterator[Block]:
        places = {name: place for place, name in enumerate(self.names)}
        for block in self.file.blocks(self.chunk):
            yield {name: block[:, places[name]] for name in wanted}


@dataclass(frozen=True)
class _SeveralNpy:
    files: Mapping[str, NpyFile]
    chunk: int

    def __call__(self, wanted: Sequence[str], _: str | None) -> Iterator[Block]:
        for parts in zip(*(self.files[name].blocks(self.chunk) for name in wanted), strict=True):
            yield {name: part[:, 0] for name, part in zip(wanted, parts)}


def _of_npy(files: Mapping[str, NpyFile], chunk: int) -> Source:
    lengths = {name: file.rows for name, file in files.items()}
    for name, file in files.items():
        if file.width != 1:
            raise DataError(f"channel {name!r}: {file.path.name} has {file.width} columns, one is needed.")
    if len(set(lengths.values())) != 1:
        raise DataError(f"the channels have different lengths: {lengths}. Cut them to the common part.")
    rows, blocks, paths = next(iter(lengths.values())), _SeveralNpy(files, chunk), [f.path for f in files.values()]
    return Source("the npy files", list(files), rows, blocks, lambda _: [FilePart.of(paths, rows, blocks)])


def _parquet_footer(path: Path) -> tuple[list[str], int]:
    parquet = pyarrow_parquet(path.name)
    try:
        return list(parquet.read_schema(path).names), parquet.read_metadata(path).num_rows
    except (ValueError, KeyError, OSError, MemoryError) as error:
        raise damaged_parquet(path, error) from error


def _of_folder(folder: Path, chunk: int) -> Source:
    files = sorted(folder.glob("*.parquet"), key=_natural)
    if not files:
        below = sorted({path.parent.relative_to(folder).as_posix() for path in folder.rglob("*.parquet")}, key=_natural)
        hint = f" Folders below have: {', '.join(below[:5])}; give a list of folders, one per experiment." * bool(below)
        raise DataError(f"folder {str(folder)!r} has no .parquet file.{hint}")
    names, _ = _parquet_footer(existing(files[0]))
    rows = 0
    for path in files:
        there, count = _parquet_footer(existing(path))
        rows += count
        if set(there) != set(names):
            odd = sorted(set(there) ^ set(names))
            raise DataError(f"{path.name} has other columns than {files[0].name} (differing: {', '.join(odd)}): "
                            f"the files of {folder.name!r} are not parts of one table.")
    return Source(folder.name, names, rows, None, lambda _: [p for path in files for p in parquet_parts(path, chunk)])


def _natural(path: Any) -> list[Any]:
    """Sort part.2 before part.10."""
    words = re.split(r"(\d+)", getattr(path, "name", path))
    return [(int(word), "") if word.isdigit() else (-1, word) for word in words]


def _stacked(arrays: Mapping[Any, Any]) -> Any:
    import dask.array

    for name, array in arrays.items():
        if getattr(array, "ndim", None) != 1:
            raise DataError(f"channel {str(name)!r}: a Dask array (N,) is needed, not of shape "
                            f"{getattr(array, 'shape', None)}.")
    lengths = {str(name): array.shape[0] for name, array in arrays.items()}
    if len({str(length) for length in lengths.values()}) != 1:
        raise DataError(f"the channels have different lengths: {lengths}. Cut them to the common part.")
    return dask.array.stack(list(arrays.values()), axis=1)


def _of_dask(collection: Any, chunk: int, columns: Sequence[str] | None) -> Source:
    if hasattr(collection, "columns"):
        known = {str(name): name for name in collection.columns}

        def partitions(wanted: Sequence[str]) -> list[Part]:
            columns = tuple(dict.fromkeys(wanted))  # the others are not even read where Dask can help it
            contents = collection[[known[name] for name in columns]].to_delayed()
            return [FramePart(f"the Dask data frame, partition {i}", columns, chunk, content)
                    for i, content in enumerate(contents)]

        return Source("the Dask data frame", list(known), None, None, partitions)
    if getattr(collection, "ndim", None) not in (1, 2):
        raise DataError("a Dask data frame or array (N, channels) is needed; the array has "
                        f"{getattr(collection, 'ndim', 'no')} dimensions.")
    array = collection[:, None] if collection.ndim == 1 else collection
    rows, width = array.shape
    names = position_names(columns, width, "the Dask array")
    if rows == rows and width > rows:
        raise DataError(f"the Dask array has shape {array.shape}: more channels than samples. Transpose it (x.T).")
    array = array.rechunk({1: -1})
    lengths = [int(n) if n == n else None for n in array.chunks[0]]
    return Source("the Dask array", names, None if rows != rows else int(rows), None, lambda _: (
        FramePart(f"the Dask array, chunk {i}", tuple(names), chunk, content, n_samples=length)
        for i, (content, length) in enumerate(zip(array.to_delayed().ravel(), lengths))))
