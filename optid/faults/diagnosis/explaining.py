"""Explanations of a record by one or two candidates, with their probabilities and what they leave."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.faults.consistency.leftover import UNFIT, further_fault, left_over
from optid.faults.diagnosis.alternatives import UNLISTED, parted
from optid.faults.diagnosis.answers import Remaining
from optid.faults.diagnosis.counting import recounted
from optid.faults.diagnosis.looking import Seen
from optid.faults.diagnosis.posterior import Explained, Explanation, probabilities, several, single, smallest_set
from optid.faults.search.pair_search import pairs
from optid.faults.search.scanning import scan

REACH = 10
"""Onsets on both sides of the best ones over which two faults are summed."""

FAR = 30.0
"""Pairs of candidates whose gain is smaller than the best by this are left out."""

ATOMS = 8_000
"""Candidates times onsets beyond which two faults are searched on a grid of onsets."""


class Fit(NamedTuple):
    """An explanation and how well it fits.

    Attributes:
        explanation: candidates over their onsets.
        probability: posterior.
        gain: energy explained at the best onsets, less the thresholds.
        fitted: (N, l) what it leaves in the innovations.
        remaining: what it does not explain.
    """

    explanation: Explanation
    probability: float
    gain: float
    fitted: Array
    remaining: Remaining

    @property
    def fits(self) -> bool:
        """Whether what it leaves may be the noise of a healthy plant."""
        return self.remaining.p_value > UNFIT


class Ranking(NamedTuple):
    """What may have happened.

    Attributes:
        fits: the smallest set with the probability asked for, the most probable first.
        odds: twice the logarithm of the odds of the first against the next explanation, in the set or not.
        exhaustive: whether every onset was tried.
    """

    fits: tuple[Fit, ...]
    odds: float
    exhaustive: bool


def singles(seen: Seen) -> list[Explanation]:
    """Return every candidate that is tested, and what is thought possible beside them, over their onsets."""
    listed = seen.dictionary.candidates
    result: list[Explanation] = []
    if seen.search is not None:
        for candidate in seen.tested:
            found = single(seen.search, candidate)
            if found is not None:
                result += parted(recounted(found, seen.search, seen.uncertainty), seen.search, listed)
    if seen.beside is not None:
        lost = {label.removesuffix(" loss") for label in seen.lost}
        for candidate in seen.beside.dictionary.candidates:
            found = None if candidate.name in lost else single(seen.beside, candidate)
            if found is not None:
                found = found._replace(logs=found.logs + np.log(UNLISTED), entry=candidate)
                result += parted(recounted(found, seen.beside, seen.uncertainty), seen.beside, listed)
    return result + seen.gains_of_sensors + seen.courses


def doubles(seen: Seen) -> tuple[list[Explanation], bool]:
    """Return the pairs of candidates that come near the best one, and whether all onsets were tried."""
    search, limits = seen.search, seen.limits
    assert search is not None and limits is not None
    candidates, count = search.dictionary.candidates, len(seen.whitened.r)
    stride = -(-int(np.sum(~np.isnan(seen.gains))) // ATOMS)
    tried = search if stride == 1 else scan(
        search.dictionary, seen.whitened, search.u, onsets=np.arange(0, count, stride)
    )
    found = pairs(tried, limits)
    gains = found.gains.copy()
    lost = [label in seen.lost for label in search.labels]
    gains[lost], gains[:, lost] = np.nan, np.nan
    if np.isnan(gains).all():
        return [], True
    near = np.argwhere(gains > np.nanmax(gains) - FAR)
    return [
        several(search, [candidates[i], candidates[j]], [int(k) for k in found.onsets[i, j]], max(REACH, stride))
        for i, j in near
    ], stride == 1


def ranked(seen: Seen, explanations: Sequence[Explanation], rare: float, coverage: float, exhaustive: bool) -> Ranking:
    """Return the smallest set of explanations that holds the probability asked for.

    Args:
        seen: the experiment.
        explanations: those that are thought possible.
        rare: probability of a further fault beside one.
        coverage: of the set.
        exhaustive: whether every onset was tried.
    """
    if not explanations:
        return Ranking((), np.inf, exhaustive)
    logs = np.array([e.log_evidence + np.log(rare) * (len(e.candidates) - 1) for e in explanations])
    posterior = probabilities(logs)
    for first, others in _alike(explanations, posterior).items():
        posterior[first] = posterior[others].sum()
        logs[first] = np.logaddexp.reduce(logs[others])
        logs[[i for i in others if i != first]] = -np.inf
        posterior[[i for i in others if i != first]] = 0.0
    largest = np.sort(logs[np.isfinite(logs)])
    odds = float(2 * (largest[-1] - largest[-2])) if largest.size > 1 else np.inf
    chosen = [i for i in smallest_set(posterior, coverage) if posterior[i] > 0]
    return Ranking(tuple(_fit(seen, explanations[i], float(posterior[i])) for i in chosen), odds, exhaustive)


def _alike(explanations: Sequence[Explanation], posterior: Array) -> dict[int, list[int]]:
    """Explanations of one name: the most probable, and all of them."""
    named: dict[tuple[str, ...], list[int]] = {}
    for i, found in enumerate(explanations):
        named.setdefault(tuple(c.label for c in found.candidates), []).append(i)
    return {max(group, key=lambda i: posterior[i]): group for group in named.values() if len(group) > 1}


def _fit(seen: Seen, explanation: Explanation, probability: float) -> Fit:
    best = explanation.best
    made = _made(seen, explanation)
    rest = made.rest if explanation.error is None else explanation.error(made.rest)
    further, penalty = 1.0, 0.0
    if seen.search is not None and seen.limits is not None:
        search, limits = seen.search, seen.limits
        gains = search.sweep.statistic(search.sweep.correlations(rest)) - limits.q[:, None]
        gains[np.isnan(seen.gains)] = np.nan
        further = further_fault(gains, limits.false_alarm)
        listed = [] if explanation.entry is not None and explanation.entry not in search.dictionary.candidates else (
            [explanation.entry] if explanation.entry is not None else explanation.candidates)
        penalty = float(np.nansum([limits.q[search.index(c)] for c in listed])) if listed else float(
            np.nanmax(limits.q))
    left = left_over(seen.whitened, rest, seen.nx + made.magnitudes, further)
    return Fit(explanation, probability, float(explanation.energies[best] - penalty), made.fitted, left)


def _made(seen: Seen, explanation: Explanation) -> Explained:
    best = explanation.best
    if explanation.course is not None:
        return explanation.course(int(explanation.onsets[best, 0]))
    source = seen.search if explanation.entry is None else seen.beside
    assert source is not None
    pairs_of = zip(explanation.candidates, explanation.onsets[best])
    traces = [source.signature(candidate, int(onset)) for candidate, onset in pairs_of]
    fitted = np.concatenate(traces, axis=2) @ explanation.sizes[best]
    return Explained(fitted, seen.whitened.r - fitted, explanation.sizes.shape[1])
