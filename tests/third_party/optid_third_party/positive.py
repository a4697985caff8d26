"""A structure of a third party with its solver and its certificate: an impulse response that is nowhere negative.

    min ‖y - sum_j b_j u(t - j) - d‖²   subject to   b >= 0
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import cvxpy as cp
import numpy as np
from scipy.optimize import lsq_linear

from optid import Bound, Data, Program
from optid.backends import Answer, BackEnd, Settings
from optid.program.solution import Status, relative_gap
from optid.program.structure import Structure
from optid.program.view import View
from optid_third_party.fir import facts, recover, triangle


@dataclass(frozen=True, eq=False)
class PositiveLeastSquares(Structure):
    """``‖matrix [b; offset] - target‖²`` with b >= 0."""

    word: ClassVar[str] = "positive"
    matrix: np.ndarray
    target: np.ndarray

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return that of the sum of squares at [b; offset]."""
        return 2.0 * self.matrix.T @ (self.matrix @ x - self.target)


def positive(data: Data, *, length: int, constraints: tuple = ()) -> Program:
    """Pose the fit for one input and one output. Named variables: ``b``, ``offset``.

    Args:
        data: the record; samples that touch a missing one are left out.
        length: number of coefficients.
        constraints: on ``b`` and ``offset``.
    """
    root, scale = triangle(data, length)
    b, offset = cp.Variable(length, name="b"), cp.Variable(1, name="offset")
    program = Program(
        "fir.positive", cp.Minimize(cp.sum_squares(root[:, :-1] @ cp.hstack([b, offset]) - root[:, -1])),
        {"positive": (b >= 0,)}, {"b": b, "offset": offset}, {}, partial(recover, data),
        View({"b": b, "offset": offset}, **facts(data)),
        frozenset({"positive"}), structure=PositiveLeastSquares(root[:, :-1], root[:, -1]), certify=certify,
        scale=scale)
    return program.subject_to(*constraints)


def certify(program: Program, values: Any, duals: Any) -> tuple[Bound, None]:
    """Return the least value of the quadratic's lower model ``F + gradientᵀd + sigma² ‖d‖²`` over all b + d >= 0."""
    problem = program.structure
    if not isinstance(problem, PositiveLeastSquares) or program.user_constraints:
        return Bound.none("the bound knows no constraint but b >= 0"), None
    x = np.concatenate([values["b"], values["offset"]])
    slope, value = problem.gradient(x), float(np.sum((problem.matrix @ x - problem.target) ** 2))
    curvature = float(np.linalg.svd(problem.matrix, compute_uv=False)[-1]) ** 2
    least = np.append(-values["b"], -np.inf)
    d = np.maximum(-slope / (2 * curvature), least)
    bound = value + float(slope @ d + curvature * d @ d)
    gap = relative_gap(value, bound, program.scale)
    return Bound(bound, gap < 1e-6, "strong convexity", f"relative gap {gap:.1e}"), None


def run(program: Program, settings: Settings) -> Answer:
    """Solve by the active-set method of SciPy."""
    problem = program.structure
    assert isinstance(problem, PositiveLeastSquares)
    low = np.append(np.zeros(problem.matrix.shape[1] - 1), -np.inf)
    found = lsq_linear(problem.matrix, problem.target, (low, np.inf), method="bvls", tol=1e-14)
    if not found.success:
        return Answer(Status.LIMIT, found.message)
    return Answer(Status.LOCAL, found.message, {"b": found.x[:-1], "offset": found.x[-1:]},
                  {"positive": np.maximum(problem.gradient(found.x)[:-1], 0.0)}, found.nit)


back_end = BackEnd("active_set", frozenset(), run, structures=(PositiveLeastSquares,),
                   about="a third party's active-set method")
