"""Run cells in worker processes, one per core: reused for several cells, replaced after a crash or a timeout.

pebble manages the processes, `worker` has the rest. Whatever happens to a worker, its cell becomes a row.
"""

import json
import multiprocessing.spawn
import os
import pickle
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, TimeoutError, wait
from contextlib import suppress
from datetime import UTC, datetime
from itertools import count
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any

from optid.data.reduction import available_cores
from optid.errors import StudyError
from optid.processes import death
from optid.solving.answers import GRACE
from optid.studies.execution.cell import lost_row, prepare, run_cell, without_warm
from optid.studies.execution.worker import RETIRED, last_words, run, start
from optid.studies.grid import Cell
from optid.studies.storage.rows import CRASHED, ERROR, MEMORY_LIMIT, TIME_LIMIT, complete
from optid.threads import THREADS

TICK = 0.2  # seconds between checks of the standard error of the workers
TALK = 10_000_000  # bytes of it that are kept on the disk
STILLBORN = 3  # successive pools whose workers end before they are ready, until that is an error

Row = dict[str, Any]


def execute(cells: Iterable[Cell], function: Callable[[Cell], Mapping[str, Any]] = run_cell, *,
            workers: int | None = None) -> Iterator[Row]:
    """Run every cell in a worker and yield its row, in the order of completion.

    Closing the generator, or an exception in it such as KeyboardInterrupt, ends all workers at once.

    Args:
        cells: what to run, within their own limits.
        function: makes a row of a cell; workers import it by its name.
        workers: number of processes; by default one per core.

    Raises:
        StudyError: no positive number, workers that do not start (with their error message), or as of `Pool`.
    """
    todo = deque(cells)
    pool = Pool(function, min(available_cores(workers, "workers", StudyError), max(len(todo), 1)))
    try:
        yield from pool.run(todo)
    finally:
        pool.close()


class Pool:
    """Worker processes for a function of cells, kept for several calls of `run`, one at a time.

    `StudyError` if pebble is missing, or for a function that cannot be imported by name.
    """

    def __init__(self, function: Callable[..., Any], size: int) -> None:
        try:
            import pebble
        except ModuleNotFoundError as error:
            if error.name != "pebble":
                raise
            raise StudyError("worker processes of a study need pebble: pip install 'optid[study]'") from None
        try:
            self._function = pickle.dumps((function, prepare if function is run_cell else None))
        except Exception as error:
            raise StudyError(f"workers cannot import {function!r}: {error}") from None
        self._pebble, self._size, self._pool = pebble, size, None
        self._notes = tempfile.TemporaryDirectory(prefix="optid-study-", ignore_cleanup_errors=True)
        self._folder = Path(self._notes.name)
        self._tokens, self._failed, self._killed = count(), 0, False

    def run(self, todo: deque[Cell]) -> Iterator[Row]:
        """Run the cells and yield their rows, as `execute`."""
        pending: dict[Future[Any], tuple[Cell, str]] = {}
        while (todo or pending) and not self._killed:
            while todo and len(pending) < self._size + 1:  # one waits, so that no worker does
                cell, token = todo.popleft(), str(next(self._tokens))
                try:
                    packed = pickle.dumps(cell)
                except Exception as error:
                    yield lost_row(cell, ERROR, f"the cell cannot be sent to a worker: {error}")
                    continue
                pending[self._scheduled(token, packed, cell)] = cell, token
            for future in wait(pending, TICK, FIRST_COMPLETED).done:
                cell, token = pending.pop(future)
                row = self._row(cell, token, future)
                if row is None:
                    todo.appendleft(cell)
                else:
                    yield row
            for path in self._folder.glob("*.words"):
                with suppress(OSError):
                    if path.stat().st_size > TALK:  # forget what workers wrote where that fills the disk
                        os.truncate(path, 0)

    def kill(self) -> None:
        """End all workers, from another thread; `run` ends with the rows so far, `close` must follow."""
        self._killed = True
        self._end_workers()

    def close(self) -> None:
        """End all workers."""
        self._end_workers()
        if self._pool is not None:
            self._pool.join()
        self._notes.cleanup()

    def _scheduled(self, token: str, packed: bytes, cell: Cell) -> "Future[Any]":
        if self._pool is None:
            self._pool = self._pebble.ProcessPool(self._size, initializer=start, context=_Context(), initargs=(
                str(self._folder), self._function, os.getpid()))
        arguments = (token, packed, cell.memory_limit)
        try:
            return self._pool.schedule(run, arguments, timeout=cell.time_limit + GRACE)
        except RuntimeError as error:  # the pool has just broken
            future: Future[Any] = Future()
            future.set_exception(BrokenExecutor(str(error)))
            return future

    def _row(self, cell: Cell, token: str, future: "Future[Any]") -> Row | None:
        """Return the row of a completed cell; None if another worker must run it."""
        begun = None  # process that has, or had, the cell, and when it began
        with suppress(OSError, ValueError):
            path = self._folder / token
            begun = int(path.read_text()), path.stat().st_mtime
        try:
            row, outcome, reason = future.result()
            self._failed = 0
            found = _checked(cell, row) if row is not None else self._lost(cell, token, begun, outcome, reason)
        except TimeoutError:
            seconds = time.time() - begun[1] if begun else cell.time_limit
            found = self._lost(cell, token, begun, TIME_LIMIT,
                               f"stopped after {seconds:.1f} s; the limit is {cell.time_limit:g} s")
        except BrokenExecutor:
            self._renew()
            return None
        except Exception as error:
            code = getattr(error, "exitcode", None)
            if code is None:
                found = lost_row(cell, ERROR, f"the row cannot be received: {type(error).__name__}: {error}")
            elif code == RETIRED or begun is None:
                return None
            else:
                said = last_words(self._folder / f"{begun[0]}.words")
                how = ", ".join(filter(None, [death(code), said]))
                fate = CRASHED, f"the worker died: {how}"
                if "bad_alloc" in said or "memory allocation" in said or "MemoryError" in said:
                    fate = MEMORY_LIMIT, f"got no more memory ({said}); the limit is {cell.memory_limit:g} MB"
                found = self._lost(cell, token, begun, *fate)
        if begun is not None and future.exception() is not None:
            _kill_group(begun[0])
            (self._folder / f"{begun[0]}.words").unlink(missing_ok=True)
        for name in (token, f"{token}.row"):
            (self._folder / name).unlink(missing_ok=True)
        return found

    def _lost(self, cell: Cell, token: str, begun: tuple[int, float] | None, outcome: str, reason: str) -> Row:
        """Return the row that was kept for a cell, else one with the outcome and the reason."""
        with suppress(OSError, ValueError):
            return without_warm(complete(json.loads((self._folder / f"{token}.row").read_text())), reason)
        times: dict[str, Any] = {} if begun is None else {"started": datetime.fromtimestamp(begun[1], UTC),
                                                          "total_s": time.time() - begun[1]}
        return lost_row(cell, outcome, reason, **times)

    def _renew(self) -> None:
        """Replace a broken pool; pebble breaks one when a worker without a cell ends."""
        if self._pool is None or self._pool.active:
            return  # replaced by another cell of the same pool
        self._pool.stop()
        self._pool.join()
        self._pool = None
        self._failed += 1
        if self._failed >= STILLBORN:
            files = sorted(self._folder.glob("*.words"), key=lambda path: path.stat().st_mtime)
            said = next(filter(None, (last_words(path) for path in reversed(files))), "no error message")
            raise StudyError(f"workers ended before they were ready, {STILLBORN} times in a row: {said}")

    def _end_workers(self) -> None:
        """Kill all workers with their children; pebble itself waits seconds for those that do not respond."""
        if self._pool is not None:
            self._pool.stop()  # else it replaces them
        for path in self._folder.glob("*.words"):
            _kill_group(int(path.stem))


def _kill_group(process: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process, signal.SIGKILL)


def _checked(cell: Cell, content: Mapping[str, Any]) -> Row:
    """Return the row that a function returned, or one with the reason why it is invalid."""
    try:
        row = complete(content)
        if (row["key"], row["repetition"]) != (cell.key, cell.repetition):
            raise ValueError(f"it is of another cell, {row['key'][:12]} {row['repetition']}")
    except ValueError as error:
        return lost_row(cell, ERROR, f"the function did not return a row: {error}")
    return row


_starting = threading.Lock()
_preparation = multiprocessing.spawn.get_preparation_data


def _without_main(name: str) -> dict[str, Any]:
    found = _preparation(name)
    path = [str(place) for place in found.get("sys_path", ())]  # a script may have put a Path into it
    return {key: value for key, value in found.items() if not key.startswith("init_main")} | {"sys_path": path}


class _Process(SpawnProcess):
    """A fresh interpreter with one thread for linear algebra, which imports nothing of the caller's main module.

    A daemon may start it, such as a Dask worker: it ends with its parent.
    """

    def start(self) -> None:
        """Start it with the settings of this class, which `multiprocessing` keeps in global places."""
        own = multiprocessing.process.current_process()._config  # type: ignore[attr-defined]
        with _starting:
            missing = [name for name in THREADS if name not in os.environ]
            daemon = own.pop("daemon", None)
            os.environ.update(dict.fromkeys(missing, "1"))
            multiprocessing.spawn.get_preparation_data = _without_main
            try:
                super().start()
            finally:
                multiprocessing.spawn.get_preparation_data = _preparation
                for name in missing:
                    del os.environ[name]
                if daemon is not None:
                    own["daemon"] = daemon


class _Context(SpawnContext):
    Process = _Process  # type: ignore[assignment]
