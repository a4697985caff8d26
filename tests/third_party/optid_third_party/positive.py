"""A formulation of a third party with its solver and its proof: an impulse response that is nowhere negative.

    min ‖y - sum_j b_j u(t - j) - d‖²   subject to   b >= 0
"""

from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from optid import Bound, Data
from optid.backends import Answer, BackEnd, Settings
from optid.core.form import Form
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.program.solution import Status, relative_gap
from optid_third_party.fir import facts, recover, triangle

POSITIVE = "positive"  # name of the restriction, by which the solver knows the problem


def positive(data: Data, *, length: int, constraints: tuple = ()) -> Problem:
    """State the fit for one input and one output. Named variables: ``b``, ``offset``.

    Args:
        data: the record; samples that touch a missing one are left out.
        length: number of coefficients.
        constraints: on ``b`` and ``offset``.
    """
    root, scale = triangle(data, length)
    return Problem("fir.positive", {"b": np.zeros(length), "offset": np.zeros(1)},
                   (Squares(root[:, :-1], root[:, -1], 0.0, ("b", "offset")),), model=partial(recover, data),
                   facts=facts(data), restrictions=(lambda v: {POSITIVE: v["b"] >= 0},), builders=tuple(constraints),
                   scale=scale, proof=bound)


def bound(problem: Problem, values: Values, duals: Values) -> tuple[Bound, None]:
    """Return the least value of the quadratic's lower model ``F + gradientᵀd + sigma² ‖d‖²`` over all b + d >= 0."""
    if problem.constraint_names:
        return Bound.none("the bound knows no constraint but b >= 0"), None
    value, slope, _ = problem.pull(values)
    (squares,) = problem.terms
    curvature = float(np.linalg.svd(squares.root, compute_uv=False)[-1]) ** 2
    least = np.append(-values["b"], -np.inf)
    d = np.maximum(-slope / (2 * curvature), least)
    found = value + float(slope @ d + curvature * d @ d)
    gap = relative_gap(value, found, problem.scale)
    return Bound(found, gap < 1e-6, "strong convexity", f"relative gap {gap:.1e}"), None


class Positive(Form):
    """One sum of squares under b >= 0."""

    word = POSITIVE

    @classmethod
    def of(cls, problem: Problem) -> "Positive | None":
        """Return the form of a problem, None where it has another."""
        one = len(problem.terms) == 1 and isinstance(problem.terms[0], Squares)
        return cls() if one and problem.structural == {POSITIVE} else None


def run(program: Any, settings: Settings) -> Answer:
    """Solve by the active-set method of SciPy."""
    problem: Problem = program
    (squares,) = problem.terms
    low = np.append(np.zeros(problem.size - 1), -np.inf)
    found = lsq_linear(squares.root, squares.target, (low, np.inf), method="bvls", tol=1e-14)
    if not found.success:
        return Answer(Status.LIMIT, found.message)
    slope = problem.pull(problem.unpack(found.x))[1]
    return Answer(Status.LOCAL, found.message, problem.unpack(found.x), {POSITIVE: np.maximum(slope[:-1], 0.0)},
                  found.nit)


back_end = BackEnd("active_set", frozenset(), run, form=POSITIVE, takes=Positive.of,
                   about="a third party's active-set method")
