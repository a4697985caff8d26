"""Rows of a table of text that is still being written, with a name for everything that is wrong with one of them."""

import csv
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.data.reading.columns import TIME_TOLERANCE, as_stamps, choose, seconds, time_column
from optid.data.reading.csvfile import MISSING
from optid.errors import DataError

LARGEST = 1e100
"""Larger numbers are no readings: what is computed from them a sample later must not overflow either."""


class Rows(NamedTuple):
    """What was read.

    Attributes:
        u: (N, m) inputs, NaN where missing.
        y: (N, l) outputs, NaN where missing.
        lines: (N,) line of the stream, from 1; 0 for a sample that was put into a gap.
        stamps: (N,) text of the time stamps; empty without them.
        bad: (line, what is wrong) of the rows that could not be read, and count as missing samples.
        error: what ends the stream after these rows; empty where it goes on.
        stop: the line that does.
    """

    u: Array
    y: Array
    lines: np.ndarray
    stamps: list[str]
    bad: list[tuple[int, str]]
    error: str = ""
    stop: int = 0


class RowReader:
    """Reads the lines of a CSV table as they come; the first one is the header unless the columns are named.

    Attributes:
        line: lines read.
    """

    def __init__(
        self, inputs: Sequence[str], outputs: Sequence[str], *, dt: float, time: str | bool | None = None,
        columns: Sequence[str] | None = None, delimiter: str = ",", decimal: str = ".", fill: int = 0,
        label: str = "stream", tolerance: float = TIME_TOLERANCE,
    ) -> None:
        """Say what is read.

        Args:
            inputs: columns of the inputs.
            outputs: columns of the outputs.
            dt: sampling time that the time stamps must have.
            time: column of time stamps; t or time when not given; False ignores it.
            columns: names of the columns of a table without a header.
            delimiter: between the cells.
            decimal: decimal mark.
            fill: largest number of missing samples that a gap of whole sampling times is filled with; 0 refuses gaps.
            label: what messages call the table.
            tolerance: largest deviation of a time step from dt, relative to it.

        Raises:
            DataError: a delimiter or decimal mark that cannot be used.
        """
        if len(delimiter) != 1 or decimal not in (".", ",") or decimal == delimiter:
            raise DataError(f"decimal = {decimal!r} with delimiter = {delimiter!r}: '.' or ',' and not the delimiter.")
        self.line = 0
        self._wanted, self._dt, self._fill, self._label, self._tolerance = (
            (list(inputs), list(outputs)), dt, fill, label, tolerance
        )
        self._time, self._delimiter, self._decimal = time, delimiter, decimal
        self._names: list[str] | None = None
        self._blank: list[int] = []
        self._last: np.ndarray | None = None
        self._since = 0
        self._headed = columns is None
        if columns is not None:
            self._known([str(name) for name in columns])

    def _known(self, names: list[str]) -> None:
        for name in names:
            if name and names.count(name) > 1:
                raise DataError(f"{self._label} has two columns named {name!r}: rename one.")
        ins, outs = (choose(names, wanted, letter, self._label) for wanted, letter in zip(self._wanted, "uy"))
        signals = [*ins.values(), *outs.values()]
        clock = time_column(names, self._time, signals, self._label)
        self._names, self._m = names, len(ins)
        self._places = [names.index(name) for name in signals]
        self._clock = None if clock is None else names.index(clock)

    @property
    def memory(self) -> dict[str, Any]:
        """What must be kept to read on later, in JSON types."""
        last = None if self._last is None else str(self._last[0])
        return {
            "line": self.line, "names": self._names, "last": last, "since": self._since, "blank": list(self._blank)
        }

    def resume(self, memory: Mapping[str, Any]) -> None:
        """Read on where `memory` was taken."""
        self.line, self._since, self._blank = int(memory["line"]), int(memory["since"]), list(memory["blank"])
        if memory["names"] is not None:
            self._known(list(memory["names"]))
        if memory["last"] is not None:
            self._last = as_stamps([memory["last"]], self._label)

    def begin_file(self) -> None:
        """Expect the header of another file; its time stamps may begin anew."""
        if self._headed:
            self._names = None
        self.line, self._blank, self._last, self._since = 0, [], None, 0

    def read(self, lines: Sequence[str]) -> Rows:
        """Read complete lines, without their ends.

        Raises:
            DataError: a header without the columns that are needed.
        """
        lines = list(lines)
        if self._names is None:
            while lines and not lines[0].strip():
                del lines[0]
                self.line += 1
            if not lines:
                return self._empty()
            first = self._cells(lines[0].removeprefix("\ufeff"))
            if all(_is_number(cell) for cell in first):
                raise DataError(
                    f"{self._label} has no header row (it starts with {lines[0][:60]!r}): name the columns, --columns."
                )
            self._known([cell.strip() for cell in first])
            del lines[0]
            self.line += 1
        return self._timed(*self._rows(lines))

    def _empty(self) -> Rows:
        widths = [len(part) for part in self._wanted]
        return Rows(np.empty((0, widths[0])), np.empty((0, widths[1])), np.empty(0, dtype=int), [], [])

    def _cells(self, line: str) -> list[str]:
        if '"' in line:
            return next(csv.reader([line], delimiter=self._delimiter), [])
        return line.split(self._delimiter)

    def _rows(self, lines: list[str]) -> tuple[Array, np.ndarray, list[str], list[tuple[int, str]]]:
        """Values (N, channels), lines, stamps and what is wrong."""
        assert self._names is not None
        first, width = self.line + 1, len(self._names)
        self.line += len(lines)
        if not self._blank and all(lines) and self._decimal == ".":
            cells = [line.split(self._delimiter) for line in lines]
            try:
                if any('"' in line or "_" in line for line in lines) or set(map(len, cells)) - {width}:
                    raise ValueError
                columns = list(zip(*cells)) or [()] * width
                values = np.array([list(map(float, columns[place])) for place in self._places]).T
                if np.any(np.abs(values) > LARGEST):
                    raise ValueError
                stamps = [] if self._clock is None else [cell.strip() for cell in columns[self._clock]]
                return values.reshape(len(lines), -1), np.arange(first, first + len(lines)), stamps, []
            except ValueError:
                pass
        rows, numbers, stamps, bad = [], [], [], []
        for number, line in enumerate(lines, first):
            if not line.strip():
                self._blank.append(number)
                continue
            for blank in self._blank:  # blank lines at the end are none
                rows.append([np.nan] * len(self._places))
                numbers.append(blank)
                stamps.append("")
                bad.append((blank, f"line {blank} is blank; it counts as a missing sample."))
            self._blank = []
            row, stamp, wrong = self._row(self._cells(line), number)
            rows.append(row)
            numbers.append(number)
            stamps.append(stamp)
            bad += wrong
        values = np.array(rows, dtype=float).reshape(len(rows), len(self._places))
        return values, np.array(numbers, dtype=int), [] if self._clock is None else stamps, bad

    def _row(self, cells: list[str], number: int) -> tuple[list[float], str, list[tuple[int, str]]]:
        assert self._names is not None
        nothing = [np.nan] * len(self._places)
        if len(cells) != len(self._names):
            return nothing, "", [(number, (
                f"line {number} has {len(cells)} cells, the header has {len(self._names)}; it counts as a missing "
                "sample."
            ))]
        row, wrong = [], []
        for place in self._places:
            cell = cells[place].strip()
            text = cell.replace(self._decimal, ".")
            value = np.nan
            if cell.lower() not in MISSING:
                if _is_number(text) and abs(float(text)) <= LARGEST:
                    value = float(text)
                else:
                    wrong.append((number, (
                        f"line {number}, column {self._names[place]!r} holds {cell!r}, not a number; it counts as "
                        "missing."
                    )))
            row.append(value)
        return row, "" if self._clock is None else cells[self._clock].strip(), wrong

    def _timed(self, values: Array, lines: np.ndarray, stamps: list[str], bad: list[tuple[int, str]]) -> Rows:
        """Check the time stamps; cut before the first that is wrong, or fill the gaps."""
        error, stop = "", 0
        if self._clock is not None and len(lines):
            values, lines, stamps, error, stop, unread = self._checked(values, lines, stamps)
            bad = sorted([*bad, *unread])
        if error:
            bad = [(line, text) for line, text in bad if line < stop]
            self.line = stop - 1
        return Rows(values[:, : self._m], values[:, self._m :], lines, stamps, bad, error, stop)

    def _checked(self, values: Array, lines: np.ndarray, stamps: list[str]) -> "_Checked":
        there = np.array([bool(stamp) for stamp in stamps])
        marks = np.flatnonzero(there)
        if not marks.size:
            self._since += len(lines)
            return _Checked(values, lines, stamps)
        try:
            read = as_stamps([stamps[k] for k in marks], f"{self._label}, time")
        except DataError:
            read = None
        if read is None or (self._last is not None and read.dtype != self._last.dtype) or not np.isfinite(read).all():
            return self._one_by_one(values, lines, stamps)
        before = read[:1] if self._last is None else self._last
        steps = seconds(np.diff(np.concatenate([before, read])))
        # samples since the stamp before; rows without a stamp count
        rows = np.diff(np.concatenate([[marks[0] if self._last is None else -1 - self._since], marks]))
        wrong = np.abs(steps - rows * self._dt) > self._tolerance * self._dt
        if not wrong.any():
            self._last, self._since = read[-1:], len(lines) - 1 - int(marks[-1])
            return _Checked(values, lines, stamps)
        at = int(np.argmax(wrong))
        row, extra = int(marks[at]), steps[at] / self._dt - rows[at]
        whole = int(round(extra))
        if self._fill and whole >= 1 and abs(extra - whole) <= self._tolerance:
            self._last, self._since = read[at : at + 1], 0
            whole = min(whole, self._fill)
            gap = np.full((whole, values.shape[1]), np.nan)
            rest = self._checked(values[row + 1 :], lines[row + 1 :], stamps[row + 1 :])
            return _Checked(
                np.vstack([values[:row], gap, values[row : row + 1], rest.values]),
                np.concatenate([lines[:row], np.zeros(whole, dtype=int), lines[row : row + 1], rest.lines]),
                [*stamps[:row], *[""] * whole, stamps[row], *rest.stamps], rest.error, rest.stop,
            )
        advice = " Pass --fill-gaps to count lost samples as missing." if whole >= 1 and abs(extra - whole) <= \
            self._tolerance and not self._fill else ""
        return _Checked(values[:row], lines[:row], stamps[:row], (
            f"{self._label}, line {lines[row]}: the time stamp {stamps[row]} comes {steps[at]:.6g} after the one "
            f"before, the sampling time of the model is {self._dt:g}. Resample the stream, or ignore the stamps with "
            f"--time none.{advice}"
        ), int(lines[row]))

    def _one_by_one(self, values: Array, lines: np.ndarray, stamps: list[str]) -> "_Checked":
        """Take rows whose time stamp cannot be read as rows without one."""
        kind = None if self._last is None else self._last.dtype
        kept, unread = list(stamps), []
        for row, stamp in enumerate(stamps):
            try:
                found = as_stamps([stamp], self._label) if stamp else None
            except DataError:
                found = np.array([np.nan])
            if found is None:
                continue
            if not np.isfinite(found).all() or (kind is not None and found.dtype != kind):
                kept[row] = ""  # the row is there, its time is not known
                unread.append((int(lines[row]), f"{self._label}, line {lines[row]}: {stamp!r} is no time stamp like "
                               "those before; the row counts as one without a stamp."))
            else:
                kind = found.dtype
        if not unread:
            raise DataError(f"{self._label}: the time stamps of lines {lines[0]} to {lines[-1]} do not fit together.")
        return self._checked(values, lines, kept)._replace(unread=tuple(unread))


class _Checked(NamedTuple):
    """Rows up to the first whose time stamp is wrong."""

    values: Array
    lines: np.ndarray
    stamps: list[str]
    error: str = ""
    stop: int = 0
    unread: tuple[tuple[int, str], ...] = ()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text
