"""Rows of a CSV table that is still being written, with a message for every bad cell and row."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.data.reading import dates
from optid.data.reading.clock import TimeColumn, clock_columns, recognise, seconds
from optid.data.reading.columns import check_unique, choose, to_numbers
from optid.data.reading.format import Format, is_number
from optid.errors import DataError

LARGEST = 1e100  # larger numbers are not samples: they would overflow in later computations

DAY = 86400.0  # seconds


class Rows(NamedTuple):
    """Rows of samples."""

    values: Array  # (N, channels) samples, inputs first, NaN where missing
    m: int  # number of inputs
    lines: np.ndarray  # (N,) line of the stream, from 1; 0 for a sample that was put into a gap
    stamps: list[str]  # (N,) text of the time stamps; empty without them
    bad: list[tuple[int, str]]  # (line, message) of rows that could not be read and count as missing samples
    error: str = ""  # why the stream ends after these rows; empty if it continues
    stop: int = 0  # the line of the error
    remarks: tuple[str, ...] = ()  # on rows that count as they are

    @property
    def u(self) -> Array:
        """Inputs (N, m)."""
        return self.values[:, : self.m]

    @property
    def y(self) -> Array:
        """Outputs (N, l)."""
        return self.values[:, self.m :]

    def cut(self, first: int, last: int | None = None) -> "Rows":
        """Return rows first to last - 1."""
        part = slice(first, last)
        return self._replace(values=self.values[part], lines=self.lines[part], stamps=self.stamps[part])


class RowReader:
    """Reads the lines of a CSV table as they arrive; the first one is the header unless `columns` are given.

    Attributes:
        line: lines read.
    """

    def __init__(self, inputs: Sequence[str], outputs: Sequence[str], *, dt: float, time: str | bool | None = None,
                 how: Format | None = None, fill: int = 0, label: str = "stream") -> None:
        """Prepare for the columns of inputs and outputs, with time stamps every dt in the column `time`.

        By default that is one that is named as a clock; False ignores it. At most `fill` missing samples are put into a
        gap of whole sampling times; 0 refuses gaps. `DataError`: a word of the format needs the whole record.
        """
        how = Format() if how is None else how
        for word, instead in (("gaps", "fill_gaps"), ("resample", ""), ("quality", ""), ("from_", ""), ("to", "")):
            if getattr(how, word) is not None:
                raise DataError(f"{word}= needs the whole record, not a stream of rows"
                                + (f"; use --{instead.replace('_', '-')}." if instead else "."))
        self._wanted, self._dt, self._fill, self._label, self._how = (list(inputs), list(outputs)), dt, fill, label, how
        self._time, self._delimiter = time, how.delimiter or ","
        self._names: list[str] | None = None
        self._headed = how.columns is None
        self._reads: TimeColumn | None = None
        self.begin_file()
        if how.columns is not None:
            self._known([str(name) for name in how.columns])

    def _known(self, names: list[str]) -> None:
        check_unique(filter(None, names), self._label)
        ins, outs = (choose(names, wanted, letter, self._label) for wanted, letter in zip(self._wanted, "uy"))
        signals = [*ins.values(), *outs.values()]
        clocks = clock_columns(names, self._time, signals, self._label)
        self._names, self._places = names, [names.index(name) for name in signals]
        self._clock = [names.index(name) for name in clocks[:2]]

    @property
    def memory(self) -> dict[str, Any]:
        """The state from which to resume, in JSON types."""
        last = None if self._last is None else [self._last.dtype.str, self._last.view(np.int64).tolist()]
        clock = self._reads and [self._reads.kind, self._reads.scale, self._reads.origin, list(self._reads.forms)]
        return {
            "line": self.line, "names": self._names, "last": last, "since": self._since, "blank": list(self._blank),
            "delimiter": self._delimiter, "texts": self._texts, "clock": clock,
        }

    def resume(self, memory: Mapping[str, Any]) -> None:
        """Resume from the state `memory`."""
        self.line, self._since, self._blank = int(memory["line"]), int(memory["since"]), list(memory["blank"])
        self._delimiter, self._texts = str(memory["delimiter"]), int(memory["texts"])
        if memory["clock"] is not None:
            kind, scale, origin, forms = memory["clock"]
            self._reads = TimeColumn(("time",), kind, self._how, scale, origin, tuple(forms))
        if memory["names"] is not None:
            self._known(list(memory["names"]))
        if memory["last"] is not None:
            kind, bits = memory["last"]
            self._last = np.array(bits, dtype=np.int64).view(kind)

    def begin_file(self) -> None:
        """Expect the header of another file; its time stamps may start again."""
        if self._headed:
            self._names = None
        self.line, self._since = 0, 0  # lines read, and rows since the last stamp
        self._texts = 0  # rows of units that may follow
        self._blank: list[int] = []
        self._last: np.ndarray | None = None

    def read(self, lines: Sequence[str]) -> Rows:
        """Read complete lines, without their ends; `DataError` for a header without the required columns."""
        lines = list(lines)
        if self._names is None:
            while lines and (not lines[0].strip() or self.line < self._how.skip_rows or self._how.is_comment(lines[0])):
                del lines[0]
                self.line += 1
            if not lines:
                return Rows(np.empty((0, sum(map(len, self._wanted)))), len(self._wanted[0]), np.empty(0, int), [], [])
            head = lines[0].removeprefix("\ufeff")
            if self._how.delimiter is None:
                self._delimiter = max(",\t;", key=head.count)
            first = self._cells(head)
            if all(map(is_number, first)):
                raise DataError(f"{self._label} has no header row (it starts with {lines[0][:60]!r}): name the "
                                "columns, --columns.")
            self._known([cell.strip() for cell in first])
            del lines[0]
            self.line += 1
            self._texts = 3 if self._how.units_row is None else self._how.units_row
        rows = self._rows(lines)
        if self._clock and len(rows.lines):
            rows = self._timed(rows)
        if rows.error:
            self.line = rows.stop - 1
        return rows

    def _cells(self, line: str) -> list[str]:
        if '"' in line:
            return next(csv.reader([line], delimiter=self._delimiter), [])
        return line.split(self._delimiter)

    def _is_units(self, line: str) -> bool:
        """Whether a line after the header holds units: texts, and nothing missing or numeric."""
        cells = [cell.strip() for cell in self._cells(line) if cell.strip()]
        units = bool(cells) and self._texts > 0 and not any(
            any(sign.isdigit() for sign in cell[:1]) or is_number(cell) or self._how.is_missing(cell) for cell in cells)
        self._texts = self._texts - 1 if units else 0
        return units

    def _stamp(self, cells: Sequence[str]) -> str:
        """Return the text of the stamp of a row: one cell, or a date and a time of day."""
        if not self._clock:
            return ""
        text = cells[self._clock[0]].strip()
        if len(self._clock) > 1 and " " not in text and dates.is_date(text):
            hour = cells[self._clock[1]].strip()
            return f"{text} {hour}" if dates.is_time_of_day(hour) else text
        return text

    def _stamps(self, texts: Sequence[str]) -> np.ndarray:
        """Return stamps of texts (N,), by the clock that the first ones show."""
        block = {"time": np.array(texts, dtype=object)}
        if self._reads is None:
            assert self._names is not None
            found = recognise(block["time"], self._names[self._clock[0]], self._how, self._label)
            self._reads = replace(found, columns=("time",))
        return self._reads.stamps(block, self._label)

    def _rows(self, lines: list[str]) -> Rows:
        assert self._names is not None
        while lines and self._texts and self._is_units(lines[0]):
            del lines[0]
            self.line += 1
        first, m = self.line + 1, len(self._wanted[0])
        self.line += len(lines)
        cells = [line.split(self._delimiter) for line in lines]
        if (not self._blank and all(lines) and self._how.is_plain and not self._how.missing and not self._how.comment
                and {len(self._names)} >= set(map(len, cells))):
            try:  # all at once, where nothing is wrong
                values = np.array([[float(row[place]) for place in self._places] for row in cells])
                if not any('"' in line or "_" in line for line in lines) and not np.any(np.abs(values) > LARGEST):
                    stamps = [self._stamp(row) for row in cells] if self._clock else []
                    numbers = np.arange(first, first + len(lines))
                    return Rows(values.reshape(len(lines), len(self._places)), m, numbers, stamps, [])
            except ValueError:
                pass
        rows, numbers, stamps, bad = [], [], [], []
        for number, line in enumerate(lines, first):
            if not line.strip():
                self._blank.append(number)
                continue
            if self._how.is_comment(line):
                continue
            for blank in self._blank:  # blank lines at the end are none
                rows.append([np.nan] * len(self._places))
                numbers.append(blank)
                stamps.append("")
                bad.append((blank, f"line {blank} is blank; it counts as a missing sample."))
            self._blank = []
            row, stamp, wrong = self._row(self._cells(line))
            rows.append(row)
            numbers.append(number)
            stamps.append(stamp)
            bad += [(number, f"line {number}{what}") for what in wrong]
        values = np.array(rows, dtype=float).reshape(len(rows), len(self._places))
        return Rows(values, m, np.array(numbers, dtype=int), stamps if self._clock else [], bad)

    def _row(self, cells: list[str]) -> tuple[list[float], str, list[str]]:
        """Return the samples of a row, its stamp, and messages about bad cells."""
        assert self._names is not None
        if len(cells) != len(self._names):
            return [np.nan] * len(self._places), "", [
                f" has {len(cells)} cells, the header has {len(self._names)}; it counts as a missing sample."]
        row, wrong = [], []
        for place in self._places:
            cell = cells[place].strip()
            (value,), row_of_bad = to_numbers([cell], self._how)
            value = float(value) if row_of_bad is None and abs(value) <= LARGEST else np.nan
            if value in self._how.numbers:
                value = np.nan
            elif value != value and not self._how.is_missing(cell):
                wrong.append(f", column {self._names[place]!r} holds {cell!r}, not a number; it counts as missing.")
            row.append(value)
        return row, self._stamp(cells), wrong

    def _timed(self, rows: Rows) -> Rows:
        """Check the time stamps; fill gaps, report a clock that was set back, and cut before any other bad stamp."""
        done: list[Rows] = []
        while len(rows.lines):
            marks = np.flatnonzero([bool(stamp) for stamp in rows.stamps])
            if not marks.size:
                self._since += len(rows.lines)
                break
            try:
                read = self._stamps([rows.stamps[k] for k in marks])
            except DataError:
                read = np.full(1, np.nan)
            if not np.isfinite(read).all() or (self._last is not None and read.dtype != self._last.dtype):
                rows = self._without_odd_stamps(rows)
                continue
            steps = seconds(np.diff(np.concatenate([read[:1] if self._last is None else self._last, read])))
            if read.dtype.kind == "m":  # times of day begin again at midnight
                steps = (steps + DAY / 2) % DAY - DAY / 2
            # samples since the stamp before; rows without a stamp count
            since = np.diff(np.concatenate([[marks[0] if self._last is None else -1 - self._since], marks]))
            wrong = np.abs(steps - since * self._dt) > self._how.time_tolerance * self._dt
            if not wrong.any():
                self._last, self._since = read[-1:], len(rows.lines) - 1 - int(marks[-1])
                break
            at = int(np.argmax(wrong))
            row, extra = int(marks[at]), steps[at] / self._dt - since[at]
            lost = int(round(extra)) if abs(extra - round(extra)) <= self._how.time_tolerance else 0
            stop = int(rows.lines[row])
            where = f"line {stop}: the time stamp {rows.stamps[row]} comes {steps[at]:.6g} after the one before"
            if not (steps[at] < 0 or (self._fill and lost >= 1)):
                advice = " Pass --fill-gaps to count lost samples as missing." if lost >= 1 else ""
                rows = rows.cut(0, row)._replace(bad=[one for one in rows.bad if one[0] < stop], stop=stop, error=(
                    f"{self._label}, {where}, the sampling time of the model is {self._dt:g}. Resample the stream, or "
                    f"ignore the stamps with --time none.{advice}"))
                break
            self._last, self._since = read[at : at + 1], 0
            done.append(rows.cut(0, row))
            if steps[at] < 0:
                rows = rows._replace(remarks=(*rows.remarks, f"{where}: the clock was set back. The rows count as "
                                              "consecutive samples."))
            else:
                count = min(lost, self._fill)
                done.append(Rows(np.full((count, rows.values.shape[1]), np.nan), rows.m, np.zeros(count, int),
                                 [""] * count, []))
            done.append(rows.cut(row, row + 1))
            rows = rows.cut(row + 1)
        done.append(rows)
        return rows._replace(values=np.vstack([part.values for part in done]),
                             lines=np.concatenate([part.lines for part in done]),
                             stamps=[stamp for part in done for stamp in part.stamps])

    def _without_odd_stamps(self, rows: Rows) -> Rows:
        """Treat rows with unreadable time stamps as rows without one."""
        kind = None if self._last is None else self._last.dtype
        kept, bad = list(rows.stamps), list(rows.bad)
        for row, stamp in enumerate(rows.stamps):
            try:
                found = self._stamps([stamp]) if stamp else np.array([np.nan])
            except DataError:
                found = np.array([np.nan])
            if np.isfinite(found).all() and found.dtype == (kind or found.dtype):
                kind = found.dtype
            elif stamp:
                kept[row] = ""  # the row counts, without a time
                line = int(rows.lines[row])
                bad.append((line, f"{self._label}, line {line}: {stamp!r} is not a time stamp like those before; the "
                            "row counts as one without a stamp."))
        if kept == rows.stamps:
            raise DataError(f"{self._label}: the time stamps of lines {rows.lines[0]} to {rows.lines[-1]} do not fit "
                            "together.")
        return rows._replace(stamps=kept, bad=sorted(bad))
