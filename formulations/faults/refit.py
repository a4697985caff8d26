"""Refit of a damaged plant with a healthy prior: the damaged nonlinearities alone, or all parameters.

``actuator``: the values of the damaged nonlinearities at their nodes are the unknowns, and the columns of B and D that
carry them stay, so that the innovations are linear in them and the programme is a QP:

    minimise ‖s - R z‖² + sum ((c - c_healthy) / p)² + sum (D2 (c - (1 - g) c_healthy) / q)²

with c = values at the nodes, D2 second differences, and g the share of the gain that is lost, in [0, 1]: a plain loss
of gain changes no curvature. By default c is monotone like the healthy nonlinearity and nowhere steeper: a fault does
not increase the gain. ``parameters``: A, B, C, D and the other nonlinearities are open, too, each with a
healthy prior; a Gauss-Newton procedure whose steps are the same QP. Named variables: ``mu[input]``,
``constant[input]``, ``lost[input]``, and A, B, C, D.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from formulations.constraints.rule import Rule
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.faults.repair.refitting import Refitting
from optid.program.solution import Bound, Status
from optid.registry import read_constraints
from optid.solving.solve import Evidence, Procedure

Array = np.ndarray

STEPS = 30
"""Gauss-Newton steps at most."""

SETTLED = 1e-6
"""Share of the objective below which a step that promises less is the last one."""

HALVINGS = 12


def actuator(problem: Refitting, *, constraints: Sequence[Any] | str = "default") -> Problem:
    """Build the refit of the damaged nonlinearities alone.

    Args:
        problem: from `optid.faults.repair.refitting.refitting`.
        constraints: constraints on f or their words; "default": monotone, and nowhere steeper than before.
    """
    r, s = problem.linearise(problem.start)
    return _step("refit.actuator", problem, problem.start, r, s, constraints)


def parameters(problem: Refitting, *, constraints: Sequence[Any] | str = "default") -> Procedure:
    """Refit all parameters with a healthy prior by Gauss-Newton steps under the constraints of `actuator`.

    Args:
        problem: with all parameters open.
        constraints: as `actuator`.

    Returns:
        The model; its value of the objective is a local minimum.
    """
    z = np.append(problem.start, np.zeros(len(problem.curves)))
    r, s = problem.linearise(problem.start)
    (believed, wanted), objective = problem.prior_rows(), np.inf
    for _ in range(STEPS):
        solution = yield _step("refit.parameters", problem, z[: problem.start.size], r, s, constraints)
        if not solution.has_point:
            break
        before, step, length = objective, _vector(problem, solution.values) - z, 1.0
        for _ in range(HALVINGS):
            trial = z + length * step
            r, s = problem.linearise(trial[: problem.start.size])
            objective = float(np.sum(r**2) + np.sum((believed @ trial - wanted) ** 2))
            if np.isfinite(objective) and objective <= before:
                break
            length /= 2
        z = trial
        if before - objective < SETTLED * max(objective, 1e-300):
            break
    status = Status.LOCAL if solution.has_point else solution.status
    bound = Bound.none("innovations are not linear in A and C: a local minimum, no bound is known")
    return Evidence(Refitted(problem, z), float(objective), bound, status, solution.reason)


class Refitted:
    """Result of a refit.

    Attributes:
        theta: the vector of unknowns.
        lost: share of its gain that each damaged nonlinearity has lost.
        model: the model.
    """

    def __init__(self, problem: Refitting, z: Array) -> None:
        self.theta, shares = np.split(z, [problem.start.size])
        self.lost = dict(zip((curve.name for curve in problem.curves), shares.tolist()))
        self.model = problem.model_at(self.theta)


def _step(name: str, problem: Refitting, theta: Array, r: Array, s: Array, constraints: Sequence[Any] | str) -> Problem:
    """State the problem linearised at theta: one sum of squares, of the record and of the prior."""
    believed, wanted = problem.prior_rows()
    rows = np.vstack([np.pad(s, ((0, 0), (0, len(problem.curves)))), believed])
    q = rows.shape[1]
    factor: Any = np.linalg.qr(np.column_stack([rows, np.concatenate([s @ theta - r, wanted])]), mode="r")
    rest = float(np.sum(factor[q:, q] ** 2))
    start = problem.unpack(theta) | {f"lost[{curve.name}]": np.zeros(1) for curve in problem.curves}
    names = tuple(start)
    places = problem.unpack(np.arange(theta.size, dtype=float)).values()  # row by row
    by_column = np.concatenate([*(part.ravel(order="F") for part in places), np.arange(theta.size, q)]).astype(int)
    misfit = Squares(factor[:q, by_column], factor[:q, q], rest, names)  # of the record, and of what is believed
    rules: list[Any] = []
    if isinstance(constraints, str) and constraints == "default":
        for curve in problem.curves:
            rules += [] if curve.dead else _not_stronger(curve)
    else:
        rules = list(read_constraints(constraints))

    def restrict(view: Any) -> dict[str, Any]:
        still = [key for key, part in problem.slices.items() if problem.held[part].any()]
        zeros = {f"zeros stay[{key}]": view[key] == 0 for key in still}
        shares = [(curve.name, view[f"lost[{curve.name}]"]) for curve in problem.curves]
        return zeros | {f"share lost[{name}]": [lost >= 0, lost <= 1] for name, lost in shares}

    of_one = {"mu": f"mu[{problem.curves[0].name}]"} if len(problem.curves) == 1 else {}
    return Problem(
        name, start, (misfit,), model=lambda values: Refitted(problem, _vector(problem, values)),
        facts={"channels": tuple(curve.name for curve in problem.curves), "gauge": "none",
               "bases": {curve.name: curve.basis for curve in problem.curves}, "outputs": problem.model.outputs},
        further=lambda view, _: {short: view[long] for short, long in of_one.items()}, restrictions=(restrict,),
        builders=tuple(rules), scale=misfit.value(start) or 1.0)


def _not_stronger(curve: Any) -> list[Any]:
    """Monotone like the healthy nonlinearity and nowhere steeper; nothing for one that is not monotone."""
    steps = np.diff(curve.healthy)
    sign = 1.0 if steps.sum() >= 0 else -1.0
    if np.any(sign * steps < 0):
        return []
    rows = sign * np.diff(curve.to_nodes[:, :-1], axis=0)
    return [
        Rule(f"monotone[{curve.name}]", lambda view: rows @ view[f"mu[{curve.name}]"] >= 0),
        Rule(f"not steeper[{curve.name}]", lambda view: rows @ view[f"mu[{curve.name}]"] <= sign * steps)]


def _vector(problem: Refitting, values: Values) -> Array:
    """Return [unknowns; shares lost], fixed zeros exact."""
    theta = np.where(problem.held, 0.0, problem.pack(values))
    return np.append(theta, [float(np.ravel(values[f"lost[{curve.name}]"])[0]) for curve in problem.curves])
