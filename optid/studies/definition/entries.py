"""From what a user writes, in a file or in Python, to the entries of a study; every problem is noted, none stops it."""

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import PurePath
from typing import Any

from optid.backends.choice import back_ends
from optid.bases import parse
from optid.data.record import Data
from optid.errors import OptidError, nearest
from optid.registry import CONSTRAINTS, FORMULATIONS, named_constraint, registered
from optid.solving.solve import solve
from optid.studies.definition.description import DataEntry, FormulationEntry, SolverEntry
from optid.studies.definition.problems import Path, Problems, items, one_or_several, shown
from optid.studies.sources.systems import SYSTEMS, simulate

AUTO, ALL = "auto", "all"
MOST_SEEDS, MOST_FORMULATIONS = 1_000_000, 10_000
"""A study has no more cells than that."""

READING = ("inputs", "outputs", "dt", "time", "experiment", "columns", "delimiter", "decimal")
"""Keys of a data entry that say how its files are read."""

_TOP = ("name", "accuracy", "time_limit", "memory_limit", "repetitions", "warm", "seeds", "holdout", "data",
        "formulation", "solver", "solvers")
_DATA = ("name", "file", "system", "samples", "noise", *READING)
_FORMULATION = ("name", "formulation", "constraints", "data")
_SOLVER = ("name", "solver", "accuracy", "options")
SETTINGS = tuple(p.name for p in inspect.signature(solve).parameters.values() if p.kind is not p.VAR_KEYWORD)
"""What solving has arguments for: among the options of a solver, these would override what its rows say."""

_KINDS: tuple[tuple[type | tuple[type, ...], str, str], ...] = (
    (bool, "bool", "true or false"),
    (int, "int float", "an integer"),
    (float, "float", "a number"),
    (str, "str", "a text"),
    ((list, tuple), "Sequence list tuple", "a list"),
)
"""Types of a value, the words of an annotation that take it, and its words for people."""


def read(raw: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """Return the arguments of a `Study` for a raw description.

    Args:
        raw: keys and values as in a study file.
        problems: collects what is wrong; what is returned is usable only if nothing is.
    """
    _check_known((), raw, _TOP, problems)
    checks: dict[str, Callable[[Path, Any], Any]] = {
        "name": problems.text,
        "time_limit": lambda at, value: problems.number(at, value, "a positive number of seconds", 0.0),
        "memory_limit": lambda at, value: problems.number(at, value, "a positive number of MB", 0.0),
        "holdout": lambda at, value: problems.number(at, value, "a share of at least 0 and below 1", 0.0, 1.0,
                                                     closed=True),
        "repetitions": lambda at, value: problems.whole(at, value, 1),
        "warm": problems.flag,
        "accuracy": lambda at, value: _accuracies(at, value, problems),
        "seeds": lambda at, value: _seeds(value, problems),
    }
    found: dict[str, Any] = {key: check((key,), raw[key]) for key, check in checks.items() if key in raw}
    data = tuple(_data(("data", i), entry, problems) for i, entry in enumerate(_tables("data", raw, problems)))
    found["data"] = data
    found["formulations"] = tuple(one for i, entry in enumerate(_tables("formulation", raw, problems))
                                  for one in _formulations(("formulation", i), entry, data, problems))
    found["solvers"] = tuple(_solvers(raw, problems))
    for axis, key in (("data", "data"), ("formulations", "formulation"), ("solvers", "solver")):
        _distinct(key, found[axis], raw, problems)
    return found


def _tables(key: str, raw: Mapping[str, Any], problems: Problems) -> list[Mapping[str, Any]]:
    entries = raw.get(key, [])
    if not entries and key != "solver":
        if not any(problem.path[:1] == (key,) for problem in problems):
            problems.add((), f"there is no [[{key}]]: a study needs at least one")
        return []
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        how = f"[[{key}]], with two brackets" if isinstance(entries, Mapping) else f"a table of its own, [[{key}]]"
        listed = ", or at the top solvers = \"auto\"" if key == "solver" else ""
        problems.add((key,), f"{key} is written as {how}{listed}")
        return []
    return entries


def _data(path: Path, raw: Mapping[str, Any], problems: Problems) -> DataEntry:
    record = raw.get("record")
    in_memory = isinstance(record, Data)
    _check_known(path, raw, (*_DATA, *["record"] * in_memory), problems, _DATA)
    sources = [key for key in ("file", "system") if key in raw] + ["record"] * in_memory
    if len(sources) != 1:
        problems.add(path, f"[[data]] needs {'a file or a system' if not sources else 'only one of file and system'}")
    files = problems.texts((*path, "file"), raw["file"]) if "file" in raw else ()
    system = problems.text((*path, "system"), raw["system"]) if "system" in raw else None
    if system is not None and system not in SYSTEMS:
        problems.add((*path, "system"), f"no system is called {system!r}. {nearest(system, SYSTEMS)}")
    for key in ("samples", "noise") if system is None and sources else READING if "file" not in raw else ():
        if key in raw:
            which = "a simulated system" if key in ("samples", "noise") else "a file"
            problems.add((*path, key), f"{key} is for {which}, which this entry is not")
    samples = [problems.whole(at, value, 1) for at, value in items((*path, "samples"), raw.get("samples", []))]
    noise = [problems.number(at, value, "a number of at least 0, relative to the noise-free output", 0.0, closed=True)
             for at, value in items((*path, "noise"), raw.get("noise", []))]
    default = system or (PurePath(files[0]).stem if files else getattr(record, "name", "") or "record")
    return DataEntry(
        _label(path, raw, default, problems), files, system, record if in_memory else None,
        problems.once((*path, "samples"), samples), problems.once((*path, "noise"), noise),
        {key: _reading((*path, key), raw[key], problems) for key in READING if key in raw},
    )


def _reading(path: Path, value: Any, problems: Problems) -> Any:
    """Check one key that says how a file is read."""
    key = path[-1]
    if key == "dt":
        return problems.number(path, value, "a positive number", 0.0)
    if key in ("inputs", "outputs", "columns"):
        if isinstance(value, Mapping) and key != "columns":
            return {str(name): problems.text((*path, name), column) for name, column in value.items()}
        return list(problems.texts(path, value))
    if key == "time" and value is False:
        return value
    if key in ("delimiter", "decimal") and isinstance(value, str) and len(value) == 1:
        return value
    return problems.text(path, value)


def _formulations(path: Path, raw: Mapping[str, Any], data: Sequence[DataEntry], problems: Problems
                  ) -> list[FormulationEntry]:
    """The formulations of one entry: one, or the grid over its arguments that are lists of values."""
    known, name, names = registered(FORMULATIONS), raw.get("formulation"), [entry.name for entry in data]
    axes: dict[str, list[Any]] = {}
    if isinstance(name, str) and name in known:
        try:
            parameters = inspect.signature(known[name].load(), eval_str=True).parameters
        except Exception:  # told below
            parameters = {}
        used = [entry for entry in data if entry.name in one_or_several(raw.get("data", names))]
        axes = {key: list(value) for key, value in raw.items()
                if key in parameters and isinstance(value, list | tuple) and value
                and _is_axis(parameters[key].annotation, value, used)}
    if (count := math.prod(map(len, axes.values()))) > MOST_FORMULATIONS:
        problems.add(path, f"{', '.join(axes)} form a grid of {count:,} formulations; at most {MOST_FORMULATIONS:,} "
                     "are taken")
        return []
    found = []
    for values in product(*axes.values()):
        point = dict(zip(axes, values))
        one = _formulation(path, {**raw, **point}, names, problems)
        found.append(replace(one, name=", ".join([one.name, *(
            f"{key} = {'+'.join(map(str, one_or_several(value))) or 'none'}" for key, value in point.items())])))
    return found


def _is_axis(annotation: Any, value: Sequence[Any], data: Sequence[DataEntry]) -> bool:
    """Whether a list holds several values of an argument: the argument takes no list, or a list of lists is given.

    Arguments that take one value or one per input are per input where the data have several inputs.
    """
    if all(isinstance(one, list | tuple) for one in value):
        return True
    text = annotation if isinstance(annotation, str) else str(annotation)
    outside = set(re.findall(r"\w+", re.sub(r"\[[^]]*]", "", getattr(annotation, "__name__", "") or text)))
    if "Sequence" in outside or outside & {"list", "tuple", "Any"}:
        scalar = bool(outside & {"int", "float", "str"})
        return scalar and len(value) > 1 and bool(data) and all(_has_one_input(entry) for entry in data)
    return bool(outside & {"int", "float", "str", "bool"})


def _has_one_input(entry: DataEntry) -> bool:
    """Whether the record of an entry is known to have a single input."""
    if entry.record is not None:
        return entry.record.m == 1
    if entry.system is not None:
        return entry.system in SYSTEMS and simulate(entry.system, 10)[0].m == 1
    return "inputs" in entry.options and len(entry.options["inputs"]) == 1


def _formulation(path: Path, raw: Mapping[str, Any], data: Sequence[str], problems: Problems) -> FormulationEntry:
    name = problems.text((*path, "formulation"), raw["formulation"]) if "formulation" in raw else None
    known = registered(FORMULATIONS)
    options = {key: value for key, value in raw.items() if key not in _FORMULATION}
    if "formulation" not in raw:
        problems.add(path, "[[formulation]] needs formulation = \"NAME\" (optid formulations lists them)")
    elif name is not None and name not in known:
        problems.add((*path, "formulation"), f"no formulation is called {name!r}. {nearest(name, known)}")
    elif name is not None:
        try:
            _arguments(path, name, known[name].load(), options, "constraints" in raw, problems)
        except Exception as error:  # a broken plug-in is told like everything else
            problems.add((*path, "formulation"),
                         f"formulation {name!r} cannot be loaded: {type(error).__name__}: {error}")
    for key, value in options.items():
        problems.writable((*path, key), value)
    constraints = problems.texts((*path, "constraints"), raw["constraints"]) if "constraints" in raw else ()
    for i, text in enumerate(constraints):
        _constraint((*path, "constraints", i), text, problems)
    only = problems.texts((*path, "data"), raw["data"]) if "data" in raw else ()
    for i, label in enumerate(only):
        if label not in data:
            problems.add((*path, "data", i), f"no [[data]] is called {label!r}. {nearest(label, data)}")
    default = " + ".join([name or "formulation", *constraints])
    return FormulationEntry(_label(path, raw, default, problems), name or "", constraints, options, only)


def _constraint(path: Path, text: str, problems: Problems) -> None:
    word = text.partition(":")[0]
    known = registered(CONSTRAINTS)
    if word not in known:
        problems.add(path, f"no constraint is called {word!r}. {nearest(word, known)}")
        return
    try:
        named_constraint(text)
    except Exception as error:  # whatever a builder of a third party raises
        problems.add(path, f"{error}" if "constraint" in str(error) else f"constraint {text!r}: {error}")


def _arguments(path: Path, name: str, function: Callable[..., Any], options: Mapping[str, Any], constrained: bool,
               problems: Problems) -> None:
    """Check the options of a formulation by its signature, and bases by their names."""
    parameters = inspect.signature(function).parameters
    takes = {key: p for key, p in parameters.items() if p.kind is p.KEYWORD_ONLY}
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    if constrained and "constraints" not in takes:
        problems.add((*path, "constraints"), f"formulation {name!r} takes no constraints")
    for key, value in options.items():
        if key not in takes:
            known = [*takes, *_FORMULATION]
            problems.add((*path, key), f"formulation {name!r} takes no argument {key!r}. {nearest(key, known)}")
            continue
        if (wanted := _misfit(takes[key].annotation, value)) is not None:
            problems.add((*path, key), f"must be {wanted}; {shown(value)} is not")
        elif "basis" in key:
            for at, text in items((*path, key), value):
                _basis(at, text, problems)
    missing = [key for key, p in takes.items() if p.default is p.empty and key not in options]
    if missing:
        problems.add(path, f"formulation {name!r} needs {', '.join(missing)}")


def _misfit(annotation: Any, value: Any) -> str | None:
    """What a value of the annotation would be, where this one is none; None where it is or cannot be told."""
    words = set(re.findall(r"\w+", annotation if isinstance(annotation, str) else
                           annotation.__name__ if isinstance(annotation, type) else str(annotation)))
    if annotation is inspect.Parameter.empty or "Any" in words or not words & {"bool", "int", "float", "str"}:
        return None
    for kind, takers, _ in _KINDS:
        if isinstance(value, kind):
            if words & set(takers.split()):
                return None
            break
    else:
        return None  # a table or a date: the formulation says
    return " or ".join(word for _, takers, word in _KINDS if words & {takers.split()[0]})


def _basis(path: Path, text: Any, problems: Problems) -> None:
    if not isinstance(text, str):
        problems.add(path, f"must be a text such as \"triangular:10\"; {shown(text)} is not")
        return
    if text == "none":  # an output that is not fed back
        return
    try:
        parse(text)
    except OptidError as error:
        problems.add(path, str(error))


def _solvers(raw: Mapping[str, Any], problems: Problems) -> list[SolverEntry]:
    found = []
    if "solvers" in raw:
        words = problems.texts(("solvers",), raw["solvers"])
        if words == (ALL,):
            words = tuple(name for name, back_end in sorted(back_ends().items()) if back_end.installed)
        for i, word in enumerate(words):
            found.append(SolverEntry(word, _solver(("solvers", i), word, problems, *[ALL] * (len(words) == 1))))
    for i, entry in enumerate(_tables("solver", raw, problems)):
        found.append(_solver_entry(("solver", i), entry, problems))
    if "solvers" not in raw and not raw.get("solver") and not any(p.path[:1] == ("solver",) for p in problems):
        problems.add((), "there is no solver: add solvers = \"all\", solvers = [\"clarabel\", ...] or [[solver]]")
    return found


def _solver_entry(path: Path, raw: Mapping[str, Any], problems: Problems) -> SolverEntry:
    _check_known(path, raw, _SOLVER, problems, more=" Native options of the solver go into options = { ... }.")
    word = problems.text((*path, "solver"), raw["solver"]) if "solver" in raw else None
    if "solver" not in raw:
        problems.add(path, "[[solver]] needs solver = \"NAME\" (optid solvers lists them)")
    name = word and _solver((*path, "solver"), word, problems)
    options = raw.get("options", {})
    if not isinstance(options, Mapping):
        problems.add((*path, "options"), f"must be a table, {{ key = value }}; {shown(options)} is not")
        options = {}
    for key in options:
        if key in SETTINGS:
            where = f"write {key} = ... beside solver" if key == "accuracy" else "it is a key of the study" \
                if key in _TOP else "the study sets it for every solver"
            problems.add((*path, "options", key), f"options are the solver's own, and {key!r} is none: {where}")
    problems.writable((*path, "options"), options)
    accuracy = _accuracies((*path, "accuracy"), raw["accuracy"], problems) if "accuracy" in raw else ()
    return SolverEntry(_label(path, raw, word or "solver", problems), name or "", accuracy, dict(options))


def _solver(path: Path, word: str, problems: Problems, *more: str) -> str:
    """Look a solver up; `more` are words that could be meant besides."""
    known = [AUTO, *back_ends()]
    if word.lower() not in known:
        problems.add(path, f"no solver is called {word!r}. {nearest(word.lower(), [*known, *more])}")
    return word.lower()


def _accuracies(path: Path, value: Any, problems: Problems) -> tuple[float, ...]:
    numbers = [problems.number(at, one, "a number between 0 and 1", 0.0, 1.0) for at, one in items(path, value)]
    if not numbers and not one_or_several(value):
        problems.add(path, "accuracy is empty; give at least one number")
    return problems.once(path, numbers)


def _seeds(value: Any, problems: Problems) -> tuple[int, ...]:
    if not isinstance(value, list | tuple | range):
        count = problems.whole(("seeds",), value, 1)
        if count is not None and count > MOST_SEEDS:
            problems.add(("seeds",), f"{count:,} seeds are too many: at most {MOST_SEEDS:,} are taken")
            return ()
        return tuple(range(count or 1))
    seeds = [problems.whole(("seeds", i), seed, 0) for i, seed in enumerate(value)]
    if not seeds:
        problems.add(("seeds",), "seeds is empty; give their number or a list of them")
    return problems.once(("seeds",), seeds)


def _label(path: Path, raw: Mapping[str, Any], default: str, problems: Problems) -> str:
    return (problems.text((*path, "name"), raw["name"]) if "name" in raw else None) or default


def _distinct(key: str, entries: Sequence[Any], raw: Mapping[str, Any], problems: Problems) -> None:
    """Refuse two entries with one label; solvers listed at the top come before the tables."""
    seen: set[str] = set()
    listed = len(entries) - len(raw.get("solver", [])) if key == "solver" else 0
    for i, entry in enumerate(entries):
        if entry.name in seen:
            path: Path = ("solvers", i) if i < listed else (key, i - listed)
            problems.add(path, f"two entries are called {entry.name!r}; give this one another name = \"...\"")
        seen.add(entry.name)


def _check_known(path: Path, raw: Mapping[str, Any], known: Sequence[str], problems: Problems,
                 named: Sequence[str] | None = None, more: str = "") -> None:
    for key in raw:
        if key not in known:
            problems.add((*path, key), f"unknown key {key!r}. {nearest(key, named or known)}{more}")
