"""Faults of any course: the consistent set keeps its promise, its energies are those of dense least squares."""

from dataclasses import replace

import numpy as np
import pytest
from fault_plants import LOAD, levels, noisy, record, refused
from scipy.stats import chi2, kstest
from test_fault_injection import small

from optid import Data
from optid.errors import DataError, LookupFailed, StructureError
from optid.faults import Fault, dictionary, inject, model_uncertainty, waveform_test, whiten
from optid.faults.consistency.waveforms import waveform_matrix

N = 50


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD}, kinds=["bias", "loss", "frozen", "noise"])


@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("onset", [0, 20])
def test_columns_are_the_signatures_of_steps_summed(found, missing, onset):
    data = record(found.model, 1, missing=missing)
    white = whiten(found.model, data, x0="zero")
    u = data.experiments[0].u
    for label in ("actuator:u1", "sensor:y2", "process:load", "actuator:u2 loss"):
        c = found[label]
        matrix = waveform_matrix(found, c, white, onset, u=u)
        for start in (onset, onset + 7):
            step = np.arange(onset, N) >= start
            direct = found.signature(c, N, start, u=u, present=white.present)
            np.testing.assert_allclose(matrix @ step, direct.ravel(), atol=1e-9)


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_energies_are_those_of_dense_least_squares(found, missing):
    white = whiten(found.model, record(found.model, 2, missing=missing), x0="zero")
    test, r = waveform_test(found, white, onset=15), white.r.ravel()
    start = waveform_matrix(found, found["state"], white)[:, :3]
    for place in test.places:
        whole = np.hstack([waveform_matrix(found, found[place.labels[0]], white, 15), start])
        solved, _, rank, _ = np.linalg.lstsq(whole, r, rcond=1e-10)
        assert place.energy == pytest.approx(float(np.sum((r - whole @ solved) ** 2)), rel=1e-8)
        assert place.freedom == white.present.sum() - rank
        assert place.limit == pytest.approx(chi2.ppf(0.99, place.freedom))
        assert place.p_value == pytest.approx(chi2.sf(place.energy, place.freedom), rel=1e-6, abs=1e-12)
    assert {p.name for p in test.places} == {"actuator:u1", "actuator:u2", "sensor:y1", "sensor:y2", "process:load"}
    assert set(test.untested) == {"state", "sensor:y1 noise", "sensor:y2 noise", "process:load noise"}


@pytest.mark.slow
def test_the_true_place_has_uniform_p_values_whatever_the_course(found):
    rng, p_values = np.random.default_rng(0), {"actuator:u1": [], "sensor:y2": []}
    for run in range(120):
        label = list(p_values)[run % 2]
        data = record(found.model, run)
        white = whiten(found.model, data)  # the start is fitted
        matrix = waveform_matrix(found, found[label], white)
        course = np.cumsum(rng.standard_t(3, N)) * 10 * (rng.random(N) < 0.5)
        shifted = replace(white, r=white.r + (matrix @ course).reshape(N, 2))
        p_values[label].append(waveform_test(found, shifted)[label].p_value)
    for values in p_values.values():
        assert kstest(values, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("fault, place", [
    (Fault.frozen("sensor:y2", 20), "sensor:y2"), (Fault.stuck("actuator:u1", 20, 1.1), "actuator:u1"),
    (Fault.loss("actuator:u1", 20, 1.0), "actuator:u1"), (Fault.ramp("sensor:y1", 20, 0.1), "sensor:y1"),
    (Fault.step("process:load", 20, 2.0), "process:load")])
def test_any_course_is_named_by_its_place(found, fault, place):
    test = waveform_test(found, whiten(found.model, record(found.model, 5, fault), x0="zero"), onset=15)
    assert place in test.consistent[:2] and test[place].consistent and not test.healthy.consistent
    text = str(test)
    assert max(map(len, text.splitlines())) <= 80 and "in the set" in text and "ruled out" in text


def test_a_healthy_window_keeps_every_place(found):
    test = waveform_test(found, whiten(found.model, record(found.model, 8)))
    assert test.healthy.consistent and set(test.consistent) == {p.name for p in test.places}


def test_the_course_is_estimated(found):
    data = record(found.model, 3)
    white = whiten(found.model, data, x0="zero")
    matrix, k = waveform_matrix(found, found["sensor:y1"], white), np.arange(N)
    course = 30 * np.sin(k / 5)
    test = waveform_test(found, replace(white, r=white.r + (matrix @ course).reshape(N, 2)))
    assert test.best == "sensor:y1"
    assert np.sqrt(np.nanmean((test["sensor:y1"].course[:, 0] - course) ** 2)) < 0.1 * 30


def test_three_equal_readings_name_a_frozen_sensor_at_once(found):
    data = record(found.model, 6, Fault.frozen("sensor:y1", N - 3))
    test = waveform_test(found, whiten(found.model, data), data=data)
    assert test.consistent == ("sensor:y1",) and test.best == "sensor:y1"
    assert test.flat[0].count >= 3 and "readings of exactly" in str(test)
    healthy = record(found.model, 6)
    assert waveform_test(found, whiten(found.model, healthy), data=healthy).flat == ()


def test_an_uncertain_model_widens_nothing_it_should_not(found):
    u = levels(400, 9)
    uncertain = model_uncertainty(found.model, Data(u, inject(found.model, u, seed=9)))
    white = whiten(found.model, record(found.model, 7, Fault.step("sensor:y2", 20, 1.0)), uncertainty=uncertain)
    assert "sensor:y2" in waveform_test(found, white, onset=15).consistent


def test_refusals(found):
    white = whiten(found.model, record(found.model, 0))
    one = dictionary(noisy([[0.5]], [[1.0]], [[1.0]], [[0.04]], [[0.01]]))
    alone = whiten(one.model, Data(levels(N, 0, m=1), np.zeros((N, 1))))
    bad = np.where(np.arange(N)[:, None] == 3, np.nan, white.r)
    refused(
        (StructureError, "Not isolable with one output", lambda: waveform_test(one, alone)),
        (DataError, "outputs", lambda: waveform_test(found, alone)),
        *((StructureError, "probability=", lambda p=p: waveform_test(found, white, p)) for p in (0.0, 1.0, 2.0)),
        *((StructureError, "onset=", lambda k=k: waveform_test(found, white, onset=k)) for k in (-1, N, 1.5)),
        (StructureError, "one experiment", lambda: waveform_test(found, (white, white))),
        (StructureError, "too many for this test", lambda: waveform_test(found, replace(white, r=np.zeros((4000, 2))))),
        (DataError, "'y1' at sample 3", lambda: waveform_test(found, replace(white, r=bad))),
        (LookupFailed, "as many directions as outputs", lambda: waveform_test(found, white)["state"]),
        (LookupFailed, "was not tested", lambda: waveform_test(found, white)["sensor:y7"]),
        (DataError, "longer window",
         lambda: waveform_test(found, whiten(found.model, record(found.model, 0, count=3), x0="zero"))))
