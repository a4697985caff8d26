"""Noise statistics of a state-space model: gain of the innovations, covariances, spectrum, colour.

With A and C known, what the inputs and the measured feedback do not explain is ``r = (I + C (qI - A)^-1 K) e``. The
gain K and the covariance of the innovations e minimise the prediction errors (Levenberg-Marquardt, the initial states
eliminated, started from several observers and from long autoregressions of their errors: Hannan and Rissanen 1982). The
covariances reported are those of the residuals of the state and the output equation along the states of that predictor,
``w = K e`` and ``v = e``: Q = K Re K', S = K Re, R = Re (Van Overschee and De Moor, Subspace Identification for Linear
Systems, 1996, chapter 3). They are positive semidefinite and belong to K by construction. Q, R and S are not unique:
every process and measurement noise with the same spectrum gives the same outputs. What the data determine is the
spectrum, hence K and Re.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.bases.basis import Array
from optid.channels import Transform
from optid.data import Data
from optid.errors import StructureError
from optid.models.kalman import kalman_gain
from optid.models.noise_covariances import NoiseCovariances
from optid.stretches import between_gaps
from optid.subspace.innovations import innovation_form
from optid.validation.correlations import Correlation, autocorrelation
from optid.validation.predictions import one_step

if TYPE_CHECKING:
    from optid.models.hammerstein_ss import HammersteinSS

ROUNDING = 1e-10
"""Residuals below this share of the outputs are rounding: there is no noise to describe."""

NEARLY_MARGINAL = 1 - 1e-4
"""Poles beyond this radius need an observer: without it the residuals would not settle within a record."""

STEPS, TOLERANCE, LARGEST = 50, 1e-10, 1e8

RATIOS = (1e-2, 1.0, 1e2)
"""Process over measurement noise of the observers behind the starts, in units of C."""

TRIED = 2
"""Starts that are refined, the best of all."""


class Noise(NamedTuple):
    """The noise model of a state-space model.

    Attributes:
        K: (n, l) gain of the innovations; A - K C is stable.
        covariances: Q, R, S and the covariance of the innovations.
    """

    K: Array
    covariances: NoiseCovariances


def with_noise(model: "HammersteinSS", data: Data) -> "HammersteinSS":
    """Return the model with the gain and the noise covariances that a record shows, see `estimate_noise`."""
    found = estimate_noise(model, data)
    return replace(model, K=found.K, noise=found.covariances)


def estimate_noise(model: "HammersteinSS", data: Data) -> Noise:
    """Estimate the noise model from what A, B, C, D, E and L leave unexplained.

    Args:
        model: the model; its K and noise do not matter.
        data: the record, in the units of the model (a transform is not undone: a formulation calls this before the
            model returns to raw units). Samples may be missing.

    Raises:
        DataError: other channels than the model's, or no stretch long enough without a missing input.
        StructureError: a pole on or outside the unit circle that the outputs do not see.
    """
    observer = _observer(model)
    data, _ = between_gaps(_as_it_is(data), 2 * model.nx + 1)
    rest = residuals(replace(model, K=observer, noise=None), data)
    level = float(np.nanmax(np.abs(np.vstack([e.y for e in data.experiments])), initial=0.0))
    if not np.nanmax(np.abs(np.vstack(rest)), initial=0.0) > ROUNDING * level:
        return Noise(observer, _innovation_form(observer, _covariance(rest)))
    A = model.A - observer @ model.C
    found = [_refined(A, model.C, gain, rest) for gain in _starts(A, model.C, rest)[:TRIED]]
    gain, covariance = min(found, key=lambda pair: _logdet(pair[1]))
    return Noise(observer + gain, _innovation_form(observer + gain, covariance))


def residuals(model: "HammersteinSS", data: Data) -> list[Array]:
    """Return the one-step prediction errors (N, l) of every experiment in the units of the model, NaN = missing."""
    data = _as_it_is(data)
    return [e.y - p for e, p in zip(data.experiments, one_step(model, data))]


def noise_spectrum(model: "HammersteinSS", w: ArrayLike) -> Array:
    """Return the spectral density of the noise at the outputs, H Re H* with H = I + C (zI - A)^-1 K.

    Args:
        model: a model with noise covariances.
        w: (F,) frequencies in radians per unit of time, up to pi / dt.

    Returns:
        (F, l, l) complex, Hermitian; its mean over (-pi/dt, pi/dt) is the covariance of the noise at the outputs.

    Raises:
        StructureError: the model has no noise covariances.
    """
    if model.noise is None:
        raise StructureError("the model has no noise covariances; optid.noise.with_noise(model, data) estimates them")
    z = np.exp(1j * np.atleast_1d(np.asarray(w, dtype=float)) * model.dt)
    states = np.linalg.solve(z[:, None, None] * np.eye(model.nx) - model.A, model.K.astype(complex))
    shaped = np.eye(model.l) + model.C @ states
    return np.asarray(shaped @ model.noise.innovation @ np.conj(np.swapaxes(shaped, 1, 2)))


def colour(model: "HammersteinSS", data: Data, lags: int = 25) -> dict[str, Correlation]:
    """Test the noise at every output for whiteness: of the simulation with measured feedback, without correction.

    Args:
        model: the model.
        data: the record, in raw units or with the transform to them.
        lags: largest lag.

    Returns:
        {output: test}; one that fails says that the noise of that output is coloured.
    """
    raw = data.raw()
    rest = residuals(replace(model, K=_observer(model), noise=None), raw)
    lags = max(1, min(lags, int(np.sum(~np.isnan(np.vstack(rest)), axis=0).min()) // 4))
    return {name: autocorrelation([r[:, o] for r in rest], name, lags) for o, name in enumerate(model.outputs)}


def output_noise(model: "HammersteinSS") -> Array:
    """Return the covariance (l, l) of the noise at the outputs, process and measurement noise together.

    It is the mean of the spectrum; infinite where a pole on or outside the unit circle is driven by the noise.

    Raises:
        StructureError: the model has no noise covariances.
    """
    from scipy.linalg import solve_discrete_lyapunov

    if model.noise is None:
        raise StructureError("the model has no noise covariances; optid.noise.with_noise(model, data) estimates them")
    if not model.K.any():
        return np.array(model.noise.innovation)
    if not model.is_stable:
        return np.full((model.l, model.l), np.inf)
    states = solve_discrete_lyapunov(model.A, model.K @ model.noise.innovation @ model.K.T)
    return np.asarray(model.C @ states @ model.C.T + model.noise.innovation)


def _starts(A: Array, C: Array, rest: Sequence[Array]) -> list[Array]:
    """Gains to start from, the most promising first: of several observers, and from the whitening of their errors.

    The observers are those of equal noise in all states and equal noise at all outputs.
    """
    size = np.linalg.norm(C, axis=1)
    unit, observers = np.diag(np.where(size > 0, size, 1.0) ** 2), [np.zeros((len(A), len(C)))]
    for ratio in RATIOS:
        try:
            observers.append(np.array(kalman_gain(A, C, ratio * np.eye(len(A)), unit).K))
        except StructureError:
            continue
    found = list(observers)
    for gain in observers:
        errors = _whitened(A, C, gain, rest)
        whole = [part for e in errors for part in _complete(e)]
        try:
            found.append(np.array(innovation_form(A, C, gain, whole)[0]))
        except (StructureError, ValueError):  # too few in a row, or a zero on the unit circle
            continue
    return sorted(found, key=lambda gain: _logdet(_innovations(A, C, gain, rest)))


def _complete(errors: Array) -> list[Array]:
    """Cut (N, l) into stretches without missing samples."""
    present = ~np.isnan(errors).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(np.int8)))
    return [errors[start:stop] for start, stop in edges.reshape(-1, 2)]


def _observer(model: "HammersteinSS") -> Array:
    """Zero for a stable model; for others a gain that stabilises A - K C, so that the residuals are stationary."""
    if np.max(np.abs(model.poles), initial=0.0) < NEARLY_MARGINAL:
        return np.zeros((model.nx, model.l))
    size = np.linalg.norm(model.C, axis=1)
    unit = np.diag(np.where(size > 0, size, 1.0) ** 2)
    return np.array(kalman_gain(model.A, model.C, 0.1 * np.eye(model.nx), unit).K)


def _as_it_is(data: Data) -> Data:
    """Return the same samples without the way back to raw units."""
    if data.transform.is_identity:
        return data
    return data.mapped(lambda u: u, lambda y: y, transform=Transform.identity(data.m, data.l))


def _innovation_form(gain: Array, covariance: Array) -> NoiseCovariances:
    cross = gain @ covariance
    process = cross @ gain.T
    return NoiseCovariances((process + process.T) / 2, covariance, cross, covariance)


def _covariance(signals: Sequence[Array], lag: int = 0) -> Array:
    """Mean of s(k) s(k - lag)' over the pairs that are present, (l, l)."""
    count = signals[0].shape[1]
    sums, pairs = np.zeros((count, count)), np.zeros((count, count))
    for s in signals:
        here = ~np.isnan(s)
        filled = np.where(here, s, 0.0)
        if len(s) > lag:
            sums += filled[lag:].T @ filled[: len(s) - lag]
            pairs += here[lag:].T.astype(float) @ here[: len(s) - lag].astype(float)
    found = sums / np.maximum(pairs, 1.0)
    return (found + found.T) / 2 if lag == 0 else found


def _stable(A: Array, C: Array, gain: Array, covariance: Array) -> Array:
    """Return the gain of the same spectrum that makes A - K C stable."""
    if _radius(A - gain @ C) < 1:
        return gain
    try:
        level = covariance + 1e-12 * np.trace(covariance) * np.eye(len(C))
        return np.array(kalman_gain(A, C, gain @ level @ gain.T, level, gain @ level).K)
    except (StructureError, ValueError):  # zeros on the unit circle
        return np.zeros_like(gain)


def _refined(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> tuple[Array, Array]:
    """Minimise the determinant of the covariance of the innovations by Levenberg-Marquardt steps.

    A step that makes the predictor unstable is replaced by the stable gain of the same spectrum.
    """
    best, damping = _innovations(A, C, gain, rest), 1e-4
    for _ in range(STEPS):
        normal, right = _equations(A, C, gain, rest, best)
        found, trial = None, gain
        while damping < LARGEST and found is None:
            step = _solved(normal + damping * np.diag(np.diag(normal)), right).reshape(gain.shape[::-1]).T
            trial = _stable(A, C, gain + step, best)
            covariance = _innovations(A, C, trial, rest)
            if _logdet(covariance) < _logdet(best):
                found = covariance
            damping *= 0.1 if found is not None else 10.0
        if found is None:
            break
        gained = _logdet(best) - _logdet(found)
        gain, best = trial, found
        if gained < TOLERANCE:
            break
    return gain, best


def _innovations(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> Array:
    """Covariance (l, l) of the innovations under a gain."""
    return _covariance(_whitened(A, C, gain, rest))


def _whitened(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> list[Array]:
    """Innovations (N, l) of every experiment under a gain, with the initial state that fits best."""
    F, run = A - gain @ C, _kernels()[0]
    return [run(F, C, gain, r, x0) for r, x0 in zip(rest, _initial(F, C, gain, rest))]


def _initial(F: Array, C: Array, gain: Array, rest: Sequence[Array]) -> list[Array]:
    """Initial states (n,) that minimise the squared innovations, which are affine in them."""
    weight = np.diag(1 / np.sqrt(np.maximum(np.diag(_covariance(rest)), np.finfo(float).tiny)))
    found = []
    for r in rest:
        settled = r[: _settling(F, len(r))]
        normal, right = _kernels()[1](F, C, gain, settled, np.zeros(len(F)), weight)
        part = normal[gain.size :, gain.size :]
        found.append(_solved(part, right[gain.size :]))
    return found


def _settling(F: Array, count: int) -> int:
    """Samples after which the initial state is forgotten."""
    radius = _radius(F)
    return count if radius > 0.99 else min(count, len(F) + 10 + int(np.log(1e-10) / np.log(max(radius, 0.1))))


def _equations(A: Array, C: Array, gain: Array, rest: Sequence[Array], covariance: Array) -> tuple[Array, Array]:
    """Normal equations of a step in the gain (column by column), the innovations in units of their covariance.

    The initial states are eliminated.
    """
    values, vectors = np.linalg.eigh(covariance)
    weight = (vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))).T
    F, size = A - gain @ C, gain.size
    normal, right = np.zeros((size, size)), np.zeros(size)
    for r, x0 in zip(rest, _initial(F, C, gain, rest)):
        information, pull = _kernels()[1](F, C, gain, r, x0, weight)
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


def _logdet(covariance: Array) -> float:
    sign, value = np.linalg.slogdet(covariance)
    return float(value) if sign > 0 else -np.inf


def _radius(A: Array) -> float:
    return float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))


def _innovate(F: Array, C: Array, gain: Array, r: Array, x0: Array) -> Array:
    """Innovations e = r - C x, x+ = F x + K r with F = A - K C; a missing residual corrects nothing."""
    n, l = gain.shape  # noqa: E741
    e = np.empty_like(r)
    x, later = x0.copy(), np.empty(n)
    for k in range(r.shape[0]):
        for i in range(n):
            later[i] = 0.0
            for j in range(n):
                later[i] += F[i, j] * x[j]
        for o in range(l):
            seen = 0.0
            for j in range(n):
                seen += C[o, j] * x[j]
            e[k, o] = r[k, o] - seen
            taken = seen if np.isnan(r[k, o]) else r[k, o]
            for i in range(n):
                later[i] += gain[i, o] * taken
        x, later = later, x
    return e


def _sensitivities(F: Array, C: Array, gain: Array, r: Array, x0: Array, weight: Array) -> tuple[Array, Array]:
    """Sum of J'J and J'e over a record, J the derivative of -e by the gain (column by column) and x0, both whitened."""
    n, l = gain.shape  # noqa: E741
    q = n * l + n
    x, later = x0.copy(), np.zeros(n)
    turn, turned = np.zeros((n, q)), np.zeros((n, q))
    for i in range(n):
        turn[i, n * l + i] = 1.0
    normal, right = np.zeros((q, q)), np.zeros(q)
    e, white, slope, rows = np.zeros(l), np.zeros(l), np.zeros((l, q)), np.zeros((l, q))
    for k in range(r.shape[0]):
        for o in range(l):
            seen = 0.0
            for j in range(n):
                seen += C[o, j] * x[j]
            missing = np.isnan(r[k, o])
            e[o] = 0.0 if missing else r[k, o] - seen
            for p in range(q):
                slope[o, p] = 0.0
                if not missing:
                    for j in range(n):
                        slope[o, p] += C[o, j] * turn[j, p]
        for o in range(l):
            white[o] = 0.0
            for c in range(l):
                white[o] += weight[o, c] * e[c]
            for p in range(q):
                rows[o, p] = 0.0
                for c in range(l):
                    rows[o, p] += weight[o, c] * slope[c, p]
        for o in range(l):
            for p in range(q):
                right[p] += rows[o, p] * white[o]
                for s in range(p + 1):
                    normal[p, s] += rows[o, p] * rows[o, s]
        for i in range(n):
            later[i] = 0.0
            for j in range(n):
                later[i] += F[i, j] * x[j]
            for o in range(l):
                seen = 0.0
                for j in range(n):
                    seen += C[o, j] * x[j]
                later[i] += gain[i, o] * (seen + e[o])
        # d x+ = A dx + K de + dK e with de = -C dx where the residual is there
        for i in range(n):
            for p in range(q):
                total = 0.0
                for j in range(n):
                    total += F[i, j] * turn[j, p]
                for o in range(l):
                    if np.isnan(r[k, o]):
                        for j in range(n):
                            total += gain[i, o] * C[o, j] * turn[j, p]
                turned[i, p] = total
        for o in range(l):
            for i in range(n):
                turned[i, o * n + i] += e[o]
        x, later = later, x
        turn, turned = turned, turn
    for p in range(q):
        for s in range(p):
            normal[s, p] = normal[p, s]
    return normal, right


@cache
def _kernels() -> tuple[Any, Any]:
    from numba import njit

    options = {"cache": True, "nogil": True, "error_model": "numpy"}
    return njit(**options)(_innovate), njit(**options)(_sensitivities)
