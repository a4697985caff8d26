"""What broke at an actuator, offset, share of its effect or its motion: decided by likelihood, as in a diagnosis.

A broken actuator contributes (1 - gamma) f(u) + c. The candidates of one actuator explain much the same, so that they
count as one group: energies beyond thresholds decide between groups, and marginal likelihoods within a group. Those
of a carried fault follow from its estimate, which sharpens as long as it is carried.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.alternatives import EXACT
from optid.faults.diagnosis.posterior import marginal, smallest_set
from optid.faults.signatures import Candidate

SMALL = 0.2
"""A share lost is uniform up to one, or up to this: small losses are as likely, and told beside an offset until they
are excluded."""


def searched(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return candidates as a monitor searches for them: a loss may add any constant, unless its zero is stated.

    Where the stuck actuator is a candidate, too, that is the one with the constants.
    """
    wide = {c.name for c in candidates if c.has_constants}
    free = [c.fault_kind.loses and c.columns and c.zero is None and c.name not in wide for c in candidates]
    return tuple(replace(c, constants=True) if wider else c for c, wider in zip(candidates, free))


def groups_of(candidates: Sequence[Candidate]) -> tuple[int, ...]:
    """Return the number of the first candidate of the group of each."""
    first: dict[str, int] = {}
    return tuple(first.setdefault(c.name, i) if c.name.startswith("actuator:") and is_grouped(c) else i
                 for i, c in enumerate(candidates))


def is_grouped(candidate: Candidate) -> bool:
    """Whether the kind of a candidate is decided by likelihood."""
    return candidate.fault_kind.share is not None


def kinds(candidate: Candidate, sizes: Array, covariance: Array, listed: Sequence[Candidate]) -> dict[str, float]:
    """Return {label: logarithm of the marginal likelihood} of what an estimate may be, of those listed.

    The offset is the family with a share of zero, the stuck actuator that with a share of one (Savage-Dickey). The
    sizes (d,), the share lost first, have the covariance (d, d).
    """
    energy = float(sizes @ np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) @ sizes)
    if candidate.additive:
        return {candidate.label: float(marginal(np.array([energy]), sizes.size)[0])}
    share, variance = float(sizes[0]), max(float(covariance[0, 0]), EXACT)
    offset = float(marginal(np.array([energy - share**2 / variance]), sizes.size - 1)[0])
    lost = offset + share**2 / (2 * variance) + np.log(_lost(share, np.sqrt(variance)) + 1e-300)
    if not candidate.has_constants:
        return {candidate.label: lost}
    own = {c.label: c.fault_kind.share for c in listed if c.name == candidate.name}
    return {label: lost if np.isnan(fixed) else offset + (share**2 - (fixed - share) ** 2) / (2 * variance)
            for label, fixed in own.items() if fixed is not None}


def _lost(share: float, std: float) -> float:
    """Density of an estimated share over that at its peak, averaged over the shares that may be lost."""
    from scipy.special import ndtr

    inside = [float(ndtr((most - share) / std) - ndtr(-share / std)) / most for most in (1.0, SMALL)]
    return float(np.sqrt(2 * np.pi) * std * np.mean(inside))


def likelihoods(logs: dict[str, float]) -> dict[str, float]:
    """Return {label: likelihood} relative to the largest one, from their logarithms."""
    most = max(logs.values(), default=0.0)
    return {label: float(np.exp(log - most)) for label, log in logs.items()}


def likeliest(weights: dict[str, float], coverage: float = 0.95) -> tuple[tuple[str, float], ...]:
    """Return the smallest set of labels with this share of the weights, the most probable first."""
    labels, values = list(weights), np.array(list(weights.values()))
    values = values / values.sum()
    return tuple((labels[i], float(values[i])) for i in smallest_set(values, coverage))
