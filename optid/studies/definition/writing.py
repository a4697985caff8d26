"""From a study back to the keys and values of a study file, and to its text."""

import json
import math
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


def as_raw(given: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """Return the keys and values of a study file for the arguments of a `Study`, however simply they were written.

    Args:
        given: the arguments by name.
        problems: collects what cannot be read at all.
    """
    raw: dict[str, Any] = {"name": given["name"], **{key: plain(given[key]) for key in _ALONE}}
    raw["data"] = [_data(entry, label) for label, entry in _labelled(given["data"], _DATA_KEYS)]
    raw["formulation"] = []
    for label, entry in _labelled(given["formulations"], _FORMULATION_KEYS):
        entry = {"formulation": entry} if isinstance(entry, str) else entry
        raw["formulation"].append(_with_label(entry, label))
    solvers = given["solvers"]
    if isinstance(solvers, str) or plain(solvers) == [ALL]:
        raw["solvers"] = solvers
    else:
        raw["solver"] = []
        for label, entry in _labelled(solvers, _SOLVER_KEYS):
            raw["solver"].append(_with_label({"solver": entry} if isinstance(entry, str) else entry, label))
    for key, takes in _TAKES.items():
        for i, entry in enumerate(raw.get(key, [])):
            if not isinstance(entry, Mapping):
                problems.add((key, i), f"{shown(entry)} is none of what is taken here: {takes}, or a mapping with the "
                             f"keys of [[{key}]]")
        raw.update({key: [plain(entry) for entry in raw[key] if isinstance(entry, Mapping)]} if key in raw else {})
    return raw


_TAKES = {"data": "a record, optid.Data(u, y, dt), the name of a file or of a simulated system",
          "formulation": "the name of a formulation", "solver": "the name of a solver"}
_DATA_KEYS, _FORMULATION_KEYS, _SOLVER_KEYS = ("file", "system", "name"), ("formulation",), ("solver",)


def _labelled(value: Any, marks: tuple[str, ...]) -> list[tuple[str | None, Any]]:
    """Entries with their labels: a mapping without the keys of an entry has labels for keys."""
    if isinstance(value, Mapping) and not any(key in value for key in marks):
        return [(str(key), entry) for key, entry in value.items()]
    return [(None, entry) for entry in (value if isinstance(value, list | tuple) else [value])]


def _data(entry: Any, label: str | None) -> Any:
    if isinstance(entry, Data):
        entry = {"record": entry}
    elif isinstance(entry, str | Path):
        known = isinstance(entry, str) and (entry in SYSTEMS or not PurePath(entry).suffix)
        entry = {"system": entry} if known else {"file": str(entry)}
    return _with_label(entry, label)


def _with_label(entry: Any, label: str | None) -> Any:
    if isinstance(entry, DataEntry | FormulationEntry | SolverEntry):
        entry = entry_keys(entry)
    if isinstance(entry, Mapping) and label is not None:
        return {"name": label, **entry}
    return entry


def entry_keys(entry: DataEntry | FormulationEntry | SolverEntry) -> dict[str, Any]:
    """Return the keys and values of an entry; what is empty is left out."""
    found = {f.name: getattr(entry, f.name) for f in fields(entry)}
    options = dict(found.pop("options"))
    if "files" in found:
        found["file"] = found.pop("files")
    if isinstance(entry, SolverEntry):
        found["options"] = options
        options = {}
    kept = {key: value for key, value in found.items() if value is not None and not _empty(value)}
    return {**kept, **options}


def _empty(value: Any) -> bool:
    return isinstance(value, tuple | dict) and not value


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
            for name, value in entry_keys(entry).items():
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
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else {math.inf: "inf", -math.inf: "-inf"}.get(value, "nan")
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(str(key))} = {_value(item)}" for key, item in value.items()) + " }"
    return value.isoformat()  # a date or a time: an entry holds nothing else


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
