"""Our own residuals at a solver's point: a solver's status is a claim, these numbers decide."""

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint

from optid.program import Program, Values
from optid.solution import Residuals


def judge(program: Program, values: Values, duals: Values) -> tuple[float, Residuals]:
    """Measure a point: objective, violation, stationarity and complementarity.

    Args:
        program: the programme.
        values: {variable: array}; derived variables are recomputed from the others first.
        duals: {constraint: flat multipliers}; names may be missing.

    Returns:
        The recomputed objective and the residuals. Stationarity is ``nan`` where multipliers are missing or the
        objective has a kink at the point.
    """
    program.assign(values)
    violation, worst = measure_violation(program)
    if program.rank_one is not None and not program.user_constraints:
        objective, stationarity = _rank_one_residuals(program)
        return objective, Residuals(violation, worst, stationarity, 0.0)
    objective = float(np.asarray(program.objective.expr.value))
    stationarity, complementarity = _first_order(program, duals, objective)
    return objective, Residuals(violation, worst, stationarity, complementarity)


def _rank_one_residuals(program: Program) -> tuple[float, float]:
    """Objective and stationarity of an unconstrained rank-one programme from its compressed numbers.

    The gauge has multiplier zero, because moving the scale between mu and b does not change the objective.
    """
    form = program.rank_one
    assert form is not None
    problem = form.problem
    w = np.concatenate([np.ravel(program.variables[name].value, order="F") for name in form.linear] or [np.zeros(0)])
    pairs = [(program.variables[mu].value, np.ravel(program.variables[b].value, order="F")) for mu, b in form.blocks]
    z = np.concatenate([w, *(np.kron(b, mu) for mu, b in pairs)])
    r = problem.root @ z - problem.target
    pull = 2.0 * problem.root.T @ r
    parts, position = [pull[: w.size]], w.size
    for mu, b in pairs:
        block = pull[position : position + mu.size * b.size].reshape(b.size, mu.size)
        parts += [block.T @ b, block @ mu]
        position += mu.size * b.size
    size = 2.0 * float(np.max(np.abs(problem.root.T @ problem.target), initial=0.0))
    return float(r @ r) + problem.remainder, float(np.max(np.abs(np.concatenate(parts)))) / (1.0 + size)


def measure_violation(program: Program) -> tuple[float, str]:
    """Return the largest relative violation over all constraints at the assigned point, and its name."""
    worst, name = 0.0, ""
    for key, group in program.constraints.items():
        for member in group:
            size = 1.0 + max((float(np.max(np.abs(arg.value), initial=0.0)) for arg in member.args), default=0.0)
            amount = float(np.max(np.asarray(member.violation()), initial=0.0)) / size
            if not amount <= worst:  # also true for nan
                worst, name = amount, key
    return (worst if np.isfinite(worst) else float("inf")), name


def multiplier_terms(member: Constraint, dual: np.ndarray) -> list[tuple[cp.Expression, np.ndarray]] | None:
    """Return (expression, weights) pairs whose inner products are the constraint's part of the Lagrangian.

    Args:
        member: a CVXPY constraint.
        dual: its multipliers, flat, in the order of its dual variables.

    Returns:
        The pairs, or None for a cone whose multipliers are not used here.
    """
    if isinstance(member, cp.constraints.Equality | cp.constraints.Inequality | cp.constraints.Zero
                  | cp.constraints.NonPos):
        return [(member.expr, dual)]
    if isinstance(member, cp.constraints.NonNeg | cp.constraints.PSD):
        return [(member.args[0], -dual)]
    if isinstance(member, cp.SOC):
        split = member.args[0].size
        return [(member.args[0], -dual[:split]), (member.args[1], -dual[split:])]
    return None


def _first_order(program: Program, duals: Values, objective: float) -> tuple[float, float]:
    gradient = {v.id: np.zeros(v.size) for v in program.variables.values()}
    try:
        if not _accumulate(gradient, program.objective.expr, np.ones(1)):
            return float("nan"), float("nan")
        size = max((float(np.max(np.abs(g), initial=0.0)) for g in gradient.values()), default=0.0)
        complementarity, reference = 0.0, size
        for name, group in program.constraints.items():
            if name not in duals:
                return float("nan"), float("nan")
            dual, position = duals[name], 0
            for member in group:
                length = sum(d.size for d in member.dual_variables)
                terms = multiplier_terms(member, dual[position : position + length])
                position += length
                if terms is None:
                    return float("nan"), float("nan")
                inner = 0.0
                for expression, weights in terms:
                    part = {v.id: np.zeros(v.size) for v in program.variables.values()}
                    if not _accumulate(part, expression, weights):
                        return float("nan"), float("nan")
                    for key, value in part.items():
                        gradient[key] += value
                        reference = max(reference, float(np.max(np.abs(value), initial=0.0)))
                    inner += float(np.dot(np.ravel(expression.value, order="F"), weights))
                if not isinstance(member, cp.constraints.Equality | cp.constraints.Zero):
                    complementarity = max(complementarity, abs(inner))
    except (ValueError, NotImplementedError, TypeError):
        return float("nan"), float("nan")
    residual = max((float(np.max(np.abs(g), initial=0.0)) for g in gradient.values()), default=0.0)
    return residual / (1.0 + reference), complementarity / (1.0 + abs(objective))


def _accumulate(gradient: dict[int, np.ndarray], expression: cp.Expression, weights: np.ndarray) -> bool:
    """Add d<weights, expression>/dx to the gradient; False where the expression has a kink."""
    if not _smooth(expression):
        return False
    for variable, jacobian in expression.grad.items():
        if jacobian is None:
            return False
        if variable.id in gradient:
            gradient[variable.id] += np.asarray(jacobian @ weights).ravel()
    return True


_KINKS = {"abs", "max", "maximum", "min", "minimum", "norm1", "norm_inf", "normNuc", "lambda_max", "sigma_max",
          "sum_largest", "lambda_sum_largest", "pos", "neg"}


def _smooth(expression: cp.Expression) -> bool:
    if expression.is_affine():
        return True
    return not ({type(atom).__name__ for atom in _atoms(expression)} & _KINKS)


def _atoms(expression: cp.Expression) -> list[cp.Expression]:
    stack, found = [expression], []
    while stack:
        node = stack.pop()
        found.append(node)
        stack.extend(getattr(node, "args", []))
    return found
