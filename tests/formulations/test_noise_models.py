"""ARMAX and Box-Jenkins fits: other optimisers, known systems, constraints, gaps, experiments, efficiency, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from sample_fits import quiet
from scipy.optimize import least_squares
from scipy.signal import lfilter

import optid
from formulations.constraints import poles, shape
from formulations.prediction_error import armax as linear_armax
from formulations.prediction_error import bj as linear_bj
from formulations.prediction_error import hammerstein_armax as armax
from formulations.prediction_error import hammerstein_bj as bj
from optid.bases import Linear, Polynomial, Triangular
from optid.data.record import Data
from optid.errors import InfeasibleError, OptidError, RankError, StructureError
from optid.identify.prediction_error.search import arma
from optid.models import HammersteinTF, Nonlinearity, roots
from optid.program.solution import Status

BASIS = Triangular(4).with_interval(-1.0, 1.0)
MU = np.array([-0.9, -0.35, 0.5, 0.75])
A, B, C, D = np.array([-1.2, 0.5]), np.array([1.0, 0.6]), np.array([-0.6, 0.2]), np.array([-0.7])


def system(kind, a=A, b=B, mu=MU, c=C, d=D):
    plant = HammersteinTF(a, (b / np.linalg.norm(b),), (Nonlinearity(BASIS, mu * np.linalg.norm(b)),), (1,), 0.3)
    return replace(plant, c=c, d=None if kind == "armax" else d)


def record(model, counts=(400,), noise=0.3, seed=0, gaps=0.0):
    rng = np.random.default_rng(seed)
    us, ys = [], []
    for count in counts:
        u = rng.uniform(-1, 1, count)
        e = noise * rng.standard_normal(count + 200)
        v = lfilter(np.r_[1, model.c], np.r_[1, model.noise_denominator], e)[200:]
        y = model.simulate(u, rng.normal(size=model.largest_lag)) + v
        if gaps:
            y[rng.uniform(size=count) < gaps] = np.nan
        us.append(u)
        ys.append(y)
    return Data(us, ys)


ORDERS = {"armax": (armax, {"na": 2, "nb": 2, "nk": 1, "nc": 2, "basis": BASIS}),
          "bj": (bj, {"na": 2, "nb": 2, "nk": 1, "nc": 2, "nd": 1, "basis": BASIS})}


@pytest.mark.parametrize("kind", ORDERS)
def test_optimum_is_that_of_another_optimiser(kind):
    """The innovations written out once more, minimised by scipy from the same start."""
    data = record(system(kind))
    pose, orders = ORDERS[kind]
    fit = optid.fit(data, pose, **orders)
    assert fit.solution.status is Status.LOCAL
    u, y = data.u[:, 0], data.y[:, 0]
    eta = BASIS.values(u)

    def innovations(theta):
        a, b, mu, offset, c = theta[:2], theta[2:4], theta[4:8], theta[8], theta[9:11]
        f = np.concatenate([[0.0], eta @ mu])[:-1]
        right = offset + np.convolve(f, b)[: len(u)]
        if kind == "armax":
            return lfilter([1.0], np.r_[1, c], np.convolve(y, np.r_[1, a])[2 : len(u)] - right[2:])
        right[:2] += theta[12:]
        return lfilter([1.0, theta[11]], np.r_[1, c], y - lfilter([1.0], np.r_[1, a], right))

    model = fit.model
    start = np.concatenate([model.a, model.b[0], model.nonlinearities[0].mu, model.offset, model.c])
    if kind == "bj":
        start = np.concatenate([start, model.d, fit.values["x0"]])
    assert np.sum(innovations(start) ** 2) == pytest.approx(fit.solution.objective, rel=1e-10)
    theirs = least_squares(innovations, start * 1.02, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert 2 * theirs.cost == pytest.approx(fit.solution.objective, rel=1e-8)
    # and the model predicts with these innovations
    assert np.nansum(model.innovations(data) ** 2) == pytest.approx(fit.solution.objective, rel=1e-6)


@pytest.mark.parametrize("kind", ORDERS)
def test_truth_without_noise(kind):
    model = system(kind)
    data = record(model, (300, 200), noise=0.0)
    pose, orders = ORDERS[kind]
    found = quiet(data, pose, **orders).model
    assert found.a == pytest.approx(A, abs=1e-6) and found.theta() == pytest.approx(model.theta(), abs=1e-6)


@pytest.mark.parametrize("kind", ORDERS)
@pytest.mark.parametrize("counts, seed, gaps, of_a, of_theta", [((6000, 9000), 3, 0.05, 0.02, 0.06),
                                                                ((40_000,), 4, 0.33, 0.008, 0.03)])
def test_truth_with_noise_several_experiments_and_gaps(kind, counts, seed, gaps, of_a, of_theta):
    model = system(kind)
    pose, orders = ORDERS[kind]
    fit = optid.fit(record(model, counts, seed=seed, gaps=gaps), pose, **orders)
    found = fit.model
    assert found.structure == kind
    assert found.a == pytest.approx(A, abs=of_a) and found.c == pytest.approx(C, abs=0.06)
    assert found.theta() == pytest.approx(model.theta(), abs=of_theta)
    if kind == "bj":
        assert found.d == pytest.approx(D, abs=0.06)
    assert gaps > 0.1 or fit.solution.objective / fit.figures["rows"] == pytest.approx(0.09, rel=0.06)


@pytest.mark.parametrize("kind, pose, own, other, structure", [
    ("armax", armax, {"nc": 0}, "hammerstein_arx.exact", "arx"),
    ("bj", bj, {"nc": 0, "nd": 0}, "hammerstein_oe.exact", "oe")])
def test_without_a_noise_filter_it_is_the_arx_or_the_output_error_fit(kind, pose, own, other, structure):
    data = record(system(kind, c=[], d=[]), (300, 200), gaps=0.1 if structure == "oe" else 0.0)
    orders = {"na": 2, "nb": 2, "nk": 1, "basis": BASIS}
    ours, theirs = optid.fit(data, pose, **own, **orders), optid.fit(data, other, **orders)
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=1e-9)
    assert ours.model.a == pytest.approx(theirs.model.a, abs=1e-6) and ours.model.structure == structure


def test_linear_models():
    plant = HammersteinTF(A, (B,), (Nonlinearity(Linear(), [1.0]),), (1,), 0.3)
    for pose, model, orders in ((linear_armax, replace(plant, c=C), {"nc": 2}),
                                (linear_bj, replace(plant, c=C, d=D), {"nc": 2, "nd": 1})):
        fit = optid.fit(record(model, (8000,)), pose, na=2, nb=2, nk=1, **orders)
        assert fit.model.b[0] == pytest.approx(B, abs=0.03) and fit.model.nonlinearities[0].mu == pytest.approx([1.0])
        assert fit.model.c == pytest.approx(C, abs=0.06) and "Linear" in fit.model.title


@pytest.mark.slow
def test_two_inputs_and_one_common_noise():
    functions = Nonlinearity(BASIS, MU), Nonlinearity(Polynomial(2).with_interval(-1.0, 1.0), [0.8, 0.3])
    plant = HammersteinTF(A, (B / np.linalg.norm(B), [1.0]), functions, (0, 2), 0.1)
    model, rng = replace(plant, c=C), np.random.default_rng(0)
    u = rng.uniform(-1, 1, (5000, 2))
    y = model.simulate(u) + lfilter(np.r_[1, C], np.r_[1, A], 0.2 * rng.standard_normal(5000))[:, None]
    fit = optid.fit(Data(u, y), armax, na=2, nb=[2, 1], nk=[0, 2], nc=2, basis=[BASIS, functions[1].basis])
    for c in (0, 1):
        assert fit.model.theta(c) == pytest.approx(plant.theta(c), abs=0.04)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ORDERS)
def test_constraints_hold_and_the_optimum_is_that_of_a_penalty_free_search(kind):
    data = record(system(kind, mu=np.array([-0.2, -0.5, 0.5, 0.4])), (300,), seed=2)
    pose, orders = ORDERS[kind]
    rules = [shape.monotone("increasing"), lambda v: {"first zero": v["c"][0] >= -0.5}]
    free = optid.fit(data, pose, **orders)
    fit = optid.fit(data, pose, constraints=rules, **orders)
    assert fit.solution.status is Status.LOCAL
    f = fit.model.nonlinearities[0](np.linspace(-1, 1, 201))
    assert np.all(np.diff(f) >= -1e-7) and fit.model.c[0] >= -0.5 - 1e-7
    assert fit.solution.objective > free.solution.objective
    # no feasible point nearby is better
    rng = np.random.default_rng(0)
    model = fit.model
    for _ in range(40):
        size = 10.0 ** rng.uniform(-4, -1.5)
        mu = model.nonlinearities[0].mu + size * rng.normal(size=4)
        values = Nonlinearity(BASIS, mu)(np.linspace(-1, 1, 5))
        c = model.c + size * rng.normal(size=2)
        if np.any(np.diff(values) < 0) or c[0] < -0.5 or roots.radius(c) >= 1:
            continue
        a = model.a + size * rng.normal(size=2)
        plant = HammersteinTF(a, model.b, (Nonlinearity(BASIS, mu),), (1,), model.offset + size * rng.normal())
        other = replace(plant, c=c, d=model.d)
        assert np.nansum(other.innovations(data) ** 2) >= fit.solution.objective * (1 - 1e-7)


def test_stability_of_a_constrained_armax_plant():
    model = system("armax", a=np.array([-1.85, 0.87]))
    data = record(model, (300,), noise=0.5)
    fit = optid.fit(data, armax, constraints=[poles.stable(0.85)], **ORDERS["armax"][1])
    assert np.max(np.abs(fit.model.poles)) <= 0.85 + 1e-6
    assert fit.solution.status is Status.LOCAL and fit.prices[0].active


@pytest.mark.parametrize("gauge", ["norm", "gain", "b0"])
def test_gauges_describe_the_same_model(gauge):
    data, orders = record(system("bj"), (300,)), ORDERS["bj"][1]
    fit, reference = optid.fit(data, bj, gauge=gauge, **orders), optid.fit(data, bj, **orders)
    assert fit.model.gauge == gauge
    assert fit.model.theta() == pytest.approx(reference.model.theta(), rel=1e-4, abs=1e-5)
    assert fit.solution.objective == pytest.approx(reference.solution.objective, rel=1e-8)


@pytest.mark.slow
def test_gaps_cost_no_more_than_their_samples():
    """The estimate on a record with gaps stays near the one without, and its variance within that of the rows left."""
    truth, whole, gapped = system("armax"), [], []
    for seed in range(12):
        data = record(truth, (1500,), seed=seed)
        y = data.y.copy()
        y[np.random.default_rng(seed).uniform(size=1500) < 0.2] = np.nan
        for found, one in ((whole, data), (gapped, Data(data.u, y))):
            model = optid.fit(one, armax, starts=1, **ORDERS["armax"][1]).model
            found.append(np.concatenate([model.a, model.c]) - np.concatenate([A, C]))
    spread = np.sqrt(np.mean(np.square(gapped)) / np.mean(np.square(whole)))
    assert spread < 2.0
    bias = np.abs(np.mean(gapped, axis=0)) / (np.std(gapped, axis=0) / np.sqrt(12))
    assert np.all(bias < 4.0)


def test_outputs_that_never_follow_one_another():
    data = record(system("armax"), (3000,))
    y = data.y.copy()
    y[::2] = np.nan
    fit = optid.fit(Data(data.u, y), armax, **ORDERS["armax"][1])
    assert fit.model.a == pytest.approx(A, abs=0.02) and fit.figures["rows"] == 1500 - 10
    # outputs before the first one are at the level of the record in the fit, at zero in the model
    assert np.nansum(fit.model.innovations(Data(data.u, y)) ** 2) == pytest.approx(fit.solution.objective, rel=1e-5)


def test_unstable_plant_in_a_loop():
    """Prediction errors do not need a stable plant, nor an input independent of the noise."""
    rng, a, count = np.random.default_rng(0), np.poly([1.1, 0.6])[1:], 3000
    e, r = 0.1 * rng.standard_normal(count), rng.uniform(-0.8, 0.8, count)
    u, y = np.zeros(count), np.zeros(count)
    for k in range(count):
        y[k] = e[k] - (a @ [y[k - 1], y[k - 2]] - u[k - 1] - 0.03 * u[k - 1] ** 3 + 0.5 * e[k - 1] if k > 1 else 0.0)
        u[k] = r[k] - 0.6 * y[k]
    fit = quiet(Data(u, y), armax, na=2, nb=1, nk=1, nc=1, basis=Polynomial(3))
    assert fit.model.a == pytest.approx(a, abs=0.02) and fit.model.c == pytest.approx([-0.5], abs=0.05)
    assert not fit.model.is_stable and fit.solution.status is Status.LOCAL


def test_missing_inputs():
    data = record(system("armax"), (4000,))
    u = data.u.copy()
    u[[100, 700, 701, 2500]] = np.nan
    fit = optid.fit(Data(u, data.y), armax, **ORDERS["armax"][1])
    reference = optid.fit(data, armax, **ORDERS["armax"][1])
    assert fit.model.theta() == pytest.approx(reference.model.theta(), abs=0.03)
    assert fit.figures["rows"] == 4000 - 2 - 7


@pytest.mark.slow
def test_efficiency():
    """The mean of the squared errors is that of the Cramer-Rao bound (60 short records)."""
    truth = system("armax", b=np.array([1.0]), mu=np.array([-1.0, -0.5, 0.5, 1.0]), c=np.array([-0.5]))
    errors, bounds = [], []
    theta = np.concatenate([truth.a, truth.c])
    for seed in range(60):
        data = record(truth, (800,), seed=seed, noise=0.2)
        fit = optid.fit(data, armax, na=2, nb=1, nk=1, nc=1, basis=BASIS, starts=1)
        errors.append(np.concatenate([fit.model.a, fit.model.c]) - theta)
        e, u = data.y[:, 0], BASIS.values(data.u[:, 0])
        noise = truth.innovations(data)[:, 0]
        columns = [-np.r_[np.zeros(i), e[:-i]] for i in (1, 2)] + [np.r_[0, np.nan_to_num(noise)[:-1]]]
        columns += [*np.vstack([np.zeros(4), u[:-1]]).T, np.ones(800)]
        slopes = lfilter([1.0], [1, -0.5], np.array(columns)[:, 2:])
        bounds.append(np.diag(0.04 * np.linalg.inv(slopes @ slopes.T))[:3])
    ratio = np.mean(np.square(errors), axis=0) / np.mean(bounds, axis=0)
    assert np.all((ratio > 0.5) & (ratio < 1.6)), ratio


def test_arma_of_a_signal():
    rng = np.random.default_rng(1)
    signals = [lfilter(np.r_[1, C], np.r_[1, D], rng.standard_normal(n)) for n in (8000, 6000)]
    signals[0][rng.uniform(size=8000) < 0.01] = np.nan
    c, d = arma(signals, 2, 1)
    assert c == pytest.approx(C, abs=0.1) and d == pytest.approx(D, abs=0.06)
    assert arma(signals, 0, 0)[0].size == 0 and arma(signals, 0, 2)[1].size == 2
    assert np.all(arma([np.zeros(50)], 1, 1)[0] == 0)
    assert roots.radius(roots.contain_roots(np.array([-3.0, 0.5, 0.0]), 0.98)) <= 0.98 + 1e-12


def test_results_by_name():
    data = record(system("armax"), (200,))
    for name, orders in (("armax.exact", {"nc": 1}), ("bj.exact", {"nc": 1, "nd": 1}),
                         ("hammerstein_armax.exact", {"nc": 1, "basis": BASIS}),
                         ("hammerstein_bj.exact", {"nc": 1, "nd": 1, "basis": BASIS})):
        fit = quiet(data, name, na=1, nb=2, nk=1, **orders)
        assert isinstance(fit.model, HammersteinTF)
        assert "starts converge to it" in fit.figures["starts"] and not fit.solution.bound.proved
        assert "prediction errors are not convex" in fit.solution.reason
        assert fit.model.title in str(fit)


@pytest.mark.parametrize(("changes", "error", "words"), [
    ({"nc": -1}, StructureError, "nc must be a nonnegative integer"),
    ({"nc": 1.5}, StructureError, "nc must be a nonnegative integer; got 1.5"),
    ({"na": True}, StructureError, "na"),
    ({"nb": 0}, StructureError, "nb of input 'u'"),
    ({"starts": 0}, StructureError, "starts"),
    ({"gauge": "none"}, StructureError, "gauge='none': use one of norm, gain, b0"),
    ({"na": 60, "nb": 60}, RankError, "rows|samples")])
def test_structure_that_will_not_do(changes, error, words):
    data = record(system("armax"), (120,))
    for pose, orders in ORDERS.values():
        refuses(error, words, quiet, data, pose, **orders | changes)


@pytest.mark.slow
def test_orders_of_the_noise_beyond_the_record():
    data = record(system("armax"), (40,))
    refuses(RankError, "prediction errors for", quiet, data, armax, **ORDERS["armax"][1] | {"nc": 30})
    refuses(RankError, "prediction errors for", quiet, data, bj, **ORDERS["bj"][1] | {"nd": 30})


@pytest.mark.parametrize("kind", ORDERS)
def test_records_that_will_not_do(kind):
    pose, orders = ORDERS[kind]
    data = record(system(kind), (200,))
    refuses(StructureError, "one output", quiet, Data(data.u, np.hstack([data.y, data.y**2])), pose, **orders)
    refuses(OptidError, "'y'", lambda: quiet(Data(data.u, np.full((200, 1), np.nan)), pose, **orders))
    refuses(OptidError, "'u'", quiet, Data(np.full(200, 0.5), data.y), pose, **orders)
    with pytest.raises(RankError, match=r"u2\(k-1\)\) of the regressor depends on triangular1\(u1\(k-1\)"):
        quiet(Data(np.hstack([data.u, data.u]), data.y), pose, **orders)
    with pytest.raises(InfeasibleError):
        quiet(data, pose, constraints=[lambda v: {"up": v["a"][0] >= 1, "down": v["a"][0] <= -1}], **orders)


def test_noise_with_a_zero_on_the_unit_circle():
    """Over-differenced noise: the optimum lies on the edge of what can be inverted; every iterate stays inside."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 500)
    y = system("armax").simulate(u) + lfilter([1, -1.0], np.r_[1, A], 0.2 * rng.standard_normal(500))
    fit = quiet(Data(u, y), armax, na=2, nb=2, nk=1, nc=1, basis=BASIS, raises=False)
    assert roots.radius(fit.model.c) < 1 and fit.model.c[0] == pytest.approx(-1.0, abs=0.02)


def test_without_poles():
    u = np.random.default_rng(0).uniform(-1, 1, 2000)
    plant = HammersteinTF([], (B,), (Nonlinearity(BASIS, MU),), (1,), 0.3)
    y = plant.simulate(u) + lfilter([1, -0.5], [1], 0.2 * np.random.default_rng(1).standard_normal(2000))
    for pose, orders in ((armax, {"nc": 1}), (bj, {"nc": 1, "nd": 0})):
        model = optid.fit(Data(u, y), pose, na=0, nb=2, nk=1, basis=BASIS, **orders).model
        assert model.theta() == pytest.approx(plant.theta(), abs=0.03) and model.c == pytest.approx([-0.5], abs=0.06)


def test_a_plant_without_lags_predicts_by_its_noise_alone():
    rng = np.random.default_rng(4)
    u, v = rng.uniform(-1, 1, 200), lfilter([1.0, 0.5], [1.0, -0.8], 0.1 * rng.standard_normal(200))
    fit = quiet(Data(u, 2 * u + v), "bj.exact", na=0, nb=1, nk=0, nc=1, nd=1)
    model = fit.model
    assert model.largest_lag == 0 and "The model on this record" in str(fit)
    errors = lfilter(np.r_[1, model.d], np.r_[1, model.c], fit.data.y[:, 0] - model.simulate(fit.data)[:, 0])
    assert model.predict(fit.data)[20:, 0] == pytest.approx((fit.data.y[:, 0] - errors)[20:], abs=1e-6)


def test_gas_furnace_of_box_and_jenkins(real_data):
    """The transfer-function model of their book (1976, section 11.4), within its standard errors.

    y = -(0.53 + 0.37 B + 0.51 B^2) / (1 - 0.57 B) x(t-3) + a / (1 - 1.53 B + 0.63 B^2), variance of a 0.0561.
    """
    data = optid.read(real_data / "boxjenkins_gas_furnace.csv", inputs=["u"], outputs=["y"], dt=9.0)
    fit = optid.fit(data, "bj.exact", na=1, nb=3, nk=3, nc=0, nd=2)
    estimates = {name: (value, error) for name, value, error, *_ in fit.uncertainty.table()}
    for name, published in (("a1", -0.57), ("b0", -0.53), ("b1", -0.37), ("b2", -0.51), ("d1", -1.53), ("d2", 0.63)):
        value, error = estimates[name]
        assert abs(value - published) < error
    assert fit.solution.objective / 296 == pytest.approx(0.0561, abs=0.0005)


@pytest.mark.parametrize("kind", ORDERS)
def test_long_records_are_searched_in_part_unless_that_part_is_missing(kind):
    data = record(system(kind), (12_000,))
    pose, orders = ORDERS[kind]
    y = data.y.copy()
    y[3_000:9_000] = np.nan
    for one, error in ((data, 0.05), (Data(data.u, y), 0.1)):
        fit = quiet(one, pose, **orders)
        assert fit.model.a == pytest.approx(A, abs=error) and fit.model.c == pytest.approx(C, abs=error)


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore:clarabel stopped")  # the best zero of C lies on the unit circle, where no step ends
@pytest.mark.parametrize(("form", "seed", "gain"), [
    ("bj.exact", 0, -2.4), ("armax.exact", 0, -2.0), ("armax.exact", 4, -3.0), ("bj.exact", 1, -2.5),
    ("bj.exact", 2, -2.4), ("bj.exact", 3, -3.0)])
def test_a_gain_is_kept_where_a_zero_of_c_comes_to_the_unit_circle(form, seed, gain):
    rng, u, y = np.random.default_rng(seed), np.repeat([0.0, 1, 0, 1, 1, 0], 20), np.zeros(120)
    for k in range(4, 120):
        y[k] = 0.93 * y[k - 1] - 0.175 * u[k - 4]
    data = optid.Data(u, y + 0.15 * rng.standard_normal(120), dt=2.0)
    orders = {"na": 1, "nb": 1, "nk": 4, "nc": 1, **({"nd": 1} if form == "bj.exact" else {})}
    model = optid.fit(data, form, **orders, constraints=[f"gain:{gain}"]).model
    assert model.frequency_response(np.array([1e-9])).real.item() == pytest.approx(gain, abs=1e-9)


@pytest.mark.parametrize("solver", ["clarabel", "osqp", "piqp"])
def test_back_ends_agree(solver):
    if solver not in [name for name, end in optid.backends.back_ends().items() if end.installed]:
        pytest.skip(f"{solver} is not installed")
    data, orders = record(system("armax"), (300,)), ORDERS["armax"][1]
    reference = optid.fit(data, armax, **orders).solution.objective
    assert quiet(data, armax, solver=solver, **orders).solution.objective == pytest.approx(reference, rel=1e-6)
