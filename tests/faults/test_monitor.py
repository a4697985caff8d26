"""The monitor against dense least squares, and its decisions on records with known faults."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from fault_plants import levels, noisy, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from optid.bases import Linear, Polynomial, UserFunctions
from optid.data.record import Data
from optid.errors import DataError, DataWarning, ModelFileError, StructureError
from optid.faults import Fault, Monitor, diagnose, dictionary, inject, whiten
from optid.models import Nonlinearity

HIGH = 1e9  # a threshold that nothing exceeds


def plant(feedback=False):
    """Three states, two inputs (one with a cubic nonlinearity and two functions), two outputs, a feedthrough."""
    A = np.array([[0.8, 0.2, 0.0], [-0.3, 0.7, 0.1], [0.0, 0.0, 0.5]])
    B = np.array([[1.0, 0.3, 0.2], [0.5, -0.4, 0.1], [0.2, 1.0, -0.3]])
    C = np.array([[1.0, 0.0, 0.5], [0.3, 1.0, -0.4]])
    D = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.1]])
    cubic = Nonlinearity(Polynomial(3, (-1.5, 1.5), outside="extrapolate"), np.array([1.0, 0.2, 0.3]))
    line = Nonlinearity(Linear(), np.ones(1))
    square = Nonlinearity(Polynomial(2, (-1.5, 1.5), outside="extrapolate"), np.array([0.3, 0.5]))
    more = {"L": np.array([[0.1, 0.0], [0.0, -0.1], [0.05, 0.1]])} if feedback else {}
    return noisy(A, B, C, 0.02 * np.eye(3), np.diag([0.03, 0.05]), D=D, nonlinearities=(cubic, line, square),
                 input_of=(0, 1, 1), offset_x=np.array([0.1, -0.2, 0.0]), offset_y=np.array([1.0, -1.0]), **more)


def listed(model, *kinds, **how):
    """A dictionary without the gains of sensors, which no running search looks for."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        found = dictionary(model, kinds=list(kinds), **how)
    keep = [i for i, c in enumerate(found.candidates) if c.kind != "loss" or c.columns]
    return replace(found, candidates=tuple(found.candidates[i] for i in keep), sines=found.sines[np.ix_(keep, keep)])


def everything(model):
    return listed(model, "bias", "drift", "loss", "stuck", process={"load": [0.3, -0.2, 0.5]})


def watch(model, found, window=40, level=HIGH, **how):
    return Monitor(model, found, window=window, thresholds=np.full(len(found.labels), level), **how)


def observed(found, u, y):
    """What the readings that are there say: (present rows whitened, the same map for signatures of the innovations).

    The innovations of the complete record are linear in its readings; those that are missing are left out of the joint
    covariance of the readings.
    """
    steady, (count, l) = found.predictor, y.shape  # noqa: E741
    pulses = np.eye(count * l).reshape(count, l, -1)
    fed = np.zeros((count, found.model.nx, count * l))
    fed[1:] = -np.einsum("io,koj->kij", found.model.L, pulses[:-1])  # readings that the plant feeds back
    M = steady.respond(fed, pulses).reshape(count * l, -1)
    start = whiten(found.model, Data(u, np.zeros_like(y)), x0="zero").innovations.ravel()
    there, back = ~np.isnan(y.ravel()), np.linalg.inv(M)
    factor = back @ np.kron(np.eye(count), np.linalg.cholesky(steady.covariance))
    lower = np.linalg.cholesky((factor @ factor.T)[np.ix_(there, there)])
    onto = np.linalg.solve(lower, back[there])
    return np.linalg.solve(lower, (np.nan_to_num(y.ravel()) + back @ start)[there]), onto


def dense(found, window, u, y, nuisance=None, share=1e-9):
    """{label: (statistic, onset)} by generalised least squares over every onset of the window that ends with a record.

    The nuisance, a candidate and its onset, is taken out; readings may be missing. Directions with less than a share
    of the energy of the largest count as dependent.
    """
    (r, onto), count, best = observed(found, u, y), len(y), {}

    def seen(candidate, onset):
        plain = found.predictor.respond(*found.additions(candidate, count, onset, u=u)).reshape(y.size, -1)
        left = onto @ plain
        return left if np.linalg.norm(left) > 1e-9 * np.linalg.norm(plain) else 0 * left

    basis = np.zeros((len(r), 1)) if nuisance is None else seen(*nuisance)
    out = np.eye(len(r)) - basis @ np.linalg.pinv(basis)
    for c in found.candidates:
        here = (0.0, -1)
        for onset in range(max(1 if c.columns else 0, count - window), count + 1 - (-(-c.dimension // found.model.l))):
            axes, sizes, _ = np.linalg.svd(out @ seen(c, onset), full_matrices=False)
            energy = float(np.sum((axes[:, sizes**2 > share * sizes[0] ** 2].T @ (out @ r)) ** 2))
            here = max(here, (energy, onset), key=lambda one: one[0])
        best[c.label] = here
    return best


def agrees(monitor, best, accuracy=1e-9):
    for label, (energy, onset) in best.items():
        assert monitor.statistics[label] == pytest.approx(energy, rel=accuracy), label
        assert monitor.onsets[label] == onset, label


LATER = (71, 90, 109, 110, 111, 130)
"""After one missing reading the products come from the tables, are summed, and are tables again."""


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("count, lost", [(3, ""), (25, ""), (90, ""), (70, "some"), *((k, "one") for k in LATER)])
def test_statistics_are_those_of_dense_least_squares(count, lost, feedback):
    model = plant(feedback)
    found, u = everything(model), levels(count, 3)
    y = inject(model, u, Fault.step("sensor:y1", count // 2, 0.2), seed=4)
    if lost == "some":
        y[np.random.default_rng(0).random(y.shape) < 0.15] = y[33:36] = np.nan
    elif lost:
        y[70, 1] = np.nan
    monitor = watch(model, found, x0="zero")
    assert {e.kind for e in monitor.run(u, y)} <= {"untestable"}  # nothing can reach this threshold
    agrees(monitor, dense(found, 40, u, y))


def test_an_unknown_state_counts_for_nothing():
    model, count = plant(), 50
    found, u = everything(model), levels(count, 7)
    y = inject(model, u, seed=8, x0=np.array([40.0, -30.0, 20.0]))
    monitor = watch(model, found)
    monitor.run(u, y)
    agrees(monitor, dense(found, 40, u, y, ("state", 0)), 1e-8)
    zero, unknown = watch(model, found, x0="zero"), watch(model, found)
    zero.run(u[:6], y[:6])
    unknown.run(u[:6], y[:6])
    assert max(zero.statistics.values()) > 100 > max(unknown.statistics.values())


def near_integrating(T):
    """A slow plant of poles .99999, .9999 and .8 in coordinates T x."""
    back = np.linalg.inv(T)
    C = np.array([[1.0, 0.5, 1.0], [0.0, 1.0, -0.5]])
    return noisy(T @ np.diag([0.99999, 0.9999, 0.8]) @ back, T @ np.ones((3, 1)), C @ back, 1e-4 * T @ T.T,
                 np.diag([0.03, 0.05]))


@pytest.mark.parametrize("lost", [False, True])
def test_the_start_depends_neither_on_coordinates_nor_on_offsets(lost):
    rng = np.random.default_rng(2)
    u, known = rng.standard_normal((300, 1)), near_integrating(np.eye(3))
    ways, results = (np.eye(3), rng.standard_normal((3, 3)), np.diag([1e-6, 1.0, 1e5])), []
    for T in ways:
        model = near_integrating(T)
        found = dictionary(model, kinds=["bias"], actuators=[], state_jump=False)
        for size in (0.0, 1e3, 1e7):
            y = inject(known, u, seed=3, x0=size * np.array([1.0, -0.7, 0.4]))
            if lost:
                y[:4, 0] = y[2:9, 1] = y[200:210] = np.nan
                u[100:103] = np.nan  # the input is unknown to the monitor
            results.append(watch(model, found).watched(u, y))
            u = np.nan_to_num(u, nan=0.3)
    for one in results[1:]:
        assert np.allclose(one, results[0], rtol=2e-5, atol=2e-5)
    assert results[0].max() < 25 and results[0][20:].max() > 5


@pytest.mark.parametrize("size", [1.0, 1e4, 1e8])
def test_no_alarm_at_a_start_that_is_far_from_zero(size):
    model, u = plant(), levels(300, 3)
    found = everything(model)
    for seed in range(5):
        monitor = watch(model, found, 40, 35.0)
        x0 = size * np.random.default_rng(seed).standard_normal(3)
        events = monitor.run(u, inject(model, u, Fault.step("sensor:y1", 200, 2.0), seed=seed, x0=x0))
        assert [e.sample // 10 for e in events if e.kind == "alarm"] == [20]


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize("where", [0, 3000])
def test_a_transient_in_the_healthy_record_is_no_noise(where, unit):
    """A start-up that the model does not describe hides faults: it is named, or refused."""
    base, u, parts = plant(), levels(5000, 1), [slice(0, 2000), slice(2000, 5000)]
    scale = np.array([unit, 1.0])
    noise = replace(base.noise, R=base.noise.R * np.outer(scale, scale), S=base.noise.S * scale,
                    innovation=base.noise.innovation * np.outer(scale, scale))
    model = replace(base, C=scale[:, None] * base.C, D=scale[:, None] * base.D, offset_y=scale * base.offset_y,
                    K=None if base.K is None else base.K / scale, noise=noise)
    clean = inject(base, u, seed=3) * scale

    def calibrated(size):
        y = clean.copy()
        y[where:, 0] += size * unit * np.exp(-np.arange(5000 - where) / 150)
        return Monitor(model, arl0=1000, window=40, healthy=Data([u[p] for p in parts], [y[p] for p in parts]))

    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        calibrated(9.0)
    assert any("raises the energy of the innovations of y1" in str(one.message) for one in heard)
    experiment, first = (1, 0) if where == 0 else (2, 1000)
    refused((DataError, rf"in samples {first} to \d+ of experiment {experiment}: smaller", lambda: calibrated(40.0)))


def test_thresholds_that_a_stretch_raises_are_reported():
    """A few windows reach far more than the others."""
    model, u = plant(), levels(4000, 1)
    clean = inject(model, u, seed=3)

    def calibrated(size):
        y = clean.copy()
        for k in (1000, 1250, 1500, 1750):
            y[k : k + 12, 0] += size
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            Monitor(model, arl0=1000, window=40, healthy=Data(u, y))
        return " ".join(str(one.message) for one in heard)

    assert "raises the thresholds" not in calibrated(1.0)
    assert re.search(r"raises the thresholds [3-9]\.\d-fold, most in samples 1\d\d0 to 1\d\d9: ", calibrated(4.5))
    refused((DataError, "raises the thresholds", lambda: calibrated(10.0)))


def test_a_missing_input_makes_the_state_unknown():
    model, count = plant(), 120
    gap, u = levels(count, 9), levels(count, 9)
    u[60:63] += 5.0  # what the plant gets while nobody sees it
    gap[60:63] = np.nan
    assert watch(model, everything(model), 40, 40.0).run(gap, inject(model, u, seed=10)) == []


@pytest.mark.parametrize("seed", range(4))
def test_a_fault_of_an_actuator_whose_input_is_unknown_is_carried_with_a_finite_size(seed):
    model, u = plant(), levels(500, seed)
    found = everything(model)
    faults = [Fault.step("process:load", 90, 3.0, direction=[0.3, -0.2, 0.5]), Fault.step("sensor:y1", 300, 2.0)]
    y = inject(model, u, faults, seed=seed)
    u[100:250, seed % 2] = u[280:420, 1 - seed % 2] = np.nan
    monitor = watch(model, found, 40, 30.0)
    events = monitor.run(u, y)
    assert "alarm" in {e.kind for e in events} and np.isfinite(monitor.plant.P).all()
    assert np.linalg.eigvalsh(monitor.plant.P)[0] > -1e-6 and np.abs(monitor.plant.P).max() < 1e12


def test_a_carried_fault_counts_for_nothing_and_its_size_is_that_of_least_squares():
    model, count = plant(), 140
    found, u = everything(model), levels(count, 11)
    y = inject(model, u, Fault.step("sensor:y2", 50, 6.0), seed=12)
    monitor = watch(model, found, 40, 35.0, x0="zero", learned=0.0)
    events = monitor.run(u, y)
    assert [e.kind for e in events] == ["alarm", "isolated"]
    assert events[1].candidates == (("sensor:y2", pytest.approx(1.0, abs=1e-6)),) and events[1].onset == 50
    r, flat = whiten(model, Data(u, y), x0="zero").r.ravel(), found.signature("sensor:y2", count, 50).ravel()
    (carried,) = monitor.carried
    assert carried.size[0] == pytest.approx(flat @ r / (flat @ flat), rel=1e-9)
    assert carried.deviation[0] == pytest.approx(1 / np.sqrt(flat @ flat), rel=1e-9)
    agrees(monitor, dense(found, 40, u, y, ("sensor:y2", 50)), 1e-7)


@pytest.mark.parametrize(
    "fault, label",
    [
        (Fault.loss("actuator:u1", 50, 0.8), "actuator:u1 loss"),
        (Fault.step("process:load", 50, 3.0, direction=[0.3, -0.2, 0.5]), "process:load"),
        (Fault.ramp("sensor:y1", 50, 0.3), "sensor:y1 drift"),
        (Fault.jump("state", 50, [3.0, -2.0, 4.0]), "state"),
    ],
)
def test_after_a_fault_is_named_innovations_are_white_again(fault, label):
    model, count = plant(), 400
    found, u = listed(model, "bias", "drift", "loss", process={"load": [0.3, -0.2, 0.5]}), levels(count, 13)
    monitor = watch(model, found, 80, 35.0, x0="zero")
    events = monitor.run(u, inject(model, u, fault, seed=14))
    assert [e.kind for e in events[:2]] == ["alarm", "isolated"]
    assert [e.kind for e in events[2:]] == (["cleared"] if label == "state" else [])
    assert events[1].candidates[0][0] == label and abs(events[1].onset - 50) <= 1
    assert max(monitor.statistics.values()) < 30


def test_a_carried_fault_is_estimated_for_a_window_before_it_is_held():
    """A size that is held too early stays wrong, and the search finds what is left of it again."""
    model, window, later = plant(), 60, 0
    found = dictionary(model, kinds=["loss"], sensors=[], state_jump=False)
    for seed in range(6):
        u = levels(900, 100 + seed)
        y = inject(model, u, Fault.loss("actuator:u1", 50, 0.5), seed=seed)
        monitor = watch(model, found, window, 25.0, x0="zero")
        named = next((e.sample for e in monitor.run(u[:100], y[:100]) if e.kind == "isolated"), 100)
        early = max(100, named + window)
        monitor.run(u[100:early], y[100:early])
        (carried,) = monitor.carried
        assert carried.deviation[0] > 0
        later += sum(e.kind == "alarm" for e in monitor.run(u[early:], y[early:]))
        (carried,) = monitor.carried
        assert abs(carried.size[0] - 0.5) < 4 * carried.deviation[0] < 0.12
    assert later == 0


def stream(model, count=500, seed=1):
    u = levels(count, seed)
    y = inject(model, u, [Fault.step("sensor:y1", 150, 1.0), Fault.loss("actuator:u2", 330, 0.9)], seed=seed)
    y[40:43] = np.nan
    y[200, 0] = np.nan
    u[100] = np.nan
    return u, y


@pytest.mark.parametrize("cut", [1, 39, 152, 158, 165, 240, 333, 499])
def test_a_saved_state_continues_bit_for_bit(tmp_path, cut):
    model = plant(True)
    found, (u, y) = everything(model), stream(model)
    whole = watch(model, found, 40, 35.0)
    before = whole.run(u[:cut], y[:cut])
    restored = Monitor.load(whole.save(tmp_path / "monitor.npz"))
    assert restored.labels == whole.labels and restored.samples == cut
    after, again = whole.run(u[cut:], y[cut:]), restored.run(u[cut:], y[cut:])
    assert after == again and {e.kind for e in before + after} >= {"alarm", "isolated"}
    assert whole.statistics == restored.statistics and whole.carried == restored.carried
    assert np.array_equal(whole.state, restored.state)


@pytest.mark.parametrize("outside", [None, "clamp", "extrapolate"])
def test_steps_and_blocks_give_the_same_numbers(outside):
    model = plant()
    if outside is not None:  # functions that cannot be compiled
        shapes = [lambda u: u + 0.25 * u**3, np.sin, lambda u: np.tanh(1.5 * u) + 0.15 * u]
        functions = [UserFunctions((f, np.square), interval=(-1.0, 1.0), outside=outside, names=("f", "square"))
                     for f in shapes]
        model = replace(model, nonlinearities=tuple(Nonlinearity(f, np.array([1.0, 0.1])) for f in functions))
    found, (u, y) = everything(model), stream(model)
    blocks, steps = (watch(model, found, 40, 35.0) for _ in range(2))
    events = blocks.run(u[:7], y[:7]) + blocks.run(u[7:300], y[7:300]) + blocks.run(u[300:], y[300:])
    single = [event for a, b in zip(u, y) for event in steps.step(a, b)]
    assert events == single and len(events) >= 4
    assert blocks.statistics == steps.statistics and np.array_equal(blocks.state, steps.state)


def test_outside_the_identified_range_thresholds_grow_for_a_window(tmp_path):
    model, u = plant(), levels(400, 8)
    found = listed(model, "bias")
    u[100:103, 0], u[110:160, 0] = 3.0, 1.8
    y = inject(model, u, Fault.step("sensor:y2", 130, 0.7), seed=2)

    def watching(most):
        return watch(model, found, 40, 20.0, beyond=most)

    plain, blocks, steps = watching(1.0), watching(5.0), watching(5.0)
    single, raised = [], []
    for a, b in zip(u, y):
        single += steps.step(a, b)
        raised.append(steps.decisions.limits.thresholds[0] / 20.0)
    half = np.ptp(steps.checks.known[:, 0]) / 2
    assert raised[99] == raised[201] == 1 and raised[142] == 5  # 3.0 is far out
    assert raised[143] == raised[199] == pytest.approx((1.8 / half) ** 4)
    first = blocks.run(u[:180], y[:180])
    restored = Monitor.load(blocks.save(tmp_path / "monitor.npz"))
    assert single == first + restored.run(u[180:], y[180:])
    alarms = [next(e.sample for e in events if e.kind in ("alarm", "untrusted"))
              for events in (plain.run(u, y), single)]
    assert 130 <= alarms[0] < alarms[1]


def test_the_next_fault_is_found_after_the_first():
    model = plant()
    events = watch(model, everything(model), 60, 35.0).run(*stream(model, 600))
    named = [(e.candidates[0][0], e.onset) for e in events if e.kind == "isolated"]
    assert named[0][0] == "sensor:y1" and abs(named[0][1] - 150) <= 2
    assert named[-1][0].startswith("actuator:u2") and abs(named[-1][1] - 330) <= 3


def watched(found, u, fault, seed, window, level):
    """A monitor and its events along a record with a fault."""
    monitor = watch(found.model, found, window, level)
    return monitor, monitor.run(u, inject(found.model, u, fault, seed=seed))


def test_a_repaired_fault_is_cleared():
    fault = Fault.step("sensor:y2", 150, 3.0, end=300)
    monitor, events = watched(everything(plant()), levels(500, 2), fault, 3, 60, 35.0)
    assert [e.kind for e in events] == ["alarm", "isolated", "alarm", "isolated", "cleared"]
    assert events[-1].candidates == (("sensor:y2", 1.0),) and monitor.carried == () and not monitor.alarmed


def test_an_actuator_at_rest_is_untestable_and_does_not_alarm():
    u = levels(500, 4)
    u[150:350, 0] = 0.0
    _, events = watched(everything(plant()), u, [], 5, 50, 30.0)
    assert {e.kind for e in events} == {"untestable", "testable"}
    silent_since = {e.candidates[0][0]: e.onset for e in events if e.kind == "untestable"}
    assert set(silent_since) == {"actuator:u1 loss", "actuator:u1 stuck"}
    assert all(120 < since <= 200 for since in silent_since.values())
    assert all(350 <= e.sample < 365 for e in events if e.kind == "testable")


def test_noise_that_grows_is_named_although_jumps_of_the_state_explain_a_few_samples():
    A = np.array([[0.96, 0, 0.1, 0], [0, 0.92, 0, 0.1], [0, 0, 0.9, 0], [0, 0, 0, 0.87]])
    model = noisy(A, np.array([[0.5, 0], [0, 0.5], [0, 0.3], [0.3, 0]]), np.eye(4)[:2], 0.01 * np.eye(4),
                  0.01 * np.eye(2))
    u = levels(400, 4)
    for output, seed in (("y1", 1), ("y2", 2), ("y1", 3), ("y2", 4)):
        monitor = watch(model, listed(model, "bias", "drift", "loss", "stuck"), level=25.0)
        y = inject(model, u, Fault.sensor_noise(f"sensor:{output}", 300, scale=4.0), seed=seed)
        named = next(e for e in monitor.run(u, y) if e.kind == "isolated" and e.sample >= 300)
        assert named.candidates == ((f"sensor:{output} noise", 1.0),)
        assert abs(named.onset - 300) <= 2 and 2 < named.size[0] < 8


def test_parameters_confounded_with_the_initial_state_do_not_raise_the_thresholds():
    """A plant that nearly integrates: a monitor has long forgotten the start, an error there is no effect."""
    model = noisy(np.diag([0.9995, 0.8]), np.array([[0.02, 0], [0.1, 0.5]]), np.eye(2), 1e-4 * np.eye(2),
                  0.01 * np.eye(2))
    u = levels(1500, 3)
    data = Data(u, inject(model, u, seed=9, x0="rest"))
    monitor = Monitor(model, listed(model, "bias"), arl0=1000, uncertainty=data)
    assert np.all(monitor.calibration.q < 25)


def test_what_no_candidate_explains_is_unknown():
    model = plant()
    found, u = listed(model, "bias"), levels(300, 6)
    shaken = inject(model, u, seed=7)
    shaken[150:220] += 2.0 * np.random.default_rng(0).standard_normal((70, 2))
    monitor = watch(model, found, 60, 30.0)
    events = monitor.run(u, shaken)
    assert events[0].kind == "alarm"
    assert events[1].kind == "isolated" and events[1].candidates == (("unknown", 1.0),)
    assert events[-1].kind == "cleared" and not monitor.alarmed
    sure = watch(model, replace(found, unknown=False), 60, 30.0)
    assert all(label != "unknown" for event in sure.run(u, shaken) for label, _ in event.candidates)


def test_two_faults_at_once_are_told_together():
    """No single one is claimed once the record contradicts it, and none is named beside the pair."""
    model, u = plant(), levels(320, 6)
    broken = [Fault.step("sensor:y1", 150, 2.0), Fault.step("sensor:y2", 150, 2.0)]
    monitor = watch(model, listed(model, "bias"), 60, 30.0)
    events = [e for e in monitor.run(u, inject(model, u, broken, seed=7)) if e.kind in ("isolated", "revised")]
    last = events[-1]
    assert last.candidates[0][0] == "sensor:y1 + sensor:y2" and last.note == "more than one fault"
    assert abs(last.onset - 150) <= 1 and np.allclose(last.size, 2.0, atol=0.3)
    assert all(e.sample <= 165 for e in events if "more than" not in e.note) and monitor.alarmed


def test_two_faults_are_not_taken_for_a_disturbance_of_unknown_direction():
    """One with as many magnitudes as the plant has states fits them within the noise, but less well than they do."""
    model, u = plant(), levels(320, 6)[:190]
    broken = [Fault.step("sensor:y1", 150, 2.0), Fault.step("actuator:u1", 150, 0.8)]
    found = diagnose(model, (u, inject(model, u, broken, seed=0)), listed(model, "bias", "loss"))
    assert {fault.name for fault in found.candidates[0].faults} == {"sensor:y1", "actuator:u1"}
    assert [fault.onset for fault in found.candidates[0].faults] == [150, 150]


def test_a_loss_without_excitation_gets_no_verdict_alone():
    u = levels(400, 4)
    u[100:] = [0.8, -0.5]
    found = listed(plant(), "stuck", sensors=[], state_jump=False)
    _, events = watched(found, u, Fault.loss("actuator:u1", 250, 1.0), 5, 50, 30.0)
    (named,) = [event for event in events if event.kind == "isolated"]
    assert named.candidates[0][0] == "actuator:u1 stuck"
    assert named.sample >= 250 + 10 and "not isolable from a constant" in named.note


def test_a_spike_is_a_spike():
    found = listed(plant(), "bias", "spike")
    monitor, events = watched(found, levels(300, 6), Fault.jump("sensor:y1", 150, 8.0), 7, 60, 30.0)
    assert [e.kind for e in events] == ["alarm", "isolated", "cleared"]
    assert events[1].candidates[0][0] == "sensor:y1 spike" and monitor.carried == ()


def test_refusals_name_what_is_wrong(tmp_path):
    model = plant()
    found = everything(model)
    some = {label: 30.0 for label in found.labels if label != "sensor:y1"}
    usual = {"model": model, "faults": found, "thresholds": np.full(len(found.labels), HIGH)}
    monitor, unlike = watch(model, found), "sample 1: .* give 2 and 2 numbers"
    assert monitor.step([0.0, None], [0.0, 0.0]) == []  # missing
    refused(
        *((StructureError, words, lambda how=how: Monitor(**(usual | how))) for how, words in (
            ({"window": 3}, "window=3"), ({"patiance": 3}, "patiance"), ({"model": plant(True)}, "another model"),
            ({"thresholds": [1.0]}, "one positive number for each"), ({"thresholds": some}, "none for sensor:y1"))),
        (DataError, "channel 'y2': sample 2 is inf", lambda: monitor.run(np.zeros((2, 2)), [[0, 0], [0, np.inf]])),
        (DataError, "2 samples and y has 3", lambda: monitor.run(np.zeros((2, 2)), np.zeros((3, 2)))),
        (DataError, "channel 'y1': sample 1 is inf", lambda: monitor.step([0, 0], [np.inf, 0])),
        *((DataError, unlike, lambda u=u, y=y: monitor.step(u, y)) for u, y in (
            ([1.0], [0.0, 0.0]), ([1.0, 2.0, 3.0], [0.0, 0.0]), ([0.0, 0.0], "ab"))),
    )
    assert "thresholds as given" in str(monitor) and max(map(len, str(monitor).splitlines())) <= 80
    with pytest.warns(DataWarning, match="sensor:y1 frozen is not monitored"):
        with_frozen = dictionary(model, kinds=["bias", "frozen"], sensors=["y1"], actuators=[])
        Monitor(model, with_frozen, thresholds=np.full(len(with_frozen.labels) - 1, 30.0))
    (tmp_path / "half.npz").write_bytes(monitor.save(tmp_path / "m.npz").read_bytes()[:2000])
    with pytest.raises(ModelFileError, match="not the complete state of a monitor"):
        Monitor.load(tmp_path / "half.npz")


def test_a_healthy_record_that_contradicts_the_noise_gives_its_own():
    model = plant()
    u = levels(1000, 8)
    loud = inject(model, u, Fault.sensor_noise("sensor", 0, scale=2.0), seed=9)
    with pytest.warns(DataWarning, match="size 1.70 times the predicted one.*taken from that record"):
        monitor = watch(model, everything(model), healthy=Data(u, loud))
    assert np.trace(monitor.dictionary.predictor.covariance) > 1.5 * np.trace(everything(model).predictor.covariance)


@st.composite
def systems(draw):
    """A stable plant with poles of any kind, one to three outputs, one or two inputs, and a share of lost readings."""
    n, m, l = draw(st.integers(1, 5)), draw(st.integers(1, 2)), draw(st.integers(1, 3))  # noqa: E741
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    A = rng.standard_normal((n, n))
    # below, what a jump leaves of the fifth state comes near the share at which columns count as dependent
    A *= draw(st.floats(0.5, 0.95)) / np.abs(np.linalg.eigvals(A)).max()
    D = rng.standard_normal((l, m)) * draw(st.sampled_from([0.0, 0.3]))
    model = noisy(A, rng.standard_normal((n, m)), rng.standard_normal((l, n)), 0.1 * np.eye(n), 0.2 * np.eye(l), D=D,
                  L=0.1 * rng.standard_normal((n, l)) * draw(st.integers(0, 1)))
    lost = draw(st.sampled_from([0.0, 0.1, 0.5]))
    return model, lost, draw(st.integers(12, 60)), rng


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(systems())
def test_random_plants_against_dense_least_squares(system):
    model, lost, count, rng = system
    found, u = listed(model, "bias", "loss", "stuck", "drift", "spike"), rng.standard_normal((count, model.m))
    y = inject(model, u, seed=1)
    y[rng.random(y.shape) < lost] = np.nan
    window = max(2 * model.nx + 2, 20)
    monitor = watch(model, found, window=window, x0="zero")
    monitor.run(u, y)
    most, least = (dense(found, window, u, y, share=share) for share in (1e-12, 1e-6))
    for label, value in monitor.statistics.items():  # the two differ only where a direction is nearly dependent
        assert least[label][0] * (1 - 1e-6) - 1e-9 <= value <= most[label][0] * (1 + 1e-6) + 1e-9, label
