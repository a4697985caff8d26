"""When the samples of an experiment were taken: numbers of samples, times and dates as text."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.data.description import instant
from optid.errors import DataError


@dataclass(frozen=True)
class Timeline:
    """The times of the samples of an experiment.

    Attributes:
        start: time of sample 0; seconds since 1970 (UTC) where the times are dates.
        dt: sampling time.
        unit: its unit; "" where it is unknown.
        dated: whether the times are dates.
    """

    start: float = 0.0
    dt: float = 1.0
    unit: str = ""
    dated: bool = False

    def instants(self, samples: Any) -> np.ndarray:
        """Return the times of samples (n,), as datetime64 where they are dates."""
        if not self.dated:
            return self.start + self.dt * np.asarray(samples)
        start = np.datetime64(round(self.start * 1e6), "us").astype("M8[ns]")  # seconds since 1970 hold microseconds
        return start + np.round(self.dt * np.asarray(samples) * 1e9).astype("m8[ns]")

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


def seconds_of(end: Any) -> Any:
    """Return a date as seconds since 1970; other ends of a slice as they are."""
    try:
        return float(np.asarray(end).astype("M8[us]").astype(np.int64)) / 1e6 if not np.isreal(end) else end
    except (ValueError, TypeError):
        return end
