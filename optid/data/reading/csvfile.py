"""Comma separated files in blocks, through the csv module: quoting is right and every bad cell can be named."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import DataError

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})
"""Cells that mean a missing sample, in any case and with blanks around them."""


@dataclass(frozen=True)
class CsvFile:
    """A CSV file whose columns have names.

    Attributes:
        path: the file.
        names: one name per column.
        header: whether the first row holds the names.
        delimiter: character between cells.
        decimal: decimal mark, "." or ",".
    """

    path: Path
    names: list[str]
    header: bool
    delimiter: str
    decimal: str

    def blocks(self, wanted: Sequence[str], rows: int) -> Iterator[dict[str, tuple[str, ...]]]:
        """Yield the cells of the wanted columns, at most `rows` rows at a time.

        Raises:
            DataError: a row of another width, a blank row inside the table, or text that is not UTF-8.
        """
        pick = itemgetter(*(self.names.index(name) for name in wanted))
        done = 0
        with open(self.path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, delimiter=self.delimiter)
            try:
                if self.header:
                    next(reader)
                while block := list(islice(reader, rows)):
                    if set(map(len, block)) != {len(self.names)}:
                        block = self._without_tail(block, reader, done)
                    done += len(block)
                    cells = list(zip(*map(pick, block))) if len(wanted) > 1 else [tuple(map(pick, block))]
                    if block:
                        yield dict(zip(wanted, cells))
            except (UnicodeDecodeError, csv.Error) as error:
                raise DataError(f"{self.path.name}: not a text table after row {done} ({error}).") from error

    def numbers(self, cells: Sequence[str], column: str, first: int) -> np.ndarray:
        """Return the cells of one column as (n,) float64, NaN where the cell says missing.

        Args:
            cells: the text of the cells.
            column: name of the column, for the message.
            first: number of rows before these cells.

        Raises:
            DataError: a cell that is not a number, named by column and row.
        """
        text = cells if self.decimal == "." else [cell.replace(self.decimal, ".") for cell in cells]
        try:
            if "_" in "".join(text):  # float() reads 1_000 as a number, a table does not
                raise ValueError
            return np.array(list(map(float, text)), dtype=np.float64)
        except ValueError:
            return np.array([self._number(cell, column, first + k) for k, cell in enumerate(text)], dtype=np.float64)

    def _number(self, cell: str, column: str, row: int) -> float:
        if cell.strip().lower() in MISSING:
            return np.nan
        try:
            if "_" in cell:
                raise ValueError
            return float(cell)
        except ValueError:
            comma = ' For decimal commas pass decimal=","' if "," in cell else ""
            raise DataError(
                f"{self.path.name}: column {column!r}, row {row + 1} after the header holds {cell!r}, not a number. "
                f"Leave the cell blank where a sample is missing.{comma}"
            ) from None

    def _without_tail(self, block: list[list[str]], reader: Any, done: int) -> list[list[str]]:
        """Accept blank lines at the end of the file; refuse any other row of the wrong width."""
        bad = next(k for k, row in enumerate(block) if len(row) != len(self.names))
        if not any(block[bad:]) and not any(reader):
            return block[:bad]
        found = f"has {len(block[bad])} cells" if block[bad] else "is blank"
        raise DataError(
            f"{self.path.name}: row {done + bad + 1} after the header {found}, the header has {len(self.names)}. "
            "Repair the row; where samples are missing keep the row and leave its cells blank."
        )


def open_csv(path: Path, columns: Sequence[str] | None, delimiter: str, decimal: str) -> CsvFile:
    """Read the header of a CSV file.

    Args:
        path: the file.
        columns: names of the columns when the file has no header row.
        delimiter: character between cells.
        decimal: decimal mark.

    Raises:
        DataError: empty file, no header, two columns of one name, not UTF-8.
    """
    if decimal not in (".", ",") or decimal == delimiter:
        raise DataError(f"decimal = {decimal!r} with delimiter = {delimiter!r}: '.' or ',' and not the delimiter.")
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            first = next(csv.reader(file, delimiter=delimiter), None)
    except UnicodeDecodeError as error:
        raise DataError(f"{path.name} is not UTF-8 text: save it as CSV UTF-8. ({error})") from error
    if not first:
        raise DataError(f"{path.name} is empty: a header row and at least one row of numbers are needed.")
    if columns is None and all(_is_number(cell) for cell in first):
        raise DataError(f"{path.name} has no header row (it starts with {first}): name the columns, columns=[...].")
    names = [cell.strip() for cell in (first if columns is None else columns)]
    if len(names) != len(first):
        raise DataError(f"{path.name} has {len(first)} columns, columns= names {len(names)}.")
    for name in names:
        if name and names.count(name) > 1:
            raise DataError(f"{path.name} has two columns named {name!r}: rename one.")
    return CsvFile(path, names, columns is None, delimiter, decimal)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
