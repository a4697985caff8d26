"""Whole Parquet files, through polars."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from optid.data.reading.parts import damaged_parquet


def parquet_schema(path: Path) -> dict[str, Any]:
    """Return the names and types of the columns; `DataError` where the file is damaged."""
    import polars as pl

    return dict(_guarded(path, lambda: pl.read_parquet_schema(path)))


def parquet_frame(path: Path, wanted: Sequence[str]) -> Any:
    """Return some columns as a polars frame; `DataError` where they are damaged."""
    import polars as pl

    return _guarded(path, lambda: pl.read_parquet(path, columns=list(dict.fromkeys(wanted)), use_statistics=False))


def _guarded(path: Path, read: Callable[[], Any]) -> Any:
    import polars as pl

    try:
        return read()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError, MemoryError) as error:
        raise damaged_parquet(path, error) from error
