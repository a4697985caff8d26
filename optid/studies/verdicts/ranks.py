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

from optid.studies.verdicts.averages import means_of_groups
from optid.studies.verdicts.statement import there_are

MINIMUM_DATA_SETS = 6  # with five, even a unanimous comparison of two has a two-sided probability of 1/16 > 0.05


@dataclass(frozen=True)
class Ranking:
    """Mean ranks of k solvers over data sets, 1 the best, and which of them differ."""

    names: tuple[str, ...]  # the solvers, best mean rank first
    ranks: np.ndarray  # their mean ranks
    n: int  # data sets
    level: float = 0.05  # significance level
    left_out: tuple[str, ...] = ()  # solvers that did not run on every data set
    missing: str = ""  # what is missing to tell
    test: str = "none"
    probability: float = float("nan")  # of ranks as different as these if all were alike; nan where it cannot be told
    difference: float = float("nan")  # mean ranks further apart differ (Nemenyi); nan where there is no such number

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


def rank(costs: np.ndarray, tried: np.ndarray, names: tuple[str, ...], data: np.ndarray, noun: str = "solver"
         ) -> Ranking:
    """Rank those that were tried on every data set; a failure on a problem ranks last there, failures tied.

    Costs (lower is better, ``nan`` where not solved) and where somebody was tried are (P, k), the labels of the data
    sets (P,).
    """
    everywhere = [bool(len(data)) and all(column[data == label].any() for label in dict.fromkeys(data))
                  for column in tried.T]
    kept, out = (tuple(name for name, there in zip(names, everywhere) if there == keep) for keep in (True, False))
    scores = means_of_groups(ranks_of_problems(costs[:, everywhere]), data)
    return rank_over_data_sets(scores, kept, out, noun)


def ranks_of_problems(costs: np.ndarray) -> np.ndarray:
    """Return the ranks within every problem, (P, S): 1 the best, equal costs and all failures (``nan``) tied."""
    return rankdata(np.where(np.isfinite(costs), costs, np.inf), axis=1) if costs.size else np.zeros(costs.shape)


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
    """Return the exact two-sided probability of Wilcoxon's signed-rank statistic over all signs, ties included.

    Args:
        differences: (N,) paired; zeros are left out, and the probability is 1 where none is left.
    """
    d = differences[differences != 0]
    if not d.size:
        return 1.0
    doubled = np.rint(2 * rankdata(np.abs(d))).astype(int)  # ties give halves
    chances = np.ones(1)
    for r in doubled:
        chances = (np.pad(chances, (0, r)) + np.pad(chances, (r, 0))) / 2
    low = min(doubled[d > 0].sum(), doubled[d < 0].sum())
    return float(min(1.0, 2 * np.sum(chances[: low + 1])))


def rank_over_data_sets(scores: np.ndarray, names: tuple[str, ...], left_out: tuple[str, ...] = (),
                        noun: str = "solver", level: float = 0.05) -> Ranking:
    """Rank over data sets and test the differences: Wilcoxon's signed ranks for two, Friedman and Nemenyi for more.

    Args:
        scores: (N, k) lower is better, one row per data set, no ``nan``; fewer than `MINIMUM_DATA_SETS` rows or two
            columns give no test, and `Ranking.missing` says so.
        names: the k names.
        left_out: who could not take part, for the record.
        noun: what is ranked.
        level: significance level.
    """
    n, k = len(scores), len(names)
    means = np.mean(rankdata(scores, axis=1), axis=0) if n and k else np.full(k, np.nan)
    order = sorted(range(k), key=lambda s: (means[s], names[s]))
    named, sorted_means = tuple(names[s] for s in order), means[order]
    missing = []
    if k < 2:
        missing.append(f"at least 2 {noun}s that ran on every data set; {there_are(k)}")
    if n < MINIMUM_DATA_SETS:
        missing.append(f"at least {MINIMUM_DATA_SETS} data sets; {there_are(n)}")
    if missing:
        return Ranking(named, sorted_means, n, level, left_out, "needs " + ", and ".join(missing))
    if k == 2:
        p = signed_ranks(scores[:, 0] - scores[:, 1])
        return Ranking(named, sorted_means, n, level, left_out, "", "Wilcoxon signed ranks", p)
    return Ranking(named, sorted_means, n, level, left_out, "", "Friedman and Nemenyi", friedman(scores)[1],
                   critical_difference(k, n, level))
