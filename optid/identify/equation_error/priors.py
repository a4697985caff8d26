"""Gaussian priors on impulse responses: smooth and decaying, their strength by marginal likelihood.

The lags of every past output and of every function of every input are a priori normal with covariance c K(decay)
(Chen, Ohlsson and Ljung, On the estimation of transfer functions, Automatica 48, 2012). The hyperparameters, and the
variance of the noise, maximise the marginal likelihood, computed from the triangular factor of the record; the constant
has a flat prior.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from optid.arrays import Array
from optid.models.layout import Layout
from optid.statistics import Statistics

DECAYS, NOISES = (0.3, 0.6, 0.9), (-4.0, -1.0)  # starts: decays per lag, and logarithms of the noise
FLOOR = 1e-9  # smallest relative variance of a coefficient, so that K is regular
# of logarithms of variances relative to the output's, decays and correlations
BOUNDS = {"size": (-25.0, 12.0), "decay": (0.05, 0.998), "correlation": (-0.98, 0.98), "noise": (-30.0, 3.0)}
KERNELS = ("tc", "dc", "ss")


def kernel(word: str, lags: int, decay: float, correlation: float = 0.0) -> Array:
    """Return K[i, j], (lags, lags): "tc", tuned and correlated, decay^max(i, j).

    "dc", diagonal and correlated, decay^((i + j) / 2) correlation^|i - j|; "ss", the second-order stable spline,
    3 (d^(i + j + max) / 2 - d^(3 max) / 6) with d^3 = decay.
    """
    i = np.arange(1, lags + 1)
    both, most = np.add.outer(i, i), np.maximum.outer(i, i).astype(float)
    if word == "tc":
        return decay**most
    if word == "dc":
        return decay ** (both / 2) * correlation ** np.abs(np.subtract.outer(i, i))
    return 3 * (decay ** ((both + most) / 3.0) / 2 - decay**most / 6)


@dataclass(frozen=True, eq=False)
class Prior:
    """Covariance (n, n) of the coefficients of columns (n,) of the regressor; variance (l,) of the noise of outputs."""

    columns: np.ndarray
    covariance: Array
    noise: Array

    def rows(self, places: np.ndarray) -> Array:
        """Return the rows that the prior adds to the least squares in z, output by output.

        The places (n_columns, l) are the positions in z of every coefficient of the regressor.
        """
        inverse = solve_triangular(np.linalg.cholesky(self.covariance), np.eye(self.columns.size), lower=True)
        found = np.zeros((self.noise.size, self.columns.size, places.size))
        for rows, variance, own in zip(found, self.noise, places[self.columns].T):
            rows[:, own] = np.sqrt(variance) * inverse
        return found.reshape(-1, places.size)


def families(layout: Layout) -> list[list[np.ndarray]]:
    """Return groups of columns that share hyperparameters, lag by lag: the past of outputs, functions of inputs."""
    found = [[np.arange(layout.na) * layout.l + o] for o in range(layout.l)] if layout.na else []
    for c, (basis, lags) in enumerate(zip(layout.bases, layout.nb)):
        start = layout.block(c).start
        found.append([start + j + basis.size * np.arange(lags) for j in range(basis.size)])
    return found


def likeliest(word: str, statistics: Statistics) -> Prior:
    """Return the prior of a kernel, one of `KERNELS`, with the largest marginal likelihood of the record."""
    from scipy.optimize import minimize

    layout, n = statistics.layout, statistics.layout.n_columns
    groups = families(layout)
    columns = np.concatenate([part for group in groups for part in group])
    edges = np.cumsum([0, *(len(part) for group in groups for part in group)])
    free = np.r_[layout.offset, columns]  # the constant first: what it explains is projected out
    whole = np.hstack([statistics.root[:, free], statistics.root[:, n:]])
    factor = np.asarray(np.linalg.qr(whole, mode="r"))[1:, 1:]
    inner, right, rest = factor[: n - 1, : n - 1], factor[: n - 1, n - 1 :], factor[n - 1 :, n - 1 :]
    energy = np.sum(factor[:, n - 1 :] ** 2, axis=0) / statistics.rows
    sizes = np.array([np.sum(inner[:, edges[i] : edges[i + 1]] ** 2) for i in range(len(edges) - 1)]) / statistics.rows
    most = [float(np.mean(energy)) / max(float(np.max(sizes[start : start + len(group)])), 1e-300)
            for start, group in zip(np.cumsum([0, *map(len, groups)]), groups)]
    each = 3 if word == "dc" else 2

    def covariance(x: Array) -> Array:
        found, at = np.zeros((n - 1, n - 1)), 0
        for group, size, own in zip(groups, most, x[: each * len(groups)].reshape(-1, each)):
            block = size * np.exp(own[0]) * kernel(word, len(group[0]), *own[1:])
            block += FLOOR * block[0, 0] * np.eye(len(block))
            for part in group:
                found[at : at + len(part), at : at + len(part)] = block
                at += len(part)
        return found

    def unlikelihood(x: Array) -> float:
        spread, total = inner @ covariance(x) @ inner.T, 0.0
        for o, level in enumerate(x[each * len(groups) :]):
            noise = np.exp(level) * energy[o]
            try:
                root = cho_factor(spread + noise * np.eye(n - 1))
            except np.linalg.LinAlgError:
                return 1e300
            explained = right[:, o] @ cho_solve(root, right[:, o])
            total += 2 * np.sum(np.log(np.diag(root[0]))) + explained + (statistics.rows - n) * level + float(
                np.sum(rest[:, o] ** 2)) / noise
        return float(total) / statistics.rows

    words, ends = ["size", "decay", "correlation"][:each] * len(groups) + ["noise"] * layout.l, []
    for decay, noise in product(DECAYS, NOISES):
        values = {"size": 1.0, "decay": decay, "correlation": 0.7, "noise": noise}
        ends.append(minimize(unlikelihood, np.array([values[word] for word in words]), method="L-BFGS-B",
                             bounds=[BOUNDS[word] for word in words]))
    x = min(ends, key=lambda end: end.fun).x
    return Prior(columns, covariance(x), np.exp(x[each * len(groups) :]) * energy)
