"""The numbers of a group-sparse least-squares problem, its dual bound, and which groups are zero for certain.

    P(a) = 1/2 ‖r - M a‖² + lambda sum_g w_g ‖a_g‖
    D(v) = 1/2 ‖r‖² - 1/2 ‖r - v‖²   for every v with ‖M_g' v‖ <= lambda w_g

D is strongly concave, so that the best v lies within sqrt(2 (P - D)) of any feasible one: a group whose ‖M_g' v‖ stays
below lambda w_g on that whole ball is zero in every minimiser (the gap-safe sphere of Ndiaye et al. 2017).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError

SPREAD = 1e-8  # columns of a group may differ from an orthogonal set of one length by this much


@dataclass(frozen=True, eq=False)
class GroupProblem:
    """One problem; the columns of a group are orthogonal and of one length, or zero.

    Raises:
        StructureError: shapes that do not fit, weights that are not positive, columns that are not orthogonal.
    """

    design: Array  # (m, p) M
    target: Array  # (m,) r
    edges: np.ndarray  # (G + 1,) columns edges[g]:edges[g + 1] are group g
    weights: Array  # (G,) w, positive

    def __post_init__(self) -> None:
        m, p = self.design.shape
        if self.target.shape != (m,) or self.edges[0] != 0 or self.edges[-1] != p or np.any(np.diff(self.edges) < 1):
            raise StructureError(
                f"design {self.design.shape}, target {self.target.shape} and edges to {self.edges[-1]} do not fit.")
        if self.weights.shape != (self.edges.size - 1,) or not np.all(np.isfinite(self.weights) & (self.weights > 0)):
            raise StructureError("every group needs a positive weight.")
        if not (np.isfinite(self.design).all() and np.isfinite(self.target).all()):
            raise StructureError("the design or the target has a value that is not finite.")
        counts = np.diff(self.edges)
        sizes, group = np.repeat(self.lengths**2, counts), np.repeat(np.arange(counts.size), counts)
        for d in range(1, int(counts.max())):
            first = np.flatnonzero(group[d:] == group[:-d])
            inner = np.einsum("ij,ij->j", self.design[:, first], self.design[:, first + d])
            if np.any(np.abs(inner) > SPREAD * sizes[first]):
                raise StructureError("the columns of a group must be orthogonal.")
        own = np.einsum("ij,ij->j", self.design, self.design)
        if np.any((np.abs(own - sizes) > SPREAD * sizes) & (own > 0)):
            raise StructureError("the columns of a group must be of one length, or zero.")

    @cached_property
    def lengths(self) -> Array:
        """(G,) length of the columns of every group."""
        return np.sqrt(np.maximum.reduceat(np.einsum("ij,ij->j", self.design, self.design), self.edges[:-1]))

    def norms(self, a: Array) -> Array:
        """Return the norm (G,) of every group of (p,)."""
        return np.sqrt(np.add.reduceat(a**2, self.edges[:-1]))

    def value(self, a: Array, penalty: float) -> float:
        """Return P(a)."""
        rest = self.target - self.design @ a
        return 0.5 * float(rest @ rest) + penalty * float(self.weights @ self.norms(a))

    def largest(self) -> float:
        """Return the smallest penalty at which everything is zero."""
        return float(np.max(self.norms(self.design.T @ self.target) / self.weights))

    def dual(self, v: Array, penalty: float, slope: Array | float = 0.0, constant: float = 0.0) -> tuple[float, Array]:
        """Return the value of the dual and the best feasible multiple of v (m,), usually the residual of a point.

        Multipliers of affine constraints add ``slope' a + constant`` to the objective, and are scaled with v.
        """
        if not np.isfinite(v).all():
            return -np.inf, np.zeros_like(v)
        most = float(np.max(self.norms(self.design.T @ v - slope) / (penalty * self.weights), initial=0.0))
        square, along = float(v @ v), float(self.target @ v) + constant
        best = 0.0 if square == 0.0 else max(along, 0.0) / square
        scale = best if most == 0.0 else min(best, 1.0 / most)
        if not scale > 0 or not np.isfinite(scale):  # also a most or along that is not a number
            return 0.0, np.zeros_like(v)
        return scale * along - 0.5 * scale**2 * square, scale * v

    def certainly_zero(self, point: Array, gap: float, penalty: float) -> np.ndarray:
        """Return which groups (G,) are zero in every minimiser, from a feasible point (m,) of the dual.

        The gap is a value of the primal less that of the dual at the point.
        """
        # the lengths and the gap are sums of about m rounded terms
        rounding = 1e-14 * float(self.target @ self.target)
        radius = np.sqrt(2 * max(gap, 0.0) + rounding)
        return self.norms(self.design.T @ point) + radius * self.lengths < penalty * self.weights
