"""Trackers against the textbook recursion, certificates against an SDP, projectors against search."""

import time

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from optid.errors import DataError, RankError, StructureError
from optid.identify.tracking import (
    SubspaceTracker,
    constrained_reconstruction,
    fantope_certificate,
    loss_derivatives,
    optimal_reconstruction,
    principal_angles,
    projection_loss,
    stationary_point,
    stationary_points,
    suboptimal_reconstruction,
    surviving,
)

VALUES = np.array([5, 3, 1, 0.5, 0.3, 0.1])


def rotation(n, seed=0):
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]


def covariance(seed=0, values=VALUES):
    u = rotation(len(values), seed)
    return u @ np.diag(values) @ u.T


def samples(c, count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, len(c))) @ np.linalg.cholesky(c).T


def textbook(x, r, beta, start, p0=1.0, orthonormal=False):
    """Yang's recursion with P, and for OPAST the inverse square root of W^T W."""
    w, p = start.copy(), p0 * np.eye(r)
    for sample in x:
        y = w.T @ sample
        h = p @ y
        g = h / (beta + y @ h)
        p = (p - np.outer(g, h)) / beta
        p = np.triu(p) + np.triu(p, 1).T
        w = w + np.outer(sample - w @ y, g)
        if orthonormal:
            values, vectors = np.linalg.eigh(w.T @ w)
            w = w @ (vectors / np.sqrt(values)) @ vectors.T
    return w


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", ["past", "opast"])
def test_recursion_is_that_of_the_textbook(method):
    c = covariance()
    x, start = samples(c, 500), rotation(6, 5)[:, :2]
    tracker = SubspaceTracker(6, 2, method=method, forgetting=0.97, start=start, information=2.0)
    first = tracker.W.copy()
    tracker.update(x)
    assert tracker.W == pytest.approx(textbook(x, 2, 0.97, first, 0.5, method == "opast"), abs=1e-9)


def test_gap_to_the_dominant_subspace_of_the_reference_example():
    c = covariance()
    nominal = optimal_reconstruction(c, 2)
    errors, creep = [], []
    for seed in range(8):
        tracker = SubspaceTracker(6, 2, method="past", forgetting=0.995)
        tracker.update(samples(c, 4000, seed))
        errors.append(np.linalg.norm(tracker.projector - nominal.projector))
        creep.append(np.linalg.norm(tracker.W.T @ tracker.W - np.eye(2)))
    assert 0.04 < np.mean(errors) < 0.2  # reference: about 0.11
    assert np.mean(creep) < 0.01  # reference: 0.002


def test_tracked_subspace_is_that_of_the_weighted_covariance():
    c = covariance(values=np.array([50, 30, 1, 0.5, 0.3, 0.1]))
    x, beta = samples(c, 6000, 3), 0.999
    weights = beta ** np.arange(len(x))[::-1]
    dominant = optimal_reconstruction((x * weights[:, None]).T @ x / weights.sum(), 2).basis
    for method in ("past", "opast"):
        tracker = SubspaceTracker(6, 2, method=method, forgetting=beta)
        tracker.update(x)
        assert tracker.angles(dominant)[-1] < 0.01
        assert tracker.energies == pytest.approx(np.linalg.eigvalsh(dominant.T @ c @ dominant)[::-1], rel=0.15)
        assert tracker.floor == pytest.approx(1.9 / 4, rel=0.15)
        assert tracker.rank == 2
        assert max(map(len, str(tracker).splitlines())) <= 80


def test_opast_stays_orthonormal_over_a_long_run():
    tracker = SubspaceTracker(8, 3, forgetting=0.99)
    tracker.update(samples(np.diag(np.arange(8, 0, -1.0)), 200_000))
    assert np.abs(tracker.W.T @ tracker.W - np.eye(3)).max() < 1e-12


@pytest.mark.parametrize("method", ["past", "opast"])
def test_silence_and_large_changes_of_scale_are_survived(method):
    c = covariance()
    tracker = SubspaceTracker(6, 2, method=method, forgetting=0.9)
    tracker.update(samples(c, 500))
    before = tracker.W.copy()
    tracker.update(np.zeros((20_000, 6)))
    assert tracker.W == pytest.approx(before, abs=1e-14)
    for scale in (1e-9, 1e9, 1.0):
        tracker.update(scale * samples(c, 3000, 1))
    tracker.forgetting = 0.995
    tracker.update(samples(c, 5000, 2))
    assert np.isfinite(tracker.W).all()
    assert tracker.angles(optimal_reconstruction(c, 2).basis)[-1] < 0.3


@pytest.mark.parametrize("method", ["past", "opast"])
def test_restart_from_a_file_is_bit_identical(method, tmp_path):
    x = samples(covariance(), 3000)
    x[100:120, 2] = np.nan
    whole = SubspaceTracker(6, 2, method=method, names=list("abcdef"))
    expected = whole.update(x)
    parts = SubspaceTracker(6, 2, method=method, names=list("abcdef"))
    found = [parts.update(x[:1777])]
    parts = SubspaceTracker.load(parts.save(tmp_path / "state.npz"))
    found.append(parts.update(x[1777:]))
    assert np.array_equal(np.concatenate(found), expected, equal_nan=True)
    for name in ("W", "root", "sums", "counts"):
        assert np.array_equal(getattr(parts, name), getattr(whole, name))
    assert parts.names == whole.names


def test_missing_entries_are_filled_from_the_subspace():
    c = covariance(values=np.array([5, 3, 1e-4, 1e-4, 1e-4, 1e-4]))
    x = samples(c, 4000)
    x[np.random.default_rng(1).random(x.shape) < 0.3] = np.nan
    tracker = SubspaceTracker(6, 2, forgetting=0.999)
    tracker.update(x)
    assert tracker.angles(optimal_reconstruction(c, 2).basis)[-1] < 0.05
    skipping = SubspaceTracker(6, 2, forgetting=0.999, missing="skip")
    distances = skipping.update(x)
    assert np.array_equal(np.isnan(distances), np.isnan(x).any(axis=1))
    assert skipping.counts[1] < 0.2 * tracker.counts[1]


def test_one_update_with_a_missing_entry_by_hand():
    w, x = rotation(5, 3)[:, :2], np.array([0.3, np.nan, -1.0, 0.7, 0.2])
    tracker = SubspaceTracker(5, 2, start=w, method="past")
    w, present = tracker.W.copy(), ~np.isnan(x)
    y = np.linalg.lstsq(w[present], x[present], rcond=None)[0]
    tracker.update(x)
    complete = np.where(present, x, w @ y)
    other = SubspaceTracker(5, 2, start=w, method="past")
    other.W = w.copy()
    other.update(complete)
    assert tracker.W == pytest.approx(other.W, abs=1e-12)


def test_a_sample_without_an_entry_to_spare_says_nothing_of_the_noise():
    tracker = SubspaceTracker(5, 2, forgetting=0.9)
    tracker.update(np.random.default_rng(1).normal(size=(20, 5)))
    before = tracker.floor
    tracker.update([0.4, -1.0, np.nan, np.nan, np.nan])
    assert tracker.counts.tolist() == [21, 21, 0] and tracker.floor == pytest.approx(before, rel=1e-12)


def test_samples_that_do_not_determine_their_coordinates_are_passed_over():
    tracker = SubspaceTracker(4, 2, start=np.eye(4)[:, :2])
    x = np.array([[np.nan, 1.0, 2.0, 3.0], [np.nan, np.nan, np.nan, 1.0], [np.nan] * 4, [1.0, 2.0, 3.0, 4.0]])
    distances = tracker.update(x)  # the first: no row present sees the first coordinate
    assert np.isnan(distances[:3]).all() and np.isfinite(distances[3])
    assert tracker.counts.tolist() == [4, 1, 3]


def test_bad_samples_are_refused_by_name():
    tracker = SubspaceTracker(3, 1, missing="refuse", names=["flow", "level", "heat"])
    tracker.update(np.ones((5, 3)))
    refuses(DataError, "level is missing at sample 6", tracker.update, [[1, 1, 1], [1, np.nan, 1]])
    refuses(DataError, "'heat': sample 5 is inf", tracker.update, [1, 1, np.inf])
    refuses(DataError, r"\(N, 3\)", tracker.update, np.ones((2, 4)))


@pytest.mark.parametrize("arguments", [
    dict(n=1, r=1), dict(n=4, r=4), dict(n=4, r=0), dict(n=4, r=2, method="pca"), dict(n=4, r=2, forgetting=0.0),
    dict(n=4, r=2, information=0), dict(n=4, r=2, names=["a"]), dict(n=4, r=2, start=np.eye(4)[:, :1]),
    dict(n=4, r=2, missing="zero"),
])
def test_impossible_trackers_are_refused(arguments):
    with pytest.raises(StructureError):
        SubspaceTracker(**arguments)


def test_retracking_after_a_lost_sensor_is_the_constrained_projector():
    c = covariance(values=np.array([20, 12, 0.1, 0.1, 0.1, 0.1]))
    x = samples(c, 6000)
    x[2000:, 4] = 0
    tracker = SubspaceTracker(6, 2, forgetting=0.998)
    tracker.update(x)
    expected = constrained_reconstruction(c, 2, within=surviving(6, [4]))
    assert tracker.angles(expected.basis)[-1] < 0.03


def test_a_sample_costs_microseconds():
    tracker, x = SubspaceTracker(40, 4), np.random.default_rng(0).normal(size=(20_000, 40))
    tracker.update(x[:10])
    begin = time.process_time()
    tracker.update(x)
    assert (time.process_time() - begin) / len(x) < 50e-6


def test_stationary_points_of_the_reference_example():
    points = stationary_points(covariance(3), 2, among=range(4))
    assert [p.loss for p in points] == pytest.approx([1.9, 3.9, 4.4, 5.9, 6.4, 8.4])
    assert [p.curvatures[0] for p in points] == pytest.approx([0, -4, -5, -8, -9, -9], abs=1e-9)
    assert [p.kind for p in points] == ["minimum"] + 5 * ["saddle"]
    assert np.sum(np.abs(points[0].curvatures) < 1e-9) == 1  # the rotations of two columns
    assert all(p.gradient < 1e-12 for p in points)


def test_points_of_lower_rank_are_stationary_too():
    c = covariance()
    u = np.linalg.eigh(c)[1][:, -1]
    zero = stationary_point(c, np.zeros((6, 2)))
    single = stationary_point(c, np.column_stack([u, 0 * u]))
    assert (zero.kind, zero.rank, zero.loss) == ("maximum", 0, pytest.approx(9.9))
    assert (single.kind, single.rank, single.loss) == ("saddle", 1, pytest.approx(4.9))
    assert stationary_point(c, 2 * np.column_stack([u, u])).kind == "not stationary"


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 6), st.integers(1, 5), st.integers(0, 10_000))
def test_derivatives_by_differences(n, r, seed):
    r = min(r, n)
    rng = np.random.default_rng(seed)
    c, w = covariance(seed, rng.random(n) + 0.1), rng.normal(size=(n, r))
    gradient, hessian = loss_derivatives(c, w)
    x = rng.normal(size=(3, n))
    direct = [np.sum((v - w @ w.T @ v) ** 2) for v in x]
    assert projection_loss(x.T @ x / 3, w) == pytest.approx(np.mean(direct))
    for column in range(n * r):
        step = np.zeros(n * r)
        step[column] = 1e-6
        d = step.reshape(r, n).T
        slope = (projection_loss(c, w + d) - projection_loss(c, w - d)) / 2e-6
        bend = (loss_derivatives(c, w + d)[0] - loss_derivatives(c, w - d)[0]).T.ravel() / 2e-6
        assert gradient.T.ravel()[column] == pytest.approx(slope, abs=1e-5)
        assert hessian[:, column] == pytest.approx(bend, abs=1e-5)


@pytest.mark.slow
def test_descent_from_everywhere_ends_at_the_minimum():
    c = covariance()
    for seed in range(10):
        w = np.random.default_rng(seed).normal(size=(6, 2))
        for _ in range(4000):
            w = w - 0.02 * loss_derivatives(c, w)[0] / max(1, np.linalg.norm(w) ** 2)
        assert projection_loss(c, w) == pytest.approx(1.9, abs=1e-8)
        assert w.T @ w == pytest.approx(np.eye(2), abs=1e-6)


def test_turning_one_direction_changes_the_loss_by_the_formula():
    c = covariance()
    u = np.linalg.eigh(c)[1][:, ::-1]
    for angle in (0.1, 0.7, 1.5):
        turned = np.column_stack([u[:, 0], np.cos(angle) * u[:, 2] + np.sin(angle) * u[:, 1]])
        assert projection_loss(c, turned) == pytest.approx(3.9 + np.sin(angle) ** 2 * (1 - 3))


@settings(max_examples=40, deadline=None)
@given(st.integers(3, 8), st.integers(0, 10_000))
def test_the_largest_angle_is_that_of_the_projector_norm(n, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n, 2)), rng.normal(size=(n, 2))
    found = principal_angles(a, b)
    pa, ub = np.linalg.qr(a)[0], np.linalg.qr(b)[0]
    assert np.sin(found[-1]) == pytest.approx(np.linalg.norm(ub - pa @ pa.T @ ub, 2))
    assert principal_angles(a, rng.normal(size=(n, 1))).shape == (1,)


def test_small_angles_keep_their_digits():
    u = rotation(5)
    for angle in (1e-12, 1e-7, 0.5, 1.2, np.pi / 2):
        turned = np.column_stack([u[:, 0], np.cos(angle) * u[:, 1] + np.sin(angle) * u[:, 2]])
        assert principal_angles(u[:, :2], turned)[-1] == pytest.approx(angle, rel=1e-3)


def test_bound_holds_for_any_t_and_is_tight_at_the_best():
    rng = np.random.default_rng(0)
    for seed in range(20):
        c = covariance(seed, np.sort(rng.random(6))[::-1])
        w = rng.normal(size=(6, 2))
        for t in rng.normal(size=5):
            assert fantope_certificate(c, w, t).gap >= -1e-12
        best = fantope_certificate(c, optimal_reconstruction(c, 2).basis)
        assert abs(best.gap) < 1e-12
        assert fantope_certificate(c, w).bound == pytest.approx(best.energy)


@pytest.mark.parametrize("lost", [[], [1, 4]])
def test_bound_is_the_value_of_the_semidefinite_programme(lost):
    c = covariance(7)
    p = cp.Variable((6, 6), symmetric=True)
    constraints = [p >> 0, np.eye(6) - p >> 0, cp.trace(p) == 2] + [p[:, i] == 0 for i in lost]
    problem = cp.Problem(cp.Maximize(cp.trace(c @ p)), constraints)
    problem.solve(solver="CLARABEL")
    within = constrained_reconstruction(c, 2, within=surviving(6, lost))
    found = fantope_certificate(c, within.basis, lost=lost)
    assert found.bound == pytest.approx(problem.value, abs=1e-6)
    assert abs(found.gap) < 1e-12
    assert np.linalg.norm(p.value @ p.value - p.value) < 1e-5  # a projector: the relaxation is tight
    assert "no subspace holds more" in str(found) and max(map(len, str(found).splitlines())) <= 80


def refusals():
    c, w = covariance(), rotation(6)[:, :2]
    yield lambda: fantope_certificate(c, w, lost=[0]), DataError, "uses the lost coordinates"
    yield lambda: fantope_certificate(-c, w), DataError, "smallest eigenvalue"
    yield lambda: fantope_certificate(c, w, lost=[6]), StructureError, "coordinates from 0"
    yield lambda: fantope_certificate(c, w, np.nan), StructureError, "finite"
    yield lambda: fantope_certificate(c, np.ones((6, 2))), RankError, "1 dimensions"
    yield lambda: fantope_certificate(np.triu(c) + 1, w), DataError, "not symmetric"
    yield lambda: constrained_reconstruction(c, 2, within=np.eye(6)[:, :1]), StructureError, "dimension 1 only"
    yield (lambda: constrained_reconstruction(c, 2, within=surviving(6, [0]), containing=np.eye(6)[:, 0]),
           StructureError, "not among the surviving")
    yield lambda: constrained_reconstruction(c, 1, containing=np.eye(6)[:, :2]), StructureError, "2 directions"
    yield lambda: surviving(2, [0, 1]), StructureError, "not all of them"
    yield lambda: suboptimal_reconstruction(c, [1, 1]), StructureError, "distinct"


@pytest.mark.parametrize("call, error, words", list(refusals()))
def test_what_cannot_be_proved_or_projected_is_refused(call, error, words):
    refuses(error, words, call)


def test_losses_are_mean_squares_of_what_is_left():
    c = covariance()
    x = samples(c, 400_000)
    for found in (optimal_reconstruction(c, 2), suboptimal_reconstruction(c, [0, 3]),
                  constrained_reconstruction(c, 2, within=surviving(6, [2]))):
        assert np.mean(np.sum((x - found(x)) ** 2, axis=1)) == pytest.approx(found.loss, rel=0.01)
        assert found.projector @ found.projector == pytest.approx(found.projector, abs=1e-12)
        assert found.optimal_loss - 1e-12 <= found.loss <= found.worst_loss + 1e-12
        assert max(map(len, str(found).splitlines())) <= 80


def test_excess_of_other_invariant_subspaces():
    for point in stationary_points(covariance(), 2):
        found = suboptimal_reconstruction(covariance(), point.indices)
        assert found.loss == pytest.approx(point.loss)
        assert found.excess == pytest.approx(8 - VALUES[list(point.indices)].sum())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 2), st.integers(0, 2))
def test_no_admissible_projector_beats_the_constrained_one(seed, lost, kept):
    rng = np.random.default_rng(seed)
    c = covariance(seed, rng.random(6))
    space = np.linalg.qr(rng.normal(size=(6, 6 - lost)))[0]
    held = space @ rng.normal(size=(6 - lost, kept)) if kept else None
    found = constrained_reconstruction(c, 3, within=space, containing=held)
    assert found.loss <= found.worst_loss + 1e-9
    assert space @ space.T @ found.basis == pytest.approx(found.basis, abs=1e-9)
    if held is not None:
        assert found.projector @ held == pytest.approx(held, abs=1e-9)
    for _ in range(50):
        other = space @ rng.normal(size=(6 - lost, 3 - kept))
        w = np.linalg.qr(other if held is None else np.hstack([held, other]))[0]
        assert np.trace(c) - np.trace(w.T @ c @ w) >= found.loss - 1e-9
