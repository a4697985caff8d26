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

import numpy as np
from scipy.linalg import solve_triangular

from optid.arrays import Array
from optid.certificate.lifting import lift
from optid.core.constraint import join_by_name
from optid.core.judge import in_dual_cone, rows_at
from optid.core.least_squares import LeastSquaresForm, LinearForm
from optid.core.leaves import variable_size
from optid.core.problem import Problem
from optid.core.terms import Values, flat
from optid.program.expressions import differences
from optid.program.solution import Bound, relative_gap
from optid.structures.multipliers import least_distance

CLOSED = 1e-6  # relative gap up to which a convex programme counts as solved to its optimum
FEW = 64  # scalar variables up to which the curvature of a quadratic objective is formed
TANGENT = "tangent"
"""Method of a bound from a tangent: it may be weak at a good point, so that it proves but does not refute."""

REACH = 2.0  # half-width of the box in which a bound from a tangent holds, in sizes of the variables


def certify_convex(problem: Problem, values: Values, duals: Values, quadratic: bool = False) -> Bound | None:
    """Return the dual bound at a point, from multipliers of which some may be missing.

    None where it cannot be formed (no multipliers, an objective with kinks). A quadratic objective has more to say.
    """
    x = {name: np.reshape(values[name], np.shape(start), order="F") for name, start in problem.start.items()}
    form, objective = LinearForm.of(problem), problem.value(x)
    if form is None or not _is_triangular(form.problem.root):
        found, method = _tangent_bound(problem, x, duals, quadratic), TANGENT
    else:
        found, method = _least_squares_bound(problem, form, x, duals, objective), "convex dual"
    if found is None or not np.isfinite(found[0]):
        return None
    value, words = found
    gap = relative_gap(abs(objective), value + abs(objective) - objective, problem.scale)
    state = "convex programme" if gap <= CLOSED else "not proved"
    return Bound(value, gap <= CLOSED, method, f"{state}: {words}, relative gap {gap:.1e}")


def _is_triangular(root: Array) -> bool:
    return root.shape[0] == root.shape[1] and not np.tril(root, -1).any()


def _least_squares_bound(problem: Problem, form: LeastSquaresForm, x: Values, duals: Values, objective: float
                         ) -> tuple[float, str]:
    best = _quadratic_bound(problem, form, x, duals, objective), "least-squares dual of the multipliers"
    if relative_gap(objective, best[0], problem.scale) > CLOSED and (own := _own_multipliers(problem, form)):
        value = _quadratic_bound(problem, form, x, own, objective)
        best = max(best, (value, "least-squares dual of multipliers by least-distance programming"))
    return best


def _quadratic_bound(problem: Problem, form: LeastSquaresForm, x: Values, duals: Values, objective: float
                     ) -> float:
    """Minimum over all z of the Lagrangian of least squares; -inf without multipliers.

    A convex constraint lies above its tangent. What is left of the gradient by unknowns that constraints have brought
    with them counts over the box.
    """
    root, z, y = form.problem.root, form.flat(x), problem.leaf_values(x)
    gradient, value = np.zeros(problem.space.size), objective
    for one in problem.constraints():
        if one.name not in duals or not one.is_smooth:
            return -np.inf
        dual = in_dual_cone(one, duals[one.name][one.span])
        gradient, value = gradient + dual @ one.slope(problem.space, y), value + float(dual @ one.residual(
            problem.space, y))
    pull = 2.0 * root.T @ (root @ z - form.problem.target) + np.concatenate(
        [gradient[problem.space.places[name]] for name in form.linear])
    step = solve_triangular(root, pull, trans=1)
    loose = sum(float(np.sum(np.abs(_free(problem, x, name, gradient[place])))) * _width(x[name])
                for name, place in problem.slices.items() if name not in form.linear)
    return value - float(step @ step) / 4 - loose


def _tangent_bound(problem: Problem, x: Values, duals: Values, quadratic: bool) -> tuple[float, str] | None:
    if not problem.is_measured or any(not hasattr(term, "pull") for term in problem.terms):
        return None
    value, gradient, _ = problem.pull(x)
    for row in rows_at(problem, x):
        if row.constraint.name not in duals:
            return None
        dual = in_dual_cone(row.constraint, duals[row.constraint.name][row.constraint.span])
        gradient, value = gradient + dual @ row.slope, value + float(dual @ row.residual)
    if not np.all(np.isfinite(gradient)):
        return None
    plain = sum(_descent(problem, x, name, gradient[place]) for name, place in problem.slices.items())
    if quadratic and gradient.size <= FEW and not problem.bounds:
        widths = np.concatenate([np.full(np.size(value), _width(value)) for value in x.values()])
        sizes, directions = np.linalg.eigh(_hessian(problem, x))
        curved = sizes > 1e-12 * max(float(sizes[-1]), np.finfo(float).tiny)
        along = directions.T @ gradient
        caught = float(np.sum(along[curved] ** 2 / sizes[curved])) / 2
        plain = min(plain, caught + float(np.abs(directions[:, ~curved] @ along[~curved]) @ widths))
    return value - plain, f"tangent of the Lagrangian, within {REACH:g} times the solution"


def _hessian(problem: Problem, x: Values) -> Array:
    """Second derivatives of a quadratic objective: differences of its gradient, which are exact."""
    matrix, _ = differences(lambda v: problem.pull(problem.unpack(v))[1], problem.pack(x))
    return (matrix + matrix.T) / 2


def _free(problem: Problem, x: Values, name: str, gradient: Array) -> Array:
    """Return the flat gradient by an unknown, its symmetric part where the unknown is symmetric."""
    if name not in problem.symmetric:
        return gradient
    matrix = gradient.reshape(np.shape(x[name]), order="F")
    return flat((matrix + matrix.T) / 2)


def _width(value: Array) -> float:
    return REACH * variable_size(value)


def _descent(problem: Problem, x: Values, name: str, gradient: Array) -> float:
    """By how much the gradient can lower the Lagrangian inside the box and the bounds of an unknown."""
    value = flat(x[name])
    room = np.full(value.size, _width(value))
    gradient = _free(problem, x, name, gradient)
    if name in problem.bounds:
        low, high = (flat(end) for end in problem.bounds[name])
        room = np.clip(np.where(gradient > 0, value - low, high - value), 0.0, room)
    return float(np.sum(np.abs(gradient) * room))


def _own_multipliers(problem: Problem, form: LeastSquaresForm) -> dict[str, Array] | None:
    """Multipliers of linear constraints: those of the point of the polyhedron next to the least-squares estimate."""
    numbers, lifted = form.problem, lift(problem, form)
    linear = lifted.linear
    if lifted.refused or not len(linear.right):
        return None
    estimate = solve_triangular(numbers.root, numbers.target)
    slopes = solve_triangular(numbers.root, linear.rows.T, trans=1).T
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
    held = problem.constraints()
    edges = np.cumsum([len(one) for one in held])[:-1]
    return join_by_name(held, np.split(2.0 * size * weights / lengths, edges))
