"""Estimates of the output of a lost sensor: by a Kalman filter on the others, or learnt from healthy records.

The filter on the remaining sensors is optimal for a known plant, and its Riccati equation predicts its error. Without
a reliable model the conditional mean of the lost reading, given the last readings of the others and the last inputs, is
estimated from healthy data; the projection onto their signal subspace is the same without weighting by the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from optid.arrays import Array, one_or_all
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.faults.places import channel_of
from optid.models import HammersteinSS
from optid.models.experiments import in_units_of
from optid.models.kalman import kalman_gain

LAGS = 16
"""Samples of the past in a sensor that is learnt from data."""

UNSEEN = 1e-8
"""A mode is unobservable when its rows have a singular value below this share of the largest."""

MARGINAL = 1e-9
"""Modes within this of the unit circle do not decay."""


@dataclass(frozen=True, eq=False)
class Observer:
    """A Kalman filter on the remaining sensors; `estimate` gives every output, the lost ones included.

    Attributes:
        model: the plant, with the gain of the one-step predictor on the remaining sensors (zero columns for lost ones).
        lost: names of the outputs that are not used.
        correction: (n, l) gain of the correction by the readings of the same sample.
        error: (n, n) covariance of the error of the corrected state.
    """

    model: HammersteinSS
    lost: tuple[str, ...]
    correction: Array
    error: Array

    @property
    def rmse(self) -> dict[str, float]:
        """Predicted root mean square error of every output without its noise, in its units."""
        return _output_errors(self.model, self.error)

    @property
    def open_loop(self) -> dict[str, float]:
        """The same of a simulation without measurements; inf for a plant that is not stable."""
        if not self.model.is_stable:
            return dict.fromkeys(self.model.outputs, float("inf"))
        return _output_errors(self.model, _uncorrected(self.model))

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the noise of every sensor."""
        assert self.model.noise is not None
        return dict(zip(self.model.outputs, np.sqrt(np.diag(self.model.noise.R)).tolist()))

    def estimate(self, data: Data, x0: Any = "fit") -> Any:
        """Return the outputs without their noise (N, l), from the remaining sensors up to the same sample.

        Args:
            data: the record; the readings of lost sensors are not used. Several experiments give a tuple of arrays.
            x0: as `HammersteinSS.predict`.
        """
        seen = without_sensors(in_units_of(self.model, data), self.lost)
        predicted = self.model.predict(seen, x0=x0)
        found = []
        for part, p in zip(seen.experiments, predicted if isinstance(predicted, tuple) else (predicted,)):
            innovations = np.where(np.isnan(part.y), 0.0, part.y - p)
            found.append(p + innovations @ (self.model.C @ self.correction).T)
        return one_or_all(found)

    def __str__(self) -> str:
        head = f"filter without {', '.join(self.lost)}" if self.lost else "filter on all sensors"
        rows = [f"  {name}: predicted RMSE {self.rmse[name]:.4g} (its own noise {self.noise[name]:.4g}, simulation "
                f"{self.open_loop[name]:.4g})" for name in self.lost]
        return "\n".join([head, *rows])


def without_sensors(data: Data, names: Sequence[str]) -> Data:
    """Return the record without the readings of some sensors."""
    gone = np.isin(data.outputs, names)
    return data.map_signals(lambda u: u, lambda y: np.where(gone, np.nan, y)) if gone.any() else data


def _output_errors(model: HammersteinSS, covariance: Array) -> dict[str, float]:
    squares = np.einsum("oi,ij,oj->o", model.C, covariance, model.C)
    return dict(zip(model.outputs, np.sqrt(np.maximum(squares, 0.0)).tolist()))


def _uncorrected(model: HammersteinSS) -> Array:
    """Covariance (n, n) of the state of a stable plant."""
    from scipy.linalg import solve_discrete_lyapunov

    assert model.noise is not None
    return np.asarray(solve_discrete_lyapunov(model.A, model.noise.Q))


def observer(model: HammersteinSS, lost: Sequence[str] = ()) -> Observer:
    """Return the Kalman filter on the sensors of a model that are not lost ("y1" or "sensor:y1").

    Raises:
        LookupFailed: an unknown output.
        StructureError: no noise covariances, or a mode that does not decay and is not observable, named.
    """
    if model.noise is None:
        raise StructureError("The model has no noise covariances, which the filter depends on: estimate them with "
                             "optid.noise.with_noise(model, data).")
    names = _names(model, lost)
    left = [o for o, name in enumerate(model.outputs) if name not in names]
    mode = _hidden_mode(model.A, model.C[left])
    if mode:
        words = ", ".join(f"sensor {name}" for name in names) or "more sensors"
        raise StructureError(
            f"Without {words} the {mode} is observed by no sensor and does not decay: the damaged plant is not "
            "detectable. Repair the sensor, or measure this mode.")
    noise, shape = model.noise, (model.nx, model.l)
    K, correction = np.zeros(shape), np.zeros(shape)
    if left:
        C = model.C[left]
        steady = kalman_gain(model.A, C, noise.Q, noise.R[np.ix_(left, left)], noise.S[:, left])
        K[:, left], gain = steady.K, np.linalg.solve(steady.innovation, C @ steady.error).T
        correction[:, left] = gain
        error = steady.error - gain @ steady.innovation @ gain.T
    else:
        error = _uncorrected(model)
    return Observer(replace(model, K=K), names, correction, (error + error.T) / 2)


def check_stabilisable(model: HammersteinSS, left: Sequence[int]) -> None:
    """Refuse a mode that does not decay and that no remaining function of the inputs controls (`StructureError`)."""
    mode = _hidden_mode(model.A.T, model.B[:, list(left)].T)
    if mode:
        lost = sorted({c for i, c in enumerate(model.input_of) if i not in left})
        words = ", ".join(f"actuator {model.inputs[c]}" for c in lost) or "any actuator"
        raise StructureError(
            f"Without {words} the {mode} is controlled by no actuator and does not decay: the damaged plant is not "
            "stabilisable.")


def _hidden_mode(A: Array, C: Array) -> str:
    """Name the first unobservable mode on or outside the unit circle, and the state it is largest in."""
    for value, vector in zip(*(part.T for part in np.linalg.eig(A))):
        sizes = np.linalg.svd(np.vstack([value * np.eye(len(A)) - A, C]), compute_uv=False)
        if abs(value) >= 1 - MARGINAL and sizes[-1] < UNSEEN * sizes[0]:
            value = complex(value)
            shown = f"{value.real:.4g}" if abs(value.imag) < 1e-12 else f"{value.real:.4g} ± {abs(value.imag):.4g}i"
            state = int(np.argmax(np.abs(vector))) + 1
            return f"mode at {shown} (modulus {abs(value):.4g}, largest in state x{state})"
    return ""


def _names(model: HammersteinSS, lost: Sequence[str]) -> tuple[str, ...]:
    """Return the names of outputs, given with their part or without, in their order."""
    places = sorted({channel_of(model.outputs, name if ":" in name else f":{name}") for name in lost})
    return tuple(model.outputs[o] for o in places)


@dataclass(frozen=True, eq=False)
class LearntSensor:
    """A lost output as a linear function of the last readings of the others and of the last inputs."""

    model: HammersteinSS  # gives the nonlinearities of the inputs and the names
    lost: tuple[str, ...]  # names of the outputs that are estimated
    method: str  # "conditional mean" or "subspace"
    lags: int  # samples of the past, the present one included
    weights: Array  # (features, lost) acting on [other readings; f(u)] of every lag, the newest first
    constant: Array  # (lost,)
    residual: Array  # (lost,) standard deviation of its error on the healthy record, the noise of the sensor included

    @cached_property
    def rmse(self) -> dict[str, float]:
        """Predicted root mean square error of each lost output, without its noise where the model has covariances."""
        noise = self.model.noise
        places = [self.model.outputs.index(name) for name in self.lost]
        own = np.zeros(len(places)) if noise is None else noise.R[places, places]
        return dict(zip(self.lost, np.sqrt(np.maximum(self.residual**2 - own, 0.0)).tolist()))

    def estimate(self, data: Data) -> Any:
        """Return the lost outputs (N, lost); NaN in the first samples and where a sample of the past is missing."""
        found = []
        for part in in_units_of(self.model, data).experiments:
            rows = _stacked(self.model, part.u, part.y, self.lost, self.lags)[0] @ self.weights + self.constant
            found.append(np.vstack([np.full((self.lags - 1, len(self.lost)), np.nan), rows])[: len(part.y)])
        return one_or_all(found)


def conditional_mean(model: HammersteinSS, data: Data, lost: Sequence[str], *, lags: int = LAGS) -> LearntSensor:
    """Learn a lost sensor from healthy data: the mean of its reading given the last ones of the others and the inputs.

    Args:
        model: gives the nonlinearities of the inputs.
        data: a healthy record.
        lost: names of outputs.
        lags: samples of the past, the present one included.

    Raises:
        DataError: fewer complete windows than twice the weights, with the required length.
        LookupFailed: an unknown output.
        StructureError: no output is named.
    """
    names, rows, readings = _learning(model, data, lost, lags, 2)
    readings = readings[:, : len(names)]
    mean, level = rows.mean(axis=0), readings.mean(axis=0)
    weights = np.linalg.lstsq(rows - mean, readings - level, rcond=1e-10)[0]
    rest = readings - level - (rows - mean) @ weights
    count, free = len(rows), rows.shape[1] + 1
    residual = np.sqrt(np.sum(rest**2, axis=0) / (count - free) * (1 + free / count))
    return LearntSensor(model, names, "conditional mean", lags, weights, level - mean @ weights, residual)


def subspace_projection(
    model: HammersteinSS, data: Data, lost: Sequence[str], *, lags: int = LAGS, rank: int | None = None
) -> LearntSensor:
    """Learn a lost sensor from healthy data: the point of the signal subspace that agrees with the other channels.

    Arguments as in `conditional_mean`, as are the errors raised; `rank` is the dimension of the subspace, lags times
    the inputs and the states by default.
    """
    names, rows, readings = _learning(model, data, lost, lags, 1)
    everything, width, count = np.hstack([rows, readings]), rows.shape[1], len(names)
    mean = everything.mean(axis=0)
    axes = np.linalg.svd(everything - mean, full_matrices=False)[2]
    basis = axes[: rank or lags * len(model.nonlinearities) + model.nx].T
    weights = np.linalg.pinv(basis[:width]).T @ basis[width : width + count].T
    constant = mean[width : width + count] - mean[:width] @ weights
    residual = np.std(readings[:, :count] - rows @ weights - constant, axis=0)
    return LearntSensor(model, names, "subspace", lags, weights, constant, residual)


def _learning(model: HammersteinSS, data: Data, lost: Sequence[str], lags: int, per_weight: int
              ) -> tuple[tuple[str, ...], Array, Array]:
    """Names of the lost, and complete windows of a healthy record: as `_stacked`."""
    names = _names(model, lost)
    if not names:
        raise StructureError("No lost sensor is named.")
    found = [_stacked(model, part.u, part.y, names, lags) for part in in_units_of(model, data).experiments]
    rows, readings = (np.vstack(parts) for parts in zip(*found))
    complete = ~(np.isnan(rows).any(axis=1) | np.isnan(readings).any(axis=1))
    least = per_weight * (rows.shape[1] + 1)
    if complete.sum() < least:
        raise DataError(
            f"{complete.sum()} complete windows of {lags} samples do not determine {rows.shape[1] + 1} weights: at "
            f"least {least + lags} healthy samples are needed, or fewer lags.")
    return names, rows[complete], readings[complete]


def _stacked(model: HammersteinSS, u: Array, y: Array, lost: tuple[str, ...], lags: int) -> tuple[Array, Array]:
    """[other readings; f(u)] and the lost readings of every lag, the newest first, (N - lags + 1, p)."""
    gone = np.isin(model.outputs, lost)
    count = max(len(y) - lags + 1, 0)
    starts = [max(lags - 1 - lag, 0) for lag in range(lags)]
    signal = np.hstack([y[:, ~gone], model.expand_inputs(u)])
    return tuple(np.hstack([part[k : k + count] for k in starts]) for part in (signal, y[:, gone]))  # type: ignore
