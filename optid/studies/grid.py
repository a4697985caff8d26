"""The grid of a study as cells, each with the hash of everything that determines its result."""

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from optid.backends.choice import find
from optid.data.record import Data
from optid.errors import SolverMissing, StudyError
from optid.studies.definition.description import DataEntry, FormulationEntry, SolverEntry, Study
from optid.studies.sources.systems import system
from optid.studies.versions import determining

KEY_VERSION = 1
"""Part of every key: to be counted up when what a key says changes its meaning."""


MOST = 1_000_000
"""Cells of a study: more would take months, and minutes to count one by one."""


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
        data_hash: sha256 of the data file, see `content_hash`; empty for a simulated system.
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


def cells(study: Study) -> list[Cell]:
    """Return the cells of a study: data x formulations x solvers x accuracies x seeds x repetitions.

    Cells of one record and formulation stand next to each other, so that a worker need not read or simulate it again.
    A solver that is not installed gives cells that are refused with the reason, and a pair of solver and formulation
    that do not fit is found out when the cell is run: what a study names always has a row.

    Args:
        study: what to expand.

    Raises:
        StudyError: more cells than `MOST`, data files that cannot be read, or entries that differ in nothing but their
            labels.
    """
    if (count := number_of_cells(study)) > MOST:
        raise StudyError(f"study {study.name!r} has {count:,} cells; at most {MOST:,} are taken. Make two of it")
    study.check_data()
    found: list[Cell] = []
    entries = [located(entry, study.folder) for entry in study.data]
    try:
        sources = [(entry, content_hash(entry)) for entry in entries]
    except OSError as error:  # it was there when the data were checked
        raise StudyError(f"study {study.name!r}: {error.filename} cannot be read: {error.strerror}") from error
    for (entry, content), samples, noise, seed in _records(sources, study.seeds):
        for formulation in study.formulations:
            if formulation.data and entry.name not in formulation.data:
                continue
            for solver in study.solvers:
                for accuracy in solver.accuracy or study.accuracy:
                    cell = _cell(study, entry, content, samples, noise, seed, formulation, solver, accuracy)
                    found += [replace(cell, repetition=number) for number in range(study.repetitions)]
    _check_distinct(found)
    return found


def number_of_cells(study: Study) -> int:
    """Return how many cells a study has, without making them."""
    count = 0
    for entry in study.data:
        records = 1 if entry.system is None else len(entry.samples or "1") * len(entry.noise or "1") * len(study.seeds)
        count += records * sum(not formulation.data or entry.name in formulation.data
                               for formulation in study.formulations)
    return count * study.repetitions * sum(len(solver.accuracy or study.accuracy) for solver in study.solvers)


def left(all_cells: Iterable[Cell], done: Collection[tuple[str, int]]) -> list[Cell]:
    """Return the cells that have no row yet.

    Args:
        all_cells: of the study.
        done: (key, repetition) of the rows there are.
    """
    return [cell for cell in all_cells if (cell.key, cell.repetition) not in done]


def check_unchanged(all_cells: Iterable[Cell], hashes: Mapping[tuple[str, str], Collection[str]]) -> None:
    """Refuse a study whose data files are not those of the rows there are.

    Args:
        all_cells: of the study.
        hashes: of the data behind the rows there are, by (study, data label).

    Raises:
        StudyError: names the files that changed.
    """
    changed = {}
    for cell in all_cells:
        if cell.data_hash and (known := hashes.get((cell.study, cell.data))) and set(known) != {cell.data_hash}:
            changed[cell.data] = ", ".join(cell.data_source.files) or "a record in memory"
    if changed:
        listed = "".join(f"\n  {label}: {files}" for label, files in changed.items())
        raise StudyError(f"data changed since the last run of study {next(iter(all_cells)).study!r}:{listed}\nRows of "
                         "the former content are in the database. --accept-changed-data (accept_changed_data=True) "
                         "runs these cells again and sets the former rows aside; or give another database")


def located(entry: DataEntry, folder: Path) -> DataEntry:
    """Return an entry with absolute file names."""
    return replace(entry, files=tuple(str((folder / name).resolve()) for name in entry.files))


def content_hash(entry: DataEntry) -> str:
    """Return the sha256 (hex) of a data file, of the sha256 of several, or of a record in memory.

    Args:
        entry: its file names absolute; empty is returned for a simulated system.

    Raises:
        OSError: a file cannot be read.
    """
    if entry.record is not None:
        return _hash_of_record(entry.record)
    digests = []
    for name in entry.files:
        with open(name, "rb") as file:
            digests.append(hashlib.file_digest(file, "sha256"))
    if len(digests) > 1:
        return hashlib.sha256(b"".join(digest.digest() for digest in digests)).hexdigest()
    return digests[0].hexdigest() if digests else ""


def _hash_of_record(data: Data) -> str:
    digest = hashlib.sha256()
    channels = (data.inputs, data.outputs, data.input_units, data.output_units, data.dt)
    digest.update(repr((channels, data.transform)).encode())
    for experiment in data.experiments:
        for array in (experiment.u, experiment.y):
            digest.update(repr(array.shape).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _records(sources: list[tuple[DataEntry, str]], seeds: tuple[int, ...]
             ) -> Iterator[tuple[tuple[DataEntry, str], int | None, float | None, int | None]]:
    """Every record of a study: (entry and hash), samples, noise, seed; None where they do not apply."""
    for entry, content in sources:
        if entry.system is None:
            yield (entry, content), None, None, None
            continue
        own = system(entry.system)
        for samples in entry.samples or (own.samples,):
            for noise in entry.noise or (own.noise,):
                for seed in seeds:
                    yield (entry, content), samples, noise, seed


def _cell(study: Study, entry: DataEntry, content: str, samples: int | None, noise: float | None, seed: int | None,
          formulation: FormulationEntry, solver: SolverEntry, accuracy: float) -> Cell:
    determined = {
        "key": KEY_VERSION,
        "data": content or [entry.system, samples, noise, seed],
        "reading": dict(entry.options),
        "holdout": study.holdout,
        "formulation": [formulation.formulation, dict(formulation.options), list(formulation.constraints)],
        "solver": [solver.solver, dict(solver.options)],
        "settings": [accuracy, study.warm, study.time_limit, study.memory_limit],
        "versions": determining(formulation.formulation, solver.solver, entry.system is not None),
    }
    text = json.dumps(determined, sort_keys=True, separators=(",", ":"), default=str)
    return Cell(
        key=hashlib.sha256(text.encode()).hexdigest(), repetition=0, study=study.name, data=entry.name,
        formulation=formulation.name, solver=solver.name, data_source=entry, data_hash=content, samples=samples,
        noise=noise, seed=seed, formulation_name=formulation.formulation, options=dict(formulation.options),
        constraints=formulation.constraints, solver_name=solver.solver, solver_options=dict(solver.options),
        accuracy=accuracy, warm=study.warm, time_limit=study.time_limit, memory_limit=study.memory_limit,
        holdout=study.holdout, refusal=_refusal(solver.solver),
    )


def _refusal(solver: str) -> str:
    """Why a back end cannot run here; empty for one that can, and for auto."""
    try:
        if solver != "auto":
            find(solver)
    except SolverMissing as error:
        return str(error)
    return ""


def _check_distinct(found: list[Cell]) -> None:
    seen: dict[tuple[str, int], Cell] = {}
    for cell in found:
        other = seen.setdefault((cell.key, cell.repetition), cell)
        if other is not cell:
            names = [f"{axis} {getattr(other, axis)!r} and {getattr(cell, axis)!r}"
                     for axis in ("data", "formulation", "solver") if getattr(other, axis) != getattr(cell, axis)]
            raise StudyError(f"study {cell.study!r} has the same cell twice: {', '.join(names)} differ in "
                             "nothing that determines the result. Leave one of them out")
