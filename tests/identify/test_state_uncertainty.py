"""Intervals of state-space fits: against those of transfer functions, brute-force covariances, and repeated records."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from state_systems import two_outputs

import optid
from optid.bases import Polynomial
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.tangent import whiten_directions
from optid.models import HammersteinSS, Nonlinearity
from optid.statistics.coloured import long_autoregression, response_of, score_covariance

CUBIC = Nonlinearity(Polynomial(3, interval=(-1.0, 1.0), outside="extrapolate"), np.array([1.0, 0.3, 0.4]))


def record(seed, samples=600, process=0.0, sensor=0.05, units=1.0):
    rng = np.random.default_rng(seed)
    u = np.random.default_rng(99).uniform(-1, 1, samples)
    A, B, C, x, y = np.array([[1.4, -0.5], [1.0, 0.0]]), np.array([1.0, 0.0]), np.array([0.8, 0.3]), np.zeros(2), []
    for f in CUBIC(u):
        y.append(C @ x)
        x = A @ x + B * f + process * rng.normal(size=2)
    return Data(u, units * (np.array(y) + sensor * rng.normal(size=samples)))


def fitted(data, **arguments):
    return optid.fit(data, "hammerstein_ss.exact", nx=2, basis="polynomial:3", feedthrough=False, **arguments)


def test_they_are_those_of_the_transfer_function():
    """White noise at the output: the same model, least squares in another form."""
    data = record(0)
    ours = fitted(data).uncertainty
    theirs = optid.fit(data, "hammerstein_oe.exact", na=2, nb=2, nk=1, basis="polynomial:3").uncertainty
    for quantity in (lambda m: m.static_gain(0.3), lambda m: np.log(np.abs(m.frequency_response(0.3).ravel()))
                     + np.log(np.abs(m.nonlinearities[0].slope(0.2))), lambda m: np.sum(m.poles).real):
        one, other = ours.of(quantity), theirs.of(quantity)
        assert one.value == pytest.approx(other.value, rel=1e-5)
        assert one.error == pytest.approx(other.error, rel=0.2)  # the one estimates the colour of the noise


@pytest.mark.parametrize("factor", [1e-3, 1e4])
def test_units_of_the_output_scale_them(factor):
    rows = [np.array([row[1:] for row in fitted(record(3, units=unit)).uncertainty.table()]) for unit in (1.0, factor)]
    assert rows[1][:2] == pytest.approx(rows[0][:2], rel=1e-4)
    assert rows[1][2] == pytest.approx(factor * rows[0][2], rel=1e-4)


def test_a_change_of_the_states_changes_nothing():
    """Directions that change no output have no part in them: other starts, the same intervals."""
    data = record(1, process=0.02)
    one = fitted(data)
    other = fitted(data, initial=one.model.transform([[2.0, 0.3], [-0.5, 0.7]]), block_rows=6)
    for row, again in zip(one.uncertainty.table(), other.uncertainty.table()):
        assert again[1:] == pytest.approx(row[1:], rel=1e-4)


@pytest.mark.slow
def test_coloured_errors_scatter_the_estimate(monkeypatch):
    """Errors with a long memory: the standard error is that of repeated experiments, not that of white errors."""
    quantity = [lambda m: m.static_gain(0.0)]
    found = [fitted(record(seed, process=0.03, sensor=0.01)).uncertainty.of(quantity[0]) for seed in range(24)]
    scatter = np.std([one.value for one in found], ddof=1)
    printed = np.sqrt(np.mean([one.error**2 for one in found]))
    assert 0.65 < printed / scatter < 1.5

    def of_a_transfer_function():
        return optid.fit(record(0, process=0.03, sensor=0.01), "hammerstein_oe.exact", na=2, nb=2, nk=1,
                         basis="polynomial:3").uncertainty.of(quantity[0]).error

    assert 0.65 < of_a_transfer_function() / scatter < 1.5
    monkeypatch.setattr("optid.identify.prediction_error.error_noise.DEPENDENT", -1.0)  # no errors are coloured
    assert of_a_transfer_function() < 0.5 * scatter


def test_table_and_bands():
    fit = fitted(record(2, process=0.01), criterion="prediction")
    table = {name: rest for name, *rest in fit.uncertainty.table()}
    assert list(table) == ["pole 1, real", "pole 1, imaginary", "static gain[y,u]"]
    gain = fit.uncertainty.of(lambda m: m.static_gain(np.mean(record(2).u)))
    assert table["static gain[y,u]"][:2] == pytest.approx([float(gain.value), float(gain.error)])
    band = fit.uncertainty.band(0)
    assert np.all(band.lower < band.upper) and band.at.size == 201
    text = str(fit)
    assert "Poles and static gain" in text and "static gain[y,u]" in text and "depend on the choice" in text


def test_feedback_functions_have_bands():
    g = Nonlinearity(Polynomial(3, interval=(-2.0, 2.0), outside="extrapolate"), np.array([0.0, 0.1, -0.3]))
    plant = HammersteinSS([[0.7, 0.2], [-0.1, 0.5]], [[0.6], [0.3]], [[1.0, 0.0]], E=[[0.3], [0.1]], feedback=(g,))
    u = np.random.default_rng(0).uniform(-1, 1, 600)
    y = plant.simulate(u[:, None])[:, 0]
    fit = optid.fit(Data(u, y + 0.02 * np.random.default_rng(1).normal(size=600)), "hammerstein_ss.exact", nx=2,
                    basis="linear", feedback_basis="polynomial:3", feedthrough=False)
    band = fit.uncertainty.band(0, np.linspace(-0.5, 0.5, 5), family="feedback")
    assert np.all(band.error > 0) and np.all(band.error < 0.5)
    gain = fit.uncertainty.of(lambda m: m.static_gain(0.1))
    assert abs(gain.value - plant.static_gain(0.1)) < 5 * gain.error


def test_active_constraints_hold_the_intervals():
    data = record(4)
    free = fitted(data).uncertainty.of(lambda m: m.offset_y)
    fit = fitted(data, constraints=[lambda v: {"most": v["offset"] >= free.value[0] + 0.5 * free.error[0]}])
    found = fit.uncertainty.of(lambda m: m.offset_y)
    assert found.value == pytest.approx(free.value + 0.5 * free.error, abs=1e-6)
    assert "inequalities" in fit.uncertainty.meaning
    assert found.upper - found.value < 0.9 * (free.upper - free.value + free.error)  # it tells as much at least
    equal = fitted(data, constraints=[lambda v: {"equal": v["offset"] == 0.01}])
    assert equal.uncertainty.of(lambda m: m.offset_y).error == pytest.approx(0.0, abs=1e-9)


def test_too_few_samples_are_refused():
    fit = fitted(record(0, samples=30))
    few = replace(fit.problem.compressed, at=replace(fit.problem.compressed.at, rows=8))
    refuses(RankError, "8 rows for 9 parameters", lambda: few.spread(np.zeros((14, 1)), np.eye(14)))


@pytest.mark.parametrize("cuts", [(300,), (7, 100, 105, 300), (1, 2, 3, 300)])
def test_scatter_of_coloured_errors_is_that_of_the_whole_covariance(cuts):
    rng = np.random.default_rng(0)
    outputs, columns, ahead = 2, 3, 11
    rows = rng.normal(size=(300, outputs, columns))
    response = np.array([np.eye(2), *(0.8**i * rng.normal(size=(2, 2)) for i in range(1, ahead + 1))])
    root = np.linalg.cholesky([[1.0, 0.3], [0.3, 2.0]]).T
    filters = np.zeros((300 * outputs, (300 + ahead) * outputs))
    for k in range(300):
        for i in range(ahead + 1):
            filters[2 * k : 2 * k + 2, 2 * (k - i + ahead) : 2 * (k - i + ahead) + 2] = response[i]
    covariance = filters @ np.kron(np.eye(300 + ahead), root.T @ root) @ filters.T
    flat = rows.reshape(-1, columns)
    blocks = [(np.column_stack([rows[a:b].reshape(-1, columns), np.zeros(2 * (b - a))]), 0)
              for a, b in zip((0, *cuts), cuts)]
    expected = flat.T @ covariance @ flat
    assert score_covariance(blocks, response, root) == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())


def test_long_autoregression_and_its_response():
    lags, root, e, _ = two_outputs()
    found, scale = long_autoregression([e[:9000], e[9000:]], 2)
    assert found == pytest.approx(lags, abs=0.03)
    assert scale.T @ scale == pytest.approx(root.T @ root, abs=0.05)
    response = response_of(lags)
    assert response[1] == pytest.approx(lags[0])
    assert response[2] == pytest.approx(lags[0] @ lags[0] + lags[1])
    assert np.abs(response[-1]).max() < 0.05


def test_a_singular_direction_is_named():
    effect = np.random.default_rng(0).normal(size=(9, 5))
    effect[:, 4] = effect[:, 1] - 2.0 * effect[:, 2]
    with pytest.raises(RankError, match=r"combination of the parameters \(valve, tank\) has no effect"):
        whiten_directions(effect, np.zeros((0, 5)), {"A": (1,), "valve": (2,), "K": (1,), "tank": (1,)})
