"""Tables of named columns from files, frames and dictionaries: the names first, then only the columns wanted."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optid.arrays import check_integers
from optid.data.reading.csvfile import open_csv
from optid.errors import DataError

TABLES = 'pip install "optid[tables]"'
MAT = 'pip install "optid[mat]"'


@dataclass(frozen=True)
class Table:
    """A source whose columns can be loaded by name.

    Attributes:
        label: name of the source, for messages.
        names: names of its columns or variables.
        load: function of (columns wanted, those of them to leave as they are) returning {name: array}; numeric columns
            are (N,) or (N, channels) of a real type, the columns to leave may hold text or dates.
    """

    label: str
    names: list[str]
    load: Callable[[Sequence[str], Sequence[str]], dict[str, Any]]


def open_table(source: Any, columns: Sequence[str] | None, delimiter: str, decimal: str) -> Table:
    """Open a file, a frame, a dictionary of arrays or an array.

    Args:
        source: path of a .csv, .txt, .tsv, .parquet, .mat, .npz or .npy file; pandas or polars frame; mapping
            {name: array}; (N, channels) array.
        columns: names of the columns of a source that has none (npy, array, CSV without a header).
        delimiter: character between the cells of a CSV file.
        decimal: decimal mark of a CSV file.

    Raises:
        DataError: no such file, unknown format, a file that cannot be read, or a missing extra with its pip line.
    """
    if isinstance(source, str | Path):
        return _open_file(Path(source), columns, delimiter, decimal)
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
    if not path.is_file():
        near = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))[:5] if path.parent.is_dir() else []
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
        ".mat": lambda: _of_arrays(path.name, _mat_variables(path)),
        ".npz": lambda: _npz_table(path),
        ".npy": lambda: _of_array(path.name, _numpy_file(path, None), columns),
    }
    if kind not in readers:
        raise DataError(f"{path.name}: unknown kind of file {kind!r}. Known: {', '.join(readers)}.")
    existing(path)
    return readers[kind]()


def _csv_table(path: Path, columns: Sequence[str] | None, delimiter: str, decimal: str) -> Table:
    file = open_csv(path, columns, delimiter, decimal)

    def load(wanted: Sequence[str], as_is: Sequence[str]) -> dict[str, Any]:
        parts: dict[str, list] = {name: [] for name in wanted}
        done = 0
        for block in file.blocks(wanted, 65536):
            for name, cells in block.items():
                parts[name].append(np.array(cells) if name in as_is else file.numbers(cells, name, done))
            done += len(next(iter(block.values())))
        if not done:
            raise DataError(f"{path.name} has a header but no rows.")
        return {name: np.concatenate(part) for name, part in parts.items()}

    return Table(path.name, file.names, load)


def _parquet_table(path: Path) -> Table:
    try:
        import pyarrow.parquet as engine
    except ImportError:
        return _parquet_by_polars(path)
    try:
        names = list(engine.read_schema(path).names)
    except (ValueError, OSError) as error:  # pyarrow's own errors derive from these
        raise DataError(f"{path.name} is not a Parquet file, or it is damaged: {error}") from error
    return Table(path.name, names, lambda wanted, as_is: _load_frame(
        path.name, engine.read_table(path, columns=list(wanted)), wanted, as_is))


def _parquet_by_polars(path: Path) -> Table:
    try:
        import polars
    except ImportError:
        raise DataError(f"{path.name}: reading Parquet needs pyarrow or polars: {TABLES}") from None
    try:
        names = list(polars.read_parquet_schema(path))
    except polars.exceptions.PolarsError as error:
        raise DataError(f"{path.name} is not a Parquet file, or it is damaged: {error}") from error
    return Table(path.name, names, lambda wanted, as_is: _load_frame(
        path.name, polars.read_parquet(path, columns=list(wanted)), wanted, as_is))


def _of_frame(label: str, frame: Any) -> Table:
    import narwhals as nw

    try:
        names = [str(name) for name in nw.from_native(frame, eager_only=True).columns]
    except TypeError:
        raise DataError(
            f"cannot read data from a {type(frame).__name__}: pass a path, a list of paths, a pandas or polars frame "
            "(a lazy one after .collect()), a dictionary of arrays, or use Data(u=, y=)."
        ) from None
    return Table(label, names, lambda wanted, as_is: _load_frame(label, frame, wanted, as_is))


def _load_frame(label: str, frame: Any, wanted: Sequence[str], as_is: Sequence[str]) -> dict[str, np.ndarray]:
    import narwhals as nw

    table = nw.from_native(frame, eager_only=True)
    if len(table) == 0:
        raise DataError(f"{label} has no rows.")
    loaded = {}
    for name in wanted:
        column = table[name]
        if name in as_is:
            dates = isinstance(column.dtype, nw.Datetime) and column.null_count() == 0
            # Through integers, because a time zone would make objects of the dates.
            loaded[name] = column.dt.timestamp("ns").to_numpy().astype("M8[ns]") if dates else column.to_numpy()
        elif not column.dtype.is_numeric():
            raise DataError(
                f"{label}: column {name!r} is of type {column.dtype}, numbers are needed. "
                "Convert it first (pandas.to_numeric, polars cast)."
            )
        elif column.dtype.is_integer() and column.null_count() == 0:
            loaded[name] = column.to_numpy()
        else:
            if column.dtype.is_integer() and column.null_count() < len(column):
                check_integers(column.drop_nulls().to_numpy()[:, None], [f"{label}, column {name!r}"])
            loaded[name] = column.cast(nw.Float64).to_numpy()
    return loaded


def _of_arrays(label: str, variables: Mapping[str, Any]) -> Table:
    if not variables:
        raise DataError(f"{label} holds no arrays.")

    def load(wanted: Sequence[str], as_is: Sequence[str]) -> dict[str, Any]:
        return {name: np.ravel(variables[name]) if name in as_is else variables[name] for name in wanted}

    return Table(label, [str(name) for name in variables], load)


def _of_array(label: str, array: np.ndarray, columns: Sequence[str] | None) -> Table:
    if array.ndim not in (1, 2):
        raise DataError(f"{label} has shape {array.shape}; (samples, channels) is needed.")
    table = array[:, None] if array.ndim == 1 else array
    names = position_names(columns, table.shape[1], label)
    return Table(label, names, lambda wanted, as_is: {name: table[:, names.index(name)] for name in wanted})


def position_names(columns: Sequence[str] | None, width: int, label: str) -> list[str]:
    """Return the names of the columns of a plain array: those given, else their positions as text.

    Raises:
        DataError: the number of names is not the number of columns.
    """
    if columns is not None and len(columns) != width:
        raise DataError(f"{label} has {width} columns, columns= names {len(columns)}.")
    return [str(c) for c in (range(width) if columns is None else columns)]


def _npz_table(path: Path) -> Table:
    def load(wanted: Sequence[str], as_is: Sequence[str]) -> dict[str, Any]:
        arrays = _numpy_file(path, wanted)
        return {name: np.ravel(arrays[name]) if name in as_is else arrays[name] for name in wanted}

    return Table(path.name, list(_numpy_file(path, ())), load)


def _numpy_file(path: Path, wanted: Sequence[str] | None) -> Any:
    """Return the array of an npy file, or the wanted arrays of an npz file, None for those that are not wanted."""
    from zipfile import BadZipFile

    try:
        with open(path, "rb") as file:  # opened here, so that it is closed when numpy gives up
            content = np.load(file, allow_pickle=False)
            if wanted is None and isinstance(content, np.ndarray):
                return content
            if wanted is None:
                raise ValueError("it is an archive; name it .npz")
            return {name: content[name] if name in wanted else None for name in content.files}
    except (ValueError, OSError, EOFError, BadZipFile, AttributeError) as error:
        raise DataError(f"{path.name} is damaged, or not a NumPy file of plain numbers: {error}") from error


def _mat_variables(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        # With mat_dtype a double that MATLAB packed into bytes comes back as a double.
        content = loadmat(path, mat_dtype=True)
    except NotImplementedError:
        return _hdf_variables(path)
    except (ValueError, TypeError, OSError, MatReadError) as error:
        raise DataError(f"{path.name} is damaged, or not a MAT file: {error}") from error
    variables = {}
    for name, value in content.items():
        if not isinstance(value, np.ndarray) or name.startswith("__"):
            continue
        if value.dtype.names and value.size == 1:
            variables |= {f"{name}.{part}": value.flat[0][part] for part in value.dtype.names}
        else:
            variables[name] = value
    return variables


def _hdf_variables(path: Path) -> dict[str, np.ndarray]:
    try:
        import h5py
    except ImportError:
        raise DataError(f"{path.name} is a MAT file of version 7.3, which needs h5py: {MAT}") from None
    variables: dict[str, np.ndarray] = {}

    def visit(name: str, item: Any) -> None:
        is_text = item.attrs.get("MATLAB_class", b"") in (b"char", b"cell")
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and not is_text and item.dtype.kind in "iuf":
            variables[name.replace("/", ".")] = item[()].T  # HDF5 stores MATLAB's columns as rows

    try:
        with h5py.File(path) as file:
            file.visititems(visit)
    except OSError as error:
        raise DataError(f"{path.name} is damaged, or not a MAT file: {error}") from error
    return variables
