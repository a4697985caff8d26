"""Thresholds of the search for a fault for a given false-alarm probability of a healthy window."""

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataError
from optid.faults.false_alarms import Thresholds, check_draws, family_thresholds
from optid.faults.search.sweeps import sweep
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Whitened
from optid.models.experiments import samples_of

STRETCHES = 100  # number of sections drawn from a longer input


def thresholds(
    found: Dictionary, window: int | Whitened, false_alarm: float = 0.01, *, u: ArrayLike | None = None,
    draws: int = 20_000, seed: int | None = 0,
) -> Thresholds:
    """Calibrate the search on simulated healthy windows.

    The thresholds are quantiles of the largest energy over the onsets, at one level for all candidates, such that the
    family of all candidates and onsets has the given false-alarm probability.

    Args:
        found: the candidates.
        window: number of samples N; or a window, whose missing readings and uncertain model are simulated, too.
        false_alarm: probability that a healthy window exceeds any threshold.
        u: inputs for losses and stuck actuators: those of the window (N, m), or a longer typical record of them, of
            which sections are drawn. Without it these candidates are not tested.
        draws: simulated windows.
        seed: of the simulation.

    Raises:
        DataError: too few draws for so rare an alarm, an input that is too short or has a missing sample.
        StructureError: a probability outside (0, 1), a window that is too short, no candidate with a signature.
    """
    check_draws(false_alarm, draws)
    count = len(window.r) if isinstance(window, Whitened) else int(window)
    rng, inputs = np.random.default_rng(seed), None if u is None else samples_of(u, "u", found.model.m)
    if inputs is None or len(inputs) == count:
        starts: np.ndarray = np.zeros(1, dtype=int)
    elif len(inputs) < count:
        raise DataError(f"u has {len(inputs)} samples; it must have at least those of the window, {count}.")
    else:
        starts = rng.integers(0, len(inputs) - count + 1, min(STRETCHES, draws))
    shares = np.diff(draws * np.arange(starts.size + 1) // starts.size)
    largest: list[Array] = []
    for start, share in zip(starts, shares):
        prepared = sweep(found, window, None if inputs is None else inputs[start : start + count])
        largest += [prepared.largest(windows) for windows in prepared.simulated(int(share), rng)]
    return Thresholds(found.labels, family_thresholds(np.vstack(largest), false_alarm), false_alarm, count, draws, seed)
