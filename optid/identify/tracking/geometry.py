"""The loss behind subspace tracking, its stationary points, and angles between subspaces.

J(W) = E|x - W W^T x|^2 = tr C - 2 tr(W^T C W) + tr(W^T C W W^T W), W of rank r. Theorems of Yang (1995): W is
stationary if and only if W = U_r Q with r eigenvectors of C and Q orthogonal; all of these are saddles except the r
dominant ones, where J has its global minimum, the sum of the other eigenvalues. Without the rank condition W = 0 and
[u_1, 0] are stationary too. Turning u_i towards a discarded u_k by an angle t changes J by sin^2(t) (c_i - c_k).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import subspace_angles

from optid.arrays import Array, check_integer
from optid.errors import DataError, RankError, StructureError

SYMMETRIC = 1e-8
FLAT = 1e-8  # curvature, or gradient, relative to the largest eigenvalue of C that is zero up to rounding
MANY = 10_000  # invariant subspaces listed at most


@dataclass(frozen=True, eq=False)
class StationaryPoint:
    """One matrix W held against the theorems.

    Attributes:
        indices: eigenvectors of C that span it, 0 for the dominant one; () for a W that was given.
        loss: J(W).
        gradient: Frobenius norm of the gradient of J.
        rank: rank of W.
        curvatures: (n r,) eigenvalues of the Hessian, ascending; r (r - 1) / 2 of them are zero, the rotations of W.
        kind: "minimum", "saddle", "maximum", or "not stationary".
    """

    indices: tuple[int, ...]
    loss: float
    gradient: float
    rank: int
    curvatures: Array
    kind: Literal["minimum", "saddle", "maximum", "not stationary"]


def as_covariance(covariance: ArrayLike) -> Array:
    """Return a covariance (n, n), symmetric.

    Raises:
        DataError: not square, not finite, not symmetric, or not positive semidefinite, with the numbers.
    """
    c = np.asarray(covariance, dtype=float)
    if c.ndim != 2 or c.shape[0] != c.shape[1] or not c.size:
        raise DataError(f"covariance: a square matrix is needed; got shape {c.shape}.")
    if not np.isfinite(c).all():
        i, j = (int(k[0]) for k in np.nonzero(~np.isfinite(c)))
        raise DataError(f"covariance: entry ({i}, {j}) is {c[i, j]}; estimate it from complete samples.")
    size = float(np.abs(c).max())
    if np.abs(c - c.T).max() > SYMMETRIC * size:
        raise DataError("covariance: the matrix is not symmetric.")
    c = (c + c.T) / 2
    least = float(np.linalg.eigvalsh(c)[0])
    if least < -SYMMETRIC * max(size, np.finfo(float).tiny):
        raise DataError(f"covariance: the smallest eigenvalue is {least:.3g}; a covariance has none below zero.")
    return c


def as_basis(basis: ArrayLike, n: int, what: str = "basis") -> Array:
    """Return a matrix (n, r) with finite entries.

    Raises:
        DataError: another shape, or an entry that is not finite.
    """
    w = np.asarray(basis, dtype=float)
    w = w[:, None] if w.ndim == 1 else w
    if w.ndim != 2 or w.shape[0] != n or not 0 < w.shape[1] <= n:
        raise DataError(f"{what}: an array ({n}, r) with r from 1 to {n} is needed; got shape {w.shape}.")
    if not np.isfinite(w).all():
        raise DataError(f"{what}: every entry must be finite.")
    return w


def orthonormal(basis: ArrayLike, what: str = "basis", n: int | None = None) -> Array:
    """Return an orthonormal basis (n, r) of the columns; any n where none is given.

    Raises:
        DataError: another shape, or an entry that is not finite.
        RankError: columns that depend on one another.
    """
    w = as_basis(basis, len(np.asarray(basis)) if n is None else n, what)
    length = np.linalg.norm(w, axis=0)
    if not length.all():
        raise RankError(f"{what}: column {int(np.argmin(length)) + 1} is zero.")
    left, values, _ = np.linalg.svd(w / length, full_matrices=False)
    if values[-1] <= 1e-12 * values[0]:
        raise RankError(f"{what}: the {w.shape[1]} columns span {int(np.sum(values > 1e-12 * values[0]))} dimensions "
                        "only; leave dependent columns out.")
    return left


def _checked(covariance: ArrayLike, basis: ArrayLike) -> tuple[Array, Array]:
    c = as_covariance(covariance)
    return c, as_basis(basis, len(c))


def principal_angles(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the principal angles between two column spaces, ascending, in radians.

    Small angles come from sines, large ones from cosines (Bjorck and Golub 1973): both keep all their digits. The
    largest one satisfies sin = ``||(I - P_1) U_2||_2`` when the dimensions agree.

    Args:
        first: (n, r1), any basis.
        second: (n, r2), any basis.

    Raises:
        DataError: different n.
        RankError: dependent columns.
    """
    a, b = orthonormal(first, "first subspace"), orthonormal(second, "second subspace")
    if len(a) != len(b):
        raise DataError(f"the subspaces live in {len(a)} and {len(b)} dimensions.")
    return subspace_angles(a, b)[::-1]


def projection_loss(covariance: ArrayLike, basis: ArrayLike) -> float:
    """Return J(W) for a covariance (n, n) and W (n, r) of any rank."""
    c, w = _checked(covariance, basis)
    inner = w.T @ c @ w
    return float(np.trace(c) - 2 * np.trace(inner) + np.sum(inner * (w.T @ w)))


def loss_gradient(covariance: ArrayLike, basis: ArrayLike) -> Array:
    """Return the gradient (n, r) of J at W: -4 C W + 2 C W W^T W + 2 W W^T C W."""
    c, w = _checked(covariance, basis)
    return -4 * c @ w + 2 * c @ w @ (w.T @ w) + 2 * w @ (w.T @ c @ w)


def loss_hessian(covariance: ArrayLike, basis: ArrayLike) -> Array:
    """Return the Hessian (n r, n r) of J at W, for vec(W) by columns."""
    c, w = _checked(covariance, basis)
    n, r = w.shape
    cw, gram, inner = c @ w, w.T @ w, w.T @ c @ w
    hessian = np.kron(gram - 2 * np.eye(r), 2 * c) + np.kron(inner, 2 * np.eye(n))
    hessian += np.kron(np.eye(r), 2 * (cw @ w.T + w @ cw.T))
    # terms in D^T: vec(X D^T Y) has the block (b, a) equal to X[:, a] Y[:, b]^T
    turned = np.einsum("ia,jb->biaj", cw, w) + np.einsum("ia,jb->biaj", w, cw)
    hessian += 2 * turned.reshape(n * r, n * r)
    return (hessian + hessian.T) / 2


def stationary_point(covariance: ArrayLike, basis: ArrayLike, indices: Sequence[int] = ()) -> StationaryPoint:
    """Judge one W (n, r) by gradient and curvature of J."""
    c, w = _checked(covariance, basis)
    scale = float(np.linalg.norm(c, 2)) * max(1.0, float(np.linalg.norm(w, 2)) ** 3)
    gradient = float(np.linalg.norm(loss_gradient(c, w)))
    curvatures = np.asarray(np.linalg.eigvalsh(loss_hessian(c, w)), dtype=float)
    if gradient > FLAT * scale:
        kind = "not stationary"
    elif curvatures[0] >= -FLAT * scale:
        kind = "minimum"
    else:
        kind = "maximum" if curvatures[-1] <= FLAT * scale else "saddle"
    rank = int(np.linalg.matrix_rank(w))
    return StationaryPoint(tuple(indices), projection_loss(c, w), gradient, rank, curvatures, kind)


def stationary_points(covariance: ArrayLike, r: int, among: Sequence[int] | None = None) -> list[StationaryPoint]:
    """Judge all invariant subspaces of r eigenvectors, by ascending loss.

    Args:
        covariance: (n, n).
        r: dimension.
        among: eigenvectors that are combined, 0 for the dominant one; all when not given.

    Raises:
        StructureError: r out of range, or more than 10,000 combinations.
    """
    c = as_covariance(covariance)
    vectors = np.linalg.eigh(c)[1][:, ::-1]
    pool = check_indices(range(len(c)) if among is None else among, len(c), "among")
    check_integer(r, "r", high=len(pool))
    if comb(len(pool), r) > MANY:
        raise StructureError(f"{comb(len(pool), r)} invariant subspaces: give fewer eigenvectors in `among`.")
    found = [stationary_point(c, vectors[:, list(chosen)], chosen) for chosen in combinations(pool, r)]
    return sorted(found, key=lambda point: point.loss)


def check_indices(indices: Sequence[int], n: int, what: str) -> list[int]:
    """Return indices of eigenvectors as a list.

    Raises:
        StructureError: none, one below 0 or not below n, or one that is named twice.
    """
    chosen = [int(i) for i in indices]
    if not chosen or len(set(chosen)) != len(chosen) or not all(0 <= i < n for i in chosen):
        raise StructureError(f"{what}={chosen}: distinct eigenvectors from 0 to {n - 1} are needed.")
    return chosen
