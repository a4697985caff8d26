"""Thresholds of the search for a fault, such that a healthy window alarms with the probability asked for."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_probability
from optid.errors import DataError, StructureError
from optid.faults.search.sweeps import Sweep, sweep
from optid.faults.signature_space import family_thresholds
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Whitened
from optid.models.experiments import samples_of

EXCEEDING = 50
"""Simulated windows that must exceed the thresholds for these to be trusted."""

BATCH = 2_000_000
"""Numbers of a batch of windows."""

COURSES = 100
"""Stretches of a longer input that are drawn."""


@dataclass(frozen=True, eq=False)
class Thresholds:
    """What the energy that a candidate explains must exceed; `thresholds` makes them.

    Attributes:
        labels: the C candidates.
        q: (C,) thresholds; NaN for a candidate that is not tested.
        false_alarm: probability that a healthy window exceeds any of them at any onset.
        window: samples of the window.
        draws: simulated healthy windows.
        seed: of the simulation.
    """

    labels: tuple[str, ...]
    q: Array
    false_alarm: float
    window: int
    draws: int
    seed: int | None

    def of(self, labels: tuple[str, ...]) -> Array:
        """Return the thresholds (C,) of candidates.

        Raises:
            StructureError: other candidates than these.
        """
        if labels != self.labels:
            raise StructureError(
                f"These thresholds are of other candidates ({', '.join(self.labels)}): calibrate them again."
            )
        return self.q

    def __str__(self) -> str:
        """Print the thresholds."""
        head = f"false alarm {self.false_alarm:g} in a window of {self.window} samples ({self.draws} simulated)"
        rows = [f"  {label[:60]:<62}{'not tested' if np.isnan(q) else format(q, '.2f'):>10}"
                for label, q in zip(self.labels, self.q)]
        return "\n".join([head, *rows])


def thresholds(
    found: Dictionary, window: int | Whitened, false_alarm: float = 0.01, *, u: ArrayLike | None = None,
    draws: int = 20_000, seed: int | None = 0,
) -> Thresholds:
    """Calibrate the search on simulated healthy windows.

    The thresholds are quantiles of the largest energy over the onsets, at one level for all candidates, such that the
    family of all candidates and onsets alarms with the probability asked for.

    Args:
        found: the candidates.
        window: number of samples N; or a window, whose missing readings and uncertain model are simulated, too.
        false_alarm: probability that a healthy window exceeds any threshold.
        u: inputs for losses and stuck actuators: those of the window (N, m), or a longer typical record of them, of
            which stretches are drawn. Without it these candidates are not tested.
        draws: simulated windows.
        seed: of the simulation.

    Raises:
        DataError: too few draws for so rare an alarm, an input that is too short or has a missing sample.
        StructureError: a probability outside (0, 1), a window that is too short, no candidate with a signature.
    """
    check_probability(false_alarm, "false_alarm")
    if false_alarm * draws < EXCEEDING:
        raise DataError(
            f"{draws} simulated windows cannot support a false alarm in {1 / false_alarm:.3g}: use at least "
            f"{int(np.ceil(EXCEEDING / false_alarm))} draws, or a higher probability."
        )
    count = len(window.r) if isinstance(window, Whitened) else int(window)
    largest = simulated(found, window, u=u, draws=draws, seed=seed)
    tested = ~np.isnan(largest).all(axis=0)
    q = np.full(len(found.candidates), np.nan)
    q[tested] = family_thresholds(np.nan_to_num(largest[:, tested]), false_alarm)
    return Thresholds(found.labels, q, false_alarm, count, draws, seed)


def simulated(
    found: Dictionary, window: int | Whitened, *, u: ArrayLike | None = None, draws: int = 20_000, seed: int | None = 0
) -> Array:
    """Return the largest energies (M, C) that candidates explain of simulated healthy windows; NaN: not tested.

    The arguments are those of `thresholds`.
    """
    count = len(window.r) if isinstance(window, Whitened) else int(window)
    rng = np.random.default_rng(seed)
    return np.vstack([
        prepared.largest(rng.standard_normal((size, count, found.model.l)))
        for prepared, share in _searches(found, window, count, u, draws, rng) for size in _batches(share, prepared)
    ])


def _searches(
    found: Dictionary, window: int | Whitened, count: int, u: ArrayLike | None, draws: int, rng: np.random.Generator
) -> Iterator[tuple[Sweep, int]]:
    """Yield prepared searches and how many windows each is calibrated on."""
    how = {} if isinstance(window, int) else {
        "steady": window.predictor, "present": window.present, "nuisance": window.nuisance,
        "states": window.states}
    inputs = None if u is None else samples_of(u, "u", found.model.m)
    if inputs is None or len(inputs) == count:
        yield sweep(found, count, u=inputs, **how), draws
        return
    if len(inputs) < count:
        raise DataError(f"u has {len(inputs)} samples; the window has {count}, as many are needed at least.")
    stretches = min(COURSES, draws)
    starts = rng.integers(0, len(inputs) - count + 1, stretches)
    for i, start in enumerate(starts):
        share = draws * (i + 1) // stretches - draws * i // stretches
        yield sweep(found, count, u=inputs[start : start + count], **how), share


def _batches(draws: int, prepared: Sweep) -> Iterator[int]:
    size = max(1, BATCH // (prepared.window * prepared.found.model.l))
    for start in range(0, draws, size):
        yield min(size, draws - start)
