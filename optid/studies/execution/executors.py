"""Run cells on this machine or with an executor of `concurrent.futures`, each in a process of its own."""

import json
import pickle
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from functools import partial

from optid.errors import StudyError
from optid.studies.execution.apart import CellRunner, Row, RowFunction, run_apart
from optid.studies.execution.cell import lost_row, run_cell, versions_of
from optid.studies.grid import Cell
from optid.studies.storage.rows import ERROR, KILLED

MOST = 256  # cells that an executor has at a time
KEPT = "The rows so far are kept; run the study again"


def run_here(cells: Iterable[Cell], function: RowFunction = run_cell, *, workers: int) -> Iterator[Row]:
    """Run every cell in a process of this machine and yield its row, in the order of completion.

    Closing the generator, or an exception in it such as KeyboardInterrupt, ends all processes at once.

    Args:
        cells: what to run, within their own limits.
        function: makes a row of a cell; the processes import it by its name.
        workers: number of processes.

    Raises:
        StudyError: processes that do not start, or a function that cannot be imported.
    """
    todo, runner = list(cells), CellRunner(function)
    if not todo:
        return
    pool = ThreadPoolExecutor(min(workers, len(todo)), "optid-cell")
    try:
        yield from _rows(pool, runner, todo, workers + 1)
    finally:
        runner.end()
        pool.shutdown(cancel_futures=True)


def run_with(executor: Executor, cells: Iterable[Cell], function: RowFunction = run_cell) -> Iterator[Row]:
    """Run every cell with an executor, there in a process of its own, and yield its row; the executor stays open.

    Closing the generator cancels the cells that have not begun.

    Raises:
        StudyError: the executor broke, or takes no cells.
    """
    yield from _rows(executor, partial(run_apart, function=function), list(cells), MOST)


def _rows(executor: Executor, task: Callable[[Cell], Row], cells: list[Cell], most: int) -> Iterator[Row]:
    todo, pending = deque(cells), dict[Future[Row], Cell]()
    try:
        while todo or pending:
            while todo and len(pending) < most:
                cell = todo.popleft()
                try:
                    pickle.dumps(cell)
                except Exception as error:
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
