import json
import re
import warnings

import numpy as np
import pytest
from html_page import Page
from sample_fits import example_fit, feedback_fit, linear_fit, mimo_fit, two_by_two

import optid
from optid import report
from optid.show.sections import extremes


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {
        "thruster": report.render(example_fit("thruster"), command="optid fit 'my data.csv'"),
        "mimo": report.render(mimo_fit(), two_by_two(seed=5)),
        "linear": report.render(linear_fit()), "feedback": report.render(feedback_fit())}


@pytest.mark.parametrize("name", ["thruster", "mimo", "linear", "feedback"])
def test_nothing_is_loaded_from_anywhere(pages, name):
    page = Page(pages[name])
    for attribute in ("src", "href", "xlink:href", "data", "action", "srcset"):
        assert all(value.startswith("#") or value == "data:," for value in page.values(attribute))
    text = pages[name].replace("http://www.w3.org/2000/svg", "")  # the name of a language
    assert not re.search(r"url\((?!#)", text) and "@import" not in text
    assert "http://" not in text and "https://" not in text


@pytest.mark.parametrize("name", ["thruster", "mimo", "linear", "feedback"])
def test_identifiers_are_unique_and_every_reference_has_its_target(pages, name):
    page = Page(pages[name])
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    targets = [value[1:] for value in page.values("href") if value.startswith("#")]
    assert set(targets) <= set(ids) and len(targets) > 7


def test_the_verdict_the_figures_and_the_prices_are_on_the_page(pages):
    fit, page = example_fit("thruster"), Page(pages["thruster"])
    text = page.text.replace("\N{NO-BREAK SPACE}", " ")
    for words in (
        "Solution: optimal (proved)", f"{fit.one_step_fit[0]:.2f} %", f"{fit.simulation_fit[0]:.2f} %",
        "monotone:increasing", fit.model.equation(), "optid.fit(data, 'hammerstein_arx.exact', na=2",
        optid.__version__, str(fit), "optid fit 'my data.csv'",
    ):
        assert words in text
    sections = {value for tag, name, value in page.attributes if tag == "section" and name == "id"}
    assert sections == {
        "trust", "dynamics", "optimum", "model", "figures", "constraints", "certificate", "validation", "data",
        "solver", "reproduce"}
    charts = json.loads(re.search(r'id="charts-data">(.*?)</script>', pages["thruster"], re.DOTALL)[1])
    assert pages["thruster"].count("<figure>") == len(charts) == 10
    assert "Bode diagram: phase" in text and "PASS (p = " in text
    assert text.index("The model on this record") < text.index("Optimal (proved)".lower())


@pytest.mark.slow
def test_names_are_text_never_markup():
    data = two_by_two()
    hostile = optid.Data(
        data.u, data.y, 0.5, ['<script>alert("1")</script>', "a&b"], ["<b>y</b>", "'\"z"], name="<i>name</i>")
    source = report.render(optid.fit(hostile, na=1, nb=1, basis="polynomial:2"))
    assert "<script>alert" not in source and "<b>y" not in source and "<i>name" not in source
    text = Page(source).text
    assert '<script>alert("1")</script>' in text and "<i>name</i>" in text and "'\"z" in text


def test_the_test_record_is_validated(pages):
    page = Page(pages["mimo"])
    with warnings.catch_warnings(action="ignore", category=optid.errors.DataWarning):
        validation = optid.validate(mimo_fit().model, two_by_two(seed=5))
    assert any("outside" in note for note in validation.notes)
    assert all(note in page.text for note in validation.notes)
    assert "Test record, not used by the fit" in page.text
    lowest = min(q.fit for q in validation.simulation.values())
    assert f"{lowest:.2f} %" in page.text


def test_a_fit_without_a_model_is_refused():
    fit = optid.fit(
        example_fit("dead_zone").data, na=2, nb=2, basis="triangular:8", raises=False,
        constraints=[lambda v: {"low": v["a"][0] <= -1, "high": v["a"][0] >= 1}])
    with pytest.raises(optid.errors.DataError, match="infeasible"):
        report.render(fit)


def test_a_state_space_model_shows_singular_values_noise_and_feedback(pages):
    text = Page(pages["feedback"]).text
    for words in ("Spectrum of the noise", "measured feedback", "Feedback nonlinearity g", "Intermediate results"):
        assert words in text
    assert "Singular values" in text


def test_extremes_of_whole_numbers_are_those_of_numbers():
    values = np.random.default_rng(0).integers(-9, 9, 5003)
    np.testing.assert_array_equal(extremes(values, 100), extremes(values.astype(float), 100))


def test_long_curves_keep_their_peaks():
    values = np.sin(np.arange(1e5) / 500)
    values[[12_345, 54_321]] = 7.0, -9.0
    values[70_000:70_010] = np.nan
    kept = extremes(values, 1000)
    assert kept.size <= 2020 and {12_345, 54_321} <= set(kept) and np.isnan(values[kept]).any()
