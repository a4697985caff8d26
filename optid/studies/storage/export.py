"""Rows of a database as a Parquet or CSV file."""

from pathlib import Path

from optid.errors import DatabaseError
from optid.studies.storage.rows import COLUMNS
from optid.studies.storage.store import Store

ENDINGS = (".parquet", ".csv")
FORMULA = "^[=+\\-@\t\r]"  # begins a text that a spreadsheet runs; an apostrophe in front makes it a text


def check_target(target: str | Path) -> Path:
    """Return the path of a file to export to; DatabaseError for another ending than .parquet or .csv."""
    target = Path(target)
    if target.suffix.lower() not in ENDINGS:
        raise DatabaseError(f"{target}: rows are exported to a file that ends in {' or '.join(ENDINGS)}")
    return target


def export(path: str | Path, target: str | Path, study: str | None = None) -> int:
    """Write the rows of a database, or of one study, to a .parquet or .csv file and return how many there are.

    Raises:
        DatabaseError: another ending, no rows, the target cannot be written, or the database cannot be read.
    """
    target = check_target(target)
    with Store(path) as store:
        rows = store.values(study)
    if not rows:
        whose = f"no rows of a study {study!r}" if study is not None else "no rows"
        raise DatabaseError(f"{path} has {whose} to export: `optid study run` makes them")
    import polars

    kinds = {"REAL": polars.Float64, "INTEGER": polars.Int64, "TEXT": polars.String}
    frame = polars.DataFrame(rows, schema={c.name: kinds[c.sql] for c in COLUMNS}, orient="row")
    flags = [c.name for c in COLUMNS if c.kind == "flag"]
    frame = frame.with_columns(polars.col(flags).cast(polars.Boolean),
                               polars.col("started").str.to_datetime(time_unit="us", time_zone="UTC"))
    try:
        if target.suffix.lower() == ".parquet":
            frame.write_parquet(target)
        else:
            texts = polars.col(polars.String)
            frame.with_columns(polars.when(texts.str.contains(FORMULA)).then("'" + texts).otherwise(texts)
                               .name.keep()).write_csv(target)
    except Exception as error:
        raise DatabaseError(f"{target} cannot be written: {str(error).partition(chr(10))[0]}") from None
    return len(frame)

