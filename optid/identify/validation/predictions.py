"""Predictions of a record by a model, and their errors.

The one-step-ahead prediction uses the outputs up to the sample before, the simulation uses none. For models with
nonlinear feedback the simulation with measured feedback takes the outputs in the feedback from the record.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array, as_list
from optid.data.record import Data
from optid.data.stretches import runs_of
from optid.errors import DataError
from optid.models.functions import has_feedback
from optid.registry import Rendered

ONE_STEP, MEASURED, SIMULATION = "one step", "measured feedback", "simulation"
HORIZONS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)
"""Samples ahead at which the fit is evaluated, as far as the record reaches."""
RESTARTS = 5  # samples per pole that a stretch between missing inputs must have


def predictors(model: Any) -> tuple[str, ...]:
    """Return the names of the predictors that differ for this model."""
    return (ONE_STEP, MEASURED, SIMULATION) if has_feedback(model) else (ONE_STEP, SIMULATION)


def one_step(model: Any, data: Data, horizon: int = 1) -> list[Array]:
    """Return the predictions (N, l) of every experiment, so many steps ahead; NaN where there is none.

    A horizon that is not a positive integer is a `StructureError`.
    """
    return as_list(model.predict(data, horizon))


def simulate_outputs(model: Any, data: Data, word: str = SIMULATION, x0: Any = "fit") -> list[Array]:
    """Return the outputs (N, l) of every experiment by "simulation" or "measured feedback", x0 as the model takes it.

    A missing input, or a simulation that leaves the range of the data, is a `DataError`.
    """
    return as_list((model.simulate_measured_feedback if word == MEASURED else model.simulate)(data, x0=x0))


def simulated_or_nan(model: Any, data: Data, word: str = SIMULATION) -> list[Array]:
    """Simulate the outputs from one missing input to the next; NaN there and where the simulation diverges."""
    found = []
    for i, e in enumerate(data.experiments):
        runs = runs_of(np.isfinite(e.u).all(axis=1)).tolist()
        y = np.full(e.y.shape, np.nan)
        for first, last in runs:
            if len(runs) > 1 and last - first < RESTARTS * max(len(model.poles), 1):  # the state would follow the noise
                continue
            with suppress(DataError):
                y[first:last] = simulate_outputs(model, data.select(experiments=i).window(first, last), word)[0]
        found.append(y)
    return found


def one_step_or_nan(model: Any, data: Data, horizon: int = 1) -> list[Array]:
    """Return what `one_step` does; NaN where nothing can be predicted or the prediction diverges."""
    try:
        return one_step(model, data, horizon)
    except DataError:
        return [np.full(e.y.shape, np.nan) for e in data.experiments]


@dataclass(frozen=True)
class Measures:
    """Errors of one output over the samples that are present and predicted.

    Attributes:
        fit: 100 (1 - |y - yhat| / |y - mean y|), in %; 100 is perfect, the mean scores 0.
        vaf: variance accounted for, 100 (1 - var(y - yhat) / var y), in %.
        rmse: root of the mean squared error, in output units.
        e_n: mean squared error (1/N) sum (y - yhat)^2.
        snr: sum y^2 / sum (y - yhat)^2, a ratio of energies.
        snr_amplitude: its root, a ratio of amplitudes.
        samples: number of samples N.
    """

    fit: float = np.nan
    vaf: float = np.nan
    rmse: float = np.nan
    e_n: float = np.nan
    snr: float = np.nan
    snr_amplitude: float = np.nan
    samples: int = 0

    @classmethod
    def of(cls, y: Array, predicted: Array) -> "Measures":
        """Compare y (N,) with predicted (N,); NaN in either leaves the sample out."""
        here = ~(np.isnan(y) | np.isnan(predicted))
        if not here.any():
            return cls()
        y, error = y[here], (y - predicted)[here]
        e_n = float(np.mean(error**2))
        snr = float(np.mean(y**2)) / e_n if e_n > 0 else float("inf")
        fit = vaf = float("nan")
        if np.ptp(y) > 0:
            fit = 100 * (1 - float(np.linalg.norm(error) / np.linalg.norm(y - y.mean())))
            vaf = 100 * (1 - float(np.var(error) / np.var(y)))
        return cls(fit, vaf, float(np.sqrt(e_n)), e_n, snr, float(np.sqrt(snr)), int(here.sum()))


def fit_percent(y: Array, predicted: Array) -> Array:
    """Return 100 (1 - |y - yhat| / |y - mean y|) of every output, (l,), over the samples (N, l) present in both."""
    return np.array([Measures.of(measured, found).fit for measured, found in zip(y.T, predicted.T)])


def common_fits(data: Data, several: Sequence[Sequence[Array]]) -> Array:
    """Return the fits in % of several predictions of a record, (k, l), over the samples that all of them predict.

    Each has one (N, l) per experiment. One that predicts nothing does not count for the others; its fit is NaN.
    """
    y = np.vstack([e.y for e in data.experiments])
    stacked = [np.vstack(list(arrays)) for arrays in several]
    lost = [np.isnan(predicted) for predicted in stacked if not np.isnan(predicted).all()]
    y = np.where(np.any(lost, axis=0), np.nan, y) if lost else y
    return np.array([fit_percent(y, predicted) for predicted in stacked])


def prediction_fit(model: Any, data: Data, word: str = ONE_STEP) -> Array:
    """Return the fit in % of one predictor on a record, (l,); NaN where there is no such simulation.

    The word is "one step", "measured feedback" or "simulation"; the last two need every sample of the inputs.
    """
    raw = data.raw()
    found = one_step_or_nan(model, raw) if word == ONE_STEP else simulated_or_nan(model, raw, word)
    return common_fits(raw, [found])[0]


@dataclass(frozen=True, eq=False, repr=False)
class HorizonCurve(Rendered):
    """Fits of the predictions by horizon; `print` it.

    Attributes:
        outputs: names of the outputs.
        horizons: (h,) samples ahead.
        fits: (h, l) in %, all over the same samples: those that the longest horizon predicts.
        simulation: (l,) fit of the simulation over these samples, the limit of the curve; NaN where there is none.
    """

    outputs: tuple[str, ...]
    horizons: tuple[int, ...]
    fits: Array
    simulation: Array


def fit_by_horizon(model: Any, data: Data, horizons: Sequence[int] | None = None) -> HorizonCurve:
    """Predict 1, 2, ... samples ahead and compare each with the record.

    Args:
        model: the model.
        data: the record.
        horizons: samples ahead; by default up to 100, a quarter of the longest experiment at most.

    Raises:
        DataError: other channels or another sampling time than the model's, or nothing that can be predicted.
        StructureError: a horizon that is not a positive integer.
    """
    raw = data.raw()
    longest = max(e.n_samples for e in raw.experiments)
    chosen = [h for h in HORIZONS if h <= max(1, longest // 4)] if horizons is None else list(horizons)
    ahead = [one_step(model, raw, h) for h in chosen]
    for h, arrays in zip(chosen, ahead):
        if np.isnan(np.vstack(arrays)).all():
            raise DataError(f"no sample can be predicted {h} samples ahead; use shorter horizons")
    fits = common_fits(raw, [*ahead, simulated_or_nan(model, raw)])
    return HorizonCurve(raw.outputs, tuple(chosen), fits[:-1], fits[-1])
