"""The tables and sources of files, frames, arrays and Dask collections."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optid.arrays import check_shape
from optid.data.reading.clock import clock_hints, is_rate_name, is_step_name
from optid.data.reading.columns import position_names
from optid.data.reading.csvfile import open_csv
from optid.data.reading.format import Format
from optid.data.reading.frames import dated_columns, frame_names, index_name, load_frame, partition_blocks
from optid.data.reading.npyfile import npz_arrays, open_npy, side_by_side
from optid.data.reading.parts import Part, file_parts
from optid.data.reading.tables import RawTable, Source
from optid.errors import DataError

TEXT = (".csv", ".txt", ".tsv", ".lvm", ".dat", ".asc")
PLANT = (".xlsx", ".tdms", ".mf4")


def existing(path: Path) -> Path:
    """Return the path of a file that exists and is not empty (else a `DataError`)."""
    size, near = -1, []
    with suppress(OSError, ValueError):  # a name too long, or with a null character
        size = path.stat().st_size if path.is_file() else -1
        near = [] if size >= 0 else sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))[:5]
    if size < 0:
        raise DataError(f"no file {str(path)!r}." + (f" There: {', '.join(near)}." if near else ""))
    if size == 0:
        raise DataError(f"{path.name} is empty (0 bytes).")
    return path


# -- whole


def open_tables(source: Any, how: Format) -> list[RawTable]:
    """Open a file, a frame, a dictionary of arrays or an array: one table for each experiment that it holds.

    `DataError`: no such file, unknown format, an unreadable file, or a missing extra with its pip line.
    """
    if isinstance(source, str | Path):
        path = Path(source)
        kind = path.suffix.lower()
        known = (*TEXT, ".parquet", ".mat", ".npz", ".npy", *PLANT)
        if kind not in known:
            raise DataError(f"{path.name}: unknown kind of file {kind!r}. Known: {', '.join(known)}.")
        try:
            return _file_tables(existing(path), kind, how)
        except OSError as error:
            raise DataError(f"{path.name} cannot be read: {error.strerror}.") from error
    if hasattr(source, "data_vars") and hasattr(source, "coords"):
        return [_of_data_set("the data set", source, how)]
    if isinstance(source, Mapping):
        return [_of_arrays("the dictionary", source, how)]
    if isinstance(source, np.ndarray):
        return [_of_array("the array", source, how)]
    return [_of_frame("the frame", source, how)]


def _file_tables(path: Path, kind: str, how: Format) -> list[RawTable]:
    if kind in TEXT:
        file = open_csv(path, how)
        return [RawTable(path.name, file.names, file.columns, file.layout.how, None, file.layout.dates,
                         file.layout.units, advice=file.layout.advice, hints=file.layout.hints,
                         findings=file.layout.findings)]
    if kind == ".parquet":
        from optid.data.reading.parquet import load_parquet, parquet_head

        head = parquet_head(path)
        return [RawTable(path.name, list(head.columns), partial(load_parquet, path), how, None, dated_columns(head))]
    if kind == ".npz":
        names = list(npz_arrays(path))
        known = npz_arrays(path, [name for name in names if is_step_name(name) or is_rate_name(name)])
        step, rest = _stated_step(known, path.name)
        names = [name for name in names if name not in known or name in rest]
        return [RawTable(path.name, names, lambda wanted, _: npz_arrays(path, wanted), how, step=step)]
    if kind == ".npy":
        opened = open_npy(path, how.columns)
        return [RawTable(path.name, list(opened.names), lambda wanted, _: next(opened.blocks(opened.rows, wanted)),
                         how)]
    if kind in PLANT:
        from optid.data.reading.plant_files import plant_tables

        return [replace(_of_frame(one.label, one.frame, how), units=one.units, findings=one.findings)
                for one in plant_tables(path, kind)]
    from optid.data.reading.matlab import mat_table

    return [mat_table(path, how)]


def _of_frame(label: str, frame: Any, how: Format) -> RawTable:
    names, table = frame_names(label, frame)
    if len(table) == 0:
        raise DataError(f"{label} has no rows.")
    head = table.head(50)
    hints = clock_hints({str(name): head[name].to_list() for name in head.columns})
    return RawTable(label, names, partial(load_frame, label, table), how, index_name(frame, names),
                    dated_columns(table), hints=hints)


def _of_data_set(label: str, source: Any, how: Format) -> RawTable:
    """Return the table of an xarray data set: its variables of one dimension, with their units."""
    variables = {str(name): variable for name, variable in source.variables.items()}
    found = _of_arrays(label, {name: variable.values for name, variable in variables.items()}, how)

    def load(wanted: Sequence[str], texts: Mapping[str, str]) -> dict[str, Any]:
        along = {name: variables[name].dims[0] for name in wanted if variables[name].dims}
        if len(set(along.values())) > 1:
            several = ", ".join(f"{name} ({dimension})" for name, dimension in along.items())
            raise DataError(f"{label}: the variables have different dimensions: {several}. Interpolate them onto one "
                            "first (xarray.Dataset.interp).")
        return found.load(wanted, texts)

    units = {name: str(variable.attrs.get("units", "")) for name, variable in variables.items()}
    index = next((str(name) for name in source.dims if str(name) in source.coords
                  and source.coords[name].dtype.kind in "iufMm"), None) if len(source.dims) == 1 else None
    return replace(found, load=load, units=units, index=index)


def _of_arrays(label: str, variables: Mapping[Any, Any], how: Format) -> RawTable:
    if not variables:
        raise DataError(f"{label} holds no arrays.")
    named = {str(name): value for name, value in variables.items()}
    step, named = _stated_step(named, label)
    dated = tuple(name for name, value in named.items() if getattr(getattr(value, "dtype", None), "kind", "") in "Mm"
                  and getattr(value, "ndim", 0) == 1)
    return RawTable(label, list(named), lambda wanted, _: {name: named[name] for name in wanted}, how, dates=dated,
                    step=step)


def _stated_step(named: Mapping[str, Any], label: str) -> tuple[float | None, dict[str, Any]]:
    """Return the sampling time that stands beside the samples as a single number, and the other variables."""
    step, others = None, dict(named)
    for name, value in named.items():
        word = name.rpartition(".")[2]
        if (is_step_name(word) or is_rate_name(word)) and np.size(value) == 1 and np.asarray(value).dtype.kind in "iuf":
            number = float(np.ravel(value)[0])
            if not 0 < number < np.inf:
                kind = "rate" if is_rate_name(word) else "time"
                raise DataError(f"{label}: {name} = {number:g}: the sampling {kind} beside the samples must be "
                                "positive; leave it out and pass dt=.")
            step = 1 / number if is_rate_name(word) else number
            del others[name]
    return step, others


def _of_array(label: str, array: np.ndarray, how: Format) -> RawTable:
    if array.ndim not in (1, 2):
        raise DataError(f"{label} has shape {array.shape}; it must be (samples, channels).")
    table = array[:, None] if array.ndim == 1 else array
    check_shape(table, label)
    names = position_names(how.columns, table.shape[1], label)
    return RawTable(label, names, _of_arrays(label, dict(zip(names, table.T)), how).load, how)


# -- in blocks and parts


def is_dask(thing: Any) -> bool:
    """Whether something is a Dask collection, without importing Dask."""
    return hasattr(thing, "__dask_graph__") and hasattr(thing, "to_delayed")


def open_source(source: Any, chunk: int, how: Format) -> Source:
    """Open a file, a folder of Parquet files, a mapping {channel: npy file or Dask array} or a Dask collection.

    Arguments as of `optid.data.streams.open_stream`, errors as of `open_tables`.
    """
    if is_dask(source):
        return _of_dask(source, chunk, how)
    if isinstance(source, Mapping):
        if source and all(is_dask(item) for item in source.values()):
            return _of_dask(_stacked(source), chunk, replace(how, columns=list(map(str, source))))
        return _of_npy(source, chunk, how)
    if not isinstance(source, str | Path):
        raise DataError(f"a stream is opened from a path or a Dask collection, not from {type(source).__name__}; "
                        "use read for data in memory.")
    if Path(source).is_dir():
        return _of_folder(Path(source), chunk, how)
    path = existing(Path(source)).absolute()
    kind = path.suffix.lower()
    if kind == ".parquet":
        from optid.data.reading.parquet import parquet_blocks, parquet_footer, parquet_parts

        names, rows, dates = parquet_footer(path)
        whole = Part(path.name, partial(parquet_blocks, path, None, chunk), rows)
        return Source(names, rows, whole, lambda _: parquet_parts(path, chunk), path.name, how, dates)
    if kind in TEXT:
        file = open_csv(path, how)
        found = _of_files(file.names, how, Part(path.name, partial(file.blocks, chunk)), path)
        return replace(found, how=file.layout.how, dates=file.layout.dates, units=file.layout.units,
                       findings=file.layout.findings)
    if kind == ".npy":
        opened = open_npy(path, how.columns)
        return _of_files(opened.names, how, Part(path.name, partial(opened.blocks, chunk), opened.rows), path)
    raise DataError(f"{path.name}: streams are read from .csv, .txt, .tsv, .parquet and .npy files, and from "
                    "folders of .parquet files; use read.")


def _of_files(names: Sequence[str], how: Format, whole: Part, *paths: Path, label: str = "") -> Source:
    return Source(names, whole.n_samples, whole, lambda _: file_parts([whole], *paths), label or whole.label, how)


def _of_npy(paths: Mapping[Any, Any], chunk: int, how: Format) -> Source:
    if not paths:
        raise DataError("the mapping {channel: path of an npy file, or Dask array} is empty; give every channel.")
    for name, path in paths.items():
        if not isinstance(path, str | Path):
            raise DataError(f"channel {str(name)!r} is of type {type(path).__name__}: a stream takes paths of npy "
                            "files for all channels, or Dask arrays for all; use read for data in memory.")
    files = {str(name): open_npy(existing(Path(path).absolute())) for name, path in paths.items()}
    for name, file in files.items():
        if len(file.names) != 1:
            raise DataError(f"channel {name!r}: {file.path.name} has {len(file.names)} columns; it must have one.")
    rows = _one_length({name: file.rows for name, file in files.items()})
    first = next(iter(files.values())).path.name
    whole = Part(first, partial(side_by_side, files, chunk), rows)
    return _of_files(list(files), how, whole, *(file.path for file in files.values()), label="the npy files")


def _one_length(lengths: Mapping[str, Any]) -> Any:
    if len(set(map(str, lengths.values()))) != 1:
        raise DataError(f"the channels have different lengths: {dict(lengths)}. Cut them to the common part.")
    return next(iter(lengths.values()))


def _of_folder(folder: Path, chunk: int, how: Format) -> Source:
    from optid.data.reading.parquet import parquet_footer, parquet_parts

    files = sorted(folder.glob("*.parquet"), key=_natural)
    if not files:
        below = sorted({path.parent.relative_to(folder).as_posix() for path in folder.rglob("*.parquet")}, key=_natural)
        hint = f" Folders below have: {', '.join(below[:5])}; give a list of folders, one per experiment." * bool(below)
        raise DataError(f"folder {str(folder)!r} has no .parquet file.{hint}")
    found = [parquet_footer(existing(path)) for path in files]
    names = found[0][0]
    for path, (there, *_) in zip(files, found):
        if odd := sorted(set(there) ^ set(names)):
            raise DataError(f"{path.name} has other columns than {files[0].name} (differing: {', '.join(odd)}): "
                            f"the files of {folder.name!r} are not parts of one table.")
    return Source(names, sum(rows for _, rows, _ in found), None,
                  lambda _: [part for path in files for part in parquet_parts(path, chunk)], folder.name, how,
                  found[0][2])


def _natural(path: Any) -> list[Any]:
    """Sort part.2 before part.10."""
    words = re.split(r"(\d+)", getattr(path, "name", path))
    return [(int(word), "") if word.isdigit() else (-1, word) for word in words]


def _stacked(arrays: Mapping[Any, Any]) -> Any:
    import dask.array

    for name, array in arrays.items():
        if getattr(array, "ndim", None) != 1:
            raise DataError(f"channel {str(name)!r}: must be a Dask array (N,), not of shape "
                            f"{getattr(array, 'shape', None)}.")
    _one_length({str(name): array.shape[0] for name, array in arrays.items()})
    return dask.array.stack(list(arrays.values()), axis=1)


def _of_dask(collection: Any, chunk: int, how: Format) -> Source:
    dates: tuple[str, ...] = ()
    if hasattr(collection, "columns"):
        label, rows, known = "the Dask data frame", None, {str(name): name for name in collection.columns}
        names = list(known)
        dates = tuple(str(name) for name, kind in collection.dtypes.items() if getattr(kind, "kind", "") in "Mm")
    else:
        label = "the Dask array"
        if getattr(collection, "ndim", None) not in (1, 2):
            raise DataError("must be a Dask data frame or an array (N, channels); the array has "
                            f"{getattr(collection, 'ndim', 'no')} dimensions.")
        array = collection[:, None] if collection.ndim == 1 else collection
        rows, width = array.shape
        names, known = position_names(how.columns, width, label), None
        if rows == rows and width > rows:
            raise DataError(f"the Dask array has shape {array.shape}: more channels than samples. Transpose it (x.T).")
        array = array.rechunk({1: -1})

    def parts(wanted: Sequence[str]) -> list[Part]:
        if known is not None:  # the other columns are not even read where Dask can help it
            there, what = list(dict.fromkeys(wanted)), "partition"
            contents = collection[[known[name] for name in there]].to_delayed()
            lengths = [np.nan] * len(contents)
        else:
            there, what, contents, lengths = names, "chunk", array.to_delayed().ravel(), array.chunks[0]
        labels = [f"{label}, {what} {i}" for i in range(len(contents))]
        return [Part(one, partial(partition_blocks, one, there, chunk), None if n != n else int(n), content=content)
                for one, content, n in zip(labels, contents, lengths)]

    return Source(names, None if rows is None or rows != rows else int(rows), None, parts, label, how,
                  dates)
