"""Group-sparse least squares: bounds hold for every point, the descent closes the gap, what is ruled out is zero."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from optid.backends.block_descent import minimise
from optid.errors import StructureError
from optid.structures.group_sparse import GroupProblem


def problem(seed, groups=25, m=30, similar=0.9):
    """Groups of one to three orthogonal columns, neighbours nearly collinear."""
    rng = np.random.default_rng(seed)
    base, columns, edges = rng.standard_normal((m, 3)), [], [0]
    for _ in range(groups):
        base = similar * base + np.sqrt(1 - similar**2) * rng.standard_normal((m, 3))
        d = int(rng.integers(1, 4))
        columns.append(np.linalg.qr(base[:, :d])[0] * rng.uniform(0.2, 5.0))
        edges.append(edges[-1] + d)
    design = np.hstack(columns)
    truth = rng.standard_normal(edges[-1]) * (rng.random(edges[-1]) < 0.1)
    target = 4 * design @ truth + rng.standard_normal(m)
    return GroupProblem(design, target, np.array(edges), rng.uniform(0.5, 2, groups))


@given(st.integers(0, 10_000), st.floats(0.01, 0.99) | st.floats(1.01, 1.2))
@settings(max_examples=40, deadline=None)
def test_the_gap_closes_and_the_conditions_hold(seed, share):
    p = problem(seed)
    penalty = share * p.largest()
    found = minimise(p, penalty, gap=1e-9)
    assert found.gap <= 1e-9
    slopes = p.norms(p.design.T @ (p.target - p.design @ found.point))
    # the gap of 1e-9 in the value leaves the square root of it in the slopes
    slack = np.sqrt(2e-9 * found.value) * p.lengths + 1e-9
    assert np.all(slopes <= penalty * p.weights + slack)
    assert np.any(p.norms(found.point) > 0) == (share < 1)
    zero = p.certainly_zero(found.dual, found.value - found.bound, penalty)
    assert np.all(p.norms(found.point)[zero] * p.lengths[zero] <= 1e-3 * np.sqrt(found.value))


@given(st.integers(0, 10_000), st.floats(0.05, 2.0), st.integers(0, 100))
@settings(max_examples=60, deadline=None)
def test_weak_duality_at_any_point(seed, penalty, other):
    p = problem(seed, groups=8)
    rng = np.random.default_rng(other)
    a, v = rng.standard_normal(p.design.shape[1]), 10 * rng.standard_normal(p.target.size)
    bound, point = p.dual(v, penalty)
    assert bound <= p.value(a, penalty) + 1e-9
    assert bound >= 0 and np.all(p.norms(p.design.T @ point) <= penalty * p.weights * (1 + 1e-12))


def test_scalars_against_coordinate_search_and_warm_starts():
    p = problem(3)
    cold = minimise(p, 0.1 * p.largest(), gap=1e-10)
    warm = minimise(p, 0.1 * p.largest(), gap=1e-10, start=cold.point)
    assert warm.iterations <= 1 and warm.value == pytest.approx(cold.value, rel=1e-10)
    rng = np.random.default_rng(0)
    for _ in range(200):
        near = cold.point + 1e-3 * rng.standard_normal(cold.point.size) * (rng.random(cold.point.size) < 0.2)
        assert p.value(near, 0.1 * p.largest()) >= cold.value * (1 - 1e-10)


def test_two_equal_columns_and_a_zero_column_are_no_trouble():
    rng = np.random.default_rng(1)
    column = rng.standard_normal((20, 1))
    design = np.hstack([column, column, np.zeros((20, 1)), rng.standard_normal((20, 1))])
    p = GroupProblem(design, 3 * column[:, 0] + rng.standard_normal(20), np.arange(5), np.ones(4))
    found = minimise(p, 0.3 * p.largest(), gap=1e-10)
    assert found.gap <= 1e-9 and found.point[2] == 0


def test_a_limit_is_reported_as_it_is():
    p = problem(5)
    found = minimise(p, 1e-3 * p.largest(), gap=1e-15, limit=1)
    assert found.gap > 1e-15 and found.iterations <= 1 and found.bound <= found.value


def test_bad_numbers():
    eye, r = np.eye(4), np.ones(4)
    for design, target, edges, weights, words in (
        (eye, np.ones(3), np.arange(5), np.ones(4), "do not fit"),
        (eye, r, np.arange(4), np.ones(3), "do not fit"),
        (eye, r, np.array([0, 2, 2, 4]), np.ones(3), "do not fit"),
        (eye, r, np.arange(5), np.array([1, 1, 0, 1.0]), "positive weight"),
        (eye, r, np.arange(5), np.ones(3), "positive weight"),
        (np.tril(np.ones((4, 4))), r, np.array([0, 2, 4]), np.ones(2), "orthogonal"),
        (np.diag([1.0, 2, 1, 1]), r, np.array([0, 2, 4]), np.ones(2), "one length"),
        (eye * np.nan, r, np.arange(5), np.ones(4), "not finite"),
    ):
        refuses(StructureError, words, GroupProblem, design, target, edges, weights)
