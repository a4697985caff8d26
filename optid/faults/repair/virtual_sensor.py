"""What a lost sensor would read: by a Kalman filter on the others, or learnt from healthy records.

The filter on the surviving sensors is the best there is for a known plant, and its Riccati equation says beforehand how
far it will be off. Without a trusted model the conditional mean of the lost reading given the last readings of the
others and the last inputs is estimated from healthy data; the projection onto their signal subspace is its older,
unweighted relative, which ignores how noisy each channel is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data, one_or_all
from optid.errors import DataError, StructureError
from optid.faults.faults import channel_of
from optid.models.experiments import in_units_of
from optid.models.kalman import kalman_gain

if TYPE_CHECKING:
    from optid.models import HammersteinSS

LAGS = 16
"""Samples of the past in a sensor that is learnt from data."""

UNSEEN = 1e-8
"""A mode is lost when its rows have a singular value below this share of the largest."""

MARGINAL = 1e-9
"""Modes within this of the unit circle do not decay."""


@dataclass(frozen=True, eq=False)
class Observer:
    """A Kalman filter on the surviving sensors; `estimate` gives every output, the lost ones included.

    Attributes:
        model: the plant, with the gain of the one-step predictor on the surviving sensors (zero columns for lost ones).
        lost: names of the outputs that are not used.
        correction: (n, l) gain of the correction by the readings of the same sample.
        error: (n, n) covariance of the error of the corrected state.
        predicted_error: (n, n) covariance before the correction.
    """

    model: "HammersteinSS"
    lost: tuple[str, ...]
    correction: Array
    error: Array
    predicted_error: Array

    @property
    def rmse(self) -> dict[str, float]:
        """Predicted root mean square error of every output without its noise, in its units."""
        return self._sizes(self.error)

    @property
    def open_loop(self) -> dict[str, float]:
        """The same of a simulation that no sensor corrects; inf for a plant that is not stable."""
        from scipy.linalg import solve_discrete_lyapunov

        assert self.model.noise is not None
        if not self.model.is_stable:
            return dict.fromkeys(self.model.outputs, float("inf"))
        return self._sizes(np.asarray(solve_discrete_lyapunov(self.model.A, self.model.noise.Q)))

    def _sizes(self, covariance: Array) -> dict[str, float]:
        squares = np.einsum("oi,ij,oj->o", self.model.C, covariance, self.model.C)
        return dict(zip(self.model.outputs, np.sqrt(np.maximum(squares, 0.0)).tolist()))

    def estimate(self, data: Data, x0: Any = "fit") -> Any:
        """Return the outputs without their noise (N, l), from the surviving sensors up to the same sample.

        Args:
            data: the record; the readings of lost sensors are ignored, NaN or not.
            x0: as `HammersteinSS.predict`.

        Returns:
            (N, l); a tuple of such arrays for several experiments.
        """
        raw = in_units_of(self.model, data)
        gone = [o for o, name in enumerate(self.model.outputs) if name in self.lost]

        def without(y: Array) -> Array:
            left = np.array(y, dtype=float)
            left[:, gone] = np.nan
            return left

        seen = raw.mapped(lambda u: u, without)
        predicted = self.model.predict(seen, x0=x0)
        found = []
        for part, p in zip(seen.experiments, predicted if isinstance(predicted, tuple) else (predicted,)):
            surprise = np.where(np.isnan(part.y), 0.0, part.y - p)
            found.append(p + surprise @ (self.model.C @ self.correction).T)
        return one_or_all(found)

    def __str__(self) -> str:
        """Say what is lost and how far each output will be off."""
        head = f"filter without {', '.join(self.lost)}" if self.lost else "filter on all sensors"
        rows = [
            f"  {name}: predicted RMSE {value:.4g}" + (
                f" (its own noise {self._noise(name):.4g}, simulation {self.open_loop[name]:.4g})"
            ) for name, value in self.rmse.items() if name in self.lost
        ]
        return "\n".join([head, *rows])

    def _noise(self, name: str) -> float:
        assert self.model.noise is not None
        o = self.model.outputs.index(name)
        return float(np.sqrt(self.model.noise.R[o, o]))


def observer(model: "HammersteinSS", lost: Sequence[str] = ()) -> Observer:
    """Return the Kalman filter on the sensors that are left.

    Args:
        model: with noise covariances.
        lost: names of outputs, "y1" or "sensor:y1".

    Raises:
        LookupFailed: an unknown output.
        StructureError: no noise covariances, no sensor left with an unstable mode, or a mode that does not decay and
            that no surviving sensor sees, named.
    """
    if model.noise is None:
        raise StructureError(
            "The model has no noise covariances, and the best filter depends on them: estimate them with "
            "optid.noise.with_noise(model, data)."
        )
    gone = sorted({channel_of(model.outputs, name if ":" in name else f":{name}") for name in lost})
    left = [o for o in range(model.l) if o not in gone]
    names = tuple(model.outputs[o] for o in gone)
    check_detectable(model, left)
    noise, n = model.noise, model.nx
    K, correction = np.zeros((n, model.l)), np.zeros((n, model.l))
    if left:
        C, R, S = model.C[left], noise.R[np.ix_(left, left)], noise.S[:, left]
        steady = kalman_gain(model.A, C, noise.Q, R, S)
        K[:, left] = steady.K
        gain = np.linalg.solve(steady.innovation, C @ steady.error).T
        correction[:, left] = gain
        before, after = steady.error, steady.error - gain @ steady.innovation @ gain.T
    else:
        from scipy.linalg import solve_discrete_lyapunov

        before = after = np.asarray(solve_discrete_lyapunov(model.A, noise.Q))
    return Observer(replace(model, K=K), names, correction, (after + after.T) / 2, before)


def check_detectable(model: "HammersteinSS", left: Sequence[int]) -> None:
    """Refuse when a mode that does not decay is seen by no sensor that is left.

    Raises:
        StructureError: with the mode.
    """
    mode = hidden_mode(model.A, model.C[list(left)])
    if mode is not None:
        raise StructureError(
            f"Without {_others(model.outputs, left)} the {_named(*mode)} is seen by no sensor and does not decay: the "
            "damaged plant is not detectable, and no observer can follow it. Repair the sensor, or measure this mode."
        )


def check_stabilisable(model: "HammersteinSS", left: Sequence[int]) -> None:
    """Refuse when a mode that does not decay is moved by no actuator that is left.

    Args:
        model: the plant.
        left: functions of the inputs (columns of B) that still move.

    Raises:
        StructureError: with the mode.
    """
    mode = hidden_mode(model.A.T, model.B[:, list(left)].T)
    if mode is not None:
        lost = sorted({model.input_of[i] for i in range(len(model.input_of)) if i not in left})
        words = ", ".join(f"actuator {model.inputs[c]}" for c in lost) or "any actuator"
        raise StructureError(
            f"Without {words} the {_named(*mode)} is moved by no actuator and does not decay: the damaged plant is "
            "not stabilisable, and no controller can hold it."
        )


def hidden_mode(A: Array, C: Array) -> tuple[complex, int] | None:
    """Return the first mode on or outside the unit circle that C does not see, and the state it is largest in."""
    values, vectors = np.linalg.eig(A)
    for value, vector in zip(values, vectors.T):
        if abs(value) < 1 - MARGINAL:
            continue
        rows = np.vstack([value * np.eye(len(A)) - A, C.reshape(-1, len(A))])
        sizes = np.linalg.svd(rows, compute_uv=False)
        if sizes[-1] < UNSEEN * sizes[0]:
            return complex(value), int(np.argmax(np.abs(vector)))
    return None


def _named(value: complex, state: int) -> str:
    shown = f"{value.real:.4g}" if abs(value.imag) < 1e-12 else f"{value.real:.4g} ± {abs(value.imag):.4g}i"
    return f"mode at {shown} (modulus {abs(value):.4g}, largest in state x{state + 1})"


def _others(names: Sequence[str], left: Sequence[int]) -> str:
    lost = [f"sensor {name}" for o, name in enumerate(names) if o not in left]
    return ", ".join(lost) or "more sensors"


@dataclass(frozen=True, eq=False)
class LearntSensor:
    """A lost output as a linear function of the last readings of the others and of the last inputs.

    Attributes:
        model: gives the nonlinearities of the inputs and the names.
        lost: names of the outputs that are reconstructed.
        method: "conditional mean" or "subspace".
        lags: samples that it looks back on, the present one included.
        weights: (features, lost) acting on [other readings; f(u)] of every lag, the newest first.
        constant: (lost,).
        residual: (lost,) standard deviation of what it missed in the healthy record, the noise of the sensor included.
    """

    model: "HammersteinSS"
    lost: tuple[str, ...]
    method: str
    lags: int
    weights: Array
    constant: Array
    residual: Array

    @cached_property
    def rmse(self) -> dict[str, float]:
        """Predicted root mean square error of each lost output without its noise, where the model knows the noise."""
        noise = self.model.noise
        places = [self.model.outputs.index(name) for name in self.lost]
        own = np.zeros(len(places)) if noise is None else noise.R[places, places]
        return dict(zip(self.lost, np.sqrt(np.maximum(self.residual**2 - own, 0.0)).tolist()))

    def estimate(self, data: Data) -> Any:
        """Return the lost outputs (N, lost); NaN in the first samples and where a sample of the past is missing."""
        raw = in_units_of(self.model, data)
        found = []
        for part in raw.experiments:
            result = np.full((len(part.y), len(self.lost)), np.nan)
            rows = _stacked(self.model, part.u, part.y, self.lost, self.lags)
            result[self.lags - 1 :] = rows @ self.weights + self.constant
            found.append(result)
        return one_or_all(found)


def conditional_mean(model: "HammersteinSS", data: Data, lost: Sequence[str], *, lags: int = LAGS) -> LearntSensor:
    """Learn a lost sensor from healthy data: the mean of its reading given the last ones of the others and the inputs.

    Args:
        model: gives the nonlinearities of the inputs.
        data: a healthy record.
        lost: names of outputs.
        lags: samples of the past, the present one included.

    Raises:
        DataError: fewer complete windows than twice the weights, with the length that is needed.
        LookupFailed: an unknown output.
    """
    names = _names(model, lost)
    rows, readings = _learning(model, data, names, lags, 2)
    mean, level = rows.mean(axis=0), readings.mean(axis=0)
    weights = np.linalg.lstsq(rows - mean, readings - level, rcond=1e-10)[0]
    rest = readings - level - (rows - mean) @ weights
    count, free = len(rows), rows.shape[1] + 1
    residual = np.sqrt(np.sum(rest**2, axis=0) / (count - free) * (1 + free / count))
    return LearntSensor(model, names, "conditional mean", lags, weights, level - mean @ weights, residual)


def subspace_projection(
    model: "HammersteinSS", data: Data, lost: Sequence[str], *, lags: int = LAGS, rank: int | None = None
) -> LearntSensor:
    """Learn a lost sensor from healthy data: the point of the signal subspace that agrees with what is left.

    Args:
        model: gives the nonlinearities of the inputs and the order of the plant.
        data: a healthy record.
        lost: names of outputs.
        lags: rows of the stack.
        rank: dimension of the subspace; lags times the inputs, and the states, by default.

    Raises:
        DataError: as `conditional_mean`.
        LookupFailed: an unknown output.
    """
    names = _names(model, lost)
    seen, readings = _learning(model, data, names, lags, 1)
    past = _learning(model, data, names, lags, 1, whole=True)[1]
    everything = np.hstack([seen, past])
    mean = everything.mean(axis=0)
    axes = np.linalg.svd(everything - mean, full_matrices=False)[2]
    rank = min(rank or lags * len(model.nonlinearities) + model.nx, len(axes))
    basis = axes[:rank].T
    width = seen.shape[1]
    weights = np.linalg.pinv(basis[:width]).T @ basis[width : width + len(names)].T
    constant = mean[width : width + len(names)] - mean[:width] @ weights
    residual = np.std(readings - seen @ weights - constant, axis=0)
    return LearntSensor(model, names, "subspace", lags, weights, constant, residual)


def _names(model: "HammersteinSS", lost: Sequence[str]) -> tuple[str, ...]:
    places = sorted({channel_of(model.outputs, name if ":" in name else f":{name}") for name in lost})
    if not places:
        raise StructureError("No lost sensor is named.")
    return tuple(model.outputs[o] for o in places)


def _learning(model: "HammersteinSS", data: Data, lost: tuple[str, ...], lags: int, per_weight: int,
              whole: bool = False) -> tuple[Array, Array]:
    """Complete windows of a healthy record: features (T, p), and readings of the lost sensors (T, lost [lags])."""
    raw = in_units_of(model, data)
    gone = [model.outputs.index(name) for name in lost]
    features, readings = [], []
    for part in raw.experiments:
        if len(part.y) < lags:
            continue
        features.append(_stacked(model, part.u, part.y, lost, lags))
        past = [part.y[lags - 1 - lag : len(part.y) - lag, gone] for lag in range(lags)]
        readings.append(np.hstack(past if whole else past[:1]))
    width = lags * (model.l - len(lost) + len(model.nonlinearities))
    if features:
        rows, targets = np.vstack(features), np.vstack(readings)
        complete = ~(np.isnan(rows).any(axis=1) | np.isnan(targets).any(axis=1))
        rows, targets = rows[complete], targets[complete]
    else:
        rows, targets = np.zeros((0, width)), np.zeros((0, len(lost)))
    if len(rows) < per_weight * (width + 1):
        raise DataError(
            f"{len(rows)} complete windows of {lags} samples do not determine {width + 1} weights: at least "
            f"{per_weight * (width + 1) + lags} healthy samples are needed, or fewer lags."
        )
    return rows, targets


def _stacked(model: "HammersteinSS", u: Array, y: Array, lost: tuple[str, ...], lags: int) -> Array:
    """[other readings; f(u)] of every lag, the newest first, (N - lags + 1, p)."""
    left = [o for o, name in enumerate(model.outputs) if name not in lost]
    signal = np.hstack([y[:, left], model.expanded(u)])
    return np.hstack([signal[lags - 1 - lag : len(signal) - lag] for lag in range(lags)])
