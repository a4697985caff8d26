"""The nuclear norm of a block Hankel matrix of outputs, as a term, and the form of problems with it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from optid.core.form import Form
from optid.core.terms import Squares, Values
from optid.structures.nuclear_norm import NuclearProblem


@dataclass(frozen=True, eq=False)
class LowRank:
    """``‖left H(yhat) right - T Phi‖_*``, convex in the outputs ``yhat`` and the coefficients ``T`` of known signals.

    Attributes:
        numbers: record, weights and known signals; ``T`` is an unknown only where there are such signals.
    """

    numbers: NuclearProblem

    def start(self) -> dict[str, np.ndarray]:
        """Return the measured outputs, and the coefficients that explain most of them."""
        numbers = self.numbers
        explained = {} if numbers.predictor is None else {
            "T": numbers.predictor_coefficients(numbers.hankel(numbers.data))}
        return {"yhat": numbers.data, **explained}

    def misfit(self, weight: float) -> Squares:
        """Return the term ``weight ‖yhat - y‖²`` of the outputs that were measured."""
        known, y = np.flatnonzero(self.numbers.known.ravel()), self.numbers.data
        places = np.arange(y.size).reshape(y.shape).ravel(order="F")  # of the entries column by column
        chosen = sp.csr_array((np.full(y.size, np.sqrt(weight)), (places, np.arange(y.size))), (y.size, y.size))[known]
        return Squares(chosen, np.sqrt(weight) * y.ravel()[known], 0.0, ("yhat",))

    def matrix(self, y: Values) -> np.ndarray:
        """Return the matrix at values of the unknowns."""
        return self.numbers.matrix(np.asarray(y["yhat"]), np.asarray(y.get("T", np.zeros((0, self.numbers.l)))))

    def value(self, y: Values) -> float:
        """Return the value at values of the unknowns."""
        return float(np.linalg.norm(self.matrix(y), "nuc"))

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the matrix, of which the term is the nuclear norm, in CVXPY expressions of the unknowns."""
        numbers, flat = self.numbers, cp.vec(v["yhat"], order="C")
        matrix: Any = cp.reshape(flat[numbers.index.ravel(order="F")], numbers.index.shape, order="F")
        matrix = matrix if numbers.left is None else numbers.left @ matrix
        matrix = matrix if numbers.right is None else matrix @ numbers.right
        return matrix if numbers.predictor is None else matrix - self._explained(v["T"])

    def _explained(self, theta: cp.Expression) -> cp.Expression:
        """``T Phi`` plus constants: one regression matrix serves all outputs."""
        numbers, predictor = self.numbers, self.numbers.predictor
        assert predictor is not None
        regressors = np.stack([predictor.apply(column[:, None]).ravel() for column in np.eye(predictor.size)], axis=1)
        l, rows, j = numbers.l, numbers.rows, len(numbers.starts)  # noqa: E741
        flat = cp.vec(regressors @ theta, order="C")  # by block row, window, output
        where = (np.arange(rows)[:, None, None] * j + np.arange(j)[None, None, :]) * l + np.arange(l)[None, :, None]
        return cp.reshape(flat[where.reshape(rows * l, j).ravel(order="F")], (rows * l, j), order="F")


@dataclass(frozen=True, eq=False)
class LowRankForm(Form):
    """``F = ‖matrix(v, theta)‖_* + weight ‖v - y‖²`` in ``yhat`` = v and ``T`` = theta.

    ``T`` is there with a predictor only. The multipliers ``structure`` are those of the equation for the matrix.
    """

    word: ClassVar[str] = "nuclear"
    problem: NuclearProblem
    weight: float

    @classmethod
    def of(cls, problem: Any) -> "LowRankForm | None":
        """Return the form of a low-rank matrix and the misfit of its outputs."""
        match problem.terms:
            case (LowRank(numbers=numbers), Squares()) if not problem.restrictions:
                return cls(numbers, problem.weights["weight"])
        return None

    @property
    def about(self) -> str:
        """What the problem is and how large."""
        return f"nuclear norm of a Hankel matrix, {self.problem.shape} entries"
