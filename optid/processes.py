"""Run a function in a forked child, so that a crash, an endless loop or too much memory does not end the program."""

import faulthandler
import os
import pickle
import signal
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any


def run_forked(function: Callable[..., Any], *arguments: Any, seconds: float | None = None, memory: int | None = None,
               quiet: bool = False) -> Any:
    """Return the result of a function in a child of this process; its exceptions are raised here.

    Args:
        function: its result and exceptions must be picklable.
        arguments: of the function.
        seconds: time limit.
        memory: limit in bytes beyond the memory of this process.
        quiet: whether to discard the output of the child.

    Raises:
        TimeoutError: the time limit was exceeded.
        ChildProcessError: the child could not be started, or died, with the signal or the exit code.
    """
    receiver, sender = Pipe(duplex=False)
    with warnings.catch_warnings():  # forking beside threads is deprecated; the child runs one function and ends
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            child = os.fork()  # multiprocessing allows none to its own workers
        except OSError as error:
            receiver.close()
            sender.close()
            raise ChildProcessError(f"no process can be started: {error.strerror}") from error
    if not child:
        receiver.close()  # so that sending fails, and does not wait, where the parent is gone
        _work(sender, function, arguments, memory, quiet)
    sender.close()
    try:
        if not receiver.poll(seconds):
            raise TimeoutError
        try:
            result, error = receiver.recv()
        except (EOFError, OSError):
            _, status = os.waitpid(child, 0)
            child = 0
            raise ChildProcessError(death(os.waitstatus_to_exitcode(status))) from None
    finally:
        receiver.close()
        if child:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
    if error is not None:
        raise error
    return result


def limit_memory(more: int) -> None:
    """Limit the address space of this process to so many bytes beyond those in use."""
    with suppress(ImportError, OSError, ValueError):  # a system without this figure
        import resource

        reserved = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        wanted = reserved + max(more, 0)
        resource.setrlimit(resource.RLIMIT_AS, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))


def death(code: int) -> str:
    """Return the exit code of a process, or the signal that killed it, in words."""
    if code >= 0:
        return f"exit code {code}"
    return f"signal {signal.Signals(-code).name}" if -code in set(signal.Signals) else f"signal {-code}"


def _work(sender: Connection, function: Callable[..., Any], arguments: tuple, memory: int | None, quiet: bool) -> None:
    """Run the function and send (result, None) or (None, exception); the child ends here."""
    code = 1
    try:
        if quiet:
            faulthandler.disable()
            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        if memory is not None:
            limit_memory(memory)
        try:
            answer = function(*arguments), None
        except Exception as error:
            answer = None, error
        try:
            sender.send(answer)
        except (TypeError, AttributeError, pickle.PicklingError) as error:
            sender.send((None, RuntimeError(f"the result of the child process cannot be sent: {error}")))
        code = 0
    finally:
        os._exit(code)
