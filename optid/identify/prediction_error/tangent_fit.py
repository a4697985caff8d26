"""A fit by programmes in the tangent of an iterate: its problem, its errors, and the programme of a step.

A formulation states the problem; `tangent_descent` takes the steps.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.core.judge import largest_excess
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.identify.prediction_error.criterion import Criterion, Places
from optid.statistics.linearised import Linearised

INSIDE = 1e-6  # relative violation up to which a point satisfies the constraints


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

    def pose(self, z0: Array, at: Linearised, damping: float) -> Problem:
        """Return the programme of the step from z0, ``at`` the errors near z0."""
        compressed = self.compressed(at, z0)
        root, target, remainder = compressed.problem
        if damping:
            sizes = np.sqrt(damping) * np.linalg.norm(at.whole[0], axis=0)
            root, target = np.vstack([root, np.diag(sizes)]), np.append(target, sizes * z0)
        squares = Squares(root[:, self.places.columns], target, remainder, tuple(self.places.names))
        return self.problem.tangent(self.places.values(z0), squares, compressed)

    def excess(self, x: Array, unknowns: frozenset[str] = frozenset()) -> float:
        """Return the largest relative violation of the constraints, or of those about some unknowns alone."""
        return largest_excess(self.problem, self.places.values(x), unknowns)

    @property
    def places(self) -> Places:
        """The named unknowns in the order of their vector."""
        return self.criterion.variables

    def with_required_signs(self, x: Array) -> Array:
        """Return x with the signs of mu and b that the constraints ask for."""
        return with_signs(self.criterion, x, self.excess if self.constraints else None)

    def sign_variants(self, x: Array, same: bool = False) -> Iterator[Array]:
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
    x, at = criterion.normalise(x), criterion.unknowns.slices
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
