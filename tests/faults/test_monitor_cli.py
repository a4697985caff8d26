"""`optid monitor` from end to end, and the rows of a table that is still being written."""

import json
import os
import re
import signal
import subprocess
import sys

import numpy as np
import psutil
import pytest
from processes import wait_for
from test_monitor import plant, stream

from optid import Format
from optid.data.reading.rows import RowReader

NAMES = ["u1", "u2", "y1", "y2"]
QUICK = ["--arl0", "300", "--window", "30", "--kinds", "bias", "loss"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("monitor")
    plant().save(where / "model.json")
    u, y = stream(plant(), 500)
    rows = ["t,u1,u2,y1,y2"]
    for k, row in enumerate(np.hstack([u, y])):
        rows.append(f"{k}," + ",".join("" if np.isnan(v) else repr(float(v)) for v in row))
    (where / "stream.csv").write_text("\n".join(rows) + "\n")
    run(where, "--thresholds", "thresholds.json", text="t,u1,u2,y1,y2\n")
    return where


def run(folder, *words, text=None, code=0):
    done = subprocess.run(
        [sys.executable, "-m", "optid", "monitor", "model.json", *QUICK, *words], cwd=folder, capture_output=True,
        input=(folder / "stream.csv").read_text() if text is None else text, text=True,
    )
    assert done.returncode == code, done.stderr
    return done.stdout, " ".join(done.stderr.split())


def known(folder, *words, **how):
    return run(folder, "--thresholds", "thresholds.json", *words, **how)


def test_one_line_per_event(folder):
    out, errors = known(folder)
    lines = out.splitlines()
    assert errors == ""
    assert lines[0].startswith("sample 15") and "(t = 15" in lines[0] and ": alarm: " in lines[0]
    assert any("isolated: sensor:y1" in line for line in lines)
    assert any("isolated: actuator:u2 loss" in line for line in lines)
    objects = [json.loads(line) for line in known(folder, "--json")[0].splitlines()]
    assert len(objects) == len(lines)
    assert [o["line"] for o in objects] == [o["sample"] + 2 for o in objects]
    assert all(o["onset_time"] == str(o["onset"]) for o in objects if o["onset"] is not None)
    assert objects[0]["kind"] == "alarm" and objects[0]["time"] == str(objects[0]["sample"])


def test_dates_stand_beside_samples_and_survive_a_restart(folder, tmp_path):
    head, *rows = (folder / "stream.csv").read_text().splitlines()
    dates = np.datetime_as_string(np.datetime64("2024-05-01T06:00:00") + np.arange(len(rows)), "s")
    dated = [f"{date}," + row.partition(",")[2] for date, row in zip(dates, rows)]
    out, _ = known(folder, text="\n".join([head, *dated]) + "\n")
    for line in out.splitlines():
        sample, when = re.match(r"sample (\d+) \((.*?)\): ", line).groups()
        assert when == dates[int(sample)]
        for onset, since in re.findall(r"since (\d+) \((.*?)\)", line):
            assert since == dates[int(onset)]
    assert "since" in out
    grown, state = tmp_path / "grown.csv", tmp_path / "state.npz"
    said = ""
    grown.write_text(head + "\n")
    for first, last in ((0, 152), (152, len(dated))):
        with grown.open("a") as file:
            file.write("".join(f"{row}\n" for row in dated[first:last]))
        said += known(folder, "--follow", str(grown), "--until-end", "--state", str(state))[0]
    assert said == out


def test_a_state_is_resumed_as_if_nothing_had_happened(folder, tmp_path):
    whole = known(folder)[0]
    rows = (folder / "stream.csv").read_text().splitlines(keepends=True)
    state = str(tmp_path / "state.npz")
    parts = [known(folder, "--state", state, text="".join([rows[0], *part]))[0]
             for part in (rows[1:150], rows[150:158], rows[158:])]
    assert "".join(parts) == whole
    with open(tmp_path / "grown.csv", "w") as file:
        file.writelines(rows[:200])
    followed = ["--follow", str(tmp_path / "grown.csv"), "--until-end", "--state", str(tmp_path / "followed.npz")]
    first = known(folder, *followed)[0]
    with open(tmp_path / "grown.csv", "a") as file:
        file.writelines(rows[200:])
    assert first + known(folder, *followed)[0] == whole
    assert known(folder, *followed)[0] == ""
    (tmp_path / "grown.csv").write_text("".join(rows[:5]))
    assert "it is read from its beginning" in known(folder, *followed)[1]


def test_a_state_of_another_model_or_file_is_refused(folder, tmp_path):
    state = str(tmp_path / "state.npz")
    known(folder, "--state", state, "--follow", "stream.csv", "--until-end")
    (tmp_path / "copy.csv").write_text((folder / "stream.csv").read_text())
    text = known(folder, "--state", state, "--follow", str(tmp_path / "copy.csv"), "--until-end", code=2)[1]
    assert "is the state of" in text and "copy.csv" in text
    plant(True).save(folder / "other.json")
    done = subprocess.run([sys.executable, "-m", "optid", "monitor", "other.json", "--state", state], cwd=folder,
                          capture_output=True, text=True, input="")
    assert done.returncode == 2 and "another model" in done.stderr
    (tmp_path / "state.npz").write_bytes(b"not a state")
    assert "not the complete state of a monitor" in known(folder, "--state", state, code=2)[1]


def test_rows_that_cannot_be_read_are_named_and_the_stream_goes_on(folder):
    rows = (folder / "stream.csv").read_text().splitlines()
    rows[20], rows[30], rows[40], rows[60] = "19,0.5,0.5,oops,1.0", "29,0.5,0.5", "39,0.5,0.5,inf,1.0", ""
    text = "\r\n".join(rows) + "\r\n\r\n"
    out, errors = known(folder, text=text)
    for words in ("line 21, column 'y1' holds 'oops', not a number", "line 31 has 3 cells, the header has 5",
                  "line 41, column 'y1' holds 'inf'", "line 61 is blank", "4 of 500 rows were unreadable"):
        assert words in errors
    assert "isolated: sensor:y1" in out
    out, errors = known(folder, "--strict", text=text, code=2)
    assert "line 21, column 'y1' holds 'oops'" in errors and out == ""


def test_time_stamps_that_are_not_those_of_the_model_end_the_stream(folder):
    rows = (folder / "stream.csv").read_text().splitlines()
    del rows[200:203]
    out, errors = known(folder, text="\n".join(rows), code=2)
    assert "line 201: the time stamp 202 comes 4 after the one before, the sampling time of the model is 1" in errors
    assert "--fill-gaps" in errors and "isolated: sensor:y1" in out  # what came before has been judged
    out, errors = known(folder, "--fill-gaps", "10", text="\n".join(rows))
    assert "isolated: actuator:u2 loss" in out and errors == ""
    jittered = [rows[0], *(f"{0.5 * k}," + row.partition(",")[2] for k, row in enumerate(rows[1:]))]
    assert "comes 0.5 after the one before" in known(folder, text="\n".join(jittered), code=2)[1]
    assert known(folder, "--time", "none", text="\n".join(jittered))[0] != ""


@pytest.mark.parametrize("words, text, named", [
    ([], "u1,u2,y1\n1,2,3\n", "has no column 'y2'"), ([], "1,2,3,4\n", "no header row"),
    ([], "u1,u1,u2,y1,y2\n", "two columns named 'u1'"), (["--follow", "nowhere.csv"], None, "No such file"),
    (["--columns", *NAMES], "1,0.5,3,4\n", ""),
    (["--delimiter", ";", "--decimal", ","], "u1;u2;y1;y2\n0,5;1,0;2;3\n", "")])
def test_what_is_wrong_with_the_table_is_said_by_name(folder, words, text, named):
    out, errors = known(folder, *words, text=text, code=2 if named else 0)
    assert out == "" and (named in errors if named else errors == "")


def test_thresholds_of_something_else_and_impossible_requests_are_refused(folder):
    (folder / "broken.json").write_text("{}")
    for words, named in ((["--thresholds", "broken.json"], "does not hold thresholds"),
                         (["--thresholds", "thresholds.json", "--window", "40"], "in a window of 30"),
                         (["--thresholds", "thresholds.json", "--arl0", "123456"], "--arl0 asks for 123456"),
                         (["--arl0", "1e9"], "cannot support a false alarm every 1e+09"),
                         (["--kinds", "biass"], "no fault of kind 'biass'")):
        assert named in run(folder, *words, code=2)[1]
    assert "no sample was read" in known(folder, text="t,u1,u2,y1,y2\n")[1]


def test_a_file_is_followed_until_the_monitor_is_stopped(folder, tmp_path):
    rows = (folder / "stream.csv").read_text().splitlines(keepends=True)
    grown, state = tmp_path / "grown.csv", tmp_path / "state.npz"
    size = grown.write_text("".join(rows[:100]) + rows[100][:7])  # a line that is not complete
    process = subprocess.Popen(
        [sys.executable, "-m", "optid", "monitor", "model.json", *QUICK, "--thresholds", "thresholds.json", "--follow",
         str(grown), "--state", str(state)], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )
    try:
        wait_for(lambda: (str(grown), size) in places(process.pid), 600)  # the half line has been read
        with grown.open("a") as file:
            file.write(rows[100][7:] + "".join(rows[101:]))
        lines = [process.stdout.readline() for _ in range(2)]
        assert ": alarm: " in lines[0] and lines[1]
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=600)
        assert errors == "" and process.returncode == 0
    finally:
        process.kill()
    assert state.exists()


def places(pid):
    """Files that a process reads, and how far it has come."""
    return [(one.path, one.position) for one in psutil.Process(pid).open_files()]


@pytest.mark.skipif(os.name != "posix", reason="pipes")
def test_whoever_reads_the_events_may_leave(folder):
    command = f"{sys.executable} -m optid monitor model.json {' '.join(QUICK)} --thresholds thresholds.json " \
              "< stream.csv | head -n 1"
    done = subprocess.run(command, shell=True, cwd=folder, capture_output=True, text=True)
    assert done.stdout.count("\n") == 1 and "Traceback" not in done.stderr and "Broken" not in done.stderr


def reader(**how):
    return RowReader(["u"], ["y"], dt=0.5, **how)


def test_rows_come_in_any_pieces():
    text = ["t,u,y", "0,1,2", "0.5,,3", "1.0,NA,4", "1.5,5,6"]
    whole = reader().read(text)
    one_by_one = reader()
    parts = [one_by_one.read([line]) for line in text]
    assert np.array_equal(np.vstack([p.u for p in parts]), whole.u, equal_nan=True)
    assert np.concatenate([p.lines for p in parts]).tolist() == whole.lines.tolist() == [2, 3, 4, 5]
    assert whole.u.ravel().tolist()[0] == 1 and np.isnan(whole.u[1:3]).all() and whole.bad == []
    assert reader(time=False).read(["t,u,y", "9,1,2", "1,1,2"]).error == ""


def test_dates_quotes_and_gaps():
    dates = ["time,u,y", "2024-05-01T12:00:00,1,2", '"2024-05-01T12:00:00.5","1","2"', "2024-05-01T12:00:02,3,4"]
    stopped = reader().read(dates)
    assert len(stopped.y) == 2 and stopped.stop == 4 and "comes 1.5 after" in stopped.error
    filled = reader(fill=5).read(dates)
    assert filled.lines.tolist() == [2, 3, 0, 0, 4] and np.isnan(filled.y[2:4]).all() and filled.y[4, 0] == 4
    assert len(reader(fill=1).read(dates).y) == 4  # no gap is filled with more
    for text in ([*dates[:2], "3.5,1,2"], ["t,u,y", "0,1,2", "soon,1,2"]):
        found = reader().read(text)
        assert found.error == "" and found.y.ravel().tolist() == [2, 2]  # the row counts, its time is not known
        assert [line for line, _ in found.bad] == [3] and "is not a time stamp like those before" in found.bad[0][1]


@pytest.mark.parametrize("back", [1.5, 3600.0])
def test_a_clock_that_is_set_back_is_reported_and_its_rows_count(back):
    times = np.arange(0, 20, 0.5)
    times[7:] -= back
    times[23:] -= back
    lines = ["t,u,y", *(f"{t},{k},2" for k, t in enumerate(times))]
    found = reader().read(lines)
    assert found.error == "" and found.u.ravel().tolist() == list(range(40)) and found.bad == []
    assert len(found.remarks) == 2 and f"line 9: the time stamp {times[7]}" in found.remarks[0]
    assert "was set back" in found.remarks[0] and found.lines.tolist() == list(range(2, 42))
    times[30:] += 2.0  # a gap is none of this
    lines = ["t,u,y", *(f"{t},{k},2" for k, t in enumerate(times))]
    assert "--fill-gaps" in reader().read(lines).error and len(reader().read(lines).y) == 30
    filled = reader(fill=4).read(lines)
    assert len(filled.y) == 44 and np.isnan(filled.y[30:34]).all() and len(filled.remarks) == 2
    assert "comes 0 after" in reader().read(["t,u,y", "0,1,2", "0,1,2"]).error


def test_many_gaps_and_clocks_in_one_block_are_one_loop():
    times = np.cumsum(np.where(np.arange(3000) % 2, 1.0, 0.5))
    assert len(reader(fill=1).read(["t,u,y", *(f"{t},1,2" for t in times)]).y) == 4500
    odd = [f"{t},1,2" for t in np.tile([1.0, 0.5], 1500)]
    assert len(reader().read(["t,u,y", *odd[:2]]).remarks) == 1


def test_reading_goes_on_where_it_stopped():
    first = reader()
    first.read(["t,u,y", "0,1,2", "bad"])
    again = reader()
    again.resume(json.loads(json.dumps(first.memory)))
    found = again.read(["1.0,1,2"])  # one row, of which no stamp is known, lies between
    assert found.error == "" and found.lines.tolist() == [4]


@pytest.mark.parametrize("text", [
    "t;u;y\ns;V;mV\n10,0;1;2\n10,5;1,5;2\n11,0;1;2,5\n\n12,0;1;2\n",
    "date\tu\ty\n03.04.2024 12:00:00.0\t1\t2\n03.04.2024 12:00:00.5\t1\t2\n03.04.2024 12:00:01.0\t1\t2\n",
    "time,u,y\n23:59:59.0,1,2\n23:59:59.5,1,2\n00:00:00.0,1,2\n00:00:00.5,3,4\n"])
def test_reading_goes_on_in_the_format_that_was_found(text):
    how = {"how": Format(decimal="," if ";" in text else ".", date_format="%d.%m.%Y %H:%M:%S.%f" if "date" in text
                         else None)}
    lines = text.splitlines()
    whole = reader(**how).read(lines)
    assert whole.error == "" and len(whole.y) >= 3 and not np.isnan(whole.y[:3]).any()
    for cut in range(1, len(lines)):
        first, again = reader(**how), reader(**how)
        before = first.read(lines[:cut])
        again.resume(json.loads(json.dumps(first.memory)))
        after = again.read(lines[cut:])
        for word in ("values", "lines"):
            both = np.concatenate([getattr(before, word), getattr(after, word)])
            assert np.array_equal(both, getattr(whole, word), equal_nan=True), (cut, word)
        assert after.error == "" and before.bad + after.bad == whole.bad


def test_a_decimal_mark_that_is_the_delimiter_needs_quotes():
    comma = reader(how=Format(delimiter=",", decimal=","))
    found = comma.read(["t,u,y", '0,"0,5",2', "1,0,5,2"])
    assert found.u[0, 0] == 0.5 and np.isnan(found.u[1:]).all() and [line for line, _ in found.bad] == [3]


@pytest.mark.slow
def test_a_model_file_names_the_record_that_calibrates_its_monitor(tmp_path):
    """Two commands: noise and uncertainty come from the record of the fit, as if it had been named twice."""
    rng = np.random.default_rng(4)
    u, noise = rng.uniform(-1, 1, 1500), np.zeros(1500)
    x = y = np.zeros(1500)
    for k in range(1499):
        x[k + 1] = 0.8 * x[k] + u[k] + 0.3 * u[k] ** 2
        noise[k + 1] = 0.9 * noise[k] + 0.02 * rng.normal()
    y = x + noise
    np.savetxt(tmp_path / "healthy.csv", np.column_stack([u, y])[:1000], delimiter=",", header="u,y", comments="")
    np.savetxt(tmp_path / "later.csv", np.column_stack([u, y])[1000:], delimiter=",", header="u,y", comments="")

    def optid(*words):
        done = subprocess.run([sys.executable, "-m", "optid", *words], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout, " ".join(done.stderr.split())

    optid("fit", "healthy.csv", "--inputs", "u", "--outputs", "y", "--dt", "1", "--formulation",
          "hammerstein_ss.sid", "--basis", "polynomial:2", "--set", "nx=1", "--model", "m.json")
    words = ["monitor", "m.json", *QUICK, "--follow", "later.csv", "--until-end"]
    out, told = optid(*words)
    assert "are taken from the record of the identification, healthy.csv" in told
    assert out == optid(*words, "--identified", "healthy.csv", "--healthy", "healthy.csv")[0]
    (tmp_path / "healthy.csv").rename(tmp_path / "moved.csv")
    told = optid(*words)[1]
    assert "healthy.csv, from which the model was identified, does not exist any more" in told
    assert "assume an exact model" in told
    content = json.loads((tmp_path / "m.json").read_text())
    (tmp_path / "m.json").write_text(json.dumps({**content, "record": {"files": [3]}}))
    done = subprocess.run([sys.executable, "-m", "optid", *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and "'record' lists no files" in done.stderr
