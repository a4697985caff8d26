"""Changes of a model that leave its predictions alone: the scale between f and B, and the units of the channels."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.bases.expansions import Linear
from optid.data.channels import Transform
from optid.errors import StructureError, nearest
from optid.models.nonlinearity import Nonlinearity

if TYPE_CHECKING:
    from optid.models.hammerstein_arx import HammersteinARX

GAUGES = ("norm", "gain", "b0", "none")


def regauged(model: "HammersteinARX", gauge: str, signs: bool = True) -> "HammersteinARX":
    """Move the scale between f and B of every input; the documentation is at `HammersteinARX.regauge`.

    With ``signs=False`` the gauge "norm" leaves the signs of B as they are.
    """
    if gauge not in GAUGES:
        raise StructureError(f"Unknown gauge {gauge!r}. {nearest(gauge, GAUGES)}")
    if gauge == "gain" and model.l > 1:
        raise StructureError("gauge 'gain' is defined for one output; use 'norm' or 'b0'.")
    scales = [_scale(model, c, gauge) for c in range(model.m)]
    if gauge == "norm" and not signs:
        scales = [abs(scale) for scale in scales]
    return replace(
        model,
        b=tuple(b / s for b, s in zip(model.b, scales)),
        nonlinearities=tuple(replace(f, mu=s * f.mu) for f, s in zip(model.nonlinearities, scales)),
        gauge=gauge,
    )


def in_raw_units(model: "HammersteinARX", transform: Transform) -> "HammersteinARX":
    """Undo a change of units; the documentation is at `HammersteinARX.with_transform`."""
    if transform.is_identity:
        return model
    gain, shift = np.array(transform.y_scale), np.array(transform.y_offset)
    if len(transform.u_scale) != model.m or gain.size != model.l:
        raise StructureError(
            f"The transform has {len(transform.u_scale)} inputs and {gain.size} outputs, "
            f"the model {model.m} and {model.l}."
        )
    a = model.a if model.l == 1 else model.a * (gain[:, None] / gain)
    b = tuple(row * gain for row in model.b)
    offset = gain * model.offset + shift + a.reshape(model.na, model.l, model.l).sum(axis=0) @ shift
    nonlinearities = []
    for f, rows, scale, origin in zip(model.nonlinearities, b, transform.u_scale, transform.u_offset):
        basis, matrix, constant = f.basis.mapped(scale, origin)
        nonlinearities.append(Nonlinearity(basis, matrix @ f.mu))
        offset = offset + float(constant @ f.mu) * rows.sum(axis=0)
    raw = replace(model, a=a, b=b, nonlinearities=tuple(nonlinearities), offset=offset)
    # units do not turn signs: what a constraint decided about them stays
    return regauged(raw, model.gauge, signs=False)


def _scale(model: "HammersteinARX", c: int, gauge: str) -> float:
    """The factor that leaves b[c] and enters f."""
    b, f = model.b[c], model.nonlinearities[c]
    if gauge == "none":
        # a linear channel has no nonlinearity to scale: its coefficients belong to B
        return 1 / float(f.mu[0]) if isinstance(f.basis, Linear) and f.mu[0] != 0 else 1.0
    return gauge_factor(gauge, model.a, b, model.inputs[c])


def gauge_factor(gauge: str, a: Array, b: Array, channel: str) -> float:
    """Return the factor by which B must be divided, and f multiplied, to satisfy a gauge.

    Args:
        gauge: "norm", "gain" or "b0".
        a: coefficients of A.
        b: (nb,) or (nb, l) coefficients of B.
        channel: name of the input, for the message.

    Raises:
        StructureError: the quantity that the gauge sets to one is zero.
    """
    size = float(np.linalg.norm(b))
    if size == 0:
        raise StructureError(f"B of input {channel!r} is zero: it has no gauge but 'none'.")
    if gauge == "norm":
        return size * leading_sign(b)
    if gauge == "b0":
        scale, what = float(b.flat[0]), "first coefficient of B"
    else:
        scale, what = _unit_gain(a, b), "static gain of the linear part"
    if not 1e-9 * size < abs(scale) < 1e9 * size:
        raise StructureError(
            f"gauge {gauge!r} cannot be reached: the {what} of input {channel!r} is zero or infinite; use 'norm'."
        )
    return scale


def _unit_gain(a: Array, b: Array) -> float:
    denominator = 1 + float(a.sum())
    return float(b.sum()) / denominator if denominator else np.inf


def leading_sign(b: Array) -> float:
    """Sign of the first entry of B that is not negligible; 1 where all are zero."""
    entries = b.ravel(order="F")
    large = np.flatnonzero(np.abs(entries) > 1e-12 * np.abs(entries).max(initial=0.0))
    return float(np.sign(entries[large[0]])) if large.size else 1.0
