"""Statistics of a regression whose equation has its own constant in every experiment."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtrc

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import RankError
from optid.models.layout import Layout
from optid.statistics.blocks import check_lengths
from optid.statistics.factors import ROUNDING, add_to_root, any_root_of_gram
from optid.statistics.regression import CONDITION_LIMIT, LEAST_REMAINDER, Statistics, accumulate, factorise

FEW = 20  # errors of an experiment that tell its level
UNEQUAL = 0.01  # p value below which the levels of experiments are different
OF_EXPERIMENTS = "of another level in every experiment"


def equal_levels(counts: Array, squares: Array, scatter: float = 2.0) -> float:
    """Return the p value of Bartlett's test that experiments have errors of one level.

    Args:
        counts: (E,) errors.
        squares: (E,) their mean squares.
        scatter: variance of the square of an error over that of its mean: 2 for normal ones, more for heavy tails.
    """
    if len(counts) < 2 or min(counts) < FEW or not np.all(squares > 0):
        return 1.0
    whole = float(counts @ squares) / counts.sum()
    statistic = 2 / scatter * float(counts @ np.log(whole / squares))
    return float(chdtrc(len(counts) - 1, max(statistic, 0.0)))


@dataclass(frozen=True, eq=False)
class ExperimentMeans:
    """Means of the rows of every experiment."""

    rows: Array  # (E, n + l) of [Phi | Y]
    weights: Array  # (E,) sum of the weights of the rows

    def constants(self, theta: Array) -> Array:
        """Return the constants (E, l) of the experiments that belong to coefficients (n_columns, l).

        Their mean is the coefficient of the constant, wherever constraints hold it.
        """
        n, mean = len(theta), theta[-1]
        own = self.rows[:, n:] - self.rows[:, : n - 1] @ theta[:-1]
        shares = 1 / self.weights
        return own + np.outer(shares / shares.mean(), mean - own.mean(axis=0))

    def energy(self, shifts: Array) -> Array:
        """Return the sum of squares (l,) of the mean outputs about their mean, with shifts (E, l) of the outputs."""
        means = self.rows[:, self.rows.shape[1] - shifts.shape[1] :] + shifts
        return self.weights @ (means - self.weights @ means / self.weights.sum()) ** 2


def collect_by_experiment(data: Data, layout: Layout, weights: Sequence[Array] | None = None
                          ) -> tuple[Statistics, ExperimentMeans]:
    """Take the statistics of a record with one constant per experiment, and the means of the rows of each.

    The constants are eliminated but for their mean, which is the coefficient of the column of ones: rows are taken
    about the mean of their experiment, and one row, exact at the optimum, holds the mean of these means with the
    weight that leaves the information about the mean of the constants as it is. Arguments and errors as `collect`; a
    column that is constant within every experiment is refused as well (`RankError`).
    """
    parts = by_experiment(accumulate, data, layout, weights)
    for i, part in enumerate(parts, start=1):
        if not part.rows:
            raise RankError(f"Experiment {i} has no complete row, so that its constant is unknown: leave it out, or "
                            "use fewer lags.")
    found, means = _about_means(parts)
    found.check()
    if found.condition > CONDITION_LIMIT or found.remainder < LEAST_REMAINDER:
        found, means = _about_means(by_experiment(factorise, data, layout, weights))
        _ = found.root  # refuses dependent columns by name
    return found, means


def by_experiment(take: Callable[..., Statistics], data: Data, layout: Layout, weights: Sequence[Array] | None = None
                  ) -> list[Statistics]:
    """Take the statistics of every experiment by `accumulate` or `factorise`."""
    check_lengths([e.n_samples for e in data.experiments], layout)
    own: list[Any] = [None] * data.n_experiments if weights is None else [[one] for one in weights]
    return [take(data.select(experiments=i), layout, one) for i, one in enumerate(own)]


def rows_factor(part: Statistics, about_mean: bool) -> Array:
    """Return a factor (r, n + l) of the rows of an experiment, dependent or not, about their mean if asked."""
    first = [part.layout.offset] if about_mean else []
    order = np.r_[first, np.delete(np.arange(part.layout.n_columns + part.layout.l), first)].astype(int)
    return _ordered(part, order)[len(first) :, np.argsort(order)]


def _ordered(part: Statistics, order: Any) -> Array:
    """Return the triangular factor of the columns in another order."""
    if part.factor is None:
        return any_root_of_gram(part.gram[np.ix_(order, order)])
    return np.asarray(np.linalg.qr(part.factor[:, order], mode="r"))


def _about_means(parts: Sequence[Statistics]) -> tuple[Statistics, ExperimentMeans]:
    """Join the statistics of experiments, each about its own means, and the mean of these means."""
    layout, one = parts[0].layout, parts[0].layout.offset
    order = np.r_[one, np.delete(np.arange(layout.n_columns + layout.l), one)]
    back, means, weights, inner = np.argsort(order), [], [], np.zeros((0, order.size))
    for part in parts:
        triangle = _ordered(part, order)
        means.append((triangle[0] / triangle[0, 0])[back])
        weights.append(float(triangle[0, 0] ** 2))
        inner = np.asarray(np.linalg.qr(np.vstack([inner, triangle[1:]]), mode="r"))
    shares = 1 / np.array(weights)
    mean = np.sqrt(len(parts) / shares.mean()) * np.mean(means, axis=0)
    root = add_to_root(np.zeros((order.size, order.size)), np.vstack([mean, inner[:, back]]))
    exact = any(part.factor is not None for part in parts)
    energy = np.sum([np.diag(part.gram)[: layout.n_columns - 1] for part in parts], axis=0)
    left = np.sum(inner[:, back[: layout.n_columns - 1]] ** 2, axis=0)
    constant = left <= ROUNDING["qr" if exact else "gram"] ** 2 * energy
    if constant.any():
        raise RankError(f"Column {layout.names()[int(np.argmax(constant))]} of the regressor is constant within every "
                        "experiment: the record does not tell its effect from a constant of each. Use offset=True, or "
                        "experiments in which it moves.")
    total = Statistics(layout, root.T @ root, sum(part.rows for part in parts),
                       sum(part.candidates for part in parts), root if exact else None, len(parts) - 1)
    return total, ExperimentMeans(np.array(means), np.array(weights))
