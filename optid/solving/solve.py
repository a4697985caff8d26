"""Solve a programme: look the solver up, refuse what it cannot take, run it, judge its point, prove it."""

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import LARGEST
from optid.backends.back_end import Answer, BackEnd, Settings
from optid.backends.choice import choose, fallbacks, find
from optid.certificate.convex import TANGENT, certify_convex
from optid.certificate.infeasibility import satisfiable
from optid.errors import SolverRefused, StructureError
from optid.packing import Unsendable
from optid.processes import LONGEST, run_apart
from optid.program.expressions import is_crash
from optid.program.judging import judge, measure_violation
from optid.program.program import Program, Values
from optid.program.solution import GRADIENT, Bound, Residuals, Solution, Status, Times, relative_gap, tolerance
from optid.structures.least_squares import rank_one_of

Procedure = Generator[Program, Solution, Any]

FALSE_CLAIM = 1e-3  # a claim of success at a point this far outside the constraints is false, not inaccurate
ENDLESS = LONGEST / 2  # seconds; a longer time limit, such as infinity, is none
GRACE = 0.5  # seconds after its time limit at which a solver is killed
UNUSABLE = (Status.FAILED, Status.LIMIT)
OPEN = 1e-8  # relative gap that a proof leaves, above which a back end is asked to search further
CONFLICT = "the constraints contradict each other"
NOT_FINITE = "returned non-finite numbers"  # the reason of such a solution, after its solver


def solve(program: Program, solver: str | BackEnd | Callable = "auto", *, accuracy: float = 1e-8,
          time_limit: float | None = None, isolate: bool | None = None, warm: bool = True, prove: bool = True,
          verbose: bool = False, **options: Any) -> Solution:
    """Solve one programme with one back end and judge the answer.

    Args:
        program: what to solve.
        solver: the back end's word, "auto", or a `BackEnd` (or plain ``run`` function) of your own.
        accuracy: requested relative accuracy, translated for each solver.
        time_limit: seconds, infinity for none; implies a separate process, which is killed when it does not stop.
        isolate: run in a separate process (default: only with a time limit), so that a crash is an outcome; back ends
            of your own must then be importable.
        warm: start from the programme's ``start``.
        prove: ask the programme's certificate for a proof of global optimality.
        verbose: let the solver print.
        options: native options of the solver.

    Returns:
        The outcome, always as a value: infeasible, failed and limit are statuses here.

    Raises:
        LookupFailed: no such solver.
        SolverMissing: not installed (with the pip line).
        SolverRefused: the solver cannot take this class of programme; the message names the nonconvex part.
    """
    chosen = ""
    if solver == "auto":
        back_end, chosen = choose(program)
    elif isinstance(solver, str):
        back_end = find(solver)
    else:
        back_end = solver if isinstance(solver, BackEnd) else BackEnd(
            getattr(solver, "__name__", "callable"), frozenset({"LP", "QP", "SOCP", "SDP", "conic", "NLP"}), solver)
    refusal = back_end.refuses(program)
    if refusal:
        raise SolverRefused(refusal)
    settings = Settings(accuracy, time_limit, warm, verbose, options)
    if time_limit is not None and time_limit > ENDLESS:
        settings, time_limit = replace(settings, time_limit=None), None
    separate = (time_limit is not None) if isolate is None else isolate

    def attempt(back_end: BackEnd, settings: Settings, chosen: str, spent: float = 0.0) -> Solution:
        clock = time.perf_counter()
        answer = _attempt(program, back_end, settings, separate)
        seconds = spent + time.perf_counter() - clock
        base = Solution(answer.status, answer.word, back_end.name, chosen=chosen, scale=program.scale,
                        iterations=answer.iterations, times=Times(solve=seconds, compile=answer.compile),
                        claim=answer.status)
        return _verdict(program, back_end, answer, base, settings, prove, separate).in_units(program.unit)

    solution = attempt(back_end, settings, chosen)
    if not chosen or options:
        return solution
    outside = solution.residuals is not None and solution.residuals.violation > FALSE_CLAIM
    if solution.status is Status.FAILED or (solution.status is Status.LIMIT and outside):
        for other in fallbacks(program, back_end.name):
            found = attempt(other, settings, f"{other.name}: in place of {back_end.name}")
            if found.status is Status.INFEASIBLE or (found.has_point and found.status not in UNUSABLE):
                return replace(found, failed=back_end.name)
    if solution.status is Status.INACCURATE:  # a hundredth of the tolerance may satisfy our measurements
        sharper = replace(settings, accuracy=settings.accuracy / 100)
        found = attempt(back_end, sharper, chosen, solution.times.solve)
        return found if found.status in (Status.LOCAL, Status.OPTIMAL) else solution
    return solution


def _substitutions(steps: Sequence[tuple[str, Solution]]) -> dict[str, str]:
    """State how many programmes another back end than the one chosen first has solved."""
    replaced = [solution for _, solution in steps if solution.failed]
    if not replaced:
        return {}
    first, others = replaced[0].failed, ", ".join(dict.fromkeys(solution.solver for solution in replaced))
    return {"solver fallback": f"{first} gave no usable answer for {len(replaced)} of {len(steps)} programmes, which "
                               f"{others} solved"}


def _attempt(program: Program, back_end: BackEnd, settings: Settings, separate: bool) -> Answer:
    """Run a back end from the programme's start, in another process where it is to be separate; every outcome counts.

    What only models and proofs need may stay here (`optid.packing.Absent`).
    """
    program.clear_duals()
    if settings.warm and program.start:
        program.assign(program.start)
    if not separate:
        return _run(back_end, program, settings)
    clock = time.monotonic()
    try:
        limit = None if settings.time_limit is None else settings.time_limit + GRACE
        return run_apart(_run, back_end, program, settings, seconds=limit, lenient=True)
    except TimeoutError:
        return Answer(Status.LIMIT, f"stopped after {time.monotonic() - clock:.1f} s: it did not keep its time limit")
    except ChildProcessError as death:
        return Answer(Status.FAILED, f"the solver's process died: {death}")
    except Unsendable as refusal:
        raise SolverRefused(f"a separate process for {back_end.name!r} is not possible: {refusal}; or use neither "
                            "time_limit nor isolate") from refusal


def _run(back_end: BackEnd, program: Program, settings: Settings) -> Answer:
    """Run a back end; an exception of its own is an answer, too, also in a child."""
    try:
        return back_end.run(program, settings)
    except Unsendable:
        raise
    except StructureError as refusal:  # its message has the remedy for the user
        raise SolverRefused(str(refusal)) from refusal
    except BaseException as error:  # a solver that crashes is an outcome, not a traceback
        if not is_crash(error):
            raise
        return Answer(Status.FAILED, f"{type(error).__name__}: {error}")


def _verdict(program: Program, back_end: BackEnd, answer: Answer, base: Solution, settings: Settings, prove: bool,
             separate: bool) -> Solution:
    values = {name: np.asarray(value, dtype=float) for name, value in answer.values.items()}
    if not values:
        status, reason = _without_point(program, answer, back_end.name)
        if status is Status.FAILED and _contradictory(program):
            return _conflict(base, reason)
        return replace(base, status=status, reason=reason)
    if not all(np.all(np.isfinite(value)) for value in values.values()):
        return replace(base, status=Status.FAILED, reason=f"{back_end.name} {NOT_FINITE}")
    if missing := program.shapes.keys() - values.keys():
        return replace(base, status=Status.FAILED,
                       reason=f"{back_end.name} returned no value for {', '.join(sorted(missing))}")

    clock = time.perf_counter()
    try:
        point = _judged(program, answer, base)
    except ValueError as error:  # CVXPY takes no value of another shape, and none that overflowed
        why = NOT_FINITE if _overflowed(program) else f"returned a point that cannot be judged: {error}"
        return replace(base, status=Status.FAILED, reason=f"{back_end.name} {why}")
    judged = time.perf_counter()
    assert point.residuals is not None
    if not abs(point.objective) <= LARGEST:  # models refuse such numbers, since their squares overflow
        return replace(point, status=Status.FAILED, reason=f"{back_end.name} {NOT_FINITE}", values={}, duals={})
    status, reason = _status(answer, point.residuals, settings.accuracy, back_end.name)
    if status not in (Status.LOCAL, Status.OPTIMAL) and _contradictory(program):
        return _conflict(base, reason)
    bound: Bound | None = None
    if status in (Status.LOCAL, Status.INACCURATE) and prove:
        point, bound = _proof(program, back_end, settings, point, separate)
        assert point.residuals is not None
        outside = point.residuals.violation > tolerance(settings.accuracy)
        if bound is not None and bound.proved and outside:  # a point outside may well lie below the optimum
            bound = replace(bound, proved=False, reason=f"no proof: the point violates {point.residuals.worst!r}")
        if bound is not None and bound.proved and status is Status.LOCAL:
            status = Status.OPTIMAL
        elif bound is not None and status is Status.LOCAL and _refuted(program, point, bound, settings.accuracy):
            status, reason = Status.INACCURATE, f"the certified bound is not reached: {bound.reason}"
    done = time.perf_counter()
    return replace(point, status=status, reason=reason or (bound.reason if bound and not bound.proved else ""),
                   bound=bound, times=replace(base.times, judge=judged - clock, prove=done - judged))


def _conflict(base: Solution, reason: str) -> Solution:
    """Report that no point satisfies the constraints; the point of the solver is dropped."""
    return replace(base, status=Status.INFEASIBLE, reason=f"{CONFLICT}; {reason}")


def _judged(program: Program, answer: Answer, base: Solution) -> Solution:
    """Return a solution at the answer's point, with what we measured there."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite shows in the residuals
        values, objective, residuals = judge(program, answer.values, answer.duals)
    return replace(base, values=values, duals=dict(answer.duals), objective=objective, residuals=residuals)


def _overflowed(program: Program) -> bool:
    """Whether quantities that follow from the assigned variables are not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        values = [np.asarray(expression.value) for expression in program.derived.values()]
    return any(value.dtype == object or not np.all(np.isfinite(value)) for value in values)


def _contradictory(program: Program) -> bool:
    """Whether the constraints of a bilinear programme contradict each other: its descents cannot tell."""
    return rank_one_of(program) is not None and bool(program.user_constraints) and not satisfiable(
        program, list(program.user_constraints))


def _without_point(program: Program, answer: Answer, name: str) -> tuple[Status, str]:
    """Judge a claim that comes without a point."""
    if answer.status in (Status.OPTIMAL, Status.LOCAL, Status.INACCURATE):
        return Status.FAILED, f"{name} claims success, but returned no point"
    if answer.status is Status.INFEASIBLE and program.start:
        program.assign(program.start)
        if all(v.value is not None for v in program.variables.values()) and measure_violation(program)[0] < 1e-9:
            return Status.FAILED, f"{name} claims infeasibility, but the start satisfies every constraint"
    return answer.status, answer.word


def _status(answer: Answer, residuals: Residuals, accuracy: float, name: str) -> tuple[Status, str]:
    """Turn a claim and our measurements into a status: success at a bad point is downgraded."""
    limit = tolerance(accuracy)
    claims = answer.status in (Status.OPTIMAL, Status.LOCAL)
    outside = residuals.violation > limit
    amount = f"constraint {residuals.worst!r} is violated by {residuals.violation:.1e} (relative)" if outside else ""
    if answer.status is Status.INFEASIBLE and not outside:
        return Status.FAILED, f"{name} claims infeasibility at a point that satisfies every constraint"
    if answer.status not in (Status.OPTIMAL, Status.LOCAL, Status.INACCURATE):
        return answer.status, f"{answer.word}; {amount}" if amount else answer.word
    if outside:
        if residuals.violation > FALSE_CLAIM:
            return Status.FAILED, f"{name} claims success, but {amount}" if claims else f"{answer.word}; {amount}"
        return Status.INACCURATE, amount
    if residuals.stationarity > GRADIENT * limit or residuals.complementarity > limit:
        return Status.INACCURATE, (
            f"{name + ' claims success' if claims else answer.word}, but the point is not stationary: "
            f"residual {residuals.stationarity:.1e}, complementarity {residuals.complementarity:.1e}")
    if not claims and not np.isfinite(residuals.stationarity):
        return Status.INACCURATE, answer.word
    return Status.LOCAL, ""


def _refuted(program: Program, point: Solution, bound: Bound, accuracy: float) -> bool:
    """Whether the dual bound of a convex programme leaves room for a better point, beyond the tolerance."""
    if bound.proved or bound.method == TANGENT or not np.isfinite(bound.value) or program.kind == "NLP":
        return False
    return relative_gap(point.objective, bound.value, program.scale) > tolerance(accuracy)


def _proof(program: Program, back_end: BackEnd, settings: Settings, point: Solution, separate: bool
           ) -> tuple[Solution, Bound | None]:
    """Ask for a proof; what the attempt proposes as a better start, and a wider search, may lead to a better point."""
    if program.certify is None:
        if program.kind == "NLP":
            return point, None
        try:
            return point, certify_convex(program, point.values, point.duals, point.objective)
        except (ValueError, NotImplementedError, TypeError):  # no gradient in CVXPY, or a multiplier of another shape
            return point, None
    bound, start = program.certify(program, point.values, point.duals)
    if start is not None and not bound.proved:
        point, bound = _lowered(program, start, back_end, settings, point, bound, separate)
    if not bound.proved and back_end.thorough and relative_gap(point.objective, bound.value, program.scale) > OPEN:
        wider = replace(settings, options={**back_end.thorough, **settings.options})
        point, bound = _lowered(program, program.start, back_end, wider, point, bound, separate)
    return point, bound


def _lowered(program: Program, start: Values, back_end: BackEnd, settings: Settings, point: Solution, bound: Bound,
             separate: bool) -> tuple[Solution, Bound]:
    """Solve again from a start, and certify the point found there where it lies lower."""
    answer = _attempt(replace(program, start=start), back_end, settings, separate)
    if answer.values and program.certify is not None:
        again = _judged(program, answer, point)
        assert again.residuals is not None and point.residuals is not None
        lower = again.objective < point.objective - 1e-10 * abs(point.objective)
        if lower and again.residuals.violation <= max(point.residuals.violation, 1e-9):
            point, bound = again, program.certify(program, again.values, again.duals)[0]
    program.assign(point.values)
    return point, bound


@dataclass(frozen=True)
class Evidence:
    """What a procedure returns when its objective is not that of its last programme."""

    model: Any  # the model
    objective: float  # value of the procedure's own objective
    # bound on that objective, with the reason where there can be none; or a function that returns it, called when the
    # solution of the fit is first used
    bound: Bound | Callable[[], Bound]
    status: Status  # status of the procedure as a whole
    reason: str = ""  # one sentence
    # what the procedure measured on its way, by the names that are printed ("condition of R11", "starts",
    # "order"): numbers, texts, and one-dimensional arrays such as "singular values", largest first, which the report
    # draws. The fit prints them in this order
    figures: Mapping[str, Any] = field(default_factory=dict)
    # returns the model completed by what only some uses need, such as a noise model, and further figures; it is called
    # when the model of the fit is first used
    extend: Callable[[], tuple[Any, dict[str, Any]]] | None = None
    # of the variables of the last programme at the model, where the model is not that of its solution
    values: Mapping[str, Any] | None = None

    def extended(self) -> tuple[Any, dict[str, Any]]:
        """Return the completed model and further figures."""
        return self.extend() if self.extend else (self.model, {})

    @classmethod
    def pointless(cls, status: Status, reason: str) -> "Evidence":
        """Return evidence without a model, with the reason."""
        return cls(None, float("nan"), Bound.none(reason), status, reason)


@dataclass(frozen=True)
class Outcome:
    """What a formulation ended with."""

    model: Any  # the model, or None where no programme had a point
    solution: Solution  # the last solution
    program: Program  # the last programme
    steps: tuple[tuple[str, Solution], ...]  # every (name, solution) on the way; one entry for a plain programme
    # those of the evidence, and which solvers stood in for others
    figures: Mapping[str, Any] = field(default_factory=dict)
    # the last programme, with its solution, in which each user constraint stood: a procedure hands its constraints to
    # the steps they are about
    constrained: Mapping[str, tuple[Program, Solution]] = field(default_factory=dict, repr=False)
    # with which a procedure judged the whole: solution and program then do not belong together; the solution has
    # no bound where the evidence has a function that returns it
    evidence: Evidence | None = None


def run(problem: Program | Procedure, solver: Any = "auto", **settings: Any) -> Outcome:
    """Solve a programme, or drive a procedure that yields programmes and returns the model, with settings of `solve`.

    The time that a procedure itself takes, between its programmes, counts as building.
    """
    constrained: dict[str, tuple[Program, Solution]] = {}
    steps: list[tuple[str, Solution]] = []
    if isinstance(problem, Program):
        solution = solve(problem, solver, **settings)
        model = problem.recover(solution.values) if solution.has_point else None
        constrained = dict.fromkeys(problem.user_constraints, (problem, solution))
        return Outcome(model, solution, problem, ((problem.name, solution),), constrained=constrained)
    clock = time.perf_counter()
    program = next(problem)
    building = time.perf_counter() - clock
    while True:
        solution = solve(program, solver, **settings)
        steps.append((program.name, solution))
        constrained |= dict.fromkeys(program.user_constraints, (program, solution))
        clock = time.perf_counter()
        try:
            program = problem.send(solution)
            building += time.perf_counter() - clock
        except StopIteration as stop:
            found = stop.value
            building += time.perf_counter() - clock
            solution = replace(solution, times=replace(solution.times, build=building))
            if not isinstance(found, Evidence):
                return Outcome(found, solution, program, tuple(steps), _substitutions(steps), constrained)
            bound = None if callable(found.bound) else found.bound
            solution = replace(solution, objective=found.objective, bound=bound, status=found.status,
                               reason=found.reason)
            if found.values is not None:
                program.assign(found.values)
                solution = replace(solution, values=program.values())
            figures = {**found.figures, **_substitutions(steps)}
            return Outcome(found.model, solution, program, tuple(steps), figures, constrained, found)
