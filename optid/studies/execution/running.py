"""Run a study into its database: cells with a row are not run again, and finished rows are never lost."""

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from optid.data.reduction import available_cores
from optid.errors import DatabaseError, StudyError, nearest
from optid.studies.definition import Definition
from optid.studies.execution.cell import known_columns, lost_row
from optid.studies.execution.executors import run_here, run_with
from optid.studies.grid import Cell, cells, check_unchanged, with_absolute_paths
from optid.studies.storage.rows import KILLED, OUTCOMES, REFUSED
from optid.studies.storage.store import LABELS, Store
from optid.studies.trial import check_data

Row = dict[str, Any]
Execution = Callable[[Sequence[Cell]], Iterator[Row]]
"""Yields one row for each cell, in any order; closing the generator ends all that it started."""
Progress = Callable[[int, int, Row | None], None]


def run(study: Definition, db: str | Path, *, workers: int | None = None, executor: Executor | Execution | None = None,
        progress: Progress | None = None, accept_changed_data: bool = False, retry: str | Sequence[str] = ()
        ) -> list[Row]:
    """Run the cells of a study that have no row yet.

    Args:
        study: what to run.
        db: the database; made when it is not there.
        workers: processes on this machine; one per core when not given.
        executor: of `concurrent.futures`, or one like it such as Dask's ``Client(...).get_executor()``, whose workers
            run the cells instead; they must see data files under the same path, and have the same versions. Or an
            `Execution` of your own.
        progress: called with (cells that have a row, all cells, None) before work starts and with the row after each.
        accept_changed_data: run cells again whose data file is not what it was; their former rows are set aside.
        retry: outcomes whose rows are set aside and run again, such as "crashed" or "time limit"; rows of other
            studies with such an outcome are not taken over.

    Returns:
        The rows of all cells of the study, in the order of its grid.

    Raises:
        StudyError: a data file changed since the last run, an unknown outcome to retry, or an executor that broke
            (what is finished is kept then).
        DatabaseError: another run is writing to the database, it is of another schema version, or it cannot be written
            (what is finished is kept then, and the next run goes on from there).
    """
    retry, grid = _checked(study, retry)
    if workers is not None and executor is not None:
        raise StudyError("workers are processes of this machine, an executor has its own: leave one of them out")
    if executor is None:
        execute: Execution = partial(run_here, workers=available_cores(workers, "workers", StudyError))
    else:
        execute = executor if callable(executor) else partial(run_with, executor)
    with Store(db, write=True) as store, store.claim(study.name):
        todo = _prepared(store, study, grid, accept_changed_data, retry)
        store.describe(study.name, _description(study))
        _work(todo, len(grid), execute, store, progress or (lambda *_: None))
        return store.rows_of(study.name, [cell.identity for cell in grid])


def plan(study: Definition, db: str | Path, *, accept_changed_data: bool = False, retry: str | Sequence[str] = ()
         ) -> tuple[list[Cell], list[Cell], str]:
    """Return what a run would do, without changing the database, which need not exist.

    Arguments and errors are those of `run`.

    Returns:
        All cells, those that a run would run, and a text on the rows that it would set aside.
    """
    retry, grid = _checked(study, retry)
    if not Path(db).exists():
        return grid, grid, ""
    with Store(db) as store, store.copy() as copy:
        todo = _prepared(copy, study, grid, accept_changed_data, retry)
        return grid, todo, describe_previous_run(copy, study)


def describe_previous_run(store: Store, study: Definition) -> str:
    """Return a text on the superseded rows of a study and the reasons; empty if there are none."""
    axes = {"data": study.data, "formulation": study.formulations, "solver": study.solvers}
    known_labels = [{entry.name for entry in entries} for entries in axes.values()]
    counts: Counter[str] = Counter()
    for labels, count in store.count_superseded(study.name).items():
        gone = [f"{axis} {label} is no longer in the study" for axis, label, names in zip(axes, labels, known_labels)
                if label not in names]
        counts[gone[0] if gone else ""] += count
    reasons = [f"{gone} ({count:,})" for gone, count in sorted(counts.items()) if gone]
    if counts[""]:
        reasons.append(f"former data, settings or versions, or run again ({counts['']:,})")
    total = counts.total()
    return f"{total:,} {'row is' if total == 1 else 'rows are'} set aside: {'; '.join(reasons)}" if total else ""


def _checked(study: Definition, retry: str | Sequence[str]) -> tuple[Sequence[str], list[Cell]]:
    """Return the outcomes to retry, and the cells of a study whose data can be read."""
    retry = (retry,) if isinstance(retry, str) else retry
    for outcome in retry:
        if outcome not in OUTCOMES:
            raise StudyError(f"no outcome is called {outcome!r}. {nearest(outcome, OUTCOMES)}")
    check_data(study)
    return retry, cells(study)


def _prepared(store: Store, study: Definition, grid: list[Cell], accept_changed_data: bool, retry: Sequence[str]
              ) -> list[Cell]:
    """Make the rows of a database those of the grid, and return the cells without a row."""
    if not accept_changed_data:
        check_unchanged(grid, store.data_hashes())
    store.keep(study.name, [cell.identity for cell in grid])
    store.set_aside(study.name, [KILLED, *retry])
    store.append(_relabelled(store, grid, retry))
    done = store.finished_rows(study.name)
    return [cell for cell in grid if cell.identity not in done]


def _work(todo: list[Cell], total: int, execute: Execution, store: Store, progress: Progress) -> None:
    done, expected = total - len(todo), {cell.identity for cell in todo}
    progress(done, total, None)
    with closing(_all_rows(todo, execute)) as rows:
        for row in rows:
            identity = (row["key"], row["repetition"])
            if identity not in expected:  # a cluster may run a cell twice when a machine is lost
                continue
            try:
                store.append([row])
            except DatabaseError as error:
                raise DatabaseError(f"{error}. {done:,} of {total:,} cells are kept. Where the disk is full, free "
                                    "space; the same run resumes from there") from error
            expected.remove(identity)
            done += 1
            progress(done, total, row)
    if expected:
        raise StudyError(f"{len(expected)} cells of {total} returned no row; run the study again")


def _all_rows(todo: Sequence[Cell], execute: Execution) -> Generator[Row, None, None]:
    yield from (lost_row(cell, REFUSED, cell.refusal) for cell in todo if cell.refusal)
    yield from execute([cell for cell in todo if not cell.refusal])


def _description(study: Definition) -> str:
    try:
        return replace(study, data=tuple(with_absolute_paths(entry, study.folder) for entry in study.data)).to_toml()
    except StudyError:  # records in memory, and other values that TOML does not hold, have no text
        return ""


def _relabelled(store: Store, grid: Iterable[Cell], retry: Sequence[str]) -> list[Row]:
    """Return rows of cells that were run under other labels or in another study, except outcomes to be retried."""
    there, wanted = store.labels(), {}
    any_study = {identity[1:] for identity in there}
    for cell in grid:
        if cell.identity in any_study:
            facts = known_columns(cell)
            labels = {name: facts[name] for name in LABELS}
            if there.get((cell.study, *cell.identity)) != tuple(labels.values()):
                wanted[cell.identity] = labels
    return [row | wanted[row["key"], row["repetition"]] for row in store.rows_of(None, wanted)
            if row["outcome"] not in (KILLED, *retry)]
