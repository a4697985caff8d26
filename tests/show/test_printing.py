import re
import warnings

import numpy as np
import pytest
from sample_fits import example_fit, feedback_fit, linear_fit, mimo_fit, output_error_fit, two_by_two

import optid
from optid.show.printing import describe


def rows(text: str, title: str) -> dict[str, list[str]]:
    """Cells of a printed table by the first cell of their row."""
    body = text[text.index(title) :].split("\n---")[0].splitlines()[2:]
    return {line.split()[0]: line.split()[1:] for line in body}


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "make",
    [
        lambda: example_fit("thruster"), lambda: example_fit("two_inputs"), mimo_fit, linear_fit, feedback_fit,
        output_error_fit, lambda: example_fit("dead_zone", "hammerstein_arx.nuclear", weight=0.5),
    ],
)
def test_no_line_is_wider_than_80_columns(make):
    text = describe(make())
    assert max(map(len, text.splitlines())) <= 80
    assert text == str(make())


def test_the_printed_equation_is_the_true_one():
    text = describe(linear_fit())
    equation = next(line for line in text.splitlines() if line.startswith("y(k) = "))
    assert equation == "y(k) = 0.5 y(k-1) - 0.2 y(k-2) + 2 u(k-1) - 3"
    assert "Linear ARX model of y from u" in text


def test_parameters_are_those_of_the_model_to_the_digits_of_their_errors():
    fit = example_fit("two_inputs")
    table = rows(describe(fit), "Parameters")
    a, b = fit.model.a, fit.model.b
    expected = {
        "a1": a[0], "a2": a[1], "b0[valve]": b[0][0], "b1[valve]": b[0][1], "b0[heater]": b[1][0],
        "b1[heater]": b[1][1], "offset": fit.model.offset[0]}
    assert list(table) == list(expected)
    for name, value in expected.items():
        estimate, error, low, high = map(float, table[name])
        assert abs(estimate - value) <= 0.051 * error  # two digits of the error are printed
        assert low < estimate < high
        assert 0.7 * error < (high - low) / 4 < 1.3 * error


def test_the_static_characteristic_is_listed_at_the_nodes_of_f():
    fit = example_fit("thruster")
    table = rows(describe(fit), "Static characteristic: thrust at rest")
    points = np.array([float(u) for u in table])
    assert np.allclose(points, np.linspace(*fit.model.f.basis.interval, 11), atol=1e-3)
    printed = np.array([float(cells[0]) for cells in table.values()])
    errors = np.array([float(cells[1]) for cells in table.values()])
    rest = fit.model.static_curve(0, points)[:, 0]
    assert np.all(np.abs(printed - rest) <= 0.06 * errors + 1e-3 * np.abs(printed))


def test_proved_is_printed_only_with_a_proof():
    proved, unproved = describe(example_fit("dead_zone")), describe(example_fit("dead_zone", prove=False))
    assert "optimal (proved)" in proved and "global optimality is proved" in " ".join(proved.split())
    assert "(proved)" not in unproved and "locally optimal (not proved)" in unproved
    assert "is not known" in " ".join(unproved.split())


def test_constraints_are_listed_with_state_and_price():
    text = describe(example_fit("thruster"))
    price = example_fit("thruster").prices[0]
    line = next(line for line in text.splitlines() if line.startswith(price.name))
    assert f"active ({price.active} of {price.rows})" in line
    assert float(line.split()[-1]) == pytest.approx(price.points_per_step, rel=5e-3)


def test_an_inactive_constraint_shows_its_slack_and_no_price():
    fit = example_fit("two_inputs")
    line = next(line for line in describe(fit).splitlines() if line.startswith(fit.prices[0].name))
    assert "not active" in line and line.split()[-2:] == ["-", "-"]
    assert float(line.split()[-3]) == pytest.approx(fit.prices[0].slack, rel=5e-3)


def test_missing_samples_and_rows_used_are_stated():
    text = describe(mimo_fit())
    assert re.search(r"Missing:? +level_a ", text)
    assert re.search(rf"Rows used +{mimo_fit().figures['rows']} of {mimo_fit().figures['candidates']}", text)


def test_why_there_are_no_standard_errors_is_said():
    text = " ".join(describe(example_fit("dead_zone", "hammerstein_arx.nuclear", weight=0.5)).split())
    assert "No standard errors: the nuclear norm shrinks Theta" in text


def test_findings_of_the_examination_are_printed():
    rng = np.random.default_rng(0)
    u = rng.choice(np.linspace(-1, 1, 7), 400)
    y = np.convolve(u**3, [1.0, 0.5])[:400] + 0.01 * rng.standard_normal(400)
    with pytest.warns(optid.errors.DataWarning, match="too few levels"):
        fit = optid.fit(optid.Data(u, y), na=1, nb=2, basis="polynomial:3")
    assert "Note: too few levels: input 'u' takes 7 distinct values" in describe(fit)


def test_a_fit_without_a_point_is_described():
    data = example_fit("dead_zone").data
    fit = optid.fit(
        data, na=2, nb=2, basis="triangular:8", raises=False,
        constraints=[lambda v: {"low": v["a"][0] <= -1}, lambda v: {"high": v["a"][0] >= 1}])
    text = describe(fit)
    assert fit.model is None and "No model: infeasible" in text and "Solution returned: no" in text
    assert max(map(len, text.splitlines())) <= 80


def test_validation_text_has_the_fit_that_the_formula_gives():
    fit = linear_fit()
    with warnings.catch_warnings(action="ignore", category=optid.errors.DataWarning):  # of its length
        text = str(optid.validate(fit.model, fit.data))
    assert re.search(r"y, one step +100\.00", text)


def test_no_line_of_a_validation_is_wider_than_80_columns():
    with warnings.catch_warnings(action="ignore", category=optid.errors.DataWarning):
        text = str(optid.validate(mimo_fit().model, two_by_two(seed=5), horizon=4))
    assert max(map(len, text.splitlines())) <= 80
    for words in ("level_a, 4 steps", "level_a, experiment 3", 'temp "b": independent of level_a', "white"):
        assert words in text


@pytest.mark.parametrize(
    "basis",
    ["triangular:25", "trigonometric:4", "polynomial:5", "bspline:6", "piecewiseconstant:8",
     optid.UserFunctions((np.sin, np.tanh), ("sine", "tanh"))],
)  # fmt: skip
def test_every_basis_is_listed_by_its_values(basis):
    data = example_fit("dead_zone").data
    fit = optid.fit(data, na=2, nb=2, basis=basis)
    text = describe(fit)
    table = rows(text, "Static characteristic: ")
    points = np.array([float(u) for u in table])
    assert len(points) == 11 and max(map(len, text.splitlines())) <= 80
    exact = np.linspace(*fit.model.f.basis.interval, 11)  # the table rounds the points to four digits
    assert np.allclose(points, exact, rtol=1e-3, atol=1e-3)
    for cells, value in zip(table.values(), fit.model.static_curve(0, exact)[:, 0]):
        assert abs(float(cells[0]) - value) <= 0.051 * float(cells[1])


@pytest.mark.parametrize("gauge", ["norm", "gain", "b0"])
def test_the_gauge_is_stated_and_true(gauge):
    fit = optid.fit(example_fit("dead_zone").data, na=2, nb=2, basis="triangular:4", gauge=gauge)
    text, b = " ".join(describe(fit).split()), fit.model.b[0]
    said = {
        "norm": ("norm of b is one; the output rises with f", np.linalg.norm(b)),
        "gain": ("static gain of the linear part is one", b.sum() / (1 + fit.model.a.sum())),
        "b0": ("first coefficient of b is one", b[0])}
    sentence, one = said[gauge]
    assert f"Gauge: {sentence}" in text and one == pytest.approx(1.0, abs=1e-9)


def test_a_channel_whose_sign_the_constraint_fixes_says_so():
    fit = optid.fit(example_fit("two_inputs").data, na=2, nb=2, basis="triangular:8", constraints=[
        lambda v: {"rising": v.bases["valve"].increments() @ v["mu[valve]"] >= 0}])
    assert fit.model.b[0].sum() < 0
    assert "norm of b is one; the output falls with f_valve" in describe(fit)


def test_a_state_space_model_with_feedback_shows_its_three_simulators_and_its_noise():
    fit = feedback_fit()
    text = describe(fit)
    assert "Hammerstein state-space model with nonlinear feedback of y from u" in text
    head = next(line for line in text.splitlines() if line.startswith("output ") and "measured feedback" in line)
    assert head.split() == ["output", "one", "step", "measured", "feedback", "simulation"]
    fits = (fit.one_step_fit[0], fit.measured_feedback_fit[0], fit.simulation_fit[0])
    assert all(f"{value:.2f} %" in text for value in fits)
    innovation = float(np.sqrt(fit.model.noise.innovation[0, 0]))
    noise = rows(text, "\nNoise\n"[1:])["y"]
    assert float(noise[0]) == pytest.approx(innovation, rel=1e-3) and noise[2] in ("white", "coloured")
    assert "Feedback nonlinearity g, basis polynomial" in text and "Singular values:" in text
    assert "No standard errors: they follow from compressed least squares" in " ".join(text.split())
    assert "no model of this structure can lower" not in " ".join(text.split())


def test_an_output_error_model_shows_the_errors_of_every_coefficient():
    fit = output_error_fit()
    text, table = describe(fit), rows(describe(fit), "Parameters")
    assert "Hammerstein output-error model of y from u" in text
    assert list(table) == [*(name for name, _ in fit.model.coefficients()), "The"]
    assert "The errors are coloured; the standard errors account for it." in text
    assert fit.one_step_fit == pytest.approx(fit.simulation_fit, abs=1e-6)
