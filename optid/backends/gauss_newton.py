"""Own Gauss-Newton for rank-one least squares: `optid.structures.rank_one`, under constraints `RankOneSQP`."""

import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.backends.rank_one_sqp import DIRECTIONS, RankOneSQP
from optid.certificate.ladder import certify
from optid.core.least_squares import RankOneForm
from optid.core.problem import Problem
from optid.models.gauges import gauge_factor
from optid.program.solution import Status
from optid.structures.bilinear import LocalSolution, minimise
from optid.structures.rank_one import Point

DESCENTS = 2  # how many of these are followed to the end


def run(problem: Problem, settings: Settings) -> Answer:
    """Solve a programme that carries a `RankOneForm`.

    Options: ``starts`` (number of starts, default 8), ``seed`` of the random ones; under constraints ``directions``
    (different b that are settled first, default 4) and ``descents`` (how many of these are then followed to their end,
    default 2).
    """
    form = RankOneForm.of(problem)
    assert form is not None
    options = dict(settings.options)
    count, seed = int(options.get("starts", 8)), int(options.get("seed", 0))
    free = _minimum(problem, form, count, seed)
    if problem.constraint_names:
        return RankOneSQP(problem, form, free.point).solve(
            seed, int(options.get("directions", DIRECTIONS)), int(options.get("descents", DESCENTS)))
    status, word = (Status.LOCAL, "stationary") if free.converged else (Status.LIMIT, "iteration limit")
    return Answer(status, word, to_values(problem, form, free.point), iterations=free.iterations)


def _minimum(problem: Problem, form: RankOneForm, count: int, seed: int) -> LocalSolution:
    """Descend from the programme's start, and from others where the instant proof fails there."""
    found = minimise(form.problem, form.point(problem.start)) if problem.start else None
    if found is not None and certify(form.problem, found.point, effort="instant").bound.proved:
        return found
    others = minimise(form.problem, count=count, seed=seed)
    return found if found is not None and found.value <= others.value else others


def to_values(problem: Problem, form: RankOneForm, point: Point) -> dict[str, np.ndarray]:
    """Name the parts of a point, in the programme's gauge."""
    values = form.unpack(point, problem.shapes)
    for (mu, b), direction in zip(form.blocks, point.bs):
        size = float(np.linalg.norm(direction)) or 1.0  # the sign stays: constraints may depend on it
        if form.gauge != "norm":
            size = gauge_factor(form.gauge, values.get("a", np.zeros(0)), np.asarray(direction, dtype=float), mu)
        values[mu], values[b] = values[mu] * size, values[b] / size
    return values
