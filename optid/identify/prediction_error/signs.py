"""The signs of mu and b in fits in the norm gauge, which fixes the scale between them and not who has which sign."""

from collections.abc import Callable, Iterator

import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.identify.prediction_error.criterion import INSIDE, Criterion, criterion_of, excess


def with_required_signs(problem: Problem, x: Array) -> Array:
    """Return x with the signs of mu and b that the constraints ask for."""
    return with_signs(criterion_of(problem), x, (lambda x: excess(problem, x)) if problem.builders else None)


def sign_variants(problem: Problem, x: Array, same: bool = False) -> Iterator[Array]:
    """Yield x with other pairs of signs of mu and b of every input, of the same function or of its negative.

    What a word says of f may be nearer to one of them, and its optimum to another: f may be convex either way. Two
    descriptions of one function are the same to constraints that speak about it alone.
    """
    criterion, told = criterion_of(problem), problem.fixes_signs
    signs = [(1, -1), *[(-1, 1)] * told] if not same else [(-1, -1)] * told
    for mu, b in _products(criterion):
        for pair in signs if mu.startswith("mu") else ():
            yield _turned(criterion, x, (mu, b), pair)


def input_signs(problem: Problem, x: Array) -> Array:
    """Return -1 for every input whose f falls where the output rises, if the constraints allow the opposite signs.

    1 for the others; (m,). A descent under constraints may end with other signs than it began with.
    """
    criterion = criterion_of(problem)
    found = np.ones(criterion.data.m)
    for mu, b in _products(criterion) if problem.builders else ():
        if mu.startswith("mu") and criterion.gain_sign(x, b) < 0:
            found[int(b[1:])] = -1.0 if excess(problem, _turned(criterion, x, (mu, b), (-1, -1))) <= INSIDE else 1.0
    return found


def with_signs(criterion: Criterion, x: Array, outside: Callable[[Array], float] | None) -> Array:
    """Turn the signs of mu and b to where constraints are violated least; without, f rises where the output does.

    A monotone f or a sign of the gain says which of the two equal descriptions is meant; where it asks for the opposite
    characteristic, mu or b alone is turned, since no tangent step leads through zero.
    """
    x = criterion.normalise(x)
    for mu, b in _products(criterion):
        if mu.startswith("nu"):  # the signs of feedback functions stay
            continue
        best, chosen = np.inf, x
        first = criterion.gain_sign(x, b)
        signs = (first, first), (-first, -first), (-first, first), (first, -first)
        for pair in signs if mu.startswith("mu") else signs[:2]:
            turned = _turned(criterion, x, (mu, b), pair)
            amount = 0.0 if outside is None else outside(turned)
            if amount < (best if pair[0] == pair[1] else 0.5 * best):
                best, chosen = amount, turned
            if best <= 1e-9:
                break
        x = chosen
    return x


def _products(criterion: Criterion) -> tuple[tuple[str, str], ...]:
    return criterion.unknowns.products if criterion.gauge == "norm" else ()


def _turned(criterion: Criterion, x: Array, product: tuple[str, str], signs: tuple[float, float]) -> Array:
    turned = np.array(x)
    for part, sign in zip(product, signs):
        turned[criterion.unknowns.slices[part]] *= sign
    return turned
