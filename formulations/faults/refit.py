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

from formulations.constraints.rule import Rule
from optid.errors import StructureError
from optid.faults.repair.refitting import Refitting
from optid.program.program import Program, Values
from optid.program.solution import Bound, Status
from optid.program.view import View
from optid.registry import named_constraint
from optid.solving.solve import Evidence, Procedure

Array = np.ndarray

STEPS = 30
"""Gauss-Newton steps at most."""

SETTLED = 1e-6
"""Share of the objective below which a step that promises less is the last one."""

HALVINGS = 12


def actuator(problem: Refitting, *, constraints: Sequence[Any] | str = "default") -> Program:
    """Pose the refit of what broke alone.

    Args:
        problem: from `optid.faults.repair.refitting.refitting`.
        constraints: constraints on f or their words; "default": monotone, and nowhere steeper than before.
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
        before = _cost(problem, theta, lost, r) if solution is not None else np.inf
        solution = yield program
        if not solution.has_point:
            break
        new, lost_new = _vector(problem, solution.values), _lost(problem, solution.values)
        step, length = new - theta, 1.0
        for _ in range(HALVINGS):
            trial = theta + length * step
            at = {name: lost.get(name, 0.0) + length * (g - lost.get(name, 0.0)) for name, g in lost_new.items()}
            r_trial, s_trial = problem.linearised(trial)
            objective = _cost(problem, trial, at, r_trial)
            if np.isfinite(objective) and objective <= before:
                break
            length /= 2
        theta, r, s, lost = trial, r_trial, s_trial, at
        if before - objective < SETTLED * max(objective, 1e-300):
            break
    status = Status.LOCAL if solution.has_point else solution.status
    bound = Bound(-np.inf, False, "none", "innovations are not linear in A and C: a local minimum, no bound is known")
    return Evidence(Refitted(problem, theta, lost), float(objective), bound, status, solution.reason)


class Refitted:
    """What a refit ends with.

    Attributes:
        theta: the vector of unknowns.
        lost: share of its gain that each damaged nonlinearity has lost.
        model: the model.
    """

    def __init__(self, problem: Refitting, theta: Array, lost: dict[str, float]) -> None:
        self.theta, self.lost, self.model = theta, lost, problem.model_at(theta)


def _step(name: str, problem: Refitting, theta: Array, r: Array, s: Array, constraints: Sequence[Any] | str
          ) -> Program:
    """Pose the programme linearised at theta: one sum of squares, of the record and of what is believed beforehand."""
    shares = {f"lost[{curve.name}]": curve for curve in problem.curves}
    width = problem.size + len(shares)
    rows, target = np.zeros((len(r), width)), s @ theta - r
    rows[:, : problem.size] = s
    believed, wanted = problem.believed()
    triangle, target, rest = _compressed(np.vstack([rows, believed]), np.concatenate([target, wanted]))
    variables = {key: cp.Variable(shape, name=key) for key, shape in problem.shapes.items()}
    variables |= {key: cp.Variable(1, name=key) for key in shares}
    edges = [(part.start, part.stop) for part in problem.slices.values()]
    edges += [(problem.size + i, problem.size + i + 1) for i in range(len(shares))]
    terms = [
        triangle[:, first:last] @ (v if v.ndim == 1 else cp.vec(v, order="C"))
        for (first, last), v in zip(edges, variables.values())
    ]
    forecast: Any = (cp.sum(cp.vstack(terms), axis=0) if len(terms) > 1 else terms[0]) - target
    residual = cp.Variable(target.size, name="residual")
    structural: dict[str, tuple[Any, ...]] = {"residuals": (residual == forecast,)}
    spread = problem.spread()
    for key, part in problem.slices.items():
        zeros = np.flatnonzero(spread[part] == 0)
        if zeros.size:
            structural[f"zeros stay[{key}]"] = tuple(
                _entry(variables[key], int(i)) == problem.start[part][i] for i in zeros
            )
    expressions: dict[str, Any] = dict(variables)
    rules: list[Any] = []
    for key, curve in shares.items():
        mu, lost = variables[f"mu[{curve.name}]"], variables[key]
        structural[f"share {key}"] = (lost >= 0, lost <= 1)
        if curve.dead:
            structural[f"dead[{curve.name}]"] = (mu == 0,)
        if len(shares) == 1:
            expressions["mu"] = mu
        if isinstance(constraints, str) and not curve.dead:
            rules += _not_stronger(curve, mu)
    if not isinstance(constraints, str):
        rules = [named_constraint(rule) if isinstance(rule, str) else rule for rule in constraints]
    elif constraints != "default":
        raise StructureError(f"constraints={constraints!r}: a list of rules, or 'default'.")
    view = View(expressions, channels=tuple(curve.name for curve in problem.curves), gauge="none",
                bases={curve.name: curve.basis for curve in problem.curves}, outputs=problem.model.outputs)

    def recover(values: Values) -> Refitted:
        return Refitted(problem, _vector(problem, values), _lost(problem, values))

    start = problem.unpack(theta) | {key: np.zeros(1) for key in shares}
    begin = np.concatenate([theta, np.zeros(len(shares))])
    program = Program(
        name, cp.Minimize(cp.sum_squares(residual) + rest), structural, {**variables, "residual": residual},
        {**start, "residual": triangle @ begin - target}, recover, view, frozenset(structural),
        derived={"residual": forecast},
        scale=float(np.sum((triangle @ begin - target) ** 2)) + rest or 1.0,
    )
    return program.subject_to(*rules)


def _entry(variable: cp.Variable, flat: int) -> Any:
    """One entry of a variable, counted row by row."""
    return variable[np.unravel_index(flat, variable.shape)] if variable.ndim > 1 else variable[flat]


def _not_stronger(curve: Any, mu: Any) -> list[Any]:
    """Monotone like the healthy nonlinearity and nowhere steeper; nothing for one that is not monotone."""
    steps = np.diff(curve.healthy)
    sign = 1.0 if steps.sum() >= 0 else -1.0
    if np.any(sign * steps < 0):
        return []
    rows = sign * np.diff(curve.to_nodes[:, :-1], axis=0)
    return [
        Rule(f"monotone[{curve.name}]", lambda view: rows @ mu >= 0),
        Rule(f"not steeper[{curve.name}]", lambda view: rows @ mu <= sign * steps),
    ]


def _compressed(s: Array, target: Array) -> tuple[Array, Array, float]:
    """Triangular factor of [s target]: ‖s z - target‖² = ‖R z - t‖² + rest."""
    q = s.shape[1]
    factor: Any = np.linalg.qr(np.column_stack([s, target]), mode="r")
    rest = float(factor[q, q] ** 2) if len(factor) > q else 0.0
    return factor[:q, :q], factor[:q, q], rest


def _lost(problem: Refitting, values: Values) -> dict[str, float]:
    return {curve.name: float(np.ravel(values[f"lost[{curve.name}]"])[0]) for curve in problem.curves}


def _vector(problem: Refitting, values: Values) -> Array:
    """Return the unknowns; what is held is held exactly."""
    theta = problem.pack(values)
    for curve in problem.curves:
        if curve.dead:
            theta[problem.slices[f"mu[{curve.name}]"]] = 0.0
    return theta


def _cost(problem: Refitting, theta: Array, lost: dict[str, float], r: Array) -> float:
    """Value of the objective with the innovations r at theta, linearised in nothing."""
    rows, wanted = problem.believed()
    point = np.concatenate([theta, [lost.get(curve.name, 0.0) for curve in problem.curves]])
    return float(np.sum(r**2) + np.sum((rows @ point - wanted) ** 2))
