"""The scale between mu and b, which no prediction shows: how the formulations fix it."""

from typing import Any

import cvxpy as cp
import numpy as np

from optid.errors import StructureError

GAUGES = ("norm", "gain", "b0")


def check_gauge(gauge: str) -> None:
    """Refuse an unknown word (`StructureError`)."""
    if gauge not in GAUGES:
        raise StructureError(f"gauge must be one of {', '.join(GAUGES)}; got {gauge!r}")


def scale_fixed(gauge: str, b: cp.Variable, a: cp.Variable | None, reference: np.ndarray | None = None) -> Any:
    """Return the constraint on the coefficients of B: norm one, unit static gain, or a first coefficient of one.

    Args:
        gauge: one of `GAUGES`.
        b: coefficients of B of one input, (nb,) or (nb, l).
        a: coefficients of A, None without poles.
        reference: (nb,) iterate in whose tangent the norm is fixed; None for the norm itself.

    Raises:
        StructureError: "gain" with several outputs.
    """
    if gauge == "norm":
        return cp.sum_squares(b) == 1 if reference is None else reference @ b == float(reference @ reference)
    if gauge == "b0":
        return (b[0] if b.ndim == 1 else b[0, 0]) == 1
    if b.ndim > 1:
        raise StructureError("gauge 'gain' is defined for one output; use 'norm' or 'b0'")
    return cp.sum(b) == 1 + (cp.sum(a) if a is not None else 0)
