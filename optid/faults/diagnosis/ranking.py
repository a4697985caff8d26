"""Explanations of a record by one or several candidates, ranked by probability, with their residuals."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import SolverFailed, StructureError
from optid.faults.diagnosis.alternatives import (
    UNKNOWN_DIRECTION,
    UNLISTED,
    declares_process,
    same_at_process,
    split_by_kind,
)
from optid.faults.diagnosis.answers import Certificate, Remaining
from optid.faults.diagnosis.counting import with_model_uncertainty
from optid.faults.diagnosis.leftover import UNFIT, further_fault, remainder_test
from optid.faults.diagnosis.posterior import Explanation, several, single, smallest_set
from optid.faults.diagnosis.record_search import RecordSearch
from optid.faults.programmes import solve_registered
from optid.faults.search.scanning import scan
from optid.faults.search.sparse import SparseResult
from optid.faults.search.subsets import SubsetSearch, best_subsets

REACH = {1: 40, 2: 10, 3: 5, 4: 3}
"""Onsets on both sides of the best ones that are summed, by the number of faults; two for more faults."""

FAR = 30.0  # difference to the best gain beyond which choices of candidates are left out
ATOMS = 8_000  # candidates times onsets beyond which two faults are searched on a grid of onsets

NEAR, NEAR_OF_MANY = 10, 4
"""Onsets searched exactly on both sides of those of the programme, for up to two faults and for more."""

STRETCH = 100  # samples of the section with bounded noise, whose proof holds for the record
BEFORE = 25  # samples of this section before the best onset

TEMPERED = 0.5
"""Power of the likelihoods where outputs leave the range of the identification: the likelihood of a model that is
wrong there says too much (J. W. Miller, D. B. Dunson, J. American Statistical Association 114, 2019)."""

NOTHING = Certificate("none", float("nan"))


class RankedExplanation(NamedTuple):
    """An explanation with its fit."""

    explanation: Explanation  # candidates over their onsets
    probability: float  # posterior
    gain: float  # energy explained at the best onsets, less the thresholds
    fitted: Array  # (N, l) fit to the innovations
    remaining: Remaining  # residual

    @property
    def is_unlisted(self) -> bool:
        """Whether it is a disturbance of the process of unknown direction."""
        return any(c.name == UNKNOWN_DIRECTION for c in self.explanation.candidates)


class Ranking(NamedTuple):
    """The set of explanations."""

    fits: tuple[RankedExplanation, ...] = ()  # the smallest set with the required probability, the most probable first
    odds: float = float("inf")  # twice the log-odds of the first against the next explanation, in the set or not
    certificate: Certificate = NOTHING  # of the first
    note: str = ""  # a remark for the report

    @property
    def explains(self) -> bool:
        """Whether one of the residuals agrees with the noise of a healthy plant."""
        return any(fit.remaining.p_value > UNFIT for fit in self.fits)

    @property
    def settles(self) -> bool:
        """Whether that is the residual of faults that are listed.

        The disturbance of unknown direction has as many magnitudes as the plant has states, and fits what is left of
        most pairs of faults.
        """
        return any(fit.remaining.p_value > UNFIT and not fit.is_unlisted for fit in self.fits)


def explain_record(seen: RecordSearch) -> tuple[RecordSearch, Ranking, bool]:
    """Return the search, its ranking by the chosen method, and whether there is an alarm."""
    alarm, unproved = seen.p_value <= seen.asked.false_alarm, ""
    if seen.asked.method == "set":
        ranking, proved = _by_bounds(seen)
        if proved and not ranking.explains:  # a fault is proved, but no single one fits
            seen, other = _explained(seen)
            return seen, ranking._replace(fits=other.fits, note=f"{ranking.note} {other.note}".strip()), True
        if proved or not alarm:
            return seen, ranking, proved
        unproved = f"{ranking.note} The answer is that of the exact search."
    if not alarm:
        return seen, Ranking(), False
    if seen.asked.method.startswith("sparse"):
        return seen, _by_programme(seen), True
    seen, ranking = _explained(seen)
    return seen, ranking._replace(note=f"{unproved} {ranking.note}".strip()), True


def _explained(seen: RecordSearch) -> tuple[RecordSearch, Ranking]:
    """Explain a record by the candidates, with outliers beside them, by two faults."""
    most = seen.asked.max_faults
    ranking = _exact(seen, most)
    if ranking.settles or seen.search is None or not seen.dictionary.unknown:
        return seen, ranking
    wide = seen.widened()
    for count in dict.fromkeys((most, 2)):
        wider = _exact(wide, count)
        if wider.settles or (count > 1 and wider.explains):
            searched = "No single fault of the dictionary explains the record: two were searched. " * (count > most)
            return wide, wider._replace(note=f"{searched}{wider.note}".strip())
    return seen, ranking


def _exact(seen: RecordSearch, count: int) -> Ranking:
    """The set of explanations by so many faults at most."""
    explanations, exhaustive, search = singles(seen), True, seen.search
    if count > 1 and seen.tested:
        assert search is not None and seen.limits is not None
        stride = -(-int(np.sum(~np.isnan(seen.gains))) // ATOMS)
        exhaustive = stride == 1
        if not exhaustive:
            search = scan(search.dictionary, seen.whitened, search.u, onsets=slice(None, None, stride))
        explanations += _several(seen, best_subsets(search, seen.limits), stride)
    ranking = ranked(seen, explanations)
    note = "" if exhaustive else "Two faults were searched on a grid of onsets."
    if not ranking.fits:
        return ranking._replace(note=note)
    on_grid = any(c.fault_kind.noise for c in ranking.fits[0].explanation.candidates)  # whose onsets are sampled
    kind = "exhaustive" if exhaustive and not on_grid else "grid"
    return ranking._replace(certificate=Certificate(kind, ranking.fits[0].gain, ranking.odds), note=note)


def singles(seen: RecordSearch) -> list[Explanation]:
    """Return the explanations by every tested candidate and by those beside the dictionary."""
    lost = {label.removesuffix(" loss") for label in seen.lost}
    able = [(seen.search, c, 0.0) for c in seen.tested]
    if seen.beside is not None:
        beside = seen.beside.dictionary.candidates
        able += [(seen.beside, c, float(np.log(UNLISTED))) for c in beside if c.name not in lost]
    result: list[Explanation] = []
    for search, candidate, prior in able:
        found = None if search is None else single(search, candidate)
        if found is not None:
            counted = with_model_uncertainty(found._replace(logs=found.logs + prior), seen.noise.get("uncertainty"))
            result += split_by_kind(counted, seen.dictionary.candidates)
            if seen.dictionary.unknown and not declares_process(seen.dictionary):
                result += same_at_process(counted)
    return result + seen.gains_of_sensors + seen.courses


def _several(seen: RecordSearch, found: SubsetSearch, reach: int = 1) -> list[Explanation]:
    """Explanations by several candidates with a gain near the best, over the onsets around them."""
    near = [s for s in found.ranked if len(s.labels) > 1 and not set(seen.lost) & set(s.labels)]
    result: list[Explanation] = []
    for subset in near:
        if subset.gain > near[0].gain - FAR:
            result += split_by_kind(_around(seen, subset.labels, subset.onsets, reach), seen.dictionary.candidates)
    return result


def _around(seen: RecordSearch, labels: Sequence[str], onsets: Sequence[int], reach: int = 1) -> Explanation:
    assert seen.search is not None
    candidates = [seen.dictionary[label] for label in labels]
    alone = single(seen.search, candidates[0]) if len(candidates) == 1 else None
    return alone or several(seen.search, candidates, onsets, max(REACH.get(len(labels), 2), reach))


def ranked(seen: RecordSearch, explanations: Sequence[Explanation]) -> Ranking:
    """Return the smallest set of explanations with the required probability."""
    if not explanations:
        return Ranking()
    named: dict[tuple[str, ...], list[Explanation]] = {}
    for found in explanations:
        named.setdefault(tuple(c.label for c in found.candidates), []).append(found)
    best = [max(group, key=lambda e: e.log_evidence) for group in named.values()]
    # a further fault beside one is as rare as a false alarm
    rare = np.array([np.log(seen.asked.false_alarm) * (len(e.candidates) - 1) for e in best])
    logs = rare + [np.logaddexp.reduce([e.log_evidence for e in group]) for group in named.values()]
    logs = logs * (TEMPERED if seen.extrapolated else 1.0)
    posterior = np.exp(logs - np.logaddexp.reduce(logs))
    largest = np.sort(logs[np.isfinite(logs)])
    odds = float(2 * (largest[-1] - largest[-2])) if largest.size > 1 else np.inf
    chosen = [i for i in smallest_set(posterior, seen.asked.coverage) if posterior[i] > 0]
    return Ranking(tuple(_fit(seen, best[i], float(posterior[i])) for i in chosen), odds)


def _fit(seen: RecordSearch, explanation: Explanation, probability: float) -> RankedExplanation:
    made = explanation.fit_to_window()
    rest = made.rest if explanation.error is None else explanation.error(made.rest)
    further, penalty, search, limits = 1.0, 0.0, seen.search, seen.limits
    if search is not None and limits is not None:
        gains = search.again(rest).gains(limits)
        gains[np.isnan(seen.gains)] = np.nan
        further = further_fault(gains, limits.false_alarm)
        if explanation.search is search:
            own = explanation.entries or explanation.candidates
            penalty = float(np.nansum([limits.q[search.index(c)] for c in own]))
        elif explanation.search is not None:
            penalty = float(np.nanmax(limits.q))
    left = remainder_test(seen.whitened, rest, seen.dictionary.model.nx + made.magnitudes, further)
    gain = float(explanation.energies[explanation.best] - penalty)
    return RankedExplanation(explanation, probability, gain, made.fitted, left)


def _by_programme(seen: RecordSearch) -> Ranking:
    """Choose onsets by the group-sparse programme, and without polishing candidates, too.

    Raises:
        StructureError: no candidate with a signature, too many subsets.
    """
    asked, search, limits = seen.asked, seen.search, seen.limits
    if search is None or limits is None:
        raise StructureError(
            f"method={asked.method!r} requires a candidate with a signature: add kind 'bias', or use method='exact'.")
    try:
        result: SparseResult = solve_registered("fault.signature", search, limits, solver=asked.solver)
    except SolverFailed:
        return Ranking(note="The solver found no point.")
    if asked.method == "sparse+polish":
        reach = NEAR if asked.max_faults < 3 else NEAR_OF_MANY
        found = best_subsets(search, limits, max_faults=asked.max_faults, near=result.near(reach))
        ranking = ranked(seen, singles(seen) + _several(seen, found))
    else:  # the strongest group of every cluster, estimated again without the penalty
        active = [g for g in result.active if g.label not in seen.lost]
        groups = [[g for g in active if first <= g.onset <= last] for first, last in result.clusters]
        strongest = [max(here, key=lambda g: g.deflection) for here in groups if here]
        strongest = sorted(strongest, key=lambda g: -g.deflection)[: asked.max_faults]
        labels, onsets = [g.label for g in strongest], [g.onset for g in strongest]
        ranking = ranked(seen, [_around(seen, labels, onsets)] if strongest else [])
    if not result.certified:
        note = f"Not certified ({result.status}; relative gap {result.gap:.1e}): no answer is called the best."
        return ranking._replace(certificate=Certificate("none", result.gap, ranking.odds), note=note)
    return ranking._replace(certificate=Certificate("duality gap", result.gap, ranking.odds))


def _by_bounds(seen: RecordSearch) -> tuple[Ranking, bool]:
    """Rank the candidates that bounds of the noise do not exclude; return whether they prove a fault, too."""
    count = len(seen.whitened.r)
    gains = np.nan_to_num(seen.gains, nan=-np.inf)
    peak = int(np.argmax(gains.max(axis=0))) if gains.size else 0
    start = int(np.clip(peak - BEFORE, 0, max(count - STRETCH, 0)))
    stop = min(start + STRETCH, count)
    record, part = seen.record, seen.part
    stretch = Data(part.u, part.y, record.dt, record.inputs, record.outputs, start=part.start).window(start, stop)
    found = solve_registered("fault.membership", seen.dictionary.model, stretch, faults=seen.dictionary,
                             candidates=False, solver=seen.asked.solver)
    where = f"samples {start} to {stop - 1}"
    if not found.impossible:
        factor = f"{found.factor:.2f}" if np.isfinite(found.factor) else "unknown"
        note = f"No proof: within bounds of 3 standard deviations times {factor} a healthy plant is possible ({where})."
        return Ranking(certificate=Certificate("none", found.factor), note=note), False
    possible = set(found.consistent) | set(found.untested)
    ranking = ranked(seen, [e for e in singles(seen) if e.candidates[0].label in possible])
    vector = np.zeros(seen.whitened.r.shape)
    if found.parity_vector is not None:
        vector[start:stop] = found.parity_vector
    factor = found.proof.factor if found.proof else found.factor
    excluded = [label for label in seen.dictionary.labels if label not in possible]
    note = f"Proved on {where}; excluded by proof: {', '.join(excluded)}." if excluded else f"Proved on {where}."
    proof = Certificate("infeasible healthy", factor, ranking.odds, vector)
    return ranking._replace(certificate=proof, note=note), True
