"""Least squares of whitened innovations or covariances, with a penalty: the frame of the fault programmes."""

from collections.abc import Mapping
from typing import Any

import cvxpy as cp
import numpy as np

from optid.program.program import Program, Values
from optid.program.view import View


def least_squares(name: str, target: np.ndarray, fit: Any, variables: Mapping[str, cp.Variable], start: Values,
                  view: Mapping[str, Any], *, penalty: Any = 0.0,
                  constraints: Mapping[str, tuple[Any, ...]] | None = None, **further: Any) -> Program:
    """Build min 1/2 ‖target - fit‖² + penalty, with the residual as a variable of its own.

    Args:
        name: of the programme.
        target: (M,).
        fit: (M,) expression of the variables.
        variables: named variables.
        start: values to start from.
        view: named expressions for constraints.
        penalty: added to the objective.
        constraints: structural ones.
        further: fields of the `Program`.
    """
    residual, misfit = cp.Variable(target.size, name="residual"), target - fit
    structural = {"residual": (residual == misfit,), **(constraints or {})}
    return Program(
        name, cp.Minimize(0.5 * cp.sum_squares(residual) + penalty), structural, {**variables, "residual": residual},
        start, dict, View(dict(view)), structural=frozenset(structural), derived={"residual": misfit},
        scale=0.5 * float(target @ target), **further)
