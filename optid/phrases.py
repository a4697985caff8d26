"""Counts and p values in words, the same in every message, table and page."""

import math
from collections.abc import Sequence

SMALLEST = 1e-16
"""Smallest p value that is printed; the figures below are rounding errors of the tail."""


def plural(n: int, noun: str, mark: str = ",") -> str:
    """Write "1 problem", "3,000 problems", with a mark between groups of digits or none ("")."""
    return f"{n:{mark}} {noun}{'' if n == 1 else 's'}"


def p_value(p: float, digits: int = 2, missing: str = "-") -> str:
    """Write the number of a table: "0.03", "< 1e-16"; `missing` for NaN."""
    return missing if math.isnan(p) else f"< {SMALLEST:g}" if p < SMALLEST else f"{p:.{digits}g}"


def p_equals(p: float, digits: int = 2) -> str:
    """Write "p = 0.03", or "p < 1e-16"."""
    return f"p {p_value(p, digits)}" if p < SMALLEST else f"p = {p_value(p, digits)}"


def seconds(value: float) -> str:
    """Write a time in the unit that suits it; a dash where there is none."""
    return "-" if math.isnan(value) else f"{1e3 * value:.3g} ms" if value < 0.9995 else f"{value:.3g} s"


def and_joined(words: Sequence[str]) -> str:
    """Write "a, b and c"."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def short(text: str, most: int = 120) -> str:
    """Cut a text to so many characters, the last of them an ellipsis."""
    return text if len(text) <= most else text[: most - 1] + "…"


def unit_ratio(above: str, below: str) -> str:
    """Write the unit of a ratio; that of newtons and amperes in words, since N/A reads as not available."""
    return "N per A" if (above, below) == ("N", "A") else f"{above or 1}/{below}" if below else above
