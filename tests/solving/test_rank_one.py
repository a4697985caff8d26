"""The bilinear core: elimination, whitening, local solution."""

import numpy as np
import pytest
from exact_search import direction_value, hammerstein, monotone, regress, search_circle
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from scipy.optimize import lsq_linear
from scripts import benchmark

from optid.errors import RankError, StructureError
from optid.structures.bilinear import best_of, descend, minimise, starts
from optid.structures.rank_one import Point, RankOne, reduce
from optid.structures.whitening import kronecker_factors

minimise_in_cones = benchmark("rank_one_fits").minimise_in_cones


def alternate(problem: RankOne, start: Point, sweeps: int = 5000) -> float:
    """Alternating least squares on the root itself (Bai 1998): all mu_i and w for fixed b_i, then all b_i and w."""
    mus, bs, value = list(start.mus), list(start.bs), np.inf
    pieces = [problem.root[:, columns].reshape(-1, nb, p) for columns, (p, nb) in zip(problem.slices, problem.blocks)]

    def solved(designs):
        whole = np.concatenate([problem.root[:, :problem.linear], *designs], axis=1)
        cuts = np.cumsum([problem.linear, *(design.shape[1] for design in designs)])[:-1]
        return np.split(np.linalg.lstsq(whole, problem.target, rcond=None)[0], cuts)

    for _ in range(sweeps):
        _, *mus = solved([np.einsum("njp,j->np", piece, b) for piece, b in zip(pieces, bs)])
        w, *bs = solved([piece @ mu for piece, mu in zip(pieces, mus)])
        point = Point(w, tuple(mus), tuple(bs)).normalise()
        mus, bs, before, value = list(point.mus), list(point.bs), value, problem.value(point.lift())
        if before - value <= 1e-12 * max(value, 1e-16 * problem.scale):
            break
    return value


def plain_split(problem: RankOne) -> Point:
    """The two-step estimate: full least squares, then the SVD of Theta."""
    theta = np.linalg.solve(problem.root, problem.target)[problem.linear:]
    p, nb = problem.blocks[0]
    u, d, vt = np.linalg.svd(theta.reshape(nb, p).T)
    return Point(np.zeros(problem.linear), (u[:, 0] * d[0],), (vt[0],))


@pytest.mark.parametrize("seed", range(6))
def test_two_lags_reach_the_exact_search(seed):
    problem = hammerstein(seed, 2, 6, 60, snr=0.5, correlation=0.9, rank=1 + seed % 2)
    assert minimise(problem).value == pytest.approx(search_circle(problem), rel=1e-10)


def test_exact_search_agrees_with_a_hand_made_problem():
    """Identity Gram, n_b = 2: the optimum leaves exactly the second singular value behind (Eckart-Young)."""
    rng = np.random.default_rng(0)
    theta = rng.standard_normal((4, 2))
    problem = RankOne(np.eye(8), theta.T.ravel(), 0.25, ((4, 2),))
    expected = 0.25 + np.linalg.svd(theta)[1][1] ** 2
    assert search_circle(problem) == pytest.approx(expected, rel=1e-12)
    assert minimise(problem).value == pytest.approx(expected, rel=1e-12)


def test_kronecker_gram_is_solved_by_the_first_start():
    rng = np.random.default_rng(1)
    left, right = (np.triu(rng.standard_normal((k, k))) + 3 * np.eye(k) for k in (3, 5))
    problem = RankOne(np.kron(left, right), rng.standard_normal(15), 0.0, ((5, 3),))
    core = reduce(problem)
    assert core.gram == pytest.approx(core.gram[0, 0] * np.eye(15), abs=1e-9 * core.gram[0, 0])
    first = descend(core, starts(core)[0][1])
    assert first.iterations <= 1
    assert first.value == pytest.approx(best_of(core, 20).value, rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_plain_svd_is_suboptimal_on_correlated_data(seed):
    problem = hammerstein(seed, 4, 6, 200, snr=2.0, correlation=0.9)
    split = direction_value(problem, plain_split(problem).bs[0])
    assert minimise(problem).value < split * (1 - 1e-4)


@given(st.integers(0, 10**6), st.integers(1, 4), st.integers(1, 6), st.integers(1, 2), st.integers(0, 3))
def test_stationary_and_no_worse_than_alternating(seed, nb, p, channels, linear):
    problem = hammerstein(seed, nb, p, 30 + 3 * channels * nb * p, channels=channels, linear=linear)
    found = minimise(problem)
    assert found.converged and found.gradient <= 1e-12
    assert found.value == pytest.approx(problem.value(found.point.lift()), rel=1e-12)
    for b in found.point.bs:
        assert np.linalg.norm(b) == pytest.approx(1.0, abs=1e-12)
        assert b[np.flatnonzero(np.abs(b) > 1e-9)[0]] > 0
    assert alternate(problem, found.point) >= found.value * (1 - 1e-11)
    rng = np.random.default_rng(seed)
    start = Point(np.zeros(linear), tuple(rng.standard_normal(p) for _ in range(channels)),
                  tuple(rng.standard_normal(nb) for _ in range(channels)))
    assert alternate(problem, start) >= found.value * (1 - 1e-7)


def test_alternating_and_newton_meet_from_the_same_basin():
    problem = hammerstein(3, 4, 6, 300, correlation=0.9, channels=2)
    found = minimise(problem)
    core = reduce(problem)
    assert alternate(problem, core.point(*starts(core)[0])) == pytest.approx(found.value, rel=1e-9)


@pytest.mark.parametrize("start", range(6))
def test_descent_is_monotone(start):
    problem = hammerstein(5, 5, 7, 120, snr=0.3, correlation=0.9, rank=2)
    core = reduce(problem)
    factors = starts(core, 6)[start]
    values = [descend(core, factors[1], iterations=k).value for k in range(12)]
    assert all(new <= old * (1 + 1e-12) for old, new in zip(values[:-1], values[1:]))


def test_gradient_vanishes_by_differences():
    problem = hammerstein(2, 3, 5, 100, channels=2, snr=0.5)
    point = minimise(problem).point
    rng = np.random.default_rng(0)
    for _ in range(5):
        step = 1e-5
        shift = [[rng.standard_normal(len(part)) for part in parts] for parts in ([point.w], point.mus, point.bs)]
        values = [problem.value(Point(point.w + sign * step * shift[0][0],
                                      tuple(m + sign * step * d for m, d in zip(point.mus, shift[1])),
                                      tuple(b + sign * step * d for b, d in zip(point.bs, shift[2]))).lift())
                  for sign in (1, -1)]
        assert abs(values[0] - values[1]) / (2 * step) < 1e-6 * problem.scale


def test_noise_free_is_recovered():
    problem = hammerstein(7, 3, 5, 100, snr=np.inf, correlation=0.5, channels=2)
    found = minimise(problem)
    assert found.converged and found.value < 1e-22 * problem.scale


@pytest.mark.parametrize(("nb", "p"), [(1, 6), (5, 1), (1, 1)])
def test_one_lag_or_one_function_is_linear_least_squares(nb, p):
    problem = hammerstein(1, nb, p, 60)
    exact = float(np.sum((problem.root @ np.linalg.solve(problem.root, problem.target) - problem.target) ** 2))
    found = minimise(problem)
    assert found.iterations == 0
    assert found.value == pytest.approx(problem.remainder + exact, rel=1e-12)
    assert problem.value(found.point.lift()) == pytest.approx(found.value, rel=1e-12)


def test_a_linear_channel_between_two_bilinear_ones():
    rng = np.random.default_rng(4)
    blocks = [(4, 3), (3, 1), (2, 2)]
    design = rng.standard_normal((80, 2 + 12 + 3 + 4))
    y = design @ rng.standard_normal(21) + rng.standard_normal(80)
    problem = regress(design, y, blocks, 2)
    found = minimise(problem)
    reordered = regress(np.hstack([design[:, 14:17], design[:, :14], design[:, 17:]]), y, [(4, 3), (2, 2)], 5)
    assert found.value == pytest.approx(minimise(reordered).value, rel=1e-11)
    assert found.value == pytest.approx(float(np.sum((design @ found.point.lift() - y) ** 2)), rel=1e-11)


@pytest.mark.parametrize("seed", range(3))
def test_against_fifty_starts(seed):
    problem = hammerstein(seed, 4, 6, 130, snr=0.3, correlation=0.9, rank=2)
    core = reduce(problem)
    assert best_of(core).value == pytest.approx(best_of(core, 50, seed=17).value, rel=1e-10)


def test_seeded_starts_are_reproducible():
    core = reduce(hammerstein(0, 3, 4, 60))
    one, two, other = (starts(core, 8, seed)[7][1][0] for seed in (1, 1, 2))
    assert np.array_equal(one, two) and not np.allclose(one, other)


def test_point_round_trip():
    problem = hammerstein(0, 3, 5, 90, channels=2)
    core = reduce(problem)
    point = minimise(problem).point
    back = core.point(*core.factors(point)[1:])
    assert back.lift() == pytest.approx(point.lift(), rel=1e-9)


def test_flip_flop_finds_a_kronecker_product():
    rng = np.random.default_rng(0)
    a, b = (m @ m.T + np.eye(len(m)) for m in (rng.standard_normal((3, 3)), rng.standard_normal((5, 5))))
    factor_mu, factor_b = kronecker_factors(np.kron(a, b), (5, 3))
    assert np.kron(factor_b @ factor_b.T, factor_mu @ factor_mu.T) == pytest.approx(np.kron(a, b), rel=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_cone_solution_beats_feasible_points_and_is_stationary(seed):
    problem, increments = monotone(seed, 3, 6, 100, snr=0.5)
    found = minimise_in_cones(problem, {0: increments})
    assert found.converged
    delta = increments @ found.point.mus[0]
    delta = delta * np.sign(delta.sum())
    assert delta.min() >= -1e-12 * delta.max()
    b = found.point.bs[0]
    change = np.kron(b[:, None], np.linalg.inv(increments))
    design = np.hstack([problem.root[:, :1], problem.root[:, 1:] @ change])
    values = []
    for sign in (1.0, -1.0):
        flipped = design * np.r_[1.0, np.full(6, sign)]
        solution = lsq_linear(flipped, problem.target, (np.r_[-np.inf, np.zeros(6)], np.inf), method="bvls", tol=1e-14)
        values.append(2 * solution.cost + problem.remainder)
    assert found.value == pytest.approx(min(values), rel=1e-9)


def test_wrong_shapes_are_named():
    refuses(StructureError, r"root \(6, 6\)", RankOne, np.eye(5), np.ones(5), 0.0, ((3, 2),))
    refuses(StructureError, "triangular", RankOne, np.ones((6, 6)), np.ones(6), 0.0, ((3, 2),))
    refuses(StructureError, "remainder", RankOne, np.eye(6), np.ones(6), -1.0, ((3, 2),))
    with pytest.raises(StructureError, match="square"):
        minimise_in_cones(RankOne(np.eye(6), np.ones(6), 0.0, ((3, 2),)), {0: np.ones((2, 3))})


def test_undetermined_linear_part_is_an_error():
    refuses(RankError, "singular", minimise, RankOne(np.diag([1.0, 0.0, 1.0]), np.ones(3), 0.0, ((3, 1),)))
