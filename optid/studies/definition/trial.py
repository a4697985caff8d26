"""Checks before a study runs: unreadable data, impossible formulations, wrong options."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optid.core.program import Program, programme_of
from optid.data.record import Data
from optid.errors import DataError, DataWarning, LookupFailed, StructureError
from optid.phrases import short
from optid.program.solution import Status
from optid.registry import formulation as look_up
from optid.registry import named_constraint
from optid.solving.solve import solve
from optid.studies.definition.description import DataEntry, FormulationEntry, SolverEntry
from optid.studies.definition.problems import Label, Problems
from optid.studies.definition.problems import Path as Keys
from optid.studies.sources.systems import simulate, system

SHORT = 300  # samples on which a formulation, and the options of a solver, are tried
TRIAL = 20.0  # seconds that a trial of options may take
LONGEST = 300  # characters of the message of a solver that fails


def note_all(folder: Path, data: Sequence[DataEntry], formulations: Sequence[FormulationEntry],
             solvers: Sequence[SolverEntry], problems: Problems) -> None:
    """Note unreadable data and, if there are no problems, impossible formulations and wrong options.

    Relative files are in the folder; data entries with problems are skipped.
    """
    records, wrong = _Records(folder), {path[:2] for path, _ in problems}
    for i, entry in enumerate(data):
        if ("data", i) not in wrong:
            _note_unreadable(("data", i), entry, records, problems)
    if not problems:
        note_impossible(data, formulations, records, problems)
        note_wrong_options(data, formulations, solvers, records, problems)


class _Records:

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._read: dict[str, Data] = {}

    def read(self, entry: DataEntry) -> Data:
        """The whole record of an entry that is not simulated."""
        from optid.studies.grid import located
        from optid.studies.sources.records import read_entry

        if entry.name not in self._read:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DataWarning)  # repeated when the record is used
                self._read[entry.name] = read_entry(located(entry, self.folder))
        return self._read[entry.name]

    def beginning(self, entry: DataEntry, samples: float = SHORT) -> Data:
        """The beginning of a record, or a simulated one, of so many samples at most."""
        if entry.system is not None:
            longest = max(entry.samples or (system(entry.system).samples,))
            return simulate(entry.system, int(min(samples, longest)))[0]
        whole = self.read(entry)
        short = whole.experiments[0].n_samples <= samples
        return whole if short else whole.select(experiments=0).window(0, int(samples))


def _note_unreadable(path: Keys, entry: DataEntry, records: _Records, problems: Problems) -> None:
    """Note problems with the files of an entry, at the key that causes them."""
    from optid.data.reading.columns import choose
    from optid.data.reading.format import Format
    from optid.data.reading.sources import open_tables

    options, at = dict(entry.options), (*path, "file")
    try:
        for number, name in enumerate(entry.files):
            at = (*path, "file", number)
            words = {word: value for word, value in options.items() if word in Format.__dataclass_fields__}
            table = open_tables(records.folder / name, Format(**words))[0]
            for key, letter in (("inputs", "u"), ("outputs", "y")):
                at = (*path, key)
                choose(table.names, options.get(key), letter, table.label)
        at = (*path, "file")
        if entry.files:
            records.read(entry)
    except DataError as error:
        problems.append((at, str(error)))


def note_impossible(data: Sequence[DataEntry], formulations: Sequence[FormulationEntry], records: _Records,
                    problems: Problems) -> None:
    """Note the formulations whose arguments or constraints do not fit any of their data.

    Each is built on a short record; what only a longer one can show becomes a row of the run.
    """
    for entry in formulations:
        its_data = [one for one in data if entry.is_for(one)]
        if all(_refused(entry, records.beginning(one)) for one in its_data):
            reasons = [_refused(entry, records.beginning(one, np.inf)) for one in its_data]  # was it too short?
            if reasons and all(reasons):
                text = f"the formulation does not fit the data: {reasons[0]}"
                problems.append((("formulation", Label(entry.name)), text))


def _refused(entry: FormulationEntry, record: Data) -> str:
    """Return why a formulation rejects its arguments on a record; empty if it does not, or if that is unknown."""
    try:
        _posed(entry, record)
    except (StructureError, LookupFailed) as error:
        return str(error)
    except Exception:  # a short record or a defect: the row of the run has it
        pass
    return ""


def _posed(entry: FormulationEntry, record: Data) -> Any:
    """Return the programme of a formulation on a record, or the first one of a procedure."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem = programme_of(posed(entry.formulation, record, entry.constraints, entry.options))
        return problem if isinstance(problem, Program) else programme_of(next(problem))


def posed(formulation: str, record: Data, constraints: Sequence[str], options: Mapping[str, Any]) -> Any:
    """Return the programme, or procedure, of a registered formulation with named constraints on a record."""
    named = tuple(named_constraint(text) for text in constraints)
    return look_up(formulation)[1](record, **options, **({"constraints": named} if named else {}))


def note_wrong_options(data: Sequence[DataEntry], formulations: Sequence[FormulationEntry],
                       solvers: Sequence[SolverEntry], records: _Records, problems: Problems) -> None:
    """Note the options with which a solver fails on a short record that it solves without them."""
    for entry in solvers:
        if not entry.options:
            continue
        programme = next(_solved_without(entry.solver, data, formulations, records), None)
        if programme is None or not (all_fail := _failure(programme, entry.solver, entry.options)):
            continue
        alone = {key: _failure(programme, entry.solver, {key: value}) for key, value in entry.options.items()}
        path, without = ("solver", Label(entry.name), "options"), f"{entry.solver} fail where it succeeds without"
        for key, why in alone.items():
            if why:
                problems.append(((*path, key), f"{key} makes {without}: {why}"))
        if not any(alone.values()):
            problems.append((path, f"these options make {without}: {all_fail}"))


def _solved_without(solver: str, data: Sequence[DataEntry], formulations: Sequence[FormulationEntry], records: _Records
                    ) -> Iterator[Any]:
    """Programmes on short records that a solver solves without any option."""
    for entry in formulations:
        for one in filter(entry.is_for, data):
            try:
                programme = _posed(entry, records.beginning(one))
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
