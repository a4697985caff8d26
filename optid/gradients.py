"""Derivatives and sizes of CVXPY expressions at the assigned point, in the one form that all of optid uses."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

PROBES = 3
"""Random points at which the size of an expression is tried."""


def flat_value(expression: cp.Expression) -> np.ndarray:
    """Return the value of an expression as a flat array, column by column."""
    return np.ravel(np.asarray(expression.value, dtype=float), order="F")


def jacobians(expression: cp.Expression) -> dict[cp.Variable, sp.csr_array] | None:
    """Return the Jacobian (rows, size) of an expression with respect to each of its variables.

    Rows and columns follow the entries column by column. None where CVXPY knows no gradient at the assigned point.
    """
    found = {}
    for variable, part in expression.grad.items():
        if part is None:
            return None
        matrix = part if sp.issparse(part) else np.reshape(np.asarray(part, dtype=float),
                                                           (variable.size, expression.size))
        found[variable] = sp.csr_array(sp.csr_array(matrix).T)
    return found


def affine_parts(expression: cp.Expression) -> tuple[dict[cp.Variable, sp.csr_array], np.ndarray] | None:
    """Return the Jacobians of an affine expression, as `jacobians` does, and its constant, flat; None if not affine.

    The constant is the value at the origin, so that one that is zero is exactly zero.
    """
    if not expression.is_affine():
        return None
    with _values_kept(expression.variables()) as variables:
        for variable in variables:
            variable.save_value(np.zeros(variable.shape))
        slopes = jacobians(expression)
        return None if slopes is None else (slopes, flat_value(expression))


def row_sizes(expression: cp.Expression, usual: Mapping[int, float]) -> np.ndarray:
    """Return how much every entry of an expression changes when its variables have their usual size; never zero.

    Args:
        expression: affine or smooth.
        usual: {id of a variable: usual size of its entries}; one where it is not named.
    """
    rng = np.random.default_rng(0)
    with _values_kept(expression.variables()) as variables:
        for variable in variables:
            variable.save_value(np.zeros(variable.shape))
        origin, largest = flat_value(expression), np.zeros(expression.size)
        for _ in range(PROBES):
            for variable in variables:
                entries = rng.uniform(0.5, 1.5, variable.shape) * rng.choice([-1.0, 1.0], variable.shape)
                if variable.ndim == 2 and variable.attributes["symmetric"]:
                    entries = (entries + entries.T) / 2
                variable.save_value(usual.get(variable.id, 1.0) * entries)
            largest = np.fmax(largest, np.abs(flat_value(expression) - origin))
    usable = np.isfinite(largest) & (largest > 64 * np.finfo(float).eps * np.abs(origin))
    return np.where(usable, largest, 1.0)


@contextmanager
def _values_kept(variables: list[cp.Variable]) -> Iterator[list[cp.Variable]]:
    saved = [variable.value for variable in variables]
    try:
        yield variables
    finally:
        for variable, value in zip(variables, saved):
            variable.save_value(value)
