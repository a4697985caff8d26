"""Streamed errors of transfer-function models and sensitivities against differences, formed matrices and the model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from systems import inputs, nonlinearity

from optid.bases import Linear, Polynomial, Triangular
from optid.data.record import Data
from optid.models import HammersteinTF, Nonlinearity
from optid.models.layout import Layout
from optid.statistics import sensitivities
from optid.statistics.sensitivities import TransferPredictor
from optid.statistics.unknowns import TransferPoint, TransferUnknowns

C, D = np.array([-0.6, 0.25]), np.array([-0.5, 0.1, 0.3])


def plant(a=(-1.2, 0.5), **noise):
    functions = nonlinearity(Triangular(4), 1), nonlinearity(Polynomial(3), 2), nonlinearity(Linear(), 3)
    return HammersteinTF(a, ([1.0, 0.4], [0.3, -0.2, 0.1], [0.5]), functions, (0, 2, 1), 0.4, **noise)


# model, and whether its noise has poles of its own
CASES = {"armax": (plant(c=C), False), "arx": (plant(), False), "long": (plant(c=[0.2, 0.0, 0.1, -0.3, 0.2]), False),
         "bj": (plant(c=C, d=D), True), "oe": (plant(d=()), True), "ma": (plant(c=C, d=()), True),
         "ar": (plant(d=D), True), "fir": (plant((), c=C, d=()), True)}


def records(model, gaps="", seed=0, counts=(90, 60)):
    """Experiments in which outputs ("y", or "Y" where those of the first ten samples tell the state) or inputs miss."""
    rng = np.random.default_rng(seed)
    us, ys = [], []
    for count in counts:
        u = inputs(model, count, seed + count)
        v = lfilter(np.r_[1, model.c], np.r_[1, model.noise_denominator], 0.3 * rng.standard_normal(count))
        y = model.simulate(u, rng.normal(size=model.largest_lag)) + v[:, None]
        if "y" in gaps.lower():
            y[(rng.uniform(size=count) < 0.15) & (np.arange(count) >= 10 * ("Y" in gaps))] = np.nan
        if "u" in gaps:
            u[[30, 33], [0, 1]] = np.nan
        us.append(u)
        ys.append(y)
    return Data(us, ys)


def case(name="oe", gaps="Y", constant=True, **more):
    """A record of two experiments, the unknowns, and a point of them off the truth."""
    model, apart = CASES[name]
    data, rng, layout = records(model, gaps, **more), np.random.default_rng(3), model.layout
    free = tuple(not isinstance(b, Linear) for b in layout.bases)
    denominator = len(model.noise_denominator) if apart else None
    unknowns = TransferUnknowns(layout, data.n_experiments, free, constant, len(model.c), denominator)
    x0 = rng.normal(size=(data.n_experiments, layout.first_row))
    mus = tuple(f.mu for f in model.nonlinearities)
    point = TransferPoint(model.a, mus, model.b, float(model.offset[0]), x0, model.c, model.noise_denominator)
    return data, unknowns, unknowns.pack(point) + 0.02 * rng.standard_normal(unknowns.size)


def errors(data, unknowns, x):
    """Predicted less measured outputs, zero where there is no error."""
    found = []
    predictor, point = TransferPredictor(data, unknowns), unknowns.unpack(x)
    for i, y in enumerate(predictor.simulate(point)):
        one = predictor.predict(point, i, y)
        found.append(np.where(one.state == 0, -one.innovations, 0.0))
    return np.concatenate(found)


def jacobian(data, unknowns, x):
    return np.column_stack([(errors(data, unknowns, x + step) - errors(data, unknowns, x - step)) / 2e-6
                            for step in 1e-6 * np.eye(x.size)])


def compress(data, unknowns, x, **how):
    return TransferPredictor(data, unknowns).compress(unknowns.unpack(x), **how)


def scale_rows(unknowns, x):
    """The directions between mu and b that change no prediction."""
    rows = np.zeros((len(unknowns.products), unknowns.shared))
    for row, (_, b) in zip(rows, unknowns.products):
        row[unknowns.slices[b]] = x[unknowns.slices[b]]
    return rows


def across_scale(unknowns, x):
    """A step that the weights of `scale_rows` do not count."""
    step, at = np.zeros(unknowns.shared), unknowns.slices["b0"]
    step[at] = [x[at][1], -x[at][0]]
    return step


@pytest.mark.parametrize("name", ["bj", "armax", "oe"])
@pytest.mark.parametrize("constant", [True, False])
def test_packing_is_undone(name, constant):
    _, unknowns, x = case(name, constant=constant)
    assert np.array_equal(unknowns.pack(unknowns.unpack(x)), x)
    assert name != "armax" or np.array_equal(unknowns.unpack(x).d, unknowns.unpack(x).a)


def assert_derivatives(data, unknowns, x):
    """Rows [sensitivities | states | errors] of all experiments against finite differences."""
    predictor, point, rows = TransferPredictor(data, unknowns), unknowns.unpack(x), []
    n, width = unknowns.memory, unknowns.memory + unknowns.shared + 1
    for i in range(data.n_experiments):
        # a forgotten initial state has no columns
        part = np.vstack([np.pad(block, ((0, 0), (width - block.shape[1], 0)))
                          for block, _ in predictor.blocks(point, i)])
        states = np.zeros((len(part), data.n_experiments * n))
        states[:, i * n : (i + 1) * n] = part[:, :n]
        rows.append(np.hstack([part[:, n:-1], states, part[:, -1:]]))
    whole = np.vstack(rows)
    assert whole[:, -1] == pytest.approx(errors(data, unknowns, x), abs=1e-13)
    for j, slope in enumerate(jacobian(data, unknowns, x).T):
        assert whole[:, j] == pytest.approx(slope, abs=2e-7 * (1 + np.max(np.abs(slope)))), j


# the state of a plant apart is lost where an input is missing, so that such records are refused
GAPS = [(name, gaps) for name, (_, apart) in CASES.items() for gaps in (("", "y") if apart else ("", "y", "u", "uy"))]


@pytest.mark.parametrize(("name", "gaps"), GAPS)
def test_sensitivities_are_the_derivatives_of_the_errors(name, gaps, monkeypatch):
    monkeypatch.setattr(sensitivities, "CHUNK", 17)
    assert_derivatives(*case(name, gaps))


@pytest.mark.parametrize("name", ["armax", "long"])
def test_derivatives_where_outputs_never_follow_one_another(name, monkeypatch):
    """Every second output: the recursion begins with held samples, whose derivatives do not count."""
    monkeypatch.setattr(sensitivities, "CHUNK", 17)
    data, unknowns, x = case(name, "")
    ys = [e.y.copy() for e in data.experiments]
    ys[0][::2], ys[1][1::2] = np.nan, np.nan
    data = Data([e.u for e in data.experiments], ys)
    predictor, point = TransferPredictor(data, unknowns), unknowns.unpack(x)
    for i, e in enumerate(data.experiments):
        found = predictor.predict(point, i, predictor.simulate(point)[i])
        assert np.count_nonzero(found.state == 0) == np.isfinite(e.y[10 * unknowns.layout.first_row :]).sum() > 5
    assert_derivatives(data, unknowns, x)


@pytest.mark.parametrize("chunk", [7, 50, 4096])
@pytest.mark.parametrize("name, gaps", [("armax", "uy"), ("arx", "u"), ("long", "y"), ("bj", "y"), ("ma", ""),
                                        ("oe", "y")])
def test_errors_are_those_of_the_models_predictor(name, gaps, chunk, monkeypatch):
    monkeypatch.setattr(sensitivities, "CHUNK", chunk)
    monkeypatch.setattr(sensitivities, "TABLE", 0)
    data, unknowns, x = case(name, gaps)
    (model, apart), point, predictor = CASES[name], unknowns.unpack(x), TransferPredictor(data, unknowns)
    functions = tuple(Nonlinearity(f.basis, mu) for f, mu in zip(model.nonlinearities, point.mus))
    truth = HammersteinTF(point.a, point.bs, functions, model.nk, point.offset, c=point.c, d=point.d,
                          inputs=data.inputs)
    expected = truth.innovations(data, list(point.x0) if apart else "fit")
    for i, y in enumerate(predictor.simulate(point)):
        found = predictor.predict(point, i, y)
        assert np.array_equal(found.state == 0, np.isfinite(expected[i][:, 0]))
        assert found.innovations == pytest.approx(np.nan_to_num(expected[i][:, 0]), abs=1e-11)


@pytest.mark.parametrize("name, constant", [("oe", True), ("oe", False), ("armax", True), ("bj", True)])
@pytest.mark.parametrize("method", ["gram", "qr"])
@pytest.mark.parametrize("chunk", [7, 50, 4096])
def test_compressed_sensitivities_equal_finite_differences(chunk, method, name, constant, monkeypatch):
    monkeypatch.setattr(sensitivities, "CHUNK", chunk)
    data, unknowns, x = case(name, constant=constant)
    e, slopes = errors(data, unknowns, x), jacobian(data, unknowns, x)
    matrix, pulled = compress(data, unknowns, x, method=method).whole
    size = np.linalg.norm(slopes, axis=0)
    assert np.max(np.abs(matrix.T @ matrix - slopes.T @ slopes) / np.outer(size, size)) < 1e-7
    assert np.max(np.abs(matrix.T @ pulled - slopes.T @ e) / size) < 1e-6
    found = compress(data, unknowns, x, method=method, gauge=scale_rows(unknowns, x))
    assert found.value == pytest.approx(e @ e, rel=1e-12)
    first = 0 if unknowns.apart else unknowns.layout.first_row
    assert found.rows == sum(np.isfinite(one.y[first:]).sum() for one in data.experiments)
    full = np.linalg.lstsq(slopes, e, rcond=1e-10)[0]
    assert found.remainder == pytest.approx(np.sum((e - slopes @ full) ** 2), rel=1e-7)


def test_eliminated_initial_states_follow_a_step():
    data, unknowns, x = case()
    e, slopes = errors(data, unknowns, x), jacobian(data, unknowns, x)
    found = compress(data, unknowns, x, gauge=scale_rows(unknowns, x))
    shared, states = slopes[:, : unknowns.shared], slopes[:, unknowns.shared :]
    step = 0.1 * np.random.default_rng(3).normal(size=unknowns.shared)
    assert np.allclose(found.follow(step), np.linalg.lstsq(states, -(e + shared @ step))[0], atol=1e-5)
    step = across_scale(unknowns, x)
    rest = e + shared @ step
    rest = rest - states @ np.linalg.lstsq(states, rest)[0]
    assert np.sum((found.root @ step + found.pull) ** 2) + found.remainder == pytest.approx(rest @ rest, rel=1e-7)


def test_directions_without_effect_get_weight_and_change_nothing():
    data, unknowns, x = case()
    plain, weighted = (compress(data, unknowns, x, gauge=gauge) for gauge in (None, scale_rows(unknowns, x)))
    assert plain.condition > 1e7 > 1e4 > weighted.condition
    assert weighted.value == pytest.approx(plain.value, rel=1e-12)
    across = across_scale(unknowns, x)  # a step along a gauge row itself is the only one that costs
    assert np.linalg.norm(weighted.root @ across) == pytest.approx(np.linalg.norm(plain.root @ across), rel=1e-6)


@pytest.mark.parametrize("method", ["gram", "qr"])
def test_gauge_changes_the_factor_of_one_experiment_in_its_own_directions_alone(method):
    data, unknowns, x = case(counts=(137,))
    rows, at = scale_rows(unknowns, x), unknowns.slices
    free, fixed = (compress(data, unknowns, x, gauge=gauge, method=method) for gauge in (None, rows))
    more = fixed.root.T @ fixed.root - free.root.T @ free.root
    weights = np.array([more[at[b].start, at[b].start] / x[at[b].start] ** 2 for _, b in unknowns.products])
    assert np.all(weights > 0)
    assert np.max(np.abs(more - (rows.T * weights) @ rows)) < 1e-8 * np.max(np.abs(free.root)) ** 2
    assert fixed.value == pytest.approx(free.value, rel=1e-10)
    most = {"gram": np.finfo(float).eps ** -0.5, "qr": 1e12}[method]  # a Gram matrix tells half the digits
    assert not free.condition < most and fixed.condition < 1e6


def test_ill_conditioned_sensitivities_are_factorised_by_qr():
    rng = np.random.default_rng(1)
    data = Data(rng.normal(size=400), rng.normal(size=400))
    layout = Layout(4, (4,), (0,), (Linear().with_interval(-3, 3),), ("y",), ("u",))
    unknowns = TransferUnknowns(layout, 1, (False,))
    x = np.concatenate([np.poly([0.99, 0.985, 0.98, 0.975])[1:], [1.0, 0.5, 0.2, 0.1, 0.0], np.zeros(4)])
    found = compress(data, unknowns, x)
    assert found.method == "qr" and found.condition > 1e6
    assert found.value == pytest.approx(np.sum(errors(data, unknowns, x) ** 2), rel=1e-10)


def test_instruments_hold_the_measured_output_in_the_columns_of_a():
    data, unknowns, x = case()
    point, na, p = unknowns.unpack(x), unknowns.layout.na, unknowns.shared
    predictor, a, columns = TransferPredictor(data, unknowns), np.concatenate([[1.0], point.a]), []
    for y, e in zip(predictor.simulate(point), data.experiments):
        missing = np.isnan(e.y[:, 0])
        past = np.concatenate([np.zeros(na), lfilter([1.0], a, np.where(missing, y, e.y[:, 0]))])
        rows = np.column_stack([-past[na - i : na - i + len(y)] for i in range(1, na + 1)])
        columns.append(np.where(missing[:, None], 0.0, rows))
    slopes = jacobian(data, unknowns, x)
    formed = np.column_stack([slopes[:, :p], np.vstack(columns), errors(data, unknowns, x)])
    formed -= slopes[:, p:] @ np.linalg.lstsq(slopes[:, p:], formed)[0]
    size = np.linalg.norm(formed, axis=0)
    assert np.max(np.abs(predictor.instruments(point) - formed.T @ formed) / np.outer(size, size)) < 1e-6


def test_kept_basis_functions_change_nothing(monkeypatch):
    data, unknowns, x = case()
    monkeypatch.setattr(sensitivities, "CHUNK", 50)
    with_table = *compress(data, unknowns, x).whole, TransferPredictor(data, unknowns).instruments(unknowns.unpack(x))
    monkeypatch.setattr(sensitivities, "TABLE", data.n_samples)
    anew = *compress(data, unknowns, x).whole, TransferPredictor(data, unknowns).instruments(unknowns.unpack(x))
    for ours, theirs in zip(with_table, anew):
        assert np.array_equal(ours, theirs)


def test_without_a_noise_filter_it_is_the_output_error():
    data, unknowns, x = case(counts=(300, 200))
    plain = compress(data, unknowns, x, method="qr")
    filtered = replace(unknowns, nc=1, nd=2)  # C = D = 1 as a point of a model with a noise filter
    ours = TransferPredictor(data, filtered).compress(replace(unknowns.unpack(x), c=np.zeros(1), d=np.zeros(2)),
                                                      method="qr")
    assert ours.value == pytest.approx(plain.value, rel=1e-10)
    ours, theirs = np.delete(ours.whole[0], np.arange(unknowns.shared, filtered.shared), axis=1), plain.whole[0]
    assert ours.T @ ours == pytest.approx(theirs.T @ theirs, rel=1e-8, abs=1e-8)
