"""How far a subspace is from the dominant one: the dual of max tr(C P) over 0 <= P <= I, tr P = r.

The set is the convex hull of the projectors of rank r (Fan 1949; Overton and Womersley 1992), so that the maximum over
projectors has no gap: for every t, tr(C P) <= r t + sum max(c_i - t, 0), equal at any t between c_(r+1) and c_r.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_integer
from optid.errors import DataError, StructureError
from optid.identify.tracking.geometry import as_basis, as_covariance, orthonormal


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


def fantope_bound(eigenvalues: Array, r: int, t: float) -> float:
    """Return r t + sum max(c_i - t, 0), an upper bound on tr(C P) for every t."""
    return float(r * t + np.sum(np.maximum(eigenvalues - t, 0)))


def fantope_certificate(
    covariance: ArrayLike, basis: ArrayLike, t: float | None = None, lost: Sequence[int] = ()
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
    w = orthonormal(as_basis(basis, len(c)))
    gone = tuple(sorted({int(i) for i in lost}))
    if gone and not 0 <= gone[0] <= gone[-1] < len(c):
        raise StructureError(f"lost={list(lost)}: coordinates from 0 to {len(c) - 1} are needed.")
    kept = [i for i in range(len(c)) if i not in gone]
    check_integer(w.shape[1], "r", high=len(kept))
    if gone and float(np.abs(w[list(gone)]).max()) > 1e-8:
        raise DataError(f"the basis uses the lost coordinates {list(gone)}: restrict it to the surviving ones first.")
    r, values = w.shape[1], np.linalg.eigvalsh(c[np.ix_(kept, kept)])[::-1]
    if t is None:
        t = float(values[r - 1] + (values[r] if r < len(values) else values[r - 1])) / 2
    elif not np.isfinite(t):
        raise StructureError(f"t={t!r}: a finite number is needed.")
    energy = float(np.trace(w.T @ c @ w))
    bound = fantope_bound(np.asarray(values, dtype=float), r, t)
    return FantopeCertificate(energy, bound, float(t), float(np.trace(c)), gone)
