"""Opening the database of a study: one DuckDB file, made when it is not there; refused when it is something else.

A writer opens the file for each batch and closes it again, so that a report can be made while the study runs and a
killed study leaves a database that opens. Every batch is one transaction.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from optid.errors import DatabaseError, OptidError
from optid.studies.storage.rows import COLUMNS, SCHEMA_VERSION

if TYPE_CHECKING:
    import duckdb

MAGIC = b"DUCK"  # bytes 8 to 11 of every file of DuckDB
PATIENCE = 10.0  # seconds to wait for another process that has the file open for a moment


class InUse(DatabaseError):
    """Another process has the database open."""


@contextmanager
def opened(path: str | Path, write: bool = False, patience: float | None = None
           ) -> "Iterator[duckdb.DuckDBPyConnection]":
    """Open a database of studies; it is made when it is not there and ``write`` is asked for.

    Args:
        path: the file.
        write: open it for writing.
        patience: seconds to wait for another process that has it open; `PATIENCE` when not given.

    Raises:
        InUse: by another process, for longer than that.
        DatabaseError: no such file, not a database of studies, a damaged one, another schema version, or duckdb is
            missing (with the pip line).
    """
    path = Path(path)
    if not write and not path.is_file():
        raise DatabaseError(f"{path}: no such database; `optid study run` makes one")
    if path.exists():
        _check_kind(path)
    else:
        _create(path)
    connection = _connected(path, write, PATIENCE if patience is None else patience)
    try:
        _check(path, connection)
        yield connection
    except Exception as error:
        if write or not _of_duckdb(error):  # `writing` has words of its own
            raise
        raise _damaged(path, "read", error) from error
    finally:
        connection.close()


def _check_kind(path: Path) -> None:
    """Refuse a file of another kind before DuckDB, which opens a table of text as a database in memory, sees it."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError as error:
        raise DatabaseError(f"{path} cannot be opened: {error.strerror}") from None
    if not head:
        raise DatabaseError(f"{path} is empty, and no database: remove it, and `optid study run` makes one")
    if head[8:] != MAGIC:
        raise DatabaseError(f"{path} is a file of another kind, not a database of studies: give the one that `optid "
                            "study run` wrote, or another name for a new one")


def _of_duckdb(error: Exception) -> bool:
    return type(error).__module__.startswith(("duckdb", "_duckdb"))


def _damaged(path: Path, what: str, error: Exception) -> DatabaseError:
    return DatabaseError(f"{path} cannot be {what}: {str(error).splitlines()[0]}. Where it is damaged, such as a copy "
                         "that was cut short, take another copy, or remove it and run the study again")


def _connected(path: Path, write: bool, patience: float) -> "duckdb.DuckDBPyConnection":
    try:
        import duckdb
    except ImportError:
        raise DatabaseError("a database of studies needs duckdb: pip install 'optid[study]'") from None
    until = time.monotonic() + patience
    while True:
        try:
            return duckdb.connect(str(path), read_only=not write, config={"threads": 1})
        except duckdb.Error as error:
            text = str(error).splitlines()[0]
            if "set lock" not in text.lower():
                raise _damaged(path, "opened", error) from None
            if time.monotonic() > until:
                raise InUse(f"{path} has been in use by another process for {patience:g} s: {text}") from None
            time.sleep(0.02)


def _tables(connection: "duckdb.DuckDBPyConnection") -> set[str]:
    return {name for (name,) in connection.execute("SELECT table_name FROM duckdb_tables()").fetchall()}


def _create(path: Path) -> None:
    """Make the file under another name first: whoever is killed here leaves nothing that does not open."""
    new = path.with_name(path.name + ".new")
    unsaved = new.with_name(new.name + ".wal")
    for rest in (new, unsaved):
        rest.unlink(missing_ok=True)
    connection = _connected(new, True, PATIENCE)
    try:
        _fill(connection)
    finally:
        connection.close()
    if unsaved.exists():
        raise DatabaseError(f"{path} cannot be written: there is no room for its tables")
    os.replace(new, path)


def _fill(connection: "duckdb.DuckDBPyConnection") -> None:
    columns = ", ".join(f'"{c.name}" {c.sql}{" NOT NULL" if c.always else ""}' for c in COLUMNS)
    from optid import __version__

    connection.execute("BEGIN")
    connection.execute(f"CREATE TABLE rows ({columns}, PRIMARY KEY (study, key, repetition))")
    connection.execute(f"CREATE TABLE superseded ({columns})")
    connection.execute("CREATE TABLE studies (study VARCHAR PRIMARY KEY, description VARCHAR)")
    connection.execute("CREATE TABLE meta (name VARCHAR PRIMARY KEY, value VARCHAR)")
    connection.executemany("INSERT INTO meta VALUES (?, ?)", [("schema version", str(SCHEMA_VERSION)),
                                                               ("made by", f"optid {__version__}")])
    connection.execute("COMMIT")


def _check(path: Path, connection: "duckdb.DuckDBPyConnection") -> None:
    tables = _tables(connection)
    if not {"rows", "meta"} <= tables:
        raise DatabaseError(f"{path} is a DuckDB file, but not a database of studies (it has "
                            f"{', '.join(sorted(tables)) or 'no tables'}); give another file name")
    meta = dict(connection.execute("SELECT name, value FROM meta").fetchall())
    version = meta.get("schema version", "unknown")
    if version != str(SCHEMA_VERSION):
        made = f" (made by {meta['made by']})" if "made by" in meta else ""
        raise DatabaseError(f"{path} has schema version {version}{made}; this is "
                            f"version {SCHEMA_VERSION}. Export it with the optid that made it, or give another file")


@contextmanager
def writing(path: str | Path, patience: float | None = None) -> "Iterator[duckdb.DuckDBPyConnection]":
    """Open a database for one transaction, which is undone when anything fails.

    Args:
        path: the database; made when it is not there.
        patience: as in `opened`.

    Raises:
        DatabaseError: as in `opened`, or it cannot be written.
    """
    try:
        with opened(path, write=True, patience=patience) as connection:
            connection.execute("BEGIN")
            yield connection
            connection.execute("COMMIT")
    except OptidError:
        raise
    except Exception as error:
        if not _of_duckdb(error) and not isinstance(error, OSError):
            raise
        raise DatabaseError(f"{path} cannot be written: {str(error).splitlines()[0]}") from error
