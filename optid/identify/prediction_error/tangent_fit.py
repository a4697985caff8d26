"""What a formulation hands to the iteration: named variables, the programme of a step, and the model of its values."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.identify.prediction_error.descent import Criterion
from optid.models.gauges import leading_sign
from optid.program.compressed import Spread, white_spread
from optid.program.judging import measure_violation
from optid.program.program import Program, Values
from optid.statistics.linearised import Linearised
from optid.statistics.unknowns import Unknowns


@dataclass(frozen=True, eq=False)
class Places:
    """Named variables, and where each stands in the vector of the unknowns."""

    unknowns: Unknowns  # the order of the vector
    names: Mapping[str, str]  # {variable: part of the vector}, in its order; "x0" is the initial states

    @classmethod
    def of(cls, criterion: Criterion) -> "Places":
        """Name the parts by the keys of a criterion."""
        found, unknowns = {}, criterion.unknowns
        for part, shape in unknowns.shapes.items():
            kind = part.rstrip("0123456789")
            if np.prod(shape):
                found[part if kind == part else criterion.key(kind, int(part[len(kind) :]))] = part
        return cls(unknowns, {**found, "x0": "x0"} if unknowns.memory else found)

    def values(self, x: Array) -> dict[str, Array]:
        """Name the parts of x; initial states are (n,), or (n, experiments)."""
        unknowns, parts = self.unknowns, self.unknowns.parts(x)
        states = x[unknowns.shared :].reshape(unknowns.experiments, unknowns.memory).T
        parts["x0"] = states if unknowns.experiments > 1 else states[:, 0]
        return {name: parts[part] for name, part in self.names.items()}

    def pack(self, values: Mapping[str, Array]) -> Array:
        """Return x of named values."""
        return np.concatenate([np.ravel(values[name], order="F" if part == "x0" else "C")
                               for name, part in self.names.items()]).astype(float)

    def variables(self) -> dict[str, cp.Variable]:
        """Return new CVXPY variables."""
        return {name: cp.Variable(value.shape, name=name)
                for name, value in self.values(np.zeros(self.unknowns.size)).items()}

    def stacked(self, variables: Mapping[str, cp.Variable]) -> cp.Expression:
        """Return the variables as the vector of the unknowns."""
        return cp.hstack([variables[name] if variables[name].ndim == 1 else
                          cp.vec(variables[name], order="F" if part == "x0" else "C")
                          for name, part in self.names.items()])


@dataclass(frozen=True, eq=False)
class TangentFit(ABC):
    """A fit by programmes in the tangent of an iterate; a formulation states the programme and its model."""

    name: str  # of the formulation
    criterion: Criterion  # the errors, in the gauge of the programmes
    constraints: tuple[Any, ...]  # the user's

    @abstractmethod
    def pose(self, z0: Array, at: Linearised, damping: float) -> Program:
        """State the programme of the step from z0, with the user's constraints; ``at`` are the errors near z0."""

    @abstractmethod
    def recover(self, values: Values) -> Any:
        """Return the model of the values of the variables."""

    @cached_property
    def places(self) -> Places:
        """The named variables in the order of the unknowns."""
        return Places.of(self.criterion)

    def signed(self, x: Array) -> Array:
        """Turn the signs of mu and b to where the constraints are violated least.

        A monotone f or a sign of the gain says which of the two equal descriptions is meant; where it asks for the
        opposite characteristic, mu or b alone is turned, since no tangent step leads through zero.
        """
        x, at = self.criterion.normalised(x), self.criterion.unknowns.slices
        errors = self.criterion.linearise(x) if self.constraints else None
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            if not mu.startswith("mu"):  # the signs of feedback functions stay
                continue
            best, chosen = np.inf, x
            first = leading_sign(x[at[b]])
            for mu_sign, b_sign in ((first, first), (-first, -first), (-first, first), (first, -first)):
                turned = np.array(x)
                turned[at[mu]] *= mu_sign
                turned[at[b]] *= b_sign
                outside = 0.0 if errors is None else violation(self.pose(turned, errors, 0.0))
                if outside < (best if mu_sign == b_sign else 0.5 * best):
                    best, chosen = outside, turned
                if best <= 1e-9:
                    break
            x = chosen
        return x


def violation(program: Program) -> float:
    """Return the largest relative violation of the constraints at the iterate of a programme."""
    program.assign(program.view.reference)
    return measure_violation(program)[0]


class LeastSquares(NamedTuple):
    """``‖root z - target‖² + remainder``."""

    root: Array
    target: Array
    remainder: float


class ErrorRows(NamedTuple):
    """The triangular factor ``root`` (n + 1, n + 1) of [sensitivities | errors], and the rows it came from."""

    root: Array
    rows: int
    candidates: int
    condition: float
    method: str


@dataclass(eq=False)
class CompressedErrors:
    """The compressed errors near an iterate, for uncertainty, prices and figures."""

    criterion: Criterion  # the errors
    at: Linearised  # these near the iterate
    reference: Array  # (n,) variables of the iterate, flattened: z

    @cached_property
    def places(self) -> Places:
        """Where the variables stand in z."""
        return Places.of(self.criterion)

    @property
    def energy(self) -> Array:
        """Sum of squares of the output about its mean, (1,)."""
        return np.array([self.criterion.energy])

    @property
    def problem(self) -> LeastSquares:
        """The sum of squares in z."""
        root, errors = self.at.whole
        return LeastSquares(root, root @ self.reference - errors, self.at.remainder)

    @property
    def statistics(self) -> ErrorRows:
        """The same as a factor of rows."""
        size, (matrix, errors) = len(self.reference), self.at.whole
        root = np.zeros((size + 1, size + 1))
        root[:size, :size], root[:size, size] = matrix, matrix @ self.reference - errors
        root[size, size] = np.sqrt(self.at.remainder)
        candidates = sum(e.y.size for e in self.criterion.data.experiments)
        return ErrorRows(root, self.at.rows, candidates, self.condition, self.at.method)

    @property
    def condition(self) -> float:
        """Condition number of the scaled sensitivities."""
        return self.at.condition

    @property
    def columns(self) -> NDArray[np.intp]:
        """Positions (n, 1) in z of the coefficients of the columns."""
        return np.arange(len(self.reference))[:, None]

    def lifted(self, values: Mapping[str, Array]) -> Array:
        """Return z."""
        return self.places.pack(values)

    def one_step_fit(self, values: Mapping[str, Array]) -> Array | None:
        """Return the fit in % on the record: one step ahead an output-error model predicts what it simulates."""
        value = self.at.after(self.lifted(values) - self.reference)
        return 100.0 * (1.0 - np.sqrt(value / np.maximum(self.energy, 1e-300)))

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter under white errors."""
        return white_spread(self, z, moves)
