"""Comma separated files: polars reads them in blocks, the csv module reads a block that polars refuses.

Polars fills short rows without an error and does not report the row of a bad cell. So the rows of each block must have
as many cells as the header, and a block that polars refuses is read by the csv module, which accepts quotes, blanks
around cells and any spelling of a missing sample, and names the row and the column of a bad cell.
"""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from optid.errors import DataError

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})
"""Cells of missing samples, in any case and with blanks around them."""

NULLS = ["NA", "N/A", "null", "NULL", "None", "nan", "NaN", "NAN"]
"""Common spellings of `MISSING`, which polars reads at full speed."""

SMALL = 1 << 18  # bytes up to which the csv module reads a file in less time than polars needs to be imported
BLOCK = 1 << 22  # bytes read at a time
ROWS = 65536  # rows that the csv module converts at a time

Columns = dict[str, np.ndarray]
"""{column: (n,) samples}, or its text."""


@dataclass(frozen=True)
class CsvFile:
    """A CSV file whose columns have names."""

    path: Path  # the file
    names: list[str]  # one name per column
    offset: int  # bytes before the first row of samples
    delimiter: str  # character between cells
    decimal: str  # decimal mark, "." or ","

    def columns(self, wanted: Sequence[str], clock: str | None, group: str | None) -> Columns:
        """Return whole columns as float64, NaN for missing samples.

        A clock that is not numeric, and the column of the experiments (`group`), are returned as text.

        Raises:
            DataError: no rows, a cell that is not a number, a row of another width, a blank row inside the table, or
                text that is not UTF-8.
        """
        whole = list(self._blocks(wanted, clock, group))
        if not whole:
            raise DataError(f"{self.path.name} has a header but no rows.")
        return _joined(whole, wanted)

    def blocks(self, rows: int, wanted: Sequence[str], clock: str | None) -> Iterator[Columns]:
        """Yield columns `rows` rows at a time; arguments and errors as of `columns`."""
        kept: list[Columns] = []
        count = 0
        for block in self._blocks(wanted, clock, None):
            kept.append(block)
            count += len(block[wanted[0]])
            if count >= rows:
                whole, full = _joined(kept, wanted), count - count % rows
                for first in range(0, full, rows):
                    yield {name: column[first : first + rows] for name, column in whole.items()}
                count -= full
                kept = [{name: column[full:] for name, column in whole.items()}]
        if count:
            yield _joined(kept, wanted)

    def _blocks(self, wanted: Sequence[str], clock: str | None, group: str | None) -> Iterator[Columns]:
        done = 0
        text = {name for name in (clock, group) if name is not None}
        attempts = [(text - {clock}, [])]
        if group is None:
            attempts.append((set(), NULLS))
        if clock is not None:
            attempts.append((text, []))
        with open(self.path, "rb", buffering=0) as file:
            file.seek(self.offset)
            if self.path.stat().st_size > SMALL and self.delimiter.isascii():
                for start, block in _whole_lines(file, self.offset):
                    if not _is_plain(block):
                        file.seek(start)
                        break
                    found: Iterable[Columns] = []
                    for attempt in list(attempts):
                        if table := self._parsed(block, wanted, *attempt):
                            found = [table]
                            attempts.remove(attempt)
                            attempts.insert(0, attempt)  # the next block will be like this one
                            break
                    else:
                        if not self._has_even_rows(block):
                            file.seek(start)
                            break
                        found = self._exact(io.StringIO(block.decode(), newline=""), wanted, text, done)
                    for columns in found:
                        done += len(columns[wanted[0]])
                        yield columns
            with io.TextIOWrapper(io.BufferedReader(file), "utf-8", newline="") as lines:
                yield from self._exact(lines, wanted, text, done)

    def _parsed(self, block: bytes, wanted: Sequence[str], as_text: Set[str], nulls: list[str]) -> Columns | None:
        """Return the columns of a block without quotes, None if polars refuses a cell or a row has a wrong width.

        Columns `as_text` are not converted; cells in `nulls` are missing samples.
        """
        import polars as pl

        places = [self._places[name] for name in wanted]
        schema = dict.fromkeys(map(str, range(len(self.names))), pl.Float64)
        schema |= {str(self._places[name]): pl.String for name in as_text}
        try:
            table = pl.read_csv(block, has_header=False, columns=sorted(set(places)), schema=schema, quote_char=None,
                                separator=self.delimiter, decimal_comma=self.decimal == ",", null_values=nulls or None)
        except pl.exceptions.PolarsError:
            return None
        # Polars refuses long rows where it reads all columns, and fills short ones, the last cell at least, with nulls.
        if (table.width < len(self.names) or table[:, -1].null_count()) and not self._has_even_rows(block):
            return None
        series = [table[str(place)] for place in places]
        return {name: column.fill_null("").to_numpy() if name in as_text else column.to_numpy()
                for name, column in zip(wanted, series)}

    def _has_even_rows(self, block: bytes) -> bool:
        signs = np.frombuffer(block, np.uint8)
        ends = signs == ord("\n")
        marks = ends[np.flatnonzero(ends | (signs == ord(self.delimiter)))]  # whether each separator ends a row
        width = len(self.names)
        return width > 1 and marks.size % width == 0 and bool(
            marks[width - 1 :: width].all() and np.count_nonzero(marks) == marks.size // width)

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: place for place, name in enumerate(self.names)}

    def _exact(self, lines: Iterable[str], wanted: Sequence[str], as_is: Set[str], done: int) -> Iterator[Columns]:
        """Read rows by the csv module, `done` rows after the header."""
        pick = itemgetter(*(self._places[name] for name in wanted))
        reader = csv.reader(lines, delimiter=self.delimiter)
        try:
            while block := list(islice(reader, ROWS)):
                if set(map(len, block)) != {len(self.names)}:
                    block = self._without_tail(block, reader, done)
                cells = list(zip(*map(pick, block))) if len(wanted) > 1 else [tuple(map(pick, block))]
                if block:
                    yield {name: np.array(column, dtype=object) if name in as_is else self._numbers(column, name, done)
                           for name, column in zip(wanted, cells)}
                done += len(block)
        except (UnicodeDecodeError, csv.Error) as error:
            raise DataError(f"{self.path.name}: not a text table after row {done} ({error}).") from error

    def _numbers(self, cells: Sequence[str], column: str, first: int) -> np.ndarray:
        text = cells if self.decimal == "." else [cell.replace(self.decimal, ".") for cell in cells]
        try:
            if "_" in "".join(text):  # float() reads 1_000 as a number, a table does not
                raise ValueError
            return np.array(list(map(float, text)), dtype=np.float64)
        except ValueError:
            pass
        for row, cell in enumerate(text, first + 1):
            if not is_missing(cell) and ("_" in cell or not is_number(cell)):
                comma = ' For decimal commas pass decimal=","' if "," in cell else ""
                raise DataError(f"{self.path.name}: column {column!r}, row {row} after the header holds {cell!r}, not "
                                f"a number. Leave the cell blank where a sample is missing.{comma}") from None
        return np.array([np.nan if is_missing(cell) else float(cell) for cell in text], dtype=np.float64)

    def _without_tail(self, block: list[list[str]], reader: Any, done: int) -> list[list[str]]:
        """Accept blank lines at the end of the file; refuse any other row of the wrong width."""
        bad = next(k for k, row in enumerate(block) if len(row) != len(self.names))
        if not any(block[bad:]) and not any(reader):
            return block[:bad]
        found = f"has {len(block[bad])} cells" if block[bad] else "is blank"
        raise DataError(f"{self.path.name}: row {done + bad + 1} after the header {found}, the header has "
                        f"{len(self.names)}. Repair the row; where samples are missing keep the row and leave its "
                        "cells blank.")


def open_csv(path: Path, columns: Sequence[str] | None, delimiter: str, decimal: str) -> CsvFile:
    """Read the header of a CSV file; `columns` are the names where it has none.

    Raises:
        DataError: empty file, no header, two columns of one name, not UTF-8, a delimiter that cannot be one.
    """
    check_marks(delimiter, decimal)
    with open(path, "rb") as file:
        start = 3 if file.read(3) == b"\xef\xbb\xbf" else 0
        file.seek(start)
        line = file.readline()
        while line.count(b'"') % 2 and (more := file.readline()):  # a line end inside a quoted name
            line += more
    if b'"' not in line and b"\r" in line.rstrip(b"\r\n"):  # lines that end with a carriage return alone
        line = line[: line.index(b"\r") + 1]
    try:
        rows = csv.reader(io.StringIO(line.decode(), newline=""), delimiter=delimiter)
        first = next(rows, None)
        following = next(rows, None)
    except UnicodeDecodeError as error:
        raise DataError(f"{path.name} is not UTF-8 text: save it as CSV UTF-8. ({error})") from error
    except csv.Error as error:
        raise DataError(f"{path.name} is not a text table ({error}).") from error
    if not first:
        raise DataError(f"{path.name} is empty: it must have a header row and at least one row of numbers.")
    if following is not None:
        raise DataError(f"{path.name} has quoted names and carriage returns as line ends: save it with line feeds.")
    if columns is None and all(is_number(cell) for cell in first):
        raise DataError(f"{path.name} has no header row (it starts with {first[:20]}): name the columns, "
                        "columns=[...].")
    names = [str(cell).strip() for cell in (first if columns is None else columns)]
    if len(names) != len(first):
        raise DataError(f"{path.name} has {len(first)} columns, columns= names {len(names)}.")
    for name, count in Counter(names).items():
        if name and count > 1:
            raise DataError(f"{path.name} has two columns named {name!r}: rename one.")
    return CsvFile(path, names, start + len(line) if columns is None else start, delimiter, decimal)


def check_marks(delimiter: Any, decimal: Any) -> None:
    """Refuse an invalid delimiter or decimal mark (`DataError`)."""
    if not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter.isalnum() or delimiter in '"\r\n+-\0':
        raise DataError(f"delimiter = {delimiter!r}: must be one character such as ',' or ';' or a tab.")
    if decimal not in (".", ",") or decimal == delimiter:
        raise DataError(f"decimal = {decimal!r} with delimiter = {delimiter!r}: '.' or ',' and not the delimiter.")


def _joined(blocks: list[Columns], wanted: Sequence[str]) -> Columns:
    """Join blocks, each column freed as soon as it is copied."""
    return {name: np.concatenate([block.pop(name) for block in blocks]) for name in dict.fromkeys(wanted)}


def _whole_lines(file: BinaryIO | io.RawIOBase, start: int) -> Iterator[tuple[int, bytes]]:
    """Yield (position, bytes) of blocks of whole lines."""
    rest, size = b"", BLOCK
    while more := file.read(size):
        block = rest + more
        end = block.rfind(b"\n") + 1
        if end:
            yield start, block[:end]
        start, rest = start + end, block[end:]
        size = BLOCK if end else 2 * size  # a line longer than a block
    if rest.strip(b"\r\n"):
        yield start, rest + b"\n"


def _is_plain(block: bytes) -> bool:
    """Whether the block has one kind of line ends, no quotes and only UTF-8."""
    if b'"' in block or b"\0" in block or (b"\r" in block and block.count(b"\r") != block.count(b"\r\n")):
        return False
    if not block.isascii():
        try:
            block.decode()
        except UnicodeDecodeError:
            return False
    return True


def is_number(cell: str) -> bool:
    """Whether float() reads a cell."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def is_missing(cell: str) -> bool:
    """Whether a cell is a missing sample."""
    return cell.strip().lower() in MISSING
