"""Shared test set-up: deterministic property tests and the folder with real data."""

import os
from pathlib import Path

import matplotlib
import pytest
from hypothesis import HealthCheck, settings

matplotlib.use("Agg")
settings.register_profile("optid", derandomize=True, deadline=None, max_examples=25,
                          suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("optid")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real records, named by OPTID_DATA; skips with the reason where there is none."""
    folder = os.environ.get("OPTID_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("real data: set OPTID_DATA to the folder that holds the records")
    return Path(folder)
