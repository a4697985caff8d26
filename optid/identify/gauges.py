"""The scale between mu and b, which is not identifiable: how the formulations fix it."""

from typing import Any

import cvxpy as cp
import numpy as np

from optid.errors import StructureError
from optid.models.gauges import GAUGES, gauge_factor

FIXED = GAUGES[:-1]  # the gauges that fix the scale


def scale_fixed(gauge: str, b: cp.Variable, a: cp.Variable | None, reference: np.ndarray | None = None) -> Any:
    """Return the constraint on the coefficients of B: norm one, unit static gain, or a first coefficient of one.

    The gauge is one of `FIXED`, b (nb,) or (nb, l) of one input, a that of A, None without poles. The norm is fixed in
    the tangent of a reference (nb,), if given. "gain" with several outputs is a `StructureError`.
    """
    if gauge == "norm":
        return cp.sum_squares(b) == 1 if reference is None else reference @ b == float(reference @ reference)
    if gauge == "b0":
        return (b[0] if b.ndim == 1 else b[0, 0]) == 1
    if b.ndim > 1:
        raise StructureError("gauge 'gain' is defined for one output; use 'norm' or 'b0'")
    return cp.sum(b) == 1 + (cp.sum(a) if a is not None else 0)


def in_gauge(gauge: str, mu: np.ndarray, b: np.ndarray, a: np.ndarray | None, channel: str
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return mu (P,) and b (nb,) or (nb, l) of one input, the channel, scaled to satisfy a gauge of `FIXED`.

    The coefficients a of A are None without poles. A quantity that is zero, and that the gauge sets to one, is a
    `StructureError`.
    """
    if gauge == "norm" and not np.any(b):  # an input without effect: any direction will do
        return np.zeros_like(mu), np.full(b.shape, 1 / np.sqrt(b.size))
    factor = gauge_factor(gauge, np.zeros(0) if a is None else a, b, channel)
    return mu * factor, b / factor
