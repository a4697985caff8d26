"""Linear algebra of fits and of workers runs with one thread, and the caller's number of threads comes back."""

import os

import numpy as np
import pytest
import scipy.linalg  # noqa: F401
from refusals import refuses
from threadpoolctl import threadpool_info, threadpool_limits

import optid
from optid.processes import run_apart
from optid.threads import THREADS, one_thread


def threads() -> set[int]:
    """Those of the libraries of NumPy and SciPy, which are loaded; solvers may load their own at any time."""
    return {one["num_threads"] for one in threadpool_info()
            if os.path.basename(os.path.dirname(one["filepath"])) in ("numpy.libs", "scipy.libs")}


pytestmark = pytest.mark.skipif(not threads(), reason="the libraries of NumPy and SciPy are not those of their wheels")


def test_a_function_runs_with_one_thread_and_those_of_the_caller_come_back():
    with threadpool_limits(3):
        assert one_thread(threads)() == {1}
        assert threads() == {3}


def test_a_fit_that_fails_leaves_the_threads_of_the_caller():
    def pose(data, **_):
        assert threads() == {1}
        raise optid.errors.RankError("as asked")

    u = np.random.default_rng(0).normal(size=50)
    with threadpool_limits(3):
        refuses(optid.errors.RankError, "as asked", lambda: optid.fit(optid.Data(u, u), pose))
        assert threads() == {3}


def test_other_processes_have_one_thread_unless_the_caller_asks_for_more(monkeypatch):
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    assert run_apart(threads) == {1}
    assert run_apart(environment) == {**dict.fromkeys(THREADS, "1"), "NUMBA_NUM_THREADS": "2"}


def environment() -> dict[str, str | None]:
    return {name: os.environ.get(name) for name in THREADS}
