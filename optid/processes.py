"""Run a function in a forked child: a crash, an endless loop, too much memory is an outcome, not the program's end."""

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
    """Return what a function returns in a child of this process; its exceptions are raised here.

    Args:
        function: what it returns, and raises, is sent by pickle.
        arguments: of the function.
        seconds: after which the child is killed.
        memory: bytes that it may take beyond those of this process.
        quiet: whether what the child writes to the terminal is dropped.

    Raises:
        TimeoutError: the child was killed.
        ChildProcessError: it could not be started, or died by itself, with the signal or the exit code.
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
    """Let the system refuse this process so many bytes beyond those that it has reserved."""
    with suppress(ImportError, OSError, ValueError):  # a system without this figure
        import resource

        reserved = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        wanted = reserved + max(more, 0)
        resource.setrlimit(resource.RLIMIT_AS, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))


def death(code: int) -> str:
    """Return the exit code of a process in words: the name of the signal where one killed it."""
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
            sender.send((None, RuntimeError(f"the answer of a child process cannot be sent: {error}")))
        code = 0
    finally:
        os._exit(code)
