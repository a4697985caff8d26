"""Subspaces of a covariance C: the loss of projecting on them, its stationary points, reconstruction, a certificate.

J(W) = E|x - W W^T x|^2 = tr C - 2 tr(W^T C W) + tr(W^T C W W^T W), W of rank r. Theorems of Yang (1995): W is
stationary if and only if W = U_r Q with r eigenvectors of C and Q orthogonal; all of these are saddles except the r
dominant ones, where J has its global minimum, the sum of the other eigenvalues (Eckart and Young 1936). Without the
rank condition W = 0 and [u_1, 0] are stationary too. Turning u_i towards a discarded u_k by an angle t changes J by
sin^2(t) (c_i - c_k). Subspaces within surviving directions N lose what the dominant eigenvectors of N^T C N leave,
bounded by the interlacing of eigenvalues (Cauchy).

The certificate is the dual of max tr(C P) over 0 <= P <= I, tr P = r. The set is the convex hull of the projectors of
rank r (Fan 1949; Overton and Womersley 1992), so that the maximum over projectors has no gap: for every t,
tr(C P) <= r t + sum max(c_i - t, 0), equal at any t between c_(r+1) and c_r.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import subspace_angles

from optid.arrays import Array, check_integer
from optid.errors import DataError, RankError, StructureError

SYMMETRIC = INSIDE = 1e-8
FLAT = 1e-8  # curvature, or gradient, relative to the largest eigenvalue of C that is zero up to rounding
MANY = 10_000  # invariant subspaces listed at most


def as_covariance(covariance: ArrayLike) -> Array:
    """Return a covariance (n, n); one that is not square, finite, symmetric and semidefinite is a `DataError`."""
    c = np.asarray(covariance, dtype=float)
    if c.ndim != 2 or c.shape[0] != c.shape[1] or not c.size:
        raise DataError(f"covariance: must be a square matrix; got shape {c.shape}.")
    if not np.isfinite(c).all():
        i, j = np.argwhere(~np.isfinite(c))[0]
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
    """Return a matrix (n, r); another shape, or an entry that is not finite, is a `DataError`."""
    w = np.asarray(basis, dtype=float)
    w = w[:, None] if w.ndim == 1 else w
    if w.ndim != 2 or w.shape[0] != n or not 0 < w.shape[1] <= n:
        raise DataError(f"{what}: must be an array ({n}, r) with r from 1 to {n}; got shape {w.shape}.")
    if not np.isfinite(w).all():
        raise DataError(f"{what}: every entry must be finite.")
    return w


def orthonormal(basis: ArrayLike, what: str = "basis", n: int | None = None) -> Array:
    """Return an orthonormal basis (n, r) of the columns; dependent columns are a `RankError`, others as `as_basis`."""
    w = as_basis(basis, len(np.asarray(basis)) if n is None else n, what)
    length = np.linalg.norm(w, axis=0)
    if not length.all():
        raise RankError(f"{what}: column {int(np.argmin(length)) + 1} is zero.")
    left, values, _ = np.linalg.svd(w / length, full_matrices=False)
    if values[-1] <= 1e-12 * values[0]:
        raise RankError(f"{what}: the {w.shape[1]} columns span {int(np.sum(values > 1e-12 * values[0]))} dimensions "
                        "only; leave dependent columns out.")
    return left


def principal_angles(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the principal angles between two column spaces (n, r1) and (n, r2), ascending, in radians.

    The largest one satisfies sin = ``||(I - P_1) U_2||_2`` when the dimensions agree (Bjorck and Golub 1973).

    Raises:
        DataError: different n.
        RankError: dependent columns.
    """
    a, b = orthonormal(first, "first subspace"), orthonormal(second, "second subspace")
    if len(a) != len(b):
        raise DataError(f"the subspaces live in {len(a)} and {len(b)} dimensions.")
    return subspace_angles(a, b)[::-1]


@dataclass(frozen=True, eq=False)
class StationaryPoint:
    """A matrix W judged by the theorems: its rank, J(W), and the norm of the gradient of J there.

    Attributes:
        indices: eigenvectors of C that span it, 0 for the dominant one; () for a W that was given.
        curvatures: (n r,) eigenvalues of the Hessian, ascending; r (r - 1) / 2 of them are zero, the rotations of W.
    """

    indices: tuple[int, ...]
    loss: float
    gradient: float
    rank: int
    curvatures: Array
    kind: Literal["minimum", "saddle", "maximum", "not stationary"]


def projection_loss(covariance: ArrayLike, basis: ArrayLike) -> float:
    """Return J(W) for a covariance (n, n) and W (n, r) of any rank."""
    c = as_covariance(covariance)
    w = as_basis(basis, len(c))
    inner = w.T @ c @ w
    return float(np.trace(c) - 2 * np.trace(inner) + np.sum(inner * (w.T @ w)))


def loss_derivatives(covariance: ArrayLike, basis: ArrayLike) -> tuple[Array, Array]:
    """Return the gradient (n, r) of J at W, and the Hessian (n r, n r) for vec(W) by columns."""
    c = as_covariance(covariance)
    w = as_basis(basis, len(c))
    n, r = w.shape
    cw, gram, inner = c @ w, w.T @ w, w.T @ c @ w
    hessian = np.kron(gram - 2 * np.eye(r), 2 * c) + np.kron(inner, 2 * np.eye(n))
    hessian += np.kron(np.eye(r), 2 * (cw @ w.T + w @ cw.T))
    # terms in D^T: vec(X D^T Y) has the block (b, a) equal to X[:, a] Y[:, b]^T
    turned = np.einsum("ia,jb->biaj", cw, w) + np.einsum("ia,jb->biaj", w, cw)
    hessian += 2 * turned.reshape(n * r, n * r)
    return -4 * cw + 2 * cw @ gram + 2 * w @ inner, (hessian + hessian.T) / 2


def stationary_point(covariance: ArrayLike, basis: ArrayLike, indices: Sequence[int] = ()) -> StationaryPoint:
    """Judge one W (n, r) by gradient and curvature of J."""
    slope, hessian = loss_derivatives(covariance, basis)
    scale = float(np.linalg.norm(covariance, 2)) * max(1.0, float(np.linalg.norm(basis, 2)) ** 3)
    gradient, curvatures = float(np.linalg.norm(slope)), np.asarray(np.linalg.eigvalsh(hessian), dtype=float)
    if gradient > FLAT * scale:
        kind = "not stationary"
    elif curvatures[0] >= -FLAT * scale:
        kind = "minimum"
    else:
        kind = "maximum" if curvatures[-1] <= FLAT * scale else "saddle"
    return StationaryPoint(tuple(indices), projection_loss(covariance, basis), gradient,
                           int(np.linalg.matrix_rank(np.asarray(basis))), curvatures, kind)


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
    vectors, pool = _descending(c)[1], _eigenvectors(range(len(c)) if among is None else among, len(c), "among")
    check_integer(r, "r", high=len(pool))
    if comb(len(pool), r) > MANY:
        raise StructureError(f"{comb(len(pool), r)} invariant subspaces: give fewer eigenvectors in `among`.")
    found = [stationary_point(c, vectors[:, list(chosen)], chosen) for chosen in combinations(pool, r)]
    return sorted(found, key=lambda point: point.loss)


def _eigenvectors(indices: Sequence[int], n: int, what: str) -> list[int]:
    chosen = [int(i) for i in indices]
    if not chosen or len(set(chosen)) != len(chosen) or not all(0 <= i < n for i in chosen):
        raise StructureError(f"{what}={chosen}: must be distinct eigenvectors from 0 to {n - 1}.")
    return chosen


def _descending(c: Array) -> tuple[Array, Array]:
    values, vectors = np.linalg.eigh((c + c.T) / 2)
    return values[::-1], vectors[:, ::-1]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An orthogonal projector of rank r and its loss.

    Attributes:
        basis: (n, r) orthonormal.
        loss: tr((I - P) C), mean energy of x - P x.
        optimal_loss: the same for the r dominant eigenvectors, without constraint.
        worst_loss: bound on the loss from the dimension of the constraint alone.
        kind: "optimal", "sub-optimal" or "constrained".
    """

    basis: Array
    loss: float
    optimal_loss: float
    worst_loss: float
    kind: str

    @property
    def projector(self) -> Array:
        """P, (n, n)."""
        return self.basis @ self.basis.T

    @property
    def excess(self) -> float:
        """Energy lost beyond the optimum."""
        return self.loss - self.optimal_loss

    def __call__(self, x: ArrayLike) -> Array:
        """Project samples (N, n) or one sample (n,)."""
        return np.asarray(x, dtype=float) @ self.basis @ self.basis.T

    def __str__(self) -> str:
        return (f"{self.kind} reconstruction of rank {self.basis.shape[1]} in {len(self.basis)} dimensions\n"
                f"energy lost {self.loss:.6g}, the optimum {self.optimal_loss:.6g}, at most {self.worst_loss:.6g}")


def optimal_reconstruction(covariance: ArrayLike, r: int) -> Reconstruction:
    """Project on the r dominant eigenvectors of a covariance (n, n): P = U_1 U_1^T."""
    return replace(constrained_reconstruction(covariance, r), kind="optimal")


def suboptimal_reconstruction(covariance: ArrayLike, indices: Sequence[int]) -> Reconstruction:
    """Project on chosen eigenvectors, 0 for the dominant one; repeated or unknown ones are a `StructureError`."""
    c = as_covariance(covariance)
    chosen = _eigenvectors(indices, len(c), "indices")
    found = constrained_reconstruction(c, len(chosen), within=_descending(c)[1][:, chosen])
    return replace(found, kind="sub-optimal")


def constrained_reconstruction(covariance: ArrayLike, r: int, *, within: ArrayLike | None = None,
                               containing: ArrayLike | None = None) -> Reconstruction:
    """Find the best projector of rank r whose range lies within a subspace and contains another.

    Args:
        covariance: (n, n).
        r: rank.
        within: (n, s) surviving directions, s >= r; None for all (`surviving` gives those of lost sensors).
        containing: (n, k) directions that must be kept, k <= r; None for none.

    Raises:
        StructureError: r larger than the surviving directions or smaller than those to be kept, or kept directions
            outside the surviving ones.
        RankError: dependent columns.
    """
    c = as_covariance(covariance)
    check_integer(r, "r", high=len(c))
    space = np.eye(len(c)) if within is None else orthonormal(within, "within", len(c))
    if space.shape[1] < r:
        raise StructureError(f"r={r}: the surviving directions have dimension {space.shape[1]} only.")
    kept = np.zeros((len(c), 0)) if containing is None else orthonormal(containing, "containing", len(c))
    if kept.shape[1] > r:
        raise StructureError(f"r={r}: {kept.shape[1]} directions are to be kept.")
    if np.linalg.norm(kept - space @ (space.T @ kept)) > INSIDE:
        raise StructureError("containing: a direction that must be kept is not among the surviving ones.")
    rest = space @ np.linalg.svd(space.T @ kept, full_matrices=True)[0][:, kept.shape[1] :]
    basis = np.hstack([kept, rest @ _descending(rest.T @ c @ rest)[1][:, : r - kept.shape[1]]])
    values = _descending(c)[0]
    # interlacing: the i-th eigenvalue in a subspace of codimension d is at least the (i + d)-th of C
    lost, free = len(c) - space.shape[1] + kept.shape[1], r - kept.shape[1]
    held = float(np.sum(values[lost : lost + free])) + float(np.sum(values[len(c) - kept.shape[1] :]))
    loss = float(np.trace(c) - np.trace(basis.T @ c @ basis))
    return Reconstruction(basis, loss, float(np.sum(values[r:])), float(np.sum(values)) - held, "constrained")


def surviving(n: int, lost: Sequence[int]) -> Array:
    """Return the directions (n, n - lost) that remain when coordinates are lost.

    Coordinates that do not exist, or none left, are a `StructureError`.
    """
    gone = sorted({int(i) for i in lost})
    if not all(0 <= i < n for i in gone) or len(gone) >= n:
        raise StructureError(f"lost={gone}: must be coordinates from 0 to {n - 1}, not all of them.")
    return np.delete(np.eye(n), gone, axis=1)


@dataclass(frozen=True, eq=False)
class FantopeCertificate:
    """Energy of a subspace, and a proven bound on the energy of any subspace of its dimension.

    Attributes:
        energy: tr(P C) of the projector on the subspace.
        bound: r t + sum max(c_i - t, 0).
        t: the multiplier of tr P = r.
        total: tr C.
        lost: coordinates that every admissible subspace must leave at zero.
    """

    energy: float
    bound: float
    t: float
    total: float
    lost: tuple[int, ...] = ()

    @property
    def gap(self) -> float:
        """Bound less energy."""
        return self.bound - self.energy

    @property
    def relative_gap(self) -> float:
        """The gap as a share of the bound."""
        return self.gap / self.bound if self.bound > 0 else 0.0

    def __str__(self) -> str:
        within = f" ({len(self.lost)} coordinates lost)" if self.lost else ""
        return (f"energy {self.energy:.6g} of {self.total:.6g}; no subspace holds more than {self.bound:.6g}{within}\n"
                f"gap {self.gap:.2g} ({100 * self.relative_gap:.2g} %), multiplier t = {self.t:.6g}")


def fantope_certificate(covariance: ArrayLike, basis: ArrayLike, t: float | None = None, lost: Sequence[int] = ()
                        ) -> FantopeCertificate:
    """Certify a subspace, tracked or computed.

    Args:
        covariance: (n, n) C.
        basis: (n, r) its columns span the subspace; orthonormalised first.
        t: any number gives a valid bound; the best one when not given.
        lost: coordinates that must stay zero (P F = 0 with unit vectors F): the bound is then over the rest.

    Raises:
        DataError: a basis that uses a lost coordinate, or shapes that do not agree.
        StructureError: lost coordinates that do not exist or leave fewer than r, a t that is not finite.
    """
    c = as_covariance(covariance)
    w = orthonormal(basis, n=len(c))
    gone, space = sorted({int(i) for i in lost}), surviving(len(c), lost)
    r = check_integer(w.shape[1], "r", high=space.shape[1])
    if gone and float(np.abs(w[gone]).max()) > INSIDE:
        raise DataError(f"the basis uses the lost coordinates {gone}: restrict it to the surviving ones first.")
    values = _descending(space.T @ c @ space)[0]
    t = float(values[r - 1] + values[min(r, len(values) - 1)]) / 2 if t is None else float(t)
    if not np.isfinite(t):
        raise StructureError(f"t={t!r}: must be a finite number.")
    bound = float(r * t + np.sum(np.maximum(values - t, 0)))
    return FantopeCertificate(float(np.trace(w.T @ c @ w)), bound, t, float(np.trace(c)), tuple(gone))
