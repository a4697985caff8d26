"""The gain of an innovation form from what the known signals leave of the outputs: ``r = C x + e, x+ = A x + K e``.

The determinant of the covariance of the innovations is minimised over K, with the initial state of every experiment
eliminated (maximum likelihood of Gaussian noise). Near an optimum with known information, such as that of a part of a
long record, a step costs two runs through the record: forth for the innovations and back for the slope of the
likelihood (Fisher scoring).
"""

from collections.abc import Sequence

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.kalman import kalman_gain
from optid.models.roots import spectral_radius

STEPS = 50
"""Steps at most."""

FIRM = 0.01
"""Damping at least, relative to the diagonal of the information, where a step gained little of what it promised."""

ARRIVED = 2e-5
"""Gain of the log-likelihood of no account; half a unit is one standard error of a parameter."""


def refined(A: Array, C: Array, gain: Array, rest: Sequence[Array], known: Array | None = None,
            arrived: float = ARRIVED) -> tuple[Array, Array]:
    """Minimise the determinant of the covariance of the innovations by Levenberg-Marquardt steps.

    A step that makes the predictor unstable is replaced by the stable gain of the same spectrum.

    Args:
        A: (n, n).
        C: (l, n).
        gain: (n, l) start.
        rest: (N, l) what the known signals leave of the outputs, one array per experiment; NaN = missing.
        known: (n l, n l) the information about the gain (column by column) to be used at every step, near an optimum.
        arrived: gain of the log-likelihood still to be expected at which the search ends.

    Returns:
        The gain and the covariance (l, l) of its innovations.
    """
    errors = whitened(A, C, gain, rest)
    best, damping, before = covariance_of(errors), 1e-4, 0.0
    half = sum(np.count_nonzero(~np.isnan(r)) for r in rest) / (2 * len(C))
    for _ in range(STEPS):
        if known is None:
            normal, right = _equations(A, C, gain, rest, best)
        else:
            normal, right = known, _slope(A, C, gain, errors)
        promised, gained = np.inf, 0.0
        while not gained > 0 and promised > arrived:
            step = _solved(normal + damping * np.diag(np.diag(normal)), right)
            promised = 0.5 * float(right @ step)
            trial = _stable(A, C, gain + step.reshape(gain.shape[::-1]).T, best)
            errors = whitened(A, C, trial, rest, best)
            covariance = covariance_of(errors)
            gained = half * (log_determinant(best) - log_determinant(covariance))
            if gained > 0.75 * promised:
                damping *= 0.1
            elif not gained > 0.25 * promised:
                damping = max(10 * damping, FIRM)
        if not gained > 0:
            break
        gain, best = trial, covariance
        rate = promised / before if before and damping < FIRM else 1.0  # undamped steps shrink at a rate, or faster
        if promised * rate < arrived:
            break
        before = promised
    return gain, best


def information(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> Array:
    """Mean information (n l, n l) of a sample about the gain (column by column), initial states unknown."""
    normal, _ = _equations(A, C, gain, rest, innovations_covariance(A, C, gain, rest))
    return normal / sum(map(len, rest))


def innovations_covariance(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> Array:
    """Covariance (l, l) of the innovations under a gain."""
    return covariance_of(whitened(A, C, gain, rest))


def whitened(A: Array, C: Array, gain: Array, rest: Sequence[Array], covariance: Array | None = None) -> list[Array]:
    """Innovations (N, l) of every experiment under a gain, with the initial state that fits best, see `_initial`."""
    from optid.models.innovation_kernels import innovate

    F, C, gain = _predictor(A, C, gain)
    rest = [np.ascontiguousarray(r) for r in rest]
    return [innovate(F, C, gain, r, x0) for r, x0 in zip(rest, _initial(F, C, gain, rest, covariance))]


def covariance_of(signals: Sequence[Array]) -> Array:
    """Mean of s(k) s(k)' over the samples that are present, pair by pair of outputs, (l, l), positive semidefinite.

    Means over different samples may contradict each other where outputs are nearly collinear. There the products are
    divided by the geometric mean of the counts of the two outputs, which keeps the variances and is semidefinite.
    """
    sums, pairs = _products(signals)
    found = sums / np.maximum(pairs, 1.0)
    found = (found + found.T) / 2
    values = np.linalg.eigvalsh(found)
    if values[0] < -1e-12 * abs(values[-1]):
        own = np.sqrt(np.maximum(np.diag(pairs), 1.0))
        found = (sums + sums.T) / 2 / np.outer(own, own)
    return found


def _products(signals: Sequence[Array]) -> tuple[Array, Array]:
    """Sum of s(k) s(k)' over the samples at which both outputs are present, and the number of them, (l, l) each."""
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
    return sums, pairs


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


def _initial(F: Array, C: Array, gain: Array, rest: Sequence[Array], covariance: Array | None = None) -> list[Array]:
    """Initial states (n,) that minimise the squared innovations, which are affine in them.

    The innovations are in units of a covariance (l, l); without one every output counts by the size of its residuals.
    """
    from optid.models.innovation_kernels import innovation_moments

    if covariance is None:
        covariance = np.diag(np.maximum(np.diag(covariance_of(rest)), np.finfo(float).tiny))
    weight = _whitening(covariance)
    settled, found = _settling(F), []
    for r in rest:
        part = np.ascontiguousarray(r[:settled])
        normal, right = innovation_moments(F, C, gain, part, np.zeros(len(F)), weight)
        found.append(_solved(normal[gain.size :, gain.size :], right[gain.size :]))
    return found


def _predictor(A: Array, C: Array, gain: Array) -> tuple[Array, Array, Array]:
    """Return A - K C, C and K as the kernels read them."""
    return np.ascontiguousarray(A - gain @ C), np.ascontiguousarray(C), np.ascontiguousarray(gain)


def _whitening(covariance: Array) -> Array:
    """Matrix (l, l) that turns innovations of a covariance into white ones."""
    values, vectors = np.linalg.eigh(covariance)
    return np.ascontiguousarray((vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))).T)


def _settling(F: Array) -> int | None:
    """Samples after which the initial state is forgotten; None for never."""
    radius = spectral_radius(F)
    return None if radius >= 1 else len(F) + 10 + int(np.log(1e-10) / np.log(max(radius, 0.1)))


def _slope(A: Array, C: Array, gain: Array, errors: Sequence[Array]) -> Array:
    """Slope (n l,) of the log-likelihood by the gain (column by column) at its innovations."""
    from optid.models.innovation_kernels import innovation_slope

    sums, pairs = _products(errors)
    root, (F, C, gain) = _whitening(sums / np.maximum(pairs, 1.0)), _predictor(A, C, gain)
    weight = root.T @ root * np.mean(np.diag(pairs)) / np.maximum(pairs, 1.0)
    return np.sum([innovation_slope(F, C, gain, e, weight) for e in errors], axis=0).T.ravel()


def _equations(A: Array, C: Array, gain: Array, rest: Sequence[Array], covariance: Array) -> tuple[Array, Array]:
    """Normal equations of a step in the gain (column by column), the innovations in units of their covariance.

    The initial states are eliminated.
    """
    from optid.models.innovation_kernels import innovation_moments

    weight, (F, C, gain), size = _whitening(covariance), _predictor(A, C, gain), gain.size
    normal, right = np.zeros((size, size)), np.zeros(size)
    for r, x0 in zip(rest, _initial(F, C, gain, rest)):
        information, pull = innovation_moments(F, C, gain, np.ascontiguousarray(r), x0, weight)
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
