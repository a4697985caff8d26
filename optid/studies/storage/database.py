"""The rows in the database of a study, one per cell and repetition: read, append, export."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.errors import DatabaseError
from optid.studies.storage import journal
from optid.studies.storage.opening import opened, writing
from optid.studies.storage.rows import COLUMNS, DONE, NAMES, complete

if TYPE_CHECKING:
    import duckdb

FORMATS: dict[str, str] = {".parquet": "FORMAT parquet", ".csv": "FORMAT csv, HEADER"}


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
        _register(connection, whole)
        names = ", ".join(f'"{name}"' for name in NAMES)
        connection.execute(f"INSERT INTO superseded SELECT {names} FROM rows WHERE {OLDER}")
        connection.execute(f"DELETE FROM rows WHERE {OLDER}")
        connection.execute(f"INSERT INTO rows ({names}) SELECT {CASTS} FROM batch")


CASTS = ", ".join(f'CAST("{c.name}" AS {c.sql})' for c in COLUMNS)
_SAME = "SELECT r.rowid FROM rows AS r JOIN batch AS b ON b.study = r.study AND "  # by equality: hashed, no loop
OLDER = (f"rowid IN ({_SAME} b.place = r.place WHERE b.key <> r.key OR b.repetition <> r.repetition UNION ALL "
         f"{_SAME} b.key = r.key AND b.repetition = r.repetition WHERE b.place <> r.place)")
"""Which rows make room for those of a batch."""


def _register(connection: "duckdb.DuckDBPyConnection", whole: Sequence[Mapping[str, Any]]) -> None:
    """Let whole rows be known to a connection as the table ``batch``."""
    connection.register("batch", {c.name: _packed([row[c.name] for row in whole], c.kind) for c in COLUMNS})


def _all_rows(connection: "duckdb.DuckDBPyConnection", path: str | Path) -> str:
    """Name of the table of all rows: with those that a run, under way or killed, has in the journal only.

    Nobody writes to the database while it is open here, so that every row is in it, in the journal, or in both.
    """
    if not (waiting := journal.kept(path)):
        return "rows"
    _register(connection, waiting)
    names = ", ".join(f'"{name}"' for name in NAMES)
    connection.execute(f"CREATE TEMP TABLE all_rows AS SELECT {names} FROM rows WHERE NOT {OLDER}")
    connection.execute(f"INSERT INTO all_rows SELECT {CASTS} FROM batch ANTI JOIN rows USING (study, key, repetition)")
    return "all_rows"


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

    Those that are only in the journal, of a run that is under way or was killed, are among them; nothing is written.

    Args:
        path: the database.
        study: only rows of this study.

    Returns:
        {column: (rows,) array} for every column of `rows.COLUMNS`: "number" float64, "integer" float64 (int64 for the
        columns that every row has), both NaN where there is no value; "text" and "json" objects, "" where there is no
        value; "flag" bool, False where there is none; "time" datetime64[us].

    Raises:
        DatabaseError: as in `opened`, or what is in the journal is no row of this version.
    """
    names = ", ".join(f"coalesce(\"{c.name}\", '') AS \"{c.name}\"" if c.kind in ("text", "json") else f'"{c.name}"'
                      for c in COLUMNS)
    with opened(path) as connection:
        condition, values = ("WHERE study = ?", [study]) if study is not None else ("", [])
        found = connection.execute(f"SELECT {names} FROM {_all_rows(connection, path)} {condition} "
                                   "ORDER BY started, key, repetition", values).fetchnumpy()
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
    """Write the rows, as `read_rows` finds them, to a Parquet or CSV file and return how many there are.

    Args:
        path: the database.
        target: file that ends in .parquet or .csv; replaced when it is there.
        study: only rows of this study.

    Raises:
        DatabaseError: another ending, no rows, the target cannot be written, or as in `read_rows`.
    """
    target = check_target(target)
    condition, values = ("WHERE study = ?", [study]) if study is not None else ("", [])
    names = ", ".join(f'"{name}"' for name in NAMES)
    with opened(path) as connection:
        import duckdb

        source = f"{_all_rows(connection, path)} {condition}"
        if connection.execute(f"SELECT 1 FROM {source} LIMIT 1", values).fetchall() == []:
            whose = f"no rows of a study {study!r}" if study is not None else "no rows"
            raise DatabaseError(f"{path} has {whose} to export: `optid study run` makes them")
        try:
            count = connection.execute(
                f"COPY (SELECT {names} FROM {source} ORDER BY started, key, repetition) "
                f"TO '{str(target).replace(chr(39), 2 * chr(39))}' ({FORMATS[target.suffix.lower()]})", values
            ).fetchone()
        except duckdb.Error as error:
            raise DatabaseError(f"{target} cannot be written: {str(error).splitlines()[0]}") from None
    return int(count[0]) if count else 0
