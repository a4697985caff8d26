"""NumPy files, read and not mapped: mapped pages count as resident memory; headers are compared with the file first."""

import math
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np

from optid.errors import DataError

BROKEN = (ValueError, OSError, EOFError, TypeError, SyntaxError, KeyError, IndexError, AttributeError, RecursionError,
          TokenError, OverflowError, MemoryError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What numpy and zipfile raise on damaged files."""


@dataclass(frozen=True)
class NpyFile:
    """An npy file of real numbers.

    Attributes:
        path: the file.
        rows: number of samples.
        width: number of columns.
        dtype: type of the samples as stored.
        by_column: whether a column is contiguous in the file (Fortran order).
        offset: bytes before the first sample.
    """

    path: Path
    rows: int
    width: int
    dtype: np.dtype
    by_column: bool
    offset: int

    def blocks(self, rows: int) -> Iterator[np.ndarray]:
        """Yield (n, width) arrays of the stored type, n at most `rows`."""
        if self.by_column:
            yield from self._blocks_by_column(rows)
            return
        with open(self.path, "rb", buffering=0) as file:
            file.seek(self.offset)
            for first in range(0, self.rows, rows):
                count = min(rows, self.rows - first) * self.width
                yield np.fromfile(file, self.dtype, count).reshape(-1, self.width)

    def _blocks_by_column(self, rows: int) -> Iterator[np.ndarray]:
        with ExitStack() as stack:
            files = [stack.enter_context(open(self.path, "rb", buffering=0)) for _ in range(self.width)]
            for c, file in enumerate(files):
                file.seek(self.offset + c * self.rows * self.dtype.itemsize)
            for first in range(0, self.rows, rows):
                count = min(rows, self.rows - first)
                yield np.stack([np.fromfile(file, self.dtype, count) for file in files], axis=1)


def open_npy(path: Path) -> NpyFile:
    """Read the header of an npy file.

    Raises:
        DataError: not an npy file, not real numbers, not (N,) or (N, channels), empty, or shorter than its header says.
    """
    with open(path, "rb") as file:
        try:
            shape, by_column, dtype = _header(file)
        except BROKEN as error:
            raise DataError(f"{path.name} is damaged, or not an npy file: {error}") from error
        offset = file.tell()
    if dtype.kind not in "iuf":
        raise DataError(f"{path.name} holds {dtype}, real numbers are needed.")
    if len(shape) not in (1, 2) or 0 in shape:
        raise DataError(f"{path.name} has shape {shape}; (samples,) or (samples, channels) is needed, with samples.")
    rows, width = shape if len(shape) == 2 else (shape[0], 1)
    if width > rows:
        raise DataError(f"{path.name} has shape {shape}: more channels than samples. Save the transpose (x.T).")
    there = (path.stat().st_size - offset) // dtype.itemsize
    if there < rows * width:
        raise DataError(f"{path.name} is truncated: its header says {rows * width} numbers, {there} are there.")
    return NpyFile(path, rows, width, dtype, bool(by_column) and width > 1, offset)


def load_npy(path: Path, label: str) -> np.ndarray:
    """Return the array of an npy file of plain numbers; `DataError` with the label otherwise."""
    try:
        with open(path, "rb") as file:
            if file.read(2) == b"PK":
                raise ValueError("it is an archive; name it .npz")
            file.seek(0)
            return _array(file, path.stat().st_size)
    except BROKEN as error:
        raise DataError(f"{label} is damaged, or not a NumPy file of plain numbers: {error}") from error


def npz_names(path: Path) -> list[str]:
    """Return the names of the arrays of an npz file; `DataError` where it is none."""
    return list(_archive(path, ()))


def npz_arrays(path: Path, names: Any) -> dict[str, Any]:
    """Return the arrays of these names; `DataError` where one is damaged or holds no plain numbers."""
    return {name: array for name, array in _archive(path, names).items() if name in names}


def _archive(path: Path, wanted: Any) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(path) as archive:
            found: dict[str, Any] = {}
            for info in archive.infolist():
                name = info.filename.removesuffix(".npy")
                found[name] = None
                if name in wanted:
                    with archive.open(info) as file:
                        found[name] = _array(file, info.file_size)
            return found
    except BROKEN as error:
        raise DataError(f"{path.name} is damaged, or not a NumPy file of plain numbers: {error}") from error


def _array(file: IO[bytes], size: int) -> np.ndarray:
    """Read an array of at most `size` bytes; refuse a header that promises more before memory is taken for it."""
    shape, by_column, dtype = _header(file)
    if dtype.hasobject:
        raise ValueError("it holds objects")
    count = math.prod(shape)
    if dtype.itemsize == 0 or count * dtype.itemsize > size:
        raise ValueError(f"its header says {count} numbers of {dtype.itemsize} bytes, the file has {size} bytes")
    content = file.read(count * dtype.itemsize)
    if len(content) < count * dtype.itemsize:
        raise ValueError("it is truncated")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if by_column else "C")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"npy version {version} is unknown")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # headers of Python 2, and damaged ones that look like them
        shape, by_column, dtype = read(file)
    if any(not isinstance(n, int) or n < 0 for n in shape):
        raise ValueError(f"its header has shape {shape}")
    return shape, by_column, dtype
