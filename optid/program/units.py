"""The units of the programmes: outputs about their level, in multiples of their spread.

A model is the same model in any units, but a solver's tolerances and the digits of a sum of squares are not. Every
formulation therefore uses a record whose outputs have mean zero and variance one, all outputs divided by the same
number, which preserves their relative weights; inputs that act linearly are treated likewise. Constraints are stated
in the units of the record: `outward` returns the named expressions in these.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from optid.data.channels import Transform


def own_units(data: Any, linear: Sequence[bool] = (), centred: bool = True) -> Transform:
    """Return the units in which outputs, and inputs that act linearly, have mean zero and variance one.

    Inputs that do not act linearly keep their units, which their bases take care of. The means of a model without a
    constant stay (not ``centred``). Of a stream the first chunk with samples decides; any fixed choice near the record
    serves.
    """
    experiments = getattr(data, "experiments", None)
    arrays = [(e.u, e.y) for e in experiments] if experiments else [data.first_chunk()]
    y_level, y_size = _moments([y for _, y in arrays], centred)
    chosen = np.array([*linear, *[False] * (data.m - len(linear))], dtype=bool)
    u_level, u_size = _moments([u for u, _ in arrays], centred) if chosen.any() else np.zeros((2, data.m))
    spread = float(np.sqrt(np.mean(y_size**2))) or 1.0
    return Transform(tuple(np.where(chosen, np.where(u_size > 0, u_size, 1.0), 1.0).tolist()),
                     tuple(np.where(chosen, u_level, 0.0).tolist()),
                     (spread,) * data.l, tuple(y_level.tolist()))


def _moments(arrays: Sequence[np.ndarray], centred: bool) -> tuple[np.ndarray, np.ndarray]:
    """Means (zero unless centred) of the channels of arrays (N, channels), and standard deviations about them."""
    count = sum(_sums(1.0 - np.isnan(array)) for array in arrays)
    level = np.zeros(arrays[0].shape[1])
    for _ in range(2 if centred else 0):  # a second pass removes the rounding of the first
        level = level + sum(_sums(array - level) for array in arrays) / np.maximum(count, 1)
    energy = sum(_sums((array - level) ** 2) for array in arrays)
    spread = np.sqrt(energy / np.maximum(count, 1))
    spread[spread <= 4 * np.finfo(float).eps * np.abs(level)] = 0.0  # a constant channel varies by rounding alone
    return level, spread


def _sums(array: np.ndarray) -> np.ndarray:
    """Sums of the columns without what is missing; a product is several times faster than a reduction of rows."""
    found = np.ones(len(array)) @ array
    return np.nansum(array, axis=0) if np.isnan(found).any() else found


def in_units(data: Any, units: Transform) -> Any:
    """Return a record in other units; its own way back to raw units is not carried along."""
    if not hasattr(data, "experiments"):
        return data.in_units(units)
    changed = Transform.identity(data.m, data.l)
    same_inputs = (units.u_scale, units.u_offset) == (changed.u_scale, changed.u_offset)
    return data.map_signals((lambda u: u) if same_inputs else units.apply_u, units.apply_y, transform=changed)


def inner_bases(bases: Sequence[Any], units: Transform) -> tuple[Any, ...]:
    """Return the bases of inputs in the units of the programme; those of inputs that keep theirs stay as they are."""
    return outer_bases(bases, inverse(units))


def outer_bases(bases: Sequence[Any], units: Transform) -> tuple[Any, ...]:
    """Return the bases of inputs in the units of the record."""
    return tuple(basis.in_units(scale, origin)[0] for basis, scale, origin in zip(bases, units.u_scale, units.u_offset))


def inverse(units: Transform) -> Transform:
    """Return the way from the units of the record to those of the programme."""
    scales, offsets = np.array(units.u_scale + units.y_scale), np.array(units.u_offset + units.y_offset)
    m = len(units.u_scale)
    gain, shift = (1 / scales).tolist(), (-offsets / scales).tolist()
    return Transform(tuple(gain[:m]), tuple(shift[:m]), tuple(gain[m:]), tuple(shift[m:]))


def energy_unit(units: Transform) -> float:
    """Return what one squared unit of the outputs is in squared units of the record."""
    return units.y_scale[0] ** 2


def outward(view: Any) -> dict[str, Any]:
    """Return the named expressions of an `optid.program.view.View` in the units of the record.

    The constant of a state-space model, which has A in its reference, is that of its output equation.
    """
    expressions, units, inputs = view.inner, view.units, view.channels
    r, found = units.y_scale[0], {}
    for name, expression in expressions.items():
        word, _, channel = name.partition("[")
        alone = word == "b" and "mu" + name[1:] not in expressions  # of an input that acts linearly
        factor = r if word in view.heights | view.courses or alone else 1.0
        if factor != 1.0 and word in ("mu", "Theta", "b", "static"):
            channel = channel.rstrip("]")
            factor /= units.u_scale[inputs.index(channel) if channel in inputs else 0]
        found[name] = expression if factor == 1.0 else factor * expression
        if word in view.courses:
            level = np.array(units.y_offset)
            found[name] = found[name] + (level[0] if expression.ndim == 1 else np.tile(level, (expression.shape[0], 1)))
    if "offset" in found:
        found["offset"] = found["offset"] + _level(found, units, inputs, "A" in view.reference)
    return found


def _level(found: Mapping[str, Any], units: Transform, inputs: Sequence[str], states: bool) -> Any:
    """What the levels of outputs and linear inputs add to the constants of the equations."""
    level: Any = np.array(units.y_offset)
    if states:
        return level
    a = found.get("a")
    if a is not None and np.any(level):
        if a.ndim == 1:
            level = level + level * cp.sum(a)
        else:  # (l, na l) = [A_1 .. A_na]
            level = level + a @ np.tile(level, a.shape[1] // len(level))
    for c, origin in enumerate(units.u_offset):
        if origin:
            key = "" if len(inputs) == 1 else f"[{inputs[c]}]"
            theta = found.get(f"Theta{key}", found.get(f"b{key}"))
            outs = len(units.y_offset)
            columns = theta if theta.ndim == 2 and theta.shape[0] != 1 else cp.reshape(
                theta, (theta.size // outs, outs), order="F")
            level = level - origin * cp.sum(columns, axis=0)
    return level
