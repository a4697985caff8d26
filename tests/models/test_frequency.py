"""Figures of the frequency domain against formulas, with regions against the covariance of least squares."""

from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from sample_fits import example_fit, linear_fit, mimo_fit, quiet
from scipy.stats import chi2
from systems import mimo, siso
from test_continuous import process

import optid
from optid import plots
from optid.show import panels
from optid.show.frequency import ellipses

FIGURES = ["bode", "nyquist", "poles_and_zeros"]
RESULTS = {"thruster": lambda: example_fit("thruster"), "mimo fit": mimo_fit, "linear": linear_fit, "siso": siso,
           "mimo": mimo, "late": lambda: process(delay=12.0, time_unit="s"), "static": lambda: siso(a=[], b=([2.0],)),
           "integrator": lambda: replace(process((0.0, -0.3)), B=[[1.0], [0.0]]),
           "sampled integrator": lambda: siso(a=np.poly([1.0, 0.5])[1:], nk=1),
           "silent": lambda: siso(b=([0.0, 0.0],), nk=1)}


@pytest.mark.sampled(6)
@pytest.mark.parametrize("result", RESULTS)
@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_is_drawn_without_a_warning_and_leaves_no_trace(result, name, tmp_path):
    before = dict(matplotlib.rcParams)
    getattr(plots, name)(RESULTS[result]()).savefig(tmp_path / "figure.png", dpi=40)
    assert (tmp_path / "figure.png").stat().st_size > 2000 and dict(matplotlib.rcParams) == before


def noisy(n=300):
    """Return y(k) = 1.5 y(k-1) - 0.7 y(k-2) + u(k-1) + 0.8 u(k-2) + e(k), and its covariance of least squares."""
    r = np.random.default_rng(1)
    u, e, y = r.normal(size=n), 0.3 * r.normal(size=n), np.zeros(n)
    for k in range(2, n):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + 0.8 * u[k - 2] + e[k]
    phi = np.column_stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(n - 2)])
    theta, rest = np.linalg.lstsq(phi, y[2:], rcond=None)[:2]
    fit = quiet(optid.Data(u, y, 0.1, ["valve"], ["flow"], ["%"], ["l/s"]), "arx", na=2, nb=2, nk=1)
    assert np.allclose([*fit.model.a, *fit.model.b[0] * fit.model.nonlinearities[0].mu], theta[:4], atol=1e-9)
    return fit, theta, rest[0] / (n - 2 - 5) * np.linalg.inv(phi.T @ phi)


def region(theta, covariance, quantity):
    """Mean and covariance (2, 2) of a complex function of theta, by differences."""
    value = quantity(theta)
    slopes = np.array([(quantity(theta + step) - quantity(theta - step)) / 2e-6 for step in 1e-6 * np.eye(theta.size)])
    rows = np.array([slopes.real, slopes.imag])
    return np.array([value.real, value.imag]), rows @ covariance @ rows.T


def distances(line, centre, covariance):
    away = np.column_stack(line) - centre
    return np.einsum("ki,ki->k", away, np.linalg.solve(covariance, away.T).T)


def closed(figure, marks=181):
    return [one.get_data() for one in figure.axes[0].get_lines() if len(one.get_xdata()) == marks
            and one.get_color() != panels.MUTED]


def test_the_ellipse_of_a_pole_is_that_of_its_covariance():
    fit, theta, covariance = noisy()
    above, below = closed(plots.poles_and_zeros(fit))
    centre, expected = region(theta, covariance, lambda t: np.roots([1, *t[:2]])[np.argmax(np.roots([1, *t[:2]]).imag)])
    assert distances(above, centre, expected) == pytest.approx(chi2.ppf(0.95, 2), rel=1e-3)
    assert np.allclose(below[0], above[0]) and np.allclose(below[1], -np.asarray(above[1]))


def test_the_bar_of_a_real_zero_is_its_interval():
    fit, theta, covariance = noisy()
    lines = plots.poles_and_zeros(fit).axes[0].get_lines()
    bar = next(one.get_xdata() for one in lines if len(one.get_xdata()) == 2 and one.get_linewidth() > 3)
    slope = np.array([0, 0, theta[3] / theta[2] ** 2, -1 / theta[2], 0])
    assert np.mean(bar) == pytest.approx(-theta[3] / theta[2], abs=1e-6)
    assert np.ptp(bar) == pytest.approx(2 * 1.96 * np.sqrt(slope @ covariance @ slope), rel=0.01)


def test_the_nyquist_curve_and_its_regions_are_those_of_the_formula():
    fit, theta, covariance = noisy()
    figure = plots.nyquist(fit)
    curve = next(one.get_data() for one in figure.axes[0].get_lines() if one.get_label() == "response")
    w = np.geomspace(np.pi / 0.1 * 1e-3, np.pi / 0.1, 400)
    response = lambda t, z: (t[2] / z + t[3] / z**2) / (1 + t[0] / z + t[1] / z**2)  # noqa: E731
    assert curve[0] + 1j * curve[1] == pytest.approx(response(theta, np.exp(0.1j * w)), abs=1e-8)
    dots = next(one.get_xydata() for one in figure.axes[0].get_lines() if one.get_marker() == "o")
    drawn = closed(figure)
    assert len(drawn) == len(dots) > 8
    for line, dot in list(zip(drawn, dots))[2:-1]:  # the ends are nearly real: their ellipses are lines
        k = np.argmin(np.abs(curve[0] + 1j * curve[1] - dot @ [1, 1j]))
        z = np.exp(0.1j * w[k])
        centre, expected = region(theta, covariance, lambda t, z=z: response(t, z))
        assert distances(line, centre, expected) == pytest.approx(chi2.ppf(0.95, 2), rel=0.02)


def test_an_ellipse_needs_errors_and_keeps_its_correlation():
    class Known:
        def of(self, quantity):
            value = quantity(None)
            spread = np.full(value.shape, 2.0) if value.ndim == 2 else np.full(value.shape, np.sqrt(2 + 2 * 0.6))
            return type("Found", (), {"value": value, "error": spread})

    ((x, y),) = ellipses(Known(), lambda _: np.array([[1.0, 3.0]]))
    assert np.corrcoef(x[:-1], y[:-1])[0, 1] == pytest.approx(0.6)
    assert np.max(x) - 1 == pytest.approx(2 * np.sqrt(chi2.ppf(0.95, 2)))


def test_frequencies_are_in_radians_or_in_hertz():
    fit = noisy()[0]
    radians, hertz = (plots.bode(fit, hertz=word) for word in (False, True))
    lines = [next(one for one in figure.axes[0].get_lines()).get_data() for figure in (radians, hertz)]
    assert lines[0][0] == pytest.approx(2 * np.pi * lines[1][0]) and np.array_equal(lines[0][1], lines[1][1])
    assert lines[1][0][-1] == pytest.approx(5.0)  # half the sampling rate
    assert radians.axes[1].get_xlabel() == "frequency (rad/s)" and hertz.axes[1].get_xlabel() == "frequency (Hz)"
    assert radians.axes[0].get_ylabel() == "magnitude (dB of l/s/%)"


@pytest.mark.parametrize("fields, titles", [
    ({"time_unit": "min", "dt": 2.0}, ("frequency (rad/min)", "frequency (cycles/min)")),
    ({"time_unit": "", "dt": 1.0}, ("frequency (rad/sample)", "frequency (cycles/sample)")),
    ({"time_unit": "", "dt": 0.1}, ("frequency (rad per unit of time)", "frequency (cycles per unit of time)"))])
def test_other_units_of_time_are_named(fields, titles):
    model = siso(**fields)
    assert tuple(plots.bode(model, hertz=word).axes[1].get_xlabel() for word in (False, True)) == titles


def test_a_continuous_model_is_drawn_with_its_dead_time():
    model = process(delay=12.0, time_unit="s")
    w, phase = plots.bode(model).axes[1].get_lines()[0].get_data()
    expected = -np.arctan(30 * w) - np.arctan(8 * w) - 12 * w
    assert phase == pytest.approx(np.degrees(expected), abs=1e-6)
    axes = plots.poles_and_zeros(model).axes[0]
    assert axes.get_xlabel() == "real part (1/s)"
    drawn = next(one.get_xdata() for one in axes.get_lines() if one.get_marker() == "x")
    assert np.sort(drawn) == pytest.approx([-1 / 8, -1 / 30])


def test_zeros_far_away_are_named_instead_of_drawn():
    axes = plots.poles_and_zeros(siso(nk=1, b=([1.0, 20.0],))).axes[0]
    assert any("zeros at -20" in one.get_label() for one in axes.get_lines()) and axes.get_xlim()[0] > -2
