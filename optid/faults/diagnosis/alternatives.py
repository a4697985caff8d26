"""Explanations beside those of the dictionary.

A broken actuator contributes (1 - gamma) f(u) + c. It is *stuck* where gamma = 1, and has *lost* a share where
0 < gamma < 1; c is free unless the input without effect is known, because an identified f is known up to a constant
only. The probability of gamma = 1 relative to all other shares (Savage-Dickey ratio) decides between them.

A constant disturbance of unknown direction in the state equation, a leak, is no entry of the dictionary, nor is one
that drifts. It competes with all entries: a fault has to explain the record as well as the best direction does, given
its number of magnitudes. What an actuator adds to the states alone, a leak at the same place does, too: no record
isolates them, and the leak has the prior of what is not listed. Where directions of the process are declared, the leaks
are among them: then neither one that drifts nor one beside an actuator is added.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.posterior import Explanation, share_bound, share_prior
from optid.faults.signatures import Candidate, Dictionary, candidate_of
from optid.models import HammersteinSS

UNLISTED = 0.1  # prior of a fault outside the dictionary, relative to one inside
LEAK = "bias"  # kind of the disturbance of unknown direction that always competes
UNKNOWN_DIRECTION = "process"  # name of a disturbance whose direction is estimated

INTEGRATES = 1e10
"""Condition number above which the plant integrates: a constant disturbance has no steady-state effect."""

EXACT = 1e-12  # variance of a share lost that is known


def with_unlisted_candidates(found: Dictionary) -> Dictionary | None:
    """Return the candidates beside those of a dictionary; None for none.

    They are actuators with a loss without a stated zero and without a stuck candidate, and, where "none of these" is a
    possible answer, the disturbance of unknown direction.
    """
    wide = {c.name for c in found.candidates if c.has_constants}
    more = [family_of(c) for c in found.candidates if family_of(c) is not c and c.name not in wide]
    known = found.model.l > 1 or any(not c.fault_kind.waveform for c in found.candidates)
    if found.unknown and known and all(c.name != UNKNOWN_DIRECTION for c in found.candidates):
        listed = {} if declares_process(found) else {c.kind: None for c in found.candidates if c.fault_kind.leaks}
        more += [candidate_of(found.model, UNKNOWN_DIRECTION, kind) for kind in dict.fromkeys([LEAK, *listed])]
    sines = np.full((len(more), len(more)), np.nan)
    return replace(found, candidates=tuple(more), excluded={}, sines=sines) if more else None


def family_of(candidate: Candidate) -> Candidate:
    """Return an actuator with a loss of unstated zero as one to which any constant is added; others unchanged."""
    if not (candidate.fault_kind.loses and candidate.columns) or candidate.zero is not None or candidate.has_constants:
        return candidate
    family = candidate.widened
    return replace(family, members=(family.own_label,))


def declares_process(found: Dictionary) -> bool:
    """Whether a dictionary has directions of the process."""
    return any(c.name.startswith(f"{UNKNOWN_DIRECTION}:") for c in found.candidates)


def same_at_process(found: Explanation) -> list[Explanation]:
    """Return the disturbance of the process that has the same effect as an actuator; none for other explanations."""
    (c,) = found.candidates
    if not c.fault_kind.leaks or not c.name.startswith("actuator:") or c.into_output.any():
        return []
    label = c.fault_kind.own_label(UNKNOWN_DIRECTION)
    other = replace(c, name=UNKNOWN_DIRECTION, members=(label,), places=(UNKNOWN_DIRECTION,))
    return [found._replace(logs=found.logs + np.log(UNLISTED), candidates=(other,), entries=found.entries or (c,))]


def split_by_kind(found: Explanation, listed: Sequence[Candidate]) -> list[Explanation]:
    """Return a broken actuator as a stuck one and as one that lost a share, of the listed kinds; others unchanged.

    Of several faults every broken actuator is taken apart, in all combinations.
    """
    family = found.candidates[0]
    alone = len(found.candidates) == 1 and family.fault_kind.loses
    if alone and family.columns and not family.has_constants:
        return [found._replace(logs=np.logaddexp(found.logs, _all_lost(found, 0)) - np.log(2))]
    result, first = [found], 0
    for number, family in enumerate(found.candidates):
        if family.has_constants:
            result = [part for one in result for part in _kinds(one, number, first, listed)]
        first += family.dimension
    return result


def _kinds(found: Explanation, number: int, first: int, listed: Sequence[Candidate]) -> list[Explanation]:
    """Return the kinds of a broken actuator, one of the candidates, whose share is the magnitude `first`."""
    family, entries = found.candidates[number], found.entries or found.candidates
    result = []
    for c in sorted(listed, key=lambda c: not c.has_constants):
        if c.name != family.name or not c.fault_kind.loses:
            continue
        if c.has_constants:
            result.append(_stuck(found, first)._replace(entries=entries))
        elif c.zero is None:
            lost = replace(family, kind=c.kind, constants=True, members=(c.own_label,))
            candidates = (*found.candidates[:number], lost, *found.candidates[number + 1 :])
            result.append(found._replace(candidates=candidates, entries=entries))
    return result


def _all_lost(found: Explanation, first: int) -> Array:
    """Logarithm (K,) of the marginal likelihood with a share fixed to one."""
    share, variance = found.sizes[:, first], np.maximum(found.covariances[:, first, first], EXACT)
    free = found.logs - np.log(share_bound(share, variance))
    density = np.sqrt(2 * np.pi * variance) * share_prior(np.sqrt(variance))
    return free - (1 - share) ** 2 / (2 * variance) - np.log(density)


def _stuck(found: Explanation, first: int) -> Explanation:
    """The explanation with a share fixed to one, and the other magnitudes conditional on it."""
    share, variance = found.sizes[:, first], np.maximum(found.covariances[:, first, first], EXACT)
    slope = found.covariances[:, :, first] / variance[:, None]
    slope[:, first] = 1.0
    covariances = found.covariances - np.einsum(
        "ki,kj,k->kij", slope, slope, found.covariances[:, first, first])
    each = np.arange(covariances.shape[1])  # a magnitude that the share determines has no variance, but for rounding
    covariances[:, each, each] = np.maximum(covariances[:, each, each], EXACT * found.covariances[:, each, each])
    covariances[:, first, first] = EXACT
    return found._replace(
        logs=_all_lost(found, first), sizes=found.sizes + slope * (1 - share)[:, None], covariances=covariances,
        energies=found.energies - (1 - share) ** 2 / variance,
    )


def final_effect(model: HammersteinSS, name: str, size: Array) -> dict[str, float]:
    """Return the steady-state effect on every output of a constant disturbance of estimated direction (n,).

    It is empty for other faults and for unknown sizes.
    """
    A = np.eye(model.nx) - model.A - model.L @ model.C
    if name != UNKNOWN_DIRECTION or size.shape != (model.nx,) or np.linalg.cond(A) > INTEGRATES:
        return {}
    return dict(zip(model.outputs, (model.C @ np.linalg.solve(A, size)).tolist()))
