"""From the optimum of a descent to a point that a back end confirms: programmes in the tangent of the iterate.

Without constraints one programme at the optimum suffices. With constraints every step is a convex problem, which any
back end for its class can solve: the linearised errors, the user's constraints in the tangent of the iterate, the
curvature that earlier steps have shown, and, after a step that our own figures refuse, a quadratic damping term.
Whatever the constraints, the last programme is that of the linearised errors alone, posed at the final iterate, and
solved by the back end that was asked for: that it offers no better point is what "locally optimal" means here.
"""

from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.errors import RankError, StructureError
from optid.identify.prediction_error import border
from optid.identify.prediction_error.criterion import INSIDE, criterion_of, excess, step_problem
from optid.identify.prediction_error.curvature import Curvature, measure_curvature
from optid.identify.prediction_error.descent import STEPS, Descent
from optid.identify.prediction_error.signs import input_signs, sign_variants
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure
from optid.statistics.linearised import CONDITION_LIMIT, Linearised

# share of the sum of squares that a full step may still gain, as measured through a back end, whose accuracy limits it
CONFIRMED = 1e-8
# share that counts as nothing where programme after programme promises as little: a curved boundary is followed
STALLED = 1e-6
NOWHERE = 1e-9  # relative violation that is rounding; a step to more than that pays for it
ROUNDING = 1e-14  # share of the energy of the record below which differences of sums of squares are rounding
PATIENCE = 5  # undamped programmes in all that may promise no more than `STALLED` before it counts as nothing
# accept a feasibility step if the sum of squares is at most TRUSTED times its linear prediction; with damping above
# NEAR always: it is then nearly the shortest step
TRUSTED, NEAR = 10.0, 1e-2
CONFLICT = 0.1  # share of the errors above the free optimum from which descents from other signs are worth their time
SIGNED = 60  # programmes of a descent from other signs, which goes on only where it is better
MOVED = 30  # the same of one from poles that were moved
# programmes over which the fall of such a descent is taken, and how many times this fall it is given to come near
OVER, AHEAD = 5, 10
GOING, WORTH = 4, 1e-4  # how often an end that has not arrived is gone on from, and the share of the errors that pays
# moves of poles along a border; share of the errors that one must gain, and all of them for an end to be no optimum
ROUNDS, ALONG, BETTER = 12, 1e-6, 1e-5
ALL = 20  # steps along a flat valley with all curvature, before programmes of linear errors go on
PARTS = 10  # halvings of an undamped step that are tried where no damped one descends
IN_VALLEY = "the errors still fall along a flat valley"
MEETING = "where poles meet on the border of their region the programmes have no answer, or creep"
CREEPS = ("the errors still fall as a pole nears the unit circle, where a static curve that the record contradicts "
          "costs nothing; keep poles off it, by stable:0.99 for instance")
NO_BOUND = "the {} are not convex in poles and zeros: no lower bound is known, several starts are compared"


def refine(problem: Problem, found: Descent, figures: Mapping[str, Any], x: Array) -> Procedure:
    """Bring a descent to a point that a back end confirms, under the constraints of the programmes.

    Args:
        problem: of the fit; its term is `optid.core.terms.Errors`.
        found: the unconstrained optimum.
        figures: what is known already; returned with the evidence.
        x: where to start: the optimum, in the signs that the constraints ask for, or a point nearer to them.

    Returns:
        The evidence, or None where a programme has no point: its status says why.
    """
    here = _Iterate.of(problem, x)
    if not np.isfinite(here.at.value):
        raise RankError("no start has a run that stays within its range; use another order or another basis")
    figures = {**figures, "Gauss-Newton steps": found.steps}
    if problem.constraint_names:
        # how well the record tells the unknowns: a constraint that it contradicts may end where f is all but flat
        figures["condition"] = found.at.condition
        criterion = criterion_of(problem)
        free = criterion.unit * found.value
        best = yield from _best_signed(here, free, figures)
        if best is None:
            return None
        easy = best.objective <= free * (1 + CONFLICT) and found.at.condition < CONDITION_LIMIT
        end = yield from _settled(problem, best, figures, easy)
        creeps = end.status is Status.LIMIT and border.creeps(criterion, criterion.variables.pack(end.values or {}))
        return replace(end, reason=CREEPS) if creeps else end
    solution = yield here.tangent
    if not solution.has_point:
        return None
    verdict = here.judge(solution, CONFIRMED) if found.converged else (Status.LIMIT, found.reason)
    return here.evidence(*verdict, {**figures, "programmes": 1})


def _settled(problem: Problem, end: Evidence, figures: Mapping[str, Any], easy: bool) -> Procedure:
    """Go on from an end while another way lowers the errors: along flat valleys, or with poles along their border.

    An easy end is near the free optimum, where the record tells all unknowns: only poles on a border make it flat.
    Where two poles all but meet there, programmes have no answer any more; the errors as a function of these two, with
    everything else fitted, then say that a point is the best one near it, if nothing else is constrained.
    """
    criterion = criterion_of(problem)
    depth, tried = border.about_poles(problem.builders), False
    alone = all("poles" in getattr(rule, "about", ()) for rule in problem.builders)
    for _ in range(ROUNDS):
        if end.status not in (Status.LOCAL, Status.LIMIT, Status.INACCURATE):
            break
        best = before = criterion.variables.pack(end.values or {})
        if depth is not None:
            best = border.along_border(criterion, depth, before, ALONG, alone)
            if not alone:
                moved = border.with_double_pole(criterion, depth, before), best
                best = yield from _beside_others(problem, before, moved, figures)
                tried = True
        on_border = best is not before
        if not on_border and end.status is Status.LOCAL and not (easy and depth is None):
            best, tried = (yield from _along_valley(problem, before)), True
        if best is before and (end.status is Status.LOCAL or depth is None):
            break
        there, tried = _Iterate.of(problem, best), True
        again = yield from _constrained(there, figures, MOVED)
        least = min(end.objective, criterion.unit * there.at.value)
        if _is_inside(problem, again) and (
                again.status is Status.LOCAL and again.objective < end.objective
                or again.objective < least * (1 - WORTH)):
            end = again  # on the way, if not there
            continue
        two = alone and depth is not None and border.meet(criterion, best)
        two = two and (yield from _along_valley(problem, best)) is best
        gains = criterion.unit * there.at.value < end.objective * (1 - BETTER)
        if end.status is Status.LOCAL and not gains and not two:
            break
        status = (Status.LOCAL, NO_BOUND.format(criterion.errors)) if two else (
            Status.LIMIT, MEETING if on_border or end.status is not Status.LOCAL else IN_VALLEY)
        end = there.evidence(*status, end.figures)
        break
    else:
        end = replace(end, status=Status.LIMIT, reason=f"{IN_VALLEY}, or a border, after {ROUNDS} moves")
    if tried:  # prices are those of the last programme
        yield _end_of(problem, end).tangent
    return end


def _along_valley(problem: Problem, x: Array) -> Generator[Problem, Solution, Array]:
    """Return x, or a better point along a flat valley: by programmes with the curvature of the errors, measured."""
    first = here = _Iterate.of(problem, x)
    damping = 0.0
    for _ in range(ALL):
        at, new = measure_curvature(criterion_of(problem), here.x, here.at), None
        while new is None and damping <= 1.0:
            solution = yield step_problem(problem, here.x, at, damping)
            if solution.has_point:
                gain, new = here.gain(step := here.step(solution), at), here.move_to(here.x + step)
                damping = damping if gain > ALONG * here.at.value else np.inf
                if new is not None and (new.outside > INSIDE or not here.at.value - new.at.value >= 0.1 * gain > 0):
                    new = None
            damping = damping if new is not None else max(10 * damping, 1e-8)
        if new is None or not damping < np.inf:
            break
        here, damping = new, 0.01 * damping if damping > 1e-8 else 0.0
    return here.x if here.at.value < first.at.value * (1 - BETTER) else x


def _beside_others(problem: Problem, x: Array, moved: Iterable[Array | None], figures: Mapping[str, Any]
                   ) -> Generator[Problem, Solution, Array]:
    """Return x, or what is better of moved poles with everything else fitted again under all constraints."""
    best, least = x, criterion_of(problem).value(x) * (1 - BETTER)
    # those about poles hold as it is
    others = tuple(rule for rule in problem.builders if "poles" not in getattr(rule, "about", ()))
    for point in moved:
        if point is None or point is x:
            continue
        end = yield from _with_poles(problem, point, others, figures)
        there = None if end is None else _end_of(problem, end)
        if there is not None and there.outside <= INSIDE and there.at.value < least:
            best, least = there.x, there.at.value
    return best


def _with_poles(problem: Problem, x: Array, rules: tuple[Any, ...], figures: Mapping[str, Any]) -> Procedure:
    """Fit everything but the poles of x again, under rules."""
    criterion = criterion_of(problem)
    word, part = criterion.dynamics, criterion.unknowns.parts(x)[criterion.dynamics]
    held = *problem.restrictions, lambda view: {"poles": view[word] == part}
    still = replace(problem, builders=rules, restrictions=held)
    return (yield from _constrained(_Iterate.of(still, x), figures, MOVED))


@dataclass(frozen=True, eq=False)
class _Iterate:
    problem: Problem
    x: Array
    at: Linearised
    outside: float  # largest violation, relative
    amount: float  # sum of the absolute violations of the user's constraints

    @classmethod
    def of(cls, problem: Problem, x: Array) -> "_Iterate":
        criterion = criterion_of(problem)
        x = criterion.normalise(x)
        at = criterion.linearise(x)
        outside = excess(problem, x) if problem.builders else 0.0
        amount = problem.violation(criterion.variables.values(x)) if outside > NOWHERE else 0.0
        return cls(problem, x, at, outside, amount)

    @cached_property
    def tangent(self) -> Problem:
        """The problem of the undamped step from here."""
        return step_problem(self.problem, self.x, self.at, 0.0)

    def move_to(self, x: Array) -> "_Iterate | None":
        """Return the iterate at x, None where it is inadmissible, its run explodes or its gauge cannot be reached."""
        criterion = criterion_of(self.problem)
        x = criterion.confine(x)
        if not criterion.admissible(x):
            return None
        try:
            there = _Iterate.of(self.problem, x)
        except (StructureError, np.linalg.LinAlgError):
            return None
        return there if np.isfinite(there.at.value) else None

    def merit(self, weight: float) -> float:
        return self.at.value + weight * self.amount

    def step(self, solution: Solution) -> Array:
        return criterion_of(self.problem).variables.pack(solution.values) - self.x

    def gain(self, step: Array, at: Linearised | None = None) -> float:
        """By how much a step lowers the sum of squares of the linear errors, or of others with the same gradient."""
        at = self.at if at is None else at
        return at.value - at.after(step)

    def negligible(self, gain: float, share: float) -> bool:
        return abs(gain) <= share * self.at.value + ROUNDING * criterion_of(self.problem).energy

    def judge(self, solution: Solution, share: float) -> tuple[Status, str]:
        """What an answer to the programme makes of the iterate: it must have been solved, and the iterate stay."""
        if solution.status not in (Status.OPTIMAL, Status.LOCAL) and not _near(solution):
            return solution.status, solution.reason
        gain = self.gain(self.step(solution))
        if self.negligible(gain, share):
            return Status.LOCAL, NO_BOUND.format(criterion_of(self.problem).errors)
        return Status.INACCURATE, (f"{solution.solver} moves the sum of squares of the last tangent programme by "
                                   f"{abs(gain) / max(self.at.value, 1e-300):.0e} of its value")

    def evidence(self, status: Status, reason: str, figures: Mapping[str, Any]) -> Evidence:
        criterion, turns = criterion_of(self.problem), input_signs(self.problem, self.x)
        bound, values = Bound.none(NO_BOUND.format(criterion.errors)), criterion.variables.values(self.x)
        model = self.problem.model(values)
        model = model.with_signs(turns) if np.any(turns < 0) else model
        return Evidence(model, criterion.unit * self.at.value, bound, status, reason, figures, values=values)


def _best_signed(here: _Iterate, free: float, figures: Mapping[str, Any]) -> Procedure:
    """Return the best end of descents from all signs of f and B, where the first ends far above the free optimum.

    Constraints that the record contradicts have several local optima; near the free optimum there is one. A slow pole
    is another way to the characteristic that they ask for, and so are the poles of the free optimum, held at first.
    """
    problem, criterion = here.problem, criterion_of(here.problem)
    best = yield from _constrained(here, figures)
    if best is not None and best.objective <= free * (1 + CONFLICT):
        return best
    known = border.about_poles(problem.builders) or criterion.dynamics not in criterion.unknowns.slices
    slow = [] if known else border.with_slow_poles(criterion, here.x)
    held = []
    for x in () if known else (here.x, *slow):
        end = yield from _with_poles(problem, x, problem.builders, figures)
        held += [] if end is None else [criterion.variables.pack(end.values or {})]
    slow_ones = [start for x in slow for start in (x, *sign_variants(problem, x, same=True))]
    ends = [] if best is None else [best]
    for start in (*sign_variants(problem, here.x, same=True), *sign_variants(problem, here.x), *slow_ones, *held):
        least = min((one.objective for one in ends), default=np.inf)
        end = yield from _constrained(_Iterate.of(problem, start), figures, SIGNED, least * (1 + CONFLICT))
        ends += [] if end is None else [end]
    best, least, arrived = None, min((one.objective for one in ends), default=np.inf), np.inf
    for end in sorted(ends, key=lambda one: one.objective):
        if arrived == np.inf or end.objective <= least * (1 + CONFLICT):
            end = yield from _gone_on(problem, end, figures, arrived)
            inside = _is_inside(problem, end) and end.objective < arrived
            best, arrived = (end, end.objective) if inside else (best or end, arrived)
    return best


def _gone_on(problem: Problem, end: Evidence, figures: Mapping[str, Any], rival: float) -> Procedure:
    """Go on from an end that has not arrived, while that lowers the errors by what is worth it or leads inside.

    Where they fall too slowly to come below a rival, it is left.
    """
    for _ in range(GOING):
        if end.status is Status.LOCAL:
            break
        again, inside = (yield from _constrained(_end_of(problem, end), figures, rival=rival)), _is_inside(problem, end)
        if again is None or inside and not (_is_inside(problem, again) and again.objective < end.objective):
            break
        worth = not inside or again.objective < end.objective * (1 - WORTH)
        end = again
        if not worth:
            break
    return end


def _is_inside(problem: Problem, end: Evidence | None) -> bool:
    return end is not None and _end_of(problem, end).outside <= INSIDE


def _end_of(problem: Problem, end: Evidence) -> _Iterate:
    return _Iterate.of(problem, criterion_of(problem).variables.pack(end.values or {}))


def _constrained(here: _Iterate, figures: Mapping[str, Any], most: int = STEPS, rival: float = np.inf) -> Procedure:
    """Solve tangent programmes until an undamped one gains nothing; an exact penalty judges the steps.

    It ends, without evidence, where its errors fall too slowly to come down to those of a rival.
    """
    previous: _Iterate | None = None
    damping, growth, weight, last, idle, more = 0.0, 4.0, 0.0, np.inf, 0, 0
    answered, curvature, since = False, Curvature(here.x.size), here.at.value
    entered = here.outside <= INSIDE  # figures are compared from the first point that satisfies the constraints
    rival, passed = rival / criterion_of(here.problem).unit, np.inf
    for count in range(1, most + 1):
        if count % OVER == 0:
            if entered and here.at.value - AHEAD * (passed - here.at.value) > rival:
                return None
            passed = here.at.value if entered else np.inf
        at = curvature.add_to(here.at) if curvature.used else here.at
        plain = at is here.at and not damping
        solution = yield here.tangent if plain else step_problem(here.problem, here.x, at, damping)
        if not solution.has_point and at is not here.at:
            curvature.used = False
            continue
        if not solution.has_point:
            if most < STEPS or (solution.status is Status.INFEASIBLE and previous is None) or damping > 1e3:
                if most < STEPS or here.outside > INSIDE or not answered:
                    return None  # of a descent that may be in vain, the first programme without an answer is the last
                said = f"{solution.solver} gave no answer to the last programme: {solution.claimed}"
                return here.evidence(Status.LIMIT, said, {**figures, "programmes": count + more})
            if solution.status is Status.INFEASIBLE and previous is not None:
                here, previous = previous, None
            damping = max(100.0 * damping, 1e-6)  # a nearer point, and a better conditioned programme
            continue
        answered, step = True, here.step(solution)
        gain, new = here.gain(step, at), here.move_to(here.x + step)
        duals = [solution.duals[name] for name in here.problem.constraint_names if name in solution.duals]
        needed = max((2.0 * float(np.max(np.abs(dual), initial=0.0)) for dual in duals), default=0.0)
        weight = max(needed, (weight + needed) / 2)  # multipliers far from the constraints may be huge
        if here.at.value < since * (1 - BETTER):  # little is promised, and more is gained in between
            idle, since = 0, here.at.value
        idle += plain and abs(gain) <= STALLED * here.at.value
        share = CONFIRMED if abs(gain) < 0.5 * last and idle <= PATIENCE else STALLED
        last = abs(gain) if plain else last
        if plain and here.negligible(gain, share) and here.outside <= INSIDE:
            best = here if new is None or new.outside > INSIDE or new.at.value > here.at.value else new
            return best.evidence(*here.judge(solution, share), {**figures, "programmes": count + more})
        expected = gain + weight * here.amount
        fall = here.merit(weight) - new.merit(weight) if new is not None else -np.inf
        entering = new is not None and not entered and (damping > NEAR or new.at.value <= TRUSTED * here.at.after(step))
        if new is not None and (entering or fall >= 1e-3 * expected or abs(fall) <= 1e-12 * here.merit(weight)):
            if not damping and entered and fall > expected:
                new = _longer(here, new, step, weight)
            curvature.learn(here.at, new.at, new.x - here.x)
            if at is not here.at and here.negligible(gain, CONFIRMED):
                curvature.used = False  # only a programme of linear errors can confirm
            previous, here, growth = here, new, 4.0
            entered = entered or new.outside <= INSIDE
            damping *= 0.1 if fall > 0.5 * expected else 1.0
        elif at is not here.at:
            curvature.used = False
        elif plain and here.negligible(gain, BETTER) and here.outside <= INSIDE:  # little, and it does not come
            return here.evidence(*here.judge(solution, BETTER), {**figures, "programmes": count + more})
        else:
            damping, growth = max(growth * damping, 1e-7), 2.0 * growth
            if damping > 1e10:
                shorter, more = (yield from _shortened(here, weight)), more + 1
                if shorter is None:
                    figures = {**figures, "programmes": count + more + 1}
                    return (yield from _ended(here, "no step descends", last, figures))
                previous, here, damping, growth = here, shorter, 0.0, 4.0
                entered = entered or here.outside <= INSIDE
                continue
        if damping < 1e-10 or (fall >= 0 and gain <= STALLED * here.at.value):
            damping = 0.0  # only an undamped programme can confirm
    reason = f"{most} programmes did not suffice"
    return (yield from _ended(here, reason, last, {**figures, "programmes": most + more + 1}))


def _longer(here: _Iterate, new: _Iterate, step: Array, weight: float) -> _Iterate:
    """Go on along a step that gained more than its programme promised, as on a boundary that is curved inwards."""
    for factor in 2.0 ** np.arange(1, PARTS + 1):
        further = here.move_to(here.x + factor * step)
        if further is None or further.merit(weight) >= new.merit(weight):
            break
        new = further
    return new


def _shortened(here: _Iterate, weight: float) -> Generator[Problem, Solution, _Iterate | None]:
    """Take a part of the undamped step: however damped, programmes end on a boundary that may be curved outwards.

    A part of the way there is off it, where the point to start from is.
    """
    solution = yield here.tangent
    if not solution.has_point:
        return None
    step = here.step(solution)
    for part in 0.5 ** np.arange(1, PARTS + 1):
        new, gain = here.move_to(here.x + part * step), here.gain(part * step)
        if new is not None and gain > 0 and here.merit(weight) - new.merit(weight) >= 1e-3 * gain:
            return new
    return None


def _ended(here: _Iterate, reason: str, last: float, figures: Mapping[str, Any]) -> Procedure:
    """Judge where the iteration stopped by one more undamped programme."""
    solution = yield here.tangent
    if solution.has_point and here.outside <= INSIDE and here.negligible(here.gain(here.step(solution)), STALLED):
        return here.evidence(*here.judge(solution, STALLED), figures)
    reason = f"{reason}; the last undamped one promised {last / here.at.value:.0e} of the value"
    return here.evidence(Status.LIMIT, reason, figures)


def _near(solution: Solution) -> bool:
    """Whether an inaccurate solution is off by its complementarity alone, and by no more than counts as nothing.

    Many nearly parallel rows share large multipliers: their products with the slacks then keep a rest.
    """
    found = solution.residuals
    return found is not None and solution.status is Status.INACCURATE and (
        max(found.violation, found.stationarity) <= INSIDE and found.complementarity <= BETTER)
