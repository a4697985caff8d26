"""Lines of a stream: the standard input, or a file that is being appended, rotated, truncated or replaced."""

import hashlib
import os
import sys
import time as clock
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from optid.cli.terminal import note

POLL = 0.1  # seconds between checks of a followed file
BLOCK = 1 << 16  # bytes read at a time
MARK = 256  # bytes before the current place that identify a file


def standard_input() -> Iterator[tuple[list[bytes], str]]:
    """Yield complete lines as they arrive, without their ends, and an empty remark."""
    if sys.stdin.isatty():
        note("reading from the terminal; end with Ctrl-D, or pipe a file: optid monitor model.json < stream.csv")
    rest = b""
    while part := os.read(sys.stdin.fileno(), BLOCK):
        *whole, rest = (rest + part).split(b"\n")
        if whole:
            yield whole, ""
    if rest:
        yield [rest], ""


class Followed:
    """A file that is followed.

    Attributes:
        place: start of the next line, in JSON types: path, offset, inode, and a hash of the bytes before it.
    """

    def __init__(self, path: Path, place: Mapping[str, Any] | None) -> None:
        """Open a file, to be read from the place of an earlier run, if given (`OSError`: no such file)."""
        self._path, self._old = path, dict(place) if place else None
        with open(path, "rb") as file:
            self.place: dict[str, Any] = {"path": str(path.resolve()), "offset": 0, "inode": _inode(file), "mark": ""}
        self._tail = b""

    def advance(self, count: int, lines: list[bytes]) -> None:
        """Record that lines of so many bytes have been processed."""
        self._tail = (self._tail + b"".join(line + b"\n" for line in lines[-MARK:]))[-MARK:]
        self.place |= {"offset": self.place["offset"] + count, "mark": _hash(self._tail)}

    def lines(self, until_end: bool, *, partial: bool = True) -> Iterator[tuple[list[bytes], str]]:
        """Yield complete lines, without their ends, and a remark where another file begins.

        It stops at the end of the file if `until_end`; a last line without an end counts if `partial`.
        """
        remark, self._partial = "", partial
        if self._old is not None:
            found = self._found(self._old)
            if found is None:
                remark = f"{self._path} is not the file that was read before: it is read from its beginning"
            else:
                self._tail = _before(found, int(self._old["offset"]))
                self.place |= {key: self._old[key] for key in ("offset", "inode", "mark")}
                yield from self._of(found, until_end or not _same(found, self._path))
                if not _same(found, self._path):
                    remark = f"{self._path} was rotated: the rest of {found.name} was read"
                elif until_end:
                    return
                else:
                    remark = self._remark
        while True:
            self.place |= {"offset": 0, "inode": os.stat(self._path).st_ino, "mark": ""}
            self._tail, first = b"", True
            for raw in self._of(self._path, until_end):
                yield raw[0], remark if first else ""
                first = False
            if until_end:
                return
            remark = self._remark

    def _found(self, old: Mapping[str, Any]) -> Path | None:
        """Return the file that an earlier run read: under its name, or under the name after a rotation."""
        for path in (self._path, *sorted(self._path.parent.glob(self._path.name + "?*"))):
            if path.is_file() and path.stat().st_size >= int(old["offset"]) and \
                    _hash(_before(path, int(old["offset"]))) == old["mark"] and \
                    (path == self._path or path.stat().st_ino == old["inode"]):
                return path
        return None

    def _of(self, path: Path, until_end: bool) -> Iterator[tuple[list[bytes], str]]:
        """Yield lines of one file from the place on, until its end or until another file has its name."""
        rest, self._remark = b"", ""
        with open(path, "rb") as file:
            file.seek(self.place["offset"])
            self.place["inode"] = _inode(file)
            while True:
                if part := file.read(BLOCK):
                    *whole, rest = (rest + part).split(b"\n")
                    if whole:
                        yield whole, ""
                    continue
                if until_end or self._remark:
                    break
                self._remark = self._other(file)
                if not self._remark:
                    clock.sleep(POLL)
                elif "cut" in self._remark:
                    return  # else what came between the last look and the rotation is read, too
        if rest and (self._partial or self._remark):
            yield [rest], ""

    def _other(self, file: Any) -> str:
        try:
            now = os.stat(self._path)
        except FileNotFoundError:  # between the two halves of a rotation
            return ""
        if now.st_ino != _inode(file):
            return f"{self._path} was replaced: the new file is read from its beginning"
        if now.st_size < file.tell():
            return f"{self._path} was cut: it is read from its beginning"
        return ""


def _inode(file: Any) -> int:
    return os.fstat(file.fileno()).st_ino


def _same(one: Path, other: Path) -> bool:
    return one.stat().st_ino == other.stat().st_ino


def _before(path: Path, place: int) -> bytes:
    """Return at most `MARK` bytes of a file before a place."""
    with open(path, "rb") as file:
        file.seek(max(place - MARK, 0))
        return file.read(min(MARK, place))


def _hash(part: bytes) -> str:
    return hashlib.sha256(part).hexdigest()[:16]
