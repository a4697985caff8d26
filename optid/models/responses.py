"""Gains and responses of the linear part of a model."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import StructureError
from optid.models import simulation

if TYPE_CHECKING:
    from optid.models.hammerstein_arx import HammersteinARX


def static_gain(model: "HammersteinARX", u0: ArrayLike) -> Any:
    """Return A(1)^-1 sum_j b_j f'(u0), see `HammersteinARX.static_gain`."""
    points = np.atleast_1d(np.asarray(u0, dtype=float))
    if points.shape != (model.m,):
        raise StructureError(f"u0 has shape {points.shape}; one operating point per input is needed, ({model.m},).")
    at_one = np.eye(model.l) + simulation.matrices_of(model).sum(axis=0)
    smallest = np.linalg.svd(at_one, compute_uv=False)[-1]
    if smallest <= 1e-12 * (1 + np.abs(model.a).sum()):
        raise StructureError("The model has a pole at 1 (an integrator): it has no static gain.")
    slopes = np.array([f.slope(u) for f, u in zip(model.nonlinearities, points)])
    sums = np.stack([np.atleast_1d(b.sum(axis=0)) for b in model.b], axis=1)
    gain = np.linalg.solve(at_one, sums * slopes)
    return float(gain[0, 0]) if gain.size == 1 else gain


def impulse_response(model: "HammersteinARX", n: int) -> Array:
    """Return the response to a unit impulse of each f_c, (n, l, m)."""
    response = np.zeros((n, model.l, model.m))
    for c in range(model.m):
        right = np.zeros((n, model.l))
        for lag, row in simulation.lagged(model, c):
            if lag < n:
                right[lag] = row
        response[:, :, c] = simulation.filtered(model, right)
    return response


def frequency_response(model: "HammersteinARX", w: ArrayLike) -> Array:
    """Return A^-1 B_c at the frequencies w (radians per unit of time), complex (len(w), l, m)."""
    shift = np.exp(-1j * np.atleast_1d(np.asarray(w, dtype=float)) * model.dt)
    denominator = np.tile(np.eye(model.l, dtype=complex), (shift.size, 1, 1))
    for i, a in enumerate(simulation.matrices_of(model), start=1):
        denominator += a * (shift**i)[:, None, None]
    numerator = np.zeros((shift.size, model.l, model.m), dtype=complex)
    for c in range(model.m):
        for lag, row in simulation.lagged(model, c):
            numerator[:, :, c] += (shift**lag)[:, None] * row
    return np.asarray(np.linalg.solve(denominator, numerator))


LONGEST_STEP, SETTLED = 400, 0.02


def step_length(model: Any) -> int:
    """Return the number of samples after which the step response of the linear part has settled within 2 %.

    At least 20 and at most 400, and 50 for an unstable model, whose response does not settle.
    """
    radius = float(np.max(np.abs(model.poles), initial=0.0))
    if radius >= 1:
        return 50
    decay = 0 if radius == 0 else int(np.ceil(np.log(SETTLED) / np.log(radius)))
    return int(np.clip(1.5 * decay, 20, LONGEST_STEP))


def response_pairs(model: Any) -> list[tuple[str, str]]:
    """Return (input, output) of every column of a response of the linear part, in the order of its last two axes.

    Where an input has several static functions there is one column for each of them, by its word.
    """
    from optid.models.functions import static_functions

    columns = model.frequency_response(np.array([0.1 / model.dt])).shape[-1]
    words = [function.word for function in static_functions(model) if not function.fed_back]
    sources = model.inputs if columns == model.m else words
    return [(source, output) for output in model.outputs for source in sources]
