"""Kronecker whitening: coordinates in which every rank-one block of a least-squares problem sees nearly the identity.

For independent inputs the Gram matrix of a Hammerstein block is ``G_b kron G_mu`` and the best rank-one fit is a plain
singular value decomposition in the coordinates ``L_mu^T Theta L_b`` (G = L L^T). For correlated inputs the nearest
Kronecker product still makes starts, Newton steps and proofs of optimality well conditioned, and it keeps rank one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from scipy.linalg import get_lapack_funcs

from optid.arrays import Array

_potrf, _trtri, _trtrs = get_lapack_funcs(("potrf", "trtri", "trtrs"), dtype=float)

TINY = np.finfo(float).tiny


def kronecker_factors(gram: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Return lower triangular ``(L_mu, L_b)`` with ``gram ~ (L_b L_b^T) kron (L_mu L_mu^T)`` for a shape (P, nb).

    Flip-flop iteration, the maximum-likelihood fit of a separable covariance (Dutilleul, J. Stat. Comput. Simul. 64,
    1999): each factor in turn is the average of the other one's whitened blocks.
    """
    p, nb = shape
    paired = gram.reshape(nb, p, nb, p).transpose(0, 2, 1, 3).reshape(nb * nb, p * p)
    inverse_b = np.eye(nb)
    factor_mu, factor_b = np.eye(p), np.eye(nb)
    for _ in range(5):  # enough for coordinates
        factor_mu, inverse_mu = _factor((inverse_b.ravel() @ paired).reshape(p, p) / nb)
        factor_b, inverse_b = _factor((paired @ inverse_mu.ravel()).reshape(nb, nb) / p)
    return factor_mu, factor_b


def _factor(matrix: Array) -> tuple[Array, Array]:
    """Lower Cholesky factor and inverse; a tiny multiple of the identity is added to keep it invertible."""
    shifted = matrix.copy()
    shifted.flat[:: len(matrix) + 1] += 1e-13 * max(float(matrix.trace()) / len(matrix), TINY)
    factor, info = _potrf(shifted, lower=1, clean=1)
    if info:
        raise np.linalg.LinAlgError(f"the matrix is not positive definite at row {info - 1}")
    inverse = invert_triangular(factor)
    return factor, inverse.T @ inverse


def invert_triangular(factor: Array, lower: bool = True) -> Array:
    """Inverse of a triangular matrix whose diagonal has no zero."""
    inverse, info = _trtri(factor, lower=int(lower))
    if info:
        raise np.linalg.LinAlgError(f"the triangular factor is singular at row {info - 1}")
    return inverse


def symmetric_root(matrix: Array) -> Array:
    """Return the symmetric square root of a matrix without negative eigenvalues, which is unique."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def block_slices(shapes: Sequence[tuple[int, int]], first: int = 0) -> list[slice]:
    """Columns of every block in a lifted vector whose first block begins at a column."""
    return [slice(start, stop) for start, stop in pairwise(accumulate((p * nb for p, nb in shapes), initial=first))]


@dataclass(frozen=True, eq=False)
class Whitening:
    """The change of coordinates ``Theta_i' = L_mu,i^T Theta_i L_b,i`` and, for kept linear unknowns, ``w' = R_w w``."""

    shapes: tuple[tuple[int, int], ...]  # (P_i, nb_i) of every block
    factors_mu: tuple[Array, ...]  # (P_i, P_i) lower triangular
    factors_b: tuple[Array, ...]  # (nb_i, nb_i) lower triangular
    factor_w: Array  # (linear, linear) upper triangular

    @property
    def linear(self) -> int:
        """Number of unknowns outside the blocks."""
        return len(self.factor_w)

    def columns(self, rows: Array) -> Array:
        """Return ``rows @ K^-1``: linear forms in the old unknowns (k, n) written in the new ones."""
        new = np.empty((len(rows), rows.shape[1]))
        w = self.linear
        new[:, :w] = rows[:, :w] @ invert_triangular(self.factor_w, lower=False) if w else 0.0
        for where, (p, nb), factor_mu, factor_b in zip(
                block_slices(self.shapes, w), self.shapes, self.factors_mu, self.factors_b):
            block = rows[:, where].reshape(-1, p) @ invert_triangular(factor_mu).T
            new[:, where] = np.matmul(invert_triangular(factor_b), block.reshape(-1, nb, p)).reshape(-1, p * nb)
        return new

    def forward(self, mus: tuple[Array, ...], bs: tuple[Array, ...]) -> tuple[list[Array], list[Array]]:
        """Factors (mu_i, b_i) in the new coordinates."""
        return ([factor.T @ mu for factor, mu in zip(self.factors_mu, mus)],
                [factor.T @ b for factor, b in zip(self.factors_b, bs)])

    def back(self, mus: list[Array], bs: list[Array]) -> tuple[list[Array], list[Array]]:
        """Factors (mu_i, b_i) in the original coordinates."""
        return ([_trtrs(factor, mu, lower=1, trans=1)[0] for factor, mu in zip(self.factors_mu, mus)],
                [_trtrs(factor, b, lower=1, trans=1)[0] for factor, b in zip(self.factors_b, bs)])


def whiten(root: Array, shapes: tuple[tuple[int, int], ...], linear: int = 0) -> Whitening:
    """Choose the coordinates of blocks (P_i, nb_i) from the root (n, n) of the Gram matrix.

    Its first ``linear`` columns belong to unknowns outside the blocks.
    """
    parts = [root[:, where] for where in block_slices(shapes, linear)]
    pairs = [kronecker_factors(part.T @ part, shape) for part, shape in zip(parts, shapes)]
    return Whitening(shapes, tuple(mu for mu, _ in pairs), tuple(b for _, b in pairs), root[:linear, :linear].copy())
