"""How a table is written: the words by which a user says what the table itself does not."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from optid import arrays
from optid.arrays import check_integer
from optid.errors import DataError, nearest

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})
"""Cells of missing samples, in any case and with blanks around them."""

TIME_TOLERANCE = 0.01  # a time step may deviate from the median step by this share of it

GAPS = ("missing", "experiments", "stamps")

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}
"""Seconds in a unit of time."""

_DURATION = re.compile(r"([0-9.eE+-]+)\s*([a-zµ]*)")


@dataclass(frozen=True)
class Format:
    """How a table is written; every field is also a keyword of `optid.read` and an option of the commands.

    Attributes:
        columns: names of the columns of a table that has none.
        input_units: one unit per input.
        output_units: one unit per output.
        delimiter: character between the cells of a text file; when not given the one of comma, tab, semicolon and
            blanks that cuts the first rows into equally many cells.
        decimal: decimal mark, "." or ",".
        thousands: mark between groups of three digits.
        encoding: encoding of a text file, such as "latin-1"; UTF-8, or by its byte order mark, when not given.
        comment: lines that begin with this text are skipped.
        skip_rows: lines to skip before the header.
        units_row: row after the header that holds the units, from 1; found when not given, 0 if there is none.
        missing: further words of missing samples, such as "BAD,-9999"; a number is compared by its value.
        date_format: format of the time stamps, such as "%d.%m.%Y %H:%M:%S", or what numbers count: unix, unix ms,
            excel, matlab, julian, labview, ...; ISO 8601 and the like, and usual counts, when not given.
        time_zone: zone of local time stamps without an offset, such as "Europe/Berlin"; they become UTC.
        time_tolerance: largest deviation of a time step from the median step, relative to it.
        gaps: what becomes of lost rows: "missing" samples, or "experiments" that begin after them; a row that
            is repeated counts once. With "stamps" every row keeps its stamp, however irregular, which processes in
            continuous time alone take. When not given they are refused.
        resample: sampling time onto which the record is brought, in seconds or such as "1s", "5min": inputs are held,
            outputs interpolated linearly; where samples come faster, both are averaged over a sampling time.
        quality: the value of each column of quality that marks a good sample, such as {"PV.Q": 192} or
            "OP.Q:192,PV.Q:192|216" for two such values; where it has another value, the samples of the column that it
            is named after are missing, of all columns where it is named after none.
        from_: time of the first sample: a date of a dated clock, else seconds.
        to: time of the last sample.
    """

    columns: Sequence[str] | None = None
    input_units: str | Sequence[str] | None = None
    output_units: str | Sequence[str] | None = None
    delimiter: str | None = None
    decimal: str = "."
    thousands: str | None = None
    encoding: str | None = None
    comment: str | None = None
    skip_rows: int = 0
    units_row: int | None = None
    missing: str | Sequence[str] = ()
    date_format: str | None = None
    time_zone: str | None = None
    time_tolerance: float = TIME_TOLERANCE
    gaps: str | None = None
    resample: Any = None
    quality: Any = None
    from_: Any = None
    to: Any = None

    def __post_init__(self) -> None:
        for name in ("delimiter", "decimal", "thousands", "encoding", "comment", "date_format", "time_zone", "gaps"):
            value = getattr(self, name)
            given = value is not None or name == "decimal"
            if given and (not isinstance(value, str) or not value):
                raise DataError(f"{name}={value!r}: must be a text with at least one character.")
            if any("\ud800" <= sign <= "\udfff" for sign in value or ""):
                raise DataError(f"{name}={value!r}: holds half a character.")
        for name in ("columns", "input_units", "output_units"):
            object.__setattr__(self, name, _texts(getattr(self, name), name))
        _check_marks(self)
        check_integer(self.skip_rows, "skip_rows", 0, error=DataError)
        if self.units_row is not None:
            check_integer(self.units_row, "units_row", 0, error=DataError)
        if self.comment is not None and not (isinstance(self.comment, str) and self.comment.strip()):
            raise DataError(f"comment={self.comment!r}: must be the text with which comment lines begin, such as '#'.")
        if self.encoding is not None:
            _check_encoding(self.encoding)
        tolerance = self.time_tolerance
        if not arrays.is_number(tolerance) or not 0 <= tolerance < 1:
            raise DataError(f"time_tolerance={tolerance!r}: must be a share of the sampling time of at least 0 and "
                            "below 1, such as 0.05.")
        if self.gaps is not None and self.gaps not in GAPS:
            raise DataError(f"gaps={self.gaps!r}: use one of {', '.join(GAPS)}.")
        for name, value in (("missing", _words(self.missing, "missing")), ("quality", _qualities(self.quality)),
                            ("resample", None if self.resample is None else duration(self.resample, "resample"))):
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, given: "Format | None", words: Mapping[str, Any]) -> "Format":
        """Return the format given as an object, or by its fields; `DataError` for both or an unknown word."""
        if given is not None and words:
            word = next(iter(words))
            raise DataError(f"give format= or {word}=, not both; Format({word}=...) holds it.")
        if given is not None and not isinstance(given, cls):
            raise DataError(f"format={given!r}: must be an optid.Format.")
        known = [field.name for field in fields(cls)]
        for word in words:
            if word not in known:
                raise DataError(f"there is no argument {word!r}. {nearest(word, known)}")
        return given if given is not None else cls(**words)

    def is_missing(self, cell: str) -> bool:
        """Whether a cell is a missing sample."""
        word = cell.strip().lower()
        return word in MISSING or word in self.marks

    def is_comment(self, line: str) -> bool:
        """Whether a line is a comment."""
        return self.comment is not None and line.lstrip().startswith(self.comment)

    @cached_property
    def marks(self) -> frozenset[str]:
        """The further words of missing samples, in lower case."""
        return frozenset(word.lower() for word in self.missing)

    @cached_property
    def numbers(self) -> list[float]:
        """The numbers among the words of missing samples."""
        return [float(word) for word in self.missing if is_number(word)]

    def number(self, cell: str) -> float:
        """Return the number that a cell holds, NaN if it is missing; a ValueError for any other text."""
        text = cell.strip()
        if self.is_missing(text):
            return np.nan
        if self.thousands is not None and self.thousands in text:
            mark, point = re.escape(self.thousands), re.escape(self.decimal)
            if not re.fullmatch(rf"[+-]?\d{{1,3}}(?:{mark}\d{{3}})+(?:{point}\d*)?(?:[eE][+-]?\d+)?", text):
                raise ValueError
            text = text.replace(self.thousands, "")
        if self.decimal == ",":
            if "." in text:
                raise ValueError
            text = text.replace(",", ".")
        if "_" in text:  # float() reads 1_000 as a number, a table does not
            raise ValueError
        return float(text)

    @property
    def is_plain(self) -> bool:
        """Whether float() reads the numbers of this format."""
        return self.decimal == "." and self.thousands is None


def is_number(cell: str) -> bool:
    """Whether float() reads a cell."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def duration(value: Any, name: str) -> float:
    """Return a positive duration in seconds, from a number of seconds or a text such as "5min" (`DataError`)."""
    text = str(value).strip().lower() if isinstance(value, str | int | float | np.number) else ""
    found = _DURATION.fullmatch(text)
    unit = found[2].replace("µ", "u") or "s" if found else ""
    if isinstance(value, bool) or not found or unit not in UNITS or not is_number(found[1]):
        raise DataError(f"{name}={value!r}: must be a number of seconds, or a text such as '1s', '100ms' or '5min'.")
    seconds = float(found[1]) * UNITS[unit]
    if not 0 < seconds < np.inf:
        raise DataError(f"{name}={value!r}: must be positive.")
    return seconds


def call(words: Mapping[str, Any]) -> str:
    """Return the words that a user is to type, as keywords of Python."""
    return ", ".join(f"{name}={value!r}" for name, value in words.items())


def _check_marks(how: Format) -> None:
    delimiter, decimal, thousands = how.delimiter, how.decimal, how.thousands
    if delimiter == "\\t":  # as a shell passes it
        object.__setattr__(how, "delimiter", "\t")
    elif delimiter is not None and (not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter.isalnum()
                                    or delimiter in '"\r\n+-\0'):
        raise DataError(f"delimiter={delimiter!r}: must be one character such as ',' or ';' or a tab.")
    if decimal not in (".", ","):
        raise DataError(f"decimal={decimal!r}: must be '.' or ','.")
    escaped = {"\\xa0": "\u00a0", "\\u00a0": "\u00a0", "\\u202f": "\u202f", "\\u2019": "\u2019"}
    if thousands in escaped:  # as a shell passes it
        thousands = escaped[thousands]
        object.__setattr__(how, "thousands", thousands)
    if thousands is not None and (thousands not in (",", ".", " ", "'", "\u2019", "\u00a0", "\u202f")
                                  or thousands == decimal):
        raise DataError(f"thousands={thousands!r} with decimal={decimal!r}: ',', '.', a blank or an apostrophe, and "
                        "not the decimal mark.")


def _check_encoding(name: Any) -> None:
    import codecs

    try:
        "u,y".encode(codecs.lookup(name).name)
    except (LookupError, TypeError, ValueError):
        raise DataError(f"encoding={name!r}: there is no such encoding of text; common ones are 'utf-8', 'latin-1', "
                        "'cp1252' and 'utf-16'.") from None


def _texts(given: Any, name: str) -> list[str] | None:
    """Return one text or several as a list; None stays None."""
    if given is None:
        return None
    several = [given] if isinstance(given, str) else given
    if not isinstance(several, list | tuple) or not all(isinstance(one, str) for one in several):
        raise DataError(f"{name}={given!r}: must be a list of texts.")
    return list(several)


def _words(given: Any, name: str) -> tuple[str, ...]:
    several = given if isinstance(given, list | tuple | set | frozenset) else [given] * (given is not None)
    words = []
    for word in several:
        if isinstance(word, bool) or not isinstance(word, str | int | float | np.number):
            raise DataError(f"{name}={given!r}: must be words or numbers, such as 'BAD,-9999'.")
        words += [part.strip() for part in str(word).split(",") if part.strip()]
    return tuple(words)


def _qualities(given: Any) -> dict[str, str] | None:
    """Return {column of quality: value of a good sample}."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        return {str(column): str(good) for column, good in given.items()}
    found = {}
    if not isinstance(given, str | list | tuple):
        raise DataError(f"quality={given!r}: must be a mapping such as {{'PV.Q': 192}}, or words such as 'PV.Q:192'.")
    if isinstance(given, str):
        blanks = "," not in given and all(":" in part for part in given.split())
        given = given.split() if blanks else given.split(",")
    for word in given:
        column, colon, good = str(word).rpartition(":")
        if not (column and colon and good):
            raise DataError(f"quality={word!r}: write COLUMN:VALUE with the value of a good sample, such as "
                            "'PV.Q:192'.")
        found[column.strip()] = good.strip()
    return found
