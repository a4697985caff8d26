"""Every conic and QP solver of CVXPY by name, with one requested accuracy translated per solver.

Small least squares under constraints go straight to Clarabel: CVXPY takes longer to translate than it to solve.
"""

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from optid.backends.back_end import Answer, Settings
from optid.backends.catalogue import WITHOUT_DUALS
from optid.core.constraint import join_by_name
from optid.core.leaves import Affine, positions
from optid.core.problem import Problem
from optid.core.statement import statement_of
from optid.core.terms import Squares
from optid.program.expressions import solve_quietly
from optid.program.solution import Status

SHARP = 1e-11  # accuracy of small least squares
CONES = ("zero", "below", "psd")  # of the constraints that a problem of the core has read, in the order of a solver
Side = tuple[np.ndarray, np.ndarray]  # rows (r, n) and right-hand sides (r,)
STATUS = {
    cp.OPTIMAL: Status.OPTIMAL,
    cp.OPTIMAL_INACCURATE: Status.INACCURATE,
    cp.INFEASIBLE: Status.INFEASIBLE,
    cp.INFEASIBLE_INACCURATE: Status.INFEASIBLE,
    cp.UNBOUNDED: Status.UNBOUNDED,
    cp.UNBOUNDED_INACCURATE: Status.UNBOUNDED,
    "infeasible_or_unbounded": Status.FAILED,  # not knowing which of the two is neither
    cp.USER_LIMIT: Status.LIMIT,
    cp.SOLVER_ERROR: Status.FAILED,
}

OF_CLARABEL = {
    "Solved": Status.OPTIMAL, "AlmostSolved": Status.INACCURATE, "PrimalInfeasible": Status.INFEASIBLE,
    "AlmostPrimalInfeasible": Status.INFEASIBLE, "DualInfeasible": Status.UNBOUNDED,
    "AlmostDualInfeasible": Status.UNBOUNDED, "MaxIterations": Status.LIMIT, "MaxTime": Status.LIMIT,
}

AMBIGUOUS = {"sdpa"}
"""Solvers whose "infeasible" can mean "unbounded": SDPA's pdINF says that the primal or the dual is infeasible."""


def tolerances(name: str, settings: Settings) -> dict[str, Any]:
    """Translate one requested accuracy and time limit into a solver's own options; those of the user come last."""
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
        # its active-set method for quadratic programmes may cycle without end
        "highs": {"primal_feasibility_tolerance": max(eps, 1e-10), "dual_feasibility_tolerance": max(eps, 1e-10),
                  "qp_iteration_limit": 10_000},
        # a gap of 1e-8 leaves multipliers that are good to 1e-5 only. Such a gap is out of reach of the factorisation
        # that CVXPY chooses, "chol", on half of all small quadratic programmes; "qr" is CVXOPT's own default for cones
        "cvxopt": {"abstol": 0.01 * eps, "reltol": 0.01 * eps, "feastol": max(eps, 1e-7), "max_iters": 200,
                   "kktsolver": "qr", "refinement": 2},
        "ecos": {"abstol": eps, "reltol": eps, "feastol": eps, "max_iters": 500},
        # its documented accuracy is 1e-7; beyond it rounding errors decide whether its Cholesky factorisation fails.
        # In several threads its answers, and now and then its verdict, change from run to run
        "sdpa": {"epsilonStar": max(eps, 1e-7), "epsilonDash": max(eps, 1e-7), "numThreads": 1},
        # feastol above 1e-9 makes badly scaled programmes run for minutes
        "scip": {"scip_params": {"numerics/feastol": 1e-9,
                                 **({"limits/time": float(limit)} if limit is not None else {})}},
        "mosek": {"mosek_params": {"MSK_DPAR_INTPNT_CO_TOL_REL_GAP": eps, "MSK_DPAR_INTPNT_QO_TOL_REL_GAP": eps}},
        "gurobi": {"BarConvTol": eps, "FeasibilityTol": max(eps, 1e-9), "OptimalityTol": max(eps, 1e-9)},
    }
    clock = {"clarabel": "time_limit", "scs": "time_limit_secs", "osqp": "time_limit", "highs": "time_limit",
             "gurobi": "TimeLimit"}
    options = dict(table.get(name, {}))
    if limit is not None and name in clock:
        options[clock[name]] = float(limit)
    return {**options, **settings.options}


def solve_with(name: str, problem: Problem, settings: Settings) -> Answer:
    """Solve a convex programme with one of CVXPY's solvers, by its lower-case name.

    An exception inside the solver becomes ``Status.FAILED`` with its words.
    """
    if name == "clarabel" and not settings.options and not settings.verbose and _has_rows_alone(problem):
        return _least_squares_in_rows(problem, settings)
    statement, options = statement_of(problem), tolerances(name, settings)
    posed = statement.problem
    if name == "clarabel" and problem.scale < 1:  # objectives are in units of the data; its relative gap is one to 1
        options |= {key: options[key] * max(problem.scale, 1e-8) for key in ("tol_gap_abs", "tol_gap_rel")
                    if key not in settings.options}
    try:
        solve_quietly(posed, name.upper(), verbose=settings.verbose, warm_start=settings.warm, **options)
    except Exception as error:  # a solver that crashes is an outcome
        return Answer(Status.FAILED, f"{type(error).__name__}: {error}")
    status, statistics = STATUS.get(posed.status, Status.FAILED), posed.solver_stats
    compiling = float("nan") if posed.compilation_time is None else float(posed.compilation_time)
    iterations = getattr(statistics, "num_iters", None)
    answer = Answer(status, posed.status, iterations=-1 if iterations is None else int(iterations), compile=compiling)
    if status is Status.INFEASIBLE and name in AMBIGUOUS and not _has_no_point(posed, name, options):
        return Answer(Status.FAILED, "infeasible_or_unbounded", compile=compiling)
    if status not in (Status.OPTIMAL, Status.INACCURATE, Status.LIMIT) or any(
            v.value is None for v in statement.variables.values()):
        return answer
    return replace(answer, values=statement.values(), duals={} if name in WITHOUT_DUALS else statement.duals())


def _has_no_point(problem: cp.Problem, name: str, options: dict[str, Any]) -> bool:
    """Return whether the solver finds the constraints infeasible without an objective, where the dual is feasible."""
    bare = cp.Problem(cp.Minimize(0), problem.constraints)
    try:
        solve_quietly(bare, name.upper(), **options)
    except Exception:  # no answer confirms nothing
        return False
    return STATUS.get(bare.status) is Status.INFEASIBLE


def solve_least_squares(matrix: np.ndarray, target: np.ndarray, equal: Sequence[Side], below: Sequence[Side],
                        settings: Settings, definite: Sequence[Side] = ()) -> Answer:
    """Minimise ``‖matrix x - target‖²`` subject to ``rows x = right`` and ``rows x <= right``, matrix (k, n).

    The matrices ``right - rows x``, flat, of `definite` must be positive semidefinite. The residuals are variables, so
    that the matrix is not squared.

    Returns:
        "x" (n,), where there is a usable point; "rows": multipliers of the equalities, then of the inequalities, for
        ``L = f + multipliers' (rows x - right)``, then of the matrices, flat.
    """
    clarabel: Any = import_module("clarabel")  # compiled, without types
    k, n = matrix.shape
    sides = [*equal, *below, *((_to_triangle(part), _to_triangle(side)) for part, side in definite)]
    rows = np.vstack([np.hstack([matrix, -np.eye(k)]),
                      *(np.hstack([part, np.zeros((len(part), k))]) for part, _ in sides)])
    right = np.concatenate([target, *(side for _, side in sides)])
    counts = k + sum(len(part) for part, _ in equal), sum(len(part) for part, _ in below)
    cones = [clarabel.ZeroConeT(counts[0]), *([clarabel.NonnegativeConeT(counts[1])] if counts[1] else []),
             *(clarabel.PSDTriangleConeT(round(len(side) ** 0.5)) for _, side in definite)]
    options = clarabel.DefaultSettings()
    options.verbose = settings.verbose
    for key, value in tolerances("clarabel", settings).items():
        setattr(options, key, value)
    weights = sp.diags_array(np.concatenate([np.zeros(n), np.full(k, 2.0)]), format="csc")
    found = clarabel.DefaultSolver(weights, np.zeros(n + k), sp.csc_array(rows), right, cones, options).solve()
    status = OF_CLARABEL.get(str(found.status), Status.FAILED)
    if status not in (Status.OPTIMAL, Status.INACCURATE, Status.LIMIT):
        return Answer(status, str(found.status))
    edges = np.cumsum([sum(counts), *(len(part) for part, _ in sides[len(equal) + len(below) :])])[:-1]
    plain, *triangles = np.split(np.asarray(found.z), edges)
    matrices = [_from_triangle(part, len(side)) for part, (_, side) in zip(triangles, definite)]
    return Answer(status, str(found.status), {"x": np.asarray(found.x)[:n]},
                  {"rows": np.concatenate([plain[k:], *matrices])}, int(found.iterations))


def _to_triangle(rows: np.ndarray) -> np.ndarray:
    """Return the triangles of the symmetric parts of flat square matrices (n², k), with the same inner products."""
    i, j, n = _places(len(rows))
    weights = np.where(i == j, 0.5, np.sqrt(0.5)).reshape(-1, *[1] * (rows.ndim - 1))
    return weights * (rows[i + n * j] + rows[j + n * i])


def _from_triangle(part: np.ndarray, size: int) -> np.ndarray:
    """Return the flat symmetric matrix (n²,) of a triangle."""
    i, j, n = _places(size)
    found = np.empty(size)
    found[i + n * j] = found[j + n * i] = np.where(i == j, 1.0, np.sqrt(0.5)) * part
    return found


def _places(size: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return rows and columns of the upper triangle of a square matrix with so many entries, column by column."""
    n = round(size**0.5)
    j, i = np.tril_indices(n)
    return i, j, n


def _has_rows_alone(problem: Problem) -> bool:
    """Whether a programme states one term of squares without products, under rows and matrices: it needs no CVXPY."""
    if len(problem.terms) != 1 or not isinstance(problem.terms[0], Squares):
        return False
    if not problem.start.keys() <= set(problem.terms[0].z):  # the record tells no size of an unknown without effect
        return False
    if problem.symmetric or not all(isinstance(leaf, Affine) for leaf in problem.leaves):
        return False
    return all(one.cone != "other" for one in problem.constraints())


def sizes_by_effect(problem: Problem, matrix: np.ndarray) -> np.ndarray:
    """Return how much of every unknown would account for the whole record, by its largest effect; (unknowns,).

    Solvers stop at absolute tolerances, so programmes are written in these units and not in those of the data. The
    matrix (k, unknowns) is the slope of the residuals.
    """
    effect, reach, sizes = np.linalg.norm(matrix, axis=0), float(np.sqrt(problem.scale)), np.ones(problem.size)
    for place in problem.slices.values():
        most = float(np.max(effect[place], initial=0.0))
        sizes[place] = reach / most if most > 0 and reach > 0 else 1.0
    return sizes


def _least_squares_in_rows(problem: Problem, settings: Settings) -> Answer:
    """Solve such a problem, in units in which the record accounts for every unknown."""
    (squares,) = problem.terms
    assert isinstance(squares, Squares)
    slope = problem.slope(problem.start)
    level = problem.space.vector(problem.leaf_values(problem.start)) - slope @ problem.pack(problem.start)
    matrix = np.zeros((len(squares.root), problem.size))
    matrix[:, positions(problem.slices, squares.z)] = squares.root
    sizes = sizes_by_effect(problem, matrix)
    unit = max(float(np.max(np.abs(matrix * sizes))), np.finfo(float).tiny)
    held, units = sorted(problem.constraints(), key=lambda one: CONES.index(one.cone)), []
    sides: dict[str, list[Side]] = {cone: [] for cone in CONES}
    for one in held:
        rows, right = one.rows @ slope, one.right - one.rows @ level
        units.append(float(np.max(np.abs(rows) @ sizes + np.abs(right), initial=0.0)) or 1.0)
        sides[one.cone].append((rows * sizes / units[-1], right / units[-1]))
    sharp = replace(settings, accuracy=min(settings.accuracy, SHARP))  # which costs an iteration or two
    scaled, target = matrix * sizes / unit, squares.target / unit
    own, root = np.linalg.qr(scaled)  # in its units nearly dependent unknowns cost no digits
    small = np.abs(np.diag(root))
    turn = np.linalg.inv(root) if len(small) == problem.size and np.min(small) > 1e-12 * np.max(small) else None
    if turn is not None:
        scaled, target = np.eye(problem.size), own.T @ target
        sides = {cone: [(rows @ turn, right) for rows, right in several] for cone, several in sides.items()}
    found = solve_least_squares(scaled, target, sides["zero"], sides["below"], sharp, sides["psd"])
    if not found.values:
        return found
    x = found.values["x"] if turn is None else turn @ found.values["x"]
    edges = np.cumsum([0, *map(len, held)])
    parts = [unit**2 * found.duals["rows"][a:b] / size for a, b, size in zip(edges, edges[1:], units)]
    return Answer(found.status, found.word, problem.unpack(x * sizes), join_by_name(held, parts), found.iterations)
