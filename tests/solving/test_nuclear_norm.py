"""The structured nuclear-norm problem: adjoints, Gram matrices, and its minimum and bound against the generic SDP."""

import warnings

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optid.backends.admm import minimise
from optid.structures.nuclear_norm import KnownSignals, NuclearProblem, window_starts

FORMS = ("plain", "predictor", "projection", "weighted")


def made(form="predictor", *, samples=28, outputs=2, inputs=1, rows=4, missing=0, seed=0):
    """A small problem of every form, from a system of order two in noise."""
    rng = np.random.default_rng(seed)
    a = np.array([[0.8, 0.4], [-0.4, 0.8]])
    b, c, d = rng.normal(size=(2, inputs)), rng.normal(size=(outputs, 2)), rng.normal(size=(outputs, inputs))
    u, x, y = rng.normal(size=(samples, inputs)), rng.normal(size=2), np.zeros((samples, outputs))
    for k in range(samples):
        y[k] = c @ x + d @ u[k] + 0.1 * rng.normal(size=outputs)
        x = a @ x + b @ u[k]
    measured = y.copy()
    measured.ravel()[rng.permutation(y.size)[:missing]] = np.nan
    lengths = [samples // 2 + 3, samples - samples // 2 - 3]
    starts = window_starts(lengths, rows, [np.ones(n, bool) for n in lengths])
    windows = np.stack([np.hstack([u, y])[starts + i].T for i in range(rows)])
    problem = NuclearProblem(measured, starts, rows)
    if form == "plain":
        return problem
    if form == "predictor":
        direct = np.array([True] * inputs + [False] * outputs)
        return NuclearProblem(measured, starts, rows, predictor=KnownSignals(windows, direct, True))
    known = np.vstack([windows[:, :inputs].reshape(-1, len(starts)), np.ones(len(starts))])
    complement = np.linalg.svd(known.T)[0][:, len(known) :]
    if form == "projection":
        return NuclearProblem(measured, starts, rows, right=complement)
    right = complement @ rng.normal(size=(complement.shape[1], 6))
    return NuclearProblem(measured, starts, rows, left=rng.normal(size=(5, rows * outputs)), right=right)


def generic(problem, weight):
    """The same problem written out for an interior-point method: every map formed column by column."""
    y, theta = cp.Variable(problem.y.size), cp.Variable(max(problem.parameters * problem.l, 1))
    columns = [problem.hankel(e.reshape(problem.y.shape)).ravel() for e in np.eye(problem.y.size)]
    matrix = cp.reshape(np.array(columns).T @ y, problem.shape, order="C")
    if problem.predictor is not None:
        size = problem.parameters * problem.l
        columns = [problem.predictor.apply(e.reshape(problem.parameters, problem.l)).ravel() for e in np.eye(size)]
        matrix = matrix - cp.reshape(np.array(columns).T @ theta, problem.shape, order="C")
    known = problem.known.ravel()
    cost = cp.normNuc(matrix) + weight * cp.sum_squares(y[known] - problem.data.ravel()[known])
    program = cp.Problem(cp.Minimize(cost))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program.solve(solver=cp.CLARABEL)
    return program.value


@given(st.sampled_from(FORMS), st.integers(0, 5), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_adjoints_and_gram_matrices(form, missing, seed):
    problem = made(form, missing=missing, seed=seed)
    rng = np.random.default_rng(seed)
    v, z = rng.normal(size=problem.y.shape), rng.normal(size=problem.shape)
    assert np.sum(problem.hankel(v) * z) == pytest.approx(np.sum(v * problem.hankel_adjoint(z)))
    gram, separate = problem.gram
    through = problem.hankel_adjoint(problem.remove_predictor(problem.hankel(v)))
    assert np.allclose(through, gram @ v if separate else (gram @ v.ravel()).reshape(v.shape))
    if form == "predictor":
        theta = rng.normal(size=(problem.parameters, problem.l))
        inner = np.sum(problem.predictor.apply(theta) * z)
        assert inner == pytest.approx(np.sum(theta * problem.predictor.adjoint(z, problem.l)))
        columns = [problem.predictor.apply(e[:, None]).ravel() for e in np.eye(problem.parameters)]
        assert np.allclose(np.array(columns) @ np.array(columns).T, problem.predictor.gram)
        rest = problem.remove_predictor(z)
        assert np.max(np.abs(problem.predictor.adjoint(rest, problem.l))) < 1e-9


def test_the_predictor_is_block_toeplitz_and_causal():
    problem = made("predictor", inputs=2)
    predictor = problem.predictor
    rng = np.random.default_rng(0)
    theta = rng.normal(size=(predictor.size, problem.l))
    whole = predictor.toeplitz(theta)[:, :-1].reshape(problem.rows, problem.l, problem.rows, -1)
    for i in range(problem.rows):
        for j in range(problem.rows):
            if j > i:
                assert not np.any(whole[i, :, j])
            else:
                assert np.array_equal(whole[i, :, j], whole[i - j, :, 0])
    assert np.any(whole[0, :, 0, :2]) and not np.any(whole[0, :, 0, 2:])  # outputs act with a delay


@pytest.mark.sampled(6)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("missing", [0, 6])
@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_our_minimum_and_bound_against_the_generic_programme(form, missing, weight):
    problem = made(form, missing=missing, seed=3)
    found = minimise(problem, weight, gap=1e-7)
    assert found.gap <= 1e-7
    value = generic(problem, weight)
    assert found.value == pytest.approx(value, rel=2e-6)
    assert found.bound <= value * (1 + 2e-6)
    assert found.value == pytest.approx(problem.value(*found.point, weight))


@given(st.sampled_from(FORMS), st.integers(0, 5), st.integers(0, 1000), st.floats(0.05, 20))
@settings(max_examples=40, deadline=None)
def test_any_dual_point_gives_a_bound_on_any_point(form, missing, seed, weight):
    problem = made(form, missing=missing, seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(5):
        multipliers = rng.normal(size=problem.shape) * rng.choice([0.0, 1e-3, 1.0, 1e3])
        bound, point = problem.dual(multipliers, weight)
        assert np.linalg.norm(point, 2) <= 1 + 1e-9
        v = problem.data + rng.normal(size=problem.y.shape) * rng.choice([0.0, 0.1, 1.0])
        theta = problem.predictor_coefficients(problem.hankel(v))
        assert bound <= problem.value(v, theta, weight) * (1 + 1e-9)
        # what free variables demand of a dual point
        pull = problem.hankel_adjoint(point)
        assert np.max(np.abs(pull[~problem.known]), initial=0.0) < 1e-8


def test_the_update_is_the_least_squares_solution():
    problem = made("predictor", missing=5)
    rng = np.random.default_rng(1)
    target, weight, step = rng.normal(size=problem.shape), 0.7, 1.3
    v, theta = problem.update(target, weight, step)

    def cost(v, theta):
        misfit = np.where(problem.known, v - problem.data, 0.0)
        return weight * np.sum(misfit**2) + step / 2 * np.sum((problem.matrix(v, theta) - target) ** 2)

    least = cost(v, theta)
    for _ in range(20):
        moved = cost(v + 1e-3 * rng.normal(size=v.shape), theta + 1e-3 * rng.normal(size=theta.shape))
        assert moved > least


def test_without_noise_the_matrix_has_the_rank_of_the_system():
    rng = np.random.default_rng(0)
    u, x, y = rng.normal(size=(60, 1)), rng.normal(size=2), np.zeros((60, 1))
    for k in range(60):
        y[k] = x[:1] + 0.3 * u[k]
        x = np.array([[0.8, 0.4], [-0.4, 0.8]]) @ x + np.array([1.0, -0.5]) * u[k]
    starts = window_starts([60], 6, [np.ones(60, bool)])
    known = np.stack([u[starts + i].T for i in range(6)]).reshape(6, -1)
    problem = NuclearProblem(y, starts, 6, right=np.linalg.svd(known.T)[0][:, 6:])
    found = minimise(problem, 1e4, gap=1e-8)
    sizes = np.linalg.svd(problem.matrix(*found.point), compute_uv=False)
    assert sizes[2] < 1e-4 * sizes[1] and np.allclose(found.point[0], y, atol=1e-3)
    assert np.linalg.norm(problem.matrix(*found.point), "nuc") == pytest.approx(np.sum(sizes))


def test_a_limit_of_iterations_leaves_an_honest_gap():
    problem = made("projection")
    stopped = minimise(problem, 1.0, gap=1e-9, limit=5)
    assert stopped.gap > 1e-9 and stopped.iterations == 5
    best = minimise(problem, 1.0, gap=1e-8).value
    assert stopped.bound <= best <= stopped.value + 1e-9


def test_outputs_with_the_same_gaps_share_a_decomposition():
    problem = made("plain", missing=0)
    assert problem.groups[0].vectors is problem.groups[1].vectors
    both = np.zeros(problem.y.size)
    both[np.concatenate([g.measured for g in problem.groups])] += 1
    assert np.all(both == 1)
    measured = problem.y.copy()
    measured[[4, 9]] = np.nan
    gaps = NuclearProblem(measured, problem.starts, problem.rows)
    first, second = gaps.groups
    assert first.vectors is second.vectors
    assert list(second.free) == [9, 19] and list(first.free) == [8, 18]


def test_windows_do_not_cross_experiments_or_gaps():
    good = [np.ones(6, bool), np.array([True, True, False, True, True, True]), np.ones(2, bool)]
    assert list(window_starts([6, 6, 2], 3, good)) == [0, 1, 2, 3, 9]
