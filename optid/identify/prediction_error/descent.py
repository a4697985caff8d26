"""Levenberg-Marquardt descents on a sum of squared errors, and comparison of starts.

The scaling is that of Moré (1978); the damping follows the ratio of the gain reached to the gain expected as in Nielsen
(Damping parameter in Marquardt's method, IMM-REP-1999-05, 1999): steady where steps are refused in turn.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.identify.prediction_error.criterion import Criterion
from optid.statistics.linearised import Linearised

STATIONARY = 1e-12  # share of the sum of squares that a full step would still gain, below which a descent has arrived
EXACT = 1e-24  # sum of squared errors, as a share of the energy of the record, that counts as zero
STEPS = 100

CREEPING = 5  # steps over which progress is measured
# relative gain of a full step, and relative fall over so many steps, below which a descent in a flat valley has arrived
FLAT, CREPT = 1e-8, 1e-10
# relative gain of a full step below which a start counts as arrived; only the best of them descends further
COMPARED = 1e-6
# damping, relative to the squared sensitivities, below which the normal equations lose too many digits: use QR
DAMPED = 1e-7
# damping that remains where errors are nonlinear in the states: a Gram matrix then serves all steps but the last
GRAM = 1e-14
AGREE = 1e-4  # relative difference of the sums of squares within which two starts have arrived at the same optimum
# share of the energy of the record left unexplained at an agreed optimum up to which other optima are not looked for:
# where noise is larger than that, starts of different methods have been seen to agree on an optimum that is not best
EXPLAINED = 0.1
BETTER = 2.0  # times the errors' energy that a local optimum may have of that at the border of stability, and win
ROUNDING = 1e-9  # relative difference of two sums of squares that were added up in different ways
BORDER = ("the errors still fall towards a pole, or a zero of C, on the unit circle; choose other orders, or a "
          "constraint such as integrator (a pole at 1) or stable:0.999")


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a descent arrived."""

    x: Array  # the unknowns
    at: Linearised  # the errors there
    steps: int  # number of linearisations
    converged: bool  # whether a full step would gain no more than `STATIONARY`
    reason: str = ""  # why it stopped where it did not converge
    start: str = ""  # name of the start it came from
    border: bool = False  # whether it stopped because every better point is inadmissible

    @property
    def value(self) -> float:
        """Sum of squared errors."""
        return self.at.value

    @property
    def rank(self) -> float:
        """By what ends are compared, the smallest first.

        At the border of stability there is no local optimum: an unstable model would be better still. A plant that
        integrates has its best model there, though, and what is left as local optima may be useless.
        """
        return BETTER * self.value if self.border else self.value


def descend(criterion: Criterion, x: Array, *, held: Array | None = None, iterations: int = STEPS,
            tolerance: float = STATIONARY, progress: float = 0.0, start: str = "") -> Descent:
    """Lower the sum of squares from a point by Levenberg-Marquardt steps; every iterate is admissible.

    Args:
        criterion: the errors.
        x: an admissible start.
        held: (p,) marks of shared unknowns that stay.
        iterations: at most.
        tolerance: relative gain of a full step below which it stops.
        progress: relative fall over `CREEPING` steps below which it stops, too.
        start: name for the record.
    """
    x = criterion.normalise(x)
    at = criterion.linearise(x)
    if not np.isfinite(at.value):
        return Descent(x, at, 0, False, "the run leaves its range", start, True)
    p = len(at.pull)
    free = np.ones(p, dtype=bool) if held is None else np.logical_not(held)
    moving = np.concatenate([free, np.ones(x.size - p, dtype=bool)]) if criterion.bends else free
    scale, least = np.zeros(int(moving.sum())), EXACT * criterion.energy
    damping, growth, rejected, blocked, values = 1e-3, 2.0, 0, False, [at.value]
    for count in range(1, iterations + 1):
        gain = _gain(at.root[:, free], at)
        if gain <= tolerance * at.value and not at.exact:
            at = criterion.linearise(x)
            gain = _gain(at.root[:, free], at)
        fall = values[-1 - CREEPING] - at.value if len(values) > CREEPING else np.inf
        crept = gain <= FLAT * at.value and fall <= CREPT * at.value
        if crept or gain <= tolerance * at.value or at.value <= least:
            return Descent(x, at, count, True, start=start)
        matrix, errors = at.whole if criterion.bends else (at.root, at.pull)
        scale = np.maximum(scale, np.linalg.norm(matrix[:, moving], axis=0))
        step = np.zeros(len(moving))
        step[moving] = _damped(matrix[:, moving], errors, np.where(scale > 0, scale, 1.0), damping)
        expected = at.reach - float(np.sum((matrix @ step + errors) ** 2))
        whole = step if criterion.bends else np.concatenate([step, at.follow(step)])
        moved = criterion.normalise(x + whole)
        allowed = criterion.admissible(moved)
        new = None
        if allowed and criterion.value(moved) < (1 + ROUNDING) * at.value:  # most steps that fail are told by the value
            new = criterion.linearise(moved, "gram" if criterion.bends or damping > DAMPED else "auto")
        ratio = (at.value - new.value) / max(expected, 1e-300) if new is not None else -1.0
        if new is not None and ratio > 1e-3 and np.isfinite(new.value):
            x, at, rejected, blocked = moved, new, 0, False
            damping, growth = damping * max(0.1, 1 - (2 * ratio - 1) ** 3) if ratio < 1.5 else 0.3 * damping, 2.0
            damping = damping if damping > 1e-14 else GRAM if criterion.bends else 0.0
            values.append(at.value)
            if values[-1] > (1 - progress) * values[-1 - CREEPING :][0] and len(values) > CREEPING:
                return Descent(x, at, count, False, f"{CREEPING} steps gain less than {progress:g}", start)
            continue
        rejected, blocked = rejected + 1, blocked or not allowed
        damping, growth = max(growth * damping, 1e-8), 2 * growth
        if rejected > 20 or damping > 1e12:
            # at this size of the gain rounding decides whether a step descends
            settled = gain <= 1e3 * tolerance * at.value or at.value <= 1e4 * least
            # what a descent creeps along without arriving is the border of the admissible set, also between refusals
            reason = BORDER if blocked and not settled else "no step descends"
            return Descent(x, at, count, settled, reason, start, not settled)
    return Descent(x, at, iterations, False, f"{iterations} steps did not suffice", start)


def _damped(matrix: Array, errors: Array, weights: Array, damping: float) -> Array:
    """Return the step that lowers ``|matrix step + errors|² + damping |weights step|²`` most."""
    p = len(weights)
    stacked = np.vstack([np.column_stack([matrix / weights, -errors]), np.sqrt(damping) * np.eye(p, p + 1)])
    if damping < GRAM:
        return np.linalg.lstsq(stacked[:, :p], stacked[:, p], rcond=1e-15)[0] / weights
    root: Any = np.linalg.qr(stacked, mode="r")  # several times as fast
    return np.linalg.solve(root[:p, :p], root[:p, p]) / weights


def _gain(root: Array, at: Linearised) -> float:
    """By how much a full undamped step over the free unknowns would lower the sum of squares of the linear model."""
    size = np.linalg.norm(root, axis=0)
    used = root[:, size > 0] / size[size > 0]
    basis, triangle = np.linalg.qr(used)
    diagonal = np.abs(np.diag(triangle))
    if diagonal.size and np.min(diagonal) <= 1e-12:  # columns that add no direction must not add their rounding
        basis = np.linalg.svd(used, full_matrices=False)[0][:, : np.linalg.matrix_rank(triangle, tol=1e-12)]
    return float(np.sum((basis.T @ at.pull) ** 2)) + at.reach - float(at.pull @ at.pull)


def with_poles(criterion: Criterion, x: Array, a: Array) -> Descent:
    """Return what belongs to a given stable A: the rest of the unknowns after a few steps with A held."""
    moved = x.copy()
    moved[criterion.unknowns.slices["a"]] = a
    return beside_poles(criterion, moved, iterations=6, tolerance=1e-3)


def beside_poles(criterion: Criterion, x: Array, **limits: Any) -> Descent:
    """Descend with the poles of x held, up to limits of `descend`."""
    held = np.zeros(criterion.unknowns.shared, dtype=bool)
    held[criterion.unknowns.slices[criterion.dynamics]] = True
    return descend(criterion, x, held=held, **limits)


def best_of(criterion: Criterion, starts: Iterable[tuple[str, Array]], iterations: int = STEPS, *,
            enough: int | None = None) -> list[Descent]:
    """Descend from every start; the best comes first, see `Descent.rank`.

    Starts are (name, point) pairs, which may be estimated as they are asked for: no more than ``enough`` of them where
    all of these ended at the same optimum and it leaves little of the record unexplained.
    """
    found: list[Descent] = []
    for name, x in starts:
        if criterion.admissible(x):
            found.append(descend(criterion, x, iterations=iterations, tolerance=COMPARED, start=name))
            found.sort(key=lambda one: one.rank)
        if len(found) == enough and not any(one.border for one in found) and (
                found[0].value <= EXPLAINED * criterion.energy):
            if agreement(found, 1e-12 * criterion.energy)[0] == enough:
                break
    return found


def agreement(found: Sequence[Descent], floor: float) -> tuple[int, str]:
    """Return how many descents share the best value, and a sentence that says so."""
    best = found[0]
    same = [one for one in found if abs(one.value - best.value) <= AGREE * best.value + floor]
    sentence = f"{len(same)} of {len(found)} starts converge to it ({', '.join(one.start for one in same)})"
    out = [one for one in found if one.border and one not in same and one.value < best.value]
    return len(same), sentence + (f"; {len(out)} with a smaller error end at the border of stability" if out else "")
