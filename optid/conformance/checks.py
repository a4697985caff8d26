"""Conformance of back ends and formulations, judged by our residuals; third parties can run it too.

    from optid.conformance.checks import check_back_end, check_formulation
    check_back_end(my_back_end)
    check_formulation(my_formulation, data, na=2, nb=2)

A conformant back end never makes a claim that the known answer or our residuals contradict. It may fail honestly on
cases marked hard, and need not recognise infeasible or unbounded programmes as such. A conformant formulation gives a
model that predicts, leaves the caller's record alone, and refuses what it cannot take with a named error.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.backends.back_end import BackEnd
from optid.conformance.zoo import SOLVED, Case, cases
from optid.core.problem import Problem
from optid.core.statement import for_solvers, statement_of
from optid.data.record import Data
from optid.errors import DataWarning, OptidError
from optid.program.solution import Solution, Status
from optid.solving.solve import solve

SUCCESS = (Status.OPTIMAL, Status.LOCAL)
VALUE = 1e-6  # relative accuracy of the objective behind every "optimal"
POINT = 1e-3  # points are determined less sharply than values: to about the square root of their accuracy
DUAL = 1e-4


class ConformanceError(OptidError, AssertionError):
    """A back end or a formulation does not do what it claims; the message lists every complaint."""


@dataclass(frozen=True)
class Row:
    """One back end on one case."""

    case: Case  # what was solved
    solver: str  # name of the back end
    solution: Solution  # the judged outcome
    seconds: float  # wall time, building included
    complaints: tuple[str, ...]  # what contradicts the back end's claim; empty for a conformant run


def accepted_cases(back_end: BackEnd, zoo: Sequence[Case] | None = None) -> list[Case]:
    """Return the cases whose class the back end says it solves."""
    return [case for case in (cases() if zoo is None else zoo) if not back_end.refuses(for_solvers(case.build()))]


def run_case(back_end: BackEnd, case: Case, **settings) -> Row:
    """Solve a case of the zoo, with settings of `optid.solve`, and compare the outcome with what is known."""
    clock = time.perf_counter()
    problem = for_solvers(case.build())
    solution = solve(problem, back_end, **settings)
    seconds = time.perf_counter() - clock
    return Row(case, back_end.name, solution, seconds, tuple(_complaints(back_end, case, problem, solution)))


def check_back_end(back_end: BackEnd, zoo: Sequence[Case] | None = None) -> list[Row]:
    """Run a back end over every case of its classes, of the shipped zoo or another; return one row per case.

    Raises:
        ConformanceError: lists all complaints.
    """
    rows = [run_case(back_end, case) for case in accepted_cases(back_end, zoo)]
    complaints = [f"{row.case.name}: {text}" for row in rows for text in row.complaints]
    if complaints:
        raise ConformanceError(f"{back_end.name} is not conformant:\n  " + "\n  ".join(complaints))
    return rows


def check_formulation(formulation: str | Callable[..., Any], data: Data, **arguments: Any) -> None:
    """Apply a formulation to a record, to damaged copies of it, and to records that it must refuse.

    The record is one that the model should describe, with at least 100 samples; the arguments are the formulation's.

    Raises:
        ConformanceError: lists all complaints.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        complaints = list(_about_formulation(formulation, data, arguments))
    if complaints:
        name = formulation if isinstance(formulation, str) else getattr(formulation, "__name__", "formulation")
        raise ConformanceError(f"{name} is not conformant:\n  " + "\n  ".join(complaints))


def _about_formulation(formulation: str | Callable[..., Any], data: Data, arguments: dict[str, Any]) -> Iterator[str]:
    from optid.identify.fitting import fit

    def attempt(record: Data, **more: Any) -> Any:
        try:
            return fit(record, formulation, prove=False, **{**arguments, **more})
        except Exception as error:
            return error

    before = [(e.u.copy(), e.y.copy()) for e in data.experiments]
    found = attempt(data)
    if isinstance(found, Exception):
        yield f"the record: {type(found).__name__}: {found}"
        return
    if not all(np.array_equal(a, b, equal_nan=True) for e, pair in zip(data.experiments, before)
               for a, b in zip((e.u, e.y), pair)):
        yield "the caller's record was changed"
    if found.solution.status not in SUCCESS:
        yield f"the record: {found.solution.status}: {found.solution.reason}"
    yield from _about_model(found.model, data)
    whole = data.experiments[0]
    holes = whole.y.copy()
    holes[len(holes) // 2 :: 17] = np.nan
    half = len(holes) // 2
    damaged = {
        "missing samples": Data(whole.u, holes, data.dt),
        "two experiments": Data([whole.u[:half], whole.u[half:]], [whole.y[:half], whole.y[half:]], data.dt),
    }
    short, still = Data(whole.u[:3], whole.y[:3], data.dt), Data(0 * whole.u, whole.y, data.dt)
    for what, record in {**damaged, "3 samples": short, "an input that never moves": still}.items():
        again = attempt(record)
        if isinstance(again, Exception) and not isinstance(again, OptidError):
            yield f"{what}: {type(again).__name__}: {again} (it must be an error of optid.errors, with the remedy)"
        elif what not in damaged and not isinstance(again, Exception):
            yield f"{what}: accepted"
    if not isinstance(again := attempt(data, no_such_argument=1), OptidError):
        yield f"an unknown argument is not refused by name: {type(again).__name__}"


def _about_model(model: Any, data: Data) -> Iterator[str]:
    """Check the attributes and methods of a model that optid uses."""
    for name in ("inputs", "outputs", "dt", "nonlinearities", "memory", "poles", "kind"):
        if not hasattr(model, name):
            yield f"the model has no {name}"
    whole = data.experiments[0]
    for name in ("predict", "simulate"):
        try:
            found = np.asarray(getattr(model, name)(Data(whole.u, whole.y, data.dt)), dtype=float)
        except Exception as error:
            yield f"model.{name}: {type(error).__name__}: {error}"
            continue
        if found.shape != whole.y.shape:
            yield f"model.{name} returns shape {found.shape} for a record with outputs {whole.y.shape}"
        elif name == "predict":
            error, size = np.nanstd(found - whole.y), np.nanstd(whole.y)
            if not error < size:
                yield f"model.predict is no better than a constant: error {error:.3g}, output {size:.3g}"


def value_error(case: Case, solution: Solution) -> float:
    """Return the error of the objective relative to its size (a vanishing one: to a millionth of its scale)."""
    return abs(solution.objective - case.value) / max(abs(case.value), 1e-6 * solution.scale)


def _complaints(back_end: BackEnd, case: Case, problem: Problem, solution: Solution):
    claims = solution.status in SUCCESS
    if case.outcome != SOLVED:
        if claims:
            yield f"claims {solution.status} for a programme that is {case.outcome}"
        wrong = {"infeasible": Status.UNBOUNDED, "unbounded": Status.INFEASIBLE}[case.outcome]
        if solution.status is wrong:
            yield f"says {solution.status} of a programme that is {case.outcome}"
        return
    if solution.status in (Status.INFEASIBLE, Status.UNBOUNDED):
        yield f"says {solution.status} of a programme that has a solution"
    if not claims:
        if not case.hard:
            yield f"{solution.status}: {solution.reason} (its own word: {solution.claimed})"
        return
    if value_error(case, solution) > VALUE:
        yield f"objective {solution.objective:.9g}, known {case.value:.9g}"
    for name, known in case.point.items():
        yield from _differs(f"variable {name!r}", solution.values[name], np.asarray(known, dtype=float), POINT)
    if not back_end.duals:
        return
    if missing := set(statement_of(problem).constraints) - set(solution.duals):
        yield f"no multipliers for {', '.join(sorted(missing))}"
        return
    for name, known in case.duals.items():
        yield from _differs(f"multiplier of {name!r}", solution.duals[name], np.asarray(known, dtype=float), DUAL)


def _differs(what: str, found: np.ndarray, known: np.ndarray, tolerance: float):
    known = np.ravel(known, order="F")
    error = float(np.max(np.abs(np.ravel(found, order="F") - known), initial=0.0))
    if not error <= tolerance * (1.0 + float(np.max(np.abs(known), initial=0.0))):
        yield f"{what} is off by {error:.1e}"
