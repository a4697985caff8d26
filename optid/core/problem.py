"""A problem: unknowns with a start, terms of the objective, leaves and constraints; values and slopes without CVXPY."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from optid.arrays import Array
from optid.core.constraint import Constraint, read_constraints
from optid.core.leaves import DENSE, GAUGE, Affine, Leaf, LeafSpace, Product, in_places, positions, slices_of
from optid.core.terms import Errors, Expressed, Squares, Term, Values, flat
from optid.errors import StructureError, nearest
from optid.program.solution import Bound
from optid.program.view import View

TRIALS = 5  # random points at which constraints are compared with those of the opposite signs


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise the sum of terms over the unknowns, under the constraints of builders.

    Attributes:
        name: of the formulation, or of its step.
        start: value of every unknown: its shape, its usual size, and where to begin; never zero in a product.
        terms: of the objective.
        leaves: what else terms and constraints speak about.
        model: values of the unknowns -> model.
        facts: keyword arguments of the `View` that builders get: channels, bases, outputs, units, reference, ....
        further: (variables of the leaves, values of the unknowns) -> more expressions for it, such as Q = A P, or None
            for a leaf that it does not show.
        restrictions: builders of constraints that belong to the formulation, have no price, and need not be convex.
        builders: of the user's constraints.
        scale: objective of the zero model, the yardstick of gaps.
        unit: what one unit of the objective is in units of the record.
        energy: of the outputs about their mean in units of the record, to which prices are relative.
        compressed: the compressed record, for intervals and figures.
        symmetric: unknowns that are symmetric matrices.
        bounds: of unknowns, each (least, largest) in the shape of the unknown.
        courses: unknowns that the restrictions determine from the others, such as states at every sample.
        settled: whether the start is close to an optimum, from which a solver should not wander.
        proof: (problem, values, multipliers) -> bound on the objective and a better start or None, where the terms
            imply none; or the reason why there can be none.
        about: names of further expressions that depend on the values of the unknowns.
        weights: of penalties, which `under_weights` changes.
        posed: states the problem with given weights, as keywords.
        step: whether a procedure goes on from the answer, so that no proof is asked for.
    """

    name: str
    start: Values
    terms: tuple[Term, ...]
    leaves: tuple[Leaf, ...] = ()
    model: Callable[[Values], Any] = dict
    facts: Mapping[str, Any] = field(default_factory=dict)
    further: Callable[[Mapping[str, Any], Values], Mapping[str, Any]] | None = None
    _: KW_ONLY
    restrictions: tuple[Any, ...] = ()
    builders: tuple[Any, ...] = ()
    scale: float = 1.0
    unit: float = 1.0
    energy: float = float("nan")
    compressed: Any = field(default=None, repr=False)
    symmetric: frozenset[str] = frozenset()
    bounds: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    courses: frozenset[str] = frozenset()
    settled: bool = False
    proof: Callable[["Problem", Values, Values], tuple[Bound, Values | None]] | str = ""
    about: frozenset[str] = frozenset()
    weights: Mapping[str, float] = field(default_factory=dict)
    posed: Callable[..., "Problem"] | None = field(default=None, repr=False)
    step: bool = False

    def under_weights(self, **weights: float) -> "Problem":
        """Return the problem with other weights of its penalties."""
        assert self.posed is not None, "it has none"
        return replace(self.posed(**{**self.weights, **weights}), builders=self.builders)

    def beginning(self, start: Values, model: Callable[[Values], Any] | None = None) -> "Problem":
        """Return the problem with another start, of some unknowns at least, and another model of its values.

        Constraints are as they were read.
        """
        start = {name: start.get(name, value) for name, value in self.start.items()}
        return self._as_read(start=start, model=model or self.model)

    def with_terms(self, *terms: Term) -> "Problem":
        """Return the problem with other terms of the same leaves; constraints are as they were read."""
        return self._as_read(terms=terms)

    def _as_read(self, **changes: Any) -> "Problem":
        made = replace(self, **changes)
        vars(made).update({name: one for name, one in vars(self).items() if name in ("space", "_at_start")})
        return made

    def subject_to(self, *builders: Any) -> "Problem":
        """Return the problem with further constraints, which are read when they are first needed."""
        return replace(self, builders=(*self.builders, *builders))

    def tangent(self, x: Values, squares: Squares, compressed: Any) -> "Problem":
        """Return the convex problem of a step from a point: squares in the unknowns, leaves and gauges to first order.

        Its constraints are those of this problem, read about the point where they move; one that is not convex in the
        leaves is a `StructureError`.
        """
        gauges = (self.gauges_about(x),) if self.gauged else ()
        step = replace(
            self, start=x, terms=(squares,), leaves=tuple(Affine.of(leaf, x) for leaf in self.leaves),
            restrictions=gauges + self.restrictions, compressed=compressed, step=True)
        held = [replace(one, moving=False) for one in self.constraints(x)]
        for one in held:
            one.refuse_nonconvex(self.name)
        return self._shared_with(step, x, len(gauges), held)

    def gauges_about(self, x: Values) -> Callable[[View], dict[str, Any]]:
        """Return the builder of the gauges of all products to first order about a point."""
        return lambda view: {GAUGE: [product.tangent(view.inner, x) for product in self.gauged]}

    def holding(self, x: Values, names: Collection[str], *more: Any) -> "Problem":
        """Return the problem in the other unknowns, with some held at their values in a point, and more restrictions.

        Its terms must be squares. Its constraints are those of this problem, as they were read.
        """
        for name in names:
            if name not in self.start:
                raise StructureError(f"cannot hold {name!r}. {nearest(name, self.start)}")
            if np.shape(x[name]) != np.shape(self.start[name]):
                raise StructureError(f"{name!r} has shape {np.shape(self.start[name])}, the value given has "
                                     f"{np.shape(x[name])}")
        leaves = [Affine(leaf.name, leaf.value(x), {name: part for name, part in leaf.slope(x).items()
                                                    if name not in names}, x) for leaf in self.leaves]
        held = [Affine(name, np.asarray(x[name], dtype=float), {}, x) for name in names]
        part = replace(self, start={name: x[name] for name in self.start if name not in names},
                       leaves=(*held, *leaves), restrictions=(*more, *self.restrictions),
                       model=lambda values: self.model({**x, **values}), proof="one factor is held")
        vars(part)["space"] = self.space
        left, slope = part.pack(part.start), part.slope(part.start)
        terms = []
        for term in self.terms:
            root = term.root @ slope[positions(self.space.places, term.z)]
            terms.append(Squares(root, root @ left - term.residual(self.leaf_values(x)), term.remainder,
                                 tuple(part.start)))
        return self._shared_with(replace(part, terms=tuple(terms)), x, len(more), self.constraints(x))

    def _shared_with(self, made: "Problem", x: Values, own: int, held: Iterable[Constraint]) -> "Problem":
        """Return a problem made of this one, in whose leaves constraints were read, behind its own first ones."""
        vars(made)["space"] = self.space  # the same leaves of the same usual sizes
        vars(made)["_at_start"] = (*(read_constraints(made, x, range(own)) if own else ()),
                                   *(replace(one, builder=one.builder + own) for one in held))
        return made

    @cached_property
    def products(self) -> tuple[Product, ...]:
        """The products among the leaves."""
        return tuple(leaf for leaf in self.leaves if isinstance(leaf, Product))

    @cached_property
    def bilinear_terms(self) -> tuple[Squares, ...]:
        """The squares in which a product stands."""
        names = {product.name for product in self.products}
        return tuple(term for term in self.terms if isinstance(term, Squares) and names & set(term.z))

    @cached_property
    def gauged(self) -> tuple[Product, ...]:
        """The products between whose factors a gauge fixes the scale."""
        return tuple(product for product in self.products if product.gauge)

    @property
    def has_convex_terms(self) -> bool:
        """Whether all terms are convex in the unknowns."""
        return not self.bilinear_terms and not any(
            isinstance(term, Errors) or isinstance(term, Expressed) and not term.build(self.space.variables).is_convex()
            for term in self.terms)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where every unknown is in the vector of all."""
        return slices_of(self.start)

    @cached_property
    def space(self) -> LeafSpace:
        """The leaves, the unknowns first."""
        return LeafSpace(self.leaf_values(self.start), self.symmetric)

    @property
    def no_proof(self) -> str:
        """Why there can be no proof, where that is known beforehand."""
        return self.proof if isinstance(self.proof, str) else ""

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the unknowns."""
        return {name: np.shape(value) for name, value in self.start.items()}

    @cached_property
    def size(self) -> int:
        """Number of scalar unknowns."""
        return sum(np.size(value) for value in self.start.values())

    def pack(self, x: Values) -> Array:
        """Return the values of the unknowns as one vector."""
        return np.concatenate([flat(x[name]) for name in self.start]).astype(float)

    def unpack(self, vector: Array) -> dict[str, Array]:
        """Return the unknowns of a vector in their shapes."""
        return {name: vector[place].reshape(np.shape(self.start[name]), order="F")
                for name, place in self.slices.items()}

    def leaf_values(self, x: Values) -> dict[str, Array]:
        """Return the values of all leaves at a point."""
        return {**{name: x[name] for name in self.start}, **{leaf.name: leaf.value(x) for leaf in self.leaves}}

    def in_gauge(self, x: Values) -> dict[str, Array]:
        """Return the point with every product in its gauge."""
        found = dict(x)
        for product in self.products:
            found = product.in_gauge(found)
        return found

    def expressions(self, leaves: Mapping[str, Any], x: Values) -> dict[str, Any]:
        """Return what constraints about a point may use, in expressions of the leaves and in units of the problem."""
        further = {} if self.further is None else self.further(leaves, x)
        return {name: one for name, one in {**leaves, **further}.items() if one is not None}

    def named_quantities(self, x: Values) -> dict[str, Array]:
        """Return the values at a point of everything that constraints may use, in the units of the record."""
        self.space.assign(self.leaf_values(x))
        view = View(self.expressions(self.space.variables, x), **{"reference": x, **self.facts})
        return {name: np.asarray(expression.value, dtype=float) for name, expression in view.items()}

    def value(self, x: Values) -> float:
        """Return the objective, in the units of the problem."""
        y = self.leaf_values(x)
        return float(sum(term.value(y) for term in self.terms))

    def pull(self, x: Values) -> tuple[float, Array, Array]:
        """Return the objective, the gradient of its smooth terms, and the magnitudes that it is a sum of."""
        y, sizes = self.leaf_values(x), {name: np.abs(value) for name, value in x.items()}
        value, gradient, magnitudes = 0.0, np.zeros(self.size), np.zeros(self.size)
        for term in self.terms:
            if hasattr(term, "pull"):
                one = term.pull(y)  # type: ignore[union-attr]
                value += one.value
                gradient += self.chain(one.gradient, x)
                magnitudes += self.chain(one.magnitudes, sizes)
            else:
                value += term.value(y)
        return value, gradient, magnitudes

    def chain(self, pulls: Mapping[str, Array], x: Values) -> Array:
        """Return the gradient by the unknowns of a quantity with these gradients by leaves."""
        found = np.zeros(self.size)
        for name, pull in pulls.items():
            if name in self.slices:
                found[self.slices[name]] += pull
        for leaf in self.leaves:
            if leaf.name in pulls:
                for name, part in leaf.chain(pulls[leaf.name], x).items():
                    found[self.slices[name]] += part
        return found

    def slope(self, x: Values) -> Any:
        """Return the derivative (leaves, unknowns) of all leaves, sparse where it has many entries."""
        eye: Any = sp.eye_array if self.space.size * self.size > DENSE else np.eye
        blocks: dict[str, Any] = {name: {name: eye(place.stop - place.start)} for name, place in self.slices.items()}
        blocks |= {leaf.name: leaf.slope(x) for leaf in self.leaves}
        places = self.space.places.items()
        return in_places([(place.stop - place.start, blocks.get(name, {})) for name, place in places], self.slices)

    @cached_property
    def _at_start(self) -> tuple[Constraint, ...]:
        held = tuple(read_constraints(self, self.start)) if self.restrictions or self.builders else ()
        if self.gauged and any(one.name == GAUGE for one in held):
            raise StructureError(f"there are two constraints named {GAUGE!r}; give each its own name")
        return held

    @cached_property
    def _read_about(self) -> dict[bytes, tuple[Constraint, ...]]:
        return {}

    def constraints(self, x: Values | None = None) -> tuple[Constraint, ...]:
        """Return the constraints: as read at the start, or with those that move read at a point."""
        moving = {one.builder for one in self._at_start if one.moving}
        if x is None or not moving:
            return self._at_start
        point = self.pack(x).tobytes()
        if point not in self._read_about:  # the last one alone is kept
            held = [one for one in self._at_start if one.builder not in moving] + read_constraints(self, x, moving)
            self._read_about.clear()
            self._read_about[point] = tuple(sorted(held, key=lambda one: one.builder))
        return self._read_about[point]

    @cached_property
    def complete(self) -> "Problem":
        """The problem with what constraints need for themselves, such as the matrix of an inequality, as unknowns."""
        known = {variable.id for variable in self.space.variables.values()} if self._at_start else set()
        used = [one for held in self._at_start for one in held.limit.member.variables()]
        own = {one.name(): one for one in used if one.id not in known}
        return self if not own else replace(
            self, start={**self.start, **{name: np.zeros(one.shape) for name, one in own.items()}},
            symmetric=self.symmetric | {name for name, one in own.items() if one.attributes["symmetric"]})

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Names of the constraints of the user."""
        return tuple(dict.fromkeys(one.name for one in self._at_start if not self._is_own(one)))

    @property
    def structural(self) -> frozenset[str]:
        """Names of the constraints that belong to the formulation."""
        return frozenset(one.name for one in self._at_start if self._is_own(one)) if self.restrictions else frozenset()

    def _is_own(self, one: Constraint) -> bool:
        return one.builder < len(self.restrictions)

    @cached_property
    def fixes_signs(self) -> bool:
        """Whether the constraints tell (mu, b) of some product from (-mu, -b); compared at random points.

        Those about ``mu bᵀ`` do not, nor do equations such as a symmetry of f.
        """
        if not self.constraint_names:
            return False
        rng = np.random.default_rng(0)
        for _ in range(TRIALS):
            x = {name: rng.normal(size=np.shape(value)) for name, value in self.start.items()}
            here = self._violations(x)
            for product in self.products:
                there = self._violations(_turned(x, product))
                if not np.allclose(here, there, rtol=1e-6, atol=1e-9 * np.max(here, initial=1.0)):
                    return True
        return False

    def signed_start(self) -> dict[str, Array]:
        """Return the start with the sign of every (mu, b) with which the constraints are violated least.

        Methods that follow one start would otherwise stay at ``mu = 0`` where the constraints turn the sign round.
        """
        start = dict(self.start)
        for product in self.products:
            start = min(start, _turned(start, product), key=self.violation)
        return start

    def _violations(self, x: Values) -> Array:
        """Return the violation of every row (of a matrix: the largest) of the user's constraints at a point."""
        y = self.leaf_values(x)
        return np.concatenate([one.violations(one.residual(self.space, y)) for one in self.constraints()
                               if not self._is_own(one)])

    @cached_property
    def is_measured(self) -> bool:
        """Whether the stationarity of a point can be measured.

        Every constraint has a slope, and every term a gradient or nearest subgradients.
        """
        return all(one.is_smooth for one in self._at_start) and all(
            hasattr(term, "pull") or hasattr(term, "nearest") for term in self.terms)

    def violation(self, x: Values, constraints: tuple[Constraint, ...] | None = None) -> float:
        """Return the sum of the violations at a point, of rows divided by their sizes."""
        held, y = self.constraints(x) if constraints is None else constraints, self.leaf_values(x)
        return sum(one.violation(self.space, y) for one in held)


def _turned(x: Values, product: Product) -> dict[str, Array]:
    """Return a point with the signs of both factors of a product changed."""
    return {**x, product.mu: -x[product.mu], product.b: -x[product.b]}
