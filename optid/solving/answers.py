"""Run a back end, here or in its own process: whatever happens, an answer comes back."""

import time
from collections.abc import Mapping
from dataclasses import replace

from optid.backends.back_end import Answer, BackEnd, Settings
from optid.core.problem import Problem
from optid.core.statement import is_stated, statement_of
from optid.errors import SolverRefused, StructureError
from optid.packing import Unsendable
from optid.processes import run_apart
from optid.program.expressions import is_crash
from optid.program.solution import Status

GRACE = 0.5  # seconds after its time limit at which a solver is killed


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
