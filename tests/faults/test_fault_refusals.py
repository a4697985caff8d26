"""Absurd options and damaged files of the faults: one sentence that names what is wrong; honest onsets of noise."""

import json

import numpy as np
import pytest
from commands import run
from fault_plants import levels
from test_fault_injection import small

from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.faults import Fault, diagnose, dictionary, inject, reformulate
from optid.models import NoiseCovariances


@pytest.mark.parametrize("name", ["Q", "R"])
def test_a_model_file_with_negative_variances_is_damaged(name, tmp_path):
    path = small().save(tmp_path / "model.json")
    content = json.loads(path.read_text())
    content["noise"][name][0][0] = -1.0
    path.write_text(json.dumps(content))
    result = run("isolability", path)
    assert result.exit_code == 2 and "negative variance" in result.output and "damaged" in result.output


def test_noise_of_innovations_is_a_covariance_though_singular():
    rng = np.random.default_rng(0)
    for _ in range(20):
        root = rng.standard_normal((3, 3)) * 10.0 ** rng.integers(-4, 4, 3)[:, None]
        NoiseCovariances.of_innovations(rng.standard_normal((5, 3)), root @ root.T)
    with pytest.raises(StructureError, match="innovation"):
        NoiseCovariances(np.eye(2), np.eye(2), np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]]))


@pytest.mark.slow
def test_the_onset_of_grown_noise_has_an_interval_that_holds_it():
    model, held = small(), 0
    found = dictionary(model, kinds=["bias", "noise"], state_jump=False)
    onsets = (70, 95, 113, 128)
    for seed, onset in enumerate(onsets):
        u = levels(200, seed)
        y = inject(model, u, [Fault.sensor_noise("sensor:y2", onset, scale=6)], seed=seed)
        answer = diagnose(model, (u, y), found)
        assert answer.verdict == "faulty" and answer.certificate.basis == "grid"
        (fault,) = answer.best.faults
        assert fault.kind == "noise" and abs(fault.onset - onset) < 15
        low, high = fault.onset_interval
        held += low - 2 <= onset <= high + 2
    assert held >= len(onsets) - 1


def test_a_record_that_stands_still_at_its_end_is_searched_for_noise():
    model, u = small(), levels(160, 3)
    y = np.array(inject(model, u, [], seed=3))
    y[80:] = y[79]
    answer = diagnose(model, (u, y), dictionary(model, kinds=["bias", "noise"], state_jump=False))
    assert answer.verdict == "faulty" and {fault.kind for fault in answer.best.faults} == {"frozen"}


@pytest.mark.slow
def test_two_faults_of_one_actuator_at_different_times_are_refitted():
    model, u = small(), levels(400, 6)
    y = inject(model, u, [Fault.loss("actuator:u1", 200, 0.6), Fault.step("actuator:u1", 240, 0.8)], seed=6)
    data = Data(u, y, model.dt, list(model.inputs), list(model.outputs))
    answer = diagnose(model, data, dictionary(model, kinds=["bias", "loss"]), max_faults=2)
    assert answer.verdict == "faulty" and len(answer.best.faults) == 2
    damaged = reformulate(model, answer, data).model
    same = reformulate(model, answer, (u, y)).model
    np.testing.assert_array_equal(same.B, damaged.B)
    np.testing.assert_array_equal(same.offset_x, damaged.offset_x)
    after = Data(u[240:], y[240:], model.dt, list(model.inputs), list(model.outputs))

    def squares(m):
        return float(np.nansum((m.predict(after) - y[240:]) ** 2))

    assert squares(damaged) < 0.9 * squares(model)


def test_what_is_left_names_the_test_behind_its_p_value_and_standing_readings_are_no_readings():
    model, u = small(), levels(160, 7)
    y = np.array(inject(model, u, [Fault.step("sensor:y1", 80, 2.0)], seed=7))
    answer = diagnose(model, (u, y))
    assert f"the worst of four tests ({answer.remaining.test})" in " ".join(str(answer).split())
    with pytest.raises(DataError, match="flat lines do not count"):
        diagnose(model, (u, np.zeros_like(y)))
