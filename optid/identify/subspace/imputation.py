"""Missing outputs estimated by a model, for projections whose windows must be complete.

A first model, of linearly interpolated outputs, predicts the missing outputs one step ahead; the next model is that of
the record so completed, and so on until the estimates converge (the expectation step of Dempster, Laird and Rubin 1977
with the steady predictor). The true model is a fixed point: the innovations are zero where outputs are missing.
"""

from collections.abc import Callable, Sequence

import numpy as np

from optid.arrays import Array, as_list
from optid.data.record import Data
from optid.data.stretches import interpolate_missing
from optid.errors import DataError, RankError
from optid.models.hammerstein_ss import HammersteinSS

ROUNDS = 12  # models at most
# change of the estimates (root mean square, in standard deviations of their outputs) below which no model follows
SETTLED = 1e-3
BEYOND = 0.2  # estimated outputs are clipped to the range of the record, wider by this share of it on either side


def clipping_range(outputs: Array) -> tuple[Array, Array]:
    """Return the limits (l,) of simulated outputs: those of the outputs (N, l) on record, and `BEYOND`."""
    low, high = np.nanmin(outputs, axis=0), np.nanmax(outputs, axis=0)
    return low - BEYOND * (high - low), high + BEYOND * (high - low)


def _predicted(model: HammersteinSS, data: Data, filled: Sequence[Array]) -> list[Array]:
    """Return the predictions (N, l); those from the present estimates where a feedback of predictions diverges."""
    completed = Data([e.u for e in data.experiments], list(filled), data.dt, list(data.inputs), list(data.outputs))
    for record in (data, completed):
        try:
            return as_list(model.predict(record))
        except DataError as error:
            reason = error
    raise RankError(f"the missing outputs cannot be predicted by a preliminary model: {reason}")


def impute(data: Data, estimate: Callable[[list[Array]], HammersteinSS]) -> tuple[list[Array], str]:
    """Estimate the missing outputs of a record.

    Args:
        data: the record.
        estimate: returns the model, with its gain K, of records (N, m + l) whose outputs are complete.

    Returns:
        Arrays [u | y], (N, m + l), one per experiment, NaN where no prediction exists; and a description.

    Raises:
        RankError: an output with fewer than two samples present, or as `estimate`.
    """
    data = data.without_transform()
    outputs = [e.y for e in data.experiments]
    lost = [np.isnan(y) for y in outputs]
    stacked = np.vstack(outputs)
    if np.any(np.sum(~np.isnan(stacked), axis=0) < 2):
        raise RankError("an output has fewer than two samples: leave it out")
    spread, (low, high) = np.nanstd(stacked, axis=0), clipping_range(stacked)
    filled, count, change, rounds = [interpolate_missing(y) for y in outputs], int(np.sum(np.isnan(stacked))), np.inf, 0
    while rounds < ROUNDS and change > SETTLED:
        rounds += 1
        model = estimate([np.hstack([e.u, y]) for e, y in zip(data.experiments, filled)])
        predicted = [np.clip(p, low, high) for p in _predicted(model, data, filled)]
        new = [np.where(gone, p, y) for gone, p, y in zip(lost, predicted, outputs)]
        moved = np.vstack([a - b for a, b in zip(new, filled)]) / spread
        change = float(np.sqrt(np.nansum(moved**2) / count))
        filled = new
    return ([np.hstack([e.u, y]) for e, y in zip(data.experiments, filled)],
            f"{count} of {stacked.size} estimated for the projections by {rounds} preliminary models, the first from "
            f"interpolated outputs (last change {change:.1e} standard deviations)")
