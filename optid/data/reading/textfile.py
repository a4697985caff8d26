"""Text files as blocks of whole lines in UTF-8, whatever their encoding, without comments and runs of blanks."""

import codecs
import re
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path

from optid.errors import DataError

BLOCK = 1 << 22  # bytes read at a time
HEAD = 1 << 16  # bytes of which the layout is derived
LONGEST_HEAD = 1 << 24  # bytes up to which the end of the first line is looked for

_MARKS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF32_LE, "utf-32-le"), (codecs.BOM_UTF32_BE, "utf-32-be"),
          (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
"""Byte order marks, the longer before the shorter."""


class TextFile:
    """A text file that is read as UTF-8.

    Attributes:
        encoding: encoding of the file.
        trusted: whether the encoding is known: given, marked, or UTF-8 as far as was read.
    """

    def __init__(self, file: FileIO, encoding: str | None) -> None:
        """Find the encoding of a file; a byte order mark counts more than what was given."""
        start = file.read(4)
        mark, name = next(((mark, name) for mark, name in _MARKS if start.startswith(mark)), (b"", encoding))
        file.seek(len(mark))
        self._file, self._start, self.trusted = file, len(mark), True
        if name is None:
            sample = file.read(HEAD)
            file.seek(self._start)
            name = _guess(sample)
            self.trusted = name == "utf-8"
        self.encoding = name
        direct = codecs.lookup(name).name in ("utf-8", "ascii")
        self._decoder = None if direct else codecs.getincrementaldecoder(name)()

    def read(self, size: int) -> bytes:
        """Return the next bytes as UTF-8; none at the end."""
        if self._decoder is None:
            return self._file.read(size)
        found = b""
        while not found:
            more = self._file.read(size)
            found = self._decoder.decode(more, not more).encode("utf-8", "surrogatepass")
            if not more:
                break
        return found

    def head(self) -> tuple[str, str]:
        """Return the first lines as text, and the encoding."""
        found, size = b"", HEAD
        while more := self.read(size):
            found, size = found + more, 2 * size
            if b"\n" in found or b"\r" in found[:-1] or len(found) > LONGEST_HEAD:
                break
        more = self.read(1)  # the last line is whole where the file ends
        ends = max(found.rfind(b"\n"), -1 if b"\n" in found else found[:-1].rfind(b"\r")) + 1
        whole = found[:ends] if more and ends else found
        return whole.decode("utf-8", "replace"), self.encoding

    def longest_line(self) -> bool:
        """Whether the file goes on after `LONGEST_HEAD` bytes without the end of a line."""
        self._file.seek(self._start)
        start = self._file.read(LONGEST_HEAD + 1)
        self._file.seek(self._start)
        return len(start) > LONGEST_HEAD and b"\n" not in start and b"\r" not in start

    def blocks(self, offset: int, most: int, mark: bytes) -> Iterator[bytes]:
        """Yield the bytes after an offset in blocks of whole lines, the last one with a line end.

        A `DataError` for a line that is longer than a block and holds more than `most` of the delimiter `mark`.
        """
        rest, size = b"", BLOCK
        if self._decoder is None:
            self._file.seek(self._start + offset)
        while self._decoder is not None and len(rest) < offset and (more := self.read(HEAD)):
            rest += more
        if self._decoder is not None:
            rest = rest[offset:]
        while more := self.read(size):
            block = rest + more
            end = block.rfind(b"\n") + 1 or block[:-1].rfind(b"\r") + 1
            if end:
                yield block[:end]
            elif block.count(mark) > most:
                raise DataError(f"{Path(str(self._file.name)).name}: a row has more than {block.count(mark)} cells. "
                                "Are there ends of lines?")
            rest = block[end:]
            size = BLOCK if end else 2 * size
        if rest.strip(b"\r\n"):
            yield rest + b"\n"


@contextmanager
def open_text(path: Path, encoding: str | None) -> Iterator[TextFile]:
    """Open a text file; text that is not of its encoding becomes a `DataError`."""
    with open(path, "rb", buffering=0) as file:
        try:
            yield TextFile(file, encoding)
        except UnicodeError as error:
            kind = encoding or getattr(error, "encoding", "UTF-8")
            raise DataError(f"{path.name} is not {kind} text ({getattr(error, 'reason', error)}): save it as UTF-8, or "
                            "pass its encoding, such as encoding='latin-1'.") from error


def clean(block: bytes, comment: str | None, blanks: bool) -> bytes:
    """Return a block of whole lines without comment lines, and with a tab in place of each run of blanks."""
    if comment is not None:
        mark = re.escape(comment.strip().encode())
        block = re.sub(rb"(?m)^[ \t]*" + mark + rb"[^\r\n]*(?:\r\n|\n|\r|\Z)", b"", block)
    if blanks:
        block = re.sub(rb"(?m)^[ \t]+|[ \t]+(?=\r?$)", b"", block)
        block = re.sub(rb"[ \t]+", b"\t", block)
    return block


def _guess(sample: bytes) -> str:
    """Return UTF-8 if a sample is; else the encoding that a user may have to name."""
    if b"\0" in sample[:1000]:
        return "utf-16-be" if sample[:1] == b"\0" else "utf-16-le"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(sample)
        return "utf-8"
    except UnicodeDecodeError:
        return "cp1252" if any(0x80 <= byte <= 0x9F for byte in sample) else "latin-1"
