"""Terms of an objective, as data. A term implements what it can, and solvers match on that.

Terms speak about named quantities, *leaves*: the unknowns of a problem, or what they determine (`optid.core.leaves`).
Values of leaves are arrays by name; a flat one runs column by column.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from optid.arrays import Array
from optid.errors import StructureError
from optid.program.expressions import has_kinks, jacobians
from optid.structures.rank_one import RankOne

Values = Mapping[str, Array]
TINY = float(np.finfo(float).tiny)
RANK = 1e-7  # singular value, relative to the largest, beneath which a matrix has lost rank
EMPTY = 1e-9  # length of a row, relative to the longest, beneath which it is zero


def flat(value: Any) -> Array:
    """Return an array in one dimension, column by column."""
    return np.ravel(value, order="F")


class Pull(NamedTuple):
    """Value of a smooth term, its gradient by every leaf (flat), and the magnitudes that the gradient is a sum of."""

    value: float
    gradient: dict[str, Array]
    magnitudes: dict[str, Array]


@dataclass(frozen=True, eq=False)
class Squares:
    """``‖root z - target‖² + remainder``, z the leaves one after another.

    Attributes:
        root: (k, n), sparse where it is large.
        target: (k,).
        remainder: what no leaf changes.
        z: names of the leaves.
        lifted: what special methods know of it: the same numbers with their rank-one blocks, or with groups.
    """

    root: Any
    target: Array
    remainder: float
    z: tuple[str, ...]
    lifted: Any = field(default=None, repr=False)

    @classmethod
    def of(cls, lifted: RankOne, z: tuple[str, ...]) -> "Squares":
        """Return the squares of a compressed record."""
        return cls(lifted.root, lifted.target, lifted.remainder, z, lifted)

    @classmethod
    def half(cls, target: Array, parts: Mapping[str, Array], lifted: Any = None) -> "Squares":
        """Return ``1/2 ‖target - sum parts[name] vec(name)‖²``, target (k,), parts (k, size) column by column."""
        root = np.sqrt(0.5)
        return cls(root * np.hstack(list(parts.values())), root * target, 0.0, tuple(parts), lifted)

    @classmethod
    def of_sum(cls, several: Sequence["Squares"], sizes: Mapping[str, int]) -> "Squares":
        """Return the sum of squares of leaves of these sizes as one, its root upper triangular."""
        z = tuple(dict.fromkeys(name for one in several for name in one.z))
        edges = np.cumsum([0, *(sizes[name] for name in z)])
        rows = []
        for one in several:
            wide = np.zeros((len(one.target), int(edges[-1]) + 1))
            columns = [np.arange(edges[z.index(name)], edges[z.index(name) + 1]) for name in one.z]
            wide[:, np.concatenate(columns)], wide[:, -1] = one.root, one.target
            rows.append(wide)
        wide = np.vstack([*rows, np.zeros((int(edges[-1]) + 1, int(edges[-1]) + 1))])
        triangle = np.asarray(np.linalg.qr(wide, mode="r"))
        remainder = float(triangle[-1, -1] ** 2) + sum(one.remainder for one in several)
        return cls(triangle[:-1, :-1], triangle[:-1, -1], remainder, z)

    def residual(self, y: Values) -> Array:
        """Return ``root z - target`` (k,)."""
        return self.root @ stack(y, self.z) - self.target

    def value(self, y: Values) -> float:
        """Return the value at values of the leaves."""
        r = self.residual(y)
        return float(r @ r) + self.remainder

    def pull(self, y: Values) -> Pull:
        """Return value and gradient."""
        r = self.residual(y)
        return Pull(float(r @ r) + self.remainder, split(2 * r @ self.root, y, self.z),
                    split(2 * np.abs(r) @ abs(self.root), y, self.z))

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the term in CVXPY expressions of the leaves."""
        return cp.sum_squares(self.root @ stacked_expression(v, self.z) - self.target) + self.remainder


@dataclass(frozen=True, eq=False)
class Length:
    """``‖root z - target‖``, the length itself: the square of a tiny one would vanish in a solver's tolerance."""

    root: Array
    target: Array
    z: tuple[str, ...]

    def value(self, y: Values) -> float:
        """Return the value at values of the leaves."""
        return float(np.linalg.norm(self.root @ stack(y, self.z) - self.target))

    def pull(self, y: Values) -> Pull:
        """Return value and gradient; zero where the length vanishes."""
        squares = Squares(self.root, self.target, 0.0, self.z).pull(y)
        size = float(np.sqrt(squares.value))
        return Pull(size, {name: g / (2 * max(size, TINY)) for name, g in squares.gradient.items()},
                    {name: g / (2 * max(size, TINY)) for name, g in squares.magnitudes.items()})

    def ease(self, y: Values, slope: Array, pull: Array, rest: float) -> Array:
        """Return what another subgradient adds to the gradient (unknowns,), so that less is left of a pull.

        The direction of a short residual is known no better than its entries, and all directions w within the unit
        ball with ``length - wᵀ residual`` of no more than the rest count as its gradient; the slope is that of the
        residual (k, unknowns).
        """
        r = self.root @ stack(y, self.z) - self.target
        size = float(np.linalg.norm(r))
        w = r / max(size, TINY)
        turned = w - np.linalg.lstsq(slope.T, pull, rcond=None)[0]
        turned /= max(1.0, float(np.linalg.norm(turned)))
        return slope.T @ (turned - w) if size - float(turned @ r) <= rest else np.zeros(len(pull))

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the term in CVXPY expressions of the leaves."""
        return cp.norm(self.root @ stacked_expression(v, self.z) - self.target)


@dataclass(frozen=True, eq=False)
class NuclearNorms:
    """``sum of weight ‖leaf‖_*``: kinks where a leaf loses rank. A negative weight is a `StructureError`."""

    weights: Mapping[str, float]

    def __post_init__(self) -> None:
        if not all(0 <= one < np.inf for one in self.weights.values()):
            raise StructureError("the weight of a nuclear norm must be a nonnegative number of no extreme size")

    def value(self, y: Values) -> float:
        """Return the value at values of the leaves."""
        return float(sum(t * np.sum(np.linalg.svd(y[name], compute_uv=False)) for name, t in self.weights.items()))

    def nearest(self, name: str, value: Array, pull: Array, rest: float = 0.0) -> Array:
        """Return the subgradient at a value of a leaf that is nearest to minus a pull, both in the leaf's shape.

        What changes the objective by no more than the rest counts as zero.
        """
        weight = self.weights[name]
        u, s, vt = np.linalg.svd(value, full_matrices=False)
        force = weight + float(np.linalg.norm(pull, 2))
        rank = int(np.sum((s > RANK * max(float(s[0]), TINY)) & (s * force > rest)))
        u, vt = u[:, :rank], vt[:rank]
        beside = -pull - u @ (u.T @ -pull)
        beside = beside - beside @ vt.T @ vt
        left, size, right = np.linalg.svd(beside, full_matrices=False)
        return weight * u @ vt + (left * np.minimum(size, weight)) @ right

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the term in CVXPY expressions of the leaves."""
        return sum_of([t * cp.normNuc(v[name]) for name, t in self.weights.items()])


@dataclass(frozen=True, eq=False)
class GroupNorms:
    """``sum of weight ‖row‖`` over the rows of leaves: kinks where a row vanishes."""

    weights: Mapping[str, Array]  # of every row

    def value(self, y: Values) -> float:
        """Return the value at values of the leaves."""
        return float(sum(np.sum(t * np.linalg.norm(y[name], axis=-1)) for name, t in self.weights.items()))

    def nearest(self, name: str, value: Array, pull: Array, rest: float = 0.0) -> Array:
        """Return the subgradient at a value of a leaf that is nearest to minus a pull, both in the leaf's shape.

        What changes the objective by no more than the rest counts as zero.
        """
        weight = np.reshape(self.weights[name], (-1, 1))
        size, most = (np.linalg.norm(x, axis=-1, keepdims=True) for x in (value, pull))
        inside = -pull * np.minimum(1.0, weight / np.maximum(most, TINY))
        there = (size > EMPTY * max(float(size.max()), TINY)) & (size * (weight + most) > rest)
        return np.where(there, weight * value / np.maximum(size, TINY), inside)

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the term in CVXPY expressions of the leaves."""
        return sum_of([cp.sum(cp.multiply(t, self._lengths(v[name]))) for name, t in self.weights.items()])

    @staticmethod
    def _lengths(rows: cp.Expression) -> Any:
        if rows.ndim == 2 and rows.shape[1] == 1:  # a linear programme
            return cp.abs(rows[:, 0])
        return cp.norm(rows, 2, axis=1) if rows.ndim == 2 else cp.norm(rows, 2)


@dataclass(frozen=True, eq=False)
class Errors:
    """Squared errors of a run of the model, nonlinear in the unknowns.

    Attributes:
        linearise: values of the unknowns -> the `Squares` of the errors to first order in them.
        measure: values of the unknowns -> sum of squares, infinite where the run is not admissible.
        criterion: what the errors are of, for methods that take steps with them; see
            `optid.identify.prediction_error.criterion`.
    """

    linearise: Callable[[Values], Squares]
    measure: Callable[[Values], float]
    criterion: Any = field(default=None, repr=False)

    def value(self, y: Values) -> float:
        """Return the value at values of the leaves."""
        return self.measure(y)

    def pull(self, y: Values) -> Pull:
        """Return value and gradient."""
        return self.linearise(y).pull(y)


@dataclass(frozen=True, eq=False)
class Expressed:
    """Any scalar expression of CVXPY's atoms: linear, smooth or with kinks.

    Attributes:
        build: leaves by name, as expressions -> the expression.
    """

    build: Callable[[Mapping[str, Any]], cp.Expression]

    def value(self, y: Values) -> float:
        """Return the value at values of the leaves."""
        return float(np.asarray(self._at(y)[0].value))

    def pull(self, y: Values) -> Pull:
        """Return value and gradient; NaN where CVXPY knows none, or it would say nothing."""
        expression, variables = self._at(y)
        slopes = None if has_kinks(expression) else jacobians(expression)
        parts = {} if slopes is None else {one.name(): flat(part.toarray() if sp.issparse(part) else part)
                                           for one, part in slopes.items()}
        missing = np.nan if slopes is None else 0.0
        gradient = {name: parts.get(name, np.full(one.size, missing)) for name, one in variables.items()}
        return Pull(float(np.asarray(expression.value)), gradient, {name: abs(one) for name, one in gradient.items()})

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the term in CVXPY expressions of the leaves."""
        return self.build(v)

    def _at(self, y: Values) -> tuple[cp.Expression, dict[str, cp.Variable]]:
        """Return the expression in variables of its own, which hold the values of the leaves."""
        variables = {name: cp.Variable(np.shape(value), name=name) for name, value in y.items()}
        for name, variable in variables.items():
            variable.save_value(np.asarray(y[name], dtype=float))
        return self.build(variables), variables


Term = Any  # any of these, or one of its own: what it implements decides who can use it


def stack(y: Values, names: tuple[str, ...]) -> Array:
    """Return named leaves one after another."""
    return np.concatenate([flat(y[name]) for name in names])


def split(vector: Array, y: Values, names: tuple[str, ...]) -> dict[str, Array]:
    """Return the parts of a vector that belong to leaves one after another."""
    return dict(zip(names, np.split(vector, np.cumsum([np.size(y[name]) for name in names])[:-1])))


def sum_of(expressions: Sequence[Any]) -> cp.Expression:
    """Return the sum of expressions."""
    found: cp.Expression = cp.Constant(0.0)
    for one in expressions:
        found = found + one
    return found


def stacked_expression(v: Mapping[str, cp.Expression], names: tuple[str, ...]) -> cp.Expression:
    """Return expressions of named leaves one after another."""
    return cp.hstack([cp.vec(v[name], order="F") for name in names])
