"""Parquet files by pyarrow, which verifies checksums and bounds its memory; whole ones also by polars."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from optid.data.reading.chunks import Block
from optid.data.reading.frames import dated_columns, load_frame
from optid.data.reading.parts import Part, file_parts
from optid.errors import DataError

SAMPLES = 1 << 20  # row groups are taken together up to this many samples: smaller tasks do not pay


def parquet_head(path: Path) -> Any:
    """Return the first rows, and so the columns and their types; `DataError` where the file is damaged."""
    import polars as pl

    with _undamaged(path, pl.exceptions.PolarsError, pl.exceptions.PanicException):
        return pl.read_parquet(path, n_rows=50, use_statistics=False)


def load_parquet(path: Path, wanted: Sequence[str], texts: Mapping[str, str]) -> dict[str, Any]:
    """Return some columns whole; errors as of `load_frame`, and `DataError` where they are damaged.

    Checksums of pages are verified where pyarrow is installed: polars ignores them.
    """
    import polars as pl

    columns = list(dict.fromkeys(wanted))
    with _undamaged(path, pl.exceptions.PolarsError, pl.exceptions.PanicException):
        try:
            import pyarrow.parquet as parquet
        except ImportError:
            frame: Any = pl.read_parquet(path, columns=columns, use_statistics=False)
        else:
            frame = parquet.read_table(path, columns=columns, page_checksum_verification=True)
    return load_frame(path.name, frame, wanted, texts)


def parquet_footer(path: Path) -> tuple[list[str], int, tuple[str, ...]]:
    """Return columns, number of rows and columns of dates; `DataError` if the file is damaged or pyarrow is missing."""
    parquet = _pyarrow_parquet(path)
    import pyarrow as pa

    with _undamaged(path), parquet.ParquetFile(path) as file:
        head = next(file.iter_batches(50), None)
        dates = () if head is None else dated_columns(pa.Table.from_batches([head]))
        return list(file.schema_arrow.names), file.metadata.num_rows, dates


def parquet_blocks(path: Path, groups: Sequence[int] | None, chunk: int, wanted: Sequence[str], texts: Mapping[str, str]
                   ) -> Iterator[Block]:
    """Yield columns of some row groups, or of all for None, `chunk` rows at a time; errors as of `load_parquet`."""
    parquet = _pyarrow_parquet(path)
    import pyarrow as pa

    # Both settings bound the memory: by default pyarrow fetches the whole file ahead, or a whole row group.
    with _undamaged(path), parquet.ParquetFile(
        path, buffer_size=1 << 20, pre_buffer=False, page_checksum_verification=True
    ) as file:
        for batch in file.iter_batches(chunk, row_groups=groups, columns=list(dict.fromkeys(wanted))):
            yield load_frame(path.name, pa.Table.from_batches([batch]), wanted, texts)


def parquet_parts(path: Path, chunk: int) -> list[Part]:
    """Cut a Parquet file into parts of successive row groups."""
    contents = _pyarrow_parquet(path).read_metadata(path)
    parts, groups, rows = [], [], 0
    for group in range(contents.num_row_groups):
        groups.append(group)
        rows += contents.row_group(group).num_rows
        if rows >= SAMPLES or group == contents.num_row_groups - 1:
            where = "" if len(groups) == contents.num_row_groups else f", row groups {groups[0]} to {groups[-1]}"
            parts.append(Part(path.name + where, partial(parquet_blocks, path.absolute(), tuple(groups), chunk), rows))
            groups, rows = [], 0
    return file_parts(parts, path)


@contextmanager
def _undamaged(path: Path, *kinds: Any) -> Iterator[None]:
    try:
        yield
    except DataError:
        raise
    except (OSError, ValueError, KeyError, IndexError, TypeError, NotImplementedError, MemoryError, *kinds) as error:
        raise DataError(f"{path.name} is not a Parquet file, or it is damaged: {str(error)[:500]}") from error


def _pyarrow_parquet(path: Path) -> Any:
    try:
        import pyarrow.parquet
    except ImportError:
        raise DataError(f'{path.name}: streaming Parquet needs pyarrow: pip install "optid[tables]"') from None
    return pyarrow.parquet
