"""What a model says about a record, by the three predictors: one step, measured feedback, simulation.

One step ahead uses the outputs up to the sample before; the simulation uses none. Between them stands, for models that
feed outputs back through static functions, the simulation that takes these outputs from the record (theory of
subspace identification with nonlinear feedback: P1, P2 and P3).
"""

from typing import Any

from optid.arrays import Array
from optid.data.record import Data
from optid.models.functions import has_feedback

ONE_STEP, MEASURED, SIMULATION = "one step", "measured feedback", "simulation"


def predictors(model: Any) -> tuple[str, ...]:
    """Return the words of the predictors that differ for this model."""
    return (ONE_STEP, MEASURED, SIMULATION) if has_feedback(model) else (ONE_STEP, SIMULATION)


def one_step(model: Any, data: Data, horizon: int = 1) -> list[Array]:
    """Return the predictions (N, l) of every experiment, so many steps ahead; NaN where there is none.

    Raises:
        StructureError: a horizon that is not a positive integer.
    """
    return _as_list(model.predict(data, horizon))


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
    return _as_list((model.simulate_measured_feedback if word == MEASURED else model.simulate)(data, x0=x0))


def _as_list(arrays: Any) -> list[Array]:
    """One array per experiment."""
    return list(arrays) if isinstance(arrays, list | tuple) else [arrays]
