"""Averages of times, comparisons of two on the problems that both solved, and performance profiles.

E. D. Dolan, J. J. Moré: Benchmarking optimization software with performance profiles. Mathematical Programming 91
(2002) 201-213. With more than two solvers a profile compares each with the fastest, not with each other (N. Gould,
J. Scott, ACM Transactions on Mathematical Software 43 (2016) 15).
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest
from scipy.stats import t as student

SHIFT = 0.01  # s; times far below it count alike, so that a microsecond saved does not outweigh a second
MINIMUM_PAIRS = 6  # with five, even a unanimous comparison has a two-sided sign-test probability of 1/16 > 0.05
MINOR = 0.1  # 10 % of a time or an error, 0.1 points of fit: without practical meaning
VAGUE = 10.0  # with `MINOR` of 10 %, the interval of a tie is within a factor of 2
LEVEL = 0.05  # of tests


def shifted_geometric_mean(times: np.ndarray, shift: float = SHIFT) -> float:
    """Return ``exp(mean(log(t + shift))) - shift`` of positive times, ``nan`` left out; ``nan`` without times.

    The larger the shift, the less small times weigh (H. Mittelmann's benchmarks; T. Achterberg, 2007, appendix A).
    """
    known = times[~np.isnan(times)]
    return float(np.exp(np.mean(np.log(known + shift))) - shift) if known.size else float("nan")


@dataclass(frozen=True)
class Paired:
    """A paired comparison, problem by problem: lower is better."""

    value: float  # geometric mean of the ratios, or mean of the differences; nan without a common problem
    low: float  # its 95 % interval; infinite with fewer than two problems
    high: float
    n: int  # problems that both solved, or groups of them
    ratio: bool = False  # whether these are ratios, whose equals are at 1, or differences, whose equals are at 0

    @property
    def texts(self) -> tuple[str, ...]:
        """Value and interval as texts."""
        return tuple(f"{v + 0.0:{'.3g' if self.ratio else '.2f'}}" for v in (self.value, self.low, self.high))

    @property
    def enough(self) -> bool:
        """Whether there are enough common problems for a conclusion."""
        return self.n >= MINIMUM_PAIRS

    @property
    def notable(self) -> bool:
        """Whether the estimate is worse by more than `MINOR`, significant or not."""
        return self.value > self.ratio + MINOR

    @property
    def behind(self) -> bool:
        """Whether it is significantly worse, and by more than `MINOR`."""
        return self.enough and self.low > self.ratio and self.notable

    @property
    def vague(self) -> bool:
        """Whether the interval contains differences `VAGUE` times `MINOR`: too wide for a tie."""
        slack = VAGUE * MINOR
        return self.low < (1 / (1 + slack) if self.ratio else -slack) or self.high > self.ratio + slack


def paired_mean(values: np.ndarray, reference: np.ndarray, ratio: bool = True,
                groups: np.ndarray | None = None) -> Paired:
    """Return the mean of ``values / reference`` or ``values - reference``, with its interval by Student's distribution.

    Args:
        values: (P,), positive for ratios, ``nan`` where not solved; only problems that both solved count.
        reference: (P,), alike.
        ratio: whether to take the geometric mean of ratios, else the mean of differences.
        groups: (P,) labels; if given, the mean of each group counts as one.
    """
    if ratio:
        logs = paired_mean(np.log(values), np.log(reference), False, groups)
        value, low, high = (float(v) for v in np.exp([logs.value, logs.low, logs.high]))
        return Paired(value, low, high, logs.n, True)
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
    """Return the mean over the rows of every group, in order of first appearance; (P, ...) values, (P,) labels."""
    return np.array([np.mean(values[groups == label], axis=0) for label in dict.fromkeys(groups)])


def sign_test(lost: int, won: int) -> float:
    """Return the exact one-sided probability of at least as many losses between two equals; 1 without any."""
    return float(binomtest(lost, lost + won, alternative="greater").pvalue) if lost + won else 1.0


def time_ratios(times: np.ndarray) -> np.ndarray:
    """Return every time relative to the fastest on its problem; (P, S), ``nan`` where not solved becomes ``inf``."""
    reached = np.where(np.isfinite(times), times, np.inf)
    fastest = np.min(reached, axis=1, initial=np.inf, keepdims=True)
    return np.where(np.isfinite(reached), reached / np.where(np.isfinite(fastest), fastest, 1.0), np.inf)


def performance_profiles(times: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return a profile per solver for times (P, S), ``nan`` where not solved: a right-continuous step function.

    It has the factors of the fastest time at which it steps, ascending from 1, and the shares of all P problems that
    are solved within them.
    """
    profiles = []
    for ratios in time_ratios(times).T:
        factors, counts = np.unique(ratios[np.isfinite(ratios)], return_counts=True)
        profiles.append((factors, np.cumsum(counts) / max(len(ratios), 1)))
    return profiles
