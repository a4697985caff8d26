"""One clock from several columns that may hold it: a date and a time of day together, or rivals that must agree."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from optid.data.reading.clock import NoStamps, TimeColumn, over_midnight, recognise, seconds
from optid.data.reading.tables import RawTable, Source
from optid.data.reading.uniform import COARSE, share_of_repeats
from optid.errors import DataError

AGREEMENT = 1e-3  # share of the span by which two clocks may differ, beyond one step of the coarser one


def settle(block: Mapping[str, Any], names: Sequence[str], table: RawTable | Source, asked: bool
           ) -> tuple[TimeColumn, np.ndarray, list[str]]:
    """Return the clock that some columns, the likeliest first, hold, its stamps (N,), and findings.

    `DataError`: the only column, or one that the user named (`asked`), holds no stamps; or two clocks disagree.
    """
    clocks: list[TimeColumn] = []
    refused: dict[str, NoStamps] = {}
    for name in names:
        try:
            clocks.append(recognise(block[name], name, table.how, table.label, table.units.get(name, "")))
        except NoStamps as error:
            if asked:
                raise
            refused[name] = error
    if not clocks:
        raise next(iter(refused.values()))
    said = [f"column {name!r} holds no time stamps and is not taken as the clock" for name in refused]
    found = [(clock, clock.stamps(block, table.label)) for clock in clocks]
    found = _paired(found, block, table)
    moving = [one for one in found if one[1].size < 2 or one[1][0] != one[1][-1] or (one[1] != one[1][0]).any()]
    found = moving or found
    clock, stamps = found[0]
    for other, rival in found[1:]:
        if not _agree(stamps, rival):
            raise DataError(
                f"{table.label}: two clocks disagree: {_told(clock, stamps)}, {_told(other, rival)}. Choose one: "
                f"time={clock.columns[0]!r} or time={other.columns[0]!r}.")
    if len(found) > 1:  # of clocks that agree the one with the finer stamps, dated if both are
        clock, stamps = min(found, key=lambda one: (share_of_repeats(one[1]), one[1].dtype.kind != "M"))
    if table.how.time_zone is not None and clock.kind == "numbers" and clock.scale != 86400.0:
        raise DataError(f"{table.label}: time_zone={table.how.time_zone!r} is for local dates; the clock "
                        f"{clock.columns[0]!r} holds numbers.")
    return clock, stamps, [clock.finding] * bool(clock.finding) + said


def _paired(found: list[tuple[TimeColumn, np.ndarray]], block: Mapping[str, Any], table: RawTable | Source
            ) -> list[tuple[TimeColumn, np.ndarray]]:
    """Join a column of dates without a time of day, and one of times of day."""
    hours = [one for one in found if one[0].kind == "times of day" or (one[1].dtype.kind == "m" and (
        one[1] < np.timedelta64(1, "D")).all() and one[0].kind == "ready")]
    days = [one for one in found if hours and one[1].dtype.kind == "M"
            and not (one[1] - one[1].astype("M8[D]")).any()]
    if not days:
        return [(clock, over_midnight(stamps) if clock.kind == "times of day" else stamps) for clock, stamps in found]
    (day, dates), (hour, of_day) = days[0], hours[0]
    if day.kind == "ready":
        clock = TimeColumn((day.columns[0],), "ready", table.how)
        stamps = dates + of_day
    else:
        clock = TimeColumn((day.columns[0], hour.columns[0]), "dates", table.how, forms=(day.forms[0], hour.forms[0]))
        stamps = clock.stamps(block, table.label)
    return [(clock, stamps), *(one for one in found if one not in (days[0], hours[0]))]


def _agree(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two clocks run alike, up to one step of the coarser; two of one kind also show the same time."""
    if one.shape != other.shape or one.size < 2:
        return one.shape == other.shape
    a, b = seconds(one - one[0]), seconds(other - other[0])
    if one.dtype.kind == other.dtype.kind:
        b = b + float(seconds(np.atleast_1d(other[0] - one[0]))[0])
    coarse = max(_resolution(part) for part in (a, b))
    return bool(np.nanmax(np.abs(a - b)) <= coarse + AGREEMENT * max(abs(a[-1]), abs(b[-1])))


def _resolution(t: np.ndarray) -> float:
    """Return the resolution of stamps that rows share, or a hundredth of the usual step."""
    steps = np.abs(np.diff(t))
    return float(np.max(steps)) if share_of_repeats(t) > COARSE else 0.01 * float(np.median(steps))


def _told(clock: TimeColumn, stamps: np.ndarray) -> str:
    step = float(np.median(seconds(np.diff(stamps))))
    return f"{clock.columns[0]!r} steps by {step:.6g} s from {stamps[0]}"
