"""From the optimum of a descent to a point that a back end confirms: programmes in the tangent of the iterate.

A formulation hands over named variables, the programme of a step, and the model of its values (`TangentFit`). Without
constraints one programme at the optimum suffices. With constraints every step is a `Program`, which any back end for
its class can solve: the linearised errors, the user's constraints in the tangent of the iterate, and, after a step that
our own figures refuse, a quadratic damping term. Whatever the constraints, the last programme is undamped, posed at the
final iterate, and solved by the back end that was asked for: that it offers no better point is what "locally optimal"
means here.
"""

from abc import ABC, abstractmethod
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.errors import RankError, StructureError
from optid.identify.prediction_error.descent import STEPS, Criterion, Descent
from optid.program.judging import measure_violation
from optid.program.program import Program, Values
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure
from optid.statistics.linearised import Linearised
from optid.statistics.unknowns import Unknowns

# share of the sum of squares that a full step may still gain, as measured through a back end, whose accuracy limits it
CONFIRMED = 1e-8
# share that counts as nothing where programme after programme promises as little: a curved boundary is followed
STALLED = 1e-5
INSIDE = 1e-6  # relative violation up to which a point satisfies the constraints
NOWHERE = 1e-9  # relative violation that is rounding; a step to more than that pays for it
ROUNDING = 1e-14  # share of the energy of the record below which differences of sums of squares are rounding
PATIENCE = 5  # undamped programmes in all that may promise no more than `STALLED` before it counts as nothing
# a step onto the constraints is taken where the sum of squares is up to so many times what its linear model said, and
# from this damping on, with which it is nearly the shortest one, in any case
TRUSTED, NEAR = 10.0, 1e-2
PARTS = 10  # halvings of an undamped step that are tried where no damped one descends
NO_BOUND = "the {} are not convex in poles and zeros: no lower bound is known, several starts are compared"


@dataclass(frozen=True, eq=False)
class Places:
    """Named variables, and where each stands in the vector of the unknowns."""

    unknowns: Unknowns  # the order of the vector
    names: Mapping[str, str]  # {variable: part of the vector}, in its order; "x0" is the initial states

    @classmethod
    def of(cls, criterion: Criterion) -> "Places":
        """Name the parts by the keys of a criterion."""
        found, unknowns = {}, criterion.unknowns
        for part, shape in unknowns.shapes.items():
            kind = part.rstrip("0123456789")
            if np.prod(shape):
                found[part if kind == part else criterion.key(kind, int(part[len(kind) :]))] = part
        return cls(unknowns, {**found, "x0": "x0"} if unknowns.memory else found)

    def values(self, x: Array) -> dict[str, Array]:
        """Name the parts of x; initial states are (n,), or (n, experiments)."""
        unknowns, parts = self.unknowns, self.unknowns.parts(x)
        states = x[unknowns.shared :].reshape(unknowns.experiments, unknowns.memory).T
        parts["x0"] = states if unknowns.experiments > 1 else states[:, 0]
        return {name: parts[part] for name, part in self.names.items()}

    def pack(self, values: Mapping[str, Array]) -> Array:
        """Return x of named values."""
        return np.concatenate([np.ravel(values[name], order="F" if part == "x0" else "C")
                               for name, part in self.names.items()]).astype(float)

    def variables(self) -> dict[str, cp.Variable]:
        """Return new CVXPY variables."""
        return {name: cp.Variable(value.shape, name=name)
                for name, value in self.values(np.zeros(self.unknowns.size)).items()}

    def stacked(self, variables: Mapping[str, cp.Variable]) -> cp.Expression:
        """Return the variables as the vector of the unknowns."""
        return cp.hstack([variables[name] if variables[name].ndim == 1 else
                          cp.vec(variables[name], order="F" if part == "x0" else "C")
                          for name, part in self.names.items()])


@dataclass(frozen=True, eq=False)
class TangentFit(ABC):
    """A fit by programmes in the tangent of an iterate; a formulation states the programme and its model."""

    name: str  # of the formulation
    criterion: Criterion  # the errors, in the gauge of the programmes
    constraints: tuple[Any, ...]  # the user's

    @abstractmethod
    def pose(self, z0: Array, at: Linearised, damping: float) -> Program:
        """State the programme of the step from z0, with the user's constraints; ``at`` are the errors near z0."""

    @abstractmethod
    def recover(self, values: Values) -> Any:
        """Return the model of the values of the variables."""

    @cached_property
    def places(self) -> Places:
        """The named variables in the order of the unknowns."""
        return Places.of(self.criterion)

    def signed(self, x: Array) -> Array:
        """Turn the signs of mu and b to where constraints are violated least; without, f rises where the output does.

        A monotone f or a sign of the gain says which of the two equal descriptions is meant; where it asks for the
        opposite characteristic, mu or b alone is turned, since no tangent step leads through zero.
        """
        x, at = self.criterion.normalised(x), self.criterion.unknowns.slices
        errors = self.criterion.linearise(x) if self.constraints else None
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            if mu.startswith("nu"):  # the signs of feedback functions stay
                continue
            best, chosen = np.inf, x
            first = self.criterion.gain_sign(x, b)
            signs = (first, first), (-first, -first), (-first, first), (first, -first)
            for mu_sign, b_sign in signs if mu.startswith("mu") else signs[:2]:
                turned = np.array(x)
                turned[at[mu]] *= mu_sign
                turned[at[b]] *= b_sign
                outside = 0.0 if errors is None else violation(self.pose(turned, errors, 0.0))
                if outside < (best if mu_sign == b_sign else 0.5 * best):
                    best, chosen = outside, turned
                if best <= 1e-9:
                    break
            x = chosen
        return x

    def turns(self, x: Array, errors: Linearised) -> Array:
        """Return -1 for every input whose f falls where the output rises, if the constraints allow the opposite signs.

        1 for the others; (m,). A descent under constraints may end with other signs than it began with.
        """
        at, found = self.criterion.unknowns.slices, np.ones(self.criterion.data.m)
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            if mu.startswith("mu") and self.criterion.gain_sign(x, b) < 0:
                turned = np.array(x)
                turned[at[mu]], turned[at[b]] = -x[at[mu]], -x[at[b]]
                found[int(b[1:])] = -1.0 if violation(self.pose(turned, errors, 0.0)) <= INSIDE else 1.0
        return found


def violation(program: Program) -> float:
    """Return the largest relative violation of the constraints at the iterate of a programme."""
    program.assign(program.view.reference)
    return measure_violation(program)[0]


def refine(fit: TangentFit, found: Descent, figures: Mapping[str, Any], x: Array) -> Procedure:
    """Bring a descent to a point that a back end confirms, under the constraints of the programmes.

    Args:
        fit: its programmes.
        found: the unconstrained optimum.
        figures: what is known already; returned with the evidence.
        x: where to start: the optimum, in the signs that the constraints ask for, or a point nearer to them.

    Returns:
        The evidence, or None where a programme has no point: its status says why.
    """
    here = _Iterate.of(fit, x)
    if not np.isfinite(here.at.value):
        raise RankError("no start has a run that stays within its range; use another order or another basis")
    figures = {**figures, "Gauss-Newton steps": found.steps}
    if here.program.user_constraints:
        return (yield from _constrained(here, figures))
    solution = yield here.program
    if not solution.has_point:
        return None
    verdict = here.judged(solution, CONFIRMED) if found.converged else (Status.LIMIT, found.reason)
    return here.evidence(*verdict, {**figures, "programmes": 1})


@dataclass(frozen=True, eq=False)
class _Iterate:
    fit: TangentFit
    x: Array
    at: Linearised
    program: Program
    outside: float  # largest violation, relative
    amount: float  # sum of the absolute violations of the user's constraints

    @classmethod
    def of(cls, fit: TangentFit, x: Array) -> "_Iterate":
        x = fit.criterion.normalised(x)
        at = fit.criterion.linearise(x)
        program = fit.pose(x, at, 0.0)
        outside = violation(program) if program.user_constraints else 0.0
        amount = sum(float(np.sum(np.abs(np.asarray(member.violation()))))
                     for group in program.user_constraints.values() for member in group)
        return cls(fit, x, at, program, outside, amount if outside > NOWHERE else 0.0)

    def moved(self, x: Array) -> "_Iterate | None":
        """Return the iterate at x, None where it is inadmissible, its run explodes or its gauge cannot be reached."""
        criterion = self.fit.criterion
        try:
            return _Iterate.of(self.fit, x) if criterion.admissible(x) and np.isfinite(criterion.value(x)) else None
        except StructureError:
            return None

    def merit(self, weight: float) -> float:
        return self.at.value + weight * self.amount

    def step(self, solution: Solution) -> Array:
        return self.fit.places.pack(solution.values) - self.x

    def gain(self, step: Array) -> float:
        """By how much a step lowers the sum of squares of the linear errors."""
        return self.at.value - self.at.after(step)

    def negligible(self, gain: float, share: float) -> bool:
        return abs(gain) <= share * self.at.value + ROUNDING * self.fit.criterion.energy

    def judged(self, solution: Solution, share: float) -> tuple[Status, str]:
        """What an answer to the programme makes of the iterate: it must have been solved, and the iterate stay."""
        if solution.status not in (Status.OPTIMAL, Status.LOCAL) and not _near(solution):
            return solution.status, solution.reason
        gain = self.gain(self.step(solution))
        if self.negligible(gain, share):
            return Status.LOCAL, NO_BOUND.format(self.fit.criterion.errors)
        return Status.INACCURATE, (f"{solution.solver} moves the sum of squares of the last tangent programme by "
                                   f"{abs(gain) / max(self.at.value, 1e-300):.0e} of its value")

    def evidence(self, status: Status, reason: str, figures: Mapping[str, Any]) -> Evidence:
        bound = Bound.none(NO_BOUND.format(self.fit.criterion.errors))
        values, value = self.fit.places.values(self.x), self.fit.criterion.unit * self.at.value
        model, turns = self.fit.recover(values), self.fit.turns(self.x, self.at) if self.fit.constraints else np.ones(1)
        model = model.turned(turns) if np.any(turns < 0) else model
        return Evidence(model, value, bound, status, reason, figures, values=values)


def _constrained(here: _Iterate, figures: Mapping[str, Any]) -> Procedure:
    """Solve tangent programmes until an undamped one gains nothing; an exact penalty judges the steps."""
    previous: _Iterate | None = None
    damping, growth, weight, last, idle, more = 0.0, 4.0, 0.0, np.inf, 0, 0
    entered = here.outside <= INSIDE  # figures are compared from the first point that satisfies the constraints
    for count in range(1, STEPS + 1):
        solution = yield here.program if not damping else here.fit.pose(here.x, here.at, damping)
        if not solution.has_point:
            if (solution.status is Status.INFEASIBLE and previous is None) or damping > 1e3:
                return None
            if solution.status is Status.INFEASIBLE and previous is not None:
                here, previous = previous, None
            damping = max(100.0 * damping, 1e-6)  # a nearer point, and a better conditioned programme
            continue
        step = here.step(solution)
        gain, new = here.gain(step), here.moved(here.x + step)
        duals = [solution.duals[name] for name in here.program.user_constraints if name in solution.duals]
        weight = max(weight, *(2.0 * float(np.max(np.abs(dual), initial=0.0)) for dual in duals), 0.0)
        idle += not damping and abs(gain) <= STALLED * here.at.value
        share = CONFIRMED if abs(gain) < 0.5 * last and idle <= PATIENCE else STALLED
        last = abs(gain) if not damping else last
        if not damping and here.negligible(gain, share) and here.outside <= INSIDE:
            best = here if new is None or new.outside > INSIDE else new
            return best.evidence(*here.judged(solution, share), {**figures, "programmes": count + more})
        expected = gain + weight * here.amount
        fall = here.merit(weight) - new.merit(weight) if new is not None else -np.inf
        entering = new is not None and not entered and (
            damping > NEAR or new.at.value <= TRUSTED * here.at.after(step))
        if new is not None and (entering or fall >= 1e-3 * expected or abs(fall) <= 1e-12 * here.merit(weight)):
            if not damping and entered and fall > expected:
                new = _longer(here, new, step, weight)
            previous, here, growth = here, new, 4.0
            entered = entered or new.outside <= INSIDE
            damping *= 0.1 if fall > 0.5 * expected else 1.0
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
    reason = f"{STEPS} programmes did not suffice"
    return (yield from _ended(here, reason, last, {**figures, "programmes": STEPS + more + 1}))


def _longer(here: _Iterate, new: _Iterate, step: Array, weight: float) -> _Iterate:
    """Go on along a step that gained more than its programme promised, as on a boundary that is curved inwards."""
    for factor in 2.0 ** np.arange(1, PARTS + 1):
        further = here.moved(here.x + factor * step)
        if further is None or further.merit(weight) >= new.merit(weight):
            break
        new = further
    return new


def _shortened(here: _Iterate, weight: float) -> Generator[Program, Solution, _Iterate | None]:
    """Take a part of the undamped step: however damped, programmes end on a boundary that may be curved outwards.

    A part of the way there is off it, where the point to start from is.
    """
    solution = yield here.program
    if not solution.has_point:
        return None
    step = here.step(solution)
    for part in 0.5 ** np.arange(1, PARTS + 1):
        new, gain = here.moved(here.x + part * step), here.gain(part * step)
        if new is not None and gain > 0 and here.merit(weight) - new.merit(weight) >= 1e-3 * gain:
            return new
    return None


def _ended(here: _Iterate, reason: str, last: float, figures: Mapping[str, Any]) -> Procedure:
    """Judge where the iteration stopped by one more undamped programme."""
    solution = yield here.program
    if solution.has_point and here.outside <= INSIDE and here.negligible(here.gain(here.step(solution)), STALLED):
        return here.evidence(*here.judged(solution, STALLED), figures)
    reason = f"{reason}; the last undamped one promised {last / here.at.value:.0e} of the value"
    return here.evidence(Status.LIMIT, reason, figures)


def _near(solution: Solution) -> bool:
    """Whether an inaccurate solution is off by its complementarity alone, and by no more than counts as nothing.

    Many nearly parallel rows share large multipliers: their products with the slacks then keep a rest.
    """
    found = solution.residuals
    return found is not None and solution.status is Status.INACCURATE and (
        max(found.violation, found.stationarity) <= INSIDE and found.complementarity <= STALLED)
