"""Records that are wrong before any statistics."""

import numpy as np
import pytest
from fault_plants import levels
from test_fault_injection import small

from optid import Data
from optid.errors import DataError
from optid.faults import Fault, check_channels, flat_lines, inject
from optid.faults.readings import SensorChecks, lost_readings


@pytest.fixture(scope="module")
def record():
    model, u = small(), levels(200, 0)
    return model, u, inject(model, u)


def test_a_frozen_sensor_is_a_flat_line(record):
    model, u, y = record
    assert flat_lines(Data(u, y)) == ()
    frozen = inject(model, u, Fault.frozen("sensor:y2", 80, end=120))
    (line,) = flat_lines(Data(u, frozen))
    assert (line.name, line.first, line.count, line.value) == ("sensor:y2", 79, 41, frozen[79, 1])
    assert "sensor:y2: 41 readings" in str(line) and "sample 79" in str(line)
    frozen[100, 1] = np.nan
    assert [(f.first, f.count) for f in flat_lines(Data(u, frozen))] == [(79, 40)]


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e5])
def test_a_saturated_sensor_returns_to_its_limit(record, unit):
    """A frozen one keeps the reading that it had, which is the limit of nothing."""
    _, u, y = record
    u, y = np.vstack([u] * 3), unit * np.vstack([y + 0.001 * k for k in range(3)])
    for sign in (1, -1):
        limit = np.quantile(sign * y[:, 1], 0.8)
        clipped = np.column_stack([y[:, 0], sign * np.minimum(sign * y[:, 1], limit)])
        lines = lost_readings(clipped, ("y1", "y2"))
        assert {(one.name, one.condition, one.value) for one in lines} == {("sensor:y2", "saturated", sign * limit)}
        assert all(one.count >= 5 and "again and again" in str(one) for one in lines) and len(lines) > 1
        assert all(np.all(clipped[one.first : one.first + one.count, 1] == sign * limit) for one in lines)
        streamed, (checks, parts) = [], (SensorChecks(2), np.array_split(clipped, 17))
        for first, part in zip(np.cumsum([0, *map(len, parts)]), parts):
            streamed += checks.screen(part, np.zeros(len(part), dtype=bool), int(first))[2]
        assert [one.onset for one in streamed if not one.ended] == [one.first for one in lines]
        assert [one.condition for one in streamed if not one.ended][1:] == ["saturated"] * (len(lines) - 1)


@pytest.mark.parametrize("gap", [0, 3, 12, 59])
def test_a_sensor_that_is_read_now_and_then_is_not_dead(record, gap):
    _, u, y = record
    y = np.vstack([y] * 4).copy()
    y[np.arange(len(y)) % (gap + 1) != 0, 0] = np.nan
    assert lost_readings(y, ("y1", "y2")) == ()
    y[500:, 0] = np.nan
    (line,) = lost_readings(y, ("y1", "y2"), 2)
    assert (line.name, line.condition, line.experiment) == ("sensor:y1", "dead", 2)
    assert line.first == 500 - (500 - 1) % (gap + 1) and line.count == 800 - line.first
    y[700:, 0] = 1.0 + np.arange(100)
    assert len(lost_readings(y, ("y1", "y2"))) == 1  # also when it comes back


def test_three_equal_readings_are_enough_where_no_other_is_repeated(record):
    _, u, y = record
    y = y.copy()
    y[100:103, 1] = y[100, 1]
    (line,) = flat_lines(Data(u, y))
    assert (line.name, line.condition, line.first, line.count) == ("sensor:y2", "frozen", 100, 3)
    y[40:42, 1] = y[40, 1]
    assert flat_lines(Data(u, y)) == ()


def test_a_constant_channel_is_a_finding_and_no_crash(record):
    _, u, y = record
    constant = np.column_stack([np.full(200, 1.5), y[:, 1]])
    (line,) = flat_lines(Data([u, u], [y, constant]))
    assert (line.experiment, line.first, line.count) == (1, 0, 200)


def test_a_coarse_sensor_is_not_a_flat_line(record):
    _, u, y = record
    assert flat_lines(Data(u, np.round(y))) == ()
    rising = np.round(np.column_stack([np.arange(200) / 7, -np.arange(200) / 9]))  # each reading is an extreme
    assert flat_lines(Data(u, rising)) == ()


@pytest.mark.parametrize(("spoil", "named"), [
    (lambda u, y: (u, y[:, ::-1]), "outputs y1, y2 look swapped"),
    (lambda u, y: (u[:, ::-1], y), "inputs u1, u2 look swapped"),
    (lambda u, y: (u * [1.0, 25.4], y), "'u2' .* divided by 25.4")])
def test_swapped_channels_and_inputs_in_another_unit_are_named(record, spoil, named):
    model, u, y = record
    check_channels(model, Data(u, y))
    with pytest.raises(DataError, match=named):
        check_channels(model, Data(*spoil(u, y)))


def test_a_change_of_the_unit_is_named_with_its_sample(record):
    model, u, y = record
    other = y.copy()
    other[120:, 1] *= 1000
    with pytest.raises(DataError, match=r"'y2' seems to change at sample 120: .* divided by 1000"):
        check_channels(model, Data(u, other))
    with pytest.raises(DataError, match="experiment 2: .*'y2'"):
        check_channels(model, Data([u, u], [y, other]))


def test_a_fault_is_no_swap_and_no_unit(record):
    model, u, _ = record
    for fault in (Fault.step("sensor:y1", 100, 3.0), Fault.hard_over("actuator:u1", 100),
                  Fault.frozen("sensor:y2", 90)):
        check_channels(model, Data(u, inject(model, u, fault)))
