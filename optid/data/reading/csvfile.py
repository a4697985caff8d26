"""Text tables: polars reads them in blocks, the csv module reads a block that polars refuses.

Polars fills short rows without an error and does not report the row of a bad cell. So the rows of each block must have
as many cells as the header, and a block that polars refuses is read by the csv module, which accepts quotes, blanks
around cells and any spelling of a missing sample, and names the row and the column of a bad cell.
"""

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from optid.data.reading.columns import cell_error, to_numbers
from optid.data.reading.format import Format
from optid.data.reading.layout import BLANKS, TextLayout, find_layout
from optid.data.reading.textfile import clean, open_text
from optid.errors import DataError

NULLS = ["NA", "N/A", "null", "NULL", "None", "nan", "NaN", "NAN"]
"""Common spellings of missing samples, which polars reads at full speed."""

SMALL = 1 << 18  # bytes up to which the csv module reads a file in less time than polars needs to be imported
ROWS = 65536  # rows that the csv module converts at a time
LONG_LINE, LONG_CELL = 1 << 16, 64  # bytes of a line, and of each of its cells, beyond which polars is not asked
SPARE = 1000  # cells beyond twice those of the header with which a row is not even cut

Columns = dict[str, Any]
"""{column: (n,) samples}, or its texts as objects or as a series of polars."""


@dataclass(frozen=True)
class CsvFile:
    """A text table whose columns have names."""

    path: Path  # the file
    layout: TextLayout  # where its samples are

    @property
    def names(self) -> list[str]:
        """One name per column."""
        return self.layout.names

    def columns(self, wanted: Sequence[str], texts: Mapping[str, str]) -> Columns:
        """Return whole columns as float64, NaN for missing samples; those in `texts` may be texts.

        `texts` says of a column whether it is a "clock", which is read as numbers where it is numeric, or a "text".

        Raises:
            DataError: no rows, a cell that is not a number, a row of another width, a blank row inside the table, or
                text of another encoding.
        """
        whole = list(self._blocks(wanted, texts))
        if not whole:
            raise DataError(f"{self.path.name} has a header but no rows.")
        return _joined(whole, wanted)

    def blocks(self, rows: int, wanted: Sequence[str], texts: Mapping[str, str]) -> Iterator[Columns]:
        """Yield columns `rows` rows at a time; arguments and errors as of `columns`."""
        kept: list[Columns] = []
        count = 0
        for block in self._blocks(wanted, texts):
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

    @property
    def _how(self) -> Format:
        return self.layout.how

    def _blocks(self, wanted: Sequence[str], texts: Mapping[str, str]) -> Iterator[Columns]:
        done, mark, how = 0, self.layout.delimiter, self._how
        with open_text(self.path, how.encoding) as file:
            blocks = file.blocks(self.layout.offset, 2 * len(self.names) + SPARE, mark.encode())
            cleaned = (clean(block, how.comment, how.delimiter == BLANKS) for block in blocks)
            if self.path.stat().st_size > SMALL and mark.isascii() and how.thousands is None:
                as_text = {name for name, kind in texts.items() if kind == "text" or name in self.layout.dates}
                attempts: list[tuple[Set[str], list[str]]] = [
                    (as_text, []), (as_text, NULLS), *([(set(texts), [])] if as_text != set(texts) else [])]
                for block in cleaned:
                    if not _is_plain(block) or not self._has_short_lines(block):
                        cleaned = chain([block], cleaned)
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
                            cleaned = chain([block], cleaned)
                            break
                        found = self._exact(io.StringIO(block.decode(), newline=""), wanted, set(texts), done)
                    for columns in found:
                        done += len(columns[wanted[0]])
                        yield columns
            lines = chain.from_iterable(io.StringIO(_text(block, self.path.name), newline="") for block in cleaned)
            yield from self._exact(lines, wanted, set(texts), done)

    def _parsed(self, block: bytes, wanted: Sequence[str], as_text: Set[str], nulls: list[str]) -> Columns | None:
        """Return the columns of a block without quotes, None if polars refuses a cell or a row has a wrong width.

        Columns `as_text` are not converted; cells in `nulls`, and the words of the format, are missing samples.
        """
        import polars as pl

        places = [self._places[name] for name in wanted]
        comma = self._how.decimal == ","
        schema: dict[str, Any] = dict.fromkeys(map(str, range(len(self.names))), pl.String if comma else pl.Float64)
        schema |= {str(self._places[name]): pl.String for name in as_text}
        nulls = [*nulls, *self._how.missing]
        try:
            table = pl.read_csv(block, has_header=False, columns=sorted(set(places)), schema=schema, quote_char=None,
                                separator=self.layout.delimiter, null_values=nulls or None)
        except pl.exceptions.PolarsError:
            return None
        # Polars refuses long rows where it reads all columns, and fills short ones, the last cell at least, with nulls.
        if (table.width < len(self.names) or table[:, -1].null_count()) and not self._has_even_rows(block):
            return None
        series = [table[str(place)] for place in places]
        try:
            series = [column if name in as_text or not comma else _with_points(column)
                      for name, column in zip(wanted, series)]
        except pl.exceptions.PolarsError:
            return None
        return {name: column if name in as_text else column.to_numpy() for name, column in zip(wanted, series)}

    def _has_short_lines(self, block: bytes) -> bool:
        """Whether no line is far longer than the header makes likely: a single long row costs polars much memory."""
        longest = LONG_LINE + LONG_CELL * len(self.names)
        return all(block.find(b"\n", k, k + longest) >= 0 for k in range(0, len(block) - longest, longest))

    def _has_even_rows(self, block: bytes) -> bool:
        signs = np.frombuffer(block, np.uint8)
        ends = signs == ord("\n")
        marks = ends[np.flatnonzero(ends | (signs == ord(self.layout.delimiter)))]  # whether a separator ends a row
        width = len(self.names)
        return width > 1 and marks.size % width == 0 and bool(
            marks[width - 1 :: width].all() and np.count_nonzero(marks) == marks.size // width)

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: place for place, name in enumerate(self.names)}

    def _exact(self, lines: Iterable[str], wanted: Sequence[str], as_is: Set[str], done: int) -> Iterator[Columns]:
        """Read rows by the csv module, `done` rows after the header."""
        pick = itemgetter(*(self._places[name] for name in wanted))
        reader = csv.reader(self._of_usual_width(lines), delimiter=self.layout.delimiter)
        try:
            while block := list(islice(reader, ROWS)):
                if set(map(len, block)) != {len(self.names)}:
                    block = self._without_tail(block, reader, done)
                cells = list(zip(*map(pick, block))) if len(wanted) > 1 else [tuple(map(pick, block))]
                if block:
                    yield {name: np.array(column, dtype=object) if name in as_is else
                           self._numbers(column, name, done, cells) for name, column in zip(wanted, cells)}
                done += len(block)
        except csv.Error as error:
            raise DataError(f"{self.path.name}: not a text table after row {done} ({error}).") from error

    def _of_usual_width(self, lines: Iterable[str]) -> Iterator[str]:
        """Yield lines; refuse one with far more cells than the header before each becomes an object."""
        mark, most = self.layout.delimiter, 2 * len(self.names) + SPARE
        for line in lines:
            if line.count(mark) > most and (count := re.sub(r'"[^"]*"', "", line).count(mark)) > most:
                raise DataError(f"{self.path.name}: the row that begins with {line[:30]!r} has {count + 1} cells, the "
                                f"header has {len(self.names)}.")
            yield line

    def _numbers(self, cells: Sequence[str], column: str, first: int, around: Sequence[Sequence[str]]) -> np.ndarray:
        values, row = to_numbers(cells, self._how)
        if row is not None:
            number = first + row + 1 + self.layout.text_rows
            raise cell_error(f"{self.path.name}: column {column!r}, row {number} after the header", cells[row],
                             self._how, around, self.layout.advice, [column[row] for column in around])
        return values

    def _without_tail(self, block: list[list[str]], reader: Any, done: int) -> list[list[str]]:
        """Accept blank lines at the end of the file; refuse any other row of the wrong width."""
        bad = next(k for k, row in enumerate(block) if len(row) != len(self.names))
        if not any(block[bad:]) and not any(reader):
            return block[:bad]
        found = f"has {len(block[bad])} cells" if block[bad] else "is blank"
        words = f" If the table is written otherwise pass {self.layout.advice}." if self.layout.advice else ""
        number = done + bad + 1 + self.layout.text_rows
        raise DataError(f"{self.path.name}: row {number} after the header {found}, the header has {len(self.names)}. "
                        f"Repair the row; where samples are missing keep the row and leave its cells blank.{words}")


def open_csv(path: Path, how: Format) -> CsvFile:
    """Find the layout of a text table; errors as of `find_layout`."""
    if path.suffix.lower() == ".tsv" and not how.delimiter:
        how = replace(how, delimiter="\t")
    return CsvFile(path, find_layout(path, how))


def _with_points(column: Any) -> Any:
    """Return the numbers of texts with decimal commas; a point is no decimal mark there, and polars refuses it."""
    import polars as pl

    pointed = column.str.replace_all(".", "x", literal=True).str.replace(",", ".", literal=True)
    return pl.select(pl.when(pointed == "").then(None).otherwise(pointed).cast(pl.Float64)).to_series()


def _joined(blocks: list[Columns], wanted: Sequence[str]) -> Columns:
    """Join blocks, each column freed as soon as it is copied."""
    joined = {}
    for name in dict.fromkeys(wanted):
        parts = [block.pop(name) for block in blocks]
        if all(isinstance(part, np.ndarray) for part in parts):
            joined[name] = np.concatenate(parts)
        else:
            import polars as pl

            joined[name] = pl.concat([pl.Series("", part, dtype=pl.String, strict=False) for part in parts])
    return joined


def _text(block: bytes, label: str) -> str:
    try:
        return block.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{label} is not UTF-8 text: save it as CSV UTF-8, or pass its encoding, such as "
                        f"encoding='latin-1'. ({error})") from error


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
