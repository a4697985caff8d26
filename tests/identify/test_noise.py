"""Noise statistics: what the data determine is recovered on simulated systems with known covariances."""

from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refuses
from scipy.optimize import approx_fprime
from scipy.signal import csd

from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.identify.noise import (
    _most_likely,
    _part,
    _starts,
    colour,
    noise_spectrum,
    residuals,
    whitening_gain,
    with_noise,
)
from optid.models.hammerstein_ss import HammersteinSS
from optid.models.innovation_gain import Likelihood, _parts, _run, _slope, covariance_of, refine_gain
from optid.models.kalman import NoiseCovariances, kalman_gain
from optid.show.summary import noise_table

A = np.array([[0.7, 0.35, 0.0], [-0.35, 0.7, 0.1], [0.0, 0.0, 0.5]])
B = np.array([[1.0, 0.2], [0.0, 0.8], [0.5, -0.6]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]])


def truth(seed=0, A=A, size=0.1):
    """A model with random Q, R, S and the gain that belongs to them."""
    W = size * np.random.default_rng(seed).normal(size=(5, 5))
    Q, R, S = (W @ W.T)[:3, :3], (W @ W.T)[3:, 3:], (W @ W.T)[:3, 3:]
    found = kalman_gain(A, C, Q, R, S)
    return HammersteinSS(A, B, C, K=found.K, noise=NoiseCovariances(Q, R, S, found.innovation))


def record(model, lengths=(20000,), seed=1, missing=0.0):
    rng = np.random.default_rng(seed)
    noise = model.noise
    cov = np.block([[noise.Q, noise.S], [noise.S.T, noise.R]])
    us, ys = [], []
    for N in lengths:
        u, wv = rng.normal(size=(N, 2)), rng.multivariate_normal(np.zeros(5), cov, N)
        x, y = rng.normal(size=3), np.zeros((N, 2))
        for k in range(N):
            y[k] = model.C @ x + wv[k, 3:]
            x = model.A @ x + model.B @ u[k] + wv[k, :3]
        y[rng.uniform(size=y.shape) < missing] = np.nan
        us.append(u)
        ys.append(y)
    return Data(us, ys)


def bare(model):
    return HammersteinSS(model.A, model.B, model.C)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("lengths", "missing", "most"), [((20000,), 0.0, 0.1), ((9000, 4000, 7000), 0.1, 0.12)])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gain_innovations_and_spectrum_are_recovered(lengths, missing, most, seed):
    model = truth(seed)
    found = with_noise(bare(model), record(model, lengths, seed + 10, missing))
    w = np.linspace(0.02, 3.1, 50)
    for got, true in ((found.K, model.K),
                      (found.noise.innovation, model.noise.innovation),
                      (noise_spectrum(found, w), noise_spectrum(model, w))):
        assert np.linalg.norm(got - true) < most * np.linalg.norm(true)


@pytest.mark.slow
def test_errors_shrink_like_the_root_of_the_record():
    model, errors = truth(4), []
    for N in (1000, 16000):
        runs = [with_noise(bare(model), record(model, (N,), seed)).K - model.K for seed in range(8)]
        errors.append(np.sqrt(np.mean(np.square(runs))))
    assert 2.5 < errors[0] / errors[1] < 6.5  # 4 in theory


def test_covariances_are_positive_semidefinite_and_give_the_gain_back():
    model = truth(5)
    found = with_noise(bare(model), record(model, (3000,)))
    noise = found.noise
    joint = np.block([[noise.Q, noise.S], [noise.S.T, noise.R]])
    assert np.linalg.eigvalsh(joint)[0] > -1e-12 * np.trace(joint)
    again = kalman_gain(A, C, noise.Q, noise.R, noise.S)
    assert again.K == pytest.approx(found.K, abs=1e-7) and again.innovation == pytest.approx(noise.innovation)


@pytest.mark.slow
def test_no_other_gain_predicts_better():
    model = truth(6)
    data = record(model, (1500,), missing=0.05)
    found = with_noise(bare(model), data)
    rest = residuals(bare(model), data)

    def loss(gain):
        return Likelihood(A, C, rest).at(gain.reshape(3, 2)).log_determinant

    slope = approx_fprime(found.K.ravel(), loss, 1e-6)
    assert np.abs(slope).max() < 1e-3
    rng = np.random.default_rng(0)
    best = loss(found.K.ravel())
    assert all(loss(found.K.ravel() + 0.02 * rng.normal(size=6)) > best for _ in range(20))


@pytest.mark.slow
def test_the_normal_equations_are_those_of_a_formed_jacobian():
    model = truth(7)
    data = record(model, (400, 150), missing=0.1)
    rest, gain = residuals(bare(model), data), 0.5 * model.K
    likelihood = Likelihood(A, C, rest)
    found = likelihood.at(gain)
    weight = np.linalg.inv(np.linalg.cholesky(found.covariance))

    def errors(flat):
        e = []
        for r, x in zip(rest, flat[6:].reshape(2, 3)):
            for row in r:
                e.append(np.where(np.isnan(row), 0.0, row - C @ x))
                x = A @ x + flat[:6].reshape(3, 2) @ e[-1]
        return (np.array(e) @ weight.T).ravel()

    start = np.concatenate([gain.ravel(), *found.starts])
    jacobian = np.column_stack([(errors(start + h) - errors(start - h)) / 2e-6 for h in 1e-6 * np.eye(12)])
    step = np.linalg.lstsq(jacobian, -errors(start), rcond=None)[0][:6]
    assert np.linalg.solve(*likelihood.equations(found)) == pytest.approx(step, rel=1e-4, abs=1e-7)
    weight = np.diag(1 / np.sqrt(np.diag(covariance_of(rest))))  # in which the initial states fit best
    best = np.linalg.norm(errors(start))
    assert all(np.linalg.norm(errors(start + sign * h)) > best for h in 0.01 * np.eye(12)[6:] for sign in (-1, 1))


@pytest.mark.parametrize("radius", [1.0, 1.02])
def test_poles_on_and_outside_the_unit_circle(radius):
    A1 = A * radius / np.max(np.abs(np.linalg.eigvals(A)))
    model = truth(8, A1)
    found = with_noise(bare(model), record(model, (200,) * 8))
    assert np.linalg.norm(found.K - model.K) < 0.25 * np.linalg.norm(model.K)
    assert np.max(np.abs(np.linalg.eigvals(A1 - found.K @ C))) < 1


def test_white_noise_at_the_outputs_needs_no_gain():
    model = HammersteinSS(A, B, C, noise=NoiseCovariances(np.zeros((3, 3)), np.diag([0.04, 1.0]), np.zeros((3, 2)),
                                                          np.diag([0.04, 1.0])))
    data = record(model, (8000,))
    found = with_noise(bare(model), data)
    assert np.abs(found.K / [5.0, 1.0]).max() < 0.05
    assert np.diag(found.noise.R) == pytest.approx([0.04, 1.0], rel=0.06)
    assert all(test.passed for test in colour(bare(model), data).values())


def test_the_colour_test_names_the_output():
    model = HammersteinSS(np.diag([0.9, 0.5]), np.eye(2), np.eye(2), K=np.zeros((2, 2)))
    rng, N = np.random.default_rng(3), 3000
    u, e = rng.normal(size=(N, 2)), 0.1 * rng.normal(size=(N, 2))
    for k in range(1, N):
        e[k, 1] += 0.6 * e[k - 1, 1]
    tests = colour(model, Data(u, model.simulate(u) + e))
    assert tests["y1"].passed and not tests["y2"].passed


def test_a_marginal_mode_that_no_output_sees_leaves_the_table_of_the_noise():
    covariance = NoiseCovariances(*(np.zeros((1, 1)),) * 3, np.eye(1))
    model = HammersteinSS([[1.0]], [[1.0]], [[0.0]], noise=covariance)
    data = Data(np.ones(60), np.random.default_rng(0).standard_normal(60))
    refuses(StructureError, "no stabilising solution", colour, model, data)
    assert noise_table(SimpleNamespace(model=model, data=data)).rows[0][3] == "-"


def test_the_spectrum_is_that_of_the_residuals():
    model = truth(9)
    rest = residuals(bare(model), record(model, (60000,)))[0]
    w = 2 * np.pi * csd(rest[:, 0], rest[:, 1], nperseg=256)[0]
    measured = np.array([[csd(rest[:, i], rest[:, j], nperseg=256)[1] for j in range(2)] for i in range(2)]) / 2
    expected = np.transpose(noise_spectrum(model, w), (1, 2, 0)).conj()  # scipy conjugates the first signal
    inner = slice(3, -3)
    error = np.linalg.norm((measured - expected)[..., inner]) / np.linalg.norm(expected[..., inner])
    assert error < 0.12


def test_scaled_data_are_in_the_units_of_their_model():
    model = truth(10)
    data = record(model, (4000,)).scale({"y1": 10.0, "y2": 0.1})
    scaled = HammersteinSS(A, B, np.diag([0.1, 10.0]) @ C)
    found = with_noise(scaled, data).with_transform(data.transform)
    plain = with_noise(bare(model), data.raw())
    assert found.K == pytest.approx(plain.K, rel=1e-4)
    assert found.noise.innovation == pytest.approx(plain.noise.innovation, rel=1e-4)


def test_without_noise_there_is_nothing_to_estimate():
    model, u = bare(truth()), np.random.default_rng(0).normal(size=(300, 2))
    found = with_noise(model, Data(u, model.simulate(u)))
    assert not found.K.any() and np.abs(found.noise.innovation).max() < 1e-15
    refuses(StructureError, "no noise covariances", noise_spectrum, model, [0.1])


def test_covariances_with_missing_samples_by_hand():
    x = np.array([[1.0, 2.0], [np.nan, 1.0], [3.0, np.nan], [0.0, 1.0]])
    assert covariance_of([x])[0, 0] == pytest.approx(10 / 3) and covariance_of([x])[0, 1] == pytest.approx(2 / 2)


@pytest.mark.parametrize("seed", range(5))
def test_a_covariance_of_collinear_outputs_with_gaps_is_one(seed):
    """Pairs of outputs are present at different samples: their means alone can be those of no signals."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((60, 1)) @ rng.standard_normal((1, 4)) + 1e-3 * rng.standard_normal((60, 4))
    x[rng.random(x.shape) < 0.3] = np.nan
    here = ~np.isnan(x)
    pairs = np.array([[np.mean((x[:, i] * x[:, j])[here[:, i] & here[:, j]]) for j in range(4)] for i in range(4)])
    assert np.linalg.eigvalsh(pairs)[0] < 0
    found = covariance_of([x])
    assert np.linalg.eigvalsh(found)[0] > 0
    np.testing.assert_allclose(np.diag(found), np.diag(pairs))


def test_missing_inputs_cut_the_record():
    model = truth(2)
    data = record(model, (6000, 3000))
    us = [u.copy() for u in data.u]
    us[0][[700, 2500, 2504]] = np.nan
    us[1][1] = np.nan
    found = with_noise(bare(model), Data(us, data.y))
    assert np.linalg.norm(found.K - model.K) < 0.15 * np.linalg.norm(model.K)
    rest = residuals(model, Data(us, data.y))
    lost = np.flatnonzero(np.isnan(rest[0][:, 0]))
    assert lost.tolist() == [700, *range(2500, 2505)]
    assert np.isnan(rest[1][:2]).all() and not np.isnan(rest[1][2:]).any()


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_the_slope_of_the_likelihood_by_finite_differences(missing):
    model = truth(7)
    rest, gain = residuals(bare(model), record(model, (3000, 1500), missing=missing)), 0.5 * model.K
    states = Likelihood(A, C, rest).at(gain).starts
    count = np.mean(np.sum(~np.isnan(np.vstack(rest)), axis=0))

    def errors(flat):  # the initial states stand still
        parts = _parts(A, C, flat.reshape(3, 2))
        return [r - _run(parts, r, x0.copy(), np.empty((0, 3))) for r, x0 in zip(rest, states)]

    def loss(flat):
        return count / 2 * np.linalg.slogdet(covariance_of(errors(flat)))[1]

    slope = approx_fprime(gain.ravel(), loss, 1e-7)
    assert _slope(A, C, gain, errors(gain.ravel())) == pytest.approx(-slope, rel=1e-4, abs=1e-2)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("lengths", [(40000,), (9000, 700, 12000)])
@pytest.mark.parametrize("missing", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["stationary", "grows", "coloured"])
def test_the_search_in_a_part_first_ends_where_the_search_in_all_does(lengths, missing, kind):
    model, rng = truth(11), np.random.default_rng(3)
    rest = residuals(bare(model), record(model, lengths, missing=missing))
    if kind == "grows":  # the information of a part is not that of the whole
        rest = [r * np.linspace(0.2, 2, len(r))[:, None] for r in rest]
    if kind == "coloured":  # no gain whitens
        rest = [r + 0.3 * np.roll(r, 5, axis=0) + 0.05 * rng.normal(size=r.shape) for r in rest]
    part = _part(rest, C.size)
    assert 3000 < sum(map(len, part)) < 0.5 * sum(lengths)
    assert all(any(np.shares_memory(p, r) for r in rest) for p in part)
    searched, likelihood = _most_likely(A, C, rest).gain, Likelihood(A, C, rest)
    whole = [refine_gain(likelihood, likelihood.at(gain)).gain for gain in (model.K, np.zeros((3, 2)))]
    found, *others = (likelihood.at(gain).log_determinant for gain in (searched, *whole))
    assert sum(lengths) / 2 * (found - min(others)) < 0.01
    assert np.max(np.abs(np.linalg.eigvals(A - searched @ C))) < 1


def test_a_part_that_shows_too_little_is_not_searched():
    rng = np.random.default_rng(0)
    quiet = 0.1 * rng.normal(size=(40000, 2))
    late = np.where(np.arange(40000)[:, None] < [0, 38000], np.nan, quiet)  # few samples have both outputs
    assert _part([late], 6)[0] is late and _part([quiet[:5000]], 6)[0].shape == (5000, 2)
    silent = quiet * [1.0, 0.0]
    assert _part([silent], 6)[0] is silent


def test_the_autoregression_of_the_errors_of_an_observer_shows_the_gain():
    rng = np.random.default_rng(7)
    k, e = truth(3).K, rng.standard_normal((20000, 2)) * [1.0, 0.3]
    gain, x, predicted, errors = 0.5 * k, np.zeros(3), np.zeros(3), np.empty((20000, 2))
    for t in range(20000):
        errors[t] = C @ (x - predicted) + e[t]
        x, predicted = A @ x + k @ e[t], A @ predicted + gain @ errors[t]
    errors[15000] = np.nan
    assert whitening_gain(A, C, gain, [errors]) == pytest.approx(k, abs=0.05)
    refuses(StructureError, "too few", whitening_gain, A, C, gain, [errors[:50]])
    refuses(StructureError, "predicted exactly", whitening_gain, A, C, gain, [errors[:15000] * [1.0, 0.0]])


def test_a_stable_gain_whose_run_leaves_the_range_of_numbers_is_refused():
    A, C, rest = np.array([[0.0, 1e200], [0.0, 0.0]]), np.array([[1.0, 1.0]]), [np.ones((20, 1))]
    refuses(DataError, "range of numbers", Likelihood(A, C, rest).at, np.zeros((2, 1)))


def test_a_start_whose_innovations_leave_the_range_of_numbers_is_left_out():
    """Without a gain the state of a plant of pole 1.5 grows beyond all numbers; with those of observers it does not."""
    rest = [np.random.default_rng(0).normal(size=(3000, 1))]
    starts = _starts(Likelihood(np.array([[1.5]]), np.array([[1.0]]), rest))
    assert starts and all(abs(1.5 - float(found.gain[0, 0])) < 1 for found in starts)


def test_a_model_without_states_has_the_noise_of_its_outputs():
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal((2, 300, 1))
    model = HammersteinSS(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[2.0]]))
    found = with_noise(model, Data(u, 2 * u + 0.1 * e)).noise
    np.testing.assert_allclose(found.R, 0.01 * np.mean(e**2), rtol=1e-9)
