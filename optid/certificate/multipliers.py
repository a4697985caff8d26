"""Multipliers of our own: those that come nearest to making a point stationary, whatever the solver says of them."""

from collections.abc import Callable, Mapping

import numpy as np
from cvxpy.constraints.constraint import Constraint
from cvxpy.constraints.psd import PSD

from optid.arrays import Array
from optid.program.expressions import flat_value, jacobians
from optid.program.judging import Lagrangian, term_size
from optid.program.limits import EQUALITIES, rows_of, spans
from optid.program.program import Program
from optid.structures.multipliers import exchange_multipliers, fit_multipliers

ACTIVE = 1e-6  # slack, relative to the size of the constraint's terms, up to which an inequality may have a multiplier
LARGEST = 4_000_000  # entries of the system of equations, at most
INDEPENDENT = 1e-10  # length of a row beside the equalities, relative to its own, that is no combination of them


def fitted_multipliers(program: Program) -> dict[str, Array] | None:
    """Return flat multipliers of all constraints, nearest to making the assigned point stationary.

    Equalities may have any, active inequalities those of their sign, matrix inequalities combinations of the directions
    in which they are active. None where the objective has no gradient, for other cones, and for large programmes.
    """
    system = _stationarity(program)
    if system is None:
        return None
    columns, equality, places, target = system
    weights = _least_squares(columns, equality, target)
    if weights is None:
        return None
    duals: dict[str, Array] = {
        name: np.zeros(sum(dual.size for member in group for dual in member.dual_variables))
        for name, group in program.constraints.items()}
    for weight, (name, span, direction) in zip(weights, places):
        duals[name][span] += weight * direction
    return duals


def least_multipliers(program: Program, duals: Mapping[str, Array]) -> Callable[[str, Array], Array] | None:
    """Return, for an effect of the multipliers of a named constraint, those of all at the point that have the least.

    Where more rows are active than the point needs, many multipliers make it stationary; a bound that is relaxed gains
    the least that any of them says. None where they are unique, or not polyhedral.

    Args:
        program: the programme, its point assigned.
        duals: multipliers that make the point stationary.
    """
    system = _stationarity(program)
    if system is None or any(isinstance(member, PSD) for group in program.constraints.values() for member in group):
        return None
    return exchange_multipliers(*system, duals)


def _stationarity(program: Program) -> tuple[Array, np.ndarray, list[tuple[str, slice, Array]], Array] | None:
    """Return scaled gradients (k, n) of what may have a multiplier, which are equalities, their places, and a target.

    Multipliers w make the point stationary where w @ gradients = target (n,).
    """
    lagrangian = Lagrangian(program)
    try:
        if not lagrangian.add(program.objective.expr, np.ones(1)):
            return None
        found = _columns(program)
    except (ValueError, NotImplementedError, TypeError):  # no gradient in CVXPY
        return None
    if found is None:
        return None
    columns, equality, places = found
    yardstick = max(abs(float(np.asarray(program.objective.expr.value))), program.scale)
    floor = np.concatenate([lagrangian.floor(v, yardstick) for v in lagrangian.variables])
    target = -np.concatenate([lagrangian.total[v.id] for v in lagrangian.variables]) / floor
    return columns / floor, equality, places, target


def _columns(program: Program) -> tuple[Array, np.ndarray, list[tuple[str, slice, Array]]] | None:
    """Return what a unit multiplier adds to the gradient, (k, n), which are equalities, and where each belongs."""
    variables = list(program.variables.values())
    usual, columns, equality, places = program.usual_sizes, [], [], []
    size = sum(v.size for v in variables)
    for name, group in program.constraints.items():
        for member, span in zip(group, spans(group)):
            directions, rows = _candidates(member, usual), rows_of(member)
            if directions is None or (len(columns) + len(directions)) * size > LARGEST:
                return None
            slopes = jacobians(member.args[0] if rows is None else rows)
            if slopes is None:
                return None
            sign = -1.0 if isinstance(member, PSD) else 1.0
            by_id = {variable.id: slope for variable, slope in slopes.items()}
            for direction in directions:
                parts = [np.asarray(by_id[v.id].T @ direction).ravel() if v.id in by_id else np.zeros(v.size)
                         for v in variables]
                columns.append(sign * np.concatenate(parts))
                equality.append(isinstance(member, EQUALITIES))
                places.append((name, span, direction))
    return np.array(columns).reshape(-1, size), np.array(equality, dtype=bool), places


def _candidates(member: Constraint, usual: dict[int, float]) -> list[Array] | None:
    """Return the flat multipliers, of which those of a constraint are combinations; None for a cone of another kind."""
    rows = rows_of(member)
    if rows is not None:
        value = flat_value(rows)
        active = np.ones(value.size, bool) if isinstance(member, EQUALITIES) else (
            value >= -ACTIVE * term_size(member, usual))
        return list(np.eye(value.size)[active])
    if not isinstance(member, PSD):
        return None
    matrix = np.asarray(member.args[0].value)
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    null = vectors[:, values <= ACTIVE * term_size(member, usual)]
    pairs = [(null[:, i] + sign * null[:, j]) / np.sqrt(2) for i in range(null.shape[1]) for j in range(i)
             for sign in (1.0, -1.0)]
    return [np.outer(v, v).ravel(order="F") for v in (*null.T, *pairs)]


def _least_squares(columns: Array, equality: np.ndarray, target: Array) -> Array | None:
    """Return the weights of the columns (k, n) nearest to a target (n,), not below zero but for equalities."""
    fixed, free = columns[equality], columns[~equality]
    basis = np.zeros((columns.shape[1], 0))
    if len(fixed):
        vectors, values, _ = np.linalg.svd(fixed.T, full_matrices=False)
        basis = vectors[:, values > INDEPENDENT * max(float(values[0]), 1e-300)]
    rest = free - (free @ basis) @ basis.T
    rest[np.linalg.norm(rest, axis=1) <= INDEPENDENT * np.linalg.norm(free, axis=1)] = 0.0
    weights = np.zeros(len(columns))
    try:
        weights[~equality] = fit_multipliers(rest, target - basis @ (basis.T @ target), np.zeros(len(free), bool))[0]
    except RuntimeError:  # the iterations did not suffice
        return None
    if len(fixed):
        weights[equality] = np.linalg.lstsq(fixed.T, target - free.T @ weights[~equality], rcond=INDEPENDENT)[0]
    return weights
