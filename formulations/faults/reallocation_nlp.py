"""Re-allocation in the inputs: for nonlinearities without an inverse, for feedback, and for rates of u.

    minimise sum ‖W (y_k - r)‖² + effort ‖(u_k - u_s) / half the range‖² + terminal cost
    subject to x_k+1 = A x_k + B f(u_k) + E g(y_k) + L y_k + d, y_k = C x_k + D f(u_k) + c, bounds and rates of u

by multiple shooting (Bock 1984): the programmes of `formulations.faults.reallocation` with v = f(u) as equations. A
function is written as a straight line and softened kinks, ``width log(1 + exp((u - node) / width))``: of a piecewise
linear one at its corners, with a width that does not show; of any other at even nodes, as wide as their distance, which
gives smooth functions to about 1e-6 of their range. Any NLP back end takes it. Local minima: there is no bound.
"""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.faults.reallocation import target, track
from optid.bases import Triangular
from optid.faults.repair.allocation_problem import AllocationProblem
from optid.program.program import Program

Array = np.ndarray

NODES = 16
"""Cells of a function that is not piecewise linear."""

SHARP = 1e-5
"""Width of a corner, as a share of the range."""


def resting(problem: AllocationProblem, *, reference: Any, constraints: Sequence[Any] = ()) -> Program:
    """Build the resting point nearest to a reference; see `formulations.faults.reallocation.target`."""
    return target(problem, reference=reference, equations=function_equations, constraints=constraints)


def tracker(problem: AllocationProblem, **how: Any) -> Program:
    """Build the control of a horizon, with or without rates of u; see `formulations.faults.reallocation.track`."""
    return track(problem, **how, equations=function_equations)


def function_equations(problem: AllocationProblem, u: Any, v: Any, y: Any) -> dict[str, tuple[Any, ...]]:
    """Return v = [f(u); g(y)], by column."""
    found = {}
    for i, (one, c, name) in enumerate(zip(problem.inverses, problem.input_of, problem.names)):
        found[f"f {i + 1} of {name}"] = (v[..., i] == _written(one.f, one.low, one.high, u[..., c]),)
    for j, (g, o) in enumerate(problem.feedback):
        low, high = g.basis.interval or (-1.0, 1.0)
        margin = 0.0 if g.basis.outside == "error" else (high - low) / 2
        column = v[..., problem.low.size + j]
        found[f"feedback of {problem.outputs[o]} {j + 1}"] = (
            column == _written(g, low - margin, high + margin, y[..., o]),)
    return found


def _written(f: Any, low: float, high: float, z: Any) -> Any:
    """Return f(z) as an expression of smooth atoms; straight lines beyond the range."""
    cell = (high - low) / NODES
    nodes, width = low + cell * np.arange(-2, NODES + 3), 0.7 * cell
    if isinstance(f.basis, Triangular):
        nodes, width = f.basis.nodes, SHARP * (high - low)
        nodes = nodes[(nodes > low) & (nodes < high)]
    grid = np.union1d(np.linspace(low, high, 801), nodes[(nodes >= low) & (nodes <= high)])
    bends = width * np.logaddexp(0.0, (grid[:, None] - nodes) / width)
    heights = np.linalg.lstsq(np.column_stack([np.ones(grid.size), grid, bends]), f(grid), rcond=1e-11)[0]
    kinks = [float(c * width) * cp.logistic((z - node) / width) for node, c in zip(nodes, heights[2:])]
    return sum(kinks, heights[0] + heights[1] * z)
