"""The database of a study: one DuckDB file, one row per cell and repetition; read, append, export.

A writer opens the file for each batch and closes it again, so that a report can be made while the study runs and a
killed study leaves a database that opens. Every batch is one transaction.
"""

import os
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.errors import DatabaseError, OptidError
from optid.studies.storage.rows import COLUMNS, DONE, NAMES, SCHEMA_VERSION, complete

if TYPE_CHECKING:
    import duckdb

FORMATS: dict[str, str] = {".parquet": "FORMAT parquet", ".csv": "FORMAT csv, HEADER"}
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
        DatabaseError: no such file, not a database of studies, another schema version, or duckdb is missing (with the
            pip line).
    """
    path = Path(path)
    if not write and not path.is_file():
        raise DatabaseError(f"{path}: no such database; `optid study run` makes one")
    if not path.exists():
        _create(path)
    connection = _connected(path, write, PATIENCE if patience is None else patience)
    try:
        _check(path, connection)
        yield connection
    finally:
        connection.close()


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
                raise DatabaseError(f"{path} cannot be opened: {text}") from None
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
    found = connection.execute("SELECT value FROM meta WHERE name = 'schema version'").fetchone()
    version = found[0] if found else "unknown"
    if version != str(SCHEMA_VERSION):
        made = connection.execute("SELECT value FROM meta WHERE name = 'made by'").fetchone()
        raise DatabaseError(f"{path} has schema version {version}{f' (made by {made[0]})' if made else ''}; this is "
                            f"version {SCHEMA_VERSION}. Export it with the optid that made it, or give another file")


def append(path: str | Path, rows: Sequence[Mapping[str, Any]], patience: float | None = None) -> None:
    """Append rows in one transaction.

    A row whose place in the grid is taken by one of another key (other data, options or versions), or whose key stands
    at another place of the study (other labels), moves the older one to the table ``superseded``.

    Args:
        path: the database; made when it is not there.
        rows: mappings of columns; completed and checked by `rows.complete`.
        patience: as in `opened`.

    Raises:
        DatabaseError: as in `opened`; or it cannot be written, such as on a full disk: nothing of the batch is in it
            then, and what was in it before stays.
        ValueError: a row that does not keep the schema.
    """
    whole = [complete(row) for row in rows]
    with writing(path, patience) as connection:
        if not whole:
            return
        connection.register("batch", {c.name: _packed([row[c.name] for row in whole], c.kind) for c in COLUMNS})
        names = ", ".join(f'"{name}"' for name in NAMES)
        casts = ", ".join(f'CAST("{c.name}" AS {c.sql})' for c in COLUMNS)
        same = "SELECT r.rowid FROM rows AS r JOIN batch AS b ON b.study = r.study AND "  # by equality: hashed, no loop
        older = (f"rowid IN ({same} b.place = r.place WHERE b.key <> r.key OR b.repetition <> r.repetition UNION ALL "
                 f"{same} b.key = r.key AND b.repetition = r.repetition WHERE b.place <> r.place)")
        connection.execute(f"INSERT INTO superseded SELECT {names} FROM rows WHERE {older}")
        connection.execute(f"DELETE FROM rows WHERE {older}")
        connection.execute(f"INSERT INTO rows ({names}) SELECT {casts} FROM batch")


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
        if not type(error).__module__.startswith(("duckdb", "_duckdb")) and not isinstance(error, OSError):
            raise
        raise DatabaseError(f"{path} cannot be written: {str(error).splitlines()[0]}") from error


def _packed(values: list[Any], kind: str) -> np.ndarray:
    missing = [value is None for value in values]
    if kind == "number":
        return np.ma.masked_array([0.0 if v is None else v for v in values], missing, dtype=float)
    if kind in ("integer", "flag"):
        return np.ma.masked_array([0 if v is None else v for v in values], missing,
                                  dtype=np.int64 if kind == "integer" else bool)
    return np.array(values, dtype=object)


def read_rows(path: str | Path, study: str | None = None) -> dict[str, np.ndarray]:
    """Return the rows as one array per column, in the order in which the cells started.

    Args:
        path: the database.
        study: only rows of this study.

    Returns:
        {column: (rows,) array} for every column of `rows.COLUMNS`: "number" float64, "integer" float64 (int64 for the
        columns that every row has), both NaN where there is no value; "text" and "json" objects, "" where there is no
        value; "flag" bool, False where there is none; "time" datetime64[us].

    Raises:
        DatabaseError: as in `opened`.
    """
    names = ", ".join(f"coalesce(\"{c.name}\", '') AS \"{c.name}\"" if c.kind in ("text", "json") else f'"{c.name}"'
                      for c in COLUMNS)
    with opened(path) as connection:
        condition, values = ("WHERE study = ?", [study]) if study is not None else ("", [])
        found = connection.execute(f"SELECT {names} FROM rows {condition} ORDER BY started, key, repetition", values
                                   ).fetchnumpy()
    return {c.name: _unpacked(found[c.name], c.kind, c.always) for c in COLUMNS}


def _unpacked(values: Any, kind: str, always: bool) -> np.ndarray:
    if kind in ("text", "json"):
        return np.asarray(values, dtype=object)
    if kind == "flag":
        return np.asarray(np.ma.filled(values, False), dtype=bool)
    if kind == "time":
        return np.asarray(np.ma.filled(values, np.datetime64("NaT")), dtype="datetime64[us]")
    if kind == "integer" and always:
        return np.asarray(values, dtype=np.int64)
    return np.asarray(np.ma.filled(np.ma.asarray(values, dtype=float), np.nan), dtype=float)


def finished(path: str | Path, study: str | None = None) -> set[tuple[str, int]]:
    """Return (key, repetition) of every row; empty where there is no database yet.

    Args:
        path: the database.
        study: only rows of this study.

    Raises:
        DatabaseError: as in `opened`.
    """
    return {(key, repetition) for owner, key, repetition in identities(path) if study in (None, owner)}


def identities(path: str | Path) -> dict[tuple[str, str, int], str]:
    """Return {(study, key, repetition): place} of every row; empty where there is no database yet.

    Raises:
        DatabaseError: as in `opened`.
    """
    if not Path(path).exists():
        return {}
    with opened(path) as connection:
        found = connection.execute("SELECT study, key, repetition, place FROM rows").fetchall()
    return {(study, key, int(repetition)): place for study, key, repetition, place in found}


def rows_of(path: str | Path, study: str | None, identified: Sequence[tuple[str, int]]) -> list[dict[str, Any]]:
    """Return rows as they were written, as dictionaries, in the order asked for; those that are not there are left out.

    Args:
        path: the database.
        study: only rows of this study; None for any: one of each, one that is "done" before others, then the newest.
        identified: (key, repetition) of the rows.

    Raises:
        DatabaseError: as in `opened`.
    """
    if not identified:
        return []
    names = ", ".join("strftime(started, '%Y-%m-%dT%H:%M:%S.%f') || '+00:00' AS started" if c.kind == "time"
                      else f'"{c.name}"' for c in COLUMNS)
    condition, values = ("WHERE study = ?", [study]) if study is not None else ("", [])
    with opened(path) as connection:
        found = connection.execute(f"SELECT {names} FROM rows {condition} ORDER BY outcome = '{DONE}', rows.started, "
                                   "rows.study", values).fetchall()
    rows = [dict(zip(NAMES, values)) for values in found]
    by_identity = {(row["key"], row["repetition"]): row for row in rows}
    return [by_identity[identity] for identity in identified if identity in by_identity]


def keep(path: str | Path, study: str, cells: Collection[tuple[str, int]]) -> None:
    """Make the rows of a study those of its grid as it is now.

    Rows of other cells (entries taken out of the study, other data, options or versions) move to the table
    ``superseded``, and rows of these cells that are there come back, the newest of each, so that an entry that is
    taken out and put in again is not run again.

    Args:
        path: the database.
        study: title of the study.
        cells: (key, repetition) of the cells of its grid.

    Raises:
        DatabaseError: as in `writing`.
    """
    names = ", ".join(f'"{name}"' for name in NAMES)
    asked = "study = ? AND (key, repetition) {} (SELECT key, repetition FROM grid)"
    same = ("EXISTS (SELECT 1 FROM rows AS r WHERE r.study = superseded.study AND r.key = superseded.key "
            "AND r.repetition = superseded.repetition{})")
    back = f"{asked.format('IN')} AND NOT {same.format('')}"
    newest = "row_number() OVER (PARTITION BY key, repetition ORDER BY started DESC) = 1"
    with writing(path) as connection:
        connection.register("grid", {"key": np.array([key for key, _ in cells], dtype=object),
                                     "repetition": np.array([repetition for _, repetition in cells], dtype=np.int64)})
        connection.execute(f"INSERT INTO superseded SELECT {names} FROM rows WHERE {asked.format('NOT IN')}", [study])
        connection.execute(f"DELETE FROM rows WHERE {asked.format('NOT IN')}", [study])
        connection.execute(f"INSERT INTO rows SELECT {names} FROM superseded WHERE {back} QUALIFY {newest}", [study])
        connection.execute(f"DELETE FROM superseded WHERE study = ? AND "
                           f"{same.format(' AND r.started = superseded.started')}", [study])


def set_aside(path: str | Path, study: str, outcomes: Sequence[str]) -> None:
    """Move the rows of a study with these outcomes to the table ``superseded``, so that their cells are run again.

    Raises:
        DatabaseError: as in `writing`.
    """
    if not outcomes:
        return
    names = ", ".join(f'"{name}"' for name in NAMES)
    chosen = f"study = ? AND outcome IN ({', '.join('?' * len(outcomes))})"
    with writing(path) as connection:
        connection.execute(f"INSERT INTO superseded SELECT {names} FROM rows WHERE {chosen}", [study, *outcomes])
        connection.execute(f"DELETE FROM rows WHERE {chosen}", [study, *outcomes])


def former(path: str | Path, study: str | None = None) -> int:
    """Return how many rows are in the table ``superseded``: kept, but in no report.

    Args:
        path: the database.
        study: only rows of this study.

    Raises:
        DatabaseError: as in `opened`.
    """
    condition, values = ("WHERE study = ?", [study]) if study is not None else ("", [])
    with opened(path) as connection:
        found = connection.execute(f"SELECT count(*) FROM superseded {condition}", values).fetchone()
    return int(found[0]) if found else 0


def describe(path: str | Path, study: str, description: str) -> None:
    """Keep the text of a study file with its rows; the newest replaces the one before.

    Raises:
        DatabaseError: as in `writing`.
    """
    with writing(path) as connection:
        connection.execute("INSERT OR REPLACE INTO studies VALUES (?, ?)", [study, description])


def data_hashes(path: str | Path) -> dict[tuple[str, str], set[str]]:
    """Return {(study, data label): hashes of the data files that the rows were made from}; simulated data have none.

    Raises:
        DatabaseError: as in `opened`.
    """
    with opened(path) as connection:
        found = connection.execute("SELECT DISTINCT study, data, data_hash FROM rows WHERE data_hash <> ''").fetchall()
    hashes: dict[tuple[str, str], set[str]] = {}
    for study, data, value in found:
        hashes.setdefault((study, data), set()).add(value)
    return hashes


def check_target(target: str | Path) -> Path:
    """Return the path of a file that rows can be exported to, before there are any.

    Raises:
        DatabaseError: another ending than .parquet or .csv.
    """
    target = Path(target)
    if target.suffix.lower() not in FORMATS:
        raise DatabaseError(f"{target}: rows are exported to a file that ends in {' or '.join(FORMATS)}")
    return target


def export(path: str | Path, target: str | Path, study: str | None = None) -> int:
    """Write the rows to a Parquet or CSV file and return how many there are.

    Args:
        path: the database.
        target: file that ends in .parquet or .csv; replaced when it is there.
        study: only rows of this study.

    Raises:
        DatabaseError: another ending, the target cannot be written, or as in `opened`.
    """
    target = check_target(target)
    condition, values = ("WHERE study = ?", [study]) if study is not None else ("", [])
    names = ", ".join(f'"{name}"' for name in NAMES)
    with opened(path) as connection:
        import duckdb

        try:
            count = connection.execute(
                f"COPY (SELECT {names} FROM rows {condition} ORDER BY started, key, repetition) "
                f"TO '{str(target).replace(chr(39), 2 * chr(39))}' ({FORMATS[target.suffix.lower()]})", values
            ).fetchone()
        except duckdb.Error as error:
            raise DatabaseError(f"{target} cannot be written: {str(error).splitlines()[0]}") from None
    return int(count[0]) if count else 0
