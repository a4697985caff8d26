"""Thresholds by their false alarms: simulated, from a healthy record, or from both.

A block is a window, or a stretch of a stream as long as one; what counts is the largest energy that a candidate
explains in it. The thresholds of all candidates have one level, such that together they have the false alarms asked
for: in windows a share of them exceeds a threshold (`family_thresholds`), on a stream an alarm is a block that does
after one that did not (`equalised`), and the rate of alarms while there is none is

    1 / ARL0 = -log(1 - alarms / blocks without an alarm before) / length of a block.

A healthy record is rarely long enough for thresholds of its own: it raises those that are simulated by one factor.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.arrays import Array, check_probability
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.models import HammersteinSS
from optid.models.experiments import in_units_of

EXCEEDING = 50  # fewest simulated windows or alarms beyond thresholds; with fewer they are refused, or extrapolated
COMMON = 0.1  # share of blocks by whose energies a healthy record is compared with the simulation
CONFIDENCE = 0.95  # with which a healthy record shows more than the simulation
RECORDED = 20  # fewest blocks of a healthy record
# factors by which a healthy record may raise energies: above the first one with a warning, above the second not
RAISED, REFUSED = 3.0, 10.0


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
        """Return the thresholds (C,) of candidates with these labels.

        Raises:
            StructureError: other candidates than these, no threshold for one that a search has `tested` (C,).
        """
        if labels != self.labels:
            raise StructureError(
                f"These thresholds are of other candidates ({', '.join(self.labels)}): calibrate them again.")
        used = () if tested is None else np.flatnonzero(np.asarray(tested) & ~(self.q > 0))
        missing = [self.labels[c] for c in used]
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


@dataclass(frozen=True, eq=False)
class Calibration:
    """Thresholds and their basis.

    Attributes:
        labels: the candidates.
        q: (C,) their thresholds.
        arl0: requested mean number of samples between false alarms.
        window: samples of the window.
        samples: samples simulated.
        alarms: false alarms among them at these thresholds.
        seed: of the simulation.
        spreads: (C,) factors of the energies of the candidates, and of the variances of their sizes, because the
            parameters of the model are uncertain or the healthy record is noisier than the model.
        extrapolated: whether the simulation was too short for this ARL0 and the tail was extrapolated.
        common: largest energy over its threshold that a tenth of the simulated blocks reach; NaN without a simulation.
    """

    labels: tuple[str, ...]
    q: Array
    arl0: float
    window: int
    samples: int
    alarms: int
    seed: int | None
    spreads: Array
    extrapolated: bool = False
    common: float = float("nan")

    def __str__(self) -> str:
        """Return the thresholds and the simulation behind them."""
        tail = ", the tail extrapolated" if self.extrapolated else ""
        lines = [f"false alarm every {self.arl0:g} samples: {self.alarms} alarms in {self.samples} simulated{tail}"]
        if not self.samples:
            lines = ["thresholds as given"]
        return "\n".join(lines + [f"  {label:<40} {q:7.2f}" for label, q in zip(self.labels, self.q)])

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        return {**self.__dict__, "labels": list(self.labels), "q": [float(q) for q in self.q],
                "spreads": [float(spread) for spread in self.spreads]}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "Calibration":
        """Return the calibration of a description by `to_dict`."""
        arrays = {word: np.array(content[word], dtype=float) for word in ("q", "spreads")}
        return cls(**{**content, "labels": tuple(content["labels"]), **arrays})


def given_thresholds(known: Any, labels: tuple[str, ...], arl0: float, window: int) -> Calibration:
    """Return a `Calibration`, {label: threshold} or (C,) as the thresholds of a monitor of these labels.

    Raises:
        StructureError: thresholds of other candidates or of another window, or not one positive number for each.
    """
    if isinstance(known, Calibration):
        if known.labels != labels or known.window != window:
            raise StructureError(f"thresholds: they are those of {', '.join(known.labels)} in a window of "
                                 f"{known.window}; this monitor searches for {', '.join(labels)} in {window}.")
        return known
    if isinstance(known, Mapping):
        missing = [label for label in labels if label not in known]
        if missing:
            raise StructureError(f"thresholds: none for {', '.join(missing)}.")
        known = [known[label] for label in labels]
    q = np.array(known, dtype=float)
    if q.shape != (len(labels),) or not np.all(q > 0):
        raise StructureError(f"thresholds: give one positive number for each of {', '.join(labels)}.")
    return Calibration(labels, q, float(arl0), window, 0, 0, None, np.ones(len(q)))


def check_draws(false_alarm: float, draws: int) -> None:
    """Refuse a probability outside (0, 1), and too few simulated windows for it."""
    check_probability(false_alarm, "false_alarm")
    if false_alarm * draws < EXCEEDING:
        raise DataError(f"{draws} simulated windows are too few for a false alarm in {1 / false_alarm:.3g}: use at "
                        f"least {int(np.ceil(EXCEEDING / false_alarm))} draws, or a higher probability.")


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


def equalised(largest: Array, length: int, arl0: float) -> tuple[Array, int]:
    """Return thresholds (C,) of equal rates, together 1 / ARL0, and the number of alarms.

    The largest statistics (B, C) are those of blocks of `length` samples.
    """
    goal = -np.expm1(-length / arl0)
    level = goal / largest.shape[1]  # for independent candidates
    few = goal * len(largest) < 0.9 * EXCEEDING  # too few to count: this level is conservative
    for _ in range(30):
        q = np.array([tail(column, level) for column in largest.T])
        above = np.any(largest > q, axis=1)
        alarms, quiet = int(np.sum(above[1:] & ~above[:-1])), int(np.sum(~above[:-1]))
        share = alarms / max(quiet, 1)  # of the blocks that follow a block without an alarm
        if few or not alarms or abs(share / goal - 1) < 0.005:
            break
        level *= goal / share
    return q, alarms


def tail(column: Array, level: float) -> float:
    """Return the statistic that a share `level` of the blocks exceeds, from an exponential tail where they are few."""
    count, ordered = len(column), np.sort(column)
    exceed = level * count
    base = min(count // 10, max(500, int(4 * exceed)))
    if exceed >= 500 or base < 20:
        return float(np.quantile(ordered, 1 - level))
    start = ordered[count - base - 1]
    scale = float(np.mean(ordered[count - base :] - start))
    return float(start + scale * np.log(base / exceed))


def blocks_of(values: Array, length: int) -> Array:
    """Return values (N,) in blocks (N // length, length)."""
    return values[: len(values) // length * length].reshape(-1, length)


def check_rise(factor: float, what: str, levels: list[Array], usual: float, length: int) -> None:
    """Report a stretch of a healthy record that hides faults, which raises `what` by a factor.

    The levels are those of every block of `length` samples, for each experiment, and `usual` that of a usual one. Above
    `RAISED` it is a `DataWarning`, above `REFUSED` a `DataError`.
    """
    if factor <= RAISED:
        return
    number = int(np.argmax([one.max(initial=-np.inf) for one in levels]))
    high = levels[number] > RAISED * usual
    first = last = int(np.argmax(levels[number]))
    while first > 0 and high[first - 1]:
        first -= 1
    while last + 1 < len(high) and high[last + 1]:
        last += 1
    where = f"samples {first * length} to {(last + 1) * length - 1}" + (
        f" of experiment {number + 1}" if len(levels) > 1 else "")
    text = (f"The healthy record raises {what} {factor:.1f}-fold, most in {where}: smaller faults stay hidden. If the "
            "plant was starting up there, moved outside the range of the model, or was faulty, leave these samples out")
    if factor > REFUSED:
        raise DataError(f"{text}; else identify a model that describes them.")
    warnings.warn(text + ".", DataWarning, stacklevel=4)


def common_excess(largest: Array, common: float) -> float:
    """Return the factor by which healthy blocks exceed the simulated ones; one where that is not significant.

    It compares the energies, over their thresholds, that a tenth of the blocks (B,) and of the simulated ones reach.
    """
    from scipy.special import bdtrik

    if np.sum(largest > common) > bdtrik(CONFIDENCE, len(largest), COMMON):
        return max(float(np.quantile(largest, 1 - COMMON)) / common, 1.0)
    return 1.0


def raise_thresholds(base: Calibration, model: HammersteinSS, healthy: Data,
                     watched: Callable[[Array, Array], Array]) -> Calibration:
    """Return thresholds with no more alarms on a healthy record than are due: those of `base` times a factor.

    The factor is one, unless more than a tenth of the windows reach the energies that a tenth of the simulated ones
    reach, or there are more alarms than in 95 % of records of this length; then it is the ratio of these energies, or
    the one that leaves so many alarms. `watched` returns the statistics (N, C) of the monitor along inputs (N, m) and
    readings (N, l). A record of fewer than `RECORDED` windows is a `DataError`; others as of `check_rise`.
    """
    from scipy.special import pdtrik

    window, records = base.window, in_units_of(model, healthy).experiments
    levels = [blocks_of(np.max(watched(part.u, part.y) / base.q, axis=1), window).max(axis=1) for part in records]
    largest = np.concatenate(levels)
    if len(largest) < RECORDED:
        raise DataError(f"The healthy record has {len(largest)} stretches of {window} samples: {RECORDED} are needed "
                        "for thresholds.")
    samples = sum(len(part.y) for part in records)
    allowed = min(int(np.ceil(pdtrik(CONFIDENCE, samples / base.arl0))), len(largest) - 1)
    factor = max(common_excess(largest, base.common), float(np.sort(largest)[-1 - allowed]))
    check_rise(factor, "the thresholds", levels, 1.0, window)
    return replace(base, q=factor * base.q, spreads=factor * base.spreads, samples=base.samples + samples)
