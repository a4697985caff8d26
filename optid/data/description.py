"""A record at a glance: its experiments, its sampling, and each channel's range, levels and missing samples."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.data.channels import MOST_LEVELS, Channel
from optid.phrases import plural

MOST_EXPERIMENTS = 10  # that are listed
MOST_FINDINGS = 6  # that stand before a verdict
RECORD = "The record"  # their heading


@dataclass(frozen=True, repr=False)
class DataDescription:
    """What `Data.describe` returns; printing it shows a table.

    Attributes:
        name: name of the data set.
        interval: sampling time with its unit.
        lengths: samples of each experiment.
        ends: time of the first and of the last sample of each experiment.
        channels: figures of each channel over all experiments, inputs first.
        findings: what reading the record derived, assumed or repaired.
    """

    name: str
    interval: str
    lengths: tuple[int, ...]
    ends: tuple[tuple[Any, Any], ...]
    channels: tuple[Channel, ...]
    findings: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.name or 'Record'}: {plural(sum(self.lengths), 'sample', '')} every {self.interval}"]
        found = [f"  {finding}" for finding in self.findings]
        if len(self.lengths) > MOST_EXPERIMENTS:
            lines.append(f"  {len(self.lengths)} experiments of {min(self.lengths)} to {max(self.lengths)} samples")
        for k, (samples, ends) in enumerate(zip(self.lengths, self.ends) if len(lines) < 2 else ()):
            label = f"experiment {k + 1}: {plural(samples, 'sample', '')} " if len(self.lengths) > 1 else ""
            lines.append(f"  {label}from {instant(ends[0])} to {instant(ends[1])}")
        lines[1:1] = found
        table = [("channel", "role", "unit", "low", "high", "mean", "std", "levels", "missing")]
        for c in self.channels:
            levels = str(c.levels) if c.levels <= MOST_LEVELS else f"over {MOST_LEVELS}"
            table.append((c.name, c.role, c.unit, *(f"{value:.4g}" for value in (c.low, c.high, c.mean, c.std)), levels,  # pyright: ignore[reportArgumentType]
                          f"{c.missing:.2%}" if c.missing else "none"))
        widths = [max(map(len, column)) for column in zip(*table)]
        for row in table:
            words = [f"{cell:<{w}}" if k < 3 else f"{cell:>{w}}" for k, (cell, w) in enumerate(zip(row, widths))]
            lines.append("  ".join(words).rstrip())
        return "\n".join(lines)

    __repr__ = __str__


def first_findings(findings: Sequence[str]) -> list[str]:
    """Return the first findings of a record, and a line that counts the others."""
    more = len(findings) - MOST_FINDINGS
    return [*findings[:MOST_FINDINGS], *([f"and {more} more, listed by print(data)"] if more > 0 else [])]


def listed_findings(findings: Sequence[str]) -> list[str]:
    """Return the first findings of a record as lines under their heading; none without findings."""
    return [RECORD, *(f"- {finding}" for finding in first_findings(findings))] if findings else []


def instant(time: Any) -> str:
    """Return a time as text: a date without trailing zeros, or a number."""
    if not isinstance(time, np.datetime64):
        return f"{time:.10g}"
    day, _, clock = str(time.astype("M8[us]")).partition("T")
    return f"{day} {clock.rstrip('0').rstrip('.') if '.' in clock else clock}"
