"""Where the keys and values of a TOML text stand, which the parser of the standard library does not tell."""

import re
from dataclasses import dataclass, field
from typing import Any

Path = tuple[str | int, ...]

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_SCALAR = re.compile(r"[^,\]}\n#]*")
_SPACE = re.compile(r"[ \t]*")
_BLANK = re.compile(r"(?:[ \t\r\n]+|#[^\n]*)*")
_STRING = re.compile(r'"""(?:\\.|[^\\])*?"{3,5}|' r"'''.*?'{3,5}|" r'"(?:\\.|[^"\\\n])*"|' r"'[^'\n]*'", re.DOTALL)


@dataclass(frozen=True)
class Positions:
    """Places in a text.

    Attributes:
        keys: where each key stands, and the header of each table; {path: (line, column)}, both from 1.
        values: where each value begins.
    """

    keys: dict[Path, tuple[int, int]] = field(default_factory=dict)
    values: dict[Path, tuple[int, int]] = field(default_factory=dict)

    def of(self, path: Path, value: bool = False) -> tuple[int, int]:
        """Return the place of a key, or of its value; of what is in it, or around it, where it does not stand there."""
        places = [self.values, self.keys] if value else [self.keys, self.values]
        for length in range(len(path), 0, -1):
            for found in places:
                if path[:length] in found:
                    return found[path[:length]]
                inside = [place for key, place in found.items() if key[:length] == path[:length]]
                if inside:  # an array of tables has no place of its own
                    return min(inside)
        return 1, 1


def locate(text: str) -> Positions:
    """Return the places of all keys and values of a text that is known to be valid TOML."""
    return _Scan(text).document()


class _Scan:
    """One pass over a text; `at` is the next character."""

    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0
        self.found = Positions()
        self.count: dict[Path, int] = {}  # entries of every array of tables so far

    def document(self) -> Positions:
        table: Path = ()
        self._skip(_BLANK)
        while self.at < len(self.text):
            place, opening = self._place(), 0
            while self.text[self.at] == "[" and opening < 2:
                opening += 1
                self.at += 1
            if opening:
                table = self._resolve(self._key(), several=opening == 2)
                self.found.keys.setdefault(table, place)
                self.at = self.text.index("]" * opening, self.at) + opening
            else:
                self._pair(table)
            self._skip(_BLANK)
        return self.found

    def _resolve(self, names: tuple[str, ...], several: bool) -> Path:
        """Path of a table header: a name that is an array of tables means its last entry."""
        path: Path = ()
        for i, name in enumerate(names):
            path += (name,)
            if several and i == len(names) - 1:
                self.count[path] = self.count.get(path, -1) + 1
            if path in self.count:
                path += (self.count[path],)
        return path

    def _pair(self, table: Path) -> None:
        place = self._place()
        names = self._key()
        for i in range(1, len(names)):
            self.found.keys.setdefault(table + names[:i], place)
        self.found.keys[table + names] = place
        self.at = self.text.index("=", self.at) + 1
        self._skip(_SPACE)
        self._value(table + names)

    def _key(self) -> tuple[str, ...]:
        names = []
        while True:
            self._skip(_SPACE)
            bare = _BARE.match(self.text, self.at)
            quoted = None if bare else _STRING.match(self.text, self.at)
            match = bare or quoted
            if match is None:
                return tuple(names)
            self.at = match.end()
            names.append(match[0] if bare else _unquoted(match[0]))
            self._skip(_SPACE)
            if self.text[self.at : self.at + 1] != ".":
                return tuple(names)
            self.at += 1

    def _value(self, path: Path) -> None:
        self.found.values[path] = self._place()
        start = self.text[self.at]
        if start in "\"'":
            match = _STRING.match(self.text, self.at)
            self.at = match.end() if match else len(self.text)
        elif start in "[{":
            self.at += 1
            index = 0
            while True:
                self._skip(_BLANK)
                if self.text[self.at] in "]}":
                    self.at += 1
                    return
                if start == "[":
                    self._value((*path, index))
                else:
                    self._pair(path)
                index += 1
                self._skip(_BLANK)
                if self.text[self.at] == ",":
                    self.at += 1
        else:
            self._skip(_SCALAR)

    def _skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self.text, self.at)
        self.at = match.end() if match else self.at

    def _place(self) -> tuple[int, int]:
        return self.text.count("\n", 0, self.at) + 1, self.at - self.text.rfind("\n", 0, self.at)


def _unquoted(word: str) -> str:
    import tomllib

    found: Any = next(iter(tomllib.loads(f"{word} = 0")))
    return found
