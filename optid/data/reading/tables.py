"""Tables of named columns from files, frames and dictionaries: the names first, then only the columns wanted."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optid.data.reading.csvfile import open_csv
from optid.data.reading.frames import frame_names, index_name, load_frame, only_clock
from optid.data.reading.npyfile import load_npy, npz_arrays, npz_names
from optid.errors import DataError


@dataclass(frozen=True)
class Table:
    """A source whose columns can be loaded by name.

    Attributes:
        label: name of the source, for messages.
        names: names of its columns or variables.
        load: function of (columns wanted, the clock among them, the column of experiments among them) returning
            {name: array}; numeric columns are (N,) or (N, channels) of a real type, clock and experiments may be text
            or dates.
        index: name of a time index besides the columns, or of the only column of dates; None without one.
    """

    label: str
    names: list[str]
    load: Callable[[Sequence[str], str | None, str | None], dict[str, Any]]
    index: str | None = None


def open_table(source: Any, columns: Sequence[str] | None, delimiter: str, decimal: str) -> Table:
    """Open a file, a frame, a dictionary of arrays or an array.

    Args:
        source: path of a .csv, .txt, .tsv, .parquet, .mat, .npz or .npy file; pandas, polars or arrow table; xarray
            data set; mapping {name: array}; (N, channels) array.
        columns: names of the columns of a source that has none (npy, array, CSV without a header).
        delimiter: character between the cells of a CSV file.
        decimal: decimal mark of a CSV file.

    Raises:
        DataError: no such file, unknown format, a file that cannot be read, or a missing extra with its pip line.
    """
    if isinstance(source, str | Path):
        return _open_file(Path(source), columns, delimiter, decimal)
    if hasattr(source, "data_vars") and hasattr(source, "coords"):  # an xarray data set
        return _of_arrays("the data set", {name: variable.values for name, variable in source.variables.items()})
    if isinstance(source, Mapping):
        return _of_arrays("the dictionary", dict(source))
    if isinstance(source, np.ndarray):
        return _of_array("the array", source, columns)
    return _of_frame("the frame", source)


def existing(path: Path) -> Path:
    """Return the path of a file that is there and not empty.

    Raises:
        DataError: no such file, a folder, or an empty file.
    """
    try:
        is_file = path.is_file()
    except (OSError, ValueError):  # a name too long, or with a null character
        is_file = False
    if not is_file:
        try:
            near = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))[:5] if path.parent.is_dir() else []
        except (OSError, ValueError):
            near = []
        raise DataError(f"no file {str(path)!r}." + (f" There: {', '.join(near)}." if near else ""))
    if path.stat().st_size == 0:
        raise DataError(f"{path.name} is empty (0 bytes).")
    return path


def _open_file(path: Path, columns: Sequence[str] | None, delimiter: str, decimal: str) -> Table:
    kind = path.suffix.lower()
    readers = {
        ".csv": lambda: _csv_table(path, columns, delimiter, decimal),
        ".txt": lambda: _csv_table(path, columns, delimiter, decimal),
        ".tsv": lambda: _csv_table(path, columns, "\t", decimal),
        ".parquet": lambda: _parquet_table(path),
        ".mat": lambda: _mat_table(path),
        ".npz": lambda: Table(path.name, npz_names(path), lambda wanted, clock, group: _raveled(
            npz_arrays(path, wanted), clock, group)),
        ".npy": lambda: _of_array(path.name, load_npy(path, path.name), columns),
    }
    if kind not in readers:
        raise DataError(f"{path.name}: unknown kind of file {kind!r}. Known: {', '.join(readers)}.")
    existing(path)
    try:
        return readers[kind]()
    except OSError as error:
        raise DataError(f"{path.name} cannot be read: {error.strerror}.") from error


def _csv_table(path: Path, columns: Sequence[str] | None, delimiter: str, decimal: str) -> Table:
    file = open_csv(path, columns, delimiter, decimal)
    return Table(path.name, file.names, file.columns)


def _mat_table(path: Path) -> Table:
    from optid.data.reading.matlab import mat_names, mat_variables

    names = mat_names(path)
    if not names:
        raise DataError(f"{path.name} holds no arrays of numbers.")
    return Table(path.name, names, lambda wanted, clock, group: _raveled(mat_variables(path, wanted), clock, group))


def _parquet_table(path: Path) -> Table:
    from optid.data.reading.parquet import parquet_frame, parquet_schema

    schema = parquet_schema(path)
    return Table(path.name, list(schema), lambda wanted, clock, group: load_frame(
        path.name, parquet_frame(path, wanted), wanted, clock, group), only_clock(schema))


def _of_frame(label: str, frame: Any) -> Table:
    names, table = frame_names(label, frame)
    index = index_name(frame, names)
    return Table(label, names, lambda wanted, clock, group: load_frame(label, table, wanted, clock, group),
                 index or only_clock(table.schema))


def _of_arrays(label: str, variables: Mapping[str, Any]) -> Table:
    if not variables:
        raise DataError(f"{label} holds no arrays.")
    named = {str(name): value for name, value in variables.items()}
    return Table(label, list(named), lambda wanted, clock, group: _raveled(
        {name: named[name] for name in wanted}, clock, group))


def _raveled(arrays: dict[str, Any], clock: str | None, group: str | None) -> dict[str, Any]:
    return {name: np.ravel(array) if name in (clock, group) else array for name, array in arrays.items()}


def _of_array(label: str, array: np.ndarray, columns: Sequence[str] | None) -> Table:
    if array.ndim not in (1, 2):
        raise DataError(f"{label} has shape {array.shape}; (samples, channels) is needed.")
    table = array[:, None] if array.ndim == 1 else array
    names = position_names(columns, table.shape[1], label)
    places = {name: place for place, name in enumerate(names)}
    return Table(label, names, lambda wanted, clock, group: {name: table[:, places[name]] for name in wanted})


def position_names(columns: Sequence[str] | None, width: int, label: str) -> list[str]:
    """Return the names of the columns of a plain array: those given, else their positions as text.

    Raises:
        DataError: the number of names is not the number of columns.
    """
    if columns is not None and len(columns) != width:
        raise DataError(f"{label} has {width} columns, columns= names {len(columns)}.")
    return [str(c) for c in (range(width) if columns is None else columns)]
