"""Which proof suits a problem: what it states itself, or what the form of its terms implies."""

import numpy as np

from optid.certificate.convex import certify_convex
from optid.certificate.dual_points import certify_groups, certify_low_rank
from optid.certificate.lifting import certify_nuclear, certify_rank_one
from optid.core.group_sparse import GroupSparseForm
from optid.core.least_squares import RankOneForm
from optid.core.low_rank import LowRankForm
from optid.core.problem import Problem
from optid.core.statement import class_of
from optid.core.terms import NuclearNorms, Squares, Values
from optid.program.solution import Bound
from optid.structures.rank_one import RankOne


def proof_of(problem: Problem, values: Values, duals: Values) -> tuple[Bound | None, Values | None]:
    """Return a bound on the objective from a point and its multipliers, and a better start that the attempt proposes.

    No bound where the problem is not convex and nothing is known of its terms, or where none can be formed.
    """
    x = {name: np.asarray(values[name], dtype=float) for name in problem.start}
    if problem.no_proof:
        return Bound.none(problem.no_proof), None
    if callable(problem.proof):
        return problem.proof(problem, x, duals)
    if RankOneForm.of(problem) is not None:
        return certify_rank_one(problem, x)
    if (groups := GroupSparseForm.of(problem)) is not None:
        return certify_groups(problem, groups, x, duals), None
    if (matrix := LowRankForm.of(problem)) is not None:
        return certify_low_rank(problem, matrix, x, duals), None
    match problem.terms:
        case (Squares(lifted=RankOne(), z=z), NuclearNorms()) if z == tuple(problem.start):
            return certify_nuclear(problem, x, duals), None
    kind = class_of(problem)
    try:
        return (None if kind == "NLP" else certify_convex(problem, x, duals, kind == "QP")), None
    except (ValueError, NotImplementedError, TypeError):  # no gradient in CVXPY, or a multiplier of another shape
        return None, None
