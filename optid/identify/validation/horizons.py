"""The fit of a model against how far ahead it predicts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError
from optid.identify.validation.measures import common_fits
from optid.identify.validation.predictions import one_step, simulated
from optid.registry import render

HORIZONS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)
"""Samples ahead at which the fit is evaluated, as far as the record reaches."""


@dataclass(frozen=True, eq=False)
class HorizonCurve:
    """Fits of the predictions so many samples ahead; `print` it.

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

    def __str__(self) -> str:
        return render(self)


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
    try:
        free = simulated(model, raw)
    except DataError:
        free = [np.full(e.y.shape, np.nan) for e in raw.experiments]
    fits = common_fits(raw, [*ahead, free])
    return HorizonCurve(raw.outputs, tuple(chosen), fits[:-1], fits[-1])
