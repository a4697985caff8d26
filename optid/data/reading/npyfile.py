"""NumPy files; these are read, not mapped, since mapped pages count as resident memory."""

import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from optid.data.reading.columns import position_names
from optid.errors import DataError

BROKEN = (ValueError, OSError, EOFError, TypeError, SyntaxError, KeyError, IndexError, AttributeError, RecursionError,
          TokenError, OverflowError, MemoryError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What numpy and zipfile raise on damaged files."""


@dataclass(frozen=True)
class NpyFile:
    """An npy file of real numbers."""

    path: Path  # the file
    names: tuple[str, ...]  # one name per column
    rows: int  # number of samples
    dtype: np.dtype  # type of the samples as stored
    by_column: bool  # whether a column is contiguous in the file (Fortran order)
    offset: int  # bytes before the first sample

    def blocks(self, rows: int, wanted: Sequence[str], _: Any = None) -> Iterator[dict[str, np.ndarray]]:
        """Yield columns of the stored type, at most `rows` rows at a time."""
        places = {name: place for place, name in enumerate(self.names)}
        width = 1 if self.by_column else len(self.names)
        with ExitStack() as stack:
            files = [stack.enter_context(open(self.path, "rb", buffering=0)) for _ in range(len(self.names) // width)]
            for c, file in enumerate(files):
                file.seek(self.offset + c * self.rows * self.dtype.itemsize)
            for first in range(0, self.rows, rows):
                count = min(rows, self.rows - first)
                runs = [np.fromfile(file, self.dtype, count * width).reshape(-1, width) for file in files]
                yield {name: runs[places[name]][:, 0] if self.by_column else runs[0][:, places[name]]
                       for name in wanted}


def open_npy(path: Path, columns: Sequence[str] | None = None) -> NpyFile:
    """Read the header of an npy file; `columns` are the names of its columns, by default their positions.

    `DataError`: not an npy file, not real numbers, not (N,) or (N, channels), empty, shorter than its header says, or
    another number of columns.
    """
    with open(path, "rb") as file, _named(path.name, "an npy file"):
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ValueError(f"npy version {version} is unknown")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_column, dtype = read(file)
        if any(not isinstance(n, int) or n < 0 for n in shape):
            raise ValueError(f"its header has shape {shape}")
        offset = file.tell()
    if dtype.kind not in "iuf":
        raise DataError(f"{path.name} holds {dtype}; it must hold real numbers.")
    if len(shape) not in (1, 2) or 0 in shape:
        raise DataError(f"{path.name} has shape {shape}; it must be (samples,) or (samples, channels), with samples.")
    rows, width = shape if len(shape) == 2 else (shape[0], 1)
    if width > rows:
        raise DataError(f"{path.name} has shape {shape}: more channels than samples. Save the transpose (x.T).")
    there = (path.stat().st_size - offset) // dtype.itemsize
    if there < rows * width:
        raise DataError(f"{path.name} is truncated: its header says {rows * width} numbers, the file has {there}.")
    names = tuple(position_names(columns, width, path.name))
    return NpyFile(path, names, rows, dtype, bool(by_column), offset)


def side_by_side(files: Mapping[str, NpyFile], rows: int, wanted: Sequence[str], _: Any = None
                 ) -> Iterator[dict[str, np.ndarray]]:
    """Yield blocks of channels with one single-column file each."""
    for parts in zip(*(files[name].blocks(rows, files[name].names) for name in wanted), strict=True):
        yield {name: column for name, part in zip(wanted, parts) for column in part.values()}


def npz_arrays(path: Path, names: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the arrays of these names of an npz file, by default only all names; `DataError` if one is damaged."""
    with _named(path.name, "a NumPy file of plain numbers"), open(path, "rb") as file:
        with np.load(file, allow_pickle=False) as archive:
            return dict.fromkeys(archive.files) if names is None else {name: archive[name] for name in names}


@contextmanager
def _named(label: str, kind: str) -> Iterator[None]:
    """Name the file that numpy cannot read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # headers of Python 2, and damaged ones that look like them
            yield
    except BROKEN as error:
        raise DataError(f"{label} is damaged, or not {kind}: {error}") from error
