"""Workers: whatever a cell does to its process is a row, and the others go on."""

import os
import pickle
import re
import resource
import signal
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import psutil
import pytest
import study_trouble
from processes import cell_workers, gone, wait_for
from study_trouble import behave, cell

from optid.errors import StudyError
from optid.studies.execution import workers
from optid.studies.execution.worker_process import WorkerProcess
from optid.studies.execution.workers import Pool, execute
from optid.studies.storage.rows import NAMES


def by_key(cells, **settings):
    """Rows by number of the cell; every cell has exactly one."""
    rows = list(execute(cells, behave, **settings))
    found = {int(row["key"], 16): row for row in rows}
    assert len(rows) == len(cells) == len(found) and set(found) == {int(c.key, 16) for c in cells}
    assert all(tuple(row) == NAMES for row in rows)
    return found


def test_workers_are_reused():
    rows = by_key([cell(k) for k in range(40)], workers=2)
    assert len({row["unknowns"] for row in rows.values()}) <= 2
    assert all(row["outcome"] == "done" for row in rows.values())
    assert all(gone(row["unknowns"]) for row in rows.values())


FAILURES = {
    "segfault": ("crashed", "signal SIGSEGV, at File .* in string_at"),
    "abort": ("crashed", "signal SIGABRT"),
    "orphan": ("crashed", "signal SIGABRT"),
    "leave": ("crashed", "exit code 3"),
    "complain": ("crashed", "exit code 134, terminate called after throwing an instance of 'std::bad_alloc'"),
    "raise": ("error", "KeyError: 'no such thing'"),
    "garbage": ("error", "TypeError"),
    "partial": ("error", "is no row: .*needs a value in every row"),
    "vast": ("error", "is no row: column 'iterations' holds whole numbers of 64 bits"),
    "other": ("error", "is no row: it is of another cell"),
}


def test_a_worker_that_fails_is_a_row_and_the_next_cell_runs():
    ways = [way for failure in FAILURES for way in (failure, "fine")]
    rows = by_key([cell(k, do) for k, do in enumerate(ways)], workers=1)
    for k, do in enumerate(ways):
        outcome, words = FAILURES.get(do, ("done", ""))
        assert rows[k]["outcome"] == outcome and re.search(words, rows[k]["reason"] or ""), rows[k]["reason"]
        if outcome == "error":  # nothing is wrong with the worker
            assert rows[k - 1]["unknowns"] == rows[k + 1]["unknowns"]


def test_a_worker_that_dies_between_cells_is_no_fault_of_the_next_cell():
    pool = Pool(behave, 1)
    try:
        (first,) = pool.run(deque([cell(0)]))
        os.kill(first["unknowns"], signal.SIGKILL)
        wait_for(lambda: gone(first["unknowns"]))
        (second,) = pool.run(deque([cell(1)]))
    finally:
        pool.close()
    assert second["outcome"] == "done" and second["unknowns"] != first["unknowns"]


@pytest.mark.parametrize("then, words", [("abort", "the worker died: signal SIGABRT"), ("raise", "no such thing"),
                                         ("stuck", "the limit is 5 s"), ("hog", "the limit is 500 MB")])
def test_a_row_that_was_kept_stands_whatever_comes_after_it(then, words):
    rows = by_key([cell(0, "keep_row", then=then, time_limit=5.0 if then == "stuck" else 300.0, memory_limit=500.0),
                   cell(1, "abort")], workers=1)
    assert (rows[0]["outcome"], rows[0]["objective"]) == ("done", 5.0)
    assert rows[0]["reason"].startswith("no warm solve: ") and words in rows[0]["reason"]
    assert rows[1]["outcome"] == "crashed"


def test_a_row_that_is_made_replaces_the_one_that_was_kept():
    assert by_key([cell(0, "keep_row", then="fine")])[0]["objective"] is None


@pytest.mark.parametrize("do", ["loop", "stuck"])
def test_an_endless_cell_is_stopped(do):
    clock = time.monotonic()
    rows = by_key([cell(0, do, time_limit=0.5), cell(1)], workers=1)
    assert rows[0]["outcome"] == "time limit" and "the limit is 0.5 s" in rows[0]["reason"]
    assert 0.5 < rows[0]["total_s"] < time.monotonic() - clock
    assert rows[1]["outcome"] == "done"


def test_a_memory_hog_is_stopped():
    rows = by_key([cell(0, "hog", memory_limit=500.0), cell(1)], workers=1)
    assert rows[0]["outcome"] == "memory limit" and "the limit is 500 MB" in rows[0]["reason"]
    assert rows[0]["peak_mb"] > 500.0
    assert rows[1]["outcome"] == "done"


def test_children_count_and_go_with_their_worker(tmp_path):
    pids, left = tmp_path / "pids", tmp_path / "left"
    hog = "held = bytearray(400_000_000)\nimport time\ntime.sleep(600)"
    sleeper = f"import os, time\nos.setsid()\nopen({str(left)!r}, 'w').close()\ntime.sleep(600)"
    rows = by_key([cell(0, "family", memory_limit=400.0, program=hog, pids=str(pids)),
                   cell(1, "family", time_limit=5.0, program=sleeper, pids=str(pids))], workers=1)
    assert (rows[0]["outcome"], rows[1]["outcome"]) == ("memory limit", "time limit")
    children = [int(line) for line in pids.read_text().split()]
    assert len(children) == 2 and left.exists()  # the second was out of the session of its worker
    wait_for(lambda: all(map(gone, children)))


@pytest.fixture
def with_child(tmp_path):
    """Give a worker a cell whose child runs a program, and wait until that has made a file."""
    started = []

    def start(program):
        worker = WorkerProcess(pickle.dumps((behave, None)))
        started.append(worker)
        assert worker.connection.recv()[0] == "ready"
        ready = tmp_path / "ready"
        program = f"{program}\nopen({str(ready)!r}, 'w').close()\nimport time\ntime.sleep(600)"
        assert worker.give(cell(0, "family", program=program, pids=str(tmp_path / "pids")))
        wait_for(ready.exists)
        return worker

    yield start
    for worker in started:
        worker.end()


def test_memory_that_a_process_shares_with_its_forks_counts_once(with_child):
    if not hasattr(psutil.Process().memory_full_info(), "pss"):
        pytest.skip("this system does not tell which memory processes share")
    worker = with_child("import os\nheld = bytearray(400_000_000)\nos.fork()")
    family = [psutil.Process(worker.pid), *psutil.Process(worker.pid).children(recursive=True)]
    assert len(family) == 3 and sum(member.memory_info().rss for member in family) > 800e6
    assert 400.0 < worker.resident_mb(family=True) < 800.0


def test_a_child_that_ends_while_a_family_is_looked_at_hides_none_of_it(with_child, monkeypatch):
    worker = with_child("held = bytearray(400_000_000)")
    with subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE) as short:
        ended = psutil.Process(short.pid)
        short.communicate()
    with pytest.raises(psutil.NoSuchProcess):
        ended.memory_info()
    real = psutil.Process.children
    monkeypatch.setattr(psutil.Process, "children", lambda self, recursive: [ended, *real(self, recursive=recursive)])
    assert worker.resident_mb(family=True) > 400.0


def test_a_worker_that_crashes_leaves_no_core_file():
    before, largest = resource.getrlimit(resource.RLIMIT_CORE)
    if largest == 0:
        pytest.skip("this process may not leave core files in the first place")
    resource.setrlimit(resource.RLIMIT_CORE, (largest, largest))
    try:
        (row,) = execute([cell(0, "cores")], behave)
    finally:
        resource.setrlimit(resource.RLIMIT_CORE, (before, largest))
    assert row["iterations"] == 0


def test_nan_of_a_function_is_empty_in_its_row():
    row = by_key([cell(0, "nan")])[0]
    assert row["objective"] is None and row["gap"] is None


def test_a_noisy_solver_disturbs_nobody(capfd):
    rows = by_key([cell(0, "noisy"), cell(1)], workers=1)
    assert [row["outcome"] for row in rows.values()] == ["done", "done"]
    out, err = capfd.readouterr()
    assert not out and not err


def test_a_worker_that_keeps_memory_is_replaced(monkeypatch):
    monkeypatch.setattr(workers, "KEPT_MB", 100.0)
    cells = [cell(0, "keep", memory_limit=700.0, megabytes=300), cell(1, memory_limit=700.0), cell(2)]
    rows = by_key(cells, workers=1)
    assert [row["outcome"] for row in rows.values()] == ["done"] * 3
    assert rows[0]["unknowns"] != rows[1]["unknowns"] == rows[2]["unknowns"]


def test_a_cell_that_cannot_be_sent_is_a_row():
    bad = cell(0, how=lambda: None)
    rows = by_key([bad, cell(1)], workers=1)
    assert rows[0]["outcome"] == "error" and "cannot be sent to a worker" in rows[0]["reason"]
    assert rows[1]["outcome"] == "done"


def test_closing_ends_the_workers_at_once():
    rows = execute([cell(0), cell(1, "loop"), cell(2, "loop")], behave, workers=2)
    pid = next(rows)["unknowns"]
    assert pid in cell_workers(os.getpid())
    clock = time.monotonic()
    rows.close()
    assert gone(pid) and time.monotonic() - clock < 30.0
    assert not cell_workers(os.getpid())


def test_workers_die_with_a_parent_that_is_killed(tmp_path):
    program = f"""
import sys
sys.path.insert(0, {str(Path(study_trouble.__file__).parent)!r})
from study_trouble import behave, cell
from optid.studies.execution.workers import execute
for row in execute([cell(0), cell(1), cell(2, "stuck"), cell(3, "stuck")], behave, workers=2):
    print(row["unknowns"], flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        parent.stdout.readline(), parent.stdout.readline()
        children = psutil.Process(parent.pid).children()
        assert len(children) == 2
        time.sleep(0.2)
        parent.kill()
    wait_for(lambda: all(gone(child.pid) for child in children))


@pytest.mark.parametrize("missing, error, words", [
    ("psutil", StudyError, "pip install 'optid"),
    ("optid.solving.isolated", ModuleNotFoundError, "optid.solving.isolated")])
def test_only_a_missing_psutil_is_said_to_be_missing(monkeypatch, missing, error, words):
    monkeypatch.delitem(sys.modules, "optid.studies.execution.worker_process")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(error, match=words):
        Pool(behave, 1)


def test_no_guard_of_the_main_module_is_needed(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(f"""
import sys
sys.path.insert(0, {str(Path(study_trouble.__file__).parent)!r})
from study_trouble import behave, cell
from optid.studies.execution.workers import execute
print("once", [row["outcome"] for row in execute([cell(0)], behave)])
""")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=600)
    assert done.stdout == "once ['done']\n", done.stderr


@pytest.mark.parametrize("number", [0, -2])
def test_no_workers_are_refused(number):
    with pytest.raises(StudyError, match="at least one, is needed"):
        list(execute([cell(0)], behave, workers=number))


def test_a_function_without_a_name_is_refused():
    with pytest.raises(StudyError, match="workers cannot import"):
        list(execute([cell(0)], lambda cell: {}))


def test_workers_that_do_not_start_are_an_error_with_their_last_words(monkeypatch):
    program = "import no_such_module_{parent}  # {path} {descriptor}"
    monkeypatch.setattr("optid.studies.execution.worker_process.PROGRAM", program)
    with pytest.raises(StudyError, match="5 workers, one after another, .*exit code 1, ModuleNotFoundError"):
        list(execute([cell(0)], behave))


def test_a_path_object_in_the_search_path_is_no_obstacle(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, Path("/nowhere")])
    assert by_key([cell(0)])[0]["outcome"] == "done"


def test_nothing_to_do_starts_nobody():
    before = set(psutil.Process().children())
    assert list(execute([], behave)) == []
    assert set(psutil.Process().children()) <= before
