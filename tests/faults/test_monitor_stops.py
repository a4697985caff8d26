"""A monitor that is stopped at any moment goes on as if it had never been stopped."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from test_monitor import everything, plant, stream, watch

from optid.cli import following, monitoring
from optid.cli.state_file import StateFile
from optid.data.reading.rows import RowReader
from optid.errors import DataError
from optid.faults import Monitor

QUICK = ["--arl0", "300", "--window", "30", "--kinds", "bias", "loss", "--thresholds", "thresholds.json", "--json"]


def write_stream(folder, repeats):
    """Write a model and its thresholds; return header and rows of a stream with faults, bad cells and blank lines."""
    plant().save(folder / "model.json")
    rows = []
    for k in range(repeats):
        u, y = stream(plant(), 500, 1 + k % 7)
        for row in np.hstack([u, y]):
            rows.append(f"{len(rows)};" + ";".join("" if np.isnan(v) else repr(float(v)) for v in row) + "\n")
    for at in range(60, len(rows), 977):
        rows[at] = f"{at};0.5;0.5;oops;1.0\n"
    for at in range(70, len(rows), 991):
        rows[at] = "\n"
    return "t;u1;u2;y1;y2\n", rows


def start(folder, state, *words, out):
    return subprocess.Popen(
        [sys.executable, "-m", "optid", "monitor", "model.json", *QUICK, "--follow", "grown.csv", "--state", state,
         *words], cwd=folder, stdout=out, stderr=subprocess.PIPE, text=True)


def finish(folder, state):
    """Read the stream to its end; return the counts that are kept and those that are reported."""
    with (folder / f"{state}.jsonl").open("a") as out:
        process = start(folder, state, "--until-end", out=out)
        errors = process.communicate(timeout=600)[1]
    assert process.returncode == 0, errors
    with np.load(folder / state) as kept:
        head = json.loads(str(kept["head"]))
    counts = [line for line in " ".join(errors.split()).split("note: ") if "rows were unreadable" in line]
    return head["samples"], head["source"]["line"], head["source"]["place"]["offset"], counts


def stop_often(folder, stops, seed=0, repeats=40):
    """Stop a monitor of a growing file at random moments; return results without and with stops, and the signals."""
    rng = np.random.default_rng(seed)
    head, rows = write_stream(folder, repeats)
    grown = folder / "grown.csv"
    grown.write_text(head + "".join(rows))
    begun = time.monotonic()
    whole = finish(folder, "whole.npz")
    usual = time.monotonic() - begun
    grown.write_text(head)
    signals, written = [], 0
    for number in range(stops):
        upto = len(rows) * (number + 1) // stops  # a part of the stream is there already, the rest follows
        early = written + int(rng.integers(upto - written + 1))
        with grown.open("a") as file:
            file.write("".join(rows[written:early]))
        with (folder / "stopped.npz.jsonl").open("a") as out:
            process = start(folder, "stopped.npz", out=out)
            time.sleep(rng.uniform(0, usual))
            with grown.open("a") as file:
                text = "".join(rows[early:upto])
                cut = int(rng.integers(len(text) + 1))  # not always at the end of a line
                file.write(text[:cut])
                file.flush()
                time.sleep(rng.uniform(0, 0.3))
                signals.append((signal.SIGTERM, signal.SIGINT, signal.SIGKILL)[int(rng.integers(3))])
                process.send_signal(signals[-1])
                file.write(text[cut:])
            errors = process.communicate(timeout=600)[1]
        assert process.returncode in (0, -signals[-1], 130), errors
        written = upto
    stopped = finish(folder, "stopped.npz")
    return whole, stopped, signals


def events(folder, state):
    return (folder / f"{state}.jsonl").read_text().splitlines()


def follow(folder, name, capsys, errors=False):
    """Follow the stream from the state of this name; return the printed lines, or the warnings, and the monitor."""
    with StateFile(folder / name) as kept:
        if kept.is_empty:
            found = everything(plant())
            monitor = watch(found.model, found, 40, 35.0)
        else:
            monitor = Monitor.load(kept.path)
        reader = RowReader(["u1", "u2"], ["y1", "y2"], dt=1.0)
        monitoring._Watch(monitor, reader, folder / "grown.csv", kept, as_json=True).run(True)
    told = capsys.readouterr()
    return " ".join(told.err.split()) if errors else told.out.splitlines(), monitor


@pytest.fixture
def heeded():
    """Interrupts have their usual handler: a process that a shell starts in the background ignores them."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.usefixtures("heeded")
@pytest.mark.parametrize("number, owner, name", [
    (signal.SIGTERM, RowReader, "read"), (signal.SIGTERM, Monitor, "run"), (signal.SIGINT, Monitor, "run"),
    (signal.SIGINT, Monitor, "save"), (signal.SIGTERM, following.Followed, "advance"),
    (signal.SIGTERM, monitoring._Watch, "_tell"), (signal.SIGTERM, os, "replace")])
def test_a_signal_at_any_step_waits_until_the_block_is_processed(tmp_path, monkeypatch, capsys, number, owner, name):
    head, rows = write_stream(tmp_path, 2)
    (tmp_path / "grown.csv").write_text(head + "".join(rows))
    monkeypatch.setattr(following, "BLOCK", 8000)  # about 100 rows
    whole, undisturbed = follow(tmp_path, "whole.npz", capsys)
    told, original, calls, former, runs = [], getattr(owner, name), [], signal.getsignal(number), 0

    def stopped(*arguments):
        if signal.getsignal(number) is former:  # before the stream is read
            return original(*arguments)
        calls.append(runs)
        due = calls.count(runs) == 1 + runs % 4
        if due and runs % 2:
            signal.raise_signal(number)
        result = original(*arguments)
        if due and not runs % 2:
            signal.raise_signal(number)
        return result

    monkeypatch.setattr(owner, name, stopped)
    for runs in range(40):  # noqa: B007
        lines, monitor = follow(tmp_path, "stopped.npz", capsys)
        told += lines
        if monitor.samples == undisturbed.samples:
            break
    assert len(calls) > 3 and told == whole and len(whole) > 6
    assert monitor.samples == undisturbed.samples and monitor.source["bad"] == undisturbed.source["bad"] > 0
    assert np.array_equal(monitor.state, undisturbed.state) and monitor.statistics == undisturbed.statistics


def test_a_block_that_was_not_finished_is_processed_again(tmp_path, monkeypatch, capsys):
    """As after a second signal, or an error in the middle of a block."""
    head, rows = write_stream(tmp_path, 2)
    (tmp_path / "grown.csv").write_text(head + "".join(rows))
    monkeypatch.setattr(following, "BLOCK", 4000)
    whole, _ = follow(tmp_path, "whole.npz", capsys)
    original, told, calls = Monitor.run, [], []

    def broken(self, u, y):
        calls.append(len(u))
        events = original(self, u, y)
        if len(calls) % 9 == 0:
            raise KeyboardInterrupt
        return events

    monkeypatch.setattr(Monitor, "run", broken)
    for _ in range(30):
        told += follow(tmp_path, "stopped.npz", capsys)[0]
    assert told == whole and sum(calls) > 1000


def test_a_state_is_held_by_one_monitor(tmp_path):
    path = tmp_path / "state.npz"
    with StateFile(path) as first:
        for _ in range(2):
            with pytest.raises(DataError, match=r"state.npz is the state of another monitor, which is running"):
                StateFile(path)
            first.replace(lambda part: part.write_text("state"), lambda: None)
    assert path.read_text() == "state"
    with StateFile(tmp_path / "new.npz"):
        pass
    with StateFile(path) as again:
        with pytest.raises(OSError, match="full"):
            again.replace(lambda part: part.write_text("half"), _full)
        assert path.read_text() == "state"
    assert [one.name for one in tmp_path.iterdir()] == ["state.npz"]


def _full():
    raise OSError("the disk is full")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_stops_at_random_moments_change_neither_events_nor_counts(tmp_path):
    whole, stopped, _ = stop_often(tmp_path, 15)
    assert stopped == whole
    assert events(tmp_path, "stopped.npz") == events(tmp_path, "whole.npz")
    assert not list(tmp_path.glob("*.part"))


class Disk:
    """Fails while it is full."""

    def __init__(self, original):
        self.original, self.full = original, False

    def __call__(self, *arguments):
        if self.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.original(*arguments)


@pytest.mark.parametrize("what", ["state", "output", "both"])
def test_a_full_disk_ends_no_monitor(tmp_path, monkeypatch, capsys, what):
    head, rows = write_stream(tmp_path, 2)
    (tmp_path / "grown.csv").write_text(head + "".join(rows))
    monkeypatch.setattr(following, "BLOCK", 4000)
    whole, undisturbed = follow(tmp_path, "whole.npz", capsys)
    files, output, blocks = Disk(Path.write_bytes), Disk(sys.stdout.flush), []
    monkeypatch.setattr(Path, "write_bytes", lambda *a: files(*a))
    monkeypatch.setattr(sys.stdout, "flush", output)
    monkeypatch.setattr(monitoring, "RETRY", 0.0)
    original = Monitor.run

    def run(*arguments):
        blocks.append(0)
        files.full = what != "output" and 2 <= len(blocks) <= 8
        output.full = what != "state" and 2 <= len(blocks) <= 8
        return original(*arguments)

    monkeypatch.setattr(Monitor, "run", run)
    with StateFile(tmp_path / "full.npz") as kept:
        monitor = watch(undisturbed.dictionary.model, undisturbed.dictionary, 40, 35.0)
        reader = RowReader(["u1", "u2"], ["y1", "y2"], dt=1.0)
        monitoring._Watch(monitor, reader, tmp_path / "grown.csv", kept, as_json=True).run(True)
    told = capsys.readouterr()
    assert told.out.splitlines() == whole and Monitor.load(kept.path).samples == undisturbed.samples
    errors = " ".join(told.err.split())
    assert errors.count("cannot be written (No space left on device): monitoring goes on") == 1
    assert errors.count("writing works again") == 1
    assert ("the events cannot" if what == "output" else "full.npz cannot") in errors
    assert not list(tmp_path.glob("*.part*"))


def test_a_state_that_is_never_written_is_reported_at_the_beginning_and_at_the_end(tmp_path, monkeypatch, capsys):
    head, rows = write_stream(tmp_path, 1)
    (tmp_path / "grown.csv").write_text(head + "".join(rows))
    files = Disk(None)
    files.full = True
    monkeypatch.setattr(Path, "write_bytes", lambda *a: files(*a))
    lines, monitor = follow(tmp_path, "never.npz", capsys, errors=True)
    assert lines.index("No space left") < lines.index("is blank")
    assert "the last state that could be saved is that of sample 0" in lines and monitor.samples == 500
    assert not (tmp_path / "never.npz").exists() and not list(tmp_path.glob("*.part*"))
