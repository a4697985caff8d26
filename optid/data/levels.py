"""Levels of experiments: what sensors with another zero in every experiment add to its outputs."""

import warnings

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError


def remove_levels(data: Data) -> tuple[Data, Array]:
    """Return the record with the outputs of all experiments about one level, and what was subtracted (E, l).

    The shifts sum to zero, so that the mean of the constants of the experiments of a linear equation stays. An
    experiment without a single sample of an output is refused (`DataError`).
    """
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # an empty mean is refused here
        means = np.array([np.nanmean(e.y, axis=0) for e in data.experiments])
    if not np.isfinite(means).all():
        i, o = np.argwhere(~np.isfinite(means))[0]
        raise DataError(f"experiment {i + 1} has no sample of output {data.outputs[o]!r}, so that its level is "
                        "unknown: leave the experiment out (data.select(experiments=...)), or use offset=True")
    shifts = means - means.mean(axis=0)
    outputs = iter([e.y - shift for e, shift in zip(data.experiments, shifts)])
    return data.map_signals(lambda u: u, lambda _: next(outputs)), shifts
