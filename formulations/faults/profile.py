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
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.core.problem import Problem
from optid.core.terms import GroupNorms, Squares
from optid.errors import StructureError, nearest
from optid.faults.consistency.profiles import EACH, PRIORS, CourseProblem, Profile, course_problem
from optid.faults.search.scanning import Scan
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure
from optid.structures.group_sparse import GroupProblem

PENALTIES = tuple(float(share) for share in np.geomspace(0.5, 0.003, 10))
"""Penalties tried, as shares of the one at which the course is zero."""

ROUGHNESS = tuple(float(share) for share in np.geomspace(1e-4, 1e2, 9))
"""Weights of the random walk tried, over the mean square of the columns of T."""

PROVED = 1e-6
"""Relative gap up to which every programme must be solved."""

SIGNS = {"positive": 1.0, "negative": -1.0}


class _Fits:
    """Results of the programmes: courses with their criterion and solution, gaps, and the first failure."""

    def __init__(self, problem: CourseProblem) -> None:
        self.problem = problem
        self.found: list[tuple[float, Profile, Solution]] = []
        self.gaps: list[float] = []
        self.failed = ""

    def usable(self, word: str, solution: Solution, *, proved: bool = True) -> bool:
        """Record the gap of a solution, or its failure."""
        if solution.has_point and (not proved or solution.status in (Status.OPTIMAL, Status.LOCAL)):
            self.gaps.append(solution.gap)
            return True
        self.failed = self.failed or f"{word}: {solution.status}, {solution.reason}"
        return False

    def add(self, solution: Solution, fit: Profile) -> None:
        """Add a course with the value of its criterion."""
        rest = self.problem.r - self.problem.matrix @ fit.course
        self.found.append((self.problem.criterion(float(rest @ rest), fit.freedom), fit, solution))


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
    problem = course_problem(found, label)
    fits = _Fits(problem)
    if prior != "auto" and prior not in PRIORS:
        raise StructureError(f"prior={prior!r}. {nearest(str(prior), ['auto', *PRIORS])}")
    if penalties is None:
        penalties = ROUGHNESS if prior == "smooth" else PENALTIES
    shares = [float(share) for share in penalties]
    if not shares or not all(np.isfinite(share) and share > 0 for share in shares):
        raise StructureError(f"penalties={penalties!r}; they must be positive numbers.")
    rules = [*_rules(sign, limit, slew), *constraints]
    for word in ("tv", "trend") if prior == "auto" else (prior,):
        yield from (_smoothed(shares, rules, fits) if word == "smooth" else _changing(word, shares, rules, fits))
    if not fits.found:
        return Evidence.pointless(Status.FAILED, fits.failed)
    bic: dict[str, float] = {}
    for value, fit, _ in fits.found:
        bic[fit.prior] = min(value, bic.get(fit.prior, np.inf))
    _, best, solution = min(fits.found, key=lambda fit: fit[0])
    gap, failed = max(fits.gaps, default=float("inf")), fits.failed
    if not gap < PROVED:
        failed = failed or f"a programme was solved without a proof, relative gap {gap:.1e}"
    best = replace(best, bic=bic, gap=gap, certified=not failed, status=failed)
    bound = solution.bound or Bound.none(solution.reason)
    status = Status.INACCURATE if failed else solution.status
    return Evidence(best, solution.objective, bound, status, failed or solution.reason,
                    {"prior": best.prior, "degrees of freedom": best.freedom, "largest relative gap": gap})


def _changing(prior: str, shares: Sequence[float], rules: Sequence[Any], fits: _Fits) -> Procedure:
    """Propose changes by the penalties, drop those that the criterion rejects, and fit again."""
    problem = fits.problem
    shapes = problem.shapes(prior)
    design = problem.matrix @ shapes
    lengths = np.linalg.norm(design, axis=0)
    penalised = course_of_changes(problem, prior).subject_to(*rules)
    largest = float(np.abs(design.T @ problem.r).max())
    seen: set[tuple[int, ...]] = set()
    for share in sorted(shares, reverse=True):
        solution = yield penalised.under_weights(**{"lambda": share * largest})
        if not fits.usable(f"{prior} at {share:.2g}", solution, proved=False):
            continue
        sizes = np.abs(np.ravel(solution.values["changes"])) * lengths
        kept = np.flatnonzero(sizes > 1e-5 * max(float(sizes.max()), 1e-3 * float(np.linalg.norm(problem.r))))
        if kept.size:
            kept = problem.pruned(design, problem.moved(design, problem.pruned(design, kept)))
        if tuple(kept.tolist()) in seen:
            continue
        seen.add(tuple(kept.tolist()))
        unit = 1 / np.where(lengths[kept] > 0, lengths[kept], 1.0)
        columns, course, std = design[:, kept] * unit, np.zeros(problem.count), np.zeros(problem.count)
        changes: dict[int, float] = {}
        if kept.size:
            courses = shapes[:, kept] * unit
            solution = yield Problem(
                f"fault.profile {prior} refit", {"scaled": problem.refitted(columns)[0]},
                (Squares.half(problem.r, {"scaled": columns}),),
                further=lambda v, _, courses=courses, unit=unit: {
                    "f": courses @ v["scaled"], "changes": cp.multiply(unit, v["scaled"])},
                scale=0.5 * float(problem.r @ problem.r), builders=tuple(rules))
            if not fits.usable(f"refit of {prior}", solution):
                continue
            heights = np.asarray(solution.values["scaled"]) * unit
            course = shapes[:, kept] @ heights
            covariance = np.linalg.pinv(columns.T @ columns, rcond=1e-10, hermitian=True)
            std = np.sqrt(np.maximum(np.einsum("kp,pq,kq->k", courses, covariance, courses), 0.0))
            scale = 1.0 if prior == "tv" else 1.0 / problem.count
            changes = {int(k): float(height * scale) for k, height in zip(kept, heights)}
        fits.add(solution, Profile(problem.label, course, std, prior, changes, {}, float(EACH * kept.size), 0.0, False,
                                   penalised.constraint_names))


def course_of_changes(problem: CourseProblem, prior: str) -> Problem:
    """State the problem with a penalty on the changes of the course ("tv") or of its slope ("trend").

    Args:
        problem: from `optid.faults.consistency.profiles.course_problem`.
        prior: "tv" or "trend".
    """
    count, shapes = problem.count, problem.shapes(prior)
    columns = problem.matrix @ shapes
    numbers = GroupProblem(columns, problem.r, np.arange(count + 1), np.ones(count))
    misfit = Squares.half(problem.r, {"changes": columns}, numbers)  # 1/2 ‖r - T f‖²

    def state(**weights: float) -> Problem:
        sparse = GroupNorms({"changes": np.full(count, weights["lambda"])})  # lambda ‖changes‖_1
        return Problem(
            f"fault.profile {prior}", {"changes": _one(columns, problem.r)[:, None]}, (misfit, sparse),
            further=lambda v, _: {"f": shapes @ v["changes"][:, 0], "changes": v["changes"][:, 0]},
            scale=0.5 * float(problem.r @ problem.r), weights=weights, posed=state)

    return state(**{"lambda": 0.1 * float(np.abs(columns.T @ problem.r).max())})


def _smoothed(shares: Sequence[float], rules: Sequence[Any], fits: _Fits) -> Procedure:
    """Fit random walks of several variances; the trace of the smoother counts as degrees of freedom."""
    problem = fits.problem
    walk = random_walk(problem).subject_to(*rules)
    differences = np.eye(problem.count) - np.eye(problem.count, k=-1)
    products = problem.matrix.T @ problem.matrix
    scale = max(float(np.trace(products)) / problem.count, 1e-300)
    for share in shares:
        solution = yield walk.under_weights(rho=share * scale)
        if fits.usable(f"smooth at {share:.2g}", solution):
            covariance = np.linalg.inv(products + share * scale * differences.T @ differences)
            fits.add(solution, Profile(
                problem.label, np.asarray(solution.values["f"]), np.sqrt(np.diag(covariance)), "smooth", {}, {},
                float(np.sum(covariance * products)), 0.0, False, walk.constraint_names))


def random_walk(problem: CourseProblem, rho: float = 1.0) -> Problem:
    """State the problem of a random walk: that of the Kalman smoother, with constraints."""
    differences = np.eye(problem.count) - np.eye(problem.count, k=-1)
    shapes, misfit = problem.shapes("tv"), Squares.half(problem.r, {"f": problem.matrix})  # 1/2 ‖r - T f‖²
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
