"""The model against its own difference equation run by hand, and laws that gauges and units must obey."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from systems import BASES, by_hand, inputs, mimo, nonlinearity, siso

from optid.bases import Linear, Triangular, UserFunctions
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.models import HammersteinTF, Nonlinearity

MODELS = [siso(), siso(nk=3), siso(Linear()), mimo(), siso(a=[]), siso(a=[-0.5], b=([1.0],))]


def record(model, count=200, seed=1, noise=0.0):
    u = inputs(model, count, seed)
    e = noise * np.random.default_rng(seed).normal(size=(count, model.l))
    return Data(u, by_hand(model, u, noise=e), dt=model.dt)


# -- nonlinearity ----------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("basis", BASES)
def test_nonlinearity_equals_its_expansion(basis):
    f = nonlinearity(basis)
    u = np.linspace(-1, 2, 70_001)
    assert f(u) == pytest.approx(f.basis.values(u) @ f.mu, abs=1e-12)
    assert replace(f, offset=2.0)(u) == pytest.approx(f(u) + 2.0)
    assert f(0.3) == pytest.approx(float(f(np.array([0.3]))[0])) and isinstance(f(0.3), float)
    assert f(u[:6].reshape(2, 3)).shape == (2, 3) and np.isnan(f(np.nan))
    assert f.slope(0.31) == pytest.approx((f(0.31 + 1e-6) - f(0.31 - 1e-6)) / 2e-6, abs=1e-6)


def test_nonlinearity_refuses_wrong_coefficients():
    refuses(StructureError, r"needs \(7,\)", Nonlinearity, Triangular(7).with_interval(0, 1), np.ones(8))
    refuses(StructureError, r"mu\[1\]", Nonlinearity, Triangular(2).with_interval(0, 1), np.array([1.0, np.nan]))


# -- simulation and prediction ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
def test_simulation_equals_the_equation(model):
    u = inputs(model)
    assert model.simulate(u) == pytest.approx(by_hand(model, u), abs=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_simulation_from_the_state_after_a_past(model):
    rng = np.random.default_rng(3)
    u = inputs(model, 60)
    u_past, y_past = inputs(model, 10, 5), rng.normal(size=(10, model.l))
    w_past = np.column_stack([f(u_past[:, c]) for c, f in enumerate(model.nonlinearities)])
    expected = by_hand(model, u, y_past, w_past)
    state = model.state(u_past, y_past)
    assert state.shape == (model.memory, model.l)
    assert model.simulate(u, x0=state) == pytest.approx(expected, abs=1e-12)
    data = Data(u, expected, dt=model.dt)
    assert model.simulate(data, x0="fit") == pytest.approx(expected, abs=1e-9)
    assert model.initial_state(data) == pytest.approx(state, abs=1e-6)


def test_fitted_state_ignores_missing_outputs_and_minimises():
    model, rng = siso(), np.random.default_rng(4)
    u = inputs(model, 80)
    y = by_hand(model, u) + rng.normal(size=(80, 1))
    y[rng.uniform(size=80) < 0.3] = np.nan
    data = Data(u, y, dt=0.1)
    x0 = model.initial_state(data)
    loss = lambda x: np.nansum((y - model.simulate(u, x0=x)) ** 2)  # noqa: E731
    for _ in range(20):
        assert loss(x0) <= loss(x0 + 0.1 * rng.normal(size=x0.shape)) + 1e-9


@pytest.mark.parametrize("model", MODELS)
def test_prediction_uses_measured_outputs(model):
    data = record(model, noise=0.2)
    prediction, n = model.predict(data), model.memory
    assert np.isnan(prediction[:n]).all() and np.isfinite(prediction[n:]).all()
    noise = 0.2 * np.random.default_rng(1).normal(size=data.y.shape)
    assert data.y[n:] - prediction[n:] == pytest.approx(noise[n:], abs=1e-12)


def test_prediction_is_missing_where_a_sample_is():
    model = siso(nk=1)
    data = record(model, 30)
    u, y = data.u.copy(), data.y.copy()
    u[10], y[20] = np.nan, np.nan
    prediction = model.predict(Data(u, y, dt=0.1))[:, 0]
    assert np.flatnonzero(np.isnan(prediction)).tolist() == [0, 1, 11, 12, 21, 22]
    assert prediction[20] == pytest.approx(model.predict(data)[20, 0])


def test_several_experiments_and_shapes():
    model = siso()
    parts = [inputs(model, 50, 1), inputs(model, 70, 2)]
    data = Data(parts, [by_hand(model, u) for u in parts], dt=0.1)
    for result in (model.simulate(data), model.simulate(parts), model.predict(data), model.simulate(data, "fit")):
        assert [r.shape for r in result] == [(50, 1), (70, 1)]
    assert model.simulate(parts[0][:, 0]).shape == (50,)
    assert model.simulate(data, x0=[np.zeros(2), np.ones((2, 1))])[1] == pytest.approx(
        model.simulate(parts[1], x0=np.ones(2)))


def test_simulation_refusals():
    model = siso()
    data = record(model)
    u = data.u.copy()
    u[7] = np.nan
    refuses(DataError, "Input 'u' is missing at sample 7.*Interpolate", model.simulate, u)
    refuses(DataError, "2 channels; the model has 1", model.simulate, np.zeros((9, 2)))
    refuses(StructureError, "needs the outputs", model.simulate, data.u, x0="fit")
    refuses(StructureError, "'zero', 'fit'", model.simulate, data.u, x0="steady")
    refuses(StructureError, r"\(2, 1\)", model.simulate, data.u, x0=np.zeros(3))
    refuses(StructureError, "give one each", model.simulate, [data.u, data.u], x0=[np.zeros(2)])
    refuses(DataError, "sampled every 0.2", model.simulate, Data(data.u, data.y, dt=0.2))
    with pytest.raises(DataError, match=r"data.select\(outputs="):
        mimo().predict(Data(np.zeros((20, 3)), np.zeros((20, 2)), dt=0.5, outputs=["y2", "y1"]))
    refuses(DataError, "follows from 2 samples", model.state, [1.0], [1.0])
    refuses(DataError, "missing 2 samples before the end", model.state, [1.0, 1.0, 1.0], [1.0, np.nan, 1.0])


def test_unstable_model_warns_and_names_the_overflow():
    model = siso(a=[-2.5, 1.0])
    radius = np.max(np.abs(np.roots([1, -2.5, 1.0])))
    with pytest.warns(DataWarning, match="radius 2"):
        model.simulate(inputs(model, 20))
    overflow = np.log(np.finfo(float).max) / np.log(radius)
    with (pytest.warns(DataWarning),
          pytest.raises(DataError, match="'y' leaves the range of numbers at sample") as caught):
        model.simulate(inputs(model, 2000))
    assert abs(int(str(caught.value).split("at sample ")[1].split(":")[0]) - overflow) < 20
    double = mimo()
    with pytest.warns(DataWarning), pytest.raises(DataError, match="leaves the range"):
        replace(double, a=5 * double.a).simulate(inputs(double, 3000))


def test_arguments_are_not_modified_and_coefficients_are_read_only():
    u = inputs(siso())
    before = u.copy()
    siso().simulate(u)
    assert np.array_equal(u, before)
    with pytest.raises(ValueError, match="read-only"):
        siso().a[0] = 1


# -- linear part ----------------------------------------------------------


def test_poles_and_stability():
    assert siso().poles == pytest.approx(np.roots([1, -1.5, 0.7])[::-1])
    model = mimo()
    a1, a2 = model.a
    z = model.poles
    assert z.size == 4
    for pole in z:
        assert abs(np.linalg.det(np.eye(2) * pole**2 + a1 * pole + a2)) < 1e-10
    assert model.is_stable and not siso(a=[-1.0]).is_stable and siso(a=[]).poles.size == 0


@pytest.mark.parametrize("model", [siso(nk=2), mimo()])
def test_responses_agree_with_each_other_and_with_simulation(model):
    response = model.impulse_response(400)
    w = np.array([0.0, 0.3, np.pi / model.dt])
    direct = np.array([(response * np.exp(-1j * f * model.dt * np.arange(400))[:, None, None]).sum(axis=0) for f in w])
    assert model.frequency_response(w) == pytest.approx(direct, abs=1e-9)
    assert model.step_response(400)[-1] == pytest.approx(model.frequency_response(0)[0].real, abs=1e-9)
    for c in range(model.m):
        u = np.full((200, model.m), 0.1)
        u[0, c] = 0.7
        f = model.nonlinearities[c]
        change = model.simulate(u) - model.simulate(np.full((200, model.m), 0.1))
        assert change == pytest.approx((f(0.7) - f(0.1)) * response[:200, :, c], abs=1e-11)


@pytest.mark.parametrize("model", [siso(), mimo()])
def test_static_gain_is_the_slope_of_the_steady_state(model):
    u0, step = np.full(model.m, 0.22), 1e-5
    gain = np.empty((model.l, model.m))
    for c in range(model.m):
        ends = []
        for sign in (1, -1):
            point = u0 + sign * step * np.eye(model.m)[c]
            ends.append(model.simulate(np.tile(point, (600, 1)))[-1])
        gain[:, c] = (ends[0] - ends[1]) / (2 * step)
        curve = model.static_curve(c, u0[c] + step * np.array([1.0, -1.0]))
        assert curve[0] - curve[1] == pytest.approx(ends[0] - ends[1], abs=1e-11)
    assert np.reshape(model.static_gain(u0), gain.shape) == pytest.approx(gain, abs=1e-6)
    refuses(StructureError, "integrator", replace(model, a=-np.eye(2)[None] if model.l > 1 else [-1.0]).static_gain, u0)
    refuses(StructureError, "one operating point per input", model.static_gain, np.zeros(7))


# -- gauge, offset, units ----------------------------------------------------------


@pytest.mark.sampled(2)
@pytest.mark.parametrize("model", MODELS)
@given(scale=st.floats(-50, 50).filter(lambda x: abs(x) > 0.02), gauge=st.sampled_from(["norm", "gain", "b0", "none"]))
def test_predictions_do_not_depend_on_the_gauge(model, scale, gauge):
    if model.l > 1 and gauge in ("gain", "b0"):
        refuses(StructureError, "cannot be reached|one output", model.regauge, gauge)
        return
    data = record(model)
    scaled = replace(model,
                     b=tuple(b / scale for b in model.b),
                     nonlinearities=tuple(replace(f, mu=scale * f.mu) for f in model.nonlinearities))
    other = scaled.regauge(gauge)
    size = np.max(np.abs(data.y))
    assert other.simulate(data) == pytest.approx(data.y, abs=1e-12 * size)
    assert other.predict(data)[model.memory :] == pytest.approx(model.predict(data)[model.memory :], abs=1e-12 * size)
    assert other.gauge == gauge
    assert other.theta() == pytest.approx(model.theta(), abs=1e-12)
    b = other.b[0]
    if gauge == "norm":
        assert np.linalg.norm(b) == pytest.approx(1) and b.ravel(order="F")[0] > 0
    elif gauge == "gain":
        assert b.sum() == pytest.approx(1 + model.a.sum())
    elif gauge == "b0":
        assert b[0] == pytest.approx(1)
    elif isinstance(model.nonlinearities[0].basis, Linear):
        assert other.nonlinearities[0].mu[0] == pytest.approx(1)


def test_gauge_refusals():
    refuses(StructureError, "gauge=.norn.: use one of norm, gain", siso().regauge, "norn")
    refuses(StructureError, "static gain", siso(b=([1.0, -1.0],)).regauge, "gain")
    refuses(StructureError, "is zero", siso(b=([0.0, 0.0],)).regauge, "norm")
    refuses(StructureError, "infinite", siso(a=[-1.0]).regauge, "gain")


def test_offset_of_f_is_restored_where_it_can_be():
    model = siso(offset=0.7)
    assert model.c0 == pytest.approx(0.7 / (16 / 15 + 0.8)) and not model.offset_note
    u = inputs(model)
    whole = model.f
    moved = replace(model, offset=0.0)
    w = by_hand(moved, u)
    constant = by_hand(replace(moved, nonlinearities=(replace(whole, offset=None),)), u)
    assert w == pytest.approx(constant)
    assert whole(0.4) == pytest.approx(model.nonlinearities[0](0.4) + model.c0)
    assert siso(b=([1.0, -1.0],)).c0 is None and "sum to zero" in siso(b=([1.0, -1.0],)).offset_note
    assert mimo().c0 is None and "several inputs" in mimo().offset_note and len(mimo().f) == 3
    assert siso(Linear()).c0 is None
    two = HammersteinTF(
        np.zeros((0, 2, 2)), ([[1.0, 2.0], [0.0, 1.0]],), (nonlinearity(Triangular(4)),), (0,), [0.5, 1.5])
    assert two.c0 == pytest.approx(0.5)
    assert replace(two, offset=np.array([0.5, 0.0])).c0 is None


@pytest.mark.sampled(5)
@pytest.mark.parametrize("basis", BASES)
@given(scales=st.tuples(st.floats(0.01, 100), st.floats(0.01, 100)),
       offsets=st.tuples(st.floats(-20, 20), st.floats(-20, 20)))
def test_raw_units_siso(basis, scales, offsets):
    transform = Transform((scales[0],), (offsets[0],), (scales[1],), (offsets[1],))
    model = siso(basis, gauge="b0").regauge("b0")
    check_raw(model, transform)


def check_raw(model, transform):
    data = record(model, 60, noise=0.1)
    raw = Data(transform.raw_u(data.u), transform.raw_y(data.y), dt=model.dt)
    converted = model.with_transform(transform)
    size = np.max(np.abs(raw.y)) + np.max(transform.y_scale)
    assert converted.gauge == model.gauge
    expected = transform.raw_y(model.predict(data))[model.memory :]
    assert converted.predict(raw)[model.memory :] == pytest.approx(expected, abs=1e-9 * size)
    assert np.max(np.abs(converted.simulate(raw, "fit") - transform.raw_y(model.simulate(data, "fit")))) < 1e-7 * size


def test_raw_units_mimo_and_linear():
    transform = Transform((3.0, 0.2, 1.0), (1.0, 0.0, -5.0), (10.0, 0.3), (2.0, -1.0))
    check_raw(mimo().regauge("norm"), transform)
    linear = siso(Linear()).regauge("none").with_transform(Transform((4.0,), (1.0,), (2.0,), (0.0,)))
    assert linear.nonlinearities[0].mu[0] == pytest.approx(1)
    refuses(StructureError, "3 inputs", siso().with_transform, transform)
    assert siso().with_transform(Transform.identity(1, 1)).a.tolist() == [-1.5, 0.7]


def test_user_functions_keep_their_units():
    functions = UserFunctions((np.tanh,), ("tanh",)).with_interval(-1, 1)
    with pytest.raises(StructureError, match="keeps the units"):
        siso(nonlinearities=(Nonlinearity(functions, [1.0]),)).with_transform(Transform((2.0,), (0.0,), (1.0,), (0.0,)))


# -- text and refusals ----------------------------------------------------------


def test_equations():
    assert siso().equation() == "y(k) = 1.5 y(k-1) - 0.7 y(k-2) + 1.067 f(u(k)) + 0.8 f(u(k-1))"
    assert siso(b=([1.0, -1.0],), nk=2, offset=-0.02).equation(3).endswith("+ 1 f(u(k-2)) - 1 f(u(k-3)) - 0.02")
    linear = siso(Linear(), a=[0.5], nonlinearities=(Nonlinearity(Linear(), [1.0]),))
    assert linear.equation() == "y(k) = -0.5 y(k-1) + 1.067 u(k) + 0.8 u(k-1) + 0.3"
    first, second = mimo().equation().splitlines()
    assert first.startswith("y1(k) = 0.9 y1(k-1) - 0.1 y2(k-1)") and first.endswith("+ 0.2")
    assert "f_u2(u2(k-2))" in second and "f_u2" not in first
    assert "poles: 0.75" in str(siso())
    assert siso(a=[], b=([0.0],), offset=0.0).equation() == "y(k) = 0"


def test_orders_and_layout():
    model = mimo()
    assert model.orders == {"na": 2, "nb": (2, 1, 3), "nk": (0, 2, 1)} and model.memory == 3
    assert model.layout.first_row == model.memory and model.layout.n_columns == 2 * 2 + 2 * 6 + 3 + 3 * 6 + 1
    assert model.theta(2).shape == (6, 6)


@pytest.mark.parametrize(("changes", "words"),
                         [({"a": [[1.0]]}, r"must be \(na,\)"),
                          ({"b": ([[1.0, 2.0]],)}, r"b\[0\]"),
                          ({"b": ([],)}, r"b\[0\]"),
                          ({"b": ()}, "nonlinearities has 1 entries for 0 inputs"),
                          ({"b": ([1.0], [1.0])}, "nonlinearities has 1"),
                          ({"nk": -1}, "nk of input .u. must be a nonnegative integer"),
                          ({"a": [np.inf]}, "not finite"),
                          ({"dt": 0.0}, "positive"),
                          ({"gauge": "unit"}, "gauge"),
                          ({"outputs": ("y", "z")}, "2 names"),
                          ({"nonlinearities": (replace(nonlinearity(Triangular(3)), offset=1.0),)}, "offset=")])
def test_inconsistent_models(changes, words):
    refuses(StructureError, words, siso, **changes)


@pytest.mark.parametrize("horizon", [1, 2, 3, 7])
@pytest.mark.parametrize("make", [siso, mimo, lambda: siso(a=[])])
def test_prediction_several_steps_ahead_is_simulation_from_the_state_then(make, horizon):
    model = make()
    u = inputs(model, 60)
    y = by_hand(model, u, noise=np.random.default_rng(2).normal(size=(60, model.l)))
    predicted, longer = model.predict(Data(u, y, dt=model.dt), horizon), np.vstack([u, u])
    for k in range(model.memory + horizon - 1, 60):
        known = k - horizon + 1  # samples before this one are known
        state = model.state(u[:known], y[:known])
        assert predicted[k] == pytest.approx(model.simulate(longer[known:], state)[k - known], abs=1e-10)
    refuses(StructureError, "horizon must be a positive integer", model.predict, Data(u, y, dt=model.dt), 0)
