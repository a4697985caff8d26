"""When the samples of an experiment were taken: numbers of samples, times and dates as text."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import read_only
from optid.data.description import instant
from optid.errors import DataError

EVEN = 1e-6  # of a sampling time by which a time may miss a multiple of it and count as that


@dataclass(frozen=True)
class Timeline:
    """The times of the samples of an experiment."""

    start: float = 0.0  # time of sample 0; seconds since 1970 (UTC) where the times are dates
    dt: float = 1.0  # sampling time
    unit: str = ""  # its unit; "" where it is unknown
    dated: bool = False  # whether the times are dates
    stamps: np.ndarray | None = None  # (N,) times after sample 0 where these are no multiples of dt

    def instants(self, samples: Any) -> np.ndarray:
        """Return the times of samples (n,), as datetime64 where they are dates."""
        if not self.dated:
            return self.start + self.times_after_start(samples)
        start = np.datetime64(round(self.start * 1e6), "us").astype("M8[ns]")  # seconds since 1970 hold microseconds
        return start + np.round(self.times_after_start(samples) * 1e9).astype("m8[ns]")

    def times_after_start(self, samples: Any) -> np.ndarray:
        """Return the times of samples (n,) after sample 0."""
        return self.dt * np.asarray(samples, dtype=float) if self.stamps is None else self.stamps[np.asarray(samples)]

    def text(self, sample: int) -> str:
        """Return the time of a sample: a date, a number with its unit, or "" where the unit is unknown."""
        if not (self.dated or self.unit):
            return ""
        at = instant(self.instants([sample])[0])
        return at if self.dated else f"{at} {self.unit}"

    def sample_text(self, sample: int) -> str:
        """Return the number of a sample with its time in brackets, where it is known."""
        time = self.text(sample)
        return f"sample {sample} ({time})" if time else f"sample {sample}"

    def with_times(self, sentence: str) -> str:
        """Put the time beside every number of a sample in a sentence."""
        return re.sub(r"\bsample (\d+)", lambda found: self.sample_text(int(found[1])), sentence)


def starts_of(start: Any, count: int) -> tuple[np.ndarray, bool]:
    """Return the start of every experiment in seconds, and whether they are dates."""
    try:
        starts = np.atleast_1d(np.asarray(start))
        dated = starts.dtype.kind in "MUO"
        if dated:
            starts = starts.astype("M8[us]").astype(np.int64) / 1e6
        starts = starts.astype(float)
    except (ValueError, TypeError):
        starts, dated = np.array([np.nan]), False
    if starts.shape not in ((1,), (count,)) or not (np.isfinite(starts) & (np.abs(starts) < 1e15)).all():
        raise DataError(f"start = {start!r}: one finite time or date, or one for each of the {count} experiments.")
    return starts, dated


def read_times(times: Any, counts: Sequence[int], dt: float | None
               ) -> tuple[np.ndarray, bool, list[np.ndarray | None], float]:
    """Return (starts, whether they are dates, stamps of every experiment or None where regular, sampling time).

    Raises:
        DataError: other numbers than the samples, times that are not finite or do not increase, by sample.
    """
    arrays = list(times) if isinstance(times, list | tuple) and np.ndim(times[0]) else [times]
    if len(arrays) != len(counts):
        raise DataError(f"times has {len(arrays)} arrays for {len(counts)} experiments")
    starts, kinds, found = [], set[bool](), []
    for i, (given, count) in enumerate(zip(arrays, counts), start=1):
        where, t = f"experiment {i}: " * (len(counts) > 1), np.asarray(given)
        if t.shape != (count,) or not count:
            raise DataError(f"{where}times has shape {t.shape}; it must be ({count},), one for each sample")
        dated = t.dtype.kind in "MUO"
        try:
            t = t.astype("M8[ns]") if dated else t.astype(float)
        except (ValueError, TypeError):
            raise DataError(f"{where}times must be numbers of seconds or dates; the first is {t[0]!r}") from None
        lost = np.isnat(t) if dated else ~np.isfinite(t)
        if lost.any():
            raise DataError(f"{where}the time of sample {int(np.argmax(lost))} is not finite")
        later = (t - t[0]) / np.timedelta64(1, "ns") * 1e-9 if dated else t - t[0]
        steps = np.diff(later)
        if np.any(steps <= 0):
            k = int(np.argmax(steps <= 0)) + 1
            word = "runs backwards" if steps[k - 1] < 0 else "stands still"
            raise DataError(f"{where}the time {word} at sample {k} ({t[k - 1]}, then {t[k]}; "
                            f"{int(np.sum(steps <= 0))} such samples in all). Sort the record by time and drop "
                            "duplicate times")
        kinds.add(dated)
        starts.append(float(t[0].astype("M8[us]").astype(np.int64)) / 1e6 if dated else float(t[0]))
        found.append(later)
    if len(kinds) > 1:
        raise DataError("times are dates in some experiments and numbers in others; give dates in all")
    steps = np.concatenate([np.diff(one) for one in found])
    if dt is None:
        dt = float(f"{np.median(steps):.12g}") if steps.size else 1.0
    even = [bool(np.all(np.abs(one - dt * np.arange(one.size)) <= EVEN * dt)) for one in found]
    return np.array(starts), kinds.pop(), [None if regular else read_only(one) for one, regular in zip(found, even)], dt


def seconds_of(end: Any) -> Any:
    """Return a date as seconds since 1970; other ends of a slice as they are."""
    try:
        return float(np.asarray(end).astype("M8[us]").astype(np.int64)) / 1e6 if not np.isreal(end) else end
    except (ValueError, TypeError):
        return end
