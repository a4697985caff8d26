"""State-space models by prediction and simulation error, against finite differences, SciPy and known systems."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from refusals import refuses
from scipy.signal import lfilter
from state_systems import by_hand
from state_systems import linear as linear_system

import optid
from formulations.constraints import shape
from formulations.constraints.poles import stable
from formulations.constraints.rule import Rule
from formulations.state_space import hammerstein_ss as exact
from formulations.state_space import ss as linear
from optid.bases import BSpline, Linear, Polynomial, Triangular, UserFunctions
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataError, InfeasibleError, RankError, StructureError
from optid.identify.prediction_error import state_errors
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.prediction_error.state_search import start_from_model
from optid.models import HammersteinSS, Nonlinearity
from optid.models.kalman import kalman_gain
from optid.program.solution import Status
from optid.statistics.expansion import expand
from optid.statistics.linearised import linearise_errors
from optid.statistics.state_unknowns import Latent, StateUnknowns, beyond_affine


def problem(criterion, missing, fed, experiments=2, n=3, seed=0, basis=None, latent=(), linear_output=True):
    """A criterion on noise and a random point: nothing about it is special."""
    rng = np.random.default_rng(seed)
    us = [rng.normal(size=(60 - 7 * i, 2)) for i in range(experiments)]
    ys = [0.3 * np.cumsum(rng.normal(size=(60 - 7 * i, 2)), axis=0) for i in range(experiments)]
    for y in ys:
        y[rng.uniform(size=y.shape) < missing] = np.nan
    data = Data(us, ys) if experiments > 1 else Data(us[0], ys[0])
    bases = [Triangular(4).with_interval(-4, 4), Linear()]
    feedback = [(basis or Polynomial(3)).with_interval(-3, 3), None] if fed else None
    expansion = expand(data, bases, feedback)
    unknowns = StateUnknowns(n, expansion, experiments, (True, False), criterion, True, latent, linear_output)
    criterion = StateErrors(data, unknowns, np.array([[2.0, 0.3], [0.3, 0.5]]), Transform.identity(data.m, 2))
    return criterion, criterion.normalise(0.3 * rng.normal(size=unknowns.size))


def weighted_square(criterion, x):
    covariance, total = np.linalg.inv(criterion.weight), 0.0
    for errors in criterion.residuals(x):
        for e in errors:
            here = ~np.isnan(e)
            if here.any():
                total += e[here] @ np.linalg.inv(covariance[np.ix_(here, here)]) @ e[here]
    return total


def latent_functions():
    smooth, cells = Polynomial(4).with_interval(-2, 2), BSpline(5, interval=(-1.0, 1.0), outside="extrapolate")
    return (Latent(smooth, beyond_affine(smooth), direct=True), Latent(cells, np.eye(cells.size), feeds=False, output=1,
                                                                       moved=False))


RUNS = {"simulation": "simulate", "measured feedback": "simulate_measured_feedback", "prediction": "predict"}


@pytest.mark.sampled(9)
@pytest.mark.parametrize("latent", [(), latent_functions()])
@pytest.mark.parametrize("criterion", RUNS)
@pytest.mark.parametrize("basis", [None, Polynomial(3), UserFunctions((np.sin, np.tanh), interval=(-3.0, 3.0))])
@pytest.mark.parametrize("missing", [0.2, 0.0])
def test_sensitivities_equal_finite_differences(criterion, missing, basis, latent):
    word = criterion
    criterion, x = problem(criterion, missing, basis is not None, basis=basis, latent=latent)
    at = criterion.linearise(x)
    assert at.value == pytest.approx(weighted_square(criterion, x), rel=1e-12)
    matrix, errors = at.whole
    differences = [(weighted_square(criterion, x + 1e-6 * d) - weighted_square(criterion, x - 1e-6 * d)) / 2e-6
                   for d in np.eye(x.size)]
    assert 2 * matrix.T @ errors == pytest.approx(differences, abs=1e-6 * np.abs(differences).max())
    point = criterion.unknowns.unpack(x)
    model = criterion.at(point)
    run = getattr(model, RUNS[word])
    for y, e, errors in zip(run(criterion.data, x0=list(point.x0)), criterion.data.experiments, criterion.residuals(x)):
        assert y - e.y == pytest.approx(errors, abs=1e-10, nan_ok=True)


def test_chunks_agree(monkeypatch):
    criterion, x = problem("prediction", 0.1, True)
    found = [criterion.linearise(x)]
    monkeypatch.setattr(state_errors, "NUMBERS", 0)  # the shortest chunks
    found.append(criterion.linearise(x))
    grams = [one.whole[0].T @ one.whole[0] for one in found]
    assert grams[0] == pytest.approx(grams[1], rel=1e-9, abs=1e-9 * np.abs(grams[0]).max())


@pytest.mark.parametrize("latent", [(), latent_functions()])
@pytest.mark.parametrize("word", RUNS)
def test_directions_of_the_gauge_change_nothing(word, latent):
    criterion, x = problem(word, 0.0, True, latent=latent)
    rows = criterion.gauge_rows(x)
    assert len(rows) == 9 + 2 + bool(latent)  # n^2 changes of states, scales of functions
    assert rows @ rows.T == pytest.approx(np.eye(len(rows)), abs=1e-10)
    plain = linearise_errors(criterion.rows(x), 2, 3, criterion.unknowns.shared)
    assert np.abs(plain.root @ rows.T).max() < 1e-5 * np.abs(plain.root).max()


def test_vector_of_a_model_and_back():
    criterion, x = problem("prediction", 0.0, True)
    unknowns = criterion.unknowns
    model = criterion.at(unknowns.unpack(x))
    again = criterion.normalise(unknowns.pack(criterion.point_of(model)))
    assert again[: unknowns.shared] == pytest.approx(x[: unknowns.shared], abs=1e-10)


def system(seed=0, n=2, noise=0.05, samples=400, kind="output", experiments=1):
    """A linear two-input two-output record and its model."""
    model = replace(linear_system(seed, n=n, offset_x=None), dt=1.0)
    rng = np.random.default_rng(seed + 1)
    us, ys = [], []
    for i in range(experiments):
        u = rng.normal(size=(samples - 50 * i, 2))
        e = noise * rng.normal(size=(len(u), 2))
        if kind == "output":
            y = replace(model, K=None).simulate(u, x0=rng.normal(size=n)) + e
        else:
            x, y = rng.normal(size=n), np.zeros((len(u), 2))
            for k in range(len(u)):
                y[k] = model.C @ x + model.D @ u[k] + model.offset_y + e[k]
                x = model.A @ x + model.B @ u[k] + model.K @ e[k]
        us.append(u), ys.append(y)
    return model, Data(us, ys) if experiments > 1 else Data(us[0], ys[0])


@pytest.mark.parametrize("criterion", ["simulation", "prediction"])
def test_scipy_finds_no_better_point(criterion):
    _, data = system(seed=3, kind="innovation" if criterion == "prediction" else "output", samples=300, noise=0.2)
    fit = optid.fit(data, linear, nx=2, criterion=criterion, weighting="scale")
    unknowns = StateUnknowns(2, _expansion(data), 1, (True, True), criterion)
    error = StateErrors(data, unknowns, np.diag(1 / data.y.var(axis=0)), Transform.identity(data.m, data.l))
    x = start_from_model(error, fit.model)
    assert error.linearise(x).value == pytest.approx(fit.solution.objective, rel=1e-8)
    root = np.linalg.cholesky(error.weight).T

    def weighted(z):
        return np.vstack([r @ root.T for r in error.residuals(z)]).ravel()

    best = scipy.optimize.least_squares(weighted, x, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert 2 * best.cost == pytest.approx(fit.solution.objective, rel=1e-8)


def _expansion(data):
    return expand(data, Linear())


def test_linear_system_without_noise_with_missing_samples_and_two_experiments():
    model, data = system(noise=0.0, experiments=2, n=3)
    rng = np.random.default_rng(5)
    ys = [np.where(rng.uniform(size=y.shape) < 0.02, np.nan, y) for y in data.y]
    lost = Data(list(data.u), ys)
    fit = optid.fit(lost, "ss.exact", nx=3)
    assert np.sort_complex(fit.model.poles) == pytest.approx(np.sort_complex(model.poles), abs=1e-6)
    assert fit.model.impulse_response(20) == pytest.approx(model.impulse_response(20), abs=1e-6)
    for found, y in zip(fit.model.simulate(lost, x0="fit"), data.y):
        assert found == pytest.approx(y, abs=1e-5)
    assert fit.solution.objective < 1e-8


def hammerstein(samples=1500, seed=0, fed=True):
    """Two inputs with a cubic each, one output fed back through a sine."""
    rng = np.random.default_rng(seed)
    cubic = Polynomial(3, interval=(-2.0, 2.0))
    functions = (Nonlinearity(cubic, np.array([1.0, 0.4, 0.3])), Nonlinearity(cubic, np.array([0.6, -0.5, 0.2])))
    sine = UserFunctions((lambda y: np.sin(2 * y),), interval=(-4.0, 4.0))
    model = HammersteinSS(
        [[0.7, 0.35], [-0.35, 0.6]], [[0.3, 0.1], [0.0, 0.4]], [[1.0, 0.0], [0.2, 1.0]], nonlinearities=functions,
        E=[[0.1], [0.25]] if fed else None, feedback=(Nonlinearity(sine, np.ones(1)),) if fed else (),
        output_of=(0,) if fed else (), offset_y=[0.3, -0.2])
    u = rng.uniform(-2, 2, (samples, 2))
    return model, u, rng


@pytest.mark.slow
def test_hammerstein_with_feedback_without_noise():
    model, u, _ = hammerstein(samples=800)
    y = model.simulate(u, x0=[0.5, -0.5])
    data = Data(u, y)
    sine = UserFunctions((lambda v: np.sin(2 * v),), interval=(-4.0, 4.0))
    fit = optid.fit(data, "hammerstein_ss.exact", nx=2, basis=Polynomial(3, interval=(-2.0, 2.0)),
                    feedback_basis=[sine, None], block_rows=5)
    assert fit.model.simulate_measured_feedback(data, x0="fit") == pytest.approx(y, abs=1e-5)
    assert fit.model.simulate(data, x0="fit") == pytest.approx(y, abs=1e-4)
    for c in range(2):
        ratio = fit.model.nonlinearities[c].mu / model.nonlinearities[c].mu
        assert ratio == pytest.approx(np.full(3, ratio[0]), rel=1e-5)


def test_innovation_form_finds_the_kalman_gain_and_the_noise():
    model, data = system(kind="innovation", samples=4000, noise=0.3, seed=3)
    fit = optid.fit(data, "ss.exact", nx=2, criterion="prediction")
    truth = data.y - model.predict(data)
    found = data.y - fit.model.predict(data)
    assert np.linalg.det(np.cov(found.T)) < np.linalg.det(np.cov(truth.T))
    assert np.cov(found.T) == pytest.approx(0.09 * np.eye(2), abs=0.01)
    products = lambda one: np.array([one.C @ np.linalg.matrix_power(one.A, k) @ one.K for k in range(4)])  # noqa: E731
    assert products(fit.model) == pytest.approx(products(model), abs=0.06)


def test_covariance_weights_are_a_fixed_point():
    _, data = system(noise=0.2)
    fit = optid.fit(data, linear, nx=2, weighting="determinant")
    errors = data.y - fit.model.simulate(data, x0="fit")
    covariance = errors.T @ errors / len(errors)
    assert fit.figures["weight of the outputs"] @ covariance == pytest.approx(np.eye(2), abs=0.02)


def test_poles_obey_their_constraint_at_every_step():
    _, data = system(noise=0.05, n=2)
    free = optid.fit(data, linear, nx=2)
    radius = 0.9 * np.abs(free.model.poles).max()
    fit = optid.fit(data, linear, nx=2, constraints=[stable(radius)], raises=False)
    assert np.abs(fit.model.poles).max() <= radius * (1 + 1e-6)
    assert fit.solution.objective > 0
    with pytest.raises(StructureError, match="cannot judge a model"):
        optid.fit(data, linear, nx=2, constraints=[Rule("somewhere", lambda v: [], None, frozenset({"poles"}))])
    with pytest.raises(InfeasibleError, match="'strip:0.5,0.6' and 'disc:-0.5,0.1' contradict each other"):
        optid.fit(data, linear, nx=2, constraints=["strip:0.5,0.6", "disc:-0.5,0.1"])


@pytest.mark.parametrize("rule", ["stable:0.7", "disc:0.3,0.45"])
def test_the_optimum_at_the_border_of_a_region_is_that_of_the_transfer_function(rule):
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 400)
    y = lfilter([0.0, 0.5, 0.2], [1.0, -0.78, 0.68], u) + 0.05 * rng.normal(size=400)
    fit = optid.fit(Data(u, y), linear, nx=2, constraints=[rule])
    assert fit.solution.status is Status.LOCAL and fit.prices[0].active
    polynomial = optid.fit(Data(u, y), "oe.exact", na=2, nb=3, constraints=[rule])
    assert fit.model.poles == pytest.approx(polynomial.model.poles, abs=1e-3)
    assert y.var() * fit.solution.objective == pytest.approx(polynomial.solution.objective, rel=1e-4)


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
@pytest.mark.parametrize(("rule", "obeys"), [
    ("strip:0.4,0.6", lambda z: 0.4 <= z.real <= 0.6), ("sector:0.7", lambda z: abs(np.angle(z)) <= 0.7)])
def test_regions_of_poles_hold_and_no_model_nearby_in_them_is_better(rule, obeys):
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, 300)
    y = lfilter([0.0, 0.5, 0.2], [1.0, -0.6, 0.72], u) + 0.05 * rng.normal(size=300)
    fit = optid.fit(Data(u, y), linear, nx=2, constraints=[rule])
    assert fit.solution.status is Status.LOCAL and all(obeys(z) for z in fit.model.poles)
    errors = []
    for _ in range(200):
        pole = fit.model.poles[0] + 0.02 * (rng.normal() + 1j * rng.normal())
        if obeys(pole):
            a = np.real(np.poly([pole, np.conj(pole)]))
            rows = [lfilter(np.eye(3)[i], a, u) for i in range(3)]
            rows += [lfilter(np.eye(2)[i], a, np.eye(300)[0]) for i in range(2)] + [np.ones(300)]
            rest = y - np.transpose(rows) @ np.linalg.lstsq(np.transpose(rows), y)[0]
            errors.append(rest @ rest)
    assert len(errors) > 20 and y.var() * fit.solution.objective <= min(errors) * (1 + 1e-6)


def test_shape_constraints_hold_for_every_input():
    model, u, rng = hammerstein(fed=False)
    data = Data(u, model.simulate(u) + 0.05 * rng.normal(size=(len(u), 2)))
    fit = optid.fit(data, "hammerstein_ss.exact", nx=2, basis=Triangular(6), block_rows=6,
                    constraints=[shape.monotone("increasing", channel="u2")])
    f = fit.model.nonlinearities[1]
    assert (np.diff(f(np.linspace(-2, 2, 200))) >= -1e-6).all()
    free = optid.fit(data, "hammerstein_ss.exact", nx=2, basis=Triangular(6), block_rows=6)
    assert (np.diff(free.model.nonlinearities[1](np.linspace(-2, 2, 200))) < -1e-4).any()


def test_refusals():
    _, data = system()
    refuses(StructureError, "criterion='best'", optid.fit, data, linear, nx=2, criterion="best")
    refuses(StructureError, "weighting", optid.fit, data, linear, nx=2, weighting="best")
    refuses(StructureError, "iterations", optid.fit, data, linear, nx=2, iterations=0)
    refuses(StructureError, "nx", optid.fit, data, linear, nx=0)
    refuses(StructureError, "a start has 3 states", optid.fit, data, linear, nx=2, initial=linear_system(n=3))
    short = Data(data.u[:30], data.y[:30])
    with pytest.raises((RankError, StructureError)):
        optid.fit(short, linear, nx=12)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises((RankError, DataError), match="linear"):
            optid.fit(data, exact, nx=2, basis="linear", feedback_basis="polynomial:1")


@pytest.mark.slow
def test_detrended_and_scaled_data_give_the_model_in_raw_units():
    model, u, rng = hammerstein(samples=600)
    y = model.simulate(u) + 0.05 * rng.normal(size=(len(u), 2))
    y[rng.uniform(size=y.shape) < 0.02] = np.nan
    raw = Data(u, y)
    sine = UserFunctions((lambda v: np.sin(2 * v),), interval=(-4.0, 4.0))
    for criterion in ("simulation", "prediction"):
        options = {"nx": 2, "basis": "polynomial:3", "criterion": criterion, "block_rows": 6, "weighting": "scale"}
        options["feedback_basis"] = [Polynomial(5), None]
        one = optid.fit(raw, "hammerstein_ss.exact", **options)
        other = optid.fit(raw.detrend().scale(), "hammerstein_ss.exact", **options)
        assert other.model.predict(raw) == pytest.approx(one.model.predict(raw), abs=2e-3)
        assert other.solution.objective == pytest.approx(one.solution.objective, rel=1e-5)
        assert other.model.noise.innovation == pytest.approx(one.model.noise.innovation, rel=1e-2, abs=1e-5)
    with pytest.raises(StructureError, match="UserFunctions"):
        optid.fit(raw.scale(), "hammerstein_ss.exact", **{**options, "feedback_basis": [sine, None]})


@pytest.mark.parametrize("criterion", ["simulation", "prediction"])
def test_noise_covariances_belong_to_the_gain(criterion):
    model, data = system(kind="innovation", samples=3000, noise=0.3, seed=3)
    found = optid.fit(data, "ss.exact", nx=2, criterion=criterion).model
    noise = found.noise
    assert noise.innovation == pytest.approx(0.09 * np.eye(2), abs=0.01)
    assert noise.Q == pytest.approx(found.K @ noise.innovation @ found.K.T, abs=1e-8)
    assert noise.S == pytest.approx(found.K @ noise.innovation, abs=1e-8)
    assert found.C @ found.K == pytest.approx(model.C @ model.K, abs=0.06)


def test_poles_may_leave_the_circle_where_that_is_allowed():
    plant = HammersteinSS([[1.01, 0.1], [0.0, 0.6]], [[0.0], [1.0]], [[1.0, 0.0]])
    rng = np.random.default_rng(0)
    u = rng.normal(size=300)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        y = plant.simulate(u) + 0.05 * rng.normal(size=300)
        stable_one = optid.fit(Data(u, y), "ss.exact", nx=2, raises=False)
        free = optid.fit(Data(u, y), "ss.exact", nx=2, stability="free")
    assert stable_one.model.is_stable and stable_one.solution.status.value == "limit"
    assert np.abs(free.model.poles).max() == pytest.approx(1.01, abs=1e-3)
    assert free.solution.objective < 0.5 * stable_one.solution.objective


@pytest.mark.sampled(1)
@pytest.mark.parametrize("weighting", ["scale", "variance"])
def test_simulation_errors_carry_the_hankel_bound(weighting):
    _, data = system(samples=1500, noise=0.3, seed=5)
    fits = {n: optid.fit(data, "ss.exact", nx=n, weighting=weighting, block_rows=8) for n in (1, 2)}
    for n, fit in fits.items():
        bound, objective = fit.solution.bound, fit.solution.objective
        assert not bound.proved and 0 < bound.value < objective
        assert f"no model of order {n}" in str(fit).replace("\n  ", " ")
        simulated = fit.model.simulate(data, x0="fit")
        weight = np.diag(fit.figures["weight of the outputs"])
        assert np.sum((data.y - simulated) ** 2 * weight) == pytest.approx(objective, rel=1e-3)  # x0 is unweighted
    predicted = optid.fit(data, "ss.exact", nx=2, criterion="prediction", block_rows=8)
    assert predicted.solution.bound.value == -np.inf  # the bound says nothing of one-step errors


def test_a_start_of_the_user_is_taken():
    model, data = system(noise=0.05)
    fit = optid.fit(data, linear, nx=2, initial=model, block_rows=5)
    assert "start 1" in fit.figures["starts"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 6, 11])
def test_outputs_of_different_noise_do_not_lead_to_the_border(seed):
    """Weights from the outputs instead of the errors ended at a zero of the noise on the unit circle, far off."""
    A, B = np.array([[0.88, 0.22, 0.0], [-0.22, 0.88, 0.0], [0.0, 0.0, 0.6]]), [[0.6, 0.2], [-0.3, 0.5], [0.4, 0.3]]
    C, R = np.array([[-1.2, 1.2, 0.3], [0.05, -0.1, 0.4]]), np.diag([0.05, 0.06]) ** 2
    steady = kalman_gain(A, C, 0.03**2 * np.eye(3), R)
    plant = HammersteinSS(A, B, C, D=0.1 * np.eye(2), K=steady.K)
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, (40, 2)), 5, axis=0)
    e = rng.normal(size=(200, 2)) @ np.linalg.cholesky(steady.innovation).T
    data = Data(u, by_hand(plant, u, np.zeros(3), noise=e))
    fit = optid.fit(data, "ss.exact", nx=3, criterion="prediction", block_rows=8)
    assert fit.solution.status.value == "locally optimal"
    # the model is at least as likely as the plant
    errors = data.y - plant.predict(data, x0="fit")
    assert np.linalg.det(fit.model.noise.innovation) < np.linalg.det(errors.T @ errors / 200)


def test_order_is_found_from_the_gap():
    _, data = system(noise=0.01, n=3, samples=800)
    assert optid.fit(data, linear, nx="auto").figures["order"] == 3


def test_static_gain_is_kept():
    model, u, rng = hammerstein(fed=False)
    data = Data(u, model.simulate(u) + 0.05 * rng.normal(size=(len(u), 2)))
    options = {"nx": 2, "basis": Polynomial(3, interval=(-2.0, 2.0)), "block_rows": 6}
    free = optid.fit(data, "hammerstein_ss.exact", **options)
    gain = 1.2 * free.model.static_gain([0.5, 0.0])[0, 0]
    fit = optid.fit(data, "hammerstein_ss.exact", constraints=[shape.gain(gain, at=0.5, channel="u1", output="y1")],
                    **options)
    assert fit.model.static_gain([0.5, 0.0])[0, 0] == pytest.approx(gain, rel=1e-5)
    assert fit.solution.status.value == "locally optimal"
    with pytest.raises(StructureError, match="outputs are y1, y2"):
        optid.fit(data, "hammerstein_ss.exact", constraints=[shape.gain(gain, at=0.5, channel="u1")], **options)
    with pytest.raises(StructureError, match="nonlinear feedback"):
        optid.fit(data, "hammerstein_ss.exact", feedback_basis=["polynomial:4", None],
                  constraints=[shape.gain(gain, at=0.5, channel="u1", output="y1")], **options)
