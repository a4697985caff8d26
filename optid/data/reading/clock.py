"""The clock of a record: which column holds it, what its numbers or texts mean, and its stamps."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta
from typing import Any

import numpy as np

from optid.data.reading import dates
from optid.data.reading.columns import column_name, listing, to_numbers
from optid.data.reading.counts import COUNTS, meaning
from optid.data.reading.format import UNITS, Format, is_number
from optid.errors import DataError

NAMES = frozenset({
    "t", "ts", "time", "timestamp", "timestamps", "datetime", "date", "dates", "clock", "utc", "timeutc", "utctime",
    "datetimeutc", "localtime", "sampletime", "elapsed", "elapsedtime", "reltime", "relativetime", "abstime",
    "absolutetime", "seconds", "sec", "secs", "epoch", "unixtime", "xvalue", "tstamp", "datetimestamp", "recordtime",
    "uptime", "runtime", "laufzeit", "secondselapsed", "mjd", "jd", "juliandate", "filetime", "ticks", "timems",
    "zeit", "zeitstempel", "datum", "uhrzeit", "datumuhrzeit", "datumzeit",
    "temps", "horodatage", "heure", "tiempo", "fecha", "fechahora", "hora", "tempo", "tijd", "tijdstip", "tid",
    "messzeit", "zeitpunkt", "čas", "czas", "aika", "idő", "zaman", "timp", "χρόνος", "время", "час", "时间", "時間",
    "時刻", "日時", "시간", "milliseconds", "millisekunden", "sekunden",
})
"""Names of columns of time, in lower case, without unit, blanks and marks."""

_STEPS = ("ts", "dt", "sampletime", "samplingtime", "sampleperiod", "samplingperiod", "timestep", "samplinginterval",
          "deltat")
_RATES = ("fs", "samplerate", "samplingrate", "samplingfrequency", "samplefrequency")
"""Names of a single number beside the samples: the sampling time, and the sampling rate."""

_UNIT_WORDS = {word: unit for unit, words in {
    "s": "s sec secs second seconds sek sekunde sekunden segundo segundos seconde secondes secondi seconden sekunder "
         "sekundy сек с 秒 초",
    "ms": "ms msec msecs millis millisecond milliseconds millisekunde millisekunden milisegundos millisecondes мс",
    "us": "us µs μs usec usecs µsec μsec microsecond microseconds", "ns": "ns nsec nanosecond nanoseconds",
    "min": "min mins minute minutes minuten minuto minutos minuti minuuten minuter minutter minuty мин 分 분",
    "h": "h hr hrs hour hours stunden horas heures ore uren timmar godziny ч",  # not hora, heure, ora: a time of day
    "d": "d day days tage días dias jours giorni dagen dagar dager dage dni дни",
    "w": "week weeks wk wks woche wochen",
}.items() for word in words.split()}

_ZONE_WORDS = ("utc", "gmt", "local", "lokal", "cet", "cest", "est", "edt", "pst", "pdt", "relative", "abs", "absolute")
_SINCE = re.compile(r"([a-zµ]+) since (.+)")
_OF_SIGNAL = re.compile(r"(.*?)[ ._]*\d+")

_DATED = re.compile(r"\d[-/:. ]\d|\d\D+\d")
FEWEST_HINTS = 5  # cells from which a column may be a clock

_BRACKETS = re.compile(r"(.*?)[ _]*[\[({<]([^\])}>]*)[\])}>]\s*")
_SUFFIX = re.compile(r"(.*?)(?:[ _.]*/[ _]*| in |[ _.,-]+)([^\W\d_]+)\.?")
_MULTIPLE = re.compile(r"[\d.,/*×^e -]*\d[\d.,/*×^e -]*([^\W\d_]+)", re.IGNORECASE)


class UnreadStamps(DataError):
    """Stamps that need words of the user; what the layout of a file proposes may take the place of the remedy."""

    def __init__(self, cause: str, remedy: str = "") -> None:
        """Keep what is wrong apart from what to do."""
        super().__init__(f"{cause} {remedy}".rstrip())
        self.cause = cause


class NoStamps(UnreadStamps):
    """A column named as a clock holds something else."""


@dataclass(frozen=True)
class TimeColumn:
    """How the stamps of a record are read from its columns."""

    columns: tuple[str, ...]  # the column, or those of the date and of the time of day
    # "numbers", "digits" (numbers that spell dates), "dates" (text), "times of day" (text) or "ready" (dates or
    # durations already)
    kind: str
    how: Format  # format of the table
    scale: float = 1.0  # seconds in a unit of numbers
    origin: float | None = None  # number of 1970-01-01; None where the numbers count from an unknown instant
    forms: tuple[str, ...] = ()  # format of each column of text
    finding: str = ""  # what was recognised and is worth saying

    def stamps(self, block: Mapping[str, Any], label: str) -> np.ndarray:
        """Return the stamps (N,) of a block: seconds as float64, or dates and durations in nanoseconds; NaN or NaT.

        `DataError` for text that is no stamp like the others, with its row.
        """
        where = f"{label}, column {self.columns[0]!r}"
        if self.forms and self.kind != "digits":
            return self._of_texts(block, label, where)
        values = np.ravel(block[self.columns[0]])
        if self.kind == "digits":
            width = len(datetime(2024, 1, 1).strftime(self.forms[0]))
            stamps = dates.parse(dates.format_digits(values, width), self.forms[0], where)[0]
            return self._in_utc(stamps, where) if dates.has_day(self.forms[0]) else stamps.view("m8[ns]")
        if self.kind == "ready":
            stamps = dates.in_nanoseconds(values, where)
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
        if values.dtype.kind in "iu" and 1e-9 <= self.scale <= 1.0 and self.origin == round(self.origin):
            return ((values.astype(np.int64) - round(self.origin)) * round(self.scale * 1e9)).view("M8[ns]")
        lost = np.isnan(values)
        bad = np.abs(np.where(lost, self.origin, values) - self.origin) * self.scale > dates.SECONDS
        if bad.any():
            row = int(np.argmax(bad))
            raise DataError(f"{where}, row {row + 1}: {values[row]:g} is outside the years 1678 to 2261.")
        nanoseconds = np.round((np.where(lost, self.origin, values) - self.origin) * (self.scale * 1e9) / 1000) * 1000
        stamps = nanoseconds.astype(np.int64).view("M8[ns]")
        stamps[lost] = np.datetime64("NaT")
        return self._in_utc(stamps, where) if self.scale == 86400.0 else stamps

    def _in_utc(self, stamps: np.ndarray, where: str) -> np.ndarray:
        return stamps if self.how.time_zone is None else dates.to_utc(stamps, self.how.time_zone, where)


def clock_hints(columns: Mapping[str, Sequence[Any]]) -> dict[str, str]:
    """Return why some columns may be a clock although they are not named as one, by their first cells."""
    found = {}
    for name, cells in columns.items():
        texts = [str(cell).strip() for cell in list(cells)[:50]]
        if len(texts) < FEWEST_HINTS or not name:
            continue
        if all(map(is_number, texts)):
            steps = np.diff([float(text) for text in texts])
            counter = steps[0] == 1 and float(texts[0]) in (0, 1)
            if steps[0] > 0 and not counter and np.ptp(steps) <= 0.01 * steps[0]:
                found[name] = f"increases evenly by {steps[0]:.6g}"
        elif _DATED.search(texts[0]) and len(set(texts)) > 1:
            found[name] = f"holds texts such as {texts[0]!r}"
    return found


def clock_values(values: Any, label: str) -> np.ndarray:
    """Return the values of a clock (N,) as numbers, dates or texts; dates of Python, with their offset, become UTC."""
    array = np.ravel(values)
    if array.dtype.kind != "O" or any(isinstance(cell, str) for cell in array.tolist()):
        return array
    found = []
    for cell in array.tolist():
        if isinstance(cell, datetime) and cell.tzinfo is not None:
            cell = cell.astimezone(UTC).replace(tzinfo=None)
        if isinstance(cell, time):
            cell = timedelta(hours=cell.hour, minutes=cell.minute, seconds=cell.second, microseconds=cell.microsecond)
        found.append(cell)
    for kind in ("M8[us]", "m8[us]", "f8"):
        try:
            if kind == "f8" or not any(isinstance(cell, int | float) for cell in found):
                return np.array(found, dtype=kind)
        except (ValueError, TypeError, OverflowError):
            continue
    raise NoStamps(f"{label}: the stamps (first: {array[0]!r}) are no numbers, dates or texts; convert them first.")


def seconds(stamps: np.ndarray) -> np.ndarray:
    """Return stamps (N,) as float64: numbers as they are, durations in seconds, dates in seconds since 1970."""
    return stamps.astype(np.int64) / 1e9 if stamps.dtype.kind in "Mm" else stamps


def over_midnight(of_day: np.ndarray) -> np.ndarray:
    """Return times of day (N,) that go on after midnight."""
    day = np.timedelta64(1, "D").astype("m8[ns]")
    back = np.diff(of_day) < -day // 2
    return of_day + np.concatenate([np.zeros(min(1, of_day.size), int), np.cumsum(back)]) * day


def is_time_name(name: str) -> bool:
    """Whether a column is named as a clock, with or without a unit."""
    return _plain(_parts(name)[0]) in NAMES or _plain(name) in NAMES


def is_rival_name(name: str, signals: Sequence[str]) -> bool:
    """Whether a column is named as another clock: "Timestamp.1", "Time (s)_2", or after a signal, "Time flow"."""
    numbered = _OF_SIGNAL.fullmatch(name)
    words = name.split()
    return bool(numbered and is_time_name(numbered[1])) or any(
        words and is_time_name(words[0]) and name == f"{words[0]} {signal}" or name == f"{signal} {words[-1]}"
        and is_time_name(words[-1]) for signal in signals if words)


def is_step_name(name: str) -> bool:
    """Whether a single number is named as a sampling time."""
    return _plain(name) in _STEPS


def is_rate_name(name: str) -> bool:
    """Whether a single number is named as a sampling rate."""
    return _plain(name) in _RATES


def clock_columns(known: Sequence[str], time: Any, taken: Sequence[str], label: str, index: str | None = None,
                  dated: Sequence[str] = ()) -> list[str]:
    """Return the columns that may hold the clock, the likeliest first; `DataError` if there is no such column.

    `time` is a column, or two of a date and a time of day; None looks for one, True requires it, False ignores it.
    `taken` are the inputs and outputs, `dated` the columns of dates; the time index need not be among the known ones.
    """
    if time is False:
        return []
    if time is not None and time is not True:
        several = time if isinstance(time, list | tuple) else [time]
        if not several or not all(isinstance(one, str | int) and not isinstance(one, bool) for one in several):
            raise DataError(f"time={time!r}: must be the name or position of a column, or two of a date and a time of "
                            "day; False ignores the clock.")
        return [one if one == index else column_name(known, one, label) for one in several]
    named = [c for c in known if c not in taken and is_time_name(c)]
    named += [c for c in known if c not in taken and c not in named and is_rival_name(c, taken)]
    named += [index] if index is not None and index not in taken and index not in named else []
    found = named + [c for c in dated if c not in taken and c not in named]
    if time and not found:
        raise DataError(f"{label} has no column t or time. {listing(known)}")
    return found


def recognise(values: Any, name: str, how: Format, label: str, unit: str = "") -> TimeColumn:
    """Return the clock that samples (N,) of a column show: numbers, dates, texts or a series of texts.

    `DataError`: neither numbers, dates nor times of day, or dates of a format that a user must name.
    """
    where = f"{label}, column {name!r}"
    head = np.ravel(values[:2000])
    if head.dtype.kind in "Mm":
        return TimeColumn((name,), "ready", how)
    if head.dtype.kind in "UO":
        cells = ["" if cell is None else str(cell) for cell in head.tolist()]
        numbers, row = to_numbers(cells, how)
        if row is not None and not dates.formats(cells[row]) and _are_numbers(cells, how) > len(cells) // 2:
            raise NoStamps(f"{where}: row {row + 1} holds {cells[row]!r}, no number like the others.",
                           "Remove the row, or pass time=False and dt=.")
        if row is not None or (how.date_format and how.date_format not in COUNTS):
            return _of_texts(cells[:200], name, how, where)
    else:
        numbers = np.ravel(values)
    if numbers.dtype.kind not in "iuf":
        raise NoStamps(f"{where}: time stamps of type {numbers.dtype} cannot be read; convert them to seconds.")
    return _of_numbers(numbers, name, how, unit, where)


def _are_numbers(cells: Sequence[str], how: Format) -> int:
    """Return how many cells are numbers."""
    return sum(to_numbers([cell], how)[1] is None for cell in cells)


def _odd_date(cells: Sequence[str]) -> str | None:
    """Return the first cell that is no date like the first one that is; None where most are no dates."""
    first = next(filter(dates.formats, cells), None)
    if first is None or 2 * sum(map(bool, map(dates.formats, cells))) <= len(cells):
        return None
    return next((cell for cell in cells if not dates.agreed_format([first, cell]) or not dates.formats(cell)), None)


def _of_texts(cells: Sequence[str], name: str, how: Format, where: str) -> TimeColumn:
    full = [cell for cell in cells if not how.is_missing(cell) and cell.strip().lower() != "nat"]
    first, given = full[0] if full else "", how.date_format
    if given and (dates.is_time_of_day(first) if dates.has_day(given) else any(
            map(dates.has_day, dates.formats(first)))):
        given = None  # it is the format of the other column of a date and a time of day
    if given is None and "mm:ss" in name.lower().replace(" ", "") and re.fullmatch(r"\d+:\d\d", first):
        given = "%M:%S"
    found = [given] if given else dates.agreed_format(full)
    if not found:
        if (odd := _odd_date(full)) is not None:
            raise NoStamps(f"{where}: row {cells.index(odd) + 1} holds {odd!r}, no date like the others.",
                           "Remove the row, or write all dates alike.")
        raise NoStamps(f"{where}: the stamps (first: {first!r}) are neither numbers nor ISO dates such as "
                       "2024-05-01T12:00:00.",
                       "Name their format (date_format='%d.%m.%Y %H:%M:%S'), convert them to seconds, or pass "
                       "time=False and dt=.")
    if not given and not dates.is_unambiguous(found[0]):
        raise UnreadStamps(f"{where}: the dates (first: {first!r}) do not begin with the year.",
                           f"Pass {dates.choices(found)}.")
    form = found[0]
    finding = f"clock {name!r}: dates with an offset, shown in UTC" if "%z" in form else ""
    if form in ("%H:%M", "%M:%S"):
        finding = f"clock {name!r}: read as {'hours:minutes' if form == '%H:%M' else 'minutes:seconds'}"
    return TimeColumn((name,), "dates" if dates.has_day(form) else "times of day", how, forms=(form,), finding=finding)


def _of_numbers(values: np.ndarray, name: str, how: Format, unit: str, where: str) -> TimeColumn:
    """Return the clock of numbers: a count of time, or dates in digits where the user says so."""
    if how.date_format and how.date_format not in COUNTS:
        return TimeColumn((name,), "digits", how, forms=(how.date_format,))
    base, word = _parts(name)
    stated = _UNIT_WORDS.get(unit.strip().lower().strip("[]()"), "")
    if word and stated and word != stated:
        raise DataError(f"{where}: its name says {word}, its unit {stated}. Correct one, or pass time=False and dt=.")
    finite = values[np.isfinite(values.astype(float))]
    if not finite.size:
        return TimeColumn((name,), "numbers", how)
    since = _SINCE.fullmatch(unit.strip().lower())
    if since and since[1] in _UNIT_WORDS:
        scale = UNITS[_UNIT_WORDS[since[1]]]
        start = dates.instant(since[2])
        if start is not None:
            return TimeColumn((name,), "numbers", how, scale, -start / scale, finding=f"clock {name!r}: {unit}")
    unknown = _unknown_unit(name)
    multiple = _MULTIPLE.fullmatch(unknown.lower())
    if multiple and multiple[1] in _UNIT_WORDS:
        raise DataError(f"{where}: its name says that it counts steps of {unknown!r}. Convert it to seconds, or pass "
                        "time=False and dt=.")
    base = "mjd" if unknown.lower() == "mjd" else _plain(base)
    found = meaning(finite, name, base, word or stated, how.date_format, where)
    finding = found.finding
    if not finding and unknown and not stated:
        finding = f"clock {name!r}: the unit {unknown!r} is not known; read as seconds"
    return TimeColumn((name,), "numbers", how, found.scale, found.origin, finding=finding)


def _unknown_unit(name: str) -> str:
    """Return what stands in brackets behind a name, unless it is a unit of time or a time zone."""
    found = _BRACKETS.fullmatch(name.strip())
    text = found[2].strip(" .") if found else ""
    return "" if text.lower() in (*_UNIT_WORDS, *_ZONE_WORDS) or "/" in text else text


def _parts(name: str) -> tuple[str, str]:
    """Return the name of a column without its unit, and the unit of time, "" if it has none that is known."""
    text = name.strip().lower()
    for pattern in (_BRACKETS, _SUFFIX):
        found = pattern.fullmatch(text)
        if found and (pattern is _BRACKETS or found[2] in _UNIT_WORDS):
            return found[1], _UNIT_WORDS.get(found[2].strip(" ."), "")
    return text, _UNIT_WORDS.get(text, "")


def _plain(name: str) -> str:
    return re.sub(r"[\s_.\-/]+", "", name.strip().lower())
