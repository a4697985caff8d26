"""A function in a forked child: what it returns and raises, and its death, its time and its memory as outcomes."""

import faulthandler
import multiprocessing
import os
import signal
import time

import numpy as np
import pytest

from optid.data.readers import read
from optid.data.reading import matlab
from optid.errors import DataError, StructureError
from optid.processes import run_forked


def die(number):
    faulthandler.disable()  # the test runner would print the stack of a death that is intended
    os.kill(os.getpid(), number)


def held(count):
    return np.ones(count, dtype=np.uint8).size


def refuse(text):
    raise StructureError(text)


def test_results_and_exceptions_come_back():
    assert run_forked(os.getpid) != os.getpid()
    np.testing.assert_array_equal(run_forked(np.arange, 1_000_000), np.arange(1_000_000))
    with pytest.raises(StructureError, match="not this one"):
        run_forked(refuse, "not this one")


def test_a_death_is_told_with_its_signal_or_code():
    with pytest.raises(ChildProcessError, match="signal SIGSEGV"):
        run_forked(die, signal.SIGSEGV)
    with pytest.raises(ChildProcessError, match="exit code 3"):
        run_forked(os._exit, 3)


def test_an_answer_that_no_pickle_holds_is_named():
    with pytest.raises(RuntimeError, match="cannot be sent"):
        run_forked(lambda: (lambda: None))


def test_a_child_is_killed_after_its_time():
    clock = time.monotonic()
    with pytest.raises(TimeoutError):
        run_forked(time.sleep, 60, seconds=0.2)
    assert time.monotonic() - clock < 10
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)  # none is left


def test_memory_is_refused_beyond_the_limit():
    with pytest.raises(MemoryError):
        run_forked(held, 1 << 30, memory=1 << 28)
    assert run_forked(held, 1 << 20, memory=1 << 28) == 1 << 20
    assert held(1 << 20) == 1 << 20  # this process has no limit


def test_what_a_quiet_child_writes_is_dropped(capfd):
    run_forked(os.write, 1, b"loud")
    run_forked(os.write, 2, b"silent", quiet=True)
    assert capfd.readouterr() == ("loud", "")


def _in_daemon(sender, path):
    sender.send(read(path).u.shape)


def test_a_daemon_may_read_mat_files(tmp_path):
    from scipy.io import savemat

    savemat(tmp_path / "r.mat", {"u": np.arange(9.0)[:, None], "y": np.ones((9, 1))})
    receiver, sender = multiprocessing.Pipe(duplex=False)
    daemon = multiprocessing.get_context("fork").Process(target=_in_daemon, args=(sender, tmp_path / "r.mat"),
                                                         daemon=True)
    daemon.start()
    assert receiver.poll(60) and receiver.recv() == (9, 1)
    daemon.join()


@pytest.mark.parametrize("end, words", [(lambda *_: die(signal.SIGABRT), "crashed .signal SIGABRT"),
                                        (lambda *_: time.sleep(60), "took more than 0.2 s")])
def test_a_mat_file_that_kills_its_reader_is_a_named_error(tmp_path, monkeypatch, end, words):
    (tmp_path / "r.mat").write_bytes(b"x" * 200)
    monkeypatch.setattr(matlab, "_variables", end)
    monkeypatch.setattr(matlab, "SECONDS", 0.2)
    with pytest.raises(DataError, match=f"r.mat is damaged, or not a MAT file: .*{words}"):
        read(tmp_path / "r.mat")


def test_a_process_that_cannot_be_started_is_named(monkeypatch):
    def refuse():
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(os, "fork", refuse)
    with pytest.raises(ChildProcessError, match="no process can be started: Cannot allocate memory"):
        run_forked(len, "abc")
