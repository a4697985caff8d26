"""The scale between f and B, and its sign: f rises where the output of the plant rises."""

from typing import Literal

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError

GAUGES = ("norm", "gain", "b0", "none")
Gauge = Literal["norm", "gain", "b0"]  # those that fix the scale
NEGLIGIBLE = 1e-9  # share of the size of its terms below which a gain counts as zero


def gauge_factor(gauge: str, a: Array, b: Array, channel: str) -> float:
    """Return the factor by which B (nb,) or (nb, l) is divided, and f multiplied, for "norm", "gain" or "b0".

    A is (na,), or (na, l, l) of several outputs. A gauge that sets a quantity to one which is zero is refused
    (`StructureError`).
    """
    size = float(np.linalg.norm(b))
    if size == 0:
        raise StructureError(f"B of input {channel!r} is zero: it has no gauge but 'none'.")
    if gauge == "norm":
        return size * plant_sign(a, b)
    if gauge == "b0":
        scale, what = float(b.flat[0]), "first coefficient of B"
    else:
        denominator = 1 + float(a.sum())
        scale, what = float(b.sum()) / denominator if denominator else np.inf, "static gain of the linear part"
    if not 1e-9 * size < abs(scale) < 1e9 * size:
        raise StructureError(
            f"gauge {gauge!r} cannot be reached: the {what} of input {channel!r} is zero or infinite; use 'norm'.")
    return scale


def in_gauge(gauge: str, mu: Array, b: Array, a: Array, channel: str) -> tuple[Array, Array]:
    """Return mu (P,) and b (nb,) or (nb, l) of one input, the channel, scaled to satisfy a `Gauge`.

    The coefficients a of A are (na,) or (na, l, l). A quantity that is zero, and that the gauge sets to one, is a
    `StructureError`.
    """
    if gauge == "norm" and not np.any(b):  # an input without effect: any direction will do
        return np.zeros_like(mu), np.full(b.shape, 1 / np.sqrt(b.size))
    factor = gauge_factor(gauge, a, b, channel)
    return mu * factor, b / factor


def plant_sign(a: Array, b: Array) -> float:
    """Return 1 where the output of B/A rises with what drives it, -1 where it falls; A, B as in `gauge_factor`."""
    by_lag = b[:, None] if b.ndim == 1 else b
    matrix = np.eye(by_lag.shape[1]) + np.reshape(a, (-1, by_lag.shape[1], by_lag.shape[1])).sum(axis=0)
    return float(plant_signs(matrix, by_lag.sum(axis=0)[:, None], by_lag[:, :, None])[0])


def plant_signs(matrix: Array, drive: Array, response: Array, seen: Array | None = None, direct: Array | None = None
                ) -> Array:
    """Return 1 for each of r drives with which the output rises, -1 where it falls, 1 where it has no effect.

    The sign is that of ``seen adj(matrix) drive + det(matrix) direct``, for one output the numerator at z = 1, B(1). It
    is the sign of the static gain of a stable plant, and of the slope with which a plant that integrates answers a
    step; it does not turn as a pole passes one. Of several outputs that with the largest decides; where all are
    negligible the largest entry of the response does.

    Args:
        matrix: (n, n) of the equations at rest.
        drive: (n, r) what enters them.
        response: (T, l, r) coefficients of B, or the impulse response.
        seen: (l, n) what the outputs see of the solution; its identity where None.
        direct: (l, r) what reaches the outputs directly; zero where None.
    """
    left, values, right = np.linalg.svd(matrix)
    turned = np.linalg.det(left) * np.linalg.det(right)
    last = values[-1] if values.size else 1.0  # adjugate and determinant, both divided by the other singular values
    shares = np.divide(last, values, out=np.ones_like(values), where=values > 0)
    adjugate, determinant = turned * (right.T * shares) @ left.T, turned * last
    adjugate = adjugate if seen is None else seen @ adjugate
    through = np.zeros((len(adjugate), drive.shape[1])) if direct is None else determinant * direct
    gains, sizes = adjugate @ drive + through, np.abs(adjugate) @ np.abs(drive) + np.abs(through)
    gains[np.abs(gains) <= NEGLIGIBLE * sizes] = 0.0
    found = [gain if np.any(gain) else response[:, :, j].ravel() for j, gain in enumerate(gains.T)]
    return np.array([-1.0 if one.size and one[np.argmax(np.abs(one))] < 0 else 1.0 for one in found])
