"""Coefficients of a model: read-only, finite, and of shapes that agree."""

from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.gauges import GAUGES

if TYPE_CHECKING:
    from optid.models.hammerstein_arx import HammersteinARX


def coefficients(values: Any, name: str) -> Array:
    """Copy coefficients into a read-only float64 array, refusing values that are not finite."""
    array = np.array(values, dtype=float)
    if not np.all(np.isfinite(array)):
        raise StructureError(f"{name} contains a value that is not finite.")
    array.flags.writeable = False
    return array


def checked_horizon(horizon: Any) -> int:
    """Return a prediction horizon as an int.

    Raises:
        StructureError: not a whole number from 1.
    """
    if isinstance(horizon, bool) or not isinstance(horizon, int | np.integer) or horizon < 1:
        raise StructureError(f"horizon = {horizon!r}: a whole number of samples from 1.")
    return int(horizon)


def check_shapes(model: "HammersteinARX") -> None:
    """Refuse parts of a model that do not agree.

    Raises:
        StructureError: names the part and the shape that is needed.
    """
    l, m = model.offset.size, len(model.b)  # noqa: E741 - the field's letter
    if not m:
        raise StructureError("A model needs at least one input.")
    if model.offset.ndim != 1 or len(model.outputs) != l or len(model.output_units) != l:
        raise StructureError(
            f"offset has shape {model.offset.shape} for {len(model.outputs)} outputs: one each is needed."
        )
    for name in ("nonlinearities", "nk", "inputs", "input_units"):
        if len(getattr(model, name)) != m:
            raise StructureError(
                f"{name} has {len(getattr(model, name))} entries; b has one array for each of {m} inputs."
            )
    if model.a.ndim != (1 if l == 1 else 3) or model.a.shape[1:] not in ((), (l, l)):
        raise StructureError(f"a has shape {model.a.shape}; {'(na,)' if l == 1 else f'(na, {l}, {l})'} is needed.")
    for c, b in enumerate(model.b):
        if b.ndim != (1 if l == 1 else 2) or not b.size or b.shape[1:] not in ((), (l,)):
            raise StructureError(f"b[{c}] has shape {b.shape}; {'(nb,)' if l == 1 else f'(nb, {l})'} is needed.")
        if model.nk[c] < 0:
            raise StructureError(f"nk[{c}] = {model.nk[c]}: a delay is not negative.")
    if any(f.offset is not None for f in model.nonlinearities):
        raise StructureError("A nonlinearity of a model has offset None: put the constant of the equation in offset=.")
    if not (np.isfinite(model.dt) and model.dt > 0):
        raise StructureError(f"dt = {model.dt!r}: a positive number.")
    if model.gauge not in GAUGES:
        raise StructureError(f"Unknown gauge {model.gauge!r}: use one of {', '.join(GAUGES)}.")


def listed(model: "HammersteinARX") -> list[tuple[str, float]]:
    """Names and values of A, B and the offset, one line each; see `HammersteinARX.coefficients`."""
    several, found = model.l > 1, []
    for (i, *pair), value in np.ndenumerate(model.a):
        found.append((f"a{i + 1}" + (f"[{','.join(model.outputs[o] for o in pair)}]" if several else ""), float(value)))
    for channel, b in zip(model.inputs, model.b):
        for (j, *output), value in np.ndenumerate(b):
            words = ([channel] if model.m > 1 else []) + [model.outputs[o] for o in output]
            found.append((f"b{j}" + (f"[{','.join(words)}]" if words else ""), float(value)))
    return found + [
        ("offset" + (f"[{name}]" if several else ""), float(value)) for name, value in zip(model.outputs, model.offset)
    ]
