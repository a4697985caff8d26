"""The signs of mu and b in fits in the norm gauge, which fixes the scale between them and not who has which sign."""

from collections.abc import Callable, Iterator

import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.identify.prediction_error.criterion import Criterion
from optid.identify.prediction_error.tangent_problem import INSIDE, criterion_of, excess


def with_required_signs(problem: Problem, x: Array) -> Array:
    """Return x with the signs of mu and b that the constraints ask for."""
    return with_signs(criterion_of(problem), x, (lambda x: excess(problem, x)) if problem.builders else None)


def sign_variants(problem: Problem, x: Array, same: bool = False) -> Iterator[Array]:
    """Yield x with other pairs of signs of mu and b of every input, of the same function or of its negative.

    What a word says of f may be nearer to one of them, and its optimum to another: f may be convex either way. Two
    descriptions of one function are the same to constraints that speak about it alone.
    """
    criterion, told = criterion_of(problem), problem.fixes_signs
    at, pairs = criterion.unknowns.slices, [(1, -1), (-1, 1)] if told else [(1, -1)]
    if same:
        pairs = [(-1, -1)] if told else []
    for mu, b in criterion.unknowns.products if criterion.gauge == "norm" else ():
        for mu_sign, b_sign in pairs if mu.startswith("mu") else ():
            turned = np.array(x)
            turned[at[mu]] *= mu_sign
            turned[at[b]] *= b_sign
            yield turned


def input_signs(problem: Problem, x: Array) -> Array:
    """Return -1 for every input whose f falls where the output rises, if the constraints allow the opposite signs.

    1 for the others; (m,). A descent under constraints may end with other signs than it began with.
    """
    criterion = criterion_of(problem)
    at, found = criterion.unknowns.slices, np.ones(criterion.data.m)
    for mu, b in criterion.unknowns.products if problem.builders and criterion.gauge == "norm" else ():
        if mu.startswith("mu") and criterion.gain_sign(x, b) < 0:
            turned = np.array(x)
            turned[at[mu]], turned[at[b]] = -x[at[mu]], -x[at[b]]
            found[int(b[1:])] = -1.0 if excess(problem, turned) <= INSIDE else 1.0
    return found


def with_signs(criterion: Criterion, x: Array, outside: Callable[[Array], float] | None) -> Array:
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
            amount = 0.0 if outside is None else outside(turned)
            if amount < (best if mu_sign == b_sign else 0.5 * best):
                best, chosen = amount, turned
            if best <= 1e-9:
                break
        x = chosen
    return x
