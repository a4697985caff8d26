"""Thresholds from healthy records, for plants whose innovations are not white.

Model errors (a wrong order, slow disturbances, weak nonlinearities) increase the energies that the candidates explain
of a healthy record beyond those of white noise. The thresholds are those simulated for white noise times one factor, as
small as the required false-alarm rate of the record allows. A separate threshold for each candidate would rest on
the largest energy of few independent windows, and with many candidates one of them is soon exceeded on the next record.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_integer
from optid.errors import DataError, DataWarning, StructureError
from optid.faults.search.calibration import EXCEEDING, Thresholds, simulated, thresholds
from optid.faults.search.sweeps import sweep
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Whitened
from optid.models.experiments import samples_of

LEAST = 1.0
"""Least expected number of disjoint windows of a record above the threshold."""

SURE = 5
"""Number of alarms below which the false-alarm rate of the next record may be twice that of this one."""

COMMON = 0.25
"""Largest alarm rate from which a rarer one is extrapolated."""


@dataclass(frozen=True, eq=False)
class SlidingScan:
    """The search along a record, window after window; `sliding_scan` makes it.

    Attributes:
        labels: the C candidates.
        window: samples of a window.
        samples: samples of the record.
        stops: (M,) sample after the last of every window.
        statistic: (M, C) largest energy over the onsets; NaN for a candidate that is not tested.
    """

    labels: tuple[str, ...]
    window: int
    samples: int
    stops: np.ndarray
    statistic: Array

    def excess(self, limits: Thresholds) -> Array:
        """Return the largest energy over its threshold, (M,); StructureError for thresholds of other windows."""
        if limits.window != self.window:
            raise StructureError(f"These thresholds are of windows of {limits.window} samples, not {self.window}.")
        return np.nanmax(self.statistic / limits.of(self.labels), axis=1)

    def alarms(self, limits: Thresholds) -> np.ndarray:
        """Return the windows with an alarm, (M,)."""
        return self.excess(limits) > 1

    def accused(self, limits: Thresholds) -> np.ndarray:
        """Return the index (M,) of the candidate with the largest energy less its threshold."""
        return np.nanargmax(self.statistic - limits.of(self.labels), axis=1)


def sliding_scan(
    found: Dictionary, whitened: Whitened, window: int, *, u: ArrayLike | None = None, hop: int = 1
) -> SlidingScan:
    """Search every window of a record.

    Args:
        found: the candidates.
        whitened: the record; one experiment.
        window: samples of a window.
        u: (N, m) inputs in raw units, for losses and stuck actuators, which are not tested without them.
        hop: samples from one window to the next.

    Raises:
        DataError: a record shorter than a window, inputs of another length.
        StructureError: a window that is too short, a hop below one, the innovations of an uncertain model.
    """
    if whitened.nuisance is not None:
        raise StructureError(
            "The uncertainty of the model has been taken out of the record as a whole: whiten it without uncertainty."
        )
    check_integer(hop, "hop")
    count = len(whitened.r)
    if count < window:
        raise DataError(f"The record has {count} samples: a window of {window} does not fit.")
    inputs = None if u is None else samples_of(u, "u", found.model.m)
    if inputs is not None and len(inputs) != count:
        raise DataError(f"u has {len(inputs)} samples; the record has {count}.")
    starts = np.arange(0, count - window + 1, hop)
    complete: np.ndarray = np.asarray(whitened.present.all(axis=1))
    moving = inputs is not None and any(c.columns for c in found.candidates)
    whole = [not moving and bool(complete[k : k + window].all()) for k in starts]
    statistic = np.empty((starts.size, len(found.candidates)))
    if any(whole):  # windows that one search serves
        views = np.lib.stride_tricks.sliding_window_view(whitened.r, window, axis=0).swapaxes(1, 2)
        first = _part(whitened, int(starts[whole.index(True)]), window)
        statistic[whole] = sweep(found, first).largest(views[starts[whole]])
    for i in np.flatnonzero(~np.array(whole)):
        own, k = _part(whitened, int(starts[i]), window), starts[i]
        statistic[i] = sweep(found, own, None if inputs is None else inputs[k : k + window]).largest(own.r[None])[0]
    return SlidingScan(found.labels, window, count, starts + window, statistic)


def _part(whitened: Whitened, start: int, window: int) -> Whitened:
    part = slice(start, start + window)
    r, innovations, present = (values[part] for values in (whitened.r, whitened.innovations, whitened.present))
    return replace(whitened, r=r, innovations=innovations, present=present, states=None)


@dataclass(frozen=True, eq=False)
class EmpiricalThresholds(Thresholds):
    """Thresholds from a healthy record; `empirical_thresholds` makes them.

    Attributes:
        factor: by which those of white innovations were multiplied.
        share: share of the windows of the healthy record that exceed them.
        excursions: number of alarms, those within one window counted once.
        windows: number of windows.
        independent: number of disjoint windows.
        extrapolated: whether the factor is that of a more frequent alarm, because the record is too short.
    """

    factor: float = 1.0
    share: float = 0.0
    excursions: int = 0
    windows: int = 0
    independent: float = 0.0
    extrapolated: bool = False

    def __str__(self) -> str:
        """Print the thresholds and the healthy record behind them."""
        tail = ", factor of more frequent alarms" if self.extrapolated else ""
        return (
            f"healthy record of {self.independent:.0f} windows: {self.factor:.3g} times those of white innovations"
            f"{tail}\n{self.share:.2%} of its windows alarm, in {self.excursions} excursions\n" + super().__str__()
        )


def empirical_thresholds(
    found: Dictionary, healthy: Whitened | Sequence[Whitened], window: int, false_alarm: float = 0.01, *,
    u: Any = None, hop: int = 1, draws: int = 20_000, seed: int | None = 0,
    extrapolate: bool = False,
) -> EmpiricalThresholds:
    """Calibrate the search on a healthy record, where its innovations are not white or not of the size predicted.

    Args:
        found: the candidates.
        healthy: whitened innovations of a record without faults, better not the one the model was identified from;
            one or several experiments.
        window: samples of a window.
        false_alarm: share of the healthy windows that exceed any threshold.
        u: (N, m) its inputs, a sequence of them where `healthy` is one, for losses and stuck actuators.
        hop: samples from one window to the next.
        draws: simulated windows behind the thresholds of white innovations.
        seed: of the simulation.
        extrapolate: whether a short record may give the factor of a more frequent alarm; its own where that is larger.

    Returns:
        Thresholds for `diagnose`, `Scan.gains` and `SlidingScan`.

    Raises:
        DataError: a record too short for so rare an alarm.
        StructureError: as `thresholds` and `sliding_scan`.

    Warns:
        DataWarning: few excursions of the record behind the factor.
    """
    parts = [healthy] if isinstance(healthy, Whitened) else list(healthy)
    inputs = [u] * len(parts) if u is None or isinstance(healthy, Whitened) else list(u)
    if len(inputs) != len(parts):
        raise DataError(f"u is of {len(inputs)} experiments, the record of {len(parts)}.")
    independent = sum(len(part.r) for part in parts) / window
    rare = false_alarm * independent < LEAST
    if rare and not extrapolate:
        raise DataError(
            f"{independent:.0f} windows of a healthy record are too few for a false alarm in {1 / false_alarm:.3g}: "
            f"{int(np.ceil(LEAST / false_alarm * window))} samples are required. Take a longer record, shorter windows "
            "or a higher probability, or let the factor be that of a more frequent alarm (extrapolate=True)."
        )
    longest = None if u is None else max((np.asarray(one) for one in inputs), key=len)
    draws = max(draws, int(np.ceil(EXCEEDING / false_alarm)))
    white = thresholds(found, window, false_alarm, u=longest, draws=draws, seed=seed)
    scans = [sliding_scan(found, part, window, u=one, hop=hop) for part, one in zip(parts, inputs)]
    ratios = np.concatenate([one.excess(white) for one in scans])
    factor = float(np.quantile(ratios, 1 - false_alarm, method="higher"))
    if rare:  # the factor of a more frequent alarm, its own where that is larger
        level = min(SURE / independent, COMMON)
        usual = np.nanmax(simulated(found, window, u=longest, draws=draws, seed=seed) / white.q, axis=1)
        factor = max(factor, float(np.quantile(ratios, 1 - level) / np.quantile(usual, 1 - level)))
    above = [one.excess(white) > factor for one in scans]
    # an alarm that begins within a window of the one before is the same
    excursions = sum(int(np.sum(np.diff(one.stops[alarms], prepend=-window) > window))
                     for one, alarms in zip(scans, above))
    if not rare and excursions < SURE:
        warnings.warn(
            f"The thresholds rest on {excursions} excursions of the healthy record: its rate of false alarms is kept, "
            "that of the next record may be twice as large or more. Use a longer healthy record.",
            DataWarning, stacklevel=2,
        )
    return EmpiricalThresholds(
        white.labels, factor * white.q, false_alarm, window, white.draws, seed, factor=factor,
        share=float(np.mean(np.concatenate(above))), excursions=excursions, windows=ratios.size,
        independent=independent, extrapolated=rare,
    )
