"""Parts of a record that can be read independently, on this machine or on the worker of a cluster.

A part is sent to the worker, not its samples: a file is opened there, and a partition of a Dask collection is stored
or computed there.
"""

import hashlib
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from optid.data.reading.chunks import Block
from optid.errors import DataError

TAIL = 1 << 16
"""Bytes at the end of a file (of a Parquet file its footer) that distinguish it from others of the same size."""


@dataclass(frozen=True)
class Part:
    """Successive samples of one experiment, read on every pass."""

    label: str  # for messages
    # yields blocks of (columns, those of them that may be text); of a Dask partition of (its content, columns, texts)
    read: Callable[..., Iterator[Block]] = field(repr=False)
    n_samples: int | None = None  # number of samples, or None
    # path, size and digest of the end of each file when the record was opened
    files: tuple[tuple[Path, int, str], ...] = field(default=(), repr=False)
    experiment: int = 0  # which experiment of the record they belong to
    # task of Dask, or its result: a frame, or an array (n, channels); None for files
    content: Any = field(default=None, repr=False)

    def blocks(self, wanted: Sequence[str], texts: Mapping[str, str]) -> Iterator[Block]:
        """Start a pass over some columns; `DataError` if a file is missing on this machine or has other content."""
        for path, size, digest in self.files:
            _check_same(path, (size, digest))
        return self.read(wanted, texts) if self.content is None else self.read(self.content, wanted, texts)


def file_parts(parts: Sequence[Part], *paths: Path) -> list[Part]:
    """Return parts with their files; workers must have these under their absolute paths."""
    files = tuple((path.absolute(), *_fingerprint(path)) for path in paths)
    return [replace(part, files=files) for part in parts]


def _fingerprint(path: Path) -> tuple[int, str]:
    size = path.stat().st_size
    with open(path, "rb") as file:
        file.seek(max(size - TAIL, 0))
        return size, hashlib.sha256(file.read()).hexdigest()


def _check_same(path: Path, wanted: tuple[int, str]) -> None:
    machine = platform.node()
    try:
        found = _fingerprint(path)
    except OSError as error:
        raise DataError(
            f"machine {machine!r} cannot read {str(path)!r} ({error.strerror}). Put the record into a folder that "
            "every worker sees under the same path, or open it as a Dask collection.") from error
    if found != wanted:
        what = f"{found[0]} bytes, not {wanted[0]}" if found[0] != wanted[0] else "the same size, another content"
        raise DataError(f"on machine {machine!r} {str(path)!r} differs from the file that was opened ({what}): it "
                        "was changed, or the machines have different copies. Open it again, or copy it again.")
