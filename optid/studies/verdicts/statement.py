"""One sentence of a verdict, and how its numbers are written."""

from dataclasses import dataclass

from optid.program.solution import tolerance

GOOD, FAIR, BAD = "good", "fair", "bad"
FINEST = tolerance(0.0) / 100  # requested accuracies below are judged as this one


@dataclass(frozen=True)
class Statement:
    """One sentence or two.

    Attributes:
        tone: "good", "fair" or "bad".
        word: the heading: what to do.
        text: why, with the numbers.
        about: "solver", "formulation", "data sets", "claims".
    """

    tone: str
    word: str
    text: str
    about: str


def plural(n: int, noun: str) -> str:
    """Write "1 problem", "3 problems"."""
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def counting(accuracy: float) -> str:
    """Say which residuals count as a requested accuracy reached, and that a stricter request changes nothing below."""
    most = f"verified residuals up to {tolerance(accuracy):.0e} count"
    return f"{most}; asking for less than {FINEST:.0e} changes nothing" if accuracy < FINEST else most


def of(n: int, total: int, noun: str = "problem") -> str:
    """Write "3 of 4 problems"; "all 4 problems" where nothing is missing."""
    if n == total:
        return f"the only {noun}" if total == 1 else f"all {plural(total, noun)}"
    return f"{n:,} of {plural(total, noun)}"
