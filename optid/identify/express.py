"""A problem of the core as a programme in CVXPY, for the back ends, judgement and proofs of programmes."""

from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.certificate.lifting import MAX_SIZE, certify_rank_one
from optid.core.leaves import Affine
from optid.core.problem import GAUGE, Problem
from optid.core.terms import Squares, stacked_expression
from optid.identify.gauges import scale_fixed
from optid.program.program import Program
from optid.program.view import View
from optid.structures.least_squares import LinearStructure, RankOneStructure


def as_program(problem: Problem, max_size: int = MAX_SIZE, step: bool = False) -> Program:
    """Return the programme of a problem whose objective is one term of squares, with its constraints.

    Where products stand in it, no semidefinite relaxation with more multipliers than `max_size` is tried for a proof;
    for a step of a procedure that has evidence of its own none at all.
    """
    (squares,) = problem.terms
    assert isinstance(squares, Squares)
    products = {product.name: product for product in problem.products}

    def statement() -> dict[str, Any]:
        unknowns = {name: cp.Variable(np.shape(value), name=name) for name, value in problem.start.items()}
        leaves: dict[str, Any] = {name: cp.outer(unknowns[one.mu], cp.vec(unknowns[one.b], order="F"))
                                  for name, one in products.items()}
        leaves |= {one.name: one.express(unknowns) for one in problem.leaves if isinstance(one, Affine)}
        residual = squares.root @ stacked_expression({**unknowns, **leaves}, squares.z) - squares.target
        r = cp.Variable(residual.size, name="residual")
        further = {} if problem.further is None else problem.further({**unknowns, **leaves}, problem.start)
        gauge = {GAUGE: tuple(scale_fixed(one.gauge, unknowns[one.b], unknowns.get("a"))
                              for one in products.values())} if products else {}
        shown = {name: one for name, one in {**unknowns, **leaves, **further}.items() if one is not None}
        return {"objective": cp.Minimize(cp.sum_squares(r) + squares.remainder),
                "constraints": {"residual": (r == residual,), **gauge}, "derived": {"residual": residual},
                "variables": {**unknowns, "residual": r},
                "view": View(shown, **({"reference": problem.start} | dict(problem.facts)))}

    linear, numbers = tuple(name for name in squares.z if name not in products), squares.lifted or squares
    pairs = tuple((one.mu, one.b) for one in map(products.__getitem__, squares.z[len(linear) :]))
    structure = RankOneStructure(numbers, linear, pairs, problem.products[0].gauge) if products else (
        LinearStructure(numbers, linear))
    made = Program.deferred(
        problem.name, statement, start=problem.start, recover=problem.model, structure=structure,
        structural=frozenset({"residual", GAUGE} if products or GAUGE in problem.structural else {"residual"}),
        scale=problem.scale, unit=problem.unit, compressed=problem.compressed, step=step,
        certify=partial(certify_rank_one, max_size=max_size) if products else None,
        core=replace(problem, builders=()))
    return made.under(problem) if problem.builders else made
