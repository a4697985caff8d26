"""Our own ADMM for nuclear-norm problems of Hankel structure (after Liu, Hansson and Vandenberghe 2013).

``min ‖X‖_* + weight ‖v - y‖²`` subject to ``X = matrix(v, theta)``: X by thresholding singular values, (v, theta) in
the eigenvectors of a Gram matrix that is decomposed once. It stops by the duality gap, not by residuals: the dual point
is feasible by construction and its value is a bound.
"""

import numpy as np

from optid.arrays import Array
from optid.backends.back_end import Answer, Minimum, Settings
from optid.core.low_rank import LowRankForm
from optid.core.problem import Problem
from optid.program.solution import tolerance
from optid.structures.nuclear_norm import NuclearProblem

RELAXATION = 1.7
CHECK = 10  # iterations between measurements of the gap
BALANCE = 1.2  # ratio of residuals beyond which the step size changes
FACTOR = 1.3  # by how much
FIRST = 60, 3.0  # iterations in which the size of the step is found, and the factor there


def run(problem: Problem, settings: Settings) -> Answer:
    """Solve a programme of the form `LowRankForm` without further constraints.

    Options: ``limit`` (iterations at most, default 20,000).
    """
    form = LowRankForm.of(problem)
    assert form is not None
    allowed = 0.5 * tolerance(settings.accuracy)  # half of what the judgement allows
    found = minimise(form.problem, form.weight, allowed, int(dict(settings.options).get("limit", 20_000)))
    v, theta = found.point
    return found.answer(allowed, {"yhat": v} | ({"T": theta} if form.problem.parameters else {}),
                        {"structure": -np.ravel(found.dual, order="F")})


def minimise(problem: NuclearProblem, weight: float, gap: float = 1e-7, limit: int = 20_000) -> Minimum:
    """Minimise the objective for one positive weight of the misfit: point (v, theta), dual point (r, q).

    It stops at a relative duality gap, or at a number of iterations.
    """
    v, theta = problem.data, problem.predictor_coefficients(problem.hankel(problem.data))
    reached = problem.matrix(v, theta)
    step = problem.shape[0] / max(float(np.linalg.norm(reached)) * np.sqrt(problem.shape[0]), 1e-300)
    scaled = np.zeros(problem.shape)
    low_rank, best = reached, None
    for count in range(1, limit + 1):
        before = low_rank
        relaxed = RELAXATION * reached + (1.0 - RELAXATION) * before
        low_rank = shrunk(relaxed + scaled, 1.0 / step)
        scaled = scaled + relaxed - low_rank
        v, theta = problem.update(low_rank - scaled, weight, step)
        reached = problem.matrix(v, theta)
        if count % CHECK and count < limit:
            continue
        bound, multipliers = problem.dual(scaled * step, weight)
        found = Minimum((v, theta), multipliers, problem.value(v, theta, weight), bound, count)
        if best is None or found.gap < best.gap:
            best = found
        if found.gap <= gap or count == limit:
            break
        outside, moved = np.linalg.norm(reached - low_rank), np.linalg.norm(low_rank - before)
        sizes = np.linalg.norm(scaled) / max(float(np.linalg.norm(low_rank)), 1e-300)
        change = FIRST[1] if count <= FIRST[0] else FACTOR
        # the step grows where the constraint lags behind, and shrinks where the matrix does; balance by the geometric
        # mean of absolute and relative residual ratios: with either alone the penalty oscillates
        lag = outside * np.sqrt(sizes)
        factor = change if lag > BALANCE * moved else 1.0 / change if moved > BALANCE * lag else 1.0
        factor = 1.0 if count > limit // 2 else factor
        step, scaled = step * factor, scaled / factor
    assert best is not None
    return best


def shrunk(matrix: Array, threshold: float) -> Array:
    """Return the matrix with its singular values reduced by a threshold, not below zero.

    Through the Gram matrix of the shorter side: singular values near the threshold lose no digits that matter.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return shrunk(matrix.T, threshold).T
    values, vectors = np.linalg.eigh(matrix @ matrix.T)
    kept = values > threshold**2
    factors = 1.0 - threshold / np.sqrt(values[kept])
    return (vectors[:, kept] * factors) @ (vectors[:, kept].T @ matrix)
