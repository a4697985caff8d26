"""The dictionary, the monitor and the streams that the benchmarks of the monitor share."""

import warnings
from dataclasses import replace

import numpy as np
from plants import levels, standard_plant

from optid.errors import DataWarning
from optid.faults import Dictionary, Fault, Monitor, dictionary, inject
from optid.models import HammersteinSS

ONSET = 300
"""Sample of the fault in a stream."""


def standard_dictionary(model: HammersteinSS, load: np.ndarray) -> Dictionary:
    """Return two stuck actuators, steps of two sensors and of the load, and a jump of the state."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        steps = dictionary(model, actuators=[], process={"load": load})
        stuck = dictionary(model, kinds="stuck", sensors=[], state_jump=False)
    candidates = (*stuck.candidates, *steps.candidates)
    sines = np.full((len(candidates), len(candidates)), np.nan)
    sines[len(stuck.candidates) :, len(stuck.candidates) :] = steps.sines
    return replace(steps, candidates=candidates, sines=sines)


def standard_monitor(arl0: float, window: int, **how: object) -> tuple[Monitor, HammersteinSS]:
    """Return a monitor of the standard plant, and the plant."""
    model, load = standard_plant()
    return Monitor(model, standard_dictionary(model, load), arl0=arl0, window=window, **how), model


def stream(model: HammersteinSS, count: int, seed: int, fault: Fault | None = None, still: slice | None = None,
           level: float | None = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and readings; in `still` the inputs keep a level, a random one if it is None."""
    rng = np.random.default_rng([seed, 77])
    u = levels(count, rng)
    if still is not None:
        u[still] = rng.uniform(-1.2, 1.2, 2) if level is None else level
    return u, inject(model, u, [] if fault is None else [fault], seed=int(rng.integers(2**31)))
