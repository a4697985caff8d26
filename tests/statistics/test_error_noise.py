"""The noise that errors show, and the scatter of estimates under it, against whole covariance matrices."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from scipy.stats import bartlett
from state_systems import two_outputs

import optid
from optid.identify.prediction_error.error_noise import ErrorNoise
from optid.identify.uncertainty import uncertainty
from optid.statistics.coloured import autoregression, short_autoregression
from optid.statistics.experiments import equal_levels


def coloured(count, seed=0, pole=0.9):
    return lfilter([np.sqrt(1 - pole**2)], [1, -pole], np.random.default_rng(seed).standard_normal(count))


def output_errors(noise=0.9, seed=0, sizes=(0.3, 0.3), missing=0.0, samples=400):
    """Experiments of a first-order plant, with noise at the output."""
    us, ys = [], []
    for i, size in enumerate(sizes):
        rng = np.random.default_rng([seed, i])
        u = rng.uniform(-1, 1, samples)
        y = lfilter([0, 0.4], [1, -0.6], u) + size * lfilter([1], [1, -noise], rng.normal(size=samples))
        us.append(u)
        ys.append(np.where(rng.uniform(size=samples) < missing, np.nan, y))
    return optid.Data(us, ys)


def test_an_autoregression_is_found_also_beside_missing_samples():
    lags, root, e, w = two_outputs()
    e[np.random.default_rng(2).uniform(size=e.shape) < 0.2] = np.nan
    found, covariance = autoregression([e[:9000], e[9000:]], 6)
    assert found[:2] == pytest.approx(lags, abs=0.04) and np.abs(found[2:]).max(initial=0.0) < 0.05
    assert covariance == pytest.approx(root.T @ root, abs=0.08)
    one = short_autoregression([e[:, 0]], 5)
    assert one[0] == 1.0 and len(one) <= 6
    white, level = autoregression([w], 6)
    assert len(white) <= 1 and level == pytest.approx(root.T @ root, abs=0.05)


def test_constant_errors_have_no_autoregression():
    found, covariance = autoregression([np.zeros((50, 1))], 5)
    assert len(found) == 0 and covariance == pytest.approx(0.0)


@pytest.mark.parametrize("sizes", [(1.0, 1.0, 1.0), (1.0, 1.3, 0.8)])
def test_levels_are_compared_as_bartlett_does(sizes):
    samples = [size * np.random.default_rng(i).normal(size=n) for i, (size, n) in enumerate(zip(sizes, (90, 60, 300)))]
    ours = equal_levels(np.array([len(x) - 1 for x in samples]), np.array([np.var(x, ddof=1) for x in samples]))
    assert ours == pytest.approx(bartlett(*samples).pvalue, abs=0.02)  # which divides by its small-sample factor
    assert (ours < 0.01) == (sizes[1] > 1)
    assert equal_levels(np.zeros(2), np.zeros(2)) == 1.0  # no errors at all
    assert equal_levels(np.array([400]), np.array([1.0])) == 1.0 == equal_levels(np.array([5, 400]), np.array([1, 9.0]))


def test_noise_is_described_by_colour_and_level():
    white = [np.random.default_rng(i).normal(size=(500, 1)) for i in (7, 8)]
    assert ErrorNoise(white).words == () and ErrorNoise(white).response == pytest.approx(np.ones((1, 1, 1)))
    one = ErrorNoise([white[0], 2 * white[1]])
    assert one.words == ("of another level in every experiment",)
    assert [float(np.squeeze(root)) for root in one.roots] == pytest.approx([1, 2], rel=0.1)
    slow = ErrorNoise([coloured(500, 3)[:, None], coloured(500, 4)[:, None]])
    assert slow.words == ("coloured",) and slow.response[:4, 0, 0] == pytest.approx(0.9 ** np.arange(4), abs=0.12)
    together = ErrorNoise([np.column_stack([x, np.r_[0.0, x[:-1, 0]]]) for x in white])  # one output is the other, late
    assert together.coloured


@pytest.mark.parametrize("noise, sizes, missing", [
    (0.9, (0.3, 0.3), 0.0), (0.9, (0.3, 0.3), 0.1), (0.0, (0.1, 1.0), 0.0)])
def test_the_scatter_of_output_errors_is_that_of_the_whole_covariance(noise, sizes, missing):
    """Sensitivities by differences of simulations, and the covariance of all errors as a matrix."""
    data = output_errors(noise, sizes=sizes, missing=missing)
    fit = optid.fit(data, "oe.exact", na=1, nb=1, nk=1, offset=False, prove=False)
    found = fit.uncertainty.of(lambda m: np.r_[m.a, m.b[0]])
    model, step, columns = fit.model, 1e-6, []
    for da, db in ((step, 0.0), (0.0, step)):
        ends = [np.concatenate([lfilter([0, model.b[0][0] + s * db], [1, model.a[0] + s * da], e.u[:, 0])
                                for e in data.experiments]) for s in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    decay = [np.concatenate([(-model.a[0]) ** np.arange(400) * (i == j) for j in range(2)]) for i in range(2)]
    here = ~np.isnan(np.concatenate([e.y[:, 0] for e in data.experiments]))
    jacobian = np.column_stack([*columns, *decay])
    size = [s**2 / (1 - noise**2) for s in sizes]
    whole = np.zeros((800, 800))
    for i in range(2):
        whole[400 * i : 400 * (i + 1), 400 * i : 400 * (i + 1)] = size[i] * toeplitz(noise ** np.arange(400))
    jacobian, whole = jacobian[here], whole[np.ix_(here, here)]
    bread = np.linalg.inv(jacobian.T @ jacobian)
    errors = np.sqrt(np.diag(bread @ jacobian.T @ whole @ jacobian @ bread))[:2]
    assert found.error == pytest.approx(errors, rel=0.25)  # of an estimated colour
    plain = np.sqrt(bread[0, 0] * np.mean(np.diag(whole)))  # by which white errors would scatter a
    assert not noise or abs(np.log(found.error[0] / errors[0])) < 0.5 * abs(np.log(plain / errors[0]))
    word = "coloured" if noise else "another level"
    assert word in fit.uncertainty.meaning
    even = optid.fit(output_errors(0.0), "oe.exact", na=1, nb=1, nk=1, offset=False, prove=False)
    assert "errors" not in even.uncertainty.meaning


@pytest.mark.parametrize("offset", [True, "each"])
def test_experiments_of_different_noise_count_by_their_noise(offset):
    """Equation errors: the sandwich of the regression with all its rows."""
    rng, us, ys = np.random.default_rng(2), [], []
    for size, level in ((0.05, 0.0), (1.0, 0.0 if offset is True else 2.0)):
        u = rng.uniform(-1, 1, 300) + rng.uniform()
        us.append(u)
        ys.append(level + lfilter([0, 0.4], [1, -0.6], u) + lfilter([1], [1, -0.6], size * rng.normal(size=300)))
    fit = optid.fit(optid.Data(us, ys), "arx", na=1, nb=1, nk=1, offset=offset)
    found = fit.uncertainty.of(lambda m: np.r_[m.a, m.b[0]])
    rows = [np.column_stack([-y[:-1], u[:-1]]) for u, y in zip(us, ys)]
    ones = [np.column_stack([np.full(299, float(i == j or offset is True)) for j in range(1 if offset is True else 2)])
            for i in range(2)]
    matrix, target = np.hstack([np.vstack(rows), np.vstack(ones)]), np.concatenate([y[1:] for y in ys])
    left = target - matrix @ np.linalg.lstsq(matrix, target)[0]
    variances = np.repeat([np.mean(left[:299] ** 2), np.mean(left[299:] ** 2)], 299) * 598 / (598 - matrix.shape[1])
    bread = np.linalg.inv(matrix.T @ matrix)
    errors = np.sqrt(np.diag(bread @ (matrix.T * variances) @ matrix @ bread))[:2]
    assert found.error == pytest.approx(errors, rel=0.01)
    assert "another level in every experiment" in fit.uncertainty.meaning


def test_an_experiment_may_determine_nothing_by_itself():
    """Steps to a level each: one alone tells no coefficient of the input from the constant."""
    us = [np.full(60, level) for level in (-1.0, 0.5, 2.0)]
    ys = [lfilter([0, 0.4], [1, -0.6], u) + size * np.random.default_rng(i).normal(size=60)
          for i, (u, size) in enumerate(zip(us, (0.01, 0.01, 0.3)))]
    fit = optid.fit(optid.Data(us, ys), "arx", na=1, nb=1, nk=1)
    found = fit.uncertainty.of(lambda m: m.a)
    assert 0 < found.error[0] < 0.2 and "another level" in fit.uncertainty.meaning


@pytest.mark.slow
@pytest.mark.parametrize("formulation, more", [("oe.exact", {}), ("bj.exact", {"nc": 0, "nd": 0})])
def test_intervals_cover_in_coloured_noise(formulation, more):
    covered = []
    for seed in range(150):
        data = output_errors(seed=seed, sizes=(0.05, 0.05))
        fit = optid.fit(data, formulation, na=1, nb=1, nk=1, prove=False, **more)
        found = uncertainty(fit).of(lambda m: (lambda p: np.r_[p.a, p.b[0]])(getattr(m, "plant", m)))
        covered.append((found.lower <= [-0.6, 0.4]) & ([-0.6, 0.4] <= found.upper))
    assert np.all(np.mean(covered, axis=0) > 0.89), np.mean(covered, axis=0)
