"""The formulations recover what is there, and equal the same problems on the raw samples."""

import cvxpy as cp
import numpy as np
import pytest
from problems import BASIS, dense, plant, raw_problem, record, regression
from refusals import refuses
from systems import BASES, by_hand, distance, inputs, mimo, nonlinearity, siso

import optid
from formulations.constraints import shape
from optid.bases import BSpline, Linear, Polynomial, Triangular
from optid.errors import RankError, StructureError
from optid.models import HammersteinTF

ORDERS = [([-1.5, 0.7], [16 / 15, 0.8], 0), ([-0.8], [1.0], 1), ([], [0.5, 0.2, -0.3], 2)]
FORMS = ["hammerstein_arx.exact", "hammerstein_arx.nuclear", "hammerstein_arx.overparametrised"]


def noise_free(model, count=300, seed=1):
    u = inputs(model, count, seed)
    return optid.Data(u=u, y=by_hand(model, u), dt=model.dt)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("a, b, nk", ORDERS, ids=["na2-nb2", "na1-nb1-nk1", "na0-nb3-nk2"])
@pytest.mark.parametrize("basis", BASES, ids=str)
def test_noise_free_systems_are_recovered_with_every_basis(basis, a, b, nk, form):
    true = siso(basis=basis, a=a, b=(b,), nk=nk, offset=0.05)
    fit = optid.fit(noise_free(true), form, na=len(a), nb=len(b), nk=nk, basis=basis.with_interval(-0.7, 1.3))
    assert distance(fit.model, true) < 1e-7
    assert fit.one_step_fit[0] > 100 - 1e-4  # the square root of roundoff
    assert fit.solution.objective <= 1e-12 * fit.solution.scale


def test_ratio_of_b_is_exact_for_a_function_that_is_not_odd():
    true = siso(nk=0, b=([1.0, 0.75],))
    assert abs(true.nonlinearities[0].mu.sum()) > 0.1  # where the structural null space hurts
    fit = optid.fit(noise_free(true), na=2, nb=2, basis=Triangular(7).with_interval(-0.7, 1.3))
    assert abs(fit.model.b[0][1] / fit.model.b[0][0] - 0.75) < 1e-8


@pytest.mark.parametrize("form", FORMS)
def test_several_inputs_each_with_its_own_basis_order_and_delay(form):
    bases = [Triangular(6), Polynomial(3), BSpline(4)]
    true = HammersteinTF([-1.1, 0.4], ([1.0, 0.5], [0.7], [0.3, -0.2, 0.4]),
                         tuple(nonlinearity(basis, seed) for seed, basis in enumerate(bases)), (0, 2, 1), 0.2)
    fit = optid.fit(noise_free(true, 500), form, na=2, nb=[2, 1, 3], nk=[0, 2, 1],
                    basis=[basis.with_interval(-0.7, 1.3) for basis in bases])
    assert distance(fit.model, true) < 1e-7


@pytest.mark.parametrize("form", FORMS)
def test_several_outputs_with_full_matrices(form):
    true = mimo()
    fit = optid.fit(noise_free(true, 500), form, na=2, nb=true.nb, nk=true.nk,
                    basis=[f.basis for f in true.nonlinearities])
    assert distance(fit.model, true) < 1e-7
    assert fit.one_step_fit.shape == (2,)


@pytest.mark.parametrize("seed", range(3))
def test_exact_fits_of_random_stable_systems(seed):
    rng = np.random.default_rng(seed)
    poles = rng.uniform(-0.9, 0.9, 3)
    true = HammersteinTF(np.poly(poles)[1:], (rng.normal(size=4),), (nonlinearity(Triangular(5), seed),), (1,), 0.1)
    fit = optid.fit(noise_free(true), na=3, nb=4, nk=1, basis=Triangular(5).with_interval(-0.7, 1.3))
    assert distance(fit.model, true) < 1e-7
    assert fit.solution.proof


def ragged():
    """Two experiments with two inputs and two outputs, samples missing in all of them."""
    rng = np.random.default_rng(5)
    us, ys = [], []
    for count in (90, 140):
        u = rng.uniform(-0.7, 1.3, (count, 2))
        y = rng.normal(size=(count, 2))
        u[rng.random(count) < 0.02, 0] = np.nan
        y[rng.random(count) < 0.03, 1] = np.nan
        us.append(u)
        ys.append(y)
    return optid.Data(u=us, y=ys)


def test_compressed_least_squares_equal_those_of_the_dense_regressor():
    data, bases = ragged(), [Triangular(4).with_interval(-0.7, 1.3), Polynomial(2).with_interval(-0.7, 1.3)]
    fit = optid.fit(data, "hammerstein_arx.overparametrised", na=2, nb=[2, 1], nk=[0, 1], basis=bases)
    phi, y = dense(data, 2, (2, 1), (0, 1), bases)
    theta, rest, *_ = np.linalg.lstsq(phi, y, rcond=None)
    assert fit.figures["rows"] == len(phi)
    assert fit.solution.objective == pytest.approx(rest.sum(), rel=1e-9)
    assert np.allclose(regression(fit), theta, atol=1e-6)


def test_linear_arx_equals_numpy():
    data = record()
    fit = optid.fit(data, "arx", na=2, nb=3, nk=1)
    phi, y = dense(data, 2, (3,), (1,), [Linear().with_interval(-1, 1)])
    theta, rest, *_ = np.linalg.lstsq(phi, y, rcond=None)
    assert np.allclose(np.concatenate([fit.model.a, fit.model.b[0], fit.model.offset]), theta[:, 0], atol=1e-7)
    assert fit.solution.objective == pytest.approx(rest[0], rel=1e-9)
    assert fit.model.nonlinearities[0].mu[0] == 1.0


@pytest.mark.parametrize("weight", [0.5, 5.0, 50.0])
def test_nuclear_equals_the_raw_sample_problem(weight):
    data = record()
    fit = optid.fit(data, "hammerstein_arx.nuclear", na=2, nb=3, basis=BASIS, weight=weight, accuracy=1e-10)
    phi, y = dense(data, 2, (3,), (0,), [BASIS])
    value, (theta,) = raw_problem(phi, y, 2, [(6, 3)], cp.sum_squares, weight)
    assert fit.solution.objective == pytest.approx(value, rel=1e-7)
    assert np.allclose(fit.values["Theta"], theta, atol=1e-5)
    assert fit.solution.proof
    assert value * (1 - 1e-6) <= fit.solution.bound.value <= value * (1 + 1e-8)


def test_bound_of_the_constrained_nuclear_problem_stays_below_its_optimum():
    data = record()
    fit = optid.fit(data, "hammerstein_arx.nuclear", na=2, nb=2, basis=BASIS, weight=2.0,
                    constraints=["monotone:increasing", lambda v: {"pole": v["a"][0] >= -1.0}])
    phi, y = dense(data, 2, (2,), (0,), [BASIS])
    value, _ = raw_problem(phi, y, 2, [(6, 2)], cp.sum_squares, 2.0,
                           lambda a, t, d: [BASIS.increments() @ cp.sum(t[0], axis=1) >= 0, a[0] >= -1.0])
    assert fit.solution.objective == pytest.approx(value, rel=1e-7)
    assert value * (1 - 1e-5) <= fit.solution.bound.value <= value * (1 + 1e-8)


def squared_errors(fit, data):
    found = fit.model.predict(data)
    several = [found] if data.n_experiments == 1 else found
    return sum(np.nansum((e.y - p) ** 2) for e, p in zip(data.experiments, several))


@pytest.mark.parametrize("form", FORMS[:1] + ["arx"])
def test_objective_is_the_sum_of_squared_one_step_errors(form):
    data = record()
    structure = {} if form == "arx" else {"basis": BASIS}
    fit = optid.fit(data, form, na=2, nb=2, **structure)
    assert fit.solution.objective == pytest.approx(squared_errors(fit, data), rel=1e-10)


def test_objective_with_penalties():
    data = record()
    fit = optid.fit(data, na=2, nb=2, basis=BASIS, ridge=0.7, curvature=0.02)
    theta = fit.model.theta(0)
    penalties = 0.7 * np.sum(theta**2) + 0.02 * np.trace(theta.T @ BASIS.penalty(2) @ theta)
    assert penalties > 0.1
    assert fit.solution.objective == pytest.approx(squared_errors(fit, data) + penalties, rel=1e-9)
    assert fit.solution.proof


def test_one_step_fit_equals_that_of_the_predictions():
    data = ragged()
    fit = optid.fit(data, na=1, nb=2, basis="triangular:3")
    pairs = [(e.y, p) for e, p in zip(data.experiments, fit.model.predict(data))]
    y, p = (np.vstack(part) for part in zip(*pairs))
    keep = ~np.isnan(p).any(axis=1) & ~np.isnan(y).any(axis=1)
    y, p = y[keep], p[keep]
    expected = 100 * (1 - np.linalg.norm(y - p, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))
    assert len(y) == fit.figures["rows"]
    assert np.allclose(fit.one_step_fit, expected, atol=1e-8)


@pytest.mark.parametrize("gauge", ["gain", "b0"])
def test_predictions_do_not_depend_on_the_gauge(gauge):
    data = record()
    one = optid.fit(data, na=2, nb=2, basis=BASIS)
    other = optid.fit(data, na=2, nb=2, basis=BASIS, gauge=gauge)
    assert np.nanmax(np.abs(one.model.predict(data) - other.model.predict(data))) < 1e-9
    turned = one.model.regauge(gauge)
    assert np.nanmax(np.abs(one.model.predict(data) - turned.predict(data))) < 1e-12
    assert np.allclose(turned.b[0], other.model.b[0], atol=1e-8)
    values = {"gain": other.model.b[0].sum() - 1 - other.model.a.sum(), "b0": other.model.b[0][0] - 1}
    assert abs(values[gauge]) < 1e-9
    assert np.linalg.norm(one.model.b[0]) == pytest.approx(1) and one.model.b[0][0] > 0


def test_the_exact_objective_is_never_above_that_of_the_splits():
    data = record(count=60, noise=1.0, seed=3)
    exact = optid.fit(data, na=2, nb=2, basis=BASIS)
    for svd in ("whitened", "plain"):
        split = optid.fit(data, "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS, svd=svd)
        assert squared_errors(split, data) >= exact.solution.objective * (1 - 1e-10)
        assert split.solution.objective <= exact.solution.objective


def test_resolve_along_a_path_of_weights():
    fit = optid.fit(record(), "hammerstein_arx.nuclear", na=2, nb=2, basis=BASIS, weight=1.0)
    again = optid.resolve(fit, {"weight": 20.0})
    direct = optid.fit(record(), "hammerstein_arx.nuclear", na=2, nb=2, basis=BASIS, weight=20.0)
    assert again.solution.objective == pytest.approx(direct.solution.objective, rel=1e-7)
    refuses(StructureError, "no weight 'wieght'.*weight", optid.resolve, fit, {"wieght": 1.0})


@pytest.mark.parametrize("change, error, words", [
    ({"nb": 0}, StructureError, "nb of input 'u' must be a positive integer"),
    ({"nb": "2"}, StructureError, "nb of input 'u' must be a positive integer"),
    ({"nb": [1, 2]}, StructureError, "2 entries for 1 inputs"),
    ({"nk": -1}, StructureError, "nk of input 'u' must be a nonnegative integer"),
    ({"na": -1}, StructureError, "na .the number of past outputs. must be"),
    ({"na": 2.0}, StructureError, "na .the number of past outputs. must be"),
    ({"basis": 5}, StructureError, "basis of input 'u'.*triangular:10"),
    ({"basis": [BASIS, BASIS]}, StructureError, "2 bases for 1 inputs"),
    ({"gauge": "nrom"}, StructureError, "norm, gain, b0"),
    ({"ridge": -1.0}, StructureError, "ridge=-1"),
    ({"loss": "hubr"}, StructureError, "Did you mean 'huber'"),
    ({"basis": "triangular:60"}, RankError, "rows for 123 parameters"),
    ({"basis": Triangular(6).with_interval(-1, 9)}, RankError, "never excited"),
])
def test_bad_structure_names_the_argument_and_the_remedy(change, error, words):
    refuses(error, words, optid.fit, record(count=100), **{"na": 2, "nb": 2, "basis": BASIS} | change)


def test_a_zero_input_channel_has_a_gauge():
    silent = plant(gain=0.0)
    fit = optid.fit(record(model=silent, noise=0.5), na=2, nb=2, basis=BASIS, gauge="norm")
    assert np.linalg.norm(fit.model.b[0]) == pytest.approx(1)


@pytest.mark.parametrize("solver", ["ipopt", "gauss_newton", "alternating"])
def test_the_start_has_the_sign_that_the_constraints_ask_for(solver):
    rising = record()
    falling = optid.Data(u=rising.u, y=-rising.y)
    up, down = (optid.fit(data, na=2, nb=2, basis=BASIS, constraints=[shape.monotone(word)], solver=solver, prove=False)
                for data, word in ((rising, "increasing"), (falling, "decreasing")))
    assert down.solution.objective == pytest.approx(up.solution.objective, rel=1e-7)
    assert np.allclose(down.model.nonlinearities[0].mu, -up.model.nonlinearities[0].mu, atol=1e-5)
