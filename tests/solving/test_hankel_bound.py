"""The Hankel bound: below the error of every model of its order, and refused where it does not hold."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from scipy.optimize import least_squares

import optid
from optid.certificate.hankel import SignalPlaces, hankel_bounds
from optid.errors import RankError, StructureError


def simulate(a, b, c, d, phi, x0, offset_x, offset_y):
    x, found = np.array(x0, dtype=float), np.empty((len(phi), len(c)))
    for k, row in enumerate(phi):
        found[k] = c @ x + d @ row + offset_y
        x = a @ x + b @ row + offset_x
    return found


def random_model(rng, n, m, l, feedback=0):  # noqa: E741
    a = rng.normal(size=(n, n))
    a *= rng.uniform(0.3, 0.98) / max(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0), 1e-9) if n else 1.0
    d = rng.normal(size=(l, m))
    d[:, m - feedback :] = 0.0
    return a, rng.normal(size=(n, m)), rng.normal(size=(l, n)), d


@given(st.integers(0, 3), st.integers(0, 10_000), st.booleans())
@settings(max_examples=40, deadline=None)
def test_no_random_model_beats_the_bound(n, seed, gaps):
    """The data are near one model of order n; that model, and others of the order, have their errors measured."""
    rng = np.random.default_rng(seed)
    m, l, counts = 2, 2, (60, 45)  # noqa: E741
    models = [random_model(rng, n, m, l) for _ in range(2)]
    records, phis = [], []
    for count in counts:
        phi = rng.normal(size=(count, m))
        y = simulate(*models[0], phi, 3 * rng.normal(size=n), rng.normal(size=n), rng.normal(size=l))
        y += 0.3 * rng.normal(size=y.shape)
        if gaps:
            y[rng.integers(count, size=2), rng.integers(l, size=2)] = np.nan
        records.append(np.hstack([phi, y]))
        phis.append(phi)
    bounds = hankel_bounds(records, None, SignalPlaces(range(m), range(m, m + l)), largest=4, block_rows=(3, 5, 8))
    for model in models:
        for _ in range(3):
            changed = [part + 0.05 * rng.normal(size=part.shape) for part in model]
            offsets = rng.normal(size=n), rng.normal(size=l)
            error = 0.0
            for record, phi in zip(records, phis):
                difference = record[:, m:] - simulate(*changed, phi, rng.normal(size=n), *offsets)
                error += float(np.nansum(difference**2))
            assert np.all(bounds.values[:, n] <= error + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_no_fitted_model_beats_the_bound(n):
    """Every parameter, offsets and initial state included, fitted by least squares from many starts."""
    rng = np.random.default_rng(n)
    count = 80
    phi = rng.normal(size=(count, 1))
    truth = random_model(rng, 3, 1, 1)
    y = simulate(*truth, phi, rng.normal(size=3), np.zeros(3), np.array([2.0])) + 0.1 * rng.normal(size=(count, 1))
    bounds = hankel_bounds([np.hstack([phi, y])], None, SignalPlaces([0], [1]), largest=3, block_rows=range(3, 20))

    def error(x):
        a, b, c = x[: n * n].reshape(n, n), x[n * n : n * n + n][:, None], x[n * n + n : n * n + 2 * n][None]
        d, offset, x0 = x[-n - 2 : -n - 1][None], x[-n - 1 : -n], x[-n:]
        return np.clip(np.nan_to_num(simulate(a, b, c, d, phi, x0, np.zeros(n), offset) - y, nan=1e6), -1e6,
                       1e6).ravel()

    reached = []
    for _ in range(25):
        start = 0.5 * rng.normal(size=n * n + 3 * n + 2)
        with np.errstate(over="ignore", invalid="ignore"):
            reached.append(2 * least_squares(error, start, max_nfev=300).cost)
    assert bounds.value(n)[0] <= min(reached)
    assert bounds.value(n)[0] > 0.15 * min(reached)  # and it says something
    assert bounds.value(0)[0] >= bounds.value(1)[0] >= bounds.value(2)[0]


def test_feedback_from_measured_outputs_is_among_the_regressors():
    """An error of the P2 simulator obeys the bound; the last block row of the feedback cannot reach the output."""
    rng = np.random.default_rng(0)
    a, b, c = np.array([[0.7, 0.3], [-0.3, 0.7]]), np.array([[1.0], [0.5]]), np.array([[1.0, 0.0]])
    e = np.array([[0.3], [-0.4]])
    u, x, y = rng.uniform(-2, 2, (400, 1)), np.zeros(2), np.zeros((400, 1))
    for k in range(400):
        y[k] = c @ x + 0.1 * rng.normal()
        x = a @ x + b @ u[k] - e @ np.tanh(y[k]) + 0.05 * rng.normal(size=2)
    raw = np.hstack([u, y])

    def expand(raw):
        return np.hstack([raw[:, :1], np.tanh(raw[:, 1:]), raw[:, 1:]])

    def bounds_with(*feedback):
        return hankel_bounds([raw], expand, SignalPlaces([0], [2], feedback), block_rows=(4, 8, 15), largest=3)

    bounds = bounds_with(1)
    simulated = simulate(a, np.hstack([b, -e]), c, np.zeros((1, 2)), expand(raw)[:, :2], np.zeros(2), 0.0, 0.0)
    error = float(np.sum((y - simulated) ** 2))
    assert 0 < bounds.value(2)[0] <= error
    assert bounds.value(1)[0] > 1.5 * bounds.value(2)[0]
    without = bounds_with()
    assert np.all(without.values >= bounds.values - 1e-9)
    # a linear function of the output among the regressors leaves nothing to bound
    assert bounds_with(1, 2).value(0)[0] < 0.35 * bounds.value(0)[0]


def ar_plus_input(count=2000):
    """y(k) = 0.9 y(k-1) + u(k-1) + e(k): a one-step predictor of order one leaves e, a simulator e / (1 - 0.9 q)."""
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=count), rng.normal(size=count)
    y = np.zeros(count)
    for k in range(1, count):
        y[k] = 0.9 * y[k - 1] + u[k - 1] + e[k]
    return u, y, e


def test_one_step_errors_lie_below_the_bound_and_are_refused():
    u, y, e = ar_plus_input()
    bounds = hankel_bounds([np.column_stack([u, y])], None, SignalPlaces([0], [1]), block_rows=(40,), largest=2)
    one_step = float(np.sum(e[1:] ** 2))
    assert bounds.value(1)[0] > 1.5 * one_step  # the counterexample: it is no bound on that error
    refuses(StructureError, "was not measured by the simulator", bounds.bound, 1, one_step)
    simulated = np.zeros(len(u))
    for k in range(1, len(u)):
        simulated[k] = 0.9 * simulated[k - 1] + u[k - 1]
    error = float(np.sum((y - simulated) ** 2))
    assert bounds.bound(1, error).value <= error


def test_certificate_of_a_fit():
    rng = np.random.default_rng(1)
    bounds = hankel_bounds([rng.normal(size=(200, 3))], None, SignalPlaces([0], [2], [1]), largest=2,
                           block_rows=(4, 8, 16))
    found = bounds.bound(1, 500.0)
    assert found.value == bounds.value(1)[0] and found.method.startswith("Hankel") and not found.proved


def test_weights_and_units():
    rng = np.random.default_rng(2)
    raw = rng.normal(size=(150, 3))
    plain = hankel_bounds([raw], None, SignalPlaces([0], [1, 2]), block_rows=(5,), largest=2)
    scaled = hankel_bounds([raw * [1, 10, 0.1] + [0, 1e3, -5]], None, SignalPlaces([0], [1, 2]), block_rows=(5,),
                           largest=2, weights=np.array([0.1, 10.0]))
    assert np.allclose(plain.values, scaled.values, rtol=1e-6)


def test_exact_data_are_bounded_by_nothing():
    rng = np.random.default_rng(3)
    phi = rng.normal(size=(300, 1))
    y = simulate(*random_model(rng, 2, 1, 1), phi, np.ones(2), np.ones(2), np.ones(1))
    bounds = hankel_bounds([np.hstack([phi, y])], None, SignalPlaces([0], [1]), largest=3, block_rows=(5, 10, 20))
    assert bounds.value(2)[0] <= 1e-9 * bounds.energy and bounds.value(1)[0] > 1e-6 * bounds.energy
    assert "order 1 cannot reach" in bounds.bound(2, 1e-9 * bounds.energy).reason


@pytest.mark.parametrize("call, error, words", [
    (lambda raw: hankel_bounds([raw], None, SignalPlaces([0], [1]), block_rows=(1,)), StructureError, "two block"),
    (lambda raw: hankel_bounds([raw[:30]], None, SignalPlaces([0], [1]), block_rows=(20,)), RankError, "too few"),
    (lambda raw: hankel_bounds([raw], None, SignalPlaces([0], [1]), largest=2, block_rows=(4,)).value(7),
     StructureError, "0 to 2"),
])
def test_bad_arguments(call, error, words):
    refuses(error, words, call, np.random.default_rng(0).normal(size=(100, 2)))


def state_space_record(count=400, noise=0.2):
    rng = np.random.default_rng(4)
    u = rng.uniform(-1, 1, (count, 1))
    y = simulate(*random_model(rng, 3, 1, 1), u, np.ones(3), np.zeros(3), np.array([1.5]))
    return optid.Data(u=u, y=y + noise * rng.normal(size=y.shape), dt=1.0)


@pytest.mark.parametrize("nx", [1, 2, 3])
def test_every_subspace_fit_by_simulation_carries_its_bound(nx):
    fit = optid.fit(state_space_record(), "hammerstein_ss.sid", nx=nx, block_rows=6, observer="none")
    bound = fit.solution.bound
    assert bound.method.startswith("Hankel") and 0 < bound.value <= fit.solution.objective and not bound.proved
    simulated = fit.model.simulate(fit.data, x0="fit")
    error = np.sum((fit.data.experiments[0].y - simulated) ** 2)
    assert bound.value <= error
    assert error == pytest.approx(fit.solution.objective, rel=1e-6)  # what it bounds is the simulation error


def test_a_fit_in_innovation_form_carries_none():
    fit = optid.fit(state_space_record(), "hammerstein_ss.sid", nx=2, block_rows=6, observer="kalman")
    assert fit.solution.bound.value == -np.inf and "no simulation error" in fit.solution.bound.reason
