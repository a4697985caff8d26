"""A formulation of a third party: a finite impulse response whose coefficients decay, as a quadratic programme."""

import cvxpy as cp
import numpy as np

from optid import Data, HammersteinARX, Linear, Nonlinearity, Program
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
    if data.m != 1 or data.l != 1:
        raise StructureError(f"fir.decaying takes one input and one output, not {data.m} and {data.l}")
    if not (isinstance(length, int) and length > 0 and 0 < decay < 1 and weight >= 0):
        raise StructureError("length is a whole number from 1, decay lies between 0 and 1, weight is not negative")
    rows, targets = [], []
    for e in data.experiments:
        past = np.array([e.u[k - length + 1 : k + 1, 0][::-1] for k in range(length - 1, len(e.u))])
        whole = np.column_stack([past.reshape(-1, length), e.y[length - 1 :, 0]])
        whole = whole[~np.isnan(whole).any(axis=1)]
        rows.append(np.column_stack([whole[:, :-1], np.ones(len(whole))]))
        targets.append(whole[:, -1])
    regressor, target = np.vstack(rows), np.concatenate(targets)
    if len(target) < 1.1 * (length + 1):
        raise RankError(f"{len(target)} samples for {length + 1} unknowns; use a longer record or a shorter response")
    root = np.linalg.qr(np.column_stack([regressor, target]), mode="r")  # of the size of b, not of the record
    scale = float(target @ target)

    (low,), (high,) = data.ranges()
    line = Linear().fitted(float(low), float(high))

    b, offset = cp.Variable(length, name="b"), cp.Variable(1, name="offset")
    residual = cp.Variable(len(root), name="residual")
    error = root[:, -1] - root[:, :-1] @ cp.hstack([b, offset])
    penalty = weight * scale * cp.sum_squares(cp.multiply(decay ** (-0.5 * np.arange(length)), b))

    def recover(values):
        return HammersteinARX(np.zeros(0), (values["b"],), (Nonlinearity(line, np.ones(1)),), (0,), values["offset"],
                              data.dt, data.inputs, data.outputs, data.input_units, data.output_units)

    view = View({"b": b, "offset": offset}, kind="linear", channels=data.inputs, bases={data.inputs[0]: line},
                outputs=data.outputs)
    program = Program(
        "fir.decaying", cp.Minimize(cp.sum_squares(residual) + penalty), {"residual": (residual == error,)},
        {"b": b, "offset": offset, "residual": residual}, {}, recover, view, frozenset({"residual"}),
        derived={"residual": error}, scale=scale)
    return program.subject_to(*constraints)
