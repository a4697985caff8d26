"""The scale between mu and b, which is not identifiable: how the formulations fix it."""

from typing import Literal

import numpy as np

from optid.models.gauges import gauge_factor

Gauge = Literal["norm", "gain", "b0"]  # those that fix the scale


def in_gauge(gauge: str, mu: np.ndarray, b: np.ndarray, a: np.ndarray, channel: str) -> tuple[np.ndarray, np.ndarray]:
    """Return mu (P,) and b (nb,) or (nb, l) of one input, the channel, scaled to satisfy a `Gauge`.

    The coefficients a of A are (na,) or (na, l, l). A quantity that is zero, and that the gauge sets to one, is a
    `StructureError`.
    """
    if gauge == "norm" and not np.any(b):  # an input without effect: any direction will do
        return np.zeros_like(mu), np.full(b.shape, 1 / np.sqrt(b.size))
    factor = gauge_factor(gauge, a, b, channel)
    return mu * factor, b / factor
