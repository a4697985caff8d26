"""Entries of a study from a file or from Python; all problems are collected."""

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import product
from pathlib import PurePath
from typing import Any

from optid.backends.choice import back_ends
from optid.bases import parse
from optid.data.readers import Format
from optid.data.record import Data
from optid.errors import DataError, OptidError, nearest
from optid.registry import CONSTRAINTS, FORMULATIONS, named_constraint, registered
from optid.solving.solve import solve
from optid.studies.definition.description import DataEntry, FormulationEntry, SolverEntry
from optid.studies.definition.problems import Path, Place, Problems, shown
from optid.studies.sources.systems import SYSTEMS, simulate

AUTO, ALL = "auto", "all"
MOST_SEEDS, MOST_FORMULATIONS = 1_000_000, 10_000  # a study has no more cells than that

READING = ("inputs", "outputs", "dt", "time", "experiment", *(field.name for field in fields(Format)))
"""How files are read: arguments of `optid.read`."""

_TOP = ("name", "accuracy", "time_limit", "memory_limit", "repetitions", "warm", "seeds", "holdout", "data",
        "formulation", "solver", "solvers")
_DATA = ("name", "file", "system", "samples", "noise", *READING)
_FORMULATION = ("name", "formulation", "constraints", "data")
_SOLVER = ("name", "solver", "accuracy", "options")
SETTINGS = tuple(p.name for p in inspect.signature(solve).parameters.values() if p.kind is not p.VAR_KEYWORD)
"""Arguments of `solve`: as options of a solver they would contradict the rows."""

_KINDS: tuple[tuple[type | tuple[type, ...], str, str], ...] = (
    (bool, "bool", "true or false"),
    (int, "int float", "an integer"),
    (float, "float", "a number"),
    (str, "str", "a text"),
    ((list, tuple), "Sequence list tuple", "a list"),
)
"""Types of a value, the words of an annotation that accept it, and its name in messages."""


def read(raw: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """Return the arguments of a `Study` for keys and values as in a study file; valid only if no problem was noted."""
    top = Place(raw, problems)
    top.check_keys(_TOP)
    checks: dict[str, Callable[[Place], Any]] = {
        "name": Place.text,
        "time_limit": lambda at: at.number("a positive number of seconds", 0.0),
        "memory_limit": lambda at: at.number("a positive number of MB", 0.0),
        "holdout": lambda at: at.number("a share of at least 0 and below 1", 0.0, 1.0, closed=True),
        "repetitions": lambda at: at.whole(1),
        "warm": Place.flag,
        "accuracy": _accuracies,
        "seeds": _seeds,
    }
    found: dict[str, Any] = {key: check(top[key]) for key, check in checks.items() if key in raw}
    data = found["data"] = tuple(_data(entry) for entry in _tables("data", top))
    found["formulations"] = tuple(one for entry in _tables("formulation", top) for one in _formulations(entry, data))
    found["solvers"] = tuple(_solvers(top))
    for axis, key in (("data", "data"), ("formulations", "formulation"), ("solvers", "solver")):
        _distinct(key, found[axis], top)
    return found


def _tables(key: str, top: Place) -> list[Place]:
    entries = top.value.get(key, [])
    if not entries and key != "solver":
        if not top.problems.concern(key):
            top.note(f"there is no [[{key}]]: a study needs at least one")
        return []
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        how = f"[[{key}]], with two brackets" if isinstance(entries, Mapping) else f"a table, [[{key}]]"
        listed = ", or at the top solvers = \"auto\"" if key == "solver" else ""
        top.note(f"{key} is written as {how}{listed}", key)
        return []
    return top[key].items() if entries else []


def _data(entry: Place) -> DataEntry:
    record = entry.value.get("record")
    in_memory = isinstance(record, Data)
    for key in entry.value:
        if key not in _DATA and not (key == "record" and in_memory):
            entry.note(f"unknown key {key!r}. {nearest(key, _DATA)}", key)
    sources = [key for key in ("file", "system") if key in entry] + ["record"] * in_memory
    if len(sources) != 1:
        entry.note(f"[[data]] needs {'a file or a system' if not sources else 'only one of file and system'}")
    files, system = entry.take("file", Place.texts, ()), entry.take("system", Place.text)
    if system is not None and system not in SYSTEMS:
        entry.note(f"no system is called {system!r}. {nearest(system, SYSTEMS)}", "system")
    for key in ("samples", "noise") if system is None and sources else READING if "file" not in entry else ():
        if key in entry:
            which = "a simulated system" if key in ("samples", "noise") else "a file"
            entry.note(f"{key} is for {which}, which this entry is not", key)
    default = system or (PurePath(files[0]).stem if files else getattr(record, "name", "") or "record")
    return DataEntry(
        _label(entry, default), files, system, record if in_memory else None,
        entry.take("samples", lambda at: at.each(lambda one: one.whole(1)), ()),
        entry.take("noise", lambda at: at.each(lambda one: one.number(
            "a number of at least 0, relative to the noise-free output", 0.0, closed=True)), ()),
        {key: _reading(entry[key]) for key in READING if key in entry},
    )


def _reading(at: Place) -> Any:
    key, value = at.name, at.value
    if key == "dt":
        return at.number("a positive number", 0.0)
    if key in ("inputs", "outputs"):
        if isinstance(value, Mapping):
            return {str(name): at[name].text() for name in value}
        return list(at.texts())
    if key == "time" and value is False:
        return value
    if key in ("time", "experiment"):
        return at.text()
    if key == "columns":
        return list(at.texts())
    try:
        Format(**{key: value})
    except (DataError, TypeError) as error:
        at.note(str(error))
    return value


def _formulations(entry: Place, data: Sequence[DataEntry]) -> list[FormulationEntry]:
    """Return the formulations of an entry: one, or the grid over its arguments with several values."""
    known, name, raw = registered(FORMULATIONS), entry.value.get("formulation"), entry.value
    names = [one.name for one in data]
    axes: dict[str, list[Any]] = {}
    if isinstance(name, str) and name in known:
        try:
            parameters = inspect.signature(known[name].load(), eval_str=True).parameters
        except Exception:  # reported below
            parameters = {}
        wanted = [at.value for at in entry["data"].items()] if "data" in entry else names
        used = [one for one in data if one.name in wanted]
        axes = {key: list(value) for key, value in raw.items()
                if key in parameters and isinstance(value, list | tuple) and value
                and _is_axis(parameters[key].annotation, value, used)}
    if (count := math.prod(map(len, axes.values()))) > MOST_FORMULATIONS:
        entry.note(f"{', '.join(axes)} form a grid of {count:,} formulations; the limit is {MOST_FORMULATIONS:,}")
        return []
    found = []
    for values in product(*axes.values()):
        point = dict(zip(axes, values))
        one = _formulation(Place({**raw, **point}, entry.problems, entry.path), names)
        chosen = {key: value if isinstance(value, list | tuple) else [value] for key, value in point.items()}
        found.append(replace(one, name=", ".join([one.name, *(
            f"{key} = {'+'.join(map(str, value)) or 'none'}" for key, value in chosen.items())])))
    return found


def _is_axis(annotation: Any, value: Sequence[Any], data: Sequence[DataEntry]) -> bool:
    """Whether a list holds several values of an argument: the argument takes no list, or a list of lists is given.

    An argument that takes one value or one per input is per input if the data have several inputs.
    """
    if all(isinstance(one, list | tuple) for one in value):
        return True
    text = annotation if isinstance(annotation, str) else str(annotation)
    outside = set(re.findall(r"\w+", re.sub(r"\[[^]]*]", "", getattr(annotation, "__name__", "") or text)))
    if outside & {"Sequence", "list", "tuple", "Any"}:
        scalar = bool(outside & {"int", "float", "str"})
        return scalar and len(value) > 1 and bool(data) and all(_has_one_input(entry) for entry in data)
    return bool(outside & {"int", "float", "str", "bool"})


def _has_one_input(entry: DataEntry) -> bool:
    """Whether the record of an entry is known to have a single input."""
    if entry.record is not None:
        return entry.record.m == 1
    if entry.system is not None:
        return entry.system in SYSTEMS and simulate(entry.system, 10)[0].m == 1
    return len(entry.options.get("inputs", ())) == 1


def _formulation(entry: Place, data: Sequence[str]) -> FormulationEntry:
    name, known = entry.take("formulation", Place.text), registered(FORMULATIONS)
    options = {key: value for key, value in entry.value.items() if key not in _FORMULATION}
    if "formulation" not in entry:
        entry.note("[[formulation]] needs formulation = \"NAME\" (optid formulations lists them)")
    elif name is not None and name not in known:
        entry.note(f"no formulation is called {name!r}. {nearest(name, known)}", "formulation")
    elif name is not None:
        try:
            _check_arguments(entry, name, known[name].load(), options)
        except Exception as error:  # a broken plug-in
            entry.note(f"formulation {name!r} cannot be loaded: {type(error).__name__}: {error}", "formulation")
    for key in options:
        entry[key].check_writable()
    constraints, only = (entry.take(key, Place.texts, ()) for key in ("constraints", "data"))
    for i, text in enumerate(constraints):
        _check_constraint(entry, ("constraints", i), text)
    for i, label in enumerate(only):
        if label not in data:
            entry.note(f"no [[data]] is called {label!r}. {nearest(label, data)}", "data", i)
    default = " + ".join([name or "formulation", *constraints])
    return FormulationEntry(_label(entry, default), name or "", constraints, options, only)


def _check_constraint(entry: Place, keys: Path, text: str) -> None:
    word, known = text.partition(":")[0], registered(CONSTRAINTS)
    if word not in known:
        entry.note(f"no constraint is called {word!r}. {nearest(word, known)}", *keys)
        return
    try:
        named_constraint(text)
    except Exception as error:  # any error of a third-party builder
        entry.note(f"{error}" if "constraint" in str(error) else f"constraint {text!r}: {error}", *keys)


def _check_arguments(entry: Place, name: str, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
    """Check the options of a formulation by its signature, and bases by their names."""
    parameters = inspect.signature(function).parameters
    takes = {key: p for key, p in parameters.items() if p.kind is p.KEYWORD_ONLY}
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    if "constraints" in entry and "constraints" not in takes:
        entry.note(f"formulation {name!r} takes no constraints", "constraints")
    for key, value in options.items():
        if key not in takes:
            known = [*takes, *_FORMULATION]
            entry.note(f"formulation {name!r} takes no argument {key!r}. {nearest(key, known)}", key)
        elif (wanted := _misfit(takes[key].annotation, value)) is not None:
            entry[key].must_be(wanted)
        elif "basis" in key:
            for at in entry[key].items():
                _check_basis(at)
    missing = [key for key, p in takes.items() if p.default is p.empty and key not in options]
    if missing:
        entry.note(f"formulation {name!r} needs {', '.join(missing)}")


def _misfit(annotation: Any, value: Any) -> str | None:
    """Return what a value of the annotation must be if this one is invalid, else None."""
    words = set(re.findall(r"\w+", annotation if isinstance(annotation, str) else
                           annotation.__name__ if isinstance(annotation, type) else str(annotation)))
    if annotation is inspect.Parameter.empty or "Any" in words or not words & {"bool", "int", "float", "str"}:
        return None
    takers = next((takers for kind, takers, _ in _KINDS if isinstance(value, kind)), None)
    if takers is None or words & set(takers.split()):  # tables and dates are checked by the formulation
        return None
    return " or ".join(word for _, takers, word in _KINDS if words & {takers.split()[0]})


def _check_basis(at: Place) -> None:
    if not isinstance(at.value, str):
        at.must_be("a text such as \"triangular:10\"")
    elif at.value != "none":  # an output that is not fed back
        try:
            parse(at.value)
        except OptidError as error:
            at.note(str(error))


def _solvers(top: Place) -> list[SolverEntry]:
    found = []
    if "solvers" in top:
        words = top["solvers"].texts()
        if words == (ALL,):
            words = tuple(name for name, back_end in sorted(back_ends().items()) if back_end.installed)
        for i, word in enumerate(words):
            found.append(SolverEntry(word, _solver(top, ("solvers", i), word, *[ALL] * (len(words) == 1))))
    found += [_solver_entry(entry) for entry in _tables("solver", top)]
    if "solvers" not in top and not top.value.get("solver") and not top.problems.concern("solver"):
        top.note("there is no solver: add solvers = \"all\", solvers = [\"clarabel\", ...] or [[solver]]")
    return found


def _solver_entry(entry: Place) -> SolverEntry:
    entry.check_keys(_SOLVER, " Native options of the solver go into options = { ... }.")
    word = entry.take("solver", Place.text)
    if "solver" not in entry:
        entry.note("[[solver]] needs solver = \"NAME\" (optid solvers lists them)")
    name = word and _solver(entry, ("solver",), word)
    options = entry.value.get("options", {})
    if not isinstance(options, Mapping):
        entry.note(f"must be a table, {{ key = value }}; {shown(options)} is not", "options")
        options = {}
    for key in options:
        if key in SETTINGS:
            where = f"write {key} = ... beside solver" if key == "accuracy" else "it is a key of the study" \
                if key in _TOP else "the study sets it for every solver"
            entry.note(f"options are the solver's own, and {key!r} is none: {where}", "options", key)
    if options:
        entry["options"].check_writable()
    return SolverEntry(_label(entry, word or "solver"), name or "", entry.take("accuracy", _accuracies, ()),
                       dict(options))


def _solver(place: Place, keys: Path, word: str, *more: str) -> str:
    """Look up a solver; `more` are other possible words."""
    known = [AUTO, *back_ends()]
    if word.lower() not in known:
        place.note(f"no solver is called {word!r}. {nearest(word.lower(), [*known, *more])}", *keys)
    return word.lower()


def _accuracies(at: Place) -> tuple[float, ...]:
    if not at.items():
        at.note("accuracy is empty; give at least one number")
    return at.each(lambda one: one.number("a number between 0 and 1", 0.0, 1.0))


def _seeds(at: Place) -> tuple[int, ...]:
    if not isinstance(at.value, list | tuple | range):
        count = at.whole(1)
        if count is not None and count > MOST_SEEDS:
            at.note(f"{count:,} seeds are too many: at most {MOST_SEEDS:,} are allowed")
            return ()
        return tuple(range(count or 1))
    if not at.items():
        at.note("seeds is empty; give their number or a list of them")
    return at.each(lambda one: one.whole(0))


def _label(entry: Place, default: str) -> str:
    return entry.take("name", Place.text) or default


def _distinct(key: str, entries: Sequence[Any], top: Place) -> None:
    """Note entries with the same label; solvers listed at the top come before the tables."""
    seen: set[str] = set()
    listed = len(entries) - len(top.value.get("solver", [])) if key == "solver" else 0
    for i, entry in enumerate(entries):
        if entry.name in seen:
            path: Path = ("solvers", i) if i < listed else (key, i - listed)
            top.note(f"two entries are called {entry.name!r}; give this one another name = \"...\"", *path)
        seen.add(entry.name)
