"""Multipliers and cuts for constraints that a rank-one fit meets.

Cones ``C_i mu_i >= 0`` with the sign of b_i free act on Theta_i = mu_i b_i^T only through products: with delta = C mu
the rows of C Theta satisfy ``(row j)^T (row k) = delta_j delta_k b b^T``, positive semidefinite for either sign. Hence
``tr(W (C Theta)_j^T (C Theta)_k) >= 0`` for every W >= 0, a quadratic form that is nonnegative on both branches.
Constraints ``E z <= f`` on the lifted vector are linear and enter the Lagrangian exactly.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from optid.structures.multipliers import fit_multipliers
from optid.structures.rank_one import Array, Point

ACTIVE = 1e-6  # a row counts as active when its slack is below this fraction of the size of its terms


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Constraints on the lifted vector: ``rows @ z <= right``, or ``=`` where ``equality``."""

    rows: Array  # (r, n)
    right: Array  # (r,)
    equality: np.ndarray  # (r,) of bool

    def slack(self, z: Array) -> tuple[Array, Array]:
        """(slack, size of the terms), each (r,)."""
        return self.right - self.rows @ z, np.abs(self.rows) @ np.abs(z) + np.abs(self.right)

    @classmethod
    def none(cls, n: int) -> "LinearRows":
        """No constraints on n unknowns."""
        return cls(np.zeros((0, n)), np.zeros(0), np.zeros(0, dtype=bool))


def kkt_multipliers(slope: Array, point: Point, cones: Mapping[int, Array], linear: LinearRows
                    ) -> tuple[dict[int, Array], Array]:
    """Return the multipliers, of the cones and linear, that make the gradient along the manifold vanish.

    All is meant in the coordinates of the core: half the gradient of the objective (k,), and a point whose b are of
    unit length.
    """
    if not cones and not len(linear.right):
        return {}, np.zeros(0)
    mus = point.mus
    jacobian = Point(point.w, tuple(mu / (np.linalg.norm(mu) or 1.0) for mu in mus), point.bs).tangent()
    # of every mu in the tangent coordinates
    firsts = np.cumsum([len(point.w), *(mu.size + b.size for mu, b in zip(mus, point.bs))])
    active, parts = {}, []
    for i, cone in cones.items():
        active[i] = np.flatnonzero(np.abs(cone @ mus[i]) <= ACTIVE * (np.abs(cone) @ np.abs(mus[i])))
        parts.append(np.zeros((len(active[i]), jacobian.shape[1])))
        parts[-1][:, firsts[i] : firsts[i] + len(mus[i])] = cone[active[i]]
    slack, terms = linear.slack(point.lift())
    held = np.flatnonzero((np.abs(slack) <= ACTIVE * terms) | linear.equality)
    rows = np.vstack([*parts, -linear.rows[held] @ jacobian])
    equality = np.append(np.zeros(len(rows) - len(held), dtype=bool), linear.equality[held])
    lengths = np.maximum(np.linalg.norm(rows, axis=1), np.finfo(float).tiny)
    weights = fit_multipliers(rows / lengths[:, None], jacobian.T @ (2 * slope), equality)[0] / lengths
    *pieces, last = np.split(weights, np.cumsum([len(part) for part in parts]))
    nu: dict[int, Array] = {i: np.zeros(len(cone)) for i, cone in cones.items()}
    lam = np.zeros(len(linear.right))
    for i, piece in zip(cones, pieces):
        nu[i][active[i]] = piece
    lam[held] = last
    return nu, lam


def sign_free_cut(nu: Array, cone: Array, mu: Array) -> Array:
    """Weights (r, r) of products of rows whose form Q = C^T weights C has ``Q mu = C^T nu / 2``.

    The multipliers nu (r,) are >= 0, and zero where C mu > 0. Any second factor rho = C^T kappa with kappa >= 0 and
    rho^T mu = 1 will do; the one nearest to mu / ||mu||^2 disturbs the rest least.
    """
    kappa = nnls(cone.T, mu)[0]
    reach = float(kappa @ (cone @ mu))
    if reach <= 0:
        return np.zeros((len(nu), len(nu)))
    outer = np.outer(nu, kappa) / (2 * reach)
    return outer + outer.T


def align_cuts(weights: Array, cone: Array, mu: Array, b: Array, nu: Array) -> Array:
    """Make the cut weights of a relaxation exact at a point: no value there, and the gradient of the multipliers nu.

    The weights (r, r, nb, nb) are positive semidefinite for every pair of rows; cone (r, P), mu (P,), b (nb,) of unit
    length, nu (r,).
    """
    values = cone @ mu
    active = np.abs(values) <= ACTIVE * (np.abs(cone) @ np.abs(mu))
    weights = weights + weights.transpose(1, 0, 2, 3)
    loose = ~active[:, None] & ~active
    away = np.eye(len(b)) - np.outer(b, b)
    weights[loose] = away @ weights[loose] @ away
    pulls = np.einsum("jkab,a,b,k->j", weights, b, b, np.where(active, 0.0, values))
    factors = np.where(active & (pulls > 0), nu / np.where(pulls > 0, pulls, 1.0), 1.0)
    scale = np.where(active[:, None] & active, 1.0, np.where(active[:, None], factors[:, None], factors[None, :]))
    return weights * scale[..., None, None] / 2
