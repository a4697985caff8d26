"""Projectors that reconstruct a signal, what they lose, and a certificate of how far they are from the best.

At a stationary point of the loss W W^T is an orthogonal projector P that commutes with C and J = tr((I - P) C), the
energy lost by projecting. The minimum is the nearest r-dimensional subspace (Eckart and Young 1936); every other
invariant subspace loses what its eigenvalues lack; subspaces within surviving directions N lose what the dominant
eigenvectors of N^T C N leave, bounded by the interlacing of eigenvalues (Cauchy).

The certificate is the dual of max tr(C P) over 0 <= P <= I, tr P = r. The set is the convex hull of the projectors of
rank r (Fan 1949; Overton and Womersley 1992), so that the maximum over projectors has no gap: for every t,
tr(C P) <= r t + sum max(c_i - t, 0), equal at any t between c_(r+1) and c_r.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optid.arrays import Array, check_integer
from optid.errors import DataError, RankError, StructureError
from optid.identify.tracking.geometry import as_basis, as_covariance, check_indices, orthonormal

INSIDE = 1e-8


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An orthogonal projector of rank r and what it loses.

    Attributes:
        basis: (n, r) orthonormal.
        loss: tr((I - P) C), mean energy of x - P x.
        optimal_loss: the same for the r dominant eigenvectors, no constraint.
        worst_loss: bound on the loss that holds before the constraint is looked at, only its dimension is used.
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
    """Project on chosen eigenvectors, 0 for the dominant one; the excess is what their eigenvalues lack.

    Raises:
        StructureError: eigenvectors that do not exist or are named twice.
    """
    c = as_covariance(covariance)
    chosen = check_indices(indices, len(c), "indices")
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
    kept = np.zeros((len(c), 0))
    if containing is not None:
        kept = orthonormal(containing, "containing", len(c))
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

    Raises:
        StructureError: coordinates that do not exist, or none left.
    """
    gone = sorted({int(i) for i in lost})
    if not all(0 <= i < n for i in gone) or len(gone) >= n:
        raise StructureError(f"lost={gone}: coordinates from 0 to {n - 1}, not all of them, are needed.")
    return np.delete(np.eye(n), gone, axis=1)


@dataclass(frozen=True, eq=False)
class FantopeCertificate:
    """Energy that a subspace holds and a proven bound on the energy of any subspace of its dimension.

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
        """Energy that a better subspace could hold in addition, at most."""
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
    check_integer(w.shape[1], "r", high=space.shape[1])
    if gone and float(np.abs(w[gone]).max()) > 1e-8:
        raise DataError(f"the basis uses the lost coordinates {gone}: restrict it to the surviving ones first.")
    r, values = w.shape[1], _descending(space.T @ c @ space)[0]
    if t is None:
        t = float(values[r - 1] + (values[r] if r < len(values) else values[r - 1])) / 2
    elif not np.isfinite(t):
        raise StructureError(f"t={t!r}: a finite number is needed.")
    energy = float(np.trace(w.T @ c @ w))
    bound = float(r * t + np.sum(np.maximum(values - t, 0)))
    return FantopeCertificate(energy, bound, float(t), float(np.trace(c)), tuple(gone))


def oblique_projector(onto: ArrayLike, along: ArrayLike | None = None, *, noise: ArrayLike | None = None) -> Array:
    """Return S (G^T S)^-1 G^T, (n, n): x on the columns of S along the null space of G^T.

    Args:
        onto: (n, r) S.
        along: (n, r) G; S itself, the orthogonal projector, when neither this nor a covariance is given.
        noise: (n, n) covariance of what is added to a signal in S, positive definite; G = noise^-1 S then gives the
            estimate of least variance (Gauss and Markov). The covariance of the sum gives the same projector.

    Raises:
        StructureError: both `along` and `noise`, or S and G of different shape.
        RankError: a singular G^T S, S meets the null space of G^T, or a singular covariance.
    """
    s = as_basis(onto, len(np.asarray(onto)), "onto")
    orthonormal(s, "onto")
    if along is not None and noise is not None:
        raise StructureError("along and noise both choose the direction of the projection: give one of them.")
    g = s if along is None else as_basis(along, len(s), "along")
    if g.shape != s.shape:
        raise StructureError(f"onto has shape {s.shape} and along {g.shape}: they must agree.")
    if noise is not None:
        c = as_covariance(noise)
        if len(c) != len(s):
            raise StructureError(f"onto has {len(s)} rows and the covariance {len(c)}: they must agree.")
        if np.linalg.cond(c) > 1e14:
            raise RankError("noise: the covariance is singular; the weighted projector does not exist.")
        g = np.linalg.solve(c, s)
    inner = g.T @ s
    if not np.linalg.cond(inner) < 1e12:
        raise RankError("G^T S is singular: the subspace meets the directions along which it is projected.")
    return s @ np.linalg.solve(inner, g.T)


def filled(x: ArrayLike, basis: ArrayLike | None = None, *, covariance: ArrayLike | None = None) -> Array:
    """Fill missing entries (NaN) of zero-mean samples, from a subspace or by the conditional mean.

    Args:
        x: (N, n) or (n,).
        basis: (n, r): x = W y with the least-squares y of the entries present.
        covariance: (n, n): C_mp C_pp^+ x_p, the estimate of least variance for Gaussian samples. Give one of the two.

    Returns:
        A copy; entries that are present are not changed.

    Raises:
        StructureError: neither or both of basis and covariance.
        DataError: infinite entries, or another number of coordinates.
        RankError: a sample whose entries do not determine its coordinates, by number.
    """
    samples = np.array(x, dtype=float)
    if (basis is None) == (covariance is None):
        raise StructureError("Give either a basis or a covariance.")
    n = len(np.asarray(basis if covariance is None else covariance))
    if samples.ndim not in (1, 2) or samples.shape[-1] != n:
        raise DataError(f"x has shape {samples.shape}; samples of {n} coordinates are needed.")
    rows = samples.reshape(-1, n)  # a view
    if np.isinf(rows).any():
        k, i = (int(v[0]) for v in np.nonzero(np.isinf(rows)))
        raise DataError(f"coordinate {i + 1} is {rows[k, i]} at sample {k}: only NaN marks a missing entry.")
    missing = np.isnan(rows)
    for pattern in np.unique(missing[missing.any(axis=1)], axis=0):
        where = np.flatnonzero((missing == pattern).all(axis=1))
        weights = _from_present(pattern, basis, covariance, int(where[0]))
        rows[np.ix_(where, np.flatnonzero(pattern))] = rows[np.ix_(where, np.flatnonzero(~pattern))] @ weights
    return samples


def _from_present(pattern: NDArray[np.bool_], basis: ArrayLike | None, covariance: ArrayLike | None, sample: int
                  ) -> Array:
    """Weights (present, missing) for one pattern of missing entries."""
    present = ~pattern
    if covariance is not None:
        c = as_covariance(covariance)
        return np.linalg.pinv(c[np.ix_(present, present)], hermitian=True, rcond=1e-12) @ c[np.ix_(present, pattern)]
    w = orthonormal(basis, n=len(pattern))  # type: ignore[arg-type]
    values = np.linalg.svd(w[present], compute_uv=False)
    if present.sum() < w.shape[1] or values[-1] < 1e-6:
        raise RankError(f"sample {sample}: its {int(present.sum())} entries do not determine {w.shape[1]} coordinates; "
                        "leave it out, or give the covariance.")
    return np.linalg.pinv(w[present]).T @ w[pattern].T


def _descending(c: Array) -> tuple[Array, Array]:
    values, vectors = np.linalg.eigh((c + c.T) / 2)
    return values[::-1], vectors[:, ::-1]
