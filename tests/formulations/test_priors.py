"""Priors on impulse responses: against the posterior mean and the marginal likelihood as they are written."""

import numpy as np
import pytest
from refusals import refuses
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

import optid
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.equation_error.compression import EquationStructure, compress
from optid.identify.equation_error.priors import KERNELS, families, kernel, likeliest

G = lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], np.r_[1.0, np.zeros(99)])


def record(seed=0, samples=200, noise=0.3):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=samples)
    y = lfilter(G, 1.0, u)
    return Data(u, 3.0 + y + noise * y.std() * rng.normal(size=samples))


def regressor(data, lags, nk=1):
    u, rows = data.u[:, 0], range(lags + nk - 1, data.n_samples)
    return np.array([[u[k - nk - j] for j in range(lags)] for k in rows]), data.y[lags + nk - 1 :, 0]


def statistics(data, lags, **changes):
    return compress(data, EquationStructure(0, lags, 1, "linear", **changes), own=False).statistics


@pytest.mark.parametrize("word", KERNELS)
@pytest.mark.parametrize("decay, correlation", [(0.3, 0.5), (0.95, -0.9), (0.7, 0.0)])
def test_kernels_are_covariances(word, decay, correlation):
    found = kernel(word, 40, decay, correlation)
    assert np.allclose(found, found.T)
    assert np.linalg.eigvalsh(found).min() > -1e-12 * found[0, 0]
    assert np.all(np.diff(np.diag(found)) < 0) and found[0, 0] == pytest.approx(decay)


@pytest.mark.parametrize("word", KERNELS)
def test_hyperparameters_are_those_of_the_largest_likelihood(word):
    """The likelihood of all outputs, the constant with a wide prior, falls to every side."""
    data = record(samples=120)
    prior = likeliest(word, statistics(data, 20))
    phi, y = regressor(data, 20)

    def likelihood(size, noise):
        spread = size * phi @ prior.covariance @ phi.T + noise * prior.noise[0] * np.eye(y.size)
        return multivariate_normal(np.zeros(y.size), spread + 1e6 * np.ones((y.size, y.size))).logpdf(y)

    top = likelihood(1.0, 1.0)
    for size, noise in ((1.3, 1.0), (1 / 1.3, 1.0), (1.0, 1.15), (1.0, 1 / 1.15)):
        assert likelihood(size, noise) < top
    assert abs(likelihood(1.001, 1.0) - likelihood(0.999, 1.0)) < 1e-3


@pytest.mark.parametrize("word", KERNELS)
def test_the_fit_is_the_posterior_mean(word):
    data = record(1)
    fit = optid.fit(data, "fir", nb=25, nk=1, prior=word)
    prior = likeliest(word, statistics(data, 25))
    phi, y = regressor(data, 25)
    centred = phi - phi.mean(axis=0)
    mean = prior.covariance @ centred.T @ np.linalg.solve(
        centred @ prior.covariance @ centred.T + prior.noise[0] * np.eye(y.size), y - y.mean())
    assert fit.model.b[0] == pytest.approx(mean, abs=2e-3 * np.abs(mean).max())
    assert fit.solution.status.value == "optimal"


@pytest.mark.slow
def test_it_is_better_than_least_squares():
    errors = {word: [np.linalg.norm(optid.fit(record(seed), "fir", nb=50, nk=1, prior=word).model.impulse_response(100)
                                    [:, 0, 0] - G) for seed in range(4)] for word in ("none", "tc", "dc", "ss")}
    for word in KERNELS:
        assert np.mean(errors[word]) < 0.6 * np.mean(errors["none"])


def test_constraints_hold_and_have_a_price():
    free = optid.fit(record(3), "fir", nb=30, nk=1)
    fit = optid.fit(record(3), "fir", nb=30, nk=1, constraints=[lambda v: {"late": v["b"][10:] >= 0}])
    assert np.min(free.model.b[0][10:]) < -1e-3
    assert np.min(fit.model.b[0][10:]) >= -1e-7
    assert fit.solution.objective > free.solution.objective
    assert [price.name for price in fit.prices] == ["late"] and fit.prices[0].active > 0


@pytest.mark.slow
def test_several_channels_functions_and_missing_samples():
    rng = np.random.default_rng(4)
    u = rng.normal(size=(400, 2))
    y = np.column_stack([lfilter(G, 1, u[:, 0] + 0.3 * u[:, 0] ** 2), lfilter(G, 1, u[:, 1])]) + 0.2 * rng.normal(
        size=(400, 2))
    y[100:104] = np.nan
    fit = optid.fit(Data(u, y), "arx", na=6, nb=6, nk=1, prior="tc")
    assert fit.model.is_stable
    hammerstein = optid.fit(Data(u[:, 0], y[:, 0]), "hammerstein_arx.exact", na=6, nb=6, nk=1, basis="polynomial:2",
                            prior="tc")
    assert hammerstein.solution.status.value == "optimal"
    layout = hammerstein.problem.compressed.layout
    assert [[list(part) for part in group] for group in families(layout)] == [
        [list(range(6))], [list(range(6, 18, 2)), list(range(7, 18, 2))]]


def test_intervals_are_those_of_the_posterior():
    fit = optid.fit(record(5), "fir", nb=30, nk=1, prior="tc")
    found = fit.uncertainty.of(lambda m: m.impulse_response(31)[1:, 0, 0])
    inside = (found.lower <= G[1:31]) & (G[1:31] <= found.upper)
    assert "posterior" in fit.uncertainty.meaning and inside.mean() > 0.8
    plain = optid.fit(record(5), "fir", nb=30, nk=1, prior="none").uncertainty.of(
        lambda m: m.impulse_response(31)[1:, 0, 0])
    assert np.all(found.error[20:] < 0.65 * plain.error[20:])


def test_words_are_refused():
    refuses(StructureError, "prior='rbf': use one of none, tc, dc, ss", optid.fit, record(), "fir", nb=10, prior="rbf")
    with pytest.raises(StructureError, match="loss 'huber': a prior takes its strength"):
        optid.fit(record(), "arx", na=2, nb=2, loss="huber", prior="tc")


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_nothing_but_noise_leaves_nothing():
    rng = np.random.default_rng(6)
    fit = optid.fit(Data(rng.normal(size=300), rng.normal(size=300)), "fir", nb=30, nk=1, prior="tc")
    assert np.linalg.norm(fit.model.b[0]) < 0.15
