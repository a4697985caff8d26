"""Streamed simulation errors and sensitivities equal finite differences and formed matrices."""

import numpy as np
import pytest

import optid
from optid.bases import Linear, Triangular
from optid.models import HammersteinTF, Nonlinearity
from optid.models.layout import Layout
from optid.statistics import sensitivities
from optid.statistics.sensitivities import TransferPredictor
from optid.statistics.unknowns import TransferPoint, TransferUnknowns


def case(seed=0, constant=True):
    """Two inputs with delays, two experiments, missing outputs, a point that is no optimum."""
    rng = np.random.default_rng(seed)
    lengths = (137, 90)
    ys = [rng.normal(size=(n, 1)) for n in lengths]
    ys[0][5:9] = np.nan
    ys[1][20] = np.nan
    data = optid.Data([rng.uniform(-1, 1, (n, 2)) for n in lengths], ys)
    bases = (Triangular(4, (-1, 1)), Linear().with_interval(-1, 1))
    layout = Layout(3, (2, 3), (0, 2), bases, ("y",), ("u1", "u2"))
    unknowns = TransferUnknowns(layout, 2, (True, False), constant)
    poles = [0.8, 0.5 + 0.3j, 0.5 - 0.3j]
    point = TransferPoint(np.real(np.poly(poles))[1:], (rng.normal(size=4), np.ones(1)),
                          (rng.normal(size=2), rng.normal(size=3)), 0.3 if constant else 0.0,
                          rng.normal(size=(2, unknowns.memory)))
    return data, unknowns, point


def scale_row(unknowns, point):
    """The direction between mu and b that changes no simulation."""
    row = np.zeros((1, unknowns.shared))
    row[0, unknowns.slices["b0"]] = point.bs[0]
    return row


def errors(data, unknowns, x):
    found = TransferPredictor(data, unknowns).simulate(unknowns.unpack(x))
    whole = np.concatenate([y - e.y[:, 0] for y, e in zip(found, data.experiments)])
    return whole[~np.isnan(whole)]


def jacobian(data, unknowns, x, step=1e-6):
    columns = [(errors(data, unknowns, x + step * v) - errors(data, unknowns, x - step * v)) / (2 * step)
               for v in np.eye(len(x))]
    return np.column_stack(columns)


def test_packing_is_undone():
    for constant in (True, False):
        _, unknowns, point = case(constant=constant)
        x = unknowns.pack(point)
        assert x.size == unknowns.size
        assert np.array_equal(unknowns.pack(unknowns.unpack(x)), x)


@pytest.mark.parametrize("chunk", [7, 50, 4096])
def test_simulation_equals_that_of_the_model(chunk, monkeypatch):
    monkeypatch.setattr(sensitivities, "CHUNK", chunk)
    monkeypatch.setattr(sensitivities, "TABLE", 0)
    data, unknowns, point = case()
    layout = unknowns.layout
    model = HammersteinTF(point.a, point.bs, tuple(Nonlinearity(b, mu) for b, mu in zip(layout.bases, point.mus)),
                          layout.nk, point.offset)
    found = TransferPredictor(data, unknowns).simulate(point)
    for ours, theirs in zip(found, model.simulate(data, x0=list(point.x0))):
        assert np.max(np.abs(ours - theirs[:, 0])) < 1e-12


@pytest.mark.parametrize("constant", [True, False])
@pytest.mark.parametrize("method", ["gram", "qr"])
@pytest.mark.parametrize("chunk", [7, 50, 4096])
def test_compressed_sensitivities_equal_finite_differences(chunk, method, constant, monkeypatch):
    monkeypatch.setattr(sensitivities, "CHUNK", chunk)
    data, unknowns, point = case(constant=constant)
    x = unknowns.pack(point)
    e, slopes = errors(data, unknowns, x), jacobian(data, unknowns, x)
    matrix, pulled = TransferPredictor(data, unknowns).compress(point, method=method).whole
    size = np.linalg.norm(slopes, axis=0)
    assert np.max(np.abs(matrix.T @ matrix - slopes.T @ slopes) / np.outer(size, size)) < 1e-7
    assert np.max(np.abs(matrix.T @ pulled - slopes.T @ e) / size) < 1e-6
    found = TransferPredictor(data, unknowns).compress(point, method=method, gauge=scale_row(unknowns, point))
    assert found.value == pytest.approx(e @ e, rel=1e-12)
    assert found.rows == e.size
    full = np.linalg.lstsq(slopes, e, rcond=1e-10)[0]
    assert found.remainder == pytest.approx(np.sum((e - slopes @ full) ** 2), rel=1e-7)


def test_eliminated_initial_states_follow_a_step():
    data, unknowns, point = case()
    x = unknowns.pack(point)
    e, slopes = errors(data, unknowns, x), jacobian(data, unknowns, x)
    found = TransferPredictor(data, unknowns).compress(point, gauge=scale_row(unknowns, point))
    step = 0.1 * np.random.default_rng(3).normal(size=unknowns.shared)
    moves = np.linalg.lstsq(slopes[:, unknowns.shared :], -(e + slopes[:, : unknowns.shared] @ step), rcond=None)[0]
    assert np.allclose(found.follow(step), moves, atol=1e-5)
    step[unknowns.slices["b0"]] = [point.bs[0][1], -point.bs[0][0]]  # across the scale, where the weights do not count
    moves = np.linalg.lstsq(slopes[:, unknowns.shared :], -(e + slopes[:, : unknowns.shared] @ step), rcond=None)[0]
    rest = e + slopes @ np.concatenate([step, moves])
    assert np.sum((found.root @ step + found.pull) ** 2) + found.remainder == pytest.approx(rest @ rest, rel=1e-7)


def test_directions_without_effect_get_weight_and_change_nothing():
    data, unknowns, point = case()
    plain = TransferPredictor(data, unknowns).compress(point)
    weighted = TransferPredictor(data, unknowns).compress(point, gauge=scale_row(unknowns, point))
    assert plain.condition > 1e7 > 1e4 > weighted.condition
    assert weighted.value == pytest.approx(plain.value, rel=1e-12)
    across = np.zeros(unknowns.shared)  # a step along the gauge row itself is the only one that costs
    across[unknowns.slices["b0"]] = [point.bs[0][1], -point.bs[0][0]]
    assert np.linalg.norm(weighted.root @ across) == pytest.approx(np.linalg.norm(plain.root @ across), rel=1e-6)


def test_ill_conditioned_sensitivities_are_factorised_by_qr():
    rng = np.random.default_rng(1)
    data = optid.Data(rng.normal(size=400), rng.normal(size=400))
    layout = Layout(4, (4,), (0,), (Linear().with_interval(-3, 3),), ("y",), ("u",))
    unknowns = TransferUnknowns(layout, 1, (False,))
    nearly = np.poly([0.99, 0.985, 0.98, 0.975])[1:]
    point = TransferPoint(nearly, (np.ones(1),), (np.array([1.0, 0.5, 0.2, 0.1]),), 0.0, np.zeros((1, 4)))
    found = TransferPredictor(data, unknowns).compress(point)
    assert found.method == "qr" and found.condition > 1e6
    assert found.value == pytest.approx(np.sum(errors(data, unknowns, unknowns.pack(point)) ** 2), rel=1e-10)


def test_instruments_hold_the_measured_output_in_the_columns_of_a():
    data, unknowns, point = case()
    from scipy.signal import lfilter

    x, na, p = unknowns.pack(point), unknowns.layout.na, unknowns.shared
    simulated, a = TransferPredictor(data, unknowns).simulate(point), np.concatenate([[1.0], point.a])
    columns = []
    for y, e in zip(simulated, data.experiments):
        record = np.where(np.isnan(e.y[:, 0]), y, e.y[:, 0])
        past = np.concatenate([np.zeros(na), lfilter([1.0], a, record)])
        rows = np.column_stack([-past[na - i : na - i + len(y)] for i in range(1, na + 1)])
        columns.append(rows[~np.isnan(e.y[:, 0])])
    slopes = jacobian(data, unknowns, x)
    states = slopes[:, p:]
    formed = np.column_stack([slopes[:, :p], np.vstack(columns), errors(data, unknowns, x)])
    formed -= states @ np.linalg.lstsq(states, formed, rcond=None)[0]
    size = np.linalg.norm(formed, axis=0)
    found = TransferPredictor(data, unknowns).instruments(point)
    assert np.max(np.abs(found - formed.T @ formed) / np.outer(size, size)) < 1e-6


def test_kept_basis_functions_change_nothing(monkeypatch):
    data, unknowns, point = case()
    monkeypatch.setattr(sensitivities, "CHUNK", 50)
    kept = TransferPredictor(data, unknowns)
    with_table = *kept.compress(point).whole, kept.instruments(point)
    monkeypatch.setattr(sensitivities, "TABLE", data.n_samples)
    anew = TransferPredictor(data, unknowns)
    for ours, theirs in zip(with_table, (*anew.compress(point).whole, anew.instruments(point))):
        assert np.array_equal(ours, theirs)


@pytest.mark.parametrize("method", ["gram", "qr"])
def test_gauge_changes_the_factor_of_one_experiment_in_its_own_direction_alone(method):
    data, unknowns, point = case()
    data = data.select(experiments=[0])
    unknowns = TransferUnknowns(unknowns.layout, 1, unknowns.free)
    point = TransferPoint(point.a, point.mus, point.bs, point.offset, point.x0[:1])
    row = scale_row(unknowns, point)
    free = TransferPredictor(data, unknowns).compress(point, method=method)
    fixed = TransferPredictor(data, unknowns).compress(point, gauge=row, method=method)
    more = fixed.root.T @ fixed.root - free.root.T @ free.root
    weight = more[unknowns.slices["b0"].start, unknowns.slices["b0"].start] / point.bs[0][0] ** 2
    assert weight > 0 and np.max(np.abs(more - weight * row.T @ row)) < 1e-8 * np.max(np.abs(free.root)) ** 2
    assert fixed.value == pytest.approx(free.value, rel=1e-10)
    most = {"gram": np.finfo(float).eps ** -0.5, "qr": 1e12}[method]  # a Gram matrix tells half the digits
    assert not free.condition < most and fixed.condition < 1e6
