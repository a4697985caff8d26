"""The other ways to an answer: a group-sparse programme, alone or as a screen, and a proof by bounds of the noise."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optid.data.record import Data
from optid.errors import StructureError
from optid.faults.diagnosis.answers import Certificate
from optid.faults.diagnosis.explaining import FAR, Ranking, ranked, singles
from optid.faults.diagnosis.looking import Seen
from optid.faults.diagnosis.posterior import Explanation, several, single
from optid.faults.diagnosis.records import one_record
from optid.faults.search.sparse import SparseResult
from optid.faults.search.subsets import polish

if TYPE_CHECKING:
    from optid.faults.consistency.bounded_noise import Membership
    from optid.faults.diagnosis.diagnosing import Question

REACH = {1: 40, 2: 10, 3: 5, 4: 3}
"""Onsets on both sides of the best ones over which so many faults are summed."""

NEAR, NEAR_OF_MANY = 10, 4
"""Onsets on both sides of those of the programme that are searched exactly, for up to two faults and for more."""

STRETCH = 100
"""Samples of the stretch for which the noise is bounded: the proof for a part is one for the record."""

BEFORE = 25
"""Samples of it before the onset that explains most."""


class Way(NamedTuple):
    """What a method found.

    Attributes:
        ranking: the set of explanations.
        certificate: its proof.
        note: what is to be said of it.
    """

    ranking: Ranking
    certificate: Certificate
    note: str = ""


def _solved(name: str, solver: Any, *given: Any, **settings: Any) -> Any:
    from optid.registry import fault_formulation
    from optid.solving.solve import run

    return run(fault_formulation(name)(*given, **settings), solver).model


def by_programme(seen: Seen, asked: "Question") -> Way:
    """Let the group-sparse programme choose onsets, and candidates too where nothing is polished.

    Raises:
        StructureError: no candidate with a signature, too many subsets.
    """
    search, limits = seen.search, seen.limits
    if search is None or limits is None:
        raise StructureError(
            f"method={asked.method!r} needs a candidate with a signature: add the kind 'bias', or use method='exact'."
        )
    result: SparseResult | None = _solved("fault.signature", asked.solver, search, limits)
    if result is None:
        return Way(Ranking((), np.inf, False), Certificate("none", float("nan")), "The solver found no point.")
    chosen = _polished(seen, result, asked) if asked.method == "sparse+polish" else _clusters(seen, result, asked)
    explanations = singles(seen) if asked.method == "sparse+polish" else []
    ranking = ranked(seen, [*explanations, *chosen], asked.false_alarm, asked.coverage, False)
    if not result.certified:
        note = f"Not certified ({result.status}; relative gap {result.gap:.1e}): no answer is called the best."
        return Way(ranking, Certificate("none", result.gap, ranking.odds), note)
    return Way(ranking, Certificate("duality gap", result.gap, ranking.odds))


def _polished(seen: Seen, result: SparseResult, asked: "Question") -> list[Explanation]:
    assert seen.search is not None and seen.limits is not None
    reach = NEAR if asked.max_faults < 3 else NEAR_OF_MANY
    found = polish(seen.search, seen.limits, result, max_faults=asked.max_faults, reach=reach)
    near = [s for s in found.ranked if s.gain > found.ranked[0].gain - FAR and len(s.labels) > 1]
    lost = set(seen.lost)
    return [_around(seen, s.labels, s.onsets) for s in near if not lost & set(s.labels)]


def _clusters(seen: Seen, result: SparseResult, asked: "Question") -> list[Explanation]:
    """The strongest group of every cluster, estimated again without the penalty."""
    strongest = []
    for first, last in result.clusters:
        here = [g for g in result.active if first <= g.onset <= last and g.label not in seen.lost]
        strongest += [max(here, key=lambda g: g.deflection)] if here else []
    strongest = sorted(strongest, key=lambda g: -g.deflection)[: asked.max_faults]
    if not strongest:
        return []
    return [_around(seen, tuple(g.label for g in strongest), tuple(g.onset for g in strongest))]


def _around(seen: Seen, labels: tuple[str, ...], onsets: tuple[int, ...]) -> Explanation:
    assert seen.search is not None
    candidates = [seen.dictionary[label] for label in labels]
    if len(candidates) == 1:
        alone = single(seen.search, candidates[0])
        if alone is not None:
            return alone
    return several(seen.search, candidates, onsets, REACH.get(len(labels), 2))


def by_bounds(record: Data, seen: Seen, asked: "Question") -> "tuple[Way, bool]":
    """Prove by bounds of the noise that the plant is not healthy, and name what is not excluded.

    Args:
        record: that the experiment belongs to.
        seen: the experiment.
        asked: what is asked.

    Returns:
        What was found, and whether it is proved that the plant is not healthy.
    """
    count = len(seen.whitened.r)
    gains = np.nan_to_num(seen.gains, nan=-np.inf)
    peak = int(np.argmax(gains.max(axis=0))) if gains.size else 0
    start = int(np.clip(peak - BEFORE, 0, max(count - STRETCH, 0)))
    stop = min(start + STRETCH, count)
    part = one_record(record, seen.part).window(start, stop)
    found: Membership = _solved("fault.membership", asked.solver, seen.dictionary.model, part, faults=seen.dictionary,
                                candidates=False)
    vector = np.zeros(seen.whitened.r.shape)
    if found.parity_vector is not None:
        vector[start:stop] = found.parity_vector
    where = f"samples {start} to {stop - 1}"
    if not found.impossible:
        factor = f"{found.factor:.2f}" if np.isfinite(found.factor) else "unknown"
        note = f"No proof: within bounds of 3 standard deviations times {factor} a healthy plant is possible ({where})."
        return Way(Ranking((), np.inf, True), Certificate("none", found.factor), note), False
    possible = set(found.consistent) | set(found.untested)
    left = [e for e in singles(seen) if e.candidates[0].label in possible]
    ranking = ranked(seen, left, asked.false_alarm, asked.coverage, True)
    proof = Certificate("infeasible healthy", found.proof.factor if found.proof else found.factor, ranking.odds, vector)
    excluded = [label for label in seen.dictionary.labels if label not in possible]
    note = f"Proved on {where}; excluded by proof: {', '.join(excluded)}." if excluded else f"Proved on {where}."
    return Way(ranking, proof, note), True
