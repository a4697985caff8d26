"""Faults in real records and in the process simulators of the literature: the headline claims of two benchmarks."""

import warnings

import numpy as np
import pytest
import scripts

from optid.errors import DataWarning
from optid.faults import Monitor, health, model_uncertainty, whiten

tanks = scripts.benchmark("faults.three_tank")
process = scripts.benchmark("faults.tennessee")


@pytest.fixture(scope="module")
def watch(real_data):
    """What the three tanks teach from two healthy runs: candidates, thresholds, uncertainty, and all runs."""
    stored = tanks.runs(real_data)
    own = tanks.record(*stored["normal"][:2])
    with warnings.catch_warnings(action="ignore", category=DataWarning):  # no optimum; faults alike
        model = tanks.fitted(own, block_rows=4, iterations=5)
        found = tanks.possible(model)
    monitor = Monitor(model, found, arl0=tanks.ARL0, window=tanks.WINDOW, samples=40_000, extrapolate=True)
    return found, monitor.calibration, model_uncertainty(model, own), stored


def test_three_tanks_identified_in_closed_loop_leave_white_innovations_on_other_runs(watch):
    found, _, _, stored = watch
    others = health(whiten(found.model, tanks.record(*stored["normal"][4:])))
    assert others.white and others.scaled
    # the flow of a pump over the area of its tank
    gains = tanks.AREA * found.model.C @ found.model.B
    np.testing.assert_allclose(gains, np.eye(3, 2), atol=0.3)


def test_three_tanks_raise_no_alarm_when_healthy(watch):
    found, thresholds, _, stored = watch
    for table in stored["normal"][4:]:
        assert [e for e in tanks.watched(found, table, thresholds) if e.kind == "alarm"] == []


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", tanks.FAULTS)
def test_three_tanks_alarm_after_the_onset_and_name_the_part_in_a_small_set(watch, name):
    found, thresholds, uncertainty, stored = watch
    answer = tanks.answered(found, stored[name], thresholds, uncertainty)
    assert answer.alarm is not None and tanks.ONSET <= answer.alarm < tanks.ONSET + 250
    assert len(answer.parts) <= 3 and tanks.FAULTS[name][1] & set(answer.parts)


@pytest.fixture(scope="module")
def plant(real_data):
    """The detector of the Tennessee Eastman process, the records, and principal components beside it."""
    stored = process.tables(real_data)
    return process.detector(stored, 3), stored, process.components(stored)


def test_principal_components_agree_with_the_published_rates(plant):
    _, _, pca = plant
    for name, published in {"d04": (0.942, 0.034), "d05": (0.771, 0.742)}.items():
        missed = np.mean(pca[f"{name}_te"][process.ONSET :] <= 1, axis=0)
        np.testing.assert_allclose(missed, published, atol=2e-3)


@pytest.mark.parametrize("name", process.COOLING)
def test_tennessee_misses_no_more_than_principal_components_and_names_the_valve(plant, name):
    detector, stored, pca = plant
    assert detector.share <= process.FALSE_ALARM
    result = process.judged(detector.along(stored[f"{name}_te"]), detector)
    assert result.missed <= np.mean(pca[f"{name}_te"][process.ONSET :] <= 1, axis=0).min()
    assert result.early < 0.03
    assert result.accused[0][0] == f"actuator:{process.COOLING[name]}" and result.accused[0][1] > 0.9
