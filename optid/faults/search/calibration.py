"""Thresholds of the search for a fault for a given false-alarm probability of a healthy window."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_probability
from optid.errors import DataError, StructureError
from optid.faults.search.sweeps import sweep
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Whitened
from optid.models.experiments import samples_of

EXCEEDING = 50  # least number of simulated windows that exceed the thresholds
STRETCHES = 100  # number of sections drawn from a longer input


@dataclass(frozen=True, eq=False)
class Thresholds:
    """Thresholds of the energy that a candidate explains; `thresholds` makes them.

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

    def of(self, labels: tuple[str, ...], tested: np.ndarray | None = None) -> Array:
        """Return the thresholds (C,) of candidates.

        Args:
            labels: of the candidates.
            tested: (C,) which of them a search tests; none by default.

        Raises:
            StructureError: other candidates than these, no threshold for a tested one.
        """
        if labels != self.labels:
            raise StructureError(
                f"These thresholds are of other candidates ({', '.join(self.labels)}): calibrate them again."
            )
        used = np.zeros(len(labels), dtype=bool) if tested is None else tested
        missing = [label for label, value, here in zip(self.labels, self.q, used) if here and not value > 0]
        if missing:
            raise StructureError(
                f"There is no threshold for {', '.join(missing)}: calibrate with the inputs, thresholds(..., u=u).")
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
    q = family_thresholds(simulated(found, window, u=u, draws=draws, seed=seed), false_alarm)
    return Thresholds(found.labels, q, false_alarm, count, draws, seed)


def check_draws(false_alarm: float, draws: int) -> None:
    """Refuse a probability outside (0, 1), and too few simulated windows for it."""
    check_probability(false_alarm, "false_alarm")
    if false_alarm * draws < EXCEEDING:
        raise DataError(
            f"{draws} simulated windows are too few for a false alarm in {1 / false_alarm:.3g}: use at least "
            f"{int(np.ceil(EXCEEDING / false_alarm))} draws, or a higher probability."
        )


def family_thresholds(statistics: Array, false_alarm: float) -> Array:
    """Return the quantiles (C,) at one level such that a share `false_alarm` of the rows exceeds any of them.

    Args:
        statistics: (M, C) of healthy windows; NaN for a candidate that is not tested, whose threshold is NaN, too.
        false_alarm: that share.
    """
    q, tested = np.full(statistics.shape[1], np.nan), ~np.isnan(statistics).all(axis=0)
    values, count = np.nan_to_num(statistics[:, tested]), len(statistics)
    # a row's rank is how rare its rarest statistic is; the rows with the best ranks are the alarms
    above = count - np.argsort(np.argsort(values, axis=0, kind="stable"), axis=0, kind="stable")
    level = np.sort(above.min(axis=1))[max(int(np.floor(false_alarm * count)) - 1, 0)] / count
    q[tested] = np.quantile(values, 1 - level, axis=0)
    return q


def simulated(
    found: Dictionary, window: int | Whitened, *, u: ArrayLike | None = None, draws: int = 20_000, seed: int | None = 0
) -> Array:
    """Return the largest energies (M, C) of simulated healthy windows, NaN: not tested; arguments of `thresholds`."""
    count = len(window.r) if isinstance(window, Whitened) else int(window)
    rng, inputs = np.random.default_rng(seed), None if u is None else samples_of(u, "u", found.model.m)
    if inputs is None or len(inputs) == count:
        starts: np.ndarray = np.zeros(1, dtype=int)
    elif len(inputs) < count:
        raise DataError(f"u has {len(inputs)} samples; it must have at least those of the window, {count}.")
    else:
        starts = rng.integers(0, len(inputs) - count + 1, min(STRETCHES, draws))
    shares = np.diff(draws * np.arange(starts.size + 1) // starts.size)
    found_in: list[Array] = []
    for start, share in zip(starts, shares):
        prepared = sweep(found, window, None if inputs is None else inputs[start : start + count])
        found_in += [prepared.largest(windows) for windows in prepared.simulated(int(share), rng)]
    return np.vstack(found_in)
