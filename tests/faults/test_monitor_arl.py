"""Run lengths: the CUSUM table, simulated charts, and thresholds that keep the time between false alarms asked for."""

import numpy as np
import pytest
from fault_plants import levels
from test_monitor import everything, plant

from optid.errors import DataError, StructureError
from optid.faults import Monitor, cusum_arl, dictionary, inject
from optid.faults.false_alarms import Calibration, equalised, tail


@pytest.mark.parametrize("shift, arl", [(0.0, 465.4), (0.5, 38.0), (1.0, 10.38), (2.0, 4.01)])
def test_the_table_of_run_lengths(shift, arl):
    assert cusum_arl(shift) == pytest.approx(arl, rel=1e-2)


def test_run_lengths_against_simulated_charts():
    rng = np.random.default_rng(0)
    sums, steps, ends = np.zeros(4000), 0, []
    while sums.size:
        sums = np.maximum(0, sums + rng.standard_normal(sums.size) + 0.3 - 0.4)
        steps += 1
        ends += [steps] * int(np.sum(sums > 2.5))
        sums = sums[sums <= 2.5]
    found = cusum_arl(0.3, 0.4, 2.5, two_sided=False)
    assert np.mean(ends) == pytest.approx(found, abs=4 * np.std(ends) / np.sqrt(len(ends)))
    assert cusum_arl(0.0, two_sided=False) == pytest.approx(2 * cusum_arl(0.0), rel=1e-12)
    with pytest.raises(StructureError, match="h=0"):
        cusum_arl(0.0, h=0)


def test_equalised_thresholds_have_the_rate_asked_for():
    rng = np.random.default_rng(1)
    blocks = rng.chisquare([1, 1, 4], (200_000, 3))
    q, alarms = equalised(blocks, 50, 20_000.0)
    assert alarms / len(blocks) == pytest.approx(50 / 20_000, rel=0.02)
    single = [np.mean(column > value) for column, value in zip(blocks.T, q)]
    assert single == pytest.approx([50 / 20_000 / 3] * 3, rel=0.05)
    assert tail(blocks[:, 0], 1e-4) == pytest.approx(15.14, rel=0.05)  # chi2 with one degree of freedom
    frequent, _ = equalised(blocks, 50, 150.0)  # where alarms in neighbouring blocks are common
    assert np.mean(np.any(blocks > frequent, axis=1)) == pytest.approx(1 - np.exp(-50 / 150), rel=0.02)


def test_realised_time_between_false_alarms():
    model = plant()
    found = dictionary(model, kinds=["bias"], sensors="all", actuators="all")
    asked, ends = 500.0, []
    for seed in range(120):
        monitor = Monitor(model, found, arl0=asked, window=40, samples=150_000, x0="zero")
        u = levels(6000, seed + 1000)
        events = monitor.run(u, inject(model, u, seed=seed + 1000))
        ends.append(next(e.sample + 1 for e in events if e.kind == "alarm"))
    assert np.mean(ends) == pytest.approx(asked, abs=4 * np.std(ends) / np.sqrt(len(ends)))
    assert 0.7 < np.mean(ends) / asked < 1.35


def test_a_calibration_is_kept_and_travels():
    model = plant()
    found = everything(model)
    first = Monitor(model, found, arl0=400, window=30, samples=40_000)
    assert Monitor(model, found, arl0=400, window=30, samples=40_000).calibration is first.calibration
    other = Monitor(model, found, arl0=400, window=30, samples=40_000, seed=1)
    assert other.calibration.q == pytest.approx(first.calibration.q, rel=0.12)
    assert not np.array_equal(other.calibration.q, first.calibration.q)
    copy = Calibration.from_dict(first.calibration.to_dict())
    again = Monitor(model, found, thresholds=copy, window=30)
    assert np.array_equal(again.calibration.q, first.calibration.q) and again.calibration.arl0 == 400
    with pytest.raises(StructureError, match="in a window of 30"):
        Monitor(model, found, thresholds=copy, window=31)
    assert max(len(line) for line in str(copy).splitlines()) <= 80


def test_a_simulation_that_is_too_short_is_refused_or_marked():
    model = plant()
    found = dictionary(model)
    with pytest.raises(DataError, match="cannot support a false alarm every 1e\\+09"):
        Monitor(model, found, arl0=1e9, samples=100_000)
    with pytest.raises(StructureError, match="arl0=10"):
        Monitor(model, found, arl0=10)
    marked = Monitor(model, found, arl0=20_000, samples=100_000, window=30, extrapolate=True).calibration
    assert marked.extrapolated and "extrapolated" in str(marked)
    short = Monitor(model, found, arl0=1000, samples=100_000, window=30).calibration
    assert not short.extrapolated and np.all(marked.q > short.q)
