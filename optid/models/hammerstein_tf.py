"""Transfer-function Hammerstein models run over records: predictions, simulations and their initial states.

The state x (n, l) is what the past adds to the right-hand side of the next n equations: the observer form of the plant.
It shifts by one every sample and receives B_i f(u) - A_i y, so a free response is 1/A driven by the rows of x.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataError
from optid.models import noise_filter, roots
from optid.models.experiments import Record, check_inputs, samples_of, scaled_least_squares, signal_units
from optid.models.files import KINDS
from optid.models.recursions import autoregression
from optid.models.transfer_function import TransferFunction

FORGOTTEN = 1e-12
"""A free response below this share of its start no longer informs about the initial state."""


class HammersteinTF(TransferFunction):
    """A transfer-function model that predicts and simulates records; its arguments are those of `TransferFunction`."""

    SIMULATORS = ("predict", "free")

    @property
    def _state_shape(self) -> tuple[int, int]:
        return self.largest_lag, self.l

    def predict_record(self, u: Array, y: Any, horizon: int = 1, x0: Array | None = None, label: str = "") -> Array:
        """Predict one record in raw units; see `predict`. The arguments are those of `Model.predict_record`."""
        if self.structure == "arx":
            return self._regression(u, y, horizon)
        if self.structure == "armax":
            return self._noise_predicted(y, self.driven(u), horizon, self.memory)
        return super().predict_record(u, y, horizon, x0, label)

    def _predicted(self, u: Array, y: Array, horizon: int, state: Array, label: str) -> Array:
        x = self._simulated(u, state, label)
        return x + self._noise_predicted(y - x, None, horizon, 0)

    def _noise_predicted(self, s: Array, drive: Array | None, horizon: int, start: int) -> Array:
        """Predict s = drive + (C/D) e, (N, 1)."""
        c, d = self.c, self.noise_denominator
        found = noise_filter.innovations(s[:, 0], None if drive is None else drive[:, 0], c, d, start)
        return noise_filter.predict(found, c, d, horizon)[:, None]

    def _regression(self, u: Array, y: Array, horizon: int) -> Array:
        """Predict an ARX model from the outputs `horizon` and more samples before, and the inputs up to the sample."""
        right = self.driven(u)
        right[: self.memory] = np.nan
        shorter: list[Array] = []  # predictions 1, 2, ... samples ahead, as far back as A looks
        for ahead in range(1, horizon + 1):
            prediction = right.copy()
            if self.na:
                prediction[: self.memory + ahead - 1] = np.nan
            for i, matrix in enumerate(self.matrices, start=1):
                known = y if i >= ahead else shorter[-i]
                prediction[i:] -= known[: len(known) - i] @ matrix.T
            shorter = [*shorter[-max(self.na, 1) :], prediction]
        return shorter[-1]

    def driven(self, u: Array) -> Array:
        """Return the right-hand side sum_c B_c(q) f_c(u_c) + offset, (N, l), with nothing before the record."""
        right = np.tile(self.offset, (len(u), 1))
        for c, nonlinearity in enumerate(self.nonlinearities):
            f = nonlinearity(u[:, c])
            for lag, row in self.terms(c):
                if lag < len(u):
                    right[lag:] += f[: len(u) - lag, None] * row
        return right

    def _run(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        states = self._states(simulator, records, x0)
        self._warn_unstable()
        return [self._simulated(u, state, label) for (u, _, label), state in zip(records, states)]

    def _simulated(self, u: Array, state: Array, label: str = "") -> Array:
        """Compute the plant's outputs (N, l) from the inputs (N, m) and the state (n, l).

        Raises:
            DataError: a missing input, or an output that leaves the range of numbers; named by channel and sample.
        """
        check_inputs(self, u, label)
        right = self.driven(u)
        right[: len(state)] += state[: len(right)]
        y = autoregression(self.matrices, right)
        wild = ~np.isfinite(y).all(axis=1)
        if wild.any():
            k = int(np.argmax(wild))
            name = self.outputs[int(np.argmin(np.isfinite(y[k])))]
            raise DataError(
                f"{label}The simulated output {name!r} leaves the range of numbers at sample {k}: the largest pole has "
                f"radius {self.radius:.6g}. Identify the model with a stability constraint, or simulate fewer samples."
            )
        return y

    def _fitted(self, simulator: str, u: Array, y: Any, label: str) -> Array:
        """Estimate the initial state (n, l) by least squares of a simulator's errors, where outputs are present.

        The errors of each output count in units of its standard deviation, so that the estimate does not depend on
        units. Those of the prediction pass the inverse of the noise filter; ARX and ARMAX predictors have no state, the
        free run gives it. Directions that the record does not determine are set to zero.
        """
        n, outputs = self.largest_lag, self.l
        if n == 0:
            return np.zeros((0, outputs))
        whitened = simulator == "predict" and self.d is not None
        radius = max(self.radius, roots.radius(self.c) if whitened else 0.0)
        forgotten = 10 * n + (int(2 * np.log(FORGOTTEN) / np.log(radius)) if 0 < radius < 1 else 0)
        count = len(y) if radius >= 1 else min(len(y), forgotten)
        units, rest = signal_units(y), (y - self._simulated(u, np.zeros((n, outputs)), label))[:count]
        present = np.isfinite(rest)
        if not present.any():
            return np.zeros((n, outputs))
        free = self.inverse_impulse(count)
        columns = np.zeros((count, outputs, n, outputs))
        for i in range(min(n, count)):
            columns[i:, :, i] = free[: count - i]
        rest, columns = rest / units, columns.reshape(count, outputs, n * outputs) / units[:, None]
        if whitened:
            signals = np.where(present, np.column_stack([rest, columns[:, 0]]), np.nan).T
            errors = [noise_filter.innovations(s, None, self.c, self.noise_denominator).innovations for s in signals]
            rest, columns = errors[0][:, None], np.column_stack(errors[1:])[:, None]
        return scaled_least_squares(columns[present], rest[present]).reshape(n, outputs)

    def state(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Return the state (n, l) that follows the samples u (N, m) and y (N, l), N >= n, of the plant without noise.

        Row i is what these samples add to the right-hand side of the equation i samples ahead.

        Raises:
            DataError: too few samples, or one of the last n missing.
        """
        u, y, n = samples_of(u, "u", self.m), samples_of(y, "y", self.l), self.largest_lag
        if len(u) < n or len(u) != len(y):
            raise DataError(f"The state follows from {n} samples of u and y; got {len(u)} of u and {len(y)} of y.")
        u, y = u[len(u) - n :], y[len(y) - n :]
        check_inputs(self, u, "The last samples: ")
        if np.isnan(y).any():
            k, o = np.argwhere(np.isnan(y))[0]
            raise DataError(
                f"Output {self.outputs[o]!r} is missing {n - k} samples before the end: the state needs it."
            )
        return self.following(u, y)

    def following(self, u: Array, y: Array) -> Array:
        """Return the state (n, l) after n complete samples u (n, m) and y (n, l), see `state`, without checks."""
        n = self.largest_lag
        state = np.zeros((n, self.l))
        for i, matrix in enumerate(self.matrices, start=1):
            state[:i] -= y[n - i :] @ matrix.T
        for c, nonlinearity in enumerate(self.nonlinearities):
            f = nonlinearity(u[:, c])
            for lag, row in self.terms(c):
                state[:lag] += np.outer(f[n - lag :], row)
        return state


KINDS |= {"HammersteinTF": HammersteinTF.from_dict, "HammersteinARX": HammersteinTF.from_dict}
