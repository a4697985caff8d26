"""No result that exists fails to print, report, draw, save, load, pickle or export."""

import pickle

import cvxpy as cp
import numpy as np
import pytest
from commands import run
from random_results import TANK, record, troubles
from refusals import refuses
from sample_fits import example_fit, quiet
from test_cli import csv  # noqa: F401 - a fixture

import optid
from optid.backends import BackEnd
from optid.bases import Polynomial
from optid.errors import DataError, SolverFailed, StructureError
from optid.examples import example
from optid.identify.intervals import LocalEstimate
from optid.identify.tangent import Tangent
from optid.identify.validation.predictions import prediction_fit
from optid.models import HammersteinSS, Nonlinearity
from optid.program.expressions import solve_quietly
from optid.show import estimates, plots, sections, summary
from optid.show.notebook import fit_html
from optid.show.printing import describe
from optid.show.report import render


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", [1, 20, 21, 77, 5431])
def test_a_random_fit_can_be_used_in_every_way(seed, tmp_path):
    assert troubles(seed, tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("half", [0, 1])
def test_many_random_fits_can_be_used_in_every_way(half, tmp_path):
    found = [troubles(seed, tmp_path) for seed in range(150 * half, 150 * half + 8)]
    assert sum(one is not None for one in found) >= 5  # the others are refused with a reason
    assert [sentence for one in found for sentence in one or ()] == []


# -- fits at the edge of what can be computed --------------------------------------------------------------------------


def delayed(seed):
    """A slow record with white noise at the output, whose ARMAX model has a zero of C on the unit circle."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat([0.0, 1, 0, 1, 1, 0], 20), np.zeros(120)
    noise = 0.15 * rng.standard_normal(120)
    for k in range(4, 120):
        y[k] = 0.93 * y[k - 1] - 0.175 * u[k - 4]
    return optid.Data(u, y + noise, 2.0)


@pytest.mark.parametrize("name, orders", [("armax.exact", {"nc": 1}), ("bj.exact", {"nc": 1, "nd": 1})])
def test_a_fit_with_a_zero_of_c_on_the_unit_circle_is_its_model_and_has_no_standard_errors(name, orders):
    ended = [fit for fit in (quiet(delayed(seed), name, na=1, nb=1, nk=4, **orders) for seed in (1, 2, 3, 4, 18))
             if str(fit.solution.status) == "limit"]
    assert len(ended) >= 2
    for fit in ended:
        assert "No standard errors: they hold at an optimum" in " ".join(str(fit).split())
        assert fit.solution.values["c"] == pytest.approx(fit.model.c)
        # the innovations of a slowly forgotten start are those of the criterion, hence no equality
        assert fit.one_step_fit == pytest.approx(prediction_fit(fit.model, fit.data), abs=5.0)


def test_an_estimate_beside_the_edge_of_the_models_is_differentiated_to_its_inner_side():
    def rebuild(values):
        if values["c"][0] > 1:
            raise StructureError("beyond the edge")
        return values["c"][0]

    local = LocalEstimate(np.zeros(1), np.eye(1), 10.0, np.zeros((0, 1)), np.zeros(0), 100, 0)
    shapes = {"c": (1,)}
    inside, edge = (Tangent(rebuild, shapes, np.array([x]), np.eye(1), local, np.eye(1), "") for x in (0.5, 1.0))
    assert inside.slopes(lambda c: c**2) == pytest.approx(1.0, rel=1e-9)
    assert edge.slopes(lambda c: c**2) == pytest.approx(2.0, rel=1e-4)
    refuses(StructureError, "edge of the possible models",
            lambda: Tangent(rebuild, shapes, np.array([1.1]), np.eye(1), local, np.eye(1), "").neighbours)


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")  # of unstable models
@pytest.mark.parametrize("system", ["white", "slow"])
def test_records_too_short_for_every_part_of_the_structure_test_are_judged(system):
    for n in range(20, 44, 2):
        fit = quiet(record(system, n, 1, 1, np.random.default_rng(n)), "arx", na=1, nb=1)
        assert fit.verdict.word in str(fit)


@pytest.mark.slow
@pytest.mark.parametrize("power", [-300, 300])
@pytest.mark.parametrize("name, orders", [("arx", {"na": 1, "nb": 1}), ("oe.exact", {"na": 1, "nb": 1}),
                                          ("ss.exact", {"nx": 1}), ("hammerstein_ss.asivid", {"nx": 1})])
def test_the_verdict_and_the_noise_do_not_depend_on_the_unit_of_the_output(name, orders, power):
    data = record("plain", 60, 1, 1, np.random.default_rng(3))
    fit, other = (quiet(optid.Data(data.u, data.y * unit, data.dt), name, **orders) for unit in (1.0, 2.0**power))
    assert str(other.verdict) == str(fit.verdict)
    assert other.simulation_fit == pytest.approx(fit.simulation_fit)
    if hasattr(fit.model.noise, "innovation"):
        assert other.model.noise.innovation == pytest.approx(fit.model.noise.innovation * 4.0**power)
    assert other.plot() and render(other)


@pytest.mark.parametrize("power", [-300, 300])
@pytest.mark.parametrize("name", ["arx", "oe.exact"])
def test_prices_do_not_depend_on_the_unit_of_the_output(name, power):
    data = record("slow", 100, 1, 1, np.random.default_rng(3))
    fit, other = (quiet(optid.Data(data.u, data.y * unit, data.dt), name, na=1, nb=1, constraints=["stable:0.9"])
                  for unit in (1.0, 2.0**power))
    assert fit.prices[0].binding and fit.prices[0].points_per_step > 0
    assert other.prices[0].points_per_step == pytest.approx(fit.prices[0].points_per_step, rel=1e-4)


def test_a_transfer_function_in_small_units_keeps_its_numerator():
    fit = quiet(record("tiny", 100, 1, 1, np.random.default_rng(0)), "arx", na=1, nb=2)
    system = fit.model.to_dlti()
    assert system.impulse(n=10)[1][0][:, 0] == pytest.approx(fit.model.impulse_response(10)[:, 0, 0])
    with np.errstate(all="ignore"):
        assert np.max(np.abs(system.impulse(n=10)[1][0])) > 1e-102


def test_a_quantity_that_a_move_takes_far_has_a_finite_error():
    local = LocalEstimate(np.zeros(1), np.eye(1), 10.0, np.zeros((0, 1)), np.zeros(0), 100, 0)
    tangent = Tangent(lambda values: values["c"][0], {"c": (1,)}, np.zeros(1), np.eye(1), local, np.eye(1), "",
                      objective=lambda _: 0.0)
    assert tangent.error_within_reach(lambda c: 1e200 * c) == pytest.approx(1e200)  # whose square is infinite


def resting():
    """A state x + 0.1 (2 x - 2 - x^3): from zero, Newton steps go in a circle for ever."""
    basis, points = Polynomial(3, interval=(-3.0, 3.0)), np.linspace(-3, 3, 50)
    target = 0.1 * (2 * points - 2 - points**3)
    columns = np.column_stack([Nonlinearity(basis, one)(points) for one in np.eye(basis.size)] + [np.ones(50)])
    *mu, constant = np.linalg.lstsq(columns, target)[0]
    return HammersteinSS([[1.0]], [[0.0]], [[1.0]], E=[[1.0]], feedback=(Nonlinearity(basis, mu),), output_of=(0,),
                         offset_x=[constant])


def test_an_equilibrium_is_found_where_newton_steps_from_zero_go_in_a_circle():
    model = resting()
    x, y = model.equilibrium([0.0])
    assert x[0] == y[0] == pytest.approx(-1.769292354238631)
    assert model.equilibrium([0.0], near=[-2.0])[0] == pytest.approx(x)
    assert model.static_curve(0, np.linspace(-1, 1, 5)) == pytest.approx(np.full((5, 1), x[0]))


def test_a_static_gain_that_neighbours_do_not_have_is_left_out_of_the_table():
    fit = quiet(record("plain", 100, 1, 1, np.random.default_rng(1)), "ss.exact", nx=1)
    names = [name for name, *_ in fit.uncertainty.table()]
    assert names == ["pole 1", "static gain[y,u]"]
    above, below, gap = fit.uncertainty.source.neighbours[0]
    object.__setattr__(above, "A", np.eye(1))
    vars(above).pop("poles", None)
    assert [name for name, *_ in fit.uncertainty.table()] == ["pole 1"]


def test_equations_without_static_functions_are_drawn():
    fit = quiet(record("plain", 80, 1, 1, np.random.default_rng(2)), "physical", equations=TANK, starts=1)
    assert len(fit.plot().subfigs) > 2
    refuses(DataError, "no static functions", plots.nonlinearity, fit)


class PanicException(BaseException):
    """What a panic of Rust is in Python."""


def test_a_panic_of_a_solver_is_its_failure_and_an_interruption_is_none():
    def solver(error):
        def run(program, settings):
            raise error

        return BackEnd("mine", frozenset({"QP"}), run)

    data = record("plain", 60, 1, 1, np.random.default_rng(0))
    with pytest.raises(SolverFailed, match="PanicException: Eigval"):
        optid.fit(data, "arx", na=1, nb=1, solver=solver(PanicException("Eigval error")))
    with pytest.raises(KeyboardInterrupt):
        optid.fit(data, "arx", na=1, nb=1, solver=solver(KeyboardInterrupt()))


def test_a_panic_inside_cvxpy_is_an_error_of_the_solver(monkeypatch):
    def panic(*_, **__):
        raise PanicException("Eigval error")

    monkeypatch.setattr(cp.Problem, "solve", panic)
    with pytest.raises(cp.SolverError, match="CLARABEL crashed: Eigval error"):
        solve_quietly(cp.Problem(cp.Minimize(0)))


# -- parts that fail ---------------------------------------------------------------------------------------------------


def fail(*_, **__):
    raise ZeroDivisionError("nothing to divide by")


@pytest.fixture
def lenient(monkeypatch):
    """Parts that fail are replaced by a note, as outside the tests."""
    monkeypatch.setattr(sections, "CAUGHT", (Exception,))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("module, name, left", [
    (estimates, "parameter_tables", "The model on this record"), (summary, "fit_table", "Parameters"),
    (summary, "verdict", "Parameters"), (summary, "judgement", "Parameters"), (summary, "model_facts", "Parameters"),
    (summary, "constraint_table", "Parameters"), (summary, "evidence_facts", "Parameters"),
])
def test_a_part_that_fails_leaves_the_others_and_says_why(monkeypatch, lenient, module, name, left):
    fit = example_fit("thruster")
    whole = describe(fit).splitlines()
    monkeypatch.setattr(module, name, fail)
    for shown in (describe(fit), render(fit)):
        text = " ".join(shown.split())
        assert f"{sections.FAILED}: ZeroDivisionError: nothing to divide by; this is a defect of optid" in text
        assert left in text
    kept = describe(fit).splitlines()
    lost = [line for line in whole if line not in kept]
    assert len(lost) < len(whole) / 2
    assert "<table>" in fit_html(fit)
    monkeypatch.setattr(sections, "CAUGHT", ())
    with pytest.raises(ZeroDivisionError):
        describe(fit)


def test_a_panel_that_fails_leaves_the_others(monkeypatch, lenient):
    monkeypatch.setattr(plots, "_dynamics_panels", fail)
    figure = example_fit("thruster").plot()
    words = [text.get_text() for part in figure.findobj(match=lambda one: hasattr(one, "texts")) for text in part.texts]
    assert any(sections.FAILED in word for word in words)
    assert len([ax for ax in figure.get_axes() if ax.lines]) >= 3


def test_a_noise_model_that_has_no_equivalent_in_raw_units_leaves_the_model():
    fit = quiet(record("plain", 100, 1, 1, np.random.default_rng(1)), "hammerstein_ss.asivid", nx=1)
    evidence = fit.outcome.evidence

    def refuse():
        raise StructureError("no noise")

    object.__setattr__(evidence, "extend", refuse)
    assert fit.model.nx == 1 and fit.figures["noise model"] == "none: no noise"
    assert "no noise" in str(fit) and pickle.loads(pickle.dumps(fit)).model.nx == 1


# -- the command -------------------------------------------------------------------------------------------------------

ORDERS = ["--dt", 0.5, "--na", 1, "--nb", 1, "--basis", "polynomial:3"]


@pytest.mark.parametrize("broken", ["optid.cli.results.render", "optid.show.printing.describe"])
def test_a_report_or_a_text_that_fails_leaves_the_model(monkeypatch, csv, tmp_path, broken):  # noqa: F811
    monkeypatch.setattr(broken, fail)
    found = run("fit", csv, *ORDERS, "--model", tmp_path / "m.json", "--report", tmp_path / "r.html")
    assert found.exit_code == 1 and f"model written to {tmp_path / 'm.json'}" in found.output
    assert "ZeroDivisionError" in found.output and "report written" not in found.output
    assert ("The model on this record" in found.output) == broken.endswith("render")
    assert optid.load(tmp_path / "m.json").na == 1


def test_a_picture_that_fails_leaves_the_text(monkeypatch, csv, tmp_path):  # noqa: F811
    monkeypatch.setattr("optid.show.figures.order_study", fail)
    found = run("order", csv, "--dt", 0.5, "--picture", tmp_path / "p.png")
    assert found.exit_code == 1 and "Recommended: nx" in found.output and "picture written" not in found.output
    again = run("fit", "--example", "thruster", "--no-prove", "--model", tmp_path / "m.json")
    assert example("thruster").data.inputs == optid.load(tmp_path / "m.json").inputs and again.exit_code == 0
