"""More noise at one place: the likelihood is that of the full covariance; covariance matching by NNLS and by an SDP."""

from dataclasses import replace

import numpy as np
import pytest
from fault_plants import LOAD, record, refused
from scipy.optimize import nnls
from scipy.stats import multivariate_normal
from test_fault_injection import small

from optid.backends import Answer, BackEnd
from optid.errors import DataError, LookupFailed, StructureError
from optid.faults import Fault, dictionary, noise_covariance, noise_search, noise_test, whiten
from optid.faults.consistency.noise_changes import noise_places
from optid.faults.consistency.noise_matching import covariance_problem
from optid.faults.consistency.waveforms import start_matrix, waveform_matrix
from optid.program.solution import Status

N = 40


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD}, kinds=["bias", "noise"])


def white(found, seed, fault=(), count=N, missing=0.0, **how):
    return whiten(found.model, record(found.model, seed, fault, missing, count), **{"x0": "zero", **how})


@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("onset", [0, 12])
def test_the_likelihood_is_that_of_the_full_covariance(found, missing, onset):
    w = white(found, 1, Fault.sensor_noise("sensor:y1", 10, scale=3.0), missing=missing)
    search = noise_search(found, w, onset=onset, free_start=False)
    there = w.present.ravel()
    for place, (_, candidate) in zip(search.places, noise_places(found)):
        H = waveform_matrix(found, candidate, w, onset)[there]
        for rho in (0.0, 0.01, 0.7):
            full = multivariate_normal(cov=np.eye(there.sum()) + rho * H @ H.T)
            healthy = multivariate_normal(cov=np.eye(there.sum()))
            r = w.r.ravel()[there]
            z2 = (w.r.reshape(1, -1) @ place.axes) ** 2
            expected = full.logpdf(r) - healthy.logpdf(r)
            assert place.likelihood(np.array([rho]), z2)[0, 0] == pytest.approx(expected, rel=1e-8, abs=1e-8)
        best, gain = place.maximise(w.r.reshape(1, -1))
        scan = np.linspace(0, 3 * best[0] + 1e-3, 4001)
        assert gain[0] >= place.likelihood(scan, (w.r.reshape(1, -1) @ place.axes) ** 2).max() - 1e-6


def test_a_wrong_start_changes_nothing(found):
    w = white(found, 2)
    moved = replace(w, r=w.r + 50 * (start_matrix(w) @ [1.0, -2.0, 0.5]).reshape(N, 2))
    a, b = (noise_test(found, x, draws=1000) for x in (w, moved))
    for change in a.changes:
        assert b[change.label].gain == pytest.approx(change.gain, abs=1e-6)


@pytest.mark.parametrize("fault, label", [
    (Fault.sensor_noise("sensor:y1", 0, scale=3.0), "sensor:y1 noise"),
    (Fault.sensor_noise("sensor:y2", 0, scale=3.0), "sensor:y2 noise"),
    (Fault.process_noise("process:load", 0, std=0.8), "process:load noise")])
def test_noise_is_named_and_measured(found, fault, label):
    w = white(found, 4, fault, count=150)
    test = noise_test(found, w, draws=1000)
    assert test.detected and test.best.label == label and label in test.consistent
    true = 0.8 if fault.std is not None else np.sqrt(8 * found.model.noise.R[int(label[8]) - 1, int(label[8]) - 1])
    low, high = test.best.interval
    assert low < true**2 < high and abs(np.log(test.best.std / true)) < 0.4
    if fault.scale is not None:
        assert abs(test.best.scale - 3.0) < 0.8
    match = noise_covariance(found, w)
    assert match.best == label and match.certified and match.gap < 1e-6
    assert abs(np.log(np.sqrt(match.rho[match.labels.index(label)]) / true)) < 0.6
    for text in (str(test), str(match)):
        assert max(map(len, text.splitlines())) <= 80


@pytest.mark.slow
def test_healthy_windows_alarm_as_often_as_asked(found):
    search = noise_search(found, white(found, 0))
    levels_ = search.healthy(4000, 1)
    p = [noise_test(found, white(found, s, x0="fit"), search=search, healthy=levels_).p_value for s in range(150)]
    assert 1 <= sum(value <= 0.1 for value in p) <= 30
    assert np.mean(p) == pytest.approx(0.5, abs=0.1)


def test_intervals_of_the_variance_cover(found):
    hits = 0
    for seed in range(60):
        w = white(found, seed, Fault.sensor_noise("sensor:y1", 0, scale=2.0))
        search = noise_search(found, w)
        low, high = noise_test(found, w, search=search, healthy=np.zeros(1000))["sensor:y1 noise"].interval
        hits += low <= 3 * found.model.noise.R[0, 0] <= high
    assert hits >= 52


# -- covariance matching ----------------------------------------------------------------------------------------------


def test_signatures_are_covariances_of_the_innovations(found):
    problem = covariance_problem(found, white(found, 1, count=200), lags=6)
    assert problem.signatures.shape == (3 + 6 * 4, 3)
    noise = found.model.noise
    Q = 0.04 * np.outer(LOAD, LOAD)
    whole = problem.by_process @ Q.ravel(order="F")
    load = problem.signatures[:, problem.labels.index("process:load noise")]
    np.testing.assert_allclose(whole, 0.04 * load, rtol=1e-9)
    # twice all the noise of the plant: covariances of the innovations double
    doubled = problem.by_process @ noise.Q.ravel(order="F") + problem.by_sensor @ noise.R.ravel(order="F")
    weights = np.sqrt(200 / np.array([2.0, 1.0, 2.0]))
    np.testing.assert_allclose(doubled[:3], weights * [1, 0, 1], atol=1e-6)
    np.testing.assert_allclose(doubled[3:], 0, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_places_are_non_negative_least_squares(found, seed):
    w = white(found, seed, Fault.sensor_noise("sensor:y1", 0, scale=1.5), count=120, missing=0.1 * (seed == 2))
    problem = covariance_problem(found, w)
    known = nnls(problem.signatures, problem.target)
    for solver in ("auto", "osqp", "piqp"):
        match = noise_covariance(found, w, solver=solver)
        assert match.certified and match.objective == pytest.approx(0.5 * known[1] ** 2, rel=1e-6)
        np.testing.assert_allclose(match.gains, known[0] * np.linalg.norm(problem.signatures, axis=0), atol=2e-3)


def test_full_covariances_fit_at_least_as_well_and_are_semidefinite(found):
    w = white(found, 3, Fault.sensor_noise("sensor:y2", 0, scale=3.0), count=200)
    places, full = noise_covariance(found, w), noise_covariance(found, w, form="full")
    assert full.certified and full.objective <= places.objective * (1 + 1e-6)
    assert np.linalg.eigvalsh(full.Q)[0] > -1e-7 and np.linalg.eigvalsh(full.R)[0] > -1e-7
    added = 8 * found.model.noise.R[1, 1]
    assert abs(full.R[1, 1] / added - 1) < 0.5 and full.R[0, 0] < 0.3 * added
    with pytest.raises(StructureError, match="no place"):
        _ = full.best
    assert "sensor noise" in str(full)


def test_constraints_and_solvers_that_fail(found):
    w = white(found, 3, Fault.sensor_noise("sensor:y2", 0, scale=3.0), count=100)
    free = noise_covariance(found, w)
    i = free.labels.index("sensor:y2 noise")
    held = noise_covariance(found, w, constraints=[lambda v: {"known": v["rho"][i] <= 0.5 * free.rho[i]}])
    assert held.rho[i] == pytest.approx(0.5 * free.rho[i], rel=1e-5) and held.objective > free.objective
    broken = BackEnd("broken", frozenset({"QP"}), lambda *_: Answer(Status.FAILED, "no memory"))
    failed = noise_covariance(found, w, solver=broken)
    assert not failed.certified and np.isnan(failed.rho).all() and "no memory" in str(failed)
    liar = BackEnd("liar", frozenset({"QP"}), lambda program, _: Answer(
        Status.OPTIMAL, "optimal", {name: np.ones(v.shape) for name, v in program.variables.items()}, {}))
    assert not noise_covariance(found, w, solver=liar).certified


def test_bad_input(found):
    w = white(found, 0)
    bad = replace(w, r=np.where(np.arange(N)[:, None] == 5, np.inf, w.r))

    def test(w=w, **how):
        return noise_test(found, w, **{"draws": 1000, **how})

    refused(
        *((StructureError, "false_alarm=", lambda p=p: test(false_alarm=p)) for p in (0.0, 1.0)),
        (DataError, "at least 100000", lambda: test(false_alarm=1e-4)),
        *((StructureError, "onset=", lambda k=k: test(onset=k)) for k in (-1, N, 2.5)),
        *((StructureError, "onset=", lambda k=k: noise_covariance(found, w, onset=k)) for k in (-1, N, 2.5)),
        *((DataError, "'y1' at sample 5", act) for act in (lambda: test(bad), lambda: noise_covariance(found, bad))),
        *((StructureError, "one experiment|one by one", act) for act in (
            lambda: test((w, w)), lambda: noise_covariance(found, (w, w)))),
        (StructureError, "form=", lambda: noise_covariance(found, w, form="half")),
        *((StructureError, "lags=", lambda k=k: noise_covariance(found, w, lags=k)) for k in (-1, N, 1.5)),
        (DataError, "too few", lambda: noise_covariance(found, w, lags=N - 5)),
        (LookupFailed, "was not tested", lambda: test()["sensor:y3"]),
    )
