"""Alternating convex half-steps for bilinear programmes: hold every b and solve for the rest, then hold every mu.

Each half-step is a convex programme made by `Program.freeze`; it is compiled once, and only the values of its
parameters change. The value never increases; convergence is linear and to a point that is stationary in each half
(for a smooth objective: stationary). In the norm gauge the half-step in b keeps ``bᵀ b_previous = 1``, which holds the
scale to first order, so that constraints on mu that are not scale-free stay meaningful; b is normalised afterwards.
"""

from collections.abc import Mapping
from dataclasses import replace

import cvxpy as cp
import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.program.expressions import flat
from optid.program.program import Program
from optid.program.solution import Solution, Status
from optid.program.structure import GAUGE
from optid.solving.solve import solve
from optid.structures.least_squares import rank_one_of

STEPS = 1000


def run(program: Program, settings: Settings) -> Answer:
    """Alternate from the start until the objective stops falling; the multipliers are those of the last two half-steps.

    Options: ``inner`` (word of the convex back end of the half-steps, default "clarabel"), ``steps`` (largest number of
    pairs of half-steps, default 1000).

    Raises:
        StructureError: a constraint that is not convex even with one factor held.
    """
    form = rank_one_of(program)
    assert form is not None
    options = dict(settings.options)
    inner, steps = str(options.pop("inner", "clarabel")), int(options.pop("steps", STEPS))
    if options:
        return Answer(Status.FAILED, f"unknown option {', '.join(sorted(options))}; known: inner, steps")
    mus, bs = [mu for mu, _ in form.blocks], [b for _, b in form.blocks]
    point = {name: np.asarray(program.start.get(name, program.variables[name].value), dtype=float)
             for name in (*mus, *bs)}
    without_b = _hold(program, {name: point[name] for name in bs})
    without_mu = _hold(_tangent(program, bs), {name: point[name] for name in mus})
    accuracy = min(settings.accuracy, 1e-9)
    before, count, last = np.inf, 0, None
    for count in range(1, steps + 1):
        in_mu = _step(without_b, point, inner, accuracy)
        if not in_mu.has_point:
            return _stopped(in_mu, last, count)
        point.update(in_mu.values)
        in_b = _step(without_mu, point, inner, accuracy)
        if not in_b.has_point:
            return _stopped(in_b, last, count)
        duals = {**in_b.duals, **in_mu.duals}
        if form.gauge == "norm" and GAUGE in in_b.duals:
            duals[GAUGE] = in_b.duals[GAUGE] / 2.0  # the gradient of bᵀb is twice that of the tangent
        values = {name: np.array(point[name]) for name in program.variables if name in point}
        last = Answer(Status.LIMIT, "iteration limit", values, duals, count)
        # the decrease has to be far below the requested accuracy, because convergence is only linear
        if before - in_mu.objective <= 1e-4 * settings.accuracy * max(in_mu.objective, 1e-9 * in_mu.scale):
            return replace(last, status=Status.LOCAL, word="stationary")
        before = in_mu.objective
        point.update(in_b.values)
        if form.gauge == "norm":
            for name in bs:
                point[name] = point[name] / np.linalg.norm(point[name])
    return last or Answer(Status.LIMIT, "iteration limit", iterations=count)


def _hold(program: Program, values: Mapping[str, np.ndarray]) -> Program:
    """Freeze variables and drop the constraints in which nothing is left to choose."""
    frozen = program.freeze(**values)
    idle = [name for name, group in frozen.constraints.items() if not any(c.variables() for c in group)]
    return frozen.without(*idle)


def _tangent(program: Program, bs: list[str]) -> Program:
    """Replace a gauge that is not convex by its tangent at the b of the step before."""
    if all(member.is_dcp() for member in program.constraints.get(GAUGE, ())):
        return program
    parameters, tangents = dict(program.parameters), []
    for name in bs:
        b = program.variables[name]
        direction = cp.Parameter(b.size, name=_direction(name))
        parameters[_direction(name)] = direction
        tangents.append(direction @ flat(b) == 1)
    return replace(program, constraints={**program.constraints, GAUGE: tuple(tangents)}, parameters=parameters)


def _direction(name: str) -> str:
    return f"direction of {name}"


def _step(half: Program, point: Mapping[str, np.ndarray], inner: str, accuracy: float) -> Solution:
    for name, value in point.items():
        if name in half.parameters:
            half.parameters[name].value = value
        if _direction(name) in half.parameters:
            half.parameters[_direction(name)].value = np.ravel(value, order="F")
    return solve(half, inner, accuracy=accuracy, prove=False)


def _stopped(half: Solution, last: Answer | None, count: int) -> Answer:
    word = f"half-step {count} with {half.solver}: {half.status} ({half.reason or half.claimed})"
    if last is not None:
        return replace(last, status=Status.INACCURATE, word=word)
    return Answer(Status.UNBOUNDED if half.status is Status.UNBOUNDED else Status.FAILED, word, iterations=count)
