"""Uno through CVXPY's derivative engine, driven here so that multipliers come back and nothing is printed.

CVXPY's own interface to Uno reports "optimal" for any terminated run, infeasible stationary points included, and
returns no multipliers. Here the status of the *point* decides the claim.
"""

import time
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.backends.dnlp import Derivatives, Smooth, smooth
from optid.core.problem import Problem
from optid.core.statement import statement_of
from optid.program.solution import Status

ENDED = {
    "ITERATION_LIMIT": Status.LIMIT, "TIME_LIMIT": Status.LIMIT, "EVALUATION_ERROR": Status.FAILED,
    "ALGORITHMIC_ERROR": Status.FAILED, "USER_TERMINATION": Status.LIMIT,
}
POINT = {
    "FEASIBLE_KKT_POINT": Status.LOCAL, "FEASIBLE_FJ_POINT": Status.INACCURATE,
    "FEASIBLE_SMALL_STEP": Status.INACCURATE, "INFEASIBLE_STATIONARY_POINT": Status.INFEASIBLE,
    "INFEASIBLE_SMALL_STEP": Status.INFEASIBLE, "UNBOUNDED_OBJECTIVE": Status.UNBOUNDED,
    "DIVERGING_ITERATE": Status.UNBOUNDED,
}


def run(problem: Problem, settings: Settings) -> Answer:
    """Solve an LP, QP or smooth nonconvex programme with Uno.

    Options: ``preset``, default "filtersqp", and Uno's own.
    """
    unopy: Any = import_module("unopy")
    clock = time.perf_counter()
    form = smooth(statement_of(problem).problem)
    solver = unopy.UnoSolver()
    chosen = options(settings)
    solver.set_preset(chosen.pop("preset"))
    for name, value in chosen.items():
        solver.set_option(name, value)
    model = _model(unopy, form)
    compiling = time.perf_counter() - clock
    result = solver.optimize(model)
    word, status = _status(str(result.optimization_status), str(result.solution_status))
    return form.answer(problem, status, word, list(result.primal_solution), list(result.constraint_dual_solution),
                       iterations=int(result.number_iterations), compile=compiling)


def options(settings: Settings) -> dict[str, Any]:
    """Translate what is asked into Uno's options; native options of the user come last."""
    chosen: dict[str, Any] = {
        "preset": "filtersqp", "primal_tolerance": settings.accuracy, "dual_tolerance": settings.accuracy,
        "logger": "INFO" if settings.verbose else "SILENT", "print_solution": settings.verbose, "max_iterations": 3000,
    }
    if settings.time_limit is not None:
        chosen["time_limit"] = float(settings.time_limit)
    return {**chosen, **settings.options}


def _model(unopy: Any, form: Smooth) -> Any:
    start, derivatives = form.start(), Derivatives(form)
    model = unopy.Model(unopy.PROBLEM_NONLINEAR, start.size, *form.bounds, unopy.ZERO_BASED_INDEXING)

    def objective(x: Any) -> float:
        derivatives.at(x)
        return derivatives.value

    def rows(x: Any, out: np.ndarray) -> None:
        derivatives.at(x)
        out[:] = derivatives.rows

    def slope(x: Any, out: np.ndarray, kind: str) -> None:
        out[:] = getattr(derivatives.at(x), kind)(np.asarray(x))

    def hessian(x: Any, factor: float, multipliers: Any, out: np.ndarray) -> None:
        out[:] = derivatives.at(x).hessian(np.asarray(x), np.asarray(multipliers), factor)

    model.set_objective(unopy.MINIMIZE, objective, partial(slope, kind="gradient"))
    row_lower, row_upper = form.row_bounds
    if row_lower.size:
        row, column = derivatives.engine.jacobianstructure()
        model.set_constraints(row_lower.size, rows, row_lower, row_upper, len(row), row, column,
                              partial(slope, kind="jacobian"))
    row, column = derivatives.engine.hessianstructure()
    model.set_lagrangian_hessian(len(row), unopy.LOWER_TRIANGLE, row, column, hessian)
    model.set_lagrangian_sign_convention(unopy.MULTIPLIER_POSITIVE)
    model.set_initial_primal_iterate(start)
    return model


def _status(ended: str, point: str) -> tuple[str, Status]:
    """Read the two words of Uno: how the run ended, and what the point is."""
    ended, point = ended.split(".")[-1], point.split(".")[-1]
    if ended == "SUCCESS":
        return point, POINT.get(point, Status.FAILED)
    return ended, ENDED.get(ended, Status.FAILED)
