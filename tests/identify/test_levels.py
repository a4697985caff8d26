"""Levels of experiments: one constant of the equation for each, against dummy variables and brute force."""

import json

import numpy as np
import pytest
from refusals import refuses
from scipy.optimize import least_squares
from scipy.signal import lfilter

import optid
from formulations.constraints import shape
from optid import Data
from optid.errors import DataError, RankError, StructureError
from optid.identify.levels import level_evidence
from optid.identify.prediction_error.transfer_errors import TransferOrders, transfer_errors
from optid.program.solution import Status


def record(seed=0, experiments=6, samples=80, spread=2.0, noise=0.02, f=lambda u: u):
    """Return a first-order plant of gain 2 with a sensor zero in every experiment, and the zeros."""
    rng = np.random.default_rng(seed)
    zeros, us, ys = rng.normal(0, spread, experiments), [], []
    for i, zero in enumerate(zeros):
        u = np.repeat(rng.uniform(-1, 1, samples), 8)[: samples + 7 * i]
        us.append(u)
        ys.append(3 + zero + lfilter([0, 0, 0.2], [1, -0.9], f(u)) + noise * rng.standard_normal(len(u)))
    return Data(us, ys), zeros


def dummies(data, na, nb, nk):
    """Return coefficients, constants, residual energy and covariance of ARX with a dummy variable per experiment."""
    rows, targets, at = [], [], max(na, nk + nb - 1)
    for i, e in enumerate(data.experiments):
        one = np.zeros(data.n_experiments)
        one[i] = 1.0
        for k in range(at, e.n_samples):
            past = [-e.y[k - j, 0] for j in range(1, na + 1)]
            row = np.concatenate([past, *(e.u[k - nk - np.arange(nb), c] for c in range(data.m)), one])
            if np.isfinite(row).all() and np.isfinite(e.y[k, 0]):
                rows.append(row)
                targets.append(e.y[k, 0])
    phi, y = np.array(rows), np.array(targets)
    theta = np.linalg.lstsq(phi, y)[0]
    rest = y - phi @ theta
    covariance = np.linalg.inv(phi.T @ phi) * (rest @ rest) / (len(y) - len(theta))
    n = len(theta) - data.n_experiments
    return theta[:n], theta[n:], float(rest @ rest), covariance


@pytest.mark.parametrize("seed", range(4))
def test_arx_with_levels_is_least_squares_with_dummy_variables(seed):
    rng = np.random.default_rng(seed)
    us, ys = [], []
    for i in range(5):
        u = rng.standard_normal((60 + 13 * i, 2))
        y = 1e3 * rng.standard_normal() + lfilter([0, 0.5], [1, -0.7], u[:, 0]) + lfilter([0, 1], [1, -0.2], u[:, 1])
        us.append(u)
        ys.append(y + 0.3 * rng.standard_normal(len(u)))
        ys[-1][rng.integers(len(u), size=4)] = np.nan
    data, na, nb = Data(us, ys), 1 + seed % 3, 1 + seed % 2
    theta, levels, energy, covariance = dummies(data, na, nb, 1)
    fit = optid.fit(data, "arx", na=na, nb=nb, nk=1, offset="each")
    found = np.concatenate([fit.model.a, *fit.model.b])
    assert found == pytest.approx(theta, rel=1e-6, abs=1e-8) and fit.solution.status is Status.OPTIMAL
    assert fit.model.levels[:, 0] == pytest.approx(levels, rel=1e-6)
    assert fit.model.offset == pytest.approx(levels.mean(), abs=1e-6 * np.abs(levels).max())
    assert fit.solution.objective == pytest.approx(energy, rel=1e-6)
    errors = np.concatenate([fit.uncertainty.a.error, *(b.error for b in fit.uncertainty.b)])
    n = len(theta)
    assert errors == pytest.approx(np.sqrt(np.diag(covariance)[:n]), rel=1e-4)
    mean = np.concatenate([np.zeros(n), np.full(5, 0.2)])
    assert fit.uncertainty.offset.error == pytest.approx(np.sqrt(mean @ covariance @ mean), rel=1e-4)


def test_several_outputs_have_levels_each():
    rng = np.random.default_rng(1)
    us = [rng.standard_normal((90, 1)) for _ in range(3)]
    ys = [np.column_stack([lfilter([0, 1], [1, -0.5], u[:, 0]), lfilter([0, 0, 2], [1, -0.8], u[:, 0])])
          + rng.normal(0, 50, 2) + 0.1 * rng.standard_normal((90, 2)) for u in us]
    data = Data(us, ys)
    model = optid.fit(data, "arx", na=1, nb=2, nk=1, offset="each").model
    at = slice(2, None)
    phi = np.vstack([np.column_stack([-y[1:-1], u[1:-1], u[:-2], np.tile(np.eye(3)[i], (88, 1))])
                     for i, (u, y) in enumerate(zip(us, ys))])
    theta = np.linalg.lstsq(phi, np.vstack([y[at] for y in ys]))[0]
    assert model.a[0].T == pytest.approx(theta[:2], abs=1e-6) and model.b[0] == pytest.approx(theta[2:4], abs=1e-6)
    assert model.levels == pytest.approx(theta[4:], rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("name", ["arx", "armax.exact", "oe.exact", "ss.exact", "hammerstein_arx.exact",
                                  "hammerstein_oe.exact", "hammerstein_ss.exact"])
def test_zeros_of_sensors_leave_the_gain_alone(name):
    def f(u):
        return u + 0.5 * u**2

    data, zeros = record(noise=0.005, f=f if "hammerstein" in name else lambda u: u)
    orders = {"nx": 2} if "ss" in name else {"na": 1, "nb": 1, "nk": 2} | ({"nc": 1} if "armax" in name else {})
    basis = {"basis": "polynomial:2"} if "hammerstein" in name else {}
    fit = optid.fit(data, name, offset="each", **orders, **basis)
    gain = fit.model.static_gain(0.3)
    assert gain == pytest.approx(2 * (1.3 if basis else 1.0), rel=0.01)
    scale = 1.0 if "ss" in name else 1 + fit.model.a.sum()
    levels = fit.model.levels[:, 0] / scale
    assert levels - levels.mean() == pytest.approx(zeros - zeros.mean(), abs=0.03)
    runs = fit.model.simulate(data, x0="fit")
    assert max(float(np.std(e.y - run)) for e, run in zip(data.experiments, runs)) < 0.03


def test_hammerstein_arx_with_levels_is_proved_and_stationary():
    data, _ = record(1, f=lambda u: u + 0.4 * u**2, noise=0.1)
    fit = optid.fit(data, "hammerstein_arx.exact", na=1, nb=2, nk=2, basis="polynomial:2", offset="each")
    model = fit.model
    assert fit.solution.status is Status.OPTIMAL and fit.solution.bound.proved

    def through(f):  # least squares in a, b and the constants with f held
        return dummies(Data([f(e.u[:, 0]) for e in data.experiments], [e.y for e in data.experiments]), 1, 2, 2)

    theta, levels, energy, _ = through(model.f)
    assert energy == pytest.approx(fit.solution.objective, rel=1e-6)
    assert theta == pytest.approx(np.concatenate([model.a, model.b[0]]), abs=1e-5)
    worse = optid.Nonlinearity(model.f.basis, model.f.mu * [1.0, 1.05])
    assert through(worse)[2] > energy


def simulated_errors(data, a, b, states, levels):
    return [e.y[:, 0] - lfilter([0.0, b], [1.0, a], e.u[:, 0]) - x * (-a) ** np.arange(e.n_samples) - level
            for e, x, level in zip(data.experiments, states, levels)]


@pytest.mark.parametrize("name", ["oe.exact", "ss.exact"])
def test_simulation_errors_with_levels_are_those_of_brute_force(name):
    rng = np.random.default_rng(3)
    us = [rng.uniform(-1, 1, 50 + 9 * i) for i in range(4)]
    data = Data(us, [rng.normal(0, 20) + lfilter([0, 0.5], [1, -0.8], u) + 0.2 * rng.standard_normal(len(u))
                     for u in us])
    count = data.n_experiments

    def errors(x):
        return np.concatenate(simulated_errors(data, x[0], x[1], x[2 : 2 + count], x[2 + count :]))

    means = [float(e.y.mean()) for e in data.experiments]
    best = least_squares(errors, np.concatenate([[-0.8, 0.5], np.zeros(count), means]), xtol=1e-14, ftol=1e-14)
    orders = {"na": 1, "nb": 1, "nk": 1} if name == "oe.exact" else {"nx": 1, "feedthrough": False}
    fit = optid.fit(data, name, offset="each", **orders)
    runs = fit.model.simulate(data, x0="fit")
    energy = sum(float(np.sum((e.y - run) ** 2)) for e, run in zip(data.experiments, runs))
    assert energy == pytest.approx(2 * best.cost, rel=1e-7)
    assert fit.model.poles[0].real == pytest.approx(-best.x[0], abs=1e-5)
    scale = 1 + best.x[0] if name == "oe.exact" else 1.0
    levels = scale * best.x[2 + count :]  # a constant of the state equation may hold a part of them all
    rest = float(np.mean(levels - fit.model.levels[:, 0])) * (name == "ss.exact")
    assert fit.model.levels[:, 0] + rest == pytest.approx(levels, rel=1e-4)
    jacobian = np.linalg.inv(best.jac.T @ best.jac)
    gain = np.concatenate([[-best.x[1] / (1 + best.x[0]) ** 2, 1 / (1 + best.x[0])], np.zeros(2 * count)])
    error = np.sqrt(gain @ jacobian @ gain * 2 * best.cost / (data.n_samples - best.x.size))
    found = fit.uncertainty.of(lambda model: model.static_gain(0.0)).error
    assert found == pytest.approx(error, rel=1e-3 if name == "oe.exact" else 0.3)  # those of ss see coloured errors


def test_armax_with_levels_is_brute_force():
    data, _ = record(2, experiments=3, samples=60, noise=0.3)

    def errors(x):
        found = []
        for e, level in zip(data.experiments, x[3:]):
            y, u, own = e.y[:, 0], e.u[:, 0], np.zeros(e.n_samples)
            for k in range(2, e.n_samples):
                own[k] = y[k] + x[0] * y[k - 1] - x[1] * u[k - 2] - level - x[2] * own[k - 1]
            found.append(own)
        return np.concatenate(found)

    fit = optid.fit(data, "armax.exact", na=1, nb=1, nk=2, nc=1, offset="each")
    model = fit.model
    start = np.concatenate([model.a, model.b[0], model.c, model.levels[:, 0]])
    best = least_squares(errors, start + 0.02, xtol=1e-14, ftol=1e-14)
    assert start == pytest.approx(best.x, abs=1e-4) and fit.solution.objective == pytest.approx(2 * best.cost, rel=1e-7)


@pytest.mark.parametrize(("nc", "nd"), [(0, 0), (1, 1), (1, None)])
def test_sensitivities_to_levels_are_those_of_finite_differences(nc, nd):
    data, _ = record(4, experiments=3, samples=40)
    criterion = transfer_errors(data, TransferOrders(1, 2, 1, nc, nd), "linear", None, "each")
    rng = np.random.default_rng(5)
    x = 0.1 * rng.standard_normal(criterion.unknowns.size)
    x[criterion.unknowns.slices["a"]] = -0.7
    at = criterion.linearise(x, "qr")
    matrix, rest = at.whole
    step = 1e-5
    for j in range(x.size):
        moved = [criterion.value(x + sign * step * np.eye(x.size)[j]) for sign in (1, -1)]
        assert (moved[0] - moved[1]) / (2 * step) == pytest.approx(2 * matrix[:, j] @ rest, rel=1e-5, abs=1e-7)


def test_one_experiment_has_one_constant():
    data = record()[0].select(experiments=0)
    for name in ("arx", "oe.exact"):
        one, each = (optid.fit(data, name, na=1, nb=1, nk=2, offset=offset) for offset in (True, "each"))
        assert each.model.levels is None and each.model.a == pytest.approx(one.model.a, abs=1e-12)


def test_units_and_transforms_change_nothing():
    data, _ = record(5)
    for name in ("arx", "oe.exact", "ss.exact"):
        orders = {"nx": 1, "feedthrough": False} if name == "ss.exact" else {"na": 1, "nb": 1, "nk": 2}
        plain, other = (optid.fit(one, name, offset="each", **orders).model for one in (data, data.detrend().scale()))
        assert other.levels == pytest.approx(plain.levels, rel=1e-4, abs=1e-5)
        assert other.static_gain(0.0) == pytest.approx(plain.static_gain(0.0), rel=1e-4)
        big = Data([e.u for e in data.experiments], [1e6 * e.y - 1e9 for e in data.experiments])
        assert optid.fit(big, name, offset="each", **orders).model.static_gain(0.0) == pytest.approx(
            1e6 * plain.static_gain(0.0), rel=1e-4)


@pytest.mark.parametrize(("name", "orders"), [
    ("arx", {"na": 1, "nb": 1, "nk": 2}), ("oe.exact", {"na": 1, "nb": 1, "nk": 2}),
    ("armax.exact", {"na": 1, "nb": 1, "nk": 2, "nc": 1}), ("ss.exact", {"nx": 2}),
    ("ss.exact", {"nx": 2, "criterion": "prediction"})])
def test_a_new_record_has_a_level_of_its_own(name, orders, tmp_path):
    data, _ = record(6, noise=0.05)
    with np.errstate(all="ignore"):
        model = optid.fit(data, name, offset="each", raises=False, **orders).model
    new = record(7, experiments=1)[0]
    shifted = Data(new.u, new.y + 1000.0)
    near, far = model.simulate(new, x0="fit"), model.simulate(shifted, x0="fit")
    assert far == pytest.approx(near + 1000.0, abs=1e-6) and np.std(new.y - near) < 0.1
    near, far = model.predict(new), model.predict(shifted)
    assert far == pytest.approx(near + 1000.0, abs=1e-6, nan_ok=True) and np.nanstd(new.y - near) < 0.1
    mean = model.at_level(model.offset_y if name == "ss.exact" else model.offset)
    assert mean.levels is None
    assert model.simulate(new, x0="zero") == pytest.approx(mean.simulate(new, x0="zero"))
    assert model.simulate(new.u[:, 0]) == pytest.approx(mean.simulate(new.u[:, 0]))
    state = model.initial_state(shifted)
    assert model.simulate(shifted, x0=state) == pytest.approx(model.simulate(shifted, x0="fit"), abs=1e-9)
    again = optid.load(model.save(tmp_path / "model.json"))
    assert np.array_equal(again.levels, model.levels)
    content = json.loads((tmp_path / "model.json").read_text())
    del content["levels"]  # as an older release wrote it
    (tmp_path / "old.json").write_text(json.dumps(content))
    assert optid.load(tmp_path / "old.json").levels is None
    assert "constants of the 6 experiments" in str(model)


def test_the_level_of_a_simulation_is_least_squares():
    data, _ = record(8)
    model = optid.fit(data, "oe.exact", na=1, nb=1, nk=2, offset="each").model
    e = data.experiments[2]
    lacks = np.array(e.y[:, 0])
    lacks[5:30] = np.nan
    run = model.simulate(Data(e.u, lacks), x0="fit")[:, 0]
    pole, count = -model.a[0], e.n_samples
    free = [lfilter([1.0], [1.0, -pole], np.eye(count)[i]) for i in (0, 1)]
    columns = np.column_stack([*free, lfilter([1.0], [1.0, -pole], np.ones(count))])
    bare = lfilter([0, 0, model.b[0][0]], [1.0, -pole], e.u[:, 0])
    here = np.isfinite(lacks)
    theta = np.linalg.lstsq(columns[here], (lacks - bare)[here])[0]
    assert run == pytest.approx(bare + columns @ theta, abs=1e-8)


def test_constraints_on_the_static_curve_hold_at_the_mean_of_the_levels():
    data, _ = record(9, f=lambda u: u + 0.4 * u**2)
    rule = shape.through(0.0, 3.5)
    for name in ("hammerstein_arx.exact", "hammerstein_oe.exact"):
        fit = optid.fit(data, name, na=1, nb=1, nk=2, basis="polynomial:2", offset="each", constraints=[rule])
        assert fit.model.static_curve(0, np.zeros(1)) == pytest.approx(3.5, abs=1e-5)
        assert fit.model.levels.mean() == pytest.approx(fit.model.offset, rel=1e-6)
    held = optid.fit(data, "arx", na=1, nb=1, nk=2, offset="each", constraints=[shape.fixed("offset", [0.3])])
    theta, levels, _, _ = dummies(data, 1, 1, 2)
    assert held.model.offset == pytest.approx(0.3, abs=1e-6) and abs(levels.mean() - 0.3) > 0.01
    rows = []  # stationarity in the constants: the sums of the errors of the experiments are equal
    for e, level in zip(data.experiments, held.model.levels[:, 0]):
        y, u = e.y[:, 0], e.u[:, 0]
        rows.append(np.sum(y[2:] + held.model.a[0] * y[1:-1] - held.model.b[0][0] * u[:-2] - level))
    assert np.ptp(rows) < 1e-5 * np.abs(rows).max()


def test_a_multiplier_is_the_sensitivity_of_the_objective():
    data, _ = record(10, noise=0.2)
    fits = {r: optid.fit(data, "arx", na=1, nb=1, nk=2, offset="each", constraints=[f"stable:{r}"])
            for r in (0.7, 0.699, 0.701)}
    slope = (fits[0.701].solution.objective - fits[0.699].solution.objective) / 0.002
    multiplier, = [price.multiplier for price in fits[0.7].prices]
    assert multiplier == pytest.approx(-slope, rel=1e-3)


def test_robust_losses_and_bootstrap_know_the_levels():
    data, _ = record(11, noise=0.05)
    ys = [np.array(e.y[:, 0]) for e in data.experiments]
    for y in ys:
        y[20::37] += 4.0
    dirty = Data([e.u for e in data.experiments], ys)
    for loss in ("huber", "l1"):
        with pytest.warns(optid.errors.DataWarning, match="outliers"):
            model = optid.fit(dirty, "arx", na=1, nb=1, nk=2, offset="each", loss=loss).model
        assert model.static_gain(0.0) == pytest.approx(2.0, rel=0.05)
    fit = optid.fit(data, "arx", na=1, nb=1, nk=2, offset="each")
    found = optid.bootstrap(fit, runs=40).percentile.of(lambda model: model.b[0][0])
    assert found.error == pytest.approx(fit.uncertainty.b[0].error[0], rel=0.5)


def test_stretches_between_missing_inputs_have_levels():
    data, zeros = record(12, experiments=3)
    us = [np.array(e.u[:, 0]) for e in data.experiments]
    us[1][40] = np.nan
    with pytest.warns(optid.errors.DataWarning, match="cut"):
        model = optid.fit(Data(us, [e.y for e in data.experiments]), "oe.exact", na=1, nb=1, nk=2, offset="each").model
    levels = model.levels[:, 0] / (1 + model.a.sum())
    assert levels - 3 == pytest.approx([zeros[0], zeros[1], zeros[1], zeros[2]], abs=0.02)


def test_what_has_no_levels_is_refused_by_name():
    data, _ = record(13)
    orders = {"na": 1, "nb": 1, "nk": 2}
    refuses(StructureError, "'each'.*got 'every'", optid.fit, data, "arx", offset="every", **orders)
    refuses(StructureError, "fixed", optid.fit, data, "arx", offset=False, **orders)
    refuses(StructureError, r"'ss\.exact'", optid.fit, data, "hammerstein_ss.sid", nx=1, offset="each")
    with pytest.raises(StructureError, match="feedback"):
        optid.fit(data, "hammerstein_ss.exact", nx=1, feedback_basis="polynomial:3", offset="each")
    with pytest.raises(StructureError, match=r"hammerstein_oe\.exact"):
        optid.fit(data, "hammerstein_oe.shooting", offset="each", **orders)
    ys = [np.array(e.y) for e in data.experiments]
    ys[2][:] = np.nan
    lost = Data([e.u for e in data.experiments], ys)
    for name in ("arx", "oe.exact", "armax.exact"):
        with pytest.raises(DataError, match="experiment 3 has no sample"):
            optid.fit(lost, name, offset="each", **orders, **({"nc": 1} if name == "armax.exact" else {}))
    ys[2][::2] = 1.0
    with pytest.raises(RankError, match="Experiment 3 has no complete row"):
        optid.fit(Data([e.u for e in data.experiments], ys), "arx", offset="each", **orders)
    model = optid.fit(data, "oe.exact", offset="each", **orders).model
    refuses(StructureError, "at_level", model.state, data.experiments[0].u, data.experiments[0].y)


@pytest.mark.parametrize("seed", range(6))
def test_evidence_tells_levels_from_one_level(seed):
    assert level_evidence(record(seed)[0], nk=1).offset == "each"
    same = level_evidence(record(seed, spread=0.0)[0], nk=1)
    assert same.offset is True and "share one level" in str(same)


def test_evidence_needs_several_experiments():
    refuses(StructureError, "one experiment", lambda: level_evidence(record()[0].select(experiments=0)))


@pytest.mark.parametrize("criterion", ["simulation", "prediction"])
def test_every_output_of_a_state_space_model_has_its_levels(criterion):
    rng = np.random.default_rng(14)
    us = [rng.standard_normal(120) for _ in range(4)]
    zeros = rng.normal(0, 30, (4, 2))
    ys = [np.column_stack([lfilter([0, 0.5], [1, -0.8], u), lfilter([0, 1.0], [1, -0.4], u)]) + zero
          + 0.05 * rng.standard_normal((120, 2)) for u, zero in zip(us, zeros)]
    fit = optid.fit(Data(us, ys), "ss.exact", nx=2, offset="each", criterion=criterion, feedthrough=False)
    assert np.ravel(fit.model.static_gain(0.0)) == pytest.approx([2.5, 1 / 0.6], rel=0.02)
    assert fit.model.levels - fit.model.levels.mean(axis=0) == pytest.approx(zeros - zeros.mean(axis=0), abs=0.1)


def test_an_input_that_is_constant_within_every_experiment_is_refused():
    rng = np.random.default_rng(0)
    us = [np.column_stack([rng.standard_normal(60), np.full(60, rng.normal())]) for _ in range(5)]
    ys = [lfilter([0, 1.0], [1, -0.5], u[:, 0]) + 2 * u[:, 1] + 0.1 * rng.standard_normal(60) for u in us]
    held, both = Data([u[:, 1] for u in us], ys), Data(us, ys)
    for name, more in (("arx", {}), ("oe.exact", {}), ("armax.exact", {"nc": 1})):
        for data in (held, both):
            with pytest.raises(RankError, match=r"u2?\(k-1\).*constant within every experiment"):
                optid.fit(data, name, na=1, nb=1, nk=1, offset="each", **more)
    with pytest.raises(RankError):
        optid.fit(both, "ss.exact", nx=1, offset="each")


def test_the_constants_of_the_experiments_are_printed():
    data, _ = record(experiments=14)
    fit = optid.fit(data, "arx", na=1, nb=1, nk=2, offset="each", prove=False)
    words = " ".join(str(fit).split())
    assert f"Constants of the experiments: {fit.model.levels[0, 0]:.4g}" in words
    assert "and 2 more; offset is their mean" in words
