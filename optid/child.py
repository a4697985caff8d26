"""The code of a process that `optid.processes` starts: it receives functions, runs them and sends what they return."""

import importlib
import os
import pickle
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from optid.packing import REMEDY, Unsendable

BEGUN, STALE = "begun", "stale"  # messages before the result
IDLE = 60.0  # seconds after which a process that rests ends


def serve(connection: Connection) -> None:
    """Run the functions that come through a connection, until it is closed or the parent ends.

    A request is a pickled function, or None for that of the request before; its pickled arguments, or None to hold it
    for others; a memory limit, and whether to discard output. None announces a rest.
    """
    os.set_inheritable(connection.fileno(), False)
    _end_with_parent()
    function, known, resting = None, dict[str, tuple[str, int]](), False
    with suppress(EOFError, OSError):  # the parent is gone
        while not resting or connection.poll(IDLE):
            request = connection.recv()
            if request is None:
                function, resting = None, True
                continue
            if resting and _are_edited(known):
                connection.send(STALE)
                continue
            resting = False
            packed, arguments, memory, quiet = request
            importlib.invalidate_caches()
            try:
                function = function if packed is None else pickle.loads(packed)
                given = None if arguments is None else pickle.loads(arguments)
            except Exception as error:
                connection.send(_sealed(None, Unsendable(
                    f"another process cannot import what it is sent: {error}; {REMEDY}")))
                continue
            _note_modules(known)
            connection.send(BEGUN)
            if given is None:
                continue
            with _silenced(quiet):
                answer = _outcome(function, given, memory)
            del given
            for stream in (sys.stdout, sys.stderr):
                with suppress(AttributeError, OSError, ValueError):
                    stream.flush()
            connection.send(_sealed(*answer))
            del answer


def limit_memory(more: int) -> None:
    """Limit the address space of this process to so many bytes beyond those in use."""
    with suppress(ImportError, OSError, ValueError):  # a system without this figure
        import resource

        reserved = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        wanted = reserved + max(more, 0)
        resource.setrlimit(resource.RLIMIT_AS, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))


def _outcome(function: Any, arguments: tuple, memory: int | None) -> tuple[Any, Exception | None]:
    """Run the function and return (result, None) or (None, exception)."""
    try:
        with _memory_limited(memory):
            return function(*arguments), None
    except Exception as error:
        return None, error.with_traceback(None)  # whose frames would hold the arguments


def _sealed(result: Any, error: Exception | None) -> bytes:
    """Return the pickled outcome; one that no pickle holds, or that cannot be read again, is a RuntimeError."""
    try:
        packed = pickle.dumps((result, error))
        if error is not None:
            pickle.loads(packed)
    except Exception as failure:
        what = f"the result of the child process cannot be sent: {failure}" if error is None else (
            f"{type(error).__name__}: {error}")
        packed = pickle.dumps((None, RuntimeError(what)))
    return packed


@contextmanager
def _memory_limited(more: int | None) -> Iterator[None]:
    if more is None:
        yield
        return
    try:
        import resource
    except ImportError:
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit_memory(more)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextmanager
def _silenced(quiet: bool) -> Iterator[None]:
    """Discard what is written to standard output and error, also by compiled code."""
    if not quiet:
        yield
        return
    null, kept = os.open(os.devnull, os.O_WRONLY), {stream: os.dup(stream) for stream in (1, 2)}
    for stream in kept:
        os.dup2(null, stream)
    try:
        yield
    finally:
        for stream, copy in kept.items():
            with suppress(AttributeError, OSError, ValueError):
                (sys.stdout if stream == 1 else sys.stderr).flush()
            os.dup2(copy, stream)
            os.close(copy)
        os.close(null)


def _note_modules(known: dict[str, tuple[str, int]]) -> None:
    """Note for the modules imported since the last call when their files were last changed."""
    for name, module in list(sys.modules.items()):
        path = getattr(module, "__dict__", {}).get("__file__")
        if name not in known and isinstance(path, str):
            with suppress(OSError):
                known[name] = path, os.stat(path).st_mtime_ns


def _are_edited(known: dict[str, tuple[str, int]]) -> bool:
    """Whether the file of a module was changed since it was imported."""
    for path, changed in known.values():
        try:
            if os.stat(path).st_mtime_ns != changed:
                return True
        except OSError:  # a temporary file of the parent
            return True
    return False


def _end_with_parent() -> None:
    """End this process when the parent's end of the pipe at standard input closes, even inside a solver."""
    lifeline = os.dup(0)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    with suppress(ImportError, AttributeError, OSError):  # the signal ends code, too, that never lets threads run
        import fcntl

        signal.signal(signal.SIGIO, signal.SIG_DFL)
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)

    def watch() -> None:
        with suppress(OSError):
            while os.read(lifeline, 1):
                pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
