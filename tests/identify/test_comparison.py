"""Several models on one page, prediction horizons, and what validation says of models with feedback."""

import re

import numpy as np
import pytest
from refusals import refuses
from systems import mimo, record, siso
from typer.testing import CliRunner

import optid
from optid import report
from optid.cli.app import app
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.identify.validation import compare_models, fit_by_horizon, fit_percent, validate
from optid.identify.validation.correlations import autocorrelation
from optid.models import HammersteinTF, Nonlinearity
from optid.models.hammerstein_ss import HammersteinSS

pytestmark = pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")


def worse(model: HammersteinTF) -> HammersteinTF:
    return HammersteinTF(0.9 * model.a, model.b, model.nonlinearities, model.nk, model.offset, dt=model.dt)


def feedback_model() -> HammersteinSS:
    """One input and output, a cubic in the feedback."""
    g = Nonlinearity(optid.Polynomial(3).with_interval(-2, 2), [0.0, 0.0, 0.4])
    return HammersteinSS([[0.6, 0.2], [-0.1, 0.5]], [[1.0], [0.3]], [[1.0, 0.0]], E=[[-0.3], [0.1]], feedback=(g,))


def test_the_curve_is_the_fit_of_predictions_over_common_samples():
    model = siso()
    data = record(model)
    curve = fit_by_horizon(model, data, [1, 4, 9])
    last = model.predict(data, 9)
    for fit, h in zip(curve.fits, (1, 4, 9)):
        kept = np.where(np.isnan(last), np.nan, model.predict(data, h))
        assert fit == pytest.approx(fit_percent(data.y, kept))
    assert np.all(np.diff(curve.fits[:, 0]) < 0) and curve.simulation[0] < curve.fits[0, 0]
    text = str(curve)
    assert f"{curve.fits[1, 0]:.2f}" in text and "simulation" in text
    refuses(StructureError, "horizon must be a positive integer", fit_by_horizon, model, data, [0])
    refuses(DataError, "100 samples ahead", lambda: fit_by_horizon(model, data.window(0, 50), [100]))


@pytest.mark.slow
def test_a_horizon_is_validated_beside_one_step():
    model, data = mimo(), record(mimo())
    found = validate(model, data, horizon=3)
    assert found.horizon == 3 and set(found.predictors) == {"one step", "3 steps", "simulation"}
    assert found.predictors["3 steps"]["y2"].fit == pytest.approx(fit_percent(data.y, model.predict(data, 3))[1])


@pytest.mark.slow
def test_every_experiment_is_measured():
    model = mimo()
    parts = [record(model, 300, 1), record(model, 200, 2)]
    found = validate(model, Data.join(*parts))
    for k, part in enumerate(parts):
        assert found.experiments["one step"]["y1"][k].fit == pytest.approx(fit_percent(part.y, model.predict(part))[0])
    assert not validate(model, parts[0]).experiments


def test_the_residual_of_one_output_that_follows_another_is_found():
    rng = np.random.default_rng(0)
    p_values = []
    for _ in range(120):
        e, other = rng.normal(size=400), rng.normal(size=400)
        p_values.append(autocorrelation([e + 0.8 * other], "y1", 10, past=[other], other="y2").p_value)
    assert 0.3 < np.mean(p_values) < 0.7  # correlation at the same instant is no evidence
    e[3:] += 0.3 * other[:-3]
    late = autocorrelation([e], "y1", 10, past=[other], other="y2")
    assert not late.passed and late.lags[np.argmax(np.abs(late.values))] == 3
    z, v = ((x - x.mean()) / x.std() for x in (e, other))
    assert late.values[2] == pytest.approx(np.mean(z[3:] * v[:-3]))


def test_the_three_simulators_of_a_model_with_feedback():
    model = feedback_model()
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, 500)
    data = Data(u, model.simulate(u) + 0.05 * rng.normal(size=500))
    found = validate(model, data, horizon=4)
    assert list(found.predictors) == ["one step", "4 steps", "measured feedback", "simulation"]
    expected = fit_percent(data.y, model.simulate_measured_feedback(data, x0="fit"))[0]
    assert found.predictors["measured feedback"]["y"].fit == pytest.approx(expected)
    assert found.structure.passed and "measured feedback" in str(found)
    assert max(map(len, str(found).splitlines())) <= 80


def test_models_are_compared_over_the_samples_that_all_predict():
    model = siso()
    data = record(model)
    short = HammersteinTF([-0.8], model.b, model.nonlinearities, (9,), model.offset, dt=model.dt)  # looks back further
    found = compare_models({"true": model, "poor": worse(model), "late": short}, data, horizon=2)
    common = np.isnan(short.predict(data))
    for i, one in enumerate((model, worse(model), short)):
        kept = np.where(common, np.nan, one.predict(data))
        assert found.fits["one step"][i] == pytest.approx(fit_percent(data.y, kept))
    assert found.best() == "true" and found.best("2 steps") == "true" and "Best simulation: true" in str(found)
    refuses(StructureError, "no model has the prediction 'measured feedback'", found.best, "measured feedback")
    refuses(StructureError, "no model", compare_models, {}, data)


def test_models_without_names_are_named_by_what_they_are():
    model, data = siso(), record(siso())
    names = compare_models([model, worse(model)], data).names
    assert names == ("Hammerstein ARX model (na 2, nb 2, nk 0) #1", "Hammerstein ARX model (na 2, nb 2, nk 0) #2")


def test_a_model_that_runs_away_is_compared_by_what_it_predicts():
    model, data = siso(), record(siso())
    unstable = HammersteinTF([-3.0, 2.3], model.b, model.nonlinearities, (0,), model.offset, dt=model.dt)
    u = np.vstack([data.u] * 5)
    long = Data(u, np.vstack([data.y] * 5), dt=model.dt)
    found = compare_models({"true": model, "wild": unstable}, long)
    assert np.isfinite(found.fits["simulation"][0]).all() and not found.simulated[1]
    assert np.isfinite(found.fits["one step"]).all()


@pytest.mark.slow
def test_the_page_is_complete_and_makes_no_request(tmp_path):
    model = mimo()
    data = record(model)
    hostile = compare_models({"<b>bold</b>": model, "other & $x$": worse(model)}, data, horizon=5)
    source = report.write_comparison(hostile, tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<b>bold" not in source and "&lt;b&gt;bold" in source
    assert "https:" not in source and source.count("<script") == 2
    ids = re.findall(r'\bid="([^"]+)"', source.split("<script>")[0])
    assert len(ids) == len(set(ids)) and source.count("data-chart=") >= 5
    assert f"{hostile.fits['5 steps'][0, 1]:.2f} %" in source


def test_the_command_line_compares(tmp_path):
    model, data = siso(), record(siso())
    csv = tmp_path / "data.csv"
    np.savetxt(csv, np.hstack([data.u, data.y]), delimiter=",", header="u,y", comments="")
    paths = [m.save(tmp_path / f"{name}.json") for name, m in (("good", model), ("poor", worse(model)))]
    words = ["validate", *map(str, paths), str(csv), "--horizon", "5", "--report", str(tmp_path / "page.html")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "Best simulation: good" in result.output and "5 steps" in result.output
    assert "2 models on one record" in (tmp_path / "page.html").read_text(encoding="utf-8")
    alone = CliRunner().invoke(app, ["validate", str(paths[0]), str(csv), "--report", str(tmp_path / "one.html")])
    assert alone.exit_code == 0 and model.equation() in alone.output
    missing = CliRunner().invoke(app, ["validate", *map(str, paths)])
    assert missing.exit_code == 2 and "give a data file after the models" in missing.output
