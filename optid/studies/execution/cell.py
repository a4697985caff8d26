"""Run one cell of a study: load its record, fit, validate the model on the hold-out samples, and return the row.

No failure of a fit raises an exception here. An endless loop or a segmentation fault is handled by the parent of the
worker: `lost_row` makes the row of a cell that returned none.
"""

import json
import time
import warnings
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from optid.core.statement import class_of, count_variables
from optid.errors import DataError, SolverMissing, SolverRefused
from optid.identify.fitting import Fit, fit
from optid.program.solution import Solution
from optid.registry import defaults, formulation
from optid.solving.claims import NOT_FINITE
from optid.solving.solve import solve
from optid.solving.steps import choose_solvers
from optid.studies.execution.machine import Peak, machine
from optid.studies.grid import Cell, content_hash, determining
from optid.studies.records import Record, load
from optid.studies.storage.rows import (
    DONE,
    ERROR,
    MEMORY_LIMIT,
    NAMES,
    NON_FINITE,
    REFUSED,
    SUCCESS,
    as_json,
    complete,
)

KEPT = 3  # records that a worker keeps, so that cells of one data set load it once
SHORTEST = 0.01  # smallest time limit of a solver in seconds: some take 0 as no limit
REHEARSED = 0.25  # share of the time limit up to which the first cell of its kind in a process is run twice

kept_row: Path | None = None
"""File for a row that is valid if the rest of the current cell fails, in a process of its own."""

_records: dict[tuple[Any, ...], Record] = {}
_rehearsed: set[tuple[str, str, bool]] = set()


def run_cell(cell: Cell) -> dict[str, Any]:
    """Run a cell and return its row, whatever the fit does.

    The first cell of a formulation and solver in a process is run twice if it is quick, and the second run counts: the
    times exclude importing a solver and loading compiled kernels. The solver's time limit is what loading the record
    left of the limit of the cell; the caller stops a process that exceeds it.
    """
    clock = time.perf_counter()
    row = _run(cell, clock)
    kind = (cell.formulation_name, cell.solver_name, cell.warm)
    if kind not in _rehearsed and row["outcome"] == DONE:
        _rehearsed.add(kind)  # what ended before its solver has imported nothing
        if row["total_s"] < REHEARSED * cell.time_limit:
            row = _run(cell, clock)
    return row


def _run(cell: Cell, given: float) -> dict[str, Any]:
    """Run a cell that this process was given at a moment of `time.perf_counter`."""
    started, clock = datetime.now(UTC), time.perf_counter()
    peak, fitted, limit = Peak(), None, cell.time_limit
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what weakens an answer is in the figures of the row
            record, seconds = _loaded(cell), time.perf_counter() - clock
            limit = max(cell.time_limit - (time.perf_counter() - given), SHORTEST)
            found, fitted = _cold(cell, record, limit)
            found["load_s"] = seconds
    except (SolverRefused, SolverMissing) as refusal:
        found = {"outcome": REFUSED, "reason": str(refusal)}
    except MemoryError as error:
        found = {"outcome": MEMORY_LIMIT, "reason": f"MemoryError: {error}"}
    except (Exception, SystemExit) as error:
        found = {"outcome": ERROR, "reason": f"{type(error).__name__}: {error}"}

    if held := _too_much(peak, cell):  # unseen by the parent; above the limit there is no result
        found, fitted = {"outcome": MEMORY_LIMIT, "reason": held}, None
    row = complete({**known_columns(cell), **found, "started": started.isoformat(), "peak_mb": peak.mb(),
                    "base_mb": peak.start, "total_s": time.perf_counter() - clock})
    if fitted is None:
        return row
    row = _warm(cell, fitted, row, limit, given)
    if held := _too_much(peak, cell):
        row = without_warm(row, held)
    return row | {"peak_mb": peak.mb(), "total_s": time.perf_counter() - clock}


def _too_much(peak: Peak, cell: Cell) -> str:
    held, most = peak.mb(), cell.memory_limit
    return f"held {held:.0f} MB; the limit is {most:g} MB" if held > most else ""


def keep(row: Mapping[str, Any]) -> None:
    """Keep the row of the current cell, valid if the rest of the cell fails; does nothing in the caller's process."""
    if kept_row is not None:
        kept_row.write_text(json.dumps(dict(row)))


@cache
def prepare() -> None:
    """Import what every fit needs and load compiled kernels, once in a process, so that no cell includes that time."""
    from optid.examples import dead_zone
    from optid.identify.validation.predictions import one_step, simulate_outputs

    data = dead_zone(n=100).data
    tried: dict[str, dict[str, Any]] = {"hammerstein_arx.exact": {"basis": "triangular:4"}, "arx": {}}
    for name, options in tried.items():
        model = fit(data, name, na=1, nb=1, prove=False, **options).model
        one_step(model, data)
        simulate_outputs(model, data)


def lost_row(cell: Cell, outcome: str, reason: str, *, started: datetime | None = None, total_s: float | None = None
             ) -> dict[str, Any]:
    """Return the row of a cell that returned none: the reason, its start (by default now) and its duration."""
    return complete({**known_columns(cell), "outcome": outcome, "reason": reason, "total_s": total_s,
                     "started": (started or datetime.now(UTC)).isoformat()})


def without_warm(row: Mapping[str, Any], reason: str) -> dict[str, Any]:
    """Return the row of the cold solve alone; the reason is why the second solve has no result."""
    words = "; ".join(filter(None, [row["reason"], f"no warm solve: {reason}"]))
    return {**row, **dict.fromkeys(("warm_s", "warm_status", "warm_iterations")), "reason": words}


def versions_of(cell: Cell) -> dict[str, str]:
    """Return the versions here of what determines the result of a cell."""
    return determining(cell.formulation_name, cell.solver_name, cell.data_source.system is not None)


def known_columns(cell: Cell) -> dict[str, Any]:
    """Return the columns of a cell that are known before it runs."""
    entry = cell.data_source
    found = {name: getattr(cell, name) for name in NAMES if hasattr(cell, name)}
    found["versions"] = versions_of(cell)
    found |= {name: as_json(found[name]) for name in ("options", "constraints", "solver_options", "versions")}
    return found | {"system": entry.system, "file": ", ".join(map(str, entry.files)) or None, "machine": machine(),
                    "data_hash": cell.data_hash or None, "n_estimation": cell.samples}


def _cold(cell: Cell, record: Record, limit: float) -> tuple[dict[str, Any], Fit | None]:
    """Return the columns of a fit, and the fit if it is to be solved again; `limit`: seconds for each programme."""
    data = record.data
    held = 0 if record.holdout is None else record.holdout.n_samples
    name, pose = formulation(cell.formulation_name)
    solvers = choose_solvers(name, pose, {**defaults(pose), **cell.options, "constraints": cell.constraints},
                             cell.solver_name)
    if solvers.skips_main:  # it would solve other steps than the one whose objective is compared
        raise SolverRefused(f"{cell.solver_name} does not take {solvers.main!r}, the main step of {name!r}")
    fitted = fit(data, cell.formulation_name, solver=cell.solver_name, accuracy=cell.accuracy, time_limit=limit,
                 isolate=False, constraints=cell.constraints, solver_options=dict(cell.solver_options), raises=False,
                 **cell.options)
    row: dict[str, Any] = {"n_samples": data.n_samples + held, "n_estimation": data.n_samples, "n_inputs": data.m,
                           "n_outputs": data.l, **_verdict(fitted)}
    remarks = [row["reason"]]
    if fitted.model is not None:
        row |= _figures(fitted.model, record, remarks)
    row["reason"] = "; ".join(filter(None, remarks)) or None
    row |= _finiteness(fitted, row)
    plain = fitted.outcome.evidence is None and len(fitted.steps) == 1 and fitted.solution.has_point
    return row, fitted if cell.warm and plain and row["outcome"] == DONE else None


def _loaded(cell: Cell) -> Record:
    """Return the record of a cell, kept from the last few that this worker loaded."""
    entry = cell.data_source
    identity = (cell.data_hash, entry.system, cell.samples, cell.noise, cell.seed, cell.holdout, as_json(entry.options))
    record = _records.pop(identity, None)
    if record is None and entry.files and content_hash(entry) != cell.data_hash:
        raise DataError(f"{', '.join(entry.files)}: not the content that the study started with; it changed since, "
                        "or this machine has another file of that name")
    _records[identity] = record or load(cell)  # the last one used at the end
    if len(_records) > KEPT:
        del _records[next(iter(_records))]
    return _records[identity]


def _verdict(fitted: Fit) -> dict[str, Any]:
    solution, problem = fitted.solution, fitted.problem
    bound, residuals = solution.bound, solution.residuals
    steps = [step for _, step in fitted.steps]
    counts, times = [step.iterations for step in steps], [step.times for step in steps]
    compiled = [t.compile for t in times if np.isfinite(t.compile)]  # where the back end reports it
    row = {
        "outcome": DONE, "status_claimed": solution.claimed, "status_verified": str(solution.status),
        "reason": solution.reason, "reached": str(solution.status) in SUCCESS, "proved": solution.proof,
        "false_claim": any(step.false_claim for step in steps), "solver_used": solution.solver,
        "program_class": class_of(problem), "unknowns": count_variables(problem), "n_programs": len(steps),
        "steps": as_json(_steps(fitted)),
        "objective": solution.objective, "scale": solution.scale, "bound": bound.value if bound else None,
        "gap": solution.gap, "iterations": sum(counts) if min(counts, default=-1) >= 0 else None,
        "build_s": solution.times.build, "compile_s": sum(compiled) if compiled else None,
        "solve_s": sum(t.solve for t in times) - sum(compiled), "judge_s": sum(t.judge for t in times),
        "prove_s": sum(t.prove for t in times) + solution.times.late, "fit_s": fitted.total_seconds,
    }
    if residuals is not None:
        row |= {name: getattr(residuals, name) for name in ("violation", "stationarity", "complementarity")}
    return row


def _steps(fitted: Fit) -> list[dict[str, Any]]:
    """Return one entry per step and solver of a fit."""
    groups: dict[tuple[str, str], list[Solution]] = {}
    for name, solution in fitted.steps:
        groups.setdefault((name, solution.solver), []).append(solution)
    return [{"step": step, "solver": solver, "programs": len(found),
             "reached": sum(str(one.status) in SUCCESS for one in found),
             "iterations": sum(one.iterations for one in found) if all(one.iterations >= 0 for one in found) else None,
             "seconds": sum(one.times.solve for one in found)} for (step, solver), found in groups.items()]


def _warm(cell: Cell, fitted: Fit, row: dict[str, Any], limit: float, given: float) -> dict[str, Any]:
    """Solve again from the solution, with the compiled programme.

    The row of the cold solve is valid whatever happens here: if the process dies, the parent has that row. The limit is
    that of the cold solve; with another one some back ends would compile again.
    """
    left = cell.time_limit - (time.perf_counter() - given)
    if left < fitted.solution.times.solve:
        return without_warm(row, f"{max(left, 0.0):.1f} s of the time limit were left, less than the cold one took")
    keep(row)
    problem = fitted.problem.beginning(fitted.solution.values)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            again: Solution = solve(problem, cell.solver_name, accuracy=cell.accuracy, time_limit=limit, isolate=False,
                                    prove=False, **cell.solver_options)
    except (Exception, SystemExit) as error:
        return without_warm(row, f"{type(error).__name__}: {error}")
    return complete({**row, "warm_s": again.times.solve, "warm_status": str(again.status),
                     "warm_iterations": again.iterations if again.iterations >= 0 else None})


def _figures(model: Any, record: Record, remarks: list[str | None]) -> dict[str, Any]:
    """Return the figures of a model; one that fails is left out, with a remark."""
    from optid.identify.validation import fit_percent
    from optid.identify.validation.predictions import one_step, simulate_outputs

    def attempt(what: str, compute: Callable[[], Any]) -> Any:
        try:
            with np.errstate(all="ignore"):
                return compute()
        except Exception as error:
            remarks.append(f"no {what}: {error}")
            return None

    row: dict[str, Any] = {}
    if record.holdout is not None:
        raw = record.holdout.raw()
        measured = np.vstack([e.y for e in raw.experiments])
        for name, what, outputs in (("one_step_fit", "one-step fit", one_step),
                                    ("simulation_fit", "simulation fit", simulate_outputs)):
            fits = attempt(what, lambda outputs=outputs: fit_percent(measured, np.vstack(outputs(model, raw))))
            if fits is not None:
                row |= {name: float(np.mean(fits)), f"{name}s": as_json(fits)}
    if (truth := record.truth) is not None:
        row["parameter_error"] = attempt("parameter error", lambda: truth.parameter_error(model))
        row["nonlinearity_error"] = attempt("nonlinearity error", lambda: truth.nonlinearity_error(model))
    poles = attempt("poles", lambda: np.atleast_1d(np.asarray(model.poles, dtype=complex)))
    if poles is not None:
        row |= {"poles": as_json([[p.real, p.imag] for p in poles.tolist()]), "stable": bool(np.all(np.abs(poles) < 1))}
    parameters = attempt("parameters", lambda: _parameters(model))
    return row | {"parameters": None if parameters is None else as_json(parameters)}


def _parameters(model: Any) -> Mapping[str, Any]:
    from optid.models.functions import static_functions

    named: dict[str, Any] = {name: float(value) for name, value in model.coefficients()}
    for function in static_functions(model):
        word = function.word.partition("_")[0].replace("f", "mu", 1).replace("g", "nu", 1).replace("h", "c", 1)
        named[f"{word}[{function.name}]"] = function.nonlinearity.mu.tolist()
    return named


def _finiteness(fitted: Fit, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the outcome of a fit whose point, objective or model has numbers that are not finite, else nothing.

    A procedure with a model is judged by that model, also where an earlier step was not finite.
    """
    solution, wrong = fitted.solution, []
    if solution.has_point and not np.isfinite(solution.objective):
        wrong.append(f"the objective is {solution.objective}")
    if np.isinf(row.get("one_step_fit") or 0.0):
        wrong.append("the predictions of the model are not finite")
    parameters = json.loads(row.get("parameters") or "{}")
    if not all(np.all(np.isfinite(np.array(value, dtype=float))) for value in parameters.values()):
        wrong.append("the model has parameters that are not finite")
    lost = fitted.model is None and any(step.reason.endswith(NOT_FINITE) for _, step in fitted.steps)
    return {"outcome": NON_FINITE, "reached": False, "proved": False,
            "reason": "; ".join(filter(None, [*wrong, row["reason"]]))} if wrong or lost else {}
