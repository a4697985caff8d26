"""Equations of the user's own: fits against independent routes, refusals, models that run and are saved."""

import warnings
from dataclasses import replace
from time import process_time

import cvxpy as cp
import numpy as np
import pytest
from refusals import refuses
from scipy.optimize import least_squares

import optid
from optid import Data, Equations
from optid.errors import DataWarning, LookupFailed, OptidError, RankError, StructureError
from optid.examples import example
from optid.identify.physical import PhysicalErrors

pytestmark = pytest.mark.numerical


def first_order(v):
    return {"x": v["a"] * v["x"] + v["b"] * v["u"], "y": v["x"]}


def cubic(v):
    return {"x": v["a"] * v["x"] - v["c"] * v["x"] ** 3 + v["b"] * v["u"], "y": v["x"] + v["d"]}


LINEAR = Equations(first_order, {"x": 0.5}, {"a": 0.5, "b": 1.0}, time="discrete")
CUBIC = Equations(cubic, {"x": 0.1}, {"a": 0.5, "b": 0.8, "c": 0.1, "d": 0.1}, time="discrete")


def record(n=200, seed=0, noise=0.05, f=lambda x, u: 0.8 * x + 0.5 * u, offset=0.0):
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-1, 1, n), np.zeros(n + 1)
    x[0] = 0.3
    for k in range(n):
        x[k + 1] = f(x[k], u[k])
    return Data(u, x[:n] + offset + noise * rng.normal(size=n))


def bent(n=200, seed=0):
    return record(n, seed, f=lambda x, u: 0.9 * x - 0.2 * x**3 + 0.5 * u, offset=0.4)


def quiet(data, equations, **arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return optid.fit(data, "physical", equations=equations, **arguments)


@pytest.fixture(scope="module")
def tanks():
    case = example("two_tanks")
    return case, quiet(case.data, "optid.plants:TWO_TANKS")


def test_two_tanks_are_found_within_their_errors(tanks):
    case, fit = tanks
    rows = {name: (value, error) for name, value, error, _, _ in fit.uncertainty.table()}
    assert set(rows) == set(case.truth["parameters"])
    for name, true in case.truth["parameters"].items():
        value, error = rows[name]
        assert abs(value - true) < 4 * error + 2e-3 * true  # the trapezoidal rule is not exact
        assert 0 < error < 0.02 * true
    assert optid.validate(fit.model, case.data).structure is None
    assert np.abs(fit.model.frequency_response(1e-9)).item() == pytest.approx(fit.model.static_gain(1.75), rel=0.05)
    assert fit.solution.status is optid.Status.LOCAL and "locally optimal" in str(fit)
    new = example("two_tanks", seed=5)
    assert np.asarray(fit.model.simulate(new.data, x0="fit")) == pytest.approx(new.truth["noise_free"], abs=0.1)


@pytest.mark.slow
def test_shorter_steps_come_nearer_to_the_differential_equation():
    case = example("two_tanks", n=300)
    clean = Data(case.data.u, case.truth["noise_free"][:300], 1.0)
    fast = optid.plants.two_tanks(case.data.u, upper=3.0, lower=2.5, pump=4.0)
    true, errors = np.array([4.0, 3.0, 2.5]), []
    for step in (None, 0.25):
        plant = replace(optid.plants.TWO_TANKS, parameters={"pump": 3.0, "upper": 3.0, "lower": 2.0}, step=step)
        found = quiet(fast, plant).model
        errors.append(float(np.abs(found.p - true).max()))
    assert errors[1] < 0.2 * errors[0]
    assert clean.n_samples == 300


def test_a_linear_equation_is_output_error():
    data = record()
    ours = quiet(data, LINEAR)
    theirs = optid.fit(data, "oe.exact", na=1, nb=1, nk=1, offset=False)
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=1e-8)
    assert ours.model.parameters["a"] == pytest.approx(-theirs.model.a[0], abs=1e-6)
    assert ours.model.parameters["b"] == pytest.approx(theirs.model.b[0][0], abs=1e-6)
    assert ours.model.poles == pytest.approx([ours.model.parameters["a"]])
    assert ours.model.static_gain(0.2) == pytest.approx(theirs.model.static_gain(0.2), rel=1e-6)
    errors = [row[2] for row in ours.uncertainty.table()]
    assert errors == pytest.approx([theirs.uncertainty.a.error[0], theirs.uncertainty.b[0].error[0]], rel=0.25)


@pytest.mark.parametrize("seed", range(3))
def test_the_optimum_against_a_simulation_written_out(seed):
    data = bent(seed=seed)
    u, y = data.u[:, 0], data.y[:, 0]

    def errors(z):
        x, out = z[4], np.zeros(len(u))
        for k in range(len(u)):
            out[k] = x + z[3]
            x = z[0] * x - z[2] * x**3 + z[1] * u[k]
        return out - y

    fit = quiet(data, CUBIC)
    again = least_squares(errors, [*fit.model.p, fit.model.start[0]], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert fit.solution.objective == pytest.approx(2 * again.cost, rel=1e-9)
    assert fit.model.p == pytest.approx(again.x[:4], abs=1e-5)
    covariance = np.linalg.inv(again.jac.T @ again.jac) * 2 * again.cost / (len(u) - 5)
    assert [row[2] for row in fit.uncertainty.table()] == pytest.approx(np.sqrt(np.diag(covariance))[:4], rel=0.25)


@pytest.mark.parametrize("solver", ["uno", "fatrop"])
def test_back_ends_agree(solver):
    data = bent(60)
    ours, theirs = (quiet(data, CUBIC, starts=1, solver=word) for word in ("ipopt", solver))
    assert theirs.solution.objective == pytest.approx(ours.solution.objective, rel=1e-6)
    assert theirs.solution.solver == solver


def test_gaps_experiments_and_two_outputs():
    parts = [bent(seed=seed) for seed in (0, 1)]
    y = [np.column_stack([part.y[:, 0], 10 * part.y[:, 0] + np.random.default_rng(3).normal(size=200)])
         for part in parts]
    y[0][20:40, 0] = np.nan
    u = [part.u.copy() for part in parts]
    u[1][150] = np.nan
    both = Data(u, y)

    def right(v):
        state, y = cubic(v).values()
        return {"x": state, "y1": y, "y2": v["g"] * y}

    plant = Equations(right, {"x": 0.1}, {**CUBIC.parameters, "g": 5.0}, time="discrete")
    fit = quiet(both, plant)
    found = fit.model.parameters
    assert (found["a"], found["c"], found["g"]) == pytest.approx((0.9, 0.2, 10.0), rel=0.15)
    errors = {name: error for name, _, error, _, _ in fit.uncertainty.table()}
    assert abs(found["a"] - 0.9) < 4 * errors["a"]
    assert len(fit.model.simulate(Data([p.u for p in parts], y), x0="fit")) == 2


@pytest.mark.slow
def test_constraints_on_parameters_and_states_have_prices():
    data = bent()
    free = quiet(data, CUBIC)
    limit = 0.9 * free.model.parameters["b"]

    def held(limit):
        return quiet(data, CUBIC, constraints=[lambda v: {"small": v["b"] <= limit}])

    fit, step = held(limit), 1e-4
    slope = (held(limit - step).solution.objective - held(limit + step).solution.objective) / (2 * step)
    (price,) = fit.prices
    assert price.binding and price.multiplier == pytest.approx(slope, rel=1e-3)
    assert fit.model.parameters["b"] == pytest.approx(limit)
    high = quiet(data, CUBIC, constraints=[lambda v: {"low": v["x"] <= 0.6}])
    assert high.solution.objective > free.solution.objective
    assert next(p for p in high.prices if p.name == "low").binding
    bounded = replace(CUBIC, parameters={**CUBIC.parameters, "b": 0.1}, bounds={"b": (0, limit)})
    assert quiet(data, bounded).model.parameters["b"] == pytest.approx(limit)


def test_what_the_record_does_not_determine_is_named():
    def product(v):
        return {"x": v["a"] * v["x"] + v["b"] * v["c"] * v["u"], "y": v["x"] + 0 * v["e"]}

    plant = Equations(product, {"x": 0.5}, {"a": 0.5, "b": 1.0, "c": 1.0, "e": 1.0}, time="discrete")
    refuses(RankError, "'b', 'c', 'e'.*no effect|'b', 'c', 'e' can change", quiet, record(), plant, starts=1)
    rules = [lambda v: [v["b"] == 2, v["e"] == 0]]
    assert quiet(record(), plant, starts=1, constraints=rules).model.parameters["c"] == pytest.approx(0.25, rel=0.1)


def test_models_are_saved_exported_and_run(tanks, tmp_path):
    _, fit = tanks
    path = fit.model.save(tmp_path / "tanks.json")
    loaded = optid.load(path)
    u = example("two_tanks", seed=3, n=100).data.u
    expected = fit.model.simulate(u)
    assert np.array_equal(loaded.simulate(u), expected) and loaded.equation() == fit.model.equation()
    step, x = loaded.to_casadi(), loaded.start
    for k in range(100):
        x, y = (np.array(part).ravel() for part in step(x, u[k]))
        assert y == pytest.approx(expected[k], abs=1e-9)
    other = replace(loaded, parameters={**loaded.parameters, "lower": 0.2})
    assert other.static_gain(1.0) == pytest.approx(loaded.static_gain(1.0) * (loaded.parameters["lower"] / 0.2) ** 2)
    rest = (loaded.parameters["pump"] / loaded.parameters["lower"]) ** 2
    assert loaded.static_gain(1.0) == pytest.approx(2 * rest, rel=1e-6)


def test_equations_are_written_as_by_hand():
    def right(v):
        return {"x": -v["a"] * (v["x"] - v["u"]) + 2 * cp.sqrt(v["x"] + 3) - (v["b"] * v["x"]) ** 2, "y": v["x"]}

    errors = PhysicalErrors.of(record(50), Equations(right, {"x": 0.5}, {"a": 0.5, "b": 0.1}))
    assert errors.in_words() == ("dx/dt = (-a) (x - u) + 2.0 sqrt(x + 3.0) - (b x)^2", "y = x")


@pytest.mark.parametrize(
    ("given", "words"),
    [(lambda: Equations(cubic, {}, {"a": 1.0}), "at least one state"),
     (lambda: Equations(cubic, {"x": 1.0}, {"x": 1.0}), "both a state and a parameter"),
     (lambda: Equations(cubic, {"x": 1.0}, {"a": np.nan}), "start of 'a'"),
     (lambda: Equations(cubic, {"x": 1.0}, {"a": 1.0}, {"b": (0, 1)}), "bounds of 'b'"),
     (lambda: Equations(cubic, {"x": 1.0}, {"a": 2.0}, {"a": (0, 1)}), "outside its bounds"),
     (lambda: Equations(cubic, {"x": 1.0}, {"a": 2.0}, time="sampled"), "one of continuous, discrete"),
     (lambda: Equations(cubic, {"x0": 1.0}, {"a": 2.0}), "name of the formulation"),
     (lambda: Equations(cubic, {"x": 1.0}, {"a": 2.0}), "asks? for 'c'"),
     (lambda: Equations(cubic, {"u": 1.0}, {"a": 2.0}), "channel of the record"),
     (lambda: Equations(first_order, {"x": 1.0}, {"a": 0.5, "b": 1.0, "k": 2.0}), "no equation uses the parameter 'k'"),
     (lambda: Equations(lambda v: {"x": v["a"]}, {"x": 1.0}, {"a": 2.0}), "nothing for 'y'"),
     (lambda: Equations(lambda v: {"x": v["a"], "y": v["x"], "z": 0}, {"x": 1.0}, {"a": 2.0}), "neither a state"),
     (lambda: Equations(lambda v: 3, {"x": 1.0}, {"a": 2.0}), "return a dictionary"),
     (lambda: Equations(first_order, {"x": 1.0}, LINEAR.parameters, step=0.3), "divided by an integer"),
     (lambda: Equations(lambda v: {"x": v["a"] * cp.log(v["x"]), "y": v["x"] - 1}, {"x": -1.0}, {"a": 0.1}),
      "equation of 'x' has no value at the start"),
     (lambda: Equations(lambda v: {"x": v["a"] * cp.sqrt(v["u"]), "y": v["x"] - 1}, {"x": 1.0}, {"a": 0.1}),
      "no value at the start, sample 1: .*u = -"),
     ("nowhere.py:plant", "no equations at"),
     ("optid.plants:TWO_TANK", "no 'TWO_TANK'"),
     ("optid.plants:two_tanks", "not optid.Equations"),
     (3, "not optid.Equations")])
def test_bad_equations_are_refused_by_name(given, words):
    refuses((StructureError, LookupFailed), words, lambda: quiet(record(50), given() if callable(given) else given))


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("right", "start", "time"), [
    (lambda v: {"x": v["a"] * v["x"] + v["b"] * v["u"], "y": v["x"]}, 50.0, "continuous"),
    (lambda v: {"x": v["a"] * v["x"] ** 3 + v["b"] * v["u"], "y": v["x"]}, 30.0, "discrete")])
def test_equations_that_explode_from_every_start_are_refused_in_seconds(right, start, time):
    plant, started = Equations(right, {"x": 1.0}, {"a": start, "b": 1.0}, time=time), process_time()
    refuses((StructureError, RankError), "leaves the range of numbers.* a = |no effect", quiet, bent(), plant, starts=2)
    assert process_time() - started < 30


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_steps_are_solved_to_the_size_of_the_states_or_end_the_run(scale):
    def right(v):
        return {"x": -v["a"] * v["x"] ** 2 / scale + v["b"] * scale * v["u"], "y": v["x"]}

    u = bent().u
    model = PhysicalErrors.of(Data(u, scale * u), Equations(right, {"x": scale}, {"a": 0.3, "b": 0.1}))
    p = np.array([0.3, 0.1])
    x = np.vstack([states for states, _ in model.runs.over(u, np.array([scale]), p)])[:20, 0] / scale
    middle = (x[1:] ** 2 + x[:-1] ** 2) / 2
    assert x[1:] - x[:-1] == pytest.approx(-0.3 * middle + 0.1 * u[:19, 0], abs=1e-12)
    escaping = np.vstack([y for _, y in model.runs.over(u, np.array([-100 * scale]), p)])
    assert len(escaping) == len(u) and np.isfinite(escaping[0]) and np.isnan(escaping[-1])


def test_a_tank_may_run_empty(tanks):
    _, fit = tanks
    dry = fit.model.simulate(np.zeros(200), x0=np.array([1.0, 1.0]))
    assert np.isfinite(dry).all() and np.abs(dry[-20:]).max() < 0.05 and np.ptp(dry[-20:]) < 1e-9
    record = Data(np.zeros(200), dry, fit.model.dt, inputs=fit.model.inputs, outputs=fit.model.outputs)
    assert np.ravel(fit.model.simulate(record, x0="fit")) == pytest.approx(np.ravel(dry), abs=1e-6)


def test_a_record_too_long_is_refused():
    k = np.arange(30_000)
    refuses(StructureError, "takes up to", quiet, Data(k % 7.0, k % 5.0), LINEAR)


def test_a_run_that_leaves_the_record_is_an_error(tanks):
    model = tanks[1].model
    wild = replace(model, parameters={**model.parameters, "pump": 1e7, "lower": 1e-6})
    refuses(OptidError, "leaves the range", optid.validate, wild, example("two_tanks", n=100).data)
