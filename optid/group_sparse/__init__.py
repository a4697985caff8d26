"""Group-sparse least squares: numbers, an own active-set block descent, and bounds from feasible dual points."""

from optid.group_sparse.descent import Minimum, minimise
from optid.group_sparse.problem import GroupProblem

__all__ = ["GroupProblem", "Minimum", "minimise"]
