"""Parts of a record that can be read apart, on this machine or on the worker of a cluster that is told to.

A part travels to the worker, not its samples: a file is opened there, and a partition of a Dask collection is already
there or is computed there.
"""

import hashlib
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from optid.data.reading.chunks import Block
from optid.errors import DataError

TABLES = 'pip install "optid[tables]"'

SAMPLES = 1 << 20
"""Row groups of a Parquet file are taken together up to this many samples: smaller tasks do not pay."""

TAIL = 1 << 16
"""Bytes at the end of a file (of a Parquet file: its table of contents) that tell it from another of the same size."""


@dataclass(frozen=True)
class FilePart:
    """A file, or several of the same length read side by side.

    Attributes:
        paths: the files.
        prints: size and digest of the end of each, as the one who opened the record saw them.
        n_samples: number of samples, or None.
        read: what reads the blocks.
        rows: which rows these are, for messages.
        experiment: which experiment of the record they belong to.
    """

    paths: tuple[Path, ...]
    prints: tuple[tuple[int, str], ...]
    n_samples: int | None
    read: Callable[[Sequence[str], str | None], Iterator[Block]] = field(repr=False)
    rows: str = ""
    experiment: int = 0
    content: None = None

    @classmethod
    def of(cls, paths: Sequence[Path], n_samples: int | None, read: Any) -> "FilePart":
        """Take the fingerprints of files that are here; workers see them under their absolute paths."""
        return cls(tuple(path.absolute() for path in paths), tuple(map(fingerprint, paths)), n_samples, read)

    @property
    def label(self) -> str:
        """Name of the first file."""
        return self.paths[0].name + self.rows

    def blocks(self, wanted: Sequence[str], clock: str | None) -> Iterator[Block]:
        """Yield blocks once the files are known to be those that were opened.

        Raises:
            DataError: no such file on this machine, or one with another content.
        """
        for path, wanted_print in zip(self.paths, self.prints):
            _check_same(path, wanted_print)
        return self.read(wanted, clock)


@dataclass(frozen=True)
class FramePart:
    """A partition of a Dask data frame or a chunk of a Dask array.

    Attributes:
        label: which one.
        names: names of all columns.
        chunk: samples of a block.
        content: what Dask is to compute, or its result: a frame, or an array (n, channels).
        n_samples: number of samples, or None.
        experiment: which experiment of the record they belong to.
    """

    label: str
    names: tuple[str, ...]
    chunk: int
    content: Any = field(repr=False)
    n_samples: int | None = None
    experiment: int = 0

    def blocks(self, wanted: Sequence[str], clock: str | None) -> Iterator[Block]:
        """Yield blocks of the computed content."""
        whole = {name: self._column(name, name == clock) for name in wanted}
        for start in range(0, len(whole[wanted[0]]), self.chunk):
            yield {name: column[start : start + self.chunk] for name, column in whole.items()}

    def _column(self, name: str, is_clock: bool) -> np.ndarray:
        if isinstance(self.content, np.ndarray):
            column = self.content[:, self.names.index(name)]
        else:
            series = self.content.iloc[:, self.names.index(name)]
            column = series.to_numpy()
            if column.dtype.kind not in "iuf" and not is_clock and series.dtype.kind in "iuf":  # nullable numbers
                column = series.to_numpy(dtype=np.float64, na_value=np.nan)
        if column.dtype.kind not in "iuf" and not is_clock:
            raise DataError(f"{self.label}: column {name!r} is of type {column.dtype}; convert it to numbers first.")
        return column


Part = FilePart | FramePart
"""Successive samples of one experiment: `label`, `experiment`, `n_samples`, `content` (what Dask computes) and
`blocks`, which starts a new pass over some columns."""


def is_dask(thing: Any) -> bool:
    """Say whether something is a Dask collection, without importing Dask."""
    return hasattr(thing, "__dask_graph__") and hasattr(thing, "to_delayed")


def fingerprint(path: Path) -> tuple[int, str]:
    """Return the size of a file and a digest of its end: enough to tell two versions apart without reading them."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        file.seek(max(size - TAIL, 0))
        return size, hashlib.sha256(file.read()).hexdigest()


def _check_same(path: Path, wanted: tuple[int, str]) -> None:
    machine = platform.node()
    try:
        found = fingerprint(path)
    except OSError as error:
        raise DataError(
            f"machine {machine!r} cannot read {str(path)!r} ({error.strerror}). Put the record into a folder that "
            "every worker sees under the same path, or open it as a Dask collection.") from error
    if found != wanted:
        what = f"{found[0]} bytes, not {wanted[0]}" if found[0] != wanted[0] else "the same size, another content"
        raise DataError(f"machine {machine!r} has another {str(path)!r} than the one that was opened ({what}): it "
                        "changed meanwhile, or the machines have copies that differ. Open it again, or copy it anew.")


def pyarrow_parquet(label: str) -> Any:
    """Return the module that reads Parquet.

    Raises:
        DataError: it is not installed; with the pip line.
    """
    try:
        import pyarrow.parquet
    except ImportError:
        raise DataError(f"{label}: streaming Parquet needs pyarrow: {TABLES}") from None
    return pyarrow.parquet


@dataclass(frozen=True)
class RowGroups:
    """Blocks of some row groups of a Parquet file, of all of them for None.

    Raises:
        DataError: a column that does not hold numbers.
    """

    path: Path
    groups: tuple[int, ...] | None
    chunk: int

    def __call__(self, wanted: Sequence[str], clock: str | None) -> Iterator[Block]:
        """Start a pass over some columns."""
        parquet = pyarrow_parquet(self.path.name)
        import pyarrow as pa

        # Both settings bound the memory: by default pyarrow fetches the whole file ahead, or a whole row group.
        try:
            with parquet.ParquetFile(self.path, buffer_size=1 << 20, pre_buffer=False) as file:
                for name in wanted:
                    kind = file.schema_arrow.field(name).type
                    if name != clock and not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                        raise DataError(f"{self.path.name}: column {name!r} is of type {kind}; convert it to numbers "
                                        "first.")
                columns = list(dict.fromkeys(wanted))
                for batch in file.iter_batches(self.chunk, row_groups=self.groups, columns=columns):
                    block = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in wanted}
                    yield block
        except DataError:
            raise
        except (OSError, ValueError, KeyError, IndexError, MemoryError, pa.ArrowException) as error:
            raise damaged_parquet(self.path, error) from error


def damaged_parquet(path: Path, error: BaseException) -> DataError:
    """Return the refusal of a Parquet file that a library could not read."""
    return DataError(f"{path.name} is not a Parquet file, or it is damaged: {str(error)[:500]}")


def parquet_parts(path: Path, chunk: int) -> list[FilePart]:
    """Cut a Parquet file into parts of successive row groups."""
    contents = pyarrow_parquet(path.name).read_metadata(path)
    prints, parts, groups, rows = (fingerprint(path),), [], [], 0
    for group in range(contents.num_row_groups):
        groups.append(group)
        rows += contents.row_group(group).num_rows
        if rows >= SAMPLES or group == contents.num_row_groups - 1:
            read = RowGroups(path.absolute(), tuple(groups), chunk)
            whole = len(groups) == contents.num_row_groups
            where = "" if whole else f", row groups {groups[0]} to {groups[-1]}"
            parts.append(FilePart((path.absolute(),), prints, rows, read, where))
            groups, rows = [], 0
    return parts
