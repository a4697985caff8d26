"""Whatever shows time says its unit or its date, and what reading a record assumed comes before every verdict."""

import json
import warnings
from dataclasses import fields, replace

import numpy as np
import pytest
from fault_plants import levels
from matplotlib.dates import ConciseDateFormatter
from refusals import refuses
from sample_fits import example_fit

import optid
from optid import report
from optid.data.timeline import Timeline
from optid.errors import DataError
from optid.faults import diagnose, load_diagnosis
from optid.identify.responses import responses
from optid.models import HammersteinTF
from optid.models.process import process_model
from optid.show import charts, printing, summary
from optid.show.notebook import fit_html, search_html
from optid.show.page import encode_chart
from optid.show.responses import curve_charts

FINDING = "no time column: 1 sample = 1; pass dt= (seconds)"
DATE = "2024-05-01T06:00"


def record(n=600, **clock):
    """A first-order plant of which the clock is given."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, -(-n // 10)), 10)[:n]
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.8 * y[k - 1] + 0.2 * np.tanh(2 * u[k - 1])
    y += 0.01 * rng.standard_normal(n)
    return optid.Data(u, y, inputs="u", outputs="y", name="rig", **clock)


@pytest.fixture(scope="module")
def clockless(tmp_path_factory):
    path = tmp_path_factory.mktemp("time") / "rig.csv"
    data = record()
    np.savetxt(path, np.column_stack([data.u, data.y]), delimiter=",", header="u,y", comments="")
    return optid.read(path, inputs="u", outputs="y")


@pytest.fixture(scope="module")
def dated():
    data = record(dt=60.0, start=DATE)
    return optid.fit(data, "hammerstein_arx.exact", na=1, nb=2, basis="triangular:4")


# -- what reading assumed


def before(text, verdict):
    assert 0 <= text.index("1 sample = 1") < text.index(verdict), text[:500]


def test_the_findings_of_the_record_come_before_every_verdict(clockless):
    assert clockless.findings == (FINDING,)
    fit = optid.fit(clockless, "arx", na=1, nb=2)
    with warnings.catch_warnings(action="ignore"):
        found = optid.identify(clockless, effort=2, workers=1, classes=["linear"])
    checked, compared = optid.validate(fit.model, clockless), optid.compare_models({"a": fit.model}, clockless)
    for text, verdict in ((str(fit), "The model on this record"), (str(checked), "Validation on"),
                          (str(found), "Search"), (str(compared), "Fit on"), (str(optid.order(clockless)), "Order of"),
                          (fit_html(fit), "The model on this record"), (search_html(found), "Search"),
                          (checked._repr_html_(), "Residual tests"), (report.render(fit), "The model on this record")):
        before(text, verdict)
        assert "The record" in text
    assert str(found).count(FINDING) == 1


@pytest.mark.parametrize("write", [
    lambda fit, path: report.write(fit, path), lambda fit, path: fit.validate().report(path),
    lambda fit, path: optid.compare_models({"a": fit.model}, fit.data).report(path),
    lambda fit, path: optid.order(fit.data).report(path), lambda fit, path: report.write_record(fit.data, path),
])
def test_the_findings_are_the_first_section_of_a_page(clockless, tmp_path, write):
    path = tmp_path / "page.html"
    write(optid.fit(clockless, "arx", na=1, nb=2), path)
    text = path.read_text(encoding="utf-8")
    assert text.index('<section id="record"') == text.index("<section id=")
    assert FINDING in text


def test_there_is_no_heading_without_findings(dated):
    assert "The record\n" not in str(dated) and 'id="record"' not in report.render(dated)
    assert "The record\n" not in str(dated.validate())


def test_many_findings_are_counted_not_listed(clockless):
    data = clockless.map_signals(lambda u: u, lambda y: y, findings=tuple(f"finding {k}" for k in range(40)))
    text = str(optid.fit(data, "arx", na=1, nb=2))
    assert "- finding 5\n" in text and "- finding 6\n" not in text and "- and 34 more" in text
    assert "<li>and 34 more" in report.render(optid.fit(data, "arx", na=1, nb=2))


def test_a_fit_without_a_model_begins_with_the_findings(clockless):
    fit = optid.fit(clockless, "arx", na=1, nb=2)
    lost = replace(fit, outcome=replace(fit.outcome, model=None))
    before(printing.describe(lost), "No model")


# -- units of time


@pytest.mark.parametrize(("clock", "unit", "sampled"), [
    ({"dt": 0.1}, "s", "sampling time: 0.1 s"), ({}, "", "sampling time: 1 (unit unknown)"),
    ({"dt": 60.0, "start": DATE}, "s", "sampling time: 60 s")])
@pytest.mark.parametrize(("formulation", "words"), [
    ("arx", {"na": 1, "nb": 2}), ("hammerstein_arx.exact", {"na": 1, "nb": 2, "basis": "triangular:4"}),
    ("hammerstein_oe.exact", {"na": 1, "nb": 2, "basis": "triangular:4"}),
    ("armax.exact", {"na": 1, "nb": 2, "nc": 1}),
    ("hammerstein_ss.asivid", {"nx": 1, "basis": "triangular:4"}),
    ("hammerstein_ss.exact", {"nx": 1, "basis": "triangular:4"})])
def test_a_model_carries_the_unit_of_time_of_its_record(formulation, words, clock, unit, sampled, tmp_path):
    model = optid.fit(record(300, **clock), formulation, **words).model
    assert model.time_unit == unit
    assert sampled in str(model)
    assert optid.load(model.save(tmp_path / "model.json")).time_unit == unit


def test_a_recursion_and_a_stream_carry_it_too(tmp_path):
    data = record(dt=0.1)
    recursion = optid.RecursiveARX.like(data, na=1, nb=2, basis="linear")
    recursion.update(data.u, data.y)
    recursion.save(tmp_path / "state.npz")
    assert optid.RecursiveARX.load(tmp_path / "state.npz").model().time_unit == "s"
    np.savetxt(tmp_path / "rig.csv", np.column_stack([0.1 * np.arange(600), data.u, data.y]), delimiter=",",
               header="time,u,y", comments="", fmt="%.10g")
    stream = optid.open_stream(tmp_path / "rig.csv", inputs="u", outputs="y")
    fit = optid.fit(stream, "arx", na=1, nb=2)
    assert fit.model.time_unit == "s" and "every 0.1 s" in str(fit)


def test_an_older_model_file_has_no_unit(tmp_path):
    path = optid.fit(record(dt=0.1), "arx", na=1, nb=2).model.save(tmp_path / "model.json")
    content = json.loads(path.read_text())
    del content["time_unit"]
    path.write_text(json.dumps(content))
    assert optid.load(path).time_unit == ""
    path.write_text(json.dumps({**content, "time_unit": 3}))
    refuses(optid.errors.ModelFileError, "time_unit = 3", optid.load, path)


def test_other_sampling_is_refused_with_units():
    model = optid.fit(record(dt=0.1), "arx", na=1, nb=2).model
    refuses(DataError, "sampled every 0.2 s, the model every 0.1 s", model.predict, record(dt=0.2))


def titles(model):
    levels = [(0.0, 1.0)]
    step = curve_charts({"": responses(model, levels)[0]}, [model], None)[-1].chart
    return [chart.x.title for chart in (*charts.dynamics_charts({"": model}, levels)[:2], step)]


def test_frequencies_and_responses_have_a_unit():
    def model(**clock):
        return optid.fit(record(**clock), "arx", na=1, nb=2).model

    assert titles(model(dt=0.1)) == ["frequency (rad/s)"] * 2 + ["time (s)"]
    assert titles(model()) == ["frequency (rad/sample)"] * 2 + ["sample"]


def test_a_sampling_time_without_a_unit_is_not_called_a_sample():
    fit = optid.fit(record(dt=0.1), "arx", na=1, nb=2)
    unknown = HammersteinTF(**{f.name: getattr(fit.model, f.name) for f in fields(fit.model)} | {"time_unit": ""})
    assert titles(unknown) == ["frequency (rad per unit of time)"] * 2 + ["time"]


def test_designed_excitations_have_units(tmp_path):
    assert "every 0.1 s" in str(optid.design(record(dt=0.1))) and " Hz" in str(optid.design(record(dt=0.1)))
    unknown = optid.design(record())
    assert "cycles per sample" in str(unknown) and "Hz" not in str(unknown)
    assert unknown.save(tmp_path / "u.csv").read_text().startswith("sample,u")


def test_exported_code_says_the_sampling_time(tmp_path):
    assert "sampling time: 0.1 s" in example_fit("thruster").model.to_c(tmp_path / "m.c").read_text()


# -- dates


def test_a_timeline_counts_from_its_start():
    line = Timeline(np.datetime64("2024-05-01T06:00:00.25", "us").astype(int) / 1e6, 0.1, "s", True)
    assert line.sample_text(412) == "sample 412 (2024-05-01 06:00:41.45)"
    assert Timeline(5.0, 0.1, "s").text(3) == "5.3 s" and Timeline().sample_text(3) == "sample 3"
    assert Timeline(0.0, 1.0, "s").with_times("y at sample 5, first in sample 7: 3") == (
        "y at sample 5 (5 s), first in sample 7 (7 s): 3")


def test_records_with_dates_and_with_numbers_are_not_joined():
    refuses(DataError, "times of data set 2 are numbers", optid.Data.join, record(dt=60.0, start=DATE), record(dt=60.0))


def test_a_joined_record_keeps_every_finding(clockless):
    other = clockless.map_signals(lambda u: u, lambda y: y, findings=("another",))
    joined = optid.Data.join(clockless, other)
    assert joined.findings == (FINDING, "another")


def test_an_empty_part_of_a_dated_record_is_refused_with_dates():
    data = record(dt=60.0, start=DATE)
    with pytest.raises(DataError, match="2024-05-01 06:00:00") as error:
        data["2025-01-01":"2025-01-02"]
    assert "e+09" not in str(error.value) and "17" not in str(error.value)


def test_figures_of_a_dated_record_have_axes_of_dates(dated):
    shown = [dated.data.plot(), optid.plots.fit_over_time(dated), optid.plots.overview(dated),
             optid.compare_models({"a": dated.model}, dated.data).plot()]
    for figure in shown:
        figure.canvas.draw()
        dates = [ax for ax in figure.axes if isinstance(ax.xaxis.get_major_formatter(), ConciseDateFormatter)]
        assert dates and all(19000 < ax.get_xlim()[0] < 20000 for ax in dates)  # days since 1970
        for ax in dates:
            assert not any("e9" in label.get_text() or "1.7" in label.get_text() for label in ax.get_xticklabels())


def test_figures_of_seconds_and_samples_say_so():
    for clock, title in (({"dt": 0.1}, "time (s)"), ({}, "sample")):
        assert record(**clock).plot().axes[-1].get_xlabel() == title


@pytest.mark.parametrize("n", [30, 300, 50_000])
def test_a_page_carries_dates_to_the_microsecond(n):
    data = record(n, dt=0.1, start="2024-05-01T06:00:00.3")
    axis, series = (encode_chart(charts.time_charts(data, 0, [])[0])[key] for key in ("x", "series"))
    start = np.datetime64("2024-05-01T06:00:00.3", "us").astype(int) / 1e6
    assert axis["dates"] and abs(axis["start"] - start) < 1e-6 and axis["step"] == 0.1
    xs = series[0]["xs"]
    first = xs[0] if isinstance(xs, list) else xs.get("start", start)
    assert abs(first - start) < 1e-6
    assert n != 300 or abs(xs["step"] - 0.1) < 1e-8


def test_the_start_of_an_undated_record_is_told_to_the_page():
    assert encode_chart(charts.time_charts(record(dt=0.1), 0, [])[0])["x"]["start"] == 0.0


@pytest.mark.parametrize("start", [0.0, DATE])
def test_samples_at_irregular_times_are_drawn_there_and_held_inputs_as_steps(start):
    after = np.cumsum(np.random.default_rng(1).uniform(1, 9, 40))
    times = start + after if start == 0.0 else np.datetime64(start, "us") + (1e6 * after).astype("m8[us]")
    moving = np.random.default_rng(2).standard_normal(40)
    data = optid.Data(np.column_stack([np.repeat([0.0, 1.0, np.nan, 2.0], 10), moving]), moving, times=times)
    shown = charts.time_charts(data, 0, [])
    begin = data.experiments[0].start
    for chart in shown:
        np.testing.assert_allclose(chart.series[0].xs - begin, after - after[0], atol=1e-6)
        assert encode_chart(chart)["x"].keys().isdisjoint({"step"})
    assert [encode_chart(chart)["series"][0]["held"] for chart in shown] == [False, True, False]
    drawn = data.plot().axes[0].lines[0]
    assert drawn.get_drawstyle() == "steps-post" and np.array_equal(drawn.get_xdata(), data.time)


def test_the_time_of_a_proof_is_shown_once_there_is_one():
    u = np.repeat([0.0, 1.0, 0.3], 40)
    y = process_model("P1", K=2.0, tau=9.0, dt=1.0).respond(u[:, None]).ravel()
    data = optid.Data(u, y + 0.01 * np.random.default_rng(0).standard_normal(120), dt=1.0)
    fits = optid.fit(data, "process.exact", process="P1"), optid.fit(data, "process.exact", process="P1", prove=False)
    for fit, proved in zip(fits, (True, False)):
        facts, times = dict(summary.solver_facts(fit)), fit.solution.times
        assert ("Proving" in facts) == proved == (times.prove > 0)
        assert fit.total_seconds == fit.seconds + times.late and times.late == times.prove


# -- faults


@pytest.fixture(scope="module")
def plant():
    return optid.fit(record(1500, dt=0.1), "hammerstein_ss.asivid", nx=1, basis="triangular:4").model


def broken(plant, **clock):
    """A record of 300 samples whose reading is moved from sample 200 on."""
    u = np.clip(levels(300, 3, m=1)[:, 0] / 3, -0.9, 0.9)
    y = np.ravel(plant.simulate(u)) + 0.01 * np.random.default_rng(1).standard_normal(300)
    y[200:] += 0.2
    return optid.Data(u, y, inputs=plant.inputs, outputs=plant.outputs, **clock)


def test_an_onset_is_printed_with_its_date(plant, tmp_path):
    data = broken(plant, dt=0.1, start="2024-05-01T06:06:32")
    found = diagnose(plant, data.map_signals(lambda u: u, lambda y: y, findings=(FINDING,)))
    onset = found.best.faults[0]
    date = f"2024-05-01 06:06:{32 + onset.onset / 10:04.1f}".removesuffix(".0")
    assert f"sample {onset.onset} ({date})" in str(found) and f"({date})" in found.explain()
    assert "from 2024-05-01 06:06:32 to 2024-05-01 06:07:01.9" in str(found)
    assert found.to_dict()["candidates"][0]["faults"][0]["onset_time"] == date
    assert str(load_diagnosis(found.save(tmp_path / "d.json"))) == str(found)
    assert str(found).startswith(f"The record\n- {FINDING}\nfaulty")
    page = found.report(tmp_path / "d.html").read_text(encoding="utf-8")
    assert page.index('<section id="record"') < page.index('<section id="verdict"') and date in page


def test_an_onset_is_printed_in_seconds_or_as_a_sample(plant):
    found = diagnose(plant, broken(plant, dt=0.1))
    assert f"({found.onset / 10:g} s)" in str(found)
    unknown = replace(plant, dt=1.0, time_unit="")
    found = diagnose(unknown, broken(plant))
    assert f"sample {found.onset}" in str(found) and " s)" not in str(found)


def test_a_diagnosis_of_arrays_has_the_unit_of_the_model(plant):
    data = broken(plant)
    assert diagnose(replace(plant, time_unit=""), (data.u, data.y)).timeline.unit == ""
    assert diagnose(plant, (data.u, data.y)).timeline.unit == "s"
