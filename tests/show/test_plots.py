import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_fits import example_fit, linear_fit, mimo_fit, two_by_two

import optid
from optid import plots
from optid.errors import DataError, DataWarning
from optid.show import panels
from optid.show.summary import theta_singular_values

FIGURES = ["overview", "fit_over_time", "nonlinearity", "residual_tests", "poles_and_response", "certificate"]


def line(ax, label):
    return next(one for one in ax.get_lines() if one.get_label() == label)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("make", [lambda: example_fit("thruster"), mimo_fit, linear_fit])
@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_is_drawn_without_a_warning_and_leaves_no_trace(make, name, tmp_path):
    before = dict(matplotlib.rcParams)
    figure = getattr(plots, name)(make())
    figure.savefig(tmp_path / "figure.png", dpi=40)
    assert (tmp_path / "figure.png").stat().st_size > 2000
    assert dict(matplotlib.rcParams) == before


@pytest.mark.slow
def test_pyplot_is_never_imported():
    code = (
        "import sys, optid; from sample_fits import linear_fit; optid.plots.overview(linear_fit());"
        "print('matplotlib.pyplot' in sys.modules)")
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                           cwd="tests/helpers")
    assert found.stdout.strip() == "False"


def test_the_measured_line_is_the_record_and_the_one_step_line_obeys_the_difference_equation():
    fit = linear_fit()
    ax = plots.fit_over_time(fit).axes[0]
    y, u = fit.data.y[:, 0], fit.data.u[:, 0]
    assert np.array_equal(line(ax, "measured").get_ydata(), y)
    assert np.allclose(line(ax, "measured").get_xdata(), 0.1 * np.arange(300))
    drawn = line(ax, "one step ahead").get_ydata()
    assert np.allclose(drawn[2:], 0.5 * y[1:-1] - 0.2 * y[:-2] + 2 * u[1:-1] - 3, atol=1e-6)


def test_a_close_up_and_the_record_above_it_have_their_own_times():
    u, e = np.random.default_rng(0).standard_normal((2, 3000))
    y = np.convolve(u, 0.8 ** np.arange(40))[:3000] + 0.1 * e
    whole, part = plots.fit_over_time(optid.fit(optid.Data(u, y), "arx", na=1, nb=1)).axes[:2]
    assert np.ptp(part.get_xlim()) < np.ptp(whole.get_xlim()) / 2
    assert all(any(tick.label1.get_visible() for tick in ax.xaxis.get_major_ticks()) for ax in (whole, part))


def test_a_test_record_is_drawn_instead_of_the_estimation_record():
    first, second = linear_fit().data.split(0.5)
    figure = plots.fit_over_time(linear_fit(), second)
    ax = figure.axes[0]
    figure.draw_without_rendering()
    assert ax.get_legend().get_window_extent().y1 <= figure.bbox.y1  # four names, not cut
    assert np.array_equal(line(ax, "measured").get_ydata(), second.y[:, 0])
    assert "test record" in ax.get_title(loc="left")
    assert first.n_samples == 150


@given(arrays(float, st.integers(1, 6000), elements=st.floats(-1e6, 1e6) | st.just(np.nan)))
def test_thinning_keeps_the_extremes_and_the_order(y):
    t = np.arange(y.size, dtype=float)
    thin_t, thin_y = panels.thin_line(t, y)
    assert thin_t.size <= max(panels.POINTS, 1) and np.all(np.diff(thin_t) > 0)
    assert np.array_equal(thin_y, y[thin_t.astype(int)], equal_nan=True)
    if not np.isnan(y).all():
        assert np.nanmax(thin_y) == np.nanmax(y) and np.nanmin(thin_y) == np.nanmin(y)


def test_the_curve_is_f_and_lies_inside_its_band():
    fit = example_fit("dead_zone")
    ax = plots.nonlinearity(fit).axes[0]
    x, drawn = line(ax, "f").get_data()
    nodes = np.linspace(*fit.model.f.basis.interval, 9)  # f is linear between the nodes of Triangular(8)
    assert np.allclose(drawn, np.interp(x, nodes, fit.model.f(nodes)))
    band = next(c for c in ax.collections if c.get_label() == "95 % band").get_paths()[0].vertices
    low, high = band[:, 1].min(), band[:, 1].max()
    assert low <= drawn.min() and drawn.max() <= high
    truth = np.sign(x) * np.maximum(np.abs(x) - 0.25, 0)
    scale = float(drawn @ truth / (truth @ truth))
    assert np.max(np.abs(drawn - scale * truth)) < 0.1 * scale


def test_bars_count_the_samples():
    fit = example_fit("dead_zone")
    bars = plots.nonlinearity(fit).axes[0].patches
    u = fit.data.u[:, 0]
    counts = [np.sum((u >= bar.get_x()) & (u < bar.get_x() + bar.get_width())) for bar in bars]
    heights = np.array([bar.get_height() for bar in bars])
    assert len(bars) == 40
    assert np.allclose(heights / heights.max(), np.array(counts) / max(counts), atol=1.5 / max(counts))


def test_stems_are_the_autocorrelation_of_the_residuals():
    fit = example_fit("dead_zone")
    ax = plots.residual_tests(fit).axes[0]
    e = (fit.data.y - fit.model.predict(fit.data))[2:, 0]
    e = e - e.mean()
    expected = [np.mean(e[k:] * e[:-k]) / np.mean(e**2) for k in range(1, 26)]
    drawn = np.concatenate([one.get_xydata() for one in ax.get_lines() if one.get_linestyle() == "None"])
    drawn = drawn[np.argsort(drawn[:, 0])]
    assert np.array_equal(drawn[:, 0], np.arange(1, 26))
    assert np.allclose(drawn[:, 1], expected, atol=1e-9)


def test_correlations_outside_the_band_are_marked_by_colour_and_shape():
    fit = mimo_fit()  # measurement noise in an equation-error fit: its residuals are not white
    ax = plots.residual_tests(fit).axes[0]
    outside = [one for one in ax.get_lines() if one.get_marker() == "D" and len(one.get_xdata())]
    assert outside and outside[0].get_color() == panels.RED and 1 in outside[0].get_xdata()


def test_poles_are_the_roots_of_the_denominator():
    fit = linear_fit()
    ax = plots.poles_and_response(fit).axes[0]
    drawn = np.concatenate([one.get_xydata() for one in ax.get_lines() if one.get_marker() == "x"]) @ [1, 1j]
    assert np.allclose(np.sort_complex(drawn), np.sort_complex(np.roots([1, -0.5, 0.2])), atol=1e-6)


def test_the_step_response_is_that_of_the_difference_equation():
    fit = linear_fit()
    ax = plots.poles_and_response(fit).axes[2]
    t, drawn = ax.get_lines()[0].get_data()
    drawn = drawn / np.ptp(fit.data.u)  # the step goes over the range of the input
    y = np.zeros(len(t) + 2)
    for k in range(1, len(t)):
        y[k] = 0.5 * y[k - 1] - 0.2 * y[k - 2] + 2
    assert np.allclose(drawn, y[: len(t)], atol=1e-9) and np.allclose(np.diff(t), 0.1)
    assert drawn[-1] == pytest.approx(2 / 0.7, rel=0.03)


def test_the_magnitude_is_that_of_the_transfer_function():
    from scipy.signal import freqz

    ax = plots.poles_and_response(linear_fit()).axes[1]
    w, drawn = ax.get_lines()[0].get_data()
    _, response = freqz([0, 2], [1, -0.5, 0.2], worN=w * 0.1)
    assert w[-1] == pytest.approx(np.pi / 0.1)
    assert np.allclose(drawn, 20 * np.log10(np.abs(response)), atol=1e-4)


def test_the_certificate_marks_the_step_that_closed_the_proof():
    fit = example_fit("dead_zone")
    figure = plots.certificate(fit)
    words = {text.get_text(): text for text in figure.axes[0].texts}
    assert words["instant proof"].get_fontweight() == "bold" and words["SDP"].get_fontweight() == "normal"
    diamond = next(one for one in figure.axes[-1].get_lines() if one.get_marker() == "D")
    assert diamond.get_color() == panels.GREEN and diamond.get_xdata()[0] <= 1e-8


def test_without_a_bound_no_gap_is_drawn():
    figure = plots.certificate(example_fit("dead_zone", prove=False))
    assert not any(one.get_marker() == "D" for one in figure.axes[-1].get_lines())
    assert figure.axes[0].get_title(loc="left") == "No bound"


def test_singular_values_are_those_of_unrestricted_least_squares():
    fit = example_fit("dead_zone")
    u, y, basis = fit.data.u[:, 0], fit.data.y[:, 0], fit.model.f.basis
    eta = basis.values(u)
    phi = np.hstack([-y[1:-1, None], -y[:-2, None], eta[2:], eta[1:-1], np.ones((y.size - 2, 1))])
    theta = np.linalg.lstsq(phi, y[2:])[0][2:-1].reshape(2, -1).T
    expected = np.linalg.svd(theta, compute_uv=False)
    assert np.allclose(theta_singular_values(fit)["u"], expected, rtol=1e-6)
    heights = np.sort(np.concatenate([one.get_ydata() for one in plots.singular_values(fit).axes[0].get_lines()]))[::-1]
    assert np.allclose(heights, expected / expected[0], rtol=1e-6)


def test_a_vector_has_no_singular_values_to_show():
    with pytest.raises(DataError, match="no matrix Theta"):
        plots.singular_values(example_fit("thruster"))


def test_names_of_channels_are_text_not_mathematics():
    texts = [t.get_text() for ax in plots.nonlinearity(mimo_fit()).axes for t in (ax.title, ax.xaxis.label)]
    texts += [ax.get_title(loc="left") for ax in plots.nonlinearity(mimo_fit()).axes]
    assert r"heat & \$x_1\$ (kW)" in texts and r"Nonlinearity f_heat & \$x_1\$ of heat & \$x_1\$" in texts


def test_many_experiments_are_cut_to_the_first_three_and_the_title_says_so():
    data = two_by_two(300)
    five = optid.Data.join(data, data.select(experiments=[0, 1]))
    figure = plots.fit_over_time(mimo_fit(), five)
    assert len(figure.axes) == 2 * 3
    assert figure.axes[0].get_title(loc="left").endswith("experiments 1-3 of 5")


def test_an_unstable_model_is_drawn_without_its_simulation():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(60), np.zeros(60)
    for k in range(1, 60):
        y[k] = 1.05 * y[k - 1] + u[k]
    fit = optid.fit(optid.Data(u, y), "arx", na=1, nb=1)
    labels = [one.get_label() for one in plots.fit_over_time(fit).axes[0].get_lines()]
    assert "simulated" not in labels and {"measured", "one step ahead"} <= set(labels)


def test_a_stream_needs_a_record_to_draw(tmp_path):
    data = linear_fit().data
    np.save(tmp_path / "record.npy", np.hstack([data.u, data.y]))
    stream = optid.open_stream(tmp_path / "record.npy", columns=["u", "y"], dt=0.1)
    fit = optid.fit(stream, "arx", na=2, nb=1, nk=1)
    with pytest.raises(DataError, match="stream"):
        plots.overview(fit)
    assert len(plots.fit_over_time(fit, data).axes) == 1
    assert plots.nonlinearity(fit).axes


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_colours_are_told_apart_by_every_kind_of_colour_vision(scheme):
    sheet = (Path(plots.__file__).parent / "templates" / "page.html.j2").read_text(encoding="utf-8")
    both = [re.search(rf"--{name}: light-dark\((#[0-9a-f]{{6}}), (#[0-9a-f]{{6}})\)", sheet)
            for name in ("blue", "orange", "green", "ink")]
    colours = [pair[1 + scheme] for pair in both]
    if scheme == 0:  # the figures and the page share their light colours
        assert colours == [panels.BLUE, panels.ORANGE, panels.GREEN, panels.INK]

    def linear(colour):
        rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)

    kinds = [
        np.eye(3),  # Machado, Oliveira and Fernandes 2009, severity 1: protan, deutan, tritan
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    ]
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    for kind in kinds:
        seen = []
        for colour in colours:
            x, y, z = to_xyz @ np.clip(np.asarray(kind) @ linear(colour), 0, 1) / [0.9505, 1.0, 1.089]
            fx, fy, fz = (np.cbrt(v) if v > 0.008856 else 7.787 * v + 16 / 116 for v in (x, y, z))
            seen.append(np.array([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)]))
        assert min(np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i]) > 15


@pytest.mark.slow
def test_figures_of_warned_validations_do_not_warn_again():
    with pytest.warns(DataWarning):
        optid.validate(mimo_fit().model, two_by_two(seed=5))
    plots.residual_tests(mimo_fit(), two_by_two(seed=5))  # warnings are errors here
