"""Run a study into its database: what has a row already is not run again, and what is finished is never lost."""

import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from optid.errors import DatabaseError, StudyError, nearest
from optid.studies.definition.description import Study
from optid.studies.execution.cell import known, lost_row
from optid.studies.grid import Cell, cells, check_unchanged, left
from optid.studies.storage import database
from optid.studies.storage.journal import Journal, kept, locked
from optid.studies.storage.opening import InUse
from optid.studies.storage.rows import COLUMNS, NAMES, OUTCOMES, REFUSED

BATCH, EVERY = 500, 2.0  # rows, and seconds, after which what is in the journal goes to the database
WAIT = 0.2  # seconds that it then waits for a reader of the database; it is safe in the journal, and tried again later

Row = dict[str, Any]
Executor = Callable[[Sequence[Cell]], Iterator[Row]]
"""Takes cells and yields one row for each, in any order; closing the generator ends whatever it started."""
Progress = Callable[[int, int, Row | None], None]


def run(study: Study, db: str | Path, *, workers: int | None = None, scheduler: Any = None,
        progress: Progress | None = None, accept_changed_data: bool = False, retry: str | Sequence[str] = (),
        execute: Executor | None = None) -> list[Row]:
    """Run the cells of a study that have no row yet.

    Args:
        study: what to run.
        db: the database; made when it is not there.
        workers: processes on this machine; one per core when not given.
        scheduler: Dask scheduler whose workers run the cells instead, as for `optid.data.clusters.connected`: an
            address, a scheduler file or a Client.
        progress: called with (cells that have a row, all cells, None) before work starts and with the row after each.
        accept_changed_data: run cells again whose data file is not what it was; their former rows are set aside.
        retry: outcomes whose rows are set aside and run again, such as "crashed" or "time limit"; rows of other
            studies with such an outcome are not taken over.
        execute: another way to run cells, in place of ``workers`` and ``scheduler``.

    Returns:
        The rows of all cells of the study, in the order of its grid.

    Raises:
        StudyError: a data file changed since the last run, or an unknown outcome to retry.
        DatabaseError: another run is writing to the database, it is of another schema version, or it cannot be written
            (what is finished is kept then, and the next run goes on from there).
        ClusterError: the cluster cannot be used.
    """
    db = Path(db).resolve()  # a link and what it leads to have one journal
    retry = (retry,) if isinstance(retry, str) else retry
    for outcome in retry:
        if outcome not in OUTCOMES:
            raise StudyError(f"no outcome is called {outcome!r}. {nearest(outcome, OUTCOMES)}")
    grid = cells(study)
    if execute is None:
        execute = _executor(grid, workers, scheduler)
    with locked(db):
        writer = _Writer(db)
        try:
            if not accept_changed_data:
                check_unchanged(grid, database.data_hashes(db))
            database.keep(db, study.name, [(cell.key, cell.repetition) for cell in grid])
            database.set_aside(db, study.name, retry)
            if relabelled := _relabelled(db, grid, retry):
                writer.write(relabelled)
            todo = left(grid, database.finished(db, study.name))
            database.describe(db, study.name, _description(study))
            _work(todo, len(grid), execute, writer, progress)
        finally:
            writer.close()
        return database.rows_of(db, study.name, [(cell.key, cell.repetition) for cell in grid])


def run_to_frame(study: Study, db: str | Path | None = None, **settings: Any) -> Any:
    """Run a study and return its rows as a pandas frame, or as a list of dictionaries where pandas is not installed.

    Args:
        study: what to run.
        db: the database; one that is thrown away when not given.
        settings: as in `run`.
    """
    if db is None:
        with tempfile.TemporaryDirectory() as folder:
            return _framed(run(study, Path(folder) / "study.duckdb", **settings))
    return _framed(run(study, db, **settings))


def _executor(grid: Sequence[Cell], workers: int | None, scheduler: Any) -> Executor:
    if workers is not None and scheduler is not None:
        raise StudyError("workers are processes of this machine; a cluster has its own. Leave workers or scheduler out")
    if scheduler is not None:
        from optid.studies.execution import cluster

        cluster.check(grid, scheduler)
        return lambda todo: cluster.execute(todo, scheduler=scheduler)
    from optid.studies.execution import workers as processes

    processes.check_number(workers)
    return lambda todo: processes.execute(todo, workers=workers)


class _Writer:
    """The one writer of a database: every row to the journal at once, batches of rows to the database."""

    def __init__(self, db: Path) -> None:
        self._db, self._journal = db, Journal(db)
        self._pending: list[Row] = []
        self.added = 0  # rows that are safe in the journal
        self._full, self._since = BATCH, time.monotonic()
        try:
            self.absorb()  # refuses a database of another version before anything is written
        except BaseException:
            self._journal.close()
            raise

    def absorb(self) -> None:
        """Write to the database what is in the journal and not in the database, wherever a run was stopped."""
        there = database.identities(self._db)
        self.write([row for row in kept(self._db) if (row["study"], row["key"], row["repetition"]) not in there])

    def add(self, row: Row) -> None:
        self._journal.add(row)
        self.added += 1
        if not self._pending:
            self._since = time.monotonic()
        self._pending.append(row)
        if len(self._pending) >= self._full or time.monotonic() - self._since > EVERY:
            try:
                self.write(self._pending, WAIT)
            except InUse:
                self._full, self._since = len(self._pending) + BATCH, time.monotonic()

    def flush(self) -> None:
        try:
            if self._pending:
                self.write(self._pending)
        except InUse as error:
            raise InUse(f"{error}. Nothing is lost: {self._journal.path} has the rows, and the next run of the study "
                        "takes them over") from None

    def write(self, rows: Sequence[Row], patience: float | None = None) -> None:
        """Write rows to the database; the journal is empty then."""
        database.append(self._db, rows, patience)
        self._pending, self._full = [], BATCH
        self._journal.clear()

    def close(self) -> None:
        self._journal.close()


def _work(todo: list[Cell], total: int, execute: Executor, writer: _Writer, progress: Progress | None) -> None:
    """Run cells and write their rows down as they come, until all are there or something stops it."""
    done = total - len(todo)
    if progress is not None:
        progress(done, total, None)
    expected = {(cell.key, cell.repetition) for cell in todo}
    with closing(_all_rows(todo, execute)) as rows:
        try:
            for row in rows:
                identity = (row["key"], row["repetition"])
                if identity not in expected:  # a cluster may run a cell twice when a machine is lost
                    continue
                expected.remove(identity)
                writer.add(row)
                done += 1
                if progress is not None:
                    progress(done, total, row)
            writer.flush()
        except InUse:
            raise
        except DatabaseError as error:
            kept = total - len(todo) + writer.added
            raise DatabaseError(f"{error}. {kept:,} of {total:,} cells are kept. Where the disk is full, free space; "
                                "the same run goes on from there") from error
        except BaseException:  # Ctrl-C at any point, a lost cluster
            with suppress(InUse):  # the journal has the rows
                writer.absorb()
            raise
    if expected:
        raise StudyError(f"{len(expected)} cells of {total} came back without a row; run the study again")


def _all_rows(todo: Sequence[Cell], execute: Executor) -> Generator[Row, None, None]:
    """Rows of the cells that nobody needs to run, then those of the others."""
    yield from (lost_row(cell, REFUSED, cell.refusal) for cell in todo if cell.refusal)
    yield from execute([cell for cell in todo if not cell.refusal])


def _relabelled(db: Path, grid: Iterable[Cell], retry: Sequence[str]) -> list[Row]:
    """Rows for cells that were run under other labels or for another study: what determines them is the same.

    Those with an outcome that is to be run again are left out.
    """
    places = database.identities(db)
    wanted, found = [], {(key, repetition) for _, key, repetition in places}
    for cell in grid:
        if (cell.key, cell.repetition) in found:
            facts = known(cell)
            if places.get((cell.study, cell.key, cell.repetition)) != facts["place"]:
                wanted.append((cell, facts))
    former = {(row["key"], row["repetition"]): row
              for row in database.rows_of(db, None, [(cell.key, cell.repetition) for cell, _ in wanted])
              if row["outcome"] not in retry}
    return [{**former[cell.key, cell.repetition], **{name: facts[name] for name in LABELS}} for cell, facts in wanted
            if (cell.key, cell.repetition) in former]


LABELS = ("place", "study", "data", "formulation", "solver", "file")


def _description(study: Study) -> str:
    try:
        return study.to_toml()
    except StudyError:  # records in memory, and other values that TOML does not hold, have no text
        return ""


def _framed(rows: list[Row]) -> Any:
    try:
        import pandas as pd
    except ImportError:
        return rows
    kinds = {"number": "float64", "integer": "Int64", "flag": "bool"}
    frame = pd.DataFrame(rows, columns=list(NAMES))
    frame = frame.astype({c.name: "boolean" if c.kind == "flag" and not c.always else kinds[c.kind]
                          for c in COLUMNS if c.kind in kinds})
    frame["started"] = pd.to_datetime(frame["started"], utc=True)
    return frame
