"""Running a study: nothing twice, nothing lost, one writer, and a clear word where it cannot go on."""

import re
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import study_trouble
from study_rows import finished_rows
from study_trouble import behave, cell, row

from optid.errors import DatabaseError, StudyError
from optid.studies.definition import DataEntry, FormulationEntry, SolverEntry
from optid.studies.execution import running
from optid.studies.execution.executors import run_here
from optid.studies.execution.running import run
from optid.studies.storage.rows import NAMES
from optid.studies.storage.store import Store, read_rows
from optid.studies.study import Study

STUDY = Study("trouble", (DataEntry("none", system="dead_zone"),),
              (FormulationEntry("f", "arx", (), {"na": 1, "nb": 1}),), (SolverEntry("s", "clarabel"),))
PATHS = [str(Path(file).parent) for file in (study_trouble.__file__, __file__)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "study.sqlite"


class Hands:
    """An executor in this process that counts, and stops where it is told."""

    def __init__(self, stop_after=None, error=KeyboardInterrupt):
        self.ran, self.stop_after, self.error, self.closed = [], stop_after, error, False

    def __call__(self, todo):
        try:
            for one in todo:
                if self.stop_after is not None and len(self.ran) >= self.stop_after:
                    raise self.error("stopped")
                self.ran.append(int(one.key, 16))
                yield row(one)
        finally:
            self.closed = True


@pytest.fixture
def grid(monkeypatch):
    """Let the study consist of these cells."""

    def set_to(found):
        monkeypatch.setattr(running, "cells", lambda study: list(found))
        return list(found)

    return set_to


def test_a_second_run_recomputes_nothing(path, grid):
    grid([cell(k) for k in range(10)])
    seen = []
    hands = Hands()
    rows = run(STUDY, path, executor=hands, progress=lambda *found: seen.append((*found, len(finished_rows(path)))))
    assert hands.ran == list(range(10)) and [int(r["key"], 16) for r in rows] == hands.ran
    assert seen[0] == (0, 10, None, 0) and [one[2] for one in seen[1:]] == rows  # given back as they were made
    assert [(done, total, there) for done, total, _, there in seen] == [(k, 10, k) for k in range(11)]
    grid([cell(k) for k in range(12)])
    again = Hands()
    rows = run(STUDY, path, executor=again)
    assert again.ran == [10, 11] and len(rows) == 12 and tuple(rows[0]) == NAMES
    assert sorted(p.name for p in path.parent.iterdir()) == ["study.sqlite"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_what_is_finished_is_kept_when_something_stops_the_run(path, grid, error):
    grid([cell(k) for k in range(10)])
    hands = Hands(4, error)
    with pytest.raises(error):
        run(STUDY, path, executor=hands)
    assert hands.closed and len(finished_rows(path)) == 4

    def progress(done, total, found):
        if done == 7:
            raise OSError("the terminal is gone")

    rest = Hands()
    with pytest.raises(OSError):
        run(STUDY, path, executor=rest, progress=progress)
    assert rest.closed and len(finished_rows(path)) == 7
    run(STUDY, path, executor=rest)
    assert rest.ran == [4, 5, 6, 7, 8, 9] and len(finished_rows(path)) == 10


def test_rows_nobody_asked_for_and_doubles_are_left_out(path, grid):
    grid([cell(k) for k in range(3)])
    rows = run(STUDY, path, executor=lambda todo: iter([row(c) for c in [*todo, cell(7), *todo]]))
    assert len(rows) == 3 == len(finished_rows(path))


@pytest.mark.parametrize("settings, words", [
    ({"workers": 0}, "a positive integer"), ({"workers": 2.0}, "a positive integer"),
    ({"workers": True}, "a positive integer"),
    ({"retry": ["done", "crahsed"]}, "Did you mean 'crashed'"),
])
def test_settings_that_make_no_sense_are_refused_before_the_database_is_made(path, grid, settings, words):
    grid([cell(0)])
    with pytest.raises(StudyError, match=words):
        run(STUDY, path, **settings)
    assert list(path.parent.iterdir()) == []


def test_cells_that_come_back_without_a_row_are_told(path, grid):
    grid([cell(k) for k in range(3)])
    with pytest.raises(StudyError, match="2 cells of 3 returned no row"):
        run(STUDY, path, executor=lambda todo: iter([row(todo[0])]))
    assert len(finished_rows(path)) == 1


def test_refused_cells_need_no_worker(path, grid):
    grid([replace(cell(0), refusal="not installed: pip install x"), cell(1)])
    hands = Hands()
    rows = run(STUDY, path, executor=hands)
    assert hands.ran == [1] and [r["outcome"] for r in rows] == ["refused", "done"]


def test_outcomes_are_retried_on_request(path, grid):
    grid([cell(k) for k in range(4)])
    run(STUDY, path, executor=lambda todo: iter([row(c, outcome="done" if k else "crashed")
                                                for k, c in enumerate(todo)]))
    hands = Hands()
    assert [r["outcome"] for r in run(STUDY, path, executor=hands, retry=["crashed"])] == ["done"] * 4
    assert hands.ran == [0]
    with closing(sqlite3.connect(path)) as connection, connection:
        assert connection.execute("SELECT outcome FROM superseded").fetchall() == [("crashed",)]


def test_what_is_retried_is_not_taken_over_from_another_study(path, grid):
    cells = grid([cell(k) for k in range(3)])
    other = replace(STUDY, name="another")
    outcomes = ("crashed", "time limit", "done")
    run(STUDY, path, executor=lambda todo: iter([row(c, outcome=o) for c, o in zip(todo, outcomes)]))
    grid([replace(c, study="another") for c in cells])
    assert [r["outcome"] for r in run(other, path, executor=Hands())] == list(outcomes)
    grid(cells)
    hands = Hands()
    assert [r["outcome"] for r in run(STUDY, path, executor=hands, retry="crashed")] == ["done", "time limit", "done"]
    assert hands.ran == [0]
    grid([replace(c, study="third") for c in cells])
    rows = run(replace(STUDY, name="third"), path, executor=hands)
    assert [r["outcome"] for r in rows] == ["done", "time limit", "done"]  # of two rows the one that is done
    assert hands.ran == [0]


def test_other_labels_and_other_studies_take_over_what_is_there(path, grid):
    cells = grid([cell(k) for k in range(4)])
    run(STUDY, path, executor=Hands())
    grid([replace(c, solver="renamed") for c in cells])
    hands = Hands()
    rows = run(STUDY, path, executor=hands)
    assert hands.ran == [] and {r["solver"] for r in rows} == {"renamed"} and len(finished_rows(path)) == 4
    grid([replace(c, study="another") for c in cells])
    rows = run(replace(STUDY, name="another"), path, executor=hands)
    assert hands.ran == [] and {r["study"] for r in rows} == {"another"}
    assert [len(finished_rows(path, name)) for name in ("trouble", "another")] == [4, 4]
    before = read_rows(path)["started"].size
    run(replace(STUDY, name="another"), path, executor=hands)
    assert read_rows(path)["started"].size == before == 8


def changed(count):
    """Cells of a file before and after it changed, and what makes their rows."""
    entry = DataEntry("mine", files=("/somewhere/x.csv",))
    old = [replace(cell(k), data="mine", data_source=entry, data_hash="a" * 64) for k in range(count)]
    new = [replace(c, key=f"{100 + k:064x}", data_hash="b" * 64) for k, c in enumerate(old)]
    return old, new, lambda todo: iter([row(c, data_hash=c.data_hash) for c in todo])


def test_changed_data_are_refused_unless_told(path, grid):
    old, new, made = changed(3)
    grid(old)
    run(STUDY, path, executor=made)
    grid(new)
    with pytest.raises(StudyError, match="data changed since the last run.*\n.*mine: /somewhere/x.csv"):
        run(STUDY, path, executor=made)
    rows = run(STUDY, path, executor=made, accept_changed_data=True)
    assert {r["data_hash"] for r in rows} == {"b" * 64} and len(finished_rows(path)) == 3
    run(STUDY, path, executor=made)


def test_changed_data_stay_accepted_when_an_entry_was_taken_out(path, grid):
    old, new, made = changed(2)
    grid(old)
    run(STUDY, path, executor=made)
    grid(new[:1])
    for accepted in (True, False):
        run(STUDY, path, executor=made, accept_changed_data=accepted)
        assert set(read_rows(path)["data_hash"]) == {"b" * 64}
    grid(old)
    hands = Hands()
    run(STUDY, path, executor=hands, accept_changed_data=True)
    assert hands.ran == []  # the former content again: its rows were kept


def test_two_runs_of_a_study_at_once_are_refused_and_two_studies_are_not(path, tmp_path, grid):
    import os
    cells = grid([cell(0)])
    link = tmp_path / "link.sqlite"
    link.symlink_to(path)
    with Store(path, write=True) as store, store.claim(STUDY.name):
        for name in (path, link):
            with pytest.raises(DatabaseError, match=f"another run of 'trouble' .*: process {os.getpid()} on .* since"):
                run(STUDY, name, executor=Hands())
        grid([replace(c, study="another") for c in cells])
        assert len(run(replace(STUDY, name="another"), path, executor=Hands())) == 1
    grid(cells)
    assert len(run(STUDY, path, executor=Hands())) == 1


@pytest.mark.parametrize("year, free", [(2026, True), (2999, False)])
def test_a_run_on_another_machine_holds_its_study_while_it_writes_rows(path, grid, year, free):
    grid([cell(0)])
    with Store(path, write=True), closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("INSERT INTO runs VALUES ('trouble', 'elsewhere', 1, '2026-01-01', ?)",
                           [f"{year}-01-01T00:00:00+00:00"])
    if free:
        assert len(run(STUDY, path, executor=Hands())) == 1
    else:
        with pytest.raises(DatabaseError, match="process 1 on elsewhere"):
            run(STUDY, path, executor=Hands())


def test_the_study_of_a_killed_run_is_free(path, grid):
    grid([cell(0)])
    program = f"""
from optid.studies.storage.store import Store
with Store({str(path)!r}, write=True) as store, store.claim("trouble"):
    print("held", flush=True)
    input()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        with pytest.raises(DatabaseError, match=f"process {holder.pid} on"):
            run(STUDY, path, executor=Hands())
        holder.kill()
        holder.wait()
    assert len(run(STUDY, path, executor=Hands())) == 1


def test_what_would_be_run_changes_nothing(path, grid):
    cells = grid([cell(k) for k in range(5)])
    assert [len(found) for found in running.plan(STUDY, path)[:2]] == [5, 5] and not path.exists()
    run(STUDY, path, executor=Hands())
    grid(cells[2:])
    before = path.read_bytes()
    every, todo, former = running.plan(STUDY, path, retry="done")
    assert (len(every), len(todo)) == (3, 3) and former.startswith("5 rows are set aside")
    assert path.read_bytes() == before


def test_rows_of_a_run_through_a_link_that_was_killed_are_found_without_the_link(path, tmp_path, grid):
    (tmp_path / "there").mkdir()
    link = tmp_path / "there" / "link.sqlite"
    link.symlink_to(path)
    program = f"""
import os, sys
sys.path[:0] = {PATHS}
from study_trouble import cell
from optid.studies.execution import running
from test_study_running import STUDY, Hands
running.cells = lambda study: [cell(k) for k in range(5)]
running.run(STUDY, {str(link)!r}, executor=Hands(),
            progress=lambda done, total, found: os.kill(os.getpid(), 9) if done == 3 else None)
"""
    assert subprocess.run([sys.executable, "-c", program]).returncode == -9
    grid([cell(k) for k in range(5)])
    rest = Hands()
    assert len(run(STUDY, path, executor=rest)) == 5 and rest.ran == [3, 4]
    assert link.is_symlink()


def test_another_version_is_refused_before_anything_is_run(path, grid):
    grid([cell(0)])
    run(STUDY, path, executor=Hands())
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE meta SET value = '99' WHERE name = 'schema version'")
    grid([cell(1)])
    hands = Hands()
    with pytest.raises(DatabaseError, match="schema version 99"):
        run(STUDY, path, executor=hands)
    assert hands.ran == [] and sorted(p.name for p in path.parent.iterdir()) == ["study.sqlite"]


def test_a_folder_that_is_not_there_is_told(tmp_path, grid):
    grid([cell(0)])
    with pytest.raises(DatabaseError, match="cannot be written: No such file or directory"):
        run(STUDY, tmp_path / "nowhere" / "x.sqlite", executor=Hands())


def test_frames(path, grid):
    pd = pytest.importorskip("pandas")
    grid([cell(k) for k in range(3)])
    for db in (path, None):
        frame = STUDY.run(db, executor=Hands())
        assert tuple(frame.columns) == NAMES and len(frame) == 3
        assert frame["objective"].isna().all() and frame["objective"].dtype == float
        assert frame["reached"].dtype == bool and frame["unknowns"].dtype == "Int64"
        assert isinstance(frame["started"].iloc[0], pd.Timestamp)


def test_a_real_study_from_python_to_its_frame():
    """Simulated and in-memory records, a procedure, a refusal and a missing solver, in workers of their own."""
    import numpy as np

    from optid import Data
    from optid.studies.execution.cell import run_cell
    from optid.studies.grid import cells

    pytest.importorskip("pandas")
    u = np.random.default_rng(0).uniform(-1, 1, 300)
    record = Data(u, np.convolve(u, [0.0, 0.5, 0.3])[:300] + 0.01 * np.sin(np.arange(300.0)), dt=0.1)
    study = Study(
        "real", (DataEntry("simulated", system="dead_zone", samples=(200,)), DataEntry("mine", record=record)),
        (FormulationEntry("exact", "hammerstein_arx.exact", (), {"na": 1, "nb": 2, "basis": "triangular:5"}),
         FormulationEntry("linear", "arx", (), {"na": 1, "nb": 2})),
        (SolverEntry("gn", "gauss_newton"), SolverEntry("clarabel", "clarabel"), SolverEntry("gurobi", "gurobi")),
        repetitions=2, warm=True, time_limit=300.0)
    frame = study.run(workers=2)
    assert len(frame) == 2 * 2 * 3 * 2
    outcomes = frame.groupby(["formulation", "solver"])["outcome"].agg(lambda words: "/".join(sorted(set(words))))
    assert outcomes["exact", "gn"] == outcomes["linear", "clarabel"] == "done"
    assert outcomes["exact", "clarabel"] == outcomes["exact", "gurobi"] == outcomes["linear", "gurobi"] == "refused"
    done = frame[frame["outcome"] == "done"]
    assert done["reached"].all() and done["one_step_fit"].notna().all() and done["warm_s"].notna().all()
    here = {cell.key: run_cell(cell)["objective"] for cell in cells(study)}
    for key, objective in zip(done["key"], done["objective"]):
        assert objective == pytest.approx(here[key], rel=1e-12)


DRIVER = """
import sys
sys.path[:0] = {paths}
from functools import partial
from study_trouble import behave, cell
from optid.studies.execution import running
from optid.studies.execution.executors import run_here
from test_study_running import STUDY
slow = int(sys.argv[1])  # these last until the kill
running.cells = lambda study: [cell(k, seconds=0.02 if k < slow else 600.0, time_limit=900.0, log={log!r})
                               for k in range({count})]
running.run(STUDY, {path!r}, executor=partial(run_here, function=behave, workers=2))
"""


def test_killed_at_any_moment_and_run_again_every_cell_is_there_once(path, tmp_path, grid):
    count, log = 60, tmp_path / "log"
    log.touch()
    program = DRIVER.format(paths=PATHS, log=str(log), count=count, path=str(path))

    def begun():
        return len(log.read_text().splitlines())

    for aim in (1, 15, 40):
        driver = subprocess.Popen([sys.executable, "-c", program, str(aim + 10)])
        until = time.monotonic() + 300.0
        while begun() < aim and driver.poll() is None and time.monotonic() < until:
            time.sleep(0.005)
        assert begun() >= aim and driver.poll() is None
        driver.kill()
        driver.wait()
        if path.exists():
            assert len(finished_rows(path)) <= begun()  # it opens
    cells = grid([cell(k, seconds=0.0, log=str(log)) for k in range(count)])
    rows = run(STUDY, path, executor=partial(run_here, function=behave, workers=2))
    assert [r["key"] for r in rows] == [c.key for c in cells] and len(finished_rows(path)) == count
    assert begun() <= count + 3 * 4  # run twice: at most what three kills found in flight, with one waiting each


def test_a_full_disk_stops_cleanly_and_the_next_run_goes_on(path, grid):
    """Files may grow to a size only."""
    program = f"""
import resource, signal, sys
sys.path[:0] = {PATHS}
from study_trouble import cell
from optid.errors import DatabaseError
from optid.studies.execution import running
from test_study_running import STUDY, Hands
grid = [cell(k) for k in range(3000)]
running.cells = lambda study: grid
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, resource.RLIM_INFINITY))
hands = Hands()
try:
    running.run(STUDY, {str(path)!r}, executor=hands)
except DatabaseError as error:
    print(hands.closed, len(hands.ran), error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    closed, ran, words = done.stdout.split(" ", 2)
    assert closed == "True" and int(ran) > 5
    assert "study.sqlite cannot be written: " in words
    kept = re.search(r"([\d,]+) of 3,000 cells are kept\. Where the disk is full, free space; the same run", words)
    assert kept is not None, words
    assert len(finished_rows(path)) == int(kept[1].replace(",", "")) == int(ran) - 1
    grid([cell(k) for k in range(3000)])
    rest = Hands()
    assert len(run(STUDY, path, executor=rest)) == 3000
    assert len(rest.ran) + int(ran) == 3001  # the row for which there was no room is made again
