"""Prediction errors with a noise filter: against the model's own predictor, finite differences and output error."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from systems import inputs, nonlinearity

from optid.bases import Linear, Polynomial, Triangular
from optid.data.record import Data
from optid.models import HammersteinTF
from optid.statistics import sensitivities
from optid.statistics.sensitivities import TransferPredictor
from optid.statistics.unknowns import TransferPoint, TransferUnknowns

C, D = np.array([-0.6, 0.25]), np.array([-0.5, 0.1, 0.3])


def plant(a=(-1.2, 0.5), **noise):
    functions = nonlinearity(Triangular(4), 1), nonlinearity(Polynomial(3), 2)
    return HammersteinTF(a, ([1.0, 0.4], [0.3, -0.2, 0.1]), functions, (0, 2), 0.4, **noise)


def records(model, counts=(90, 60), gaps="", seed=0):
    rng = np.random.default_rng(seed)
    us, ys = [], []
    for count in counts:
        u = inputs(model, count, seed + count)
        v = lfilter(np.r_[1, model.c], np.r_[1, model.noise_denominator], 0.3 * rng.standard_normal(count))
        y = model.simulate(u, rng.normal(size=model.largest_lag)) + v[:, None]
        if "y" in gaps:
            y[rng.uniform(size=count) < 0.15] = np.nan
        if "u" in gaps:
            u[[30, 33], [0, 1]] = np.nan
        us.append(u)
        ys.append(y)
    return Data(us, ys)


def point_of(model, data, apart, seed=3):
    """A point off the truth, with its unknowns."""
    rng = np.random.default_rng(seed)
    layout = model.layout
    free = tuple(not isinstance(b, Linear) for b in layout.bases)
    denominator = len(model.noise_denominator) if apart else None
    noise = TransferUnknowns(layout, data.n_experiments, free, True, len(model.c), denominator)
    x0 = rng.normal(size=(data.n_experiments, layout.first_row))
    mus = tuple(f.mu for f in model.nonlinearities)
    point = TransferPoint(model.a, mus, model.b, float(model.offset[0]), x0, model.c, model.noise_denominator)
    return noise, noise.pack(point) + 0.02 * rng.standard_normal(noise.size)


CASES = {"armax": (plant(c=C), False), "arx": (plant(), False), "long": (plant(c=[0.2, 0.0, 0.1, -0.3, 0.2]), False),
         "bj": (plant(c=C, d=D), True), "oe": (plant(d=()), True), "ma": (plant(c=C, d=()), True),
         "ar": (plant(d=D), True), "fir": (plant((), c=C, d=()), True)}


def errors(data, unknowns, x):
    found = []
    predictor, point = TransferPredictor(data, unknowns), unknowns.unpack(x)
    for i, y in enumerate(predictor.simulate(point)):
        one = predictor.predict(point, i, y)
        found.append(np.where(one.state == 0, -one.innovations, 0.0))
    return np.concatenate(found)


# the state of a plant apart is lost where an input is missing, so that such records are refused
GAPS = [(name, gaps) for name, (_, apart) in CASES.items() for gaps in (("", "y") if apart else ("", "y", "u", "uy"))]


@pytest.mark.parametrize(("name", "gaps"), GAPS)
def test_sensitivities_are_the_derivatives_of_the_errors(name, gaps, monkeypatch):
    monkeypatch.setattr(sensitivities, "CHUNK", 17)
    model, apart = CASES[name]
    data = records(model, gaps=gaps)
    unknowns, x = point_of(model, data, apart)
    predictor, point, rows = TransferPredictor(data, unknowns), unknowns.unpack(x), []
    for i, e in enumerate(data.experiments):
        found = predictor.predict(point, i, predictor.simulate(point)[i])
        parts = [block for block, _ in predictor.blocks(point, i)]
        width = unknowns.memory + unknowns.shared + 1  # a forgotten initial state has no columns
        part = np.vstack([np.pad(block, ((0, 0), (width - block.shape[1], 0))) for block in parts])
        states = np.zeros((len(part), data.n_experiments * unknowns.memory))
        states[:, i * unknowns.memory : (i + 1) * unknowns.memory] = part[:, : unknowns.memory]
        rows.append(np.hstack([part[:, unknowns.memory : -1], states, part[:, -1:]]))
        assert np.count_nonzero(found.state == 0) < len(e.u) + apart
    assert_derivatives(np.vstack(rows), data, unknowns, x)


def assert_derivatives(whole, data, unknowns, x):
    """Columns of the rows [sensitivities | errors] against finite differences."""
    assert whole[:, -1] == pytest.approx(errors(data, unknowns, x), abs=1e-13)
    for j in range(unknowns.size):
        step = 1e-6 * np.eye(unknowns.size)[j]
        slope = (errors(data, unknowns, x + step) - errors(data, unknowns, x - step)) / 2e-6
        assert whole[:, j] == pytest.approx(slope, abs=2e-7 * (1 + np.max(np.abs(slope)))), j


@pytest.mark.parametrize("name", ["armax", "long"])
def test_derivatives_where_outputs_never_follow_one_another(name, monkeypatch):
    """Every second output: the recursion begins with held samples, whose derivatives do not count."""
    monkeypatch.setattr(sensitivities, "CHUNK", 17)
    model, apart = CASES[name]
    data = records(model)
    ys = [e.y.copy() for e in data.experiments]
    ys[0][::2], ys[1][1::2] = np.nan, np.nan
    data = Data([e.u for e in data.experiments], ys)
    unknowns, x = point_of(model, data, apart)
    predictor, point, rows = TransferPredictor(data, unknowns), unknowns.unpack(x), []
    for i, e in enumerate(data.experiments):
        found = predictor.predict(point, i, predictor.simulate(point)[i])
        assert np.count_nonzero(found.state == 0) == np.isfinite(e.y[10 * unknowns.layout.first_row :]).sum() > 5
        rows.append(np.vstack([b for b, _ in predictor.blocks(point, i)]))
    assert_derivatives(np.vstack(rows), data, unknowns, x)


@pytest.mark.parametrize("method", ["gram", "qr", "auto"])
@pytest.mark.parametrize("name", ["armax", "bj"])
def test_compression_keeps_values_gradients_and_steps(name, method, monkeypatch):
    monkeypatch.setattr(sensitivities, "CHUNK", 23)
    model, apart = CASES[name]
    data = records(model, gaps="y")
    unknowns, x = point_of(model, data, apart)
    at = TransferPredictor(data, unknowns).compress(unknowns.unpack(x), method=method)
    e = errors(data, unknowns, x)
    assert at.value == pytest.approx(e @ e, rel=1e-9)
    matrix, pull = at.whole
    value = lambda x: np.sum(errors(data, unknowns, x) ** 2)  # noqa: E731
    gradient = np.array([(value(x + s) - value(x - s)) / 2e-6 for s in 1e-6 * np.eye(unknowns.size)])
    assert 2 * matrix.T @ pull == pytest.approx(gradient, rel=1e-4, abs=1e-5 * np.max(np.abs(gradient)))
    assert at.rows == sum(np.isfinite(p.y[0 if apart else unknowns.layout.first_row :]).sum() for p in data.experiments)


def test_errors_are_those_of_the_models_predictor():
    for name, gaps in (("armax", "uy"), ("arx", "u"), ("long", "y"), ("bj", "y"), ("ma", "")):
        model, apart = CASES[name]
        data = records(model, gaps=gaps)
        unknowns, x = point_of(model, data, apart)
        point = unknowns.unpack(x)
        truth = HammersteinTF(point.a, point.bs, tuple(
            type(f)(f.basis, mu) for f, mu in zip(model.nonlinearities, point.mus)), (0, 2),
            point.offset, inputs=data.inputs, c=point.c, d=point.d)
        expected = truth.innovations(data, list(point.x0) if apart else "fit")
        predictor = TransferPredictor(data, unknowns)
        for i, y in enumerate(predictor.simulate(point)):
            found = predictor.predict(point, i, y)
            assert np.array_equal(found.state == 0, np.isfinite(expected[i][:, 0]))
            assert found.innovations == pytest.approx(np.nan_to_num(expected[i][:, 0]), abs=1e-11)


def test_without_a_noise_filter_it_is_the_output_error():
    model, _ = CASES["oe"]
    data = records(model, counts=(300, 200), gaps="y")
    unknowns, x = point_of(model, data, True)
    plain = TransferPredictor(data, unknowns).compress(unknowns.unpack(x), method="qr")
    filtered = replace(unknowns, nc=1, nd=2)  # C = D = 1 as a point of a model with a noise filter
    point = replace(unknowns.unpack(x), c=np.zeros(1), d=np.zeros(2))
    ours = TransferPredictor(data, filtered).compress(point, method="qr").whole[0]
    ours = np.delete(ours, np.arange(unknowns.shared, filtered.shared), axis=1)
    assert TransferPredictor(data, filtered).compress(point, method="qr").value == pytest.approx(plain.value, rel=1e-10)
    theirs = plain.whole[0]
    assert ours.T @ ours == pytest.approx(theirs.T @ theirs, rel=1e-8, abs=1e-8)


def test_packing():
    for name in ("bj", "armax"):
        model, apart = CASES[name]
        unknowns, x = point_of(model, records(model), apart)
        assert np.array_equal(unknowns.pack(unknowns.unpack(x)), x)
    assert np.array_equal(unknowns.unpack(x).d, unknowns.unpack(x).a)
