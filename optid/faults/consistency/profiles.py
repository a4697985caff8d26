"""The course of one fault over time: result, and the regression it is estimated from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, StructureError
from optid.faults.consistency.waveforms import waveform_matrix
from optid.faults.search.scanning import ALIKE, Scan
from optid.faults.search.subsets import exchange_search
from optid.faults.signatures import Candidate

PRIORS = {"tv": "steps: constant between changes", "trend": "ramps: straight between bends", "smooth": "a random walk"}
"""Priors of the course."""

EACH = 2
"""Degrees of freedom of a change: its size and its place."""

LONGEST = 2000
"""Samples of a window at most."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The course of a fault.

    Attributes:
        label: of the candidate.
        course: (N,) in the units of its magnitude (share lost for a loss); zero before its first change.
        std: (N,) standard deviation of the course, given where it changes.
        prior: "tv", "trend" or "smooth".
        changes: {sample: step of the course, or of its slope}; empty for "smooth".
        bic: {prior: smallest value of the Bayesian information criterion}.
        freedom: degrees of freedom of the course.
        gap: largest relative duality gap among the programmes behind it.
        certified: whether all of them were solved with a proof.
        constraints: names of its constraints.
        status: the reason where it is not certified.
    """

    label: str
    course: Array = field(repr=False)
    std: Array = field(repr=False)
    prior: str
    changes: Mapping[int, float]
    bic: Mapping[str, float]
    freedom: float
    gap: float
    certified: bool
    constraints: tuple[str, ...] = ()
    status: str = ""

    def __str__(self) -> str:
        values = ", ".join(f"{prior} {value:.1f}" for prior, value in self.bic.items())
        lines = [f"course of {self.label[:60]}: {PRIORS[self.prior]}",
                 f"  BIC {values}; {self.freedom:.3g} degrees of freedom; largest gap {self.gap:.1e}"]
        word = "changes by" if self.prior == "tv" else "slope changes by"
        lines += [f"  sample {k:>6}: {word} {amount:.4g}, to {self.course[k]:.4g} there"
                  for k, amount in list(self.changes.items())[:12]]
        if not self.certified:
            lines.append(f"  not certified: {self.status}"[:80])
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class CourseProblem:
    """Regression of a window on the course of one fault; `course_problem` makes it."""

    label: str  # of the candidate
    matrix: Array  # (N l, N) signatures of unit courses in single samples
    r: Array  # (N l,) the window
    readings: int  # number of readings

    @property
    def count(self) -> int:
        """Samples N."""
        return self.matrix.shape[1]

    @cached_property
    def shapes(self) -> dict[str, Array]:
        """The courses (N, N) of a unit change at every sample, by the prior: steps, or ramps over the window."""
        steps = np.tril(np.ones((self.count, self.count)))
        return {"tv": steps, "trend": np.cumsum(steps, axis=0) / self.count}

    @cached_property
    def design(self) -> dict[str, Array]:
        """The effects (N l, N) of these on the window."""
        return {prior: self.matrix @ courses for prior, courses in self.shapes.items()}

    @property
    def differences(self) -> Array:
        """(N, N) what gives the steps of a course, the first from zero."""
        return np.eye(self.count) - np.eye(self.count, k=-1)

    def refit(self, columns: Array) -> tuple[Array, float]:
        """Return the least-squares coefficients of columns (N l, K) and the residual energy."""
        solved = np.linalg.lstsq(columns, self.r, rcond=1e-10)[0]
        rest = self.r - columns @ solved
        return np.asarray(solved, dtype=float), float(rest @ rest)

    def criterion(self, energy: float, freedom: float) -> float:
        """Return the Bayesian information criterion for innovations of known variance."""
        return energy + freedom * float(np.log(self.readings))

    def prune(self, columns: Array, support: np.ndarray) -> np.ndarray:
        """Return the changes left of a support by backward elimination as long as the criterion falls.

        The columns (N l, N) are those of all changes.
        """
        kept = list(support)
        best = self.criterion(self.refit(columns[:, kept])[1], EACH * len(kept)) if kept else np.inf
        while len(kept) > 1:
            q, triangle = np.linalg.qr(columns[:, kept])
            try:
                inverse = np.linalg.inv(triangle)
            except np.linalg.LinAlgError:  # two indistinguishable changes: drop either
                kept.pop(int(np.argmin(np.abs(np.diag(triangle)))))
                continue
            solved = inverse @ (q.T @ self.r)
            loss = solved**2 / np.sum(inverse**2, axis=1)  # increase of the energy without each of them
            weakest = int(np.argmin(loss))
            trial = kept[:weakest] + kept[weakest + 1 :]
            value = self.criterion(self.refit(columns[:, trial])[1], EACH * len(trial))
            if value > best:
                break
            kept, best = trial, value
        return np.array(kept, dtype=int)

    def move_changes(self, columns: Array, kept: np.ndarray) -> np.ndarray:
        """Move every change to its best sample beside the others, until none moves; arguments as of `prune`."""
        sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        unit = columns / sizes

        def best_beside(others: Sequence[tuple[int, int]]) -> tuple[float, tuple[int, int]]:
            axes, values, _ = np.linalg.svd(unit[:, [k for _, k in others]], full_matrices=False)
            axes = axes[:, values > np.sqrt(ALIKE)]
            along, shared = axes.T @ self.r, axes.T @ unit
            left = np.sum(unit**2, axis=0) - np.sum(shared**2, axis=0)
            energies = np.full(self.count, -np.inf)
            np.divide((unit.T @ (self.r - axes @ along)) ** 2, left, out=energies, where=left > ALIKE)
            k = int(np.argmax(energies))
            return float(along @ along + energies[k]), (0, k)

        _, found = exchange_search([(0, int(k)) for k in kept], -1.0, best_beside)
        return np.unique([k for _, k in found]).astype(int)


def course_problem(found: Scan, label: str) -> CourseProblem:
    """Return the regression of the course of one candidate with one magnitude, from the search of the window.

    Raises:
        DataError: it has no effect in the window.
        StructureError: a candidate with several magnitudes or of noise, a window that is too long.
    """
    candidate: Candidate = found.dictionary[label]
    if candidate.fault_kind.without_course:
        raise StructureError(f"{candidate.label}: {candidate.fault_kind.without_course}.")
    if candidate.dimension != 1 or candidate.into_state.shape[1] != 1:
        raise StructureError(
            f"{candidate.label} has several magnitudes: a profile is the course of one. Take the bias or the loss of "
            "the channel, or a direction process={...} of the state.")
    count = len(found.whitened.r)
    if count > LONGEST:
        raise StructureError(f"{count} samples are too many for a profile ({LONGEST}): use a shorter window.")
    if candidate.fault_kind.driven and found.u is None:
        raise StructureError(f"{candidate.label}: its course depends on the input: scan the window with u.")
    matrix = waveform_matrix(found.dictionary, candidate, found.whitened, u=found.u)
    if not np.abs(matrix).max(initial=0.0) > 0:
        raise DataError(f"{candidate.label}: untestable, it has no effect in this window.")
    return CourseProblem(candidate.label, matrix, found.whitened.r.ravel(), int(found.whitened.present.sum()))
