"""Constraints on the nonlinearity: the model obeys them, the optimum is the global one, prices are derivatives."""

import cvxpy as cp
import numpy as np
import pytest
from problems import BASIS, NODES, dense, raw_problem, record, search
from refusals import refuses
from systems import nonlinearity

import optid
from formulations.constraints import shape
from optid.bases import BSpline, Polynomial, Triangular, Trigonometric
from optid.errors import StructureError
from optid.models import HammersteinTF

GRID = np.linspace(-1, 1, 401)
INNER = np.linspace(-0.999, 0.999, 401)


def static(model, u):
    """Output in steady state, from the difference equation itself."""
    f = model.nonlinearities[0](u)
    return (f * model.b[0].sum() + model.offset[0]) / (1 + model.a.sum())


def static_slope(model, u):
    return (static(model, u + 1e-7) - static(model, u - 1e-7)) / 2e-7


def shaped(model, u):
    return model.nonlinearities[0](u)


def rising(values):
    """Whether values rise everywhere or fall everywhere (the sign belongs to b)."""
    steps = np.diff(values)
    return min(np.max(-steps), np.max(steps)) < 1e-8


def curved(values):
    bends = np.diff(values, 2)
    return min(np.max(-bends), np.max(bends)) < 1e-8


OBEYED = {
    "monotone": (shape.monotone("increasing"), lambda m: rising(shaped(m, GRID))),
    "convex": (shape.convex(), lambda m: curved(shaped(m, GRID))),
    "concave": (shape.concave(), lambda m: curved(shaped(m, GRID))),
    "odd": (shape.odd(), lambda m: np.ptp(shaped(m, GRID) + shaped(m, -GRID)) < 1e-8),
    "even": (shape.even(), lambda m: np.ptp(shaped(m, GRID) - shaped(m, -GRID)) < 1e-8),
    "dead zone": (shape.dead_zone(-0.3, 0.3), lambda m: np.ptp(shaped(m, np.linspace(-0.3, 0.3, 50))) < 1e-8),
    "saturation": (shape.saturation(-0.6, 0.7), lambda m: np.ptp(shaped(m, np.linspace(-1, -0.6, 50))) < 1e-8
                   and np.ptp(shaped(m, np.linspace(0.7, 1, 50))) < 1e-8),
    "slope": (shape.slope(0.5, 3), lambda m: np.all(np.abs(static_slope(m, INNER) - 1.75) <= 1.25 + 1e-6)),
    "range": (shape.value_range(-2, 1.5), lambda m: np.all(static(m, GRID) <= 1.5 + 1e-7)
              and np.all(static(m, GRID) >= -2 - 1e-7)),
    "through": (shape.through([0.0, 0.5], [0.5, 2]), lambda m: np.allclose(static(m, np.array([0.0, 0.5])), [0.5, 2])),
    "gain": (shape.gain(2.0, at=0.1), lambda m: np.isclose(static_slope(m, np.array([0.1]))[0], 2.0, atol=1e-6)),
    "gain bounds": (shape.gain(low=1, high=2, at=0.1),
                    lambda m: 1 - 1e-6 <= static_slope(m, np.array([0.1]))[0] <= 2 + 1e-6),
    "known f": (shape.fixed("mu", np.delete(np.tanh(NODES), 3)),
                lambda m: np.linalg.matrix_rank([m.nonlinearities[0].mu, np.delete(np.tanh(NODES), 3)], 1e-7) == 1),
    "known b": (shape.fixed("b", [1.0, 0.5]), lambda m: np.isclose(m.b[0][1] / m.b[0][0], 0.5)),
    "known a": (shape.fixed("a", [-1.1, 0.4]), lambda m: np.allclose(m.a, [-1.1, 0.4])),
    "bound on a": (shape.coefficients("a", low=-1.0, index=0), lambda m: m.a[0] >= -1 - 1e-8),
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize("name", OBEYED)
def test_the_exact_model_obeys_and_is_the_global_optimum(name, gain):
    rule, holds = OBEYED[name]
    data = record(gain, count=80, noise=0.8, seed=1)
    fit = optid.fit(data, na=2, nb=2, basis=BASIS, constraints=[rule])
    assert holds(fit.model)
    best = known_direction(data) if name == "known b" else search(fit.problem, 48)
    assert fit.solution.objective == pytest.approx(best, rel=1e-6)
    assert fit.solution.bound.value <= best * (1 + 1e-7)


def known_direction(data):
    """With b known the problem is linear least squares in (a, mu, d)."""
    phi, y = dense(data, 2, (2,), (0,), [BASIS])
    merged = np.column_stack([phi[:, :2], phi[:, 2:8] + 0.5 * phi[:, 8:14], phi[:, -1]])
    return np.linalg.lstsq(merged, y[:, 0], rcond=None)[1][0]


RELAXED = [name for name in OBEYED if name not in ("known b",)]


@pytest.mark.sampled(11)
@pytest.mark.parametrize("name", RELAXED)
def test_the_relaxed_theta_obeys_and_bounds_the_exact_optimum(name):
    rule, _ = OBEYED[name]
    data = record(count=80, noise=0.8, seed=1)
    relaxed = optid.fit(data, "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS, constraints=[rule])
    values = relaxed.values
    total = values["Theta"].sum(axis=1)  # of a relaxation only the static characteristic has a meaning of its own
    stand_in = HammersteinTF(values["a"], ([1.0],), (type(nonlinearity(BASIS))(BASIS, total),), (0,), values["offset"])
    if name == "concave":
        assert np.max(np.diff(shaped(stand_in, GRID), 2)) < 1e-8
    else:
        assert OBEYED[name][1](stand_in)
    assert relaxed.solution.proof
    if name not in ("convex", "concave"):  # the exact forms leave the sign to b, the relaxed ones do not
        exact = optid.fit(data, na=2, nb=2, basis=BASIS, constraints=[rule])
        assert relaxed.solution.objective <= exact.solution.objective * (1 + 1e-9)


def test_a_relaxed_constraint_equals_the_raw_sample_problem():
    data = record(count=80, noise=0.8, seed=1)
    fit = optid.fit(data, "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS,
                    constraints=[shape.slope(0.5, 2.0), shape.gain(1.0, at=0.1)])
    phi, y = dense(data, 2, (2,), (0,), [BASIS])
    rows = np.diff(BASIS.values(NODES), axis=0) * 3
    value, (theta,) = raw_problem(
        phi, y, 2, [(6, 2)], cp.sum_squares,
        constrain=lambda a, t, d: [rows @ cp.sum(t[0], axis=1) >= 0.5 * (1 + cp.sum(a)),
                                   rows @ cp.sum(t[0], axis=1) <= 2.0 * (1 + cp.sum(a)),
                                   rows[3] @ cp.sum(t[0], axis=1) == 1 + cp.sum(a)])
    assert fit.solution.objective == pytest.approx(value, rel=1e-7)
    assert np.allclose(fit.values["Theta"], theta, atol=1e-5)


def test_slack_constraints_change_nothing():
    data = record()
    free = optid.fit(data, na=2, nb=2, basis=BASIS)
    fit = optid.fit(data, na=2, nb=2, basis=BASIS, constraints=[
        shape.slope(-50, 50), shape.value_range(-50, 50), shape.gain(low=-50, at=0.1), shape.coefficients("a", high=9),
        "stable:0.99"])
    assert fit.solution.objective == pytest.approx(free.solution.objective, rel=1e-10)
    assert all(not price.binding and abs(price.multiplier) < 1e-6 for price in fit.prices)
    assert fit.solution.proof


@pytest.mark.parametrize("basis", [Triangular(7), Triangular(8), Polynomial(5), Trigonometric(3), BSpline(6),
                                   BSpline(5, degree=2)], ids=str)
@pytest.mark.parametrize("parity", ["odd", "even"])
def test_parity_on_a_symmetric_interval_holds_everywhere_for_every_basis(basis, parity):
    data = record(count=200)
    fit = optid.fit(data, "hammerstein_arx.overparametrised", na=1, nb=1, basis=basis.with_interval(-1, 1),
                    constraints=[getattr(shape, parity)()])
    f = shaped(fit.model, GRID)
    assert np.ptp(f + f[::-1] if parity == "odd" else f - f[::-1]) < 1e-7 * max(np.ptp(f), 1e-3)
    assert np.ptp(f) > 1e-3  # not everything is forbidden


@pytest.mark.sampled(1)
@pytest.mark.parametrize("basis", [BSpline(6), Polynomial(4)], ids=str)
@pytest.mark.parametrize("rule, order", [(shape.monotone(), 1), (shape.convex(), 2)], ids=["monotone", "convex"])
def test_cones_of_smooth_bases_hold_between_their_points(basis, rule, order):
    fit = optid.fit(record(count=60, noise=1.5, seed=4), na=1, nb=2, basis=basis.with_interval(-1, 1),
                    constraints=[rule])
    f = shaped(fit.model, np.linspace(-1, 1, 1501))
    steps = np.diff(f, order) / np.ptp(f)
    assert np.ptp(f) > 0.1
    assert min(np.max(-steps), np.max(steps)) < 1e-4 * np.max(np.abs(steps)) + 3e-5 * (order == 1)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("form, arguments, near", [
    ("hammerstein_arx.exact", {"na": 1, "nb": 1, "nk": 1}, 1e-7),
    ("hammerstein_oe.exact", {"na": 1, "nb": 1, "nk": 1}, 3e-6),
    ("hammerstein_ss.exact", {"nx": 1, "feedthrough": False}, 3e-6)], ids=["arx", "oe", "ss"])
@pytest.mark.parametrize("degree", [4, 9])
def test_words_about_a_polynomial_hold_between_any_points(degree, form, arguments, near):
    rng = np.random.default_rng(degree)
    u = rng.uniform(-1, 1, 300)
    y = plant_response(np.tanh(4 * u) + 0.3 * np.sin(9 * u)) + 0.05 * rng.normal(size=300)
    fine = np.linspace(-0.9999, 0.9999, 40_001)
    for word, low, high in (("monotone", 0.0, np.inf), ("slope:0.2,3", 0.2, 3.0), ("range:-0.9,0.8", -0.9, 0.8)):
        fit = optid.fit(optid.Data(u, y), form, basis=f"polynomial:{degree}", constraints=[word], prove=False,
                        **arguments)
        lo, hi = fit.model.nonlinearities[0].basis.interval
        points = fine * (hi - lo) / 2 + (hi + lo) / 2
        f = fit.model.nonlinearities[0]
        if form == "hammerstein_ss.exact":
            gain = float(np.squeeze(fit.model.C @ np.linalg.solve(np.eye(1) - fit.model.A, fit.model.B)))
            curve = gain * f(points) + np.squeeze(fit.model.equilibrium(np.zeros(1))[1]) - gain * f(np.zeros(1))
        else:
            gain, curve = fit.model.b[0].sum() / (1 + fit.model.a.sum()), static(fit.model, points)
        values = curve if word[0] == "r" else f.slope(points) * gain
        assert values.min() >= low - near and values.max() <= high + near  # to the accuracy of the solver
        assert min(values.min() - low, high - values.max()) < 0.05  # and not by much less than it allows


def plant_response(f):
    y = np.zeros(len(f))
    for k in range(1, len(f)):
        y[k] = 0.5 * y[k - 1] + 0.5 * f[k - 1]
    return y


@pytest.mark.parametrize("word", ["convex", "concave", "slope:0,1", "gain:1"])
def test_steps_have_no_slope(word):
    u = np.random.default_rng(0).uniform(-1, 1, 200)
    refuses(StructureError, "piecewise constant", optid.fit, optid.Data(u, plant_response(u)),
            "hammerstein_arx.exact", na=1, nb=1, nk=1, basis="piecewiseconstant:5", constraints=[word])


@pytest.mark.parametrize("gain", [1.0, -1.0])
def test_a_direction_of_b_decides_the_sign_of_a_monotone_f(gain):
    data = record(gain, noise=0.2)
    both = [shape.sign("b"), shape.monotone("increasing" if gain > 0 else "decreasing")]
    fit = optid.fit(data, na=2, nb=2, basis=BASIS, constraints=both)
    assert np.all(np.diff(shaped(fit.model, GRID)) * gain > -1e-9)
    assert np.all(fit.model.b[0] >= 0) and fit.solution.proof
    wrong = [shape.sign("b"), shape.monotone("decreasing" if gain > 0 else "increasing")]
    worse = optid.fit(data, na=2, nb=2, basis=BASIS, constraints=wrong)
    assert worse.solution.objective == pytest.approx(search(worse.problem, 48), rel=1e-5)
    assert worse.solution.objective > 2 * fit.solution.objective


@pytest.mark.sampled(3)
@pytest.mark.parametrize("form", ["hammerstein_arx.exact", "hammerstein_arx.overparametrised", "hammerstein_oe.exact",
                                  "hammerstein_armax.exact", "hammerstein_ss.sid", "hammerstein_ss.exact"])
@pytest.mark.parametrize("gain", [1.0, -1.0])
def test_a_monotone_plant_moves_where_the_word_says(form, gain):
    orders = {"nx": 2} if "ss" in form else {"na": 2, "nb": 2, **({"nc": 1} if "armax" in form else {})}
    errors = {}
    for word in ("increasing", "decreasing"):
        fit = optid.fit(record(gain, noise=0.2), form, basis=BASIS, constraints=[f"monotone:{word}"], prove=False,
                        raises=False, **orders)
        sign = 1.0 if word == "increasing" else -1.0
        levels = [fit.model.simulate(np.full(3000, level))[-1] for level in GRID[::8]]
        assert np.all(sign * np.diff(np.ravel(levels)) > -1e-5), word
        errors[word] = fit.solution.objective
    right, wrong = ("increasing", "decreasing") if gain > 0 else ("decreasing", "increasing")
    assert errors[wrong] > 2 * errors[right]


def two_channels():
    functions = (nonlinearity(Triangular(5), 0, (-1, 1)), nonlinearity(Polynomial(3), 1, (-1, 1)))
    return HammersteinTF([-0.9, 0.2], ([1.0, 0.4], [-0.6, 0.3]), functions, (0, 1), 0.2, inputs=("valve", "pump"))


def named_record():
    data = record(model=two_channels(), count=200, noise=0.6)
    return optid.Data(u=data.u, y=data.y, inputs=["valve", "pump"])


@pytest.mark.slow
def test_channels_are_constrained_by_name():
    bases = [Triangular(5).with_interval(-1, 1), Polynomial(3).with_interval(-1, 1)]
    fit = optid.fit(named_record(), na=2, nb=2, nk=[0, 1], basis=bases, constraints=[
        shape.monotone(channel="valve"), shape.odd(channel="pump"), shape.gain(1.5, at=0.1, channel="valve")])
    assert [price.name for price in fit.prices] == ["monotone:increasing[valve]", "odd[pump]", "gain[valve]"]
    f, g = (one(GRID) for one in fit.model.nonlinearities)
    assert rising(f) and np.ptp(g + g[::-1]) < 1e-7
    slope = (fit.model.nonlinearities[0](np.array([0.1 + 1e-6])) - fit.model.nonlinearities[0](np.array([0.1]))) / 1e-6
    assert slope[0] * fit.model.b[0].sum() / (1 + fit.model.a.sum()) == pytest.approx(1.5, abs=1e-5)
    every = optid.fit(named_record(), na=2, nb=2, nk=[0, 1], basis=bases, constraints=["monotone:increasing"])
    assert all(rising(np.round(one(GRID) * b.sum(), 6)) for one, b in zip(every.model.nonlinearities, every.model.b))


@pytest.mark.slow
def test_two_channels_share_their_dynamics():
    fit = optid.fit(named_record(), na=2, nb=2, nk=[0, 1], basis=Triangular(5).with_interval(-1, 1),
                    constraints=[shape.shared("b", "valve", "pump")])
    assert np.allclose(fit.values["b[valve]"], fit.values["b[pump]"], atol=1e-8)


@pytest.mark.parametrize("build, words", [
    (lambda: shape.monotone("sideways"), "'increasing' or 'decreasing'"),
    (lambda: shape.sign("b", "up"), "'positive' or 'negative'"),
    (lambda: shape.slope(2, 1), "low <= high; got 2, 1"),
    (lambda: shape.slope(), "low= and/or high="),
    (lambda: shape.gain(), "needs a value"),
    (lambda: shape.gain(float("inf")), "finite numbers; got inf"),
    (lambda: shape.slope(low=float("nan")), "finite numbers; got nan"),
    (lambda: shape.dead_zone(1, 1), "low < high"),
    (lambda: shape.saturation(), "low= and/or high="),
    (lambda: shape.through([0, 1], [1]), "as many outputs as inputs"),
    (lambda: shape.coefficients("a"), "low= and/or high="),
])
def test_impossible_arguments_are_refused_at_once(build, words):
    refuses(StructureError, words, build)


@pytest.mark.parametrize("rule, words", [
    (shape.monotone(channel="zz"), "no input 'zz'; the inputs are u"),
    (shape.dead_zone(3, 4), "outside the interval"),
    (shape.saturation(-3, 3), "outside the interval"),
    (shape.fixed("mu", [1.0, 2.0]), r"'mu' has shape \(6,\)"),
    (shape.coefficients("b", high=1.0), "'norm' only fixes a length"),
    (lambda v: {"q": v["c"] >= 0}, "asks for 'c'"),
])
def test_constraints_that_do_not_fit_the_structure_are_refused(rule, words):
    refuses(StructureError, words, optid.fit, record(), na=2, nb=2, basis=BASIS, constraints=[rule])


def test_rules_about_the_static_characteristic_need_one_output_and_a_channel():
    from systems import mimo

    true = mimo()
    data = record(model=true)
    with pytest.raises(StructureError, match="one output"):
        optid.fit(data, na=1, nb=1, basis="polynomial:2", constraints=[shape.gain(1.0, channel="u1")])
    with pytest.raises(StructureError, match="needs channel=, one of valve, pump"):
        optid.fit(named_record(), na=1, nb=1, basis="polynomial:2", constraints=[shape.gain(1.0)])


def test_symmetry_needs_zero_inside_the_interval():
    data = record()
    moved = optid.Data(u=data.u + 3, y=data.y)
    with pytest.raises(StructureError, match="does not contain zero"):
        optid.fit(moved, na=2, nb=2, basis="triangular:6", constraints=[shape.odd()])


def test_two_of_a_kind_get_names_of_their_own():
    rules = [shape.through(0.0, 0.5), shape.through(0.5, 2.0).with_name("second point")]
    fit = optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=rules)
    assert [price.name for price in fit.prices] == ["through", "second point"]
    with pytest.raises(StructureError, match="two constraints named 'through'"):
        optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=[rules[0], rules[0]])


def test_the_sign_rule_of_the_gauge_rests_where_a_constraint_fixes_a_sign():
    fit = optid.fit(record(-1.0, noise=0.2), na=2, nb=2, basis=BASIS,
                    constraints=[lambda v: {"rising": BASIS.increments() @ v["mu"] >= 0}, shape.sign("b", "negative")])
    assert np.all(fit.model.b[0] < 0)
    assert shaped(fit.model, GRID)[-1] > shaped(fit.model, GRID)[0]
