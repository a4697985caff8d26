"""The command `optid monitor`: faults of a plant as they happen, on a stream of samples."""

import json
import os
import signal
import sys
import time as clock
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from optid.cli.options import (
    MODEL,
    RECORD,
    RESULT,
    Columns,
    Decimal,
    Delimiter,
    Dt,
    Inputs,
    Load,
    Outputs,
    StateJump,
    Time,
)
from optid.cli.terminal import FILES, Waiting, hearing, note

POLL = 0.1
"""Seconds between looks at a file that is followed."""

BLOCK = 1 << 16
"""Bytes read at a time."""

ARL0 = 10_000
"""Mean samples between false alarms that are asked for where nothing is said."""

KEPT = 10_000
"""Samples after which the state is saved, events or not."""


def monitor(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file (.json) of a state-space model.")],
    follow: Annotated[
        Path | None,
        typer.Option(
            "--follow", "-f", metavar="FILE", rich_help_panel=RECORD,
            help="Read this file, and what is written to it later, instead of the standard input.",
        ),
    ] = None,
    until_end: Annotated[
        bool, typer.Option("--until-end", rich_help_panel=RECORD, help="With --follow: stop at the end of the file.")
    ] = False,
    inputs: Inputs = None,
    outputs: Outputs = None,
    dt: Dt = None,
    time: Time = None,
    columns: Columns = None,
    delimiter: Delimiter = ",",
    decimal: Decimal = ".",
    fill_gaps: Annotated[
        bool,
        typer.Option("--fill-gaps", rich_help_panel=RECORD, help="Count samples that the time stamps skip as missing."),
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", rich_help_panel=RECORD, help="Stop at a row that cannot be read.")
    ] = False,
    kinds: Annotated[
        list[str] | None,
        typer.Option(
            "--kinds", "-k", metavar="NAME...", rich_help_panel=MODEL,
            help="bias, loss, stuck, drift, spike. [dim]bias, loss, spike[/]",
        ),
    ] = None,
    load: Load = None,
    state_jump: StateJump = True,
    arl0: Annotated[
        float | None,
        typer.Option(
            "--arl0", metavar="N", rich_help_panel=MODEL,
            help="Mean samples between false alarms. [dim]10000, or that of --thresholds[/]",
        ),
    ] = None,
    window: Annotated[
        int, typer.Option("--window", "-w", metavar="N", rich_help_panel=MODEL, help="Samples of the window.")
    ] = 100,
    healthy: Annotated[
        list[Path] | None,
        typer.Option(
            "--healthy", metavar=FILES, rich_help_panel=MODEL,
            help="A healthy record: its innovations must be white and of the size that the model says.",
        ),
    ] = None,
    rescale: Annotated[
        bool, typer.Option("--rescale", rich_help_panel=MODEL, help="Take the scale of the noise from --healthy.")
    ] = False,
    thresholds: Annotated[
        Path | None,
        typer.Option(
            "--thresholds", metavar="FILE", rich_help_panel=MODEL,
            help="Thresholds of an earlier run (.json); written there when there is no such file.",
        ),
    ] = None,
    extrapolate: Annotated[
        bool,
        typer.Option(
            "--extrapolate", rich_help_panel=MODEL, help="Allow thresholds beyond what a simulation supports."
        ),
    ] = False,
    seed: Annotated[int, typer.Option("--seed", rich_help_panel=MODEL, help="Seed of simulated thresholds.")] = 0,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state", metavar="FILE", rich_help_panel=RESULT,
            help="Go on from this state (.npz) where there is one, and keep it there.",
        ),
    ] = None,
    lines: Annotated[
        bool, typer.Option("--json", rich_help_panel=RESULT, help="One JSON object per line instead of words.")
    ] = False,
) -> None:
    """Watch a stream: one line for every alarm, every fault that is named, and everything that is over.

    Rows that cannot be read are named on the error stream and count as missing samples.

    Example: optid monitor model.json --arl0 10000 < stream.csv
    """
    from optid.cli import arguments as words
    from optid.data.reading.rows import RowReader

    words.check_folders(state, thresholds)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        plant = words.state_space_model(model)
        how = words.as_modelled(
            {"inputs": words.listed(inputs), "outputs": words.listed(outputs), "dt": dt, "time": time,
             "experiment": None, "columns": columns, "delimiter": delimiter, "decimal": decimal}, plant
        )
        reader = RowReader(
            how["inputs"], how["outputs"], dt=how["dt"], time=False if time == "none" else time,
            columns=words.listed(columns), delimiter=delimiter.replace("\\t", "\t"), decimal=decimal, fill=fill_gaps,
            label="standard input" if follow is None else follow.name,
        )
        if state is not None and state.exists():
            watcher = _resumed(state, plant, model)
        else:
            waiting.step("simulating healthy plants for the thresholds")
            sound: Any = words.read_record(healthy, how) if healthy else None
            watcher = _new(
                plant, words.listed(kinds), words.directions(load, "--load"), state_jump, thresholds, arl0=arl0,
                window=window, seed=seed, healthy=sound, rescale=rescale, extrapolate=extrapolate,
            )
    for sentence in heard:
        note(sentence)
    _watch(watcher, reader, follow, until_end, state, strict=strict, as_json=lines)


def _new(
    plant: Any, kinds: Any, process: Any, state_jump: bool, path: Path | None, arl0: float | None, **how: Any
) -> Any:
    from optid.errors import ModelFileError, StructureError
    from optid.faults import Calibration, Monitor, dictionary
    from optid.faults.monitor.monitoring import KINDS_BY_DEFAULT

    found = dictionary(plant, kinds=kinds or list(KINDS_BY_DEFAULT), process=process, state_jump=state_jump)
    if path is not None and path.exists():
        try:
            known = Calibration.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ModelFileError(f"{path} does not hold thresholds ({error}): name another file") from None
        if arl0 is not None and arl0 != known.arl0:
            raise StructureError(
                f"{path} holds thresholds for a false alarm every {known.arl0:g} samples, --arl0 asks for {arl0:g}: "
                "leave --arl0 out, or name another file"
            )
        return Monitor(plant, found, thresholds=known, **how)
    made = Monitor(plant, found, ARL0 if arl0 is None else arl0, **how)
    if path is not None:
        path.write_text(json.dumps(made.calibration.to_dict(), indent=1), encoding="utf-8")
    return made


def _resumed(state: Path, plant: Any, path: Path) -> Any:
    from optid.errors import StructureError
    from optid.faults import Monitor

    found = Monitor.load(state)
    if found.dictionary.model.to_dict() != plant.to_dict():
        raise StructureError(f"{state} is the state of another model than {path}: remove it, or name another file")
    return found


def _watch(
    watcher: Any, reader: Any, follow: Path | None, until_end: bool, state: Path | None, *, strict: bool, as_json: bool
) -> None:
    """Read, judge and tell until the stream ends."""
    from optid.errors import DataError

    start = 0
    if watcher.source is not None and follow is not None:
        if watcher.source["path"] != str(follow.resolve()):
            raise DataError(f"{state} is the state of {watcher.source['path']}, not of {follow}: name another file")
        start = int(watcher.source["offset"])
        reader.resume(watcher.source)
    offset, bad, saved = start, 0, watcher.samples

    def keep() -> None:
        nonlocal saved
        if state is not None:
            watcher.source = None if follow is None else {
                "path": str(follow.resolve()), "offset": offset, **reader.memory
            }
            watcher.save(state)
            saved = watcher.samples

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        for raw in _lines(follow, until_end, start):
            first, line = watcher.samples, reader.line
            rows = reader.read(_text(raw, reader))
            if strict and rows.bad:
                raise DataError(rows.bad[0][1])
            for _, text in rows.bad:
                note(text)
            bad += len(rows.bad)
            events = watcher.run(rows.u, rows.y)
            for event in events:
                place = event.sample - first
                _tell(event, int(rows.lines[place]), rows.stamps[place] if rows.stamps else "", as_json)
            # a line that ends the stream is the first to be read when it is resumed
            done = raw[: rows.stop - line - 1] if rows.error else raw
            offset += sum(map(len, done)) + len(done)
            if rows.error:
                raise DataError(rows.error)
            if events or watcher.samples - saved >= KEPT:
                keep()
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:  # whoever read the events has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        keep()
    if not watcher.samples:
        note("no sample was read: there was nothing behind the header")
    if bad:
        note(f"{bad} of {watcher.samples} rows could not be read in full")


def _tell(event: Any, line: int, stamp: str, as_json: bool) -> None:
    if as_json:
        print(json.dumps({**event.to_dict(), "line": line, "time": stamp or None}), flush=True)
    else:
        print(f"t = {stamp}, sample {event}" if stamp else f"sample {event}", flush=True)


def _lines(follow: Path | None, until_end: bool, start: int) -> Iterator[list[bytes]]:
    """Yield complete lines as they come, without their ends."""
    rest = b""
    for part in _standard_input() if follow is None else _followed(follow, until_end, start):
        whole, found, after = (rest + part).rpartition(b"\n")
        if found:
            yield whole.split(b"\n")
        rest = after
        if not part and rest:  # the last line has no end
            yield [rest]


def _text(raw: list[bytes], reader: Any) -> list[str]:
    from optid.errors import DataError

    try:
        return [line.removesuffix("\r") for line in b"\n".join(raw).decode("utf-8").split("\n")]
    except UnicodeDecodeError:
        for number, line in enumerate(raw, reader.line + 1):
            try:
                line.decode("utf-8")
            except UnicodeDecodeError as error:
                raise DataError(f"line {number} is not UTF-8 text ({error})") from None
        raise


def _standard_input() -> Iterator[bytes]:
    if sys.stdin.isatty():
        note("reading from the terminal; end with Ctrl-D, or pipe a file: optid monitor model.json < stream.csv")
    while part := os.read(sys.stdin.fileno(), BLOCK):
        yield part
    yield b""


def _followed(path: Path, until_end: bool, start: int) -> Iterator[bytes]:
    from optid.errors import DataError

    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size < start:
            raise DataError(f"{path} is shorter than what was read of it before: it was replaced or cut")
        file.seek(start)
        while True:
            part = file.read(BLOCK)
            if part:
                yield part
            elif until_end:
                yield b""
                return
            else:
                if path.stat().st_size < file.tell():
                    raise DataError(f"{path} was cut while it was followed: start again on the new file")
                clock.sleep(POLL)
