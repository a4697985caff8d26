"""Processes of several outputs, one type per pair, and records at irregular times."""

import json
import re

import numpy as np
import pytest
from refusals import refuses
from typer.testing import CliRunner

import optid
from formulations.constraints import process as words
from optid.cli.app import app
from optid.errors import DataError, StructureError
from optid.identify.process.order import best_basis, choose_types
from optid.identify.process.record import process_errors
from optid.models.process import ProcessModel, process_model
from optid.program.solution import Status
from optid.show import charts

T = np.arange(300.0)
PAIRS = [["P1D", "P1"], ["P2", "P1D"]]
TRUTH = {"K[level,valve]": 2.0, "tau[level,valve]": 20.0, "dead_time[level,valve]": 6.3, "K[level,heater]": -1.0,
         "tau[level,heater]": 8.0, "K[temp,valve]": 1000.0, "tau1[temp,valve]": 20.0, "tau2[temp,valve]": 5.0,
         "K[temp,heater]": 500.0, "tau[temp,heater]": 10.0, "dead_time[temp,heater]": 12.6, "level[level]": 3.0,
         "level[temp]": -40.0}
STEP = process_model("P1D", K=2.0, tau=30.0, dead_time=12.4, level=5.0)


@pytest.fixture(scope="module")
def record() -> optid.Data:
    rng = np.random.default_rng(0)
    u = np.column_stack([np.repeat(rng.normal(size=12), 25), np.repeat(rng.normal(size=15), 20)])
    pairs = (("P1D", dict(K=2.0, tau=20.0, dead_time=6.3, level=3.0)), ("P1", dict(K=-1.0, tau=8.0)),
             ("P2", dict(K=1000.0, tau1=20.0, tau2=5.0, level=-40.0)), ("P1D", dict(K=500.0, tau=10.0, dead_time=12.6)))
    parts = [process_model(word, **values).respond(u[:, [p % 2]]) for p, (word, values) in enumerate(pairs)]
    y = np.column_stack([parts[0] + parts[1], parts[2] + parts[3]]) + [0.05, 20.0] * rng.normal(size=(300, 2))
    return optid.Data(u, y, dt=1.0, inputs=["valve", "heater"], outputs=["level", "temp"])


def fit(data: optid.Data, process=PAIRS, **options) -> optid.Fit:
    return optid.fit(data, "process.exact", process=process, prove=False, **options)


@pytest.fixture(scope="module")
def both(record) -> optid.Fit:
    return fit(record)


# -- several outputs -----------------------------------------------------------------------------------------------


def test_every_output_is_what_it_is_alone(record, both):
    assert both.solution.status is Status.LOCAL
    assert both.params.names == tuple(TRUTH)
    for row in both.params:
        assert abs(row.estimate - TRUTH[row.name]) < 4 * row.error, row.name
    for output, types in zip(record.outputs, PAIRS):
        alone = fit(record.select(outputs=output), types)
        for row in alone.params:
            word, _, channel = row.name.partition("[")
            name = f"level[{output}]" if word == "level" else f"{word}[{output},{channel}"
            one = both.params[name]
            assert one.estimate == pytest.approx(row.estimate, rel=1e-6), name
            assert [one.error, one.lower, one.upper] == pytest.approx([row.error, row.lower, row.upper], rel=5e-3)


def test_the_model_of_several_outputs_runs_and_travels(record, both, tmp_path):
    model = both.model
    assert model.orders == {"process level,valve": "P1D", "process level,heater": "P1", "process temp,valve": "P2",
                            "process temp,heater": "P1D"}
    parts = [fit(record.select(outputs=output), types).model.simulate(record.select(outputs=output), "zero")[:, 0]
             for output, types in zip(record.outputs, PAIRS)]
    np.testing.assert_allclose(model.simulate(record), np.column_stack(parts), rtol=1e-4, atol=1e-4)
    sampled = model.to_continuous().to_discrete(1.0)
    rest = sampled.equilibrium(record.u[0])[0]
    np.testing.assert_allclose(sampled.simulate(record.u, x0=rest), model.simulate(record), rtol=1e-9, atol=1e-9)
    model.save(tmp_path / "plant.json")
    loaded = optid.load(tmp_path / "plant.json")
    np.testing.assert_array_equal(loaded.simulate(record), model.simulate(record))
    gains = np.array([[2.0, -1.0], [1000.0, 500.0]])
    np.testing.assert_allclose(loaded.static_gain([0.0, 0.0]), gains, rtol=0.03)
    np.testing.assert_allclose(loaded.step_response(200)[-1], [[1, 1, 0, 0], [0, 0, 1, 1]], atol=1e-3)
    assert np.allclose(loaded.frequency_response([0.1]), model.to_continuous().frequency_response([0.1]))
    assert [row.name for row in both.dynamics][-4:] == [
        "static gain[level,valve]", "static gain[level,heater]", "static gain[temp,valve]", "static gain[temp,heater]"]


def test_figures_show_a_curve_for_every_pair(both):
    series = charts.bode_charts({"": both.model}, [(-1.0, 1.0)] * 2)[0].series
    assert [one.name for one in series] == ["valve to level", "heater to level", "valve to temp", "heater to temp"]
    assert all(np.isfinite(one.ys).all() for one in series)
    one_input = ProcessModel(STEP.processes, STEP.nonlinearities, STEP.level, pairs=((0, 1),), inputs=("a", "b"))
    assert [one.name for one in charts.bode_charts({"": one_input}, [(-1.0, 1.0)] * 2)[0].series] == ["response"]
    np.testing.assert_allclose(one_input.simulate(np.column_stack([T, T]))[:, 0], STEP.simulate(T))


def test_an_older_file_of_one_output_has_no_pairs():
    content = STEP.to_dict()
    del content["pairs"]
    assert ProcessModel.from_dict(json.loads(json.dumps(content))).pairs == ((0, 0),)


def test_words_and_prices_of_a_pair(record):
    asked = [words.tau(20.0, channel="valve", output="level"), "gain:low=1010,channel=valve,output=temp"]
    first = fit(record, constraints=["tau:11,channel=heater,output=temp,number=1"])  # of one; the valve has two
    assert first.params["tau[temp,heater]"].estimate == pytest.approx(11.0)
    held = fit(record, constraints=asked)
    assert held.params["tau[level,valve]"].estimate == pytest.approx(20.0)
    assert held.params["K[temp,valve]"].estimate == pytest.approx(1010.0, rel=1e-6)
    assert [price.name for price in held.prices] == ["tau[valve,level]", "gain[valve,temp]"]
    # a price is the slope of the sum of squares in spreads of the outputs, as that of the output alone in its own
    alone = fit(record.select(outputs="level"), PAIRS[0], constraints=[words.tau(20.0, channel="valve")])
    spread = np.var(record.y[:, 0])
    assert held.prices[0].multiplier == pytest.approx(alone.prices[0].multiplier / spread, rel=1e-4)


def test_a_word_without_an_output_holds_for_every_one(record):
    with pytest.warns(optid.errors.DataWarning, match="too few levels"):
        held = fit(record, constraints=["monotone:increasing,channel=valve"], basis=["triangular:4", "linear"])
    assert [price.name for price in held.prices] == [
        "monotone:increasing[valve] of level", "monotone:increasing[valve] of temp"]


def test_functions_of_the_user_tie_outputs_together(record):
    tied = fit(record, constraints=[lambda view: view["log tau[level,heater]"] == view["log tau[temp,heater]"]])
    taus = [tied.params[f"tau[{output},heater]"].estimate for output in record.outputs]
    assert taus[0] == pytest.approx(taus[1], rel=1e-6) and 8 < taus[0] < 10


@pytest.mark.parametrize(("word", "message"), [
    ("tau:20,channel=valve", r"needs output=; the outputs are level, temp"),
    ("tau:20,channel=valve,output=speed", "names no output 'speed'"),
    ("overdamped:channel=valve,output=level", "no zeta"), ("tau:20,output=level", "needs channel=")])
def test_words_that_name_no_pair_are_refused(record, word, message):
    refuses(StructureError, message, fit, record, constraints=[word])


def test_pairs_without_effect_and_rows_in_one_list(record):
    ties = [["P1D", None], [None, "P1D"]]
    with pytest.warns(optid.errors.DataWarning, match="'level' does not begin at rest"):
        found = fit(record, ties)
    assert found.model.pairs == ((0, 0), (1, 1)) and found.model.static_gain([0.0, 0.0])[0, 1] == 0
    with pytest.warns(optid.errors.DataWarning, match="at rest"):
        flat = fit(record, ["P1D", "none", "none", "P1D"])
    assert flat.model.coefficients() == found.model.coefficients()


@pytest.mark.parametrize(("process", "message"), [
    ([["P1D", "P1"]] * 3, "3 rows for 2 outputs"), ([["P1D"], ["P1", "P1"]], "'level' has 1 entries for 2 inputs"),
    ([["P1D", "P1"], [None, None]], "'temp' names no type")])
def test_other_numbers_of_types_are_refused(record, process, message):
    refuses(StructureError, message, fit, record, process)


def test_proofs_of_all_outputs_are_one():
    u = np.where(T >= 10, 1.0, 0.0)
    rng = np.random.default_rng(1)
    y = np.column_stack([scale * STEP.respond(u[:, None]) for scale in (1.0, 1e4)])
    data = optid.Data(u, y + [0.04, 400.0] * rng.normal(size=y.shape), dt=1.0)
    found = optid.fit(data, "process.exact", process="P1D")
    assert found.solution.proof and found.solution.gap < 3e-6
    assert re.search(r"y1: proved.*y2: proved", found.solution.bound.reason)
    part = data.y.copy()
    part[::3, 1] = np.nan  # the second output is measured less often
    slow = optid.fit(optid.Data(u, part, dt=1.0), "process.exact", order="auto", prove=False)
    assert slow.figures["process type"].startswith("y1: P1D by BIC")
    for name in ("dead_time[y1,u]", "dead_time[y2,u]"):
        assert abs(slow.params[name].estimate - 12.4) < 4 * slow.params[name].error


def test_levels_of_experiments_and_motions_of_outputs(record):
    later = optid.Data([record.u, record.u], [record.y, record.y + [10.0, 1e3]], dt=1.0, inputs=record.inputs,
                       outputs=record.outputs)
    found = fit(later, offset="each", initial="free")
    np.testing.assert_allclose(np.diff(found.model.levels, axis=0), [[10.0, 1e3]], rtol=0.02)
    assert found.model.initial_state(later)[0].shape == (found.model.n_states,)
    assert found.simulation_fit.min() > 90


# -- irregular times -----------------------------------------------------------------------------------------------


def irregular(count: int = 200, seed: int = 3) -> optid.Data:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.3, 1.7, count))
    u = np.where(t >= 9.7, 1.0, 0.0)
    return optid.Data(u, STEP.respond(u[:, None], instants=t) + 0.04 * rng.normal(size=count), dt=1.0, times=t)


def test_a_model_runs_at_the_times_of_its_record():
    data = irregular()
    found = optid.fit(data, "process.exact", process="P1D")
    t = data.time
    expected = found.model.respond(data.u, instants=t)
    np.testing.assert_allclose(found.model.simulate(data)[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(found.model.predict(data, x0="zero")[:, 0], expected, atol=1e-12)
    moved = optid.Data(data.u, data.y[:, 0] + 1.5 * np.exp(-(t - t[0]) / found.params["tau"].estimate), dt=1.0, times=t)
    fitted = found.model.simulate(moved, x0="fit")[:, 0] - expected
    np.testing.assert_allclose(fitted, 1.5 * np.exp(-(t - t[0]) / found.params["tau"].estimate), atol=0.05)
    refuses(StructureError, "'zero', 'fit'", found.model.simulate, data, x0="steady")
    twice = optid.Data([data.u] * 2, [data.y] * 2, dt=1.0, times=[t, t])
    refuses(StructureError, "1 initial states for 2 experiments", found.model.simulate, twice, x0=[[0.0]])


def test_a_model_is_judged_at_irregular_times():
    """The tests hold their level where errors are coloured in time, and find a response that is too simple."""
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.exponential(1.0, 300) + 0.02)
    u, e = np.repeat(rng.normal(size=30), 10), np.zeros(300)
    kept = np.exp(-np.diff(t) / 5)
    for k, a in enumerate(kept, start=1):
        e[k] = a * e[k - 1] + np.sqrt(1 - a**2) * rng.normal()
    truth = process_model("P1D", K=2.0, tau=12.0, dead_time=3.4)
    data = optid.Data(u, truth.respond(u[:, None], instants=t) + 0.1 * e, times=t)
    right, wrong = fit(data, "P1D"), fit(data, "P1", initial="free")
    judged = {part.name: part for part in right.verdict.parts}
    assert right.verdict.word == "good" and "irregular times" in right.summary()
    assert judged["whiteness"].value == "coloured" and judged["error that the inputs explain"].passed
    assert judged["record"].outcome == judged["structure"].outcome == "-"
    failed = {part.name for part in wrong.verdict.failed}
    assert wrong.verdict.word == "poor" and failed >= {"independence of the inputs", "error that the inputs explain"}


@pytest.mark.slow
def test_a_search_at_irregular_times_tries_processes():
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.3, 1.7, 160))
    u = np.repeat(rng.normal(size=16), 10)
    truth = process_model("P1D", K=2.0, tau=6.0, dead_time=3.4)
    data = optid.Data(u, truth.respond(u[:, None], instants=t) + 0.02 * rng.normal(size=160), times=t)
    found = optid.identify(data, workers=1, classes=["linear"])
    assert found.model.orders == {"process": "P1D"} and found.verdict.word == "good"
    assert found.fit.params["dead_time"].estimate == pytest.approx(3.4, abs=0.2)


@pytest.mark.slow
def test_a_coarse_static_curve_does_not_bend_the_type():
    rng = np.random.default_rng([2, 41])
    t, u = np.cumsum(rng.uniform(0.3, 1.7, 400)), np.repeat(rng.uniform(-1, 1, size=40), 10)
    y = process_model("P2D", K=2.0, level=5.0, tau1=8.0, tau2=3.0, dead_time=3.4).respond(
        np.clip(u, -0.5, 0.5)[:, None], instants=t)
    data = optid.Data(u, y + 0.02 * np.ptp(y) * rng.normal(size=400), times=t)
    errors = [process_errors(data, "P1D", basis, initial="free") for basis in ("triangular:6", "triangular:8")]
    assert choose_types(errors[0])[1].startswith("P2DZ")  # 15 better than P2D by the criterion
    assert best_basis(errors) == 1 and choose_types(errors[1])[1].startswith("P2D by")


def test_parts_of_a_record_keep_their_times():
    data = irregular()
    first, second = data.split(0.5)
    np.testing.assert_allclose(np.concatenate([first.time, second.time]), data.time, atol=1e-12)
    np.testing.assert_allclose(data[20.0:40.0].time, data.time[(data.time >= 20) & (data.time < 40)])
    np.testing.assert_allclose(data.select(outputs="y").detrend().time, data.time)
    assert data.window(5, 9).experiments[0].stamps[0] == 0


def test_even_times_are_a_regular_record():
    data = optid.Data(np.arange(5.0), np.arange(5.0), times=3 + 0.1 * np.arange(5))
    assert data.is_regular and data.dt == 0.1 and data.start == 3.0 and data.time_unit == "s"
    dates = np.datetime64("2024-05-01T08:00:00") + np.array([0, 1, 3, 4, 5]).astype("m8[s]")
    dated = optid.Data(np.arange(5.0), np.arange(5.0), times=dates)
    assert dated.dated and not dated.is_regular and (dated.time == dates).all() and dated.dt == 1.0


def test_what_needs_even_distances_refuses_other_records():
    data = irregular()
    for call, message in ((lambda: optid.fit(data, "oe.exact", na=1, nb=1, nk=1), "'oe.exact' needs samples at even"),
                          (lambda: data.decimate(2), "decimate needs"),
                          (lambda: data.filter(high=0.1), "a filter needs"), (lambda: data.resample(2.0), "resample")):
        refuses(DataError, rf"{message}.*process\.exact", call)
    regular = optid.Data(np.where(T >= 10, 1.0, 0.0), STEP.respond(np.where(T >= 10, 1.0, 0.0)[:, None]), dt=1.0)
    model = optid.fit(regular, "oe.exact", na=1, nb=2, nk=13).model
    refuses(DataError, "this model needs samples at even distances", model.simulate, data)


@pytest.mark.parametrize(("times", "message"), [
    ([0.0, 1.0, np.nan], "sample 2 is not finite"), ([0.0, 1.0], r"shape \(2,\)"),
    (["a", "b", "c"], "seconds or dates"),
    ([0.0, 2.0, 1.0], "runs backwards at sample 2"), ([0.0, 1.0, 1.0], "stands still at sample 2"),
    ([0.0, 1.0], "one for each sample"), ([[0.0, 1.0, 2.0]] * 2, "2 arrays for 1 experiments")])
def test_impossible_times_are_refused(times, message):
    refuses(DataError, message, optid.Data, np.arange(3.0), np.arange(3.0), times=times)


@pytest.mark.slow
def test_the_command_takes_stamps_as_they_are(tmp_path):
    data = irregular()
    path = data.to_csv(tmp_path / "step.csv")
    common = [str(path), "--inputs", "u", "--outputs", "y"]
    done = CliRunner().invoke(app, ["fit", *common, "-f", "process.exact", "--process", "P1D", "--split", "0.8"])
    assert done.exit_code == 0, done.output
    assert "stamps are irregular" in done.output and "optimality is proved" in done.output
    assert "not tested: the samples" in done.output  # of the structure test on the rest
    searched = CliRunner().invoke(app, ["identify", *common])
    assert searched.exit_code == 0 and "Search over 1 structures" in searched.output  # of one move
    assert "process P1D" in searched.output and "samples at irregular times" in searched.output
    read = optid.read(path, "u", "y", gaps="stamps")
    np.testing.assert_allclose(read.time, data.time)
    refuses(DataError, "gaps='stamps' to keep the stamps", optid.read, path, "u", "y")


def test_the_command_takes_types_of_pairs(record, tmp_path):
    path = record.to_csv(tmp_path / "plant.csv")
    for given in ('[["P1D", "P1"], ["P2", "P1D"]]', "P1D,P1,P2,P1D"):
        done = CliRunner().invoke(app, [
            "fit", str(path), "--inputs", "valve,heater", "--outputs", "level,temp", "-f", "process.exact", "--process",
            given, "-c", "tau:20,channel=valve,output=level", "--no-prove"])
        assert done.exit_code == 0, done.output
        assert re.search(r"time constant\[level,valve\] +20", done.output)
        assert re.search(r"tau\[valve,level\] +active \(1 of 1\)", done.output)
