"""Gauss-Newton for simulation and prediction errors: damped steps without constraints, convex programmes with them.

Without constraints a step is a damped least-squares problem of the size of the unknowns (Levenberg-Marquardt in the
scaling of Moré 1978). With constraints every step is a `Program` of the same layer, which any back end for its class
can solve: the linearised errors, the user's constraints in the tangent of the current iterate, and, after a step that
our own figures refuse, a quadratic damping term. Whatever the constraints, the last programme is undamped, posed at
the final iterate, and solved by the back end that was asked for: that it offers no better point is what "locally
optimal" means here.
"""

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from optid.errors import StructureError
from optid.program.judging import measure_violation
from optid.program.program import Program
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence
from optid.statistics.linearised import Linearised

Array = np.ndarray

STATIONARY = 1e-12
"""Share of the sum of squares that a full step would still gain, below which an unconstrained descent has arrived."""

CONFIRMED = 1e-8
"""The same share as measured through a back end, whose accuracy limits it."""

EXACT = 1e-24
"""Sum of squared errors, as a share of the energy of the record, that counts as zero."""

STALLED = 1e-5
"""Share that counts as nothing where programme after programme promises as little: a curved boundary is followed."""

INSIDE = 1e-6
"""Relative violation up to which a point satisfies the constraints."""

NOWHERE = 1e-9
"""Relative violation that is rounding; a step to more than that pays for it."""

PATIENCE = 5
"""Undamped programmes in all that may promise no more than `STALLED` before it counts as nothing."""

PARTS = 10
"""Halvings of an undamped step that are tried where no damped one descends."""

STEPS = 100

COMPARED = 1e-6
"""Relative gain of a full step below which a start counts as arrived; only the best of them descends further."""

AGREE = 1e-4
"""Relative difference of the sums of squares within which two starts have arrived at the same optimum."""

EXPLAINED = 0.1
"""Share of the energy of the record left unexplained at an agreed optimum up to which other optima are not looked for:
where noise is larger than that, starts of different methods have been seen to agree on an optimum that is not best."""

BORDER = ("the errors still fall towards a pole, or a zero of C, on the unit circle; choose other orders, or a "
          "constraint such as stable:0.999")

NO_BOUND = "the {} are not convex in poles and zeros: no lower bound is known, several starts are compared"


class Criterion(Protocol):
    """A sum of squared errors in a vector x of unknowns, of which the last ones are initial states."""

    @property
    def errors(self) -> str:
        """Their name: "simulation errors" or "prediction errors"."""
        ...

    @cached_property
    def energy(self) -> float:
        """Sum of squares of the record about its mean."""
        ...

    def linearise(self, x: Array) -> Linearised:
        """Return the errors near x."""
        ...

    def admissible(self, x: Array) -> bool:
        """Whether the errors exist at x: its filters are stable."""
        ...

    def normalised(self, x: Array) -> Array:
        """Return the same model in its gauge."""
        ...


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a descent arrived.

    Attributes:
        x: the unknowns.
        at: the errors there.
        steps: number of linearisations.
        converged: whether a full step would gain no more than `STATIONARY`.
        reason: why it stopped where it did not converge.
        start: name of the start it came from.
        border: whether it stopped because every better point is inadmissible.
    """

    x: Array
    at: Linearised
    steps: int
    converged: bool
    reason: str = ""
    start: str = ""
    border: bool = False

    @property
    def value(self) -> float:
        """Sum of squared errors."""
        return self.at.value


def descend(criterion: Criterion, x: Array, *, held: Array | None = None, iterations: int = STEPS,
            tolerance: float = STATIONARY, start: str = "") -> Descent:
    """Lower the sum of squares from a point by Levenberg-Marquardt steps; every iterate is admissible.

    Args:
        criterion: the errors.
        x: an admissible start.
        held: (p,) marks of shared unknowns that stay.
        iterations: at most.
        tolerance: relative gain of a full step below which it stops.
        start: name for the record.
    """
    x = criterion.normalised(x)
    at = criterion.linearise(x)
    p = len(at.pull)
    free = np.ones(p, dtype=bool) if held is None else ~held
    scale, least = np.zeros(int(free.sum())), EXACT * criterion.energy
    damping, rejected, blocked = 1e-3, 0, False
    for count in range(1, iterations + 1):
        root = at.root[:, free]
        gain = _gain(root, at)
        if gain <= tolerance * at.value or at.value <= least:
            return Descent(x, at, count, True, start=start)
        scale = np.maximum(scale, np.linalg.norm(root, axis=0))
        weights = np.where(scale > 0, scale, 1.0)
        step = np.zeros(p)
        stacked = np.vstack([root / weights, np.sqrt(damping) * np.eye(len(scale))])
        pull = np.concatenate([-at.pull, np.zeros(len(scale))])
        step[free] = np.linalg.lstsq(stacked, pull, rcond=1e-15)[0] / weights
        moved = criterion.normalised(np.concatenate([x[:p] + step, x[p:] + at.follow(step)]))
        expected = at.reach - float(np.sum((at.root @ step + at.pull) ** 2))
        new = criterion.linearise(moved) if criterion.admissible(moved) else None
        ratio = (at.value - new.value) / max(expected, 1e-300) if new is not None else -1.0
        if new is not None and ratio > 1e-3 and np.isfinite(new.value):
            x, at, rejected, blocked = moved, new, 0, False
            damping = 0.1 * damping if ratio > 0.5 else damping * (1.0 if ratio > 0.25 else 4.0)
            damping = damping if damping > 1e-14 else 0.0
            continue
        rejected, blocked = rejected + 1, blocked or new is None
        damping = max(8.0 * damping, 1e-6)
        if rejected > 20 or damping > 1e12:
            # at this size of the gain rounding decides whether a step descends
            settled = gain <= 1e3 * tolerance * at.value or at.value <= 1e4 * least
            # what a descent creeps along without arriving is the border of the admissible set, also between refusals
            reason = BORDER if blocked and not settled else "no step descends"
            return Descent(x, at, count, settled, reason, start, not settled)
    return Descent(x, at, iterations, False, f"{iterations} steps did not suffice", start)


def _gain(root: Array, at: Linearised) -> float:
    """By how much a full undamped step over the free unknowns would lower the sum of squares of the linear model."""
    size = np.linalg.norm(root, axis=0)
    used = root[:, size > 0] / size[size > 0]
    basis, triangle = np.linalg.qr(used)
    diagonal = np.abs(np.diag(triangle))
    if diagonal.size and np.min(diagonal) <= 1e-12:  # columns that add no direction must not add their rounding
        basis = np.linalg.svd(used, full_matrices=False)[0][:, : np.linalg.matrix_rank(triangle, tol=1e-12)]
    return float(np.sum((basis.T @ at.pull) ** 2)) + at.reach - float(at.pull @ at.pull)


def best_of(criterion: Criterion, starts: Iterable[tuple[str, Array]], iterations: int = STEPS, *,
            enough: int | None = None) -> list[Descent]:
    """Descend from every start; the best comes first, those that end at the border of stability last.

    There they are no local optima: an unstable model would be better still.

    Args:
        criterion: the errors.
        starts: (name, point) pairs; they may be estimated as they are asked for.
        iterations: at most, for each.
        enough: number of starts after which, when all of them ended at the same optimum and it leaves little of the
            record unexplained, no more are asked for.
    """
    found: list[Descent] = []
    for name, x in starts:
        if criterion.admissible(x):
            found.append(descend(criterion, x, iterations=iterations, tolerance=COMPARED, start=name))
            found.sort(key=lambda one: (one.border, one.value))
        if len(found) == enough and not any(one.border for one in found) and (
                found[0].value <= EXPLAINED * criterion.energy):
            if agreement(found, 1e-12 * criterion.energy)[0] == enough:
                break
    return found


def agreement(found: Sequence[Descent], floor: float) -> tuple[int, str]:
    """Return how many descents share the best value, and a sentence that says so."""
    best = found[0]
    same = [one for one in found if abs(one.value - best.value) <= AGREE * best.value + floor]
    sentence = f"{len(same)} of {len(found)} starts arrive there ({', '.join(one.start for one in same)})"
    out = [one for one in found if one.border and one not in same and one.value < best.value]
    return len(same), sentence + (f"; {len(out)} with a smaller error end at the border of stability" if out else "")


@dataclass(frozen=True)
class Posed:
    """What the constrained iteration needs to know of a model.

    Attributes:
        criterion: the errors, in the gauge of the programme.
        pose: (x, errors near x, damping) -> the programme of one step, with the user's constraints.
        pack: values of the programme's variables -> x.
        model: x -> model.
        unit: what one unit of the sum of squares is in units of the record.
    """

    criterion: Criterion
    pose: Callable[[Array, Linearised, float], Program]
    pack: Callable[[Mapping[str, Array]], Array]
    model: Callable[[Array], Any] = field(repr=False)
    unit: float = 1.0


def refine(posed: Posed, found: Descent, figures: Mapping[str, Any], x: Array | None = None
           ) -> Generator[Program, Solution, Evidence | None]:
    """Bring a descent to a point that a back end confirms, under the constraints of the programmes.

    Args:
        posed: the model.
        found: the unconstrained optimum.
        figures: what is known already; returned with the evidence.
        x: where to start under constraints; the optimum itself where None.

    Returns:
        The evidence, or None where a programme has no point: its status says why.
    """
    here = _Iterate.of(posed, found.x if x is None else x)
    figures = {**figures, "Gauss-Newton steps": found.steps}
    if here.program.user_constraints:
        return (yield from _constrained(posed, here, figures))
    solution = yield here.program
    if not solution.has_point:
        return None
    gain = here.at.value - _quadratic(here.at, posed.pack(solution.values) - here.x)
    status, reason = _judged(solution, gain, here.at.value, criterion_floor(posed.criterion))
    if not found.converged:
        status, reason = Status.LIMIT, found.reason
    return _evidence(posed, here, status, reason, {**figures, "programmes": 1})


@dataclass(frozen=True, eq=False)
class _Iterate:
    x: Array
    at: Linearised
    program: Program
    outside: float  # largest violation, relative
    amount: float  # sum of the absolute violations of the user's constraints

    @classmethod
    def of(cls, posed: Posed, x: Array) -> "_Iterate":
        x = posed.criterion.normalised(x)
        at = posed.criterion.linearise(x)
        program = posed.pose(x, at, 0.0)
        if not program.user_constraints:
            return cls(x, at, program, 0.0, 0.0)
        program.assign(program.view.reference)
        outside = measure_violation(program)[0]
        amount = sum(float(np.sum(np.abs(np.asarray(member.violation()))))
                     for group in program.user_constraints.values() for member in group)
        return cls(x, at, program, outside, amount if outside > NOWHERE else 0.0)

    def merit(self, weight: float) -> float:
        return self.at.value + weight * self.amount


def _reached(posed: Posed, x: Array) -> _Iterate | None:
    """Return the iterate at x, None where it is inadmissible or its gauge cannot be reached."""
    try:
        return _Iterate.of(posed, x) if posed.criterion.admissible(x) else None
    except StructureError:
        return None


def _constrained(posed: Posed, here: _Iterate, figures: Mapping[str, Any]
                 ) -> Generator[Program, Solution, Evidence | None]:
    """Solve tangent programmes until an undamped one gains nothing; an exact penalty judges the steps."""
    floor = criterion_floor(posed.criterion)
    previous: _Iterate | None = None
    damping, growth, weight, last, idle, more = 0.0, 4.0, 0.0, np.inf, 0, 0
    entered = here.outside <= INSIDE  # figures are compared from the first point that satisfies the constraints
    for count in range(1, STEPS + 1):
        solution = yield here.program if not damping else posed.pose(here.x, here.at, damping)
        if not solution.has_point:
            if (solution.status is Status.INFEASIBLE and previous is None) or damping > 1e3:
                return None
            if solution.status is Status.INFEASIBLE and previous is not None:
                here, previous = previous, None
            damping = max(100.0 * damping, 1e-6)  # a nearer point, and a better conditioned programme
            continue
        reached = posed.pack(solution.values)
        gain = here.at.value - _quadratic(here.at, reached - here.x)
        weight = max(weight, 2.0 * _largest_dual(here.program, solution))
        new = _reached(posed, reached)
        idle += not damping and abs(gain) <= STALLED * here.at.value
        share = CONFIRMED if abs(gain) < 0.5 * last and idle <= PATIENCE else STALLED
        last = abs(gain) if not damping else last
        if not damping and abs(gain) <= share * here.at.value + floor and here.outside <= INSIDE:
            status, reason = _judged(solution, gain, here.at.value, floor, share)
            best = here if new is None or new.outside > INSIDE else new
            return _evidence(posed, best, status, reason, {**figures, "programmes": count + more})
        expected = gain + weight * here.amount
        fall = here.merit(weight) - new.merit(weight) if new is not None else -np.inf
        if new is not None and (not entered or fall >= 1e-3 * expected or abs(fall) <= 1e-12 * here.merit(weight)):
            previous, here, growth = here, new, 4.0
            entered = entered or new.outside <= INSIDE
            damping *= 0.1 if fall > 0.5 * expected else 1.0
        else:
            damping, growth = max(growth * damping, 1e-7), 2.0 * growth
            if damping > 1e10:
                shorter, more = (yield from _shortened(posed, here, weight)), more + 1
                if shorter is not None:
                    previous, here, damping, growth = here, shorter, 0.0, 4.0
                    entered = entered or here.outside <= INSIDE
                    continue
                reason = f"no step descends; the last undamped one promised {last / here.at.value:.0e} of the value"
                return (yield from _ended(posed, here, reason, {**figures, "programmes": count + more + 1}))
        if damping < 1e-10 or (fall >= 0 and gain <= STALLED * here.at.value):
            damping = 0.0  # only an undamped programme can confirm
    reason = (f"{STEPS} programmes did not suffice; the last undamped one promised {last / here.at.value:.0e} of the "
              "value")
    return (yield from _ended(posed, here, reason, {**figures, "programmes": STEPS + more + 1}))


def _shortened(posed: Posed, here: _Iterate, weight: float) -> Generator[Program, Solution, _Iterate | None]:
    """Take a part of the undamped step: however damped, programmes end on a boundary that may be curved outwards.

    A part of the way there is off it, where the point to start from is.
    """
    solution = yield here.program
    if not solution.has_point:
        return None
    step = posed.pack(solution.values) - here.x
    for part in 0.5 ** np.arange(1, PARTS + 1):
        new = _reached(posed, here.x + part * step)
        gain = here.at.value - _quadratic(here.at, part * step)
        if new is not None and gain > 0 and here.merit(weight) - new.merit(weight) >= 1e-3 * gain:
            return new
    return None


def _ended(posed: Posed, here: _Iterate, reason: str, figures: Mapping[str, Any]
           ) -> Generator[Program, Solution, Evidence]:
    """Judge where the steps ended by one more undamped programme; it may promise what a curved boundary does."""
    solution = yield here.program
    floor = criterion_floor(posed.criterion)
    if not solution.has_point or here.outside > INSIDE:
        return _evidence(posed, here, Status.LIMIT, reason, figures)
    gain = here.at.value - _quadratic(here.at, posed.pack(solution.values) - here.x)
    if abs(gain) > STALLED * here.at.value + floor:
        return _evidence(posed, here, Status.LIMIT, reason, figures)
    return _evidence(posed, here, *_judged(solution, gain, here.at.value, floor, STALLED), figures)


def criterion_floor(criterion: Criterion) -> float:
    """Sum of squares below which differences are rounding."""
    return 1e-14 * criterion.energy


def _judged(solution: Solution, gain: float, value: float, floor: float, share: float = CONFIRMED
            ) -> tuple[Status, str]:
    """What a back end's answer to the last programme makes of its reference: it must have been solved, and stay."""
    if solution.status not in (Status.OPTIMAL, Status.LOCAL):
        return solution.status, solution.reason
    if abs(gain) > share * value + floor:
        return Status.INACCURATE, (f"{solution.solver} moves the sum of squares of the last tangent programme by "
                                   f"{abs(gain) / max(value, 1e-300):.0e} of its value")
    return Status.LOCAL, ""


def _evidence(posed: Posed, here: _Iterate, status: Status, reason: str, figures: Mapping[str, Any]) -> Evidence:
    unknown = NO_BOUND.format(posed.criterion.errors)
    bound = Bound.none(unknown)
    reason = unknown if status is Status.LOCAL else reason
    return Evidence(posed.model(here.x), posed.unit * here.at.value, bound, status, reason, figures)


def _quadratic(at: Linearised, step: Array) -> float:
    """Sum of squares of the linearised errors after a step of all unknowns."""
    matrix, errors = at.whole
    rest = matrix @ step + errors
    return float(rest @ rest) + at.remainder


def _largest_dual(program: Program, solution: Solution) -> float:
    return max((float(np.max(np.abs(solution.duals[name]), initial=0.0)) for name in program.user_constraints
                if name in solution.duals), default=0.0)
