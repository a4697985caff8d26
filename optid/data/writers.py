"""From `Data` to a file that `optid.read` reads back."""

import csv
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from optid.arrays import as_list
from optid.data.reading.format import Format
from optid.data.reading.layout import find_layout
from optid.errors import DataError

TIME, EXPERIMENT = "time", "experiment"
HEAD = 60  # rows from which a reader finds header and units


def write_csv(data: Any, path: Path | str) -> Path:
    """Write a record as a text table with a row of units; file and errors as of `Data.to_csv`."""
    path = Path(path)
    with TemporaryDirectory() as folder:
        head = Path(folder) / path.name
        _write(head, islice(_rows(data), HEAD))
        _check(head, data)
    _write(path, _rows(data))
    return path


def _write(path: Path, rows: Iterable[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def _rows(data: Any) -> Iterator[list[Any]]:
    """Yield the header, the units where one is known, and the samples."""
    clock = bool(data.dated or data.time_unit)
    group = data.n_experiments > 1
    yield [EXPERIMENT] * group + [TIME] * clock + [*data.inputs, *data.outputs]
    if any(data.input_units + data.output_units):
        unit = "" if data.dated else data.time_unit
        yield [""] * group + [unit] * clock + [*data.input_units, *data.output_units]
    for number, (times, record) in enumerate(zip(as_list(data.time), data.records), 1):
        for stamp, samples in zip(_stamps(times), record.tolist()):
            yield [number] * group + [stamp] * clock + [_cell(x) for x in samples]


def _stamps(times: np.ndarray) -> list[str]:
    """Return times as text: dates with as few digits as tell them, seconds with 15 digits."""
    if times.dtype.kind != "M":
        return [f"{time:.15g}" for time in times]
    unit: Any = next(unit for unit in ("s", "ms", "us", "ns") if (times.astype(f"M8[{unit}]") == times).all())
    return np.datetime_as_string(times, unit).tolist()


def _cell(value: float) -> str:
    """Return the shortest text that is read as the same sample; NaN where it is missing: a blank row may be skipped."""
    return "NaN" if value != value else repr(value).removesuffix(".0")


def _check(head: Path, data: Any) -> None:
    """Refuse names and units that would be read as something else, such as a name '0.5' or a unit '1'."""
    wanted = [*data.inputs, *data.outputs]
    try:
        layout = find_layout(head, Format())
        if [name for name in layout.names if name not in (TIME, EXPERIMENT)] != wanted:
            raise DataError(f"the channels {', '.join(wanted)} would be read as {', '.join(layout.names)}")
        units, known = [*data.input_units, *data.output_units], [layout.units.get(name, "") for name in wanted]
        if known != units:
            raise DataError(f"the units {', '.join(map(repr, units))} would be read as {', '.join(map(repr, known))}")
    except DataError as error:
        raise DataError(f"{error}. Rename the channels or their units, so that the file is read as it is written"
                        ) from None
