"""Solve a programme: look the solver up, refuse what it cannot take, run it, judge its point, prove it."""

import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from optid.backends.back_end import BackEnd, Settings
from optid.backends.choice import AUTO, choose, fallbacks, find
from optid.core.problem import Problem
from optid.core.statement import complete_values, for_solvers
from optid.errors import SolverRefused
from optid.processes import LONGEST
from optid.program.solution import Bound, Solution, Status, Times
from optid.solving.claims import FALSE_CLAIM, answer_of, verdict
from optid.solving.steps import Solvers
from optid.threads import one_thread

Procedure = Generator[Any, Solution, Any]  # of programmes or problems

ENDLESS = LONGEST / 2  # seconds; a longer time limit, such as infinity, is none
UNUSABLE = (Status.FAILED, Status.LIMIT)


@one_thread
def solve(problem: Problem, solver: str | BackEnd | Callable = "auto", *, accuracy: float = 1e-8,
          time_limit: float | None = None, isolate: bool | None = None, warm: bool = True, prove: bool = True,
          verbose: bool = False, **options: Any) -> Solution:
    """Solve one programme with one back end and judge the answer.

    Args:
        problem: the programme.
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
    problem = for_solvers(problem)
    chosen = ""
    if solver == "auto":
        back_end, chosen = choose(problem)
    elif isinstance(solver, str):
        back_end = find(solver)
    else:
        back_end = solver if isinstance(solver, BackEnd) else BackEnd(
            getattr(solver, "__name__", "callable"), frozenset({"LP", "QP", "SOCP", "SDP", "conic", "NLP"}), solver)
    refusal = back_end.refuses(problem)
    if refusal:
        raise SolverRefused(refusal)
    settings = Settings(accuracy, time_limit, warm, verbose, options)
    if time_limit is not None and time_limit > ENDLESS:
        settings, time_limit = replace(settings, time_limit=None), None
    separate = (time_limit is not None) if isolate is None else isolate

    def attempt(back_end: BackEnd, settings: Settings, chosen: str, spent: float = 0.0) -> Solution:
        clock = time.perf_counter()
        answer = answer_of(problem, back_end, settings, separate)
        seconds = spent + time.perf_counter() - clock
        base = Solution(answer.status, answer.word, back_end.name, chosen=chosen, scale=problem.scale,
                        iterations=answer.iterations, times=Times(solve=seconds, compile=answer.compile),
                        claim=answer.status)
        return verdict(problem, back_end, answer, base, settings, prove, separate).in_units(problem.unit)

    solution = attempt(back_end, settings, chosen)
    if not chosen or options:
        return solution
    outside = solution.residuals is not None and solution.residuals.violation > FALSE_CLAIM
    # of general nonlinear solvers that do not arrive another would spend its thousands of iterations as well
    ended = solution.status is Status.LIMIT and (outside or time_limit is None) and back_end.name not in AUTO["NLP"]
    if solution.status is Status.FAILED or ended:
        for other in fallbacks(problem, back_end.name):
            found = attempt(other, settings, f"{other.name}: in place of {back_end.name}")
            if found.status is Status.INFEASIBLE or (found.has_point and found.status not in UNUSABLE):
                return replace(found, failed=back_end.name)
    if solution.status is Status.INACCURATE:  # a hundredth of the tolerance may satisfy our measurements
        sharper = replace(settings, accuracy=settings.accuracy / 100)
        found = attempt(back_end, sharper, chosen, solution.times.solve)
        return found if found.status in (Status.LOCAL, Status.OPTIMAL) else solution
    return solution


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
    # called on first access to `Fit.model`: adds the parts that are expensive and rarely needed, such as a noise model,
    # and further figures
    extend: Callable[[], tuple[Any, dict[str, Any]]] | None = None
    # of the variables of the last programme at the model, where the model is not that of its solution
    values: Mapping[str, Any] | None = None
    # (name of a parameter, level, estimate, standard error, whether that is one under coloured errors) -> ends of its
    # interval by profile likelihood, None for parameters whose errors are all but quadratic
    profiles: Callable[[str, float, float, float, bool], tuple[float, float] | None] | None = None
    # the step whose programme the objective is that of, "" for the last one
    main: str = ""

    def run_extension(self) -> tuple[Any, dict[str, Any]]:
        """Return the completed model and further figures."""
        return self.extend() if self.extend else (self.model, {})

    @classmethod
    def of(cls, solution: Solution, model: Any, figures: Mapping[str, Any] | None = None) -> "Evidence":
        """Return that of one programme, with what was made of its solution, whether it has a point or not."""
        bound = solution.bound or Bound.none(solution.reason)
        return cls(model, solution.objective, bound, solution.status, solution.reason, figures or {})

    @classmethod
    def pointless(cls, status: Status, reason: str) -> "Evidence":
        """Return evidence without a model, with the reason."""
        return cls(None, float("nan"), Bound.none(reason), status, reason)


@dataclass(frozen=True)
class Outcome:
    """What a formulation ended with."""

    model: Any  # the model, or None where no programme had a point
    solution: Solution  # that of the step whose objective is that of the fit: of its last programme
    problem: Problem  # its programme
    steps: tuple[tuple[str, Solution], ...]  # every (name, solution) on the way; one entry for a plain programme
    # those of the evidence, and which solvers stood in for others
    figures: Mapping[str, Any] = field(default_factory=dict)
    # the last programme, with its solution, in which each user constraint stood: a procedure hands its constraints to
    # the steps they are about
    constrained: Mapping[str, tuple[Problem, Solution]] = field(default_factory=dict, repr=False)
    # with which a procedure judged the whole: solution and problem then do not belong together; the solution has
    # no bound where the evidence has a function that returns it
    evidence: Evidence | None = None


def run(problem: Problem | Procedure, solver: Any = "auto", *, options: Mapping[str, Any] | None = None,
        **settings: Any) -> Outcome:
    """Solve a programme, or drive a procedure that yields programmes and returns the model, with settings of `solve`.

    The time that a procedure itself takes, between its programmes, counts as building.

    Args:
        problem: the programme, or a procedure that yields programmes.
        solver: as for `solve`, or `Solvers`: of a procedure, steps that do not take the one word run as "auto".
        options: native options, for the programmes that a named solver solves.
        settings: others of `solve`.

    Raises:
        SolverRefused: no programme takes the solver; other errors as of `solve`.
    """
    constrained: dict[str, tuple[Problem, Solution]] = {}
    steps: list[tuple[str, Solution]] = []
    solvers, last = solver if isinstance(solver, Solvers) else Solvers(solver), {}
    procedure, solution, building = _alone(problem) if isinstance(problem, Problem) else problem, None, 0.0
    while True:
        clock = time.perf_counter()
        try:
            program = for_solvers(procedure.send(solution))  # pyright: ignore[reportArgumentType]
        except StopIteration as stop:
            found = stop.value
            building += time.perf_counter() - clock
            break
        building += time.perf_counter() - clock
        asked = solvers.of(program)
        stands_in = asked == "auto" and (solvers.word != "auto" or solvers.named)
        solution = solve(program, asked, **settings, **({} if stands_in else options or {}))
        steps.append((program.name, solution))
        constrained.update(dict.fromkeys(program.constraint_names, (program, solution)))
        last[program.name] = last[""] = program, solution
    evidence = found if isinstance(found, Evidence) else None
    program, solution = last[evidence.main if evidence else ""]
    solution = replace(solution, times=replace(solution.times, build=building))
    if evidence is not None:
        bound = None if callable(evidence.bound) else evidence.bound
        values = solution.values if evidence.values is None else complete_values(program, evidence.values)
        solution = replace(solution, objective=evidence.objective, bound=bound, status=evidence.status,
                           reason=evidence.reason, values=values)
        found = evidence.model
    figures = dict(evidence.figures) if evidence else {}
    if replaced := [one for _, one in steps if one.failed]:
        others = ", ".join(dict.fromkeys(one.solver for one in replaced))
        figures["solver fallback"] = (f"{replaced[0].failed} gave no usable answer for {len(replaced)} of {len(steps)} "
                                      f"programmes, which {others} solved")
    return Outcome(found, solution, program, tuple(steps), figures, constrained, evidence)


def _alone(problem: Problem) -> Procedure:
    """Solve one programme for the model of its solution."""
    solution = yield problem
    return problem.model(solution.values) if solution.has_point else None
