"""Intervals of simulations and predictions: closed forms, refits, repeated records, laws, refusals."""

import warnings

import numpy as np
import pytest
from refusals import refuses
from sample_fits import example_fit, feedback_fit, mimo_fit, quiet
from scipy.signal import lfilter
from scipy.stats import t as student

import optid
from optid.errors import DataError, DataWarning, StructureError
from optid.identify.output_intervals import noise_filter, output_noise, prediction_intervals, simulation_intervals
from optid.models.process import process_model
from optid.show import charts, plots, report
from optid.show.printing import describe_interval

pytestmark = pytest.mark.numerical

FIR = np.array([0.0, 1.0, 0.5, -0.3])
A, B = [1.0, -1.2, 0.5], [0.0, 0.8, 0.6]
OE = {"na": 1, "nb": 1, "nk": 1}


def lags(u):
    return np.column_stack([np.r_[np.zeros(j), u[: len(u) - j]] for j in (1, 2, 3)] + [np.ones(len(u))])


def fir(n=80, seed=0, units=(1.0, 1.0), offset=2.0):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(n)
    return optid.Data(units[0] * u, units[1] * (lfilter(FIR, [1.0], u) + offset + 0.3 * rng.standard_normal(n)))


def equation_error(n, rng, sigma=0.2, b=tuple(B), a=tuple(A)):
    """A y = B u + e, in motion before the record."""
    u = rng.uniform(-1, 1, n + 200)
    u[:200] = 0
    y = lfilter(b, a, u) + lfilter([1.0], a, sigma * rng.standard_normal(n + 200))
    return u[200:], y[200:]


def output_error(n, rng, sigma=0.2):
    u = rng.uniform(-1, 1, n)
    return u, lfilter([0, 1.0], [1, -0.8], u) + sigma * rng.standard_normal(n)


@pytest.fixture(scope="module")
def arx():
    return optid.fit(optid.Data(*equation_error(300, np.random.default_rng(3))), "arx", na=2, nb=2, nk=1)


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_interval_of_a_finite_response_is_the_textbook_one(level):
    data = fir()
    fit = optid.fit(data, "arx", na=0, nb=3, nk=1)
    X, y = lags(data.u[:, 0])[3:], data.y[3:, 0]
    theta, dof = np.linalg.lstsq(X, y, rcond=None)[0], len(y) - 4
    variance = np.sum((y - X @ theta) ** 2) / dof
    v = np.random.default_rng(9).standard_normal(40)
    new = lags(v)
    scatter = np.sqrt(variance * np.einsum("ki,ij,kj->k", new, np.linalg.inv(X.T @ X), new))
    half = student.ppf(0.5 + level / 2, dof) * np.sqrt(scatter**2 + variance)
    found = fit.simulate(v, interval=level)
    assert found.value == pytest.approx(new @ theta, rel=1e-9) and found.level == level
    assert found.parameters == pytest.approx(scatter, rel=1e-7)
    assert found.noise == pytest.approx(np.full(40, np.sqrt(variance)), rel=1e-9)
    assert found.error == pytest.approx(np.hypot(scatter, np.sqrt(variance)), rel=1e-7)
    assert found.upper - found.value == pytest.approx(half, rel=1e-7)
    assert found.value - found.lower == pytest.approx(half, rel=1e-7)
    ahead = fit.predict(optid.Data(v, np.zeros(40)), interval=level)  # without past outputs the prediction is the same
    assert np.isnan(ahead.lower[:3]).all() and np.isnan(ahead.noise[:3]).all()
    assert ahead.upper[3:, 0] == pytest.approx(found.upper[3:], rel=1e-9)


def test_noise_of_every_class_by_its_response(arx):
    impulse = np.eye(1, 4000)[0]
    innovation = arx.uncertainty.source.noise[0, 0]
    response = lfilter([1.0], np.r_[1.0, arx.model.a], impulse)
    own = noise_filter(arx.model, arx.uncertainty.source)
    assert own.stationary() == pytest.approx([innovation * np.sum(response**2)], rel=1e-9)
    assert own.variances(7)[:, 0] == pytest.approx(innovation * np.cumsum(response[:7] ** 2), rel=1e-9)
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 400)
    y = lfilter([0, 1.0], [1, -0.7], u) + lfilter([1, 0.4], [1, -0.8], 0.1 * rng.standard_normal(400))
    for name, more in (("armax.exact", {"nc": 1}), ("bj.exact", {"nc": 1, "nd": 1})):
        fit = quiet(optid.Data(u, y), name, na=1, nb=1, nk=1, **more)
        model = fit.model
        response = lfilter(np.r_[1.0, model.c], np.r_[1.0, model.noise_denominator], impulse)
        assert noise_filter(model, fit.uncertainty.source).stationary() == pytest.approx(
            fit.uncertainty.source.noise[0] * np.sum(response**2), rel=1e-9)


def test_noise_of_a_state_space_model_is_that_of_its_spectrum():
    rng = np.random.default_rng(1)
    u, y = equation_error(400, rng)
    fit = quiet(optid.Data(u, y), "hammerstein_ss.exact", nx=2, basis="linear", criterion="prediction")
    own = noise_filter(fit.model, fit.uncertainty.source)
    w = np.linspace(-np.pi, np.pi, 20001)[:-1]
    scale = own.covariance / fit.model.noise.innovation
    spectrum = optid.noise.noise_spectrum(fit.model, w).real
    assert own.stationary() == pytest.approx(scale[0] * np.mean(spectrum), rel=1e-6)
    assert 1 < scale[0, 0] < 1.05  # what the parameters have taken from the residuals


def test_noise_that_an_integrator_adds_up_grows_from_the_start_of_a_simulation():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 20), 20)
    a = [1.0, -1.4, 0.4]
    data = optid.Data(u, lfilter([0, 0.5], a, u) + lfilter([1.0], a, 0.05 * rng.standard_normal(400)))
    fit = quiet(data, "arx", na=2, nb=1, nk=1, constraints=[lambda v: v["a"][0] + v["a"][1] == -1])
    found = fit.simulate(np.ones(30), interval=0.9)
    response = lfilter([1.0], np.r_[1.0, fit.model.a], np.eye(1, 30)[0])
    size = np.sqrt(fit.uncertainty.source.noise[0, 0])
    assert fit.model.integrates and found.noise == pytest.approx(size * np.sqrt(np.cumsum(response**2)), rel=1e-9)


# -- independent routes ------------------------------------------------------------------------------------------------


def test_error_by_the_parameters_is_the_scatter_of_refits(arx):
    v = np.random.default_rng(5).uniform(-1, 1, 40)
    refits = optid.bootstrap(arx, runs=300, seed=1).percentile.source.models
    scatter = np.std([one.simulate(v) for one in refits], axis=0)
    found = arx.simulate(v, interval=0.95)
    assert np.median(found.parameters[2:] / scatter[2:]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("plant, name, arguments", [
    (equation_error, "arx", {"na": 2, "nb": 2, "nk": 1}), (output_error, "oe.exact", OE)])
def test_intervals_contain_their_share_of_new_records(plant, name, arguments):
    inside, total = np.zeros(3), 0
    for seed in range(30):
        rng = np.random.default_rng([seed, 1])
        fit = quiet(optid.Data(*plant(60, rng)), name, prove=False, **arguments)
        other = optid.Data(*plant(100, rng))
        found = [simulation_intervals(fit, other, "fit", 0.9), prediction_intervals(fit, other, 1, 0.9),
                 prediction_intervals(fit, other, 3, 0.9)]
        counts = np.array([one.counts_inside(other.y) for one in found])[..., 0]
        inside, total = inside + counts[:, 0], total + counts[:, 1]
    assert np.all(np.abs(inside / total - 0.9) < 0.03)


def test_noise_of_coloured_output_errors_is_that_of_the_whole_error():
    rng = np.random.default_rng(2)
    u, _ = output_error(600, rng)
    y = lfilter([0, 1.0], [1, -0.8], u) + lfilter([1.0], [1, -0.9], 0.1 * rng.standard_normal(600))
    fit = quiet(optid.Data(u, y), "oe.exact", **OE)
    errors = y - fit.simulate()[:, 0]
    assert output_noise(fit, fit.uncertainty.source, None, 5).deviations == pytest.approx([np.std(errors)], rel=0.05)


def test_wrong_noise_model_does_not_hide_the_errors_of_its_simulation():
    """White noise at the output of a slow plant makes equation errors whose model explains too little."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 40), 25)
    data = optid.Data(u, lfilter([0, 0.05], [1, -0.95], u) + 0.3 * rng.standard_normal(1000))
    fit = quiet(data, "arx", na=1, nb=1, nk=1)
    found = quietly(lambda: fit.simulate(data, interval=0.95))
    inside, total = found.counts_inside(data.y)
    assert inside / total > 0.93


# -- laws --------------------------------------------------------------------------------------------------------------


def quietly(build):
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        return build()


@pytest.mark.parametrize("units", [(1e-6, 1e5), (1e4, 1e-7)])
def test_intervals_follow_the_units(units):
    plain, other = (optid.fit(fir(units=one), "arx", na=0, nb=3, nk=1) for one in ((1.0, 1.0), units))
    v = np.random.default_rng(3).standard_normal(20)
    one, two = plain.simulate(v, interval=0.95), other.simulate(units[0] * v, interval=0.95)
    for part in ("value", "lower", "upper", "error", "parameters", "noise"):
        assert getattr(two, part) == pytest.approx(units[1] * getattr(one, part), rel=1e-6)


def test_intervals_of_a_detrended_record_are_in_raw_units():
    raw = fir(offset=50.0)
    given, detrended = (optid.fit(one, "arx", na=0, nb=3, nk=1) for one in (raw, raw.detrend().scale()))
    for fit in (given, detrended):
        assert fit.simulate(interval=0.9).upper == pytest.approx(given.simulate(interval=0.9).upper, rel=1e-6)


def test_several_outputs_and_experiments_and_gaps():
    fit = mimo_fit()
    record = fit.data.raw()
    turned = record.select(outputs=record.outputs[::-1], inputs=record.inputs[::-1])
    again = quiet(turned, na=1, nb=1, basis="polynomial:3")
    for horizon in (None, 1, 3):
        found, other = (simulation_intervals(one, one.data, "fit", 0.95) if horizon is None else
                        prediction_intervals(one, one.data, horizon, 0.95) for one in (fit, again))
        plain = fit.simulate() if horizon is None else fit.predict(horizon=horizon)
        assert len(found) == 3
        for one, two, value, e in zip(found, other, plain, record.experiments):
            assert one.value.shape == e.y.shape
            np.testing.assert_array_equal(one.value, value)
            for part in ("lower", "upper", "parameters", "noise", "error"):
                own = getattr(one, part)
                np.testing.assert_array_equal(np.isnan(own), np.isnan(value))
                np.testing.assert_allclose(getattr(two, part)[:, ::-1], own, rtol=2e-4, equal_nan=True)
            here = np.isfinite(value)
            assert np.all(one.lower[here] < value[here]) and np.all(value[here] < one.upper[here])


def test_prediction_tends_to_the_simulation(arx):
    far, near = (arx.predict(interval=0.95, horizon=h).noise for h in (60, 1))
    free = arx.simulate(interval=0.95).noise
    assert far[-1] == pytest.approx(free[-1], rel=0.1) and np.nanmax(near) < 0.8 * free[-1]


def test_process_and_feedback_models_have_intervals():
    rng = np.random.default_rng(0)
    plant = process_model("P1D", K=0.8, tau=9.3, dead_time=3.4, level=20.0)
    u = np.repeat(rng.uniform(30, 70, 15), 20)
    fit = quiet(optid.Data(u, plant.simulate(u) + 0.5 * rng.standard_normal(300)), "process.exact",
                process="P1D", prove=False)
    found = quietly(lambda: fit.simulate(u, interval=0.95))
    assert found.noise == pytest.approx(np.full(300, 0.5), rel=0.15)
    fed = feedback_fit()
    refuses(StructureError, "no standard errors of the parameters", lambda: fed.simulate(interval=0.95))


def test_active_inequalities_widen_one_side_only():
    rng = np.random.default_rng(4)
    u = rng.uniform(-1, 1, 200)
    f = np.maximum(u, 0.0)
    y = lfilter([1.0], [1, -0.5], f + 0.1 * rng.standard_normal(200))
    fit = quiet(optid.Data(u, y), na=1, nb=1, nk=0, basis=optid.Triangular(4, interval=(-1.0, 1.0)),
                constraints=["monotone:increasing"])
    v = rng.uniform(-1, 1, 900)
    found = quietly(lambda: fit.simulate(v, interval=0.95))
    below, above = found.value - found.lower, found.upper - found.value
    assert fit.uncertainty.source.kind == "projected" and np.max(np.abs(below / above - 1)) > 1e-3
    part = quietly(lambda: fit.simulate(v[:50], interval=0.95))  # in one block, the other in two
    assert part.upper == pytest.approx(found.upper[:50], rel=1e-9)
    long = quietly(lambda: fit.simulate(np.r_[v, np.zeros(1200)], interval=0.95))  # by fewer draws
    assert np.max(np.abs(long.upper[:900] - found.upper) / above) < 0.01


# -- what is said, and what is refused ---------------------------------------------------------------------------------


def test_misfit_and_extrapolation_are_said():
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 600)
    data = optid.Data(u, lfilter([0, 1.0, 0.6, 0.4, 0.3], [1, -0.5], u + 0.8 * u**2) + 0.02 * rng.standard_normal(600))
    fit = quiet(data, na=1, nb=1, nk=1, basis=optid.Polynomial(2, interval=(-1.0, 1.0)), prove=False)
    assert fit.verdict.misfits
    with warnings.catch_warnings(record=True, action="always") as caught:
        found = fit.simulate(2 * u, interval=0.95)
    assert [str(one.message) for one in caught] == list(found.notes)
    assert "misfit" in found.notes[0] and "extrapolation" in found.notes[1]
    fine = example_fit("dead_zone")
    assert not fine.verdict.misfits and fine.predict(interval=0.95).notes == ()


def test_the_interval_is_drawn_and_counted_on_a_record_that_the_fit_has_not_seen(arx):
    other = optid.Data(*equation_error(200, np.random.default_rng(8)), name="other")
    found = quietly(lambda: arx.simulate(other, interval=0.95))
    share = f"contains {100 * found.counts_inside(other.y)[0][0] / 200:.1f} % of the samples of y."
    (label, (band,), _), = charts.interval_band(arx, other)[0]
    np.testing.assert_array_equal(band.upper, found.upper)
    assert label in report.render(arx, other) and share in report.render(arx, other)
    assert label not in report.render(arx)
    assert share in " ".join(describe_interval(arx, other).split())
    drawn = [name for ax in plots.fit_over_time(arx, other).axes for name in ax.get_legend_handles_labels()[1]]
    assert label in drawn
    robust = quiet(fir(200), na=1, nb=2, nk=1, basis="linear", loss="huber", prove=False)
    bands, contains, notes = charts.interval_band(robust, fir(100))
    assert not bands and not contains and notes[0].startswith("No interval of the simulation: no standard errors")


@pytest.mark.parametrize("level", [0.0, 1.0, 95, -0.1, "wide", True, np.nan])
def test_impossible_levels_are_refused(arx, level):
    refuses(StructureError, "interval=", lambda: arx.simulate(interval=level))
    refuses(StructureError, "interval=", lambda: arx.predict(interval=level))


def test_what_has_no_interval_is_refused_with_the_reason(arx):
    data = fir(200)
    robust = quiet(data, na=1, nb=2, nk=1, basis="linear", loss="huber", prove=False)
    refuses(StructureError, "'huber' is not least squares", lambda: robust.simulate(interval=0.95))
    refuses(DataError, "fit.predict takes optid.Data", lambda: arx.predict(np.ones(30), interval=0.95))
    refuses(StructureError, "horizon", lambda: arx.predict(interval=0.95, horizon=0))
    refuses(DataError, "missing at sample 4", lambda: arx.simulate([1, 1, 1, 1, np.nan, 1], interval=0.95))
    states = quiet(data, "hammerstein_ss.exact", nx=2, basis="linear", criterion="prediction")
    refuses(StructureError, "state coordinates", lambda: states.simulate(np.ones(9), x0=np.ones(2), interval=0.95))
    rest = quietly(lambda: states.simulate(np.ones(9), x0=np.zeros(2), interval=0.95))
    assert rest.upper == pytest.approx(quietly(lambda: states.simulate(np.ones(9), interval=0.95)).upper)
