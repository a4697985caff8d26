"""The course f(k) of one fault, as quadratic programmes (F6).

    min over f:   1/2 ‖r - T f‖²  +  lambda ‖D1 f‖_1 ("tv")  or  lambda ‖D2 f‖_1 ("trend")  or  rho/2 ‖D1 f‖² ("smooth")

with f = 0 before the window, so that a change in the first sample counts, and optional constraints on f: its sign, its
size, its slew rate. The penalties shrink the course and share one change among neighbours; so they only propose where
the course changes. Changes that the Bayesian information criterion does not pay for are dropped, the others move to
where they explain most, and the course is fitted again by least squares under the same constraints. BIC chooses the
penalty and, if asked, the prior.

Named expressions: ``f`` (N,), the course; ``changes``, what the penalty counts.
"""

from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.faults.group_bound import certify
from optid.errors import StructureError, nearest
from optid.faults.consistency.profiles import EACH, PRIORS, CourseProblem, Profile, course_problem
from optid.faults.search.scanning import Scan
from optid.program.program import Program
from optid.program.solution import Bound, Solution, Status
from optid.program.view import View
from optid.solving.solve import Evidence, Procedure
from optid.structures.group_sparse import GroupProblem, GroupSparseStructure

PENALTIES = tuple(float(share) for share in np.geomspace(0.5, 0.003, 10))
"""Penalties tried, as shares of the one at which nothing is left."""

ROUGHNESS = tuple(float(share) for share in np.geomspace(1e-4, 1e2, 9))
"""Weights of the random walk tried, over the mean square of the columns of T."""

PROVED = 1e-6
"""Relative gap up to which every programme must be solved."""

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
    problem = course_problem(found, label)
    if prior != "auto" and prior not in PRIORS:
        raise StructureError(f"prior={prior!r}. {nearest(str(prior), ['auto', *PRIORS])}")
    shares = _shares(penalties, prior)
    rules = [*_rules(sign, limit, slew), *constraints]
    priors = ("tv", "trend") if prior == "auto" else (prior,)
    fits: list[tuple[float, Profile, Solution]] = []
    gaps: list[float] = []
    failed = ""
    for word in priors:
        method = _smoothed if word == "smooth" else _changing
        found_here, reason = yield from method(problem, word, shares, rules, gaps)
        fits += found_here
        failed = failed or reason
    if not fits:
        none = Bound(-np.inf, False, "none", failed)
        return Evidence(None, float("nan"), none, Status.FAILED, failed)
    bic = {word: min(value for value, fit, _ in fits if fit.prior == word) for word in priors
           if any(fit.prior == word for _, fit, _ in fits)}
    _, best, solution = min(fits, key=lambda fit: fit[0])
    gap = max(gaps, default=float("inf"))
    if not gap < PROVED:
        failed = failed or f"a programme was solved without a proof, relative gap {gap:.1e}"
    best = replace(best, bic=bic, gap=gap, certified=not failed, status=failed)
    bound = solution.bound or Bound(-np.inf, False, "none", solution.reason)
    status = solution.status if best.certified else Status.INACCURATE
    return Evidence(best, solution.objective, bound, status, failed or solution.reason,
                    {"prior": best.prior, "degrees of freedom": best.freedom, "largest relative gap": gap})


def _changing(problem: CourseProblem, prior: str, shares: Sequence[float], rules: Sequence[Any], gaps: list[float]
              ) -> Generator[Program, Solution, tuple[list[tuple[float, Profile, Solution]], str]]:
    """Propose changes by the penalties, drop what does not pay, and fit again."""
    shapes = problem.shapes(prior)
    columns = problem.matrix @ shapes
    program = profile_programme(problem, prior).subject_to(*rules)
    largest = float(np.abs(columns.T @ problem.r).max())
    fits: list[tuple[float, Profile, Solution]] = []
    seen: set[tuple[int, ...]] = set()
    failed = ""
    for share in sorted(shares, reverse=True):
        program.parameters["lambda"].value = share * largest
        solution = yield program
        if not solution.has_point:
            failed = failed or f"{prior} at {share:.2g}: {solution.status}, {solution.reason}"
            continue
        gaps.append(solution.gap)
        sizes = np.abs(np.ravel(solution.values["changes"])) * np.linalg.norm(columns, axis=0)
        support = np.flatnonzero(sizes > 1e-5 * max(float(sizes.max()), 1e-3 * float(np.linalg.norm(problem.r))))
        kept = support
        if support.size:
            kept = problem.pruned(columns, problem.moved(columns, problem.pruned(columns, support)))
        if tuple(kept.tolist()) in seen:
            continue
        seen.add(tuple(kept.tolist()))
        refit = _refit(problem, shapes[:, kept], prior, rules)
        solution = yield refit
        if not solution.has_point or solution.status not in (Status.OPTIMAL, Status.LOCAL):
            failed = failed or f"refit of {prior}: {solution.status}, {solution.reason}"
            continue
        gaps.append(solution.gap)
        fits.append(_fitted(problem, prior, shapes, columns, kept, solution, refit))
    return fits, failed


def profile_programme(problem: CourseProblem, prior: str) -> Program:
    """Pose the programme with a penalty on the changes of the course ("tv") or of its slope ("trend").

    Args:
        problem: from `optid.faults.consistency.profiles.course_problem`.
        prior: "tv" or "trend".
    """
    count, shapes = problem.count, problem.shapes(prior)
    columns = problem.matrix @ shapes
    level = cp.Parameter(nonneg=True, name="lambda", value=0.1 * float(np.abs(columns.T @ problem.r).max()))
    changes, residual = cp.Variable((count, 1), name="changes"), cp.Variable(problem.r.size, name="residual")
    misfit = problem.r - columns @ changes[:, 0]
    form = GroupSparseStructure(GroupProblem(columns, problem.r, np.arange(count + 1), np.ones(count)),
                                {"changes": (count, 1)})
    view = View({"f": shapes @ changes[:, 0], "changes": changes[:, 0]})
    return Program(
        f"fault.profile {prior}", cp.Minimize(0.5 * cp.sum_squares(residual) + level * cp.norm1(changes)),
        {"residual": (residual == misfit,)}, {"changes": changes, "residual": residual},
        {"changes": _one(columns, problem.r)[:, None]}, dict, view, structural=frozenset({"residual"}),
        parameters={"lambda": level}, derived={"residual": misfit}, structure=form, certify=certify,
        scale=0.5 * float(problem.r @ problem.r))


def _refit(problem: CourseProblem, shapes: np.ndarray, prior: str, rules: Sequence[Any]) -> Program:
    """Pose least squares with changes at given samples, under the same constraints."""
    columns = problem.matrix @ shapes
    sizes = np.linalg.norm(columns, axis=0)
    sizes[sizes == 0] = 1.0
    scaled, residual = cp.Variable(shapes.shape[1], name="scaled"), cp.Variable(problem.r.size, name="residual")
    misfit: Any = problem.r - (columns / sizes) @ scaled if shapes.shape[1] else cp.Constant(problem.r)
    course: Any = (shapes / sizes) @ scaled if shapes.shape[1] else cp.Constant(np.zeros(problem.count))
    variables = {"scaled": scaled, "residual": residual} if shapes.shape[1] else {"residual": residual}
    start = {"scaled": problem.refitted(columns / sizes)[0]} if shapes.shape[1] else {}
    changes: Any = cp.multiply(1 / sizes, scaled) if shapes.shape[1] else cp.Constant(np.zeros(1))
    program = Program(
        f"fault.profile {prior} refit", cp.Minimize(0.5 * cp.sum_squares(residual)),
        {"residual": (residual == misfit,)}, variables, start, dict,
        View({"f": course, "changes": changes}), structural=frozenset({"residual"}),
        derived={"residual": misfit}, scale=0.5 * float(problem.r @ problem.r))
    return program.subject_to(*rules) if shapes.shape[1] else program


def _fitted(problem: CourseProblem, prior: str, shapes: np.ndarray, columns: np.ndarray, kept: np.ndarray,
            solution: Solution, refit: Program) -> tuple[float, Profile, Solution]:
    course, std = np.zeros(problem.count), np.zeros(problem.count)
    changes: dict[int, float] = {}
    if kept.size:
        sizes = np.linalg.norm(columns[:, kept], axis=0)
        heights = np.asarray(solution.values["scaled"]) / np.where(sizes > 0, sizes, 1.0)
        course = shapes[:, kept] @ heights
        scaled = columns[:, kept] / np.where(sizes > 0, sizes, 1.0)
        covariance = np.linalg.pinv(scaled.T @ scaled, rcond=1e-10, hermitian=True)
        unit = shapes[:, kept] / np.where(sizes > 0, sizes, 1.0)
        std = np.sqrt(np.maximum(np.einsum("kp,pq,kq->k", unit, covariance, unit), 0.0))
        scale = 1.0 if prior == "tv" else 1.0 / problem.count
        changes = {int(k): float(height * scale) for k, height in zip(kept, heights)}
    rest = problem.r - problem.matrix @ course
    freedom = float(EACH * kept.size)
    value = problem.criterion(float(rest @ rest), freedom)
    fit = Profile(problem.label, course, std, prior, changes, {}, freedom, 0.0, False,
                  tuple(refit.user_constraints))
    return value, fit, solution


def _smoothed(problem: CourseProblem, prior: str, shares: Sequence[float], rules: Sequence[Any], gaps: list[float]
              ) -> Generator[Program, Solution, tuple[list[tuple[float, Profile, Solution]], str]]:
    """Fit random walks of several variances; the trace of the smoother counts as degrees of freedom."""
    program = smooth_programme(problem).subject_to(*rules)
    differences = np.eye(problem.count) - np.eye(problem.count, k=-1)
    products = problem.matrix.T @ problem.matrix
    scale = max(float(np.trace(products)) / problem.count, 1e-300)
    fits: list[tuple[float, Profile, Solution]] = []
    failed = ""
    for share in shares:
        weight = share * scale
        program.parameters["root of rho"].value = np.sqrt(weight)
        solution = yield program
        if not solution.has_point or solution.status not in (Status.OPTIMAL, Status.LOCAL):
            failed = failed or f"smooth at {share:.2g}: {solution.status}, {solution.reason}"
            continue
        gaps.append(solution.gap)
        course = np.asarray(solution.values["f"])
        covariance = np.linalg.inv(products + weight * differences.T @ differences)
        freedom = float(np.sum(covariance * products))
        rest = problem.r - problem.matrix @ course
        fit = Profile(problem.label, course, np.sqrt(np.diag(covariance)), prior, {}, {}, freedom, 0.0, False,
                      tuple(program.user_constraints))
        fits.append((problem.criterion(float(rest @ rest), freedom), fit, solution))
    return fits, failed


def smooth_programme(problem: CourseProblem) -> Program:
    """Pose the programme of the random walk: what the Kalman smoother solves, open to constraints."""
    f, residual = cp.Variable(problem.count, name="f"), cp.Variable(problem.r.size, name="residual")
    root = cp.Parameter(nonneg=True, name="root of rho", value=1.0)
    misfit = problem.r - problem.matrix @ f
    rough = cp.Variable(problem.count, name="rough")
    steps_seen = problem.matrix @ problem.shapes("tv")
    steps: Any = root * (f - cp.hstack([np.zeros(1), f[:-1]]))
    return Program(
        "fault.profile smooth", cp.Minimize(0.5 * cp.sum_squares(residual) + 0.5 * cp.sum_squares(rough)),
        {"residual": (residual == misfit,), "roughness": (rough == steps,)},
        {"f": f, "residual": residual, "rough": rough}, {"f": problem.shapes("tv") @ _one(steps_seen, problem.r)}, dict,
        View({"f": f, "changes": f - cp.hstack([np.zeros(1), f[:-1]])}),
        structural=frozenset({"residual", "roughness"}), parameters={"root of rho": root},
        derived={"residual": misfit, "rough": steps}, scale=0.5 * float(problem.r @ problem.r))


def _one(columns: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The one change that explains most: a start, and the size that is usual."""
    sizes = np.linalg.norm(columns, axis=0)
    along = np.where(sizes > 0, columns.T @ r / np.where(sizes > 0, sizes, 1.0), 0.0)
    best = int(np.argmax(np.abs(along)))
    return np.where(np.arange(sizes.size) == best, along / np.where(sizes > 0, sizes, 1.0), 0.0)


def _rules(sign: str | None, limit: float | None, slew: float | None) -> list[Any]:
    rules: list[Any] = []
    if sign is not None:
        if sign not in SIGNS:
            raise StructureError(f"sign={sign!r}. {nearest(str(sign), SIGNS)}")
        factor = SIGNS[sign]
        rules.append(lambda v: {f"{sign} course": factor * v["f"] >= 0})
    for word, value in (("limit", limit), ("slew", slew)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise StructureError(f"{word}={value!r}; a positive number is needed.")
    if limit is not None:
        rules.append(lambda v: {"limit": [v["f"] <= limit, -v["f"] <= limit]})
    if slew is not None:
        rules.append(lambda v: {"slew": [v["f"][0] <= slew, -v["f"][0] <= slew, cp.diff(v["f"]) <= slew,
                                         -cp.diff(v["f"]) <= slew]})
    return rules


def _shares(penalties: Sequence[float] | None, prior: str) -> tuple[float, ...]:
    if penalties is None:
        return ROUGHNESS if prior == "smooth" else PENALTIES
    found = tuple(float(share) for share in penalties)
    if not found or not all(np.isfinite(share) and share > 0 for share in found):
        raise StructureError(f"penalties={penalties!r}; positive numbers are needed.")
    return found
