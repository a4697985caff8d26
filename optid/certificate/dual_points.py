"""Lower bounds of low-rank and group-sparse problems, in closed form from feasible dual points.

The multipliers of a solver, and the point it found, only propose dual points; each is brought into the feasible set, so
that its value bounds the optimum however inaccurate they are.

For ``min 1/2 ‖r - M a‖² + lambda sum w_g ‖a_g‖`` under affine constraints whose multipliers make the part ``c' a + k``
of the Lagrangian, every v with ``‖M_g' v - c_g‖ <= lambda w_g`` gives the bound ``r' v - 1/2 ‖v‖² + k``; v and the
multipliers are scaled together. Of low-rank problems see `NuclearProblem.dual`.
"""

import numpy as np

from optid.arrays import Array
from optid.core.group_sparse import GroupSparseForm
from optid.core.judge import in_dual_cone
from optid.core.low_rank import LowRankForm
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.program.solution import Bound, relative_gap

PROVED = 1e-6  # relative gap below which a point is optimal


def certify_low_rank(problem: Problem, form: LowRankForm, values: Values, duals: Values) -> Bound:
    """Return the dual bound from a feasible dual point near the multipliers, or near the subgradient."""
    if problem.constraint_names:
        return Bound.none("the dual bound is that of the programme without constraints")
    numbers = form.problem
    v, theta = np.asarray(values["yhat"]), np.asarray(values.get("T", np.zeros((0, numbers.l))))
    left, _, right = np.linalg.svd(numbers.matrix(v, theta), full_matrices=False)
    candidates = [left @ right]
    if np.size(duals.get("structure", ())) == np.prod(numbers.shape):
        candidates.insert(0, -np.reshape(duals["structure"], numbers.shape, order="F"))
    return _best([numbers.dual(one, form.weight) for one in candidates], numbers.value(v, theta, form.weight),
                 problem, "nuclear dual")


def certify_groups(problem: Problem, form: GroupSparseForm, values: Values, duals: Values) -> Bound:
    """Return the best bound from the residual at the point and from the multipliers that the solver gave."""
    numbers, a = form.problem, form.flat(values)
    candidates: list[Array] = [numbers.target - numbers.design @ a]
    if (given := form.dual_point(duals)) is not None:
        candidates.append(given)
    bounds = [numbers.dual(v, form.penalty, slope, constant) for slope, constant in (
        _lagrangian(problem, form, duals), (0.0, 0.0)) for v in candidates]
    return _best(bounds, numbers.value(a, form.penalty), problem, "group-sparse dual")


def _best(bounds: list[tuple[float, Array]], objective: float, problem: Problem, method: str) -> Bound:
    value, point = max(bounds, key=lambda pair: pair[0])
    gap = relative_gap(objective, value, problem.scale)
    return Bound(value, gap < PROVED, method, f"feasible dual point, relative gap {gap:.1e}", multipliers=point)


def _lagrangian(problem: Problem, form: GroupSparseForm, duals: Values) -> tuple[Array, float]:
    """Return c (p,) and k of the user's constraints that are affine in a; others count with multiplier zero."""
    total, constant = np.zeros(problem.space.size), 0.0
    for one in problem.constraints():
        given = np.ravel(duals.get(one.name, np.zeros(0)))[one.span]
        if one.cone != "other" and given.size == len(one) and np.isfinite(given).all():
            weights = in_dual_cone(one, given)
            total, constant = total + weights @ one.rows, constant - float(weights @ one.right)
    parts = {name: total[problem.space.places[name]].reshape(shape, order="F") for name, shape in form.blocks.items()}
    return form.flat(parts), constant
