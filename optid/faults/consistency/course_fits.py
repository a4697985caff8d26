"""The courses of one fault that programmes propose, compared by the Bayesian information criterion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError, nearest
from optid.faults.consistency.profiles import EACH, PRIORS, CourseProblem, Profile
from optid.program.solution import Solution, Status
from optid.solving.solve import Evidence

PENALTIES = tuple(float(share) for share in np.geomspace(0.5, 0.003, 10))
"""Penalties tried, as shares of the one at which the course is zero."""

ROUGHNESS = tuple(float(share) for share in np.geomspace(1e-4, 1e2, 9))
"""Weights of the random walk tried, over the mean square of the columns of T."""

PROVED = 1e-6
"""Relative gap up to which every programme must be solved."""


@dataclass(frozen=True, eq=False)
class Changes:
    """The samples at which a course changes, K of them."""

    prior: str
    kept: np.ndarray  # (K,) the samples
    unit: Array  # (K,) sizes of changes of one effect
    columns: Array  # (N l, K) effects of changes of these sizes on the window
    courses: Array  # (N, K) their courses

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return self.kept.size > 0


class CourseFits:
    """Results of the programmes: courses with their criterion and solution, gaps, and the first failure."""

    def __init__(self, problem: CourseProblem) -> None:
        self.problem = problem
        self.found: list[tuple[float, Profile, Solution]] = []
        self.gaps: list[float] = []
        self.failed = ""
        self._seen: set[tuple[Any, ...]] = set()

    @staticmethod
    def shares(prior: str, penalties: Sequence[float] | None) -> list[float]:
        """Return the penalties to try, several by default; refuse others, and unknown priors."""
        if prior != "auto" and prior not in PRIORS:
            raise StructureError(f"prior={prior!r}. {nearest(str(prior), ['auto', *PRIORS])}")
        if penalties is None:
            penalties = ROUGHNESS if prior == "smooth" else PENALTIES
        shares = [float(share) for share in penalties]
        if not shares or not all(np.isfinite(share) and share > 0 for share in shares):
            raise StructureError(f"penalties={penalties!r}; they must be positive numbers.")
        return shares

    def usable(self, word: str, solution: Solution, *, proved: bool = True) -> bool:
        """Record the gap of a solution, or its failure."""
        if solution.has_point and (not proved or solution.status.is_optimum):
            self.gaps.append(solution.gap)
            return True
        self.failed = self.failed or f"{word}: {solution.status}, {solution.reason}"
        return False

    def keep_changes(self, prior: str, word: str, solution: Solution) -> Changes | None:
        """Return the changes of a solution that the criterion keeps; None where there is none that is new."""
        problem, design = self.problem, self.problem.design[prior]
        if not self.usable(word, solution, proved=False):
            return None
        lengths = np.linalg.norm(design, axis=0)
        sizes = np.abs(np.ravel(solution.values["changes"])) * lengths
        kept = np.flatnonzero(sizes > 1e-5 * max(float(sizes.max()), 1e-3 * float(np.linalg.norm(problem.r))))
        if kept.size:
            kept = problem.prune(design, problem.move_changes(design, problem.prune(design, kept)))
        key = (prior, *kept.tolist())
        if key in self._seen:
            return None
        self._seen.add(key)
        unit = 1 / np.where(lengths[kept] > 0, lengths[kept], 1.0)
        return Changes(prior, kept, unit, design[:, kept] * unit, problem.shapes[prior][:, kept] * unit)

    def changing(self, changes: Changes, solution: Solution, names: tuple[str, ...]) -> None:
        """Add the course of changes, its heights those of a solution in `Changes.unit`, constraints by name."""
        problem, count = self.problem, self.problem.count
        course, std, heights = np.zeros(count), np.zeros(count), dict[int, float]()
        if changes.any:
            scaled = np.asarray(solution.values["scaled"])
            course = changes.courses @ scaled
            covariance = np.linalg.pinv(changes.columns.T @ changes.columns, rcond=1e-10, hermitian=True)
            std = np.sqrt(np.maximum(np.einsum("kp,pq,kq->k", changes.courses, covariance, changes.courses), 0.0))
            scale = 1.0 if changes.prior == "tv" else 1.0 / count
            heights = {int(k): float(size * scale) for k, size in zip(changes.kept, scaled * changes.unit)}
        self._add(solution, Profile(problem.label, course, std, changes.prior, heights, {},
                                    float(EACH * changes.kept.size), 0.0, False, names))

    def walking(self, solution: Solution, rho: float, names: tuple[str, ...]) -> None:
        """Add a random walk; the trace of the smoother counts as degrees of freedom."""
        problem, differences = self.problem, self.problem.differences
        products = problem.matrix.T @ problem.matrix
        covariance = np.linalg.inv(products + rho * differences.T @ differences)
        self._add(solution, Profile(
            problem.label, np.asarray(solution.values["f"]), np.sqrt(np.diag(covariance)), "smooth", {}, {},
            float(np.sum(covariance * products)), 0.0, False, names))

    def _add(self, solution: Solution, fit: Profile) -> None:
        """Add a course with the value of its criterion."""
        rest = self.problem.r - self.problem.matrix @ fit.course
        self.found.append((self.problem.criterion(float(rest @ rest), fit.freedom), fit, solution))

    def best(self) -> Evidence:
        """Return the course of the smallest criterion, with what was solved without a proof."""
        if not self.found:
            return Evidence.pointless(Status.FAILED, self.failed)
        bic: dict[str, float] = {}
        for value, fit, _ in self.found:
            bic[fit.prior] = min(value, bic.get(fit.prior, np.inf))
        _, best, solution = min(self.found, key=lambda fit: fit[0])
        gap, failed = max(self.gaps, default=float("inf")), self.failed
        if not gap < PROVED:
            failed = failed or f"a programme was solved without a proof, relative gap {gap:.1e}"
        best = replace(best, bic=bic, gap=gap, certified=not failed, status=failed)
        figures: dict[str, Any] = {"prior": best.prior, "degrees of freedom": best.freedom, "largest relative gap": gap}
        evidence = Evidence.of(solution, best, figures)
        return replace(evidence, status=Status.INACCURATE, reason=failed) if failed else evidence
