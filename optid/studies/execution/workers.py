"""Run cells in worker processes, one per core: reused over cells, killed and replaced when a cell does not behave.

The parent watches time, resident memory of the worker with its children, and life. Whatever happens to a worker, its
cell becomes a row.
"""

import os
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any

from optid.errors import StudyError
from optid.solving.isolated import GRACE
from optid.studies.execution.cell import lost_row, prepare, run_cell
from optid.studies.execution.worker import KEEP, RAISED, READY
from optid.studies.grid import Cell
from optid.studies.storage.rows import CRASHED, ERROR, MEMORY_LIMIT, TIME_LIMIT, complete

if TYPE_CHECKING:
    from optid.studies.execution.worker_process import WorkerProcess

TICK = 0.1  # seconds between looks at time and memory of the workers
FAMILY = 1.0  # seconds between looks at the children of workers, which take a scan of all processes
START = 300.0  # seconds a worker may take to import what it needs
STILLBORN = 5  # workers that end before they are ready, one after another, until that is an error
DYING = 2.0  # seconds to wait for the exit code of a worker whose connection has ended
KEPT, KEPT_MB = 0.5, 150.0  # share of the limit, and MB, that a worker may hold of earlier cells until it is replaced

Row = dict[str, Any]


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_number(workers: int | None) -> None:
    """Refuse a number of processes that is none.

    Raises:
        StudyError: not a whole number from 1.
    """
    if workers is not None and (not isinstance(workers, int) or isinstance(workers, bool) or workers < 1):
        raise StudyError(f"workers = {workers!r}: a whole number of processes, at least one, is needed")


def execute(cells: Iterable[Cell], function: Callable[[Cell], Mapping[str, Any]] = run_cell, *,
            workers: int | None = None) -> Iterator[Row]:
    """Run every cell in a worker and yield its row, in the order in which they end.

    Closing the generator, or an exception in it such as KeyboardInterrupt, ends all workers at once.

    Args:
        cells: what to run; their own limits hold.
        function: what makes a row of a cell; workers import it by its name.
        workers: number of processes; one per core when not given.

    Raises:
        StudyError: no whole number of workers, a function that has no name to import, workers that do not start (with
            their last words), or psutil is missing (with the pip line).
    """
    todo = deque(cells)
    check_number(workers)
    pool = Pool(function, min(workers or cores(), max(len(todo), 1)))
    try:
        yield from pool.run(todo)
    finally:
        pool.close()


class Pool:
    """The workers and what they have in hand; they are kept over several calls of `run`, one at a time.

    Raises:
        StudyError: psutil is missing (with the pip line), or a function that has no name to import.
    """

    def __init__(self, function: Callable[..., Any], size: int) -> None:
        try:
            from optid.studies.execution.worker_process import WorkerProcess
        except ModuleNotFoundError as error:
            if error.name != "psutil":
                raise
            raise StudyError("workers are watched with psutil: pip install 'optid[study]'") from None
        try:
            self._function = pickle.dumps((function, prepare if function is run_cell else None))
        except Exception as error:
            raise StudyError(f"workers cannot import {function!r}: {error}") from None
        self._hire = WorkerProcess
        self._size = size
        self._workers: list[WorkerProcess] = []
        self._stillborn = 0
        self._killed = False
        self._family_at = time.monotonic()

    def run(self, todo: deque[Cell]) -> Iterator[Row]:
        """Run the cells and yield their rows, as `execute`."""
        rows = self._employ(todo)
        while not self._killed and (rows or todo or any(worker.cell is not None for worker in self._workers)):
            yield from rows
            spoke = set(wait([worker.connection for worker in self._workers], TICK))
            rows = [row for worker in list(self._workers) if worker.connection in spoke for row in self._heard(worker)]
            rows += self._limited()
            rows += self._employ(todo)  # before rows are handed out: no worker waits for what the caller does with them

    def kill(self) -> None:
        """End all workers from another thread; `run` ends with the rows there are, and `close` is still to come."""
        self._killed = True
        for worker in list(self._workers):
            worker.kill()

    def close(self) -> None:
        """End all workers."""
        while self._workers:
            self._dismiss(self._workers[-1])

    def _among(self, which: Callable[["WorkerProcess"], bool]) -> list["WorkerProcess"]:
        return [worker for worker in self._workers if which(worker)]

    def _dismiss(self, worker: "WorkerProcess", patience: float = 0.0) -> str:
        self._workers.remove(worker)
        return worker.end(patience)

    def _employ(self, todo: deque[Cell]) -> list[Row]:
        """Give a cell to every idle worker and start workers while there are more cells than hands.

        Returns the rows of cells that cannot be handed over.
        """
        rows = []
        for worker in self._among(lambda w: w.ready and w.cell is None):
            if todo and worker.resident_mb() > max(KEPT * todo[0].memory_limit, worker.fresh_mb + KEPT_MB):
                self._dismiss(worker)
                continue
            while todo and worker.cell is None:
                cell = todo.popleft()
                try:
                    if not worker.give(cell):  # it died while it was idle, which says nothing of this cell
                        self._dismiss(worker)
                        todo.appendleft(cell)
                        break
                except Exception as error:
                    rows.append(lost_row(cell, ERROR, f"the cell cannot be sent to a worker: {error}"))
        free = len(self._among(lambda w: w.cell is None))
        while len(self._workers) < self._size and free < len(todo):
            self._workers.append(self._hire(self._function))
            free += 1
        return rows

    def _heard(self, worker: "WorkerProcess") -> list[Row]:
        try:
            word, content = worker.connection.recv()
        except Exception as error:  # the end of the connection, or half a message
            return self._died(worker, error)
        if word == READY:
            worker.ready, worker.fresh_mb, self._stillborn = True, worker.resident_mb(), 0
            return []
        if word == KEEP:
            worker.kept = content
            return []
        row = worker.lost(ERROR, content) if word == RAISED else _checked(worker, content)
        worker.take()
        return [row]

    def _died(self, worker: "WorkerProcess", error: Exception) -> list[Row]:
        lost = worker.cell is not None
        ended = self._dismiss(worker, DYING)
        if not worker.ready:
            self._count_stillborn(f"{ended} ({error})" if str(error) else ended)
        return [worker.lost(CRASHED, f"the worker died: {ended}")] if lost else []

    def _count_stillborn(self, ended: str) -> None:
        self._stillborn += 1
        if self._stillborn >= STILLBORN:
            raise StudyError(f"{STILLBORN} workers, one after another, ended before they could work: {ended}")

    def _limited(self) -> list[Row]:
        """Kill the workers whose cell has used up its time or memory, and find those that died unheard.

        The connection of a worker that died does not end while a child of it lives.
        """
        rows = []
        for worker in self._among(lambda w: w.ended and not w.connection.poll()):
            rows += self._died(worker, EOFError())
        family = time.monotonic() - self._family_at > FAMILY
        if family:
            self._family_at = time.monotonic()
        for worker in self._among(lambda w: not w.ready and w.seconds > START):
            self._dismiss(worker)
            self._count_stillborn(f"not ready after {START:.0f} s")
        for worker in self._among(lambda w: w.cell is not None and w.seconds > TICK):
            worker.shorten_words()
            memory = worker.resident_mb(family)
            worker.peak_mb = max(worker.peak_mb, memory)
            if found := _beyond(worker, memory):
                self._dismiss(worker)
                rows.append(worker.lost(*found))
        return rows


def _beyond(worker: "WorkerProcess", memory: float) -> tuple[str, str] | None:
    """Outcome and reason where the cell in hand is beyond its limits."""
    cell = worker.cell
    if cell is None:
        return None
    if memory > cell.memory_limit:
        return MEMORY_LIMIT, (f"held {memory:.0f} MB; the limit is {cell.memory_limit:g} MB, and a worker that does "
                              f"nothing takes {worker.fresh_mb:.0f}")
    if worker.seconds > cell.time_limit + GRACE:
        return TIME_LIMIT, f"stopped after {worker.seconds:.1f} s; the limit is {cell.time_limit:g} s"
    return None


def _checked(worker: "WorkerProcess", content: Mapping[str, Any]) -> Row:
    """The row a function returned, or one that says why it is none."""
    cell = worker.cell
    try:
        row = complete(content)
        if cell is None or (row["key"], row["repetition"]) != (cell.key, cell.repetition):
            raise ValueError(f"it is of another cell, {row['key'][:12]} {row['repetition']}")
    except ValueError as error:
        return worker.lost(ERROR, f"what the function returned is no row: {error}")
    return row
