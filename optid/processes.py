"""Run functions in fresh interpreters, so that a crash, an endless loop or too much memory does not end the program.

No process is forked: a lock that another thread holds at that moment would stay locked in the child. Functions and
arguments travel as pickles, and nothing of the caller's main module is imported.
"""

import atexit
import os
import pickle
import signal
import socket
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import connection
from multiprocessing.spawn import get_executable
from typing import Any

from optid.child import BEGUN
from optid.packing import pack
from optid.threads import THREADS

LONGEST = 2e6  # seconds; the system calls for waiting take no longer times
BOOT = """
import sys
from multiprocessing import connection
sys.path[:] = sys.argv[2:]
from optid.child import serve
serve(getattr(connection, "PipeConnection", connection.Connection)(int(sys.argv[1])))
"""

_resting: dict[int, list["Worker"]] = defaultdict(list)  # workers without work, by the process that started them


def run_apart(function: Callable[..., Any], *arguments: Any, seconds: float | None = None, memory: int | None = None,
              quiet: bool = False, lenient: bool = False) -> Any:
    """Return the result of a function in another process; its exceptions are raised here.

    Args:
        function: it must be importable, its result and exceptions picklable.
        arguments: of the function.
        seconds: time limit of the call, at most `LONGEST`; importing what it needs does not count.
        memory: limit in bytes beyond the memory of the process.
        quiet: whether to discard the output of the process.
        lenient: whether functions among the arguments that cannot be sent may stay here, see `optid.packing.pack`.

    Raises:
        Unsendable: the function or an argument cannot be sent.
        TimeoutError: the time limit was exceeded.
        ChildProcessError: the process could not be started, or died, with the signal or the exit code.
    """
    packed = pack(function, lenient), pack(arguments, lenient)
    (worker,) = start_workers(1, *packed, memory, quiet)
    try:
        if not worker.connection.poll(seconds):
            raise TimeoutError
        result = worker.receive()
    except BaseException:  # also an interrupt; and a process in which something failed may be damaged
        worker.kill()
        raise
    worker.rest()
    return result


class Worker:
    """A fresh interpreter that runs one function at a time, and ends with this process."""

    def __init__(self) -> None:
        """Start it; a `ChildProcessError` if the system refuses."""
        self.surroundings = _surroundings()
        self.connection, theirs = _pipe()
        ends = [_above_standard(end) for end in os.pipe()]  # the process ends when the other end is closed
        self._lifeline, self.has_rested = ends[1], False
        try:
            self._process = _start(theirs.fileno(), ends[0])
        except OSError as error:
            self.connection.close()
            os.close(self._lifeline)
            raise ChildProcessError(f"no process can be started: {error.strerror}") from error
        finally:
            theirs.close()
            os.close(ends[0])

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def request(self, function: bytes | None, arguments: bytes | None, memory: int | None = None,
                quiet: bool = False) -> None:
        """Send packed arguments, if any yet, and the packed function unless it is that of the last request."""
        try:
            self.connection.send((function, arguments, memory, quiet))
        except OSError:
            raise ChildProcessError(self.describe_death()) from None

    def wait_until_begun(self) -> bool:
        """Wait until the function is about to run; False if the process must be replaced by a new one first.

        What importing function and arguments raises is raised here.
        """
        try:
            message = self.connection.recv()
        except (EOFError, OSError):
            raise ChildProcessError(self.describe_death()) from None
        return message == BEGUN if isinstance(message, str) else _opened(message)

    def receive(self) -> Any:
        """Return the result of the function, or raise its exception."""
        try:
            message = self.connection.recv()
        except (EOFError, OSError):
            raise ChildProcessError(self.describe_death()) from None
        return _opened(message)

    def rest(self) -> None:
        """Keep the process for another function; it ends if none comes for a while."""
        with suppress(OSError):
            self.connection.send(None)
        self.has_rested = True
        _resting[os.getpid()].append(self)

    def kill_process(self) -> None:
        """End the process and its children at once, from any thread; `kill` must follow."""
        if sys.platform != "win32":
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()

    def kill(self) -> None:
        """End the process at once."""
        self.kill_process()
        self._process.wait()
        self.connection.close()
        if self._lifeline >= 0:
            os.close(self._lifeline)
            self._lifeline = -1

    def describe_death(self) -> str:
        """Return how a process that is ending has ended, in words."""
        with suppress(subprocess.TimeoutExpired):
            return death(self._process.wait(10.0))
        return "it closed its connection"


def death(code: int) -> str:
    """Return the exit code of a process, or the signal that killed it, in words."""
    if code >= 0:
        return f"exit code {code}"
    return f"signal {signal.Signals(-code).name}" if -code in set(signal.Signals) else f"signal {-code}"


def start_workers(count: int, function: bytes, arguments: bytes | None = None, memory: int | None = None,
                  quiet: bool = False) -> list[Worker]:
    """Return workers that run a packed function, or hold it for requests of arguments if there are none yet.

    Raises:
        Unsendable: the function or an argument cannot be imported there.
        ChildProcessError: a process could not be started, or died.
    """
    request, workers = (function, arguments, memory, quiet), list[Worker]()
    try:
        for _ in range(count):
            workers.append(_rested() or Worker())
            with suppress(ChildProcessError):  # the wait says why
                workers[-1].request(*request)
        for i, worker in enumerate(workers):
            while not _is_begun(worker):  # one that rested: others may do as well, and a new one does not fail so
                worker.kill()
                worker = workers[i] = _rested() or Worker()
                worker.request(*request)
    except BaseException:
        for worker in workers:
            worker.kill()
        raise
    return workers


def _is_begun(worker: Worker) -> bool:
    """Wait until a function is about to run; False for a worker whose rest has ended it, or made it out of date."""
    try:
        return worker.wait_until_begun()
    except ChildProcessError:
        if worker.has_rested:
            return False
        raise


def _rested() -> Worker | None:
    """Return a worker that rests, with the paths, environment and output of this process, if there is one."""
    resting, wanted = _resting[os.getpid()], _surroundings()
    while True:
        try:
            worker = resting.pop()  # another thread may take the last one
        except IndexError:
            return None
        if worker.is_alive and worker.surroundings == wanted:
            return worker
        worker.kill()


def _opened(message: bytes) -> Any:
    result, error = pickle.loads(message)
    if error is not None:
        raise error
    return result


def _surroundings() -> tuple[Any, ...]:
    """Return what a process takes over at its start: paths, folder, environment, standard output and error."""
    folder = None
    with suppress(OSError):  # it may have been removed
        folder = os.getcwd()
    return tuple(map(str, sys.path)), folder, dict(os.environ), tuple(map(_identity, (1, 2)))


def _identity(stream: int) -> tuple[int, int] | None:
    """Return which file a standard stream is, None if it is closed."""
    try:
        found = os.fstat(stream)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _pipe() -> tuple[Any, Any]:
    """Return the two connections of a pipe."""
    if sys.platform == "win32":
        return connection.Pipe()
    return tuple(connection.Connection(_above_standard(end.detach())) for end in socket.socketpair())  # type: ignore[return-value]


def _above_standard(descriptor: int) -> int:
    """Move a file descriptor above those of input, output and error, which this process may have closed."""
    if sys.platform == "win32" or descriptor > 2:
        return descriptor
    import fcntl

    moved = fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 3)
    os.close(descriptor)
    return moved


def _start(handle: int, lifeline: int) -> "subprocess.Popen[Any]":
    """Start the interpreter with a connection and one thread; an interrupt at the terminal does not reach it."""
    if sys.platform == "win32":
        os.set_handle_inheritable(handle, True)
        more: dict[str, Any] = {"startupinfo": subprocess.STARTUPINFO(lpAttributeList={"handle_list": [handle]}),
                                "creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    else:
        more = {"pass_fds": (handle,), "process_group": 0}
    standard = {"stdout": 1, "stderr": 2}
    streams = {name: None if _identity(number) else subprocess.DEVNULL for name, number in standard.items()}
    # -P: without it a file of the working folder could hide a module of the standard library
    return subprocess.Popen([os.fsdecode(get_executable() or ""), "-P", "-c", BOOT, str(handle), *map(str, sys.path)],
                            stdin=lifeline, env={**dict.fromkeys(THREADS, "1"), **os.environ}, **streams, **more)


@atexit.register
def _end_resting() -> None:
    for worker in _resting.pop(os.getpid(), []):
        worker.kill()
