"""The gain of an innovation form from what the known signals leave of the outputs: ``r = C x + e, x+ = A x + K e``.

The determinant of the covariance of the innovations is minimised over K, with the initial state of every experiment
eliminated (maximum likelihood of Gaussian noise).
"""

from collections.abc import Sequence

import numpy as np

from optid.bases.basis import Array
from optid.errors import StructureError
from optid.models.kalman import kalman_gain
from optid.models.roots import spectral_radius

STEPS = 50
"""Steps at most."""

ARRIVED = 1e-4
"""Gain of the log-likelihood still to be expected at which a search ends; half a unit is one standard error."""


def refined(A: Array, C: Array, gain: Array, rest: Sequence[Array], damping: float = 1e-4) -> tuple[Array, Array]:
    """Minimise the determinant of the covariance of the innovations by Levenberg-Marquardt steps.

    A step that makes the predictor unstable is replaced by the stable gain of the same spectrum.

    Args:
        A: (n, n).
        C: (l, n).
        gain: (n, l) start.
        rest: (N, l) what the known signals leave of the outputs, one array per experiment; NaN = missing.
        damping: of the first step, relative to the diagonal of the normal equations.

    Returns:
        The gain and the covariance (l, l) of its innovations.
    """
    best, before = innovations_covariance(A, C, gain, rest), 0.0
    for _ in range(STEPS):
        normal, right = _equations(A, C, gain, rest, best)
        promised, descends = np.inf, False
        while not descends and promised > ARRIVED:
            step = _solved(normal + damping * np.diag(np.diag(normal)), right)
            promised = 0.5 * float(right @ step)
            trial = _stable(A, C, gain + step.reshape(gain.shape[::-1]).T, best)
            covariance = innovations_covariance(A, C, trial, rest)
            descends = log_determinant(covariance) < log_determinant(best)
            damping *= 0.1 if descends else 10.0
        if not descends:
            break
        gain, best = trial, covariance
        if promised * (promised / before if before else 1.0) < ARRIVED:  # steps shrink at a rate or faster
            break
        before = promised
    return gain, best


def innovations_covariance(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> Array:
    """Covariance (l, l) of the innovations under a gain."""
    return covariance_of(whitened(A, C, gain, rest))


def whitened(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> list[Array]:
    """Innovations (N, l) of every experiment under a gain, with the initial state that fits best."""
    from optid.models.innovation_kernels import innovate

    F = A - gain @ C
    return [innovate(F, C, gain, r, x0) for r, x0 in zip(rest, _initial(F, C, gain, rest))]


def covariance_of(signals: Sequence[Array]) -> Array:
    """Mean of s(k) s(k)' over the samples that are present, pair by pair of outputs, (l, l)."""
    count = signals[0].shape[1]
    sums, pairs = np.zeros((count, count)), np.zeros((count, count))
    for s in signals:
        products, present = s.T @ s, np.full((count, count), float(len(s)))
        if np.isnan(products).any():
            here = ~np.isnan(s)
            filled, here = np.where(here, s, 0.0), here.astype(float)
            products, present = filled.T @ filled, here.T @ here
        sums += products
        pairs += present
    found = sums / np.maximum(pairs, 1.0)
    return (found + found.T) / 2


def log_determinant(covariance: Array) -> float:
    """Logarithm of the determinant, ``-inf`` where it is not positive."""
    sign, value = np.linalg.slogdet(covariance)
    return float(value) if sign > 0 else -np.inf


def _stable(A: Array, C: Array, gain: Array, covariance: Array) -> Array:
    """Return the gain of the same spectrum that makes A - K C stable."""
    if spectral_radius(A - gain @ C) < 1:
        return gain
    try:
        level = covariance + 1e-12 * np.trace(covariance) * np.eye(len(C))
        return np.array(kalman_gain(A, C, gain @ level @ gain.T, level, gain @ level).K)
    except (StructureError, ValueError):  # zeros on the unit circle
        return np.zeros_like(gain)


def _initial(F: Array, C: Array, gain: Array, rest: Sequence[Array]) -> list[Array]:
    """Initial states (n,) that minimise the squared innovations, which are affine in them."""
    from optid.models.innovation_kernels import innovation_moments

    weight = np.diag(1 / np.sqrt(np.maximum(np.diag(covariance_of(rest)), np.finfo(float).tiny)))
    found = []
    for r in rest:
        settled = r[: _settling(F, len(r))]
        normal, right = innovation_moments(F, C, gain, settled, np.zeros(len(F)), weight)
        part = normal[gain.size :, gain.size :]
        found.append(_solved(part, right[gain.size :]))
    return found


def _settling(F: Array, count: int) -> int:
    """Samples after which the initial state is forgotten."""
    radius = spectral_radius(F)
    return count if radius > 0.99 else min(count, len(F) + 10 + int(np.log(1e-10) / np.log(max(radius, 0.1))))


def _equations(A: Array, C: Array, gain: Array, rest: Sequence[Array], covariance: Array) -> tuple[Array, Array]:
    """Normal equations of a step in the gain (column by column), the innovations in units of their covariance.

    The initial states are eliminated.
    """
    from optid.models.innovation_kernels import innovation_moments

    values, vectors = np.linalg.eigh(covariance)
    weight = (vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))).T
    F, size = A - gain @ C, gain.size
    normal, right = np.zeros((size, size)), np.zeros(size)
    for r, x0 in zip(rest, _initial(F, C, gain, rest)):
        information, pull = innovation_moments(F, C, gain, r, x0, weight)
        cross = information[size:, :size]
        both = _solved(information[size:, size:], np.column_stack([cross, pull[size:]]))
        normal += information[:size, :size] - cross.T @ both[:, :-1]
        right += pull[:size] - cross.T @ both[:, -1]
    return normal, right


def _solved(matrix: Array, right: Array) -> Array:
    """Solve a symmetric system; directions without information stay at zero."""
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    inverse = np.where(values > 1e-12 * max(values[-1], 1e-300), 1 / np.where(values == 0, 1.0, values), 0.0)
    return (vectors * inverse) @ (vectors.T @ (right.T / scale).T) / (scale if right.ndim == 1 else scale[:, None])
