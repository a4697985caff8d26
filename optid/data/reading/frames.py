"""Columns of pandas, polars and arrow tables, through narwhals; a time index counts as a column."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from optid.arrays import check_integers
from optid.data.reading.clock import clock_values, is_time_name
from optid.data.reading.columns import check_unique
from optid.data.reading.dates import is_date
from optid.errors import DataError


def frame_names(label: str, frame: Any) -> tuple[list[str], Any]:
    """Return the names of the columns and the table with its time index, if it has one, as another column.

    Raises:
        DataError: not a table in memory, or two columns of one name.
    """
    import narwhals as nw

    if hasattr(frame, "index") and getattr(getattr(frame, "columns", None), "nlevels", 1) > 1:  # of pandas
        raise DataError(f"{label} has several rows of column names; join them first: frame.columns = ['_'.join(name) "
                        "for name in frame.columns].")
    try:
        table = nw.from_native(frame, eager_only=True)
        names = [str(name) for name in table.columns]
    except TypeError:
        raise DataError(f"cannot read data from a {type(frame).__name__}: pass a path, a list of paths, a pandas or "
                        "polars frame (a lazy one after .collect()), a dictionary of arrays, or use Data(u=, "
                        "y=).") from None
    except (ValueError, nw.exceptions.NarwhalsError) as error:
        raise DataError(f"{label} cannot be read: {error}") from error
    check_unique(names, label)
    half = [k for k, name in enumerate(names) if any("\ud800" <= sign <= "\udfff" for sign in name)]
    if half:  # on which pandas fails wherever it infers the type of the names
        raise DataError(f"{label}: the name of column {half[0]} is {names[half[0]]!r}, which holds half a character; "
                        "rename it.")
    if names != list(table.columns):  # names that are no text
        frame = frame.rename(columns=dict(zip(table.columns, names)))
        table = nw.from_native(frame, eager_only=True)
    index = index_name(frame, names)
    if index is not None:
        values = frame.index.to_timestamp() if hasattr(frame.index, "to_timestamp") and str(
            frame.index.dtype).startswith("period") else frame.index
        frame = frame.set_axis(values)
        # A series of the same index joins the frame row by row, whatever the index holds twice.
        table = nw.from_native(frame.assign(**{index: values.to_series(index=values).array}), eager_only=True)
    return names, table


def index_name(frame: Any, names: Sequence[str]) -> str | None:
    """Return the name by which the time index of a pandas frame is read; None where its index is no time."""
    index: Any = getattr(frame, "index", None)
    if hasattr(index, "to_timestamp") and str(index.dtype).startswith("period"):
        return None if index.name in names else str(index.name or "index")
    kind = getattr(getattr(index, "dtype", None), "kind", "")
    name = getattr(index, "name", None)
    if kind not in ("M", "m") and not (name is not None and is_time_name(str(name)) and kind in ("i", "u", "f", "O")):
        return None
    called = "index" if name is None else str(name)
    return called if called not in names else f"{called} (index)"


def dated_columns(frame: Any) -> tuple[str, ...]:
    """Return the columns of a table that hold dates, durations, or texts that begin with a date."""
    import narwhals as nw

    table = nw.from_native(frame, eager_only=True)
    found = []
    for name, kind in table.schema.items():
        if isinstance(kind, nw.Datetime | nw.Duration | nw.Date):
            found.append(str(name))
        elif isinstance(kind, nw.String | nw.Object):
            first = next((cell for cell in table[name].head(50).to_list() if cell is not None and cell == cell), "")
            found += [str(name)] * (not isinstance(first, str | int | float | bool) or is_date(str(first)))
    return tuple(found)


def load_frame(label: str, frame: Any, wanted: Sequence[str], texts: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return columns as (N,) arrays: numbers of a real type, texts as objects, and dates; only `texts` may be dates.

    Raises:
        DataError: a column that does not hold numbers, or integers beyond the digits of float64.
    """
    import narwhals as nw

    table = nw.from_native(frame, eager_only=True)
    loaded = {}
    for name in wanted:
        column = table[name]
        if isinstance(column.dtype, nw.Date):
            column = column.cast(nw.Datetime("us"))
        if isinstance(column.dtype, nw.Time):
            loaded[name] = np.array([_since_midnight(cell) for cell in column.to_list()], dtype="m8[ns]")
            continue
        if isinstance(column.dtype, nw.Object | nw.Unknown) and name in texts and not _is_text(column):
            loaded[name] = clock_values(column.to_list(), f"{label}, column {name!r}")
            continue
        if isinstance(column.dtype, nw.String) or (isinstance(column.dtype, nw.Object) and _is_text(column)):
            loaded[name] = np.array(["" if cell is None or cell != cell else str(cell) for cell in column.to_list()],
                                    dtype=object)
        elif name in texts:
            dates = isinstance(column.dtype, nw.Datetime) and column.null_count() == 0
            # Through integers, because a time zone would make objects of the dates.
            unit: Any = "ns" if getattr(column.dtype, "time_unit", "") == "ns" else "us"  # which hold more years
            loaded[name] = column.dt.timestamp(unit).to_numpy().astype(f"M8[{unit}]") if dates else column.to_numpy()
        elif not column.dtype.is_numeric():
            raise DataError(f"{label}: column {name!r} is of type {column.dtype}; it must be numeric. Convert it first "
                            "(pandas.to_numeric, polars cast).")
        elif column.dtype.is_integer() and column.null_count() == 0:
            loaded[name] = column.to_numpy()
        else:
            if column.dtype.is_integer() and column.null_count() < len(column):
                check_integers(column.drop_nulls().to_numpy()[:, None], [f"{label}, column {name!r}"])
            loaded[name] = column.cast(nw.Float64).to_numpy()
    return loaded


def _since_midnight(cell: Any) -> np.timedelta64:
    if cell is None:
        return np.timedelta64("NaT")
    seconds = 3600 * cell.hour + 60 * cell.minute + cell.second
    return np.timedelta64((10**6 * seconds + cell.microsecond) * 1000, "ns")


def _is_text(column: Any) -> bool:
    """Whether a column of objects holds texts, and perhaps numbers and missing samples."""
    cells = column.to_list()
    return any(isinstance(cell, str) for cell in cells) and all(
        cell is None or (isinstance(cell, str | int | float) and not isinstance(cell, bool)) for cell in cells)


def partition_blocks(label: str, names: Sequence[str], chunk: int, content: Any, wanted: Sequence[str],
                     texts: Mapping[str, str]) -> Iterator[dict[str, np.ndarray]]:
    """Yield columns of a computed partition of a Dask collection, `chunk` rows at a time; errors as of `load_frame`."""
    if isinstance(content, np.ndarray):
        if content.dtype.kind not in "iuf":
            raise DataError(f"{label}: the samples are of type {content.dtype}; convert them to numbers first.")
        whole = {name: content[:, names.index(name)] for name in wanted}
    else:
        whole = load_frame(label, content.set_axis(list(names), axis=1), wanted, texts)
    for start in range(0, len(whole[wanted[0]]), chunk):
        yield {name: column[start : start + chunk] for name, column in whole.items()}
