"""The command `optid monitor`: faults of a plant as they happen, on a stream of samples."""

import json
import os
import signal
import sys
import time as clock
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from optid.cli.options import READING, File, Paths, Words
from optid.cli.results import check_folders
from optid.cli.terminal import Spinner, capture_warnings, note
from optid.phrases import p_equals

if TYPE_CHECKING:
    from optid.cli.state_file import StateFile

LOUD = 20  # unreadable rows reported individually per block read; the others are counted
ARL0 = 10_000  # default mean number of samples between false alarms
HOUR = 3600.0  # seconds
REMEMBERED = 1000  # samples whose time stamps are kept, for the time of an onset
RETRY = 10.0  # seconds until a failed write is tried again, events or not
KEPT = 10_000  # samples after which the state is saved, events or not

Part = tuple[list[bytes], str]  # lines, and a remark where another file begins


def monitor(model: Path, follow: File = None, until_end: bool = False, *, how: dict[str, Any],
            fill_gaps: int | None = None, strict: bool = False, kinds: Words = None,
            load: Words = None, disturbance: Words = None, zero: Words = None, state_jump: bool = True,
            arl0: float | None = None, window: int = 100, identified: Paths = None, healthy: Paths = None,
            thresholds: File = None, extrapolate: bool = False, drift: float | None = None, adapt: float = 1.0,
            ack: bool = False, rebase: bool = False, maintenance: bool = False, seed: int = 0, state: File = None,
            lines: bool = False) -> None:
    """Monitor a stream of samples: print one line per alarm, isolated fault and end of a fault.

    Unreadable rows are reported on the error stream and count as missing samples. A file that is rotated, truncated
    or replaced is followed. With --json every line has the fields kind, sample, line, time, candidates, onset,
    onset_time, size, statistic and note.

    Example: optid monitor model.json --arl0 10000 < stream.csv

    The record:
        follow (-f FILE): Read this file and follow it as it grows. [dim]standard input[/]
        until_end: Stop at the end of the followed file.
        fill_gaps (N): Insert at most N missing samples where the time stamps have a gap.
        strict: Stop at the first unreadable row.
    The model:
        kinds (-k NAME...): Kinds of faults: bias, loss, stuck, drift, spike. [dim]bias, loss, spike[/]
        zero (INPUT=VALUE...): Input at which an actuator has no effect; a loss is a share of the distance from it.
            [dim]unknown[/]
        arl0 (N): Mean number of samples between false alarms (ARL0). [dim]10000, or that of --thresholds[/]
        window (-w N): Length of the window in samples.
        identified (FILE...): The record from which the model was identified; accounts for its uncertainty.
        healthy (FILE...): A later healthy record, from which noise and thresholds are calibrated.
        thresholds (FILE): Read the thresholds from this file (.json), or write them if it does not exist.
        extrapolate: Allow thresholds extrapolated beyond the simulated run lengths.
        drift (HOURS): Follow disturbances that change over this many hours, such as seasons; slower faults stay hidden.
        adapt (FACTOR): Multiply the thresholds by at most this factor where the noise has another colour.
        seed: Seed of the simulated thresholds.
    The operator (the state of a stopped monitor):
        ack: Acknowledge the alarm: discard it and go on.
        rebase: Take a new baseline after a repair: discard the alarm and all carried faults.
        maintenance: Count the rows of a maintenance period, without a search for faults.
    The result:
        state (FILE): Resume from this state (.npz) if it exists, and save the state to it.
        lines (--json): Print one JSON object per line.
    """
    from optid.cli import arguments as words
    from optid.cli.state_file import StateFile
    from optid.data.reading.format import Format
    from optid.data.reading.rows import RowReader
    from optid.errors import DataError
    from optid.faults.diagnosis.diagnosing import KINDS

    if (ack or rebase or maintenance) and (state is None or not state.is_file()):
        raise DataError("--ack, --rebase and --maintenance go on from the state of a stopped monitor: name it with "
                        "--state FILE")
    check_folders(thresholds)
    check_folders(state, writable=False)
    with nullcontext() if state is None else StateFile(state) as kept:
        with capture_warnings() as heard, Spinner() as waiting:
            waiting.step("reading")
            plant = words.state_space_model(model)
            how = words.options_of_model(how, plant)
            reading = words.reading(how)
            channels = {key: reading.pop(key) for key in ("inputs", "outputs", "dt", "time")}
            if reading.pop("experiment") is not None:
                raise DataError("a stream of rows is one experiment; leave --experiment out")
            reader = RowReader(**channels, how=Format(**reading), fill=fill_gaps or 0,
                               label="standard input" if follow is None else follow.name)
            if kept is not None and not kept.is_empty:
                watcher = _resumed(kept.path, plant, model)
                if rebase:
                    watcher.rebase()
                elif ack:
                    watcher.acknowledge()
            else:
                waiting.step("simulating healthy plants for the thresholds")
                origin, sound = (words.read_record(files, how) if files else None for files in (identified, healthy))
                if origin is None and sound is None and (thresholds is None or not thresholds.exists()):
                    origin = sound = _identified_from(model)
                found = words.candidates(plant, KINDS, kinds, load, disturbance, state_jump, zero)
                watcher = _new(found, thresholds, arl0=arl0, window=window, seed=seed, healthy=sound,
                               uncertainty=origin, extrapolate=extrapolate, adapt=adapt,
                               drift=None if drift is None else drift * HOUR / plant.dt)
                if sound is None and origin is not None:
                    _doubt(plant, origin)
                elif sound is None and thresholds is None:
                    note("the thresholds assume an exact model and white innovations: give the record from which it "
                         "was identified (--identified FILE...) and a later healthy record (--healthy FILE...)")
        for sentence in heard:
            note(sentence)
        watcher.source = watcher.source or {"model": plant.to_dict()}
        _Watch(watcher, reader, follow, kept, as_json=lines, skips=maintenance).run(until_end, strict)


def _identified_from(path: Path) -> Any:
    """Read the record that a model file names; None if it names none or the files do not exist."""
    from optid.cli.arguments import read_record
    from optid.errors import ModelFileError
    from optid.models.files import record_of

    named = record_of(path)
    if named is None:
        return None
    files = named.pop("files")
    if named.keys() != set(READING):
        raise ModelFileError(f"{path} does not hold the reading options of this release: fit the model again")
    if gone := [name for name in files if not Path(name).is_file()]:
        note(f"{gone[0]}, from which the model was identified, does not exist any more")
        return None
    note("noise and model uncertainty are taken from the record of the identification, "
         f"{', '.join(Path(name).name for name in files)}: give a later healthy record with --healthy FILE...")
    return read_record(files, named)


def _doubt(plant: Any, origin: Any) -> None:
    """Warn if the innovations on the record of the identification are not white or not of the predicted size."""
    from optid.faults import health, whiten

    judged = health(whiten(plant, origin))
    if not (judged.white and judged.scaled):
        note(f"whiteness of the innovations of the record of the identification: {p_equals(judged.p_value)}, size "
             f"{judged.ratio:.2f} times the predicted one: thresholds for white noise are too low. Calibrate them on a "
             "later healthy record: --healthy FILE...")


def _new(found: Any, path: Path | None, arl0: float | None, **how: Any) -> Any:
    from optid.errors import ModelFileError, StructureError
    from optid.faults import Calibration, Monitor
    from optid.models.files import complete

    if path is not None and path.exists():
        try:
            known = Calibration.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ModelFileError(f"{path} does not hold thresholds ({error}): give another file") from None
        if arl0 is not None and arl0 != known.arl0:
            raise StructureError(f"{path} holds thresholds for a false alarm every {known.arl0:g} samples, --arl0 asks "
                                 f"for {arl0:g}: leave --arl0 out, or name another file")
        return Monitor(found.model, found, thresholds=known, **how)
    made = Monitor(found.model, found, ARL0 if arl0 is None else arl0, **how)
    if path is not None:
        with complete(path) as part:
            part.write_text(json.dumps(made.calibration.to_dict(), indent=1), encoding="utf-8")
    return made


def _resumed(state: Path, plant: Any, path: Path) -> Any:
    from optid.errors import StructureError
    from optid.faults import Monitor

    found = Monitor.load(state)
    if found.source is not None and found.source["model"] != json.loads(json.dumps(plant.to_dict())):
        raise StructureError(f"{state} is the state of another model than {path}: remove it, or name another file")
    return found


class _Signals:
    """SIGTERM and SIGINT as a request to stop, which interrupts waiting, but no processing.

    A second signal interrupts anything: what was not saved then is processed again when the stream is resumed.
    """

    def __init__(self) -> None:
        self._waiting = self._arrived = False

    def __enter__(self) -> Self:
        wanted = [number for number in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(number) != signal.SIG_IGN]
        self._former = {number: signal.signal(number, self._arrive) for number in wanted}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def _arrive(self, *_: object) -> None:
        if self._waiting or self._arrived:
            raise KeyboardInterrupt
        self._arrived = True

    def ignore(self) -> None:
        """Let the processing come to its end."""
        for number in self._former:
            signal.signal(number, signal.SIG_IGN)

    def until_stopped(self, parts: Iterator[Part]) -> Iterator[Part]:
        """Yield the parts until a signal arrives: `KeyboardInterrupt`."""
        while True:
            self._waiting = True
            if self._arrived:
                raise KeyboardInterrupt
            part = next(parts, None)
            self._waiting = False
            if part is None:
                return
            yield part


class _Watch:
    """Reads the stream, runs the monitor and prints its events.

    Position of the stream, state of the monitor and counts belong together: they change while a block is processed and
    are saved between blocks only. The saved state is replaced right after its last events have been printed: a process
    that is killed just between the two prints these once more.

    With `as_json` events are lines of JSON; with `skips` rows pass by, as under maintenance.
    """

    def __init__(self, watcher: Any, reader: Any, follow: Path | None, state: "StateFile | None", *,
                 as_json: bool = False, skips: bool = False) -> None:
        from optid.cli.following import Followed
        from optid.errors import DataError

        self.watcher, self.reader, self.state, source = watcher, reader, state, watcher.source or {}
        self.as_json, self.skips, self.strict = as_json, skips, False
        self.plant = source.get("model")
        self.bad, self.saved, self.place = source.get("bad", 0), watcher.samples, source.get("place")
        self.stamps = {int(sample): stamp for sample, stamp in source.get("stamps", [])}
        self.lines: list[str] = []  # of events that are not printed yet
        self._is_whole, self._is_printing, self.failed = True, False, 0.0
        if self.place is not None and follow is not None:
            if self.place["path"] != str(follow.resolve()):
                raise DataError(f"{state and state.path} is the state of {self.place['path']}, not of {follow}: name "
                                "another file")
            reader.resume(source)
        self.file = None if follow is None else Followed(follow, self.place)

    def run(self, until_end: bool, strict: bool = False) -> None:
        """Read to the end of the stream, or of the file where asked; a bad row ends it where that is strict."""
        from optid.cli.following import standard_input

        self.strict = strict
        # with a state the last line may still be completed, so that it is read by the next run
        parts = standard_input() if self.file is None else self.file.lines(until_end, partial=self.state is None)
        with _Signals() as signals:
            try:
                if self.state is not None:  # a state that cannot be written is noticed at once
                    self._keep()
                for raw, fresh in signals.until_stopped(parts):
                    self._process_block(raw, fresh)
            except KeyboardInterrupt:
                pass
            except BrokenPipeError:  # the reader of the events has ended
                self._is_whole = False
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            finally:
                signals.ignore()
                if self._is_whole:
                    self._keep()
                if self.failed and self.state is not None:
                    _note(f"the last state that could be saved is that of sample {self.saved}")
        if not self.watcher.samples:
            _note("no sample was read: no rows follow the header")
        if self.bad:
            _note(f"{self.bad} of {self.watcher.samples} rows were unreadable in part or in full")

    def _process_block(self, raw: list[bytes], fresh: str) -> None:
        from optid.errors import DataError

        self._is_whole = False
        if fresh:
            _note(fresh)
            self.reader.begin_file()
        first, line = self.watcher.samples, self.reader.line
        rows = self.reader.read([part.removesuffix(b"\r").decode("utf-8", "replace") for part in raw])
        if self.strict and rows.bad:
            raise DataError(rows.bad[0][1])
        for text in [text for _, text in rows.bad[:LOUD]] + list(rows.remarks[:LOUD]):
            _note(text)
        self.bad += len({number for number, _ in rows.bad})
        self._remember(first, rows.stamps)
        if self.skips:
            self.watcher.skip(len(rows.u))
        events = [] if self.skips else self.watcher.run(rows.u, rows.y)
        for event in events:
            self._tell(event, int(rows.lines[event.sample - first]))
        if self.file is not None:  # a line that ends the stream is the first to be read when it is resumed
            done = raw[: rows.stop - line - 1] if rows.error else raw
            self.file.advance(sum(map(len, done)) + len(done), done)
            self.place = dict(self.file.place)
        self._is_whole = True
        due = bool(self.failed) or self.watcher.samples - self.saved >= KEPT
        if events or (due and clock.monotonic() - self.failed >= RETRY):
            self._keep()
        if rows.error:
            raise DataError(rows.error)

    def _remember(self, first: int, stamps: list[str]) -> None:
        """Keep the time stamps of the last samples: an event names the onset, which lies before it."""
        self.stamps |= {first + k: _clean(stamp) for k, stamp in enumerate(stamps) if stamp}
        if len(self.stamps) > 2 * REMEMBERED + len(stamps):
            self.stamps = dict([*self.stamps.items()][-REMEMBERED - len(stamps):])

    def _keep(self) -> None:
        """Print the events of the last block and replace the saved state; where that fails, it is tried again later."""
        try:
            if self.state is None:
                self._print()
            else:
                self.watcher.source = {"model": self.plant, "place": self.place, "bad": self.bad,
                                       "stamps": [*self.stamps.items()][-REMEMBERED:], **self.reader.memory}
                self.state.replace(self.watcher.save, self._print)
        except BrokenPipeError:
            raise
        except OSError as error:
            if not self.failed:
                what = "the events" if self.state is None or self._is_printing else f"the state {self.state.path}"
                _note(f"{what} cannot be written ({error.strerror or error}): monitoring goes on, and writing is tried "
                      "again")
            self.failed = clock.monotonic()
            with suppress(OSError):  # events need no state
                self._print()
            return
        if self.failed:
            _note(f"writing works again from sample {self.watcher.samples} on")
        self.failed, self.saved = 0.0, self.watcher.samples

    def _print(self) -> None:
        text, self.lines, self._is_printing = "".join(self.lines), [], True
        sys.stdout.write(text)
        sys.stdout.flush()
        self._is_printing = False

    def _tell(self, event: Any, line: int) -> None:
        stamp, onset = self.stamps.get(event.sample), self.stamps.get(event.onset)
        if self.as_json:
            text = json.dumps({**event.to_dict(), "line": line, "time": stamp, "onset_time": onset})
        else:
            text = f"sample {event.in_words(*(_clean(time, 't = ') if time else '' for time in (stamp, onset)))}"
        self.lines.append(text + "\n")


def _note(text: str) -> None:
    """Print a warning; an error stream that cannot be written ends no monitor."""
    with suppress(OSError):
        note(text)


def _clean(stamp: str, word: str = "") -> str:
    """Return a time stamp without the rounding errors of accumulated sampling times, a number after a word."""
    try:
        return f"{word}{float(stamp):.12g}"
    except ValueError:
        return stamp
