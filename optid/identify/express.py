"""A problem of the core as a programme in CVXPY, for the back ends, judgement and proofs of programmes."""

from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.certificate.lifting import MAX_SIZE, certify_rank_one
from optid.core.problem import Problem
from optid.core.terms import Squares, stacked_expression
from optid.identify.gauges import scale_fixed
from optid.program.program import Program
from optid.program.view import View
from optid.structures.least_squares import LinearStructure, RankOneStructure


def as_program(problem: Problem, max_size: int = MAX_SIZE) -> Program:
    """Return the programme of a problem whose objective is one term of squares, with its constraints.

    Where products stand in it, no semidefinite relaxation with more multipliers than `max_size` is tried for a proof.
    """
    (squares,) = problem.terms
    assert isinstance(squares, Squares) and squares.lifted is not None
    products = {product.name: product for product in problem.products}

    def statement() -> dict[str, Any]:
        unknowns = {name: cp.Variable(np.shape(value), name=name) for name, value in problem.start.items()}
        thetas = {name: cp.outer(unknowns[one.mu], cp.vec(unknowns[one.b], order="F"))
                  for name, one in products.items()}
        residual = squares.root @ stacked_expression({**unknowns, **thetas}, squares.z) - squares.target
        r = cp.Variable(residual.size, name="residual")
        further = {} if problem.further is None else problem.further({**unknowns, **thetas}, problem.start)
        gauge = {"gauge": tuple(scale_fixed(one.gauge, unknowns[one.b], unknowns.get("a"))
                                for one in products.values())} if products else {}
        return {"objective": cp.Minimize(cp.sum_squares(r) + squares.remainder),
                "constraints": {"residual": (r == residual,), **gauge}, "derived": {"residual": residual},
                "variables": {**unknowns, "residual": r},
                "view": View({**unknowns, **thetas, **further}, **problem.facts)}

    linear = tuple(name for name in squares.z if name not in products)
    pairs = tuple((one.mu, one.b) for one in map(products.__getitem__, squares.z[len(linear) :]))
    structure = RankOneStructure(squares.lifted, linear, pairs, problem.products[0].gauge) if products else (
        LinearStructure(squares.lifted, linear))
    return Program.deferred(
        problem.name, statement, start=problem.start, recover=problem.model, structure=structure,
        structural=frozenset({"residual", "gauge"} if products else {"residual"}), scale=problem.scale,
        unit=problem.unit, compressed=problem.compressed,
        certify=partial(certify_rank_one, max_size=max_size) if products else None,
        core=replace(problem, builders=())).subject_to(*problem.builders)
