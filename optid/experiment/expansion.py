"""The expanded regressor: functions of the inputs, and the part of functions of the outputs that is not linear in them.

The linear part of the feedback cannot be told from the dynamics: (A, B, linear part of E g) and (A - L C, B - L D, that
part + L y) behave alike for every L, so functions of y enter orthogonal to 1 and y on the record.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optid.bases import Linear, fitted_bases
from optid.bases.basis import Array, Basis
from optid.data import Data

LINEAR = 1e-6
"""A direction of functions of y is linear in y when no more than this share of its size is orthogonal to 1 and y."""

Bases = Basis | str | Sequence[Basis | str]


@dataclass(frozen=True, eq=False)
class Expansion:
    """The signals that drive the linear part of a Hammerstein system with nonlinear feedback.

    Attributes:
        inputs: one basis per input.
        feedback: one basis per output; empty without feedback.
        linear: (1 + l, q) coefficients of 1 and y that are subtracted from the q functions of y.
        directions: (q, r) combinations of what is left that are not linear in y, of unit standard deviation.
        nonlinear: per output, the largest ratio over its functions of the standard deviation of the part orthogonal to
            1 and y to the standard deviation of the function itself.
        names: of the P + r signals.
    """

    inputs: tuple[Basis, ...]
    feedback: tuple[Basis, ...]
    linear: Array
    directions: Array
    nonlinear: tuple[float, ...]
    names: tuple[str, ...]

    def __call__(self, samples: Array) -> Array:
        """Return the signals (T, P + r) of raw channels (T, m + l), inputs first."""
        m = len(self.inputs)
        eta = [basis.values(samples[:, c]) for c, basis in enumerate(self.inputs)]
        if not self.directions.shape[1]:
            return np.hstack(eta)
        y = samples[:, m:]
        zeta = functions_of(y, self.feedback) - np.column_stack([np.ones(len(y)), y]) @ self.linear
        return np.hstack([*eta, zeta @ self.directions])

    @property
    def eta_sizes(self) -> tuple[int, ...]:
        """Number of functions of each input."""
        return tuple(basis.size for basis in self.inputs)


def functions_of(samples: Array, bases: Sequence[Basis]) -> Array:
    """Return the functions of all channels (T, c) side by side."""
    return np.hstack([basis.values(samples[:, c]) for c, basis in enumerate(bases)])


def expansion(data: Data, basis: Bases, feedback: Bases | None = None) -> Expansion:
    """Fit the bases to a record and orthogonalise the functions of the outputs.

    Args:
        data: the record.
        basis: of the inputs, one for all or one per input.
        feedback: of the outputs, one for all or one per output; None without feedback.

    Raises:
        StructureError: a wrong number of bases.
        DataError: a constant channel.
    """
    inputs = fitted_bases(data, basis)
    eta_names = [f"{basis_name(b, i)} of {channel}" for channel, b in zip(data.inputs, inputs) for i in range(b.size)]
    if feedback is None:
        return Expansion(inputs, (), np.zeros((1 + data.l, 0)), np.zeros((0, 0)), (), tuple(eta_names))
    outputs = fitted_bases(outputs_as_inputs(data), feedback)
    y = np.concatenate([e.y for e in data.experiments])
    y = y[~np.isnan(y).any(axis=1)]
    zeta = functions_of(y, outputs)
    regressors = np.column_stack([np.ones(len(y)), y])
    linear: Array = np.asarray(np.linalg.lstsq(regressors, zeta, rcond=None)[0], dtype=np.float64)
    rest = zeta - regressors @ linear
    size = zeta.std(axis=0)
    size[size == 0] = 1.0
    ratios = rest.std(axis=0) / size
    starts = np.cumsum([0, *(b.size for b in outputs)])
    nonlinear = tuple(float(ratios[a:b].max()) for a, b in zip(starts[:-1], starts[1:]))
    _, values, right = np.linalg.svd(np.linalg.qr(rest / size, mode="r"))
    kept = values > LINEAR * np.sqrt(len(y))
    directions = (right[kept] / size).T / values[kept] * np.sqrt(len(y))
    names = [f"feedback direction {i + 1}" for i in range(directions.shape[1])]
    return Expansion(inputs, outputs, linear, directions, nonlinear, (*eta_names, *names))


def outputs_as_inputs(data: Data) -> Data:
    """Return the record with its outputs in the place of its inputs, for what is written for inputs."""
    return Data([e.y for e in data.experiments], [e.y for e in data.experiments], data.dt, inputs=list(data.outputs),
                outputs=[f"{name} again" for name in data.outputs])


def basis_name(basis: Basis, i: int) -> str:
    """Return the name of function i of a basis, as messages have it."""
    return "the value" if isinstance(basis, Linear) else f"function {i + 1}"
