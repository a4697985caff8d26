"""A formulation of a third party: a finite impulse response whose coefficients decay, as a quadratic programme."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from optid import Data, HammersteinTF, Linear, Nonlinearity
from optid.bases import Basis
from optid.core.problem import Problem
from optid.core.terms import Squares
from optid.errors import RankError, StructureError


def decaying(data: Data, *, length: int, decay: float = 0.8, weight: float = 1e-3, constraints: tuple = ()) -> Problem:
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
    rough = np.diag(np.sqrt(weight * scale) * decay ** (-0.5 * np.arange(length)))
    return Problem(
        "fir.decaying", {"b": np.zeros(length), "offset": np.zeros(1)},
        (Squares(root[:, :-1], root[:, -1], 0.0, ("b", "offset")), Squares(rough, np.zeros(length), 0.0, ("b",))),
        model=partial(recover, data), facts=facts(data), builders=tuple(constraints), scale=scale, energy=scale)


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


def facts(data: Data) -> dict[str, Any]:
    """Return what constraints may ask besides the unknowns."""
    return {"channels": data.inputs, "bases": {data.inputs[0]: line(data)}, "outputs": data.outputs}


def line(data: Data) -> Basis:
    """Return the basis of a linear input over the range of the record."""
    ((low,), (high,)) = data.ranges()
    return Linear().with_interval(float(low), float(high))


def recover(data: Data, values: Mapping[str, np.ndarray]) -> HammersteinTF:
    """Return the model: A = 1, B the impulse response."""
    return HammersteinTF(np.zeros(0), (values["b"],), (Nonlinearity(line(data), np.ones(1)),), (0,), values["offset"],
                         data.dt, data.inputs, data.outputs, data.input_units, data.output_units)
