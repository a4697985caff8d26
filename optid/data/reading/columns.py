"""The columns of inputs, outputs and time, and the check of time stamps."""

import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from optid.data.channels import numbered_names
from optid.data.reading.csvfile import MISSING
from optid.errors import DataError, nearest

Wanted = str | int | Sequence[str | int] | Mapping[str, str | int] | None
"""Columns by name or position; a mapping {channel name: column} renames."""

TIME_TOLERANCE = 0.01  # a time step may deviate from the median step by this share of it

TIME_NAMES = ("t", "time")

MOST_LISTED = 40  # columns that a message lists


def choose(known: Sequence[str], wanted: Wanted, letter: str, label: str) -> dict[str, str]:
    """Return {channel name: column} for the inputs (letter u) or the outputs (letter y).

    None takes the column `letter`, or `letter`1, `letter`2, ... of the known columns of the source called `label`.

    Raises:
        DataError: no such column (the nearest is named), or none of the default names is present.
    """
    what = "inputs" if letter == "u" else "outputs"
    if wanted is None:
        numbered = sorted((c for c in known if re.fullmatch(rf"{letter}[0-9]+", c)), key=lambda c: int(c[1:]))
        found = [letter] if letter in known else numbered
        if not found:
            raise DataError(f"{label} has no column {letter!r} or '{letter}1': name the {what}. {_listing(known)}")
        return {c: c for c in found}
    if isinstance(wanted, Mapping):
        pairs = {str(name): column_name(known, column, label) for name, column in wanted.items()}
    else:
        several = [wanted] if isinstance(wanted, str | int) else list(wanted)
        columns = [column_name(known, column, label) for column in several]
        pairs = {c: c for c in columns}
        if len(pairs) < len(columns):
            raise DataError(f"{label}: a column is listed twice in {what} {several}.")
        pairs = _unnamed(pairs, known, letter)
    if not pairs:
        raise DataError(f"{label}: {what} is empty; name at least one column. {_listing(known)}")
    return pairs


def column_name(known: Sequence[str], wanted: str | int, label: str) -> str:
    """Return the name of a column given by name or by position; a `DataError` names the nearest one."""
    if isinstance(wanted, int | np.integer) and not isinstance(wanted, bool):
        if not 0 <= wanted < len(known):
            raise DataError(f"{label} has {len(known)} columns, counted from 0; there is no column {wanted}.")
        return known[wanted]
    if not isinstance(wanted, str) or wanted not in known:
        single = " Is the delimiter right? Pass delimiter=';' or '\\t'." if len(known) == 1 else ""
        raise DataError(f"{label} has no column {wanted!r}. {nearest(str(wanted), known)}{single}")
    return wanted


def time_column(known: Sequence[str], time: str | int | bool | None, taken: Sequence[str], label: str,
                index: str | None = None) -> str | None:
    """Return the column of time stamps: the one named, else t, time or the index, None if there is none.

    Args:
        known: columns of the source.
        time: a column; None looks for t or time, True requires it, False ignores it.
        taken: columns of inputs and outputs.
        label: name of the source, for the message.
        index: name of a time index, which need not be among the columns.

    Raises:
        DataError: no such column.
    """
    if time is False:
        return None
    if time is not None and time is not True:
        return index if time == index else column_name(known, time, label)
    named = [c for c in known if c.lower() in TIME_NAMES and c not in taken]
    named += [index] if index is not None and index not in taken else []
    if time and not named:
        raise DataError(f"{label} has no column t or time. {_listing(known)}")
    return named[0] if named else None


def as_stamps(values: Any, label: str) -> np.ndarray:
    """Return time stamps (N,) as float64, as dates or as durations (datetime64, timedelta64, in nanoseconds).

    Numbers, numpy dates and durations, and ISO 8601 text are read, else `DataError`; blank text is a missing stamp.
    """
    array = np.asarray(values)
    if array.dtype.kind in "UO":
        array = _parsed(array.astype(str), label)
    if array.dtype.kind in "Mm":
        return array.astype(f"{array.dtype.kind}8[ns]")
    if array.dtype.kind not in "iuf":
        raise DataError(f"{label}: time stamps of type {array.dtype} cannot be read; convert them to seconds.")
    return array.astype(np.float64)


def seconds(stamps: np.ndarray) -> np.ndarray:
    """Return stamps (N,) as float64: numbers as they are, durations in seconds, dates in seconds since 1970."""
    return stamps.astype(np.int64) / 1e9 if stamps.dtype.kind in "Mm" else stamps


def uniform_step(stamps: np.ndarray, tolerance: float, label: str, step: float | None = None, first: int = 0
                 ) -> float | None:
    """Check that time stamps are uniform and return their mean step, None for a single stamp.

    Args:
        stamps: (N,), from `as_stamps`.
        tolerance: largest deviation of a step from the median step, relative to it.
        label: name of the source, for the message.
        step: what the steps are compared with; their median when not given.
        first: index of the first stamp in the whole record.

    Raises:
        DataError: a stamp is missing, time does not increase, or a step deviates; the message has the sample, the
            step found there and the median step.
    """
    here = np.isfinite(stamps)
    if not here.all():
        raise DataError(f"{label}: the time stamp of sample {first + int(np.argmin(here))} is missing.")
    if stamps.size < 2:
        return None
    # Differences of dates are exact in nanoseconds; seconds since 1970 would lose the digits of fast sampling.
    steps = seconds(np.diff(stamps))
    median = float(np.median(steps)) if step is None else step
    if median <= 0:
        raise DataError(f"{label}: time does not increase (median step {median:g}); sort the rows by time.")
    bad = np.abs(steps - median) > tolerance * median
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(f"{label}: time stamps are not uniform. Sample {first + k + 1} (t = {stamps[k + 1]}) comes "
                        f"{steps[k]:.6g} after the one before, the median step is {median:.6g} ({int(bad.sum())} "
                        f"step(s) deviate by more than {tolerance:.2%}). Insert rows with blank cells where samples "
                        "were lost, interpolate onto a uniform grid, raise time_tolerance, or pass time=False and dt= "
                        "if the stamps are wrong.")
    return float(steps.mean())


def agreed_step(found: float | None, dt: float | None, tolerance: float, label: str) -> float | None:
    """Return dt if given, else the step found, rounded to 12 digits; `DataError` if they differ."""
    if found is None:
        return dt
    if dt is None:
        return float(f"{found:.12g}")
    if abs(found - dt) > tolerance * dt:
        raise DataError(f"{label}: dt = {dt:g}, but the time stamps step by {found:.6g}. Leave dt out to use the "
                        "stamps (mind their unit), pass time=False to ignore them, or resample for the model.")
    return dt


def position_names(columns: Sequence[str] | None, width: int, label: str) -> list[str]:
    """Return the names of the columns of a plain array: those given (or a `DataError`), else their positions."""
    if columns is not None and len(columns) != width:
        raise DataError(f"{label} has {width} columns, columns= names {len(columns)}.")
    return [str(c) for c in (range(width) if columns is None else columns)]


def _parsed(text: np.ndarray, label: str) -> np.ndarray:
    missing = np.isin(np.char.lower(np.char.strip(text)), [*MISSING, "nat"])
    try:
        return np.where(missing, "nan", text).astype(np.float64)
    except ValueError:
        pass
    try:
        with warnings.catch_warnings():  # numpy warns that it converts a time zone to UTC, which is what is wanted
            warnings.simplefilter("ignore", UserWarning)
            return np.where(missing, "NaT", text).astype("datetime64[ns]")
    except ValueError:
        raise DataError(f"{label}: the stamps (first: {str(text[0])!r}) are neither numbers nor ISO dates such as "
                        "2024-05-01T12:00:00. Convert them to seconds, or pass time=False and dt=.") from None


def _unnamed(pairs: dict[str, str], known: Sequence[str], letter: str) -> dict[str, str]:
    """Name channels after their letter if the columns have only positions."""
    if any(not column.isdigit() or known[int(column)] != column for column in pairs.values()):
        return pairs
    return dict(zip(numbered_names(letter, len(pairs)), pairs.values()))


def _listing(known: Sequence[str]) -> str:
    more = f", and {len(known) - MOST_LISTED} more" if len(known) > MOST_LISTED else ""
    return "Columns: " + ", ".join(known[:MOST_LISTED]) + more + "."
