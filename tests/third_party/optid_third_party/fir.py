"""A formulation of a third party: a finite impulse response whose coefficients decay, as a quadratic programme."""

from collections.abc import Mapping
from functools import partial

import cvxpy as cp
import numpy as np

from optid import Data, HammersteinTF, Linear, Nonlinearity, Program
from optid.bases import Basis
from optid.errors import RankError, StructureError
from optid.program.view import View


def decaying(data: Data, *, length: int, decay: float = 0.8, weight: float = 1e-3, constraints: tuple = ()) -> Program:
    """Pose ``min ‖y - sum_j b_j u(t - j) - d‖² + weight yᵀy sum_j b_j² decay^-j`` for one input and one output.

    Args:
        data: the record; samples that touch a missing one are left out.
        length: number of coefficients.
        decay: how fast they are expected to decay per sample.
        weight: of that expectation.
        constraints: on ``b`` and ``offset``.
    """
    if not (0 < decay < 1 and weight >= 0):
        raise StructureError("decay must lie between 0 and 1, weight must not be negative")
    root, scale = triangle(data, length)
    b, offset = cp.Variable(length, name="b"), cp.Variable(1, name="offset")
    residual = cp.Variable(len(root), name="residual")
    error = root[:, -1] - root[:, :-1] @ cp.hstack([b, offset])
    penalty = weight * scale * cp.sum_squares(cp.multiply(decay ** (-0.5 * np.arange(length)), b))

    program = Program(
        "fir.decaying", cp.Minimize(cp.sum_squares(residual) + penalty), {"residual": (residual == error,)},
        {"b": b, "offset": offset, "residual": residual}, {}, partial(recover, data),
        view_of(data, b, offset), frozenset({"residual"}),
        derived={"residual": error}, scale=scale)
    return program.subject_to(*constraints)


def triangle(data: Data, length: int) -> tuple[np.ndarray, float]:
    """Return the R factor of [u(t) .. u(t - length + 1), 1, y(t)], of the size of b, and the energy of y."""
    if data.m != 1 or data.l != 1:
        raise StructureError(f"an impulse response takes one input and one output, not {data.m} and {data.l}")
    if not (isinstance(length, int) and length > 0):
        raise StructureError(f"length must be a positive integer, not {length!r}")
    blocks = []
    for e in data.experiments:
        past = np.array([e.u[k - length + 1 : k + 1, 0][::-1] for k in range(length - 1, len(e.u))])
        whole = np.column_stack([past.reshape(-1, length), np.ones(max(len(past), 0)), e.y[length - 1 :, 0]])
        blocks.append(whole[~np.isnan(whole).any(axis=1)])
    rows = np.vstack(blocks)
    if len(rows) < 1.1 * (length + 1):
        raise RankError(f"{len(rows)} samples for {length + 1} unknowns; use a longer record or a shorter response")
    return np.linalg.qr(rows, mode="r"), float(rows[:, -1] @ rows[:, -1])


def view_of(data: Data, b: cp.Variable, offset: cp.Variable) -> View:
    """Return what constraints may speak about."""
    return View({"b": b, "offset": offset}, channels=data.inputs, bases={data.inputs[0]: line(data)},
                outputs=data.outputs)


def line(data: Data) -> Basis:
    """Return the basis of a linear input over the range of the record."""
    ((low,), (high,)) = data.ranges()
    return Linear().fitted(float(low), float(high))


def recover(data: Data, values: Mapping[str, np.ndarray]) -> HammersteinTF:
    """Return the model: A = 1, B the impulse response."""
    return HammersteinTF(np.zeros(0), (values["b"],), (Nonlinearity(line(data), np.ones(1)),), (0,), values["offset"],
                          data.dt, data.inputs, data.outputs, data.input_units, data.output_units)
