"""Measures by hand; residual tests against their level and power; the structure test against dense least squares."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from scipy.stats import chi2, kstest
from systems import mimo, nonlinearity, record, siso

import optid
from optid.bases import Linear, Triangular
from optid.data.record import Data
from optid.errors import DataError, DataWarning
from optid.identify.validation import Measures, fit_percent, validate
from optid.identify.validation.correlations import autocorrelation, cross_correlation


def ar(rng, count, pole):
    x = rng.normal(size=count)
    for k in range(1, count):
        x[k] += pole * x[k - 1]
    return x


def test_measures_by_hand():
    y, yhat = np.array([1.0, 2.0, 3.0, np.nan, 6.0]), np.array([1.0, 2.5, 3.0, 4.0, 5.0])
    q = Measures.of(y, yhat)
    assert q.samples == 4
    assert q.e_n == pytest.approx(1.25 / 4) and q.rmse == pytest.approx(np.sqrt(1.25 / 4))
    assert q.fit == pytest.approx(100 * (1 - np.sqrt(1.25 / 14)))
    assert q.vaf == pytest.approx(100 * (1 - (1.25 / 4 - 0.125**2) / 3.5))
    assert q.snr == pytest.approx(50 / 1.25) and q.snr_amplitude == pytest.approx(np.sqrt(40))
    assert fit_percent(y[:, None], yhat[:, None])[0] == pytest.approx(q.fit)
    assert Measures.of(y, np.full(5, np.nan)).samples == 0
    assert np.isnan(fit_percent(np.ones((4, 1)), np.ones((4, 1)))[0])
    perfect = Measures.of(y, y)
    assert perfect.fit == 100 and perfect.snr == np.inf


def test_correlations_of_complete_records_by_hand():
    rng = np.random.default_rng(0)
    e, u = rng.normal(size=400), rng.normal(size=400)
    auto, cross = autocorrelation([e], "y", 10), cross_correlation([e], [u], "y", "u", 10)
    z, v = (e - e.mean()) / e.std(), (u - u.mean()) / u.std()
    expected = [z[lag:] @ z[: 400 - lag] / (400 - lag) for lag in range(11)]
    assert auto.values == pytest.approx(expected) and auto.values[0] == pytest.approx(1)
    c = np.array(expected) * (400 - np.arange(11)) / 400
    ljung_box = 400 * 402 * np.sum(c[1:] ** 2 / (400 - np.arange(1, 11)))
    assert auto.p_value == pytest.approx(chi2.sf(ljung_box, 10))
    assert auto.band == pytest.approx(2.5758293 / np.sqrt(400 - np.arange(11)))
    assert cross.values[10 + 3] == pytest.approx(z[3:] @ v[:-3] / 397)
    assert cross.values[10 - 2] == pytest.approx(z[:-2] @ v[2:] / 398)
    own = [v[lag:] @ v[: 400 - lag] / (400 - lag) for lag in range(11)]
    scaled = np.sqrt(400 - np.arange(11)) * cross.values[10:]
    assert cross.p_value == pytest.approx(chi2.sf(scaled @ np.linalg.solve(toeplitz(own), scaled), 11))


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_p_values_are_uniform_when_the_hypothesis_holds(missing):
    rng = np.random.default_rng(1)
    p_auto, p_cross = [], []
    for _ in range(150):
        e, u = rng.normal(size=500), ar(rng, 500, 0.8)
        e[rng.uniform(size=500) < missing] = np.nan
        p_auto.append(autocorrelation([e], "y", 10).p_value)
        p_cross.append(cross_correlation([e], [u], "y", "u", 10).p_value)
    assert kstest(p_auto, "uniform").pvalue > 1e-3
    assert kstest(p_cross, "uniform").pvalue > 1e-3


def test_tests_find_what_they_are_for():
    rng = np.random.default_rng(2)
    e, u = rng.normal(size=1000), rng.normal(size=1000)
    coloured = autocorrelation([ar(rng, 1000, 0.4)], "y")
    assert not coloured.passed and coloured.outside >= 1
    e[4:] += 0.3 * u[:-4]
    late = cross_correlation([e], [u], "y", "u")
    assert not late.passed and np.argmax(np.abs(late.values)) == 25 + 4
    feedback = cross_correlation([np.append(u[4:], np.zeros(4))], [u], "y", "u")
    assert feedback.passed and np.argmax(np.abs(feedback.values)) == 25 - 4 and feedback.outside >= 1


def test_pairs_do_not_cross_experiments():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=50), rng.normal(size=70)
    gap = np.concatenate([a, np.full(30, np.nan), b])
    together, apart = autocorrelation([gap], "y"), autocorrelation([a, b], "y")
    assert apart.values == pytest.approx(together.values) and apart.p_value == pytest.approx(together.p_value)


def test_a_constant_input_gives_no_verdict():
    test = cross_correlation([np.random.default_rng(4).normal(size=99)], [np.ones(99)], "y", "u")
    assert np.isnan(test.p_value) and test.passed and test.outside == 0


def two_paths(count=1500):
    """u -> f1 at lag 0 and u -> f2 at lag 1: Theta of rank two."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.7, 1.3, count)
    f1, f2 = nonlinearity(Triangular(5), 0), nonlinearity(Triangular(5), 1)
    w = f1(u) + np.r_[0, f2(u)[:-1]]
    return Data(u, lfilter([1.0], [1.0, -0.5], w + 0.1 * rng.normal(size=count)))


def test_a_true_model_passes():
    model = siso()
    data = record(model, 2000)
    found = optid.validate(model, data)
    assert found.passed and not found.notes
    assert found.one_step["y"].rmse == pytest.approx(0.1, rel=0.05)
    prediction, simulation = model.predict(data), model.simulate(data, "fit")
    assert found.one_step["y"].e_n == pytest.approx(np.nanmean((data.y - prediction) ** 2))
    assert found.simulation["y"].fit == pytest.approx(fit_percent(data.y, simulation)[0])
    assert found.simulation["y"].fit < found.one_step["y"].fit
    assert found.residuals[0].shape == (2000, 1) and found.simulated[0] == pytest.approx(simulation)
    text = str(found)
    for words in ("rig", "one step", "simulation", "white", "independent of u", "consistent with a Hammerstein system"):
        assert words in text


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Structure of the record")
def test_each_output_and_experiment_counts():
    model = mimo()
    parts = [record(model, 500, seed) for seed in (1, 2)]
    found = validate(model, Data.join(*parts))
    assert set(found.one_step) == {"y1", "y2"} and len(found.cross_correlations) == 6
    residual = np.concatenate([(p.y - model.predict(p))[model.memory :, 1] for p in parts])
    assert found.one_step["y2"].e_n == pytest.approx(np.mean(residual**2))
    assert found.one_step["y1"].samples == 2 * (500 - model.memory)


def test_a_wrong_model_fails():
    model = siso()
    data = record(model, 2000)
    found = validate(replace(model, a=np.array([-1.2, 0.4])), data)
    assert not found.passed and not found.autocorrelations["y"].passed
    assert "not white" in str(found)
    late = validate(replace(model, nk=(1,)), data)
    assert not late.cross_correlations["y", "u"].passed and "depends on u" in str(late)


def test_missing_outputs():
    model = siso()
    data = record(model, 2000)
    y = data.y.copy()
    y[np.random.default_rng(5).uniform(size=2000) < 0.1] = np.nan
    found = validate(model, Data(data.u, y, dt=0.1))
    assert found.passed
    assert found.one_step["y"].samples == np.sum(~np.isnan(y[2:, 0]) & ~np.isnan(y[1:-1, 0]) & ~np.isnan(y[:-2, 0]))
    assert found.simulation["y"].samples == np.sum(~np.isnan(y))


def test_scaled_data_give_the_same_validation():
    model, data = siso(), record(siso(), 800)
    assert validate(model, data.scale()).simulation["y"].rmse == pytest.approx(
        validate(model, data).simulation["y"].rmse
    )


def test_linear_model_on_a_linear_record():
    model = siso(Linear())
    assert validate(model, record(model, 800)).structure.passed


def test_notes_are_warnings():
    model = siso()
    data = record(model, 800)
    u = data.u.copy()
    u[5] = np.nan
    with pytest.warns(DataWarning, match="No simulation.*'u' is missing at sample 5"):
        found = validate(model, Data(u, data.y, dt=0.1))
    assert not found.simulation and not found.simulated and "No simulation" in str(found)
    u[5] = 3.0
    with pytest.warns(DataWarning, match=r"0.12 % of input 'u' lies outside the interval \[-0.7, 1.3\].*'clamp'"):
        found = validate(model, Data(u, data.y, dt=0.1))
    assert found.outside["u"] == pytest.approx(1 / 800)
    with pytest.warns(DataWarning, match="unstable: its largest pole has radius 1.1"):
        validate(siso(a=[-1.1]), data)
    with pytest.warns(DataWarning, match="not consistent with a Hammerstein system"):
        validate(siso(Triangular(5), a=[-0.5], dt=1.0), two_paths())
    with pytest.warns(DataWarning, match="Structure of the record: not tested"):
        short = validate(model, Data(data.u[:15], data.y[:15], dt=0.1))
    assert short.structure is None and short.autocorrelations["y"].lags[-1] == 3


def test_rounding_is_not_tested():
    model = siso()
    found = validate(model, record(model, 800, noise=0.0))
    assert found.passed and found.one_step["y"].rmse < 1e-12 and np.isnan(found.autocorrelations["y"].p_value)


def test_refusals():
    model, data = siso(), record(siso(), 60)
    with pytest.raises(DataError, match="No sample of output 'y' can be predicted"):
        validate(model, Data(data.u[:2], data.y[:2], dt=0.1))
    refuses(DataError, "sampled every 1", lambda: validate(model, Data(data.u, data.y, dt=1.0)))


@pytest.mark.slow
def test_nothing_is_warned_without_reason():
    with warnings.catch_warnings(action="error"):
        validate(mimo(), record(mimo(), 2000))
