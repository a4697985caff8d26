"""All private names of CVXPY that optid needs, in one place, for the versions pinned in the project file.

A nonconvex programme passes through CVXPY's own smooth chain (variable attributes lowered, kinks replaced by epigraph
variables); the result, `Smooth`, is the input of every NLP back end. The way back, values and multipliers, goes
through the inverse data of the same chain, never by position.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.atoms.affine.binary_operators import DivExpression
from cvxpy.atoms.quad_over_lin import quad_over_lin
from cvxpy.constraints.zero import Zero
from cvxpy.reductions.cvx_attr2constr import CvxAttr2Constr, lower_value
from cvxpy.reductions.dnlp2smooth.dnlp2smooth import Dnlp2Smooth
from cvxpy.reductions.solution import Solution as ReducedSolution
from cvxpy.reductions.solvers.nlp_solving_chain import _set_nlp_initial_point

from optid.backends.back_end import Answer
from optid.core.problem import Problem
from optid.core.statement import statement_of
from optid.errors import StructureError
from optid.program.limits import EQUALITIES, rows_of
from optid.program.solution import Status

CACHE = "optid"  # our entry in the problem's own cache of compiled solvers


@dataclass(frozen=True)
class Smooth:
    """A programme after CVXPY's smooth chain, with the way back; parameters are constants."""

    original: cp.Problem  # the problem it was made from
    problem: cp.Problem  # the smooth problem; its constraints are read through ``rows``
    invert: Callable[[ReducedSolution], ReducedSolution]  # from its solutions to those of the original
    lowered: bool  # whether attributes of variables were replaced

    @cached_property
    def variables(self) -> list[cp.Variable]:
        """Variables of the smooth problem, in the order of its flat vector of unknowns."""
        return self.problem.variables()

    @cached_property
    def rows(self) -> list[cp.Expression]:
        """What the constraints hold at zero or not above it; refuses a cone (`StructureError`).

        Their multipliers, in the convention ``L = f + dual * row``, are CVXPY's own dual values.
        """
        found = []
        for constraint in self.problem.constraints:
            if (expression := rows_of(constraint)) is None:
                raise StructureError(
                    f"{constraint} is a {type(constraint).__name__} constraint, which no NLP solver here accepts; "
                    "write it with equalities and inequalities (a second-order cone as norm(x) <= t)")
            found.append(expression)
        return found

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the flat vector of unknowns."""
        pairs = [variable.get_bounds() for variable in self.variables]
        return _flat([lower for lower, _ in pairs]), _flat([upper for _, upper in pairs])

    @cached_property
    def row_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the stacked rows."""
        lower = [np.full(rows.size, 0.0 if isinstance(constraint, EQUALITIES) else -np.inf)
                 for rows, constraint in zip(self.rows, self.problem.constraints)]
        return _flat(lower), _flat([np.zeros(rows.size) for rows in self.rows])

    def start(self) -> np.ndarray:
        """Return the flat start: the values the original variables hold now, auxiliary ones consistent with them."""
        known = {variable.id for variable in self.original.variables()}
        plain = all(variable.id in known for variable in self.variables) and not self.lowered
        current = self if plain else _apply(self.original)
        _set_nlp_initial_point(current.problem)
        return _flat([variable.value for variable in current.variables])

    def answer(self, problem: Problem, status: Status, word: str, x: Any, multipliers: Any, **figures: Any) -> Answer:
        """Return a solver's claim about a programme, whose problem this is, with point and multipliers where usable.

        Status and word are the claim in our words and in the solver's; x (unknowns,) is a point of the smooth problem.
        The multipliers (rows,) are in the convention ``L = f + multipliers * row``; empty where there are none.
        """
        if status in (Status.INFEASIBLE, Status.UNBOUNDED):
            return Answer(status, word, **figures)
        x, multipliers = np.ravel(x), np.ravel(multipliers)
        parts = np.split(x, np.cumsum([v.size for v in self.variables])[:-1])
        primal = {v.id: np.reshape(part, v.shape, order="F") for v, part in zip(self.variables, parts)}
        parts = np.split(multipliers, np.cumsum([rows.size for rows in self.rows])[:-1])
        ids = [constraint.id for constraint in self.problem.constraints]
        dual = dict(zip(ids, parts)) if multipliers.size else {}
        self.original.unpack(self.invert(ReducedSolution(cp.OPTIMAL, 0.0, primal, dual, {})))
        stated = statement_of(problem)
        return Answer(status, word, stated.values(), stated.duals(), **figures)


def smooth(problem: cp.Problem) -> Smooth:
    """Return the smooth form of a problem; it is made once and kept with the problem.

    Raises:
        StructureError: a part that the smooth chain does not carry over faithfully.
    """
    return get_or_make(problem, "smooth", lambda: _apply(problem))


def get_or_make(problem: cp.Problem, key: Any, make: Callable[[], Any]) -> Any:
    """Return what is kept under a key with the problem, in whose cache of compiled solvers it lives; made once."""
    found = problem._solver_cache.setdefault(CACHE, {})
    if key not in found:
        found[key] = make()
    return found[key]


class Derivatives:
    """Values and exact derivatives of a smooth problem, from CVXPY's compiled derivative engine.

    The engine differentiates at the point of its last evaluation, not at the point passed: it is reached through
    `at`, which evaluates first where the point is a new one.

    Attributes:
        engine: it, compiled once for a problem.
        value: the objective at the last point.
        rows: the rows there.
    """

    def __init__(self, form: Smooth) -> None:
        from cvxpy.reductions.solvers.nlp_solvers.nlp_solver import Oracles

        self.engine: Any = get_or_make(form.original, "derivatives", lambda: Oracles(
            cp.Problem(form.problem.objective, [Zero(rows) for rows in form.rows]), verbose=False))
        self._x: np.ndarray | None = None
        self.rows = np.zeros(sum(rows.size for rows in form.rows))

    def at(self, x: Any) -> Any:
        """Return the engine at a point: its gradient(x), jacobian(x) and hessian(x, multipliers, factor)."""
        if self._x is None or not np.array_equal(x, self._x):
            self._x = np.array(x, dtype=float)
            self.value = float(self.engine.objective(self._x))
            if self.rows.size:
                self.rows = np.array(self.engine.constraints(self._x))
        return self.engine


def _apply(problem: cp.Problem) -> Smooth:
    _set_nlp_initial_point(problem)
    attributes, kinks = CvxAttr2Constr(reduce_bounds=False), _SmoothChain()
    lowered, inverse = attributes.apply(problem)
    attributes.update_parameters(problem)
    for variable in problem.variables():  # the reduced symmetric variable does not inherit its start
        if inverse and variable in attributes._symmetric_vars:
            reduced = inverse[0][variable.id]
            reduced.value = np.reshape(lower_value(variable), reduced.shape, order="F")
    result, inverse_kinks = kinks.apply(lowered)
    return Smooth(problem, result, lambda one: attributes.invert(kinks.invert(one, inverse_kinks), inverse),
                  bool(inverse))


class _SmoothChain(Dnlp2Smooth):
    """CVXPY's smooth chain, with those of its canonicalisations replaced that change the problem or its start.

    * Division by a constant or parameter: CVXPY forces the divisor to be nonnegative, so that ``x / -2`` becomes
      infeasible. It is smooth as it stands.
    * ``quad_over_lin`` along an axis: CVXPY sums over everything.
    * ``log_sum_exp``: CVXPY starts its value at that of the first entry alone.
    """

    def __init__(self) -> None:
        super().__init__()
        originals = self.smooth_canon_methods

        def divide(expr: cp.Expression, args: list) -> tuple[Any, list]:
            return originals[DivExpression](expr, args) if args[1].variables() else (expr.copy(args), [])

        def squares(expr: Any, args: list) -> tuple[Any, list]:
            if args[1].variables():
                if expr.axis is not None:
                    raise StructureError(
                        f"{expr} along an axis with a variable denominator: write the columns one by one")
                return originals[quad_over_lin](expr, args)
            total = cp.sum(cp.power(args[0], 2), axis=expr.axis, keepdims=expr.keepdims)
            return (total if np.all(args[1].value == 1) else total / args[1]), []

        def level(expr: cp.Expression, args: list) -> tuple[Any, list]:
            found, constraints = originals[cp.log_sum_exp](expr, args)
            found.value = expr.copy(args).value
            return found, constraints

        self.smooth_canon_methods = {**originals, DivExpression: divide, quad_over_lin: squares, cp.log_sum_exp: level}


def _flat(arrays: list) -> np.ndarray:
    parts = [np.ravel(np.asarray(array.toarray() if hasattr(array, "toarray") else array, dtype=float), order="F")
             for array in arrays]
    return np.concatenate(parts) if parts else np.zeros(0)
