"""More noise at one place: the likelihood is that of the full covariance."""

from dataclasses import replace

import numpy as np
import pytest
from fault_plants import LOAD, record, refused
from scipy.stats import multivariate_normal
from test_fault_injection import small

from optid.errors import DataError, LookupFailed, StructureError
from optid.faults import Fault, dictionary, noise_search, noise_test, whiten
from optid.faults.consistency.noise_changes import noise_places
from optid.faults.consistency.waveforms import start_matrix, waveform_matrix

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
    assert max(map(len, str(test).splitlines())) <= 80


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


def test_bad_input(found):
    w = white(found, 0)
    bad = replace(w, r=np.where(np.arange(N)[:, None] == 5, np.inf, w.r))

    def test(w=w, **how):
        return noise_test(found, w, **{"draws": 1000, **how})

    refused(
        *((StructureError, "false_alarm=", lambda p=p: test(false_alarm=p)) for p in (0.0, 1.0)),
        (DataError, "at least 100000", lambda: test(false_alarm=1e-4)),
        *((StructureError, "onset=", lambda k=k: test(onset=k)) for k in (-1, N, 2.5)),
        (DataError, "'y1' at sample 5", lambda: test(bad)),
        (StructureError, "one experiment|one by one", lambda: test((w, w))),
        (LookupFailed, "was not tested", lambda: test()["sensor:y3"]))
