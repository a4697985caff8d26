"""Several models on one record, each predictor over the samples that all of them predict."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataWarning, StructureError
from optid.identify.validation.checks import Validation, validate
from optid.identify.validation.predictions import (
    MEASURED,
    ONE_STEP,
    SIMULATION,
    HorizonCurve,
    common_fits,
    fit_by_horizon,
)
from optid.registry import Rendered


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Rendered):
    """What `compare_models` found; `print` it, or write a page with `optid.show.report.write_comparison`.

    Attributes:
        names: one per model.
        data: the record, in raw units.
        horizon: samples ahead of the prediction besides one.
        fits: {predictor: (models, l) fits in %}, over the samples that all models predict; NaN where a model has no
            such prediction.
        validations: one per model, each over the samples it predicts itself.
        curves: fit against the horizon, one per model.
    """

    names: tuple[str, ...]
    models: tuple[Any, ...] = field(repr=False)
    data: Data = field(repr=False)
    horizon: int
    fits: dict[str, Array]
    validations: tuple[Validation, ...] = field(repr=False)
    curves: tuple[HorizonCurve, ...] = field(repr=False)

    @property
    def simulated(self) -> tuple[tuple[Array, ...], ...]:
        """Simulated outputs (N, l) per experiment, one tuple per model, empty where there is no simulation."""
        return tuple(checked.simulated for checked in self.validations)

    def best(self, predictor: str = SIMULATION) -> str:
        """Return the name of the model with the largest mean fit over the outputs, by a key of `fits`.

        A predictor that no model has is a `StructureError`.
        """
        means = np.nanmean(self.fits[predictor], axis=1) if predictor in self.fits else np.array([np.nan])
        if np.isnan(means).all():
            raise StructureError(f"no model has the prediction {predictor!r}; there are {', '.join(self.fits)}")
        return self.names[int(np.nanargmax(means))]


def compare_models(models: Mapping[str, Any] | Sequence[Any], data: Data, horizon: int = 1, x0: Any = "fit"
                   ) -> Comparison:
    """Compare several models on one record, preferably one that none of them was estimated from.

    Args:
        models: {name: model}, or models, which are then named by what they are.
        data: the record.
        horizon: samples ahead of one more prediction.
        x0: initial state of the simulations, as the models take it.

    Raises:
        StructureError: no model, or a horizon that is not a positive integer.
        DataError: the record has other channels or another sampling time than a model.
    """
    named = dict(models) if isinstance(models, Mapping) else _named(models)
    if not named:
        raise StructureError("there is no model to compare")
    raw = data.raw()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # they stand in the notes of the validations
        validations = tuple(validate(model, raw, x0=x0, horizon=horizon) for model in named.values())
        curves = tuple(fit_by_horizon(model, raw) for model in named.values())
    nothing = tuple(np.full(e.y.shape, np.nan) for e in raw.experiments)
    fits = {}
    for word in (ONE_STEP, f"{horizon} steps", MEASURED, SIMULATION):
        if any(word in checked.predicted for checked in validations):
            # a model without feedback simulates alike, measured or not
            other = SIMULATION if word == MEASURED else word
            found = common_fits(raw, [checked.predicted.get(word, checked.predicted.get(other, nothing))
                                      for checked in validations])
            fits |= {} if np.isnan(found).all() else {word: found}
    return Comparison(tuple(named), tuple(named.values()), raw, horizon, fits, validations, curves)


def _named(models: Sequence[Any]) -> dict[str, Any]:
    """Name models by their titles and orders, and number those that are still alike."""
    words = []
    for model in models:
        orders = ", ".join(f"{key} {' '.join(map(str, np.ravel(value)))}" for key, value in model.orders.items())
        words.append(f"{model.title} ({orders})" if orders else model.title)
    return {word if words.count(word) == 1 else f"{word} #{words[: i + 1].count(word)}": model
            for i, (word, model) in enumerate(zip(words, models))}
