"""From files, frames and dictionaries to `Data`."""

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from optid.arrays import as_samples, check_shape
from optid.data.channels import sampling_time
from optid.data.reading import columns as known
from optid.data.reading.clock import TimeColumn, UnreadStamps, clock_columns, clock_values, is_time_name, seconds
from optid.data.reading.columns import Wanted, choose
from optid.data.reading.format import Format, is_number
from optid.data.reading.rival_clocks import settle
from optid.data.reading.runs import RawRun, cut_between, join_continued, sample_evenly
from optid.data.reading.sources import open_tables
from optid.data.reading.tables import RawTable
from optid.data.record import Data, Experiment
from optid.data.streams import Stream, open_stream
from optid.errors import DataError

MOST_TAGS = 1000  # of a long table, one row for each tag and instant

__all__ = ["Format", "Stream", "open_stream", "read"]


def read(source: Any, inputs: Wanted = None, outputs: Wanted = None, dt: float | None = None,
         time: str | int | bool | Sequence[str] | None = None, experiment: str | int | None = None,
         name: str | None = None, *, format: Format | None = None, **words: Any) -> Data:
    """Read a record; blank, NaN and NA cells are missing samples.

    What was derived, assumed or repaired is told by `Data.findings`.

    Args:
        source: path of a .csv, .txt, .tsv, .dat, .lvm, .parquet, .mat (5 to 7.3), .npz or .npy file, with the extra
            ``plant`` also of an .xlsx, .tdms or .mf4 file; a pandas, polars or arrow table; an xarray data set; a
            mapping {name: (N,) or (N, channels) array}; an (N, channels) array; or a list of these, one per experiment.
            A source whose clock continues that of the one before continues its experiment. The fields of a MATLAB
            structure are named "structure.field".
        inputs: columns of the inputs by name or position, or {channel name: column}; u, or u1, u2, ..., when not given.
        outputs: columns of the outputs likewise; y, or y1, y2, ..., when not given.
        dt: sampling time in seconds; from the time stamps when not given, 1 sample without stamps.
        time: column of time stamps, or two with date and time of day; when not given the one that is named as a clock
            (t, time, Timestamp, Zeit, "Time (ms)", ...), a time index of a frame, or the only column of dates; False
            ignores it. Stamps are dates, times of day, seconds, another unit that the name tells, seconds or
            milliseconds since 1970, or the days of Excel or MATLAB.
        experiment: column whose value names the experiment; a new experiment starts where it changes.
        name: name of the data set; the file's when not given.
        format: how the table is written, and what to repair.
        words: the fields of `Format` as keywords, such as ``delimiter=";", decimal=","``.

    Raises:
        DataError: missing file or column (with the nearest name), empty table, cell that is not a number (with column
            and row), time stamps that are not uniform (with sample, step and median), infinite sample, or a missing
            extra (with its pip line); the message says what to type.

    Warns:
        DataWarning: integer samples that look saturated or wrapped around.
    """
    how = Format.of(format, words)
    dt = None if dt is None else sampling_time(dt)
    if name is not None and not isinstance(name, str):
        raise DataError(f"name={name!r}: must be a text.")
    sources = list(source) if isinstance(source, list | tuple) else [source]
    if not sources:
        raise DataError("the list of sources is empty; give at least one.")
    runs: list[RawRun] = []
    for item in sources:
        runs += _runs_of(open_tables(item, how), inputs, outputs, time, experiment)
    for run in runs:
        if run.names != runs[0].names:
            raise DataError(f"{run.label} has channels {run.names}, {runs[0].label} has {runs[0].names}.")
        for channel in (name for name in run.units if run.units[name] != runs[0].units.get(name, "")):
            if run.units[channel] and runs[0].units.get(channel) and not (how.input_units or how.output_units):
                raise DataError(f"{run.label} has channel {channel!r} in {run.units[channel]}, {runs[0].label} in "
                                f"{runs[0].units[channel]}. Convert one file, or give the units, input_units= and "
                                "output_units=.")
    runs, joined = join_continued(runs, how) if experiment is None and len(sources) > 1 else (runs, [])
    runs = cut_between(runs, how, dt)
    pieces, step, findings = sample_evenly(runs, how, dt)
    dated = all(run.is_dated for run in runs)
    notes = [*(note for run in runs for note in run.findings), *joined, *findings]
    if step is None:
        clockless = "no time column" if all(run.stamps is None for run in runs) else "a single time stamp"
        notes.insert(0, f"{clockless}: 1 sample = 1; pass dt= (seconds)")
    first = sources[0]
    units = runs[0].units
    return Data.of_experiments(
        [Experiment(piece.u, piece.y, float(seconds(np.atleast_1d(piece.stamp))[0]), piece.times) for piece in pieces],
        1.0 if step is None else step, *runs[0].names,
        how.input_units or [units.get(one, "") for one in runs[0].names[0]],
        how.output_units or [units.get(one, "") for one in runs[0].names[1]],
        name if name is not None else Path(first).stem if isinstance(first, str | Path) else "",
        time_unit="" if step is None else "s", dated=dated, findings=tuple(dict.fromkeys(notes)),
    )


def _runs_of(tables: Sequence[RawTable], inputs: Wanted, outputs: Wanted, time: Any, experiment: Any) -> list[RawRun]:
    """Return the experiments of a source; of several tables those that have all channels."""
    if len(tables) == 1:
        return _runs(tables[0], inputs, outputs, time, experiment)
    whole, refusals = [], []
    for table in tables:
        try:
            for wanted, letter in ((inputs, "u"), (outputs, "y")):
                choose(table.names, wanted, letter, table.label)
            whole.append(table)
        except DataError as error:
            refusals.append(error)
    if not whole:
        raise refusals[0]
    return [run for table in whole for run in _runs(table, inputs, outputs, time, experiment)]


def _runs(table: RawTable, inputs: Wanted, outputs: Wanted, time: Any, experiment: str | int | None) -> list[RawRun]:
    label, how = table.label, table.how
    inputs = table.inputs if inputs is None else inputs
    outputs = table.outputs if outputs is None else outputs
    try:
        ins, outs = choose(table.names, inputs, "u", label), choose(table.names, outputs, "y", label)
    except DataError as error:
        raise _explain_missing_column(error, table, inputs, outputs) from None
    if table.split is not None:
        tables = table.split([*ins.values(), *outs.values()], time)
        return [run for one in tables for run in _runs(one, ins, outs, None if time is True else time, experiment)]
    signals = list(dict.fromkeys([*ins.values(), *outs.values()]))
    clocks = clock_columns(table.names, time, signals, label, table.index, table.dates)
    group = None if experiment is None else known.column_name(table.names, experiment, label)
    goods: dict[str, str] = dict(how.quality or {})
    quality = known.check_quality_columns(goods, table.names, signals, label)
    others = [name for name in (*clocks, *([group] if group is not None else []), *quality) if name not in signals]
    unused = [name for name in known.quality_columns(table.names, signals) if name not in (*quality, *others)]
    wanted = list(dict.fromkeys([*signals, *others, *unused]))
    loaded = table.load(wanted, dict.fromkeys([*others, *unused], "clock") | ({group: "text"} if group else {}))
    findings = [*table.findings]
    loaded |= {name: clock_values(loaded[name], f"{label}, column {name!r}") for name in clocks
               if isinstance(loaded[name], np.ndarray | list)}
    clock, stamps, said = _clock(table, loaded, clocks, time)
    findings += said
    if clock is None and time is None and table.step is None:
        findings += [f"column {name!r} {hint}: pass time={name!r} if it is the clock"
                     for name, hint in table.hints.items() if name not in signals][:2]
    groups = None if group is None else np.ravel(loaded[group])
    good = {name: known.is_good(loaded[name], goods[name], f"{label}, column {name!r}") for name in quality}
    findings += [known.unused_quality(unused, loaded)] if unused else []
    loaded = {name: _numeric(loaded, name, table) for name in signals}
    y_names, y = _stacked(outs, loaded, table, quality, good, kept=set(ins.values()))
    u_names, u = _stacked(ins, loaded, table, quality, good)
    if len(u) != len(y):
        raise DataError(f"{label}: u has {len(u)} samples and y has {len(y)}. Cut both to the common part.")
    if stamps is not None and len(stamps) != len(u):
        raise DataError(f"{label}: {clocks[0]!r} has {len(stamps)} stamps for {len(u)} samples; time=False ignores it.")
    channels = {**dict(zip(u_names, u.T)), **dict(zip(y_names, y.T))}
    if clock is None and time is None:
        findings += [f"channel {name!r} is named as a clock and increases throughout, but is read as a signal"
                     for name, samples in channels.items() if is_time_name((ins | outs).get(name, name).split(".")[-1])
                     and len(samples) > 2 and (np.diff(samples) > 0).all()]
    if not how.numbers:
        findings += known.likely_marks(channels)
    units = {name: table.units.get(column, "") for name, column in (ins | outs).items()}
    whole = RawRun(label, (u_names, y_names), u, y, stamps, clock, units, table.step, tuple(findings))
    runs = []
    for value, rows in _groups(groups, len(u), label):
        part = replace(whole.part(rows), label=label if value is None else f"{label}, experiment {value!r}")
        check_shape(part.u, f"{part.label}, inputs")
        check_shape(part.y, f"{part.label}, outputs")
        runs.append(part)
    return runs


def _clock(table: RawTable, loaded: Mapping[str, Any], clocks: Sequence[str], time: Any
           ) -> tuple[TimeColumn | None, np.ndarray | None, list[str]]:
    """Return the clock of a table, its stamps and what is to be said of it."""
    if not clocks:
        return None, None, []
    try:
        return settle(loaded, clocks, table, asked=time is not None and time is not True)
    except UnreadStamps as error:
        if not table.advice:
            raise
        raise DataError(f"{error.cause} Pass {table.advice}.") from None


def _numeric(loaded: Mapping[str, Any], column: str, table: RawTable) -> Any:
    """Return the samples of a column, texts converted to numbers and marks of missing samples to NaN."""
    values = loaded[column]
    array = np.asarray(values) if not isinstance(values, np.ma.MaskedArray) else values
    if array.dtype.kind in "UO" and array.ndim == 1 and all(isinstance(cell, str) for cell in array.tolist()):
        cells = array.tolist()
        array, row = known.to_numbers(cells, table.how)
        if row is not None:
            beside = [str(part[row]) for part in map(np.ravel, loaded.values()) if part.size > row]
            raise known.cell_error(f"{table.label}: column {column!r}, row {row + 1}", cells[row], table.how, [cells],
                                   table.advice, beside)
    return known.without_marks(array, table.how) if array.dtype.kind in "iuf" else values


def _stacked(pairs: dict[str, str], loaded: dict[str, Any], table: RawTable, quality: Mapping[str, str],
             good: Mapping[str, np.ndarray], kept: Set[str] = frozenset()) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and samples (N, channels), read-only; all columns but those kept make room for their copies."""
    names: list[str] = []
    parts, label = [], table.label
    uses = Counter(pairs.values())
    for name, column in pairs.items():
        part = as_samples(loaded[column], f"{label}, column {column!r}")
        for guard in (guard for guard, signal in quality.items() if signal in (column, "")):
            part = np.where(good[guard][:, None], part, np.nan)
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
    seen: set[str] = set()
    for k, value in enumerate(labels):
        if value in seen:
            raise DataError(f"{label}: experiment {value!r} starts again at row {starts[k] + 1}. Sort the rows by "
                            "experiment, or give the second run its own value.")
        seen.add(value)
    return [(value, slice(a, b)) for value, a, b in zip(labels, starts, [*starts[1:], rows])]


def _explain_missing_column(error: DataError, table: RawTable, inputs: Any, outputs: Any) -> DataError:
    """Return the error about a missing column, or the one that the table is long where its cells name the channels."""
    texts = [name for name in table.names if name and name not in table.dates and not is_time_name(name)]
    if not texts:
        return error
    try:
        loaded = table.load(texts, dict.fromkeys(texts, "text"))
    except DataError:
        return error
    asked = [one for wanted in (inputs, outputs) for one in (
        wanted.values() if isinstance(wanted, dict) else wanted if isinstance(wanted, list | tuple) else [wanted])
        if one is not None]
    for name in texts:
        cells = np.asarray(loaded[name])
        if cells.dtype.kind not in "UO" or cells.ndim != 1:
            continue
        tags = list(dict.fromkeys(str(cell) for cell in cells[:10_000]))
        counts = [str(cell) for cell in cells[:10_000]]
        named = [one for one in asked if counts.count(str(one)) > 1]
        repeated = len(tags) <= MOST_TAGS and len(cells) >= 4 * len(tags) > 4 and not asked
        numbers = any(is_number(tag.replace(",", ".")) for tag in tags)  # with decimal commas, too
        if named or (repeated and not numbers):
            clock = next((one for one in table.names if one in table.dates or is_time_name(one)), "TIME")
            numeric = [one for one in table.names if one != name and one in loaded and _is_numeric(loaded[one])]
            value = next((one for one in numeric if "val" in one.lower()), numeric[0] if numeric else "VALUE")
            return DataError(
                f"{table.label} is a long table: column {name!r} holds the tags ({', '.join(tags[:4])}), one row for "
                f"each tag and instant. Make a column of each tag first, in pandas: "
                f"frame.set_index([{clock!r}, {name!r}])[{value!r}].unstack(), and read the result.")
    return error


def _is_numeric(values: Any) -> bool:
    array = np.asarray(values)
    if array.dtype.kind in "iuf":
        return True
    try:
        array[:100].astype(float)
    except (ValueError, TypeError):
        return False
    return True
