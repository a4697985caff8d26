"""Runs as they were read become experiments: joined where they continue, cut, and sampled evenly."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from optid.data.reading.clock import TimeColumn, seconds
from optid.data.reading.dates import to_utc
from optid.data.reading.format import Format
from optid.data.reading.uniform import Piece, agreed_step, regular
from optid.errors import DataError

MOST_LISTED = 3  # files of which is said that each continues the one before


@dataclass(frozen=True, eq=False)
class RawRun:
    """One experiment of one source, as it was read."""

    label: str
    names: tuple[tuple[str, ...], tuple[str, ...]]  # of inputs and outputs
    u: np.ndarray
    y: np.ndarray
    stamps: np.ndarray | None  # (N,)
    clock: TimeColumn | None
    units: Mapping[str, str]
    step: float | None  # sampling time that the source states
    findings: tuple[str, ...]

    @property
    def has_offset(self) -> bool:
        """Whether its dates have an offset from UTC."""
        return self.clock is not None and any("%z" in form for form in self.clock.forms)

    @property
    def is_dated(self) -> bool:
        """Whether its stamps are dates."""
        return self.stamps is not None and self.stamps.dtype.kind == "M"

    def part(self, rows: Any) -> "RawRun":
        """Return some of its rows."""
        return replace(self, u=self.u[rows], y=self.y[rows], stamps=None if self.stamps is None else self.stamps[rows])


def join_continued(runs: list[RawRun], how: Format) -> tuple[list[RawRun], list[str]]:
    """Join runs whose clock continues that of the run before; with `gaps` or `resample` also those behind a gap."""
    findings, joined = [], []
    if all(run.is_dated for run in runs):
        ordered = sorted(runs, key=lambda run: run.stamps[0])  # type: ignore[index]
        if any(one is not other for one, other in zip(ordered, runs)):
            findings.append("the files are taken in the order of their dates")
        runs = ordered
    found = [runs[0]]
    for run in runs[1:]:
        last = found[-1]
        if last.stamps is not None and run.stamps is not None and last.is_dated and run.is_dated and (
                run.stamps[0] <= last.stamps[-1]):
            findings.append(f"{run.label} overlaps {last.label.rpartition(' + ')[2]} in time")
        if _follows(last, run, how):
            joined.append(f"{run.label} continues {last.label.rpartition(' + ')[2]}")
            assert last.stamps is not None and run.stamps is not None
            found[-1] = replace(last, label=f"{last.label} + {run.label}", u=np.vstack([last.u, run.u]),
                                y=np.vstack([last.y, run.y]), stamps=np.concatenate([last.stamps, run.stamps]),
                                findings=tuple(dict.fromkeys([*last.findings, *run.findings])))
        else:
            found.append(run)
    if len(joined) > MOST_LISTED:
        joined = [f"{len(joined)} files continue the one before"]
    return found, findings + joined


def _follows(last: RawRun, run: RawRun, how: Format) -> bool:
    if last.stamps is None or run.stamps is None or last.stamps.dtype != run.stamps.dtype or last.stamps.size < 2:
        return False
    if last.has_offset != run.has_offset:
        return False
    border = float(seconds(run.stamps[:1] - last.stamps[-1:])[0])
    median = float(np.median(seconds(np.diff(last.stamps))))
    if how.gaps is not None or how.resample is not None:
        return border > 0
    return median > 0 and abs(border - median) <= how.time_tolerance * median


def cut_between(runs: list[RawRun], how: Format, dt: float | None) -> list[RawRun]:
    """Return the samples from the instant `from_` to the instant `to`."""
    if how.from_ is None and how.to is None:
        return runs
    kept = []
    for run in runs:
        stamps = run.stamps if run.stamps is not None else (dt or 1.0) * np.arange(len(run.u))
        inside = np.ones(len(run.u), dtype=bool)
        for name, value in (("from_", how.from_), ("to", how.to)):
            if value is not None:
                instant = _instant(value, name, stamps, run.clock)
                inside &= stamps >= instant if name == "from_" else stamps <= instant
        if inside.any():
            kept.append(run.part(inside))
    if not kept:
        stamps = runs[0].stamps
        span = "" if stamps is None else f"; {runs[0].label} has {stamps[0]} to {stamps[-1]}"
        raise DataError(f"from_={how.from_!r}, to={how.to!r}: no sample lies between{span}.")
    return kept


def _instant(value: Any, name: str, stamps: np.ndarray, clock: TimeColumn | None) -> Any:
    """Return an instant in the type of some stamps."""
    try:
        if isinstance(value, bool):
            raise ValueError
        if stamps.dtype.kind == "M":
            date = np.datetime64(value).astype("M8[ns]") if not isinstance(value, str | datetime) else None
            if date is None:
                moment = value if isinstance(value, datetime) else datetime.fromisoformat(value.strip())
                if moment.tzinfo is not None:
                    return np.datetime64(moment.astimezone(UTC).replace(tzinfo=None), "ns")
                date = np.datetime64(moment, "ns")
            if clock is not None and clock.how.time_zone is not None:
                date = to_utc(np.array([date]), clock.how.time_zone, name)[0]
            return date
        number = float(value)
        return np.timedelta64(round(number * 1e9), "ns") if stamps.dtype.kind == "m" else number
    except (ValueError, TypeError, OverflowError):
        kind = "a date such as '2024-05-01T12:00'" if stamps.dtype.kind == "M" else "a number of seconds"
        raise DataError(f"{name}={value!r}: must be {kind}, as the clock has.") from None


def sample_evenly(runs: Sequence[RawRun], how: Format, dt: float | None
                  ) -> tuple[list[Piece], float | None, list[str]]:
    """Return the uniform pieces of some runs, their sampling time and what was repaired.

    `DataError` for stamps that are not uniform, or sampling times that differ.
    """
    evenly: list[Piece] = []
    findings: list[str] = []
    step = dt
    for run in runs:
        if run.stamps is None:
            if run.step is not None:
                step = agreed_step(run.step, step, how.time_tolerance, run.label)
            if how.resample is not None or how.gaps not in (None, "stamps"):  # there are no stamps to be kept
                word = "resample" if how.resample is not None else "gaps"
                raise DataError(f"{run.label} has no time column, which {word}= needs. Name it: time=.")
            evenly.append(Piece(0.0, run.u, run.y))
            continue
        where = run.label if run.clock is None else f"{run.label}, column {run.clock.columns[0]!r}"
        pieces, found, said = regular(run.stamps, run.u, run.y, dt, how, where)
        findings += said
        if any(piece.times is not None for piece in pieces):
            evenly, step = evenly + pieces, step or found
            continue
        step = agreed_step(found, step, how.time_tolerance, run.label)
        if dt is None and found and run.step and abs(found - run.step) > how.time_tolerance * run.step:
            raise DataError(f"{run.label}: the time stamps step by {found:.6g} s, and the sampling time beside them is "
                            f"{run.step:.6g} s. Pass the right one as dt.")
        for piece in pieces:
            for part in (piece.u, piece.y):
                part.flags.writeable = False
        evenly += pieces
    return evenly, step, findings
