"""Fits of processes in continuous time: found, constrained, priced, proved, saved; bad input is refused by name."""

import re
import warnings

import numpy as np
import pytest
from refusals import refuses
from scipy import stats
from scipy.optimize import minimize, nnls
from typer.testing import CliRunner

import optid
from formulations.constraints import process as words
from optid.cli.app import app
from optid.errors import DataError, InfeasibleError, RankError, StructureError
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.order import choose_type
from optid.identify.process.proof import BranchAndBound
from optid.identify.process.record import process_errors
from optid.identify.process.starts import usual_box
from optid.identify.process.step_courses import step_of_two
from optid.models.process import ProcessModel, process_model
from optid.models.process_dynamics import ProcessDynamics, ProcessStructure
from optid.program.solution import Status

T = np.arange(200.0)
STEP = np.where(T >= 10, 1.0, 0.0)
FIRST = process_model("P1D", K=2.0, tau=30.0, dead_time=12.4, level=5.0)


def record(model: ProcessModel = FIRST, u: np.ndarray = STEP, noise: float = 0.04, seed: int = 0, **options
           ) -> optid.Data:
    u = np.reshape(u, (len(u), -1))
    y = model.respond(u) + noise * np.random.default_rng(seed).normal(size=len(u))
    return optid.Data(u, y, **{"dt": 1.0, **options})


def fit(data: optid.Data, process: str = "P1D", **options) -> optid.Fit:
    return optid.fit(data, "process.exact", process=process, **options)


def estimates(found: optid.Fit) -> dict[str, float]:
    return dict(found.model.coefficients())


def is_near(found: optid.Fit, truth: dict[str, float], errors: float = 4) -> None:
    """Assert that estimates are within so many of their standard errors of the truth."""
    for name, value in truth.items():
        row = found.params[name]
        assert abs(row.estimate - value) < errors * row.error, name


# -- what a fit returns --------------------------------------------------------------------------------------------


def test_first_order_with_dead_time_against_a_dense_search():
    """The optimum is that of a simplex over (tau, theta) from many starts, everything else by least squares."""
    data = record()
    y = data.y[:, 0]

    def value(p):
        x = np.column_stack([-np.expm1(-np.maximum(T - 10 - p[1], 0) / p[0]), np.ones(200)])
        return float(np.sum((y - x @ np.linalg.lstsq(x, y)[0]) ** 2))

    best = min((minimize(value, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14, "maxiter": 2000})
                for start in ([30, 12.2], [30, 12.7], [28, 11.5], [32, 13.5])), key=lambda one: one.fun)
    found = fit(data)
    assert found.solution.objective <= best.fun * (1 + 1e-9)
    np.testing.assert_allclose([found.params["tau"].estimate, found.params["dead_time"].estimate], best.x, rtol=1e-5)
    assert found.solution.status is Status.OPTIMAL and found.solution.proof and found.solution.gap < 2e-6


def test_time_is_in_the_unit_of_the_record():
    slow, fast = fit(record(dt=60.0)), fit(record())
    for name, factor in {"K": 1, "tau": 60, "dead_time": 60, "level": 1}.items():
        assert slow.params[name].estimate == pytest.approx(factor * fast.params[name].estimate, rel=1e-9)
        assert slow.params[name].error == pytest.approx(factor * fast.params[name].error, rel=1e-6)
    assert slow.params["tau"].unit == "s" and slow.dynamics["dead time"].unit == "s"


def test_other_units_of_the_channels_change_nothing_else():
    data = record()
    other = optid.Data(40 + 1e-3 * data.u, 1e5 * data.y - 300, dt=1.0)
    one, two = estimates(fit(data)), estimates(fit(other))
    assert two["tau"] == pytest.approx(one["tau"], rel=1e-7)
    assert two["dead_time"] == pytest.approx(one["dead_time"], rel=1e-7)
    assert two["K"] == pytest.approx(1e8 * one["K"], rel=1e-7)


@pytest.mark.parametrize(("process", "values"), [
    ("P1", {"tau": 20.0}), ("P2D", {"tau1": 30.0, "tau2": 8.0, "dead_time": 12.4}),
    ("P2DU", {"T": 8.0, "zeta": 0.3, "dead_time": 12.4}),
    ("P2DZ", {"tau1": 30.0, "tau2": 12.0, "tau_zero": -10.0, "dead_time": 6.4}),
    ("P3DU", {"tau": 25.0, "T": 5.0, "zeta": 0.2, "dead_time": 4.3})])
def test_exact_records_give_the_parameters_back(process, values):
    truth = process_model(process, K=2.0, level=5.0, **values)
    found = estimates(fit(record(truth, noise=1e-7), process))
    for name, value in {**values, "K": 2.0, "level": 5.0}.items():
        assert found[name] == pytest.approx(value, rel=2e-4), name


@pytest.mark.parametrize("process", ["P0DI", "P1DI"])
def test_integrators(process):
    values = {"dead_time": 12.4, **({"tau": 9.0} if process == "P1DI" else {})}
    truth = process_model(process, K=0.05, level=5.0, **values)
    found = fit(record(truth, ((T >= 10) & (T < 60)) * 1.0, 0.01), process)
    is_near(found, {**values, "K": 0.05})
    assert found.dynamics["slope"].estimate == pytest.approx(found.params["K"].estimate)
    refuses(StructureError, "integrator", found.model.static_gain, 0.5)


def test_two_inputs_two_experiments_and_labels():
    rng = np.random.default_rng(1)
    valve = process_model("P1D", K=2.0, tau=20.0, dead_time=6.3)
    heater = process_model("P2DU", K=-1.0, T=8.0, zeta=0.4, dead_time=2.7)
    us = [np.column_stack([np.repeat(rng.normal(size=10), 20), np.repeat(rng.normal(size=20), 10)]) for _ in range(2)]
    ys = [valve.respond(u[:, :1]) + heater.respond(u[:, 1:]) + 3 + 0.05 * rng.normal(size=200) for u in us]
    data = optid.Data(us, ys, dt=1.0, inputs=["valve", "heater"])
    found = fit(data, ["P1D", "P2DU"])
    is_near(found, {"K[valve]": 2, "tau[valve]": 20, "dead_time[valve]": 6.3, "K[heater]": -1, "T[heater]": 8,
                    "zeta[heater]": 0.4, "dead_time[heater]": 2.7, "level": 3})
    held = fit(data, ["P1D", "P2DU"], constraints=["tau:20,channel=valve"])
    assert estimates(held)["tau[valve]"] == pytest.approx(20.0)


def test_a_motion_before_the_record_has_a_state_of_its_own():
    moving = record().y[:, 0] + 1.5 * np.exp(-T / 30)
    data = optid.Data(STEP, moving, dt=1.0)
    free = fit(data, initial="free")
    with pytest.warns(optid.errors.DataWarning, match="does not begin at rest"):
        rest = fit(data)
    assert rest.figures["start"].startswith("not at rest")
    is_near(free, {"tau": 30})
    assert free.solution.objective < 0.5 * rest.solution.objective


def test_levels_of_experiments():
    ys = [record(seed=i).y[:, 0] + 10 * i for i in range(2)]
    data = optid.Data([STEP, STEP], ys, dt=1.0)
    found = fit(data, offset="each")
    is_near(found, {"tau": 30})
    np.testing.assert_allclose(found.model.levels[:, 0], [5, 15], atol=0.1)
    assert found.solution.proof


def test_irregular_instants_and_gaps():
    rng = np.random.default_rng(3)
    t = T + np.concatenate([[0], rng.uniform(-0.2, 0.2, 199)])
    u = np.where(t >= 9.7, 1.0, 0.0)
    y = FIRST.respond(u[:, None], instants=t) + 0.04 * rng.normal(size=200)
    y[40:55] = y[90:120] = np.nan
    found, regular = fit(optid.Data(u, y, dt=1.0, times=t)), fit(optid.Data(u, y, dt=1.0))
    is_near(found, {"K": 2, "tau": 30, "dead_time": 12.4})
    assert found.solution.proof and estimates(found) != estimates(regular)


def test_straight_inputs_are_exact():
    ramp = np.interp(T, [0, 10, 60, 200], [0, 0, 5, 1])
    one = FIRST.processes[0]
    y = 5 + 2 * one.response(T, T, ramp[:, None], straight=True)[:, 0, 0]
    found = fit(optid.Data(ramp, y + 1e-7 * np.random.default_rng(0).normal(size=200), dt=1.0), hold="first")
    assert estimates(found)["dead_time"] == pytest.approx(12.4, abs=1e-4)
    assert found.model.hold == "first"
    refuses(StructureError, "straight static curves", fit, optid.Data(ramp, y, dt=1.0), hold="first",
            basis="triangular:4")


def staircase(seed: int = 5, hold: int = 25) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).permutation(np.linspace(-1, 1, 16)), hold)


def test_static_curve_with_words():
    u = staircase()
    f = 2 * np.clip(u, -0.5, 0.5)
    y = process_model("P1D", K=1.0, tau=8.0, dead_time=3.3, level=5.0).respond(f[:, None])
    data = optid.Data(u, y + 0.02 * np.random.default_rng(0).normal(size=len(u)), dt=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optid.errors.DataWarning)
        free = fit(data, basis="triangular:9")
        flat = fit(data, basis="triangular:9", constraints=["monotone:increasing"])
    is_near(free, {"dead_time": 3.3})
    curve = flat.model.nonlinearities[0](np.linspace(-1, 1, 50))
    assert np.all(np.diff(curve) >= -1e-9) and flat.solution.objective >= free.solution.objective
    assert not free.solution.proof and "real poles" in free.solution.bound.reason
    assert "9 increments" in flat.solution.bound.reason


def test_a_model_is_saved_loaded_and_simulated(tmp_path):
    found = fit(record(), "P2D")
    found.model.save(tmp_path / "model.json")
    loaded = optid.load(tmp_path / "model.json")
    assert loaded.coefficients() == found.model.coefficients()
    np.testing.assert_array_equal(loaded.simulate(record()), found.model.simulate(record()))
    assert "exp(-" in str(loaded) and loaded.orders == {"process": "P2D"}
    np.testing.assert_allclose(loaded.simulate(record())[:, 0], loaded.respond(STEP[:, None]))


def test_simulation_fits_its_initial_state():
    moving = FIRST.respond(STEP[:, None]) + 1.5 * np.exp(-T / 30)
    data = optid.Data(STEP, moving, dt=1.0)
    np.testing.assert_allclose(FIRST.simulate(data, x0=FIRST.initial_state(data))[:, 0], moving, atol=1e-10)


def test_responses_of_the_model():
    model = process_model("P1D", K=2.0, tau=30.0, dead_time=12.0, level=5.0, dt=0.5)
    step = model.step_response(400)[:, 0, 0]
    t = 0.5 * np.arange(400)
    np.testing.assert_allclose(step, -np.expm1(-np.maximum(t - 12, 0) / 30), atol=1e-12)
    s = 0.2j
    assert model.frequency_response(0.2)[0, 0, 0] == pytest.approx(np.exp(-12 * s) / (30 * s + 1))
    assert model.static_gain(0.3) == 2.0 and model.is_stable and not model.integrates
    assert process_model("P2", tau1=3.0, tau2=20.0).processes[0].p.tolist() == [20.0, 3.0]  # the largest first


def test_poles_and_zero_may_be_named_instead_of_a_type():
    one = optid.fit(record(), "process.exact", poles=2, delay=True)
    assert one.model.orders == {"process": "P2D"}
    assert estimates(one) == pytest.approx(estimates(fit(record(), "P2D")))


# -- constraints ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("word", "name", "value"), [
    ("tau:high=25", "tau", 25.0), ("dead_time:15.4", "dead_time", 15.4), ("gain:2.2", "K", 2.2),
    ("K:high=1.9", "K", 1.9)])
def test_words_hold_and_their_prices_are_those_of_refits(word, name, value):
    data = record()
    found = fit(data, constraints=[word])
    assert estimates(found)[name] == pytest.approx(value, rel=1e-7)
    step = 1e-4 * value
    build = {"tau": lambda end: words.tau(high=end), "dead_time": lambda end: words.dead_time(end),
             "gain": lambda end: words.K(end), "K": lambda end: words.K(high=end)}[word.split(":")[0]]
    ends = [fit(data, constraints=[build(value + sign * step)]).solution.objective for sign in (1, -1)]
    assert found.prices[0].multiplier == pytest.approx(abs(ends[0] - ends[1]) / (2 * step), rel=1e-5)


def test_several_words_together():
    found = fit(record(), constraints=["tau:high=25", "gain:low=2.2"])
    assert found.solution.status in (Status.LOCAL, Status.OPTIMAL)
    assert estimates(found)["tau"] == pytest.approx(25) and estimates(found)["K"] == pytest.approx(2.2)


def test_overdamped_on_an_oscillation():
    truth = process_model("P2DU", K=2.0, T=8.0, zeta=0.6, dead_time=5.2, level=5.0)
    found = fit(record(truth), "P2DU", constraints=["overdamped"])
    assert estimates(found)["zeta"] == pytest.approx(1.0)
    assert found.prices[0].active and found.prices[0].multiplier > 0


def test_a_known_gain_sharpens_the_time_constant():
    t = np.arange(95.0)
    data = record(process_model("P1D", K=2.0, tau=80.0, dead_time=5.3, level=5.0), np.where(t >= 10, 1.0, 0.0))
    assert fit(data, constraints=["gain:2"]).params["tau"].error < 0.3 * fit(data).params["tau"].error


def test_bounds_are_part_of_the_proof_unless_they_contradict_each_other():
    found = fit(record(), constraints=["tau:high=25", "dead_time:low=14"])
    assert found.solution.proof and found.solution.status is Status.OPTIMAL
    refuses(InfeasibleError, "tau", fit, record(), constraints=[
        words.tau(high=10).with_name("below"), words.tau(low=20).with_name("tau above")])


@pytest.mark.parametrize("word", ["tau:high=60", "dead_time:12", "overdamped", "zeta:0.5", "K:2"])
def test_other_formulations_refuse_the_words_by_name(word):
    refuses(StructureError, rf"'{word.split(':')[0]}'.*process.exact", optid.fit, record(), "oe.exact", na=1, nb=1,
            nk=13, constraints=[word])


@pytest.mark.parametrize(("process", "word", "message"), [
    ("P1D", "overdamped", "no zeta"), ("P1", "dead_time:3", "no dead_time"), ("P1D", "tau_zero:3", "no tau_zero"),
    ("P1D", "tau:high=-2", "positive"), ("P1D", "dead_time:-1", "not negative"), ("P1D", "tau", "needs low"),
    ("P2D", "tau:3,number=4", "number=4"), ("P1D", "tau:3,number=2", "no tau2"), ("P0DI", "tau:3", "no tau")])
def test_words_that_do_not_apply_are_refused(process, word, message):
    refuses(StructureError, message, fit, record(), process, constraints=[word])


# -- proof ---------------------------------------------------------------------------------------------------------


def errors_of(data: optid.Data, process: str = "P1D", **options) -> ProcessErrors:
    return process_errors(data, process, "linear", **options)


def check_bounds(errors: ProcessErrors, boxes: np.ndarray, shares: list[np.ndarray], least: int, cone=None) -> None:
    """Assert that the bounds of boxes (B, d, 2) say something, and lie below the values at points (B, d) within."""
    lower, middle, _ = BranchAndBound(errors, usual_box(errors), cone).bounds(boxes)
    assert np.sum(lower > 0.3 * middle) > least
    for share in shares:
        for b, numbers in enumerate(boxes[:, :, 0] + share * (boxes[:, :, 1] - boxes[:, :, 0])):
            x = np.zeros(errors.unknowns.size)
            x[: len(numbers)] = numbers
            columns = errors.columns(x)
            if cone is None:
                value = float(np.sum((errors.y - columns @ np.linalg.lstsq(columns, errors.y)[0]) ** 2))
            else:  # levels of any sign
                signed = np.column_stack([columns[:, :2] @ cone, columns[:, 2:], -columns[:, 2:]])
                value = nnls(signed, errors.y)[1] ** 2
            assert lower[b] <= value * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_bounds_of_boxes_lie_below_every_point(seed):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=8), 10)
    errors = errors_of(record(process_model("P1D", K=2.0, tau=12.0, dead_time=4.4), u, 0.3, seed), offset=seed % 2 == 0)
    low = np.column_stack([rng.uniform(0, 4, 200), rng.uniform(0, 20, 200)])
    boxes = np.stack([low, low + 10 ** rng.uniform(-3, 0.3, (200, 2))], axis=2)
    check_bounds(errors, boxes, rng.uniform(0, 1, (6, 200, 2)), 30)


def test_bounds_within_a_cone_lie_below_every_point():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.integers(0, 3, 8), 10) * 1.0
    truth = process_model("P1D", K=2.0, tau=12.0, dead_time=4.4)
    errors = process_errors(record(truth, np.minimum(u, 1.2), 0.3), "P1D", "triangular:2")
    low = np.column_stack([rng.uniform(0, 4, 60), rng.uniform(0, 20, 60)])
    boxes = np.stack([low, low + 10 ** rng.uniform(-3, 0.3, (60, 2))], axis=2)
    check_bounds(errors, boxes, rng.uniform(0, 1, (6, 60, 2)), 10, np.tril(np.ones((2, 2))))


@pytest.mark.parametrize("moves", [1, 6])
def test_bounds_for_two_poles_lie_below_every_point(moves):
    rng = np.random.default_rng(moves)
    u = STEP[:80] if moves == 1 else np.repeat(rng.normal(size=8), 10)
    errors = errors_of(record(process_model("P2D", K=2.0, tau1=12.0, tau2=4.0, dead_time=4.4), u, 0.1, moves), "P2D")
    low = np.column_stack([rng.uniform(-1, 3, (150, 2)), rng.uniform(0, 20, 150)])
    boxes = np.stack([low, low + 10 ** rng.uniform(-3, 0.3, (150, 3)) * [1, 1, 3]], axis=2)
    check_bounds(errors, boxes, [*rng.uniform(0, 1, (4, 150, 3)), *rng.integers(0, 2, (4, 150, 3))], 50)


@pytest.mark.slow
def test_a_monotone_curve_of_few_increments_is_proved():
    u = np.repeat([0.0, 2, 1, 0, 1, 2], 15)
    data = record(process_model("P1D", K=2.0, tau=8.0, dead_time=4.4), np.minimum(u, 1.2), 0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optid.errors.DataWarning)
        found = fit(data, basis="triangular:2", constraints=["monotone", "tau:low=2,high=40", "dead_time:high=15"])
    assert found.solution.proof and found.solution.gap < 2e-6 and found.solution.status is Status.OPTIMAL


@pytest.mark.parametrize("seed", range(12))
def test_random_step_tests_are_proved(seed):
    rng = np.random.default_rng([seed, 3])
    count = int(rng.integers(60, 300))
    t, on = np.arange(float(count)), int(rng.integers(3, count // 4))
    truth = process_model("P1D", K=2.0, tau=np.exp(rng.uniform(np.log(2), np.log(count / 2))), level=5.0,
                          dead_time=rng.uniform(0, count / 4))
    found = fit(record(truth, np.where(t >= on, 1.0, 0.0), 2 * np.exp(rng.uniform(np.log(0.01), np.log(0.2))), seed))
    assert found.solution.proof and found.solution.gap < 2e-6


def test_steps_of_two_poles_are_those_of_processes():
    structure = ProcessStructure(2)
    for a, b in ((30.0, 8.0), (8.0, 30.0), (5.0, 5.0), (5.0, 5.0001), (100.0, 0.1)):
        process = ProcessDynamics(structure, np.array([a, b, 0.0]))
        for t in (0.01, 1.0, 7.0, 300.0):
            exact = process.response(np.array([t]), np.zeros(1), np.ones((1, 1)), sensitive=True)[0, :, 0]
            np.testing.assert_allclose(step_of_two(t, a, b), exact * [1, a, b, 1], rtol=1e-7, atol=1e-10)


def test_two_poles_are_proved_and_bounds_of_one_are_theirs():
    truth = process_model("P2D", K=2.0, tau1=12.0, tau2=4.0, dead_time=5.4, level=5.0)
    data = record(truth, STEP[:70], noise=0.005)
    found = fit(data, "P2D")
    assert found.solution.proof and found.solution.gap < 2e-6
    held = fit(data, "P2D", constraints=["tau:5,number=2", "dead_time:low=5"])
    assert held.solution.proof and estimates(held)["tau2"] == pytest.approx(5.0)


@pytest.mark.parametrize(("words", "name", "value"), [
    (["tau:low=5,number=2"], "tau2", 5.0), (["tau:high=10,number=1", "tau:low=1,number=2"], "tau1", 10.0),
    (["tau:3,number=2"], "tau2", 3.0)])
def test_numbers_count_from_the_largest_time_constant(words, name, value):
    """No bound on the second is met by giving the first and the second each other's values."""
    truth = process_model("P2D", K=2.0, tau1=12.0, tau2=4.0, dead_time=5.4, level=5.0)
    held = fit(record(truth, STEP[:70], noise=0.005), "P2D", constraints=words, prove=False)
    assert estimates(held)[name] == pytest.approx(value, rel=1e-6)
    assert held.prices[0].name == name and held.prices[0].active


def test_a_point_that_is_not_best_is_not_proved():
    errors = errors_of(record())
    search = BranchAndBound(errors, usual_box(errors))
    best = search.search(np.inf, 1e-6, 10).best
    bound = search.certify(1.01 * best)
    assert not bound.proved and "better point" in bound.reason


def test_without_a_bound_the_reason_is_said():
    found = fit(record(), "P2DU")
    assert not found.solution.proof and "one or two real poles" in found.solution.bound.reason
    assert fit(record(), prove=False).solution.bound.reason == "no proof was asked for"


# -- order ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("process", "values"), [
    ("P1D", {"tau": 30.0, "dead_time": 12.4}), ("P2DU", {"T": 8.0, "zeta": 0.4, "dead_time": 12.4}),
    ("P2D", {"tau1": 30.0, "tau2": 8.0, "dead_time": 12.4})])
def test_order_by_the_information_criterion(process, values):
    truth = process_model(process, K=2.0, level=5.0, **values)
    found = optid.fit(record(truth), "process.exact", order="auto")
    assert found.model.orders == {"process": process}
    assert re.match(rf"{process} by BIC, (runner-up|not distinguishable from) P", found.figures["process type"])


def test_types_that_the_record_does_not_tell_apart():
    truth = process_model("P3D", K=2.0, level=5.0, tau1=12.0, tau2=9.0, tau3=7.0, dead_time=5.4)
    words = [choose_type(errors_of(record(truth, seed=seed)))[1] for seed in range(6)]
    assert any("not distinguishable" in word for word in words)


def test_a_type_and_its_choice_exclude_each_other():
    refuses(StructureError, "give one of both", fit, record(), order="auto")
    refuses(StructureError, "order='bic'", fit, record(), "", order="bic")


# -- bad input -----------------------------------------------------------------------------------------------------


def test_an_input_that_never_moves_is_refused_with_what_is_determined():
    late = FIRST.respond(STEP[:, None])[60:]  # the step lies before the record
    data = optid.Data(np.ones(140), late, dt=1.0)
    refuses(DataError, "'u'", fit, data)
    words = r"'u' never moves.*before the record.*Determined is the course of 'y' alone"
    refuses(DataError, words, errors_of, data)


def test_a_dead_time_beyond_the_record_is_refused():
    quiet = 5 + 0.04 * np.random.default_rng(0).normal(size=200)
    words = r"no response to u.*dead time may be longer.*Determined is its level alone, 5"
    refuses(RankError, words, fit, optid.Data(STEP, quiet, dt=1.0))


def test_bounds_that_leave_nothing_to_try_are_refused():
    for word in ("dead_time:low=500", "dead_time:500", "tau:high=0.001", "tau:9999"):
        said = f"leave no value of {word.split(':')[0]} from .* longer or faster"
        refuses(InfeasibleError, said, fit, record(), constraints=[word])


def test_a_motion_is_named_where_it_keeps_times_from_separating():
    y = FIRST.respond(STEP[:, None]) + 3 * np.exp(-T / 30)
    with (pytest.warns(optid.errors.DataWarning, match="does not begin at rest.*initial='free'"),
          pytest.raises(RankError, match="does not separate")):
        fit(optid.Data(STEP, y + 0.04 * np.random.default_rng(0).normal(size=200), dt=1.0))


def test_time_constant_and_dead_time_that_cannot_be_separated():
    """A response that is over between two samples shows one number of the two."""
    y = 5 + 2.0 * (T >= 13) - 0.6 * (T == 13) + 1e-3 * np.random.default_rng(0).normal(size=200)
    words = "tau lies below a sampling time.*dead_time. Determined is their sum"
    refuses(RankError, words, fit, optid.Data(STEP, y, dt=1.0))


def test_other_impossible_requests():
    refuses(StructureError, "3 rows for 1 outputs", fit, record(), [["P1D"]] * 3)
    refuses(StructureError, "initial", fit, record(), initial="fit")
    refuses(StructureError, "2 entries for 1 inputs", fit, record(), ["P1D", "P1"])
    refuses(RankError, "output samples for", fit, optid.Data(STEP[8:12], T[8:12], dt=1.0))


def test_missing_inputs_cut_the_record():
    u = STEP.copy()
    u[100:103] = np.nan
    with pytest.warns(optid.errors.DataWarning, match="missing inputs"):
        found = fit(optid.Data(u, record().y, dt=1.0))
    is_near(found, {"tau": 30}, 5)


def test_kinks_between_samples_and_changes():
    errors = errors_of(record())
    assert errors.kinks(0, 12.4) == (12.0, 13.0)
    assert errors.kinks(0, 12.0) == (11.0, 12.0)
    assert ProcessStructure().names == ("tau", "dead_time")
    assert ProcessDynamics(ProcessStructure(), np.array([3.0, 1.0])).in_unit(0.5).p.tolist() == [6.0, 2.0]


# -- where else they are used --------------------------------------------------------------------------------------


def test_a_search_finds_the_process_behind_a_step_test():
    found = optid.identify(record(), workers=1)
    assert found.fit.formulation == "process.exact" and found.model.orders == {"process": "P1D"}
    is_near(found.fit, {"K": 2, "tau": 30, "dead_time": 12.4})


def test_other_fits_of_a_step_test_point_to_processes():
    sampled = optid.fit(record(), "oe.exact", na=1, nb=1, nk=13)
    assert any("--formulation process.exact --process P1D" in one.step for one in sampled.advice)
    assert not any("process.exact" in one.step for one in fit(record()).advice)


def test_criteria_count_the_dead_time():
    found = fit(record())
    errors = found.residuals[:, 0]
    likelihood = 200 * (np.log(np.mean(errors**2)) + 1 + np.log(2 * np.pi))
    assert found.bic == pytest.approx(likelihood + 4 * np.log(200))


def test_the_summary_says_seconds():
    text = fit(record(dt=2.0)).summary()
    assert "proved" in text and "profile likelihood" in text
    assert re.search(r"dead time +24\.\d+ .* s\n", text) and re.search(r"time constant +5\d\.\d+ .* s\n", text)


def test_parameters_at_their_bounds_are_named():
    ramp = process_model("P0DI", K=0.05, dead_time=3.0, level=5.0)
    found = fit(record(ramp, np.where(T >= 10, 1.0, 0.0), 0.01))
    largest = "tau at the largest value that is tried, 1990 s: the process may integrate (I in its type)"
    assert found.figures["bounds"] == largest
    two, one = (fit(record(noise=0.1, seed=seed), "P2D").figures.get("bounds", "") for seed in (0, 1))
    assert two == "" and one == "tau2 at the smallest value that is tried, 0.05 s: fewer poles may do"


def test_the_command_prints_gain_time_constant_dead_time_and_proof(tmp_path):
    data = record(dt=5.0, inputs="valve", outputs="temperature", input_units="%", output_units="K",
                  start="2024-05-01T08:00")
    data.to_csv(tmp_path / "step.csv")
    done = CliRunner().invoke(app, ["fit", str(tmp_path / "step.csv"), "--inputs", "valve", "--outputs", "temperature",
                                    "-f", "process.exact", "--process", "P1D", "--constraint", "tau:high=140",
                                    "--report", str(tmp_path / "step.html"), "--model", str(tmp_path / "step.json")])
    assert done.exit_code == 0, done.output
    assert re.search(r"time constant +140\.0 .* s\n", done.output) and "optimality is proved" in done.output
    assert re.search(r"static gain .* K/%\n", done.output) and re.search(r"tau +active \(1 of 1\)", done.output)
    assert optid.load(tmp_path / "step.json").orders == {"process": "P1D"}
    assert "dead time" in (tmp_path / "step.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("process", ["P2D", "P2DZ", "P3D", "P3DU", "P3DZ"])
def test_richer_types_fit_no_worse_and_say_what_is_not_determined(process):
    """Of a record of one pole the second one is a matter of the noise: its direction is flat, and said to be."""
    data, again = record(seed=21), record(seed=21)
    plain = fit(data, prove=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optid.errors.DataWarning)
        try:
            rich = fit(data, process, prove=False)
        except RankError as error:
            assert "can change together" in str(error) and "Determined is their sum" in str(error)
            return
    assert rich.solution.objective <= plain.solution.objective * (1 + 1e-5)
    assert rich.solution.status is Status.LOCAL or "not determined" in rich.solution.reason
    worst = max(row.error / row.estimate for row in rich.params if row.name.startswith("tau"))
    said = " ".join(str(rich.figures.get(name, "")) for name in ("not determined", "bounds", "time constants"))
    assert worst < 20 or said.strip()
    assert np.array_equal(data.u, again.u) and np.array_equal(data.y, again.y)  # the record stays as it is


def test_a_binding_word_is_the_reason_for_failed_tests():
    found = fit(record(), constraints=["tau:high=20"])
    assert found.verdict.failed and "active constraint may be the reason" in found.summary()
    assert any("leaving out 'tau', which binds" in one.sentence for one in found.advice)


RAMP = record(process_model("P1DI", K=0.05, tau=9.0, dead_time=12.4, level=5.0), ((T >= 10) & (T < 60)) * 1.0, 0.01)


@pytest.mark.parametrize("word", ["gain:low=1", "through:0,5", "range:low=0,high=9", "slope:low=0"])
def test_words_about_rest_point_integrators_to_their_slope(word):
    refuses(StructureError, "integrator has no static characteristic from u.*The word K", fit, RAMP, "P1DI",
            constraints=[word])


def test_a_bound_on_the_slope_of_an_integrator_may_push_the_dead_time_to_zero():
    held = fit(RAMP, "P1DI", constraints=["K:low=0.06"])
    assert held.solution.status is Status.LOCAL and estimates(held)["dead_time"] == pytest.approx(0, abs=1e-6)
    at_zero = fit(RAMP, "P1DI", constraints=["K:0.06", "dead_time:0"])
    assert held.solution.objective == pytest.approx(at_zero.solution.objective, rel=1e-6)


def test_intervals_of_dead_times_are_those_of_the_profile():
    data, level = record(), 0.9
    found = fit(data, prove=False)
    row = found.conf_int(level)["dead_time"]
    errors = errors_of(data)
    dof = 200 - errors.unknowns.size
    most = found.solution.objective * (1 + stats.f.ppf(level, 1, dof) / dof)
    for end in (row.lower, row.upper):  # everything else fitted again there
        there = fit(data, constraints=[words.dead_time(end)], prove=False)
        assert there.solution.objective == pytest.approx(most, rel=1e-4)
    shown = found.dynamics["dead time"]
    assert (shown.lower, shown.upper) == (found.params["dead_time"].lower, found.params["dead_time"].upper)


def test_a_time_constant_that_is_hardly_seen_has_no_negative_one_in_its_interval():
    found = fit(record(), "P2D", prove=False).params["tau2"]
    assert found.estimate - 1.96 * found.error < 0 < found.lower < found.estimate < found.upper


def test_real_poles_of_an_oscillation_are_equal_and_said_to_be():
    truth = process_model("P2DU", K=2.0, T=8.0, zeta=0.6, dead_time=5.2, level=5.0)
    with pytest.warns(optid.errors.DataWarning, match="condition number"):
        found = fit(record(truth), "P2D")
    assert estimates(found)["tau1"] == pytest.approx(estimates(found)["tau2"])
    assert found.solution.status is Status.OPTIMAL
    assert "complex pair" in found.figures["time constants"]


@pytest.mark.parametrize(("word", "values"), [
    ("P1D", {"tau": 7.0, "dead_time": 3.3}), ("P2DU", {"T": 3.0, "zeta": 0.3, "dead_time": 0.4}),
    ("P2DZ", {"tau1": 5.0, "tau2": 5.0, "tau_zero": -2.0, "dead_time": 2.0}), ("P1Z", {"tau": 4.0, "tau_zero": 2.0}),
    ("P3D", {"tau1": 5.0, "tau2": 5.0, "tau3": 1.0, "dead_time": 0.0})])
def test_state_equations_and_samples_are_those_of_the_process(word, values, tmp_path):
    model = process_model(word, K=2.5, level=1.5, dt=0.5, time_unit="s", **values)
    u = np.repeat(np.random.default_rng(0).normal(size=40), 5)
    y, continuous = model.respond(u[:, None]), model.to_continuous()
    assert np.allclose(continuous.simulate(u, dt=0.5, x0="rest"), y, atol=1e-12)
    sampled = continuous.to_discrete(0.5)
    rest = np.linalg.solve(np.eye(sampled.nx) - sampled.A, sampled.B @ [2.5 * u[0]] + sampled.offset_x)
    assert np.allclose(np.ravel(sampled.simulate(u, x0=rest)), y, atol=1e-12)
    assert np.allclose(continuous.frequency_response([0.1, 1.0]), model.frequency_response([0.1, 1.0]))
    assert model.zeros.size and model.to_c(tmp_path / "plant.c").stat().st_size > 0


@pytest.mark.parametrize(("word", "more", "message"), [
    ("P1D", {"hold": "first"}, "straight between samples"), ("P1D", {"drift": 0.1}, "A drift"),
    ("P1DI", {}, "An integrator that stands still")])
def test_what_has_no_state_equations_is_refused_by_name(word, more, message, tmp_path):
    model = process_model(word, tau=3.0, dead_time=1.0, **more)
    refuses(StructureError, message, model.to_c, tmp_path / "plant.c")


@pytest.mark.parametrize(("type_", "word"), [("P2D", "good"), ("P1D", "fair")])
def test_one_step_does_not_tell_coloured_noise_from_another_order(type_, word):
    true = process_model("P2D", K=2.0, tau1=30.0, tau2=12.0, dead_time=8.0)
    verdict = fit(record(true, u=np.repeat(STEP, 2)), type_).verdict
    assert verdict.word == word
    assert [part.name for part in verdict.failed] == ["whiteness"] * (word == "fair")


def test_bounds_are_part_of_the_proof():
    found = fit(record(), constraints=["tau:high=25", "dead_time:low=14"])
    assert found.solution.proof and found.solution.status is Status.OPTIMAL


def test_the_record_is_not_modified():
    data = record()
    u, y = data.u.copy(), data.y.copy()
    fit(data, "P2DZ")
    np.testing.assert_array_equal(data.u, u)
    np.testing.assert_array_equal(data.y, y)
