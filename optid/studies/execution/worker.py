"""What a worker process does: receive cells one after another and send back what the function returns.

On Linux it ends when its parent does (the thread that started it), whatever it is doing; elsewhere when it next looks
for a cell.
"""

import ctypes
import faulthandler
import os
import pickle
import resource
import signal
import sys
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any

READY, KEEP, ROW, RAISED = "ready", "keep", "row", "raised"
"""First word of every message to the parent."""

_parent: Connection | None = None


def main(descriptor: int, parent: int) -> None:
    """Work until the parent closes the connection.

    Args:
        descriptor: of one end of a pair of sockets, inherited. First comes a function with what prepares for it (or
            None), then cells.
        parent: its process id.
    """
    global _parent
    faulthandler.enable()  # a segmentation fault then says where
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))  # no files of crashes
    _die_with(parent)
    connection = Connection(descriptor)
    function, prepare = pickle.loads(connection.recv_bytes())
    if prepare is not None:
        prepare()
    connection.send((READY, os.getpid()))
    _parent = connection
    while True:
        try:
            cell = connection.recv_bytes()
        except EOFError:
            return
        connection.send(_answer(function, cell))


def keep(row: Mapping[str, Any]) -> None:
    """Let the parent keep the row of the cell under way, which stands where the rest of that cell comes to no end.

    Args:
        row: whole. Outside of a worker nothing is done.
    """
    if _parent is not None:
        _parent.send((KEEP, dict(row)))


def _answer(function: Callable[[Any], Any], packed: bytes) -> tuple[str, Any]:
    try:
        return ROW, dict(function(pickle.loads(packed)))
    except BaseException as error:  # the function makes rows of errors; this is one in the function itself
        return RAISED, f"{type(error).__name__}: {error}"


def _die_with(parent: int) -> None:
    """Let the system kill this process when its parent ends, even in the middle of a solver's loop."""
    if sys.platform == "linux":
        die = 1  # PR_SET_PDEATHSIG of <sys/prctl.h>
        ctypes.CDLL(None).prctl(die, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
