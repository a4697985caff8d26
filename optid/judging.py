"""Our own residuals at a solver's point: a solver's status is a claim, these numbers decide."""

from collections.abc import Mapping

import cvxpy as cp
import numpy as np
import scipy.sparse as sp
from cvxpy.constraints.constraint import Constraint
from cvxpy.constraints.nonpos import Inequality, NonNeg, NonPos
from cvxpy.constraints.psd import PSD
from cvxpy.constraints.second_order import SOC
from cvxpy.constraints.zero import Equality, Zero

from optid.program import Program, RankOneForm, Values
from optid.solution import Residuals

ZERO = 1e-9  # a variable smaller than this has no size of its own to measure by


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
    form = program.rank_one or program.least_squares
    if form is not None and not program.user_constraints:
        objective, stationarity = _rank_one_residuals(program, form)
        return objective, Residuals(violation, worst, stationarity, 0.0)
    objective = float(np.asarray(program.objective.expr.value))
    stationarity, complementarity = _first_order(program, duals, objective)
    return objective, Residuals(violation, worst, stationarity, complementarity)


def _rank_one_residuals(program: Program, form: RankOneForm) -> tuple[float, float]:
    """Objective and stationarity of an unconstrained rank-one programme from its compressed numbers.

    The gauge has multiplier zero, because moving the scale between mu and b does not change the objective.
    """
    problem = form.problem
    flat = {name: _flat(variable) for name, variable in program.variables.items()}
    w = np.concatenate([flat[name] for name in form.linear] or [np.zeros(0)])
    pairs = [(flat[mu], flat[b]) for mu, b in form.blocks]
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


def _flat(expression: cp.Expression) -> np.ndarray:
    """Value of an expression as a flat array, column by column."""
    return np.ravel(np.asarray(expression.value, dtype=float), order="F")


def value_size(program: Program, objective: float) -> float:
    """Yardstick of errors in the objective: its magnitude, or a hundredth of the zero model's where it vanishes."""
    return max(abs(objective), 1e-2 * program.scale)


def measure_violation(program: Program) -> tuple[float, str]:
    """Return the largest relative violation over all constraints at the assigned point, and its name.

    Bounds that variables carry as attributes count as well, under the name of the variable.
    """
    worst, name, usual = 0.0, "", usual_sizes(program)
    for key, group in program.constraints.items():
        if key in program.derived:
            continue  # recomputed, hence exact
        for member in group:
            with np.errstate(divide="ignore", invalid="ignore"):  # CVXPY's projection on a cone at its axis
                amount = float(np.max(np.asarray(member.violation()), initial=0.0)) / term_size(member, usual)
            if not amount <= worst:  # also true for nan
                worst, name = amount, key
    for key, variable in program.variables.items():
        value, amount = np.asarray(variable.value, dtype=float), 0.0
        if has_bounds(variable):
            lower, upper = variable.get_bounds()
            amount = float(np.max(np.maximum(lower - value, value - upper), initial=0.0))
        elif variable.attributes["PSD"] or variable.attributes["NSD"]:
            sign = 1.0 if variable.attributes["PSD"] else -1.0
            amount = max(0.0, -float(np.min(np.linalg.eigvalsh(sign * (value + value.T) / 2))))
        amount /= 1.0 + float(np.max(np.abs(value), initial=0.0))
        if not amount <= worst:
            worst, name = amount, key
    return (worst if np.isfinite(worst) else float("inf")), name


def usual_sizes(program: Program) -> dict[int, float]:
    """Largest entry of every variable at the programme's start, by id of the variable."""
    return {program.variables[name].id: float(np.max(np.abs(value), initial=0.0))
            for name, value in program.start.items() if name in program.variables}


def term_size(member: Constraint, usual: Mapping[int, float] | None = None) -> float:
    """Size of the terms that a constraint adds up at the assigned point: what a slack or a violation is relative to.

    For affine constraints every variable counts with its largest entry, so that the measure does not depend on units;
    where that vanishes, and for other constraints, it is one more than the largest argument.

    Args:
        member: the constraint.
        usual: sizes below which a variable does not count: at a point where it vanishes only roundoff is left of it.
    """
    largest = 1.0 + max((float(np.max(np.abs(arg.value), initial=0.0)) for arg in member.args), default=0.0)
    if not isinstance(member, Equality | Zero | Inequality | NonPos) or not member.expr.is_affine():
        return largest
    total = np.zeros(member.size)
    inner = -_flat(member.expr)
    for variable, jacobian in member.expr.grad.items():
        if jacobian is None:
            return largest
        entries = sp.csc_array(jacobian if sp.issparse(jacobian) else np.atleast_2d(jacobian))
        entries = entries.reshape((variable.size, member.size))
        size = max(float(np.max(np.abs(_flat(variable)), initial=0.0)), (usual or {}).get(variable.id, 0.0))
        total += np.asarray(abs(entries).sum(axis=0)).ravel() * size
        inner += entries.T @ _flat(variable)
    size = float(np.max(total + np.abs(inner), initial=0.0))  # inner is now minus the constant of the constraint
    return size if size > ZERO**2 else largest


def has_bounds(variable: cp.Variable) -> bool:
    """Whether the variable carries bounds as attributes (nonneg, bounds, ...)."""
    return any(variable.attributes[key] not in (None, False) for key in ("nonneg", "nonpos", "pos", "neg", "bounds"))


def multiplier_terms(member: Constraint, dual: np.ndarray) -> list[tuple[cp.Expression, np.ndarray]] | None:
    """Return (expression, weights) pairs whose inner products are the constraint's part of the Lagrangian.

    Args:
        member: a CVXPY constraint.
        dual: its multipliers, flat, in the order of its dual variables.

    Returns:
        The pairs, with the multipliers projected on the dual cone so that one of the wrong sign leaves a residual,
        or None for a cone whose multipliers are not used here.
    """
    if isinstance(member, Equality | Zero):
        return [(member.expr, dual)]
    if isinstance(member, Inequality | NonPos):
        return [(member.expr, np.maximum(dual, 0.0))]
    if isinstance(member, NonNeg):
        return [(member.args[0], -np.maximum(dual, 0.0))]
    if isinstance(member, PSD):
        square = np.reshape(dual, member.args[0].shape, order="F")
        values, vectors = np.linalg.eigh((square + square.T) / 2)
        return [(member.args[0], -np.ravel((vectors * np.maximum(values, 0.0)) @ vectors.T, order="F"))]
    if isinstance(member, SOC) and member.args[0].size == 1:
        level, rest = float(dual[0]), dual[1:]
        length = float(np.linalg.norm(rest))
        if length > level:  # projection on the second-order cone
            factor = max(0.0, (level + length) / 2)
            level, rest = factor, factor * rest / max(length, np.finfo(float).tiny)
        return [(member.args[0], -np.array([level])), (member.args[1], -rest)]
    return None


class _Gradient:
    """Gradient of the Lagrangian, with the size of the terms every component is a sum of."""

    def __init__(self, program: Program) -> None:
        self.variables = list(program.variables.values())
        self.total = {v.id: np.zeros(v.size) for v in self.variables}
        self.terms = {v.id: np.zeros(v.size) for v in self.variables}

    def add(self, expression: cp.Expression, weights: np.ndarray) -> bool:
        """Add d<weights, expression>/dx; False where the expression has a kink or no gradient."""
        if not _smooth(expression):
            return False
        for variable, jacobian in expression.grad.items():
            if jacobian is None:
                return False
            if variable.id in self.total:
                jacobian = jacobian if np.ndim(jacobian) else np.full((1, 1), jacobian)
                self.total[variable.id] += np.asarray(jacobian @ weights).ravel()
                self.terms[variable.id] += np.asarray(abs(jacobian) @ np.abs(weights)).ravel()
        return True

    def residual(self, yardstick: float) -> float:
        """Return the largest component relative to its terms plus the objective's size per size of the variable."""
        worst = 0.0
        for variable in self.variables:
            part = _free_part(variable, self.total[variable.id])
            if part is None:
                return float("nan")
            size = float(np.max(np.abs(_flat(variable)), initial=0.0))
            floor = yardstick / (size if size > ZERO else 1.0)
            worst = max(worst, float(np.max(part / (floor + self.terms[variable.id]), initial=0.0)))
        return worst


def _free_part(variable: cp.Variable, gradient: np.ndarray) -> np.ndarray | None:
    """Magnitudes of the gradient that the variable's own attributes leave free; None where that is not known."""
    flags = variable.attributes
    if any(flags[key] not in (None, False) for key in ("PSD", "NSD", "diag", "sparsity", "boolean", "integer")):
        return None
    gradient = np.reshape(gradient, variable.shape, order="F")
    if flags["symmetric"]:
        gradient = (gradient + gradient.T) / 2
    if has_bounds(variable):
        lower, upper = (np.asarray(bound) for bound in variable.get_bounds())
        value = np.asarray(variable.value)
        margin = 1e-6 * (1.0 + np.abs(value))
        held = ((value <= lower + margin) & (gradient > 0)) | ((value >= upper - margin) & (gradient < 0))
        gradient = np.where(held, 0.0, gradient)
    return np.abs(np.ravel(gradient, order="F"))


def _first_order(program: Program, duals: Values, objective: float) -> tuple[float, float]:
    unknown = float("nan"), float("nan")
    gradient, complementarity = _Gradient(program), 0.0
    yardstick = max(abs(objective), program.scale)
    try:
        if not gradient.add(program.objective.expr, np.ones(1)):
            return unknown
        for name, group in program.constraints.items():
            if name not in duals:
                return unknown
            position = 0
            for member in group:
                length = sum(d.size for d in member.dual_variables)
                terms = multiplier_terms(member, duals[name][position : position + length])
                position += length
                if terms is None or not all(gradient.add(expression, weights) for expression, weights in terms):
                    return unknown
                if not isinstance(member, Equality | Zero):
                    products = [_flat(expression) * weights for expression, weights in terms]
                    whole = isinstance(member, PSD | SOC)  # in these cones only the sum of the products vanishes
                    complementarity += abs(sum(map(np.sum, products))) if whole else float(np.sum(np.abs(products[0])))
    except (ValueError, NotImplementedError, TypeError):  # no gradient in CVXPY, or a multiplier of another shape
        return unknown
    return gradient.residual(yardstick), float(complementarity / value_size(program, objective))


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
