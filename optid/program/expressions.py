"""Expressions that several programmes are written with, and CVXPY's solvers without its warnings."""

import warnings
from typing import Any

import cvxpy as cp
import numpy as np


def flat(expression: cp.Expression) -> cp.Expression:
    """Stack the columns of an expression."""
    return expression if expression.ndim == 1 else cp.vec(expression, order="F")


def tangent_product(mu: cp.Expression, b: cp.Expression, mu0: np.ndarray, b0: np.ndarray) -> cp.Expression:
    """Return ``mu bᵀ`` to first order about (mu0, b0)."""
    return cp.outer(mu, b0) + cp.outer(mu0, b) - np.outer(mu0, b0)


def solve_quietly(problem: cp.Problem, solver: str = "CLARABEL", **options: Any) -> None:
    """Solve a problem by CVXPY; a point that may be inaccurate is ours to judge, and no reason for a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(solver=solver, **options)
