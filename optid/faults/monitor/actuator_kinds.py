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

GROUPED = "bias", "loss", "stuck"
"""Kinds of an actuator that are decided by likelihood."""

SMALL = 0.2
"""A share lost is uniform up to one, or up to this: small losses are as likely, and told beside an offset until they
are excluded."""


def searched(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return candidates as a monitor searches for them: a loss may add any constant, unless its zero is stated.

    Where the stuck actuator is a candidate, too, that is the one with the constants.
    """
    stuck = {c.name for c in candidates if c.kind == "stuck"}
    return tuple(replace(c, constants=True) if c.kind == "loss" and c.columns and c.zero is None and c.name not in stuck
                 else c for c in candidates)


def groups_of(candidates: Sequence[Candidate]) -> tuple[int, ...]:
    """Return the number of the first candidate of the group of each."""
    first: dict[str, int] = {}
    return tuple(first.setdefault(c.name, i) if c.name.startswith("actuator:") and is_grouped(c) else i
                 for i, c in enumerate(candidates))


def is_grouped(candidate: Candidate) -> bool:
    """Whether the kind of a candidate is decided by likelihood."""
    return candidate.kind in GROUPED


def kinds(candidate: Candidate, sizes: Array, covariance: Array, listed: Sequence[Candidate]) -> dict[str, float]:
    """Return {label: logarithm of the marginal likelihood} of what an estimate may be.

    The offset is the family with a share of zero, the stuck actuator that with a share of one (Savage-Dickey).

    Args:
        candidate: with the estimate.
        sizes: (d,) its magnitudes, the share lost first.
        covariance: (d, d) of the sizes.
        listed: the candidates of the dictionary.
    """
    energy = float(sizes @ np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) @ sizes)
    if candidate.additive:
        return {candidate.label: float(marginal(np.array([energy]), sizes.size)[0])}
    share, variance = float(sizes[0]), max(float(covariance[0, 0]), EXACT)
    offset = float(marginal(np.array([energy - share**2 / variance]), sizes.size - 1)[0])
    own = {c.kind: c.label for c in listed if c.name == candidate.name and c.kind in GROUPED}
    evidence = {
        "bias": offset, "stuck": offset + (share**2 - (1 - share) ** 2) / (2 * variance),
        "loss": offset + share**2 / (2 * variance) + np.log(_lost(share, np.sqrt(variance)) + 1e-300),
    }
    if not has_constants(candidate):
        return {candidate.label: evidence["loss"]}
    return {label: evidence[kind] for kind, label in own.items()}


def _lost(share: float, std: float) -> float:
    """Density of an estimated share over that at its peak, averaged over the shares that may be lost."""
    from scipy.special import ndtr

    inside = [float(ndtr((most - share) / std) - ndtr(-share / std)) / most for most in (1.0, SMALL)]
    return float(np.sqrt(2 * np.pi) * std * np.mean(inside))


def has_constants(candidate: Candidate) -> bool:
    """Whether a candidate has a share lost and constants."""
    return candidate.kind == "stuck" or candidate.constants


def likeliest(weights: dict[str, float], coverage: float = 0.95) -> tuple[tuple[str, float], ...]:
    """Return the smallest set of labels with this share of the weights, the most probable first."""
    labels, values = list(weights), np.array(list(weights.values()))
    values = values / values.sum()
    return tuple((labels[i], float(values[i])) for i in smallest_set(values, coverage))
