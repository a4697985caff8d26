"""Intervals around an estimate that linear inequalities may hold.

Near a fit the objective is ``‖v - centre‖² + constant`` in whitened coordinates v of the tangent space: the fit is
v = 0, ``centre`` is where the minimum would be without the inequalities, and the centre scatters with covariance
``scatter scatterᵀ``. Without inequalities in reach the intervals are the usual ones with Student's quantile. With them
the estimate is the projection of the centre on a polyhedron; it is neither Gaussian nor unbiased, and treating the
active rows as equalities gives intervals that cover too little. The interval used here is the hull of two that fail in
opposite places: the percentiles of the projected posterior and the basic bootstrap at the constrained fit.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import nnls
from scipy.special import stdtrit

from optid.bases.basis import Array
from optid.errors import StructureError

REACH = 8.0
"""Inequalities further away than this many standard deviations of their slack cannot move an interval."""


@dataclass(frozen=True, eq=False)
class LocalEstimate:
    """An estimate in whitened tangent coordinates.

    Attributes:
        centre: (n,) minimum without the inequalities, relative to the fit.
        scatter: (n, m) S, the centre has covariance S Sᵀ.
        dof: degrees of freedom of the noise estimate inside S.
        rows: (r, n) and
        slack: (r,) >= 0 of the inequalities rows @ v + slack >= 0.
        draws: number of random draws.
        seed: their seed.

    Raises:
        StructureError: fewer than 100 draws.
    """

    centre: Array
    scatter: Array
    dof: float
    rows: Array
    slack: Array
    draws: int = 400
    seed: int = 0

    def __post_init__(self) -> None:
        if self.draws < 100:
            raise StructureError(f"draws={self.draws}: the ends of an interval need at least 100 draws")

    @cached_property
    def in_reach(self) -> np.ndarray:
        """(r,) which inequalities can touch the draws."""
        deviation = REACH * np.linalg.norm(self.rows @ self.scatter, axis=1)
        nearest = self.slack + np.minimum(self.rows @ self.centre, 0.0)
        return nearest < deviation

    @property
    def held(self) -> bool:
        """Whether any inequality is in reach."""
        return bool(np.any(self.in_reach))

    @cached_property
    def samples(self) -> tuple[Array, Array]:
        """Projected draws (draws, n) around the centre and around the fit, by the same random numbers."""
        rng = np.random.default_rng(self.seed)
        half = rng.standard_normal((-(-self.draws // 2), self.scatter.shape[1]))
        half *= np.sqrt(self.dof / rng.chisquare(self.dof, (len(half), 1)))
        spread = np.vstack([half, -half])[: self.draws] @ self.scatter.T
        rows, slack = self.rows[self.in_reach], self.slack[self.in_reach]
        return project(self.centre + spread, rows, slack), project(spread, rows, slack)

    def limits(self, slopes: Array, level: float) -> tuple[Array, Array, Array]:
        """Return the standard error and the two ends, relative to the fit, of linear functions of v.

        Args:
            slopes: (q, n) derivatives of q quantities.
            level: probability inside.

        Returns:
            (error, lower, upper), each (q,), lower <= 0 <= upper.
        """
        if not self.held:
            error = np.linalg.norm(slopes @ self.scatter, axis=1)
            half = float(stdtrit(self.dof, 0.5 + level / 2)) * error
            return error, -half, half
        posterior, scattered = (points @ slopes.T for points in self.samples)
        tails = [0.5 - level / 2, 0.5 + level / 2]
        low, high = np.quantile(posterior, tails, axis=0)
        down, up = np.quantile(scattered, tails, axis=0)
        error = np.sqrt(np.mean(scattered**2, axis=0))
        return error, np.minimum(np.minimum(low, -up), 0.0), np.maximum(np.maximum(high, -down), 0.0)


def project(points: Array, rows: Array, slack: Array) -> Array:
    """Project points (K, n) on the polyhedron {v: rows @ v + slack >= 0}, which contains the origin.

    Least-distance programming by nonnegative least squares (Lawson and Hanson, Solving Least Squares Problems, 1974,
    chapter 23).
    """
    size = max(float(np.max(np.linalg.norm(points, axis=1), initial=0.0)), np.finfo(float).tiny)
    lengths = np.linalg.norm(rows, axis=1)
    rows, slack = rows[lengths > 0] / lengths[lengths > 0, None], slack[lengths > 0] / lengths[lengths > 0]
    projected = points.copy()
    need = -(points @ rows.T + slack) / size
    for k in np.flatnonzero(np.any(need > 0, axis=1)):
        system = np.vstack([rows.T, need[k]])
        target = np.zeros(len(system))
        target[-1] = 1.0
        multipliers, _ = nnls(system, target, maxiter=30 * rows.shape[0])
        residual = target - system @ multipliers
        projected[k] -= size * residual[:-1] / residual[-1]
    return projected
