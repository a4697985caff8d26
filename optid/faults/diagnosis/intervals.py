"""Intervals of onset and size that account for the search for the onset.

Least squares at the best onset gives intervals that are too short, because the best onset is the one at which noise
helped. Here the size is a mixture of the estimates at all onsets, each with the posterior probability of the onset; the
interval is cut from the tails of the mixture. Measured in `benchmarks/faults/intervals.py`.
"""

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.answers import Estimate
from optid.faults.diagnosis.posterior import Explanation, smallest_set

HALVINGS = 60
"""Steps of the search for a quantile of a mixture."""


def estimates(found: Explanation, coverage: float, window: int, edge: int) -> tuple[Estimate, ...]:
    """Return the faults of an explanation with intervals of this coverage, in the order of their onsets.

    Onsets nearer than `edge` to the start or the end of the window, of N samples, leave the size to its interval.
    """
    weights, best, first = found.weights, found.best, 0
    result = []
    for number, candidate in enumerate(found.candidates):
        part = slice(first, first + candidate.dimension)
        first = part.stop
        onset = int(found.onsets[best, number])
        low, high = onset_range(found.onsets[:, number], weights, coverage, onset)
        sizes, covariances = found.sizes[:, part], found.covariances[:, part, part]
        intervals = mixture_intervals(weights, sizes, np.sqrt(np.einsum("kii->ki", covariances)), coverage)
        mean = weights @ sizes
        spread = np.einsum("k,ki,kj->ij", weights, sizes - mean, sizes - mean)
        nu, own = sizes[best], covariances[best]
        censored, at_edge = onset < edge, not edge <= onset <= window - edge
        result.append(Estimate(
            label=candidate.label, name=candidate.name, kind=candidate.kind, candidate=candidate, onset=onset,
            onset_interval=(0 if censored else low, high), onset_censored=censored,
            size=np.full(nu.shape, np.nan) if at_edge else nu, size_interval=intervals,
            covariance=np.einsum("k,kij->ij", weights, covariances) + spread,
            deflection=float(np.sqrt(max(nu @ np.linalg.pinv(own, hermitian=True) @ nu, 0.0))),
        ))
    return tuple(sorted(result, key=lambda fault: fault.onset))


def onset_range(onsets: np.ndarray, weights: Array, coverage: float, best: int) -> tuple[int, int]:
    """Return the hull of the most probable onsets (K,) of these weights that hold the coverage, with the best one.

    Onsets may be repeated, where other faults have several.
    """
    samples, which = np.unique(onsets, return_inverse=True)
    mass = np.bincount(which.ravel(), weights)
    chosen = np.append(samples[smallest_set(np.asarray(mass, dtype=float), coverage)], best)
    return int(chosen.min()), int(chosen.max())


def mixture_intervals(weights: Array, means: Array, stds: Array, coverage: float) -> Array:
    """Return the central intervals (d, 2) of mixtures of K normal laws, by bisection.

    Args:
        weights: (K,) of the components.
        means: (K, d) of the components.
        stds: (K, d) of the components; not positive where nothing is known.
        coverage: probability of each interval.
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
