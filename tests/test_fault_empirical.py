"""Thresholds from healthy records: they keep their rate where those of white innovations do not."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from fault_plants import levels, noisy, refused

from optid import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.faults import (
    Fault,
    Monitor,
    diagnose,
    dictionary,
    empirical_thresholds,
    inject,
    model_uncertainty,
    scan,
    sliding_scan,
    thresholds,
    whiten,
)

A = np.array([[0.8, 0.2, 0.0], [-0.2, 0.8, 0.1], [0.0, 0.0, 0.6]])
B = np.array([[1.0, 0.0], [0.3, 0.5], [0.0, 1.0]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
WINDOW = 25


def plant():
    return noisy(A, B, C, 0.01 * np.eye(3), 0.04 * np.eye(2))


def record(count, seed, colour=0.0, faults=()):
    """A record of the plant; its sensors drift slowly where there is colour, which the model does not know."""
    u = levels(count, seed)
    y = inject(plant(), u, faults, seed=seed)
    shocks = np.random.default_rng(seed + 1000).normal(0, 0.02 * colour, (count, 2))
    slow = np.zeros((count, 2))
    for k in range(1, count):
        slow[k] = 0.97 * slow[k - 1] + shocks[k]
    return Data(u, y + slow)


@pytest.fixture(scope="module")
def found():
    return dictionary(plant(), kinds=["bias"])


def test_white_innovations_need_no_factor_and_the_record_keeps_the_rate(found):
    white = whiten(found.model, record(12_000, 1))
    limits = empirical_thresholds(found, white, WINDOW, 0.02)
    assert 0.85 < limits.factor < 1.15
    assert limits.share == pytest.approx(0.02, abs=2e-3)
    assert limits.windows == 12_000 - WINDOW + 1 and limits.independent == 480
    np.testing.assert_allclose(limits.q, limits.factor * thresholds(found, WINDOW, 0.02).q)
    assert "excursions" in str(limits) and all(len(line) <= 80 for line in str(limits).splitlines())


def test_coloured_innovations_alarm_too_often_until_the_thresholds_come_from_a_healthy_record(found):
    healthy, later = (whiten(found.model, record(12_000, seed, 1.5)) for seed in (2, 3))
    course = sliding_scan(found, later, WINDOW)
    assert np.mean(course.alarms(thresholds(found, WINDOW, 0.02))) > 0.1
    limits = empirical_thresholds(found, healthy, WINDOW, 0.02)
    assert limits.factor > 1.3
    assert 0.005 < np.mean(course.alarms(limits)) < 0.045
    # a fault that is large enough is still found, and named
    faulty = whiten(found.model, record(400, 4, 1.5, [Fault.step("sensor:y2", 200, 1.5)]))
    course = sliding_scan(found, faulty, WINDOW)
    after = course.stops > 200 + WINDOW // 2
    assert course.alarms(limits)[after & (course.stops < 230)].all()
    named = course.accused(limits)[after & (course.stops <= 200 + WINDOW)]
    assert np.mean(named == found.labels.index("sensor:y2")) > 0.9


def test_several_records_count_together_and_a_short_one_gives_the_factor_of_more_frequent_alarms(found):
    parts = [whiten(found.model, record(3000, seed, 1.0)) for seed in range(5, 9)]
    whole = empirical_thresholds(found, parts, WINDOW, 0.02)
    assert whole.independent == 480 and not whole.extrapolated
    with pytest.raises(DataError, match="samples are required"):
        empirical_thresholds(found, parts[0], WINDOW, 1e-3)
    rare = empirical_thresholds(found, parts, WINDOW, 1e-3, extrapolate=True)
    assert rare.extrapolated and rare.factor == pytest.approx(whole.factor, rel=0.35)
    assert np.all(rare.q > whole.q)


def test_a_factor_that_rests_on_few_excursions_is_told(found):
    with pytest.warns(DataWarning, match="excursions of the healthy record"):
        empirical_thresholds(found, whiten(found.model, record(1300, 10, 6.0)), WINDOW, 0.02)


@pytest.mark.parametrize("gaps", [0.0, 0.04])
def test_sliding_search_is_the_search_of_every_window(gaps):
    model = plant()
    found = dictionary(model, kinds=["bias", "loss"])
    data = record(120, 11)
    y = np.where(np.random.default_rng(0).random(data.y.shape) < gaps, np.nan, data.y)
    data = Data(data.u, y)
    white = whiten(model, data)
    course = sliding_scan(found, white, WINDOW, u=data.u, hop=7)
    np.testing.assert_array_equal(course.stops, np.arange(WINDOW, 121, 7))
    there = [c.kind != "loss" or bool(c.columns) for c in found.candidates]  # gains of sensors are looked for elsewhere
    for stop, row in zip(course.stops, course.statistic):
        part = slice(stop - WINDOW, stop)
        one = replace(white, r=white.r[part], innovations=white.innovations[part], present=white.present[part])
        statistic = scan(found, one, data.u[part]).statistic[there]
        np.testing.assert_allclose(row[there], np.nanmax(statistic, axis=1), rtol=1e-9)
    without = sliding_scan(found, white, WINDOW, hop=7)
    losses = [label.endswith("loss") for label in found.labels]
    assert np.isnan(without.statistic[:, losses]).all()
    np.testing.assert_allclose(without.statistic[:, ~np.array(losses)], course.statistic[:, ~np.array(losses)])


def test_losses_are_calibrated_along_the_inputs_of_the_healthy_record():
    found = dictionary(plant(), kinds=["bias", "loss"])
    data = record(2600, 12, 1.0)
    limits = empirical_thresholds(found, whiten(found.model, data), WINDOW, 0.05, u=data.u, hop=5, draws=2000)
    there = [c.kind != "loss" or bool(c.columns) for c in found.candidates]  # gains of sensors are looked for elsewhere
    assert np.isfinite(limits.q[there]).all() and limits.factor > 1.2
    assert limits.share == pytest.approx(0.05, abs=0.01)


def test_diagnosis_takes_the_thresholds_of_a_healthy_record(found):
    limits = empirical_thresholds(found, whiten(found.model, record(8000, 13, 1.0)), 60, 0.02)
    quiet = [diagnose(found.model, record(60, seed, 1.0), found, thresholds=limits) for seed in range(14, 20)]
    assert sum(one.detected for one in quiet) <= 1
    answer = diagnose(found.model, record(60, 20, 1.0, [Fault.step("sensor:y1", 30, 2.0)]), found, thresholds=limits)
    assert answer.detected and any("sensor:y1" in e.label for one in answer.candidates for e in one.faults)


def test_refusals(found):
    data = record(200, 21)
    white = whiten(found.model, data)
    course, limits = sliding_scan(found, white, WINDOW), thresholds(found, 30, 0.05, draws=2000)
    uncertain = whiten(found.model, data, uncertainty=model_uncertainty(found.model, record(400, 22)))
    refused(
        (StructureError, "windows of 30 samples, not 25", lambda: course.alarms(limits)),
        (StructureError, "without uncertainty", lambda: sliding_scan(found, uncertain, WINDOW)),
        (DataError, "20 are needed", lambda: watching(found, arl0=3000, healthy=record(300, 40))),
        (DataError, "does not fit", lambda: sliding_scan(found, white, 201)),
        (StructureError, "hop must be a positive integer; got 0", lambda: sliding_scan(found, white, WINDOW, hop=0)),
        (DataError, "u has 150 samples; the record has 200",
         lambda: sliding_scan(found, white, WINDOW, u=data.u[:150])),
        (DataError, "u is of 1 experiments, the record of 2",
         lambda: empirical_thresholds(found, [white, white], WINDOW, 0.2, u=[data.u])),
    )


# -- monitors --------------------------------------------------------------------------------------------------------


def watching(found, **how):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # the noise of a coloured record is not what the model says
        return Monitor(found.model, found, window=WINDOW, **how)


@pytest.mark.slow
def test_a_monitor_keeps_its_rate_with_the_noise_of_a_healthy_record(found):
    plain = watching(found, arl0=3000)
    taught = watching(found, arl0=3000, healthy=record(12_000, 31, 1.5))
    assert "not white" in taught.remark or "times the predicted" in taught.remark
    other = record(12_400, 32, 1.5, [Fault.step("sensor:y1", 12_200, 2.0)])
    at = [[e.sample for e in monitor.run(other.u, other.y) if e.kind == "alarm"] for monitor in (plain, taught)]
    healthy = [sum(k < 12_200 for k in samples) for samples in at]
    assert healthy[0] > 15 and healthy[1] <= 8  # 4 are asked for
    assert any(12_200 <= k < 12_215 for k in at[1])


def test_a_healthy_record_of_the_noise_that_was_predicted_changes_little(found):
    plain, taught = (watching(found, arl0=3000, **how) for how in ({}, {"healthy": record(6000, 35)}))
    assert taught.remark == ""
    assert np.all(taught.calibration.q >= plain.calibration.q * 0.95)
    assert np.all(taught.calibration.q <= plain.calibration.q * 1.3)


def test_a_record_shorter_than_the_time_between_alarms_raises_the_thresholds_of_the_simulation(found):
    how = {"arl0": 40_000, "samples": 400_000, "extrapolate": True}
    plain = watching(found, **how)
    white, coloured = (watching(found, **how, healthy=one) for one in (record(6000, 35), record(6000, 36, 1.5)))
    assert white.calibration.extrapolated and coloured.calibration.arl0 == 40_000
    assert np.max(white.calibration.q / plain.calibration.q) < 1.25
    parts = Data.join(record(4000, 37, 1.5), record(2000, 38, 1.5))
    np.testing.assert_allclose(watching(found, **how, healthy=parts).calibration.q, coloured.calibration.q, rtol=0.4)


def test_a_monitor_of_losses_is_calibrated_along_the_inputs():
    found = dictionary(plant(), kinds=["bias", "loss"])
    plain, taught = (watching(found, arl0=500, **how) for how in ({}, {"healthy": record(2500, 39, 1.5)}))
    assert taught.calibration.labels == plain.labels
    other = record(6000, 41, 1.5)
    counts = [sum(e.kind == "alarm" for e in monitor.run(other.u, other.y)) for monitor in (plain, taught)]
    assert counts[1] <= 24 < counts[0], counts  # 12 are asked for
