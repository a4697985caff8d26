"""A dense interior-point method for quadratic programmes (Mehrotra's predictor and corrector), as an optid back end.

CVXPY takes solvers of others as instances; what it asks of one is in `_Interface`.
"""

import warnings

import cvxpy as cp
import numpy as np
from cvxpy import settings as s
from cvxpy.reductions.solution import Solution, failure_solution
from cvxpy.reductions.solvers import utilities
from cvxpy.reductions.solvers.qp_solvers.qp_solver import QpSolver

from optid.backends import Answer, BackEnd, Settings
from optid.core.problem import Problem
from optid.core.statement import statement_of
from optid.program.solution import Status

STATUS = {cp.OPTIMAL: Status.OPTIMAL, cp.USER_LIMIT: Status.LIMIT}


def run(problem: Problem, settings: Settings) -> Answer:
    """Solve a convex quadratic programme. Option: ``iterations``, 100 unless given."""
    stated = statement_of(problem)
    options = {"accuracy": settings.accuracy, "iterations": 100, **settings.options}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # optid judges the point
        stated.problem.solve(solver=_Interface(), **options)
    word, steps = stated.problem.status, stated.problem.solver_stats.num_iters or 0
    if word != cp.OPTIMAL:
        return Answer(STATUS.get(word, Status.FAILED), word, iterations=steps)
    return Answer(Status.OPTIMAL, word, stated.values(), stated.duals(), steps)


def minimise(P, q, A, b, F, g, accuracy, iterations):
    """Minimise x'Px/2 + q'x with A x = b and F x <= g.

    Returns:
        x, the multipliers of equations and inequalities, and the iterations; None where it does not converge.
    """
    n, m, k = q.size, b.size, g.size
    x, y, z, slack = np.zeros(n), np.zeros(m), np.ones(k), np.ones(k)
    sizes = [1 + np.abs(part).max(initial=0) for part in (q, b, g)]
    for step in range(1, iterations + 1):
        errors = P @ x + q + A.T @ y + F.T @ z, A @ x - b, F @ x + slack - g
        gap, value = slack @ z, abs(x @ P @ x / 2 + q @ x)
        small = max(np.abs(error).max(initial=0) / size for error, size in zip(errors, sizes)) <= accuracy
        if small and gap <= accuracy * max(value, 1e-9 * sizes[0]):
            return x, y, z, step
        try:
            step_to = _newton(P, A, F, slack, z, *errors)
            _, _, dz, ds = step_to(0.0)
            after = (slack + _length(slack, ds) * ds) @ (z + _length(z, dz) * dz)
            dx, dy, dz, ds = step_to((after / gap) ** 3 * gap / k - ds * dz if k else 0.0)
        except np.linalg.LinAlgError:
            return None
        length = 0.995 * min(_length(slack, ds), _length(z, dz)) if k else 1.0
        x, y, z, slack = x + length * dx, y + length * dy, z + length * dz, slack + length * ds
        if not np.isfinite(x).all() or np.abs(x).max() > 1e15:
            return None
    return None


def _newton(P, A, F, slack, z, dual, equal, unequal):
    """Return the function that gives the step (x, y, z, slack) towards products slack * z of a given size."""
    n, m, weights = len(P), len(A), z / slack
    kkt = np.block([[P + (F.T * weights) @ F + 1e-14 * np.eye(n), A.T], [A, -1e-14 * np.eye(m)]])

    def step(target):
        rest = (slack * z - target) / slack
        right = np.concatenate([-dual - F.T @ (weights * unequal - rest), -equal])
        found = np.linalg.solve(kkt, right)
        found += np.linalg.solve(kkt, right - kkt @ found)  # refined once
        d_slack = -unequal - F @ found[:n]
        return found[:n], found[n:], -rest - weights * d_slack, d_slack

    return step


def _length(values, steps):
    """Longest step, at most one, that keeps the values from becoming negative."""
    down = steps < 0
    return min(1.0, float(np.min(-values[down] / steps[down], initial=np.inf)))


class _Interface(QpSolver):
    """The method as CVXPY calls it."""

    def name(self):
        return "PREDICTOR_CORRECTOR"

    def import_solver(self):
        return None

    def cite(self, data):
        return ""

    def solve_via_data(self, data, warm_start, verbose, solver_opts, solver_cache=None):
        dense = [np.asarray(part.todense() if hasattr(part, "todense") else part, dtype=float)
                 for part in (data[s.P], data[s.Q], data[s.A], data[s.B], data[s.F], data[s.G])]
        return minimise(*dense, solver_opts["accuracy"], solver_opts["iterations"])

    def invert(self, solution, inverse_data):
        if solution is None:
            return failure_solution(s.SOLVER_ERROR, {})
        x, y, z, steps = solution
        duals = {**utilities.get_dual_values(y, utilities.extract_dual_value, inverse_data[self.EQ_CONSTR]),
                 **utilities.get_dual_values(z, utilities.extract_dual_value, inverse_data[self.NEQ_CONSTR])}
        return Solution(s.OPTIMAL, float("nan"), {inverse_data[self.VAR_ID]: x}, duals, {s.NUM_ITERS: steps})


back_end = BackEnd("predictor_corrector", frozenset({"QP"}), run, about="a third party's interior-point method")
