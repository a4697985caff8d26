"""Intervals against textbook formulas, dense Jacobians, other parametrisations, and small Monte Carlo."""

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from scipy.signal import lfilter
from scipy.stats import t as student

import optid
from formulations.constraints import shape
from optid.errors import RankError, StructureError
from optid.identify.intervals import LocalEstimate, project
from optid.identify.uncertainty import align_signs, uncertainty

A, B = np.array([-1.2, 0.5]), np.array([0.8, 0.6])
BASIS = optid.Triangular(4, interval=(-1.0, 1.0))
NODES = np.linspace(-1.0, 1.0, 5)
F = np.array([-0.9, -0.2, 0.0, 0.3, 1.3])
STRUCTURE = {"na": 2, "nb": 2, "basis": BASIS}


def simulated(n=300, seed=0, sigma=0.1, f=F, offset=0.2):
    """One input, one output; the truth lies in the basis."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, n)
    right = lfilter(B, [1.0], np.interp(u, NODES, f)) + offset + sigma * rng.standard_normal(n)
    return optid.Data(u=u, y=lfilter([1.0], np.r_[1.0, A], right), dt=0.1)


def two_outputs(n=400, seed=1):
    """One input, two coupled outputs with correlated noise of unequal size."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, n)
    w = np.interp(u, NODES, F)
    e = rng.standard_normal((n, 2)) @ np.array([[0.3, 0.1], [0.0, 0.05]])
    y = np.zeros((n, 2))
    for k in range(1, n):
        drive = w[k] * np.array([1.0, 0.3]) + w[k - 1] * np.array([0.5, -0.2])
        y[k] = np.array([[0.6, 0.1], [-0.2, 0.4]]) @ y[k - 1] + drive + e[k]
    return optid.Data(u=u, y=y)


def dense(data, na, nb, basis):
    """Regressor [-y lags | basis by lag | 1] and y, incomplete rows left out."""
    y, u = data.y, data.u[:, 0]
    eta, first, n = basis.values(u), max(na, nb - 1), len(data.y)
    columns = [-y[first - i : n - i] for i in range(1, na + 1)] + [eta[first - j : n - j] for j in range(nb)]
    rows = np.hstack([*columns, np.ones((n - first, 1)), y[first:]])
    rows = rows[~np.isnan(rows).any(axis=1)]
    return rows[:, : -y.shape[1]], rows[:, -y.shape[1] :]


def jacobian(function, x):
    """Central differences."""
    columns = []
    for j in range(x.size):
        h = 1e-6 * max(1.0, abs(x[j]))
        above, below = x.copy(), x.copy()
        above[j] += h
        below[j] -= h
        columns.append((function(above) - function(below)) / (2 * h))
    return np.stack(columns, axis=-1)


@pytest.fixture(scope="module")
def plain():
    return optid.fit(simulated(), **STRUCTURE)


def test_errors_equal_the_fisher_matrix_of_another_parametrisation(plain):
    phi, y = dense(plain.data, 2, 2, BASIS)
    m = plain.model
    other = np.concatenate([m.a, m.nonlinearities[0].mu * m.b[0][0], [m.b[0][1] / m.b[0][0]], m.offset])

    def predicted(x):  # gauge b0 = 1, so no direction is redundant
        return phi @ np.concatenate([x[:2], x[2:6], x[6] * x[2:6], x[7:]])

    def reported(x):
        size = np.hypot(1.0, x[6])
        return np.concatenate([x[:2], [1 / size, x[6] / size], x[2:6] * size, x[7:]])

    j = jacobian(predicted, other)
    s2 = np.sum((y[:, 0] - predicted(other)) ** 2) / (len(y) - other.size)
    g = jacobian(reported, other)
    expected = np.sqrt(np.diag(g @ np.linalg.inv(j.T @ j) @ g.T) * s2)
    u = plain.uncertainty
    found = np.concatenate([u.a.error, u.b[0].error, u.mu[0].error, u.offset.error])
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    half = student.ppf(0.975, len(y) - other.size) * expected[:2]
    np.testing.assert_allclose(u.a.upper - m.a, half, rtol=1e-5)
    np.testing.assert_allclose(m.a - u.a.lower, half, rtol=1e-5)
    wider = replace(u, level=0.99).a.upper - m.a
    np.testing.assert_allclose(wider, half * student.ppf(0.995, len(y) - 8) / student.ppf(0.975, len(y) - 8), rtol=1e-6)


def test_the_gauge_does_not_touch_what_is_free_of_it(plain):
    reference = plain.uncertainty
    for gauge in ("gain", "b0"):
        u = optid.fit(plain.data, gauge=gauge, **STRUCTURE).uncertainty
        np.testing.assert_allclose(u.a.error, reference.a.error, rtol=1e-6)
        for quantity in (lambda m: m.theta(), lambda m: m.static_gain(0.3), lambda m: m.c0 * m.b[0].sum()):
            np.testing.assert_allclose(u.of(quantity).error, reference.of(quantity).error, rtol=1e-5)
    fixed = optid.fit(plain.data, gauge="b0", **STRUCTURE).uncertainty.b[0]
    assert fixed.error[0] < 1e-9 < fixed.error[1]


def covariance_of(u, quantity):
    """Covariance of a quantity without regard to inequalities."""
    scattered = u.source.slopes(quantity) @ u.source.local.scatter
    return scattered @ scattered.T


@pytest.mark.parametrize("missing", [0.0, 0.05])
def test_linear_arx_is_textbook_least_squares(missing):
    data, gone = simulated(), np.random.default_rng(5)
    data = optid.Data(*(np.where(gone.random(x.shape) < missing, np.nan, x) for x in (data.u, data.y)))
    u = optid.fit(data, "arx", na=2, nb=2).uncertainty
    phi, y = dense(data, 2, 2, optid.Linear())
    assert not missing or len(phi) < 260  # the errors are those of the rows that remain
    theta, rest, *_ = np.linalg.lstsq(phi, y[:, 0])
    covariance = np.linalg.inv(phi.T @ phi) * rest[0] / (len(y) - phi.shape[1])
    found = np.concatenate([u.a.error, u.b[0].error, u.offset.error])
    np.testing.assert_allclose(found, np.sqrt(np.diag(covariance)), rtol=1e-6)
    both = covariance_of(u, lambda m: np.concatenate([m.a, m.b[0], m.offset]))
    np.testing.assert_allclose(both, covariance, rtol=1e-5, atol=1e-9 * np.max(covariance))
    assert [row[0] for row in u.table()] == ["a1", "a2", "b0", "b1", "offset"]
    np.testing.assert_allclose([row[1] for row in u.table()], theta, rtol=1e-8)


def test_several_outputs_use_the_full_noise_covariance():
    fit = optid.fit(two_outputs(), na=1, nb=2, basis=BASIS)
    m, u = fit.model, fit.uncertainty
    phi, y = dense(fit.data, 1, 2, BASIS)

    def stacked(x):  # gauge: the first coefficient of b is one
        a, mu, b, d = x[:4].reshape(2, 2), x[4:8], np.concatenate([[1.0], x[8:11]]).reshape(2, 2, order="F"), x[11:]
        theta = np.vstack([a.T, np.outer(b[0], mu).T.reshape(4, 2), np.outer(b[1], mu).T.reshape(4, 2), d])
        return (phi @ theta).ravel(order="F")

    scale = m.b[0][0, 0]
    b, mu = (m.b[0] / scale).ravel(order="F")[1:], m.nonlinearities[0].mu * scale
    x = np.concatenate([m.a[0].ravel(), mu, b, m.offset])
    residual = y - stacked(x).reshape(y.shape, order="F")
    j = jacobian(stacked, x)
    noise = residual.T @ residual / (len(y) - x.size / 2)
    bread = np.linalg.inv(j.T @ j)
    covariance = bread @ j.T @ np.kron(noise, np.eye(len(y))) @ j @ bread
    np.testing.assert_allclose(u.source.noise, noise, rtol=1e-6)
    np.testing.assert_allclose(u.a.error.ravel(), np.sqrt(np.diag(covariance)[:4]), rtol=1e-4)
    np.testing.assert_allclose(u.offset.error, np.sqrt(np.diag(covariance)[11:]), rtol=1e-4)
    assert len(u.table()) == 4 + 4 + 2 and u.table()[1][0] == "a1[y1,y2]"


def test_known_b_makes_the_problem_linear():
    data = simulated()
    fit = optid.fit(data, constraints=[shape.fixed("b", B)], **STRUCTURE)
    phi, y = dense(data, 2, 2, BASIS)
    phi = np.column_stack([phi[:, :2], B[0] * phi[:, 2:6] + B[1] * phi[:, 6:10], phi[:, 10]])
    rest = np.linalg.lstsq(phi, y[:, 0])[1][0]
    expected = np.sqrt(np.diag(np.linalg.inv(phi.T @ phi)) * rest / (len(y) - phi.shape[1]))
    u = fit.uncertainty
    found = np.concatenate([u.a.error, u.mu[0].error, u.offset.error])
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert np.max(u.b[0].error) < 1e-6 * np.max(u.a.error)


def test_frequency_response_of_first_order():
    data = simulated()
    fit = optid.fit(data, "arx", na=1, nb=1)
    u, w = fit.uncertainty, np.array([0.3, 5.0])
    a, b, shift = fit.model.a[0], fit.model.b[0][0], np.exp(-1j * w * fit.model.dt)
    response = b / (1 + a * shift)
    slopes = np.stack([-response * shift / (1 + a * shift), response / b])  # d/da, d/db
    covariance = covariance_of(u, lambda m: np.concatenate([m.a, m.b[0]]))
    ratio = slopes / response
    for part, interval, size in zip((ratio.real, ratio.imag), u.frequency_response(w), (np.abs(response), 1.0)):
        error = np.sqrt(np.einsum("ik,ij,jk->k", part, covariance, part))
        np.testing.assert_allclose(interval.error[:, 0, 0], error * size, rtol=1e-5)
    magnitude, phase = u.frequency_response(w)
    np.testing.assert_allclose(magnitude.value[:, 0, 0], np.abs(response), rtol=1e-10)
    np.testing.assert_allclose(phase.value[:, 0, 0], np.angle(response), rtol=1e-10)


def test_changed_units_report_the_same_intervals(plain):
    free = optid.Triangular(4)
    raw = optid.fit(plain.data, na=2, nb=2, basis=free)
    scaled = optid.fit(plain.data.detrend().scale(), na=2, nb=2, basis=free)
    at = np.array([-0.7, 0.1, 0.8])
    np.testing.assert_allclose(scaled.uncertainty.a.error, raw.uncertainty.a.error, rtol=1e-5)
    for one, other in ((scaled.uncertainty.band(0, at), raw.uncertainty.band(0, at)),
                       (scaled.uncertainty.b[0], raw.uncertainty.b[0]),
                       (scaled.uncertainty.offset, raw.uncertainty.offset)):
        np.testing.assert_allclose(one.lower, other.lower, rtol=1e-5, atol=1e-8)
        np.testing.assert_allclose(one.upper, other.upper, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(scaled.uncertainty.source.noise, raw.uncertainty.source.noise, rtol=1e-6)


def test_band_without_offset_has_no_width_at_the_reference(plain):
    anchored, whole = (plain.uncertainty.band(0, [0.0, 0.6], offset=flag) for flag in (False, True))
    assert anchored.error[0] < 1e-12 < whole.error[0]
    np.testing.assert_allclose(whole.value, plain.model.f(np.array([0.0, 0.6])), rtol=1e-12)
    np.testing.assert_array_equal(plain.uncertainty.f[0].at, BASIS.grid())


def test_ridge_gives_the_posterior_of_its_prior():
    data = simulated(60, sigma=0.5)
    u = optid.fit(data, "arx", na=1, nb=3, ridge=5.0).uncertainty
    phi, y = dense(data, 1, 3, optid.Linear())
    h = phi.T @ phi
    inverse = np.linalg.inv(h + 5.0 * np.diag([0, 1, 1, 1, 0]))
    residual = y[:, 0] - phi @ (inverse @ phi.T @ y[:, 0])
    s2 = residual @ residual / (len(y) - np.trace(h @ inverse))
    found = np.concatenate([u.a.error, u.b[0].error, u.offset.error])
    np.testing.assert_allclose(found, np.sqrt(s2 * np.diag(inverse)), rtol=1e-6)
    assert "posterior" in u.meaning


def test_split_estimates_are_not_more_certain_than_the_exact_one(plain):
    exact = np.r_[plain.uncertainty.a.error, plain.uncertainty.b[0].error, plain.uncertainty.mu[0].error]
    for svd, most in (("whitened", 1.25), ("plain", 2.0)):
        u = optid.fit(plain.data, "hammerstein_arx.overparametrised", svd=svd, **STRUCTURE).uncertainty
        ratio = np.r_[u.a.error, u.b[0].error, u.mu[0].error] / exact
        assert 0.97 < np.min(ratio) and np.max(ratio) < most


def test_errors_describe_the_scatter():
    squares = []
    truth = np.concatenate([A, B, F[[0, 1, 3, 4]], [0.2]])
    for seed in range(60):
        fit = optid.fit(simulated(200, seed, sigma=0.2), prove=False, **STRUCTURE)
        u = fit.uncertainty
        parts = [u.a, u.b[0], u.mu[0], u.offset]
        value, error = (np.concatenate([getattr(p, name) for p in parts]) for name in ("value", "error"))
        squares.append(((value - truth) / error) ** 2)
    assert 0.8 < np.mean(squares) < 1.25


@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 8), st.sampled_from([1e-9, 1.0, 1e9]))
def test_projection_is_the_nearest_feasible_point(seed, n, r, unit):
    rng = np.random.default_rng(seed)
    rows, slack, points = rng.standard_normal((r, n)), rng.exponential(size=r), 3 * rng.standard_normal((4, n))
    slack[rng.random(r) < 0.5] = 0.0
    found = project(unit * points, 1e3 * rows, 1e3 * unit * slack) / unit
    assert np.min(found @ rows.T + slack) > -1e-9
    for candidate in [np.zeros(n), *(0.5 * project(5 * rng.standard_normal((3, n)), rows, slack))]:
        assert np.all(np.sum((points - found) * (candidate - found), axis=1) < 1e-8)


def test_interval_of_one_bounded_parameter():
    # estimate held at its bound, unconstrained minimum one standard deviation outside
    local = LocalEstimate(np.array([-1.0]), np.eye(1), 1e9, np.eye(1), np.zeros(1), draws=40_000)
    _, lower, upper = local.limits(np.eye(1), 0.95)
    assert lower[0] == pytest.approx(-1.96, abs=0.05)  # basic bootstrap at the bound
    assert upper[0] == pytest.approx(0.96, abs=0.05)  # posterior beyond it
    far = LocalEstimate(np.zeros(1), np.eye(1), 1e9, np.eye(1), np.full(1, 20.0))
    assert not far.held
    np.testing.assert_allclose(far.limits(np.eye(1), 0.95)[2], 1.96, atol=1e-3)


def test_constraints_out_of_reach_change_nothing(plain):
    held = optid.fit(simulated(2000, sigma=0.01), constraints=[shape.monotone("increasing")], **STRUCTURE).uncertainty
    free = optid.fit(simulated(2000, sigma=0.01), **STRUCTURE).uncertainty
    assert held.meaning == free.meaning
    np.testing.assert_allclose(held.f[0].upper - held.f[0].lower, free.f[0].upper - free.f[0].lower, rtol=1e-4)


@pytest.mark.parametrize("formulation, low, high", [("hammerstein_arx.exact", 0.5, 1.03),
                                                    ("hammerstein_arx.overparametrised", 0.4, 1.1)])
def test_active_constraints_narrow_the_band(formulation, low, high):
    data = simulated(200, 3, sigma=0.3, f=np.array([-0.8, 0.0, 0.0, 0.0, 1.0]))
    fit = optid.fit(data, formulation, constraints=[shape.monotone("increasing")], **STRUCTURE)
    assert fit.prices[0].active > 0
    held, free = fit.uncertainty, optid.fit(data, formulation, **STRUCTURE).uncertainty
    assert "hull" in held.meaning
    width, wald = (u.f[0].upper - u.f[0].lower for u in (held, free))
    assert low < np.mean(width / wald) < high
    for interval in (held.a, held.b[0], held.f[0], held.offset):
        assert np.all(interval.lower <= interval.value) and np.all(interval.value <= interval.upper)
    again = uncertainty(fit, seed=0).f[0]
    np.testing.assert_array_equal(again.lower, held.f[0].lower)
    assert np.any(uncertainty(fit, seed=1).f[0].lower != again.lower)


def test_static_gain_fixed_in_the_exact_programme():
    fit = optid.fit(simulated(), constraints=[shape.gain(3.0, at=0.6)], **STRUCTURE)
    found = fit.uncertainty.of(lambda m: m.static_gain(0.6))
    assert found.value == pytest.approx(3.0, abs=1e-5)
    assert found.error < 1e-4 * fit.uncertainty.of(lambda m: m.static_gain(-0.8)).error


@pytest.mark.slow
def test_bootstrap_agrees_with_the_linearisation(plain):
    refits = optid.bootstrap(plain, 100)
    assert refits.failed == 0 and len(refits.percentile.source.models) == 100
    for kind in (refits.percentile, refits.basic):
        np.testing.assert_allclose(kind.a.error, plain.uncertainty.a.error, rtol=0.3)
        np.testing.assert_allclose(kind.band(0, NODES).error, plain.uncertainty.band(0, NODES).error, rtol=0.35)
    low, high, value = refits.percentile.a.lower, refits.percentile.a.upper, plain.model.a
    np.testing.assert_allclose(refits.basic.a.lower, 2 * value - high)
    np.testing.assert_allclose(refits.basic.a.upper, 2 * value - low)
    first, second = (optid.bootstrap(plain, 40, seed=3).percentile.source.models for _ in range(2))
    assert first[7].a[0] == second[7].a[0]


@pytest.mark.slow
def test_bootstrap_keeps_holes_constraints_and_several_outputs():
    data = two_outputs()
    u, y = data.u.copy(), data.y.copy()
    u[50:53], y[120, 1], y[0, 0] = np.nan, np.nan, np.nan
    fit = optid.fit(optid.Data(u=u, y=y), "arx", na=1, nb=2, constraints=[lambda v: {"cap": v["a"][0, 0] >= -0.55}])
    refits = optid.bootstrap(fit, 40)
    assert min(model.a[0, 0, 0] for model in refits.percentile.source.models) > -0.55 - 1e-6
    assert refits.basic.a.value.shape == (1, 2, 2)
    linear = optid.fit(optid.Data(u=u, y=y), "arx", na=1, nb=2)
    np.testing.assert_allclose(optid.bootstrap(linear, 60).basic.b[0].error, linear.uncertainty.b[0].error, rtol=0.4)


@pytest.mark.slow
def test_bootstrap_serves_robust_losses():
    fit = optid.fit(simulated(150), "arx", na=2, nb=2, loss="huber")
    refuses(StructureError, "huber.*bootstrap", lambda: fit.uncertainty)
    assert np.all(optid.bootstrap(fit, 40).percentile.a.error > 0)


def test_refusals_name_the_reason_and_the_remedy(plain):
    for arguments, word in (({"level": 1.0}, "level"), ({"draws": 10}, "draws")):
        refuses(StructureError, word, uncertainty, plain, **arguments)
    shrunk = optid.fit(plain.data, "hammerstein_arx.nuclear", weight=1.0, **STRUCTURE)
    refuses(StructureError, "nuclear norm shrinks", lambda: shrunk.uncertainty)
    refuses(StructureError, "runs must be an integer of at least 40; got 3", optid.bootstrap, plain, 3)
    refuses(StructureError, "complex", plain.uncertainty.of, lambda m: m.poles)


def test_active_cones_are_refused_by_name(plain):
    a = float(np.linalg.norm(plain.model.a))
    matrix = [lambda v: {"short": cp.bmat([[0.9 * a * np.eye(2), v["a"][:, None]],
                                           [v["a"][None], np.array([[0.9 * a]])]]) >> 0}]
    fit = optid.fit(plain.data, "arx", na=2, nb=2, constraints=matrix)
    refuses(StructureError, "'short' is an active PSD", lambda: fit.uncertainty)
    cone = [lambda v: {"short": cp.SOC(cp.Constant(0.9 * a), v["a"])}]  # the same, as a row with a slope
    same = optid.fit(plain.data, "arx", na=2, nb=2, constraints=cone)
    assert same.solution.objective == pytest.approx(fit.solution.objective, rel=1e-6) and same.uncertainty.table()


def test_a_dead_input_is_refused_by_name():
    data = simulated()
    fit = optid.fit(data, constraints=[lambda v: {"off": v["mu"] == 0}], **STRUCTURE)
    refuses(RankError, "'b'", lambda: fit.uncertainty)


def test_alignment_only_flips_signs(plain):
    m = plain.model
    turned = replace(m, b=(-m.b[0],), nonlinearities=(replace(m.nonlinearities[0], mu=-m.nonlinearities[0].mu),))
    np.testing.assert_array_equal(align_signs(turned, m).b[0], m.b[0])
    np.testing.assert_array_equal(align_signs(turned, m).nonlinearities[0].mu, m.nonlinearities[0].mu)
    assert align_signs(m, m) is m


def determined(fit):
    """The part of the verdict about the standard error of the step response."""
    return next(part for part in fit.verdict.parts if part.name == "standard error of the step response")


@pytest.mark.parametrize("poles", [(0.9,), (0.92, 0.9, 0.88, 0.86)])
def test_errors_within_reach_are_those_of_refits_also_where_poles_and_zeros_all_but_cancel(poles):
    a = np.real(np.poly(poles))
    points = np.arange(0, 150, 3)
    u = np.repeat(np.random.default_rng(77).choice([0.0, 1.0, 2.0], 30), 20)
    clean = lfilter([0.0, 0.0, a.sum()], a, u)
    truth = lfilter([0.0, 0.0, a.sum()], a, np.ones(150))[points]

    def response(model):
        return model.step_response(150)[points].ravel()

    deviations, linear, reached = [], [], []
    for seed in range(6):
        y = clean + 0.05 * clean.std() * np.random.default_rng(seed).standard_normal(600)
        fit = optid.fit(optid.Data(u, y), "oe.exact", na=len(poles), nb=2, nk=2, prove=False)
        known = uncertainty(fit)
        deviations.append(response(fit.model) - truth)
        linear.append(float(np.sqrt(np.mean(known.of(response).error ** 2))))
        reached.append(float(np.sqrt(np.mean(known.source.error_within_reach(response) ** 2))))
        if len(poles) > 1:
            assert determined(fit).passed
    scatter = float(np.sqrt(np.mean(np.square(deviations))))
    assert 0.4 < np.median(reached) / scatter < 2.5
    assert (np.median(linear) > 1) == (len(poles) > 1)  # times the static gain
    if len(poles) == 1:
        np.testing.assert_allclose(reached, linear, rtol=0.02)


def test_a_response_that_the_record_does_not_determine_stays_uncertain():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(60)
    y = lfilter([0.0, 0.3], [1, -0.7], u) + 0.5 * rng.standard_normal(60)
    fit = optid.fit(optid.Data(u, y), "oe.exact", na=1, nb=1, nk=1, prove=False)
    found = determined(fit)
    assert not found.passed and float(found.value.removesuffix(" %")) > 12


def test_errors_within_reach_need_an_objective():
    fit = optid.fit(simulated(), "arx", na=2, nb=2, prove=False)
    assert uncertainty(fit).source.error_within_reach(lambda m: m.a) is None
