"""Multipliers and cuts for constraints that a rank-one fit meets.

Cones ``C_i mu_i >= 0`` with the sign of b_i free act on Theta_i = mu_i b_i^T only through products: with delta = C mu
the rows of C Theta satisfy ``(row j)^T (row k) = delta_j delta_k b b^T``, positive semidefinite for either sign. Hence
``tr(W (C Theta)_j^T (C Theta)_k) >= 0`` for every W >= 0, a quadratic form that is nonnegative on both branches.
Constraints ``E z <= f`` on the lifted vector are linear and enter the Lagrangian exactly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from optid.errors import StructureError
from optid.structures.rank_one import Array, RankOne

ACTIVE = 1e-6  # a row counts as active when its slack is below this fraction of the size of its terms


@dataclass(frozen=True, eq=False)
class Linear:
    """Constraints on the lifted vector: ``rows @ z <= right``, or ``=`` where ``equality``.

    Attributes:
        rows: (r, n).
        right: (r,).
        equality: (r,) of bool.
    """

    rows: Array
    right: Array
    equality: np.ndarray

    def slack(self, z: Array) -> tuple[Array, Array]:
        """(slack, size of the terms), each (r,)."""
        return self.right - self.rows @ z, np.abs(self.rows) @ np.abs(z) + np.abs(self.right)


def as_linear(linear, problem: RankOne) -> Linear | None:
    """Check the triple (E, f, equality mask) that callers give.

    Raises:
        StructureError: shapes that do not fit the lifted vector.
    """
    if linear is None:
        return None
    rows, right, equality = (np.asarray(part) for part in linear)
    n = len(problem.target)
    if rows.ndim != 2 or rows.shape[1] != n or right.shape != rows.shape[:1] or equality.shape != right.shape:
        raise StructureError(f"linear constraints need E (r, {n}), f (r,) and an equality mask (r,), not "
                             f"{rows.shape}, {right.shape}, {equality.shape}")
    return Linear(rows.astype(float), right.astype(float), equality.astype(bool)) if len(rows) else None


def as_cones(cones, problem: RankOne) -> dict[int, Array]:
    """Check the constraint matrices C_i (r_i, P_i), given as a sequence with None or as a mapping from block to C.

    Raises:
        StructureError: a matrix whose width is not P_i.
    """
    if cones is None:
        return {}
    pairs = cones.items() if isinstance(cones, Mapping) else enumerate(cones)
    found = {i: np.asarray(cone, float) for i, cone in pairs if cone is not None and len(cone)}
    for i, cone in found.items():
        if not 0 <= i < len(problem.blocks) or cone.ndim != 2 or cone.shape[1] != problem.blocks[i][0]:
            raise StructureError(f"cone {i} has shape {cone.shape}; block {i} of {problem.blocks} needs (r, P)")
    return found


@dataclass(frozen=True, eq=False)
class Multipliers:
    """KKT multipliers of a local solution: nu of the cones (by block) and lam of the linear constraints."""

    cones: dict[int, Array]
    linear: Array


def kkt_multipliers(slope: Array, shapes: Sequence[tuple[int, int]], offset: int, mus: Sequence[Array],
                    bs: Sequence[Array], cones: dict[int, Array], linear: Linear | None, z: Array) -> Multipliers:
    """Nonnegative least squares for the multipliers that make the gradient along the manifold vanish.

    Args:
        slope: (k,) half the gradient of the objective, in the coordinates of all the rest.
        shapes: (P_i, nb_i).
        offset: leading unknowns outside the blocks.
        mus: (P_i,) each.
        bs: (nb_i,) each, of unit length.
        cones: constraint matrices by block.
        linear: constraints on the lifted vector (k,).
        z: the lifted point (k,).
    """
    sizes = [np.linalg.norm(mu) for mu in mus]
    tangent = [np.eye(offset)] if offset else []
    tangent += [np.hstack([np.kron(b[:, None], np.eye(len(mu))),
                           np.kron(np.eye(len(b)), (mu / size if size else mu)[:, None])])
                for mu, b, size in zip(mus, bs, sizes)]
    heights = np.cumsum([0, *(t.shape[0] for t in tangent)])
    widths = np.cumsum([0, *(t.shape[1] for t in tangent)])
    jacobian = np.zeros((heights[-1], widths[-1]))
    for i, part in enumerate(tangent):
        jacobian[heights[i]:heights[i + 1], widths[i]:widths[i + 1]] = part
    first = 1 if offset else 0
    columns, owners = [], []
    for i, cone in cones.items():
        values, terms = cone @ mus[i], np.abs(cone) @ np.abs(mus[i])
        for row in np.flatnonzero(np.abs(values) <= ACTIVE * terms):
            column = np.zeros(widths[-1])
            column[widths[first + i]:widths[first + i] + len(mus[i])] = cone[row]
            columns.append(column)
            owners.append((i, row, 1.0))
    if linear is not None:
        slack, terms = linear.slack(z)
        for row in np.flatnonzero((np.abs(slack) <= ACTIVE * terms) | linear.equality):
            column = jacobian.T @ linear.rows[row]
            columns.append(-column)
            owners.append((-1, row, 1.0))
            if linear.equality[row]:
                columns.append(column)
                owners.append((-1, row, -1.0))
    nu: dict[int, Array] = {i: np.zeros(len(cone)) for i, cone in cones.items()}
    lam = np.zeros(0 if linear is None else len(linear.right))
    if columns:
        design = np.column_stack(columns)
        lengths = np.maximum(np.linalg.norm(design, axis=0), np.finfo(float).tiny)
        weights = nnls(design / lengths, jacobian.T @ (2 * slope))[0] / lengths
        for (i, row, sign), weight in zip(owners, weights):
            (lam if i < 0 else nu[i])[row] += sign * weight
    return Multipliers(nu, lam)


def sign_free_cut(nu: Array, cone: Array, mu: Array) -> Array:
    """Weights (r, r) of products of rows whose form Q = C^T weights C has ``Q mu = C^T nu / 2``.

    Any second factor rho = C^T kappa with kappa >= 0 and rho^T mu = 1 will do; the one nearest to mu / ||mu||^2
    disturbs the rest least.

    Args:
        nu: (r,) multipliers >= 0, zero where C mu > 0.
        cone: (r, P).
        mu: (P,).
    """
    kappa = nnls(cone.T, mu)[0]
    reach = float(kappa @ (cone @ mu))
    if reach <= 0:
        return np.zeros((len(nu), len(nu)))
    outer = np.outer(nu, kappa) / (2 * reach)
    return outer + outer.T


def align_cuts(weights: Array, cone: Array, mu: Array, b: Array, nu: Array) -> Array:
    """Make the cut weights of a relaxation exact at a point: no value there, and the gradient of the multipliers nu.

    Args:
        weights: (r, r, nb, nb), positive semidefinite for every pair of rows.
        cone: (r, P).
        mu: (P,).
        b: (nb,) of unit length.
        nu: (r,) KKT multipliers.
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
