"""Run cells on this machine or with an executor of `concurrent.futures`, each in a process of its own.

Whatever happens in that process, within the limits of time and memory of a cell, a row comes back. The processes are
those of `optid.processes`, each reused for several cells. A cell has a folder for what its process says at the end, and
for a row that is valid if the rest of the cell fails.
"""

import faulthandler
import json
import os
import resource
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from optid.child import limit_memory
from optid.errors import StudyError
from optid.packing import Unsendable, pack
from optid.processes import LONGEST, Worker, start_workers
from optid.solving.claims import GRACE
from optid.studies.execution import cell as cells
from optid.studies.execution.cell import lost_row, prepare, run_cell, versions_of, without_warm
from optid.studies.execution.machine import MB, resident_mb
from optid.studies.grid import Cell
from optid.studies.storage.rows import CRASHED, ERROR, KILLED, MEMORY_LIMIT, TIME_LIMIT, complete

TICK = 0.2  # seconds between looks whether a silent process is alive: a child of it may hold its connection
TRIES = 3  # processes that may end before a cell begins
KEPT_MB = 150.0  # memory that a process may hold of its cells without being replaced
TOLD, LAST = 100_000, 300  # bytes of the standard error that are searched, characters of it in a reason
FROM_OUTSIDE = ("signal SIGKILL", "signal SIGTERM")  # ends that no cell causes by itself
ROW, WORDS = "row.json", "words"  # files in the folder of a cell
MOST = 256  # cells that an executor has at a time
KEPT = "The rows so far are kept; run the study again"

Row = dict[str, Any]
RowFunction = Callable[[Cell], Mapping[str, Any]]


def run_here(todo: Iterable[Cell], function: RowFunction = run_cell, *, workers: int) -> Iterator[Row]:
    """Run every cell in a process of this machine and yield its row, in the order of completion.

    Closing the generator, or an exception in it such as KeyboardInterrupt, ends all processes at once.

    Args:
        todo: what to run, within their own limits.
        function: makes a row of a cell; the processes import it by its name.
        workers: number of processes.

    Raises:
        StudyError: processes that do not start, or a function that cannot be imported.
    """
    todo, runner = list(todo), CellRunner(function)
    if not todo:
        return
    pool = ThreadPoolExecutor(min(workers, len(todo)), "optid-cell")
    try:
        yield from _rows(pool, runner, todo, workers + 1)
    finally:
        runner.end()
        pool.shutdown(cancel_futures=True)


def run_with(executor: Executor, todo: Iterable[Cell], function: RowFunction = run_cell) -> Iterator[Row]:
    """Run every cell with an executor, there in a process of its own, and yield its row; the executor stays open.

    Closing the generator cancels the cells that have not begun.

    Raises:
        StudyError: the executor broke, or takes no cells.
    """
    yield from _rows(executor, partial(run_apart, function=function), list(todo), MOST)


def _rows(executor: Executor, task: Callable[[Cell], Row], todo: list[Cell], most: int) -> Iterator[Row]:
    left, pending = deque(todo), dict[Future[Row], Cell]()
    try:
        while left or pending:
            while left and len(pending) < most:
                cell = left.popleft()
                try:
                    pack(cell)
                except Unsendable as error:
                    yield lost_row(cell, ERROR, f"the cell cannot be sent to a worker: {error}")
                    continue
                try:
                    pending[executor.submit(task, cell)] = cell
                except Exception as error:  # nothing of this cell: the executor is shut down or broken
                    raise StudyError(f"the executor takes no more cells ({type(error).__name__}: {error}). {KEPT}."
                                     ) from error
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                yield _row(pending.pop(future), future)
    finally:
        for future in pending:
            future.cancel()


def _row(cell: Cell, future: "Future[Row]") -> Row:
    try:
        row = future.result()
    except StudyError:
        raise
    except (BrokenExecutor, CancelledError) as error:
        raise StudyError(f"the executor broke ({type(error).__name__}: {error}). {KEPT} with another one.") from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # of Dask, after it has tried the cell on several workers
            return lost_row(cell, KILLED, f"the workers of the executor died while they had it: {error}")
        return lost_row(cell, ERROR, f"the executor could not run it: {type(error).__name__}: {error}")
    there, here = json.loads(row["versions"]), versions_of(cell)
    if other := [name for name in here if name in there and there[name] != here[name]]:
        listed = ", ".join(f"{name}: {here[name]} here, {there[name]} there" for name in other)
        raise StudyError(f"a worker on {row['machine']} has other packages: {listed}. Install the same versions there. "
                         f"{KEPT}.")
    return row


# -- one cell in another process --------------------------------------------------------------------------------------


class CellRunner:
    """Runs cells, each call in another process, until it is ended.

    Args:
        function: makes the row of a cell; it must be importable by its name.

    Raises:
        StudyError: it is not.
    """

    def __init__(self, function: RowFunction = run_cell) -> None:
        self._function, self._lock, self._ended = function, threading.Lock(), False
        self._busy, self.idle = set[Worker](), list[Worker]()
        try:
            self._packed, self._prepare = pack(_run_here), pack(prepare if function is run_cell else bool)
            pack(function)
        except Exception as error:
            raise StudyError(f"workers cannot import {function!r}: {error}") from None

    def __call__(self, cell: Cell) -> Row:
        """Return the row of a cell, also where its process dies or is stopped at a limit.

        Raises:
            StudyError: no process starts.
        """
        with tempfile.TemporaryDirectory(prefix="optid-cell-", ignore_cleanup_errors=True) as name:
            try:
                worker = self._begun(pack((name, self._function, cell)))
            except Unsendable as error:
                return lost_row(cell, ERROR, f"the worker could not run it: {error}")
            folder, started, clock, keeps = Path(name), datetime.now(UTC), time.monotonic(), False
            try:
                if not _answers(worker, cell.time_limit + GRACE):
                    raise TimeoutError
                row, outcome, reason, keeps = worker.receive()
                return _checked(cell, row) if row is not None else _lost(cell, folder, outcome, reason, started, clock)
            except TimeoutError:
                reason = f"stopped after {time.monotonic() - clock:.1f} s; the limit is {cell.time_limit:g} s"
                return _lost(cell, folder, TIME_LIMIT, reason, started, clock)
            except ChildProcessError as end:
                return _lost(cell, folder, *_fate(str(end), _last_words(folder / WORDS), cell), started, clock)
            except Exception as error:
                return lost_row(cell, ERROR, f"the worker could not run it: {type(error).__name__}: {error}")
            finally:
                self._put_back(worker, keeps)

    def end(self) -> None:
        """End all processes, from any thread."""
        with self._lock:
            self._ended = True
            for worker in self._busy:
                worker.kill_process()
            while self.idle:
                self.idle.pop().kill()

    def _begun(self, arguments: bytes) -> Worker:
        """Return a process in which the cell of these packed arguments begins; one that ends before is replaced."""
        for _ in range(TRIES):
            with self._lock:
                worker = self.idle.pop() if self.idle else None
            worker = worker or self._started()
            with self._lock:
                self._busy.add(worker)
            try:
                if self._ended:
                    raise StudyError("the run has ended")
                worker.request(self._packed, arguments, quiet=True)
                worker.wait_until_begun()
                return worker
            except BaseException as error:
                self._put_back(worker, False)
                if not isinstance(error, ChildProcessError):
                    raise
        raise StudyError(f"{TRIES} workers in a row ended before a cell began")

    def _put_back(self, worker: Worker, keeps: bool) -> None:
        """Keep a process for another cell, or end it."""
        with self._lock:
            self._busy.discard(worker)
            if keeps and not self._ended:
                return self.idle.append(worker)
        worker.kill()

    def _started(self) -> Worker:
        """Return a process that has imported what cells need."""
        worker = None
        try:
            (worker,) = start_workers(1, self._prepare, pack(()), quiet=True)
            worker.receive()
            return worker
        except Exception as error:
            if worker is not None:
                self._put_back(worker, False)
            raise StudyError(f"a worker ended before it was ready: {type(error).__name__}: {error}") from None


def run_apart(cell: Cell, function: RowFunction = run_cell) -> Row:
    """Return the row of a cell from another process; the task of an executor."""
    runner = CellRunner(function)
    try:
        return runner(cell)
    finally:
        while runner.idle:
            runner.idle.pop().rest()


def _answers(worker: Worker, seconds: float) -> bool:
    """Wait for the answer of a process or its end; False where neither comes in time."""
    until = time.monotonic() + min(seconds, LONGEST)
    while (left := until - time.monotonic()) > 0:
        if worker.connection.poll(min(left, TICK)):
            return True
        if not worker.is_alive and not worker.connection.poll(0):
            raise ChildProcessError(worker.describe_death())
    return False


def _fate(end: str, said: str, cell: Cell) -> tuple[str, str]:
    """Return outcome and reason of a cell whose process ended like this, with these last words."""
    if any(word in said for word in ("bad_alloc", "memory allocation", "MemoryError")):
        return MEMORY_LIMIT, f"got no more memory ({said}); the limit is {cell.memory_limit:g} MB"
    if end in FROM_OUTSIDE:
        return KILLED, f"the worker was killed from outside ({end}); the next run runs the cell again"
    return CRASHED, f"the worker died: {', '.join(filter(None, [end, said]))}"


def _lost(cell: Cell, folder: Path, outcome: str, reason: str, started: datetime, clock: float) -> Row:
    """Return the row that was kept for a cell, else one with the outcome and the reason."""
    with suppress(OSError, ValueError):
        return without_warm(complete(json.loads((folder / ROW).read_text())), reason)
    return lost_row(cell, outcome, reason, started=started, total_s=time.monotonic() - clock)


def _checked(cell: Cell, content: Mapping[str, Any]) -> Row:
    """Return the row that a function returned, or one with the reason why it is invalid."""
    try:
        row = complete(content)
        if (row["key"], row["repetition"]) != cell.identity:
            raise ValueError(f"it is of another cell, {row['key'][:12]} {row['repetition']}")
    except ValueError as error:
        return lost_row(cell, ERROR, f"the function did not return a row: {error}")
    return row


def _last_words(path: Path) -> str:
    """Return where Python reports a crash, else the last line written; empty if there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TOLD))
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    fatal = [k for k, line in enumerate(lines) if line.startswith("Fatal Python error")]
    if fatal:
        said = lines[fatal[-1] - 1] if fatal[-1] and "alloc" in lines[fatal[-1] - 1] else ""
        places = [line for line in lines[fatal[-1]:] if line.startswith("File ")]
        return said or (f"at {places[0]}" if places else "")
    return lines[-1][-LAST:] if lines else ""


# -- in the other process ----------------------------------------------------------------------------------------------

_fresh_mb: float | None = None


def _run_here(folder: str, function: RowFunction, cell: Cell) -> tuple[Row | None, str, str, bool]:
    """Run a cell in this process, within its memory.

    Returns:
        The row; or None, an outcome and a reason if the function raised an exception; and whether the process holds
        little enough of this and earlier cells to run others.
    """
    global _fresh_mb
    held = resident_mb()
    _fresh_mb = held if _fresh_mb is None else min(_fresh_mb, held)
    with open(Path(folder) / WORDS, "wb") as file:
        os.dup2(file.fileno(), 2)
    faulthandler.enable(all_threads=False)  # a segmentation fault then says where
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))  # no files of crashes
    before = resource.getrlimit(resource.RLIMIT_AS)
    cells.kept_row = Path(folder) / ROW
    row, outcome, reason = None, "", ""
    try:
        limit_memory(int((cell.memory_limit - held) * MB))  # what is reserved and not used is free
        row = dict(function(cell))
    except MemoryError as error:
        outcome, reason = MEMORY_LIMIT, f"got no more memory ({error}); the limit is {cell.memory_limit:g} MB"
    except BaseException as error:
        outcome, reason = ERROR, f"{type(error).__name__}: {error}"
    finally:
        cells.kept_row = None
        resource.setrlimit(resource.RLIMIT_AS, before)
    return row, outcome, reason, resident_mb() < _fresh_mb + KEPT_MB
