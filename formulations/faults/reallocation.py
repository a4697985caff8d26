"""Re-allocation of a plant to its remaining actuators: resting points, and control to reach them.

A monotone nonlinearity maps the range of its input onto a range of v = f(u) exactly, so that the problem is linear in
v: the bounds of the inputs are those of v, and u = f^-1(v) keeps them. A stuck actuator is one whose range is a point.

* ``target``: the resting point nearest to a reference, min ‖W (y - r)‖² over x = A x + B v + d, y = C x + D v + c and
  the bounds of v. Where the reference cannot be reached, the distance is positive, and the multipliers of the bounds
  say which actuator limits it.
* ``track``: model predictive control over a horizon, ‖W (y_k - r)‖² + ‖(v_k - v_s) / q‖² and a terminal cost.
* both with several members, the possible damages: the same v for all, with the least cost of the worst of them
  (min-max), each a plant with its own gains and constants in the v of the healthy nonlinearities.
* with ``norm``: ‖S v_k‖ <= limit, a limit that actuators share (a pump, a power supply); a second-order cone.
* with ``equations``: in the inputs u themselves, as `formulations.faults.reallocation_nlp` does it.

Named variables: ``v``, ``x``, ``y`` (``x[i]``, ``y[i]`` of member i), ``worst`` where there are several, and ``u``.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from optid.faults.repair.allocation_problem import AllocationProblem, Member
from optid.program.program import Program
from optid.program.view import View

TIE = 1e-8
"""Weight of the distance of v from the middle of its range, to decide between resting points of the same outputs."""

Equations = Callable[[AllocationProblem, Any, Any, Any], dict[str, tuple[Any, ...]]]
"""(problem, u, v, y) -> the constraints that tie v to u and y, with u and v (r,) or (horizon, r)."""


def target(problem: AllocationProblem, *, reference: Any, equations: Equations | None = None,
           constraints: Sequence[Any] = ()) -> Program:
    """Build the programme of the resting point nearest to a reference.

    Args:
        problem: the damaged plant.
        reference: (l,) of the outputs.
        equations: constraints between v and the inputs u, which are then variables, too; by default v is free in its
            bounds.
        constraints: builders of further constraints in v, x and y.
    """
    r = np.asarray(reference, dtype=float)
    v, structural, costs = cp.Variable(problem.columns, name="v"), {}, []
    variables = {"v": v}
    for label, member in _labelled(problem):
        x = variables[f"x{label}"] = cp.Variable(member.A.shape[0], name=f"x{label}")
        y = variables[f"y{label}"] = cp.Variable(member.C.shape[0], name=f"y{label}")
        structural[f"rest{label}"] = (x == member.A @ x + member.B @ v + member.d,)
        structural[f"outputs{label}"] = (y == member.C @ x + member.D @ v + member.c,)
        costs.append(cp.sum_squares(cp.multiply(problem.weights, y - r)))
    middle = problem.middle if equations is None else (problem.u_low + problem.u_high) / 2
    return _posed("allocation.target", problem, variables, structural, costs, TIE * problem.scale, middle, r,
                  equations, constraints, {})


def track(problem: AllocationProblem, *, reference: Any, states: Sequence[Any], goal: Any, rests: Any = None,
          horizon: int = 40, effort: float = 1e-3, rates: Any = None, previous: Any = None,
          equations: Equations | None = None, constraints: Sequence[Any] = ()) -> Program:
    """Build the control of a horizon; reference, states, goal, rests and previous are parameters of the programme.

    Args:
        problem: the damaged plant.
        reference: (l,) of the outputs.
        states: (n,) of every member.
        goal: v (r,) of the resting point, or its u (m,) with equations.
        rests: (n,) state of every member there; that of v by default.
        horizon: samples.
        effort: weight of ((v - goal) / half its range)², of u with equations.
        rates: (m,) largest steps of u; None for none; with equations.
        previous: (m,) u of the sample before, where there are rates.
        equations: as in `target`.
        constraints: builders of further constraints.
    """
    parameters: dict[str, cp.Parameter] = {}

    def given(name: str, value: Any) -> cp.Parameter:
        value = np.asarray(value, dtype=float)
        return parameters.setdefault(name, cp.Parameter(value.shape, value=value, name=name))

    wanted, goal = given("reference", reference), given("goal", goal)
    v, structural, costs = cp.Variable((horizon, problem.columns), name="v"), {}, []
    variables, ones = {"v": v}, np.ones((horizon, 1))
    if rests is None:
        rests = [member.rest_state(np.asarray(goal.value)) for member in problem.members]
    for (label, member), state, rest in zip(_labelled(problem), states, rests, strict=True):
        x = variables[f"x{label}"] = cp.Variable((horizon + 1, member.A.shape[0]), name=f"x{label}")
        y = variables[f"y{label}"] = cp.Variable((horizon, member.C.shape[0]), name=f"y{label}")
        structural[f"dynamics{label}"] = (
            x[0] == given(f"state{label}", state),
            x[1:] == x[:-1] @ member.A.T + v @ member.B.T + ones @ member.d[None, :],
        )
        structural[f"outputs{label}"] = (y == x[:-1] @ member.C.T + v @ member.D.T + ones @ member.c[None, :],)
        cost = cp.sum_squares(cp.multiply(ones @ problem.weights[None, :], y - cp.vstack([wanted] * horizon)))
        costs.append(cost + cp.sum_squares(member.terminal_root(problem) @ (x[horizon] - given(f"rest{label}", rest))))
    program = _posed("allocation.track", problem, variables, structural, costs, effort * problem.scale,
                     cp.vstack([goal] * horizon), wanted.value, equations, constraints, parameters)
    if rates is None:
        return program
    u: Any = program.variables["u"]
    before: Any = cp.reshape(given("previous", previous), (1, u.shape[1]), order="C")
    steps, most = cp.diff(cp.vstack([before, u]), axis=0), ones @ np.asarray(rates, dtype=float)[None, :]
    return program.subject_to({"rates": [steps >= -most, steps <= most]})


def _labelled(problem: AllocationProblem) -> Iterator[tuple[str, Member]]:
    """Yield the members with the suffixes of the names of their variables."""
    for number, member in enumerate(problem.members):
        yield f"[{number + 1}]" if len(problem.members) > 1 else "", member


def _posed(name: str, problem: AllocationProblem, variables: dict[str, cp.Variable],
           structural: dict[str, tuple[Any, ...]], costs: list[Any], weight: float, goal: Any, reference: Any,
           equations: Equations | None, constraints: Sequence[Any], parameters: dict[str, cp.Parameter]) -> Program:
    """Add the bounds, by actuator, and the objective: the cost, or the worst cost of several members, and the effort.

    Both are of v, or of u where equations tie v to it.
    """
    free = v = variables["v"]
    words, low, high, half = problem.names, problem.low, problem.high, problem.half
    if equations is not None:
        words, low, high = tuple(f"actuator:{one}" for one in problem.inputs), problem.u_low, problem.u_high
        half = (high - low) / 2
        free = variables["u"] = cp.Variable((*v.shape[:-1], low.size), name="u")
        structural |= equations(problem, free, v, variables["y"])
    for i, word in enumerate(words):
        column = free[..., i]
        if low[i] == high[i]:
            structural[f"held {word}"] = (column == low[i],)
        else:
            structural[f"least {word}"], structural[f"most {word}"] = (column >= low[i],), (column <= high[i],)
    if problem.norm is not None:
        rows = [v] if v.ndim == 1 else [v[k] for k in range(v.shape[0])]
        structural["shared limit"] = tuple(cp.sum_squares(problem.norm @ row) <= problem.limit**2 for row in rows)
    effort = weight * cp.sum_squares((free - goal) @ np.diag(1 / half))
    if len(costs) > 1:
        worst = variables["worst"] = cp.Variable(name="worst")
        structural["worst member"] = tuple(cost <= worst for cost in costs)
        costs = [worst]
    rest = problem.members[0].rest_output(np.append(problem.middle, np.zeros(len(problem.feedback))))
    scale = (1 if v.ndim == 1 else v.shape[0]) * float(np.sum((problem.weights * (reference - rest)) ** 2))
    view = View(dict(variables), channels=problem.names, outputs=problem.outputs)
    return Program(name, cp.Minimize(costs[0] + effort), structural, variables, {}, lambda values: values["v"], view,
                   frozenset(structural), parameters=parameters, scale=scale or 1.0).subject_to(*constraints)
