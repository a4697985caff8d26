"""Algebra of the 2 x 2 minors: quadratic forms that vanish on rank-one matrices, and the dual bound they give.

Adding such a form ``z^T M z`` to a least-squares objective changes nothing on the rank-one blocks, and if H + M > 0 the
unrestricted minimum of the sum bounds the objective from below (Lagrangian dual of rank(Theta_i) <= 1; Shor's
relaxation is its dual). The forms of one block are the symmetric matrices that change sign when the row indices of
``X[(j, i), (l, k)]``, the lags j and l, are exchanged; this makes projection onto them one transposition.

The bound is raised by alternating projections with memory (Dykstra; equivalently ADMM) between the positive
semidefinite matrices and the affine set H + M_tangent + span(free minors), in coordinates where the point is the first
unit vector of every block: entries of different minors never overlap there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag, get_lapack_funcs

from optid.structures.rank_one import Array

_potrf, _trtrs = get_lapack_funcs(("potrf", "trtrs"), dtype=float)
Block = tuple[slice, tuple[int, int]]  # position in the lifted vector and shape (P, nb)
MARGIN = 1e-12  # a Cholesky factor of S - MARGIN max(diag S) I proves S > 0 in spite of roundoff


def project_minors(matrix: Array, shape: tuple[int, int]) -> Array:
    """Nearest combination of the minors of one block to a symmetric matrix (P nb, P nb); exactly antisymmetric."""
    p, nb = shape
    tensor = matrix.reshape(nb, p, nb, p)
    return ((tensor - tensor.transpose(2, 1, 0, 3)) / 2).reshape(p * nb, p * nb)


def tangent_minors(gradient: Array, mu: Array, b: Array) -> Array:
    """The combination M of minors with ``M kron(b, mu) = vec(gradient)``, which needs nothing beyond the tangent data.

    The gradient (P, nb) has ``gradient b = 0`` and ``gradient^T mu = 0``; mu (P,) is not zero, b (nb,) of unit length.
    """
    size = float(mu @ mu)
    outer = np.outer(gradient.T.ravel(), np.outer(b, mu)) / size
    return 2 * project_minors(outer + outer.T, gradient.shape)  # pyright: ignore[reportArgumentType]


def basis_from(direction: Array) -> Array:
    """Orthogonal matrix (n, n) whose first column is the unit vector ``direction`` (Householder)."""
    reflector = direction.copy()
    sign = 1.0 if direction[0] >= 0 else -1.0
    reflector[0] += sign
    return -sign * (np.eye(len(direction)) - np.outer(reflector, reflector) / (1 + abs(direction[0])))


def free_mask(shape: tuple[int, int]) -> np.ndarray:
    """Entries, as (P nb, P nb), of the minors that do not contain Theta[0, 0]."""
    p, nb = shape
    mask = np.ones((nb, p, nb, p), dtype=bool)
    mask[0, 0] = False
    mask[:, :, 0, 0] = False
    mask[0, :, :, 0] = False
    mask[:, 0, 0, :] = False
    return mask.reshape(p * nb, p * nb)


def cholesky(matrix: Array) -> Any | None:
    """Upper factor of a matrix proved positive definite with a margin for roundoff, or None."""
    shifted = matrix.copy()
    shifted.flat[::len(matrix) + 1] -= MARGIN * max(float(matrix.diagonal().max(initial=0.0)), 0.0)
    factor, info = _potrf(shifted, clean=0)
    return None if info else factor


@dataclass(frozen=True, eq=False)
class Quadratic:
    """The objective around a feasible point, with the terms of constraints linear in z already added."""

    gram: Array  # (k, k) H
    z: Array  # (k,) the point
    slope: Array  # (k,) half the gradient of objective and linear terms at z
    value: float  # objective at the point
    linear_terms: float = 0.0  # value at the point of the linear terms, <= 0 at a feasible point

    def bound(self, minors: Array, cuts: Array) -> float:
        """Closed-form minimum over all z of objective + linear terms + z^T (minors - cuts) z; -inf unless H + M > 0.

        The minors (k, k) are zero at every rank-one point, the cuts (k, k) nonnegative at every feasible one. Written
        around the point, D = L(z) - q^T S^-1 q with q half the gradient of L: nothing cancels, so a gap far below the
        roundoff of the objective itself is resolved.
        """
        if not len(self.z):
            return self.value
        extra = minors - cuts
        factor = cholesky(self.gram + extra)
        if factor is None:
            return -np.inf
        half, _ = _trtrs(factor, self.slope + extra @ self.z, trans=1)
        return self.value + self.linear_terms - float(self.z @ cuts @ self.z) - float(half @ half)


def rotation(linear: int, mus: Sequence[Array], bs: Sequence[Array]) -> Any:
    """Orthogonal matrix whose columns turn every block so that mu_i and b_i become first unit vectors."""
    parts = [np.kron(basis_from(b), basis_from(mu / np.linalg.norm(mu)) if mu.any() else np.eye(len(mu)))
             for mu, b in zip(mus, bs)]
    return block_diag(np.eye(linear), *parts)


def ascend(matrix: Array, blocks: Sequence[Block], masks: Sequence[np.ndarray],
           steps: int) -> tuple[Array | None, int]:
    """Return free minors N with ``matrix + N > 0`` (or None) and the steps taken, an eigenvalue decomposition each.

    The matrix (k, k) is H + M_tangent (- cuts) in rotated coordinates; masks, as (P nb, P nb), tell which entries of
    the minors of a block are free.
    """
    current, memory = matrix, np.zeros_like(matrix)
    aim = 0.1 * float(np.trace(matrix)) / len(matrix)  # inside the cone: its boundary is reached only in the limit
    for step in range(1, steps + 1):
        values, vectors = np.linalg.eigh(current + memory)
        positive = (vectors * np.maximum(values, aim)) @ vectors.T
        memory = memory + current - positive
        aim *= 0.95
        wanted = positive - memory - matrix
        current = matrix.copy()
        for (where, shape), mask in zip(blocks, masks):
            current[where, where] += project_minors(wanted[where, where], shape) * mask
        if cholesky(current) is not None:
            return current - matrix, step
    return None, steps
