"""Our own residuals at a solver's point: a solver's status is a claim, these numbers decide."""

from collections.abc import Iterable, Mapping

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint
from cvxpy.constraints.psd import PSD
from cvxpy.constraints.second_order import SOC

from optid.arrays import largest
from optid.program.expressions import flat_value, jacobians
from optid.program.limits import EQUALITIES, INEQUALITIES, rows_of, spans
from optid.program.program import Program, Values
from optid.program.solution import Residuals
from optid.program.structure import variable_size

KINKS = {"abs", "max", "maximum", "min", "minimum", "norm1", "norm_inf", "normNuc", "lambda_max", "sigma_max",
         "sum_largest", "lambda_sum_largest", "pos", "neg"}
"""Atoms whose gradient says nothing where they have a kink."""


def judge(program: Program, values: Values, duals: Values) -> tuple[Values, float, Residuals]:
    """Measure a point: its values, the objective recomputed, violation, stationarity and complementarity.

    Derived variables are recomputed from the others first. The duals are flat multipliers by constraint, of which some
    may be missing; see `Residuals` for where the measurements are ``nan``.

    Raises:
        ValueError: a value of another shape than its variable.
    """
    structure = None if program.user_constraints else program.structure
    program.assign(values)
    if program.is_stated or structure is None:
        values, (violation, worst) = program.values(), measure_violation(program)
    else:
        values, violation, worst = structure.complete(program, values)
    known = None if structure is None else structure.measure(program, values)
    if known is not None:
        objective, stationarity = known
        return values, objective, Residuals(violation, worst, stationarity, 0.0)
    objective, stationarity, complementarity = float(np.asarray(program.objective.expr.value)), np.nan, np.nan
    try:
        lagrangian = Lagrangian.of(program, duals, program.constraints)
        if lagrangian is not None and lagrangian.add(program.objective.expr, np.ones(1)):
            stationarity = lagrangian.residual(max(abs(objective), program.scale))
            size = max(abs(objective), 1e-2 * program.scale)  # a hundredth of the zero model's where it vanishes
            complementarity = lagrangian.complementarity / size
    except (ValueError, NotImplementedError, TypeError):  # no gradient in CVXPY, or a multiplier of another shape
        pass
    return values, objective, Residuals(violation, worst, stationarity, complementarity)


def _size(variable: cp.Variable, usual: Mapping[int, float]) -> float:
    return variable_size(flat_value(variable), usual.get(variable.id))


def measure_violation(program: Program) -> tuple[float, str]:
    """Return the largest relative violation over all constraints at the assigned point, and its name.

    Bounds that variables carry as attributes count as well, under the name of the variable.
    """
    amounts, usual = [], program.usual_sizes
    for key, group in program.constraints.items():
        if key in program.derived:
            continue  # recomputed, hence exact
        for member in group:
            with np.errstate(divide="ignore", invalid="ignore"):  # CVXPY's projection on a cone at its axis
                amount = float(np.max(np.asarray(member.violation()), initial=0.0))
            amounts.append((amount / term_size(member, usual) if amount else 0.0, key))
    for key, variable in program.variables.items():
        value, amount, size = np.asarray(variable.value, dtype=float), 0.0, _size(variable, usual)
        if (bounds := bounds_of(variable)) is not None:
            amount = float(np.max(np.maximum(bounds[0] - value, value - bounds[1]), initial=0.0))
            size = max([size, *(float(np.max(np.abs(b[np.isfinite(b)]), initial=0.0)) for b in bounds)])
        elif variable.attributes["PSD"] or variable.attributes["NSD"]:
            sign = 1.0 if variable.attributes["PSD"] else -1.0
            amount = max(0.0, -float(np.min(np.linalg.eigvalsh(sign * (value + value.T) / 2))))
        amounts.append((amount / size, key))
    worst, name = largest(amounts)
    return (worst if np.isfinite(worst) else float("inf")), name


def term_size(member: Constraint, usual: Mapping[int, float] | None = None) -> float:
    """Size of the terms that a constraint adds up at the assigned point: what a slack or a violation is relative to.

    Every variable counts with its largest entry, so that the measure does not depend on units, but not below its usual
    size: at a point where it vanishes only roundoff is left of it.
    """
    expressions = [member.expr] if isinstance(member, EQUALITIES | INEQUALITIES) else member.args
    sizes = [_terms(expression, usual or {}) for expression in expressions]
    largest = max((float(np.max(np.abs(arg.value), initial=0.0)) for arg in member.args), default=0.0)
    return max([size for size in sizes if size is not None], default=largest) or largest or 1.0


def _terms(expression: cp.Expression, usual: Mapping[int, float]) -> float | None:
    """Largest sum of the magnitudes of the terms of an entry; None where CVXPY has no gradient."""
    slopes = jacobians(expression)
    if slopes is None:
        return None
    total, inner = np.zeros(expression.size), -flat_value(expression)
    for variable, slope in slopes.items():
        size = max(float(np.max(np.abs(flat_value(variable)), initial=0.0)), usual.get(variable.id, 0.0))
        total += abs(slope).sum(axis=1) * size
        inner += slope @ flat_value(variable)
    return float(np.max(total + np.abs(inner), initial=0.0))  # inner is now minus the constant of an affine expression


def bounds_of(variable: cp.Variable) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the bounds that a variable carries as attributes (nonneg, bounds, ...), None where it has none."""
    if all(variable.attributes[key] in (None, False) for key in ("nonneg", "nonpos", "pos", "neg", "bounds")):
        return None
    lower, upper = (np.asarray(bound, dtype=float) for bound in variable.get_bounds())
    return lower, upper


def multiplier_terms(member: Constraint, dual: np.ndarray) -> list[tuple[cp.Expression, np.ndarray]] | None:
    """Return (expression, weights) pairs whose inner products are the constraint's part of the Lagrangian.

    The flat multipliers are projected on the dual cone, so that one of the wrong sign leaves a residual. None for a
    cone whose multipliers are not used here.
    """
    if (rows := rows_of(member)) is not None:
        return [(rows, dual if isinstance(member, EQUALITIES) else np.maximum(dual, 0.0))]
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


class Lagrangian:
    """Objective plus constraints weighed by their multipliers: gradient at the assigned point and what it is a sum of.

    Attributes:
        variables: of the programme.
        total: {id of a variable: gradient (size,)}.
        terms: {id of a variable: sum of the magnitudes of its terms}.
        value: sum of the products of multipliers and constraints.
        complementarity: sum of their magnitudes, over inequalities and cones.
    """

    def __init__(self, program: Program) -> None:
        self.variables = list(program.variables.values())
        self.usual = program.usual_sizes
        self.total = {v.id: np.zeros(v.size) for v in self.variables}
        self.terms = {v.id: np.zeros(v.size) for v in self.variables}
        self.value, self.complementarity = 0.0, 0.0

    @classmethod
    def of(cls, program: Program, duals: Values, names: Iterable[str]) -> "Lagrangian | None":
        """Add up the named constraints, multipliers projected on the dual cones; None where one has none, or no use."""
        found = cls(program)
        for name in names:
            if name not in duals:
                return None
            group = program.constraints[name]
            for member, span in zip(group, spans(group)):
                terms = multiplier_terms(member, duals[name][span])
                if terms is None or not all(found.add(expression, weights) for expression, weights in terms):
                    return None
                products = [flat_value(expression) * weights for expression, weights in terms]
                found.value += float(sum(map(np.sum, products)))
                if not isinstance(member, EQUALITIES):
                    whole = isinstance(member, PSD | SOC)  # in these cones only the sum of the products vanishes
                    found.complementarity += abs(float(sum(map(np.sum, products)))) if whole else float(
                        np.sum(np.abs(products[0])))
        return found

    def add(self, expression: cp.Expression, weights: np.ndarray) -> bool:
        """Add d<weights, expression>/dx; False where the expression has a kink or no gradient."""
        if not expression.is_affine() and {atom.__name__ for atom in expression.atoms()} & KINKS:
            return False
        slopes = jacobians(expression)
        for variable, slope in (slopes or {}).items():
            if variable.id in self.total:
                self.total[variable.id] += slope.T @ weights
                self.terms[variable.id] += abs(slope).T @ np.abs(weights)
        return slopes is not None

    def residual(self, yardstick: float) -> float:
        """Return the largest component relative to its terms plus the objective's size per size of the variable."""
        parts = [(variable, self.free_part(variable)) for variable in self.variables]
        return largest((np.nan if part is None else float(np.max(part / self.floor(variable, yardstick), initial=0.0)),
                        variable.name()) for variable, part in parts)[0]

    def floor(self, variable: cp.Variable, yardstick: float) -> np.ndarray:
        """Return what the components of the gradient by a variable are relative to, (size,)."""
        floor = yardstick / _size(variable, self.usual) + self.terms[variable.id]
        return np.where(floor > 0, floor, 1.0)

    def gradient(self, variable: cp.Variable) -> np.ndarray:
        """Return the gradient in the shape of a variable, symmetric where the variable is."""
        gradient = np.reshape(self.total[variable.id], variable.shape, order="F")
        return (gradient + gradient.T) / 2 if variable.attributes["symmetric"] else gradient

    def free_part(self, variable: cp.Variable) -> np.ndarray | None:
        """Magnitudes of the gradient that the variable's own attributes leave free; None where that is not known."""
        flags = variable.attributes
        if any(flags[key] not in (None, False) for key in ("PSD", "NSD", "diag", "sparsity", "boolean", "integer")):
            return None
        gradient = self.gradient(variable)
        if (bounds := bounds_of(variable)) is not None:
            value, margin = np.asarray(variable.value), 1e-6 * _size(variable, self.usual)
            held = ((value <= bounds[0] + margin) & (gradient > 0)) | ((value >= bounds[1] - margin) & (gradient < 0))
            gradient = np.where(held, 0.0, gradient)
        return np.abs(np.ravel(gradient, order="F"))
