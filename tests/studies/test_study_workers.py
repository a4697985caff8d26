"""Workers: whatever a cell does to its process is a row, and the others go on."""

import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import study_trouble
from processes import cell_workers, gone, wait_for
from study_trouble import behave, cell

from optid.errors import StudyError
from optid.studies.execution.executors import run_here
from optid.studies.storage.rows import NAMES


def by_key(cells, **settings):
    """Rows by number of the cell; every cell has exactly one."""
    rows = list(run_here(cells, behave, **{"workers": 2, **settings}))
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
    "complain": ("memory limit", "got no more memory .*std::bad_alloc"),
    "raise": ("error", "KeyError: 'no such thing'"),
    "garbage": ("error", "TypeError"),
    "partial": ("error", "did not return a row: .*must have a value in every row"),
    "vast": ("error", "did not return a row: column 'iterations' holds integers of 64 bits"),
    "other": ("error", "did not return a row: it is of another cell"),
}


def test_a_worker_that_fails_is_a_row_and_the_next_cell_runs():
    ways = [way for failure in FAILURES for way in (failure, "fine")]
    rows = by_key([cell(k, do) for k, do in enumerate(ways)], workers=1)
    for k, do in enumerate(ways):
        outcome, words = FAILURES.get(do, ("done", ""))
        assert rows[k]["outcome"] == outcome and re.search(words, rows[k]["reason"] or ""), rows[k]["reason"]
        if outcome == "error":  # nothing is wrong with the worker
            assert rows[k - 1]["unknowns"] == rows[k + 1]["unknowns"]


def test_a_worker_that_is_killed_from_outside_says_so(tmp_path):
    rows = run_here([cell(0), cell(1, seconds=600.0)], behave, workers=1)
    first = next(rows)
    wait_for(lambda: any(pid == first["unknowns"] for pid in cell_workers(os.getpid())))
    time.sleep(0.5)
    os.kill(first["unknowns"], signal.SIGKILL)
    (second,) = rows
    assert second["outcome"] == "killed" and "killed from outside (signal SIGKILL)" in second["reason"]


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
    assert rows[1]["outcome"] == "done"


def test_children_have_the_same_limit_and_go_with_their_worker(tmp_path):
    pids = tmp_path / "pids"
    hog = "import sys\ntry:\n    held = bytearray(4_000_000_000)\nexcept MemoryError:\n    sys.exit(9)"
    sleeper = "import time\ntime.sleep(600)"
    rows = by_key([cell(0, "family", memory_limit=700.0, program=hog, pids=str(pids)),
                   cell(1, "family", time_limit=5.0, program=sleeper, pids=str(pids))], workers=1)
    assert (rows[0]["outcome"], rows[0]["iterations"], rows[1]["outcome"]) == ("done", 9, "time limit")
    children = [int(line) for line in pids.read_text().split()]
    assert len(children) == 2
    wait_for(lambda: all(map(gone, children)))


def test_a_worker_that_crashes_leaves_no_core_file():
    before, largest = resource.getrlimit(resource.RLIMIT_CORE)
    if largest == 0:
        pytest.skip("this process may not leave core files in the first place")
    resource.setrlimit(resource.RLIMIT_CORE, (largest, largest))
    try:
        (row,) = run_here([cell(0, "cores")], behave, workers=1)
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


def test_a_worker_that_keeps_memory_is_replaced():
    cells = [cell(0, "keep", memory_limit=1000.0, megabytes=400), cell(1, memory_limit=700.0), cell(2)]
    rows = by_key(cells, workers=1)
    assert [row["outcome"] for row in rows.values()] == ["done"] * 3
    assert rows[0]["unknowns"] != rows[1]["unknowns"] == rows[2]["unknowns"]


def test_a_cell_that_cannot_be_sent_is_a_row():
    bad = cell(0, how=lambda: None)
    rows = by_key([bad, cell(1)], workers=1)
    assert rows[0]["outcome"] == "error" and "cannot be sent to a worker" in rows[0]["reason"]
    assert rows[1]["outcome"] == "done"


def test_a_function_without_a_name_is_refused():
    with pytest.raises(StudyError, match="workers cannot import"):
        list(run_here([cell(0)], lambda cell: {}, workers=1))


def test_workers_that_do_not_start_are_an_error_with_their_last_words(monkeypatch):
    monkeypatch.setattr("optid.studies.execution.executors.prepare", study_trouble.fail_to_start)
    monkeypatch.setattr("optid.studies.execution.executors.run_cell", behave)
    with pytest.raises(StudyError, match="before it was ready: ModuleNotFoundError"):
        list(run_here([cell(0)], behave, workers=1))


def test_a_path_object_in_the_search_path_is_no_obstacle(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, Path("/nowhere")])
    assert by_key([cell(0)])[0]["outcome"] == "done"


def test_nothing_to_do_starts_nobody():
    before = set(psutil.Process().children())
    assert list(run_here([], behave, workers=1)) == []
    assert set(psutil.Process().children()) <= before


def test_no_guard_of_the_main_module_is_needed(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(f"""
import sys
sys.path.insert(0, {str(Path(study_trouble.__file__).parent)!r})
from study_trouble import behave, cell
from optid.studies.execution.executors import run_here
print("once", [row["outcome"] for row in run_here([cell(0)], behave, workers=1)])
""")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=600)
    assert done.stdout == "once ['done']\n", done.stderr
