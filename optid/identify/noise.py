"""Noise statistics of a state-space model: gain of the innovations, covariances, spectrum, colour.

With A and C known, the part of the outputs not explained by inputs and measured feedback is
``r = (I + C (qI - A)^-1 K) e``. The gain K and the covariance of the innovations e minimise the prediction errors
(`optid.models.innovation_gain`, started from several observers and from long autoregressions of their errors: Hannan
and Rissanen 1982). The covariances reported are those of ``w = K e`` and ``v = e``: Q = K Re K', S = K Re, R = Re (Van
Overschee and De Moor, Subspace Identification for Linear Systems, 1996, chapter 3). Q, R and S are not unique; the data
determine the spectrum, hence K and Re.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.data.record import Data
from optid.data.stretches import between_gaps
from optid.errors import DataError, StructureError
from optid.identify.validation.correlations import Correlation, autocorrelation
from optid.identify.validation.predictions import one_step
from optid.lazy import public_names
from optid.models.hammerstein_ss import HammersteinSS
from optid.models.innovation_gain import Likelihood, OneStepPredictor, covariance_of, refine_gain
from optid.models.kalman import NoiseCovariances, kalman_gain
from optid.models.model import ROUNDING as ON_CIRCLE
from optid.models.model import impulse_response
from optid.models.roots import spectral_radius
from optid.models.state_space import StateSpace
from optid.statistics.coloured import long_autoregression, response_of
from optid.statistics.hankel import complete_runs

ROUNDING = 1e-10  # residuals below this share of the outputs are rounding: there is no noise to describe
LONGEST = 40  # lags of the autoregression of prediction errors at most
EXACT = 1e-8  # prediction errors relative to the outputs below which a record shows no noise model
NEARLY_MARGINAL = 1 - 1e-4  # radius of the poles from which an observer is used
RATIOS = (1e-2, 1.0, 1e2)  # process over measurement noise of the observers of the starts, in units of C
TRIED = 2  # observers whose errors are whitened, and then starts that are refined
# samples of a block, number of blocks, or samples per entry of K, in which a long record is searched first
BLOCK, BLOCKS, PER_ENTRY = 2048, 2, 50
# gain of the log-likelihood that is negligible in a part of a record, and difference between two optima of it
NEARLY, ELSEWHERE = 0.1, 1.0
LIKELIEST = attrgetter("log_determinant")  # key of predictors


class NoiseFilter(NamedTuple):
    """The noise at the outputs, ``(I + C (qI - F)^-1 K) e`` with white e."""

    F: Array  # (n, n)
    K: Array  # (n, l)
    C: Array  # (l, n)
    covariance: Array  # (l, l) of e

    def response(self, count: int) -> Array:
        """Return what a unit of e adds to the outputs of so many samples, (count, l, l)."""
        return impulse_response(self.F, self.K, self.C, np.eye(len(self.C)), count)

    def variances(self, ahead: int) -> Array:
        """Return the variances (ahead, l) of what e of the last 1, 2, ... samples adds to the outputs."""
        response = self.response(ahead)
        with np.errstate(all="ignore"):  # an unstable one leaves the range of numbers
            return np.cumsum(np.einsum("kip,pq,kiq->ki", response, self.covariance, response), axis=0)

    def stationary(self, nearest: float = ON_CIRCLE) -> Array | None:
        """Return the variances (l,) of the stationary noise; None where a pole comes so near to the unit circle."""
        from scipy.linalg import solve_discrete_lyapunov

        if not self.K.any():
            return np.diag(self.covariance)
        if spectral_radius(self.F) >= 1 - nearest:
            return None
        states = solve_discrete_lyapunov(self.F, self.K @ self.covariance @ self.K.T)
        return np.diag(self.C @ states @ self.C.T + self.covariance)


def with_noise(model: HammersteinSS, data: Data) -> HammersteinSS:
    """Return the model with the gain K, A - K C stable, and the noise covariances of a record.

    The record is in the units of the model: a transform is not undone. Samples may be missing. K and the noise of the
    given model are replaced.

    Raises:
        DataError: other channels than the model's, or no stretch long enough without a missing input.
        StructureError: an unobservable pole on or outside the unit circle.
    """
    observer = _observer(model)
    data = between_gaps(data.without_transform(), 2 * model.nx + 1)
    bare = model.noise is None and np.array_equal(model.K, observer)
    rest = residuals(model if bare else replace(model, K=observer, noise=None), data)
    gain, covariance = np.zeros_like(observer), covariance_of(rest)
    if _largest(rest) > ROUNDING * _largest([e.y for e in data.experiments]):
        found = _most_likely(model.A - observer @ model.C, model.C, rest)
        gain, covariance = found.gain, found.covariance
    return replace(model, K=observer + gain, noise=NoiseCovariances.of_innovations(observer + gain, covariance))


def with_noise_or_reason(model: HammersteinSS, data: Data) -> tuple[HammersteinSS, dict[str, str]]:
    """Return the model as of `with_noise`, or unchanged with the reason as a figure."""
    outputs = [e.y for e in data.experiments]
    try:
        regression_lags([int(np.count_nonzero(~np.isnan(y))) // model.l for y in outputs], model.nx, model.l)
        found = with_noise(model, data)
    except (StructureError, DataError) as reason:
        return model, {"noise model": f"none: {reason}"}
    except np.linalg.LinAlgError:
        return model, {"noise model": "none: the prediction errors leave the range of numbers where outputs are "
                                      "missing"}
    spread = np.nanstd(np.concatenate(outputs), axis=0)
    if found.noise is None or np.all(np.diag(found.noise.innovation) <= (EXACT * spread) ** 2):
        return model, {"noise model": "none: the prediction errors vanish"}
    return found, {}


def residuals(model: HammersteinSS, data: Data) -> list[Array]:
    """Return the one-step prediction errors (N, l) of every experiment in the units of the model, NaN = missing."""
    data = data.without_transform()
    return [e.y - p for e, p in zip(data.experiments, one_step(model, data))]


def noise_spectrum(model: HammersteinSS, w: ArrayLike) -> Array:
    """Return the spectral density of the noise at the outputs, H Re H* with H = I + C (zI - A)^-1 K.

    It is complex and Hermitian, (F, l, l), at the frequencies w (F,) in radians per unit of time, up to pi / dt. Its
    mean over (-pi/dt, pi/dt) is the covariance of the noise at the outputs.

    Raises:
        StructureError: the model has no noise covariances.
    """
    shaped = StateSpace(model.A, model.K, model.C, np.eye(model.l), dt=model.dt).frequency_response(w)
    return np.asarray(shaped @ _innovations(model) @ np.conj(np.swapaxes(shaped, 1, 2)))


def colour(model: HammersteinSS, data: Data, lags: int = 25) -> dict[str, Correlation]:
    """Return {output: whiteness test} of the errors of the simulation with measured feedback, up to so many lags.

    Raises:
        DataError: the simulation leaves the range of numbers.
        StructureError: a mode on or outside the unit circle that no output sees.
    """
    raw = data.raw()
    rest = residuals(replace(model, K=_observer(model), noise=None), raw)
    lags = max(1, min(lags, int(np.sum(~np.isnan(np.vstack(rest)), axis=0).min()) // 4))
    return {name: autocorrelation([r[:, o] for r in rest], name, lags) for o, name in enumerate(model.outputs)}


def output_deviations(model: HammersteinSS) -> Array:
    """Return the standard deviations (l,) of the noise at the outputs, process and measurement noise together.

    They are infinite where a pole on or outside the unit circle is driven by the noise; refused as `noise_spectrum`.
    """
    variances = NoiseFilter(model.A, model.K, model.C, _innovations(model)).stationary()
    return np.full(model.l, np.inf) if variances is None else np.sqrt(variances)


def _innovations(model: HammersteinSS) -> Array:
    if model.noise is None:
        raise StructureError("the model has no noise covariances; optid.noise.with_noise(model, data) estimates them")
    return np.array(model.noise.innovation)


def _largest(signals: Sequence[Array]) -> float:
    return max(float(np.nanmax(np.abs(s), initial=0.0)) for s in signals)


def _most_likely(A: Array, C: Array, rest: Sequence[Array]) -> OneStepPredictor:
    """Predictor of the largest likelihood; a long record is first searched in part."""
    part, whole = Likelihood(A, C, _part(rest, C.size)), Likelihood(A, C, rest)
    starts = _starts(part)[:TRIED]
    if part.rest is rest:
        found = [refine_gain(part, start) for start in starts]
    else:
        found = sorted((refine_gain(part, start, arrived=NEARLY) for start in starts), key=LIKELIEST)
        same = found[0].log_determinant + 2 * ELSEWHERE / sum(map(len, part.rest))
        optima = [found[0], *(other for other in found[1:] if other.log_determinant > same)]
        found = [refine_gain(whole, whole.at(optimum.gain), part) for optimum in optima]
    return min(found, key=LIKELIEST)


def _part(rest: Sequence[Array], entries: int) -> Sequence[Array]:
    """Blocks spread evenly over a long record; all of it where it is short or where they show too little."""
    wanted, total = max(BLOCK * BLOCKS, PER_ENTRY * entries), sum(map(len, rest))
    blocks = [r[start : start + BLOCK] for r in rest for start in range(0, len(r), BLOCK)]
    part = blocks[:: max(1, total // wanted)]
    complete = sum(int(np.sum(~np.isnan(r).any(axis=1))) for r in part)
    shown = 2 * complete >= wanted and np.all(np.diag(covariance_of(part)) > 0)
    return part if total > 2 * wanted and shown else rest


def _starts(likelihood: Likelihood) -> list[OneStepPredictor]:
    """Predictors to start from, the best first: observers, and the whitening of the errors of the best of them."""
    A, C = likelihood.A, likelihood.C
    observers: list[Array] = [np.zeros((len(A), len(C)))]
    for ratio in RATIOS:
        with suppress(StructureError):
            observers.append(observer_gain(A, C, ratio))
    found = []
    for gain in observers:
        with suppress(DataError):  # innovations that leave the range of numbers
            found.append(likelihood.at(gain))
    if not found:
        raise DataError("the noise model is not determined: the innovations leave the range of numbers")
    found.sort(key=LIKELIEST)
    for observer in found[:TRIED]:
        with suppress(StructureError, DataError, ValueError):  # too few in a row, or a zero on the unit circle
            found.append(likelihood.at(whitening_gain(A, C, observer.gain, observer.errors)))
    return sorted(found, key=LIKELIEST)


def whitening_gain(A: Array, C: Array, gain: Array, errors: Sequence[Array]) -> Array:
    """Return the gain (n, l), A - K C stable, with the spectrum of a long autoregression of an observer's errors.

    With F = A - L C the errors of the gain L are r = e + C (qI - F)^-1 (K - L) e, a response linear in K. The errors
    are (N, l), one array per experiment, NaN = missing; those that determine no gain are a `StructureError`.
    """
    n, l = gain.shape  # noqa: E741
    lags = regression_lags([len(run) for r in errors for run in complete_runs(r, 1)], n, l)
    autoregression, root = long_autoregression(errors, lags)
    spread = np.linalg.norm(root, axis=0)
    if not np.all(spread > 0):
        raise StructureError("an output is predicted exactly: the covariance of the innovations is singular.")
    response, powers = response_of(autoregression, lags + 1, fade=False), [np.asarray(C)]
    for _ in range(lags - 1):
        powers.append(powers[-1] @ (A - gain @ C))
    unit = np.tile(spread, lags)[:, None]
    change = np.linalg.lstsq(np.vstack(powers) / unit, response[1:].reshape(-1, l) / unit, rcond=None)[0]
    K, covariance = gain + change, root.T @ root
    if spectral_radius(A - K @ C) < 1:  # the Riccati equation has the solution zero
        return K
    return np.array(kalman_gain(A, C, K @ covariance @ K.T, covariance, K @ covariance).K)


def regression_lags(lengths: Sequence[int], n: int, l: int) -> int:  # noqa: E741
    """Return the lags of the autoregression of the errors of l outputs; too few errors are a `StructureError`.

    The lengths are those of complete runs, n is the order of the model.
    """
    total = sum(lengths)
    lags = int(min(LONGEST, max(4, 2 * n), max(1, total // (20 * l))))
    if max(lengths, default=0) <= 2 * lags or total < 10 * (lags + n) * l:
        raise StructureError(f"{total} prediction errors are too few for a noise model.")
    return lags


def _observer(model: HammersteinSS) -> Array:
    """Zero for a stable model; for others a gain that stabilises A - K C, so that the residuals are stationary."""
    if np.max(np.abs(model.poles), initial=0.0) < NEARLY_MARGINAL:
        return np.zeros((model.nx, model.l))
    return observer_gain(model.A, model.C, 0.1)


def observer_gain(A: Array, C: Array, ratio: float) -> Array:
    """Return the gain for equal noise in all states, so many times that at the outputs in units of C."""
    size = np.linalg.norm(C, axis=1)
    return np.array(kalman_gain(A, C, ratio * np.eye(len(A)), np.diag(np.where(size > 0, size, 1.0) ** 2)).K)


__dir__ = public_names(__name__)
