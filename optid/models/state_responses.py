"""Gains and responses of a state-space model."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import StructureError

if TYPE_CHECKING:
    from optid.models.hammerstein_ss import HammersteinSS

NEWTON_STEPS = 100
RESTS = 1e-12
"""A state that moves by less than this share of its size rests."""


def markov(model: "HammersteinSS", columns: Array, n: int, direct: bool = True) -> Array:
    """Return D, C B, C A B, ... for the given columns (n_x, r) of B, (n, l, r); zeros for D where not ``direct``."""
    response = np.zeros((n, model.l, columns.shape[1]))
    if n and direct:
        response[0] = model.D
    with np.errstate(all="ignore"):
        x = columns
        for k in range(1, n):
            response[k] = model.C @ x
            x = model.A @ x
    return response


def frequency_response(model: "HammersteinSS", w: ArrayLike) -> Array:
    """Return C (zI - A)^-1 B + D, complex (len(w), l, r), see `HammersteinSS.frequency_response`."""
    z = np.exp(1j * np.atleast_1d(np.asarray(w, dtype=float)) * model.dt)
    resolvent = np.linalg.solve(z[:, None, None] * np.eye(model.nx) - model.A, model.B.astype(complex))
    return np.asarray(model.C @ resolvent + model.D)


def equilibrium(model: "HammersteinSS", u0: ArrayLike) -> tuple[Array, Array]:
    """Return state and outputs at rest, see `HammersteinSS.equilibrium`."""
    points = np.atleast_1d(np.asarray(u0, dtype=float))
    if points.shape != (model.m,):
        raise StructureError(f"u0 has shape {points.shape}; one operating point per input is needed, ({model.m},).")
    f = model.expanded(points[None])[0]
    x = np.zeros(model.nx)
    for _ in range(NEWTON_STEPS):
        rest, y = _unrest(model, f, x)
        size = np.abs(x).max(initial=0.0) + np.abs(model.B @ f + model.offset_x).max(initial=0.0)
        if np.abs(rest).max(initial=0.0) <= RESTS * size:
            return x, y
        x = x - np.linalg.lstsq(_slope(model, y), rest)[0]
        if not np.all(np.isfinite(x)):
            break
    if not model.feedback:
        _solved(_slope(model, np.zeros(model.l)), model.B)
    raise StructureError(
        f"No equilibrium was found at u0 = {points.tolist()}: the feedback does not let the model rest there."
    )


def _unrest(model: "HammersteinSS", f: Array, x: Array) -> tuple[Array, Array]:
    """Return what the next state differs by, (n,), and the outputs (l,)."""
    y = model.C @ x + model.D @ f + model.offset_y
    g = np.array([function(y[o]) for function, o in zip(model.feedback, model.output_of)])
    return model.A @ x + model.B @ f + model.E @ g + model.L @ y + model.offset_x - x, y


def static_gain(model: "HammersteinSS", u0: ArrayLike) -> Any:
    """Return the slope of the steady-state characteristic, see `HammersteinSS.static_gain`."""
    _, y = equilibrium(model, u0)
    points = np.atleast_1d(np.asarray(u0, dtype=float))
    slopes = np.zeros((len(model.nonlinearities), model.m))
    for j, (f, c) in enumerate(zip(model.nonlinearities, model.input_of)):
        slopes[j, c] = f.slope(points[c])
    driven = model.B + _feedback(model, y) @ model.D
    gain = (model.D - model.C @ _solved(_slope(model, y), driven)) @ slopes
    return float(gain[0, 0]) if gain.size == 1 else gain


def _feedback(model: "HammersteinSS", y: Array) -> Array:
    """What a change of y adds to the next state, (n, l)."""
    total = np.array(model.L)
    for j, (g, o) in enumerate(zip(model.feedback, model.output_of)):
        total[:, o] += model.E[:, j] * g.slope(y[o])
    return total


def _slope(model: "HammersteinSS", y: Array) -> Array:
    return model.A - np.eye(model.nx) + _feedback(model, y) @ model.C


def _solved(matrix: Array, right: Array) -> Array:
    if matrix.size and np.linalg.svd(matrix, compute_uv=False)[-1] <= 1e-12 * (1 + np.abs(matrix).max()):
        raise StructureError("The model has a pole at 1 (an integrator): it has no static gain.")
    return np.asarray(np.linalg.solve(matrix, right), dtype=float)
