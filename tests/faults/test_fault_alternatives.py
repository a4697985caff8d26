"""Kinds by likelihood, sensors that lost a share, leaks of unknown direction, disturbances of any course."""

from dataclasses import replace

import numpy as np
import pytest
from fault_plants import levels, noisy, refused
from test_fault_injection import small

from optid import Data
from optid.bases import Linear, Polynomial
from optid.errors import DataError, LookupFailed, StructureError
from optid.faults import (
    Fault,
    Monitor,
    allocate,
    decouple,
    diagnose,
    dictionary,
    direction_of,
    inject,
    model_uncertainty,
    whiten,
)
from optid.faults.diagnosis.posterior import estimates
from optid.faults.diagnosis.records import record_of
from optid.faults.diagnosis.sensor_gains import SensorGain, sensor_gains
from optid.faults.nuisance import uncertain_start
from optid.faults.ranges import distance, known_range
from optid.models import Nonlinearity

COUNT = 160


def said(fault, *, kinds=("bias", "loss", "stuck"), seed=1, process=None, u=None, **how):
    model = small()
    u = levels(COUNT, 0) if u is None else u
    y = inject(model, u, fault, seed=seed, process=process)
    return diagnose(model, (u, y), dictionary(model, kinds=list(kinds), **how))


def test_a_sensor_that_lost_half_of_its_reading_is_named_with_its_share():
    answer = said(Fault.loss("sensor:y1", 80, 0.5), seed=0)
    assert answer.best.label == "sensor:y1 loss" and answer.unique
    low, high = answer.size_interval[0]
    assert low <= 0.5 <= high and high - low < 0.2
    assert answer.onset_interval[0] <= 80 <= answer.onset_interval[1]


def test_the_share_of_a_sensor_is_found_although_the_model_is_uncertain():
    # slow, far from zero: beside a wrong onset what the parameters do not know fits another share
    A, B = np.array([[0.96, 0.03], [0, 0.9]]), np.array([[0.3, 0], [0.1, 0.5]])
    model = replace(noisy(A, B, np.eye(2), 1e-3 * np.eye(2), 0.01 * np.eye(2)), offset_y=np.array([20.0, 0.0]))
    u = levels(1000, 3)
    known, u = model_uncertainty(model, Data(u, inject(model, u, seed=9, x0="rest"))), levels(200, 0)
    for onset in (57, 131):
        record = u, inject(model, u, Fault.loss("sensor:y1", onset, 0.5), seed=1)
        answer = diagnose(model, record, dictionary(model, kinds=["bias", "loss"]), model_uncertainty=known)
        assert answer.best is not None and answer.best.label == "sensor:y1 loss" and answer.onset == onset
        low, high = answer.size_interval[0]
        assert low <= 0.5 <= high and high - low < 0.05


def test_the_likelihood_of_a_sensor_gain_is_that_of_a_kalman_filter_with_another_row():
    model, u = small(), levels(COUNT, 0)
    y = inject(model, u, Fault.loss("sensor:y2", 0, 0.4), seed=3)
    found = dictionary(model, kinds=["bias", "loss"])
    record = record_of(model, (u, y))
    part = record.experiments[0]
    white = whiten(model, record, x0="zero")
    logs_of = SensorGain(found, 1, white, part).likelihoods(np.array([0]), np.array([0.0, 0.4]))
    factor = np.array([1.0, 0.6])
    other = replace(model, C=factor[:, None] * model.C, D=factor[:, None] * model.D, offset_y=factor * model.offset_y)
    again = whiten(other, record, x0="zero")
    logs = [-0.5 * np.sum(w.r**2) + COUNT * np.linalg.slogdet(w.predictor.root)[1] for w in (white, again)]
    assert logs_of[0, 0] == pytest.approx(0, abs=1e-6)
    assert logs_of[0, 1] == pytest.approx(logs[1] - logs[0], rel=1e-6)


def test_the_noise_of_a_sensor_may_be_lost_with_its_reading():
    model, u = small(), levels(COUNT, 0)
    y = inject(model, u, seed=2)
    half = np.where((np.arange(COUNT) >= 80)[:, None] & [True, False], 0.5, 1.0)
    record = record_of(model, (u, half * y))
    found, part = dictionary(model, kinds=["loss"]), record.experiments[0]
    white = whiten(model, record)
    same, scaled = (SensorGain(found, 0, white, part, scaled).searched() for scaled in (False, True))
    assert scaled.onset == 80 and scaled.logs.max() > same.logs.max() + 3
    # behind the gain the reading is one of the healthy plant, but for its unit
    again = whiten(model, record_of(model, (u, y)), x0=white.states[0])
    left = SensorGain(found, 0, white, part, True).rests(np.array([80]), np.array([0.5]))[0][0]
    np.testing.assert_allclose(left, again.r, atol=1e-6)


def test_the_effect_of_parameters_beside_a_lost_gain_is_that_of_the_filter_with_another_row():
    """Against differences of moved models, healthy to the onset, damaged afterwards, along a record without noise."""
    model, u, onset, share = small(), levels(COUNT, 0), 60, 0.5
    known = model_uncertainty(model, Data(levels(2000, 1), inject(model, levels(2000, 1), seed=9)))
    found = replace(dictionary(model, kinds=["loss"]), predictor=known.predictor)
    part = record_of(model, (u, inject(model, u, Fault.loss("sensor:y1", onset, share), noise="none"))).experiments[0]
    white = whiten(model, Data(part.u, part.y), x0="zero", uncertainty=known)
    gain = SensorGain(found, 0, white, part)
    steady, own, left = known.predictor, gain._filter(share), np.array([1 - share, 1.0])

    def innovations(moved):
        x, rows = white.states[0], []
        drive = moved.expand_inputs(u)
        for k in range(COUNT):
            of, K = (left, own.K) if k >= onset else (np.ones(2), moved.K)
            e = part.y[k] - of * (moved.C @ x + moved.D @ drive[k] + moved.offset_y)
            x = moved.A @ x + moved.B @ drive[k] + moved.offset_x + K @ e
            rows.append((own if k >= onset else steady).root @ e)
        return np.concatenate(rows)

    moves = np.stack([(innovations(plus) - innovations(minus)) * factor for plus, minus, factor in known.moves], axis=1)
    nuisance = gain._nuisance(known, onset, share)
    free = nuisance.U[:, nuisance.s > 1e4]  # of the initial state
    moves -= free @ (free.T @ moves)
    others = nuisance.U[:, nuisance.s <= 1e4] * nuisance.s[nuisance.s <= 1e4]
    expected, seen = moves @ moves.T, others @ others.T
    assert np.linalg.norm(seen - expected) < 1e-4 * np.linalg.norm(expected)


@pytest.mark.slow
@pytest.mark.sampled(1)
def test_the_interval_of_a_sensor_gain_covers():
    model, u, inside = small(), levels(COUNT, 0), 0
    found = dictionary(model, kinds=["loss"])
    for seed in range(20):
        record = record_of(model, (u, inject(model, u, Fault.loss("sensor:y1", 60, 0.5), seed=seed)))
        white = whiten(model, record)
        gains = sensor_gains(found, white, record.experiments[0], uncertain_start(model, found.predictor))
        one = next(e for e in gains if e.candidates[0].name == "sensor:y1")
        low, high = estimates(one, 0.95, COUNT, 6)[0].size_interval[0]
        inside += low <= 0.5 <= high
    assert inside >= 16  # 19 of 20 are expected


def test_with_one_output_a_disturbance_of_unknown_direction_is_offered_beside_a_frozen_sensor():
    A, B = np.array([[0.9, 0.2], [0.0, 0.8]]), np.array([[0.1], [1.0]])
    model = noisy(A, B, np.array([[1.0, 0.0]]), 0.001 * np.eye(2), np.array([[0.01]]))
    u = levels(300, 0)[:, :1]
    load = {"load": np.array([1.0, 0.0])}
    y = inject(model, u, Fault.step("process:load", 150, -0.4), seed=4, process=load)
    answer = diagnose(model, (u, y), dictionary(model, kinds=["bias", "loss", "frozen"]))
    assert answer.best is not None and answer.best.label == "process"


def test_a_partial_loss_about_another_zero_is_a_loss_and_a_stuck_actuator_is_stuck():
    zero = -1.0  # the actuator does nothing there; f is the identity
    u = levels(COUNT, 0) + 0.5
    lost = Fault.loss("actuator:u1", 70, 0.5, bias=0.5 * zero)
    answer = said(lost, u=u)
    assert answer.best.label == "actuator:u1 loss" and answer.size[0] == pytest.approx(0.5, abs=0.15)
    assert answer.size[1] == pytest.approx(0.5 * zero, abs=0.2)
    stated = said(lost, u=u, zeros={"u1": zero})
    assert stated.best.label == "actuator:u1 loss" and stated.size.shape == (1,)
    assert stated.size_interval[0, 0] <= 0.5 <= stated.size_interval[0, 1]
    answer = said(Fault.stuck("actuator:u1", 70, value=0.8), u=u)
    assert answer.best.label == "actuator:u1 stuck"
    np.testing.assert_allclose(answer.size, [1.0, 0.8], atol=0.2)
    assert answer.size_interval[1, 0] <= 0.8 <= answer.size_interval[1, 1]


def test_a_partial_loss_is_a_loss_beside_a_second_fault_too():
    u, second = levels(COUNT, 0) + 0.5, Fault.step("sensor:y2", 110, 1.5)
    for first, label in ((Fault.loss("actuator:u1", 70, 0.5, bias=-0.5), "actuator:u1 loss"),
                         (Fault.stuck("actuator:u1", 70, value=0.8), "actuator:u1 stuck")):
        y = inject(small(), u, [first, second], seed=1)
        answer = diagnose(small(), (u, y), dictionary(small(), kinds=["bias", "loss", "stuck"]), max_faults=2)
        assert answer.best.label == f"{label} + sensor:y2"
        share = answer.best.faults[0].size[0]
        assert share == pytest.approx(1.0 if "stuck" in label else 0.5, abs=0.15)


def test_a_leak_without_its_direction_is_not_named_as_an_actuator():
    model, leak = small(), {"leak": [0.1, 0.6, -0.7]}
    answer = said(Fault.step("process:leak", 80, 0.9), process=leak)
    assert answer.verdict == "faulty" and answer.best.label == "process" and answer.unique
    found = answer.size / np.linalg.norm(answer.size)
    assert found @ np.array(leak["leak"]) / np.linalg.norm(leak["leak"]) > 0.9
    assert model.outputs[0] in str(answer)  # what it does to the outputs is said, too


def test_directions_by_outputs_move_the_outputs_so_in_any_coordinates():
    model = small()
    found = direction_of(model, {"y1": -1.0})
    np.testing.assert_allclose(model.C @ found, [-1.0, 0.0], atol=1e-5)
    refused(
        (LookupFailed, "no output 'y7'", lambda: direction_of(model, {"y7": 1.0})),
        (StructureError, "not zero", lambda: direction_of(model, {"y1": 0.0})),
        (StructureError, "nothing is left to judge", lambda: dictionary(model, disturbances=["sensor:y1", "u1"])),
        (LookupFailed, "'wind'", lambda: dictionary(model, disturbances=["wind"])))


@pytest.mark.parametrize("name", ["actuator:u2", "sensor:y2", "process:load"])
def test_a_declared_disturbance_of_any_course_changes_nothing(name):
    model, u, load = small(), levels(COUNT, 0), {"load": [0.3, -0.2, 0.5]}
    found = dictionary(model, process=load, disturbances=[name], state_jump=False)
    course = 30 * np.cumsum(np.random.default_rng(3).standard_normal(COUNT))
    healthy = inject(model, u, (), seed=2, x0=np.zeros(3))
    y = np.array(healthy)
    if name == "actuator:u2":  # whose effect is the identity
        y = inject(model, u + course[:, None] * [0.0, 1.0], (), seed=2, x0=np.zeros(3))
    else:
        unit = inject(model, u, Fault.jump(name, 0, 1.0), noise="none", x0=np.zeros(3), process=load)
        impulse = unit - inject(model, u, (), noise="none", x0=np.zeros(3))
        for k in range(COUNT):
            y[k:] += course[k] * impulse[: COUNT - k]
    _, steady = decouple(model, [name], load)
    calm, moved = (whiten(found.model, record_of(model, (u, z)), x0="zero", scale=steady).r for z in (healthy, y))
    assert np.abs(moved[4:] - calm[4:]).max() < 1e-2 < np.abs(y - healthy).max() / 100
    assert np.mean(np.sum(calm[4:] ** 2, axis=1)) == pytest.approx(1, abs=0.3)  # one axis of two is left
    assert diagnose(model, (u, y), found).verdict == "healthy"
    broken = y + np.where(np.arange(COUNT) >= 80, 3.0, 0.0)[:, None] * np.array([1.0, 0.0])
    answer = diagnose(model, (u, broken), found)
    assert answer.detected and any("sensor:y1" in label for a in answer.candidates for label in a.labels)


def test_an_input_outside_its_range_raises_no_fault_and_is_named():
    def curved(*, beyond):
        basis = Polynomial(3, interval=(-1.2, 1.2), outside="extrapolate" if beyond else "clamp")
        f = tuple(Nonlinearity(basis, np.array([1.0, 0.0, 0.3])) for _ in range(2))
        return replace(small(), nonlinearities=f)

    u = levels(COUNT, 0)
    u[100:112, 1] = 2.5
    y = inject(curved(beyond=True), u, (), seed=4)
    found = dictionary(curved(beyond=False))
    answer = diagnose(curved(beyond=False), (u, y), found)
    assert answer.verdict == "healthy"
    assert "u2 is outside the identified range [-1.2, 1.2] in 12 samples, first in sample 100" in answer.status
    y[120:] += np.array([0.0, 2.0])
    faulty = diagnose(curved(beyond=False), (u, y), found)
    assert "sensor:y2" in [label for a in faulty.candidates for label in a.labels]


def ranged(unit=1.0):
    """A linear plant that was identified for inputs from -1.2 to 1.2, in units of the first input."""
    lines = tuple(Nonlinearity(Linear((-1.2 * scale, 1.2 * scale)), np.ones(1)) for scale in (unit, 1.0))
    return replace(small(), B=small().B / [unit, 1.0], D=small().D / [unit, 1.0], nonlinearities=lines)


@pytest.mark.parametrize("unit", [0.01, 1.0, 1e4])
def test_a_record_is_used_up_to_where_an_input_stays_far_outside_its_range(unit):
    model, u = ranged(unit), levels(COUNT, 0) * [unit, 1.0]
    u[90:95, 0], u[100:102, 0], u[130:, 0] = 1.7 * unit, 3.0 * unit, -2.5 * unit
    found = dictionary(model)
    for fault, label in (((), None), (Fault.step("sensor:y2", 60, 0.8), "sensor:y2")):
        y = inject(model, u, fault, seed=4)
        y[130:] += 20.0  # what nobody knows there
        answer = diagnose(model, (u, y), found)
        assert (answer.best and answer.best.label) == label and answer.window == 130
        assert "The record is used up to sample 129: u1 then stays far outside" in answer.status
        assert "first in sample 90: its linear function is extrapolated" in answer.status
        assert "u1 is far outside the identified range" in answer.status and "2 samples, first in sample 100" in (
            answer.status)
    both = diagnose(model, Data([u, u[:80]], [y, y[:80]], inputs=model.inputs, outputs=model.outputs), found)
    assert [one.window for one in both] == [130, 80] and all(one.detected for one in both)
    u[3:, 0] = 2.5 * unit
    with pytest.raises(DataError, match="It stays there from sample 3 on, and 3 samples before are too few"):
        diagnose(model, (u, y), found)


def test_a_nonlinear_input_may_leave_its_range_until_too_little_is_known():
    f = tuple(Nonlinearity(Polynomial(3, interval=(-1.2, 1.2)), np.array([1.0, 0.0, 0.3])) for _ in range(2))
    model, u = replace(small(), nonlinearities=f), levels(COUNT, 0)
    found, y = dictionary(model), inject(model, np.clip(u, -1.2, 1.2), Fault.step("sensor:y1", 40, 0.8), seed=4)
    u[50:54, 0], u[70:, 0] = 1.5, 1.5
    answer = diagnose(model, (u, y), found)
    assert answer.best.label == "sensor:y1" and "used up to sample 49" in answer.status
    u[54 + COUNT // 2 - 10 :, 0] = 0.0
    y = inject(model, np.clip(u, -1.2, 1.2), Fault.step("sensor:y1", 40, 0.8), seed=4)
    assert diagnose(model, (u, y), found).window == COUNT


def test_the_monitor_extrapolates_linear_functions_as_far_as_a_diagnosis():
    model, u = ranged(), levels(300, 2)
    u[100:200, 0], u[250:, 0] = 1.7, 2.5
    y = inject(model, u, Fault.step("sensor:y2", 150, 1.0), seed=4)
    y[250:] += 3.0  # the effect of the input is unknown there, not that of the outputs
    found = dictionary(model, kinds=["bias"], state_jump=False)
    monitor = Monitor(model, found, window=40, thresholds=np.full(len(found.labels), 25.0))
    events = monitor.run(u[:250], y[:250])
    assert [e.sample for e in events if e.kind in ("outside", "inside")] == [100, 200]
    assert 150 <= next(e.sample for e in events if e.kind == "alarm") < 160
    assert monitor.plant.certain or monitor.carried
    steps = Monitor(model, found, window=40, thresholds=np.full(len(found.labels), 25.0))
    assert [e for a, b in zip(u[:250], y[:250]) for e in steps.step(a, b)] == events


@pytest.mark.parametrize("share", [0.02, 0.98])
def test_a_share_lost_lies_between_zero_and_one(share):
    found = dictionary(small(), kinds=["loss", "stuck"], sensors=[], state_jump=False)
    for seed in range(8):
        u = 0.3 * levels(COUNT, seed)
        answer = diagnose(small(), (u, inject(small(), u, Fault.loss("actuator:u1", 60, share), seed=seed)), found,
                          false_alarm=0.2)
        for one in answer.candidates:
            for fault in one.faults:
                assert np.all((fault.size_interval[0] >= 0) & (fault.size_interval[0] <= 1)) and 0 <= fault.size[0] <= 1


def test_without_an_actuator_that_moves_it_is_said_what_is_out_of_reach():
    model = small()
    dead = replace(model, nonlinearities=tuple(Nonlinearity(Linear(), np.zeros(1)) for _ in range(2)))
    left = allocate(dead, low=[-1, -1], high=[1, 1])
    target = left.attainable([1.0, 2.0])
    assert not target.reachable and "nothing acts on y1, y2" in str(target)
    np.testing.assert_allclose(target.y, dead.equilibrium(np.zeros(2))[1])


def test_the_distance_from_a_range_is_one_inside_and_where_there_is_no_range():
    ends = np.array([[-1.0, 2.0, -np.inf], [1.0, 2.0, np.inf]])  # a range, one value only, no limits
    values = np.array([[0.5, 2.0, 9.0], [-3.0, 7.0, -9.0], [np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(distance(values, ends), [[1, 1, 1], [3, 1, 1], [1, 1, 1]])
    np.testing.assert_array_equal(distance(values, None), np.ones((3, 3)))


@pytest.mark.parametrize(("direct", "room"), [(0.0, 0.048), (1.0, 0.048), (200.0, None)])
def test_the_margin_of_a_range_is_what_the_noise_hides(direct, room):
    """A static plant y = direct f(u) + x of known slope: the room is a tenth of the noise over the slope."""
    f = Nonlinearity(Polynomial(2, interval=(-1.2, 1.2)), np.array([2.0, 0.0]))
    slow = noisy([[0.5]], [[0.0]], [[1.0]], [[1.0]], [[3.0]], D=[[direct]], nonlinearities=(f,))
    (low,), (high,) = known_range(slow)
    if room is None:
        change = f(-1.2 + 0.048) - f(-1.2)
        room = 0.048 * 0.1 * np.sqrt(slow.noise.innovation[0, 0]) / (direct * change)
        assert room < 0.002
    assert (low, high) == pytest.approx((-1.2 - room, 1.2 + room))


def test_a_direct_effect_just_outside_the_range_raises_no_alarm():
    """Readings almost without noise show by how little an input left its range: that is told, and is no fault."""
    def plant(outside):
        f = tuple(Nonlinearity(Polynomial(2, (-1.2, 1.2), outside=outside), np.array([1.0, 0.0])) for _ in range(2))
        return noisy([[0.7]], [[1.0, 0.5]], [[1.0], [0.4]], [[1e-4]], np.eye(2) * 1e-4, nonlinearities=f,
                     D=[[1.0, 0.0], [0.0, 1.0]])

    u = levels(600, 3)
    u[300:310, 1], u[400:410, 0] = 1.24, -1.24
    y = inject(plant("extrapolate"), u, (), seed=4)
    events = Monitor(plant("clamp"), window=30, thresholds=np.full(9, 30.0)).run(u, y)
    assert [(e.kind, e.sample) for e in events if e.kind != "inside"] == [("outside", 300), ("outside", 400)]
