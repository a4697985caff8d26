"""The search for one fault: equal to dense least squares on random models, thresholds that keep their rate."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from fault_plants import LOAD, levels, noisy, refused
from fault_plants import record as plants_record
from state_systems import with_feedback
from test_fault_injection import small

from optid import Data
from optid.errors import DataError, DataWarning, LookupFailed, StructureError
from optid.faults import Fault, dictionary, inject, model_uncertainty, scan, thresholds, whiten
from optid.faults.search.sweeps import sweep

KINDS = ["bias", "drift", "loss", "stuck"]


def random_model(seed, n=3, m=2, l=2):  # noqa: E741
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    Q = rng.normal(size=(n, n))
    return noisy(A, rng.normal(size=(n, m)), rng.normal(size=(l, n)), 0.1 * Q @ Q.T + 0.01 * np.eye(n),
                 np.diag(rng.uniform(0.1, 1.0, l)), D=rng.normal(size=(l, m)), L=0.1 * rng.normal(size=(n, l)))


def record(model, count, seed, gaps=0.0, fault=()):
    return plants_record(model, seed, fault, gaps, count)


def dense(found, white, u, label):
    """Energies, magnitudes and covariances of a candidate at every onset, by least squares on the whole window."""
    count, l = white.r.shape  # noqa: E741
    energies, sizes, spreads = [], [], []
    for onset in range(count):
        G = white.whiten_signature(white.predictor.respond(*found.additions(label, count, onset, u), white.present))
        G = G.reshape(count * l, -1)
        nu = np.linalg.lstsq(G, white.r.ravel(), rcond=1e-6)[0]
        energies.append(float(np.sum((G @ nu) ** 2)))
        sizes.append(nu)
        spreads.append(np.linalg.pinv(G.T @ G, rcond=1e-12))
    return np.array(energies), np.array(sizes), np.array(spreads)


def sensor_gain(candidate):
    return candidate.kind == "loss" and candidate.name.startswith("sensor:")


def compare(found, white, u):
    result = scan(found, white, u)
    assert max(map(len, str(result).splitlines())) <= 80
    for c, candidate in enumerate(found.candidates):
        if sensor_gain(candidate):  # it multiplies what the sensor reads: no least squares
            assert np.isnan(result.statistic[c]).all()
            continue
        energies, sizes, spreads = dense(found, white, u, candidate.label)
        tested = ~np.isnan(result.statistic[c])
        needed = -(-candidate.dimension // found.model.l)
        assert not tested[len(tested) - needed + 1 :].any() and tested[10:-10].all()
        np.testing.assert_allclose(result.statistic[c, tested], energies[tested], rtol=1e-7, atol=1e-7)
        for onset in np.flatnonzero(tested)[5:-10:7]:
            found_nu, covariance = result.estimate(candidate, int(onset))
            np.testing.assert_allclose(found_nu, sizes[onset], rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(covariance, spreads[onset], rtol=1e-4, atol=1e-8)
        peak = result.peak(candidate.label)
        assert tested[peak] and abs(energies[peak] - energies[tested].max()) < 1e-7 * (1 + energies[peak])
        np.testing.assert_allclose(
            result.signature(candidate, 20), white.whiten_signature(white.predictor.respond(
                *found.additions(candidate, len(white.r), 20, u), white.present)))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("gaps", [0.0, 0.15])
@pytest.mark.parametrize("shape", [(3, 2, 2), (1, 1, 1), (5, 1, 3), (2, 3, 1)])
def test_every_candidate_at_every_onset_is_dense_least_squares(shape, gaps):
    for seed in range(3):
        model = random_model(seed, *shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # groups and angles are not the matter here
            found = dictionary(model, kinds=KINDS, process={"load": np.ones(shape[0])})
        data = record(model, 50, seed, gaps)
        compare(found, whiten(model, data, x0="zero"), data.experiments[0].u)


def test_several_functions_of_one_input():
    model = with_feedback(feedback=(), E=None, output_of=())
    found = dictionary(model, kinds=KINDS)
    data = Data(0.5 * np.random.default_rng(0).normal(size=(45, 2)), np.zeros((45, 2)), dt=0.5, outputs=["p", "q"])
    y = inject(model, data.experiments[0].u, seed=1)
    data = Data(data.experiments[0].u, y, dt=0.5, outputs=["p", "q"])
    assert sorted({c.dimension for c in found.candidates}) == [1, 2, 3]
    compare(found, whiten(model, data, x0="zero"), data.experiments[0].u)


@pytest.mark.parametrize("x0", ["fit", "zero"])
def test_an_uncertain_model(x0):
    model = small()
    identified = model_uncertainty(model, record(model, 120, 7))
    found = dictionary(model, kinds=KINDS, process={"load": LOAD})
    data = record(model, 50, 3, 0.05)
    white = whiten(model, data, x0=x0, uncertainty=identified)
    assert white.nuisance is not None
    compare(found, white, data.experiments[0].u)


def scheduled(N=60):
    rng = np.random.default_rng(5)
    model = random_model(4, 3, 2, 2)
    A = np.array([model.A + 0.15 * np.sin(0.2 * k) * rng.normal(size=(3, 3)) for k in range(N)])
    B = np.array([model.B * (1 - 0.5 * k / N) for k in range(N)])
    return model, A, B


@pytest.mark.slow
@pytest.mark.parametrize("gaps", [0.0, 0.15])
def test_a_scheduled_change_is_the_difference_of_two_predictors(gaps):
    """By hand: one predictor with the healthy matrices, one that follows A(k) and B(k) from the onset on."""
    model, A, B = scheduled()
    found = dictionary(model, schedules={"wear": Fault.schedule(A=A, B=B), "B": Fault.schedule(B=lambda k: B[k])},
                       state_jump=False)
    data = record(model, 60, 3, gaps, Fault.schedule(30, A=A, B=B))
    u, y = data.experiments[0].u, data.experiments[0].y
    white = whiten(model, data, x0="zero")
    result, K = scan(found, white, u), white.predictor.K

    def innovations(onset, change_A, change_B):
        x, errors = np.zeros(3), []
        for k in range(60):
            predicted = model.C @ x + model.D @ u[k]
            there = ~np.isnan(y[k])
            errors.append(np.where(there, y[k] - predicted, 0.0))
            on = k >= onset - 1
            x = (A[k] if on and change_A else model.A) @ x + (B[k] if on and change_B else model.B) @ u[k] + \
                K @ errors[-1] + model.L @ np.where(there, y[k], predicted)
        return np.array(errors)

    healthy = innovations(99, False, False)
    np.testing.assert_allclose(white.predictor.whiten(healthy, white.present), white.r, atol=1e-9)
    for label, both in (("process:wear schedule", True), ("process:B schedule", False)):
        energies = []
        for onset in range(1, 60):
            G = white.predictor.whiten(healthy - innovations(onset, both, True), white.present)
            np.testing.assert_allclose(result.signature(label, onset)[:, :, 0], G, atol=1e-9)
            energies.append(np.sum(G * white.r) ** 2 / np.sum(G**2))
        row = result.statistic[result.index(label), 1:]
        there = ~np.isnan(row)
        assert there[:55].all()
        np.testing.assert_allclose(row[there], np.array(energies)[there], rtol=1e-7)
    without = scan(dictionary(model, state_jump=False), white, u)  # the others are what they are without a schedule
    same = [result.index(label) for label in without.labels]
    np.testing.assert_allclose(result.statistic[same], without.statistic, rtol=1e-9, atol=1e-9)
    limits = thresholds(found, white, u=u, draws=5000)
    gains = result.gains(limits)
    c, onset = np.unravel_index(np.nanargmax(gains), gains.shape)
    assert found.labels[c] == "process:wear schedule" and abs(onset - 30) <= 12  # the change sets in slowly
    nu, covariance = result.estimate(found.labels[c], 30)
    assert abs(nu[0] - 1) < 4 * np.sqrt(covariance[0, 0]) < 2


def test_a_share_of_a_scheduled_change_of_B_is_estimated():
    model = small()
    half = Fault.schedule(80, B=0.5 * model.B)
    found = dictionary(model, schedules={"lost": Fault.schedule(B=0 * model.B)}, kinds=["bias", "loss"])
    data = record(model, 200, 3, 0.0, half)
    u = data.experiments[0].u
    result = scan(found, whiten(model, data, x0="zero"), u)
    nu, covariance = result.estimate("process:lost schedule", 80)
    assert abs(nu[0] - 0.5) < 4 * np.sqrt(covariance[0, 0]) < 0.1


def test_scheduled_changes_need_states_and_matrices_that_fit():
    model, A, B = scheduled()
    data = record(model, 60, 3)
    white, u = whiten(model, data, x0="zero"), data.experiments[0].u
    found = dictionary(model, schedules={"wear": Fault.schedule(A=A)})
    c = found.labels.index("process:wear schedule")
    for one in (scan(found, white), scan(found, replace(white, states=None), u)):
        assert np.isnan(one.statistic[c]).all()
    refused(
        (StructureError, "depends on the states", lambda: found.signature("process:wear schedule", 60)),
        (DataError, "states have 30 samples; the window has 60",
         lambda: scan(found, replace(white, states=white.states[:30]), u)),
        (StructureError, "A has shape",
         lambda: scan(dictionary(model, schedules={"wear": Fault.schedule(A=A[:7])}), white, u)),
        (StructureError, "not finite",
         lambda: scan(dictionary(model, schedules={"wear": Fault.schedule(B=np.nan * B)}), white, u)),
        (StructureError, "Fault.schedule",
         lambda: dictionary(model, schedules={"wear": Fault.step("state", 0, [1.0, 1.0, 1.0])})),
    )


def test_states_of_the_predictor_with_feedback_and_gaps():
    model = with_feedback()
    u = 0.3 * np.random.default_rng(0).normal(size=(40, 2))
    y = inject(model, u, seed=1)
    y[7, 0] = y[20] = np.nan
    white = whiten(model, Data(u, y, dt=0.5, outputs=["p", "q"]), x0=[0.1, 0.0, -0.1])
    predicted = white.states @ model.C.T + model.expand_inputs(u) @ model.D.T + model.offset_y
    np.testing.assert_allclose((y - predicted)[white.present], white.innovations[white.present], atol=1e-9)


def test_only_the_onsets_asked_for():
    found, data = dictionary(small()), record(small(), 60, 0)
    white = whiten(small(), data)
    whole = scan(found, white)
    for onsets in ([20, 25, 30], slice(20, 31, 5)):
        part = scan(found, white, onsets=onsets)
        np.testing.assert_array_equal(np.flatnonzero(~np.isnan(part.statistic[0])), [20, 25, 30])
        np.testing.assert_array_equal(part.statistic[:, 25], whole.statistic[:, 25])
    for onsets in ([-1], [60], [], [1.5]):
        with pytest.raises(StructureError, match="onsets"):
            scan(found, white, onsets=onsets)


def test_what_has_no_signature_is_not_tested():
    found = dictionary(small(), kinds=["bias", "loss", "frozen", "noise"])
    data = record(small(), 60, 0)
    white = whiten(small(), data)
    result, limits = scan(found, white), thresholds(found, 60, draws=5000)
    silent = np.array([c.kind in ("loss", "frozen", "noise") for c in found.candidates])
    np.testing.assert_array_equal(np.isnan(result.statistic).all(axis=1), silent)
    np.testing.assert_array_equal(np.isnan(limits.q), silent)
    assert "not tested" in str(result) and "not tested" in str(limits)
    with pytest.raises(StructureError, match="no peak"):
        result.peak("sensor:y1 frozen")
    with pytest.raises(StructureError, match="arbitrary waveform"):
        result.signature("sensor:y1 frozen", 10)
    still = scan(found, white, np.zeros((60, 2)))
    assert np.isnan(still.statistic[result.index("actuator:u1 loss")]).all()  # f(0) = 0: nothing to lose


def in_closed_loop(model, fault, seed, count=80):
    """Inputs and readings under a controller: what it does is repeated until it fits the readings it causes."""
    reference = np.random.default_rng(seed).normal(size=(count, 2))
    u = np.zeros((count, 2))
    for _ in range(count + 1):
        y = inject(model, u, fault, seed=seed)
        before, u = u, np.zeros((count, 2))
        for k in range(1, count):
            u[k] = np.tanh(0.5 * u[k - 1] + 0.3 * (reference[k] - y[k - 1]))
    np.testing.assert_array_equal(before, u)
    return Data(u, y)


@pytest.mark.parametrize("fault", [(), Fault.step("sensor:y1", 40, 0.8), Fault.jump("state", 50, [1.0, 0.5, -1.0])],
                         ids=str)
def test_a_controller_that_is_not_known_changes_nothing(fault):
    """With the same noise the innovations of open and of closed loop are the same, and so is the search."""
    model = small()
    found = dictionary(model, process={"load": LOAD})
    closed = in_closed_loop(model, fault, 3)
    loose = whiten(model, Data(levels(80, 9), inject(model, levels(80, 9), fault, seed=3)), x0="zero")
    strict = whiten(model, closed, x0="zero")
    np.testing.assert_allclose(strict.r, loose.r, atol=1e-9)
    np.testing.assert_allclose(scan(found, strict).statistic, scan(found, loose).statistic, atol=1e-8)


def test_a_loss_in_closed_loop_is_named():
    model = small()
    found = dictionary(model, kinds=["bias", "loss"])
    data = in_closed_loop(model, Fault.loss("actuator:u2", 40, 0.9), 3)
    u = data.experiments[0].u
    result = scan(found, whiten(model, data, x0="zero"), u)
    gains = result.gains(thresholds(found, 80, u=u, draws=5000))
    c, onset = np.unravel_index(np.nanargmax(gains), gains.shape)
    assert gains[c, onset] > 0 and found.labels[c] == "actuator:u2 loss" and abs(onset - 40) <= 4


# -- thresholds ------------------------------------------------------------------------------------------------------


def test_thresholds_keep_the_rate_of_the_family():
    found = dictionary(small(), kinds=["bias", "loss", "stuck"])
    u = levels(60, 0)
    limits = thresholds(found, 60, 0.02, u=u, seed=1)
    fresh = sweep(found, 60, u=u).largest(np.random.default_rng(2).normal(size=(20_000, 60, 2)))
    assert abs(np.mean(np.any(fresh > limits.q, axis=1)) - 0.02) < 0.004
    swept = [not sensor_gain(c) for c in found.candidates]
    shares = np.mean(fresh > limits.q, axis=0)[swept]
    assert shares.max() / shares.min() < 1.8
    np.testing.assert_array_equal(thresholds(found, 60, 0.02, u=u, seed=1).q, limits.q)


def test_thresholds_of_a_typical_input_hold_on_the_average():
    found = dictionary(small(), kinds="loss", state_jump=False)
    limits, rng = thresholds(found, 40, 0.05, u=levels(4000, 0), seed=1), np.random.default_rng(2)
    rates = [
        np.mean(np.any(prepared.largest(rng.normal(size=(200, 40, 2))) > limits.q, axis=1))
        for prepared in (sweep(found, 40, u=levels(40, 100 + i)) for i in range(100))]
    assert abs(np.mean(rates) - 0.05) < 0.006


@pytest.mark.slow
def test_thresholds_of_a_window_with_gaps_and_an_uncertain_model():
    model = small()
    found, data = dictionary(model), record(model, 60, 3, 0.3)
    white = whiten(model, data, uncertainty=model_uncertainty(model, record(model, 120, 7)))
    limits = thresholds(found, white, 0.02, seed=1)
    fresh = np.random.default_rng(2).normal(size=(3000, 60, 2))
    shown = np.where(white.present, fresh, 0.0)
    windows = [np.nanmax(scan(found, replace(white, r=r)).statistic, axis=1) for r in shown]
    assert abs(np.mean(np.any(windows > limits.q, axis=1)) - 0.02) < 0.01


def test_bad_input():
    found, data = dictionary(small(), kinds=["bias", "loss"]), record(small(), 60, 0)
    white, u = whiten(small(), data), data.experiments[0].u
    spoilt = (np.arange(60)[:, None] == 3) & [True, False]
    refused(
        (StructureError, "one by one", lambda: scan(found, (white, white))),
        (DataError, "u has 50 samples; the window has 60", lambda: scan(found, white, u[:50])),
        (DataError, "'u2' is missing at sample 7",
         lambda: scan(found, white, np.where((np.arange(60)[:, None] == 7) & [False, True], np.nan, u))),
        (DataError, "'y1' at sample 3 is not finite",
         lambda: scan(found, replace(white, r=np.where(spoilt, np.inf, white.r)))),
        (DataError, "1 outputs", lambda: scan(found, replace(white, r=white.r[:, :1]))),
        (StructureError, "at least 8 samples", lambda: thresholds(found, 7)),
        (StructureError, "false_alarm=", lambda: thresholds(found, 60, 1.0)),
        (DataError, "at least 50000000 draws", lambda: thresholds(found, 60, 1e-6)),
        (DataError, "at least those of the window", lambda: thresholds(found, 60, u=u[:30])),
        (StructureError, "other candidates",
         lambda: scan(found, white).gains(thresholds(dictionary(small()), 60, draws=5000))),
        (LookupFailed, "actuator:u9", lambda: scan(found, white).peak("actuator:u9")),
        (StructureError, "No candidate has a signature",
         lambda: scan(dictionary(small(), kinds="loss", state_jump=False), white)),
        (StructureError, "not tested at onset 60", lambda: scan(found, white).estimate("actuator:u1", 60)),
    )
