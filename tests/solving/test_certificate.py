"""Proofs of global optimality: against exact search and multistarts, never a false proof, bounds recomputed."""

import numpy as np
import pytest
from exact_search import hammerstein, monotone, regress, search_circle
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from scripts import benchmark

from optid.certificate.ladder import certify
from optid.certificate.minors import basis_from, cholesky, free_mask, project_minors, tangent_minors
from optid.certificate.shape_duals import LinearRows, sign_free_cut
from optid.errors import StructureError
from optid.structures.bilinear import best_of, minimise
from optid.structures.rank_one import Point, RankOne, reduce

fits = benchmark("rank_one_fits")
minimise_in_cones, solve_certified = fits.minimise_in_cones, fits.solve_certified

SHAPES = st.tuples(st.integers(2, 4), st.integers(2, 5))


def recompute(problem: RankOne, evidence) -> float:
    """D = c - g^T S^-1 g in the original coordinates, from the multipliers, by dense algebra (no constraints)."""
    lifted, slope = problem.root.T @ problem.root, problem.root.T @ problem.target
    change = np.linalg.inv(evidence.core.whitening.columns(np.eye(len(evidence.minors))))
    lifted[problem.linear:, problem.linear:] += change.T @ evidence.minors @ change
    assert np.linalg.eigvalsh(lifted)[0] > 0
    return problem.value(0 * slope) - slope @ np.linalg.solve(lifted, slope)


@given(SHAPES, st.integers(0, 1000))
def test_projection_is_onto_forms_that_vanish_on_rank_one(shape, seed):
    p, nb = shape
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((p * nb, p * nb))
    matrix = matrix + matrix.T
    minors = project_minors(matrix, shape)
    z = np.kron(rng.standard_normal(nb), rng.standard_normal(p))
    assert abs(z @ minors @ z) < 1e-12 * (z @ z) * np.abs(matrix).max()
    assert np.array_equal(minors, minors.T)
    assert project_minors(minors, shape) == pytest.approx(minors, abs=1e-14)
    listed = []
    for i in range(p):
        for k in range(i + 1, p):
            for j in range(nb):
                for m in range(j + 1, nb):
                    form = np.zeros((p * nb, p * nb))
                    for a, b, sign in ((j * p + i, m * p + k, 1.0), (m * p + i, j * p + k, -1.0)):
                        form[a, b] = form[b, a] = sign
                    listed.append(form.ravel())
    span = np.array(listed).T
    best = span @ np.linalg.lstsq(span, matrix.ravel(), rcond=None)[0]
    assert minors.ravel() == pytest.approx(best, abs=1e-10)


@given(SHAPES, st.integers(0, 1000))
def test_tangent_minors_reproduce_the_gradient(shape, seed):
    p, nb = shape
    rng = np.random.default_rng(seed)
    mu, b = rng.standard_normal(p), rng.standard_normal(nb)
    b /= np.linalg.norm(b)
    gradient = rng.standard_normal(shape)
    gradient = gradient - np.outer(gradient @ b, b)
    gradient = gradient - np.outer(mu, mu @ gradient) / (mu @ mu)
    minors = tangent_minors(gradient, mu, b)
    assert minors @ np.kron(b, mu) == pytest.approx(gradient.T.ravel(), abs=1e-12 * (1 + np.abs(minors).max()))
    other = np.kron(rng.standard_normal(nb), rng.standard_normal(p))
    assert other @ minors @ other == pytest.approx(0.0, abs=1e-11 * (1 + np.abs(minors).max()) * (other @ other))


def test_free_minors_do_not_move_the_point():
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((12, 12))
    free = project_minors(matrix + matrix.T, (4, 3)) * free_mask((4, 3))
    assert not free[0].any()
    assert project_minors(free, (4, 3)) == pytest.approx(free, abs=1e-15)
    direction = rng.standard_normal(5)
    direction /= np.linalg.norm(direction)
    turn = basis_from(direction)
    assert turn.T @ turn == pytest.approx(np.eye(5), abs=1e-14) and turn[:, 0] == pytest.approx(direction)


def test_cholesky_refuses_the_boundary():
    assert cholesky(np.diag([1.0, 1e-6])) is not None
    assert cholesky(np.diag([1.0, 0.0])) is None
    assert cholesky(np.diag([1.0, 1e-14])) is None


@pytest.mark.parametrize("seed", range(12))
def test_two_lags_are_always_proved_and_agree_with_exact_search(seed):
    """For n_b = 2 the relaxation is exact, so every problem is provable."""
    problem = hammerstein(seed, 2, 4 + seed % 4, 50, snr=(0.3, 1.0)[seed % 2], correlation=0.9 * (seed % 3 > 0),
                          rank=1 + seed % 2)
    result = solve_certified(problem)
    exact = search_circle(problem)
    bound = result.certification.bound
    assert bound.proved and not result.certification.better
    assert result.solution.value == pytest.approx(exact, rel=1e-9)
    assert bound.value <= exact * (1 + 1e-9)


@pytest.mark.sampled(6)
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("seed", range(6))
def test_bounds_never_exceed_the_best_known_value(seed, channels):
    problem = hammerstein(seed, 3, 5, 40 * channels, snr=0.3, correlation=0.9, channels=channels, rank=2)
    best = best_of(reduce(problem), 50, seed=5)
    result = solve_certified(problem, effort=("ascent", "sdp")[seed % 2])
    bound = result.certification.bound
    assert np.isfinite(bound.value)
    assert bound.value <= best.value * (1 + 1e-9)
    if bound.proved:
        assert result.solution.value <= best.value * (1 + 1e-8)
    assert recompute(problem, bound.multipliers) == pytest.approx(bound.value, rel=1e-7)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("effort", ["instant", "ascent", "sdp"])
def test_a_worse_stationary_point_is_never_proved(effort):
    """Stationary points above the optimum must be refused on every rung, and the SDP must point to a better one."""
    refused = 0
    for seed in range(40):
        problem = hammerstein(seed, 3, 5, 40, snr=0.3, correlation=0.9, rank=2)
        core = reduce(problem)
        best = best_of(core, 20)
        for start in range(4, 8):
            worse = best_of(core, start + 1, seed=seed, first=start)
            if worse.value > best.value * (1 + 1e-6):
                found = certify(problem, worse.point, effort=effort)
                assert not found.bound.proved
                assert found.bound.value <= best.value * (1 + 1e-9)
                if effort == "sdp":
                    restarted = min(minimise(problem, point).value for point in found.better)
                    assert restarted == pytest.approx(best.value, rel=1e-8)
                refused += 1
        if refused >= 3:
            return
    assert refused > 0


def test_a_point_that_is_not_stationary_is_not_proved():
    problem = hammerstein(0, 3, 5, 100)
    point = minimise(problem).point
    moved = Point(point.w, (point.mus[0] * 1.01,), point.bs)
    found = certify(problem, moved)
    assert not found.bound.proved
    assert found.bound.value <= problem.value(point.lift()) * (1 + 1e-9)


def test_easy_problems_need_one_cholesky():
    problem = hammerstein(0, 6, 8, 3000, snr=10.0)
    result = solve_certified(problem)
    assert result.certification.bound.method == "instant" and result.certification.bound.proved
    assert result.starts == 1
    assert recompute(problem, result.certification.bound.multipliers) == pytest.approx(result.solution.value, rel=1e-9)


@pytest.mark.parametrize("channels", [1, 2])
def test_noise_free(channels):
    problem = hammerstein(1, 4, 5, 200, snr=np.inf, correlation=0.9, channels=channels)
    result = solve_certified(problem)
    assert result.solution.value < 1e-20 * problem.scale
    assert result.certification.bound.proved


def test_a_silent_channel():
    noisy = hammerstein(2, 3, 4, 200, snr=3.0, channels=2, silent=(1,))
    assert solve_certified(noisy).certification.bound.proved
    exact = hammerstein(2, 3, 4, 200, snr=np.inf, channels=2, silent=(1,))
    result = solve_certified(exact)
    assert result.certification.bound.proved
    assert np.linalg.norm(result.solution.point.mus[1]) < 1e-9 * np.linalg.norm(result.solution.point.mus[0])


def test_a_channel_set_to_zero_is_refused_unless_its_gradient_vanishes():
    problem = hammerstein(3, 3, 4, 200, channels=2)
    alone = RankOne(problem.root[:14, :14], problem.target[:14],
                    problem.remainder + float(np.sum(problem.target[14:] ** 2)), problem.blocks[:1], 2)
    first = minimise(alone).point
    zeroed = Point(first.w, (first.mus[0], np.zeros(4)), (first.bs[0], np.eye(3)[0]))
    assert not certify(problem, zeroed, effort="ascent").bound.proved
    decoupled = RankOne(problem.root * np.r_[np.ones(14), np.zeros(12)] + np.diag(np.r_[np.zeros(14), np.ones(12)]),
                        np.r_[problem.target[:14], np.zeros(12)], 1.0, problem.blocks, 2)
    assert certify(decoupled, zeroed, effort="ascent").bound.proved


@pytest.mark.parametrize(("nb", "p"), [(1, 5), (5, 1)])
def test_linear_problems_are_exact(nb, p):
    result = solve_certified(hammerstein(0, nb, p, 60))
    assert result.certification.bound.method == "exact" and result.certification.bound.proved
    assert result.certification.bound.value == pytest.approx(result.solution.value, rel=1e-12)


def test_one_lag_channel_beside_a_bilinear_one():
    rng = np.random.default_rng(4)
    design = rng.standard_normal((80, 2 + 3 + 12))
    problem = regress(design, design @ rng.standard_normal(17) + rng.standard_normal(80), [(3, 1), (4, 3)], 2)
    result = solve_certified(problem)
    assert result.certification.bound.proved
    assert result.solution.value <= best_of(reduce(problem), 50, seed=3).value * (1 + 1e-10)


def test_size_limit_is_said():
    for seed in range(60):
        problem = hammerstein(seed, 3, 6, 40, snr=0.3, correlation=0.9, rank=2)
        found = certify(problem, minimise(problem).point, steps=1, max_size=3)
        if not found.bound.proved:
            assert "45 multipliers exceeds the limit 3" in found.bound.reason
            return
    pytest.fail("every problem was proved by one step")


def test_sign_free_cut_reproduces_the_multiplier_force():
    rng = np.random.default_rng(0)
    cone = rng.standard_normal((4, 4))
    delta = np.array([1.0, 0.0, 2.0, 0.0])
    mu, nu = np.linalg.solve(cone, delta), np.array([0.0, 3.0, 0.0, 0.5])
    weights = sign_free_cut(nu, cone, mu)
    assert (weights >= 0).all()
    assert cone.T @ weights @ cone @ mu == pytest.approx(cone.T @ nu / 2, rel=1e-10)


@pytest.mark.parametrize("seed", range(8))
def test_monotone_bounds_hold_for_both_signs(seed):
    """The bound must not exceed the best constrained value over many starts, and proofs must be of the best."""
    problem, increments = monotone(seed, 2 + seed % 3, 5, 70, snr=0.4)
    found = minimise_in_cones(problem, {0: increments})
    best = min(found.value, minimise_in_cones(problem, {0: increments}, count=30, seed=9).value)
    for effort in ("ascent", "sdp"):
        bound = certify(problem, found.point, cones={0: increments}, effort=effort).bound
        assert bound.value <= best * (1 + 1e-9)
        assert not bound.proved or found.value <= best * (1 + 1e-8)
    assert bound.proved
    weights = bound.multipliers.cuts[0]
    for pair in weights.reshape(-1, *weights.shape[2:]):
        assert np.linalg.eigvalsh((pair + pair.T) / 2)[0] >= -1e-12 * np.abs(weights).max()


def test_monotone_bound_with_two_lags_against_a_search_over_directions():
    problem, increments = monotone(2, 2, 4, 40, snr=0.3)
    from scipy.optimize import nnls
    n = problem.linear
    head = np.linalg.qr(problem.root[:, :n])[0]
    best = np.inf
    for angle in np.linspace(0, 2 * np.pi, 4001):
        b = np.array([[np.cos(angle)], [np.sin(angle)]])
        design = problem.root[:, n:] @ np.kron(b, np.linalg.inv(increments))
        best = min(best, nnls(design - head @ (head.T @ design),
                              problem.target - head @ (head.T @ problem.target))[1] ** 2 + problem.remainder)
    found = minimise_in_cones(problem, {0: increments})
    bound = certify(problem, found.point, cones={0: increments}).bound
    assert bound.proved
    assert found.value <= best <= found.value * (1 + 1e-5)


def test_a_point_outside_its_constraints_is_never_proved():
    problem, increments = monotone(0, 3, 5, 100, snr=0.3)
    free = minimise(problem).point
    for effort in ("ascent", "sdp"):
        bound = certify(problem, free, cones={0: increments}, effort=effort).bound
        assert not bound.proved and "violates" in bound.reason
    row = np.ones((1, len(problem.target)))
    right = np.array([row[0] @ free.lift() - 1.0])
    assert not certify(problem, free, linear=LinearRows(row, right, np.array([False]))).bound.proved


def test_constrained_optimum_is_not_proved_without_its_cone_and_no_cone_is_needed_when_inactive():
    problem, increments = monotone(0, 3, 5, 100, snr=0.3)
    found = minimise_in_cones(problem, {0: increments})
    free = minimise(problem)
    assert free.value < found.value * (1 - 1e-6)
    assert not certify(problem, found.point).bound.proved
    assert certify(problem, found.point, cones={0: increments}).bound.proved


def with_first_unknown(problem, value):
    """The problem of two linear unknowns in which the first has a value."""
    smaller = np.column_stack([problem.root[:, 1:], problem.target - problem.root[:, 0] * value])
    triangle, n = np.linalg.qr(smaller, mode="r"), len(problem.target) - 1
    return RankOne(np.triu(triangle[:n, :n]), triangle[:n, n], problem.remainder + triangle[n, n] ** 2, problem.blocks,
                   1)


@given(st.integers(0, 10**4))
def test_lifted_equality_agrees_with_elimination(seed):
    """w_1 fixed by E z = f against the problem in which it is substituted."""
    problem = hammerstein(seed, 3, 4, 120, snr=3.0, linear=2)
    fixed = 0.7
    substituted = with_first_unknown(problem, fixed)
    found = minimise(substituted)
    point = Point(np.r_[fixed, found.point.w], found.point.mus, found.point.bs)
    linear = LinearRows(np.eye(1, len(problem.target)), np.array([fixed]), np.array([True]))
    lifted = certify(problem, point, linear=linear, effort="ascent").bound
    direct = certify(substituted, found.point, effort="ascent").bound
    assert lifted.proved == direct.proved
    if direct.proved:
        assert lifted.value == pytest.approx(direct.value, rel=1e-8)


def test_lifted_inequality_is_used_only_in_its_direction():
    problem = hammerstein(1, 3, 4, 200, snr=3.0)
    free, row = minimise(problem).point, np.eye(1, len(problem.target))
    limit = np.array([free.w[0] - 0.5])
    shifted = RankOne(problem.root, problem.target, problem.remainder, problem.blocks, 2)
    inner = minimise(with_first_unknown(problem, limit[0])).point
    point = Point(np.r_[limit, inner.w], inner.mus, inner.bs)
    at_limit = certify(shifted, point, linear=LinearRows(row, limit, np.array([False])))
    assert at_limit.bound.proved
    assert at_limit.bound.multipliers.linear[0] > 0
    assert not certify(shifted, point, linear=LinearRows(-row, -limit, np.array([False]))).bound.proved
    inactive = certify(shifted, free, linear=LinearRows(row, limit + 10.0, np.array([False])))
    assert inactive.bound.proved and inactive.bound.multipliers.linear[0] == 0


def test_sign_of_b_as_a_lifted_constraint_with_a_cone():
    """A static-gain row on theta together with the monotone cone: bound below a dense multistart, on every rung."""
    problem, increments = monotone(4, 2, 4, 60, snr=1.0)
    found = minimise_in_cones(problem, {0: increments})
    row = np.zeros((1, len(problem.target)))
    row[0, 1:5] = 1.0
    value = float(row[0] @ found.point.lift())
    for effort in ("ascent", "sdp"):
        result = certify(problem, found.point, cones={0: increments}, effort=effort,
                         linear=LinearRows(np.sign(value) * -row, np.zeros(1), np.array([False])))
        assert result.bound.value <= found.value * (1 + 1e-9)
    assert result.bound.proved


def test_an_unknown_effort_is_named():
    problem = hammerstein(0, 3, 4, 60)
    refuses(StructureError, "effort", certify, problem, minimise(problem).point, effort="all")
