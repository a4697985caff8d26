"""Cells on a Dask cluster: the same rows as on one machine, whatever dies."""

import os
import signal
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from processes import cell_workers, gone, wait_for
from study_trouble import behave, cell
from typer.testing import CliRunner

from optid.cli.app import app
from optid.errors import ClusterError, StudyError
from optid.studies import Study
from optid.studies.definition import DataEntry, FormulationEntry, SolverEntry
from optid.studies.execution import cluster, running, workers
from optid.studies.grid import cells as cells_of
from optid.studies.storage.rows import NAMES
from optid.studies.storage.store import finished, read_rows

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
CommClosedError = pytest.importorskip("distributed.comm").CommClosedError

TIMES = {"load_s", "build_s", "compile_s", "judge_s", "prove_s", "fit_s", "solve_s", "warm_s", "total_s", "peak_mb",
         "base_mb", "started"}


SMALL = Study("trouble", (DataEntry("none", system="dead_zone"),),
              (FormulationEntry("f", "arx", options={"na": 1, "nb": 1}),), (SolverEntry("s", "clarabel"),))


def by_key(found, todo):
    """Rows by number of the cell; every cell has exactly one."""
    rows = {int(row["key"], 16): row for row in found}
    assert len(found) == len(todo) == len(rows)
    assert all(tuple(row) == NAMES for row in found)
    return rows


def test_rows_are_those_of_one_machine(client, two_processes):
    """Several formulations, a refused pair, systems of the catalogue: equal in every column but times and memory."""
    study = Study(name="both", time_limit=300.0, seeds=(1, 2),
                  data=(DataEntry("rig", system="dead_zone", samples=(200,), noise=(0.1,)),),
                  formulations=(FormulationEntry("exact", "hammerstein_arx.exact",
                                                 options={"na": 2, "nb": 2, "basis": "triangular:4"},
                                                 constraints=("monotone:increasing",)),
                                FormulationEntry("linear", "arx", options={"na": 2, "nb": 2})),
                  solvers=(SolverEntry("gn", "gauss_newton"), SolverEntry("clarabel", "clarabel")))
    todo = cells_of(study)
    here = {(row["key"], row["repetition"]): row for row in workers.execute(todo, workers=1)}
    found = cluster.execute(todo, scheduler=two_processes.scheduler_address)
    there = {(row["key"], row["repetition"]): row for row in found}
    assert set(here) == set(there) and len(here) == len(todo) == 8
    assert Counter(row["outcome"] for row in here.values())["done"] >= 4
    for key, row in here.items():
        assert {n: row[n] for n in NAMES if n not in TIMES} == {n: there[key][n] for n in NAMES if n not in TIMES}


def test_what_cells_do_to_their_process_leaves_the_dask_workers_alone(client):
    """Crashes, endless loops, hogs and nonsense are the rows that they are on one machine."""
    before = set(client.nthreads())
    troubles = [("segfault", {}), ("raise", {}), ("stuck", {"time_limit": 1.0}), ("hog", {"memory_limit": 400.0}),
                ("garbage", {}), ("nan", {})]
    todo = [cell(k, do, **limits) for k, (do, limits) in enumerate(troubles)] + [cell(k) for k in range(20, 26)]
    here = by_key(list(workers.execute(todo, behave, workers=2)), todo)
    there = by_key(list(cluster.execute(todo, behave, scheduler=client)), todo)
    assert set(client.nthreads()) == before
    assert {k: row["outcome"] for k, row in here.items()} == {k: row["outcome"] for k, row in there.items()}
    assert there[0]["outcome"] == "crashed" and "SIGSEGV" in there[0]["reason"]
    assert there[2]["outcome"] == "time limit" and there[3]["outcome"] == "memory limit"


def test_worker_processes_are_reused_and_end_with_the_study(client):
    todo = [cell(k) for k in range(24)]
    rows = by_key(list(cluster.execute(todo, behave, scheduler=client)), todo)
    pids = {row["unknowns"] for row in rows.values()}
    assert len(pids) <= 2
    wait_for(lambda: all(map(gone, pids)))


def test_a_killed_dask_worker_loses_no_cell(client):
    """Killed twice in the middle: every cell has one row, and the process of its cell goes with the worker."""
    todo = [cell(k, seconds=0.1) for k in range(40)]
    rows, pids = [], client.run(os.getpid)
    for row in cluster.execute(todo, behave, scheduler=client):
        rows.append(row)
        if len(rows) in (5, 15):
            os.kill(pids.popitem()[1], signal.SIGKILL)
    found = by_key(rows, todo)
    assert all(row["outcome"] == "done" for row in found.values())
    wait_for(lambda: all(gone(row["unknowns"]) for row in rows))


def test_a_study_writes_every_cell_once_and_resumes_on_a_cluster(client, monkeypatch, tmp_path):
    """A Dask worker is killed, the run is stopped as by Ctrl-C, and the second run, here, does the rest."""
    todo = [cell(k, seconds=0.05) for k in range(40)]
    monkeypatch.setattr(running, "cells", lambda study: list(todo))
    ran, pids, db = [], client.run(os.getpid), tmp_path / "study.sqlite"

    def follow(done, total, row):
        if done == 8 and row:
            os.kill(pids.popitem()[1], signal.SIGKILL)
        if done == 20 and row:
            raise KeyboardInterrupt

    def on_cluster(cells):
        return cluster.execute(cells, behave, scheduler=client)

    def here(cells):
        ran.extend(cells)
        return workers.execute(cells, behave, workers=1)

    with pytest.raises(KeyboardInterrupt):
        running.run(SMALL, db, progress=follow, execute=on_cluster)
    kept = finished(db)
    assert len(kept) >= 19
    running.run(SMALL, db, execute=here)
    rows = read_rows(db)
    assert len(ran) == 40 - len(kept) and sorted(rows["key"]) == sorted(one.key for one in todo)


def test_a_scheduler_that_cannot_be_reached_leaves_no_database(tmp_path):
    (tmp_path / "study.toml").write_text("""
name = "small"
solvers = ["clarabel"]
[[data]]
name = "rig"
system = "dead_zone"
[[formulation]]
name = "linear"
formulation = "arx"
na = 1
nb = 1
""")
    result = CliRunner().invoke(app, ["study", "run", str(tmp_path / "study.toml"), "--db", str(tmp_path / "s.sqlite"),
                                      "--scheduler", "tcp://127.0.0.1:1"])
    assert result.exit_code == 2
    assert "no scheduler can be reached at tcp://127.0.0.1:1" in " ".join(result.output.split())
    assert not (tmp_path / "s.sqlite").exists()


def test_a_cell_whose_dask_worker_always_dies_is_a_row(client, two_processes, monkeypatch, tmp_path):
    """It is not run for ever: Dask gives up a task after some workers."""
    monkeypatch.setattr(two_processes.scheduler, "allowed_failures", 0)
    monkeypatch.setattr(cluster, "TURNS", 1)
    log, pids = tmp_path / "log", client.run(os.getpid)
    todo = [cell(0, seconds=600.0, time_limit=900.0, log=str(log))]

    def kill():
        wait_for(log.exists, 300.0)
        for pid in pids.values():
            os.kill(pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    rows = by_key(list(cluster.execute(todo, behave, scheduler=client)), todo)
    killer.join()
    assert rows[0]["outcome"] == "crashed" and "1 Dask worker" in rows[0]["reason"]


def test_closing_ends_the_cells_under_way(client, tmp_path):
    log = tmp_path / "log"
    under_way = cluster.execute([cell(k, "stuck_unless_first", log=str(log)) for k in range(9)], behave,
                                scheduler=client)
    assert next(under_way)["outcome"] == "done"
    wait_for(lambda: len(log.read_text().splitlines()) >= 3)
    assert any(map(cell_workers, client.run(os.getpid).values()))
    under_way.close()
    wait_for(lambda: not any(map(cell_workers, client.run(os.getpid).values())))
    assert len(log.read_text().splitlines()) <= 5  # the others never start
    todo = [cell(k) for k in range(4)]
    by_key(list(cluster.execute(todo, behave, scheduler=client)), todo)  # the cluster is as good as before


def file_study(path, seeds=()):
    entry = DataEntry("rig", files=(str(path),), options={"inputs": ["u"], "outputs": ["y"], "dt": 0.1})
    return Study(name="files", time_limit=300.0, data=(entry,), solvers=(SolverEntry("clarabel", "clarabel"),),
                 formulations=(FormulationEntry("linear", "arx", options={"na": 1, "nb": 1}),
                               FormulationEntry("linear 2", "arx", options={"na": 2, "nb": 2})))


@pytest.fixture
def record_file(tmp_path):
    rng = np.random.default_rng(crc32(tmp_path.name.encode()))  # another content in every test
    u = rng.standard_normal(400)
    y = np.convolve(u, [0.0, 1.0, 0.5])[:400] + 0.1 * rng.standard_normal(400)
    path = tmp_path / "record.csv"
    np.savetxt(path, np.column_stack([u, y]), delimiter=",", header="u,y", comments="")
    return path


@pytest.fixture
def no_files(client, tmp_path):
    """What lets the workers of the cluster find nothing in the folder of the test."""
    yield lambda: client.run(pretend_no_files, str(tmp_path))
    client.run(pretend_no_files, "")


def test_data_files_that_a_worker_does_not_have_are_sent(client, record_file, no_files):
    todo = cells_of(file_study(record_file))
    here = {row["key"]: row for row in workers.execute(todo, workers=1)}
    seen = {row["key"]: row for row in cluster.execute(todo, scheduler=client)}
    no_files()
    sent = {row["key"]: row for row in cluster.execute(todo, scheduler=client)}
    for key, row in here.items():
        for other in (seen[key], sent[key]):
            assert row["outcome"] == "done"
            assert {n: row[n] for n in NAMES if n not in TIMES} == {n: other[n] for n in NAMES if n not in TIMES}
    copies = client.run(copies_of, record_file.name)
    assert sum(copies.values()) in (1, 2)  # once per worker that had a cell


def copies_of(name, dask_worker):
    return len(list(Path(dask_worker.local_directory).rglob(name)))


def pretend_no_files(folder):
    """On a Dask worker: files below a folder are not there."""
    from optid.studies.execution import cluster_worker

    real = getattr(cluster_worker, "_real_content", None) or cluster_worker._content
    cluster_worker._real_content = real
    cluster_worker._content = lambda files: (
        "not here" if folder and files[0].startswith(folder) and "optid-data" not in files[0] else real(files))


def test_files_that_cannot_be_sent_are_rows(client, record_file, no_files, monkeypatch):
    todo = cells_of(file_study(record_file))[:1]
    no_files()
    monkeypatch.setattr(cluster, "SHIPPED", 10)
    (row,) = cluster.execute(todo, scheduler=client)
    assert row["outcome"] == "error" and "too large to be sent" in row["reason"]
    monkeypatch.undo()
    record_file.write_text("u,y\n1,2\n")
    (row,) = cluster.execute(todo, scheduler=client)
    assert row["outcome"] == "error" and "changed while the study ran" in row["reason"]
    record_file.unlink()
    (row,) = cluster.execute(todo, scheduler=client)
    assert row["outcome"] == "error" and "it cannot be sent there" in row["reason"]


def test_clusters_that_cannot_run_the_cells_are_refused(client, monkeypatch):
    todo = [cell(0)]
    with pytest.raises(ClusterError, match="no scheduler can be reached"):
        next(cluster.execute(todo, behave, scheduler="tcp://127.0.0.1:1"))
    with pytest.raises(ClusterError, match="no scheduler can be reached"):
        running._executor(todo, None, "tcp://127.0.0.1:1")  # before the database is made
    with pytest.raises(StudyError, match="workers cannot import"):
        next(cluster.execute(todo, lambda c: {}, scheduler=client))
    assert {"clarabel", "cvxpy", "scipy", "optid"} <= set(cluster.packages(todo))
    real = cluster._versions
    monkeypatch.setattr(cluster, "_versions", lambda c: real(c) | {"nix": "1.0"})
    assert "nix" in cluster.packages(todo)


def test_rows_of_a_worker_that_joined_with_other_versions_are_refused(client, monkeypatch):
    """It came after the cluster was looked at: its first row tells."""
    real = cluster._versions
    monkeypatch.setattr(cluster, "_versions", lambda c: real(c) | {"clarabel": "0.1"})
    monkeypatch.setattr(cluster, "packages", lambda todo: ["numpy"])
    study = file_study("x")
    todo = cells_of(replace(study, data=(DataEntry("rig", system="dead_zone", samples=(100,), noise=(0.1,)),)))[:1]
    with pytest.raises(ClusterError, match=r"other packages: clarabel: 0.1 here, .* there.*rows so far are kept"):
        list(cluster.execute(todo, scheduler=client))


def test_a_cell_that_cannot_be_pickled_is_a_row(client):
    todo = [replace(cell(0), options={"f": lambda x: x}), cell(1)]
    rows = by_key(list(cluster.execute(todo, behave, scheduler=client)), todo)
    assert rows[0]["outcome"] == "error" and "cannot be sent to a worker" in rows[0]["reason"]
    assert rows[1]["outcome"] == "done"


def test_a_client_that_is_closed_ends_the_study_and_loses_no_cell_to_a_row(two_processes, tmp_path, monkeypatch):
    """What was not run has no row: the next run has it to do."""
    todo = [cell(k) for k in range(40)]
    monkeypatch.setattr(running, "cells", lambda study: list(todo))
    lost = distributed.Client(two_processes, set_as_default=False)

    def progress(done, total, row):
        if done == 1 and row:
            lost.close()

    with pytest.raises(ClusterError, match="Rows so far are kept|the scheduler went away"):
        running.run(SMALL, tmp_path / "study.sqlite", progress=progress,
                    execute=lambda cells: cluster.execute(cells, behave, scheduler=lost))
    rows = read_rows(tmp_path / "study.sqlite")
    assert set(rows["outcome"]) == {"done"} and len(rows["key"]) < 40


def test_a_scheduler_that_goes_away_is_an_error_in_words():
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as short:
        under_way = cluster.execute([cell(k, seconds=0.2) for k in range(50)], behave,
                                    scheduler=short.scheduler_address)
        rows = [next(under_way)]
        short.close()
        with pytest.raises(ClusterError, match="Rows so far are kept|scheduler went away"):
            for row in under_way:
                rows.append(row)
        assert len(rows) < 50 and {row["outcome"] for row in rows} == {"done"}


@pytest.mark.parametrize("error", [OSError("no route to the host"), CommClosedError("Stream is closed")])
def test_a_row_that_cannot_be_fetched_is_no_fault_of_its_cell(client, monkeypatch, error):
    """It has no row then, so that the next run runs it."""

    def broken(self, timeout=None):
        raise error

    with monkeypatch.context() as severed:
        severed.setattr(distributed.Future, "result", broken)
        with pytest.raises(ClusterError, match="a row was not received .*Rows so far are kept"):
            next(cluster.execute([cell(0)], behave, scheduler=client))
