"""What is wrong with the description of a study, collected so that everything is told at once."""

import sys
from collections.abc import Mapping, Sequence
from datetime import date
from datetime import time as clock
from typing import Any, NamedTuple, TypeVar

import numpy as np

from optid.errors import StudyError


class Label(str):
    """The name of an entry in a path, in place of its number."""


Path = tuple[str | int, ...]
"""Keys that lead to a value; positions in lists are counted from 0, entries may stand with their labels."""

T = TypeVar("T")

LARGEST = 2**62  # whole numbers from here on have no place in the database


class Problem(NamedTuple):
    """One thing that is wrong: the keys that lead to it, and what would be right."""

    path: Path
    text: str


class Problems(list[Problem]):
    """All of them, in the order in which they are found."""

    def add(self, path: Path, text: str) -> None:
        """Note one problem."""
        self.append(Problem(path, text))

    def told(self, label: str) -> None:
        """Raise what was found, what is wrong at several keys once with their number.

        Raises:
            StudyError: one line per problem.
        """
        if not self:
            return
        places: dict[str, dict[str, None]] = {}
        for problem in self:
            places.setdefault(problem.text, {})[written(problem.path)] = None
        lines = []
        for text, (first, *others) in places.items():
            where = first + (f" and {len(others)} more" if others else "")
            lines.append(f"{where}: {text}" if where else text)
        count = f"{len(lines)} problems" if len(lines) > 1 else "a problem"
        raise StudyError(f"{label} has {count}:" + "".join(f"\n  {line}" for line in lines))

    # -- values of one type ----------------------------------------------------------------------------------------

    def text(self, path: Path, value: Any) -> str | None:
        """Return a text that is not empty, or note a problem."""
        if isinstance(value, str) and value.strip():
            return value
        return self._not(path, "a text", value)

    def texts(self, path: Path, value: Any) -> tuple[str, ...]:
        """Return a text or a list of texts as a tuple, or note a problem."""
        listed = value if isinstance(value, list | tuple) else [value]
        if all(isinstance(entry, str) and entry.strip() for entry in listed):
            return tuple(listed)
        self._not(path, "a text or a list of texts", value)
        return ()

    def flag(self, path: Path, value: Any) -> bool | None:
        """Return true or false, or note a problem."""
        return value if isinstance(value, bool) else self._not(path, "true or false", value)

    def number(self, path: Path, value: Any, what: str, low: float, high: float = np.inf, *, closed: bool = False
               ) -> float | None:
        """Return a number between low and high, itself included where `closed`, or note a problem."""
        fits = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
        if fits and (low < value < high or (closed and value == low)):
            return float(value)
        return self._not(path, what, value)

    def _not(self, path: Path, what: str, value: Any) -> None:
        self.add(path, f"must be {what}; {shown(value)} is not")

    def whole(self, path: Path, value: Any, low: int) -> int | None:
        """Return a whole number from low, or note a problem."""
        if isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= low:
            return int(value) if value < LARGEST else self._not(path, "below 2**62", value)
        whole = isinstance(value, float) and value.is_integer() and value >= low
        what = "a positive integer" if low == 1 else f"an integer of at least {low}"
        self.add(path, f"must be {what}; "
                 + (f"write {value:.0f} instead of {value}" if whole else f"{shown(value)} is not"))
        return None

    def once(self, path: Path, values: Sequence[T | None]) -> tuple[T, ...]:
        """Return the values without those that were noted as problems (None); note every one that is there twice."""
        for i, value in enumerate(values):
            if value is not None and value in values[:i]:
                self.add((*path, i), f"{_last_word(path)} has {value} twice; leave one of them out")
        return tuple(value for value in values if value is not None)

    def writable(self, path: Path, value: Any) -> None:
        """Note what a study file cannot hold: it has no text from which the key of a cell could be made."""
        if isinstance(value, Mapping):
            for key, item in value.items():
                if isinstance(key, str):
                    self.writable((*path, key), item)
                else:
                    self.add(path, f"{_last_word(path)} has the key {key!r}, which is no text")
        elif isinstance(value, list):
            for i, item in enumerate(value):
                self.writable((*path, i), item)
        elif value is None:
            self.add(path, f"{_last_word(path)} is None, which a study file cannot hold: leave it out")
        elif not isinstance(value, str | int | float | date | clock):
            self.add(path, f"{_last_word(path)} is of type {type(value).__name__}, which a study file cannot hold: "
                           "give texts, numbers, true, false, dates, or lists and tables of them")


def one_or_several(value: Any) -> Sequence[Any]:
    """Return a list as it is, anything else as the only entry of one."""
    return list(value) if isinstance(value, list | tuple | range | np.ndarray) else [value]


def items(path: Path, value: Any) -> list[tuple[Path, Any]]:
    """Return the entries of a list with their paths; anything else with the path itself."""
    several = isinstance(value, list | tuple | range | np.ndarray)
    return [((*path, i) if several else path, one) for i, one in enumerate(one_or_several(value))]


def shown(value: Any) -> str:
    """Write a value as people call it."""
    if isinstance(value, str):
        return f"the text {value!r}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, int) and value.bit_length() > 200:  # Python does not even write one of 5000 digits
        return "a number of more than 60 digits"
    text = " ".join(repr(list(value) if isinstance(value, tuple) else value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def written(path: Path) -> str:
    """Write a path as in a study file: data[0].noise, formulation['relaxed'].na."""
    text = ""
    for part in path:
        if isinstance(part, int | Label):
            text += f"[{part!r}]"
        else:
            text += f".{part}" if text else part
    return text


def _last_word(path: Path) -> str:
    return next((part for part in reversed(path) if isinstance(part, str)), "")
