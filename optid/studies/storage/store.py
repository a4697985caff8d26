"""The database of a study: one SQLite file in WAL mode, one row per cell and repetition.

Every row is committed on arrival, so that a killed run loses only the cells being run; others may read during a run,
and several processes may write. SQLite recovers an interrupted transaction by itself.
"""

import json
import os
import platform
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import DatabaseError, DataError, LookupFailed, StudyError, nearest
from optid.studies.storage.rows import COLUMNS, DONE, NAMES, SCHEMA_VERSION, columns, complete

PATIENCE = 30.0  # seconds to wait for another writer
LABELS = ("study", "data", "formulation", "solver", "file")
"""Columns that do not determine a result: a row takes those of its study as it is now."""
STALE = 600.0  # seconds without a new row after which a run on another machine counts as ended

Row = dict[str, Any]

_LIST = ", ".join(f'"{name}"' for name in NAMES)
_STEPS = ", ".join(["study", "rows.key", "repetition", "data", "formulation", "rows.solver", *(
    f"json_extract(step.value, '$.{name}') AS {alias}" for name, alias in (
        ("step", "step"), ("solver", "solver_used"), ("programs", "programs"), ("reached", "reached"),
        ("iterations", "iterations"), ("seconds", "seconds")))])
_OF_STUDY = "(:study IS NULL OR study = :study)"


class Store:
    """An open database; a context manager that closes it. To write, it is created if it does not exist.

    Raises:
        DatabaseError: no such file, not a database of studies, a damaged one or one of another version.
    """

    def __init__(self, path: str | Path, write: bool = False) -> None:
        self.path = Path(path)
        if not write and not self.path.is_file():
            raise DatabaseError(f"{self.path}: no such database; `optid study run` makes one")
        if not self.path.parent.is_dir():
            raise DatabaseError(f"{self.path} cannot be written: No such file or directory: {self.path.parent}")
        if write and not self.path.exists():
            self._make()
        if self.path.is_dir():
            raise DatabaseError(f"{self.path} cannot be opened: Is a directory")
        with self._named("opened"):
            try:
                self._connection = _connected(self.path, write)
            except sqlite3.DatabaseError:
                _check_kind(self.path)
                raise
            try:
                self._check()
            except BaseException:
                self._connection.close()
                raise

    def __enter__(self) -> "Store":
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    @contextmanager
    def _named(self, verb: str) -> Iterator[None]:
        """Turn errors of SQLite into a DatabaseError that names the file."""
        try:
            yield
        except (sqlite3.Error, OSError, UnicodeError) as error:
            known = isinstance(error, sqlite3.OperationalError)  # a full disk, a folder that cannot be written
            hint = "" if known else ". Where it is damaged, take another copy, or remove it and run the study again"
            raise DatabaseError(f"{self.path} cannot be {verb}: {error}{hint}") from error

    def _make(self) -> None:
        """Create the file under another name first, so that other processes find all of it or nothing."""
        from optid import __version__

        new = self.path.with_name(f"{self.path.name}.{platform.node()}.{os.getpid()}.new")
        schema = ", ".join(f'"{c.name}" {c.sql}{" NOT NULL" if c.always else ""}' for c in COLUMNS)
        tables = {"rows": f"{schema}, PRIMARY KEY (study, key, repetition)", "superseded": schema,
                  "studies": "study TEXT PRIMARY KEY, description TEXT",
                  "runs": "study TEXT PRIMARY KEY, machine TEXT, process INTEGER, since TEXT, seen TEXT",
                  "meta": "name TEXT PRIMARY KEY, value TEXT"}
        try:
            with self._named("written"), closing(sqlite3.connect(new, isolation_level=None)) as connection:
                connection.execute("PRAGMA journal_mode = WAL")
                for table, its_columns in tables.items():
                    connection.execute(f"CREATE TABLE {table} ({its_columns}) STRICT")
                connection.execute(f"CREATE VIEW steps AS SELECT {_STEPS} FROM rows, json_each(rows.steps) AS step")
                connection.executemany("INSERT INTO meta VALUES (?, ?)", [
                    ("schema version", str(SCHEMA_VERSION)), ("made by", f"optid {__version__}")])
            with self._named("written"), suppress(FileExistsError):  # another process was first
                os.link(new, self.path.resolve())
        finally:
            for rest in new.parent.glob(new.name + "*"):
                rest.unlink()

    def _check(self) -> None:
        tables = {name for (name,) in self._connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"rows", "superseded", "studies", "runs", "meta"} <= tables:
            raise DatabaseError(f"{self.path} is an SQLite file, but not a database of studies (it has "
                                f"{', '.join(sorted(tables)) or 'no tables'}); give another file name")
        meta = dict(self._connection.execute("SELECT name, value FROM meta"))
        if (version := meta.get("schema version", "unknown")) != str(SCHEMA_VERSION):
            made = f" (made by {meta['made by']})" if "made by" in meta else ""
            raise DatabaseError(f"{self.path} has schema version {version}{made}; this is version {SCHEMA_VERSION}. "
                                "Export it with the optid that made it, or give another file")
        for table in ("rows", "superseded"):
            found = tuple(row[1] for row in self._connection.execute(f"PRAGMA table_info({table})"))
            if found != NAMES:
                raise DatabaseError(f"{self.path}: table {table} does not have the columns of a study (`optid study "
                                    "schema` lists them); use another copy")

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._named("written"), self._connection:  # which commits, or rolls back
            self._connection.execute("BEGIN IMMEDIATE")
            yield

    def _all(self, statement: str, values: Mapping[str, Any] | Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        with self._named("read"):
            return self._connection.execute(statement, values).fetchall()

    def copy(self) -> "Store":
        """Return a copy in memory, whose changes leave the file as it is."""
        other = object.__new__(Store)
        other.path, other._connection = self.path, sqlite3.connect(":memory:", isolation_level=None)
        try:
            with self._named("read"):
                self._connection.backup(other._connection)
        except BaseException:
            other._connection.close()
            raise
        return other

    # -- rows ------------------------------------------------------------------------------------------------------

    def append(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Complete rows and write them in one transaction; they replace earlier rows of the same cells.

        `DatabaseError` if they cannot be written, as on a full disk; `ValueError` for a row against the schema. Nothing
        is changed then.
        """
        whole = [tuple(complete(row).values()) for row in rows]
        with self._transaction():
            self._connection.executemany(f"INSERT OR REPLACE INTO rows ({_LIST}) VALUES ({_marks(NAMES)})", whole)
            for row in rows[-1:]:
                self._connection.execute("UPDATE runs SET seen = ? WHERE study = ?", [_now(), row["study"]])

    def finished_rows(self, study: str | None = None) -> set[tuple[str, int]]:
        """Return (key, repetition) of every row, or of those of one study."""
        return set(self._all(f"SELECT key, repetition FROM rows WHERE {_OF_STUDY}", {"study": study}))

    def labels(self) -> dict[tuple[str, str, int], tuple[Any, ...]]:
        """Return {(study, key, repetition): values of `LABELS`} of every row."""
        found = self._all(f"SELECT key, repetition, {', '.join(LABELS)} FROM rows")
        return {(values[0], key, repetition): values for key, repetition, *rest in found if (values := tuple(rest))}

    def rows_of(self, study: str | None, identified: Iterable[tuple[str, int]]) -> list[dict[str, Any]]:
        """Return rows by (key, repetition) as written, in this order; missing ones are left out.

        Without a study there is one row of each, "done" before others, then the newest.
        """
        rows = ({c.name: bool(v) if c.kind == "flag" and v is not None else v for c, v in zip(COLUMNS, values)}
                for values in self._all(f"SELECT {_LIST} FROM rows WHERE {_OF_STUDY} "
                                        "ORDER BY outcome = :done, started, study", {"study": study, "done": DONE}))
        found = {(row["key"], row["repetition"]): row for row in rows}
        return [found[identity] for identity in identified if identity in found]

    def values(self, study: str | None = None) -> list[tuple[Any, ...]]:
        """Return the rows as tuples in the order of the columns, sorted by the moments their cells started."""
        return self._all(f"SELECT {_LIST} FROM rows WHERE {_OF_STUDY} ORDER BY started, key, repetition",
                         {"study": study})

    # -- a study and its rows ----------------------------------------------------------------------------------------

    @contextmanager
    def claim(self, study: str) -> Iterator[None]:
        """Hold a study, so that no other run computes its cells.

        `DatabaseError` if another run holds it: a live process on this machine, or one on another machine that wrote a
        row within the last `STALE` seconds.
        """
        here = platform.node(), os.getpid()
        with self._transaction():
            for machine, process, since, seen in self._connection.execute(
                    "SELECT machine, process, since, seen FROM runs WHERE study = ?", [study]).fetchall():
                if _lives(machine, process, since, seen):
                    raise DatabaseError(f"another run of {study!r} is writing to {self.path}: process {process} on "
                                        f"{machine} since {since[:19]} UTC. Wait until it ends, stop it, or give "
                                        "another database")
            self._connection.execute("INSERT OR REPLACE INTO runs VALUES (?, ?, ?, ?, ?)",
                                     [study, *here, _now(), _now()])
        try:
            yield
        finally:
            with suppress(sqlite3.Error):  # a full disk: the process ends, and with it its claim
                self._connection.execute("DELETE FROM runs WHERE study = ? AND machine = ? AND process = ?",
                                         [study, *here])

    def keep(self, study: str, cells: Collection[tuple[str, int]]) -> None:
        """Make the rows of a study those of the current grid, given by (key, repetition).

        Rows of other cells (entries removed, other data, options or versions) move to the table ``superseded``, and the
        newest superseded row of each cell without a row comes back: an entry removed and restored is not run again.
        """
        asked = "study = ? AND (key, repetition) {} (SELECT key, repetition FROM grid)"
        with self._transaction():
            self._connection.execute("CREATE TEMP TABLE IF NOT EXISTS grid (key TEXT, repetition INTEGER, "
                                     "PRIMARY KEY (key, repetition))")
            self._connection.execute("DELETE FROM grid")
            self._connection.executemany("INSERT INTO grid VALUES (?, ?)", cells)
            self._move("rows", "superseded", asked.format("NOT IN"), [study])
            back = self._connection.execute(
                f"SELECT key, repetition, max(started) FROM superseded WHERE {asked.format('IN')} AND (key, repetition)"
                " NOT IN (SELECT key, repetition FROM rows WHERE study = ?) GROUP BY key, repetition",
                [study, study]).fetchall()
            for row in back:
                self._move("superseded", "rows", "study = ? AND key = ? AND repetition = ? AND started = ?",
                           [study, *row])

    def set_aside(self, study: str, outcomes: Sequence[str]) -> None:
        """Move the rows of a study with these outcomes to the table ``superseded``, so that their cells run again."""
        with self._transaction():
            self._move("rows", "superseded", f"study = ? AND outcome IN ({_marks(outcomes)})", [study, *outcomes])

    def _move(self, source: str, target: str, chosen: str, values: Sequence[str]) -> None:
        self._connection.execute(f"INSERT OR REPLACE INTO {target} ({_LIST}) SELECT {_LIST} FROM {source} "
                                 f"WHERE {chosen}", values)
        self._connection.execute(f"DELETE FROM {source} WHERE {chosen}", values)

    def count_superseded(self, study: str | None = None) -> dict[tuple[str, str, str], int]:
        """Return {(data, formulation, solver): rows set aside}: kept, but in no report."""
        found = self._all("SELECT data, formulation, solver, count(*) FROM superseded "
                          f"WHERE {_OF_STUDY} GROUP BY data, formulation, solver", {"study": study})
        return {(data, formulation, solver): count for data, formulation, solver, count in found}

    def describe(self, study: str, description: str) -> None:
        """Store the text of a study file, which replaces the earlier one."""
        with self._transaction():
            self._connection.execute("INSERT OR REPLACE INTO studies VALUES (?, ?)", [study, description])

    def descriptions(self) -> dict[str, str]:
        """Return {study: text of its study file}; "" for one with records in memory."""
        return dict(self._all("SELECT study, description FROM studies"))

    def data_hashes(self) -> dict[tuple[str, str], set[str]]:
        """Return {(study, data label): hashes of the data files behind the rows}; simulated data have none."""
        found = self._all("SELECT study, data, json_group_array(DISTINCT data_hash) FROM rows "
                          "WHERE data_hash IS NOT NULL GROUP BY study, data")
        return {(study, data): set(json.loads(hashes)) for study, data, hashes in found}


def _check_kind(path: Path) -> None:
    """Explain why SQLite refused a file: another kind of file, or one that cannot be opened.

    Not for a database that is open in this process: closing a second handle would release the locks of the process
    (POSIX), and another process would remove pending writes.
    """
    try:
        head = b""
        with suppress(FileNotFoundError), path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise DatabaseError(f"{path} cannot be opened: {error.strerror}") from None
    if head and head != b"SQLite format 3\0":
        raise DatabaseError(f"{path} is a file of another kind, not a database of studies: give the one that `optid "
                            "study run` wrote, or another name for a new one")


def _connected(path: Path, write: bool) -> sqlite3.Connection:
    place, shared = path.resolve().as_uri(), os.access(path.parent, os.W_OK)
    mode = "rwc" if write else "rw" if shared and os.access(path, os.W_OK) else "ro"  # writers clean up
    connection = sqlite3.connect(f"{place}?mode={mode}", uri=True, timeout=PATIENCE, isolation_level=None)
    try:
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA synchronous = NORMAL")  # in WAL mode a killed process loses nothing with it
        connection.execute(f"PRAGMA query_only = {'OFF' if write else 'ON'}")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError:
        connection.close()
        if write or shared or path.with_name(path.name + "-wal").exists():
            raise
        # A reader in WAL mode shares memory through a file; in a folder that cannot be written nobody else writes.
        connection = sqlite3.connect(f"{place}?immutable=1", uri=True, isolation_level=None)
    except BaseException:
        connection.close()
        raise
    return connection


def _lives(machine: str, process: int, since: str, seen: str) -> bool:
    """Whether the process that claimed a study still runs it."""
    if machine != platform.node():
        return (datetime.now(UTC) - datetime.fromisoformat(seen)).total_seconds() < STALE
    import psutil

    try:
        return psutil.Process(process).create_time() <= datetime.fromisoformat(since).timestamp()
    except psutil.Error:
        return False


def _now() -> str:
    return datetime.now(UTC).isoformat()


def _marks(values: Sequence[Any]) -> str:
    return ", ".join("?" * len(values))


def read_rows(path: str | Path) -> dict[str, np.ndarray]:
    """Return the rows of a database as `rows.columns` does, sorted by the moments their cells started.

    These are datetime64[us], and repetitions int64. A run may be writing to the database. `DatabaseError` as `Store`.
    """
    with Store(path) as store:
        values = dict(zip(NAMES, zip(*store.values())))
    try:
        starts = [text.partition("+")[0] for text in values.get("started", ())]
        return columns(values) | {"started": np.array(starts, dtype="datetime64[us]"),
                                  "repetition": np.array(values.get("repetition", ()), dtype=np.int64)}
    except (DataError, AttributeError, TypeError, ValueError, OverflowError) as error:
        raise DatabaseError(f"{path} holds invalid values ({error}): use another copy") from None


def rows_of_one(path: str | Path, study: str | None = None) -> Any:
    """Return the rows of a study as `read_rows` does, or those of a .parquet file that `optid study export` wrote.

    Raises:
        StudyError: the database holds several studies, and none is given.
        LookupFailed: it holds none of this title.
        DatabaseError: the database cannot be read.
    """
    rows = _exported(Path(path)) if str(path).endswith(".parquet") else read_rows(path)
    titles = list(dict.fromkeys(rows["study"].tolist()))
    if study is None:
        if len(titles) > 1:
            listed = ", ".join(f"{title!r} ({int(np.sum(rows['study'] == title)):,} rows)" for title in titles)
            raise StudyError(f"{path} holds {len(titles)} studies: {listed}. Name one: --study TITLE (study=TITLE)")
        return rows
    if study not in titles:
        raise LookupFailed(f"no study in {path} is called {study!r}. {nearest(study, titles)}")
    return {name: values[rows["study"] == study] for name, values in rows.items()}


def _exported(path: Path) -> dict[str, np.ndarray]:
    import polars

    try:
        frame = polars.read_parquet(path)
        rows = {name: frame[name].to_numpy() for name in frame.columns if name in NAMES}
    except BaseException as error:  # polars panics on some damaged files, with an exception of its own base
        if isinstance(error, KeyboardInterrupt):
            raise
        raise DatabaseError(f"{path} cannot be read: {str(error).partition(chr(10))[0]}") from None
    if "study" not in rows:
        raise DatabaseError(f"{path} is no export of a study: it has no column 'study'")
    return rows
