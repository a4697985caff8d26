"""Re-allocation of a plant to the actuators that are left: where it can rest, and how to get there.

A monotone nonlinearity maps the range of its input onto a range of v = f(u) exactly, so that the problem is linear in
v: the bounds of the inputs are those of v, and u = f^-1(v) keeps them. A stuck actuator is one whose range is a point.

* ``target``: the resting point nearest to a reference, min ‖W (y - r)‖² over x = A x + B v + d, y = C x + D v + c and
  the bounds of v. Where the reference cannot be reached, the distance is positive, and the multipliers of the bounds
  say which actuator limits it.
* ``track``: model predictive control over a horizon, ‖W (y_k - r)‖² + ‖(v_k - v_s) / q‖² and a terminal cost.
* both with several members that stand for what may be broken: the same v for all, the worst of them made least
  (min-max), each a plant with its own gains and constants in the v of the healthy nonlinearities.
* with ``norm``: ‖S v_k‖ <= limit, a limit that actuators share (a pump, a power supply); a second-order cone.

Named variables: ``v``, ``x``, ``y`` (``x[i]``, ``y[i]`` of member i), ``worst`` where there are several.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np

from optid.faults.repair.allocation_problem import AllocationProblem, Member
from optid.program.program import Program, Values
from optid.program.view import View

TIE = 1e-8
"""Weight of the distance of v from the middle of its range, to decide between resting points of the same outputs."""


def target(problem: AllocationProblem, *, reference: Any, constraints: Sequence[Any] = ()) -> Program:
    """Pose the resting point nearest to a reference.

    Args:
        problem: what is left of the plant.
        reference: (l,) outputs wanted.
        constraints: builders of further constraints in v, x and y.
    """
    r = np.asarray(reference, dtype=float)
    v = cp.Variable(problem.columns, name="v")
    variables: dict[str, cp.Variable] = {"v": v}
    structural: dict[str, tuple[Any, ...]] = {}
    costs = []
    for number, member in enumerate(problem.members):
        label = f"[{number + 1}]" if len(problem.members) > 1 else ""
        x = variables[f"x{label}"] = cp.Variable(member.A.shape[0], name=f"x{label}")
        y = variables[f"y{label}"] = cp.Variable(member.C.shape[0], name=f"y{label}")
        structural[f"rest{label}"] = (x == member.A @ x + member.B @ v + member.d,)
        structural[f"outputs{label}"] = (y == member.C @ x + member.D @ v + member.c,)
        costs.append(cp.sum_squares(cp.multiply(problem.weights, y - r)))
    tie = TIE * problem.tie(r) * cp.sum_squares((v - problem.middle) / problem.half)
    return _posed("allocation.target", problem, variables, structural, costs, tie, v, constraints,
                  float(np.sum((problem.weights * (r - problem.rest()[1])) ** 2)))


def track(problem: AllocationProblem, *, reference: Any, states: Sequence[Any], goal: Any, horizon: int = 40,
          effort: float = 1e-3, rates: Any = None, previous: Any = None, constraints: Sequence[Any] = ()) -> Program:
    """Pose the control of a horizon from given states; reference, states and goal are parameters of the programme.

    Args:
        problem: what is left of the plant.
        reference: (l,) outputs wanted.
        states: (n,) of every member.
        goal: (columns,) v of the resting point.
        horizon: samples.
        effort: weight of ((v - goal) / half its range)².
        rates: (low, high), each (horizon, columns): bounds of the steps of v; None for none.
        previous: (columns,) v of the sample before, where there are rates.
        constraints: builders of further constraints.
    """
    v = cp.Variable((horizon, problem.columns), name="v")
    variables: dict[str, cp.Variable] = {"v": v}
    parameters: dict[str, cp.Parameter] = {
        "reference": cp.Parameter(problem.weights.size, value=np.asarray(reference, dtype=float), name="reference"),
        "goal": cp.Parameter(problem.columns, value=np.asarray(goal, dtype=float), name="goal"),
    }
    structural: dict[str, tuple[Any, ...]] = {}
    costs: list[Any] = []
    start = problem.rest()[1]
    for number, (member, state) in enumerate(zip(problem.members, states, strict=True)):
        label = f"[{number + 1}]" if len(problem.members) > 1 else ""
        n, outputs = member.A.shape[0], member.C.shape[0]
        x = variables[f"x{label}"] = cp.Variable((horizon + 1, n), name=f"x{label}")
        y = variables[f"y{label}"] = cp.Variable((horizon, outputs), name=f"y{label}")
        x0 = parameters[f"state{label}"] = cp.Parameter(n, value=np.asarray(state, dtype=float), name=f"state{label}")
        rest = parameters[f"rest{label}"] = cp.Parameter(n, value=member.rest_state(np.asarray(goal)),
                                                         name=f"rest{label}")
        ones = np.ones((horizon, 1))
        structural[f"dynamics{label}"] = (
            x[0] == x0, x[1:] == x[:-1] @ member.A.T + v @ member.B.T + ones @ member.d[None, :],
        )
        structural[f"outputs{label}"] = (y == x[:-1] @ member.C.T + v @ member.D.T + ones @ member.c[None, :],)
        wanted = cp.vstack([parameters["reference"]] * horizon)
        cost = cp.sum_squares(cp.multiply(ones @ problem.weights[None, :], y - wanted))
        costs.append(cost + cp.sum_squares(problem.terminal_root(number) @ (x[horizon] - rest)))
    moved = cp.vstack([parameters["goal"]] * horizon)
    moves = effort * problem.scale * cp.sum_squares((v - moved) @ np.diag(1 / problem.half))
    if rates is not None:
        low, high = (np.asarray(part, dtype=float) for part in rates)
        steps = cp.diff(cp.vstack([np.asarray(previous, dtype=float)[None, :], v]), axis=0)
        structural["rates"] = (steps >= low, steps <= high)
    program = _posed("allocation.track", problem, variables, structural, costs, moves, v, constraints,
                     float(horizon * np.sum((problem.weights * (np.asarray(reference) - start)) ** 2)))
    return replace(program, parameters=parameters)


def _posed(name: str, problem: AllocationProblem, variables: dict[str, cp.Variable],
           structural: dict[str, tuple[Any, ...]], costs: list[Any], extra: Any, v: cp.Variable,
           constraints: Sequence[Any], scale: float) -> Program:
    """Add the bounds, by actuator, and the objective: the cost, or the worst cost of several members."""
    at: Any = (lambda i: v[i]) if v.ndim == 1 else (lambda i: v[:, i])
    for i, word in enumerate(problem.names):
        if problem.low[i] == problem.high[i]:
            structural[f"held {word}"] = (at(i) == problem.low[i],)
            continue
        structural[f"least {word}"] = (at(i) >= problem.low[i],)
        structural[f"most {word}"] = (at(i) <= problem.high[i],)
    if problem.norm is not None:
        rows = [v] if v.ndim == 1 else [v[k] for k in range(v.shape[0])]
        structural["shared limit"] = tuple(cp.norm(problem.norm @ row, 2) <= problem.limit for row in rows)
    if len(costs) == 1:
        objective = costs[0] + extra
    else:
        worst = variables["worst"] = cp.Variable(name="worst")
        structural["worst member"] = tuple(cost <= worst for cost in costs)
        objective = worst + extra

    def recover(values: Values) -> np.ndarray:
        return np.asarray(values["v"])

    names = tuple(problem.names)
    view = View(dict(variables), channels=names, outputs=tuple(problem.outputs))
    return Program(name, cp.Minimize(objective), structural, variables, {}, recover, view, frozenset(structural),
                   scale=scale or 1.0).subject_to(*constraints)


__all__ = ["Member", "target", "track"]
