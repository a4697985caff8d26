"""The convex problem of a step of a fit whose objective is a sum of squared errors, nonlinear in the unknowns.

The problem of the fit has one term, `optid.core.terms.Errors`, with its criterion.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.core.judge import largest_excess
from optid.core.problem import Problem
from optid.core.terms import Errors, Squares
from optid.identify.prediction_error.criterion import Criterion
from optid.statistics.linearised import Linearised

INSIDE = 1e-6  # relative violation up to which a point satisfies the constraints


def criterion_of(problem: Problem) -> Criterion:
    """Return the errors of a fit, in the gauge of its problem."""
    (term,) = problem.terms
    assert isinstance(term, Errors)
    return term.criterion


def under(problem: Problem, constraints: Sequence[Any], *restrictions: Any) -> Problem:
    """Return the problem under other constraints of the user, and further restrictions that are not the user's."""
    return replace(problem, builders=tuple(constraints), restrictions=(*problem.restrictions, *restrictions))


def step_problem(problem: Problem, x: Array, at: Linearised, damping: float) -> Problem:
    """Return the problem of the step from x, ``at`` the errors near x."""
    criterion = criterion_of(problem)
    compressed, places = criterion.compressed_near(at, x), criterion.variables
    root, target, remainder = compressed.problem
    if damping:
        sizes = np.sqrt(damping) * np.linalg.norm(at.whole[0], axis=0)
        root, target = np.vstack([root, np.diag(sizes)]), np.append(target, sizes * x)
    squares = Squares(root[:, places.columns], target, remainder, tuple(places.names))
    return problem.tangent(places.values(x), squares, compressed)


def excess(problem: Problem, x: Array, unknowns: frozenset[str] = frozenset()) -> float:
    """Return the largest relative violation of the constraints, or of those about some unknowns alone."""
    return largest_excess(problem, criterion_of(problem).variables.values(x), unknowns)
