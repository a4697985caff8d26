"""A problem as solvers get it: with its statement in CVXPY, which is made when something first asks for it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint
from cvxpy.lin_ops.lin_utils import ID_COUNTER, get_id

from optid.core.leaves import Affine, Product
from optid.core.low_rank import LowRank
from optid.core.problem import Problem
from optid.core.terms import Squares, Values, stacked_expression, sum_of
from optid.errors import StructureError
from optid.program.sizes import GAUGE
from optid.program.view import View

MAX_SIZE = 700  # multipliers up to which the semidefinite relaxation is tried
AFFINE = frozenset({"zero", "below"})  # cones of constraints that are rows


@dataclass(frozen=True, eq=False)
class CvxpyStatement:
    """A problem in CVXPY.

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
        return cls(cp.Minimize(sum_of(parts)), constraints, variables, derived, view)


def programme_of(problem: Any) -> Any:
    """Return the programme of a problem, a programme as it is."""
    return as_program(problem) if isinstance(problem, Problem) else problem


def as_program(problem: Problem, max_size: int = MAX_SIZE, step: bool = False) -> "Program":
    """Return the programme of a problem with all its unknowns, and with one sum of squares where there are several.

    Raises:
        StructureError: constraints that do not fit.
    """
    problem = problem.complete
    if problem.gauged and any(one.name == GAUGE for one in problem.constraints()):
        raise StructureError(f"there are two constraints named {GAUGE!r}; give each its own name")
    if len(problem.terms) > 1 and not problem.products and all(map(is_dense, problem.terms)):  # one triangle says so
        sizes = {name: place.stop - place.start for name, place in problem.space.places.items()}
        problem = replace(problem, terms=(Squares.of_sum(problem.terms, sizes),))
    return Program(problem, step, max_size)


def is_dense(term: Any) -> bool:
    """Whether a term is squares with a matrix that is an array."""
    return isinstance(term, Squares) and isinstance(term.root, np.ndarray)


@dataclass(frozen=True, eq=False)
class Program:
    """A problem with what solvers need of it.

    Attributes:
        core: the problem.
        step: whether a procedure goes on from its answer and has evidence of its own: no bound is asked for.
        max_size: multipliers up to which a semidefinite relaxation is tried for a proof.
    """

    core: Problem
    step: bool = False
    max_size: int = MAX_SIZE

    def __getattr__(self, name: str) -> Any:
        if name in ("name", "start", "scale", "unit", "compressed", "settled", "courses"):
            return getattr(self.core, name)
        if name in ("objective", "constraints", "variables", "derived", "view"):
            return getattr(self.statement, name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __getstate__(self) -> dict[str, Any]:
        _ = self.statement  # what another process needs; solvers keep more with the problem
        return {**{name: value for name, value in vars(self).items() if name != "problem"}, "_last_id": get_id()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ID_COUNTER.count = max(ID_COUNTER.count, state.pop("_last_id"))  # CVXPY's next objects must have other ids
        vars(self).update(state)

    @cached_property
    def statement(self) -> CvxpyStatement:
        """The problem in CVXPY; it begins with the values that were assigned."""
        made = CvxpyStatement.of(self.core)
        if (held := vars(self).get("_held")) is not None:
            _assign(made, held)
        return made

    @property
    def is_stated(self) -> bool:
        """Whether the statement in CVXPY has been needed."""
        return "statement" in vars(self)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the unknowns."""
        return {name: np.shape(value) for name, value in self.core.start.items()}

    @cached_property
    def problem(self) -> cp.Problem:
        """The CVXPY problem."""
        return cp.Problem(self.statement.objective, [c for group in self.statement.constraints.values() for c in group])

    @cached_property
    def kind(self) -> str:
        """The class of the problem: "LP", "QP", "SOCP", "SDP", "conic" or "NLP".

        Raises:
            StructureError: naming the part that is neither convex nor smooth.
        """
        problem, cones = self.core, {one.cone for one in self.core.constraints()}
        squares = all(isinstance(term, Squares) for term in problem.terms)
        if squares and problem.bilinear_terms and cones <= AFFINE:
            return "NLP"
        if squares and all(isinstance(leaf, Affine) for leaf in problem.leaves) and cones <= AFFINE | {"psd"}:
            return "SDP" if "psd" in cones else "QP"
        if self.problem.is_dcp():
            return _convex_class(self.problem)
        for name, part in self._parts():
            if not getattr(part, "is_dnlp", bool)():  # cones have no such method
                raise StructureError(
                    f"{name} of {self.name!r} is neither convex nor a smooth expression that an NLP solver accepts: "
                    f"{part}")
        return "NLP"

    @property
    def note(self) -> str:
        """Why there can be no proof, where that is known beforehand."""
        return self.core.proof if isinstance(self.core.proof, str) else ""

    @property
    def user_constraints(self) -> tuple[str, ...]:
        """Names of the constraints that are not part of the formulation itself."""
        return self.core.constraint_names

    @property
    def own(self) -> dict[str, int]:
        """Sizes of the variables of the statement that are no unknowns."""
        found: dict[str, int] = {}
        for term in self.core.terms:
            if is_dense(term):
                found.setdefault("residual", len(term.target))
            elif isinstance(term, LowRank):
                found["X"] = term.matrix(self.core.start).size
        return found

    @property
    def size(self) -> int:
        """Number of scalar variables."""
        return self.core.size + sum(self.own.values())

    def complete_values(self, x: Values) -> dict[str, np.ndarray]:
        """Return values of the unknowns with those of the statement's other variables."""
        found, y = {name: x[name] for name in self.core.start}, self.core.leaf_values(x)
        for term in self.core.terms:
            if is_dense(term) and "residual" not in found:
                found["residual"] = term.residual(y)
            elif isinstance(term, LowRank):
                found["X"] = term.matrix(y)
        return found

    def nonconvex_parts(self) -> list[str]:
        """Names of the parts that break convexity."""
        return [name for name, part in self._parts() if not part.is_dcp()]

    def _parts(self) -> Iterable[tuple[str, Any]]:
        yield "the objective", self.statement.objective
        for name, group in self.statement.constraints.items():
            for member in group:
                yield f"constraint {name!r}", member

    def beginning(self, start: Values) -> "Program":
        """Return the programme with another start."""
        known = {name: start[name] for name in self.core.start if name in start}
        return replace(self, core=self.core.beginning({**self.core.start, **known}))

    def recover(self, values: Values) -> Any:
        """Return the model of values of the unknowns."""
        return self.core.model(values)

    def assign(self, values: Values) -> None:
        """Write values into the CVXPY variables, and those that follow from them."""
        if self.is_stated:
            _assign(self.statement, values)
        else:
            vars(self)["_held"] = {**vars(self).get("_held", {}), **values}

    def values(self) -> dict[str, np.ndarray]:
        """Return a copy of what the CVXPY variables hold, without variables that hold nothing."""
        return {name: np.array(v.value, dtype=float) for name, v in self.statement.variables.items()
                if v.value is not None}

    def duals(self) -> dict[str, np.ndarray]:
        """Return the multipliers the constraints hold: {name: flat array over the members of the group}.

        Names whose constraints hold no multiplier are absent.
        """
        found = {}
        for name, group in self.statement.constraints.items():
            parts = [d.value for member in group for d in member.dual_variables]
            if parts and all(part is not None for part in parts):
                found[name] = np.concatenate([np.ravel(np.asarray(part, dtype=float), order="F") for part in parts])
        return found

    def clear_duals(self) -> None:
        """Forget the multipliers of an earlier solve, so that they cannot be mistaken for new ones."""
        for group in self.statement.constraints.values() if self.is_stated else ():
            for member in group:
                for dual in member.dual_variables:
                    dual.value = None


def _assign(statement: CvxpyStatement, values: Values) -> None:
    for name, value in values.items():
        variable = statement.variables[name]  # a point just outside its own bounds is to be judged, not refused
        variable.save_value(np.asarray(value, dtype=float).reshape(variable.shape, order="F"))
    for name, expression in statement.derived.items():
        statement.variables[name].save_value(np.asarray(expression.value))


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
