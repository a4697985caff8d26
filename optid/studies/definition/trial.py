"""What can be found out before a study runs: data that cannot be read, models that cannot be posed, wrong options."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.errors import DataError, DataWarning, LookupFailed, StructureError
from optid.program.solution import Status
from optid.registry import formulation as look_up
from optid.registry import named_constraint
from optid.solving.solve import solve
from optid.studies.definition.description import DataEntry, FormulationEntry, SolverEntry
from optid.studies.definition.problems import Label, Problems
from optid.studies.sources.systems import simulate, system

SHORT = 300
"""Samples on which a formulation, and the options of a solver, are tried."""
TRIAL = 20.0
"""Seconds that a trial of options may take; whoever needs longer is left to the run."""
LONGEST = 300
"""Characters of the words of a solver that fails."""


class Records:
    """The records of data entries, each read once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[str, Data] = {}

    def path(self, name: str) -> Path:
        """Return where a file of the study is."""
        return self._folder / name

    def read(self, entry: DataEntry) -> Data:
        """Return the whole record of an entry that is not simulated.

        Raises:
            DataError: what `optid.read` refuses.
        """
        from optid.studies.grid import located
        from optid.studies.sources.records import read_entry

        if entry.name not in self._read:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DataWarning)  # they are told when the record is used
                self._read[entry.name] = read_entry(located(entry, self._folder))
        return self._read[entry.name]

    def beginning(self, entry: DataEntry, samples: float = SHORT) -> Data:
        """Return the beginning of a record, or a simulated one, of so many samples at most.

        Raises:
            DataError: what `optid.read` refuses.
        """
        if entry.system is not None:
            longest = max(entry.samples or (system(entry.system).samples,))
            return simulate(entry.system, int(min(samples, longest)))[0]
        whole = self.read(entry)
        first = whole.experiments[0]
        if first.n_samples <= samples:
            return whole
        kept = int(samples)
        return Data(first.u[:kept], first.y[:kept], whole.dt, inputs=whole.inputs, outputs=whole.outputs)


def note_unreadable(entries: Sequence[DataEntry], records: Records, problems: Problems,
                    wrong: set[tuple[str | int, ...]] | None = None) -> None:
    """Note the data entries whose files cannot be read.

    Args:
        entries: of the study.
        records: where they are read.
        problems: collects what is wrong.
        wrong: paths of entries whose keys are known to be wrong: they are left alone.
    """
    for i, entry in enumerate(entries):
        if ("data", i) not in (wrong or ()):
            _note_trouble(("data", i), entry, records, problems)


def _note_trouble(path: tuple[str | int, ...], entry: DataEntry, records: Records, problems: Problems) -> None:
    """Note what is wrong with the files of one entry, at the key that is to blame."""
    from optid.data.reading.columns import choose
    from optid.data.reading.sources import open_table

    options, key = dict(entry.options), "file"
    for number, name in enumerate(entry.files):
        try:
            table = open_table(records.path(name), options.get("columns"), options.get("delimiter", ","),
                               options.get("decimal", "."))
            for key, letter in (("inputs", "u"), ("outputs", "y")):
                choose(table.names, options.get(key), letter, table.label)
            key = "file"
        except DataError as error:
            problems.add((*path, key, number) if key == "file" else (*path, key), str(error))
            return
    try:
        if entry.files:
            records.read(entry)
    except DataError as error:
        problems.add((*path, "file"), str(error))


def note_impossible(data: Sequence[DataEntry], formulations: Sequence[FormulationEntry], records: Records,
                    problems: Problems) -> None:
    """Note the formulations whose arguments or constraints do not fit any of their data.

    Each is posed on a short record; what only a longer one can tell is left to the run, where it becomes a row.

    Args:
        data: entries of the study.
        formulations: entries of the study.
        records: where data are read.
        problems: collects what is wrong.
    """
    for entry in formulations:
        records_of = [one for one in data if not entry.data or one.name in entry.data]
        if not all(_refused(entry, records.beginning(one)) for one in records_of):
            continue
        reasons = [_refused(entry, records.beginning(one, np.inf)) for one in records_of]  # was it too short?
        if reasons and all(reasons):
            problems.add(("formulation", Label(entry.name)), f"the formulation cannot be posed: {reasons[0]}")


def _refused(entry: FormulationEntry, record: Data) -> str:
    """Why a formulation does not accept its arguments on a record; empty where it does, or where that is not known."""
    try:
        _posed(entry, record)
    except (StructureError, LookupFailed) as error:
        return str(error)
    except Exception:  # a record that is too short, a defect: the run will tell
        return ""
    return ""


def _posed(entry: FormulationEntry, record: Data) -> Any:
    """Return the programme of a formulation on a record, the first one of a procedure."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        constraints = tuple(named_constraint(text) for text in entry.constraints)
        more = {"constraints": constraints} if constraints else {}
        problem = look_up(entry.formulation)[1](record, **entry.options, **more)
        return problem if hasattr(problem, "view") else next(problem)


def note_wrong_options(data: Sequence[DataEntry], formulations: Sequence[FormulationEntry],
                       solvers: Sequence[SolverEntry], records: Records, problems: Problems) -> None:
    """Note the options with which a solver fails on a short record that it solves without them.

    Args:
        data: entries of the study.
        formulations: entries of the study.
        solvers: entries of the study.
        records: where data are read.
        problems: collects what is wrong.
    """
    for entry in solvers:
        if not entry.options:
            continue
        programme = next(_solved_without(entry.solver, data, formulations, records), None)
        if programme is None or not (all_fail := _failure(programme, entry.solver, entry.options)):
            continue
        alone = {key: _failure(programme, entry.solver, {key: value}) for key, value in entry.options.items()}
        path = ("solver", Label(entry.name), "options")
        for key, why in alone.items():
            if why:
                problems.add((*path, key), f"{key} makes {entry.solver} fail where it succeeds without: {why}")
        if not any(alone.values()):
            problems.add(path, f"these options make {entry.solver} fail where it succeeds without: {all_fail}")


def _solved_without(solver: str, data: Sequence[DataEntry], formulations: Sequence[FormulationEntry], records: Records
                    ) -> Iterator[Any]:
    """Programmes on short records that a solver solves without any option."""
    for entry in formulations:
        for one in data:
            if not entry.data or one.name in entry.data:
                try:
                    programme = _posed(entry, records.beginning(one))
                    solved = _solve(programme, solver, {}).status in (Status.OPTIMAL, Status.LOCAL)
                except Exception:  # not posed, not installed, not for this formulation
                    continue
                if solved:
                    yield programme


def _failure(programme: Any, solver: str, options: Mapping[str, Any]) -> str:
    """Why a solver ends without a point; empty where it has one, or ran out of time."""
    found = _solve(programme, solver, options)
    if found.status is not Status.FAILED or found.has_point:
        return ""
    reason = " ".join(found.reason.split()) or "it does not say why"
    return reason if len(reason) <= LONGEST else reason[: LONGEST - 1] + "…"


def _solve(programme: Any, solver: str, options: Mapping[str, Any]) -> Any:
    """Solve in a process of its own: options may crash a solver, or never let it end."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return solve(programme, solver, time_limit=TRIAL, prove=False, **options)
