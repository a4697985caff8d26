"""A study as the keys and values of a study file, and as its text."""

import json
import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.data.record import Data
from optid.errors import StudyError
from optid.studies.definition.description import DataEntry, FormulationEntry, SolverEntry
from optid.studies.definition.entries import ALL
from optid.studies.definition.problems import Problems, shown
from optid.studies.sources.systems import SYSTEMS

if TYPE_CHECKING:
    from optid.studies.definition.description import Study

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_ALONE = ("accuracy", "time_limit", "memory_limit", "repetitions", "warm", "seeds", "holdout")


_AXES = {  # key in a file: argument of a Study, keys that distinguish an entry from labels, accepted values
    "data": ("data", ("file", "system", "name"), "a record, optid.Data(u, y, dt), the name of a file or of a simulated "
             "system"),
    "formulation": ("formulations", ("formulation",), "the name of a formulation"),
    "solver": ("solvers", ("solver",), "the name of a solver"),
}


def as_raw(given: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """Return the keys and values of a study file for the arguments of a `Study`; invalid axes are noted."""
    raw: dict[str, Any] = {"name": given["name"], **{key: plain(given[key]) for key in _ALONE}}
    for key, (axis, marks, takes) in _AXES.items():
        value = given[axis]
        if key == "solver" and (isinstance(value, str) or plain(value) == [ALL]):
            raw[axis] = value
            continue
        if isinstance(value, Mapping) and not any(mark in value for mark in marks):  # by labels
            entries = [_entry(key, entry, str(label)) for label, entry in value.items()]
        else:
            entries = [_entry(key, entry) for entry in (value if isinstance(value, list | tuple) else [value])]
        for i, entry in enumerate(entries):
            if not isinstance(entry, Mapping):
                problems.append(((key, i), f"{shown(entry)} is invalid: must be {takes}, or a mapping with the keys of "
                                 f"[[{key}]]"))
        raw[key] = [plain(entry) for entry in entries if isinstance(entry, Mapping)]
    return raw


def _entry(key: str, entry: Any, label: str | None = None) -> Any:
    if isinstance(entry, Data):
        entry = {"record": entry} if key == "data" else entry
    elif isinstance(entry, str) and key != "data":
        entry = {key: entry}
    elif isinstance(entry, str | Path) and key == "data":
        known = isinstance(entry, str) and (entry in SYSTEMS or not PurePath(entry).suffix)
        entry = {"system": entry} if known else {"file": str(entry)}
    elif isinstance(entry, DataEntry | FormulationEntry | SolverEntry):
        entry = _entry_keys(entry)
    return {"name": label, **entry} if isinstance(entry, Mapping) and label is not None else entry


def _entry_keys(entry: DataEntry | FormulationEntry | SolverEntry) -> dict[str, Any]:
    found = {f.name: getattr(entry, f.name) for f in fields(entry)}
    options = dict(found.pop("options"))
    if "files" in found:
        found["file"] = found.pop("files")
    if isinstance(entry, SolverEntry):
        found, options = {**found, "options": options}, {}
    return {**{key: value for key, value in found.items() if value is not None and value not in ((), {})}, **options}


def plain(value: Any) -> Any:
    """Return a value as a study file would hold it: lists instead of tuples, Python's numbers instead of numpy's."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | range):
        return [plain(item) for item in value]
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def as_toml(study: "Study") -> str:
    """Return the text of a study file.

    Raises:
        StudyError: a record in memory, which no file holds.
    """
    lines = [f"name = {_value(study.name)}"]
    for key in _ALONE:
        value: Any = plain(getattr(study, key))
        if key == "seeds" and value == list(range(len(value))):
            value = len(value)
        lines.append(f"{key} = {_value(value[0] if key == 'accuracy' and len(value) == 1 else value)}")
    for key, entries in (("data", study.data), ("formulation", study.formulations), ("solver", study.solvers)):
        for entry in entries:
            if isinstance(entry, DataEntry) and entry.record is not None:
                raise StudyError(f"{entry.name!r} is a record in memory, which a study file cannot hold: write it to a "
                                 "file and name that")
            lines += ["", f"[[{key}]]"]
            for name, value in _entry_keys(entry).items():
                lines.append(f"{_key(name)} = {_value(_single(name, plain(value)))}")
    return "\n".join(lines) + "\n"


def _single(key: str, value: Any) -> Any:
    """One file, length, noise or accuracy is written without brackets."""
    if key in ("file", "samples", "noise", "accuracy") and isinstance(value, list) and len(value) == 1:
        return value[0]
    return value


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else _text(name)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)  # nan, inf and -inf are those of TOML
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(str(key))} = {_value(item)}" for key, item in value.items()) + " }"
    return value.isoformat()  # a date or a time: an entry holds nothing else


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
