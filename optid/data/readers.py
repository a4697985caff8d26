"""From files, frames and dictionaries to `Data`."""

from collections import Counter
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import as_samples, check_shape
from optid.data.channels import sampling_time
from optid.data.reading import columns as known
from optid.data.reading.columns import TIME_TOLERANCE, Wanted, as_stamps, choose, seconds
from optid.data.reading.sources import Table, open_table
from optid.data.record import Data, Experiment
from optid.data.streams import Stream, open_stream
from optid.errors import DataError

__all__ = ["Stream", "open_stream", "read"]


def read(source: Any, inputs: Wanted = None, outputs: Wanted = None, dt: float | None = None,
         time: str | int | bool | None = None, experiment: str | int | None = None, *,
         columns: Sequence[str] | None = None, input_units: str | Sequence[str] | None = None,
         output_units: str | Sequence[str] | None = None, name: str | None = None, delimiter: str = ",",
         decimal: str = ".", time_tolerance: float = TIME_TOLERANCE) -> Data:
    """Read a record; blank, NaN and NA cells are missing samples.

    Args:
        source: path of a .csv, .txt, .tsv, .parquet, .mat (5 to 7.3), .npz or .npy file; a pandas, polars or arrow
            table; an xarray data set; a mapping {name: (N,) or (N, channels) array}; an (N, channels) array; or a list
            of these, one per experiment. The fields of a MATLAB structure are named "structure.field".
        inputs: columns of the inputs by name or position, or {channel name: column}; u, or u1, u2, ..., when not given.
        outputs: columns of the outputs likewise; y, or y1, y2, ..., when not given.
        dt: sampling time; from the time stamps when not given, 1 without stamps.
        time: column of time stamps (numbers, dates, ISO text; dates count in seconds); when not given a column t or
            time, a time index of a frame, or the only column of dates of a frame or Parquet file; False ignores it.
        experiment: column whose value names the experiment; a new experiment starts where it changes.
        columns: names of the columns of a source that has none.
        input_units: one unit per input.
        output_units: one unit per output.
        name: name of the data set; the file's when not given.
        delimiter: character between the cells of a CSV file.
        decimal: decimal mark of a CSV file, "." or ",".
        time_tolerance: largest deviation of a time step from the median step, relative to it.

    Raises:
        DataError: missing file or column (with the nearest name), empty table, cell that is not a number (with column
            and row), time stamps that are not uniform (with sample, step and median), infinite sample, or a missing
            extra (with its pip line).

    Warns:
        DataWarning: integer samples that look saturated or wrapped around.
    """
    dt = None if dt is None else sampling_time(dt)
    sources = list(source) if isinstance(source, list | tuple) else [source]
    if not sources:
        raise DataError("the list of sources is empty; give at least one.")
    runs: list[_Run] = []
    for item in sources:
        runs += _runs(open_table(item, columns, delimiter, decimal), inputs, outputs, time, experiment)
    step = dt
    for run in runs:
        if run.names != runs[0].names:
            raise DataError(f"{run.label} has channels {run.names}, {runs[0].label} has {runs[0].names}.")
        if run.stamps is not None:
            found = known.uniform_step(run.stamps, time_tolerance, run.label)
            step = known.agreed_step(found, step, time_tolerance, run.label)
    first = sources[0]
    starts = [0.0 if run.stamps is None else float(seconds(run.stamps[:1])[0]) for run in runs]
    return Data.of_experiments(
        [Experiment(run.u, run.y, start) for run, start in zip(runs, starts)],
        1.0 if step is None else step, *runs[0].names, input_units, output_units,
        name if name is not None else Path(first).stem if isinstance(first, str | Path) else "",
    )


class _Run(NamedTuple):
    """One experiment of one source; names of inputs and outputs, stamps (N,) or None."""

    label: str
    names: tuple[tuple[str, ...], tuple[str, ...]]
    u: np.ndarray
    y: np.ndarray
    stamps: np.ndarray | None


def _runs(table: Table, inputs: Wanted, outputs: Wanted, time: str | int | bool | None, experiment: str | int | None
          ) -> list[_Run]:
    label = table.label
    ins, outs = choose(table.names, inputs, "u", label), choose(table.names, outputs, "y", label)
    signals = [*ins.values(), *outs.values()]
    clock = known.time_column(table.names, time, signals, label, table.index)
    group = None if experiment is None else known.column_name(table.names, experiment, label)
    loaded = table.load(list(dict.fromkeys([*signals, *(name for name in (clock, group) if name is not None)])),
                        clock, group)
    stamps = None if clock is None else as_stamps(np.ravel(loaded[clock]), f"{label}, column {clock!r}")
    groups = None if group is None else np.ravel(loaded[group])
    loaded = {name: loaded[name] for name in signals}
    y_names, y = _stacked(outs, loaded, label, kept=set(ins.values()))
    u_names, u = _stacked(ins, loaded, label)
    if len(u) != len(y):
        raise DataError(f"{label}: u has {len(u)} samples and y has {len(y)}. Cut both to the common part.")
    if stamps is not None and len(stamps) != len(u):
        raise DataError(f"{label}: {clock!r} has {len(stamps)} stamps for {len(u)} samples; time=False ignores it.")
    runs = []
    for value, rows in _groups(groups, len(u), label):
        part = label if value is None else f"{label}, experiment {value!r}"
        check_shape(u[rows], f"{part}, inputs")
        check_shape(y[rows], f"{part}, outputs")
        runs.append(_Run(part, (u_names, y_names), u[rows], y[rows], None if stamps is None else stamps[rows]))
    return runs


def _stacked(pairs: dict[str, str], loaded: dict[str, Any], label: str, kept: Set[str] = frozenset()
             ) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and samples (N, channels), read-only; all columns but those kept make room for their copies."""
    names: list[str] = []
    parts = []
    uses = Counter(pairs.values())
    for name, column in pairs.items():
        part = as_samples(loaded[column], f"{label}, column {column!r}")
        parts.append(part)
        names += [name] if part.shape[1] == 1 else [f"{name}{c + 1}" for c in range(part.shape[1])]
        uses[column] -= 1
        if not uses[column] and column not in kept:
            del loaded[column]
        if len(part) != len(parts[0]):
            raise DataError(f"{label}: {column!r} has {len(part)} samples, {next(iter(pairs.values()))!r} has "
                            f"{len(parts[0])}. Cut them to the common part.")
    samples = parts[0] if len(parts) == 1 else np.hstack(parts)
    samples.flags.writeable = False
    return tuple(names), samples


def _groups(values: np.ndarray | None, rows: int, label: str) -> list[tuple[Any, slice]]:
    """Return the value and the rows of each experiment, in the order of the table."""
    if values is None:
        return [(None, slice(0, rows))]
    keys = ["" if v is None or v != v else str(v) for v in values.tolist()]
    if "" in keys:
        raise DataError(f"{label}: row {keys.index('') + 1} does not say which experiment it belongs to.")
    starts = [0] + [k for k in range(1, rows) if keys[k] != keys[k - 1]]
    labels = [keys[k] for k in starts]
    for k, value in enumerate(labels):
        if value in labels[:k]:
            raise DataError(f"{label}: experiment {value!r} starts again at row {starts[k] + 1}. Sort the rows by "
                            "experiment, or give the second run a value of its own.")
    return [(value, slice(a, b)) for value, a, b in zip(labels, starts, [*starts[1:], rows])]
