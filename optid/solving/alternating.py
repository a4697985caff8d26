"""Alternating convex half-steps for bilinear problems: hold every b and solve for the rest, then hold every mu.

Each half-step is a convex problem made by `Problem.holding`. The value never increases; convergence is linear and to a
point that is stationary in each half (for a smooth objective: stationary). The half-step in b holds the gauge to first
order, so that constraints on mu that are not scale-free stay meaningful; in the norm gauge b is normalised afterwards.
"""

from dataclasses import replace

import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.core.least_squares import RankOneForm
from optid.core.problem import Problem
from optid.program.solution import Solution, Status
from optid.solving.solve import solve

STEPS = 1000


def run(problem: Problem, settings: Settings) -> Answer:
    """Alternate from the start until the objective stops falling; the multipliers are those of the last two half-steps.

    Options: ``inner`` (word of the convex back end of the half-steps, default "clarabel"), ``steps`` (largest number of
    pairs of half-steps, default 1000).

    Raises:
        StructureError: a constraint that is not convex even with one factor held.
    """
    form = RankOneForm.of(problem)
    assert form is not None
    options = dict(settings.options)
    inner, steps = str(options.pop("inner", "clarabel")), int(options.pop("steps", STEPS))
    if options:
        return Answer(Status.FAILED, f"unknown option {', '.join(sorted(options))}; known: inner, steps")
    mus, bs = [mu for mu, _ in form.blocks], [b for _, b in form.blocks]
    point = dict(problem.start)
    accuracy = min(settings.accuracy, 1e-9)
    before, count, last = np.inf, 0, None
    for count in range(1, steps + 1):
        in_mu = solve(problem.holding(point, bs), inner, accuracy=accuracy, prove=False)
        if not in_mu.has_point:
            return _stopped(in_mu, last, count)
        point |= {name: in_mu.values[name] for name in point if name not in bs}
        in_b = solve(problem.holding(point, mus, problem.gauges_about(point)), inner, accuracy=accuracy, prove=False)
        if not in_b.has_point:
            return _stopped(in_b, last, count)
        last = Answer(Status.LIMIT, "iteration limit", dict(point), {**in_b.duals, **in_mu.duals}, count)
        # the decrease has to be far below the requested accuracy, because convergence is only linear
        if before - in_mu.objective <= 1e-4 * settings.accuracy * max(in_mu.objective, 1e-9 * in_mu.scale):
            return replace(last, status=Status.LOCAL, word="stationary")
        before = in_mu.objective
        point |= {name: in_b.values[name] for name in point if name not in mus}
        if form.gauge == "norm":
            for name in bs:
                point[name] = point[name] / np.linalg.norm(point[name])
    return last or Answer(Status.LIMIT, "iteration limit", iterations=count)


def _stopped(half: Solution, last: Answer | None, count: int) -> Answer:
    word = f"half-step {count} with {half.solver}: {half.status} ({half.reason or half.claimed})"
    if last is not None:
        return replace(last, status=Status.INACCURATE, word=word)
    return Answer(Status.UNBOUNDED if half.status is Status.UNBOUNDED else Status.FAILED, word, iterations=count)
