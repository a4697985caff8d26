"""The constraint word integrator: a pole at 1, its drift, and what is said of it."""

import warnings

import numpy as np
import pytest
from refusals import refuses
from scipy.optimize import least_squares
from scipy.signal import lfilter

import optid
from formulations.constraints.poles import integrator, stable
from optid import Data
from optid.errors import InfeasibleError, StructureError
from optid.identify.advice import advise_on_poles
from optid.models import HammersteinTF, Nonlinearity, roots
from optid.program.solution import Status


def tank(seed, drift=0.0, noise=0.02, samples=600):
    """Return the level of a tank: the integral of .02 (u - 20), delayed by one sample, with a drift."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-3.0, 3.0, samples // 20), 20)
    level = 50 + np.concatenate([[0.0], np.cumsum(0.02 * u + drift)[:-1]])
    return Data(20 + u, level + noise * rng.standard_normal(samples))


ORDERS = {"na": 1, "nb": 1, "nk": 1}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("drift", [0.0, 0.01])
@pytest.mark.parametrize("seed", range(5))
def test_the_slope_of_a_tank_is_found_apart_from_its_drift(seed, drift):
    data = tank(seed, drift)
    fit = optid.fit(data, "oe.exact", constraints=[integrator()], **ORDERS)
    model = fit.model
    assert fit.solution.status is Status.LOCAL and model.poles[0] == 1.0
    assert model.b[0][0] == pytest.approx(0.02, rel=0.01)
    assert model.offset[0] + 20 * model.b[0][0] == pytest.approx(drift, abs=1e-4)
    ramp = np.concatenate([[0.0], np.cumsum(data.u[:, 0])[:-1]])  # least squares in slope, drift and level
    columns = np.column_stack([ramp, np.arange(600.0), np.ones(600)])
    theta = np.linalg.lstsq(columns, data.y[:, 0])[0]
    assert [model.b[0][0], model.offset[0]] == pytest.approx(theta[:2], rel=1e-6)
    assert model.simulate(data, x0="fit") == pytest.approx(columns @ theta[:, None], abs=1e-5)


@pytest.mark.parametrize("name", ["arx", "hammerstein_arx.exact"])
def test_equation_errors_with_an_integrator_stay_proved(name):
    data = tank(1)
    basis = {"basis": "polynomial:2"} if "hammerstein" in name else {}
    fit = optid.fit(data, name, constraints=[integrator()], **ORDERS, **basis)
    assert fit.solution.status is Status.OPTIMAL and fit.model.poles[0] == pytest.approx(1.0, abs=1e-9)
    if name == "arx":
        rows = np.column_stack([data.u[:-1, 0], np.ones(599)])
        theta = np.linalg.lstsq(rows, np.diff(data.y[:, 0]))[0]
        assert [fit.model.b[0][0], fit.model.offset[0]] == pytest.approx(theta, rel=1e-6)


@pytest.mark.parametrize(("name", "more"), [("armax.exact", {"nc": 1}), ("bj.exact", {"nc": 0, "nd": 1}),
                                            ("hammerstein_oe.exact", {"basis": "polynomial:2"}),
                                            ("hammerstein_armax.exact", {"nc": 1, "basis": "polynomial:2"})])
def test_every_transfer_function_takes_an_integrator(name, more):
    fit = optid.fit(tank(2), name, constraints=[integrator()], **ORDERS, **more)
    assert fit.solution.status is Status.LOCAL and fit.model.poles[0] == pytest.approx(1.0, abs=1e-12)
    slope = fit.model.b[0][0] * (float(fit.model.nonlinearities[0].slope(np.array([20.0]))[0]))
    assert slope == pytest.approx(0.02, rel=0.02) and fit.model.integrates and not fit.model.is_stable


@pytest.mark.parametrize("seed", range(3))
def test_a_second_pole_beside_the_integrator_is_that_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 0.0, 1.0], 20), 15)
    data = Data(u, 4 + lfilter([0, 0.3], np.convolve([1, -1], [1, -0.8]), u) + 0.2 * rng.standard_normal(300))
    fit = optid.fit(data, "oe.exact", na=2, nb=1, nk=1, constraints=[integrator()])

    def errors(x):
        a = np.convolve([1, -1], [1, x[0]])
        return data.y[:, 0] - lfilter([0, x[1]], a, u) - lfilter([1], a, np.full(300, x[2])) - x[3] - x[4] * (
            -x[0]) ** np.arange(300)

    best = least_squares(errors, [-0.8, 0.3, 0.0, 4.0, 0.0], xtol=1e-14, ftol=1e-14)
    assert fit.solution.objective == pytest.approx(2 * best.cost, rel=1e-6)
    assert fit.model.poles[1].real == pytest.approx(-best.x[0], abs=1e-5)
    assert fit.model.b[0][0] == pytest.approx(best.x[1], rel=1e-4)


def test_levels_of_several_tanks_and_their_common_slope():
    parts = [tank(seed, samples=200) for seed in range(3)]
    data = Data([p.u for p in parts], [p.y + 100 * i for i, p in enumerate(parts)])
    fit = optid.fit(data, "oe.exact", constraints=[integrator()], offset="each", **ORDERS)
    assert fit.model.b[0][0] == pytest.approx(0.02, rel=0.01) and fit.model.levels.shape == (3, 1)
    assert np.ptp(fit.model.levels) < 1e-3  # of drifts: the levels are in the initial states


def test_an_integrator_simulates_without_a_warning_and_has_no_static_gain():
    model = optid.fit(tank(3), "oe.exact", constraints=[integrator()], **ORDERS).model
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = model.simulate(np.full(50, 25.0))
    assert np.diff(run[2:]) == pytest.approx(0.1, rel=0.02) and "(integrates)" in str(model)
    for refused in (lambda: model.static_gain(20.0), lambda: model.static_curve(0, np.ones(1)),
                    lambda: model.regauge("gain")):
        refuses(StructureError, "pole at 1|cannot be reached", refused)


def test_which_models_integrate():
    def of(*poles):
        return HammersteinTF(roots.with_roots(np.array(poles), len(poles)), (np.ones(1),),
                             (Nonlinearity(optid.Linear(), np.ones(1)),), (1,), np.zeros(1))

    assert of(1.0, 0.5).integrates and not of(1.0, 0.5).is_stable
    assert not of(0.999, 0.5).integrates and of(0.999, 0.5).is_stable
    for unstable in (of(1.0, 1.0), of(1.0, 1.2), of(-1.0), of(1.01)):
        assert not unstable.integrates and not unstable.is_stable
    assert of(1.01).integrates_within(0.02) and not of(1.01, -1.2).integrates_within(0.02)


def test_a_root_is_moved_to_one_and_taken_away():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a = roots.with_roots(np.array([0.97, 0.5, *(rng.uniform(0, 0.6) * np.exp([1j, -1j]))]), 4)
        moved = roots.with_integrator(a)
        assert 1 + moved.sum() == pytest.approx(0.0, abs=1e-12)
        rest = np.sort_complex(roots.roots_of(roots.without_integrator(moved)))
        assert rest == pytest.approx(np.sort_complex(np.delete(roots.roots_of(a), np.argmin(
            np.abs(roots.roots_of(a) - 0.97)))), abs=1e-8)
    pair = roots.with_integrator(roots.with_roots(0.95 * np.exp(np.array([0.1j, -0.1j])), 2))
    assert 1 + pair.sum() == pytest.approx(0.0, abs=1e-12) and roots.radius(roots.without_integrator(pair)) < 1


def test_advice_and_verdict_call_a_pole_at_one_an_integrator():
    for seed in range(3):
        for name in ("arx", "oe.exact"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                free = optid.fit(tank(seed), name, **ORDERS)
            assert [one.step for one in advise_on_poles(free)] == ["--constraint integrator"]
            held = optid.fit(tank(seed), name, constraints=[integrator()], **ORDERS)
            assert not list(advise_on_poles(held))
            part, = [one for one in held.verdict.parts if one.name == "stability"]
            assert part.value == "integrates" and part.passed


def test_a_pole_far_outside_the_circle_keeps_its_advice():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(150)
    data = Data(u, lfilter([0, 1], [1, -1.05], u) + 0.1 * rng.standard_normal(150))
    fit = optid.fit(data, "arx", **ORDERS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert [one.step for one in advise_on_poles(fit)] == ["--constraint stable:0.99"]
        parts = fit.verdict.parts
    part, = [one for one in parts if one.name == "stability"]
    assert part.value == "unstable" and not part.passed


def test_a_fast_stable_plant_is_not_called_an_integrator():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(300)
    data = Data(u, lfilter([0, 1], [1, -0.95], u) + 0.1 * rng.standard_normal(300))
    assert not list(advise_on_poles(optid.fit(data, "oe.exact", **ORDERS)))


@pytest.mark.parametrize(("name", "arguments", "words"), [
    ("ss.exact", {"nx": 1}, "state-space.*'oe.exact'"), ("hammerstein_ss.sid", {"nx": 1}, "state-space.*'oe.exact'"),
    ("fir", {"nb": 4}, "na is 0"), ("oe.exact", {"na": 0, "nb": 2}, "na is 0"),
    ("hammerstein_oe.shooting", {**ORDERS, "basis": "polynomial:2"}, r"hammerstein_oe\.exact")])
def test_what_cannot_integrate_says_so(name, arguments, words):
    refuses(StructureError, words, optid.fit, tank(0), name, constraints=[integrator()], **arguments)


def test_several_outputs_and_contradictions_are_refused():
    data = tank(0)
    both = Data(data.u, np.hstack([data.y, tank(1).y]))
    refuses(StructureError, "one output", optid.fit, both, "arx", constraints=[integrator()], **ORDERS)
    with pytest.raises(InfeasibleError, match="integrator.*stable|stable.*integrator"):
        optid.fit(data, "arx", constraints=[integrator(), stable(0.9)], **ORDERS)
