"""Run a back end in a separate process: a crash or an endless loop is an outcome, not the end of the program."""

import os
import time

from optid.backends.back_end import Answer, BackEnd, Settings
from optid.errors import StructureError
from optid.processes import run_forked
from optid.program.program import Program
from optid.program.solution import Status

GRACE = 0.5  # seconds after its time limit at which a solver is killed


def run_isolated(back_end: BackEnd, program: Program, settings: Settings) -> Answer:
    """Run a back end on a copy of the programme in a forked child, which is killed shortly after the time limit.

    The answer is then ``Status.LIMIT``, and ``Status.FAILED`` when the child died by itself.

    Raises:
        StructureError: the back end refuses the programme.
    """
    if not hasattr(os, "fork"):
        return back_end.run(program, settings)
    started, limit = time.monotonic(), None if settings.time_limit is None else settings.time_limit + GRACE
    try:
        return run_forked(_answer, back_end, program, settings, seconds=limit)
    except TimeoutError:
        return Answer(Status.LIMIT, f"stopped after {time.monotonic() - started:.1f} s: it did not keep its time limit")
    except ChildProcessError as death:
        return Answer(Status.FAILED, f"the solver's process died: {death}")


def _answer(back_end: BackEnd, program: Program, settings: Settings) -> Answer:
    try:
        return back_end.run(program, settings)
    except StructureError:
        raise
    except Exception as error:
        return Answer(Status.FAILED, f"{type(error).__name__}: {error}")
