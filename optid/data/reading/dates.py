"""Dates as text: which formats are unambiguous, which may be meant, and their conversion by polars."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from optid.errors import DataError

_DAY = re.compile(
    r"(?P<iso>\d{4}([-/.])\d{1,2}\2\d{1,2})|(?P<compact>\d{8})(?=[T ]\d)"
    r"|(?P<month>[A-Za-z]{3,9} \d{1,2}, ?\d{4})|(?P<name>\d{1,2}([- ])[A-Za-z]{3,9}\6(\d{4}|\d\d))"
    r"|(?P<numbers>\d{1,2}([-/.])\d{1,2}\9(\d{4}|\d\d))")
_HOUR = re.compile(r"(?P<gap>T| +|^)(?P<hour>\d{1,2}:\d\d|\d{4}(?=\d\d|\b))(?P<second>:?\d\d)?(?P<part>[.,:]\d+)?"
                   r"(?P<half> ?[AaPp][Mm])?")
_ZONE = re.compile(r" ?(?P<zone>Z|UTC|GMT|[+-]\d\d(?::?\d\d)?)")
SECONDS = 9_200_000_000  # from 1970 to the ends of what nanoseconds in 64 bits hold
_BLANK = ["", "nan", "na", "n/a", "null", "none", "nat"]
_TIME_OF_DAY = re.compile(r"\d{1,2}:\d\d(:\d\d([.,]\d+)?)?( ?[AaPp][Mm])?")


def is_date(cell: str) -> bool:
    """Whether a cell looks like a date, with or without a time of day."""
    return bool(formats(cell))


def is_time_of_day(cell: str) -> bool:
    """Whether a cell is a time of day without a date."""
    return bool(_TIME_OF_DAY.fullmatch(cell.strip()))


def formats(cell: str) -> list[str]:
    """Return the formats that a date or a time of day may have, in the notation of `strptime`; none for other text.

    Several formats mean that the order of day, month and year is ambiguous.
    """
    text = cell.strip()
    day = _DAY.match(text)
    rest = text[day.end() :] if day else text
    clock = _HOUR.match(rest)
    if clock is not None and ((day is None) == bool(clock["gap"]) or (clock["part"] and not clock["second"])
                              or (day is None and ":" not in clock["hour"])):
        clock = None
    after = "" if clock is None else _format_of_hour(clock)
    rest = rest[clock.end() :] if clock else rest
    zone = _ZONE.fullmatch(rest)
    if (day is None and clock is None) or (rest and (zone is None or clock is None or day is None)):
        return []
    after += "" if zone is None else rest[: zone.start("zone")] + "%z"
    return [one + after for one in ([""] if day is None else _formats_of_day(day))]


def is_unambiguous(form: str) -> bool:
    """Whether a format needs no word of the user: it begins with the year, names the month, or has no date."""
    return form.startswith(("%Y", "%H", "%I")) or ("%b" in form and "%Y" in form)


def parse(text: Any, form: str, label: str) -> tuple[np.ndarray, bool]:
    """Return dates (N,) as datetime64[ns] (UTC where they have an offset) and whether they have one.

    Blank text is NaT, a time of day counts from 1970-01-01. `form` is in the notation of `strptime`, `label` that of
    the column. `DataError`: an impossible format, or a text of another format, with its row.
    """
    import polars as pl

    raw = pl.Series("", text, dtype=pl.String)
    chrono, series = _as_chrono(form, raw)
    if not any(code in form for code in ("%H", "%I")):
        whole = "%M" not in form  # of minutes and seconds the hour is zero
        series = series + " 00:00" if whole else "00 " + series
        chrono = chrono + " %H:%M" if whole else "%H " + chrono
    if not has_day(form):
        series, chrono = "1970-01-01 " + series, "%Y-%m-%d " + chrono
    fraction = re.search(r"\.(\d{3}|\d{6}|\d{9})(?!\d)", str(series[0]) if len(series) else "")
    usual = chrono.replace("%.f", f".%{len(fraction[1])}f" if fraction else "")  # polars reads it four times as fast
    how: Any = {"time_unit": "ns", "strict": False, "cache": False}  # stamps hardly repeat
    try:
        found = series.str.to_datetime(usual, **how)
        if found.null_count() and usual != chrono:
            found = series.str.to_datetime(chrono, **how)
    except pl.exceptions.PolarsError as error:
        raise DataError(f"{label}: date_format={form!r} is no format of dates ({error}).") from None
    if found.null_count():
        stripped = raw.str.strip_chars()
        if (stripped != raw).any():  # blanks around dates are rare, and costly to look for
            return parse(stripped, form, label)
        bad = found.is_null() & ~raw.str.to_lowercase().fill_null("").is_in(_BLANK)
        if bad.any() and (day := re.split(r"[ T]%[HI]", form)[0]) != form:
            # at midnight many programs write the date alone
            midnights, _ = parse(raw.filter(bad), day, label)
            stamps = np.array(found.dt.timestamp("ns").fill_null(np.iinfo(np.int64).min).to_numpy())
            stamps[bad.to_numpy()] = midnights.astype(np.int64)
            return stamps.view("M8[ns]"), "%z" in form
        if bad.any():
            row = int(bad.arg_max() or 0)
            raise DataError(f"{label}, row {row + 1}: {str(raw[row])!r} is not a date of the format {form!r} of the "
                            "other rows.")
    stamps = found.dt.timestamp("ns").fill_null(np.iinfo(np.int64).min).to_numpy().view("M8[ns]")
    if len(raw) and "%Y" in form and not np.isnat(stamps[0]) and "%z" not in form and str(
            np.datetime64(stamps[0], "Y")) not in str(raw[0]):  # nanoseconds in 64 bits wrap round
        raise DataError(f"{label}, row 1: {str(raw[0])!r} is outside the years 1678 to 2261.")
    return stamps, "%z" in form


def to_utc(local: np.ndarray, zone: str, label: str) -> np.ndarray:
    """Return local dates (N,) without an offset as UTC; the hour that an end of summer time repeats by the order.

    `DataError` for an unknown zone, and for a date that a beginning of summer time skips.
    """
    import polars as pl

    series = pl.Series(local)
    try:
        first, second = (series.dt.replace_time_zone(zone, ambiguous=word, non_existent="null").dt.timestamp("ns")
                         for word in ("earliest", "latest"))
    except pl.exceptions.PolarsError:
        raise DataError(f"time_zone={zone!r}: there is no such zone; write one such as 'Europe/Berlin', "
                        "'America/New_York' or 'UTC'.") from None
    skipped = (first.is_null() & series.is_not_null()).to_numpy()
    if skipped.any():
        row = int(np.argmax(skipped))
        raise DataError(f"{label}, row {row + 1}: {local[row]} does not exist in {zone}: summer time begins there. Are "
                        "the stamps in another zone?")
    early, late = (np.array(one.to_numpy()).view("M8[ns]") for one in (first, second))
    # Of the repeated hour, what follows a step back in local time is its second half.
    back = np.flatnonzero(np.diff(local) <= np.timedelta64(0, "ns")) + 1
    doubtful = early != late
    for row in back[doubtful[back]] if back.size else []:
        stop = row + int(np.argmin(np.append(doubtful[row:], False)))
        early[row:stop] = late[row:stop]
    return early


def _formats_of_day(day: re.Match[str]) -> list[str]:
    text = day[0]
    mark = re.sub(r"[0-9A-Za-z]", "", text)[:1]
    if day["iso"]:
        return [f"%Y{mark}%m{mark}%d"]
    if day["compact"]:
        return ["%Y%m%d"]
    if day["month"]:
        return ["%b %d, %Y" if ", " in text else "%b %d,%Y"]
    first, second, year = text.split(mark)
    year = "%Y" if len(year) == 4 else "%y"
    if day["name"]:
        return [f"%d{mark}%b{mark}{year}"]
    if mark == "." or int(first) > 12:
        early = mark != "." and year == "%y" and int(second) <= 12
        return [f"%d{mark}%m{mark}{year}"] * (int(first) <= 31) + [f"%y{mark}%m{mark}%d"] * early
    found = [f"%m{mark}%d{mark}{year}"] + [f"%d{mark}%m{mark}{year}"] * (int(second) <= 12)
    return found + [f"%y{mark}%m{mark}%d"] * (year == "%y" and int(second) <= 12)


def _format_of_hour(clock: re.Match[str]) -> str:
    colon = ":" in clock["hour"]
    second = clock["second"] or ""
    part = clock["part"] or ""
    return (clock["gap"] + ("%I" if clock["half"] else "%H") + ":" * colon + "%M"
            + (":" if second.startswith(":") else "") + "%S" * bool(second) + (part[0] + "%f" if part else "")
            + (" %p" if (clock["half"] or "").startswith(" ") else "%p" * bool(clock["half"])))


def _as_chrono(form: str, series: Any) -> tuple[str, Any]:
    """Return a format in the notation of chrono, which polars reads, and the texts for it."""
    if ",%f" in form:  # chrono knows no decimal comma
        series, form = series.str.replace(r",(\d+)", ".${1}"), form.replace(",%f", ".%f")
    if ".%f" not in form and "%S" in form and "%f" not in form:  # whole seconds are often written without a fraction
        form = form.replace("%S", "%S%.f")
    elif ".%f" in form:
        form = form.replace(".%f", "%.f")
    elif "%f" in form:
        digits = max((len(one) for one in re.findall(r"\d+", str(series[0]))[-1:]), default=3)
        form = form.replace("%f", f"%{digits if digits in (3, 6, 9) else 3}f")
    if "%z" in form:
        series = series.str.replace(r" ?(Z|UTC|GMT)$", "+00:00").str.replace(r" ?([+-]\d\d)$", "${1}:00")
        series, form = series.str.replace(r" ([+-]\d\d:?\d\d)$", "${1}"), form.replace(" %z", "%z")
    return form, series


def agreed_format(cells: Sequence[str]) -> list[str]:
    """Return the formats that all of some cells may have, the likeliest first."""
    found: list[str] | None = None
    days: list[str] = []
    for cell in cells:
        these = [form.replace("%S.%f", "%S") for form in formats(cell)]  # whole seconds are read with a fraction too
        if these and not any("%H" in form or "%I" in form for form in these):
            days = these if not days else [form for form in days if form in these]
            if days:  # at midnight many programs write the date alone
                continue
        found = these if found is None else [form for form in found if form in these]
    if found is None:
        return days
    return [form for form in found if not days or re.split(r"[ T]%[HI]", form)[0] in days]


def has_day(form: str) -> bool:
    """Whether a format has a date, not only a time of day."""
    return any(code in form for code in ("%d", "%j", "%m", "%b", "%B", "%y", "%Y", "%D", "%F"))


def choices(forms: Sequence[str]) -> str:
    """Return what to type for dates that may have several formats."""
    others = ", ".join(map(repr, forms[1:]))
    return f"date_format={forms[0]!r}" + (f" (or {others} for another order of day, month and year)" if others else "")


def instant(text: str) -> float | None:
    """Return a date as seconds since 1970, UTC where it has no offset; None for other text."""
    try:
        found = datetime.fromisoformat(text.strip())
    except ValueError:
        return None
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()


def format_digits(values: np.ndarray, width: int) -> Any:
    """Return numbers (N,) as a series of texts with at least so many digits, NaN as missing."""
    import polars as pl

    lost = ~np.isfinite(values.astype(float))
    series = pl.Series(np.where(lost, 0, values).astype(np.int64)).cast(pl.String).str.zfill(width)
    return series if not lost.any() else pl.select(pl.when(pl.Series(lost)).then(None).otherwise(series)).to_series()


def in_nanoseconds(values: np.ndarray, label: str) -> np.ndarray:
    """Return dates or durations (N,) in nanoseconds; `DataError` for years that these do not hold."""
    kind = values.dtype.kind
    coarse = values.astype(f"{kind}8[s]").astype(np.int64)
    bad = (np.abs(coarse) > SECONDS) & ~np.isnat(values)
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"{label}, row {row + 1}: {values[row]} is outside the years 1678 to 2261.")
    return values.astype(f"{kind}8[ns]")
