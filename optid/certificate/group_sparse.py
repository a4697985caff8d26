"""The proof of a group-sparse problem: a lower bound recomputed from a feasible dual point.

For ``min 1/2 ‖r - M a‖² + lambda sum w_g ‖a_g‖`` under affine constraints whose multipliers make the part ``c' a + k``
of the Lagrangian, every v with ``‖M_g' v - c_g‖ <= lambda w_g`` gives the bound ``r' v - 1/2 ‖v‖² + k``. The
point of a solver is scaled into that set, v and multipliers together, so that the bound always holds.
"""

import numpy as np

from optid.arrays import Array
from optid.core.group_sparse import GroupSparseForm
from optid.core.judge import in_dual_cone
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.program.solution import Bound, relative_gap

PROVED = 1e-6
"""Relative gap below which a point is optimal."""


def certify_groups(problem: Problem, values: Values, duals: Values) -> Bound:
    """Return the best bound from the residual at the point and from the multipliers that the solver gave."""
    form = GroupSparseForm.of(problem)
    assert form is not None
    numbers, a = form.problem, form.flat(values)
    candidates: list[Array] = [numbers.target - numbers.design @ a]
    if (given := form.dual_point(duals)) is not None:
        candidates.append(given)
    slope, constant = _lagrangian(problem, form, duals)
    bounds = [numbers.dual(v, form.penalty, slope, constant) for v in candidates]
    bounds += [numbers.dual(v, form.penalty) for v in candidates]
    value, point = max(bounds, key=lambda pair: pair[0])
    gap = relative_gap(numbers.value(a, form.penalty), value, problem.scale)
    return Bound(value, gap < PROVED, "group-sparse dual", f"feasible dual point, relative gap {gap:.1e}",
                 multipliers=point)


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
