"""Intervals around an estimate that linear inequalities may hold.

Near a fit the objective is ``‖v - centre‖² + constant`` in whitened coordinates v of the tangent space: the fit is
v = 0, ``centre`` is the minimum without the inequalities, with covariance ``scatter scatterᵀ``. Without inequalities
nearby the intervals are those of Student's quantile. With them the estimate is the projection of the centre on a
polyhedron, neither Gaussian nor unbiased, and intervals that treat the active rows as equalities cover too little. The
interval used here is the hull of the percentiles of the projected posterior and the basic bootstrap at the fit.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from optid.arrays import Array, check_integer
from optid.structures.multipliers import least_distance

DRAWS = 8192  # random draws of an interval under inequalities: their noise is about 0.7 % of its width
SETS = 64  # sets of active rows that are tried for all points; where there are many more, each point finds its own
BLOCK = 512  # functions whose draws are held in memory at a time
# functions, such as the samples of a run, beyond which only every eighth draw is used: their ends then scatter by 2 %
MANY, EVERY = 2000, 8
REACH = 8.0  # inequalities further away than this many standard deviations of their slack cannot move an interval


@dataclass(frozen=True, eq=False)
class LocalEstimate:
    """An estimate in whitened tangent coordinates v, and inequalities rows (r, n) @ v + slack (r,) >= 0, slack >= 0."""

    centre: Array  # (n,) minimum without the inequalities, relative to the fit
    # (n, m) S, the centre has covariance S Sᵀ; draws are made in the m coordinates, which should not depend on the
    # basis of the tangent space, to be reproducible
    scatter: Array
    dof: float  # degrees of freedom of the noise estimate inside S
    rows: Array
    slack: Array
    draws: int = DRAWS  # number of random draws, at least 100 (`StructureError`)
    seed: int = 0

    def __post_init__(self) -> None:
        check_integer(self.draws, "draws, on which the ends of an interval rest,", 100)

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
    def samples(self) -> tuple[Array, Array, Array]:
        """Draws (draws, n) around zero, and their projections around the centre and around the fit."""
        rng = np.random.default_rng(self.seed)
        half = rng.standard_normal((-(-self.draws // 2), self.scatter.shape[1]))
        half *= np.sqrt(self.dof / rng.chisquare(self.dof, (len(half), 1)))
        spread = np.vstack([half, -half])[: self.draws] @ self.scatter.T
        rows, slack = self.rows[self.in_reach], self.slack[self.in_reach]
        return spread, project(self.centre + spread, rows, slack), project(spread, rows, slack)

    def limits(self, slopes: Array, level: float) -> tuple[Array, Array, Array]:
        """Return the standard error (q,) and the two ends, lower <= 0 <= upper, of q functions of v with slopes (q, n).

        The quantiles of the projected draws are corrected by the known error of those of the draws themselves (control
        variates). The level is the probability inside.
        """
        error = np.linalg.norm(slopes @ self.scatter, axis=1)
        half = float(stdtrit(self.dof, 0.5 + level / 2)) * error
        if not self.held:
            return error, -half, half
        every = EVERY if len(slopes) > MANY else 1
        starts = range(0, max(len(slopes), 1), BLOCK)  # the draws of all at once would fill the memory
        parts = [self._constrained(slopes[k : k + BLOCK], level, error[k : k + BLOCK], half[k : k + BLOCK], every)
                 for k in starts]
        error, low, high = map(np.concatenate, zip(*parts))
        return error, low, high

    def _constrained(self, slopes: Array, level: float, error: Array, half: Array, every: int
                     ) -> tuple[Array, Array, Array]:
        free, posterior, scattered = (slopes @ points[::every].T for points in self.samples)
        tails, known = [0.5 - level / 2, 0.5 + level / 2], np.array([-half, half])
        missed = np.quantile(free, tails, axis=1) - known
        spread = np.maximum(np.std(free, axis=1), np.finfo(float).tiny)
        low, high = np.quantile(posterior, tails, axis=1) - np.std(posterior, axis=1) / spread * missed
        down, up = np.quantile(scattered, tails, axis=1) - np.std(scattered, axis=1) / spread * missed
        wide = error**2 * (self.dof / (self.dof - 2) if self.dof > 2 else 1.0)  # variance of the draws
        exact = np.divide(wide, spread**2, out=np.ones_like(wide), where=spread**2 > 0)
        error = np.sqrt(np.mean(scattered**2, axis=1) * exact)
        return error, np.minimum(np.minimum(low, -up), 0.0), np.maximum(np.maximum(high, -down), 0.0)


def project(points: Array, rows: Array, slack: Array) -> Array:
    """Project points (K, n) on the polyhedron {v: rows @ v + slack >= 0}, which contains the origin.

    Least-distance programming gives the active rows of one point; the same rows are tried for all other points.
    """
    size = max(float(np.max(np.linalg.norm(points, axis=1), initial=0.0)), np.finfo(float).tiny)
    lengths = np.linalg.norm(rows, axis=1)
    rows, slack = rows[lengths > 0] / lengths[lengths > 0, None], slack[lengths > 0] / lengths[lengths > 0]
    projected = points.copy()
    left, tried = np.flatnonzero(np.any(points @ rows.T + slack < 0, axis=1)), 0
    while left.size:
        first = left[0]
        multipliers = least_distance(-rows, -(points[first] @ rows.T + slack) / size, np.zeros(len(rows), dtype=bool))
        assert multipliers is not None  # the polyhedron contains the origin
        projected[first] += size * multipliers @ rows
        left = left[1:]
        active = np.flatnonzero(multipliers > 0)
        if tried == SETS or not left.size or not 0 < active.size <= points.shape[1]:
            continue
        tried += 1
        held = rows[active]
        gram = held @ held.T
        if np.linalg.cond(gram) > 1e12:
            continue
        forces = np.linalg.solve(gram, -(points[left] @ held.T + slack[active]).T).T
        moved = points[left] + forces @ held
        fits = np.all(forces >= -1e-12 * size, axis=1) & np.all(moved @ rows.T + slack >= -1e-9 * size, axis=1)
        projected[left[fits]] = moved[fits]
        left = left[~fits]
    return projected
