"""Linear ARX with constraints: the smallest example of a formulation.

``A(q) y = sum_c B_c(q) u_c + d + e``. Named variables: ``a``, ``b`` (``b[input]`` with several inputs), ``offset``.
"""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.equation_error import EquationError, compress, residual_programme
from formulations.losses import degree, with_loss
from optid.bases import Linear
from optid.data.record import Data
from optid.data.streams import Stream
from optid.models import HammersteinARX
from optid.program.program import Program, Values
from optid.solving.solve import Procedure
from optid.structures.least_squares import LeastSquaresStructure


def arx(data: Data | Stream, *, na: int, nb: int | Sequence[int], nk: int | Sequence[int] = 0,
        constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0) -> Program | Procedure:
    """Pose ``min ‖Y - Phi_y a - Phi_u b - d‖²``.

    Named variables: ``a``, ``b``, ``offset``.

    Args:
        data: the record.
        na: number of past outputs in A.
        nb: number of coefficients of B, one per input or one for all.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders of CVXPY constraints in ``a``, ``b``, ``offset``.
        loss: "squares", "huber[:threshold]" or "l1".
        ridge: weight of ``‖b‖²``.

    Raises:
        StructureError: impossible orders or nonconvex constraints.
        RankError: the record does not determine the parameters.
    """
    options = {"na": na, "nb": nb, "nk": nk, "basis": Linear(), "ridge": ridge, "degree": degree(loss)}

    def pose(weights: list[np.ndarray] | None = None) -> tuple[Program, EquationError]:
        problem = compress(data, weights=weights, **options)
        return _arx(problem, constraints), problem

    return with_loss(loss, data, pose, convex=True)


def _arx(problem: EquationError, constraints: Sequence[Any]) -> Program:
    linear = problem.linear_variables()
    keys = [problem.key("b", c) for c in range(len(problem.channels))]
    numerators = {key: cp.Variable(problem.b_shape(c), name=key) for c, key in enumerate(keys)}

    def recover(values: Values) -> HammersteinARX:
        ones = [np.ones(1)] * len(keys)
        return problem.model(values, ones, [values[key] for key in keys], gauge="none", flip=False)

    return residual_programme(
        problem, "arx", {**linear, **numerators}, problem.residual(linear, list(numerators.values())), start={},
        recover=recover, view=problem.view({**linear, **numerators}),
        structure=LeastSquaresStructure(problem.problem, (*linear, *keys), ())).subject_to(*constraints)
