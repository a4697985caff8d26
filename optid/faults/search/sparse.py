"""The group-sparse programme: its atoms, and its result, active candidates and those that are certainly zero.

The atoms are orthonormal axes of the signature of every candidate at every tested onset. The magnitudes of the result
are shrunk, and neighbouring onsets share one fault: it selects onsets for the exact search
(`optid.faults.search.subsets`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.search.scanning import Scan
from optid.faults.search.sweeps import inverse_roots

if TYPE_CHECKING:
    from optid.core.problem import Problem
    from optid.faults.false_alarms import Thresholds
    from optid.program.solution import Solution

REACH = 10  # onsets on either side of an active one that are searched exactly, for every candidate
MOST = 40_000_000  # largest number of values of the atoms of a window


@dataclass(frozen=True, eq=False)
class Atoms:
    """The atoms of one candidate."""

    label: str  # of the candidate
    onsets: np.ndarray  # (T,) those that are tested
    axes: Array  # (T, N l, d) orthonormal columns; zero ones for directions without effect
    back: Array  # (T, d, d) magnitudes = back @ coefficients of the axes
    threshold: float  # energy q above which the search raises an alarm for the candidate

    @property
    def dimension(self) -> int:
        """Number of magnitudes."""
        return self.axes.shape[2]


def atoms_of(found: Scan, limits: "Thresholds") -> tuple[Atoms, ...]:
    """Return the atoms of every tested candidate, from the search of a window and its thresholds.

    Raises:
        StructureError: thresholds of other candidates or missing for one that is tested; a window that is too long.
    """
    q = limits.of(found.labels, found.tested_anywhere)
    places = [np.flatnonzero(row) for row in found.tested]
    columns = sum(where.size * c.dimension for where, c in zip(places, found.dictionary.candidates))
    if columns * found.whitened.r.size > MOST:
        raise StructureError(f"{columns} columns of {found.whitened.r.size} readings are too many for a programme over "
                             "all onsets: use a shorter window, or scan fewer onsets (scan(..., onsets=...)).")
    made = []
    for candidate, where, threshold in zip(found.dictionary.candidates, places, q):
        if not where.size:
            continue
        traces = np.stack([found.signature(candidate, int(onset)) for onset in where])
        flat = traces.reshape(where.size, found.whitened.r.size, -1)
        products = np.einsum("tkp,tkq->tpq", flat, flat)
        largest = np.asarray(np.linalg.eigvalsh(products)[:, -1], dtype=float)
        back = np.swapaxes(inverse_roots(products, largest), 1, 2)
        made.append(Atoms(candidate.label, where, flat @ back, back, float(threshold)))
    return tuple(made)


@dataclass(frozen=True, eq=False)
class ActiveGroup:
    """One active candidate at one onset."""

    label: str  # of the candidate
    onset: int  # first sample that it changes
    size: Array  # (d,) magnitudes, shrunk by the penalty: not an estimate
    deflection: float  # norm of the whitened signature, shrunk, too


@dataclass(frozen=True, eq=False)
class SparseResult:
    """The optimum of the group-sparse programme.

    Attributes:
        active: groups that are not zero, largest deflection first.
        count: samples of the window.
        objective: value reached.
        bound: lower bound on it, recomputed from a feasible dual point.
        gap: their relative distance.
        certified: whether the gap is below 1e-6; otherwise the result is not conclusive.
        largest: smallest penalty at which nothing is active; above one exactly when the search raises an alarm.
        penalty: the one used; one by default, at which "something is active" is the alarm.
        provably_zero: {label: (N,) whether the candidate at that onset is zero in every optimum}; False where it is
            not tested.
        status: status of the solver in words.
        solver: its name.
        constrained: names of further constraints.
    """

    active: tuple[ActiveGroup, ...]
    count: int
    objective: float
    bound: float
    gap: float
    certified: bool
    largest: float
    penalty: float
    provably_zero: Mapping[str, np.ndarray] = field(repr=False)
    status: str = ""
    solver: str = ""
    constrained: tuple[str, ...] = ()

    @property
    def alarm(self) -> bool:
        """Whether zero is not the optimum: exactly where the search alarms, whatever the tolerance of the solver."""
        return bool(self.active) if self.constrained else self.largest > self.penalty

    @property
    def labels(self) -> tuple[str, ...]:
        """Candidates that are active somewhere."""
        return tuple(dict.fromkeys(group.label for group in self.active))

    @property
    def onsets(self) -> np.ndarray:
        """Active onsets, in order."""
        return np.unique([group.onset for group in self.active]).astype(int)

    @property
    def magnitudes(self) -> dict[tuple[str, int], Array]:
        """Magnitudes by candidate and onset, shrunk by the penalty."""
        return {(group.label, group.onset): group.size for group in self.active}

    @property
    def clusters(self) -> tuple[tuple[int, int], ...]:
        """First and last onset of every run of active onsets not more than twice `REACH` apart."""
        runs = np.split(self.onsets, np.flatnonzero(np.diff(self.onsets) > 2 * REACH) + 1)
        return tuple((int(run[0]), int(run[-1])) for run in runs if run.size)

    def near(self, reach: int = REACH) -> np.ndarray:
        """Return the mask (N,) of the onsets within reach of an active one."""
        return np.any(np.abs(np.arange(self.count)[:, None] - self.onsets) <= reach, axis=1)

    @classmethod
    def of(cls, stated: "Problem", solution: "Solution", atoms: Sequence[Atoms], count: int) -> "SparseResult":
        """Read the solution for a window of some samples; groups that rounding has left of zeros are zeros."""
        (misfit, _), penalty, bound = stated.terms, stated.weights["lambda"], solution.bound
        problem = misfit.lifted
        certified = solution.has_point and not solution.doubt
        zero = np.zeros(problem.weights.size, dtype=bool)
        if certified and not stated.constraint_names and bound is not None and bound.multipliers is not None:
            zero = problem.certainly_zero(bound.multipliers, solution.objective - bound.value, penalty)
        active: list[ActiveGroup] = []
        masks = {atom.label: np.zeros(count, dtype=bool) for atom in atoms}
        norms = np.concatenate([np.linalg.norm(solution.values[name], axis=1) for name in stated.start]
                               ) if solution.has_point else np.zeros(problem.weights.size)
        floor = 1e-6 * max(float(norms.max()), float(np.sqrt(2 * stated.scale)) * 1e-3)
        first = 0
        for atom in atoms:
            here = slice(first, first + atom.onsets.size)
            masks[atom.label][atom.onsets] = zero[here]
            for t in np.flatnonzero((norms[here] > floor) & ~zero[here]):
                size = atom.back[t] @ np.asarray(solution.values[f"a[{atom.label}]"])[t]
                active.append(ActiveGroup(atom.label, int(atom.onsets[t]), size, float(norms[here][t])))
            first += atom.onsets.size
        active.sort(key=lambda group: -group.deflection)
        return cls(tuple(active), count, solution.objective, -np.inf if bound is None else bound.value, solution.gap,
                   certified, problem.largest(), penalty, masks, f"{solution.status}: {solution.reason}".rstrip(": "),
                   solution.solver, stated.constraint_names)

    def __str__(self) -> str:
        """Print the active groups, the gap and the number of zero groups."""
        zero = sum(int(mask.sum()) for mask in self.provably_zero.values())
        tested = "certified" if self.certified else "not certified"
        lines = [f"group-sparse programme, penalty {self.penalty:g}: "
                 f"{len(self.active)} groups active in {len(self.clusters)} clusters",
                 f"relative duality gap {self.gap:.1e} ({tested}); {zero} groups are zero for certain"]
        for group in self.active[:12]:
            lines.append(f"  {group.label[:50]:<52}{group.onset:>6}   deflection {group.deflection:.3g}")
        if len(self.active) > 12:
            lines.append(f"  and {len(self.active) - 12} more")
        if not self.certified:
            lines.append(f"  {self.status}"[:80])
        return "\n".join([*lines, "Magnitudes are shrunk: search these onsets exactly (polish)."])
