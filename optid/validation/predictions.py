"""What a model says about a record, by the three predictors: one step, measured feedback, simulation.

One step ahead uses the outputs up to the sample before; the simulation uses none. Between them stands, for models that
feed outputs back through static functions, the simulation that takes these outputs from the record (theory of
subspace identification with nonlinear feedback: P1, P2 and P3).
"""

from typing import Any

import numpy as np

from optid.bases.basis import Array
from optid.data import Data
from optid.errors import DataError
from optid.models.functions import has_feedback

ONE_STEP, MEASURED, SIMULATION = "one step", "measured feedback", "simulation"

STATE_SPACE = "HammersteinSS"
"""The kind of model that predicts from a state, which every input changes."""


def predictors(model: Any) -> tuple[str, ...]:
    """Return the words of the predictors that differ for this model."""
    return (ONE_STEP, MEASURED, SIMULATION) if has_feedback(model) else (ONE_STEP, SIMULATION)


def one_step(model: Any, data: Data, horizon: int = 1) -> list[Array]:
    """Return the predictions (N, l) of every experiment, so many steps ahead.

    Where a model needs every input, the stretches between missing inputs are predicted each with an initial state of
    its own; NaN where that is not possible.
    """
    if model.kind != STATE_SPACE or not any(data.missing[name] for name in data.inputs):
        return listed(model.predict(data, horizon))
    cut, places = between_gaps(data, 2 * model.nx + 1)
    found = [np.full(e.y.shape, np.nan) for e in data.experiments]
    for (experiment, part), predicted in zip(places, listed(model.predict(cut, horizon))):
        found[experiment][part] = predicted
    return found


def between_gaps(data: Data, shortest: int) -> tuple[Data, list[tuple[int, slice]]]:
    """Cut a record where an input is missing.

    Args:
        data: the record.
        shortest: length of the shortest stretch that is kept.

    Returns:
        The stretches as experiments, without a way back to raw units, and for each the index of its experiment and
        its samples there.

    Raises:
        DataError: no stretch is long enough.
    """
    us, ys, places = [], [], []
    for i, e in enumerate(data.experiments):
        whole = ~np.isnan(e.u).any(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(np.int8)))
        for first, last in edges.reshape(-1, 2):
            # more outputs than states, or the initial state would repeat them
            if np.min(np.sum(~np.isnan(e.y[first:last]), axis=0)) >= shortest:
                us.append(e.u[first:last])
                ys.append(e.y[first:last])
                places.append((i, slice(first, last)))
    if not us:
        raise DataError(f"no stretch of {shortest} samples has every input: nothing can be predicted; interpolate them")
    names = (data.inputs, data.outputs, data.input_units, data.output_units)
    return Data(us, ys, data.dt, *names, data.name), places


def simulated(model: Any, data: Data, word: str = SIMULATION, x0: Any = "fit") -> list[Array]:
    """Return the simulated outputs (N, l) of every experiment.

    Args:
        model: the model.
        data: the record.
        word: "simulation", or "measured feedback".
        x0: initial state, as the model takes it.

    Raises:
        DataError: a missing input, or a simulation that leaves the range of the data.
    """
    return listed((model.simulate_measured_feedback if word == MEASURED else model.simulate)(data, x0=x0))


def listed(arrays: Any) -> list[Array]:
    """Return one array per experiment, as a list."""
    return list(arrays) if isinstance(arrays, list | tuple) else [arrays]
