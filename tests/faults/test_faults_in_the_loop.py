"""Faults of a plant under control: what is identified, named, sized and promised there."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from fault_plants import noisy, refused

import optid
from optid.bases import Linear, Polynomial
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.faults import Monitor, diagnose, dictionary, model_uncertainty, nuisance
from optid.faults.curvature import Products
from optid.faults.monitor.readings import ReadingChecks
from optid.faults.whitening import predictor
from optid.models import Nonlinearity


def regulated(count=1500, seed=0):
    """Three coupled tanks, two under PI controllers that answer at once; nothing but disturbances moves them."""
    rng = np.random.default_rng(seed)
    flow = np.array([[0.95, 0.0, 0.03], [0.0, 0.93, 0.03], [0.03, 0.03, 0.92]])
    x, total = np.zeros(3), np.zeros(2)
    u, y = np.empty((count, 2)), np.empty((count, 3))
    for k in range(count):
        y[k] = x + 0.05 * rng.standard_normal(3)
        total += y[k, :2]
        u[k] = -0.6 * y[k, :2] - 0.05 * total
        x = flow @ x + 0.1 * np.append(u[k], 0.0) + 0.05 * rng.standard_normal(3)
    return optid.Data(u, y, inputs=["q1", "q2"], outputs=["h1", "h2", "h3"])


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_the_inverse_of_a_controller_is_not_fitted_by_prediction_errors():
    with pytest.raises(RankError, match=r"prediction errors of h\d, .* feedthrough=false"):
        optid.fit(regulated(600), "ss.exact", nx=2, criterion="prediction", prove=False)


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_the_inverse_of_a_controller_is_not_monitored():
    record = regulated()
    inverse = optid.fit(record, "hammerstein_ss.sid", basis="linear", nx=2).model
    refused(*((DataError, "answer of a controller .* feedthrough=false", call) for call in (
        lambda: Monitor(inverse, uncertainty=record), lambda: model_uncertainty(inverse, record))))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The model is unstable")
def test_a_regulated_plant_is_fitted_without_feedthrough_and_the_advice_is_taken():
    record = regulated()
    found = optid.fit(record, "ss.exact", nx=3, criterion="prediction", feedthrough=False)
    assert not found.model.D.any()
    assert all("use a noise model" not in str(one) for one in found.advice)
    monitor = Monitor(found.model, arl0=20_000, window=30, uncertainty=record)
    later = regulated(seed=1)
    y = later.y.copy()
    y[700:, 0] += 0.6
    alarms = [e for e in monitor.run(later.u, y) if e.kind == "alarm"]
    assert alarms and alarms[0].sample >= 700


def curved(count, seed, share=0.0, onset=0):
    """A level under PI control behind an exponential valve; what flows in falls with the level."""
    rng = np.random.default_rng(seed)
    x, total, u, y = 1.0, 0.0, np.empty((count, 1)), np.empty((count, 1))
    targets = np.repeat(rng.uniform(0.7, 1.3, -(-count // 20)), 20)
    for k in range(count):
        y[k] = x + 0.001 * rng.standard_normal()
        total += 0.04 * (targets[k] - y[k, 0])
        u[k] = 0.3 * (targets[k] - y[k, 0]) + total
        flow = 0.1 * np.exp(u[k, 0]) * (1 - share * (k >= onset))
        x += flow * (2.5 - x) - 0.15 * x + 0.001 * rng.standard_normal()
    return optid.Data(u, y, inputs=["valve"], outputs=["level"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The plant is not of the class of the model")
def test_the_curvature_of_a_plant_under_control_passes_less_for_that_of_its_valve(monkeypatch):
    """Diagnosis and monitor estimate by one formula; a plant of the class of the model has no products."""
    fit = optid.fit(curved(2500, 0), "hammerstein_ss.exact", nx=1, basis="polynomial:2", criterion="prediction",
                    feedthrough=False, prove=False)
    known = model_uncertainty(fit.model, fit.data)
    monkeypatch.setattr(nuisance, "LARGEST", 0)
    flat = model_uncertainty(fit.model, fit.data)
    assert known.curvature is not None and "products" in known.remark and flat.curvature is None
    found = dictionary(fit.model, kinds=["bias", "loss"], state_jump=False)
    built = Monitor(fit.model, found, window=60, thresholds=np.full(3, 25.0), uncertainty=known)
    sizes, compared = [], 0
    for seed in range(2, 5):
        record, monitor = curved(300, seed, 0.15, 120), copy.deepcopy(built)
        ends = []
        for one in (known, flat):
            answer = diagnose(fit.model, record, found, model_uncertainty=one)
            ends += [e for a in answer.candidates for e in a.faults if e.label == "actuator:valve loss"]
        sizes.append([e.size[0] for e in ends])
        monitor.run(record.u, record.y)
        for carried in monitor.carried:
            if carried.label == "actuator:valve loss":
                assert np.allclose(carried.interval, ends[0].size_interval, atol=1e-9)
                compared += 1
    better, worse = 0.15 - np.mean(sizes, axis=0)
    assert compared and 0 < better < 0.6 * worse
    model, u, y = controlled(count=1500)
    assert model_uncertainty(model, optid.Data(u, y)).curvature is None


def test_products_act_as_a_plant_with_them_would():
    record = curved(200, 3)
    model = noisy(np.array([[0.8]]), np.array([[0.3]]), np.eye(1), 1e-4 * np.eye(1), 1e-4 * np.eye(1))
    part, products = record.experiments[0], Products.of(record.experiments)
    steady = predictor(model)
    response = products.response(steady, part, np.ones(part.y.shape, dtype=bool))
    z = [2 * (signal - signal.min()) / np.ptp(signal) - 1 for signal in (part.u[:, 0], part.y[:, 0])]
    for number, signal in enumerate((z[0] ** 3, z[0] * z[1], z[1] ** 2)):
        x, expected = 0.0, []
        for k in range(len(signal)):
            expected.append(x)
            x = steady.F[0, 0] * x + signal[k]
        assert np.allclose(response[:, 0, number], expected)


def test_an_excursion_is_remembered_however_many_follow_in_its_block():
    model, _, _ = controlled(count=10)
    checks = ReadingChecks(model, 500, np.array([[-1.0, -1.0], [1.0, 1.0]]))
    y = np.zeros((900, 2))
    y[::3, 0] = 2.0
    checks.screen(np.zeros((900, 2)), y, 0)
    assert checks.excursion(1, 20) == (f"output:{model.outputs[0]}", 3)


A, B, C = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.5, 0.1], [0.2, 0.6]]), np.eye(2)


def controlled(share=0.0, zero=(-2.0, 0.0), seed=0, count=400, onset=150, stuck=False, offset=0.0):
    """A linear plant under PI control; from the onset on its first actuator is broken."""
    rng = np.random.default_rng(seed)
    model = noisy(A, B, C, 4e-4 * np.eye(2), 4e-4 * np.eye(2))
    x, total, u, y = np.zeros(2), np.zeros(2), np.zeros((count, 2)), np.zeros((count, 2))
    gain = np.linalg.inv(C @ np.linalg.solve(np.eye(2) - A, B))
    targets = np.repeat(rng.uniform(-1, 1, (-(-count // 15), 2)), 15, axis=0)
    for k in range(count):
        y[k] = C @ x + 0.02 * rng.standard_normal(2)
        total += targets[k] - y[k]
        u[k] = gain @ (0.3 * (targets[k] - y[k]) + 0.08 * total)
        v = u[k].copy()
        if k >= onset:
            held = u[onset, 0]
            v[0] = held if stuck else (1 - share) * (v[0] - zero[0]) + zero[0] + offset
        x = A @ x + B @ v + 0.02 * rng.standard_normal(2)
    return model, u, y


def watching(model, found, level=30.0, **how):
    count = sum(c.kind != "loss" or bool(c.columns) for c in found.candidates)
    return Monitor(model, found, window=60, thresholds=np.full(count, level), x0="zero", **how)


def told(events, until):
    named = [e for e in events if e.kind in ("isolated", "revised") and e.sample < until]
    return {label for label, _ in named[-1].candidates}, named[-1]


@pytest.mark.sampled(2)
@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
@pytest.mark.parametrize("listed", [("bias", "loss"), ("bias", "loss", "stuck")])
@pytest.mark.parametrize("seed", range(3))
def test_a_loss_about_another_zero_is_a_loss_with_its_share(listed, seed):
    model, u, y = controlled(0.3, seed=seed)
    monitor = watching(model, dictionary(model, kinds=listed))
    labels, last = told(monitor.run(u, y), 210)
    assert "actuator:u1 loss" in labels and len(labels) <= 2
    (one,) = (c for c in monitor.carried if c.label == "actuator:u1 loss")
    assert abs(one.size[0] - 0.3) < 3 * one.deviation[0] < 0.1
    assert abs(one.size[1] - 0.3 * -2.0) < 3 * one.deviation[1] + 0.05


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
@pytest.mark.parametrize("seed", range(2))
def test_stuck_offset_and_small_losses_are_told_as_far_as_they_are_decided(seed):
    for how, kind in (({"stuck": True}, "actuator:u1 stuck"), ({"offset": 0.4}, "actuator:u1"),
                      ({"share": 0.06}, "actuator:u1 loss")):
        model, u, y = controlled(seed=seed, **how)
        monitor = watching(model, dictionary(model, kinds=["bias", "loss", "stuck"]))
        events = monitor.run(u, y)
        labels, _ = told(events, 210)
        assert kind in labels and len(labels) <= 2, (how, labels)
        sizes = [e.size[0] for e in events if e.size and e.candidates[0][0].endswith(("loss", "stuck"))]
        assert all(0 <= size <= 1 for size in sizes)  # a share


def test_the_monitor_takes_stated_zeros_as_diagnose_does():
    model, u, y = controlled(0.3, count=300)
    found = dictionary(model, kinds=["loss"], actuators=["u1"], sensors=[], state_jump=False, zeros={"u1": -2.0})
    monitor = watching(model, found)
    labels, last = told(monitor.run(u, y), 300)
    assert labels == {"actuator:u1 loss"} and last.size == pytest.approx([0.3], abs=0.06)


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_a_declared_disturbance_is_no_alarm():
    model, u, y = controlled()
    wind = 0.3 * np.sin(np.arange(len(u)) / 7) + (np.arange(len(u)) > 200)
    x = np.zeros(2)
    for k in range(len(u)):
        y[k] += C @ x
        x = A @ x + np.array([0.4, 0.0]) * wind[k]
    direction = {"wind": [0.4, 0.0]}
    assert any(e.kind == "alarm" for e in watching(model, dictionary(model)).run(u, y))
    found = dictionary(model, process=direction, disturbances=["wind"])
    monitor = Monitor(model, found, window=60, thresholds=np.full(len(found.labels), 30.0), x0="unknown")
    assert not [e for e in monitor.run(u, y) if e.kind == "alarm"]
    y[300:, 1] += 0.5
    monitor = Monitor(model, found, window=60, thresholds=np.full(len(found.labels), 30.0), x0="unknown")
    alarms = [e for e in monitor.run(u, y) if e.kind == "alarm"]
    assert alarms and 300 <= alarms[0].sample < 330


def test_a_zero_where_the_function_is_not_known_is_refused_or_said():
    model, _, _ = controlled()
    line = Nonlinearity(Linear((-1.0, 1.0)), np.ones(1))
    curve = Nonlinearity(Polynomial(2, (-1.0, 1.0)), np.array([1.0, 0.1]))
    refused((StructureError, "zero 3 of u1 lies outside .* Leave the zero out", lambda: dictionary(
        replace(model, nonlinearities=(curve, curve)), kinds=["loss"], sensors=[], zeros={"u1": 3.0})))
    with pytest.warns(DataWarning, match="as far as the actuator is linear"):
        dictionary(replace(model, nonlinearities=(line, line)), kinds=["loss"], sensors=[], zeros={"u1": 3.0})


def test_what_operators_do_to_a_monitor(tmp_path):
    model, u, y = controlled(count=600, onset=10_000)
    y[200:, 1] += 0.5
    found = dictionary(model)
    monitor = watching(model, found)
    monitor.run(u[:205], y[:205])
    assert monitor.alarmed
    monitor.acknowledge()
    assert not monitor.alarmed and monitor.samples == 205
    monitor = watching(model, found)
    monitor.run(u[:300], y[:300])
    assert [c.label for c in monitor.carried] == ["sensor:y2"]
    restored = Monitor.load(monitor.save(tmp_path / "m.npz"))
    for one in (monitor, restored):
        one.rebase()  # the sensor was exchanged
        y[300:, 1] -= 0.5 * (one is monitor)
        assert one.carried == () and not [e for e in one.run(u[300:400], y[300:400]) if e.kind == "alarm"]
        one.skip(100)
        assert one.samples == 500 and not one.run(u[500:], y[500:])


@pytest.mark.slow
def test_a_slow_disturbance_is_followed_and_a_fault_is_still_found():
    model, u, y = controlled(count=4000, onset=10_000)
    y += 0.5 * np.sin(2 * np.pi * np.arange(4000) / 2000)[:, None]
    plain, slow = (Monitor(model, dictionary(model), arl0=20_000, window=60, drift=drift) for drift in (None, 2000.0))
    assert any(e.kind == "alarm" for e in plain.run(u[:3000], y[:3000]))
    assert not [e for e in slow.run(u[:3000], y[:3000]) if e.kind == "alarm"]
    y[3000:, 0] += 0.3
    alarms = [e for e in slow.run(u[3000:], y[3000:]) if e.kind == "alarm"]
    assert alarms and alarms[0].sample < 3030 and alarms[0].candidates[0][0] == "sensor:y1"
    refused((StructureError, "600 samples at least", lambda: Monitor(model, dictionary(model), drift=100.0)))


def test_thresholds_adapt_to_colour_with_a_price_and_alike_by_steps_and_blocks():
    model, u, y = controlled(count=6000, onset=10_000)
    rng, noise = np.random.default_rng(3), np.zeros(2)
    for k in range(len(y)):
        noise = 0.9 * noise + 0.012 * rng.standard_normal(2)
        y[k] += noise
    found, alarms = dictionary(model), []
    base = Monitor(model, found, arl0=10_000, window=60)
    for most in (1.0, 5.0):
        monitor = Monitor(model, found, window=60, thresholds=base.calibration, adapt=most)
        events = monitor.run(u, y)
        alarms.append(sum(e.kind == "alarm" for e in events))
    assert alarms[1] < alarms[0] / 2
    assert "times as large" in next(e.note for e in events if e.kind == "adapted")
    steps = Monitor(model, found, window=60, thresholds=base.calibration, adapt=5.0)
    assert [e for k in range(0, 2000, 7) for e in steps.run(u[k : k + 7], y[k : k + 7])] == [
        e for e in events if e.sample < steps.samples]


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_onset_and_size_of_an_event_are_those_of_its_first_label():
    model, u, y = controlled()
    y[150:, 0] += 0.25
    found = dictionary(model, kinds=["bias", "loss", "stuck"])
    for event in watching(model, found, 15.0).run(u, y):
        if event.size:
            label = event.candidates[0][0]
            assert len(event.size) == (2 if label.endswith(("loss", "stuck")) else 2 if label == "state" else 1)
