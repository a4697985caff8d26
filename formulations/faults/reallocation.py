"""Re-allocation of a plant to its remaining actuators: the resting point nearest to a reference.

    minimise ‖W (y - r)‖²   subject to   x = A x + B v + d,   y = C x + D v + c,   and the bounds of the actuators

A monotone nonlinearity maps the range of its input onto a range of v = f(u) exactly, so that the problem is linear in
v: the bounds of the inputs are those of v, and u = f^-1(v) keeps them. A stuck actuator is one whose range is a point.
Where the reference cannot be reached, the distance is positive, and the multipliers of the bounds say which actuator
limits it.

* ``resting``: in the inputs u themselves, v = f(u) as equations, for nonlinearities without an inverse and for
  feedback. A function is written as a straight line and softened kinks, ``width log(1 + exp((u - node) / width))``: of
  a piecewise linear one at its corners, with a width that does not show; of any other at even nodes, as wide as their
  distance, which gives smooth functions to about 1e-6 of their range. Local minima: there is no bound.
* With several members, the possible damages: the same v for all, with the least cost of the worst of them (min-max),
  each a plant with its own gains and constants in the v of the healthy nonlinearities.
* With ``norm``: ‖S v‖ <= limit, a limit that actuators share (a pump, a power supply).

Named variables: ``v``, ``x``, ``y`` (``x[i]``, ``y[i]`` of member i), ``worst`` where there are several, and ``u``.
"""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from optid.bases import Triangular
from optid.core.problem import Problem
from optid.core.terms import Expressed, Squares, Values
from optid.faults.repair.allocation import Allocation
from optid.program.view import View

Array = np.ndarray

TIE = 1e-8
"""Weight of the distance from the middle of the range, to decide between resting points of the same outputs."""

NODES = 16
"""Cells of a function that is not piecewise linear."""

SHARP = 1e-5
"""Width of a corner, as a share of the range."""


def target(problem: Allocation, *, reference: Any, constraints: Sequence[Any] = ()) -> Problem:
    """State the problem of the resting point nearest to a reference, in v.

    Args:
        problem: the damaged plant.
        reference: (l,) of the outputs.
        constraints: builders of further constraints in v, x and y.
    """
    start = _rests(problem, np.append(problem.v_middle, np.zeros(len(problem.feedback))))
    return _posed("allocation.target", problem, start, "v", reference).subject_to(*constraints)


def resting(problem: Allocation, *, reference: Any, constraints: Sequence[Any] = ()) -> Problem:
    """State the problem of the resting point nearest to a reference, in the inputs u; arguments as of `target`."""
    u = problem.middle
    values = [float(one.f(u[c])) for one, c in zip(problem.inverses, problem.model.input_of)]
    start = {**_rests(problem, np.append(values, np.zeros(len(problem.feedback)))), "u": u}
    return _posed("allocation.resting", problem, start, "u", reference).subject_to(*constraints)


def _posed(name: str, problem: Allocation, start: Values, free: str, reference: Any) -> Problem:
    """State the problem: the cost, or the worst cost of several members, and the tie-break of what is free."""
    r, labels = np.asarray(reference, dtype=float), _labels(problem)
    costs = [Squares(np.diag(problem.weights), problem.weights * r, 0.0, (f"y{label}",)) for label in labels]
    low, high, half, words = problem.v_low, problem.v_high, problem.v_half, problem.names
    if free == "u":
        low, high = problem.low, problem.high
        half, words = (high - low) / 2, tuple(f"actuator:{one}" for one in problem.model.inputs)
    tie = np.sqrt(TIE * problem.scale) / half
    chosen = np.eye(len(half), np.size(start[free]))  # feedback has columns of v, but no range
    effort = Squares(tie[:, None] * chosen, tie * (low + high) / 2, 0.0, (free,))

    def equations(v: View) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for label, member in zip(labels, problem.members):
            x, y = v[f"x{label}"], v[f"y{label}"]
            found[f"rest{label}"] = x == member.A @ x + member.B @ v["v"] + member.d
            found[f"outputs{label}"] = y == member.C @ x + member.D @ v["v"] + member.c
        for i, word in enumerate(words):
            if low[i] == high[i]:
                found[f"held {word}"] = v[free][i] == low[i]
            else:
                found[f"least {word}"], found[f"most {word}"] = v[free][i] >= low[i], v[free][i] <= high[i]
        if problem.norm is not None:
            found["shared limit"] = cp.sum_squares(problem.norm @ v["v"]) <= problem.limit**2
        if len(costs) > 1:
            found["worst member"] = [cost.express(v) <= v["worst"] for cost in costs]
        return {**found, **(_functions(problem, v) if free == "u" else {})}

    terms = (costs[0], effort)
    if len(costs) > 1:
        start = {**start, "worst": np.array(max(cost.value(start) for cost in costs))}
        terms = (Expressed(lambda v: v["worst"]), effort)
    rest = problem.members[0].rest_output(np.append(problem.v_middle, np.zeros(len(problem.feedback))))
    return Problem(name, start, terms, model=lambda values: values["v"],
                   facts={"channels": problem.names, "outputs": problem.model.outputs}, restrictions=(equations,),
                   scale=float(np.sum((problem.weights * (r - rest)) ** 2)) or 1.0)


def _labels(problem: Allocation) -> list[str]:
    """Return the suffixes of the names of the unknowns of every member."""
    count = len(problem.members)
    return [f"[{number + 1}]" if count > 1 else "" for number in range(count)]


def _rests(problem: Allocation, v: Array) -> dict[str, Array]:
    """Return v, and the states and outputs at which every member rests."""
    found = {"v": v}
    for label, member in zip(_labels(problem), problem.members):
        found |= {f"x{label}": member.rest_state(v), f"y{label}": member.rest_output(v)}
    return found


def _functions(problem: Allocation, view: View) -> dict[str, Any]:
    """Return v = [f(u); g(y)], by column."""
    u, v, y, found = view["u"], view["v"], view["y"], {}
    for i, (one, c, name) in enumerate(zip(problem.inverses, problem.model.input_of, problem.names)):
        found[f"f {i + 1} of {name}"] = v[i] == _written(one.f, one.low, one.high, u[c])
    for j, (g, o) in enumerate(problem.feedback):
        low, high = g.basis.interval or (-1.0, 1.0)
        margin = 0.0 if g.basis.outside == "error" else (high - low) / 2
        found[f"feedback of {problem.model.outputs[o]} {j + 1}"] = (
            v[problem.v_low.size + j] == _written(g, low - margin, high + margin, y[o]))
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
