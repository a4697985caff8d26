"""Posterior probabilities of explanations, marginalised over magnitudes and onsets.

The prior of the magnitudes nu of an explanation with Gram matrix G is N(0, g G^-1), a deflection of about sqrt(g) in
every direction. The marginal likelihood ratio to the healthy plant is (1 + g)^(-d/2) exp(g / (1 + g) l / 2) with the
energy l explained (Gustafsson 1995), averaged over several g, since no size is known beforehand. It penalises the
number of magnitudes: a loss is preferred to a stuck actuator that explains as much.

Least squares at the best onset gives intervals that are too short, because that onset is selected by the noise. The
size therefore has as its distribution the mixture of the estimates at all onsets, weighted by the posterior of the
onset; the interval cuts its tails. Measured in `benchmarks/faults/intervals.py`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.answers import Estimate
from optid.faults.nuisance import Nuisance
from optid.faults.search.scanning import Scan
from optid.faults.signatures import Candidate

SPREADS = 2.0, 4.0, 9.0, 25.0, 100.0, 400.0  # squared deflections of the prior
NEGLIGIBLE = 18.0  # logarithm of the ratio to the largest probability below which onsets are left out
MODEL_ERROR = 0.02  # probability that a share lost outside [0, 1] is due to an error of the model
HALVINGS = 60  # bisections for a quantile of a mixture


class Explained(NamedTuple):
    """Fit of an explanation to a window."""

    fitted: Array  # (N, l) of the innovations
    rest: Array  # (N, l) residual, white noise where the explanation is right
    magnitudes: int  # number of estimated magnitudes


class Explanation(NamedTuple):
    """One set of candidates over its possible onsets."""

    candidates: tuple[Candidate, ...]  # one or several
    onsets: np.ndarray  # (K, s) of each candidate
    logs: Array  # (K,) logarithms of the marginal likelihoods, the prior of the onsets included
    sizes: Array  # (K, d) magnitudes of all candidates by least squares, one after the other
    covariances: Array  # (K, d, d) for the onsets of the row
    energies: Array  # (K,) energy explained, or twice the gain in log-likelihood
    search: Scan | None = None  # with the signatures; None for candidates without one
    course: Callable[[int], Explained] | None = None  # in place of signatures, the fit to the window for an onset
    error: Nuisance | None = None  # of the signature, due to the uncertainty of an identified model
    # the candidates of the search of which the candidates are special cases; empty where they are the same
    entries: tuple[Candidate, ...] = ()

    def without_negligible_onsets(self) -> "Explanation":
        """Return the explanation without onsets of negligible probability."""
        kept = self.logs > self.logs.max() - NEGLIGIBLE
        return self._replace(
            onsets=self.onsets[kept], logs=self.logs[kept], sizes=self.sizes[kept],
            covariances=self.covariances[kept], energies=self.energies[kept],
        )

    def fit_to_window(self) -> Explained:
        """Return the fit of the most probable onsets to the window."""
        onsets, sizes = self.onsets[self.best], self.sizes[self.best]
        if self.course is not None:
            return self.course(int(onsets[0]))
        assert self.search is not None
        traces = [self.search.signature(c, int(onset)) for c, onset in zip(self.entries or self.candidates, onsets)]
        fitted = np.concatenate(traces, axis=2) @ sizes
        return Explained(fitted, self.search.whitened.r - fitted, sizes.size)

    @property
    def log_evidence(self) -> float:
        """Logarithm of the marginal likelihood, onsets summed out."""
        from scipy.special import logsumexp

        return float(np.asarray(logsumexp(self.logs)))

    @property
    def weights(self) -> Array:
        """Probabilities (K,) of the onsets."""
        return np.exp(self.logs - self.log_evidence)

    @property
    def best(self) -> int:
        """The row of the most probable onsets."""
        return int(np.argmax(self.logs))


def marginal(energies: Array, dimension: int | np.ndarray) -> Array:
    """Return the marginal log-likelihood ratio to the healthy plant of energies explained by so many magnitudes."""
    from scipy.special import logsumexp

    g = np.array(SPREADS)
    terms = np.multiply.outer(energies, g / (1 + g) / 2) - np.multiply.outer(dimension, np.log1p(g)) / 2
    return np.asarray(logsumexp(terms, axis=-1) - np.log(g.size))


def single(scan: Scan, candidate: Candidate) -> Explanation | None:
    """Return the explanation by one candidate of a search; None where it is not tested."""
    c = scan.index(candidate)
    row = scan.statistic[c]
    onsets = np.flatnonzero(~np.isnan(row))
    if not onsets.size:
        return None
    roots, along = scan.sweep.roots_of(c)[onsets], scan.correlations[onsets, scan.sweep.columns(c)]
    covariances = np.swapaxes(roots, 1, 2) @ roots
    sizes = np.einsum("kij,kj->ki", covariances, along)
    logs = marginal(row[onsets], candidate.dimension) - np.log(onsets.size)
    whole = Explanation((candidate,), onsets[:, None], logs, sizes, covariances, row[onsets], scan)
    found = whole.without_negligible_onsets()
    return found._replace(logs=found.logs + bounded_shares(found.candidates, found.sizes, found.covariances))


def several(scan: Scan, candidates: Sequence[Candidate], onsets: Sequence[int], reach: int) -> Explanation:
    """Return the explanation by several candidates, over the onsets within reach of the given ones."""
    ranges = []
    for candidate, onset in zip(candidates, onsets):
        row = scan.statistic[scan.index(candidate)]
        there = np.arange(max(onset - reach, 0), min(onset + reach + 1, row.size))
        ranges.append(there[~np.isnan(row[there])])
    blocks = [
        np.stack([scan.signature(c, int(k)).reshape(scan.whitened.r.size, -1) for k in there])
        for c, there in zip(candidates, ranges)]
    edges = np.cumsum([0, *(block.shape[2] for block in blocks)])
    rows = np.indices([len(there) for there in ranges]).reshape(len(ranges), -1)
    count, total = rows.shape[1], int(edges[-1])
    gram, correlation = np.empty((count, total, total)), np.empty((count, total))
    r = scan.whitened.r.ravel()
    for i, first in enumerate(blocks):
        a = slice(edges[i], edges[i + 1])
        correlation[:, a] = np.einsum("knd,n->kd", first, r)[rows[i]]
        for j, second in enumerate(blocks[: i + 1]):
            b = slice(edges[j], edges[j + 1])
            cross = np.tensordot(first, second, ([1], [1]))[rows[i], :, rows[j], :]
            gram[:, a, b], gram[:, b, a] = cross, np.swapaxes(cross, 1, 2)
    covariances, sizes, energies, ranks = least_squares(gram, correlation)
    prior = sum(np.log(max(np.sum(~np.isnan(scan.statistic[scan.index(c)])), 1)) for c in candidates)
    logs = marginal(energies, total) - prior
    apart = ranks == total  # elsewhere one of them explains as much
    for i, first in enumerate(candidates):
        for j, second in enumerate(candidates[:i]):
            if first is second:  # counted once
                apart &= ranges[j][rows[j]] < ranges[i][rows[i]]
    logs = np.where(apart, logs, -np.inf) if apart.any() else logs
    logs = logs + bounded_shares(candidates, sizes, covariances)
    where = np.stack([there[row] for there, row in zip(ranges, rows)], axis=1)
    return Explanation(tuple(candidates), where, logs, sizes, covariances, energies, scan).without_negligible_onsets()


def least_squares(gram: Array, correlation: Array, floor: float = 1e-6) -> tuple[Array, Array, Array, np.ndarray]:
    """Return covariances, magnitudes, energies and ranks of systems (K, d, d), (K, d) by least squares."""
    scale = np.sqrt(np.maximum(np.einsum("kii->ki", gram), 1e-300))
    values, axes = np.linalg.eigh(gram / (scale[:, :, None] * scale[:, None, :]))
    there = values > floor
    inverse = np.where(there, 1 / np.where(there, values, 1.0), 0.0)
    covariances = np.einsum("kij,kj,klj->kil", axes, inverse, axes) / (scale[:, :, None] * scale[:, None, :])
    sizes = np.einsum("kij,kj->ki", covariances, correlation)
    return covariances, sizes, np.einsum("ki,ki->k", sizes, correlation), there.sum(axis=1)


def bounded_shares(candidates: Sequence[Candidate], sizes: Array, covariances: Array) -> Array:
    """Return the change (K,) of the log-likelihood because a share lost lies between 0 and 1."""
    change, first = np.zeros(len(sizes)), 0
    for candidate in candidates:
        if candidate.fault_kind.loses:
            change += np.log(share_bound(sizes[:, first], covariances[:, first, first]))
        first += candidate.dimension
    return change


def share_bound(share: Array, variance: Array) -> Array:
    """Return the factor (K,) of the likelihood because a share lost, estimated with a variance, lies in [0, 1]."""
    from scipy.special import ndtr

    std = np.sqrt(np.maximum(variance, 1e-300))
    inside = ndtr((1 - share) / std) - ndtr(-share / std)
    return (1 - MODEL_ERROR) * inside / share_prior(std) + MODEL_ERROR


def share_prior(std: Array) -> Array:
    """Return the prior probability (K,) of shares from 0 to 1."""
    from scipy.special import ndtr

    return ndtr(1 / (std * np.sqrt(np.mean(SPREADS)))) - 0.5


def smallest_set(posterior: Array, coverage: float) -> np.ndarray:
    """Return the smallest set of entries with the given probability, the most probable first."""
    order = np.argsort(-posterior, kind="stable")
    enough = int(np.searchsorted(np.cumsum(posterior[order]), coverage * (1 - 1e-12))) + 1
    return order[:enough]


def estimates(found: Explanation, coverage: float, window: int, edge: int) -> tuple[Estimate, ...]:
    """Return the faults of an explanation with intervals of this coverage, in the order of their onsets.

    For onsets within `edge` samples of the start or end of the window, of N samples, the size is NaN.
    """
    weights, best, first, result = found.weights, found.best, 0, []
    for number, candidate in enumerate(found.candidates):
        part = slice(first, first + candidate.dimension)
        first = part.stop
        onset = int(found.onsets[best, number])
        low, high = onset_range(found.onsets[:, number], weights, coverage, onset)
        sizes, covariances = found.sizes[:, part], found.covariances[:, part, part]
        intervals = mixture_intervals(weights, sizes, np.sqrt(np.einsum("kii->ki", covariances)), coverage)
        size = sizes[best].copy()
        if candidate.fault_kind.loses:  # a share lost lies between 0 and 1
            size[0], intervals[0] = np.clip(size[0], 0.0, 1.0), np.clip(intervals[0], 0.0, 1.0)
        mean = weights @ sizes
        spread = np.einsum("k,ki,kj->ij", weights, sizes - mean, sizes - mean)
        nu, own = sizes[best], covariances[best]
        censored, at_edge = onset < edge, not edge <= onset <= window - edge
        result.append(Estimate(
            label=candidate.label, name=candidate.name, kind=candidate.kind, candidate=candidate, onset=onset,
            onset_interval=(0 if censored else low, high), onset_censored=censored,
            size=np.full(nu.shape, np.nan) if at_edge else size, size_interval=intervals,
            covariance=np.einsum("k,kij->ij", weights, covariances) + spread,
            deflection=float(np.sqrt(max(nu @ np.linalg.pinv(own, hermitian=True) @ nu, 0.0))),
        ))
    return tuple(sorted(result, key=lambda fault: fault.onset))


def onset_range(onsets: np.ndarray, weights: Array, coverage: float, best: int) -> tuple[int, int]:
    """Return the hull of the most probable onsets (K,) with this coverage and of the best one.

    Onsets may be repeated, where other faults have several.
    """
    samples, which = np.unique(onsets, return_inverse=True)
    mass = np.bincount(which.ravel(), weights)
    chosen = np.append(samples[smallest_set(np.asarray(mass, dtype=float), coverage)], best)
    return int(chosen.min()), int(chosen.max())


def mixture_intervals(weights: Array, means: Array, stds: Array, coverage: float) -> Array:
    """Return the central intervals (d, 2) of mixtures of K normal laws, by bisection.

    The components have weights (K,), means (K, d) and stds (K, d), which are not positive where nothing is known.
    """
    from scipy.special import ndtr

    tails = np.array([(1 - coverage) / 2, (1 + coverage) / 2])
    unknown = (stds <= 0).any(axis=0)
    stds = np.where(stds > 0, stds, 1.0)
    low = np.repeat((means - 40 * stds).min(axis=0)[:, None], 2, axis=1)
    high = np.repeat((means + 40 * stds).max(axis=0)[:, None], 2, axis=1)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        below = np.einsum("k,kdq->dq", weights, ndtr((middle - means[:, :, None]) / stds[:, :, None])) < tails
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    result = (low + high) / 2
    result[unknown] = -np.inf, np.inf
    return result
