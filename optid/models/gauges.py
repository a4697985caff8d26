"""The scale between f and B."""

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError

GAUGES = ("norm", "gain", "b0", "none")


def gauge_factor(gauge: str, a: Array, b: Array, channel: str) -> float:
    """Return the factor by which B (nb,) or (nb, l) is divided, and f multiplied, for "norm", "gain" or "b0".

    A gauge that sets a quantity to one which is zero is refused (`StructureError`).
    """
    size = float(np.linalg.norm(b))
    if size == 0:
        raise StructureError(f"B of input {channel!r} is zero: it has no gauge but 'none'.")
    if gauge == "norm":
        return size * leading_sign(b)
    if gauge == "b0":
        scale, what = float(b.flat[0]), "first coefficient of B"
    else:
        denominator = 1 + float(a.sum())
        scale, what = float(b.sum()) / denominator if denominator else np.inf, "static gain of the linear part"
    if not 1e-9 * size < abs(scale) < 1e9 * size:
        raise StructureError(
            f"gauge {gauge!r} cannot be reached: the {what} of input {channel!r} is zero or infinite; use 'norm'.")
    return scale


def leading_sign(b: Array, negligible: float = 1e-12) -> float:
    """Sign of the first entry of B above a share of its largest; 1 where all are zero."""
    entries = b.ravel(order="F")
    large = np.flatnonzero(np.abs(entries) > negligible * np.abs(entries).max(initial=0.0))
    return float(np.sign(entries[large[0]])) if large.size else 1.0
