"""Noise statistics of a state-space model: gain of the innovations, covariances, spectrum, colour.

With A and C known, what the inputs and the measured feedback do not explain is ``r = (I + C (qI - A)^-1 K) e``. The
gain K and the covariance of the innovations e minimise the prediction errors (Gauss-Newton, started from a long
autoregression of r: Hannan and Rissanen 1982). The covariances reported are those of the residuals of the state and the
output equation along the states of that predictor, ``w = K e`` and ``v = e``: Q = K Re K', S = K Re, R = Re (Van
Overschee and De Moor, Subspace Identification for Linear Systems, 1996, chapter 3). They are positive semidefinite and
belong to K by construction. Q, R and S are not unique: every process and measurement noise with the same spectrum gives
the same outputs. What the data determine is the spectrum, hence K and Re.
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
from optid.validation.correlations import Correlation, autocorrelation

if TYPE_CHECKING:
    from optid.models.hammerstein_ss import HammersteinSS

ROUNDING = 1e-10
"""Residuals below this share of the outputs are rounding: there is no noise to describe."""

NEARLY_MARGINAL = 1 - 1e-4
"""Poles beyond this radius need an observer: without it the residuals would not settle within a record."""

STEPS, TOLERANCE = 30, 1e-6


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
        DataError: a missing input, or other channels than the model's.
        StructureError: a pole on or outside the unit circle that the outputs do not see.
    """
    observer = _observer(model)
    data = _as_it_is(data)
    rest = residuals(replace(model, K=observer, noise=None), data)
    level = float(np.nanmax(np.abs(np.vstack([e.y for e in data.experiments])), initial=0.0))
    if not np.nanmax(np.abs(np.vstack(rest)), initial=0.0) > ROUNDING * level:
        return Noise(observer, _innovation_form(observer, _covariance(rest)))
    A = model.A - observer @ model.C
    gain = _stable(A, model.C, _first_gain(A, model.C, rest), _covariance(rest))
    gain, covariance = _refined(A, model.C, gain, rest)
    return Noise(observer + gain, _innovation_form(observer + gain, covariance))


def residuals(model: "HammersteinSS", data: Data) -> list[Array]:
    """Return the one-step prediction errors (N, l) of every experiment in the units of the model, NaN = missing."""
    data = _as_it_is(data)
    predicted = model.predict(data, x0="fit")
    several = predicted if data.n_experiments > 1 else (predicted,)
    return [e.y - p for e, p in zip(data.experiments, several)]


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


def _first_gain(A: Array, C: Array, rest: Sequence[Array]) -> Array:
    """Gain whose response C A^(i-1) K is nearest to that of a long autoregression of the residuals.

    The autoregression solves the Yule-Walker equations, loaded a little: with missing samples the sample covariances
    need not be positive definite.
    """
    l, samples = C.shape[0], int(np.sum(~np.isnan(np.vstack(rest)), axis=0).min())  # noqa: E741
    order = int(np.clip(10 * np.log10(max(samples, 10)), 1, max(1, samples // (10 * l))))
    unit = np.sqrt(np.maximum(np.diag(_covariance(rest)), np.finfo(float).tiny))
    lagged = [_covariance(rest, lag) / np.outer(unit, unit) for lag in range(order + 1)]
    system = np.block([[lagged[j - i] if j >= i else lagged[i - j].T for j in range(order)] for i in range(order)])
    right = np.vstack([matrix.T for matrix in lagged[1:]])
    past = np.linalg.lstsq(system + 1e-6 * np.eye(len(system)), right)[0].T.reshape(l, order, l)
    response = [np.eye(l)]
    for i in range(1, order + 1):
        response.append(sum((past[:, j - 1] @ response[i - j] for j in range(1, i + 1)), np.zeros((l, l))))
    scaled = C / unit[:, None]
    rows, power = [], np.eye(len(A))
    for _ in range(order):
        rows.append(scaled @ power)
        power = A @ power
    gain = np.linalg.lstsq(np.vstack(rows), np.vstack(response[1:]), rcond=1e-8)[0]
    return gain / unit  # per unit of the innovations


def _stable(A: Array, C: Array, gain: Array, covariance: Array) -> Array:
    """Return the gain of the same spectrum that makes A - K C stable."""
    if _radius(A - gain @ C) < 1:
        return gain
    try:
        level = covariance + 1e-12 * np.trace(covariance) * np.eye(len(C))
        return np.array(kalman_gain(A, C, gain @ level @ gain.T, level, gain @ level).K)
    except StructureError:  # zeros on the unit circle
        return np.zeros_like(gain)


def _refined(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> tuple[Array, Array]:
    """Minimise the determinant of the covariance of the innovations by Gauss-Newton with backtracking."""
    best = _innovations(A, C, gain, rest)
    for _ in range(STEPS):
        step = _direction(A, C, gain, rest, best)
        size, improved = 1.0, False
        while size > 1e-3:
            trial = gain + size * step
            if _radius(A - trial @ C) < 1:
                found = _innovations(A, C, trial, rest)
                if _logdet(found) < _logdet(best):
                    improved = True
                    break
            size /= 2
        if not improved:
            break
        moved = float(np.linalg.norm(size * step)) / max(float(np.linalg.norm(trial)), 1e-300)
        gained = _logdet(best) - _logdet(found)
        gain, best = trial, found
        if moved < TOLERANCE or gained < 1e-12:
            break
    return gain, best


def _innovations(A: Array, C: Array, gain: Array, rest: Sequence[Array]) -> Array:
    """Covariance (l, l) of the innovations under a gain."""
    run = _kernels()[0]
    return _covariance([run(A - gain @ C, C, gain, r) for r in rest])


def _direction(A: Array, C: Array, gain: Array, rest: Sequence[Array], covariance: Array) -> Array:
    """Gauss-Newton step in the gain, the innovations in units of their covariance."""
    n, l = gain.shape  # noqa: E741
    values, vectors = np.linalg.eigh(covariance)
    weight = (vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))).T
    normal, right = np.zeros((n * l, n * l)), np.zeros(n * l)
    for r in rest:
        information, pull = _kernels()[1](A - gain @ C, C, gain, r, weight)
        normal += information
        right += pull
    load = 1e-10 * np.trace(normal) / max(n * l, 1)
    return np.linalg.solve(normal + load * np.eye(n * l), right).reshape(l, n).T


def _logdet(covariance: Array) -> float:
    sign, value = np.linalg.slogdet(covariance)
    return float(value) if sign > 0 else -np.inf


def _radius(A: Array) -> float:
    return float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))


def _innovate(F: Array, C: Array, gain: Array, r: Array) -> Array:
    """Innovations e = r - C x, x+ = F x + K r with F = A - K C; a missing residual corrects nothing."""
    n, l = gain.shape  # noqa: E741
    e = np.empty_like(r)
    x, later = np.zeros(n), np.empty(n)
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


def _sensitivities(F: Array, C: Array, gain: Array, r: Array, weight: Array) -> tuple[Array, Array]:
    """Sum of J'J and J'e over a record, J the derivative of -e by the gain (column by column), both whitened."""
    n, l = gain.shape  # noqa: E741
    q = n * l
    x, later = np.zeros(n), np.zeros(n)
    turn, turned = np.zeros((n, q)), np.zeros((n, q))
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
