"""A function in a fresh interpreter: what it returns and raises, and its death, time and memory as outcomes."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import psutil
import pytest
from problems import BASIS, record
from processes import gone, wait_for
from tasks import (
    LOCK,
    abort,
    anonymous,
    anything,
    awkward,
    die,
    held,
    locked,
    map_to_list,
    negative,
    refuse,
    sleep,
    surroundings,
)

import optid
from optid import processes
from optid.data.readers import read
from optid.data.reading import matlab
from optid.errors import DataError, StructureError
from optid.packing import Absent, Unsendable, pack
from optid.processes import run_apart

FITS = 50


@pytest.fixture
def ended():
    """Whether this process has no child but those that rest and those that others left to it before."""
    before = {child.pid for child in psutil.Process().children()}

    def ended():
        allowed = before | {worker._process.pid for worker in processes._resting[os.getpid()]}
        return not [c for c in psutil.Process().children() if c.pid not in allowed and not gone(c.pid)]

    return ended


def test_results_and_exceptions_come_back():
    assert run_apart(os.getpid) != os.getpid()
    np.testing.assert_array_equal(run_apart(np.arange, 1_000_000), np.arange(1_000_000))
    with pytest.raises(StructureError, match="not this one"):
        run_apart(refuse, "not this one")
    with pytest.raises(RuntimeError, match="Awkward: left right"):  # its pickle cannot be read
        run_apart(awkward)


def test_a_process_is_used_again_and_none_after_a_failure():
    first = run_apart(os.getpid)
    assert run_apart(os.getpid) == first
    with pytest.raises(StructureError):
        run_apart(refuse, "no")
    assert gone(first) and run_apart(os.getpid) != first


def test_a_death_is_told_with_its_signal_or_code():
    with pytest.raises(ChildProcessError, match="signal SIGSEGV"):
        run_apart(die, signal.SIGSEGV)
    with pytest.raises(ChildProcessError, match="exit code 3"):
        run_apart(os._exit, 3)


def test_what_cannot_travel_is_named_with_the_remedy():
    with pytest.raises(RuntimeError, match="cannot be sent"):
        run_apart(anonymous)
    with pytest.raises(Unsendable, match="anonymous.<locals>.<lambda> cannot be sent to another process: define it in"):
        run_apart(anonymous())
    with pytest.raises(Unsendable, match="cannot be sent.*lock"):
        run_apart(len, [threading.Lock()])
    with pytest.raises(Unsendable, match="nested too deeply"):
        deep = []
        for _ in range(100_000):
            deep = [deep]
        pack(deep)


def test_a_module_that_only_this_process_knows_is_named(monkeypatch):
    module = type(os)("only_here")
    exec("def f(): return 1", module.__dict__)
    monkeypatch.setitem(sys.modules, "only_here", module)
    with pytest.raises(Unsendable, match="No module named 'only_here'; define it in a module that can be imported"):
        run_apart(module.f)


def test_what_is_not_used_may_stay_here():
    assert run_apart(len, [anonymous()], lenient=True) == 1
    with pytest.raises(Unsendable, match="<lambda> cannot be sent"):
        run_apart(map_to_list, anonymous(), lenient=True)
    assert isinstance(run_apart(anything, anonymous(), lenient=True), Absent)


def test_a_process_is_killed_after_its_time(ended):
    clock = time.monotonic()
    with pytest.raises(TimeoutError):
        run_apart(time.sleep, 60, seconds=0.2)
    assert time.monotonic() - clock < 10 and ended()


def test_importing_takes_nothing_of_the_time(tmp_path, monkeypatch):
    (tmp_path / "takes_a_second.py").write_text("import time\ntime.sleep(1.0)\ndef f(): return 7\n")
    monkeypatch.syspath_prepend(tmp_path)
    import takes_a_second  # pyright: ignore[reportMissingImports]

    assert run_apart(takes_a_second.f, seconds=0.5) == 7


def test_a_module_that_was_edited_is_imported_again(tmp_path, monkeypatch):
    path = tmp_path / "edited.py"
    path.write_text("def f(): return 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    import edited  # pyright: ignore[reportMissingImports]

    first = run_apart(os.getpid)
    assert run_apart(edited.f) == 1 and run_apart(os.getpid) == first
    path.write_text("def f(): return 22\n")
    assert run_apart(edited.f) == 22


def test_paths_folder_and_environment_are_those_of_this_moment(tmp_path, monkeypatch):
    run_apart(os.getpid)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPTID_TEST", "here")
    assert run_apart(surroundings) == (str(tmp_path), sys.path, "here")


def test_memory_is_refused_beyond_the_limit():
    with pytest.raises(MemoryError):
        run_apart(held, 1 << 30, memory=1 << 28)
    assert run_apart(held, 1 << 20, memory=1 << 28) == 1 << 20
    assert run_apart(held, 1 << 29) == 1 << 29  # the limit was for the call before
    assert held(1 << 20) == 1 << 20  # this process has no limit


def test_what_a_quiet_process_writes_is_dropped(capfd):
    run_apart(os.write, 1, b"loud")
    run_apart(os.write, 2, b"silent", quiet=True)
    run_apart(print, " silent", quiet=True)
    run_apart(print, " and clear")
    assert capfd.readouterr() == ("loud and clear\n", "")


def test_a_lock_that_a_thread_holds_stops_no_process(monkeypatch):
    monkeypatch.setattr(os, "fork", None)
    with LOCK:
        assert run_apart(locked, 3, seconds=60) == 3


def test_no_descriptor_and_no_process_is_left(ended):
    def open_files():
        return psutil.Process().num_fds()

    run_apart(os.getpid)
    before = open_files()
    for _ in range(5):
        with pytest.raises(ChildProcessError):
            run_apart(os._exit, 0)
        with pytest.raises(TimeoutError):
            run_apart(time.sleep, 60, seconds=0.01)
    run_apart(os.getpid)
    assert open_files() == before and ended()


def script(tmp_path, lines, **settings):
    """Start a script whose module `work` is importable."""
    (tmp_path / "work.py").write_text(textwrap.dedent("""
        import ctypes, os, sys, time
        def stay(path, hard):
            open(path, "w").write(str(os.getpid()))
            ctypes.PyDLL(None).sleep(600) if hard else time.sleep(600)
        def number():
            return os.getpid()
        """))
    (tmp_path / "main.py").write_text(textwrap.dedent(lines))
    return subprocess.Popen([sys.executable, str(tmp_path / "main.py")], cwd=tmp_path, **settings)


def number_in(path):
    wait_for(lambda: path.exists() and path.read_text())
    return int(path.read_text())


@pytest.mark.parametrize("hard", [False, pytest.param(True, marks=pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere only threads see that the parent is gone"))])
def test_a_process_ends_with_its_parent_that_is_killed(tmp_path, hard):
    parent = script(tmp_path, f"""
        import work
        from optid.processes import run_apart
        run_apart(work.stay, "pid", {hard})
        """)
    number = number_in(tmp_path / "pid")
    parent.kill()
    parent.wait()
    wait_for(lambda: gone(number), 30)


def test_an_interrupt_ends_the_process_and_only_the_parent_hears_it(tmp_path):
    parent = script(tmp_path, """
        import work
        from optid.processes import run_apart
        try:
            run_apart(work.stay, "pid", False)
        except KeyboardInterrupt:
            print("interrupted")
        """, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0)
    number = number_in(tmp_path / "pid")
    os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
    assert parent.communicate(timeout=60) == ("interrupted\n", "")
    assert gone(number)


@pytest.mark.parametrize("closed", [(0,), (1,), (2,), (0, 1), (0, 1, 2)])
def test_standard_streams_of_the_parent_may_be_closed(tmp_path, closed):
    parent = script(tmp_path, f"""
        import os, subprocess, sys
        if len(sys.argv) == 1:
            keeps = [os.dup(k) for k in {closed}]
            for k in {closed}:
                os.close(k)
            os.execv(sys.executable, [sys.executable, "main.py", "again"])
        import work
        from optid.processes import run_apart
        numbers = {{run_apart(work.number) for _ in range(3)}}
        open("numbers", "w").write(" ".join(map(str, numbers)))
        """)
    assert parent.wait(60) == 0
    assert len((tmp_path / "numbers").read_text().split()) == 1


def test_a_script_needs_no_guard_of_its_main_module(tmp_path):
    parent = script(tmp_path, """
        import os, work
        from optid.processes import run_apart
        print("once", run_apart(work.number) != os.getpid())
        """, stdout=subprocess.PIPE, text=True)
    assert parent.communicate(timeout=60)[0] == "once True\n"


def test_a_file_of_the_folder_hides_no_module(tmp_path):
    (tmp_path / "socket.py").write_text("raise SystemExit('the wrong socket')")
    found = subprocess.run([sys.executable, "-P", "-c", "import os\nfrom optid.processes import run_apart\n"
                            "print(run_apart(os.getcwd))"], cwd=tmp_path, capture_output=True, text=True)
    assert (found.stdout, found.stderr) == (f"{tmp_path}\n", "")


def test_a_process_forked_by_others_starts_its_own(tmp_path):
    parent = script(tmp_path, """
        import os, work
        from optid.processes import run_apart
        ours = run_apart(work.number)
        if os.fork() == 0:
            assert run_apart(work.number) != ours
            os._exit(7)
        code = os.waitstatus_to_exitcode(os.wait()[1])
        assert run_apart(work.number) == ours
        print(code)
        """, stdout=subprocess.PIPE, text=True)
    assert parent.communicate(timeout=60)[0] == "7\n"


def test_a_process_without_work_ends_after_a_while(tmp_path):
    parent = script(tmp_path, """
        import os, work
        from optid.processes import run_apart
        os.environ["PYTHONPATH"] = os.pathsep.join([os.getcwd(), os.environ.get("PYTHONPATH", "")])
        open("sitecustomize.py", "w").write("import optid.child; optid.child.IDLE = 0.2")
        print(run_apart(work.number), flush=True)
        input()
        print(run_apart(work.number), flush=True)
        """, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    first = int(parent.stdout.readline())
    wait_for(lambda: gone(first), 30)
    second = int(parent.communicate("\n", timeout=60)[0])
    assert second != first


@pytest.mark.parametrize("end, words", [("die", "crashed .signal SIGABRT"), ("sleep", "took more than 0.2 s")])
def test_a_mat_file_that_kills_its_reader_is_a_named_error(tmp_path, monkeypatch, end, words):
    (tmp_path / "r.mat").write_bytes(b"x" * 200)
    monkeypatch.setattr(matlab, "file_contents", {"die": abort, "sleep": sleep}[end])
    monkeypatch.setattr(matlab, "SECONDS", 0.2)
    with pytest.raises(DataError, match=f"r.mat is damaged, or not a MAT file: .*{words}"):
        read(tmp_path / "r.mat")


def test_a_daemon_may_read_mat_files(tmp_path):
    from scipy.io import savemat

    savemat(tmp_path / "r.mat", {"u": np.arange(9.0)[:, None], "y": np.ones((9, 1))})
    code = ("import multiprocessing, sys\nfrom optid.data.readers import read\n"
            "def f():\n assert read('r.mat').u.shape == (9, 1)\n"
            "one = multiprocessing.get_context('fork').Process(target=f, daemon=True)\n"
            "one.start(); one.join(); sys.exit(one.exitcode)")
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path).returncode == 0


def test_a_process_that_cannot_be_started_is_named(monkeypatch):
    def refuse(*arguments, **settings):
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setitem(processes._resting, os.getpid(), [])
    monkeypatch.setattr(subprocess, "Popen", refuse)
    with pytest.raises(ChildProcessError, match="no process can be started: Cannot allocate memory"):
        run_apart(len, "abc")


@pytest.mark.slow
def test_limited_fits_beside_fitting_threads_all_end():
    stop, results, errors = threading.Event(), [], []
    data = record()

    def fit(**limit):
        return optid.fit(data, "hammerstein_arx.exact", na=2, nb=2, basis=BASIS, constraints=[negative()], **limit)

    def go_on():
        try:
            while not stop.is_set():
                results.append(fit().solution.objective)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=go_on) for _ in range(4)]
    for thread in threads:
        thread.start()
    try:
        limited = [fit(time_limit=60.0).solution.objective for _ in range(FITS)]
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert not errors and np.ptp([*limited, *results]) <= 1e-9 * np.max(limited)
