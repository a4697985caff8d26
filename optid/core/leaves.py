"""Quantities that unknowns determine, and that terms and constraints speak about besides the unknowns themselves.

Every leaf is its own CVXPY variable in the words of the user, so that a constraint about ``Theta = mu bᵀ`` is
affine; its values and slopes in the unknowns follow by the chain rule.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp
from cvxpy.lin_ops.lin_utils import ID_COUNTER, get_id
from numpy.typing import NDArray

from optid.arrays import Array, kron
from optid.core.terms import Values, flat

DENSE = 1_000_000  # entries of a matrix up to which it is an array
GAUGE = "gauge"  # of the constraints that fix the scale between the factors of products, which no objective sees
ZERO = 1e-9  # an unknown without a start that is smaller than this has no size to measure by


@dataclass(frozen=True)
class Product:
    """``Theta = mu bᵀ``, with the gauge that fixes the scale between its factors.

    Attributes:
        mu, b: names of the unknowns; b may be a matrix, whose columns follow one another.
        gauge: "norm" (‖b‖ = 1), "gain" (sum of b = 1 + sum of a) or "b0" (first coefficient one); "" for none, where
            the objective fixes it.
    """

    mu: str
    b: str
    gauge: str = "norm"

    @property
    def name(self) -> str:
        """Name of the product: ``Theta`` of ``mu``, ``Theta[valve]`` of ``mu[valve]``."""
        return "Theta" + self.mu.removeprefix("mu")

    def value(self, x: Values) -> Array:
        """Return the product (P, size of b)."""
        return np.outer(x[self.mu], flat(x[self.b]))

    def slope(self, x: Values) -> dict[str, Array]:
        """Return the derivative of the flat product by every factor."""
        mu, b = flat(x[self.mu]), flat(x[self.b])
        return {self.mu: kron(b[:, None], np.eye(mu.size)), self.b: kron(np.eye(b.size), mu[:, None])}

    def chain(self, pull: Array, x: Values) -> dict[str, Array]:
        """Return ``slopeᵀ pull`` without forming the slope."""
        b = flat(x[self.b])
        matrix = pull.reshape(b.size, -1)
        return {self.mu: b @ matrix, self.b: matrix @ flat(x[self.mu])}

    def level(self, x: Values) -> tuple[float, dict[str, Array]]:
        """Return what the gauge holds at zero, and its slope by the unknowns."""
        b = flat(x[self.b])
        if self.gauge == "norm":
            return float(b @ b) - 1.0, {self.b: 2 * b}
        if self.gauge == "b0":
            return float(b[0]) - 1.0, {self.b: np.eye(b.size)[0]}
        a = flat(x.get("a", np.zeros(0)))
        return float(b.sum() - a.sum()) - 1.0, {self.b: np.ones(b.size), **({"a": -np.ones(a.size)} if a.size else {})}

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the product in CVXPY expressions of its factors."""
        return cp.outer(v[self.mu], cp.vec(v[self.b], order="F"))

    def condition(self, v: Mapping[str, cp.Expression]) -> Any:
        """Return the gauge as a CVXPY constraint on expressions of the unknowns."""
        b = cp.vec(v[self.b], order="F")
        if self.gauge == "norm":
            return cp.sum_squares(b) == 1
        return b[0] == 1 if self.gauge == "b0" else cp.sum(b) == 1 + (cp.sum(v["a"]) if "a" in v else 0)

    def tangent(self, v: Mapping[str, cp.Expression], x: Values) -> Any:
        """Return the gauge to first order about a point."""
        level, parts = self.level(x)
        return level + sum(part @ (cp.vec(v[name], order="F") - flat(x[name])) for name, part in parts.items()) == 0

    def in_gauge(self, x: Values) -> dict[str, Array]:
        """Return the point with the same product in the gauge; as it is where that is not possible."""
        b = flat(x[self.b])
        if self.gauge == "gain":
            rest = 1.0 + float(np.sum(x.get("a", 0.0)))
            size = float(b.sum()) / rest if rest else 0.0  # a pole at 1 has no static gain
        else:
            size = float(np.linalg.norm(b)) if self.gauge == "norm" else float(b[0])
        if not np.isfinite(size) or size == 0:
            return dict(x)
        return {**x, self.mu: x[self.mu] * size, self.b: x[self.b] / size}


@dataclass(frozen=True, eq=False)
class Quantity:
    """Any other quantity of the unknowns.

    Attributes:
        name: its name.
        value: values of the unknowns -> array.
        slope: values of the unknowns -> {unknown: derivative of the flat value by the flat unknown}.
    """

    name: str
    value: Callable[[Values], Array]
    slope: Callable[[Values], Mapping[str, Array]]

    def chain(self, pull: Array, x: Values) -> dict[str, Array]:
        """Return ``slopeᵀ pull``."""
        return {name: part.T @ pull for name, part in self.slope(x).items()}


@dataclass(frozen=True, eq=False)
class Affine:
    """A quantity to first order about a point.

    Attributes:
        name: its name.
        at: its value there.
        slopes: {unknown: derivative of the flat value by the flat unknown} there.
        about: the point.
    """

    name: str
    at: Array
    slopes: Mapping[str, Array]
    about: Values

    @classmethod
    def of(cls, leaf: "Leaf", x: Values) -> "Affine":
        """Return a leaf to first order about a point."""
        return cls(leaf.name, leaf.value(x), leaf.slope(x), x)

    def value(self, x: Values) -> Array:
        """Return the value."""
        moved = sum((part @ flat(x[name] - self.about[name]) for name, part in self.slopes.items()),
                    np.zeros(self.at.size))
        return self.at + moved.reshape(self.at.shape, order="F")

    def slope(self, x: Values) -> Mapping[str, Array]:
        """Return the derivative, which is the same everywhere."""
        return self.slopes

    chain = Quantity.chain

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the quantity in CVXPY expressions of the unknowns."""
        moved: cp.Expression = cp.Constant(np.zeros(self.at.size))
        for name, part in self.slopes.items():
            moved = moved + part @ (cp.vec(v[name], order="F") - flat(self.about[name]))
        return self.at + cp.reshape(moved, self.at.shape, order="F")


Leaf = Product | Quantity | Affine


class OwnNumbers:
    """What holds objects of CVXPY, whose numbers no object that is made after them in another process must have."""

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_last_id": get_id()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ID_COUNTER.count = max(ID_COUNTER.count, state.pop("_last_id"))
        vars(self).update(state)


@dataclass(frozen=True, eq=False)
class LeafSpace(OwnNumbers):
    """All leaves of a problem one after another.

    Attributes:
        start: their values at the start.
        symmetric: those that are symmetric matrices.
    """

    start: Values
    symmetric: frozenset[str] = frozenset()

    @cached_property
    def places(self) -> dict[str, slice]:
        """Where every leaf is in their vector."""
        return slices_of(self.start)

    @cached_property
    def size(self) -> int:
        """Number of entries."""
        return sum(np.size(value) for value in self.start.values())

    @cached_property
    def usual_sizes(self) -> dict[str, float]:
        """The largest entry of every leaf at the start, without those that vanish there."""
        sizes = {name: float(np.max(np.abs(value), initial=0.0)) for name, value in self.start.items()}
        return {name: size for name, size in sizes.items() if size > 0}

    @cached_property
    def entry_sizes(self) -> Array:
        """The usual size of every entry; one where a leaf vanishes at the start."""
        return np.concatenate([np.full(np.size(value), self.usual_sizes.get(name, 1.0))
                               for name, value in self.start.items()])

    @cached_property
    def variables(self) -> dict[str, cp.Variable]:
        """One CVXPY variable a leaf, made when a constraint or a conic solver asks."""
        return {name: cp.Variable(np.shape(value), name=name, symmetric=name in self.symmetric)
                for name, value in self.start.items()}

    def assign(self, y: Values) -> None:
        """Write values into the variables, also a point just outside what a variable allows."""
        for name, variable in self.variables.items():
            variable.save_value(np.asarray(y[name], dtype=float))

    def rows(self, parts: Mapping[str, Any], count: int) -> Any:
        """Return slopes by some leaves as rows (count, leaves), sparse where there are many entries."""
        return in_places([(count, parts)], self.places)

    def vector(self, y: Values) -> Array:
        """Return values one after another."""
        return np.concatenate([flat(y[name]) for name in self.start])


def variable_size(value: Array, usual: float | None = None) -> float:
    """Return the largest entry of a value or of its start; one where there is no start and nothing but rounding."""
    size = float(np.max(np.abs(value), initial=0.0))
    return max(size, usual) if usual is not None else size if size > ZERO else 1.0


def in_places(blocks: Sequence[tuple[int, Mapping[str, Any]]], places: Mapping[str, slice]) -> Any:
    """Return blocks (rows, their parts by name) as one matrix, each part in its place; sparse with many entries."""
    height, width = sum(count for count, _ in blocks), sum(place.stop - place.start for place in places.values())
    if height * width > DENSE:
        return sp.csr_array(sp.vstack([sp.hstack([
            parts.get(name, sp.csr_array((count, place.stop - place.start))) for name, place in places.items()])
            for count, parts in blocks]))
    found, top = np.zeros((height, width)), 0
    for count, parts in blocks:
        for name, part in parts.items():
            found[top : top + count, places[name]] = part.toarray() if sp.issparse(part) else part
        top += count
    return found


def slices_of(values: Values) -> dict[str, slice]:
    """Return where every value is among all, one after another."""
    edges = np.cumsum([0, *(np.size(value) for value in values.values())]).tolist()
    return {name: slice(a, b) for name, a, b in zip(values, edges, edges[1:])}


def positions(places: Mapping[str, slice], names: Iterable[str]) -> NDArray[np.intp]:
    """Return where the entries of named values are, one after another."""
    return np.concatenate([np.arange(places[name].start, places[name].stop) for name in names])
