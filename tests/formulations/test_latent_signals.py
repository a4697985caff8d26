"""Static functions of latent signals: the model, its simulation, its derivatives, and fits of plants that have them."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import scripts
from refusals import refuses
from scipy.signal import lfilter
from state_systems import by_hand

import optid
from formulations.constraints import shape
from optid.bases import BSpline, Polynomial, UserFunctions
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataWarning, OptidError, StructureError
from optid.identify.prediction_error.latent_directions import factors
from optid.identify.prediction_error.latent_search import _confirmed, _renewed
from optid.identify.prediction_error.state_errors import StateErrors
from optid.models import HammersteinSS, Nonlinearity
from optid.statistics.expansion import expand
from optid.statistics.state_unknowns import Latent, StateUnknowns, beyond_affine

SMOOTH = Nonlinearity(Polynomial(3, interval=(-2.0, 2.0), outside="extrapolate"), np.array([0.2, -0.3, 0.1]))
CELLS = Nonlinearity(BSpline(4, interval=(-1.0, 1.0), outside="linear"), np.array([0.3, -0.5, 0.2, 0.4, 0.1, -0.2]))
USER = Nonlinearity(UserFunctions((np.tanh,), interval=(-1.0, 1.0), outside="extrapolate"), np.array([0.7]))
FED = Nonlinearity(Polynomial(2, interval=(-3.0, 3.0)), np.array([0.1, 0.2]))


def latent(first=SMOOTH, second=CELLS, seed=0, **changes):
    """Three states, two inputs, two outputs, two latent signals, one output fed back."""
    rng = np.random.default_rng(seed)
    arguments = {
        "A": np.diag([0.7, 0.5, -0.3]) + 0.05 * rng.normal(size=(3, 3)), "B": rng.normal(size=(3, 2)),
        "C": rng.normal(size=(2, 3)), "D": 0.3 * rng.normal(size=(2, 2)), "latent": (first, second),
        "Ez": 0.2 * rng.normal(size=(3, 2)), "Fz": 0.3 * rng.normal(size=(2, 2)), "Cz": 0.4 * rng.normal(size=(2, 3)),
        "Dz": 0.3 * rng.normal(size=(2, 2)), "offset_z": np.array([0.1, -0.2]), "E": 0.1 * rng.normal(size=(3, 1)),
        "feedback": (FED,), "output_of": (1,), "L": 0.05 * rng.normal(size=(3, 2)),
        "offset_x": np.array([0.1, 0.0, -0.1]), "offset_y": np.array([0.5, -1.0])}
    return HammersteinSS(**(arguments | changes))


def inputs(samples=80, seed=1):
    return np.random.default_rng(seed).normal(size=(samples, 2))


MODELS = [latent(), latent(second=USER)]
X0 = np.array([0.4, -0.2, 0.3])


@pytest.mark.parametrize("model", MODELS)
def test_simulation_equals_the_equations(model):
    u = inputs()
    assert model.simulate(u, x0=X0) == pytest.approx(by_hand(model, u, X0), abs=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_several_steps_ahead_without_correction_are_the_free_run(model):
    u = inputs()
    y = by_hand(model, u, X0)
    found = model.predict(Data(u, y), horizon=4, x0=X0)
    assert found[3:] == pytest.approx(y[3:], abs=1e-11)


@pytest.mark.parametrize("change", [
    lambda model: model.transform(np.array([[1.0, 0.3, 0.0], [0.0, 2.0, -0.1], [0.4, 0.0, 0.5]])),
    lambda model: model.inject_output(0.1 * np.ones((3, 2))),
    lambda model: HammersteinSS.from_dict(model.to_dict()),
    lambda model: model.regauge("norm")])
def test_forms_that_simulate_the_same(change):
    model, u = latent(), inputs()
    other = change(model)
    x0 = np.zeros(3)
    assert other.simulate(u, x0=x0) == pytest.approx(model.simulate(u, x0=x0), abs=1e-10)


def test_change_of_units():
    model, u = latent(), inputs()
    units = Transform((2.0, 0.5), (1.0, -3.0), (10.0, 10.0), (5.0, 7.0))
    raw = model.with_transform(units)
    expected = by_hand(model, (u - [1.0, -3.0]) / [2.0, 0.5], X0) * 10.0 + [5.0, 7.0]
    assert raw.simulate(u, x0=10.0 * X0) == pytest.approx(expected, abs=1e-9)


def test_text_and_table_have_every_term():
    """The written equations, read term by term, give the next state and the outputs."""
    model, x, u = latent(), X0, np.array([0.3, -0.4])
    y = by_hand(model, u[None], x)[0]
    z = model.latent_signals(x[None], u[None])[0]
    known = {f"x{i + 1}(k)": v for i, v in enumerate(x)} | {f"u{i + 1}(k)": v for i, v in enumerate(u)}
    known |= {f"y{i + 1}(k)": v for i, v in enumerate(y)} | {"g_y2(y2(k))": FED(y[1])}
    known |= {f"h{i + 1}(z{i + 1}(k))": h(v) for i, (h, v) in enumerate(zip(model.latent, z))}
    values = {}
    for line in model.equation(digits=15).splitlines():
        left, right = line.split(" = ")
        words = right.replace("- ", "-").replace("+ ", "").split()
        value = 0.0
        while words:
            number = float(words.pop(0))
            value += number * (known[words.pop(0)] if words and words[0] in known else 1.0)
        values[left] = value
    g, h = FED(y[1]), model.latent_values(model.latent_signals(x[None], u[None]))[0]
    later = model.A @ x + model.B @ u + model.E[:, 0] * g + model.L @ y + model.Ez @ h + model.offset_x
    expected = [*later, *y, *z]
    assert list(values.values()) == pytest.approx(expected, rel=1e-12)
    table = dict(model.coefficients())
    assert (table["Ez[x2,h1]"], table["Dz[z1,u2]"], table["offset_z[z2]"]) == (
        model.Ez[1, 0], model.Dz[0, 1], model.offset_z[1])


def test_casadi_equals_simulation():
    model, u = latent(), inputs()
    function, x, found = model.to_casadi(), X0, []
    for row in u:
        x, y = function(x, row)
        found.append(np.array(y).ravel())
    assert np.array(found) == pytest.approx(model.simulate(u, x0=X0), abs=1e-12)


def test_content_of_before_latent_signals_is_read():
    model = HammersteinSS([[0.5]], [[1.0]], [[2.0]], offset_y=[3.0])
    content = model.to_dict()
    for name in ("latent", "Ez", "Fz", "Cz", "Dz", "offset_z"):
        del content[name]
    u = inputs()[:, :1]
    assert np.array_equal(HammersteinSS.from_dict(content).simulate(u), model.simulate(u))


def test_initial_state_and_rest():
    model, u = latent(), inputs()
    data = Data(u, by_hand(model, u, X0))
    assert model.initial_state(data) == pytest.approx(X0, abs=1e-6)
    x, y = model.equilibrium([0.2, -0.1])
    assert model.simulate(np.tile([0.2, -0.1], (5, 1)), x0=x) == pytest.approx(np.tile(y, (5, 1)), abs=1e-9)
    step = 1e-6
    for c in range(2):
        near = [model.equilibrium(np.array([0.2, -0.1]) + sign * step * np.eye(2)[c])[1] for sign in (1, -1)]
        slope = (near[0] - near[1]) / (2 * step)
        assert model.static_gain([0.2, -0.1])[:, c] == pytest.approx(slope, abs=1e-6)


def resonant(seed):
    """A random resonance of two to four states with one or two cubic functions of latent signals, and white inputs."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    radius, angle, A = rng.uniform(0.8, 0.97), rng.uniform(0.2, 1.2), np.zeros((n, n))
    A[:2, :2] = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    A[range(2, n), range(2, n)] = [rng.uniform(-0.3, 0.9) for _ in range(2, n)]
    turn = rng.normal(size=(n, n))
    A, B, C, k = turn @ A @ np.linalg.inv(turn), rng.normal(size=(n, 1)), rng.normal(size=(1, n)), rng.integers(1, 3)
    cubic = Polynomial(3, interval=(-3.0, 3.0))
    functions = tuple(Nonlinearity(cubic, np.array([0, rng.normal() * 0.3, -abs(rng.normal()) * 0.6]))
                      for _ in range(k))
    Cz, Ez, u = rng.normal(size=(k, n)), rng.normal(size=(n, k)), rng.normal(size=400)
    x = np.zeros((401, n))
    for i in range(400):
        x[i + 1] = A @ x[i] + B[:, 0] * u[i]
    Cz /= (x @ Cz.T).std(axis=0)[:, None]
    return HammersteinSS(A, B, C, latent=functions, Cz=Cz, Ez=0.15 * x.std(axis=0).mean() * Ez), u, rng


@pytest.mark.parametrize("seed", [9, 51, 64, 105, *range(5)])
def test_a_state_far_from_rest_is_found(seed):
    """From rest, steps on the whole record end in other optima for some of these; errors at its beginning say so."""
    model, u, rng = resonant(seed)
    y = np.ravel(model.simulate(u))[100:]
    data = optid.Data(u[100:], y + 0.01 * y.std() * rng.normal(size=y.shape))
    assert np.std(np.ravel(model.simulate(data, x0="fit")) - y) < 0.02 * y.std()


def test_shapes_are_refused_by_name():
    refuses(StructureError, r"Cz has shape \(2, 2\).*2 of latent signals", latent, Cz=np.zeros((2, 2)))
    refuses(StructureError, "no part that is not affine", beyond_affine, Polynomial(1, interval=(-1.0, 1.0)))


@pytest.mark.parametrize("basis", [Polynomial(2), Polynomial(5), BSpline(6), BSpline(6, outside="linear")])
def test_coordinates_without_a_linear_part(basis):
    basis = replace(basis, interval=(-1.0, 3.0))
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(-1, 3, 49)  # every cell of the bases is a number of these
    z = np.concatenate([(a + b) / 2 + (b - a) / 2 * nodes for a, b in zip(edges, edges[1:])])
    functions = basis.values(z) @ beyond_affine(basis)
    natural = 2 * (basis.outside == "linear")
    assert functions.shape[1] == basis.size - 1 - natural
    assert np.linalg.matrix_rank(np.column_stack([functions, np.ones(z.size), z])) == basis.size + 1 - natural
    integrals = (np.tile(weights, 48) * functions.T) @ (z - 1)
    digits = 1e-4 if isinstance(basis, BSpline) else 1e-12  # the kinks of splines are between the nodes of a rule
    assert np.abs(integrals).max() < digits * np.abs(functions).max()


def test_functions_with_straight_tails_are_natural_splines():
    basis = BSpline(6, interval=(-1.0, 1.0), outside="linear")
    step = 1e-4
    ends = np.array([-1.0, 1.0 - step])
    bend = (basis.slopes(ends + step) - basis.slopes(ends)) @ beyond_affine(basis) / step
    inside = (basis.slopes(np.array([0.1 + step])) - basis.slopes(np.array([0.1]))) @ beyond_affine(basis) / step
    assert np.abs(bend).max() < 1e-2 * np.abs(inside).max()


def criterion_with_a_function(basis, samples=300):
    """Simulation errors of a model with a spline of its input and states, and its unknowns."""
    rng = np.random.default_rng(2)
    one = Latent(basis, beyond_affine(basis), direct=True)
    u = rng.uniform(-1, 1, (samples, 1))
    data = Data(u, rng.normal(size=(samples, 1)))
    unknowns = StateUnknowns(2, expand(data, "linear"), 1, (True,), latent=(one,))
    x = 0.3 * rng.normal(size=unknowns.size)
    return StateErrors(data, unknowns, np.eye(1), Transform.identity(data.m, 1)), x


@pytest.mark.parametrize("outside", ["linear", "clamp"])
def test_division_of_cells_keeps_the_model(outside):
    errors, x = criterion_with_a_function(BSpline(5, interval=(-1.0, 1.0), outside=outside))
    x[errors.unknowns.slices["z0"]] = [0.2, -0.3, 0.5, 0.1]
    finer, moved = _renewed(errors, x, 2)
    assert finer.unknowns.latent[0].basis.p == 10
    assert np.vstack(finer.residuals(moved)) == pytest.approx(np.vstack(errors.residuals(x)), abs=1e-9)


def test_a_signal_out_of_its_interval_is_brought_back():
    """Polynomials keep the model: what a shift makes affine goes to the matrices and offsets."""
    basis = Polynomial(3, interval=(-1.0, 1.0), outside="extrapolate")
    errors, x = criterion_with_a_function(basis)
    x[errors.unknowns.slices["z0"]] = [0.4, -0.6, 1.5, 0.7]
    moved = _renewed(errors, x)[1]
    point = errors.unknowns.unpack(moved)
    z = np.vstack(errors.run_states(point)) @ point.Cz.T + errors.data.experiments[0].u @ point.Dz.T + point.offset_z
    assert (z.min(), z.max()) == pytest.approx((-1 / 1.15, 1 / 1.15), abs=1e-6)
    assert np.vstack(errors.residuals(moved)) == pytest.approx(np.vstack(errors.residuals(x)), abs=1e-8)


def test_directions_contain_the_factors_of_a_transfer_function():
    """(q - 0.3) / (q - 0.8) and 1 / (q - 0.5) in a row: the output of the first is among the directions."""
    errors, x = criterion_with_a_function(Polynomial(3, interval=(-1.0, 1.0), outside="extrapolate"))
    point = replace(errors.unknowns.unpack(x), A=np.array([[0.8, 0.0], [0.5, 0.5]]), b=np.array([[1.0], [1.0]]),
                    C=np.array([[0.0, 1.0]]), d=np.zeros((1, 1)))
    found = list(factors(point, np.ones(3), 50, np.random.default_rng(0)))
    assert any(row == pytest.approx([0.5, 0.0, 1.0], abs=1e-9) for row in found)
    assert len(list(factors(point, np.ones(3), 2, np.random.default_rng(0)))) == 2


def test_a_function_that_is_worse_on_the_whole_record_begins_at_zero():
    wider, x = criterion_with_a_function(Polynomial(3, interval=(-1.0, 1.0), outside="extrapolate"), 800)
    errors = replace(wider, unknowns=replace(wider.unknowns, latent=()))
    point = wider.unknowns.unpack(x)
    without = replace(point, cs=(), Ez=point.Ez[:, :0], Fz=point.Fz[:, :0], Cz=point.Cz[:0], Dz=point.Dz[:0],
                      offset_z=point.offset_z[:0])
    before = errors.normalise(errors.unknowns.pack(without))
    astray = wider.unknowns.pack(replace(point, Ez=30 * point.Ez, A=0.9 * point.A))
    found, _ = _confirmed(wider, astray, errors, before, wider.data)
    assert np.isfinite(wider.value(found)) and wider.value(found) <= errors.value(before) * (1 + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_one_more_function_never_makes_a_model_of_many_outputs_worse(seed):
    """A boiler of four inputs and outputs: what few samples suggest leaves the range of the record."""
    data = scripts.benchmark("search_plants").record("boiler", seed).train
    objectives = [optid.fit(data, "ss.exact", nx=4, prove=False).solution.objective]
    for channels in (1, 2, 4):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # a descent of many unknowns ends at its limit
            fit = optid.fit(data, "lfr.exact", nx=4, channels=channels, prove=False, tries=1)
        assert np.all(np.isfinite(fit.simulation_fit))
        objectives.append(fit.solution.objective)
    assert np.all(np.diff(objectives[1:]) <= 0) and objectives[-1] < objectives[0]


def test_forgotten_initial_states_leave_no_subnormal_numbers():
    errors, x = criterion_with_a_function(Polynomial(2, interval=(-1.0, 1.0), outside="extrapolate"), 3000)
    point = errors.unknowns.unpack(x)
    x = errors.unknowns.pack(replace(point, A=0.5 * np.eye(2), Ez=0.01 * point.Ez))
    (block,) = [block for block, _ in errors.rows(x)(0)]
    small = np.abs(block[block != 0])
    assert np.all(block[-1, :2] == 0) and small.min() > 1e-160


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*steps gain less than")
def test_a_long_record_is_fitted_in_stages():
    """A saturation between two linear systems, 12,000 samples: the noise is reached."""
    rng = np.random.default_rng(4)
    u = rng.normal(size=24_000)
    x = lfilter([0.0, 0.3, 0.1], [1.0, -0.7], u)
    clean = lfilter([0.0, 0.4], [1.0, -0.6], np.tanh(x / x.std()))
    y = clean + 0.01 * clean.std() * rng.normal(size=u.size)
    fit = optid.fit(Data(u[:12_000], y[:12_000]), "lfr.exact", nx=3, direct=True, latent_basis="bspline:14")
    error = np.asarray(fit.model.simulate(Data(u[12_000:], y[12_000:]), x0="fit"))[:, 0] - y[12_000:]
    assert np.sqrt(np.mean(error**2)) < 1.1 * 0.01 * clean.std()
    assert fit.model.latent[0].basis.p == 14


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*steps gain less than", "ignore:.*without every input", "ignore:.*missing")
def test_inputs_missing_late_in_a_long_record_are_left_out():
    """The first samples of the record, which are fitted first, have fewer stretches than the whole."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=9_000)
    y = lfilter([0.0, 0.4], [1.0, -0.6], np.tanh(2 * lfilter([0.0, 0.3], [1.0, -0.7], u)))
    y += 0.01 * rng.normal(size=9_000)
    arguments = {"nx": 2, "latent_basis": "bspline:4", "tries": 1}
    whole = optid.fit(Data(u, y), "lfr.exact", **arguments)
    u[[3_000, 8_500]] = np.nan
    cut = optid.fit(Data(u, y), "lfr.exact", **arguments)
    assert cut.model.simulate(rng.normal(size=200)[:, None]).shape == (200, 1)
    assert cut.solution.objective == pytest.approx(whole.solution.objective, rel=0.02)


def oscillator(u, noise=0.0, seed=0):
    """A hardening spring: the latent signal is a state that no output shows alone."""
    x, v, y = 0.0, 0.0, np.zeros(len(u))
    for k in range(len(u)):
        y[k] = x + 0.2 * v
        v += 0.3 * (1.2 * u[k] - 0.4 * v - x - 0.4 * x**3)
        x += 0.3 * v
    return y + noise * np.random.default_rng(seed).normal(size=len(u))


def test_a_latent_spring_is_found():
    u = np.repeat(np.random.default_rng(3).uniform(-1.5, 1.5, 300), 4)
    sigma = 0.01 * oscillator(u).std()
    fit = optid.fit(Data(u[:800], oscillator(u, sigma)[:800]), "lfr.exact", nx=2, latent="states")
    test = Data(u[800:], oscillator(u)[800:])
    error = np.asarray(fit.model.simulate(test, x0="fit"))[:, 0] - test.y[:, 0]
    assert np.sqrt(np.mean(error**2)) < 0.5 * sigma
    linear = optid.fit(Data(u[:800], oscillator(u, sigma)[:800]), "ss.exact", nx=2)
    assert fit.solution.objective < 0.01 * linear.solution.objective


@pytest.mark.slow
def test_a_fit_goes_on_from_a_model_with_latent_signals():
    """In other units, too, and without a search; a model with other functions is refused."""
    u = np.repeat(np.random.default_rng(3).uniform(-1.5, 1.5, 200), 4)
    y = oscillator(u, 0.01)
    first = optid.fit(Data(u, y), "lfr.exact", nx=2, latent="states")
    moved = Data(10 + 5 * u[:700], 300 + 20 * y[:700])
    before = first.model.with_transform(Transform((5.0,), (10.0,), (20.0,), (300.0,)))
    again = optid.fit(moved, "lfr.exact", nx=2, latent="states", initial=before, tries=0)
    cold = optid.fit(moved, "lfr.exact", nx=2, latent="states")
    assert again.solution.objective == pytest.approx(cold.solution.objective, rel=1e-4)
    with pytest.raises(StructureError, match="other basis functions|latent"):
        optid.fit(moved, "lfr.exact", nx=2, latent="states", latent_basis="bspline:4", initial=before, tries=0)
    refuses(OptidError, "no start has a finite run", optid.fit, moved, "lfr.exact", nx=2, latent="states", tries=0)


@pytest.mark.parametrize("formulation, front", [("wiener_ss.exact", False), ("hammerstein_wiener_ss.exact", True)])
def test_functions_of_the_outputs_are_found(formulation, front):
    rng = np.random.default_rng(5)
    u = rng.uniform(-1, 1, 1600)
    f = u + 0.4 * u**2 if front else u
    x, z = np.zeros(2), np.zeros(1600)
    for k in range(1600):
        z[k] = x[0] - 0.4 * x[1]
        x = np.array([[0.8, 0.3], [-0.3, 0.8]]) @ x + np.array([0.3, 0.5]) * f[k]
    y = z + 0.4 * z**2
    sigma = 0.02 * y.std()
    fit = optid.fit(Data(u[:800], (y + sigma * rng.normal(size=1600))[:800]), formulation, nx=2)
    error = np.asarray(fit.model.simulate(Data(u[800:], y[800:]), x0="fit"))[:, 0] - y[800:]
    assert np.sqrt(np.mean(error**2)) < 0.3 * sigma
    assert fit.solution.status.value == "locally optimal"


def test_a_free_run_that_leaves_the_record_is_told():
    """A feedback law holds an unstable plant: its one-step errors are small, its free run leaves at the first noise."""
    rng = np.random.default_rng(0)
    u, y, x = np.zeros(600), np.zeros(600), 0.0
    for k in range(600):
        y[k] = x + 0.02 * rng.normal()
        u[k] = rng.uniform(-1, 1) - 0.3 * y[k] ** 3 - 0.5 * y[k]
        x = 0.9 * x + 0.3 * x**3 + u[k]
    arguments = {"nx": 1, "basis": "linear", "feedback_basis": "polynomial:3"}
    fit = optid.fit(Data(u, y), "hammerstein_ss.exact", criterion="prediction", **arguments)
    assert fit.solution.status.value == "locally optimal"
    assert "its free run leaves 10 times the range of the record" in fit.solution.reason
    assert "criterion='simulation'" in fit.figures["free run"]
    calm = optid.fit(Data(u, 0.1 * u), "hammerstein_ss.exact", criterion="prediction", **arguments)
    assert "free run" not in calm.figures and "free run" not in calm.solution.reason


@pytest.mark.filterwarnings("ignore:The record is not consistent")
def test_tables_figures_and_checks_show_the_latent_function():
    u = np.repeat(np.random.default_rng(3).uniform(-1.5, 1.5, 150), 4)
    data = Data(u, oscillator(u, 0.02))
    fit = optid.fit(data, "lfr.exact", nx=2, latent="states", latent_basis="polynomial:3")
    text = str(fit)
    assert "Latent nonlinearity h, basis polynomial with 3 functions on [-1, 1]" in text
    (z,) = fit.model.latent_run(data)
    inside = np.mean(np.abs(z) <= 1)
    assert z.shape == (600, 1) and inside > 0.9
    with pytest.warns(DataWarning, match="of latent signal 'z' lies outside"):
        found = optid.validate(fit.model, Data(2.0 * u, oscillator(2.0 * u)))
    (further,) = fit.model.latent_run(Data(2.0 * u, oscillator(2.0 * u)))
    share = np.mean(np.abs(further) > 1)
    assert found.outside["z"] == pytest.approx(share) and share > 0.02
    assert any("of latent signal 'z' lies outside the interval [-1, 1]" in note for note in found.notes)
    found = fit.problem.model(fit.solution.values)  # not a point with the same errors to first order
    assert found.A == pytest.approx(fit.model.A, rel=1e-6) and found.latent[0].mu == pytest.approx(
        fit.outcome.model.latent[0].mu, rel=1e-5, abs=1e-12)
    band = fit.uncertainty.band(0, family="latent")
    assert np.all(np.isfinite(band.error)) and np.all(band.lower <= band.value)
    assert all(error > 1e-6 for _, _, error, _, _ in fit.uncertainty.table())
    from optid.show.plots import nonlinearity

    titles = [ax.get_title(loc="left") for ax in nonlinearity(fit).axes]
    assert titles == ["Nonlinearity f of u", "Latent nonlinearity h of z"]


@pytest.mark.parametrize("formulation", ["lfr.exact", "wiener_ss.exact"])
def test_functions_without_effect_are_named(formulation):
    rng = np.random.default_rng(2)
    u = rng.uniform(-1, 1, 400)
    data = Data(u, lfilter([0.0, 0.5], [1.0, -0.8], u) + 0.05 * rng.normal(size=400))
    with pytest.warns(DataWarning, match="no significant effect"):
        fit = optid.fit(data, formulation, nx=1)
    assert "leave them out" in fit.figures["effect of latent signals"]


def test_words_are_refused():
    data = Data(inputs(60)[:, :1], inputs(60)[:, 1:])
    for arguments in ({"channels": 0}, {"latent": "outputs"}, {"latent_basis": "polynomial:1"},
                      {"latent_basis": "spline"}):
        with pytest.raises(OptidError):
            optid.fit(data, "lfr.exact", nx=1, **arguments)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_rest_is_judged_by_the_terms_that_cancel_there(scale):
    """A fed-back output and two functions of about one, which cancel, leave a state that is rounding."""
    rng = np.random.default_rng(0)
    model = latent(A=0.3 * rng.normal(size=(3, 3)), feedback=(), E=np.zeros((3, 0)), output_of=(),
                   offset_x=np.zeros(3), offset_z=np.array([0.4, -0.5]), Ez=scale * rng.normal(size=(3, 2)),
                   Cz=0.4 * rng.normal(size=(2, 3)) / scale, C=0.1 * rng.normal(size=(2, 3)),
                   Fz=np.zeros((2, 2)), offset_y=scale * np.ones(2))
    level = model.latent_values(model.latent_signals(np.zeros((1, 3)), np.zeros((1, 2))))[0]
    model = replace(model, L=-model.Ez * level / scale)
    x, y = model.equilibrium(np.zeros(2))
    assert np.abs(x).max() < 1e-13 * scale and y == pytest.approx(scale * np.ones(2), rel=1e-13)


def wiener_record(samples=500):
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, samples)
    z = lfilter([0.0, 0.5, 0.2], [1.0, -1.1, 0.4], u)
    return Data(u, np.tanh(1.5 * z) + 0.1 * rng.normal(size=samples))


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_shapes_of_output_functions_hold_and_have_prices():
    data, settings = wiener_record(), {"nx": 2, "output_basis": "bspline:6"}
    free = optid.fit(data, "wiener_ss.exact", **settings)
    grid = np.linspace(-1.0, 1.0, 400)
    assert np.diff(free.model.latent[0](grid)).min() < -1e-5  # the noise bends the ends down
    basis = replace(BSpline(6), interval=(-1.0, 1.0))

    def rising(slack):
        return optid.fit(data, "wiener_ss.exact", **settings, constraints=[
            lambda v: {"rising": basis.increments() @ v["mu latent[z1]"] >= slack}])

    fit = optid.fit(data, "wiener_ss.exact", **settings, constraints=[shape.monotone("increasing", "z1")])
    assert np.diff(fit.model.latent[0](grid)).min() >= -1e-7
    assert fit.solution.objective == pytest.approx(rising(0.0).solution.objective, rel=1e-6)
    step = 1e-4
    slope = (rising(step).solution.objective - rising(-step).solution.objective) / (2 * step)
    (price,) = rising(0.0).prices
    assert price.binding and abs(price.multiplier) == pytest.approx(slope, rel=0.05)
    odd = optid.fit(data, "wiener_ss.exact", **settings, constraints=[shape.odd("z1")]).model.latent[0]
    assert odd(grid) + odd(-grid) == pytest.approx(2 * odd(np.zeros(1)) * np.ones(400), abs=1e-8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_functions_of_latent_signals_are_bent_as_asked_or_the_question_is_refused():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 300), np.zeros(300)
    for k in range(299):
        y[k + 1] = 0.6 * y[k] + 0.8 * u[k] + 0.4 * max(y[k] - 0.2, 0.0) - 0.3 * max(-y[k] - 0.9, 0.0)
    data = Data(u, y + 0.05 * rng.normal(size=300))

    def fit(*rules):
        return optid.fit(data, "lfr.exact", nx=1, latent_basis="bspline:4", tries=1, iterations=40, constraints=rules)

    grid = np.linspace(-1.0, 1.0, 200)
    free = fit()
    bend = np.diff(free.model.latent[0](grid), 2)
    assert bend.min() < -1e-7 and bend.max() > 1e-7
    held = fit(shape.convex("z1"))
    assert np.diff(held.model.latent[0](grid), 2).min() >= -1e-9
    assert held.solution.objective == pytest.approx(free.solution.objective, rel=0.2)
    for rule, words in ((shape.monotone("increasing", "z1"), "slope of the function of z1"),
                        (shape.even("z1"), "slope of the function"), (shape.gain(1.0, channel="z1"), "no static"),
                        (shape.convex("z2"), "a latent signal is z1"),
                        (shape.monotone("decreasing", "z1"), "sign of z1 is arbitrary")):
        refuses(StructureError, words, fit, rule)
