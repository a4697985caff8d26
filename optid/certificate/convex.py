"""Lower bounds for convex programmes, recomputed from multipliers as values of the Lagrangian dual.

For multipliers w in the dual cone of the constraints ``g(x) in K`` the minimum of ``L(x) = F(x) + <w, g(x)>`` over all
x bounds the optimum from below, however inaccurate w is: bad multipliers give a weak bound, never a wrong one.

* Least squares ``F = ‖R z - s‖² + remainder``: with the constraints taken by their tangents at z0, which bound convex
  ones from below, the minimum is known in closed form, ``L(z0) - ‖R^-T grad L(z0)‖² / 4`` for any z0. Where the solver
  gives no multipliers, or poor ones, those of linear constraints are computed here by least-distance programming.
* Any other smooth convex F: L is convex, so that its tangent at the point bounds it from below; what is left of its
  gradient there counts over a box of `REACH` times the size of every variable around the point, as far as bounds that
  the variable carries let it go. Of a quadratic F in few variables only the part of the gradient counts that its
  curvature does not catch.
"""

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_triangular

from optid.arrays import Array
from optid.certificate.lifting import lift
from optid.core.judge import in_dual_cone
from optid.core.problem import Problem
from optid.program.expressions import differences, flat_value
from optid.program.judging import Lagrangian, bounds_of
from optid.program.program import Program, Values
from optid.program.solution import Bound, relative_gap
from optid.program.structure import variable_size
from optid.structures.least_squares import LeastSquaresStructure
from optid.structures.multipliers import least_distance

CLOSED = 1e-6  # relative gap up to which a convex programme counts as solved to its optimum
FEW = 64  # scalar variables up to which the curvature of a quadratic objective is formed
TANGENT = "tangent"
"""Method of a bound from a tangent: it may be weak at a good point, so that it proves but does not refute."""

REACH = 2.0  # half-width of the box in which a bound from a tangent holds, in sizes of the variables


def certify_convex(program: Program, values: Values, duals: Values, objective: float) -> Bound | None:
    """Return the dual bound at a point with this objective, from multipliers of which some may be missing.

    None where it cannot be formed (no multipliers, an objective with kinks).
    """
    form = program.structure if isinstance(program.structure, LeastSquaresStructure) else None
    if form is None or program.core is None or not program.core.is_measured:
        program.assign(values)
    if form is None:
        found, method = _tangent_bound(program, duals, objective), TANGENT
    else:
        found, method = _least_squares_bound(program, form, values, duals, objective), "convex dual"
    if found is None or not np.isfinite(found[0]):
        return None
    value, words = found
    gap = relative_gap(abs(objective), value + abs(objective) - objective, program.scale)
    state = "convex programme" if gap <= CLOSED else "not proved"
    return Bound(value, gap <= CLOSED, method, f"{state}: {words}, relative gap {gap:.1e}")


def _least_squares_bound(program: Program, form: LeastSquaresStructure, values: Values, duals: Values, objective: float
                         ) -> tuple[float, str]:
    best = _quadratic_bound(program, form, values, duals, objective), "least-squares dual of the multipliers"
    if relative_gap(objective, best[0], program.scale) > CLOSED and (own := _own_multipliers(program, form)):
        value = _quadratic_bound(program, form, values, own, objective)
        best = max(best, (value, "least-squares dual of multipliers by least-distance programming"))
    return best


def _bound_by_rows(problem: Problem, form: LeastSquaresStructure, values: Values, duals: Values, objective: float
                   ) -> float:
    """The same from the rows of a problem of the core, whose leaves are all in z."""
    x = {name: np.reshape(values[name], np.shape(start), order="F") for name, start in problem.start.items()}
    root, z = form.problem.root, form.flat(x)
    pull, value = 2.0 * root.T @ (root @ z - form.problem.target), objective
    for one in problem.constraints():
        if one.name not in duals:
            return -np.inf
        dual = in_dual_cone(one, duals[one.name][one.span])
        rows = one.slope(problem.space, x)  # a convex one lies above its tangent
        columns = np.concatenate([rows[:, problem.space.places[name]] for name in form.linear], axis=1)
        pull, value = pull + columns.T @ dual, value + float(dual @ one.residual(problem.space, x))
    step = solve_triangular(root, pull, trans=1)
    return value - float(step @ step) / 4


def _quadratic_bound(program: Program, form: LeastSquaresStructure, values: Values, duals: Values, objective: float
                     ) -> float:
    """Minimum over all z of the Lagrangian of least squares, whose constraints are the user's; -inf without one."""
    if program.core is not None and program.core.is_measured:
        return _bound_by_rows(program.core, form, values, duals, objective)
    lagrangian = Lagrangian.of(program, duals, program.user_constraints)
    if lagrangian is None:
        return -np.inf
    root = form.problem.root
    z = form.flat({name: program.variables[name].value for name in form.linear})
    pull = 2.0 * root.T @ (root @ z - form.problem.target)
    gradient, inner = lagrangian.total, {program.variables[name].id for name in form.linear}
    pull = pull + np.concatenate([*(gradient[program.variables[name].id] for name in form.linear), np.zeros(0)])
    step = solve_triangular(root, pull, trans=1)
    others = [v for v in program.variables.values() if v.id not in inner]  # those that constraints brought with them
    loose = sum(float(np.sum(np.abs(gradient[v.id]))) * _width(v) for v in others)
    return objective + lagrangian.value - float(step @ step) / 4 - loose


def _tangent_bound(program: Program, duals: Values, objective: float) -> tuple[float, str] | None:
    lagrangian, variables = Lagrangian.of(program, duals, program.constraints), list(program.variables.values())
    if lagrangian is None or not lagrangian.add(program.objective.expr, np.ones(1)) or any(
            lagrangian.free_part(variable) is None for variable in variables):
        return None
    plain = sum(_descent(lagrangian, variable) for variable in variables)
    gradient = np.concatenate([lagrangian.total[v.id] for v in variables])
    if program.kind == "QP" and gradient.size <= FEW:
        widths = np.concatenate([np.full(v.size, _width(v)) for v in variables])
        sizes, directions = np.linalg.eigh(_hessian(program))
        curved = sizes > 1e-12 * max(float(sizes[-1]), np.finfo(float).tiny)
        along = directions.T @ gradient
        caught = float(np.sum(along[curved] ** 2 / sizes[curved])) / 2
        plain = min(plain, caught + float(np.abs(directions[:, ~curved] @ along[~curved]) @ widths))
    return objective + lagrangian.value - plain, f"tangent of the Lagrangian, within {REACH:g} times the solution"


def _hessian(program: Program) -> Array:
    """Second derivatives of a quadratic objective: differences of its gradient, which are exact."""
    variables = list(program.variables.values())
    point = np.concatenate([flat_value(v) for v in variables])

    def assign(x: Array) -> None:
        for v, part in zip(variables, np.split(x, np.cumsum([v.size for v in variables])[:-1])):
            v.save_value(part.reshape(v.shape, order="F"))

    def gradient(x: Array) -> Array:
        assign(x)
        lagrangian = Lagrangian(program)
        lagrangian.add(program.objective.expr, np.ones(1))
        return np.concatenate([lagrangian.total[v.id] for v in variables])

    matrix, _ = differences(gradient, point)
    assign(point)
    return (matrix + matrix.T) / 2


def _width(variable: cp.Variable) -> float:
    return REACH * variable_size(flat_value(variable), None)


def _descent(lagrangian: Lagrangian, variable: cp.Variable) -> float:
    """By how much the gradient can lower the Lagrangian inside the box and the bounds that the variable carries."""
    gradient = lagrangian.gradient(variable)
    room = np.full(variable.shape, _width(variable))
    if (bounds := bounds_of(variable)) is not None:
        value = np.asarray(variable.value, dtype=float)
        room = np.clip(np.where(gradient > 0, value - bounds[0], bounds[1] - value), 0.0, room)
    return float(np.sum(np.abs(gradient) * room))


def _own_multipliers(program: Program, form: LeastSquaresStructure) -> dict[str, Array] | None:
    """Multipliers of linear constraints: those of the point of the polyhedron next to the least-squares estimate."""
    problem, lifted = form.problem, lift(program, form)
    linear = lifted.linear
    if lifted.refused or not len(linear.right):
        return None
    estimate = solve_triangular(problem.root, problem.target)
    slopes = solve_triangular(problem.root, linear.rows.T, trans=1).T
    lengths = np.linalg.norm(slopes, axis=1)
    lengths[lengths == 0] = 1.0
    need = (linear.rows @ estimate - linear.right) / lengths
    size = float(np.max(np.abs(need), initial=0.0)) or 1.0
    try:  # x = R (z - estimate): minimise |x|² subject to slopes x + need <= 0
        weights = least_distance(slopes / lengths[:, None], need / size, linear.equality)
    except RuntimeError:
        return None
    if weights is None:
        return None
    if program.core is not None:
        counts = {name: sum(len(one) for one in program.core.constraints() if one.name == name)
                  for name in program.core.constraint_names}
    else:
        counts = {name: sum(member.size for member in group) for name, group in program.user_constraints.items()}
    return dict(zip(counts, np.split(2.0 * size * weights / lengths, np.cumsum([*counts.values()])[:-1])))
