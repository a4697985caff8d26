"""What the numbers of a clock count: seconds or another unit, from an unknown instant, or from a known one as dates."""

from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple

import numpy as np

from optid.data.reading.format import UNITS
from optid.errors import DataError


class Count(NamedTuple):
    """A count of time from a known instant."""

    about: str
    scale: float  # seconds in its unit
    zero: float  # its number on 1970-01-01
    unit: str  # unit that a name may tell


COUNTS = {
    "unix": Count("seconds since 1970 (UTC)", 1.0, 0.0, "s"),
    "unix ms": Count("milliseconds since 1970 (UTC)", 1e-3, 0.0, "ms"),
    "unix us": Count("microseconds since 1970 (UTC)", 1e-6, 0.0, "us"),
    "unix ns": Count("nanoseconds since 1970 (UTC)", 1e-9, 0.0, "ns"),
    "labview": Count("seconds since 1904, as of LabVIEW", 1.0, 2082844800.0, "s"),
    "filetime": Count("100 ns since 1601, as of Windows", 1e-7, 1.16444736e17, ""),
    "ticks": Count("100 ns since year 1, as of .NET", 1e-7, 6.21355968e17, ""),
    "excel": Count("days since 1899-12-30, as of Excel", 86400.0, 25569.0, "d"),
    "matlab": Count("days since year 0, as of MATLAB", 86400.0, 719529.0, "d"),
    "julian": Count("Julian days", 86400.0, 2440587.5, "d"),
    "mjd": Count("modified Julian days", 86400.0, 40587.0, "d"),
}
"""Counts by the words that a user may give as `date_format`."""

SPAN = (9.4e8, 2.54e9)  # seconds since 1970 of the years 1999 to 2050, between which records are expected
DIGITS = {8: "%Y%m%d", 10: "%Y%m%d%H", 12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}
"""Formats of dates that are written as one number, by the count of its digits."""


@dataclass(frozen=True)
class Meaning:
    """What the numbers of a clock mean."""

    scale: float = 1.0  # seconds in their unit
    origin: float | None = None  # number of 1970-01-01; None where they count from an unknown instant
    finding: str = ""  # what is worth saying; empty where they are seconds


def meaning(values: np.ndarray, name: str, base: str, unit: str, word: str | None, where: str) -> Meaning:
    """Return what the numbers (N,) of a clock mean, by their size, their spacing and the name of the column.

    `base` is that name without its unit, in lower case; `unit` a key of `UNITS` or "", `word` a key of `COUNTS` that
    the user gave. `DataError`: numbers that are dates in digits, or whose size contradicts the unit of their name.
    """
    if word is not None:
        return Meaning(COUNTS[word].scale, COUNTS[word].zero, f"clock {name!r}: {COUNTS[word].about}")
    scale = UNITS.get(unit, 1.0)
    first, step = float(values[0]), _mean_step(values)
    if form := digit_format(values):
        raise DataError(f"{where}: the stamps (first: {first:.0f}) look like dates written as digits. Pass "
                        f"date_format={form!r}; if they are a count pass time=False and dt=.")
    if base in ("date", "datum", "fecha") and 1900 <= first <= 2100 and step == round(step):
        raise DataError(f"{where}: the stamps (first: {first:g}) look like years, which are not uniform. Pass "
                        "time=False and dt=.")
    found = [one for word, one in COUNTS.items() if SPAN[0] <= (first - one.zero) * one.scale <= SPAN[1]
             and (word != "mjd" or base == "mjd")]
    for one in found:
        if one.scale != 86400.0:
            if unit and one.unit != unit:
                raise DataError(f"{where}: by its name it is in {unit}, by its size in {one.about}. Rename the column, "
                                "or pass time=False and dt=.")
            return Meaning(one.scale, one.zero, f"clock {name!r}: {one.about}")
        serial = not is_round(step, 2) and is_round(step * 86400, 3)
        if unit in ("", "d") and (serial or unit == "d" or base in ("date", "datum", "fecha", "mjd", "jd")):
            return Meaning(one.scale, one.zero, f"clock {name!r}: {one.about}")
    if not unit and 0 <= first < 1.0 and step < 0.02 and not is_round(step, 2) and is_round(step * 86400, 3):
        return Meaning(86400.0, None, f"clock {name!r}: shares of a day, as of Excel")
    if found and not unit:
        word = next(word for word, one in COUNTS.items() if one is found[0])
        day = np.datetime64(0, "s") + round((first - found[0].zero) * found[0].scale)
        return Meaning(finding=f"clock {name!r}: read as seconds; if {first:g} means {day} pass date_format={word!r}")
    return Meaning(scale, None, f"clock {name!r}: in {unit}, read as seconds" if unit and unit != "s" else "")


def digit_format(values: np.ndarray) -> str:
    """Return the format of dates that numbers (N,) spell, "" if they spell none."""
    head = values[:50]
    if not np.array_equal(head, np.round(head)) or not 19_000_000 <= head[0] < 10**14:
        return ""
    texts = [f"{value:.0f}" for value in head.tolist()]
    form = DIGITS.get(len(texts[0]), "")
    for text in texts if form else ():
        try:
            if len(text) != len(texts[0]) or not 1970 <= datetime.strptime(text, form).year <= 2099:
                return ""
        except ValueError:
            return ""
    return form


def is_round(step: float, digits: int) -> bool:
    """Whether a step has so few digits, up to the rounding of its stamps."""
    return step > 0 and abs(float(f"{step:.{digits}g}") / step - 1) < 1e-3


def _mean_step(values: np.ndarray) -> float:
    return abs(float(values[-1]) - float(values[0])) / (values.size - 1) if values.size > 1 else 0.0
