"""The cells of a study, each with the hash of everything that determines its result, versions included."""

import hashlib
import inspect
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from optid.backends.choice import AUTO, back_ends, find
from optid.errors import SolverMissing, StudyError
from optid.registry import FORMULATIONS, find_entry_points
from optid.studies.definition import DataEntry, Definition, FormulationEntry, SolverEntry
from optid.studies.sources.systems import system

KEY_VERSION = 1  # part of every key, to be increased if the meaning of keys changes
ALWAYS = ("optid", "numpy", "scipy", "cvxpy")  # distributions behind every result
MOST = 1_000_000  # cells of a study


@dataclass(frozen=True)
class Cell:
    """One run: a record, a formulation with its options, a solver with its settings. Picklable; rows come from it."""

    key: str  # sha256 (hex) of everything that determines the result, the machine excepted; the same for repetitions
    repetition: int  # from 0; (key, repetition) identifies a row
    study: str  # title of the study
    data: str  # label of the data entry
    formulation: str  # label of the formulation entry
    solver: str  # label of the solver entry
    data_source: DataEntry  # where the record comes from, its file names absolute
    data_hash: str  # sha256 of the data file, see `content_hash`; empty for a simulated system
    samples: int | None  # length of a simulated record; None for a file, as the two that follow
    noise: float | None  # relative standard deviation of its noise
    seed: int | None  # of its simulation
    formulation_name: str  # registered name
    options: Mapping[str, Any]  # arguments of the formulation
    constraints: tuple[str, ...]  # named constraints as texts
    solver_name: str  # name of the back end, or "auto"
    solver_options: Mapping[str, Any]  # its native options
    accuracy: float  # requested relative accuracy
    warm: bool  # whether it is also solved a second time from its own solution
    time_limit: float  # seconds
    memory_limit: float  # MB
    holdout: float  # share of the record that the fit does not see
    refusal: str = ""  # why the cell is not run; empty if it is

    @property
    def identity(self) -> tuple[str, int]:
        """Key and repetition, which identify a row of a study."""
        return self.key, self.repetition


def cells(study: Definition) -> list[Cell]:
    """Return the cells of a study: data x formulations x solvers x accuracies x seeds x repetitions.

    Cells of one record and formulation are neighbours, so that a worker need not load it again. A solver that is not
    installed, or does not take the formulation, still has rows, with the reason.

    Raises:
        StudyError: more cells than `MOST`, a file that cannot be read, or entries that differ only in their labels.
    """
    if (count := number_of_cells(study)) > MOST:
        raise StudyError(f"study {study.name!r} has {count:,} cells; at most {MOST:,} are allowed: split it")
    entries = [with_absolute_paths(entry, study.folder) for entry in study.data]
    try:
        contents = [content_hash(entry) for entry in entries]
    except OSError as error:  # it was there when the data were checked
        raise StudyError(f"study {study.name!r}: {error.filename} cannot be read: {error.strerror}") from error
    found: dict[str, Cell] = {}
    for entry, content in zip(entries, contents):
        formulations = [one for one in study.formulations if one.is_for(entry)]
        for record, formulation, solver in product(_records(entry, study.seeds), formulations, study.solvers):
            for accuracy in solver.accuracy or study.accuracy:
                cell = _cell(study, entry, content, record, formulation, solver, accuracy)
                other = found.setdefault(cell.key, cell)
                if other is not cell:
                    names = [f"{axis} {getattr(other, axis)!r} and {getattr(cell, axis)!r}" for axis in (
                        "data", "formulation", "solver") if getattr(other, axis) != getattr(cell, axis)]
                    raise StudyError(f"study {cell.study!r} has the same cell twice: {', '.join(names)} differ in "
                                     "nothing that determines the result. Leave one of them out")
    return [replace(cell, repetition=k) for cell in found.values() for k in range(study.repetitions)]


def number_of_cells(study: Definition) -> int:
    """Return the number of cells of a study."""
    count = 0
    for entry in study.data:
        records = 1 if entry.system is None else len(entry.samples or "1") * len(entry.noise or "1") * len(study.seeds)
        count += records * sum(formulation.is_for(entry) for formulation in study.formulations)
    return count * study.repetitions * sum(len(solver.accuracy or study.accuracy) for solver in study.solvers)


def check_unchanged(all_cells: Iterable[Cell], hashes: Mapping[tuple[str, str], Collection[str]]) -> None:
    """Raise StudyError if data files differ from those of the rows, given by hashes by (study, data label)."""
    changed = {}
    for cell in all_cells:
        if cell.data_hash and (known := hashes.get((cell.study, cell.data))) and set(known) != {cell.data_hash}:
            changed[cell.data] = ", ".join(cell.data_source.files) or "a record in memory"
    if changed:
        listed = "".join(f"\n  {label}: {files}" for label, files in changed.items())
        raise StudyError(f"data changed since the last run of study {next(iter(all_cells)).study!r}:{listed}\nRows of "
                         "the former content are in the database. --accept-changed-data (accept_changed_data=True) "
                         "runs these cells again and sets the former rows aside; or give another database")


def with_absolute_paths(entry: DataEntry, folder: Path) -> DataEntry:
    """Return an entry with absolute file names."""
    return replace(entry, files=tuple(str((folder / name).resolve()) for name in entry.files)) if entry.files else entry


def content_hash(entry: DataEntry) -> str:
    """Return the sha256 (hex) of a data file, of the sha256 of several, or of a record in memory; "" if simulated.

    Raises:
        OSError: a file, whose name must be absolute, cannot be read.
    """
    if (data := entry.record) is not None:
        digest = hashlib.sha256()
        channels = (data.inputs, data.outputs, data.input_units, data.output_units, data.dt)
        digest.update(repr((channels, data.transform)).encode())
        for array in (array for experiment in data.experiments for array in (experiment.u, experiment.y)):
            digest.update(repr(array.shape).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()
    digests = [_file_digest(name) for name in entry.files]
    return hashlib.sha256(b"".join(digests)).hexdigest() if len(digests) > 1 else b"".join(digests).hex()


def _file_digest(name: str) -> bytes:
    with open(name, "rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


_Simulated = tuple[int | None, float | None, int | None]
"""Samples, noise and seed of a simulated record; None for another."""


def _records(entry: DataEntry, seeds: tuple[int, ...]) -> Iterable[_Simulated]:
    if entry.system is None:
        return [(None, None, None)]
    own = system(entry.system)
    return product(entry.samples or (own.samples,), entry.noise or (own.noise,), seeds)


def _cell(study: Definition, entry: DataEntry, content: str, record: _Simulated, formulation: FormulationEntry,
          solver: SolverEntry, accuracy: float) -> Cell:
    """Return the first repetition of a cell."""
    samples, noise, seed = record
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
        holdout=study.holdout, refusal=_refusal(solver.solver))


def _refusal(solver: str) -> str:
    """Return why a back end cannot run here; empty if it can, and for auto."""
    try:
        if solver != "auto":
            find(solver)
    except SolverMissing as error:
        return str(error)
    return ""


# -- versions -------------------------------------------------------------------------------------------------------


@cache
def determining(formulation: str, solver: str, simulated: bool = False) -> dict[str, str]:
    """Return the versions that determine a result, by name.

    They are those of a registered formulation (its distribution and source), of a back end (for "auto" all that it
    chooses from) and, for a simulated record, the source of the systems.
    """
    found = {name: installed_version(name) for name in ALWAYS}
    point = find_entry_points(FORMULATIONS)[formulation]
    if point.dist is not None:
        found[point.dist.name] = point.dist.version
    found[f"source of {formulation}"] = source_hash(point.value.partition(":")[0])
    for name in sorted({name for names in AUTO.values() for name in names}) if solver == "auto" else (solver,):
        found |= _of_back_end(name)
    if simulated:
        found["source of the systems"] = source_hash("optid.studies.sources.systems")
    return found


def installed_version(distribution: str) -> str:
    """Return the version of a distribution, or "not installed"."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


@cache
def source_hash(module: str) -> str:
    """Return the first 16 digits of the sha256 of a module's source; "unknown" where there is none."""
    from importlib.util import find_spec

    spec = find_spec(module)
    if spec is None or spec.origin is None:
        return "unknown"
    try:
        return _file_digest(spec.origin).hex()[:16]
    except OSError:
        return "unknown"


def _of_back_end(name: str) -> dict[str, str]:
    """Return the versions of a back end's distributions and the hash of its source, which may be edited in place."""
    back_end = back_ends().get(name)
    if back_end is None:
        return {}
    module = getattr(inspect.getmodule(back_end.run), "__name__", "")
    distributions = {*back_end.pip.split(), *packages_of(module.partition(".")[0])}
    found = {distribution: installed_version(distribution) for distribution in sorted(distributions)}
    return found | {f"source of {name}": source_hash(module)}


@cache
def packages_of(package: str) -> tuple[str, ...]:
    """Return the distributions that hold a top-level package."""
    return tuple(sorted(set(packages_distributions().get(package, ()))))
