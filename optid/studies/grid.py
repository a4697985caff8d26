"""The grid of a study as cells, each with the hash of everything that determines its result."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from optid.studies.description import DataEntry


@dataclass(frozen=True)
class Cell:
    """One run: a record, a formulation with its options, a solver with its settings. Picklable; rows come from it.

    Attributes:
        key: sha256 (hex) of everything that determines the result, the machine excepted; the same for all repetitions.
        repetition: counted from 0; (key, repetition) identifies a row.
        study: title of the study.
        data: label of the data entry.
        formulation: label of the formulation entry.
        solver: label of the solver entry.
        data_source: where the record comes from, its file names absolute.
        data_hash: sha256 of the bytes of the files or of the record in memory; empty for a simulated system.
        samples: length of a simulated record; None for a file.
        noise: relative standard deviation of its noise; None for a file.
        seed: of its simulation; None for a file.
        formulation_name: registered name.
        options: arguments of the formulation.
        constraints: named constraints as texts.
        solver_name: word of the back end, or "auto".
        solver_options: its native options.
        accuracy: requested relative accuracy.
        warm: whether it is also solved a second time from its own solution.
        time_limit: seconds.
        memory_limit: MB.
        holdout: share of the record that the fit does not see.
        refusal: why the solver cannot take this formulation: nothing is run, the row says so. Empty otherwise.
    """

    key: str
    repetition: int
    study: str
    data: str
    formulation: str
    solver: str
    data_source: DataEntry
    data_hash: str
    samples: int | None
    noise: float | None
    seed: int | None
    formulation_name: str
    options: Mapping[str, Any]
    constraints: tuple[str, ...]
    solver_name: str
    solver_options: Mapping[str, Any]
    accuracy: float
    warm: bool
    time_limit: float
    memory_limit: float
    holdout: float
    refusal: str = ""
