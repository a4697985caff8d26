"""What a study is made of: data, formulations and solvers with their labels, and what holds for every cell."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from optid.data import Data


@dataclass(frozen=True)
class DataEntry:
    """One entry of the data axis: a file, a record in memory, or a simulated system at several lengths and noises.

    Attributes:
        name: its label.
        files: data files, one experiment each, relative to the folder of the study.
        system: name of a simulated system (`optid.studies.systems`).
        record: a record in memory, from Python only.
        samples: lengths of the simulated records; empty for the system's own.
        noise: standard deviations of the noise relative to the noise-free output; empty for the system's own.
        options: how the file is read: inputs, outputs, dt, time, experiment, columns, delimiter, decimal.
    """

    name: str
    files: tuple[str, ...] = ()
    system: str | None = None
    record: Data | None = field(default=None, repr=False, compare=False)
    samples: tuple[int, ...] = ()
    noise: tuple[float, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FormulationEntry:
    """One entry of the formulation axis.

    Attributes:
        name: its label.
        formulation: registered name.
        constraints: named constraints as texts, such as "monotone:increasing".
        options: arguments of the formulation in the words of the command line, such as basis = "triangular:8".
    """

    name: str
    formulation: str
    constraints: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SolverEntry:
    """One entry of the solver axis.

    Attributes:
        name: its label.
        solver: word of the back end, or "auto".
        accuracy: requested accuracies in place of those of the study.
        options: native options of the solver.
    """

    name: str
    solver: str
    accuracy: tuple[float, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """A grid of data x formulations x solvers x seeds, and the limits that hold for every cell.

    Attributes:
        name: title of the study.
        data: the data axis.
        formulations: the formulation axis.
        solvers: the solver axis.
        accuracy: requested relative accuracies; every solver is run at each.
        time_limit: seconds a cell may take.
        memory_limit: MB a cell may take.
        repetitions: how often a cell is run, for its times.
        warm: whether a cell is also solved a second time from its own solution.
        seeds: of the simulated records.
        holdout: share of a record that the fit does not see.
        folder: where relative file names start.
    """

    name: str
    data: tuple[DataEntry, ...]
    formulations: tuple[FormulationEntry, ...]
    solvers: tuple[SolverEntry, ...]
    accuracy: tuple[float, ...] = (1e-8,)
    time_limit: float = 60.0
    memory_limit: float = 2000.0
    repetitions: int = 1
    warm: bool = False
    seeds: tuple[int, ...] = (0,)
    holdout: float = 0.3
    folder: Path = field(default_factory=Path, compare=False)
