"""What can be done with a result: parameters, predictions, copies, pickles, displays, completion."""

import copy
import pickle
import subprocess
import sys
from dataclasses import replace
from html import escape
from importlib import import_module

import numpy as np
import pytest
from refusals import refuses
from sample_fits import example_fit, linear_fit, mimo_fit

import optid
from formulations import shape
from optid.errors import DataError, LookupFailed, SolverFailed, StructureError
from optid.examples import example
from optid.phrases import p_equals, p_value, plural

RESULTS = {
    "fit": lambda: example_fit("thruster"), "several outputs": mimo_fit,
    "parameters": lambda: example_fit("thruster").params, "uncertainty": lambda: example_fit("thruster").uncertainty,
    "validation": lambda: optid.validate(example_fit("thruster").model, example("thruster").data),
    "comparison": lambda: optid.compare_models([linear_fit().model] * 2, linear_fit().data),
    "horizons": lambda: optid.fit_by_horizon(linear_fit().model, linear_fit().data),
    "order": lambda: optid.order(example("thruster").data),
    "search": lambda: optid.identify(example("thruster").data, effort=2, workers=1, classes=["linear"]),
    "verdict": lambda: example_fit("thruster").verdict, "solution": lambda: example_fit("thruster").solution,
    "model": lambda: example_fit("thruster").model, "record": lambda: example("thruster").data,
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", RESULTS)
def test_every_result_is_pickled_and_shown_in_three_lines(name):
    result = RESULTS[name]()
    again = pickle.loads(pickle.dumps(result))
    assert type(again) is type(result) and str(again) == str(result)
    assert str(copy.deepcopy(result)) == str(result)
    shown = repr(result)
    assert shown.count("\n") <= 2 and len(shown) <= 240


def test_parameters_are_a_table_with_errors():
    fit = example_fit("thruster")
    table = dict((name, row) for name, *row in fit.uncertainty.table())
    assert [list(fit.params[name][1:5]) for name in table] == list(table.values())
    assert fit.params.names[-10:] == tuple(f"mu{k}" for k in range(1, 11))
    np.testing.assert_allclose(fit.params.estimates[-10:], fit.model.f.mu)
    frame = fit.params.to_pandas()
    assert frame.loc["a1", "estimate"] == fit.params["a1"].estimate
    refuses(LookupFailed, "Did you mean", lambda: fit.params["al"])


def test_intervals_widen_with_their_level_and_are_named_after_it():
    fit = linear_fit()
    noisy = optid.fit(_noisy(), "arx", na=2, nb=1, nk=1)
    half, most = noisy.conf_int(0.5), noisy.conf_int(0.99)
    assert all(b.lower < a.lower < a.estimate < a.upper < b.upper for a, b in zip(half, most) if a.error > 0)
    assert "99 % low" in str(most)
    refuses(StructureError, "level", fit.conf_int, 1.5)


def _noisy() -> optid.Data:
    data = linear_fit().data
    noise = 0.1 * np.random.default_rng(4).standard_normal(data.y.shape)
    return optid.Data(data.u, data.y + noise, data.dt)


def test_the_methods_do_what_the_functions_do(tmp_path):
    fit = optid.fit(_noisy(), "arx", na=2, nb=1, nk=1)
    data, model = fit.data, fit.model
    np.testing.assert_array_equal(fit.predict(horizon=3), model.predict(data, 3))
    np.testing.assert_array_equal(fit.simulate(), model.simulate(data, x0="fit"))
    np.testing.assert_array_equal(fit.simulate(data.u[:50]), model.simulate(data.u[:50]))
    np.testing.assert_array_equal(fit.residuals, model.innovations(data))
    assert str(fit.validate()) == str(optid.validate(model, data))
    assert fit.summary() == str(fit)
    fit.save(tmp_path / "m.json")
    assert optid.load(tmp_path / "m.json").equation() == model.equation()
    assert fit.plot().axes
    assert "<html" in fit.report(tmp_path / "r.html").read_text(encoding="utf-8")


def test_a_comparison_draws_every_simulation():
    fit = linear_fit()
    figure = optid.compare_models({"one": fit.model, "two": fit.model}, fit.data).plot()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["measured", "one", "two"]


def test_information_criteria_are_those_of_a_gaussian_likelihood():
    fit = optid.fit(_noisy(), "arx", na=2, nb=1, nk=1)
    errors = fit.residuals[np.isfinite(fit.residuals)]
    n, variance = errors.size, np.mean(errors**2)
    likelihood = np.sum(-0.5 * np.log(2 * np.pi * variance) - errors**2 / (2 * variance))
    assert fit.aic == pytest.approx(-2 * likelihood + 2 * 4)  # a1, a2, b0, offset
    assert fit.bic == pytest.approx(-2 * likelihood + 4 * np.log(n))


def test_a_pickled_fit_keeps_its_results_and_solves_again_when_its_programme_is_asked_for():
    chosen = example("thruster")
    rules = [shape.monotone("increasing"), shape.gain(low=0.1)]
    fit = optid.fit(chosen.data, **{**chosen.suggestion, "constraints": rules})
    again = pickle.loads(pickle.dumps(fit))
    assert "outcome" not in vars(again)
    assert again.solution.proof and again.simulation_fit == fit.simulation_fit
    assert "outcome" not in vars(again)
    assert again.uncertainty.table() == fit.uncertainty.table()
    assert again.problem.constraint_names == fit.problem.constraint_names


def test_a_constraint_that_cannot_be_pickled_is_named_when_it_is_needed():
    fit = optid.fit(_noisy(), "arx", na=2, nb=1, nk=1, constraints=[lambda v: {"small": v["a"][0] <= 1}])
    again = pickle.loads(pickle.dumps(fit))
    assert again.model.equation() == fit.model.equation()
    refuses(StructureError, "lambda", lambda: again.problem)


def test_a_copy_shares_the_programme():
    fit = linear_fit()
    assert copy.copy(fit).problem is fit.problem
    refuses(AttributeError, "no attribute 'modle'", lambda: fit.modle)


def test_a_stream_keeps_no_samples_to_predict(tmp_path):
    data = linear_fit().data
    np.savetxt(tmp_path / "r.csv", np.c_[data.u, data.y], delimiter=",", header="u,y", comments="")
    fit = optid.fit(optid.open_stream(tmp_path / "r.csv", inputs=["u"], outputs=["y"], dt=0.1), "arx", na=2, nb=1)
    refuses(DataError, "stream", lambda: fit.residuals)


@pytest.mark.slow
def test_joblib_workers_return_fits():
    joblib = pytest.importorskip("joblib")
    data = _noisy()
    found = joblib.Parallel(n_jobs=2)(joblib.delayed(optid.fit)(data, "arx", na=n, nb=1, nk=1) for n in (1, 2))
    assert [fit.model.na for fit in found] == [1, 2]


def test_identify_is_a_function_whatever_was_imported_before():
    script = "import optid, optid.identify.fitting; optid.fit; assert callable(optid.identify), optid.identify"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


@pytest.mark.parametrize("name", ["signals", "bases", "errors", "examples", "plants", "plots", "report", "noise"])
def test_modules_list_public_names_only(name):
    module = getattr(optid, name)
    listed = dir(module)
    assert listed and not {"np", "Any", "dataclass", "Path", "Callable", "Sequence"} & set(listed)
    assert all(hasattr(module, one) for one in listed)


@pytest.mark.parametrize(("script", "path", "text"), [("stub", "STUB", "stub"), ("mathematics", "PAGE", "page")])
def test_what_docs_write_from_the_code_is_up_to_date(script, path, text, monkeypatch):
    monkeypatch.syspath_prepend("docs")
    module = import_module(script)
    assert getattr(module, path).read_text(encoding="utf-8") == getattr(module, text)(), f"run python docs/{script}.py"


def test_a_notebook_shows_a_record_and_a_verdict_as_tables():
    fit = example_fit("thruster")
    record = fit.data._repr_html_()
    assert f"thruster: {fit.data.n_samples} samples every" in record and record.count("<tr>") == 3
    assert all(f"<td>{name}</td>" in record for name in (*fit.data.inputs, *fit.data.outputs))
    judged = fit.verdict._repr_html_()
    assert f"The model on this record: {fit.verdict.word}" in judged
    assert all(f"<td>{part.name}</td><td>{escape(part.value)}</td>" in judged for part in fit.verdict.parts[:12])


def test_a_fit_in_a_line_says_structure_verdict_fit_and_status_and_computes_nothing():
    fit = optid.fit(example("dead_zone").data, na=2, nb=2, basis="triangular:8", constraints="monotone:increasing")
    before = set(vars(fit))
    first = repr(fit)
    assert set(vars(fit)) == before and "verdict not computed" in first
    assert first.startswith("Fit(hammerstein_arx.exact na=2 nb=2 basis=triangular:8 1 constraint, ")
    word = fit.verdict.word
    assert f"verdict {word}, fit {fit.verdict.score:.1f} %" in repr(fit) and "optimal" in repr(fit)
    assert "na=[1, 2]" in repr(replace(fit, arguments={"na": (1, 2), "nb": np.ones(3)}))


def test_a_fit_has_the_poles_and_the_equation_of_its_model():
    fit = linear_fit()
    np.testing.assert_allclose(np.sort(fit.poles), np.sort(np.roots([1, -0.5, 0.2])), atol=1e-6)
    assert fit.equation == "y(k) = 0.5 y(k-1) - 0.2 y(k-2) + 2 u(k-1) - 3"
    none = optid.fit(fit.data, "arx", na=2, nb=1, nk=1, raises=False,
                     constraints=lambda v: {"low": v["a"][0] <= -1, "high": v["a"][0] >= 1})
    for name in ("poles", "equation"):
        refuses(SolverFailed, "no model: its status is infeasible", getattr, none, name)


def test_one_constraint_needs_no_list():
    data = example("dead_zone").data
    alone, listed = (optid.fit(data, na=2, nb=2, basis="triangular:8", constraints=given)
                     for given in ("monotone:increasing", ["monotone:increasing"]))
    assert np.array_equal(alone.model.f.mu, listed.model.f.mu) and [p.name for p in alone.prices] == [
        "monotone:increasing"]
    for call in (optid.fit, optid.identify):
        refuses(LookupFailed, "called 'monotonic'", call, data, constraints="monotonic:increasing")
        refuses(StructureError, "constraints = 3", call, data, constraints=3)


@pytest.mark.parametrize(("p", "digits", "cell", "words"), [
    (0.0, 2, "< 1e-16", "p < 1e-16"), (2e-218, 1, "< 1e-16", "p < 1e-16"), (1e-16, 1, "1e-16", "p = 1e-16"),
    (0.0312, 2, "0.031", "p = 0.031"), (1.0, 2, "1", "p = 1"), (np.nan, 2, "-", "p = -")])
def test_p_values_below_rounding_are_bounds(p, digits, cell, words):
    assert (p_value(p, digits), p_equals(p, digits)) == (cell, words)


def test_one_is_written_in_the_singular():
    assert [plural(n, "sample") for n in (0, 1, 2, 3000)] == ["0 samples", "1 sample", "2 samples", "3,000 samples"]
    assert plural(3000, "sample", "") == "3000 samples"
    data = optid.Data(np.ones(1), np.ones(1), 1.0)
    assert all("1 sample every" in text for text in (repr(data), str(data), data._repr_html_()))
