"""The course f(k) of one fault, as quadratic programmes (F6).

    min over f:   1/2 ‖r - T f‖²  +  lambda ‖D1 f‖_1 ("tv")  or  lambda ‖D2 f‖_1 ("trend")  or  rho/2 ‖D1 f‖² ("smooth")

with f = 0 before the window, so that a change in the first sample counts, and optional constraints on f: its sign, its
size, its slew rate. The penalties shrink the course and share one change among neighbours; so they only propose where
the course changes. Changes that the Bayesian information criterion rejects are dropped, the others move to where they
explain most, and the course is fitted again by least squares under the same constraints. BIC chooses the
penalty and, if asked, the prior.

Named expressions: ``f`` (N,), the course; ``changes``, the penalised quantities.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.core.group_sparse import group_squares
from optid.core.problem import Problem
from optid.core.terms import GroupNorms, Squares
from optid.errors import StructureError, nearest
from optid.faults.consistency.course_fits import Changes, CourseFits
from optid.faults.consistency.profiles import CourseProblem, course_problem
from optid.faults.search.scanning import Scan
from optid.solving.solve import Procedure

SIGNS = {"positive": 1.0, "negative": -1.0}


def profile(found: Scan, label: str, *, prior: str = "auto", sign: str | None = None, limit: float | None = None,
            slew: float | None = None, penalties: Sequence[float] | None = None, constraints: Sequence[Any] = ()
            ) -> Procedure:
    """Estimate the course of one fault.

    Args:
        found: the search of the window.
        label: of the candidate.
        prior: "tv" (steps), "trend" (ramps), "smooth" (random walk), or "auto": the better of the first two.
        sign: "positive" or "negative", of the course.
        limit: largest size of the course.
        slew: largest change from one sample to the next, the first from zero.
        penalties: shares of the largest penalty (weights of the random walk over the mean square of its columns);
            several by default.
        constraints: further constraints on ``f`` and ``changes``.

    Returns:
        An `optid.faults.consistency.profiles.Profile`.

    Raises:
        DataError: the window sees nothing of the fault.
        StructureError: words or numbers that do not fit, a candidate without a course.
    """
    fits, shares = CourseFits(course_problem(found, label)), CourseFits.shares(prior, penalties)
    rules = [*_rules(sign, limit, slew), *constraints]
    for word in ("tv", "trend") if prior == "auto" else (prior,):
        yield from (_smoothed(shares, rules, fits) if word == "smooth" else _changing(word, shares, rules, fits))
    return fits.best()


def _changing(prior: str, shares: Sequence[float], rules: Sequence[Any], fits: CourseFits) -> Procedure:
    """Propose changes by the penalties, drop those that the criterion rejects, and fit again."""
    penalised = course_of_changes(fits.problem, prior).subject_to(*rules)
    largest = float(np.abs(fits.problem.design[prior].T @ fits.problem.r).max())
    for share in sorted(shares, reverse=True):
        solution = yield penalised.under_weights(**{"lambda": share * largest})
        changes = fits.keep_changes(prior, f"{prior} at {share:.2g}", solution)
        if changes is None:
            continue
        if changes.any:
            solution = yield _refit(fits.problem, changes).subject_to(*rules)
            if not fits.usable(f"refit of {prior}", solution):
                continue
        fits.changing(changes, solution, penalised.constraint_names)


def _refit(problem: CourseProblem, changes: Changes) -> Problem:
    """State the least squares of a course that changes at known samples."""
    return Problem(
        f"fault.profile {changes.prior} refit", {"scaled": problem.refit(changes.columns)[0]},
        (Squares.half(problem.r, {"scaled": changes.columns}),),
        further=lambda v, _: {"f": changes.courses @ v["scaled"], "changes": cp.multiply(changes.unit, v["scaled"])},
        scale=0.5 * float(problem.r @ problem.r))


def course_of_changes(problem: CourseProblem, prior: str) -> Problem:
    """State the problem with a penalty on the changes of the course ("tv") or of its slope ("trend").

    Args:
        problem: from `optid.faults.consistency.profiles.course_problem`.
        prior: "tv" or "trend".
    """
    count, shapes, columns = problem.count, problem.shapes[prior], problem.design[prior]
    misfit = group_squares(problem.r, {"changes": columns[:, :, None]}, {"changes": np.ones(count)})  # 1/2 ‖r - T f‖²

    def state(**weights: float) -> Problem:
        sparse = GroupNorms({"changes": np.full(count, weights["lambda"])})  # lambda ‖changes‖_1
        return Problem(
            f"fault.profile {prior}", {"changes": _one(columns, problem.r)[:, None]}, (misfit, sparse),
            further=lambda v, _: {"f": shapes @ v["changes"][:, 0], "changes": v["changes"][:, 0]},
            scale=0.5 * float(problem.r @ problem.r), weights=weights, posed=state)

    return state(**{"lambda": 0.1 * float(np.abs(columns.T @ problem.r).max())})


def _smoothed(shares: Sequence[float], rules: Sequence[Any], fits: CourseFits) -> Procedure:
    """Fit random walks of several variances."""
    walk, matrix = random_walk(fits.problem).subject_to(*rules), fits.problem.matrix
    scale = max(float(np.sum(matrix**2)) / fits.problem.count, 1e-300)
    for share in shares:
        solution = yield walk.under_weights(rho=share * scale)
        if fits.usable(f"smooth at {share:.2g}", solution):
            fits.walking(solution, share * scale, walk.constraint_names)


def random_walk(problem: CourseProblem, rho: float = 1.0) -> Problem:
    """State the problem of a random walk: that of the Kalman smoother, with constraints."""
    differences = problem.differences
    shapes, misfit = problem.shapes["tv"], Squares.half(problem.r, {"f": problem.matrix})  # 1/2 ‖r - T f‖²
    rough = Squares.half(np.zeros(problem.count), {"f": np.sqrt(rho) * differences})  # rho/2 ‖D1 f‖²
    return Problem(
        "fault.profile smooth", {"f": shapes @ _one(problem.matrix @ shapes, problem.r)}, (misfit, rough),
        further=lambda v, _: {"changes": differences @ v["f"]}, scale=0.5 * float(problem.r @ problem.r),
        weights={"rho": rho}, posed=partial(random_walk, problem))


def _one(columns: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The change that explains most, as a start."""
    sizes = np.linalg.norm(columns, axis=0)
    heights = np.divide(columns.T @ r, sizes**2, out=np.zeros(sizes.size), where=sizes > 0)
    return np.where(np.arange(sizes.size) == int(np.argmax(np.abs(heights * sizes))), heights, 0.0)


def _rules(sign: str | None, limit: float | None, slew: float | None) -> list[Any]:
    rules: list[Any] = []
    if sign is not None:
        if sign not in SIGNS:
            raise StructureError(f"sign={sign!r}. {nearest(str(sign), SIGNS)}")
        rules.append(lambda v: {f"{sign} course": SIGNS[sign] * v["f"] >= 0})
    for word, value in (("limit", limit), ("slew", slew)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise StructureError(f"{word}={value!r}; it must be a positive number.")
    if limit is not None:
        rules.append(lambda v: {"limit": [sign * v["f"] <= limit for sign in (1, -1)]})
    if slew is not None:
        rules.append(lambda v: {"slew": [sign * part <= slew for part in (v["f"][0], cp.diff(v["f"]))
                                         for sign in (1, -1)]})
    return rules
