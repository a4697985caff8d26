"""Isolability: the fast search equals dense least squares, thresholds keep their rate, forecasts meet a simulation."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from commands import run
from fault_plants import LOAD, levels, noisy, refused, standard
from scipy.stats import chi2, ncx2
from test_fault_injection import small

from optid import Data
from optid.errors import DataError, LookupFailed, StructureError
from optid.faults import Fault, dictionary, inject, isolability, whiten
from optid.faults.false_alarms import family_thresholds
from optid.faults.isolability_study import GRID, MIDDLE
from optid.faults.search.sweeps import sweep


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD}, kinds=["bias", "drift"])


@pytest.fixture(scope="module")
def standard_study(real_data):
    model, load = standard(real_data)
    faults = dictionary(model, process={"load": load})
    return model, load, faults, isolability(faults, 100)


def test_one_candidate_with_a_known_onset_has_the_law_of_chi_square():
    alone = dictionary(small(), actuators=[], sensors=["y1"], state_jump=False)
    study = isolability(alone, 60, onset=30, draws=20_000, calibration=100_000, false_alarm=0.01)
    limit = chi2.isf(0.01, 1)
    assert abs(study.thresholds[0] / limit - 1) < 0.03
    d = np.array([1.0, 2.0, 3.0, 5.0])
    np.testing.assert_allclose(np.interp(d, GRID, study.detected[0]), ncx2.sf(limit, 1, d**2), atol=0.02)
    np.testing.assert_array_equal(study.detected, study.isolated)
    needed = np.interp(0.95, ncx2.sf(limit, 1, np.linspace(0, 6, 601) ** 2), np.linspace(0, 6, 601))
    assert abs(study.deflection("sensor:y1", study.detectable[0]) - needed) < 0.05
    signature = alone.signature("sensor:y1", 60, 30)
    assert abs(study.unit[0] - np.linalg.norm(signature)) < 1e-9 and study.rivals == ("",)


def test_two_rivals_at_a_known_onset_follow_the_formula():
    """Far above the threshold the right one of two wins when noise does not bridge half the distance between them."""
    near = small().B[:, 0] + [0.1, 0.25, -0.1]
    both = dictionary(small(), actuators=["u1"], sensors=[], process={"near": near}, state_jump=False)
    study = isolability(both, 60, onset=20, draws=20_000, calibration=20_000)
    from scipy.stats import norm

    sine = study.sines[0, 1]
    first, second = (both.signature(label, 60, 20).ravel() for label in study.labels)
    cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
    assert abs(sine - np.sqrt(1 - cosine**2)) < 1e-9
    assert 0.1 < sine < 0.4
    d = 2.5 / sine
    # |r'a| > |r'b| with unit a, b at cosine c: both r'(a - b) and r'(a + b) are positive, or both negative
    up = norm.cdf(d * np.sqrt((1 - cosine) / 2)), norm.cdf(d * np.sqrt((1 + cosine) / 2))
    expected = up[0] * up[1] + (1 - up[0]) * (1 - up[1])
    assert abs(study.forecast("actuator:u1", d / study.unit[0]).isolated - expected) < 0.015


@pytest.mark.parametrize("rate", [0.01, 0.1])
def test_family_thresholds_of_independent_and_of_equal_statistics(rate):
    drawn = np.random.default_rng(0).chisquare(2, (100_000, 3))
    free = family_thresholds(drawn, rate)
    np.testing.assert_allclose(free, chi2.isf(1 - (1 - rate) ** (1 / 3), 2), rtol=0.03)
    same = family_thresholds(np.repeat(drawn[:, :1], 3, axis=1), rate)
    np.testing.assert_allclose(same, chi2.isf(rate, 2), rtol=0.03)


@pytest.mark.slow
def test_the_standard_plant_needs_the_deflections_measured_before(standard_study):
    _, _, _, study = standard_study
    detectable = (study.detectable * study.unit)[:5]
    assert np.all((5.2 < detectable) & (detectable < 6.1))
    at = study.labels.index
    pair = at("actuator:u2"), at("sensor:y2")
    assert study.rivals[pair[0]] == "sensor:y2" and study.rivals[pair[1]] == "actuator:u2"
    assert np.all(study.isolable >= study.detectable) and np.all(study.isolable[list(pair)] > 2 *
                                                                 study.detectable[list(pair)])
    np.testing.assert_array_equal(np.diag(study.matrix), study.detectable)
    assert np.all(study.matrix.max(axis=1) <= study.isolable * 1.02)
    assert study.bounded.tolist() == [False] * 5 + [True]


def compared(study, faults, label, size, window, process=None, u=None, make=Fault.step):
    """Errors of the forecast of isolation and of detection, from 400 records: faults injected, whitened, searched."""
    rng, model, windows, c = np.random.default_rng(3), faults.model, [], study.labels.index(label)
    for seed in range(400):
        driven = levels(100 + window, seed) if u is None else u
        onset = 100 + int(rng.integers(window * MIDDLE[0], window * MIDDLE[1]))
        y = inject(model, driven, make(faults[label].name, onset, size), seed=seed, process=process)
        windows.append(whiten(model, Data(driven, y), x0="zero").r[100:])
    there = [name in study.labels for name in faults.labels]
    energies = sweep(faults, window, None if u is None else u[100:]).largest(np.array(windows))[:, there]
    excess, expected = energies - study.thresholds, study.forecast(label, size)
    alarm = excess.max(axis=1) > 0
    return np.mean(alarm & (excess.argmax(axis=1) == c)) - expected.isolated, np.mean(alarm) - expected.detected


@pytest.mark.slow
@pytest.mark.parametrize("label", ["actuator:u1", "sensor:y2", "process:load"])
def test_the_forecast_meets_records_of_the_plant(standard_study, label):
    """Small version of the benchmark."""
    _, load, faults, study = standard_study
    size = 0.8 * study.isolable[study.labels.index(label)]
    isolated, detected = compared(study, faults, label, size, 100, {"load": load})
    assert abs(isolated) < 0.075 and abs(detected) < 0.06  # 3 standard errors


@pytest.mark.slow
def test_a_longer_window_helps_a_lasting_fault_and_not_a_transient_one(found):
    short, long = isolability(found, 40, calibration=5000), isolability(found, 120, calibration=5000)
    assert long.detectable[0] < 0.8 * short.detectable[0]
    assert abs(long.detectable[-1] / short.detectable[-1] - 1) < 0.15 and long.bounded[-1]


def test_faults_that_no_record_tells_apart_are_one_row():
    model = small(D=[[0.0, 0.0], [0.0, 0.3]])
    with warnings.catch_warnings(action="ignore"):
        merged = dictionary(model, process={"same": model.B[:, 0]})
    study = isolability(merged, 40, calibration=5000, draws=300)
    assert study.ambiguity_groups == [("actuator:u1", "process:same")]
    assert np.isfinite(study.isolable).all() and "not isolable from each other: actuator:u1, process:same" in str(study)


def test_one_output_cannot_tell_all_apart_at_any_size():
    """With one output and no noise in the state, a step behind one filter is told from others by its course alone."""
    model = noisy([[0.5]], [[1.0]], [[1.0]], [[0.04]], [[0.01]])
    study = isolability(dictionary(model), 40, calibration=5000, draws=500)
    assert study.labels == ("actuator:u", "sensor:y", "state")
    assert np.all(study.isolable > study.detectable)


@pytest.mark.slow
def test_it_prints_within_80_columns_and_draws(standard_study, found, tmp_path):
    _, _, _, study = standard_study
    wide = isolability(found, 40, calibration=5000, draws=200)
    for one in (study, wide):
        assert max(map(len, str(one).splitlines())) <= 80
        figure = one.plot()
        figure.savefig(tmp_path / "picture.png")
        texts = {t.get_text() for t in figure.axes[0].texts}
        assert f"{one.matrix[0, 0]:.2g}" in texts and len(figure.axes[0].texts) == len(one.labels) ** 2
    assert "transient" in str(study)


def test_bad_input(found):
    refused(
        (StructureError, "at least 8 samples", lambda: isolability(found, 7)),
        (StructureError, "prob=", lambda: isolability(found, 40, prob=1.0)),
        (StructureError, "false_alarm=", lambda: isolability(found, 40, false_alarm=0.0)),
        (DataError, "at least 50000000 draws", lambda: isolability(found, 40, false_alarm=1e-6)),
        *((StructureError, "onset=", lambda k=k: isolability(found, 40, onset=k)) for k in ("middle", 40, -1)),
        (StructureError, "draws must be a positive integer; got 0", lambda: isolability(found, draws=0)),
        (StructureError, "calibration must be a positive", lambda: isolability(found, calibration=0.5)),
        (StructureError, "fit in memory", lambda: isolability(found, 10**8)),
        (StructureError, "No candidate has a signature",
         lambda: isolability(dictionary(small(), kinds="loss", state_jump=False), 40)),
        (LookupFailed, "sensor:y2",
         lambda: isolability(found, 20, calibration=5000, draws=50).forecast("sensor:y", 1.0)))


# -- faults whose signature depends on the input -----------------------------------------------------------------------


@pytest.mark.slow
def test_the_forecast_of_a_loss_meets_records_with_that_input():
    u, lossy = levels(160, 5), dictionary(small(), kinds=["bias", "loss"])
    study = isolability(lossy, 60, u=u[100:], draws=2000)
    share = 0.8 * study.isolable[study.labels.index("actuator:u1 loss")]
    assert 0 < share < 1 and study.skipped == ("sensor:y1 loss", "sensor:y2 loss")
    assert abs(compared(study, lossy, "actuator:u1 loss", share, 60, u=u, make=Fault.loss)[0]) < 0.075


def test_an_actuator_that_does_not_move_is_untestable_and_more_than_all_cannot_be_lost():
    lossy, u = dictionary(small(), kinds="loss", actuators=["u1"]), levels(40, 3)
    with pytest.raises(DataError, match="actuator:u1 loss: untestable"):
        isolability(lossy, 40, u=u * [0.0, 1.0], calibration=5000)
    weak = isolability(lossy, 40, u=0.01 * u, calibration=5000, draws=200)
    assert np.isinf(weak.detectable[0]) and "never" in str(weak)
    weak.plot()
    with pytest.raises(DataError, match="u has 30 samples; the window has 40"):
        isolability(lossy, 40, u=u[:30])


def test_the_page_has_a_row_for_every_fault_and_the_printed_matrix(tmp_path):
    found = isolability(dictionary(small()), 40, calibration=5000, draws=100)
    page = found.report(tmp_path / "page.html", command="optid isolability model.json").read_text(encoding="utf-8")
    assert all(f"<td>{label}" in page or f"{label}</th>" in page for label in found.labels)
    assert page.count("optid isolability model.json") == 1 and str(found).splitlines()[0] in page
    assert "http://" not in page.replace("http://www.w3.org", "") and "Isolability matrix" in page


@pytest.mark.slow
def test_command(tmp_path):
    model = small()
    model.save(tmp_path / "model.json")
    done = run("isolability", tmp_path / "model.json", "--window", 40, "--load", "pump=0.3,-0.2,0.5", "--draws", 200,
               "--picture", tmp_path / "p.png", "--report", tmp_path / "p.html", "--kinds", "bias", "drift")
    assert done.exit_code == 0, done.output
    assert "process:pump drift" in done.output and "window 40 samples" in done.output
    assert all((tmp_path / f"p.{ending}").stat().st_size > 10_000 for ending in ("png", "html"))
    replace(model, noise=None).save(tmp_path / "silent.json")
    for words, message in ((["silent.json"], "noise covariances"), (["model.json", "--load", "pump"], "NAME="),
                           (["model.json", "--onset", "soon"], "--onset"), (["none.json"], "none.json")):
        done = run("isolability", tmp_path / words[0], *words[1:])
        assert done.exit_code != 0 and message in str(done.output) + str(done.exception)
