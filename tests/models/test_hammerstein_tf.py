"""The transfer-function model: predictions against brute force, the four noise models, units, files, refusals."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from scipy.signal import lfilter
from systems import inputs, mimo, nonlinearity, siso

import optid
from optid.bases import Linear, Polynomial, Triangular
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.models import HammersteinTF, Nonlinearity, roots

C, D = np.array([-0.6, 0.25]), np.array([-0.5, 0.1, 0.3])


def two_inputs():
    return HammersteinTF([-1.2, 0.5], ([1.0, 0.4], [0.3, -0.2, 0.1]),
                         (nonlinearity(Triangular(5), 1), nonlinearity(Polynomial(3), 2)), (0, 2), 0.4, dt=0.1)


def models():
    plant = siso(nk=1)
    return {"oe": replace(plant, d=()), "arx": plant, "armax": replace(plant, c=C), "bj": replace(plant, c=C, d=D),
            "ma": replace(plant, c=C, d=()), "ar": replace(plant, d=D), "fir": replace(siso(a=[]), c=C, d=()),
            "two": replace(two_inputs(), c=C, d=D)}


MODELS = models()


def noisy(model, count=300, size=0.3, seed=5):
    rng = np.random.default_rng(seed)
    u = inputs(model, count, seed)
    e = size * rng.standard_normal(count)
    v = lfilter(np.r_[1, model.c], np.r_[1, model.noise_denominator], e)
    return Data(u, model.simulate(u) + v[:, None], dt=model.dt), e[:, None]


@pytest.mark.parametrize("name", MODELS)
def test_innovations_are_the_noise_that_made_the_record(name):
    model = MODELS[name]
    data, e = noisy(model)
    found = model.innovations(data, x0="zero")
    skipped = model.memory
    assert np.isnan(found[:skipped]).all()
    if not skipped:
        assert found == pytest.approx(e, abs=1e-11)
    else:  # the first innovations count as zero, which is forgotten at the rate of C
        assert found[150:] == pytest.approx(e[150:], abs=1e-8)


@pytest.mark.parametrize("horizon", [1, 2, 3, 7])
@pytest.mark.parametrize("name", MODELS)
def test_k_steps_ahead_is_the_mean_over_the_future_noise(name, horizon):
    """Run the difference equations on from what is known at k - h, with the noise after that set to zero."""
    model = MODELS[name]
    data, e = noisy(model, 80)
    predicted = model.predict(data, horizon, x0="zero")
    found = np.nan_to_num(model.innovations(data, x0="zero"))[:, 0]
    x = model.simulate(data.u)[:, 0]
    v = lfilter(np.r_[1, model.c], np.r_[1, model.noise_denominator], found)
    for k in (30, 41, 79):
        future = found.copy()
        future[k - horizon + 1 :] = 0.0
        if model.memory:  # run the whole equation from the measured outputs
            y = data.y[:, 0].copy()
            drive = y + sum(a * np.r_[np.zeros(i), y[:-i]] for i, a in enumerate(model.a, 1))
            drive -= lfilter(np.r_[1, model.c], [1.0], found)
            for j in range(k - horizon + 1, k + 1):
                y[j] = drive[j] - sum(a * y[j - i] for i, a in enumerate(model.a, 1))
                y[j] += sum(c * future[j - i] for i, c in enumerate(model.c, 1))
            expected = y[k]
        else:
            expected = x[k] + lfilter(np.r_[1, model.c], np.r_[1, model.noise_denominator], future)[k]
            assert x + v == pytest.approx(data.y[:, 0], abs=1e-10)
        assert predicted[k, 0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("horizon", [1, 2, 5])
def test_arx_predicts_as_an_armax_model_without_moving_average_does(horizon):
    model = MODELS["arx"]
    data, _ = noisy(model)
    found, expected = model.predict(data, horizon), replace(model, c=[0.0]).predict(data, horizon)
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert found == pytest.approx(expected, abs=1e-10, nan_ok=True)


def test_armax_equals_box_jenkins_with_the_denominator_of_the_plant():
    armax, data = MODELS["armax"], noisy(MODELS["armax"])[0]
    apart = replace(armax, d=np.r_[armax.a, 0.0])
    assert apart.structure == "bj" and armax.structure == "armax"
    for horizon in (1, 4):
        assert apart.predict(data, horizon)[100:] == pytest.approx(armax.predict(data, horizon)[100:], abs=1e-8)


@pytest.mark.parametrize("name", ["oe", "bj", "two"])
def test_fitted_state_minimises_the_prediction_errors(name):
    model = MODELS[name]
    rng = np.random.default_rng(2)
    u = inputs(model, 120)
    e = 0.2 * rng.standard_normal(120)
    start = rng.normal(size=(model.largest_lag, 1))
    y = model.simulate(u, start) + lfilter(np.r_[1, model.c], np.r_[1, model.noise_denominator], e)[:, None]
    y[rng.uniform(size=120) < 0.2] = np.nan
    data = Data(u, y, dt=model.dt)
    fitted = np.nansum(model.innovations(data) ** 2)
    x0 = model.initial_state(data, "predict")
    assert np.nansum(model.innovations(data, x0) ** 2) == pytest.approx(fitted, rel=1e-9)
    for _ in range(20):
        assert fitted <= np.nansum(model.innovations(data, x0 + 0.05 * rng.normal(size=x0.shape)) ** 2) + 1e-10
    exact = Data(u, model.simulate(u, start), dt=model.dt)
    assert model.initial_state(exact, "predict") == pytest.approx(start, abs=1e-8)
    assert model.predict(exact) == pytest.approx(exact.y, abs=1e-8)


@pytest.mark.parametrize("name", ["oe", "armax", "bj"])
def test_missing_outputs_are_innovations_of_zero(name):
    model = MODELS[name]
    data, _ = noisy(model)
    y = data.y.copy()
    y[[40, 41, 100]] = np.nan
    y[41 if model.memory else 0] = np.nan
    gapped = Data(data.u, y, dt=model.dt)
    predicted = model.predict(gapped, x0="zero")
    assert np.isfinite(predicted[model.memory :]).all()
    filled = y.copy()
    for k in (0, 40, 41, 100):
        if np.isnan(filled[k]) and k >= model.memory:
            filled[k] = predicted[k]
    again = model.predict(Data(data.u, filled, dt=model.dt), x0="zero")
    assert again == pytest.approx(predicted, abs=1e-11, nan_ok=True)
    # the effect of a gap dies out with C
    whole = model.predict(data, x0="zero")
    assert predicted[160:] == pytest.approx(whole[160:], abs=1e-4 if model.memory else 1e-3)


def test_missing_inputs():
    for name in ("armax", "bj"):
        model = MODELS[name]
        data, _ = noisy(model)
        u = data.u.copy()
        u[150] = np.nan
        gapped = Data(u, data.y, dt=model.dt)
        predicted, whole = model.predict(gapped)[:, 0], model.predict(data)[:, 0]
        wrong = np.flatnonzero(np.isnan(predicted[model.memory :])) + model.memory
        assert wrong.tolist() == ([151, 152] if name == "armax" else [150])
        assert predicted[260:] == pytest.approx(whole[260:], abs=1e-2)
        for horizon in (3, 6):  # no prediction may contain the sample itself
            y = data.y.copy()
            y[170] += 100.0
            ahead = model.predict(gapped, horizon)[:, 0], model.predict(Data(u, y, dt=model.dt), horizon)[:, 0]
            if name == "armax":
                assert ahead[0][: 170 + horizon] == pytest.approx(ahead[1][: 170 + horizon], abs=1e-9, nan_ok=True)
    u[:] = data.u
    u[[4, 8, 12]] = np.nan
    assert np.isnan(MODELS["bj"].predict(Data(u, data.y, dt=model.dt))[:13]).all()


def test_all_outputs_missing_in_an_experiment():
    model = MODELS["bj"]
    data, _ = noisy(model, 50)
    predicted = model.predict(Data([data.u, data.u], [data.y, np.full((50, 1), np.nan)], dt=model.dt))
    assert predicted[1] == pytest.approx(model.simulate(data.u), abs=1e-12)


def test_several_experiments_each_with_its_own_state():
    for model in MODELS.values():
        parts = [noisy(model, n, seed=n)[0] for n in (60, 90)]
        both = Data([p.u for p in parts], [p.y for p in parts], dt=model.dt)
        for horizon in (1, 3):
            for found, part in zip(model.predict(both, horizon), parts):
                assert np.array_equal(found, model.predict(part, horizon), equal_nan=True)
        assert len(model.simulate(both)) == 2 and len(model.innovations(both)) == 2
    refuses(StructureError, "give one each", model.predict, both, x0=[np.zeros(2)])


@pytest.mark.parametrize("name", MODELS)
def test_raw_units_and_gauges_leave_predictions_alone(name):
    model = MODELS[name]
    data, _ = noisy(model, 100)
    transform = Transform(u_scale=(2.0,) * model.m, u_offset=(0.3,) * model.m, y_scale=(3.0,), y_offset=(-1.0,))
    raw = model.with_transform(transform)
    u, y = data.u * 2.0 + 0.3, data.y * 3.0 - 1.0
    rescaled = Data(u, y, dt=model.dt)
    for horizon in (1, 3):
        expected = model.predict(data, horizon) * 3.0 - 1.0
        assert raw.predict(rescaled, horizon) == pytest.approx(expected, abs=1e-9, nan_ok=True)
    assert model.regauge("norm").predict(data) == pytest.approx(model.predict(data), abs=1e-11, nan_ok=True)


@pytest.mark.parametrize("name", MODELS)
def test_files_with_the_plant_apart_or_without_noise_load(name, tmp_path):
    model = MODELS[name]
    plant = {key: value for key, value in model.to_dict().items() if key not in ("c", "d")} | {"kind": "HammersteinARX"}
    content = {"kind": "HammersteinTF", "plant": plant, "c": model.c.tolist(), "d": model.noise_denominator.tolist()}
    for old in (content, plant) if name == "arx" else (content,):
        path = tmp_path / "model.json"
        path.write_text(json.dumps({"format": "optid model", "version": 1, **old}))
        assert optid.load(path).to_dict() == model.to_dict()


def test_words():
    titles = {name: model.title for name, model in MODELS.items()}
    assert titles["oe"] == "Hammerstein output-error model" and titles["armax"] == "Hammerstein ARMAX model"
    assert titles["bj"] == titles["ma"] == titles["ar"] == "Hammerstein Box-Jenkins model"
    linear = HammersteinTF([-0.5], ([1.0],), (Nonlinearity(Linear(), [1.0]),), (1,), 0.0)
    assert replace(linear, d=()).title == "Linear output-error model"
    assert replace(linear, d=()).equation() == "x(k) = 0.5 x(k-1) + 1 u(k-1)\ny(k) = x(k) + e(k)"
    armax = replace(linear, c=[0.2], d=[-0.5])
    assert armax.equation() == "y(k) = 0.5 y(k-1) + 1 u(k-1) + e(k) + 0.2 e(k-1)"
    assert armax.coefficients()[-1] == ("c1", 0.2) and armax.orders["nc"] == 1 and armax.noise.startswith("C = 1 + 0.2")
    bj = replace(linear, c=[0.2], d=[0.0, -0.3])
    assert "v(k) = e(k) + 0.2 e(k-1) + 0.3 v(k-2)" in bj.equation()
    assert bj.coefficients()[-2:] == [("d1", 0.0), ("d2", -0.3)] and bj.orders["nd"] == 2
    assert "poles of the noise" in str(bj) and "poles of the noise" not in str(armax)


def test_refusals():
    plant = siso()
    refuses(StructureError, "one output", replace, mimo(), d=())
    refuses(StructureError, "not invertible.*modulus 1.25.*Reflect", replace, plant, c=[-1.25])
    refuses(StructureError, "not invertible", replace, plant, c=[1.0])
    refuses(StructureError, "not finite", replace, plant, c=[np.nan])
    refuses(StructureError, r"\(nd,\)", replace, plant, d=[[0.1]])
    data, _ = noisy(MODELS["oe"], 30)
    refuses(StructureError, "'zero', 'fit'", MODELS["oe"].predict, data, x0="steady")
    refuses(DataError, "sampled every", MODELS["oe"].predict, Data(data.u, data.y, dt=7.0))


def test_reflection_keeps_the_spectrum():
    c = np.real(np.poly([1.6, -0.5, 1.2 + 0.5j, 1.2 - 0.5j]))[1:]
    inside = roots.contain_roots(c)
    assert roots.radius(inside) < 1
    z = np.exp(1j * np.linspace(0, 3, 7))
    ratio = np.abs(np.polyval(np.r_[1, c], z)) / np.abs(np.polyval(np.r_[1, inside], z))
    assert ratio == pytest.approx(np.full(7, ratio[0]), rel=1e-10)
    assert roots.contain_roots(np.array([0.5, 0.0])) == pytest.approx([0.5, 0.0])


def test_unstable_armax_predicts():
    plant = siso(a=[-2.2, 1.1])
    model = replace(plant, c=C)
    rng = np.random.default_rng(0)
    u, e = inputs(model, 60), 0.1 * rng.standard_normal(60)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        y = model.simulate(u) + lfilter(np.r_[1, C], np.r_[1, plant.a], e)[:, None]
    found = model.innovations(Data(u, y, dt=model.dt))[:, 0]
    assert found[45:] == pytest.approx(e[45:], abs=1e-4)
