"""Curvature of a plant that a Hammerstein model does not have: products of its signals that drive its states.

The model is linear behind functions of the inputs. Behind a controller inputs and outputs move together, so that the
curvature of the plant passes for that of these functions: a healthy record is explained, but a loss of effect, which
moves the inputs and not the outputs, seems too small. The products of the outputs with one another and with the inputs,
and the cubes of the inputs, are therefore further parameters, zero in the model, of which the record of identification
gives the covariance, together with that of the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.data.record import Experiment
from optid.data.stretches import interpolate_missing
from optid.faults.whitening import Predictor


@dataclass(frozen=True, eq=False)
class Products:
    """The products, of signals relative to their ranges in the record of identification."""

    low: Array  # (m + l,) lowest inputs and outputs
    high: Array  # (m + l,) highest ones
    inputs: int  # number m of inputs

    @classmethod
    def of(cls, parts: Sequence[Experiment]) -> "Products":
        """Return the products of the signals of some experiments."""
        both = np.vstack([np.hstack([part.u, part.y]) for part in parts])
        return cls(np.fmin.reduce(both), np.fmax.reduce(both), parts[0].u.shape[1])

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The numbers of the signals of each product, the inputs first; those of a cube are the same."""
        m, every = self.inputs, range(len(self.low))
        return [(i, j) for i in every for j in every if max(i, m) <= j or i == j < m]

    def coefficients(self, states: int) -> int:
        """Return the number of coefficients of a model with so many states."""
        return states * len(self.pairs)

    def response(self, steady: Predictor, part: Experiment, present: Array) -> Array:
        """Return the response (N, l, K n) of the innovations to unit coefficients, those of a product together."""
        n, (count, l) = len(steady.A), present.shape  # noqa: E741
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        z = np.nan_to_num((2 * np.hstack([part.u, interpolate_missing(part.y)]) - self.low - self.high) / span)
        into_state = np.zeros((count, n, self.coefficients(n)))
        for number, (i, j) in enumerate(self.pairs):
            product = z[:-1, i] ** 3 if i == j < self.inputs else z[:-1, i] * z[:-1, j]
            into_state[1:, range(n), range(number * n, (number + 1) * n)] = product[:, None]
        return steady.respond(into_state, np.zeros((count, l, into_state.shape[2])), present)
