"""Problems in the description of a study, collected so that all are reported together."""

import sys
from collections.abc import Callable, Mapping
from datetime import date
from datetime import time as clock
from typing import Any, TypeVar

import numpy as np

from optid.errors import StudyError, nearest


class Label(str):
    """The name of an entry in a path, in place of its number."""


Path = tuple[str | int, ...]
"""Keys that lead to a value; positions in lists are counted from 0, a label may replace the position of an entry."""

T = TypeVar("T")

LARGEST = 2**62  # limit of integers in the database


class Problems(list[tuple[Path, str]]):
    """All problems in the order in which they are found: the keys that lead to each, and its description."""

    def concern(self, key: str) -> bool:
        """Whether there is a problem below a key at the top."""
        return any(path[:1] == (key,) for path, _ in self)

    def told(self, label: str) -> None:
        """Raise a `StudyError` with one line per problem, if there are any; repeated problems count as one."""
        if not self:
            return
        places: dict[str, dict[str, None]] = {}
        for path, text in self:
            places.setdefault(text, {})[_written(path)] = None
        lines = []
        for text, (first, *others) in places.items():
            where = first + (f" and {len(others)} more" if others else "")
            lines.append(f"{where}: {text}" if where else text)
        count = f"{len(lines)} problems" if len(lines) > 1 else "a problem"
        raise StudyError(f"{label} has {count}:" + "".join(f"\n  {line}" for line in lines))


class Place:
    """A value of the description with its keys and checks; a check that fails notes a problem."""

    def __init__(self, value: Any, problems: Problems, path: Path = ()) -> None:
        self.value, self.problems, self.path = value, problems, path

    def __getitem__(self, key: str | int) -> "Place":
        return Place(self.value[key], self.problems, (*self.path, key))

    def __contains__(self, key: str) -> bool:
        return key in self.value

    @property
    def name(self) -> str:
        """The last key that is a word."""
        return next((part for part in reversed(self.path) if isinstance(part, str)), "")

    def note(self, text: str, *keys: str | int) -> None:
        """Note a problem, here or at keys below."""
        self.problems.append(((*self.path, *keys), text))

    def take(self, key: str, check: "Callable[[Place], T]", default: Any = None) -> T:
        """Return what a check makes of the value at a key, or the default where there is none."""
        return check(self[key]) if key in self else default

    def items(self) -> "list[Place]":
        """Return the entries of a list, or the place itself."""
        several = isinstance(self.value, list | tuple | range | np.ndarray)
        return [self[i] for i in range(len(self.value))] if several else [self]

    def each(self, check: "Callable[[Place], T | None]") -> tuple[T, ...]:
        """Return the entries that pass a check; repeated ones are noted."""
        found = [check(item) for item in self.items()]
        for i, value in enumerate(found):
            if value is not None and value in found[:i]:
                self.note(f"{self.name} has {value} twice; leave one of them out", i)
        return tuple(value for value in found if value is not None)

    def check_keys(self, known: tuple[str, ...], more: str = "") -> None:
        """Note the keys that are not known."""
        for key in self.value:
            if key not in known:
                self.note(f"unknown key {key!r}. {nearest(key, known)}{more}", key)

    def text(self) -> str | None:
        """A text that is not empty."""
        return self.value if isinstance(self.value, str) and self.value.strip() else self.must_be("a text")

    def texts(self) -> tuple[str, ...]:
        """A text or a list of texts as a tuple."""
        listed = self.value if isinstance(self.value, list | tuple) else [self.value]
        if all(isinstance(entry, str) and entry.strip() for entry in listed):
            return tuple(listed)
        return self.must_be("a text or a list of texts") or ()

    def flag(self) -> bool | None:
        """True or false."""
        return self.value if isinstance(self.value, bool) else self.must_be("true or false")

    def number(self, what: str, low: float, high: float = np.inf, *, closed: bool = False) -> float | None:
        """A number between low and high, low included where `closed`."""
        value = self.value
        fits = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
        return float(value) if fits and (low < value < high or (closed and value == low)) else self.must_be(what)

    def whole(self, low: int) -> int | None:
        """Return an integer of at least `low`."""
        value = self.value
        if isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= low:
            return int(value) if value < LARGEST else self.must_be("below 2**62")
        what = "a positive integer" if low == 1 else f"an integer of at least {low}"
        if isinstance(value, float) and value.is_integer() and value >= low:
            return self.note(f"must be {what}; write {value:.0f} instead of {value}")
        return self.must_be(what)

    def must_be(self, what: str) -> None:
        """Note the required kind of value."""
        self.note(f"must be {what}; {shown(self.value)} is not")

    def check_writable(self) -> None:
        """Note values that a study file cannot hold: no key of a cell could be computed from them."""
        if isinstance(self.value, Mapping):
            for key in self.value:
                if isinstance(key, str):
                    self[key].check_writable()
                else:
                    self.note(f"{self.name} has the key {key!r}, which is no text")
        elif isinstance(self.value, list):
            for item in self.items():
                item.check_writable()
        elif self.value is None:
            self.note(f"{self.name} is None, which a study file cannot hold: leave it out")
        elif not isinstance(self.value, str | int | float | date | clock):
            self.note(f"{self.name} is of type {type(self.value).__name__}, which a study file cannot hold: "
                      "give texts, numbers, true, false, dates, or lists and tables of them")


def shown(value: Any) -> str:
    """Write a value for messages."""
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


def _written(path: Path) -> str:
    """Write a path as in a study file: data[0].noise, formulation['relaxed'].na."""
    text = ""
    for part in path:
        if isinstance(part, int | Label):
            text += f"[{part!r}]"
        else:
            text += f".{part}" if text else part
    return text
