"""When the samples of an experiment were taken: numbers of samples, times and dates as text."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.data.description import instant


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
