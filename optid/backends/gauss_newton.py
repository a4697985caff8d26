"""Own Gauss-Newton for rank-one least squares: `optid.structures.rank_one`, under constraints `RankOneSQP`."""

import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.backends.rank_one_sqp import DIRECTIONS, RankOneSQP
from optid.certificate.ladder import certify
from optid.certificate.lifting import certify_rank_one
from optid.core.least_squares import RankOneForm
from optid.core.problem import Problem
from optid.core.terms import Values
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
    if not problem.constraint_names:
        found = _minimum(problem, form, count, seed)
        r = form.problem.root @ found.point.lift() - form.problem.target
        status, word = (Status.LOCAL, "stationary") if found.converged else (Status.LIMIT, "iteration limit")
        return Answer(status, word, to_values(problem, form, found.point),
                      {"residual": -2.0 * r, "gauge": np.zeros(len(form.blocks))}, found.iterations)
    return _constrained(problem, _minimum(problem, form, count, seed).point, seed,
                        int(options.get("directions", DIRECTIONS)), int(options.get("descents", DESCENTS)))


def _constrained(problem: Problem, free: Point, seed: int, directions: int, descents: int) -> Answer:
    """Solve the problem of the core that a programme states."""
    def is_proved(x: Values) -> bool:
        return certify_rank_one(problem, x, max_size=0)[0].proved

    end = RankOneSQP(problem, problem.start, free, is_proved).solve(seed, directions, descents)
    if not end.x:
        return Answer(end.status, end.word, iterations=end.steps)
    (squares,) = problem.bilinear_terms
    residual = squares.residual(problem.leaf_values(end.x))
    return Answer(end.status, end.word, end.x, {"residual": -2.0 * residual, **end.duals}, end.steps)


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
