"""Every conic and QP solver that CVXPY knows, by name, with one requested accuracy translated per solver."""

import warnings
from typing import Any

import cvxpy as cp

from optid.backends import Answer, BackEnd, Settings
from optid.backends.dnlp import conic_capabilities
from optid.program import Program
from optid.solution import Status

STATUS = {
    cp.OPTIMAL: Status.OPTIMAL,
    cp.OPTIMAL_INACCURATE: Status.INACCURATE,
    cp.INFEASIBLE: Status.INFEASIBLE,
    cp.INFEASIBLE_INACCURATE: Status.INFEASIBLE,
    cp.UNBOUNDED: Status.UNBOUNDED,
    cp.UNBOUNDED_INACCURATE: Status.UNBOUNDED,
    "infeasible_or_unbounded": Status.INFEASIBLE,
    cp.USER_LIMIT: Status.LIMIT,
    cp.SOLVER_ERROR: Status.FAILED,
}

PIP = {
    "clarabel": "clarabel", "scs": "scs", "osqp": "osqp", "piqp": "piqp", "proxqp": "proxsuite", "daqp": "daqp",
    "qoco": "qoco", "highs": "highspy", "cvxopt": "cvxopt", "glpk": "cvxopt", "glpk_mi": "cvxopt", "ecos": "ecos",
    "sdpa": "sdpa-python", "scip": "pyscipopt", "mosek": "Mosek", "gurobi": "gurobipy", "copt": "coptpy",
    "cplex": "cplex", "xpress": "xpress", "pdlp": "ortools", "glop": "ortools", "cbc": "cylp", "diffcp": "diffcp",
    "mpax": "mpax", "qpalm": "qpalm", "cuopt": "cuopt", "knitro": "knitro",
}


def tolerances(name: str, settings: Settings) -> dict[str, Any]:
    """Translate one requested accuracy and time limit into a solver's own options.

    Args:
        name: lower-case solver name.
        settings: what is asked.
    """
    eps, limit = settings.accuracy, settings.time_limit
    table: dict[str, dict[str, Any]] = {
        "clarabel": {"tol_gap_abs": eps, "tol_gap_rel": eps, "tol_feas": eps, "max_iter": 500},
        "scs": {"eps_abs": eps, "eps_rel": eps, "max_iters": 200_000},
        "osqp": {"eps_abs": eps, "eps_rel": eps, "max_iter": 200_000, "polishing": True, "eps_prim_inf": 1e-9,
                 "eps_dual_inf": 1e-9},
        "piqp": {"eps_abs": eps, "eps_rel": eps, "max_iter": 1000},
        "proxqp": {"eps_abs": eps, "eps_rel": 0.0, "max_iter": 20_000},
        "daqp": {"primal_tol": max(eps, 1e-12), "dual_tol": max(eps, 1e-12)},
        "qoco": {"abstol": eps, "reltol": eps, "max_iters": 500},
        "highs": {"primal_feasibility_tolerance": max(eps, 1e-10), "dual_feasibility_tolerance": max(eps, 1e-10)},
        "cvxopt": {"abstol": eps, "reltol": eps, "feastol": eps, "max_iters": 200},
        "ecos": {"abstol": eps, "reltol": eps, "feastol": eps, "max_iters": 500},
        "sdpa": {"epsilonStar": eps, "epsilonDash": eps},
        "mosek": {"mosek_params": {"MSK_DPAR_INTPNT_CO_TOL_REL_GAP": eps, "MSK_DPAR_INTPNT_QO_TOL_REL_GAP": eps}},
        "gurobi": {"BarConvTol": eps, "FeasibilityTol": max(eps, 1e-9), "OptimalityTol": max(eps, 1e-9)},
    }
    clock = {"clarabel": "time_limit", "scs": "time_limit_secs", "osqp": "time_limit", "highs": "time_limit",
             "gurobi": "TimeLimit"}
    options = dict(table.get(name, {}))
    if limit is not None and name in clock:
        options[clock[name]] = float(limit)
    options.update(settings.options)
    return options


def solve_with(name: str, program: Program, settings: Settings) -> Answer:
    """Solve a convex programme with one of CVXPY's solvers.

    Args:
        name: lower-case solver name.
        program: a convex programme.
        settings: what is asked.

    Returns:
        The solver's claim; an exception inside the solver becomes ``Status.FAILED`` with its words.
    """
    problem = program.problem
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # inaccuracy is judged by our residuals, not by a warning
            problem.solve(solver=name.upper(), verbose=settings.verbose, warm_start=settings.warm,
                          **tolerances(name, settings))
    except Exception as error:  # a solver that crashes is an outcome
        return Answer(Status.FAILED, f"{type(error).__name__}: {error}")
    status = STATUS.get(problem.status, Status.FAILED)
    statistics = problem.solver_stats
    iterations = getattr(statistics, "num_iters", None)
    if status not in (Status.OPTIMAL, Status.INACCURATE, Status.LIMIT) or any(
        v.value is None for v in program.variables.values()
    ):
        return Answer(status, problem.status, iterations=iterations if iterations is not None else -1)
    return Answer(status, problem.status, program.values(), program.duals(),
                  int(iterations) if iterations is not None else -1)


def family() -> list[BackEnd]:
    """Return one back end for every conic or QP solver CVXPY has an interface to."""
    found = []
    for name, (classes, installed) in conic_capabilities().items():

        def run(program: Program, settings: Settings, name: str = name) -> Answer:
            return solve_with(name, program, settings)

        found.append(BackEnd(name, frozenset(classes), run, installed, PIP.get(name, ""),
                             warm=name in {"scs", "osqp", "piqp", "clarabel", "daqp", "proxqp"}, about="through CVXPY"))
    return found
