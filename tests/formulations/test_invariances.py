"""The same model in any units, levels, order of channels and coordinates of the states: registered formulations."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import optid
from formulations.constraints import shape
from optid.identify.uncertainty import uncertainty
from optid.program.units import in_units, inverse, own_units
from optid.registry import FORMULATIONS, find_entry_points
from optid.registry import formulation as find_formulation

pytestmark = pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
GRID = np.linspace(-0.9, 0.9, 7)
TAKE_A_START = {name for name in find_entry_points(FORMULATIONS)
                if "initial" in find_formulation(name)[1].__annotations__}
PROBE = np.random.default_rng(5).uniform(-0.9, 0.9, (60, 1))
CUBIC, HATS = {"basis": optid.Polynomial(3)}, {"basis": optid.Triangular(6)}
ARX, STATES = {"na": 2, "nb": 2}, {"nx": 2}


def gain(r, s):
    return [shape.gain(low=0.5 * r / s, high=5 * r / s)]


def curve(r, s):
    return [shape.monotone(), shape.slope(0.2 * r / s, 9 * r / s)]


def poles(r, s):
    return [shape.stable(0.8)]


def equations(r, s):
    """Two poles behind a curve, written by hand in units r of the output and s of the input."""
    def step(v):
        u = v["u"] / s
        return {"x": v["a"] * v["x"] + v["w"] + r * (v["b"] * u + v["c"] * u**3), "w": v["d"] * v["x"] + r * v["e"] * u,
                "y": v["x"]}

    start = {"a": 1.4, "b": 1.0, "c": 0.1, "d": -0.6, "e": 0.5}
    return optid.Equations(step, {"x": 0.1 * r, "w": 0.1 * r}, start, time="discrete")


CASES = {
    "arx": ("arx", ARX, gain), "exact": ("hammerstein_arx.exact", ARX | HATS, curve),
    "exact, linear input": ("hammerstein_arx.exact", ARX | {"basis": "linear"}, gain),
    "overparametrised": ("hammerstein_arx.overparametrised", ARX | HATS, curve),
    "huber": ("hammerstein_arx.exact", ARX | CUBIC | {"loss": "huber"}, curve), "oe": ("oe.exact", ARX, gain),
    "hammerstein oe": ("hammerstein_oe.exact", ARX | CUBIC, curve),
    "shooting": ("hammerstein_oe.shooting", ARX | CUBIC, curve), "armax": ("armax.exact", ARX | {"nc": 2}, gain),
    "hammerstein armax": ("hammerstein_armax.exact", ARX | CUBIC | {"nc": 2}, curve),
    "bj": ("bj.exact", ARX | {"nc": 1, "nd": 1}, gain),
    "hammerstein bj": ("hammerstein_bj.exact", ARX | CUBIC | {"nc": 1, "nd": 1}, curve),
    "state shooting": ("ss.shooting", STATES, None),
    "hammerstein state shooting": ("hammerstein_ss.shooting", STATES | CUBIC, None),
    "sid": ("hammerstein_ss.sid", STATES | CUBIC, curve),
    "sivid": ("hammerstein_ss.sivid", STATES | {"basis": "linear", "feedback_basis": "polynomial:2"}, None),
    "asivid": ("hammerstein_ss.asivid", STATES | CUBIC | {"feedback_basis": "polynomial:2"}, None),
    "ss": ("ss.exact", STATES, None), "hammerstein ss": ("hammerstein_ss.exact", STATES | CUBIC, None),
    "prediction": ("hammerstein_ss.exact", STATES | CUBIC | {"criterion": "prediction"}, None),
    "wiener": ("wiener_ss.exact", STATES, None),
    "hammerstein wiener": ("hammerstein_wiener_ss.exact", STATES | CUBIC, None),
    "latent shooting": ("lfr.shooting", STATES, None), "process": ("process.exact", {"process": "P2DU"}, None),
}
LOOSE = {  # with the accuracy of semidefinite programmes, of a likelihood, and of descents without a strict minimum
    "nuclear": ("hammerstein_arx.nuclear", ARX | HATS, curve, 1e-7),
    "subspace.nuclear": ("subspace.nuclear", STATES | {"weight": 30.0}, None, 1e-7),
    "poles": ("hammerstein_ss.sid", STATES | CUBIC, poles, 1e-7), "fir": ("fir", {"nb": 10}, None, 1e-7),
    "latent": ("lfr.exact", STATES | CUBIC, None, 1e-6),
    "physical": ("physical", {"equations": equations, "starts": 1}, None, 1e-6),
    "prior": ("arx", {"na": 10, "nb": 10, "nk": 1, "prior": "dc"}, None, 2e-5),
}
LONG = {"hammerstein ss", "prediction", "process", "latent shooting"}  # with two inputs
SQUARES = ("sid", "sivid", "asivid", "physical")  # of models with states: not in units of variances, or of the outputs


def record(seed=0, count=200, noise=0.3):
    """A tanh with a bit of a square before two poles, white noise on the output."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, count), np.zeros(count)
    f = np.tanh(2 * u) + 0.2 * u**2
    for k in range(2, count):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + f[k] + 0.5 * f[k - 1]
    return u, y + noise * rng.standard_normal(count)


def fitted(case, r=1.0, s=1.0, level=0.0, constrained=False, seed=0):
    name, arguments, build = case
    arguments = dict(arguments)
    if name.endswith("arx.nuclear"):
        arguments["weight"] = 2.0 * r
    if "equations" in arguments:
        arguments["equations"] = arguments["equations"](r, s)
    u, y = record(seed)
    return optid.fit(optid.Data(u=s * u, y=r * y + level), name, constraints=build(r, s) if constrained else (),
                     **arguments)


def facts(fit, r=1.0, s=1.0, level=0.0):
    """The model in numbers without units: poles and curve of a transfer function, a simulation of states."""
    model = getattr(fit.model, "plant", fit.model)
    if not hasattr(model, "a"):
        return (np.ravel(model.simulate(s * PROBE)) - level) / r
    values = np.sum(model.b[0]) * np.ravel(model.nonlinearities[0](s * GRID)) / r
    return np.concatenate([model.a, values - values[3],
                           (model.offset + values[3] * r - level * (1 + np.sum(model.a))) / r])


def same(case, accuracy, constrained, units):
    base = fitted(case, constrained=constrained)
    weighed = "nx" in case[1] and not case[0].endswith(SQUARES)
    expected, unit = facts(base), 0 if weighed else 2
    for r, s in units:
        other = fitted(case, r, s, constrained=constrained)
        assert other.solution.status is base.solution.status
        assert facts(other, r, s) == pytest.approx(expected, rel=accuracy, abs=accuracy)
        assert other.solution.objective / r**unit == pytest.approx(base.solution.objective, rel=accuracy)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_units_do_not_matter(name, constrained):
    if constrained and CASES[name][2] is None:
        pytest.skip("its constraints are those of other cases")
    same(CASES[name], 1e-9, constrained, [(1e-9, 1e9)] if constrained else [(1e9, 1e-9), (1e-9, 1e9)])


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", LOOSE)
def test_units_do_not_matter_to_the_accuracy_of_the_method(name):
    *case, accuracy = LOOSE[name]
    units = [(1e3, 1e-3), (1e-3, 1.0)] if name == "physical" else [(1e9, 1e-9), (1e-9, 1.0)]  # the user's equations
    same(case, accuracy, case[2] is not None, units)


def test_every_registered_formulation_is_tested():
    assert {name for name, *_ in (CASES | LOOSE).values()} == set(find_entry_points(FORMULATIONS))


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", CASES)
def test_a_detrended_and_scaled_record_gives_the_model_of_the_raw_one(name):
    formulation, arguments, _ = CASES[name]
    u, y = record()
    raw = optid.Data(u=3 * u + 5, y=1e-2 * y - 7)
    one, other = (optid.fit(data, formulation, **arguments) for data in (raw, raw.detrend().scale()))
    p, q = (fit.model.simulate(3 * PROBE + 5) for fit in (one, other))
    assert p == pytest.approx(q, abs=1e-5 * np.std(p))


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", [one for one in CASES if one not in LONG])
def test_order_and_units_of_the_channels_do_not_matter(name):
    """Two inputs, and of models with states two outputs, which no fit may treat by their place or size."""
    formulation, arguments, _ = CASES[name]
    (u, y), (v, z) = record(1), record(2)
    inputs, outputs = np.column_stack([u, v]), (y + 0.5 * z)[:, None]
    if "nx" in arguments:
        outputs = np.column_stack([outputs, z - 0.4 * y])
    probe, size, unit = np.column_stack([PROBE, PROBE[::-1]]), np.array([1e3, 1e-2]), np.array([50.0, 1e-3])
    unit = unit[: outputs.shape[1]]
    one = optid.fit(optid.Data(inputs, outputs), formulation, **arguments)
    other = optid.fit(optid.Data(inputs[:, ::-1] * size, outputs[:, ::-1] * unit), formulation, **arguments)
    p, q = one.model.simulate(probe), (other.model.simulate(probe[:, ::-1] * size) / unit)[:, ::-1]
    assert p == pytest.approx(q, abs=1e-4 * np.std(p))


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", [name for name, case in (CASES | LOOSE).items() if "nx" in case[1]])
def test_the_coordinates_of_the_states_do_not_matter(name):
    """Model and fit: the model in other coordinates is the same, and a start from there ends at the same model."""
    formulation, arguments, *_ = (CASES | LOOSE)[name]
    u, y = record()
    data = optid.Data(u, y)
    fit = optid.fit(data, formulation, **arguments)
    other = fit.model.transform(np.array([[1.0, 0.4], [-3.0, 20.0]]))
    for of in (lambda model: model.simulate(PROBE), lambda model: model.predict(data), lambda model: model.poles):
        assert of(other) == pytest.approx(of(fit.model), rel=1e-8, abs=1e-8 * np.std(y))
    if formulation in TAKE_A_START:
        again = optid.fit(data, formulation, initial=other, **arguments)
        assert again.solution.objective == pytest.approx(fit.solution.objective, rel=1e-7)
        assert again.model.simulate(PROBE) == pytest.approx(fit.model.simulate(PROBE), abs=1e-4 * np.std(y))


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 1000), st.floats(-9, 9), st.floats(-9, 9), st.sampled_from(["arx", "exact", "overparametrised"]),
       st.booleans())
def test_random_records_in_random_units(seed, size, spread, name, constrained):
    r, s = 10.0**size, 10.0**spread
    base, other = (fitted(CASES[name], *unit, constrained=constrained, seed=seed) for unit in ((1.0, 1.0), (r, s)))
    assert other.solution.status is base.solution.status
    assert facts(other, r, s) == pytest.approx(facts(base), rel=1e-9, abs=1e-9)
    assert other.solution.gap == pytest.approx(base.solution.gap, abs=1e-9)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize("name", ["arx", "exact", "overparametrised", "oe", "armax", "bj", "sid", "ss"])
def test_a_level_of_the_output_does_not_matter(name, constrained):
    """Up to 1e4 standard deviations what rounding of the samples leaves is far below 1e-9."""
    if constrained and CASES[name][2] is None:
        pytest.skip("its constraints are those of other cases")
    base = fitted(CASES[name], constrained=constrained)
    for level in (3e1, 3e4, -3e4):
        other = fitted(CASES[name], level=level, constrained=constrained)
        assert other.solution.status is base.solution.status
        assert other.solution.objective == pytest.approx(base.solution.objective, rel=1e-9)
        assert facts(other, level=level) == pytest.approx(facts(base), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", ["arx", "exact"])
def test_bound_and_standard_errors_do_not_depend_on_the_level(name):
    base, other = fitted(CASES[name]), fitted(CASES[name], level=1e4)
    assert other.solution.bound.value == pytest.approx(base.solution.bound.value, rel=1e-9)
    assert other.uncertainty.a.error == pytest.approx(base.uncertainty.a.error, rel=1e-9)
    assert other.uncertainty.b[0].error == pytest.approx(base.uncertainty.b[0].error, rel=1e-9)


@pytest.mark.parametrize("level", [1e6, 1e8, 1e10])
def test_high_levels_cost_what_the_rounding_of_the_samples_costs(level):
    u, y = record(count=500)
    rounded = (y + level) - level  # what a double keeps of y
    expected = optid.fit(optid.Data(u=u, y=rounded), na=2, nb=2, **HATS).solution.objective
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fit = optid.fit(optid.Data(u=u, y=y + level), na=2, nb=2, **HATS)
    assert fit.solution.status is optid.Status.OPTIMAL
    assert fit.solution.objective == pytest.approx(expected, rel=1e-15 * level)
    assert any("decimal digits" in str(one.message) for one in said) == (level > 1e9)


def test_intervals_under_inequalities_have_the_same_digits_in_any_units():
    case = CASES["exact"]
    low, high = [], []
    for r, s in [(1.0, 1.0), (1e-7, 1e5), (3e8, 2e-6)]:
        found = uncertainty(fitted(case, r, s, constrained=True))
        assert "inequalities" in found.meaning
        band = found.band(0, s * GRID)
        low.append(np.concatenate([found.a.lower, found.b[0].lower, band.lower / r]))
        high.append(np.concatenate([found.a.upper, found.b[0].upper, band.upper / r]))
    for ends in (low, high):
        for other in ends[1:]:
            assert other == pytest.approx(ends[0], rel=1e-6, abs=1e-6)


def test_prices_follow_the_units():
    base, other = fitted(CASES["exact"], constrained=True), fitted(CASES["exact"], 1e6, 1e-3, constrained=True)
    for one, two in zip(base.prices, other.prices):
        assert two.points_per_step == pytest.approx(one.points_per_step, rel=1e-6, abs=1e-9)
    assert other.prices[1].multiplier == pytest.approx(1e12 / 1e9 * base.prices[1].multiplier, rel=1e-6)


def test_named_values_are_in_the_units_of_the_record():
    fit = fitted(CASES["exact"], 1e3, 1e-2, level=7e3)
    values, model = fit.values, fit.model
    assert np.outer(values["mu"], values["b"]) == pytest.approx(np.outer(model.nonlinearities[0].mu, model.b[0]))
    assert values["offset"] == pytest.approx(model.offset) and values["a"] == pytest.approx(model.a)


def test_the_way_there_and_back():
    u, y = record()
    data = optid.Data(u=3 * u + 5, y=1e5 + 40 * y)
    units = own_units(data, [True])
    inner = in_units(data, units)
    assert np.mean(inner.y) == pytest.approx(0, abs=1e-9) and np.std(inner.y) == pytest.approx(1)
    assert np.std(inner.u) == pytest.approx(1)
    again = in_units(inner, inverse(units))
    assert again.y == pytest.approx(data.y, rel=1e-15) and again.u == pytest.approx(data.u, rel=1e-14)
    assert own_units(data, centred=False).y_offset == (0.0,)
