"""Run cells on a Dask cluster, in the same worker processes as on one machine, one per thread of a Dask worker.

The limits of a cell hold and its crash is a row as on one machine. If a Dask worker dies, Dask gives its cells to
another one; every row is yielded once.
"""

import json
import pickle
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Any

from optid.data.clusters import PACKAGES, connected, difference
from optid.errors import ClusterError, StudyError
from optid.studies.execution import cluster_worker
from optid.studies.execution.cell import lost_row, run_cell
from optid.studies.grid import Cell, content_hash, determining
from optid.studies.storage.rows import CRASHED, ERROR

TICK = 1.0  # seconds between checks of the cluster
AHEAD = 2  # cells submitted per thread of the cluster: one runs, one waits
DESERTED = 300.0  # seconds without workers until that is an error; batch systems replace workers within minutes
AGAIN = 5.0  # seconds to fetch a row; it is lost if its worker died just after the cell, which then runs again
TURNS = 3  # times a cell is submitted; each time the cluster gives it up when several of its workers have died
SHIPPED = 1 << 30  # bytes of data files that are sent to a worker that does not have them

Row = dict[str, Any]


def execute(cells: Iterable[Cell], function: Callable[[Cell], Mapping[str, Any]] = run_cell, *,
            scheduler: Any) -> Iterator[Row]:
    """Run every cell on the cluster of a scheduler and yield its row, as `workers.execute`.

    Data files are read in place where a worker has the same content under the same path, else they are sent to it once.
    The scheduler is given as for `optid.data.clusters.connected`.

    Raises:
        ClusterError: no scheduler, no worker, workers with other versions (also those that join later), or a lost
            scheduler.
        StudyError: a function that cannot be imported by name, or worker processes that do not start.
    """
    todo = deque(cells)
    try:
        packed = pickle.dumps(function)
    except Exception as error:
        raise StudyError(f"workers cannot import {function!r}: {error}") from None
    with connected(scheduler, packages(todo)) as client:
        flight = _PendingCell(client, packed)
        try:
            yield from flight.rows(todo)
        finally:
            flight.end()


def packages(cells: Iterable[Cell]) -> list[str]:
    """Return the distributions that determine the results of the cells."""
    found = (name for cell in cells for name in _versions(cell) if not name.startswith("source of "))
    return list(dict.fromkeys([*PACKAGES, *found]))


def _versions(cell: Cell) -> dict[str, str]:
    return determining(cell.formulation_name, cell.solver_name, cell.data_source.system is not None)


class _PendingCell:
    """The submitted cells of a cluster."""

    def __init__(self, client: Any, function: bytes) -> None:
        self._client, self._function = client, function
        self._name = f"optid-{uuid.uuid4().hex[:12]}"
        self._landed: SimpleQueue[Any] = SimpleQueue()
        self._cells: dict[Any, Cell] = {}  # by future
        self._turns: Counter[tuple[str, int]] = Counter()  # of cells whose Dask workers died
        self._count = 0
        self._looked = self._peopled = monotonic()
        self._threads = sum(client.nthreads().values())

    def rows(self, todo: deque[Cell]) -> Iterator[Row]:
        while todo or self._cells:
            while todo and len(self._cells) < AHEAD * max(self._threads, 1):
                cell = todo.popleft()
                try:
                    packed = pickle.dumps(cell)
                except Exception as error:
                    yield lost_row(cell, ERROR, f"the cell cannot be sent to a worker: {error}")
                else:
                    self._send(cell, packed)
            with suppress(Empty):
                if row := self._taken(self._landed.get(timeout=TICK)):
                    yield row
            self._look()

    def end(self) -> None:
        """Cancel the submitted cells and end the worker processes of this study."""
        with suppress(Exception):  # the cluster may be gone
            if self._client.status == "running":
                self._client.cancel(list(self._cells), force=True)
                self._client.run(cluster_worker.end, self._name, on_error="ignore")

    def _send(self, cell: Cell, packed: bytes, contents: Sequence[bytes] | None = None) -> None:
        self._count += 1
        try:
            with warnings.catch_warnings():  # Dask finds data files large
                warnings.simplefilter("ignore", UserWarning)
                future = self._client.submit(cluster_worker.run, self._name, self._function, packed, contents,
                                             key=f"{self._name}-{self._count}", pure=False)
        except Exception as error:  # nothing of this cell: the connection to the scheduler has gone
            raise ClusterError(f"the scheduler takes no more cells ({type(error).__name__}: {error}). Rows so far are "
                               "kept; start it and run the study again.") from error
        self._cells[future] = cell
        future.add_done_callback(self._landed.put)

    def _taken(self, future: Any) -> Row | None:
        """Return the row of a completed cell; None where it is sent or runs again."""
        from distributed import KilledWorker

        cell = self._cells[future]
        try:
            if future.status == "error":  # fetching it would leave a complaint in the log
                raise future.exception(timeout=AGAIN)
            answer = future.result(timeout=AGAIN)
        except KilledWorker as error:  # a cell cannot kill a Dask worker, but it may have been there by chance
            self._forget(future)
            self._turns[cell.identity] += 1
            turns = self._turns[cell.identity]
            if turns < TURNS:
                self._send(cell, pickle.dumps(cell))
                return None
            count = turns * (error.allowed_failures + 1)
            return lost_row(cell, CRASHED, f"{count} Dask worker{'s' * (count > 1)} died while they had it")
        except (ClusterError, StudyError):
            raise
        except BaseException as error:
            if isinstance(error, TimeoutError) and future.status != "error":
                future.add_done_callback(self._landed.put)
                return None
            if future.status in ("cancelled", "lost"):
                raise ClusterError(f"the scheduler went away or gave the study up ({type(error).__name__}).") from error
            if not isinstance(error, Exception):
                raise
            if future.status != "error":  # the cell ended, but its row was lost
                raise ClusterError(f"a row was not received ({type(error).__name__}: {error}). Rows so far are kept; "
                                   "run the study again.") from error
            answer = lost_row(cell, ERROR, f"the Dask worker could not run it: {type(error).__name__}: {error}")
        self._forget(future)
        if answer is None:
            return self._sent_with_files(cell)
        there = json.loads(answer["versions"])
        if text := difference({name: v for name, v in _versions(cell).items() if name in there}, there):
            raise ClusterError(f"a worker on {answer['machine']} has other packages: {text}. Install the same versions "
                               "there, and start again: the rows so far are kept.")
        return answer

    def _forget(self, future: Any) -> None:
        del self._cells[future]
        future.release()

    def _sent_with_files(self, cell: Cell) -> Row | None:
        entry = cell.data_source
        names = ", ".join(entry.files)
        try:
            size = sum(Path(name).stat().st_size for name in entry.files)
            if size > SHIPPED:
                return lost_row(cell, ERROR, f"a worker does not have {names}, which is too large to be sent there "
                                             f"({size / 1e6:.0f} MB): put it where every worker sees the same path")
            contents = [Path(name).read_bytes() for name in entry.files]
            if content_hash(entry) != cell.data_hash:
                return lost_row(cell, ERROR, f"{names} changed while the study ran")
        except OSError as error:
            return lost_row(cell, ERROR, f"a worker does not have {names}, and it cannot be sent there: {error}")
        self._send(cell, pickle.dumps(cell), contents)
        return None

    def _look(self) -> None:
        now = monotonic()
        if now - self._looked < TICK:
            return
        self._looked = now
        if self._client.status != "running":
            raise ClusterError("the scheduler went away. Rows so far are kept; start it and run the study again.")
        self._threads = sum(self._client.nthreads().values())
        if self._threads:
            self._peopled = now
        elif now - self._peopled > DESERTED:
            raise ClusterError(f"the cluster has had no worker for {DESERTED:.0f} s. Rows so far are kept; start "
                               "workers and run the study again.")

