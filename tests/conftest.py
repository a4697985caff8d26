"""Shared test set-up: deterministic property tests, the folder with real data, a Dask cluster."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded: threads of workers compete

from collections import Counter
from pathlib import Path

import matplotlib
import pytest
from hypothesis import HealthCheck, settings

from optid.show import sections

matplotlib.use("Agg")
sections.CAUGHT = ()  # a part of a document that fails is a defect: it must not hide behind the note in its place
settings.register_profile("optid", derandomize=True, deadline=None, max_examples=25,
                          suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("optid")

# marks of modules, and of the folders that end in a stroke
CORE = """bases certificate cli data fitting infeasibility models prices rank_one readers readme registry regressors
report solving study_database validation""".split()
NUMERICAL = """solving/ formulations/ fault_pairs fault_profile fault_scan fault_signature fitting readme
uncertainty""".split()
SLOW = """workbench/ clusters diagnosis encoding fault_alternatives fault_scan hard_over isolability monitor
monitor_arl monitor_cli monitor_stops physical processes random_commands real_faults reformulation solver_fallback
state_shooting study_cli study_description study_examples study_running study_third_party study_verdict_figures
study_workers""".split()


def pytest_collection_modifyitems(items):
    """Mark tests by folder, module and fixture; of a test that is `sampled(n)` all but the first n are slow."""
    seen = Counter()
    for item in items:
        places = {f"{item.path.parent.name}/", item.path.stem.removeprefix("test_")}
        for mark, marked in {"core": CORE, "numerical": NUMERICAL, "slow": SLOW}.items():
            if places & set(marked):
                item.add_marker(mark)
        function = f"{item.path}::{item.originalname}"
        seen[function] += 1
        sample = item.get_closest_marker("sampled")
        if {"browser", "two_processes"} & set(item.fixturenames) or sample and seen[function] > sample.args[0]:
            item.add_marker("slow")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real records, named by OPTID_DATA; skips with the reason where there is none."""
    folder = os.environ.get("OPTID_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("real data: set OPTID_DATA to the folder that holds the records")
    return Path(folder)


@pytest.fixture(scope="module")
def two_processes():
    """A Dask cluster of two processes."""
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    patient = {"distributed.deploy.lost-worker-timeout": "600s"}  # else one that starts slowly is given up
    with (dask.config.set(patient),
          distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster):
        yield cluster


@pytest.fixture
def client(two_processes):
    """A client of that cluster, when all its workers are there."""
    distributed = pytest.importorskip("distributed")
    with distributed.Client(two_processes, set_as_default=False) as one:
        one.wait_for_workers(2, timeout=600)  # the nanny replaces those that the test before killed
        yield one
