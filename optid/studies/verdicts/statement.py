"""One sentence of a verdict, and how its numbers and names are written."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from optid.phrases import and_joined, plural
from optid.program.solution import tolerance

Key = TypeVar("Key")
Member = TypeVar("Member")

GOOD, FAIR, BAD = "good", "fair", "bad"
FINEST = tolerance(0.0) / 100  # requested accuracies below are judged as this one


@dataclass(frozen=True)
class Statement:
    """One sentence or two."""

    tone: str  # "good", "fair" or "bad"
    word: str  # the heading: what to do
    text: str  # why, with the numbers


def group(pairs: Iterable[tuple[Key, Member]]) -> dict[Key, list[Member]]:
    """Return {key: its members}, both in order of appearance."""
    found: dict[Key, list[Member]] = {}
    for key, member in pairs:
        found.setdefault(key, []).append(member)
    return found


def counting(accuracy: float) -> str:
    """State which residuals count as a requested accuracy, and below which request nothing changes."""
    most = f"verified residuals up to {tolerance(accuracy):.0e} count"
    return f"{most}; asking for less than {FINEST:.0e} changes nothing" if accuracy < FINEST else most


def of(n: int, total: int, noun: str = "problem") -> str:
    """Write "3 of 4 problems"; "all 4 problems" where nothing is missing."""
    if n == total:
        return f"the only {noun}" if total == 1 else f"all {plural(total, noun)}"
    return f"{n:,} of {plural(total, noun)}"


def there_are(n: int) -> str:
    """Write "there is 1", "there are 3"."""
    return f"there {'is' if n == 1 else 'are'} {n}"


def join_names(names: Sequence[str], most: int = 4) -> str:
    """Write names as "a, b and c", quoted if one has a comma; of many the first ones and the number of the others."""
    names = list(names)
    if any("," in name or " and " in name for name in names):
        names = [f"\u201c{name}\u201d" for name in names]
    if len(names) > most:
        return ", ".join(names[: most - 1]) + f" and {len(names) - most + 1} more"
    return and_joined(names)
