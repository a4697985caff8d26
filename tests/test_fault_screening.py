"""Records that are wrong before any statistics."""

import numpy as np
import pytest
from fault_plants import levels
from test_fault_injection import small

from optid import Data
from optid.errors import DataError
from optid.faults import Fault, check_channels, flat_lines, inject


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
    assert [(f.first, f.count) for f in flat_lines(Data(u, frozen))] == [(79, 21), (101, 19)]


def test_a_constant_channel_is_a_finding_and_no_crash(record):
    _, u, y = record
    constant = np.column_stack([np.full(200, 1.5), y[:, 1]])
    (line,) = flat_lines(Data([u, u], [y, constant]))
    assert (line.experiment, line.first, line.count) == (1, 0, 200)


def test_a_coarse_sensor_is_not_a_flat_line(record):
    _, u, y = record
    assert flat_lines(Data(u, np.round(y))) == ()


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
