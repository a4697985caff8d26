"""The clock of a record: which column holds it, what its numbers or texts mean, and its stamps."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.data.reading import dates
from optid.data.reading.columns import column_name, listing, to_numbers
from optid.data.reading.format import UNITS, Format, call
from optid.errors import DataError

NAMES = frozenset({
    "t", "ts", "time", "timestamp", "timestamps", "datetime", "date", "dates", "clock", "utc", "timeutc", "utctime",
    "datetimeutc", "localtime", "sampletime", "elapsed", "elapsedtime", "reltime", "relativetime", "abstime",
    "absolutetime", "seconds", "sec", "secs", "epoch", "unixtime", "xvalue",
    "zeit", "zeitstempel", "datum", "uhrzeit", "datumuhrzeit", "datumzeit",
    "temps", "horodatage", "heure", "tiempo", "fecha", "fechahora", "hora", "tempo", "tijd", "tijdstip", "tid",
})
"""Names of columns of time, in lower case, without unit, blanks and marks."""

_STEPS = ("ts", "dt", "sampletime", "samplingtime", "sampleperiod", "samplingperiod", "timestep", "samplinginterval",
          "deltat")
_RATES = ("fs", "samplerate", "samplingrate", "samplingfrequency", "samplefrequency")
"""Names of a single number beside the samples: the sampling time, and the sampling rate."""

_UNIT_WORDS = {"s": "s", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sek": "s", "sekunden": "s",
               "ms": "ms", "msec": "ms", "millis": "ms", "milliseconds": "ms", "us": "us", "µs": "us", "μs": "us",
               "usec": "us", "microseconds": "us", "ns": "ns", "nanoseconds": "ns", "min": "min", "mins": "min",
               "minutes": "min", "minuten": "min", "h": "h", "hr": "h", "hrs": "h", "hour": "h", "hours": "h",
               "stunden": "h", "d": "d", "day": "d", "days": "d", "tage": "d"}

_BRACKETS = re.compile(r"(.*?)[ _]*[\[({<]([^\])}>]*)[\])}>]\s*")
_SUFFIX = re.compile(r"(.*?)(?:[ _.]*/[ _]*| in |[ _.])([a-zµμ]+)")

_EPOCH = (9.4e8, 4.2e9)  # seconds since 1970 of the years 1999 to 2103
_SERIAL = {"days since 1899-12-30, as of Excel": 25569.0, "days since year 0, as of MATLAB": 719529.0}
"""Numbers of 1970-01-01 in counts of days."""
_SERIAL_SPAN = (10957.0, 47482.0)  # days since 1970 of the years 2000 to 2100


class NoStamps(DataError):
    """A column named as a clock holds something else."""


@dataclass(frozen=True)
class Clock:
    """How the stamps of a record are read from its columns.

    Attributes:
        columns: the column, or those of the date and of the time of day.
        kind: "numbers", "dates" (text), "times of day" (text) or "ready" (dates or durations already).
        scale: seconds in a unit of numbers.
        origin: number of 1970-01-01; None where the numbers count from an unknown instant.
        forms: format of each column of text.
        how: format of the table.
        finding: what was recognised and is worth saying.
    """

    columns: tuple[str, ...]
    kind: str
    how: Format
    scale: float = 1.0
    origin: float | None = None
    forms: tuple[str, ...] = ()
    finding: str = ""

    def stamps(self, block: Mapping[str, Any], label: str) -> np.ndarray:
        """Return the stamps (N,) of a block: seconds as float64, or dates and durations in nanoseconds; NaN or NaT.

        `DataError` for text that is no stamp like the others, with its row.
        """
        where = f"{label}, column {self.columns[0]!r}"
        if self.forms:
            return self._of_texts(block, label, where)
        values = np.ravel(block[self.columns[0]])
        if self.kind == "ready":
            stamps = values.astype(f"{values.dtype.kind}8[ns]")
            return self._in_utc(stamps, where) if values.dtype.kind == "M" else stamps
        return self._of_numbers(values, where)

    def _of_texts(self, block: Mapping[str, Any], label: str, where: str) -> np.ndarray:
        stamps, has_offset = dates.parse(block[self.columns[0]], self.forms[0], where)
        if len(self.columns) > 1:
            of_day, more = dates.parse(block[self.columns[1]], self.forms[1], f"{label}, column {self.columns[1]!r}")
            stamps, has_offset = stamps + of_day.view("m8[ns]"), has_offset or more
        if self.kind == "times of day":
            return stamps.view("m8[ns]")  # times of day are read as of 1970-01-01
        return stamps if has_offset else self._in_utc(stamps, where)

    def _of_numbers(self, values: np.ndarray, where: str) -> np.ndarray:
        if values.dtype.kind in "UO":
            values, row = to_numbers(["" if cell is None else str(cell) for cell in values.tolist()], self.how)
            if row is not None:
                raise DataError(f"{where}: the stamp of row {row + 1} is no number, those before are.")
        if values.dtype.kind not in "iuf":
            raise DataError(f"{where}: time stamps of type {values.dtype} cannot be read; convert them to seconds.")
        if self.origin is None:
            return values.astype(np.float64) if self.scale == 1.0 else values * self.scale
        if values.dtype.kind in "iu" and self.scale <= 1.0:
            return (values.astype(np.int64) * round(self.scale * 1e9)).view("M8[ns]")
        lost = np.isnan(values)
        nanoseconds = np.round((np.where(lost, self.origin, values) - self.origin) * (self.scale * 1e9) / 1000) * 1000
        stamps = nanoseconds.astype(np.int64).view("M8[ns]")
        stamps[lost] = np.datetime64("NaT")
        return stamps

    def _in_utc(self, stamps: np.ndarray, where: str) -> np.ndarray:
        return stamps if self.how.time_zone is None else dates.to_utc(stamps, self.how.time_zone, where)


def seconds(stamps: np.ndarray) -> np.ndarray:
    """Return stamps (N,) as float64: numbers as they are, durations in seconds, dates in seconds since 1970."""
    return stamps.astype(np.int64) / 1e9 if stamps.dtype.kind in "Mm" else stamps


def is_time_name(name: str) -> bool:
    """Whether a column is named as a clock, with or without a unit."""
    return _plain(_parts(name)[0]) in NAMES or _plain(name) in NAMES


def is_step_name(name: str) -> bool:
    """Whether a single number is named as a sampling time."""
    return _plain(name) in _STEPS


def is_rate_name(name: str) -> bool:
    """Whether a single number is named as a sampling rate."""
    return _plain(name) in _RATES


def clock_columns(known: Sequence[str], time: Any, taken: Sequence[str], label: str, index: str | None = None,
                  dated: Sequence[str] = ()) -> list[str]:
    """Return the columns that may hold the clock, the likeliest first.

    Args:
        known: columns of the source.
        time: a column, or two of a date and a time of day; None looks for one, True requires it, False ignores it.
        taken: columns of inputs and outputs.
        label: name of the source, for the message.
        index: name of a time index, which need not be among the columns.
        dated: columns that hold dates.

    Raises:
        DataError: no such column.
    """
    if time is False:
        return []
    if time is not None and time is not True:
        several = time if isinstance(time, list | tuple) else [time]
        return [one if one == index else column_name(known, one, label) for one in several]
    named = [c for c in known if c not in taken and is_time_name(c)]
    named += [index] if index is not None and index not in taken and index not in named else []
    free = [c for c in dated if c not in taken]
    found = named or free
    if time and not found:
        raise DataError(f"{label} has no column t or time. {listing(known)}")
    return found


def recognise(block: Mapping[str, Any], columns: Sequence[str], how: Format, label: str, unit: str = "") -> Clock:
    """Return the clock that some samples of one column show, or of a date and a time of day.

    Args:
        block: samples of the columns.
        columns: the column, or two.
        how: format of the table.
        label: name of the source, for messages.
        unit: unit of the column, where the source tells it.

    Raises:
        DataError: neither numbers, dates nor times of day, or dates of a format that a user must name.
    """
    name = columns[0]
    where = f"{label}, column {name!r}"
    head = np.ravel(block[name][:2000])
    if head.dtype.kind in "Mm":
        return Clock((name,), "ready", how)
    if head.dtype.kind in "UO":
        values, row = to_numbers(head.astype(str).tolist(), how)
        if row is not None:
            return _of_texts(block, columns, how, label)
    else:
        values = np.ravel(block[name])
    if values.dtype.kind not in "iuf":
        raise NoStamps(f"{where}: time stamps of type {values.dtype} cannot be read; convert them to seconds.")
    return _of_numbers(values, name, how, unit)


def _of_texts(block: Mapping[str, Any], columns: Sequence[str], how: Format, label: str) -> Clock:
    forms = []
    for name in columns:
        cells = np.ravel(block[name][:200]).astype(str)
        full = [cell for cell in cells.tolist() if not how.is_missing(cell) and cell.strip().lower() != "nat"]
        found = [how.date_format] if how.date_format and not dates.is_time_of_day(full[0] if full else "") else \
            dates.agreed_format(full)
        where = f"{label}, column {name!r}"
        if not found:
            first = full[0] if full else ""
            odd = next((cell for cell in full if dates.formats(first) and not dates.formats(cell)), None)
            what = f"(first: {first!r})" if odd is None else f"(first: {first!r}; then {odd!r})"
            raise NoStamps(f"{where}: the stamps {what} are neither numbers nor ISO dates such as "
                           "2024-05-01T12:00:00. Name their format (date_format='%d.%m.%Y %H:%M:%S'), convert them to "
                           "seconds, or pass time=False and dt=.")
        if not how.date_format and not dates.is_unambiguous(found[0]):
            other = f" (or {found[1]!r} where the day comes first)" if len(found) > 1 else ""
            raise DataError(f"{where}: the dates (first: {full[0]!r}) do not begin with the year. Pass "
                            f"{call({'date_format': found[0]})}{other}.")
        forms.append(found[0])
    dated = any("%d" in form or "%j" in form for form in forms)
    finding = f"clock {columns[0]!r}: dates with an offset, shown in UTC" if "%z" in forms[0] else ""
    return Clock(tuple(columns), "dates" if dated else "times of day", how, forms=tuple(forms), finding=finding)


def _of_numbers(values: np.ndarray, name: str, how: Format, unit: str) -> Clock:
    """Return the clock of numbers: seconds or the unit that is named, since 1970, or days as of Excel and MATLAB."""
    base, word = _parts(name)
    word = word or _UNIT_WORDS.get(unit.strip().lower().strip("[]()"), "")
    clock = Clock((name,), "numbers", how, UNITS.get(word, 1.0))
    finite = values[np.isfinite(values.astype(float))]
    if not finite.size:
        return clock
    first, step = float(finite[0]), _mean_step(finite)
    for one in (word,) if word else ("s", "ms", "us", "ns"):
        if _EPOCH[0] <= first * UNITS[one] <= _EPOCH[1] and (one != "s" or _is_round(step, 2) or step < 1):
            called = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}.get(one, one)
            return replace(clock, scale=UNITS[one], origin=0.0, finding=f"clock {name!r}: {called} since 1970 (UTC)")
    for called, zero in {} if word not in ("", "d") else _SERIAL.items():
        days = first - zero
        serial = not _is_round(step, 2) and _is_round(step * 86400, 3)
        if _SERIAL_SPAN[0] <= days <= _SERIAL_SPAN[1] and (serial or _plain(base) in ("date", "datum", "fecha")):
            return replace(clock, scale=86400.0, origin=zero, finding=f"clock {name!r}: {called}")
    if word and word != "s":
        return replace(clock, finding=f"clock {name!r}: in {word}, read as seconds")
    return clock


def _mean_step(values: np.ndarray) -> float:
    return abs(float(values[-1]) - float(values[0])) / (values.size - 1) if values.size > 1 else 0.0


def _is_round(step: float, digits: int) -> bool:
    """Whether a step has so few digits, up to the rounding of its stamps."""
    return step > 0 and abs(float(f"{step:.{digits}g}") / step - 1) < 1e-3


def _parts(name: str) -> tuple[str, str]:
    """Return the name of a column without its unit, and the unit of time, "" if it has none that is known."""
    text = name.strip().lower()
    for pattern in (_BRACKETS, _SUFFIX):
        found = pattern.fullmatch(text)
        if found and (pattern is _BRACKETS or found[2] in _UNIT_WORDS):
            return found[1], _UNIT_WORDS.get(found[2].strip(), "")
    return text, "s" if text in ("seconds", "sec", "secs") else ""


def _plain(name: str) -> str:
    return re.sub(r"[\s_.\-/]+", "", name.strip().lower())

