"""Time constants, damping, dead time and gain against closed forms; curves in output units whatever the gauge."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import optid
from optid.bases import Polynomial
from optid.identify.dynamics import dynamics, input_levels, integration, middle
from optid.identify.responses import responses
from optid.models import HammersteinSS, HammersteinTF, Nonlinearity

UNIT = [(0.0, 1.0)]


def transfer(poles, b=(1.0,), nk=1, dt=1.0, **more):
    a = np.atleast_1d(np.real(np.poly(poles)))[1:]
    return HammersteinTF(a, [b], (Nonlinearity(optid.Linear(), [1.0]),), (nk,), 0.0, dt, **more)


def record(seed, dt=1.0, tau=8.0, gain=2.0, noise=0.05, n=400, delay=2, white=True, f=lambda u: u):
    """A plant of first order, sampled; the noise enters the equation, or the output."""
    rng = np.random.default_rng(seed)
    u, p = np.repeat(rng.uniform(0, 1, n // 10), 10), np.exp(-dt / tau)
    x, e = np.zeros(n), noise * rng.standard_normal(n)
    for k in range(delay, n):
        x[k] = p * x[k - 1] + gain * (1 - p) * f(u[k - delay]) + white * e[k]
    return optid.Data(u, x if white else x + e, dt, "valve", "level", "%", "m")


# -- closed forms ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dt", "unit"), [(0.01, "s"), (1.0, "min"), (60.0, "h")])
def test_time_constants_are_those_of_the_sampled_plant(dt, unit):
    model = transfer([np.exp(-0.05), np.exp(-0.5)], nk=4, dt=dt, time_unit=unit)
    found = dynamics(model, UNIT)
    assert found.names == ("time constant 1", "time constant 2", "dead time", "static gain")
    assert found.estimates[:3] == pytest.approx([20 * dt, 2 * dt, 3 * dt])
    assert [row.unit for row in found] == [unit, unit, unit, ""]
    assert found["static gain"].estimate == pytest.approx(1 / (1 - np.exp(-0.05)) / (1 - np.exp(-0.5)))
    assert np.isnan([row.error for row in found]).all()


@pytest.mark.parametrize("zeta", [0.05, 0.4, 0.95])
def test_natural_frequency_and_damping_of_a_pair(zeta):
    w, dt = 1.3, 0.2
    s = w * complex(-zeta, np.sqrt(1 - zeta**2))
    found = dynamics(transfer([np.exp(s * dt), np.exp(np.conj(s) * dt), 0.3], dt=dt, time_unit="s"), UNIT)
    assert found["natural frequency"].estimate == pytest.approx(w) and found["natural frequency"].unit == "rad/s"
    assert found["damping"].estimate == pytest.approx(zeta)


@pytest.mark.parametrize(("above", "below", "unit"), [
    ("N", "A", "N per A"), ("N", "V", "N/V"), ("", "V", "1/V"), ("N", "", "N"), ("", "", "")])
def test_the_unit_of_a_gain_is_not_read_as_not_available(above, below, unit):
    model = transfer([0.5], input_units=(below,), output_units=(above,))
    assert dynamics(model, UNIT)["static gain"].unit == unit


@pytest.mark.parametrize(("nk", "dead"), [(0, 0.0), (1, 0.0), (2, 0.5), (11, 5.0)])
def test_dead_time_does_not_count_the_sample_of_the_hold(nk, dead):
    found = dynamics(transfer([0.5], nk=nk, dt=0.5), UNIT)
    assert found["dead time"].estimate == dead
    assert any("acts on the same sample" in note for note in found.notes) == (nk == 0)


def test_poles_without_a_time_constant_are_named():
    assert any("negative real pole" in note for note in dynamics(transfer([-0.5]), UNIT).notes)
    grows = dynamics(transfer([np.exp(0.1)]), UNIT)
    assert grows["time constant of growth"].estimate == pytest.approx(10)
    zero = dynamics(HammersteinSS(np.eye(2, k=1), [[0.0], [1.0]], [[1.0, 0.0]]), UNIT)
    assert "time constant" not in zero.names and any("Poles at zero" in note for note in zero.notes)


@pytest.mark.parametrize("second", [0.0, 0.9, -0.4])
def test_an_integrator_has_a_slope_and_no_static_gain(second):
    b, dt = [0.3, 0.1], 0.5
    model = transfer([1.0, second], b, nk=2, dt=dt, time_unit="s", output_units=("m",), input_units=("%",))
    found = dynamics(model, UNIT)
    assert found["slope"].estimate == pytest.approx(0.4 / (1 - second) / dt, rel=1e-5)
    assert found["slope"].unit == "m/(% s)" and "static gain" not in found.names
    assert any("A pole at 1: the model integrates" in note for note in found.notes)
    curves, reasons = responses(model, UNIT)
    assert [one.kind for one in curves] == ["rate", "step"] and "No static characteristic: a pole at 1" in reasons[0]
    rate, step = curves
    assert rate.value[-1] == pytest.approx(found["slope"].estimate, rel=1e-5) and rate.value[0] == 0
    assert (step.value[-1] - step.value[-2]) / (step.at[-1] - step.at[-2]) == pytest.approx(rate.value[-1], rel=1e-3)


def test_a_model_with_equal_time_constants_has_no_error_of_them_but_a_reason():
    rng = np.random.default_rng(0)
    u, y = np.repeat(rng.uniform(-1, 1, 100), 5), np.zeros(500)
    for k in range(2, 500):
        y[k] = 1.6 * y[k - 1] - 0.64 * y[k - 2] + 0.1 * u[k - 1] + 1e-6 * rng.normal()
    fit = optid.fit(optid.Data(u, y, 1.0), "arx", na=2, nb=1, nk=1)
    nearly = replace(fit.uncertainty, model=fit.model)
    model = transfer([0.8, 0.8 - 1e-9], [0.1])
    assert np.isfinite(dynamics(model, UNIT).estimates).all()
    found = dynamics(fit.model, UNIT, nearly)
    rows = [row for row in found if "time constant" in row.name or row.name in ("damping", "natural frequency")]
    assert all(np.isfinite(row.estimate) for row in rows)
    near = any("coincide" in note or "nearly real" in note for note in found.notes)
    assert near or all(np.isfinite(row.error) for row in rows)


def test_levels_between_which_a_gain_is_stated_are_those_of_the_note():
    assert middle(0.0031, 0.9987) == (0.25, 0.75)
    fit = optid.fit(record(0, f=np.sqrt), "hammerstein_arx.exact", na=1, nb=1, nk=2, basis="polynomial:4")
    assert any("Static gain between valve = 0.25 and 0.75" in note for note in fit.dynamics.notes)
    slope = 2 * (np.sqrt(0.75) - np.sqrt(0.25)) / 0.5
    row = fit.dynamics["static gain"]
    assert row.lower < slope < row.upper and row.unit == "m/%" and row.error < 0.2


def test_an_insignificant_first_coefficient_is_a_remark_on_the_dead_time():
    fit = optid.fit(record(1), "hammerstein_arx.exact", na=1, nb=3, nk=0, basis="polynomial:2")
    assert any("not significant (2): the dead time may be up to 1 s" in note for note in fit.dynamics.notes)
    assert fit.dynamics["dead time"].estimate == 0


def test_a_pole_that_the_record_does_not_tell_from_one_leaves_no_finite_interval():
    rng = np.random.default_rng(0)
    u, y = np.repeat(rng.uniform(-1, 1, 30), 10), np.zeros(300)
    for k in range(1, 300):
        y[k] = y[k - 1] + 0.1 * u[k - 1] + 0.02 * rng.normal()
    fit = optid.fit(optid.Data(u, y, 1.0), "arx", na=1, nb=1, nk=1)
    assert abs(fit.poles[0] - 1) < 0.05 and "does not tell the pole" in integration(fit.model, fit.uncertainty)
    assert fit.dynamics["slope"].lower < 0.1 < fit.dynamics["slope"].upper
    assert "No static characteristic" in str(fit) and "Response of y to a step" in str(fit)


# -- gauges ---------------------------------------------------------------------------------------------------------


def test_neither_dynamics_nor_curves_depend_on_the_gauge():
    data = record(0, f=lambda u: np.tanh(3 * u - 1))
    fits = [optid.fit(data, "hammerstein_arx.exact", na=1, nb=2, nk=2, basis="polynomial:3", gauge=gauge)
            for gauge in ("norm", "gain", "b0")]
    first, levels = fits[0], input_levels(fits[0].model, data)
    for other in fits[1:]:
        for row, same in zip(first.dynamics, other.dynamics):
            assert row[1:5] == pytest.approx(same[1:5], rel=1e-4, nan_ok=True)
        for one, two in zip(*(responses(fit.model, levels, fit.uncertainty)[0] for fit in (first, other))):
            assert one.value == pytest.approx(two.value, abs=1e-6)
            assert one.upper == pytest.approx(two.upper, abs=1e-4)


def test_a_step_response_ends_at_the_difference_of_the_static_characteristic():
    f = Nonlinearity(Polynomial(3).with_interval(-1, 2), [0.3, 1.0, 0.2])
    plant = HammersteinTF([-1.2, 0.5], [[0.3, 0.4]], (f,), (2,), 0.3)
    feedback = Nonlinearity(Polynomial(3).with_interval(-3, 3), [0.2, 0.0, -0.05])
    states = HammersteinSS([[0.5]], [[0.5]], [[1.0]], None, (f,), E=[[0.3]], feedback=(feedback,))
    for model in (plant, states):
        (rest, step), reasons = responses(model, [(-1.0, 2.0)])
        assert not reasons and (rest.kind, step.kind) == ("static", "step")
        assert step.value[-1] == pytest.approx(rest.value[-1] - rest.value[0], rel=0.03)
        gain = dynamics(model, [(-1.0, 2.0)])["static gain"].estimate
        assert gain == pytest.approx(np.diff(np.interp([-0.2, 1.2], rest.at, rest.value))[0] / 1.4, rel=0.02)


def test_every_summary_has_the_dynamics(tmp_path):
    fit = optid.fit(record(0, f=np.sqrt), "hammerstein_arx.exact", na=1, nb=1, nk=2, basis="triangular:5")
    text, page = str(fit), fit.report(tmp_path / "fit.html").read_text()
    for shown in (text, page, fit._repr_html_()):
        assert "time constant" in shown and "static gain" in shown and "dead time" in shown
    assert text.index("time constant") < text.index("Solution:")
    assert "Static characteristic: level at rest against valve" in text and "f in its gauge" in page
    assert "Nonlinearity f" not in text
    found = optid.compare_models({"one": fit.model, "two": fit.model.regauge("gain")}, record(1, f=np.sqrt))
    assert "one: time constant" in str(found) and "level at rest in m, against valve in %" in str(found)
    rows = [line.split()[1:] for line in str(found).splitlines() if line.startswith(("one  ", "two  "))]
    assert rows[2] == rows[3] and len(rows) == 6


# -- coverage -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "dt", "tau", "gain", "noise"), [
    ("arx", 1.0, 8.0, 2.0, 0.05), ("arx", 60.0, 600.0, -0.5, 0.02), ("arx", 0.01, 0.2, 30.0, 1.0),
    ("oe.exact", 1.0, 8.0, 2.0, 0.1)])
def test_intervals_of_time_constant_and_gain_contain_the_truth_as_often_as_they_say(name, dt, tau, gain, noise):
    inside = np.zeros(2)
    for seed in range(200):
        data = record(seed, dt, tau, gain, noise, white=name == "arx")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optid.errors.DataWarning)
            found = optid.fit(data, name, na=1, nb=1, nk=2, prove=False).dynamics
        rows = found["time constant"], found["static gain"]
        inside += [row.lower <= truth <= row.upper for row, truth in zip(rows, (tau, gain))]
    assert np.all((0.92 * 200 <= inside) & (inside <= 0.98 * 200)), inside / 200
