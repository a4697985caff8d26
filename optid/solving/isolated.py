"""Run a back end in a process of its own: a crash or an endless loop is an outcome, not the end of the program."""

import multiprocessing
import signal
import time
import warnings
from multiprocessing.connection import Connection

from optid.backends.back_end import Answer, BackEnd, Settings
from optid.errors import StructureError
from optid.program.program import Program
from optid.program.solution import Status

GRACE = 0.5  # seconds a solver has to notice its own time limit before it is killed


def run_isolated(back_end: BackEnd, program: Program, settings: Settings) -> Answer:
    """Run a back end on a copy of the programme in a forked child, which is killed shortly after the time limit.

    The answer is then ``Status.LIMIT``, and ``Status.FAILED`` when the child died by itself.

    Raises:
        StructureError: the back end refuses the programme.
    """
    if "fork" not in multiprocessing.get_all_start_methods():
        return back_end.run(program, settings)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_work, args=(sender, back_end, program, settings), daemon=True)
    started = time.monotonic()
    with warnings.catch_warnings():  # forking a process with threads is deprecated; the child runs one solver and ends
        warnings.simplefilter("ignore", DeprecationWarning)
        child.start()
    sender.close()
    limit = None if settings.time_limit is None else settings.time_limit + GRACE
    try:
        if receiver.poll(limit):
            answer = receiver.recv()
            if isinstance(answer, StructureError):
                raise answer
            return answer
        return Answer(Status.LIMIT, f"stopped after {time.monotonic() - started:.1f} s: it did not keep its time limit")
    except EOFError:
        child.join()
        return Answer(Status.FAILED, f"the solver's process died: {death(child.exitcode or 0)}")
    finally:
        if child.is_alive():
            child.kill()
        child.join()
        receiver.close()


def death(code: int) -> str:
    """Return the exit code of a process in words: the name of the signal where one killed it."""
    if code >= 0:
        return f"exit code {code}"
    return f"signal {signal.Signals(-code).name}" if -code in set(signal.Signals) else f"signal {-code}"


def _work(sender: Connection, back_end: BackEnd, program: Program, settings: Settings) -> None:
    try:
        answer: Answer | StructureError = back_end.run(program, settings)
    except StructureError as refusal:
        answer = refusal
    except Exception as error:
        answer = Answer(Status.FAILED, f"{type(error).__name__}: {error}")
    sender.send(answer)
    sender.close()
