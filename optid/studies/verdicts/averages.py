"""Averages of times: shifted geometric means, and comparisons on the problems that two solvers both solved."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

SHIFT = 0.01  # s; times far below it count alike, so that a microsecond saved does not outweigh a second
MINIMUM_PAIRS = 6  # with five, even a unanimous comparison has a two-sided sign-test probability of 1/16 > 0.05


def shifted_geometric_mean(times: np.ndarray, shift: float = SHIFT) -> float:
    """Return ``exp(mean(log(t + shift))) - shift``; ``nan`` of nothing.

    Args:
        times: positive, in the unit of the shift; ``nan`` entries are left out.
        shift: the larger, the less small times weigh (H. Mittelmann's benchmarks; T. Achterberg, 2007, appendix A).
    """
    known = times[~np.isnan(times)]
    return float(np.exp(np.mean(np.log(known + shift))) - shift) if known.size else float("nan")


@dataclass(frozen=True)
class Paired:
    """One against another, problem by problem.

    Attributes:
        value: geometric mean of the ratios, or mean of the differences; ``nan`` without a common problem.
        low, high: its 95 % interval; infinite with fewer than two problems.
        n: problems that both solved, or groups of them.
    """

    value: float
    low: float
    high: float
    n: int

    @property
    def enough(self) -> bool:
        """Whether there are enough common problems to tell anything."""
        return self.n >= MINIMUM_PAIRS


def paired_difference(values: np.ndarray, reference: np.ndarray, groups: np.ndarray | None = None) -> Paired:
    """Return the mean of ``values - reference`` with its 95 % interval from Student's distribution.

    Args:
        values: (P,), ``nan`` where not solved; only problems that both solved count.
        reference: (P,), alike.
        groups: (P,) labels; where given, the mean of each group counts as one difference.
    """
    both = np.isfinite(values) & np.isfinite(reference)
    d = (values - reference)[both]
    if groups is not None:
        d = means_of_groups(d, groups[both])
    mean = float(np.mean(d)) if d.size else float("nan")
    if d.size < 2:
        return Paired(mean, float("-inf"), float("inf"), int(d.size))
    half = float(student.ppf(0.975, d.size - 1) * np.std(d, ddof=1) / np.sqrt(d.size))
    return Paired(mean, mean - half, mean + half, int(d.size))


def means_of_groups(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return the mean of every group, in order of first appearance.

    Args:
        values: (P,) finite.
        groups: (P,) labels.
    """
    return np.array([np.mean(values[groups == label]) for label in dict.fromkeys(groups)])


def paired_ratio(times: np.ndarray, reference: np.ndarray, groups: np.ndarray | None = None) -> Paired:
    """Return the geometric mean of ``times / reference`` with its 95 % interval.

    Args:
        times: (P,) positive, ``nan`` where not solved; only problems that both solved count.
        reference: (P,), alike.
        groups: (P,) labels; where given, the mean of each group counts as one ratio.
    """
    logs = paired_difference(np.log(times), np.log(reference), groups)
    value, low, high = (float(v) for v in np.exp([logs.value, logs.low, logs.high]))
    return Paired(value, low, high, logs.n)
