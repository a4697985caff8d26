"""Numbers and tables as text."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Table:
    """Rows of text under a heading."""

    title: str  # heading
    head: tuple[str, ...]  # one word per column
    rows: list[tuple[str, ...]]  # cells, the name of the row first
    note: str = ""  # sentence below the table


def number(value: float, digits: int = 5) -> str:
    """Write a number with so many significant digits; a dash where there is none."""
    return "-" if value is None or np.isnan(value) else f"{value:.{digits}g}"


def with_unit(name: str, unit: str) -> str:
    """Write "name (unit)", or the name alone."""
    return f"{name} ({unit})" if unit else name


def time_title(time_unit: str, counts_samples: bool = True) -> str:
    """Return the title of an axis of time; where the unit is unknown, time counts samples or has no unit."""
    return with_unit("time", time_unit) if time_unit else "sample" if counts_samples else "time"


def frequency_title(model: Any, hertz: bool = False) -> str:
    """Return the title of an axis of frequencies of a model, with their unit: radians, or Hz (cycles)."""
    counts = getattr(model, "dt", 0) == 1 and not model.time_unit
    if hertz and model.time_unit == "s":
        return "frequency (Hz)"
    word = "cycles" if hertz else "rad"
    per = f"/{model.time_unit}" if model.time_unit else "/sample" if counts else " per unit of time"
    return f"frequency ({word}{per})"


def percent(values: Any) -> str:
    """Write one or several percentages with two decimals."""
    return ", ".join("-" if np.isnan(v) else f"{v:.2f} %" for v in np.atleast_1d(values))


def gap_text(gap: float) -> str:
    """Write a relative gap; a dash where there is no bound."""
    return "-" if not np.isfinite(gap) else f"{gap:.1e}" if gap else "0"
