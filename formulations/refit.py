"""Refit of a damaged plant with a healthy prior: what broke alone, or all parameters.

``actuator``: the values of the damaged nonlinearities at their nodes are the unknowns, and the columns of B and D that
carry them stay, so that the innovations are linear in them and the programme is a QP:

    minimise ‖s - R z‖² + sum ((c - c_healthy) / p)² + sum (D2 (c - (1 - g) c_healthy) / q)²

with c = values at the nodes, D2 second differences, and g the share of the gain that is lost, in [0, 1]: a plain loss
of gain bends nothing. Unless others are asked for, c is monotone like the healthy nonlinearity and nowhere steeper:
nothing gains strength by breaking. ``parameters``: A, B, C, D and the other nonlinearities are open, too, each with a
healthy prior; a Gauss-Newton procedure whose steps are the same QP. Named variables: ``mu[input]``,
``constant[input]``, ``lost[input]``, and A, B, C, D.
"""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.rule import Rule
from optid.faults.refitting import Refitting
from optid.program import Program, Values, View
from optid.registry import named_constraint
from optid.solution import Bound, Status
from optid.solving import Evidence, Procedure

Array = np.ndarray

STEPS = 30
"""Gauss-Newton steps at most."""

SETTLED = 1e-6
"""Share of the objective below which a step that promises less is the last one."""

HALVINGS = 12


def actuator(problem: Refitting, *, constraints: Sequence[Any] | str = "default") -> Program:
    """Pose the refit of what broke alone.

    Args:
        problem: from `optid.faults.refitting.refitting`.
        constraints: rules of `formulations.shape` or their words; "default": monotone, and nowhere steeper than before.
    """
    r, s = problem.linearised(problem.start)
    return _step("refit.actuator", problem, problem.start, r, s, constraints)


def parameters(problem: Refitting, *, constraints: Sequence[Any] | str = "default") -> Procedure:
    """Refit all parameters with a healthy prior by Gauss-Newton steps under the constraints of `actuator`.

    Args:
        problem: with all parameters open.
        constraints: as `actuator`.

    Returns:
        The model; its value of the objective is a local minimum.
    """
    theta = problem.start
    r, s = problem.linearised(theta)
    solution: Any = None
    objective = np.inf
    lost: dict[str, float] = {}
    for _ in range(STEPS):
        program = _step("refit.parameters", problem, theta, r, s, constraints)
        before = _cost(program, problem, theta, lost, r) if solution is not None else np.inf
        solution = yield program
        if not solution.has_point:
            break
        new, lost_new = _vector(problem, solution.values, program)
        step, length = new - theta, 1.0
        for _ in range(HALVINGS):
            trial = theta + length * step
            at = {name: lost.get(name, 0.0) + length * (g - lost.get(name, 0.0)) for name, g in lost_new.items()}
            r_trial, s_trial = problem.linearised(trial)
            objective = _cost(program, problem, trial, at, r_trial)
            if np.isfinite(objective) and objective <= before:
                break
            length /= 2
        theta, r, s, lost = trial, r_trial, s_trial, at
        if before - objective < SETTLED * max(objective, 1e-300):
            break
    status = Status.LOCAL if solution.has_point else solution.status
    bound = Bound(-np.inf, False, "none", "innovations are not linear in A and C: a local minimum, no bound is known")
    return Evidence(_Point(problem, theta, lost), float(objective), bound, status, solution.reason)


class _Point:
    """What a refit ends with: the vector of unknowns, the model, and the share lost of every curve."""

    def __init__(self, problem: Refitting, theta: Array, lost: dict[str, float]) -> None:
        self.theta, self.lost, self.model = theta, lost, problem.model_at(theta)


def _step(name: str, problem: Refitting, theta: Array, r: Array, s: Array, constraints: Sequence[Any] | str
          ) -> Program:
    """Pose the programme linearised at theta."""
    triangle, target, rest = _compressed(s, s @ theta - r)
    residual = cp.Variable(target.size, name="residual")
    variables: dict[str, cp.Variable] = {"residual": residual}
    columns = []
    for key, shape in problem.shapes.items():
        variables[key] = cp.Variable(shape, name=key)
        columns.append(cp.vec(variables[key], order="C"))
    z = cp.hstack(columns)
    forecast = triangle @ z - target
    objective: Any = cp.sum_squares(residual) + rest
    spread = problem.spread()
    believed = np.isfinite(spread) & (spread > 0)
    if believed.any():
        objective = objective + cp.sum_squares((z[believed] - problem.start[believed]) / spread[believed])
    structural: dict[str, tuple[Any, ...]] = {"residuals": (residual == forecast,)}
    frozen = np.isfinite(spread) & (spread == 0)
    if frozen.any():
        structural["zeros stay"] = (z[frozen] == problem.start[frozen],)
    expressions: dict[str, Any] = dict(variables)
    rules: list[Any] = []
    for curve in problem.curves:
        mu, constant = variables[f"mu[{curve.name}]"], variables[f"constant[{curve.name}]"]
        lost = variables[f"lost[{curve.name}]"] = cp.Variable(1, name=f"lost[{curve.name}]")
        structural[f"share lost[{curve.name}]"] = (lost >= 0, lost <= 1)
        nodes = curve.to_nodes[:, :-1] @ mu + curve.to_nodes[:, -1] * constant[0]
        expressions[f"mu[{curve.name}]" if len(problem.curves) > 1 else "mu"] = mu
        expressions[f"nodes[{curve.name}]"] = nodes
        bend = np.diff(np.eye(curve.nodes.size), n=2, axis=0)
        half, prior = curve.half_range, problem.prior
        objective = objective + cp.sum_squares((nodes - curve.healthy) / (prior.damaged * half))
        if len(bend):
            left = nodes - curve.healthy + lost[0] * curve.healthy
            objective = objective + cp.sum_squares(bend @ left / (prior.curvature * half))
        if isinstance(constraints, str):
            rules += _not_stronger(curve, nodes)
    if not isinstance(constraints, str):
        rules = [named_constraint(rule) if isinstance(rule, str) else rule for rule in constraints]
    view = View(expressions, kind="exact", channels=tuple(curve.name for curve in problem.curves), gauge="none",
                bases={curve.name: curve.basis for curve in problem.curves}, outputs=problem.model.outputs)

    def recover(values: Values) -> _Point:
        return _Point(problem, problem.pack(values), _lost(problem, values))

    start = problem.unpack(theta) | {f"lost[{curve.name}]": np.zeros(1) for curve in problem.curves}
    start["residual"] = triangle @ theta - target
    program = Program(
        name, cp.Minimize(objective), structural, variables, start, recover, view, frozenset(structural),
        derived={"residual": forecast}, scale=float(np.sum((s @ (theta - problem.start) - r) ** 2)) or 1.0,
    )
    return program.subject_to(*rules)


def _not_stronger(curve: Any, nodes: Any) -> list[Any]:
    """Monotone like the healthy nonlinearity and nowhere steeper; nothing for one that is not monotone."""
    steps = np.diff(curve.healthy)
    sign = 1.0 if steps.sum() >= 0 else -1.0
    if np.any(sign * steps < 0):
        return []
    moved = sign * cp.diff(nodes)
    return [
        Rule(f"monotone[{curve.name}]", lambda view: moved >= 0),
        Rule(f"not steeper[{curve.name}]", lambda view: moved <= sign * steps),
    ]


def _compressed(s: Array, target: Array) -> tuple[Array, Array, float]:
    """Triangular factor of [s target]: ‖s z - target‖² = ‖R z - t‖² + rest."""
    q = s.shape[1]
    factor = np.linalg.qr(np.column_stack([s, target]), mode="r")
    rest = float(factor[q, q] ** 2) if len(factor) > q else 0.0
    return factor[:q, :q], factor[:q, q], rest


def _lost(problem: Refitting, values: Values) -> dict[str, float]:
    return {curve.name: float(np.ravel(values[f"lost[{curve.name}]"])[0]) for curve in problem.curves}


def _vector(problem: Refitting, values: Values, program: Program) -> tuple[Array, dict[str, float]]:
    return problem.pack(values), _lost(problem, values)


def _cost(program: Program, problem: Refitting, theta: Array, lost: dict[str, float], r: Array) -> float:
    """Value of the objective with the innovations r at theta, linearised in nothing."""
    value = float(np.sum(r**2))
    spread = problem.spread()
    believed = np.isfinite(spread) & (spread > 0)
    value += float(np.sum(((theta - problem.start)[believed] / spread[believed]) ** 2))
    unpacked = problem.unpack(theta)
    for curve in problem.curves:
        nodes = curve.to_nodes @ np.append(unpacked[f"mu[{curve.name}]"], unpacked[f"constant[{curve.name}]"])
        change = (nodes - curve.healthy) / curve.half_range
        value += float(np.sum((change / problem.prior.damaged) ** 2))
        left = change + lost.get(curve.name, 0.0) * curve.healthy / curve.half_range
        value += float(np.sum((np.diff(left, n=2) / problem.prior.curvature) ** 2))
    return value
