"""Over-parametrised estimates: over time, and their rank-one factors (Luo, Algorithm 3.1; Bai, Automatica 34, 1998)."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.layout import Layout


@dataclass(frozen=True, eq=False)
class Trace:
    """The estimate over time.

    Attributes:
        layout: the columns of phi.
        samples: (K,) number of samples seen at each record.
        theta: (K, n, l) estimates; NaN while the rows so far do not determine them.
        innovations: (N, l) of every sample of the block.
    """

    layout: Layout
    samples: Any
    theta: Array
    innovations: Array

    @property
    def a(self) -> Array:
        """Coefficients of A over time: (K, na), or (K, na, l, l) for several outputs."""
        return past_coefficients(self.theta, self.layout)

    def split(self, c: int = 0, beta: float = 1.0) -> tuple[Array, Array, Array]:
        """Split Theta of input c by the plain SVD in the gauge of Algorithm 3.1: mu = beta s_1 u_1, b = v_1 / beta.

        Args:
            c: index of the input.
            beta: the gauge, not zero; the first coefficient of b has its sign.

        Returns:
            mu (K, P), b (K, nb l) and s_2 / s_1 (K,), 0 where there is no second one.
        """
        if beta == 0:
            raise StructureError("beta=0: the gauge is a number other than zero.")
        known = np.asarray(np.isfinite(self.theta).all(axis=(1, 2)))
        basis, cols = self.layout.bases[c], self.layout.nb[c] * self.layout.l
        mu, b, ratio = (np.full((len(known), *s), np.nan) for s in ((basis.size,), (cols,), ()))
        left, size, right = np.linalg.svd(theta_matrices(self.theta[known], self.layout)[c], full_matrices=False)
        sign = np.where(right[:, 0, 0] < 0, -1.0, 1.0)
        mu[known] = beta * (sign * size[:, 0])[:, None] * left[:, :, 0]
        b[known] = sign[:, None] * right[:, 0] / beta
        second = size[:, 1] if size.shape[1] > 1 else np.zeros(len(size))
        ratio[known] = second / np.where(size[:, 0] > 0, size[:, 0], 1.0)
        return mu, b, ratio


def past_coefficients(theta: Array, layout: Layout) -> Array:
    """Return the coefficients of A, (..., na) or (..., na, l, l) for several outputs, from theta (..., n, l)."""
    na, l = layout.na, layout.l  # noqa: E741
    a = theta[..., : na * l, :].reshape(*theta.shape[:-2], na, l, l).swapaxes(-1, -2)
    return a[..., 0, 0] if l == 1 else a


def theta_matrices(theta: Array, layout: Layout) -> tuple[Array, ...]:
    """Return Theta_c (..., P_c, nb_c l) from the coefficients (..., n, l)."""
    found, (*several, _, l) = [], theta.shape  # noqa: E741
    for c, (b, basis) in enumerate(zip(layout.nb, layout.bases)):
        block = theta[..., layout.block(c), :].reshape(*several, b, basis.size, l)
        found.append(np.moveaxis(block, -3, -1).reshape(*several, basis.size, l * b))
    return tuple(found)
