"""A problem of the core as a programme in CVXPY, for the back ends, judgement and proofs of programmes."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.certificate.group_sparse import certify_groups
from optid.certificate.lifting import MAX_SIZE, certify_nuclear, certify_rank_one
from optid.certificate.low_rank import certify_low_rank
from optid.core.leaves import Affine, Product
from optid.core.low_rank import LowRank
from optid.core.problem import Problem
from optid.core.terms import GroupNorms, NuclearNorms, Squares, stacked_expression, sum_of
from optid.errors import StructureError
from optid.program.program import Program
from optid.program.solution import Bound
from optid.program.structure import GAUGE
from optid.program.view import View
from optid.structures.group_sparse import GroupProblem, GroupSparseStructure
from optid.structures.least_squares import LinearStructure, RankOneStructure
from optid.structures.nuclear_norm import NuclearNormStructure
from optid.structures.rank_one import RankOne


def programme_of(problem: Any) -> Any:
    """Return the programme of a problem of the core, anything else as it is."""
    return as_program(problem) if isinstance(problem, Problem) else problem


def as_program(problem: Problem, max_size: int = MAX_SIZE, step: bool = False) -> Program:
    """Return the programme of a problem, with its constraints.

    Where products stand in its squares, no semidefinite relaxation with more multipliers than `max_size` is tried for a
    proof; for a step of a procedure that has evidence of its own none at all.

    Raises:
        StructureError: a term that is no expression, constraints that do not fit.
    """
    several = [term for term in problem.terms if isinstance(term, Squares)]
    factorised = len(several) == 1 and several[0].lifted is not None
    if len(several) < len(problem.terms) or problem.products and not factorised or not (
            all(isinstance(term.root, np.ndarray) for term in several) and (
                step or len(several) > 1 or _is_triangular(several[0].root))):
        return _of_terms(problem, step)
    if len(several) > 1:
        sizes = {name: place.stop - place.start for name, place in problem.space.places.items()}
        problem = replace(problem, terms=(Squares.of_sum(several, sizes),))
    (squares,) = (term for term in problem.terms if isinstance(term, Squares))
    products = {product.name: product for product in problem.products}

    def statement() -> dict[str, Any]:
        unknowns, leaves = _expressions(problem)
        residual = squares.root @ stacked_expression(leaves, squares.z) - squares.target
        r = cp.Variable(residual.size, name="residual")
        gauge = {GAUGE: tuple(one.condition(unknowns) for one in products.values())} if products else {}
        return {"objective": cp.Minimize(cp.sum_squares(r) + squares.remainder),
                "constraints": {"residual": (r == residual,), **gauge}, "derived": {"residual": residual},
                "variables": {**unknowns, "residual": r}, "view": _view(problem, leaves)}

    linear, numbers = tuple(name for name in squares.z if name not in products), squares.lifted
    pairs = tuple((one.mu, one.b) for one in map(products.__getitem__, squares.z[len(linear) :]))
    structure = RankOneStructure(numbers, linear, pairs, problem.products[0].gauge) if products and numbers else (
        LinearStructure(numbers or squares, linear))
    made = Program.deferred(
        problem.name, statement, start=problem.start, recover=problem.model, structure=structure,
        structural=problem.structural | {"residual"} | ({GAUGE} if products else set()),
        scale=problem.scale, unit=problem.unit, compressed=problem.compressed, step=step,
        certify=partial(certify_rank_one, max_size=max_size) if products else None,
        core=replace(problem, builders=()))
    return made.under(problem) if problem.restrictions or problem.builders else made


def _of_terms(problem: Problem, step: bool) -> Program:
    """Return the programme of any terms that are expressions of the leaves."""
    terms: list[Any] = list(problem.terms)
    for term in terms:
        if not hasattr(term, "express"):
            raise StructureError(f"{type(term).__name__}, a term of {problem.name!r}, is no expression of its "
                                 "unknowns: state its squares near a point (Problem.tangent)")
    unknowns, leaves = _expressions(problem)
    structural = {GAUGE: tuple(one.condition(unknowns) for one in problem.gauged)} if problem.gauged else {}
    parts, derived = [], {}
    for term in terms:
        expression = term.express(leaves)
        if isinstance(term, LowRank):  # its multipliers, those of a matrix of its own, tell a bound
            derived["X"], expression = expression, cp.Variable(expression.shape, name="X")
            structural["structure"] = (expression == derived["X"],)
            unknowns, expression = {**unknowns, "X": expression}, cp.normNuc(expression)
        # a small dense matrix makes a sparse programme
        if isinstance(term, Squares) and isinstance(term.root, np.ndarray) and "residual" not in unknowns:
            derived["residual"] = term.root @ stacked_expression(leaves, term.z) - term.target
            r = unknowns["residual"] = cp.Variable(len(term.target), name="residual")
            structural["residual"], expression = (r == derived["residual"],), cp.sum_squares(r) + term.remainder
        parts.append(expression)
    program = Program(
        problem.name, cp.Minimize(sum_of(parts)), structural, unknowns, problem.start, problem.model,
        _view(problem, leaves), problem.structural | structural.keys(), derived=derived, scale=problem.scale,
        unit=problem.unit, compressed=problem.compressed, step=step, core=problem, courses=problem.courses,
        settled=problem.settled, **_special(problem))
    return program.stating(problem, problem.is_convex)


def _is_triangular(root: Any) -> bool:
    return root.shape[0] == root.shape[1] and not np.tril(root, -1).any()


def _special(problem: Problem) -> dict[str, Any]:
    """Return what special methods and proofs know of a form of terms: arguments of a `Program`."""
    if isinstance(problem.proof, str) and problem.proof:
        bound = Bound.none(problem.proof)
        return {"certify": lambda program, values, duals: (bound, None), "note": problem.proof}
    if problem.proof:
        proof = problem.proof
        return {"certify": lambda program, values, duals: (proof(problem, values, duals), None)}
    match problem.terms:
        case (Squares(lifted=RankOne() as numbers, z=z), NuclearNorms() as norms) if z == tuple(problem.start):
            return {"certify": partial(certify_nuclear, numbers, z, norms)}
        case (Squares(lifted=GroupProblem() as numbers, z=z), GroupNorms()):
            shapes = {name: np.shape(problem.start[name]) for name in z}
            groups = GroupSparseStructure(numbers, problem.weights["lambda"], shapes)
            return {"certify": partial(certify_groups, groups), "structure": groups}
        case (LowRank(numbers=numbers), Squares()):
            form = NuclearNormStructure(numbers, problem.weights["weight"])
            return {"certify": partial(certify_low_rank, form), "structure": form}
    return {}


def _expressions(problem: Problem) -> tuple[dict[str, cp.Variable], dict[str, Any]]:
    """Return new variables of the unknowns, and the expressions of all leaves in them."""
    unknowns = {name: cp.Variable(np.shape(value), name=name, symmetric=name in problem.symmetric,
                                  bounds=problem.bounds.get(name)) for name, value in problem.start.items()}
    leaves: dict[str, Any] = {one.name: one.express(unknowns) for one in problem.leaves
                              if isinstance(one, Product | Affine)}
    return unknowns, {**unknowns, **leaves}


def _view(problem: Problem, leaves: Mapping[str, Any]) -> View:
    further = {} if problem.further is None else problem.further(leaves, problem.start)
    shown = {name: one for name, one in {**leaves, **further}.items() if one is not None}
    return View(shown, **{"reference": problem.start, **problem.facts})
