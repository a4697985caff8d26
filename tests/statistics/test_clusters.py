"""Dask clusters of several processes: what cannot be used is refused, and fits of records in parts are the same."""

import json
import os
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from refusals import refuses
from test_reduction import STRUCTURE, assert_same_fit, frame_of, record_folders, two_experiments

import optid
from optid.data import clusters
from optid.data.clusters import check_workers, connect_cluster
from optid.errors import ClusterError, DataError, RankError
from optid.statistics import Layout, collect

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
da = pytest.importorskip("dask.array")
dd = pytest.importorskip("dask.dataframe")


@pytest.fixture(scope="module")
def record():
    return two_experiments()


@pytest.fixture
def folders(record, tmp_path):
    return record_folders(record, tmp_path)


def digits(fit):
    statistics = fit.problem.compressed.statistics
    return np.concatenate([statistics.gram.ravel(), fit.model.a, fit.model.b[0]])


def test_parquet_folders_on_workers(record, folders, two_processes, client):
    whole = optid.fit(record, **STRUCTURE)
    here = optid.fit(optid.open_stream(folders), **STRUCTURE)
    there = optid.fit(optid.open_stream(folders, scheduler=two_processes.scheduler_address), **STRUCTURE)
    again = optid.fit(optid.open_stream([str(folder) for folder in folders], scheduler=client), **STRUCTURE)
    assert_same_fit(there, whole)
    for other in (there, again):
        np.testing.assert_array_equal(digits(other), digits(here))  # the same parts: the same digits
    assert there.model.dt == 0.1 and there.model.inputs == ("u",)


def test_dask_collections_on_workers(record, client):
    frames = [dd.from_pandas(frame_of(e), npartitions=9, sort=False) for e in record.experiments]
    there = optid.fit(optid.open_stream(frames, scheduler=client), **STRUCTURE)
    assert_same_fit(there, optid.fit(record, **STRUCTURE))
    np.testing.assert_array_equal(digits(there), digits(optid.fit(optid.open_stream(frames), **STRUCTURE)))


def test_files_of_other_kinds_are_read_whole_by_a_worker(record, client, tmp_path):
    paths = []
    for i, e in enumerate(record.experiments):
        frame_of(e).to_csv(tmp_path / f"{i}.csv", index=False)
        paths.append(tmp_path / f"{i}.csv")
    assert_same_fit(optid.fit(optid.open_stream(paths, scheduler=client), **STRUCTURE), optid.fit(record, **STRUCTURE))


def test_triangular_factors_are_reduced_too(client):
    """Badly conditioned regressors go by QR decomposition."""
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, 3000)
    y = np.convolve(u + 0.3 * u**2, [1.0, 0.5])[:3000] + 1e6 + 0.01 * rng.standard_normal(3000)
    array = da.from_array(np.column_stack([u, y]), chunks=(400, 2))
    stream = optid.open_stream(array, columns=["u", "y"], scheduler=client)
    bases = (optid.Triangular(4).with_interval(-1, 1),)
    layout = Layout(na=2, nb=(2,), nk=(0,), bases=bases, outputs=("y",), inputs=("u",))
    there, whole = collect(stream, layout), collect(optid.Data(u=u, y=y), layout)
    assert there.method == whole.method == "qr"
    norms = np.sqrt(np.diag(whole.gram))
    np.testing.assert_allclose(there.gram / norms[:, None] / norms, whole.gram / norms[:, None] / norms, atol=1e-12)
    # of a column that nearly depends on those before it, the rest is known to the rounding errors of the whole column
    np.testing.assert_allclose(there.root / norms, whole.root / norms, rtol=0, atol=1e-15 * whole.condition)


def test_a_worker_killed_in_the_middle_changes_no_digit(record, two_processes, client, tmp_path):
    """The fifth partition kills the process that computes it, once; what that worker had done is done again."""
    e = record.experiments[0]
    flag = tmp_path / "killed"

    def deadly(block, path=str(flag), block_info=None):
        import os
        import signal
        import time

        time.sleep(0.05)
        if block_info[0]["chunk-location"][0] == 5:
            try:
                os.close(os.open(path, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return block
            os.kill(os.getpid(), signal.SIGKILL)
        return block

    plain = da.from_array(np.hstack([e.u, e.y]), chunks=(311, 2))
    here = optid.fit(optid.open_stream(plain, columns=["u", "y"], dt=0.1), **STRUCTURE)
    stream = optid.open_stream(plain.map_blocks(deadly, dtype=float), columns=["u", "y"], dt=0.1, scheduler=client)
    there = optid.fit(stream, **STRUCTURE)
    assert flag.exists()
    np.testing.assert_array_equal(digits(there), digits(here))


def test_a_partition_that_kills_every_worker_is_an_error_in_words(two_processes, client, monkeypatch):
    monkeypatch.setattr(two_processes.scheduler, "allowed_failures", 0)

    def deadly(block):
        import os
        import signal

        os.kill(os.getpid(), signal.SIGKILL)

    array = da.zeros((100, 2), chunks=(50, 2)).map_blocks(deadly, meta=np.zeros((1, 2)))
    with pytest.raises(ClusterError, match="1 worker died over the same task.*memory"):
        optid.open_stream(array, columns=["u", "y"], scheduler=client).ranges()


def test_errors_of_the_record_come_back_as_they_are(record, folders, client):
    stream = optid.open_stream(folders, scheduler=client)
    (folders[1] / "part.7.parquet").unlink()
    refuses(DataError, "machine .* cannot read .*part.7.parquet.*every worker sees", optid.fit, stream, **STRUCTURE)
    frame = frame_of(record.experiments[0]).assign(u=np.nan)
    with pytest.raises(DataError, match="channel 'u': every sample is missing"):
        optid.fit(optid.open_stream(dd.from_pandas(frame, npartitions=3, sort=False), scheduler=client), **STRUCTURE)
    short = dd.from_pandas(frame_of(record.experiments[0]).iloc[:3], npartitions=2, sort=False)
    with pytest.raises(RankError, match="3 samples, but the lags reach back 4"):
        optid.fit(optid.open_stream(short, scheduler=client), na=4, nb=1, basis="triangular:2")


def refused(scheduler):
    with pytest.raises(ClusterError) as caught, connect_cluster(scheduler):
        pass
    return str(caught.value)


@pytest.fixture
def closed_port():
    """A port where nothing listens, and that nobody else takes meanwhile."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield taken.getsockname()[1]


def test_a_scheduler_that_cannot_be_reached_is_said_to_be_one_quickly(tmp_path, closed_port):
    started = time.monotonic()
    assert "no scheduler can be reached at tcp://127.0.0.1" in refused(f"tcp://127.0.0.1:{closed_port}")
    assert time.monotonic() - started < 10  # a Client alone tries for 30 s
    with pytest.raises(ClusterError, match="no scheduler can be reached"):
        optid.open_stream(da.zeros((100, 2)), columns=["u", "y"], scheduler=f"127.0.0.1:{closed_port}")
    (tmp_path / "scheduler.json").write_text(json.dumps({"address": f"tcp://127.0.0.1:{closed_port}"}))
    assert "no scheduler can be reached" in refused(tmp_path / "scheduler.json")


def test_a_machine_that_nobody_knows_cannot_be_reached(monkeypatch):
    def unknown(host, *rest, real=socket.getaddrinfo, **more):
        if host == "nowhere.invalid":
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return real(host, *rest, **more)

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    words = refused("nowhere.invalid:8786")
    assert "no scheduler can be reached at tcp://nowhere.invalid:8786 (Name or service not known)" in words


def test_what_is_no_address_of_a_scheduler_is_refused(tmp_path):
    for text in ("somewhere", "tcp://127.0.0.1", "http://127.0.0.1:8787", "tcp://127.0.0.1:port"):
        assert "write tcp://host:8786" in refused(text)
    assert "scheduler=8786: give an address" in refused(8786)
    assert "not the scheduler file" in refused(tmp_path / "scheduler.json")


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH\r\n"])
def test_a_server_of_another_kind_is_no_scheduler(monkeypatch, greeting):
    monkeypatch.setattr(clusters, "ANSWER", 0.5)
    done = threading.Event()

    def greet():
        connection, _ = server.accept()
        with connection:
            connection.sendall(greeting)
            done.wait()

    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(60.0)
        thread = threading.Thread(target=greet)
        thread.start()
        try:
            assert "is no Dask scheduler" in refused(f"127.0.0.1:{server.getsockname()[1]}")
        finally:
            done.set()
            thread.join()


def test_a_client_that_does_not_run_is_refused(two_processes):
    client = distributed.Client(two_processes, set_as_default=False)
    client.close()
    assert "the Client is closed" in refused(client)


def test_a_scheduler_without_workers_is_refused():
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        assert "has no worker yet: start some (dask worker tcp://" in refused(empty.scheduler_address)


def test_workers_with_other_versions_are_refused_with_the_difference(client, monkeypatch):
    check_workers(client, ["optid", "numpy", "scipy", "cvxpy", "clarabel"])
    here = clusters._reader(["numpy"])()
    assert here["numpy"] == np.__version__ and here["python"] == "{}.{}".format(*sys.version_info)
    assert len(here["source files of optid"]) == 12
    real = clusters._reader

    def other(packages):
        read = real(packages)

        def pretending():
            import multiprocessing

            found = read()
            if multiprocessing.parent_process() is None:  # only here
                found |= {"clarabel": "0.1.0", "numpy": "1.0"}
            return found

        return pretending

    monkeypatch.setattr(clusters, "_reader", other)
    with pytest.raises(ClusterError, match=r"worker tcp://.*2 of 2 workers.*clarabel: 0.1.0 here, .* there"):
        check_workers(client, ["numpy", "clarabel"])


def test_a_real_worker_with_another_solver_is_refused(tmp_path):
    """A worker process that finds another clarabel first, as on a machine that was not updated."""
    info = tmp_path / "clarabel-0.0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: clarabel\nVersion: 0.0.1\n")
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty:
        command = [sys.executable, "-m", "dask", "worker", empty.scheduler_address, "--no-nanny", "--nthreads", "1",
                   "--dashboard-address", ":0", "--local-directory", str(tmp_path)]
        worker = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(tmp_path)}, stderr=subprocess.DEVNULL)
        try:
            with distributed.Client(empty, set_as_default=False) as client:
                client.wait_for_workers(1, timeout=600)
                with pytest.raises(ClusterError, match=r"worker \S+ has other packages: clarabel: \S+ here, 0.0.1"):
                    check_workers(client, ["optid", "numpy", "clarabel"])
                check_workers(client, ["optid", "numpy"])
        finally:
            worker.kill()
            worker.wait()


def test_the_versions_of_a_process_without_optid_can_be_read(tmp_path):
    """The function travels by value: it must need nothing of optid."""
    import cloudpickle

    (tmp_path / "read.pickle").write_bytes(cloudpickle.dumps(clusters._reader(["optid", "nix"])))
    code = "import pickle, sys; sys.modules['optid'] = None; print(sorted(pickle.load(open('read.pickle', 'rb'))()))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "nix" in done.stdout, done.stderr
    assert clusters._reader(["nix"])()["nix"] == "not installed"
