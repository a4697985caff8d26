"""The second triangularisation of instrumental-variable subspace methods, from Hankel statistics alone.

With instruments Z, regressors Phi and outputs Y (rows of one block Hankel matrix) and [Z; Phi; Y] = L Q,

    [L21; L31] = [R11 0; R21 R22] Q',     range(Gamma) = range(R22).

Sources: Chou and Verhaegen 1997 (instrumental variables), Verhaegen and Dewilde 1992 (past inputs and outputs as
instruments: Z = [U_f; U_p; Y_p], Phi = U_f gives the singular values that SLICOT's IB01AD prints).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array, one_of
from optid.errors import RankError, StructureError
from optid.statistics.hankel import HankelStatistics, dependent_signal

FORMS = ("projection", "correlation")
TINY = 1e-12  # smallest singular value of the scaled R11, relative to the largest, that is not rounding


@dataclass(frozen=True, eq=False)
class RQ:
    """The blocks of the second RQ decomposition."""

    # (y, r) outputs projected on the instruments, with the regressors removed: Gamma times the projected states
    r22: Array
    residual: Array  # (y, y) triangular factor of the outputs' part outside the instruments and regressors
    # condition number of the projected regressors, their rows scaled to the norm of the regressors themselves: it grows
    # with the record where instruments and regressors are not correlated
    condition: float
    discarded: int  # directions of the regressors that a tolerance left out
    triangle: Array  # (z, z) triangular factor of the instruments
    projected: tuple[Array, Array]  # (p, z) regressors on the orthonormal instruments, and (y, z) outputs

    @cached_property
    def decomposition(self) -> tuple[Array, Array, Array]:
        """Left vectors, singular values and right vectors (as rows) of r22."""
        return np.linalg.svd(self.r22)


def rq(statistics: HankelStatistics, instruments: Sequence[int] | NDArray[np.intp],
       regressors: Sequence[int] | NDArray[np.intp], outputs: Sequence[int] | NDArray[np.intp], *,
       form: str = "projection", tolerance: float | None = None) -> RQ:
    """Triangularise twice.

    Args:
        statistics: moments of the windows.
        instruments: positions of Z (`HankelStatistics.at`; 0 is the constant), in any order.
        regressors: positions of Phi; those that are also instruments are projected on themselves.
        outputs: positions of Y.
        form: "projection" (weight (Z Z^T / j)^-1/2) or "correlation" (no weight).
        tolerance: None asks that R11 be regular; a number drops the directions of the scaled projected regressors whose
            singular value, relative to the largest, lies below it (pseudo-inverse).

    Raises:
        StructureError: an unknown form, or centred statistics without the constant among Z and Phi.
        RankError: fewer instruments than regressors, or regressors that the instruments do not reach.
    """
    z, phi, y = (np.asarray(part, dtype=np.intp) for part in (instruments, regressors, outputs))
    one_of("form", form, FORMS)
    if np.any(statistics.centre) and not (0 in z and 0 in phi):
        raise StructureError("These statistics are centred: the constant (position 0) must be among the instruments "
                             "and the regressors, or take them without a centre.")
    if z.size < phi.size:
        raise RankError(f"{z.size} instruments for {phi.size} regressors: use more block rows of instruments or fewer "
                        "basis functions.")
    column = np.full(len(statistics.gram), -1)
    column[z] = 0
    order = np.concatenate([z, phi[column[phi] < 0], y])  # of the regressors those that are not instruments themselves
    column[order] = np.arange(order.size)
    triangle, of_phi = statistics.triangle(order), column[phi]
    of_y = np.arange(order.size - y.size, order.size)
    l21, l31 = triangle[: z.size, of_phi].T, triangle[: z.size, of_y].T
    size = np.linalg.norm(triangle[:, of_phi], axis=0)  # of the regressors before the projection
    if not size.all():
        raise RankError(f"{statistics.name(int(phi[int(np.argmin(size))]))} is zero in every window: leave that basis "
                        "function or channel out.")
    if form == "correlation":
        weight = triangle[: z.size, : z.size] / statistics.windows
        l21, l31 = l21 @ weight, l31 @ weight
    residual = triangle[order.size - y.size :, of_y]
    scaled, discarded = l21 / size[:, None], 0
    if tolerance is None:
        factor = np.asarray(np.linalg.qr(np.concatenate([scaled, l31]).T, mode="r")).T
        condition = float(np.linalg.cond(factor[: phi.size, : phi.size]))
        if not condition < 1 / TINY:
            lost = dependent_signal(statistics, phi)
            reason = f"{lost} depends on the regressors before it" if lost else "the instruments do not reach them all"
            raise RankError(f"The regressors are singular on the instruments: {reason}. Use an input with more levels "
                            "and frequencies, fewer block rows or basis functions, or augmented instruments.")
        r22 = factor[phi.size :, phi.size :]
    else:
        _, values, right = np.linalg.svd(scaled, full_matrices=True)
        kept = int(np.sum(values > tolerance * values[0]))
        condition = float(values[0] / values[-1]) if values[-1] else np.inf
        r22, discarded = l31 @ right[kept:].T, phi.size - kept
    return RQ(r22, residual.T, condition, discarded, triangle[: z.size, : z.size], (l21, l31))
