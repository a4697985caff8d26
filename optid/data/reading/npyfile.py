"""NumPy files in blocks, read and not mapped: mapped pages count as resident memory."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optid.errors import DataError


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
            version = np.lib.format.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"npy version {version} is unknown")
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, by_column, dtype = header(file)
        except (ValueError, EOFError) as error:
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
