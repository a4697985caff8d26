"""Ranks over data sets: whether an order holds on other data sets.

The unit is the data set, not the seed: seeds of one data set give the uncertainty of its own result only (J. Demšar,
Statistical comparisons of classifiers over multiple data sets, Journal of Machine Learning Research 7 (2006) 1-30).
Each is compared with the best by the exact sign test, which depends on no other one, as differences of mean ranks do
(A. Benavoli, G. Corani, F. Mangili, the same journal, 17 (2016) 1-10).
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest, rankdata

from optid.studies.verdicts.averages import means_of_groups
from optid.studies.verdicts.statement import there_are

LEVEL = 0.05  # of all tests


@dataclass(frozen=True)
class SolverRanking:
    """Mean ranks of k solvers over data sets, 1 the best, and those behind the best."""

    names: tuple[str, ...]  # the solvers, best mean rank first
    ranks: np.ndarray  # their mean ranks
    n: int  # data sets
    probabilities: dict[str, float]  # {other: of signs as unequal as these between two alike, for all pairs at once}
    left_out: tuple[str, ...] = ()  # solvers that did not run on every data set
    missing: str = ""  # the missing data

    @property
    def behind(self) -> tuple[str, ...]:
        """Those significantly behind the best."""
        return tuple(name for name, p in self.probabilities.items() if p < LEVEL and not self.missing)


def sign_test(lost: int, won: int, sides: str = "two-sided") -> float:
    """Return the exact probability of at least as unequal losses and wins between two equals; 1 without any.

    With sides "greater" it is the one-sided probability of at least as many losses.
    """
    return float(binomtest(lost, lost + won, alternative=sides).pvalue) if lost + won else 1.0


def ranks_of_problems(costs: np.ndarray) -> np.ndarray:
    """Return the ranks within every problem, (P, S): 1 the best, equal costs and all failures (``nan``) tied."""
    return rankdata(np.where(np.isfinite(costs), costs, np.inf), axis=1) if costs.size else np.zeros(costs.shape)


def rank(costs: np.ndarray, tried: np.ndarray, names: tuple[str, ...], data: np.ndarray, noun: str = "solver"
         ) -> SolverRanking:
    """Rank those that were tried on every data set; a failure on a problem ranks last there, failures tied.

    Costs (lower is better, ``nan`` where not solved) and `tried` are (P, k), the labels of the data sets (P,). The
    probabilities are multiplied by the number of pairs, since the best is known only afterwards; with too few data sets
    for a significant unanimous comparison, `SolverRanking.missing` says how many are needed.
    """
    everywhere = [bool(len(data)) and all(column[data == label].any() for label in dict.fromkeys(data))
                  for column in tried.T]
    kept, out = (tuple(name for name, there in zip(names, everywhere) if there == keep) for keep in (True, False))
    scores = means_of_groups(ranks_of_problems(costs[:, everywhere]), data)
    n, k = len(scores), len(kept)
    means = np.mean(rankdata(scores, axis=1), axis=0) if n and k else np.full(k, np.nan)
    order = sorted(range(k), key=lambda s: (means[s], kept[s]))
    pairs = max(k * (k - 1) // 2, 1)
    needed = next(size for size in range(1, 99) if pairs * sign_test(size, 0) < LEVEL)
    found = {}
    for s in order[1:]:
        gaps = scores[:, s] - scores[:, order[0]]
        lost, won = int((gaps > 0).sum()), int((gaps < 0).sum())
        found[kept[s]] = min(1.0, pairs * sign_test(lost, won)) if lost > won else 1.0
    missing = [f"at least 2 {noun}s that ran on every data set; {there_are(k)}"] if k < 2 else []
    if n < needed:
        missing.append(f"at least {needed} data sets; {there_are(n)}")
    return SolverRanking(tuple(kept[s] for s in order), means[order], n, found, out,
                   f"needs {', and '.join(missing)}" if missing else "")
