"""Multipliers are derivatives of the optimal objective; activity and slack are those of the model."""

import cvxpy as cp
import numpy as np
import pytest
from problems import BASIS, record
from scripts import benchmark

import optid
from formulations.constraints import shape

# bound -> constraint, with the sign of dF/d(bound)
BOUNDS = {
    "a low": (lambda t: lambda v: {"c": v["a"][0] >= t}, -1.0, 1.0),
    "a high": (lambda t: lambda v: {"c": v["a"][1] <= t}, 0.3, -1.0),
    "a fixed": (lambda t: lambda v: {"c": v["a"][0] == t}, -1.0, 1.0),
    "static sum": (lambda t: lambda v: {"c": cp.sum(v["Theta"], axis=1)[5] <= t}, 0.3, -1.0),
    "second entry of Theta": (lambda t: lambda v: {"c": v["Theta"][5, 1] >= t}, 1.2, 1.0),
    "radius of a": (lambda t: lambda v: {"c": cp.norm(v["a"]) <= t}, 1.1, -1.0),
}


def fit_with(form, build, bound):
    return optid.fit(record(count=100), form, na=2, nb=2, basis=BASIS, constraints=[build(bound)])


@pytest.mark.sampled(3)
@pytest.mark.parametrize("form", ["hammerstein_arx.exact", "hammerstein_arx.overparametrised"])
@pytest.mark.parametrize("name", BOUNDS)
def test_the_multiplier_is_the_derivative_of_the_objective(name, form):
    build, bound, sign = BOUNDS[name]
    fit = fit_with(form, build, bound)
    h = 1e-3
    up, down = (fit_with(form, build, bound + s * h).solution.objective for s in (1, -1))
    slope = (up - down) / (2 * h)
    assert abs(slope) > 0.1  # the bound binds
    price = fit.prices[0]
    assert price.name == "c" and price.binding and price.rows == price.active == 1
    assert price.multiplier == pytest.approx(abs(slope), rel=1e-3)
    assert np.sign(slope) == sign


def test_fit_points_are_the_change_of_the_printed_fit():
    build, bound, _ = BOUNDS["a low"]
    fit, relaxed = (fit_with("hammerstein_arx.exact", build, b) for b in (bound, bound - 1e-4))
    gained = (relaxed.one_step_fit[0] - fit.one_step_fit[0]) / 1e-4
    assert fit.prices[0].fit_points == pytest.approx(gained, rel=1e-3)


def test_a_slack_constraint_costs_nothing_and_says_how_far_it_is():
    fit = optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=[lambda v: {"far": v["a"][0] >= -3}])
    price = fit.prices[0]
    assert not price.binding and price.active == 0
    assert price.slack == pytest.approx(fit.model.a[0] + 3)
    assert price.multiplier < 1e-6 and price.fit_points < 1e-6


def test_rows_are_counted_over_the_members_of_a_group():
    fit = optid.fit(record(noise=1.0, count=60), na=2, nb=2, basis=BASIS, constraints=["convex"])
    price = fit.prices[0]
    bends = np.diff(np.diff(fit.model.nonlinearities[0](np.linspace(-1, 1, 7))))
    assert price.rows == 5 + 1  # and the sign of the sum of b
    assert price.active == np.count_nonzero(np.abs(bends) < 1e-6)
    assert 0 < price.active < 5


@pytest.mark.parametrize("build, slack", [
    (lambda v: {"cone": cp.SOC(cp.Constant(3.0), v["a"])}, lambda a: 3 - np.linalg.norm(a)),
    (lambda v: {"psd": cp.bmat([[2.0, v["a"][0]], [v["a"][0], 2.0]]) >> 0}, lambda a: 2 - abs(a[0])),
])
def test_cones_have_a_slack_too(build, slack):
    fit = optid.fit(record(), "arx", na=2, nb=2, constraints=[build])
    assert fit.prices[0].slack == pytest.approx(slack(fit.model.a), abs=1e-6)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("build", [
    lambda v: {"cone": cp.SOC(cp.Constant(1.1), v["a"])},
    lambda v: {"psd": cp.bmat([[1.0, v["a"][0]], [v["a"][0], 1.0]]) >> 0},
], ids=["SOC", "PSD"])
def test_cones_on_the_exact_form_are_solved_without_a_proof(build):
    fit = optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=[build])
    name = fit.prices[0].name
    assert fit.prices[0].binding and not fit.solution.proof
    assert f"constraint {name!r}" in fit.solution.bound.reason
    assert fit.solution.status is optid.program.solution.Status.LOCAL
    convex = optid.fit(record(), "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS, constraints=[build])
    assert convex.solution.objective <= fit.solution.objective * (1 + 1e-9)


def test_equalities_are_active():
    fit = optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=[shape.fixed("a", [-1.1, 0.4])])
    assert (fit.prices[0].active, fit.prices[0].rows, fit.prices[0].slack) == (2, 2, 0.0)


@pytest.mark.sampled(8)
@pytest.mark.parametrize("form", ["hammerstein_arx.exact", "hammerstein_arx.overparametrised"])
@pytest.mark.parametrize("word", sorted(benchmark("prices").cases(1.0, 1.0)))
def test_every_word_has_the_price_that_moving_its_bound_gains(word, form):
    seed = 0 if form.endswith("exact") else 1
    multiplier, slope = benchmark("prices").checked(word, seed, form, r=1e3, s=1e-2)
    assert multiplier == pytest.approx(slope, rel=1e-2) and slope > 0


@pytest.mark.parametrize("form", ["hammerstein_arx.overparametrised", "hammerstein_arx.exact"])
def test_bounds_that_say_the_same_cost_nothing_one_by_one(form):
    """Which of them is to have the multiplier is open, and to relax one alone gains nothing."""
    def bounds(first, second=-1.0):
        return [lambda v: {"one": v["a"][0] >= first}, lambda v: {"other": 2 * v["a"][0] >= 2 * second}]

    twice = optid.fit(record(count=100), form, na=2, nb=2, basis=BASIS, constraints=bounds(-1.0))
    relaxed = optid.fit(record(count=100), form, na=2, nb=2, basis=BASIS, constraints=bounds(-1.01))
    once = optid.fit(record(count=100), form, na=2, nb=2, basis=BASIS, constraints=bounds(-1.0)[:1])
    assert relaxed.solution.objective == pytest.approx(twice.solution.objective, rel=1e-7)
    assert once.prices[0].multiplier > 0.1
    assert [price.multiplier for price in twice.prices] == pytest.approx([0.0, 0.0], abs=1e-5)


def test_rows_of_one_bound_that_say_the_same_move_together():
    both = [lambda v: {"c": cp.hstack([v["a"][0], v["a"][0]]) >= -1.0}]
    twice, once = (optid.fit(record(count=100), "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS,
                             constraints=one).prices[0] for one in (both, [lambda v: {"c": v["a"][0] >= -1.0}]))
    assert twice.active == 2 and twice.multiplier == pytest.approx(once.multiplier, rel=1e-4)
