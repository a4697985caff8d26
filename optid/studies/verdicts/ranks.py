"""Ranks over data sets: does a difference carry over to other data sets?

J. Demšar: Statistical comparisons of classifiers over multiple data sets. Journal of Machine Learning Research 7
(2006) 1-30. The unit is the data set, never the seed: seeds of one data set say how sure its own result is, not whether
it holds elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln
from scipy.stats import f as fisher
from scipy.stats import rankdata, studentized_range

MINIMUM_DATA_SETS = 6  # with five, even a unanimous comparison of two has a two-sided probability of 1/16 > 0.05


@dataclass(frozen=True)
class Ranking:
    """Mean ranks of k solvers over N data sets, 1 the best, and which of them differ.

    Attributes:
        names: the solvers, best mean rank first.
        ranks: their mean ranks.
        n: data sets.
        probability: of ranks as different as these if all solvers were alike (Friedman with Iman and Davenport's
            correction; Wilcoxon's signed ranks for two); ``nan`` where it cannot be told.
        difference: mean ranks further apart than this differ (Nemenyi); ``nan`` where there is no such number.
        test: name of the test.
        missing: what is missing to tell; "" where it can be told.
        left_out: solvers that did not run on every data set.
        level: significance level.
    """

    names: tuple[str, ...]
    ranks: np.ndarray
    n: int
    probability: float
    difference: float
    test: str
    missing: str = ""
    left_out: tuple[str, ...] = ()
    level: float = 0.05

    @property
    def told(self) -> bool:
        """Whether the test could be made."""
        return not self.missing

    def differ(self, one: str, other: str) -> bool:
        """Whether two solvers differ significantly over the data sets."""
        if not self.told or not self.probability < self.level:
            return False
        if len(self.names) == 2:
            return True
        a, b = (self.ranks[self.names.index(name)] for name in (one, other))
        return bool(abs(a - b) > self.difference)


def ranks_of_problems(times: np.ndarray) -> np.ndarray:
    """Return the ranks within every problem, (P, S): 1 the fastest, equal times and all failures tied."""
    return rankdata(np.where(np.isfinite(times), times, np.inf), axis=1) if times.size else np.zeros(times.shape)


def scores_by_data_set(ranks: np.ndarray, data: np.ndarray) -> np.ndarray:
    """Return the mean rank of every solver on every data set, (N, S), data sets in order of first appearance.

    Args:
        ranks: (P, S).
        data: (P,) labels of the data sets.
    """
    return np.array([np.mean(ranks[data == label], axis=0) for label in dict.fromkeys(data)])


def friedman(scores: np.ndarray) -> tuple[float, float]:
    """Test whether k treatments differ over N blocks.

    Args:
        scores: (N, k), lower is better; ranked within every row, ties averaged.

    Returns:
        Friedman's statistic corrected for ties (Conover 1999, section 5.8), and the probability of it by Iman and
        Davenport's F (Demšar 2006, section 3.2.2).
    """
    ranks = rankdata(scores, axis=1)
    n, k = ranks.shape
    spread = float(np.sum(ranks**2) - n * k * (k + 1) ** 2 / 4)
    if spread <= 0:  # all tied everywhere
        return 0.0, 1.0
    statistic = (k - 1) * float(np.sum((ranks.sum(axis=0) - n * (k + 1) / 2) ** 2)) / spread
    rest = n * (k - 1) - statistic
    if rest <= 1e-12 * n * k:  # every data set gives the same order, one of k! over the factorials of its ties
        ties = np.unique(ranks[0], return_counts=True)[1]
        return statistic, float(np.exp((1 - n) * (gammaln(k + 1) - np.sum(gammaln(ties + 1)))))
    return statistic, float(fisher.sf((n - 1) * statistic / rest, k - 1, (k - 1) * (n - 1)))


def critical_difference(k: int, n: int, level: float = 0.05) -> float:
    """Return Nemenyi's critical difference of mean ranks, ``q sqrt(k (k + 1) / (6 n))`` (Demšar 2006, equation 4)."""
    return float(studentized_range.ppf(1 - level, k, np.inf)) / np.sqrt(2) * np.sqrt(k * (k + 1) / (6 * n))


def signed_ranks(differences: np.ndarray) -> float:
    """Return the exact two-sided probability of Wilcoxon's signed-rank statistic, ties included.

    Args:
        differences: (N,) paired; zeros are left out.

    Returns:
        The probability over all assignments of signs; 1 where no difference is left.
    """
    d = differences[differences != 0]
    if not d.size:
        return 1.0
    doubled = np.rint(2 * rankdata(np.abs(d))).astype(int)  # ties give halves
    ways = np.zeros(doubled.sum() + 1)
    ways[0] = 1.0
    for r in doubled:
        shifted = np.zeros_like(ways)
        shifted[r:] = ways[: ways.size - r]
        ways = (ways + shifted) / 2
    low = min(doubled[d > 0].sum(), doubled[d < 0].sum())
    return float(min(1.0, 2 * np.sum(ways[: low + 1])))


def rank_over_data_sets(scores: np.ndarray, names: tuple[str, ...], left_out: tuple[str, ...] = (),
                        level: float = 0.05, noun: str = "solver") -> Ranking:
    """Rank solvers over data sets and test the differences.

    Args:
        scores: (N, k) lower is better, one row per data set, no ``nan``.
        names: the k solvers.
        left_out: solvers that could not take part, for the record.
        level: significance level.
        noun: what is ranked.

    Returns:
        The ranking: Wilcoxon's signed ranks for two solvers, Friedman and Nemenyi for more. Fewer than
        `MINIMUM_DATA_SETS` data sets or two solvers give no test, and `missing` says so.
    """  # fmt: skip
    n, k = len(scores), len(names)
    means = np.mean(rankdata(scores, axis=1), axis=0) if n and k else np.full(k, np.nan)
    order = sorted(range(k), key=lambda s: (means[s], names[s]))
    named, sorted_means = tuple(names[s] for s in order), means[order]
    missing = []
    if k < 2:
        missing.append(f"at least 2 {noun}s that ran on every data set; there {'is' if k == 1 else 'are'} {k}")
    if n < MINIMUM_DATA_SETS:
        missing.append(f"at least {MINIMUM_DATA_SETS} data sets; there {'is' if n == 1 else 'are'} {n}")
    nan = float("nan")
    if missing:
        return Ranking(named, sorted_means, n, nan, nan, "none", "needs " + ", and ".join(missing), left_out, level)
    if k == 2:
        p = signed_ranks(scores[:, 0] - scores[:, 1])
        return Ranking(named, sorted_means, n, p, nan, "Wilcoxon signed ranks", "", left_out, level)
    p, apart = friedman(scores)[1], critical_difference(k, n, level)
    return Ranking(named, sorted_means, n, p, apart, "Friedman and Nemenyi", "", left_out, level)
