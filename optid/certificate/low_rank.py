"""The dual bound of a low-rank Hankel fit, in closed form from a feasible dual point."""

import numpy as np

from optid.core.low_rank import LowRankForm
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.program.solution import Bound, relative_gap

CLOSED = 1e-6  # relative gap up to which the bound proves the optimum


def certify_low_rank(problem: Problem, values: Values, duals: Values) -> Bound:
    """Return the dual bound, recomputed from a feasible dual point near the multipliers, or near the subgradient."""
    form = LowRankForm.of(problem)
    assert form is not None
    if problem.constraint_names:
        return Bound.none("the dual bound is that of the programme without constraints")
    numbers = form.problem
    v, theta = np.asarray(values["yhat"]), np.asarray(values.get("T", np.zeros((0, numbers.l))))
    objective, candidates = numbers.value(v, theta, form.weight), []
    if np.size(duals.get("structure", ())) == np.prod(numbers.shape):
        candidates.append(-np.reshape(duals["structure"], numbers.shape, order="F"))
    left, _, right = np.linalg.svd(numbers.matrix(v, theta), full_matrices=False)
    candidates.append(left @ right)
    value, point = max((numbers.dual(candidate, form.weight) for candidate in candidates), key=lambda pair: pair[0])
    gap = relative_gap(objective, value, problem.scale)
    return Bound(value, gap < CLOSED, "nuclear dual", f"feasible dual point, relative gap {gap:.1e}",
                 multipliers=point)
