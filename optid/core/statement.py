"""The statement of a problem in CVXPY, which is made when something first asks for it, and kept with the problem."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint

from optid.core.leaves import GAUGE, Affine, OwnNumbers, Product
from optid.core.low_rank import LowRank
from optid.core.problem import Problem
from optid.core.terms import Squares, Values, stacked_expression, sum_of
from optid.errors import StructureError
from optid.program.view import View

AFFINE = frozenset({"zero", "below"})  # cones of constraints that are rows


@dataclass(frozen=True, eq=False)
class CvxpyStatement(OwnNumbers):
    """A problem in CVXPY; its variables begin with the values of its start.

    Attributes:
        objective: in units of the problem.
        constraints: {name: constraints}, those of the statement's own variables and of gauges first.
        variables: {name: CVXPY variable}: the unknowns, and residuals or matrices that solvers want as variables.
        derived: {name: expression} of the latter in the others.
        view: the named expressions of the user.
    """

    objective: cp.Minimize
    constraints: Mapping[str, tuple[Constraint, ...]]
    variables: Mapping[str, cp.Variable]
    derived: Mapping[str, cp.Expression]
    view: View

    @classmethod
    def of(cls, problem: Problem) -> "CvxpyStatement":
        """State a problem.

        Raises:
            StructureError: a term that is no expression, constraints that do not fit.
        """
        for term in problem.terms:
            if not hasattr(term, "express"):
                raise StructureError(f"{type(term).__name__}, a term of {problem.name!r}, is no expression of its "
                                     "unknowns: state its squares near a point (Problem.tangent)")
        unknowns = {name: cp.Variable(np.shape(value), name=name, symmetric=name in problem.symmetric,
                                      bounds=problem.bounds.get(name)) for name, value in problem.start.items()}
        leaves: dict[str, Any] = {**unknowns, **{one.name: one.express(unknowns) for one in problem.leaves
                                                 if isinstance(one, Product | Affine)}}
        constraints: dict[str, tuple[Constraint, ...]] = {}
        variables, derived, parts = dict(unknowns), {}, []
        for term in problem.terms:
            expression = term.express(leaves)
            if isinstance(term, LowRank):  # its multipliers, those of its own matrix, tell a bound
                derived["X"], variables["X"] = expression, cp.Variable(expression.shape, name="X")
                constraints["structure"] = (variables["X"] == expression,)
                expression = cp.normNuc(variables["X"])
            elif is_dense(term) and "residual" not in variables:  # a small dense matrix makes a sparse programme
                derived["residual"] = term.root @ stacked_expression(leaves, term.z) - term.target
                r = variables["residual"] = cp.Variable(len(term.target), name="residual")
                constraints["residual"], expression = (r == derived["residual"],), cp.sum_squares(r) + term.remainder
            parts.append(expression)
        if problem.gauged:
            constraints[GAUGE] = tuple(one.condition(unknowns) for one in problem.gauged)
        swap = {id(variable): leaves[name] for name, variable in problem.space.variables.items() if name in leaves
                } if problem.constraints() else {}
        for one in problem.constraints():
            member = one.limit.impose(one.sizes).tree_copy(swap)
            constraints[one.name] = (*constraints.get(one.name, ()), member)
        view = View(problem.expressions(leaves, problem.start), **{"reference": problem.start, **problem.facts})
        made = cls(cp.Minimize(sum_of(parts)), constraints, variables, derived, view)
        made.assign(problem.start)
        return made

    @cached_property
    def problem(self) -> cp.Problem:
        """The CVXPY problem."""
        return cp.Problem(self.objective, [c for group in self.constraints.values() for c in group])

    def __getstate__(self) -> dict[str, Any]:
        # solvers keep more with the CVXPY problem
        return {name: value for name, value in super().__getstate__().items() if name != "problem"}

    def assign(self, values: Values) -> None:
        """Write values into the variables, and those that follow from them."""
        for name, value in values.items():
            variable = self.variables[name]  # a point just outside its own bounds is to be judged, not refused
            variable.save_value(np.asarray(value, dtype=float).reshape(variable.shape, order="F"))
        for name, expression in self.derived.items():
            value = expression.value
            self.variables[name].save_value(None if value is None else np.asarray(value))

    def values(self) -> dict[str, np.ndarray]:
        """Return a copy of what the variables hold, without variables that hold nothing."""
        return {name: np.array(v.value, dtype=float) for name, v in self.variables.items() if v.value is not None}

    def duals(self) -> dict[str, np.ndarray]:
        """Return the multipliers the constraints hold: {name: flat array over the members of the group}.

        Names whose constraints hold no multiplier are absent.
        """
        found = {}
        for name, group in self.constraints.items():
            parts = [d.value for member in group for d in member.dual_variables]
            if parts and all(part is not None for part in parts):
                found[name] = np.concatenate([np.ravel(np.asarray(part, dtype=float), order="F") for part in parts])
        return found

    def begin(self, start: Values) -> None:
        """Begin at a start, without the point and the multipliers of an earlier solve, which could pass for new."""
        for dual in (dual for group in self.constraints.values() for member in group for dual in member.dual_variables):
            dual.value = None
        for variable in self.variables.values():
            variable.save_value(None)
        self.assign(start)

    def parts(self) -> Iterator[tuple[str, Any]]:
        """Yield the objective and every constraint with the words of messages."""
        yield "the objective", self.objective
        for name, group in self.constraints.items():
            for member in group:
                yield f"constraint {name!r}", member

    def nonconvex_parts(self) -> list[str]:
        """Names of the parts that break convexity."""
        return [name for name, part in self.parts() if not part.is_dcp()]


def statement_of(problem: Problem) -> CvxpyStatement:
    """Return the statement of a problem (`CvxpyStatement.of`), made once."""
    if not is_stated(problem):
        vars(problem)["_statement"] = CvxpyStatement.of(problem)
    return vars(problem)["_statement"]


def is_stated(problem: Problem) -> bool:
    """Whether the statement in CVXPY has been needed."""
    return "_statement" in vars(problem)


def for_solvers(problem: Problem) -> Problem:
    """Return a problem with all its unknowns, and with one sum of squares where there are several.

    Constraints that do not fit are refused (`StructureError`).
    """
    problem = problem.complete
    if len(problem.terms) > 1 and not problem.products and all(map(is_dense, problem.terms)):  # one triangle says so
        sizes = {name: place.stop - place.start for name, place in problem.space.places.items()}
        return problem.with_terms(Squares.of_sum(problem.terms, sizes))
    return problem


def is_dense(term: Any) -> bool:
    """Whether a term is squares with a matrix that is an array."""
    return isinstance(term, Squares) and isinstance(term.root, np.ndarray)


def class_of(problem: Problem) -> str:
    """Return the class of a problem: "LP", "QP", "SOCP", "SDP", "conic" or "NLP".

    Raises:
        StructureError: naming the part that is neither convex nor smooth.
    """
    if "_class" not in vars(problem):
        vars(problem)["_class"] = _class_of(problem)
    return vars(problem)["_class"]


def _class_of(problem: Problem) -> str:
    cones = {one.cone for one in problem.constraints()}
    squares = all(isinstance(term, Squares) for term in problem.terms)
    if squares and problem.bilinear_terms and cones <= AFFINE:
        return "NLP"
    if squares and all(isinstance(leaf, Affine) for leaf in problem.leaves) and cones <= AFFINE | {"psd"}:
        return "SDP" if "psd" in cones else "QP"
    statement = statement_of(problem)
    if statement.problem.is_dcp():
        return _convex_class(statement.problem)
    for name, part in statement.parts():
        if not getattr(part, "is_dnlp", bool)():  # cones have no such method
            raise StructureError(f"{name} of {problem.name!r} is neither convex nor a smooth expression that an NLP "
                                 f"solver accepts: {part}")
    return "NLP"


def count_variables(problem: Problem) -> int:
    """Return the number of scalar variables of the statement."""
    return sum(value.size for value in complete_values(problem, problem.start).values())


def complete_values(problem: Problem, x: Values) -> dict[str, np.ndarray]:
    """Return values of the unknowns with those of the statement's other variables."""
    found, y = {name: x[name] for name in problem.start}, problem.leaf_values(x)
    for term in problem.terms:
        if is_dense(term) and "residual" not in found:
            found["residual"] = term.residual(y)
        elif isinstance(term, LowRank):
            found["X"] = term.matrix(y)
    return found


_MATRIX_ATOMS = {"normNuc", "lambda_max", "sigma_max", "lambda_sum_largest", "MatrixFrac", "matrix_frac", "tr_inv"}
_EXPONENTIAL_ATOMS = {"exp", "log", "log1p", "log_sum_exp", "logistic", "entr", "kl_div", "rel_entr", "xexp", "log_det",
                      "Power", "GeoMean", "Pnorm"}  # the last three are power cones; their approximations are not


def _convex_class(problem: cp.Problem) -> str:
    if problem.is_lp():
        return "LP"
    if problem.is_qp():
        return "QP"
    atoms = {atom.__name__ for atom in problem.atoms()}  # CVXPY lists the types
    cones = {type(c).__name__ for c in problem.constraints}
    if cones & {"ExpCone", "PowCone3D", "PowConeND"} or atoms & _EXPONENTIAL_ATOMS:
        return "conic"
    return "SDP" if cones & {"PSD"} or atoms & _MATRIX_ATOMS else "SOCP"
