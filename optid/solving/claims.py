"""Ask a back end, and say what its answer is worth: its claim is held against multipliers, bounds and proofs."""

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from optid.arrays import LARGEST
from optid.backends.back_end import Answer, BackEnd, Settings
from optid.backends.choice import find
from optid.certificate.convex import TANGENT, certify_convex
from optid.certificate.dual_points import certify_groups, certify_low_rank
from optid.certificate.infeasibility import satisfiable
from optid.certificate.lifting import certify_nuclear, certify_rank_one
from optid.core.group_sparse import GroupSparseForm
from optid.core.judge import judge
from optid.core.least_squares import RankOneForm
from optid.core.leaves import GAUGE
from optid.core.low_rank import LowRankForm
from optid.core.problem import Problem
from optid.core.statement import class_of, complete_values, is_stated, statement_of
from optid.core.terms import NuclearNorms, Squares, Values
from optid.errors import SolverRefused, StructureError
from optid.packing import Unsendable
from optid.processes import run_apart
from optid.program.expressions import is_crash
from optid.program.solution import GRADIENT, Bound, Residuals, Solution, Status, relative_gap, tolerance
from optid.structures.rank_one import RankOne

GRACE = 0.5  # seconds after its time limit at which a solver is killed
FALSE_CLAIM = 1e-3  # a claim of success at a point this far outside the constraints is false, not inaccurate
REFERENCE = "clarabel"  # the solver that is asked where neither multipliers nor a bound confirm a point
OPEN = 1e-8  # relative gap that a proof leaves, above which a back end is asked to search further
CONFLICT = "the constraints contradict each other"
NOT_FINITE = "returned non-finite numbers"  # the reason of such a solution, after its solver


def answer_of(problem: Problem, back_end: BackEnd, settings: Settings, separate: bool) -> Answer:
    """Run a back end from the programme's start, in another process where it is to be separate; every outcome counts.

    What only models and proofs need may stay here (`optid.packing.Absent`).
    """
    if is_stated(problem) or separate or not settings.warm:
        statement_of(problem).begin(problem.start if settings.warm else {})
    if not separate:
        return _run(back_end, problem, settings)
    clock = time.monotonic()
    try:
        limit = None if settings.time_limit is None else settings.time_limit + GRACE
        return run_apart(_run, back_end, problem, settings, seconds=limit, lenient=True)
    except TimeoutError:
        return Answer(Status.LIMIT, f"stopped after {time.monotonic() - clock:.1f} s: it did not keep its time limit")
    except ChildProcessError as death:
        return Answer(Status.FAILED, f"the solver's process died: {death}")
    except Unsendable as refusal:
        raise SolverRefused(f"a separate process for {back_end.name!r} is not possible: {refusal}; or use neither "
                            "time_limit nor isolate") from refusal


def _run(back_end: BackEnd, problem: Problem, settings: Settings) -> Answer:
    """Run a back end; its own exception is an answer, too, also in a child."""
    try:
        return _wellformed(back_end.run(problem, settings), problem)
    except Unsendable:
        raise
    except StructureError as refusal:  # its message has the remedy for the user
        raise SolverRefused(str(refusal)) from refusal
    except BaseException as error:  # a solver that crashes is an outcome, not a traceback
        if not is_crash(error):
            raise
        return Answer(Status.FAILED, f"{type(error).__name__}: {error}")


def _wellformed(answer: Answer, problem: Problem) -> Answer:
    """Return an answer with the values of the programme's variables; one of another form is a failure."""
    if not isinstance(answer, Answer) or not isinstance(answer.status, Status) or not all(
            isinstance(one, Mapping) for one in (answer.values, answer.duals)):
        return Answer(Status.FAILED, "it returned no Answer(status: Status, word, values: Mapping, duals: Mapping)")
    return replace(answer, values={name: value for name, value in answer.values.items() if name in problem.shapes})


def verdict(problem: Problem, back_end: BackEnd, answer: Answer, base: Solution, settings: Settings, prove: bool,
            separate: bool) -> Solution:
    """Return a solution with what an answer is worth, proved where that is asked for.

    Args:
        problem: the programme.
        back_end: the solver.
        answer: its answer.
        base: status, words and times of the answer.
        settings: what was asked of the solver.
        prove: whether to try to prove a local optimum to be a global one.
        separate: whether further solves have a process of their own.
    """
    try:
        values = {name: np.asarray(value, dtype=float) for name, value in answer.values.items()}
    except (TypeError, ValueError) as error:
        return replace(base, status=Status.FAILED, reason=f"{back_end.name} returned no numbers: {error}")
    if not values:
        status, reason = _without_point(problem, answer, back_end, settings)
        if status is Status.FAILED and _contradictory(problem):
            return _conflict(base, reason)
        return replace(base, status=status, reason=reason)
    if not all(np.all(np.isfinite(value)) for value in values.values()):
        return replace(base, status=Status.FAILED, reason=f"{back_end.name} {NOT_FINITE}")
    if missing := problem.shapes.keys() - values.keys():
        return replace(base, status=Status.FAILED,
                       reason=f"{back_end.name} returned no value for {', '.join(sorted(missing))}")

    clock = time.perf_counter()
    try:
        point = _judged(problem, answer, base)
    except ValueError as error:  # a value of another shape
        return replace(base, status=Status.FAILED,
                       reason=f"{back_end.name} returned a point that cannot be judged: {error}")
    judged = time.perf_counter()
    assert point.residuals is not None
    if not abs(point.objective) <= LARGEST:  # models refuse such numbers, since their squares overflow
        return replace(point, status=Status.FAILED, reason=f"{back_end.name} {NOT_FINITE}", values={}, duals={})
    status, reason = _status(answer, point.residuals, settings.accuracy, back_end.name)
    if status not in (Status.LOCAL, Status.OPTIMAL) and _contradictory(problem):
        return _conflict(base, reason)
    bound: Bound | None = None
    unknown = bool(np.isnan(point.residuals.stationarity))  # only a bound can confirm the point
    asked = status in (Status.LOCAL, Status.INACCURATE) and (prove and not problem.step or unknown)
    if asked:
        point, bound = _proof(problem, back_end, settings, point, separate)
        assert point.residuals is not None
        outside = point.residuals.violation > tolerance(settings.accuracy)
        if bound is not None and bound.proved and outside:  # a point outside may well lie below the optimum
            bound = replace(bound, proved=False, reason=f"no proof: the point violates {point.residuals.worst!r}")
        if bound is not None and bound.proved and status is Status.LOCAL:
            status = Status.OPTIMAL
        elif bound is not None and status is Status.LOCAL and _refuted(problem, point, bound, settings.accuracy):
            status, reason = Status.INACCURATE, f"the certified bound is not reached: {bound.reason}"
        if status is Status.LOCAL and unknown and not _confirmed(problem, back_end, settings, point, separate):
            status, reason = Status.INACCURATE, f"{back_end.name} claims success, but {REFERENCE} finds a better point"
    proving = time.perf_counter() - judged if asked else 0.0
    return replace(point, status=status, reason=reason or (bound.reason if bound and not bound.proved else ""),
                   bound=bound, times=replace(base.times, judge=judged - clock, prove=proving))


def _conflict(base: Solution, reason: str) -> Solution:
    """Report that no point satisfies the constraints; the point of the solver is dropped."""
    return replace(base, status=Status.INFEASIBLE, reason=f"{CONFLICT}; {reason}")


def _judged(problem: Problem, answer: Answer, base: Solution) -> Solution:
    """Return a solution at the answer's point, with what we measured there.

    Where the solver's multipliers do not make it stationary, those count that come nearest to it.
    """
    flattened = {name: np.ravel(np.asarray(part, dtype=float)) for name, part in answer.duals.items()}
    duals = {name: part for name, part in flattened.items() if np.all(np.isfinite(part))}
    x = {name: np.reshape(np.asarray(answer.values[name], dtype=float), np.shape(start), order="F")
         for name, start in problem.start.items()}
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite shows in the residuals
        found = judge(problem, x, duals)
        values, structural = complete_values(problem, x), {GAUGE: found.gauge} if problem.gauged else {}
        if "residual" in values:
            structural["residual"] = duals.get("residual", -2.0 * values["residual"])
        if "structure" in duals:  # of a low-rank matrix
            structural["structure"] = duals["structure"]
    return replace(base, values=values, duals={**structural, **found.duals},
                   objective=found.objective, residuals=found.residuals)


def _reference(problem: Problem, back_end: BackEnd) -> BackEnd | None:
    """Return another solver for a convex programme than the one that has solved it."""
    other = find(REFERENCE)
    return None if class_of(problem) == "NLP" or back_end is other or other.refuses(problem) else other


def _confirmed(problem: Problem, back_end: BackEnd, settings: Settings, point: Solution, separate: bool) -> bool:
    """Whether another solver finds no better point of a convex programme with kinks, which has no multipliers of ours.

    The claim of that solver itself stands, and any of a programme that it does not take.
    """
    other = _reference(problem, back_end)
    answer = None if other is None else answer_of(problem, other, replace(settings, options={}), separate)
    if answer is None or not answer.values:
        return True
    best = _judged(problem, answer, point)
    assert best.residuals is not None
    outside = best.residuals.violation > tolerance(settings.accuracy)
    return outside or relative_gap(point.objective, best.objective, problem.scale) <= GRADIENT * tolerance(
        settings.accuracy)


def _stationary(residuals: Residuals, accuracy: float) -> bool:
    """Whether a point is stationary as far as was measured; not where that is not known."""
    limit = tolerance(accuracy)
    return residuals.stationarity <= GRADIENT * limit and residuals.complementarity <= limit


def _contradictory(problem: Problem) -> bool:
    """Whether the constraints of a bilinear programme contradict each other: its descents cannot tell."""
    return RankOneForm.of(problem) is not None and bool(problem.constraint_names) and not satisfiable(
        problem, list(problem.constraint_names))


def _without_point(problem: Problem, answer: Answer, back_end: BackEnd, settings: Settings) -> tuple[Status, str]:
    """Judge a claim that comes without a point."""
    name = back_end.name
    if answer.status in (Status.OPTIMAL, Status.LOCAL, Status.INACCURATE):
        return Status.FAILED, f"{name} claims success, but returned no point"
    if answer.status is Status.INFEASIBLE:
        if judge(problem, problem.start, {}).residuals.violation < 1e-9:
            return Status.FAILED, f"{name} claims infeasibility, but the start satisfies every constraint"
    if answer.status is Status.INFEASIBLE and satisfiable(problem, list(problem.constraint_names)):
        if all(one.limit.member.is_dcp() for one in problem.constraints()):  # the relaxation is exact
            return Status.FAILED, f"{name} claims infeasibility, but no constraints contradict each other"
        if class_of(problem) == "NLP":  # descents end where they can't go on, and say this of any place
            return Status.FAILED, f"{name} claims infeasibility, which no convex relaxation of the constraints confirms"
    if answer.status is Status.UNBOUNDED:
        if all(isinstance(term, Squares) for term in problem.terms) or (
                statement_of(problem).objective.expr.is_nonneg()):
            return Status.FAILED, f"{name} claims that there is no minimum, but the objective is never below zero"
        other = _reference(problem, back_end)
        found = None if other is None else answer_of(problem, other, replace(settings, options={}), False)
        if found is not None and found.status is Status.OPTIMAL:
            return Status.FAILED, f"{name} claims that there is no minimum, but {REFERENCE} finds one"
    return answer.status, answer.word


def _status(answer: Answer, residuals: Residuals, accuracy: float, name: str) -> tuple[Status, str]:
    """Turn a claim and our measurements into a status: success at a bad point is downgraded."""
    limit = tolerance(accuracy)
    claims = answer.status in (Status.OPTIMAL, Status.LOCAL)
    outside = residuals.violation > limit
    amount = f"constraint {residuals.worst!r} is violated by {residuals.violation:.1e} (relative)" if outside else ""
    if answer.status is Status.INFEASIBLE and not outside:
        return Status.FAILED, f"{name} claims infeasibility at a point that satisfies every constraint"
    # steps along a valley may never meet the solver's own test, and end where ours are met
    arrived = answer.status is Status.LIMIT and not outside and np.isfinite(residuals.stationarity) and (
        _stationary(residuals, accuracy))
    if answer.status not in (Status.OPTIMAL, Status.LOCAL, Status.INACCURATE) and not arrived:
        return answer.status, f"{answer.word}; {amount}" if amount else answer.word
    if outside:
        if residuals.violation > FALSE_CLAIM:
            return Status.FAILED, f"{name} claims success, but {amount}" if claims else f"{answer.word}; {amount}"
        return Status.INACCURATE, amount
    if not np.isnan(residuals.stationarity) and not _stationary(residuals, accuracy):
        return Status.INACCURATE, (
            f"{name + ' claims success' if claims else answer.word}, but the point is not stationary: "
            f"residual {residuals.stationarity:.1e}, complementarity {residuals.complementarity:.1e}")
    if not claims and not np.isfinite(residuals.stationarity):
        return Status.INACCURATE, answer.word
    return Status.LOCAL, ""


def _refuted(problem: Problem, point: Solution, bound: Bound, accuracy: float) -> bool:
    """Whether the dual bound of a convex programme leaves room for a better point, beyond the tolerance."""
    if bound.proved or bound.method == TANGENT or not np.isfinite(bound.value) or class_of(problem) == "NLP":
        return False
    return relative_gap(point.objective, bound.value, problem.scale) > tolerance(accuracy)


def _proof(problem: Problem, back_end: BackEnd, settings: Settings, point: Solution, separate: bool
           ) -> tuple[Solution, Bound | None]:
    """Ask for a proof; what the attempt proposes as a better start, and a wider search, may lead to a better point."""
    bound, start = proof_of(problem, point.values, point.duals)
    if bound is None:
        return point, None
    if start is not None and not bound.proved:
        point, bound = _lowered(problem, start, back_end, settings, point, bound, separate)
    if not bound.proved and back_end.thorough and relative_gap(point.objective, bound.value, problem.scale) > OPEN:
        wider = replace(settings, options={**back_end.thorough, **settings.options})
        point, bound = _lowered(problem, problem.start, back_end, wider, point, bound, separate)
    return point, bound


def _lowered(problem: Problem, start: Values, back_end: BackEnd, settings: Settings, point: Solution, bound: Bound,
             separate: bool) -> tuple[Solution, Bound]:
    """Solve again from a start, and certify the point found there where it lies lower."""
    answer = answer_of(problem.beginning(start), back_end, settings, separate)
    if answer.values:
        again = _judged(problem, answer, point)
        assert again.residuals is not None and point.residuals is not None
        lower = again.objective < point.objective - 1e-10 * abs(point.objective)
        if lower and again.residuals.violation <= max(point.residuals.violation, 1e-9):
            point, bound = again, proof_of(problem, again.values, again.duals)[0] or bound
    return point, bound


def proof_of(problem: Problem, values: Values, duals: Values) -> tuple[Bound | None, Values | None]:
    """Return a bound on the objective from a point and its multipliers, and a better start that the attempt proposes.

    No bound where the problem is not convex and nothing is known of its terms, or where none can be formed.
    """
    x = {name: np.asarray(values[name], dtype=float) for name in problem.start}
    if problem.no_proof:
        return Bound.none(problem.no_proof), None
    if callable(problem.proof):
        return problem.proof(problem, x, duals)
    if RankOneForm.of(problem) is not None:
        return certify_rank_one(problem, x)
    if (groups := GroupSparseForm.of(problem)) is not None:
        return certify_groups(problem, groups, x, duals), None
    if (matrix := LowRankForm.of(problem)) is not None:
        return certify_low_rank(problem, matrix, x, duals), None
    match problem.terms:
        case (Squares(lifted=RankOne(), z=z), NuclearNorms()) if z == tuple(problem.start):
            return certify_nuclear(problem, x, duals), None
    kind = class_of(problem)
    try:
        return (None if kind == "NLP" else certify_convex(problem, x, duals, kind == "QP")), None
    except (ValueError, NotImplementedError, TypeError):  # no gradient in CVXPY, or a multiplier of another shape
        return None, None
