"""A fit by programmes in the tangent of an iterate: its problem, its errors, and the programme of a step.

A formulation states the problem; `tangent_descent` takes the steps.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.core.judge import largest_excess
from optid.core.problem import Problem
from optid.core.program import Program, as_program
from optid.core.terms import Squares, Values, flat
from optid.identify.prediction_error.descent import Criterion
from optid.statistics.linearised import Linearised
from optid.statistics.unknowns import Unknowns

INSIDE = 1e-6  # relative violation up to which a point satisfies the constraints


@dataclass(frozen=True, eq=False)
class Places:
    """Named variables, and where each stands in the vector of the unknowns of errors."""

    criterion: Criterion  # the errors
    names: Mapping[str, str]  # {variable: part of the vector}, in its order; "x0" is the initial states

    @classmethod
    def of(cls, criterion: Criterion) -> "Places":
        """Name the parts by the keys of a criterion."""
        found, unknowns = {}, criterion.unknowns
        for part, shape in unknowns.shapes.items():
            kind = part.rstrip("0123456789")
            if np.prod(shape):
                found[part if kind == part else criterion.key(kind, int(part[len(kind) :]))] = part
        return cls(criterion, {**found, "x0": "x0"} if unknowns.memory else found)

    @property
    def unknowns(self) -> Unknowns:
        """The order of the vector."""
        return self.criterion.unknowns

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

    def value(self, values: Values) -> float:
        """Return the sum of squared errors at named values."""
        return self.criterion.value(self.pack(values))

    def squares(self, values: Values) -> Squares:
        """Return the sum of squared errors near named values, the errors to first order."""
        z0 = self.pack(values)
        at = self.criterion.linearise(z0)
        root, errors = at.whole
        return Squares(root[:, self.columns], root @ z0 - errors, at.remainder, tuple(self.names))

    def stacked(self, variables: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the variables as the vector of the unknowns."""
        return cp.hstack([variables[name] if variables[name].ndim == 1 else
                          cp.vec(variables[name], order="F" if part == "x0" else "C")
                          for name, part in self.names.items()])

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Where in the vector the entries of the variables are, one after another, each column by column."""
        places = self.values(np.arange(self.unknowns.size, dtype=float))
        return np.concatenate([flat(one) for one in places.values()]).astype(np.intp)


@dataclass(frozen=True, eq=False)
class TangentFit:
    """A fit by programmes in the tangent of an iterate.

    Attributes:
        problem: unknowns and their usual sizes, leaves, the user's constraints, and the model of values.
        criterion: the errors, in the gauge of the problem.
        compressed: (errors near a point, unknowns of the point) -> the compressed errors there.
    """

    problem: Problem
    criterion: Criterion
    compressed: Callable[[Linearised, Array], Any]

    @property
    def constraints(self) -> tuple[Any, ...]:
        """The user's constraints."""
        return self.problem.builders

    def under(self, constraints: Sequence[Any], *restrictions: Any) -> "TangentFit":
        """Return the fit under other constraints of the user, and further restrictions that are not the user's."""
        return replace(self, problem=replace(self.problem, builders=tuple(constraints), restrictions=(
            *self.problem.restrictions, *restrictions)))

    def recover(self, values: Values) -> Any:
        """Return the model of the values of the unknowns."""
        return self.problem.model(values)

    def pose(self, z0: Array, at: Linearised, damping: float) -> Program:
        """Return the programme of the step from z0, ``at`` the errors near z0."""
        compressed = self.compressed(at, z0)
        root, target, remainder = compressed.problem
        if damping:
            sizes = np.sqrt(damping) * np.linalg.norm(at.whole[0], axis=0)
            root, target = np.vstack([root, np.diag(sizes)]), np.append(target, sizes * z0)
        squares = Squares(root[:, self.places.columns], target, remainder, tuple(self.places.names))
        return as_program(self.problem.tangent(self.places.values(z0), squares, compressed), step=True)

    def excess(self, x: Array, unknowns: frozenset[str] = frozenset()) -> float:
        """Return the largest relative violation of the constraints, or of those about some unknowns alone."""
        return largest_excess(self.problem, self.places.values(x), unknowns)

    @cached_property
    def places(self) -> Places:
        """The named unknowns in the order of their vector."""
        return Places.of(self.criterion)

    def signed(self, x: Array) -> Array:
        """Return x with the signs of mu and b that the constraints ask for."""
        return with_signs(self.criterion, x, self.excess if self.constraints else None)

    def mirrored(self, x: Array, same: bool = False) -> Iterator[Array]:
        """Yield x with other pairs of signs of mu and b of every input, of the same function or of its negative.

        What a word says of f may be nearer to one of them, and its optimum to another: f may be convex either way. Two
        descriptions of one function are the same to constraints that speak about it alone.
        """
        at, told = self.criterion.unknowns.slices, self.problem.fixes_signs
        pairs = ([(-1, -1)] if told else []) if same else [(1, -1), (-1, 1)] if told else [(1, -1)]
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            for mu_sign, b_sign in pairs if mu.startswith("mu") else ():
                turned = np.array(x)
                turned[at[mu]] *= mu_sign
                turned[at[b]] *= b_sign
                yield turned

    def turns(self, x: Array) -> Array:
        """Return -1 for every input whose f falls where the output rises, if the constraints allow the opposite signs.

        1 for the others; (m,). A descent under constraints may end with other signs than it began with.
        """
        at, found = self.criterion.unknowns.slices, np.ones(self.criterion.data.m)
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            if mu.startswith("mu") and self.criterion.gain_sign(x, b) < 0:
                turned = np.array(x)
                turned[at[mu]], turned[at[b]] = -x[at[mu]], -x[at[b]]
                found[int(b[1:])] = -1.0 if self.excess(turned) <= INSIDE else 1.0
        return found


def with_signs(criterion: Criterion, x: Array, excess: Callable[[Array], float] | None) -> Array:
    """Turn the signs of mu and b to where constraints are violated least; without, f rises where the output does.

    A monotone f or a sign of the gain says which of the two equal descriptions is meant; where it asks for the opposite
    characteristic, mu or b alone is turned, since no tangent step leads through zero.
    """
    x, at = criterion.normalised(x), criterion.unknowns.slices
    for mu, b in criterion.unknowns.products if criterion.gauge == "norm" else ():
        if mu.startswith("nu"):  # the signs of feedback functions stay
            continue
        best, chosen = np.inf, x
        first = criterion.gain_sign(x, b)
        signs = (first, first), (-first, -first), (-first, first), (first, -first)
        for mu_sign, b_sign in signs if mu.startswith("mu") else signs[:2]:
            turned = np.array(x)
            turned[at[mu]] *= mu_sign
            turned[at[b]] *= b_sign
            outside = 0.0 if excess is None else excess(turned)
            if outside < (best if mu_sign == b_sign else 0.5 * best):
                best, chosen = outside, turned
            if best <= 1e-9:
                break
        x = chosen
    return x
