"""The state-space model against its equations run by hand, and laws that states, gauges and units must obey."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from refusals import refuses
from state_systems import FEEDBACK_BASES, USER, by_hand, inputs, linear, with_feedback
from systems import nonlinearity

from optid.bases import Linear, Polynomial
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.models import HammersteinSS, NoiseCovariances, Nonlinearity, state_simulation
from optid.models.feedback_tables import tabulate
from optid.models.kalman import kalman_gain

MODELS = [linear(), linear(n=1, m=1, outputs=1), *(with_feedback(basis) for basis in FEEDBACK_BASES)]
X0 = np.array([0.3, -0.2, 0.1])


def state(model):
    return X0[: model.nx]


def record(model, count=120, seed=1, noise=0.05, missing=0.0, experiments=1):
    us, ys = [], []
    for e in range(experiments):
        rng = np.random.default_rng(seed + 10 * e)
        u = inputs(model, count - 17 * e, seed + e)
        y = by_hand(model, u, state(model), noise=noise * rng.normal(size=(len(u), model.l)))
        y[rng.uniform(size=y.shape) < missing] = np.nan
        us.append(u), ys.append(y)
    return Data(us if experiments > 1 else us[0], ys if experiments > 1 else ys[0], dt=model.dt,
                inputs=model.inputs, outputs=model.outputs, input_units=model.input_units)


# -- the three simulators ----------------------------------------------------------------------------------------------


@pytest.mark.sampled(6)
@pytest.mark.parametrize("model", MODELS)
def test_free_run_equals_the_equations(model):
    u = inputs(model)
    assert model.simulate(u, x0=state(model)) == pytest.approx(by_hand(model, u, state(model)), abs=1e-11)
    assert model.simulate(u) == pytest.approx(by_hand(model, u, np.zeros(model.nx)), abs=1e-11)


@pytest.mark.sampled(6)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_measured_feedback_and_prediction_equal_the_equations(model, missing):
    data = record(model, missing=missing)
    expected = by_hand(model, data.u, state(model), data.y)
    assert model.simulate_measured_feedback(data, x0=state(model)) == pytest.approx(expected, abs=1e-11)
    expected = by_hand(model, data.u, state(model), data.y, model.K)
    assert model.predict(data, x0=state(model)) == pytest.approx(expected, abs=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("model", [linear(), with_feedback(), with_feedback(USER)])
@pytest.mark.parametrize("horizon", [2, 5])
def test_several_steps_ahead_equal_a_free_run_from_the_predicted_state(model, horizon, monkeypatch):
    monkeypatch.setattr(state_simulation, "STRETCH", 23)
    data = record(model, count=60, missing=0.1)
    found = model.predict(data, horizon=horizon, x0=state(model))
    assert np.isnan(found[: horizon - 1]).all()
    for k in range(horizon - 1, 60):
        known = np.full_like(data.y, np.nan)
        known[: k - horizon + 1] = data.y[: k - horizon + 1]
        expected = by_hand(model, data.u, state(model), known, model.K)[k]
        assert found[k] == pytest.approx(expected, abs=1e-11)


def test_stretches_do_not_show(monkeypatch):
    model = with_feedback()
    data = record(model, missing=0.1, experiments=2)
    runs = [lambda: model.predict(data), lambda: model.simulate_measured_feedback(data, "fit"),
            lambda: model.simulate(data, "fit")]
    whole = [run() for run in runs]
    monkeypatch.setattr(state_simulation, "STRETCH", 13)
    for a, run in zip(whole, runs):
        for one, other in zip(a, run()):
            assert one == pytest.approx(other, abs=1e-8)


def test_without_feedback_measured_feedback_is_the_free_run():
    model = replace(linear(), K=None)
    data = record(model)
    assert model.simulate_measured_feedback(data) == pytest.approx(model.simulate(data), abs=1e-13)
    assert model.predict(data, x0="zero") == pytest.approx(model.simulate(data), abs=1e-13)


@pytest.mark.parametrize("basis", FEEDBACK_BASES)
def test_tables_equal_the_nonlinearity(basis):
    from optid.models.state_kernels import value_and_slope

    f = nonlinearity(basis, 3, (-1.0, 2.0))
    points = np.linspace(-2.5, 3.5, 1001) + 1e-7
    tables = tabulate([nonlinearity(Linear()), f])
    if not tables.compiled:
        assert basis is USER
        return
    found = [value_and_slope(tables, 1, v) for v in points]
    assert [v for v, _, _ in found] == pytest.approx(f(points), abs=1e-12)
    assert [s for _, s, _ in found] == pytest.approx(f.slope(points), abs=1e-9)


# -- initial states ----------------------------------------------------------------------------------------------------


@pytest.mark.sampled(5)
@pytest.mark.parametrize("model", [linear(), with_feedback(), with_feedback(USER)])
@pytest.mark.parametrize("simulator", ["predict", "measured_feedback", "free"])
def test_fitted_state_minimises(model, simulator):
    data = record(model, count=60, missing=0.1, noise=0.2)
    run = {"predict": model.predict, "measured_feedback": model.simulate_measured_feedback, "free": model.simulate}
    unit = np.nanstd(data.y, axis=0)
    x0 = model.initial_state(data, simulator)
    loss = lambda x: np.nansum(((data.y - run[simulator](data, x0=x)) / unit) ** 2)  # noqa: E731
    rng = np.random.default_rng(2)
    assert all(loss(x0) <= loss(x0 + 1e-3 * rng.normal(size=3)) for _ in range(20))
    assert run[simulator](data, x0="fit") == pytest.approx(run[simulator](data, x0=x0), abs=1e-12)


@pytest.mark.parametrize("simulator", ["predict", "measured_feedback"])
def test_the_state_of_a_linear_model_is_the_same_without_the_kernel(simulator, monkeypatch):
    monkeypatch.setattr(state_simulation, "STRETCH", 200)  # in several parts
    for model in (linear(), linear(n=1, m=1, outputs=1)):
        data = record(model, count=150, noise=0.2)
        found = model.initial_state(data, simulator)
        with monkeypatch.context() as patch:
            patch.setattr(state_simulation, "SHORT", 0)
            assert found == pytest.approx(model.initial_state(data, simulator), abs=1e-12)


def test_state_of_every_experiment_is_found_without_noise():
    model = with_feedback()
    data = record(model, noise=0.0, experiments=2)
    for simulator in ("predict", "measured_feedback", "free"):
        for found in model.initial_state(data, simulator):
            assert found == pytest.approx(X0, abs=1e-7)
    for y, found in zip(data.y, model.simulate(data, x0="fit")):
        assert found == pytest.approx(y, abs=1e-7)


def test_states_that_cannot_be_read():
    model, data = linear(), record(linear())
    refuses(DataError, "not finite", model.simulate, data, x0=[0, 1, np.nan])
    refuses(StructureError, "needs the outputs", model.simulate_measured_feedback, data.u)
    refuses(StructureError, "use one of predict", model.initial_state, data, "best")


def test_directions_the_record_does_not_show_are_left_alone():
    model = HammersteinSS([[0.5, 0.0], [0.0, 0.9]], [[1.0], [1.0]], [[1.0, 0.0]])
    data = Data(np.ones(30), by_hand(model, np.ones((30, 1)), [2.0, 5.0]))
    assert model.initial_state(data) == pytest.approx([2.0, 0.0], abs=1e-9)


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_missing_input_is_named():
    model, data = linear(), record(linear())
    u = data.u.copy()
    u[7, 1] = np.nan
    refuses(DataError, "'u2' is missing at sample 7", model.simulate, u)
    data = Data(u, data.y, dt=0.5)
    given, first = model.predict(data, x0=X0), Data(u[:7], data.y[:7], dt=0.5)  # the state holds up to the gap
    assert given[:7] == pytest.approx(model.predict(first, x0=X0)) and np.isnan(given[7]).all()
    assert given[8:] == pytest.approx(model.predict(data)[8:])
    u[::4] = np.nan
    refuses(DataError, "no stretch", model.predict, Data(u, data.y, dt=0.5))


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [1, 3])
def test_predictions_between_missing_inputs_are_those_of_the_stretches(horizon):
    model = linear()
    data = record(model, experiments=2)
    us = [u.copy() for u in data.u]
    us[0][[40, 43], 1] = np.nan
    lost = Data(us, list(data.y), dt=model.dt).detrend()
    found = model.predict(lost, horizon)
    parts = (slice(0, 40), slice(44, None))
    hand = model.predict(Data([data.u[0][p] for p in parts], [data.y[0][p] for p in parts], dt=model.dt), horizon)
    for part, expected in zip(parts, hand):
        assert found[0][part] == pytest.approx(expected, abs=1e-9, nan_ok=True)
    assert np.isnan(found[0][40:44]).all()
    whole = Data(data.u[1], data.y[1], dt=model.dt)
    assert found[1] == pytest.approx(model.predict(whole, horizon), abs=1e-9, nan_ok=True)


def test_diverging_free_run_is_reported_with_its_sample():
    basis = Polynomial(3, interval=(-1.0, 1.0), outside="extrapolate")
    cubic = Nonlinearity(basis, np.array([0.0, 0.0, 2.0]))
    model = HammersteinSS([[0.9]], [[1.0]], [[1.0]], E=[[1.0]], feedback=(cubic,))
    data = Data(np.full(50, 2.0), np.linspace(0, 1, 50))
    expected = by_hand_until(model, 2.0, 100 + 0.5)
    refuses(DataError, f"leaves 100 times the range of the data at sample {expected}", model.simulate, data)
    assert np.isfinite(model.simulate_measured_feedback(data)).all()
    refuses(DataError, "leaves the range of numbers at sample", model.simulate, data.u)


def by_hand_until(model, u, limit):
    x, k = np.zeros(1), 0
    while abs(x[0] - 0.5) <= limit - 0.5 and k < 50:
        x = model.A @ x + model.B @ [u] + model.E @ [model.feedback[0](x[0])]
        k += 1
    return k


def test_unstable_open_loop_warns_and_names_the_sample():
    model = HammersteinSS([[1.2]], [[1.0]], [[1.0]])
    with pytest.warns(DataWarning, match="largest pole has radius 1.2"):
        model.simulate(np.ones(20))
    with pytest.warns(DataWarning), pytest.raises(DataError, match="at sample 2"):
        model.simulate(Data(np.ones(60), 0.01 * np.sin(np.arange(60.0))))


def test_basis_that_refuses():
    basis = Polynomial(1, interval=(-1.0, 1.0), outside="error")
    model = HammersteinSS([[0.9]], [[1.0]], [[1.0]], E=[[0.0]], feedback=(Nonlinearity(basis, np.ones(1)),))
    refuses(DataError, "At sample 2 the simulated output leaves the interval", model.simulate, np.ones(50))


def test_shapes_that_do_not_agree():
    refuses(StructureError, r"B has shape \(2, 1\)", HammersteinSS, np.eye(3), np.ones((2, 1)), np.ones((1, 3)))
    refuses(StructureError, "algebraic loop", replace, with_feedback(), E=np.ones((5, 2)))
    refuses(StructureError, "output_of", replace, with_feedback(), output_of=(0, 2))
    refuses(StructureError, "input_of", replace, with_feedback(), input_of=(0, 1))
    refuses(StructureError, "offsets|offset_x", HammersteinSS, np.eye(1), np.eye(1), np.eye(1),
            nonlinearities=(Nonlinearity(Linear(), np.ones(1), offset=1.0),))
    refuses(StructureError, "C contains a value that is not finite", replace, linear(), C=np.full((2, 3), np.nan))
    refuses(StructureError, "noise covariance S", replace, linear(n=2), noise=with_feedback().noise)
    refuses(StructureError, "gauge", replace, linear(), gauge="best")


# -- forms that predict the same ---------------------------------------------------------------------------------------


def agree(one, other, data, tolerance=1e-10):
    for name in ("predict", "simulate_measured_feedback", "simulate"):
        assert getattr(one, name)(data, x0="fit") == pytest.approx(getattr(other, name)(data, x0="fit"), abs=tolerance)
    assert one.predict(data, 3) == pytest.approx(other.predict(data, 3), abs=tolerance, nan_ok=True)


@pytest.mark.parametrize("model", [linear(), with_feedback()])
def test_predictions_do_not_depend_on_the_states(model):
    data = record(model, missing=0.1)
    T = np.random.default_rng(4).normal(size=(3, 3))
    moved = model.transform(T)
    agree(model, moved, data)
    assert moved.poles == pytest.approx(model.poles)
    assert moved.impulse_response(10) == pytest.approx(model.impulse_response(10), abs=1e-12)
    assert moved.frequency_response([0.1, 1.0]) == pytest.approx(model.frequency_response([0.1, 1.0]), abs=1e-11)
    assert moved.static_gain([0.1, 0.2]) == pytest.approx(model.static_gain([0.1, 0.2]), abs=1e-9)
    refuses(StructureError, "singular", model.transform, np.ones((3, 3)))
    refuses(StructureError, "T has shape", model.transform, np.eye(2))


@pytest.mark.parametrize("model", [linear(), with_feedback()])
def test_balanced_gramians(model):
    found = model.balance()
    agree(model, found, record(model))
    driven = np.hstack([found.B, found.E])
    reach = scipy.linalg.solve_discrete_lyapunov(found.A, driven @ driven.T)
    see = scipy.linalg.solve_discrete_lyapunov(found.A.T, found.C.T @ found.C)
    assert reach == pytest.approx(see, abs=1e-8) and reach == pytest.approx(np.diag(np.diag(reach)), abs=1e-8)
    refuses(StructureError, "unstable", linear(radius=1.1).balance)
    refuses(StructureError, "not minimal", HammersteinSS(np.diag([0.5, 0.4]), [[1.0], [0.0]], [[1.0, 1.0]]).balance)


def test_injection_leaves_prediction_and_free_run_alone():
    model = with_feedback()
    data = record(model)
    moved = model.inject_output(np.random.default_rng(0).normal(size=(3, 2)))
    assert moved.predict(data) == pytest.approx(model.predict(data), abs=1e-9)
    assert moved.simulate(data, x0=X0) == pytest.approx(model.simulate(data, x0=X0), abs=1e-9)
    assert not np.allclose(moved.simulate_measured_feedback(data, x0=X0), model.simulate_measured_feedback(data, X0))
    absorbed = model.inject_output(-model.L)
    assert not absorbed.L.any() and absorbed.A == pytest.approx(model.A + model.L @ model.C)
    refuses(StructureError, "gain has shape", model.inject_output, np.ones((2, 3)))


@pytest.mark.parametrize("gauge", ["norm", "none"])
@pytest.mark.parametrize("model", [linear(), with_feedback()])
def test_predictions_do_not_depend_on_the_gauge(model, gauge):
    found = model.regauge(gauge)
    agree(model, found, record(model))
    assert found.gauge == gauge
    if gauge == "norm":
        assert np.linalg.norm(np.vstack([found.B, found.D]), axis=0) == pytest.approx(np.ones(found.B.shape[1]))
        assert np.linalg.norm(found.E, axis=0) == pytest.approx(np.ones(len(found.feedback)))
        assert found.transform(3 * np.eye(3)).regauge("norm").impulse_response(5)[0] * 0 == pytest.approx(0 * found.D)
        closed = np.eye(found.nx) - found.A - found.L @ found.C
        gains = found.C @ np.linalg.solve(closed, found.B + found.L @ found.D) + found.D
        assert (gains[np.abs(gains).argmax(axis=0), range(gains.shape[1])] > 0).all()


def test_gain_gauge():
    model = linear(m=1, outputs=1).regauge("gain")
    assert model.step_response(400)[-1, 0, 0] == pytest.approx(1.0)
    refuses(StructureError, "one output", linear().regauge, "gain")
    refuses(StructureError, "pole at 1", HammersteinSS([[1.0]], [[1.0]], [[1.0]]).regauge, "gain")
    with pytest.raises(StructureError, match="static gain of input 'u' is zero"):
        HammersteinSS([[0.5]], [[1.0]], [[1.0]], [[-2.0]]).regauge("gain")


@pytest.mark.parametrize("model", [linear(), with_feedback(), with_feedback(gauge="norm"), with_feedback(Linear())])
def test_models_of_scaled_data_in_raw_units(model):
    model = model.regauge(model.gauge)
    transform = Transform((2.0, 0.5), (0.3, -1.0), (3.0, 0.2), (5.0, -2.0))
    scaled = record(model, missing=0.1)
    raw = Data(transform.raw_u(scaled.u), transform.raw_y(scaled.y), dt=0.5, inputs=model.inputs, outputs=model.outputs)
    moved = model.with_transform(transform)
    assert moved.gauge == model.gauge
    for name in ("predict", "simulate_measured_feedback", "simulate"):
        found = getattr(moved, name)(raw, x0=X0)
        assert found == pytest.approx(transform.raw_y(getattr(model, name)(scaled, x0=X0)), abs=1e-9)
    if model.noise is not None:
        assert moved.noise.R == pytest.approx(model.noise.R * np.outer([3, 0.2], [3, 0.2]))
    assert model.with_transform(Transform.identity(2, 2)) is model
    refuses(StructureError, "transform has 1 inputs", model.with_transform, Transform((2.0,), (0.0,), (1.0,), (0.0,)))


# -- what it says ------------------------------------------------------------------------------------------------------


def test_static_gain_is_the_slope_between_equilibria():
    model = with_feedback()
    u0, step = np.array([0.11, 0.23]), 1e-6
    x, y = model.equilibrium(u0)
    long = model.simulate(np.tile(u0, (500, 1)))
    assert long[-1] == pytest.approx(y, abs=1e-9)
    assert model.simulate(np.tile(u0, (20, 1)), x0=x) == pytest.approx(np.tile(y, (20, 1)), abs=1e-9)
    for c in range(2):
        moved = model.equilibrium(u0 + step * np.eye(2)[c])[1] - model.equilibrium(u0 - step * np.eye(2)[c])[1]
        assert model.static_gain(u0)[:, c] == pytest.approx(moved / (2 * step), rel=1e-5, abs=1e-7)
    assert linear(m=1, outputs=1).static_gain(0.0) == pytest.approx(linear(m=1, outputs=1).step_response(500)[-1, 0, 0])
    refuses(StructureError, "pole at 1", HammersteinSS([[1.0]], [[1.0]], [[1.0]]).static_gain, 1.0)
    refuses(StructureError, "u0 has shape", model.static_gain, 1.0)


def test_the_static_curve_of_an_input_leaves_the_functions_of_the_others_out():
    model, points = with_feedback(), np.array([-0.2, 0.3])
    alone = replace(model, nonlinearities=tuple(
        f if c == 0 else f.times(0.0) for f, c in zip(model.nonlinearities, model.input_of)))
    for u, y in zip(points, model.static_curve(0, points)):
        assert y == pytest.approx(alone.simulate(np.tile([u, 0.0], (500, 1)))[-1], abs=1e-9)


def test_responses():
    model = linear()
    impulse = np.zeros((12, 2))
    impulse[0, 1] = 1.0
    rest = model.simulate(np.zeros((12, 2)))
    assert model.impulse_response(12)[:, :, 1] == pytest.approx(model.simulate(impulse) - rest, abs=1e-12)
    assert model.step_response(12) == pytest.approx(np.cumsum(model.impulse_response(12), axis=0))
    w = np.array([0.3])
    series = sum(h * np.exp(-1j * w * k * 0.5) for k, h in enumerate(model.impulse_response(500)))
    assert model.frequency_response(w)[0] == pytest.approx(series, abs=1e-9)


def test_equations_can_be_read():
    text = with_feedback().equation(3)
    assert "x1(k+1) = 0.7 x1(k) + 0.35 x2(k)" in text and "f_u1(u1(k))" in text and "f1_u2(u2(k))" in text
    assert "g_q(q(k))" in text and "e_p(k)" in text and len(text.splitlines()) == 5
    assert "x(k+1) = A x(k) + B f(u1, u2) + offset_x + K e(k)" in linear(n=7).equation()
    assert "poles:" in str(linear(n=7))
    names = dict(with_feedback().coefficients())
    assert names["A[x1,x2]"] == 0.35 and names["offset_y[q]"] == -0.1 and "E[x1,g_q]" in names
    assert "D[y,u]" not in dict(HammersteinSS([[0.5]], [[1.0]], [[1.0]]).coefficients())
    model = HammersteinSS([[0.5]], [[2.0]], [[1.0]])
    assert model.equation() == "x1(k+1) = 0.5 x1(k) + 2 u(k)\ny(k) = 1 x1(k)"
    assert model.title == "Linear state-space model" and "feedback" in with_feedback().title
    assert model.orders == {"nx": 1} and model.memory == 0 and model.kind == "HammersteinSS"


def test_without_states_it_is_a_static_map():
    model = HammersteinSS(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]], offset_y=[1.0])
    assert model.simulate(np.arange(3.0)) == pytest.approx([1.0, 3.0, 5.0])
    data = Data(np.arange(3.0), [1.0, 3.0, 5.5])
    assert model.predict(data)[:, 0] == pytest.approx([1.0, 3.0, 5.0]) and model.is_stable
    assert model.balance() is model and HammersteinSS.from_dict(model.to_dict()).nx == 0


# -- noise -------------------------------------------------------------------------------------------------------------


def test_kalman_gain_is_the_fixed_point_of_the_filter():
    rng = np.random.default_rng(0)
    model, root = linear(), rng.normal(size=(5, 5))
    noise = root @ root.T
    Q, R, S = noise[:3, :3], noise[3:, 3:], noise[:3, 3:]
    K, innovation, error = kalman_gain(model.A, model.C, Q, R, S)
    P = np.zeros((3, 3))
    for _ in range(500):
        gain = (model.A @ P @ model.C.T + S) @ np.linalg.inv(model.C @ P @ model.C.T + R)
        P = model.A @ P @ model.A.T + Q - gain @ (model.C @ P @ model.C.T + R) @ gain.T
    assert gain == pytest.approx(K, abs=1e-10) and P == pytest.approx(error, abs=1e-10)
    assert innovation == pytest.approx(model.C @ P @ model.C.T + R, abs=1e-10)
    assert kalman_gain(np.zeros((0, 0)), np.zeros((2, 0)), np.zeros((0, 0)), R).innovation == pytest.approx(R)


@pytest.mark.slow
def test_kalman_gain_predicts_best():
    rng = np.random.default_rng(1)
    model = linear(radius=0.95, offset_x=None)
    Q, R = 0.3 * np.eye(3), np.diag([0.5, 0.1])
    u, x, y = rng.normal(size=(4000, 2)), np.zeros(3), np.zeros((4000, 2))
    for k in range(4000):
        y[k] = model.C @ x + model.D @ u[k] + model.offset_y + np.sqrt(R) @ rng.normal(size=2)
        x = model.A @ x + model.B @ u[k] + np.sqrt(0.3) * rng.normal(size=3)
    data = Data(u, y, dt=0.5)
    K, innovation, _ = kalman_gain(model.A, model.C, Q, R)
    errors = lambda gain: np.cov((data.y - replace(model, K=gain).predict(data)).T)  # noqa: E731
    assert errors(K) == pytest.approx(innovation, rel=0.1, abs=0.02)
    assert all(np.trace(errors(K)) < np.trace(errors(K + 0.05 * rng.normal(size=(3, 2)))) for _ in range(10))


def test_kalman_gain_refusals():
    refuses(StructureError, "not positive definite", kalman_gain, np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1)))
    with pytest.raises(StructureError, match="no stabilising solution"):
        kalman_gain(np.diag([1.1, 0.5]), [[0.0, 1.0]], np.eye(2), np.eye(1))
    refuses(StructureError, "S has shape", kalman_gain, np.eye(1), np.eye(1), np.eye(1), np.eye(1), np.zeros((2, 1)))


def test_noise_covariances_refusals():
    with pytest.raises(StructureError, match="not symmetric"):
        NoiseCovariances([[1.0, 2.0], [0.0, 1.0]], np.eye(1), np.zeros((2, 1)), np.eye(1))
    refuses(StructureError, "Q has shape", NoiseCovariances, np.eye(3), np.eye(1), np.zeros((2, 1)), np.eye(1))
    refuses(StructureError, "finite", NoiseCovariances, np.eye(2), [[np.nan]], np.zeros((2, 1)), np.eye(1))
