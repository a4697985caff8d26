"""A worker process as its parent sees it: start, give it a cell, look at it, end it."""

import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from typing import Any

import psutil

from optid.solving.isolated import death
from optid.studies.execution.cell import lost_row, without_warm
from optid.studies.execution.memory import MB
from optid.studies.grid import Cell

PROGRAM = (
    "import sys; sys.path[:] = {path!r}; from optid.studies.execution.worker import main; main({descriptor}, {parent})"
)
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
TOLD = 100_000  # bytes of a dead worker's last words that are looked at
LONGEST = 300  # characters of them in a reason
TALK = 10_000_000  # bytes of them that are kept on the disk


class WorkerProcess:
    """One process, its connection, and the cell it has in hand.

    A fresh interpreter, never a fork of a process with threads; it imports nothing of the caller's main module. It
    leads a session of its own, so that Ctrl-C in the terminal does not reach it and a kill takes its children along.

    Attributes:
        connection: to it.
        ready: whether it has imported everything.
        fresh_mb: its resident memory then.
        cell: what it has in hand, or None.
        kept: row of the cell in hand that stands where the rest of the cell comes to no end.
        peak_mb: largest memory seen since it was given the cell.
    """

    def __init__(self, function: bytes) -> None:
        ours, theirs = socket.socketpair()
        self._words = tempfile.TemporaryFile("ab+")
        path = [str(place) for place in sys.path]  # a script may have put a Path into it
        program = PROGRAM.format(path=path, descriptor=theirs.fileno(), parent=os.getpid())
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", program], pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=self._words, start_new_session=True,
                env={**dict.fromkeys(THREADS, "1"), **os.environ})
        self.connection = Connection(ours.detach())
        self.ready, self.fresh_mb = False, 0.0
        self.cell: Cell | None = None
        self.kept: dict[str, Any] | None = None
        self._begin(None)
        with suppress(OSError):  # it died; the end of the connection tells
            self.connection.send_bytes(function)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def seconds(self) -> float:
        """Time since it was started, or given the cell in hand."""
        return time.monotonic() - self._clock

    @property
    def ended(self) -> bool:
        """Whether the process is gone; a child of it may still hold the other end of the connection."""
        return self._process.poll() is not None

    def give(self, cell: Cell) -> bool:
        """Hand it a cell and say whether it took it: a worker that has died does not.

        Raises:
            Exception: whatever the cell raises when it is pickled; the worker stays idle then.
        """
        packed = pickle.dumps(cell)
        self._begin(cell)
        with suppress(OSError):
            if not self.ended:
                self.connection.send_bytes(packed)
                return True
        self.cell = None
        return False

    def take(self) -> None:
        """Take the cell out of its hands; its row is there."""
        self.cell = None

    def resident_mb(self, family: bool = False) -> float:
        """Return its resident memory, that of its children with it where asked for; 0 when it is gone."""
        try:
            process = psutil.Process(self.pid)
            members = [process, *process.children(recursive=True)] if family else [process]
        except psutil.Error:
            return 0.0
        return sum(_resident(member, shared=len(members) > 1) for member in members) / MB

    def shorten_words(self) -> None:
        """Forget what it wrote when that fills the disk."""
        if os.fstat(self._words.fileno()).st_size > TALK:
            self._words.truncate(0)

    def lost(self, outcome: str, reason: str) -> dict[str, Any]:
        """Return the row of the cell in hand, which it will not make: the one that was kept, where there is one."""
        if self.cell is None:
            raise ValueError("this worker has no cell in hand")
        if self.kept is not None:
            return without_warm(self.kept, reason)
        return lost_row(self.cell, outcome, reason, started=self._started, total_s=self.seconds,
                        peak_mb=self.peak_mb or None)

    def end(self, patience: float = 0.0) -> str:
        """Kill it with its children and return how it ended, in words.

        Args:
            patience: seconds to wait first for a process that is about to end by itself, whose exit code says why.
        """
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(patience)
        self.kill()
        self.connection.close()
        code = self._process.wait()
        words = self._last_words()
        self._words.close()
        return f"{death(code)}, {words}" if words else death(code)

    def kill(self) -> None:
        """Kill it with its children; the end of its connection follows."""
        children: Sequence[psutil.Process] = ()
        with suppress(psutil.Error):
            children = psutil.Process(self.pid).children(recursive=True)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        for child in children:
            with suppress(psutil.Error):
                child.kill()

    def _begin(self, cell: Cell | None) -> None:
        self.cell, self.kept, self.peak_mb = cell, None, 0.0
        self._started, self._clock = datetime.now(UTC), time.monotonic()
        self._words.truncate(0)

    def _last_words(self) -> str:
        """What it wrote last to its standard error: where Python says it crashed, or the last line."""
        self._words.seek(max(0, self._words.seek(0, os.SEEK_END) - TOLD))
        lines = [line.strip() for line in self._words.read().decode(errors="replace").splitlines() if line.strip()]
        fatal = [k for k, line in enumerate(lines) if line.startswith("Fatal Python error")]
        if fatal:
            places = [line for line in lines[fatal[-1]:] if line.startswith("File ")]
            return f"at {places[0]}" if places else ""
        return lines[-1][-LONGEST:] if lines else ""


def _resident(process: psutil.Process, shared: bool) -> int:
    """Bytes that a process holds, 0 when it is gone; of what others hold as well its share where the system tells.

    A process that was only just forked shares all it has with its parent.
    """
    with suppress(psutil.Error):
        if shared:
            with suppress(psutil.AccessDenied, AttributeError):
                return process.memory_full_info().pss
        return process.memory_info().rss
    return 0
