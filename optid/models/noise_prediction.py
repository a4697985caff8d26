"""Predictions of a transfer-function model over one record, and the initial state that belongs to them."""

from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.models import noise_filter, roots, simulation

if TYPE_CHECKING:
    from optid.models.hammerstein_tf import HammersteinTF


def predict_record(model: "HammersteinTF", u: Array, y: Array, horizon: int, x0: Any, label: str = "") -> Array:
    """Predict one record; the documentation is at `HammersteinTF.predict`.

    Args:
        model: the model.
        u: (N, m) inputs, NaN = missing.
        y: (N, 1) outputs, NaN = missing.
        horizon: how many samples ahead, from 1.
        x0: "fit", "zero" or the state of the plant; not used where the noise shares its poles.
        label: words that name the experiment in a message.

    Returns:
        (N, 1), NaN where there is no prediction.
    """
    if model.shares_poles:
        drive = simulation.driven(model.plant, u)[:, 0]
        found = noise_filter.innovations(y[:, 0], drive, model.c, model.d, start=model.memory)
        return noise_filter.predict(found, model.c, model.d, horizon)[:, None]
    gaps = ~np.isfinite(u).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], gaps, [True]]).astype(int)))
    prediction = np.full((len(y), 1), np.nan)
    for first, last in zip(edges[::2], edges[1::2]):
        present = int(np.isfinite(y[first:last]).sum())
        state = x0 if first == 0 else "fit"
        if gaps.any() and isinstance(state, str) and state == "fit" and present <= 2 * model.plant.memory:
            continue  # the estimated state would repeat the outputs
        prediction[first:last] = _apart(model, u[first:last], y[first:last], horizon, state, label)
    return prediction


def _apart(model: "HammersteinTF", u: Array, y: Array, horizon: int, x0: Any, label: str) -> Array:
    """Predict a stretch without missing inputs: the plant's output and, apart from it, the noise."""
    plant = model.plant
    if isinstance(x0, str):
        state = np.zeros((plant.memory, 1)) if x0 == "zero" else fitted_state(model, u, y, label)
    else:
        state = simulation.state_like(plant, x0)
    x = simulation.simulate_record(plant, u, state, label)
    found = noise_filter.innovations((y - x)[:, 0], None, model.c, model.d)
    return x + noise_filter.predict(found, model.c, model.d, horizon)[:, None]


def fitted_state(model: "HammersteinTF", u: Array, y: Array, label: str = "") -> Array:
    """Estimate the state (n, 1) of the plant at the first sample by least squares of the one-step prediction errors.

    Args:
        model: a model whose noise has poles of its own.
        u: (N, m) inputs, none missing.
        y: (N, 1) outputs, NaN = missing.
        label: words that name the experiment in a message.

    Raises:
        DataError: a missing input, or an output that leaves the range of numbers.
    """
    plant, n = model.plant, model.plant.memory
    if n == 0:
        return np.zeros((0, 1))
    count = min(len(y), simulation.horizon_of(max(roots.radius(plant.a), roots.radius(model.c)), n))
    rest = (y - simulation.simulate_record(plant, u, np.zeros((n, 1)), label))[:count, 0]
    present = np.isfinite(rest)
    free = simulation.impulse_of_inverse(plant, count)[:, 0, 0]
    columns = np.zeros((count, n))
    for i in range(min(n, count)):
        column = np.concatenate([np.zeros(i), free[: count - i]])
        columns[:, i] = noise_filter.innovations(np.where(present, column, np.nan), None, model.c, model.d).innovations
    target = noise_filter.innovations(rest, None, model.c, model.d).innovations
    sizes = np.linalg.norm(columns[present], axis=0)
    sizes[sizes == 0] = 1.0
    return (np.linalg.lstsq(columns[present] / sizes, target[present])[0] / sizes)[:, None]
