"""Cells with an executor of `concurrent.futures`, Dask's included: the same rows as on one machine, whatever dies."""

import json
import os
import signal
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context

import pytest
from processes import cell_workers, gone, wait_for
from study_trouble import behave, cell, row

from optid.errors import StudyError
from optid.processes import _resting
from optid.studies.execution import running
from optid.studies.execution.executors import run_here, run_with
from optid.studies.grid import cells as cells_of
from optid.studies.storage.rows import NAMES
from optid.studies.storage.store import read_rows
from optid.studies.study import Study

TIMES = {"load_s", "build_s", "compile_s", "judge_s", "prove_s", "fit_s", "solve_s", "warm_s", "total_s", "peak_mb",
         "base_mb", "started", "steps"}
SMALL = Study("trouble", "dead_zone", {"formulation": "arx", "na": 1, "nb": 1}, "clarabel")


def by_key(found, todo):
    """Rows by number of the cell; every cell has exactly one."""
    rows = {int(one["key"], 16): one for one in found}
    assert len(found) == len(todo) == len(rows)
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("make", [
    lambda: ThreadPoolExecutor(2), lambda: ProcessPoolExecutor(2, mp_context=get_context("spawn"))])
def test_rows_are_those_of_one_machine(make):
    """Several formulations and a refused pair: equal in every column but times and memory."""
    study = Study("both", {"system": "dead_zone", "samples": 200, "noise": 0.1}, [
        {"formulation": "hammerstein_arx.exact", "na": 2, "nb": 2, "basis": "triangular:4"},
        {"formulation": "arx", "na": 2, "nb": 2}], ["gauss_newton", "clarabel"], seeds=2)
    todo = cells_of(study)
    here = {one["key"]: one for one in run_here(todo, workers=1)}
    with make() as executor:
        there = {one["key"]: one for one in run_with(executor, todo)}
    assert set(here) == set(there) and len(here) == len(todo) == 8
    assert Counter(one["outcome"] for one in here.values())["done"] >= 4
    for key, one in here.items():
        assert {n: one[n] for n in NAMES if n not in TIMES} == {n: there[key][n] for n in NAMES if n not in TIMES}


def test_what_cells_do_to_their_process_leaves_the_dask_workers_alone(client):
    """Crashes, endless loops, hogs and nonsense are the rows that they are on one machine."""
    before = set(client.nthreads())
    troubles = [("segfault", {}), ("raise", {}), ("stuck", {"time_limit": 1.0}), ("hog", {"memory_limit": 400.0}),
                ("garbage", {}), ("nan", {})]
    todo = [cell(k, do, **limits) for k, (do, limits) in enumerate(troubles)] + [cell(k) for k in range(20, 26)]
    here = by_key(list(run_here(todo, behave, workers=2)), todo)
    there = by_key(list(run_with(client.get_executor(), todo, behave)), todo)
    assert set(client.nthreads()) == before
    assert {k: one["outcome"] for k, one in here.items()} == {k: one["outcome"] for k, one in there.items()}
    assert there[0]["outcome"] == "crashed" and "SIGSEGV" in there[0]["reason"]
    assert there[2]["outcome"] == "time limit" and there[3]["outcome"] == "memory limit"


def test_a_killed_dask_worker_loses_no_cell(client):
    """Killed twice in the middle: every cell has one row, and the process of its cell goes with the worker."""
    todo = [cell(k, seconds=0.1) for k in range(40)]
    rows, pids = [], client.run(os.getpid)
    for one in run_with(client.get_executor(), todo, behave):
        rows.append(one)
        if len(rows) in (5, 15):
            os.kill(pids.popitem()[1], signal.SIGKILL)
    assert all(one["outcome"] == "done" for one in by_key(rows, todo).values())
    wait_for(lambda: len({one["unknowns"] for one in rows if not gone(one["unknowns"])}) <= 2)


def test_a_cell_whose_worker_always_dies_is_a_row_that_the_next_run_replaces(client, two_processes, monkeypatch,
                                                                             tmp_path):
    monkeypatch.setattr(two_processes.scheduler, "allowed_failures", 0)
    log, db = tmp_path / "log", tmp_path / "study.sqlite"
    todo = [cell(0, seconds=600.0, time_limit=900.0, log=str(log))]
    monkeypatch.setattr(running, "cells", lambda study: list(todo))
    pids = client.run(os.getpid)

    def follow(done, total, one):
        if one is None:
            return
        assert one["outcome"] == "killed" and "died while they had it" in one["reason"]

    def kill_all():
        wait_for(log.exists, 300.0)
        for pid in pids.values():
            os.kill(pid, signal.SIGKILL)

    def execute(cells):
        with ThreadPoolExecutor(1) as killer:
            killer.submit(kill_all)
            yield from run_with(client.get_executor(), cells, behave)

    running.run(SMALL, db, progress=follow, executor=execute)
    assert list(read_rows(db)["outcome"]) == ["killed"]
    running.run(SMALL, db, executor=lambda cells: iter([row(cells[0])]))
    assert list(read_rows(db)["outcome"]) == ["done"]


def test_a_study_resumes_on_another_executor(client, tmp_path):
    study = Study("resumed", {"system": "dead_zone", "samples": 100}, {"formulation": "arx", "na": 1, "nb": 1},
                  "clarabel", seeds=6)
    db = tmp_path / "study.sqlite"

    def stop(done, total, one):
        if done == 3 and one:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        running.run(study, db, executor=client.get_executor(), progress=stop)
    kept = set(read_rows(db)["started"])
    rows = study.run(db, workers=1)
    assert len(rows) == 6 and (rows["outcome"] == "done").all() and kept <= set(read_rows(db)["started"])


def test_an_executor_that_breaks_loses_no_row(tmp_path, monkeypatch):
    todo = [cell(k, seconds=0.05) for k in range(40)]
    monkeypatch.setattr(running, "cells", lambda study: list(todo))
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        def follow(done, total, one):
            if done == 3 and one:
                os.kill(next(iter(executor._processes)), signal.SIGKILL)

        with pytest.raises(StudyError, match="the executor broke .*rows so far are kept"):
            running.run(SMALL, tmp_path / "s.sqlite", progress=follow, executor=partial(run_with, executor,
                                                                                        function=behave))
    assert 3 <= len(read_rows(tmp_path / "s.sqlite")["key"]) < 40


def test_workers_with_other_versions_are_refused(monkeypatch):
    from optid.studies.execution import executors

    real = executors.versions_of
    monkeypatch.setattr(executors, "versions_of", lambda one: real(one) | {"clarabel": "0.1"})
    (todo,) = cells_of(Study("v", {"system": "dead_zone", "samples": 100}, {"formulation": "arx", "na": 1, "nb": 1},
                             "clarabel"))
    with ThreadPoolExecutor(1) as executor, pytest.raises(StudyError, match="other packages: clarabel: 0.1 here"):
        list(run_with(executor, [todo]))


def test_a_closed_executor_and_workers_beside_an_executor_are_refused(tmp_path):
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(StudyError, match="takes no more cells .*rows so far are kept"):
        list(run_with(executor, [cell(0)], behave))
    with pytest.raises(StudyError, match="leave one of them out"):
        running.run(SMALL, tmp_path / "s.sqlite", workers=2, executor=executor)
    assert not (tmp_path / "s.sqlite").exists()


def test_closing_ends_the_processes_of_the_cells_under_way(tmp_path):
    log = tmp_path / "log"
    under_way = run_here([cell(k, "stuck_unless_first", log=str(log)) for k in range(9)], behave, workers=2)
    assert next(under_way)["outcome"] == "done"
    wait_for(lambda: len(log.read_text().splitlines()) >= 3)
    clock = time.monotonic()
    under_way.close()
    assert time.monotonic() - clock < 30.0
    resting = {worker._process.pid for worker in _resting[os.getpid()]}  # those of other tests
    wait_for(lambda: set(cell_workers(os.getpid())) <= resting)  # killed; the system may still list them for a moment
    assert len(log.read_text().splitlines()) <= 5  # the others never start


def test_a_procedure_has_a_row_per_step_and_solver(tmp_path):
    import sqlite3

    study = Study("steps", {"system": "linear", "samples": 200}, {"formulation": "subspace.nuclear", "nx": 2}, "auto")
    study.run(tmp_path / "s.sqlite", workers=1)
    with sqlite3.connect(tmp_path / "s.sqlite") as connection:
        found = connection.execute("SELECT step, solver_used, programs, reached, seconds FROM steps").fetchall()
        ((steps, programs),) = connection.execute("SELECT steps, n_programs FROM rows").fetchall()
    assert len(found) > 1 and len({(step, solver) for step, solver, *_ in found}) == len(found)
    assert sum(count for _, _, count, *_ in found) == programs and all(seconds >= 0 for *_, seconds in found)
    assert [one["step"] for one in json.loads(steps)] == [step for step, *_ in found]
