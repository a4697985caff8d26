"""The definition of a study: data, formulations and solvers with their labels, and the settings of every cell."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields
from inspect import signature
from pathlib import Path, PurePath
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    StringConstraints,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic.dataclasses import dataclass

from optid.backends.choice import back_ends
from optid.data.readers import Format
from optid.data.record import Data
from optid.errors import DataError, StudyError, nearest
from optid.registry import FORMULATIONS, find_entry_points, named_constraint
from optid.solving.solve import solve
from optid.studies.arguments import argument_problems, arguments, points
from optid.studies.messages import Problem, format_value, problems_of, refuse, unknown_keys
from optid.studies.sources.systems import SYSTEMS, simulate

AUTO, ALL = "auto", "all"
MOST_SEEDS = 1_000_000
LARGEST = 2**62  # limit of integers in the database

READING = ("inputs", "outputs", "dt", "time", "experiment", *(f.name for f in fields(Format)))
"""How files are read: arguments of `optid.read`."""

KEYS = {
    "data": ("name", "file", "system", "samples", "noise", *READING),
    "formulation": ("name", "formulation", "constraints", "data"),
    "solver": ("name", "solver", "accuracy", "options"),
}
"""Keys of the tables of a study file; a [[formulation]] has the arguments of the formulation besides."""

TOP = ("name", "accuracy", "time_limit", "memory_limit", "repetitions", "warm", "seeds", "holdout", "solvers", *KEYS)
"""Keys of a study file."""

SETTINGS = tuple(p.name for p in signature(solve).parameters.values() if p.kind is not p.VAR_KEYWORD)
"""Arguments of `solve`: as options of a solver they would contradict the rows."""


def _plain(value: Any) -> Any:
    """Return a value with Python's own numbers, lists for arrays and ranges, and texts for paths."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple | range):
        return [_plain(one) for one in value]
    if isinstance(value, Mapping) and not isinstance(value, Data):
        return {key: _plain(one) for key, one in value.items()}
    return str(value) if isinstance(value, Path) else value


def _several(value: Any) -> Any:
    value = _plain(value)
    return tuple(value) if isinstance(value, list) else (value,)


def _distinct(values: Any) -> Any:
    """Refuse values, or labels of entries, that are there twice."""
    first: dict[Any, int] = {}
    names = [getattr(value, "name", value) for value in values]
    refuse([((i,), f"{name} is there twice; leave one of them out" if name is values[i] else
             f"two entries are called {name!r}; give this one another name = \"...\"")
            for i, name in enumerate(names) if first.setdefault(name, i) < i])
    return values


def _seeds(value: Any) -> Any:
    """Return the seeds for their number or a list of them."""
    value = _plain(value)
    if type(value) is int and value > MOST_SEEDS:
        raise ValueError(f"{value:,} seeds are too many: at most {MOST_SEEDS:,} are allowed")
    if type(value) is int and value > 0:
        return tuple(range(value))
    return tuple(value) if isinstance(value, list) else refuse([((), f"must be a positive integer or a list of "
                                                                 f"integers; {format_value(value)} is not")])


Text = Annotated[str, StringConstraints(strict=True, pattern=r"\S")]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
Share = Annotated[Number, Field(gt=0, lt=1)]
Count = Annotated[int, Field(strict=True, gt=0, lt=LARGEST), BeforeValidator(_plain)]
Texts = Annotated[tuple[Text, ...], BeforeValidator(_several)]
Accuracies = Annotated[tuple[Share, ...], AfterValidator(_distinct), BeforeValidator(_several)]
Seeds = Annotated[tuple[Annotated[int, Field(strict=True, ge=0, lt=LARGEST)], ...], Field(min_length=1),
                  AfterValidator(_distinct), BeforeValidator(_seeds)]


def _unwritable(options: Mapping[str, Any], *place: str) -> list[Problem]:
    """Return the options that a study file cannot hold: no key of a cell could be computed from them."""
    import tomlkit
    from tomlkit.exceptions import ConvertError

    found: list[Problem] = []
    for key, value in options.items():
        try:
            tomlkit.item(value)
        except (TypeError, ValueError, ConvertError) as error:
            found.append(((*place, str(key)), f"a study file cannot hold it ({error}): give texts, numbers, true, "
                          "false, dates, or lists and tables of them"))
    return found


def _set(entry: Any, **values: Any) -> None:
    for key, value in values.items():
        object.__setattr__(entry, key, value)


@dataclass(frozen=True, config=ConfigDict(arbitrary_types_allowed=True))
class DataEntry:
    """One entry of the data axis: files, a record in memory, or a simulated system at several lengths and noises."""

    name: str = ""  # its label; by default that of the system, the file or the record
    files: Texts = ()  # one experiment each, relative to the folder of the study
    system: Text | None = None  # name of a simulated system (`optid.studies.sources.systems`)
    record: Data | None = field(default=None, repr=False)  # in memory, from Python only
    samples: Annotated[tuple[Count, ...], AfterValidator(_distinct), BeforeValidator(_several)] = ()  # simulated
    noise: Annotated[tuple[Annotated[Number, Field(ge=0)], ...], AfterValidator(_distinct),
                     BeforeValidator(_several)] = ()  # standard deviations relative to the noise-free output
    options: Mapping[str, Any] = field(default_factory=dict)  # how the files are read: `READING`

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, raw: Any) -> Any:
        if not isinstance(raw, Mapping):
            return raw
        in_memory = isinstance(raw.get("record"), Data)
        refuse(unknown_keys(raw, [*KEYS["data"], *["record"] * in_memory]))
        options = {key: value for key, value in raw.items() if key in READING}
        kept = {("files" if key == "file" else key): value for key, value in raw.items() if key not in READING}
        return kept | {"options": options}

    @model_validator(mode="after")
    def _checked(self) -> "DataEntry":
        sources = [word for word, given in (("file", self.files), ("system", self.system), ("record", self.record))
                   if given]
        problems: list[Problem] = [] if len(sources) == 1 else [
            ((), f"only one of {', '.join(sources)}" if sources else "needs a file or a system")]
        if self.system and self.system not in SYSTEMS:
            problems.append((("system",), f"no system is called {self.system!r}. {nearest(self.system, SYSTEMS)}"))
        if not self.files:
            problems += [((key,), f"{key} is for a file, which this entry is not") for key in self.options]
        if sources and not self.system:
            problems += [((key,), f"{key} is for a simulated system, which this entry is not")
                         for key in ("samples", "noise") if getattr(self, key)]
        options = {}
        for key, value in self.options.items():
            try:
                options[key] = _reading(key, _plain(value))
            except (DataError, TypeError, ValueError) as error:
                problems.append(((key,), str(error)))
        refuse(problems)
        own = PurePath(self.files[0]).stem if self.files else getattr(self.record, "name", "")
        _set(self, name=self.name or self.system or own or "record", options=options)
        return self

    @property
    def has_one_input(self) -> bool:
        """Whether its record is known to have a single input."""
        if self.record is not None:
            return self.record.m == 1
        if self.system is not None:
            return simulate(self.system, 10)[0].m == 1
        return len(self.options.get("inputs", ())) == 1


def _reading(key: str, value: Any) -> Any:
    """Return an argument of `optid.read`; `ValueError` or an error of `Format` for an invalid one."""
    texts = value if isinstance(value, list) else [value]
    if key in ("inputs", "outputs", "columns"):
        if isinstance(value, Mapping) and key != "columns":
            texts = list(value.values())
        if not texts or not all(isinstance(one, str) and one.strip() for one in texts):
            raise ValueError(f"must be a text or a list of texts; {format_value(value)} is not")
        return value if isinstance(value, Mapping) else texts
    if key == "dt" and not (isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < np.inf):
        raise ValueError(f"must be a positive number; {format_value(value)} is not")
    if key in ("time", "experiment") and not (isinstance(value, str) or key == "time" and value is False):
        raise ValueError(f"must be a text; {format_value(value)} is not")
    if key in Format.__dataclass_fields__:
        Format(**{key: value})  # type: ignore[arg-type]
    return value


@dataclass(frozen=True)
class FormulationEntry:
    """One entry of the formulation axis."""

    name: str = ""  # its label; by default formulation and constraints
    formulation: Text = ""  # registered name
    constraints: Texts = ()  # named constraints as texts, such as "monotone:increasing"
    options: Mapping[str, Any] = field(default_factory=dict)  # arguments as on the command line
    data: Texts = ()  # labels of the data entries it is for; empty for all

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, raw: Any) -> Any:
        if not isinstance(raw, Mapping):
            return raw
        own = {key: value for key, value in raw.items() if key in KEYS["formulation"]}
        return own | {"options": {key: _plain(value) for key, value in raw.items() if key not in own}}

    @model_validator(mode="after")
    def _checked(self) -> "FormulationEntry":
        function = _formulation(self.formulation)
        takes = arguments(function)
        problems = [*argument_problems(self.formulation, function, self.options, KEYS["formulation"]),
                    *_unwritable(self.options)]
        if self.constraints and takes is not None and "constraints" not in takes:
            problems.append((("constraints",), f"formulation {self.formulation!r} takes no constraints"))
        for i, text in enumerate(self.constraints):
            try:
                named_constraint(text)
            except Exception as error:  # any error of a third-party builder
                problems.append((("constraints", i), str(error)))
        refuse(problems)
        _set(self, name=self.name or " + ".join([self.formulation, *self.constraints]))
        return self

    def is_for(self, entry: DataEntry) -> bool:
        """Whether it is run on a data entry."""
        return not self.data or entry.name in self.data


def _formulation(name: Any) -> Callable[..., Any]:
    known = find_entry_points(FORMULATIONS)
    if not name or not isinstance(name, str):
        refuse([((), "needs formulation = \"NAME\" (optid formulations lists them)")])
    if name not in known:
        refuse([(("formulation",), f"no formulation is called {name!r}. {nearest(name, known)}")])
    try:
        return known[name].load()
    except Exception as error:  # a broken plug-in
        refuse([(("formulation",), f"formulation {name!r} cannot be loaded: {type(error).__name__}: {error}")])
        raise


@dataclass(frozen=True)
class SolverEntry:
    """One entry of the solver axis."""

    name: str = ""  # its label; by default the solver's name
    solver: Text = ""  # name of the back end, or "auto"
    accuracy: Accuracies = ()  # requested accuracies in place of those of the study
    options: Mapping[str, Any] = field(default_factory=dict)  # native options of the solver

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, raw: Any) -> Any:
        if isinstance(raw, Mapping):
            refuse(unknown_keys(raw, KEYS["solver"], " Native options of the solver go into options = { ... }."))
        return _plain(raw)

    @model_validator(mode="after")
    def _checked(self) -> "SolverEntry":
        known, word = [AUTO, *back_ends()], self.solver.lower()
        problems: list[Problem] = [] if self.solver else [((), "needs solver = \"NAME\" (optid solvers lists them)")]
        if word and word not in known:
            problems.append((("solver",), f"no solver is called {self.solver!r}. {nearest(word, [*known, ALL])}"))
        for key in self.options:
            if key in SETTINGS:
                where = f"write {key} = ... beside solver" if key == "accuracy" else "it is a key of the study" \
                    if key in TOP else "the study sets it for every solver"
                problems.append((("options", key), f"options are the solver's own, and {key!r} is none: {where}"))
        refuse([*problems, *_unwritable(self.options, "options")])
        _set(self, name=self.name or self.solver, solver=word)
        return self


def _spread(value: Any, marks: Sequence[str], table: Callable[[Any], Any]) -> list[Any]:
    """Return the entries of an axis as tables: one, several, or {label: entry} where no key is a mark of a table."""
    if isinstance(value, Mapping) and not any(mark in value for mark in marks):
        return [{"name": str(label), **made} if isinstance(made := table(entry), Mapping) else entry
                for label, entry in value.items()]
    return [table(entry) for entry in (value if isinstance(value, list | tuple) else [value])]


def _data_axis(value: Any) -> list[Any]:
    def table(entry: Any) -> Any:
        if isinstance(entry, Data):
            return {"record": entry}
        if isinstance(entry, str | Path):
            known = isinstance(entry, str) and (entry in SYSTEMS or not PurePath(entry).suffix)
            return {"system" if known else "file": str(entry)}
        return entry

    return _spread(value, KEYS["data"], table)


def _formulations_of(table: Any, info: ValidationInfo) -> tuple[FormulationEntry, ...]:
    """Return the formulations of a table, one for each point of the grid over its arguments with several values."""
    data = info.data.get("data", ())
    several = _grid(table, data) if isinstance(table, Mapping) else [table]
    try:
        found = TypeAdapter(tuple[FormulationEntry, ...]).validate_python(several)
    except ValidationError as error:
        refuse(list(dict.fromkeys((keys[1:], text) for keys, text in problems_of(error))))
        raise
    names = [entry.name for entry in data]
    refuse([(("data", k), f"no [[data]] is called {label!r}. {nearest(label, names)}")
            for k, label in enumerate(found[0].data) if data and label not in names])
    return found


def _grid(table: Mapping[str, Any], data: Sequence[DataEntry]) -> list[dict[str, Any]]:
    """Return a table for every point of the grid over the arguments with several values."""
    table = {key: _plain(value) for key, value in table.items()}
    function, wanted = _formulation(table.get("formulation")), _several(table.get("data", ()))
    used = [entry for entry in data if not wanted or entry.name in wanted]
    found = []
    try:
        grid = points(function, table, bool(used) and all(entry.has_one_input for entry in used))
    except ValueError as error:
        refuse([((), str(error))])
        raise
    for point in grid:
        chosen = {key: value if isinstance(value, list) else [value] for key, value in point.items()}
        label = table.get("name") or " + ".join([table["formulation"], *_several(point.get(
            "constraints", table.get("constraints", ())))])
        found.append({**table, **point, "name": ", ".join([label, *(
            f"{key} = {'+'.join(map(str, value)) or 'none'}" for key, value in chosen.items())])})
    return found


def installed_solvers() -> list[str]:
    """Return the names of the installed back ends."""
    return [name for name, back_end in sorted(back_ends().items()) if back_end.installed]


def _solver_axis(value: Any) -> list[Any]:
    value = installed_solvers() if _plain(value) in (ALL, [ALL]) else _plain(value)
    return _spread(value, ("solver",), lambda entry: {"solver": entry} if isinstance(entry, str) else entry)


@dataclass(frozen=True, config=ConfigDict(arbitrary_types_allowed=True))
class Definition:
    """A grid of data x formulations x solvers x seeds, and the limits that hold for every cell; see `Study`."""

    name: Text
    data: Annotated[tuple[DataEntry, ...], Field(min_length=1), AfterValidator(_distinct), BeforeValidator(_data_axis)]
    formulations: Annotated[
        tuple[Annotated[Any, PlainValidator(_formulations_of)], ...], Field(min_length=1),
        AfterValidator(lambda several: _distinct(sum(several, ()))),
        BeforeValidator(lambda value: _spread(value, ("formulation",), lambda entry: entry))]
    solvers: Annotated[tuple[SolverEntry, ...], Field(min_length=1), AfterValidator(_distinct),
                       BeforeValidator(_solver_axis)]
    accuracy: Annotated[Accuracies, Field(min_length=1)] = (1e-8,)
    time_limit: Positive = 60.0
    memory_limit: Positive = 2000.0
    repetitions: Count = 1
    warm: Annotated[bool, Field(strict=True)] = False
    seeds: Seeds = (0,)
    holdout: Annotated[Number, Field(ge=0, lt=1)] = 0.3
    folder: Path = field(default_factory=Path, compare=False)

    def to_toml(self) -> str:
        """Return the study as the text of a study file, which `Study.from_text` reads back.

        Raises:
            StudyError: a record in memory, which no file holds.
        """
        import tomlkit

        text: dict[str, Any] = {f.name: _plain(getattr(self, f.name)) for f in fields(Definition)
                                if f.name not in ("data", "formulations", "solvers", "folder")}
        for key, entries in (("data", self.data), ("formulation", self.formulations), ("solver", self.solvers)):
            text[key] = [_table(entry) for entry in entries]
        return tomlkit.dumps(text)


def _table(entry: Any) -> dict[str, Any]:
    """Return the keys and values of an entry in a study file."""
    if getattr(entry, "record", None) is not None:
        raise StudyError(f"{entry.name!r} is a record in memory, which a study file cannot hold: write it to a file "
                         "and name that")
    found = {("file" if f.name == "files" else f.name): _plain(getattr(entry, f.name)) for f in fields(entry)}
    options = {} if isinstance(entry, SolverEntry) else found.pop("options")
    return {key: value for key, value in found.items() if value not in (None, [], {})} | options
