"""Criteria for the number of states: prediction errors of every order from one matrix of moments.

The state of order n is the best n combinations of past inputs and outputs for predicting the future (canonical
variates). Its errors 1, ..., alpha samples ahead are a quadratic form of the same moments, on the record itself and on
a part held out. Windows that do not overlap are independent given their states: N / alpha times the log determinant of
the errors of a window is the likelihood. Source: Larimore 1990; small-sample correction: Hurvich and Tsai 1989.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.statistics.expansion import Expansion
from optid.statistics.hankel import HankelStatistics

ROUNDING = 1e-10  # share of the moments added to their diagonal: prediction errors below its root count as none


@dataclass(frozen=True, eq=False)
class StateCriteria:
    """Criteria (k,) by number of states n = 0, 1, ..., k - 1; smaller is better, but for the fit.

    Attributes:
        aic, aicc, bic: Akaike's criterion, with its small-sample correction, and Schwarz's.
        fit: in % on the part held out, mean over the outputs and over 1, ..., alpha samples ahead; NaN without one.
        windows: number of prediction errors per output and horizon.
    """

    aic: Array
    aicc: Array
    bic: Array
    fit: Array
    windows: int

    def best(self) -> dict[str, int]:
        """Return the best order by each criterion; by hold-out the smallest within 0.1 points of the best."""
        found = {name: int(np.argmin(getattr(self, name))) for name in ("aic", "aicc", "bic")}
        if np.isfinite(self.fit).any():
            found["hold-out"] = int(np.flatnonzero(self.fit >= np.nanmax(self.fit) - 0.1)[0])
        return found


def criteria(likelihood: Any, parameters: Any, samples: int, outputs: int) -> tuple[Any, Any, Any]:
    """Return AIC, AIC with the small-sample correction, and BIC, from minus twice the logarithm of a likelihood."""
    aic = likelihood + 2 * parameters
    spare = np.maximum(samples * outputs - parameters - 1, 1)
    return aic, aic + 2 * parameters * (parameters + 1) / spare, likelihood + np.log(samples) * parameters


def state_criteria(statistics: HankelStatistics, expansion: Expansion, alpha: int, largest: int,
                   train: HankelStatistics | None = None, test: HankelStatistics | None = None) -> StateCriteria:
    """Compare the orders 0 ... largest by moments of windows of at least 2 alpha samples, alpha past and future ones.

    `train` and `test` are the moments, with the same centre, of the part fitted and the part held out, if any.
    """
    l = expansion.l  # noqa: E741
    covariances, j = _errors(statistics, statistics, expansion, alpha, largest), statistics.windows
    n = np.arange(largest + 1, dtype=float)
    k = n * (2 * l + expansion.p + expansion.q) + l * (expansion.p + 1)
    likelihood = j / alpha * np.array([np.linalg.slogdet(covariance)[1] for covariance in covariances])
    fit = np.full(n.size, np.nan)
    if train is not None and test is not None:
        y = test.at(expansion.y, range(alpha, 2 * alpha))
        spread = np.diag(test.gram)[y] / test.windows - (test.gram[0, y] / test.windows) ** 2
        errors = np.array([np.diag(covariance) for covariance in _errors(train, test, expansion, alpha, largest)])
        fit = 100 * np.mean(1 - np.sqrt(np.maximum(errors, 0) / np.maximum(spread, 1e-300)), axis=1)
    return StateCriteria(*criteria(likelihood, k, j, l), fit, j)


def _errors(fitted: HankelStatistics, judged: HankelStatistics, expansion: Expansion, alpha: int, largest: int
           ) -> list[Array]:
    """Covariances (alpha l, alpha l) of the errors in the future of `judged` of states and predictors of `fitted`."""
    from scipy.linalg import cholesky, solve_triangular

    past = fitted.at([*expansion.eta, *expansion.zeta, *expansion.y], range(alpha))
    _, drive, future = expansion.positions(fitted.at, "inputs", alpha)
    order = np.concatenate([drive, past, future])
    gram = fitted.gram[np.ix_(order, order)] / fitted.windows
    gram[np.diag_indices_from(gram)] *= 1 + ROUNDING
    triangle = cholesky(gram)
    p, f = slice(drive.size, drive.size + past.size), slice(drive.size + past.size, order.size)
    size = np.vstack([triangle[p, f], triangle[f, f]])
    whiten = cholesky(size.T @ size)
    right = np.linalg.svd(solve_triangular(whiten, triangle[p, f].T, trans=1))[2]
    states = np.zeros((len(fitted.gram), largest))
    states[past] = solve_triangular(triangle[p, p], right[:largest].T)
    found = []
    ours, theirs = fitted.gram / fitted.windows, judged.gram / judged.windows
    for n in range(largest + 1):
        regressors = np.zeros((len(ours), drive.size + n))
        regressors[drive, np.arange(drive.size)] = 1
        regressors[:, drive.size :] = states[:, :n]
        inner = regressors.T @ ours @ regressors
        inner[np.diag_indices_from(inner)] *= 1 + ROUNDING
        error = -regressors @ np.linalg.solve(inner, regressors.T @ ours[:, future])
        error[future, np.arange(future.size)] += 1
        covariance = error.T @ theirs @ error
        covariance[np.diag_indices_from(covariance)] += ROUNDING * np.diag(theirs)[future]
        found.append(covariance)
    return found
