"""Checks before a study runs: unreadable data, impossible formulations, wrong options."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from optid.core.problem import Problem
from optid.core.statement import for_solvers
from optid.data.readers import Format
from optid.data.record import Data
from optid.errors import DataError, DataWarning, LookupFailed, StructureError
from optid.phrases import short
from optid.program.solution import Status
from optid.registry import formulation as look_up
from optid.registry import named_constraint
from optid.solving.solve import solve
from optid.studies.definition import DataEntry, Definition, FormulationEntry
from optid.studies.grid import with_absolute_paths
from optid.studies.messages import refuse_study
from optid.studies.records import read_entry
from optid.studies.sources.systems import simulate, system

SHORT = 300  # samples on which a formulation, and the options of a solver, are tried
TRIAL = 20.0  # seconds that a trial of options may take
LONGEST = 300  # characters of the message of a solver that fails

Problems = list[tuple[str, str]]
"""Keys as in a study file, and what is wrong with the value."""
Records = dict[str, Data]
"""The whole records of a study that are not simulated, by their labels."""


def check_data(study: Definition, label: str = "") -> None:
    """Raise `StudyError` for unreadable data, impossible formulations and wrong options; a study is checked once."""
    if not vars(study).get("_data_checked"):
        refuse_study(label or f"study {study.name!r}", _data_problems(study))
        object.__setattr__(study, "_data_checked", True)


def _data_problems(study: Definition) -> Problems:
    """Return unreadable data or, if there are none, impossible formulations and wrong options."""
    records: Records = {}
    problems = [one for i, entry in enumerate(study.data)
                for one in _unreadable(f"data[{i}]", entry, study.folder, records)]
    return problems or [*_impossible(study, records), *_wrong_options(study, records)]


def _unreadable(key: str, entry: DataEntry, folder: Path, records: Records) -> Problems:
    """Read an entry that is not simulated, or return what is wrong with its files at the key that causes it."""
    from optid.data.reading.columns import choose
    from optid.data.reading.sources import open_tables

    words = {f.name: entry.options[f.name] for f in fields(Format) if f.name in entry.options}
    at = f"{key}.file"
    try:
        for number, name in enumerate(entry.files):
            at = f"{key}.file[{number}]"
            table = open_tables(folder / name, Format(**words))[0]
            for channels, letter in (("inputs", "u"), ("outputs", "y")):
                at = f"{key}.{channels}"
                choose(table.names, entry.options.get(channels), letter, table.label)
        at = f"{key}.file"
        if entry.system is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DataWarning)  # repeated when the record is used
                records[entry.name] = read_entry(with_absolute_paths(entry, folder))
    except DataError as error:
        return [(at, str(error))]
    return []


def _beginning(entry: DataEntry, records: Records, samples: float = SHORT) -> Data:
    """Return the beginning of a record, or a simulated one, of so many samples at most."""
    if entry.system is not None:
        longest = max(entry.samples or (system(entry.system).samples,))
        return simulate(entry.system, int(min(samples, longest)))[0]
    whole = records[entry.name]
    is_short = whole.experiments[0].n_samples <= samples
    return whole if is_short else whole.select(experiments=0).window(0, int(samples))


def _impossible(study: Definition, records: Records) -> Problems:
    """Return the formulations whose arguments or constraints do not fit any of their data.

    Each is built on a short record; what only a longer one can show becomes a row of the run.
    """
    found = []
    for entry in study.formulations:
        its_data = [one for one in study.data if entry.is_for(one)]
        if all(_refusal(entry, _beginning(one, records)) for one in its_data):
            reasons = [_refusal(entry, _beginning(one, records, np.inf)) for one in its_data]  # was it too short?
            if reasons and all(reasons):
                found.append((f"formulation[{entry.name!r}]", f"the formulation does not fit the data: {reasons[0]}"))
    return found


def _refusal(entry: FormulationEntry, record: Data) -> str:
    """Return why a formulation rejects its arguments on a record; empty if it does not, or if that is unknown."""
    try:
        _first_programme(entry, record)
    except (StructureError, LookupFailed) as error:
        return str(error)
    except Exception:  # a short record or a defect: the row of the run has it
        pass
    return ""


def _first_programme(entry: FormulationEntry, record: Data) -> Any:
    """Return the programme of a formulation on a record, or the first one of a procedure."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = build_problem(entry.formulation, record, entry.constraints, entry.options)
        return for_solvers(made if isinstance(made, Problem) else next(made))


def build_problem(formulation: str, record: Data, constraints: Sequence[str], options: Mapping[str, Any]) -> Any:
    """Return the problem, or procedure, of a registered formulation with named constraints on a record."""
    named = tuple(named_constraint(text) for text in constraints)
    return look_up(formulation)[1](record, **options, **({"constraints": named} if named else {}))


def _wrong_options(study: Definition, records: Records) -> Problems:
    """Return the options with which a solver fails on a short record that it solves without them."""
    found: Problems = []
    for entry in study.solvers:
        programme = next(_solved_without(entry.solver, study, records), None) if entry.options else None
        if programme is None or not (all_fail := _failure(programme, entry.solver, entry.options)):
            continue
        alone = {key: _failure(programme, entry.solver, {key: value}) for key, value in entry.options.items()}
        at, without = f"solver[{entry.name!r}].options", f"{entry.solver} fail where it succeeds without"
        found += [(f"{at}.{key}", f"{key} makes {without}: {why}") for key, why in alone.items() if why]
        if not any(alone.values()):
            found.append((at, f"these options make {without}: {all_fail}"))
    return found


def _solved_without(solver: str, study: Definition, records: Records) -> Iterator[Any]:
    """Yield programmes on short records that a solver solves without any option."""
    for entry in study.formulations:
        for one in filter(entry.is_for, study.data):
            try:
                programme = _first_programme(entry, _beginning(one, records))
                if _solve(programme, solver, {}).status in (Status.OPTIMAL, Status.LOCAL):
                    yield programme
            except Exception:  # not built, not installed, not for this formulation
                continue


def _failure(programme: Any, solver: str, options: Mapping[str, Any]) -> str:
    """Return why a solver ends without a point; empty if it has one, or ran out of time."""
    found = _solve(programme, solver, options)
    if found.status is not Status.FAILED or found.has_point:
        return ""
    return short(" ".join(found.reason.split()) or "no reason given", LONGEST)


def _solve(programme: Any, solver: str, options: Mapping[str, Any]) -> Any:
    """Solve in a separate process: options may crash a solver, or keep it from ending."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return solve(programme, solver, time_limit=TRIAL, prove=False, **options)
