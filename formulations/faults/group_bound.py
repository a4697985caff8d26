"""The proof of a group-sparse programme: a lower bound recomputed from a feasible dual point.

For ``min 1/2 ‖r - M a‖² + lambda sum w_g ‖a_g‖`` under affine constraints whose multipliers make the part ``c' a + k``
of the Lagrangian, every v with ``‖M_g' v - c_g‖ <= lambda w_g`` gives the bound ``r' v - 1/2 ‖v‖² + k``. The
point of a solver is scaled into that set, v and multipliers together, so that the bound always holds.
"""

import numpy as np

from optid.program.expressions import flat_value
from optid.program.judging import Lagrangian, multiplier_terms
from optid.program.limits import spans
from optid.program.program import Program, Values
from optid.program.solution import Bound, relative_gap
from optid.structures.group_sparse import GroupSparseStructure

PROVED = 1e-6
"""Relative gap below which a point is optimal."""


def certify(program: Program, values: Values, duals: Values) -> tuple[Bound, None]:
    """Return the best bound from the residual at the point and from the multipliers that the solver gave."""
    form = program.structure
    assert isinstance(form, GroupSparseStructure)
    penalty = float(np.asarray(program.parameters[form.penalty].value))
    program.assign({name: value for name, value in values.items() if name not in program.derived})
    objective = float(np.asarray(program.objective.expr.value))
    problem, residual = form.problem, np.asarray(program.variables[form.residual].value)
    slope, constant = _lagrangian(program, form, duals)
    candidates = [residual]
    if form.residual in duals and np.size(duals[form.residual]) == residual.size:
        candidates.append(-np.ravel(np.asarray(duals[form.residual], dtype=float)))
    bounds = [_bound(problem, v, penalty, slope, constant) for v in candidates]
    bounds += [_bound(problem, v, penalty, 0.0 * slope, 0.0) for v in candidates]
    value, point = max(bounds, key=lambda pair: pair[0])
    gap = relative_gap(objective, value, program.scale)
    return Bound(value, gap < PROVED, "group-sparse dual", f"feasible dual point, relative gap {gap:.1e}",
                 multipliers=point), None


def _bound(problem, v: np.ndarray, penalty: float, slope: np.ndarray, constant: float) -> tuple[float, np.ndarray]:
    """Scale v and the multipliers into the feasible set and return the value there."""
    if not np.isfinite(v).all():
        return -np.inf, np.zeros_like(v)
    most = float(np.max(problem.norms(problem.design.T @ v - slope) / (penalty * problem.weights), initial=0.0))
    square, along = float(v @ v), float(problem.target @ v) + constant
    best = 0.0 if square == 0.0 else max(along, 0.0) / square
    scale = best if most == 0.0 else min(best, 1.0 / most)
    if not scale > 0 or not np.isfinite(scale):  # also a most or along that is not a number
        return 0.0, np.zeros_like(v)
    return scale * along - 0.5 * scale**2 * square, scale * v


def _lagrangian(program: Program, form: GroupSparseStructure, duals: Values) -> tuple[np.ndarray, float]:
    """Return c (p,) and k of the user's constraints that are affine in a; others count with multiplier zero."""
    found, value = Lagrangian(program), 0.0
    blocks = [program.variables[name] for name in form.blocks]
    for name, group in program.user_constraints.items():
        for member, span in zip(group, spans(group)):
            given = np.ravel(duals[name])[span] if name in duals else np.zeros(0)
            usable = given.size == span.stop - span.start and np.isfinite(given).all()
            terms = multiplier_terms(member, given) if usable else None
            if terms is None or not all(one.is_affine() and set(one.variables()) <= set(blocks) for one, _ in terms):
                continue
            for expression, weights in terms:
                found.add(expression, weights)
                value += float(flat_value(expression) @ weights)
    slope = np.concatenate([np.ravel(found.gradient(block)) for block in blocks])
    point = np.concatenate([np.ravel(np.asarray(block.value, dtype=float)) for block in blocks])
    return slope, value - float(slope @ point)
