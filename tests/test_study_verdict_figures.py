"""Profiles, averages, ranks, growth and agreement of a verdict, every figure by an independent route."""

import itertools
import json
import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from study_rows import run

from optid.studies.storage.rows import columns
from optid.studies.verdicts.agreement import agreement_matrix, model_distance
from optid.studies.verdicts.averages import paired, performance_profiles, shifted_geometric_mean, time_growth
from optid.studies.verdicts.outcomes import tabulate
from optid.studies.verdicts.ranks import rank, ranks_of_problems, sign_test
from optid.studies.verdicts.verdict import conclude

NAN = float("nan")


# ---- profiles and averages


def test_the_profile_equals_its_definition_counted_by_hand():
    times = np.array([[1.0, 2.0], [4.0, 1.0], [3.0, NAN], [NAN, NAN]])
    a, b = performance_profiles(times)
    assert [a(t) for t in (0.9, 1, 3.9, 4, 100)] == [0, 0.5, 0.5, 0.75, 0.75]
    assert [b(t) for t in (1, 1.9, 2, 100)] == [0.25, 0.25, 0.5, 0.5]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_profiles_against_brute_force_and_their_invariances(seed):
    rng = np.random.default_rng(seed)
    times = np.round(np.exp(rng.normal(size=(rng.integers(1, 15), rng.integers(1, 5)))), 1) + 0.1
    times[rng.random(times.shape) < 0.3] = NAN
    profiles = performance_profiles(times)
    for s, profile in enumerate(profiles):
        for factor in (1.0, 1.5, 2.0, 7.0):
            count = 0
            for row in times:
                if np.isfinite(row[s]) and row[s] / np.nanmin(row) <= factor:
                    count += 1
            assert profile(factor) == pytest.approx(count / len(times))
        assert np.all(np.diff(profile.shares) > 0) and np.all(np.diff(profile.factors) > 0)
    for other in (times[rng.permutation(len(times))], 1024 * times):
        for one, two in zip(profiles, performance_profiles(other)):
            np.testing.assert_allclose(one.factors, two.factors, rtol=1e-12)
            np.testing.assert_allclose(one.shares, two.shares)
    dominated = np.column_stack([times, 3 * np.nanmax(np.where(np.isnan(times), -1, times), axis=1) + 1])
    dominated[np.isnan(times).all(axis=1), -1] = NAN
    for one, two in zip(profiles, performance_profiles(dominated)):
        np.testing.assert_array_equal(one.factors, two.factors)


def test_shifted_geometric_mean_against_scipy():
    t = np.array([0.001, 0.02, 3.0, NAN])
    assert shifted_geometric_mean(t, 0.0) == pytest.approx(scipy.stats.gmean(t[:3]))
    assert shifted_geometric_mean(t, 0.5) == pytest.approx(scipy.stats.gmean(t[:3] + 0.5) - 0.5)
    assert shifted_geometric_mean(1000 * t, 500.0) == pytest.approx(1000 * shifted_geometric_mean(t, 0.5))
    assert np.isnan(shifted_geometric_mean(np.array([NAN])))


def test_paired_ratio_against_scipy_and_its_reciprocal():
    rng = np.random.default_rng(4)
    a, b = np.exp(rng.normal(size=(2, 30)))
    a[3] = b[7] = NAN
    both = np.isfinite(a) & np.isfinite(b)
    ratio, back = paired(a, b), paired(b, a)
    interval = scipy.stats.ttest_rel(np.log(a[both]), np.log(b[both])).confidence_interval()
    assert (ratio.low, ratio.high) == pytest.approx(tuple(np.exp(interval)))
    assert ratio.value == pytest.approx(1 / back.value) and ratio.low == pytest.approx(1 / back.high)
    assert ratio.n == 28
    assert paired(a[:1], b[:1]).high == np.inf and paired(a[3:4], b[3:4]).n == 0


def test_the_interval_of_a_paired_difference_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(2000):
        pair = paired(1.0 + rng.normal(size=8), np.zeros(8), ratio=False)
        hits += pair.low <= 1.0 <= pair.high
    assert hits / 2000 == pytest.approx(0.95, abs=0.015)


# ---- ranks


def ranking_of(scores):
    """The ranking of costs (N, k), one problem for each data set."""
    return rank(scores, np.ones(scores.shape, bool), tuple("abcdefgh"[: scores.shape[1]]), np.arange(len(scores)))


@given(st.integers(0, 12), st.integers(0, 12))
def test_the_sign_test_counts_every_assignment_of_signs(lost, won):
    n = lost + won
    weights = np.array([math.comb(n, k) for k in range(n + 1)]) / 2**n
    assert sign_test(lost, won, "greater") == pytest.approx(weights[lost:].sum() if n else 1.0)
    assert sign_test(lost, won) == pytest.approx(min(1.0, 2 * weights[max(lost, won):].sum()))


@pytest.mark.parametrize(("k", "needed"), [(2, 6), (3, 7), (4, 8), (5, 9)])
def test_the_minimum_of_data_sets_is_where_a_unanimous_order_can_first_be_told(k, needed):
    unanimous = np.arange(1.0, k + 1)
    told, few = (ranking_of(np.tile(unanimous, (n, 1))) for n in (needed, needed - 1))
    assert told.behind == tuple("abcdefgh"[1:k]) and not told.missing
    assert f"at least {needed} data sets; there are {needed - 1}" in few.missing and few.behind == ()
    assert "at least 2 solvers" in ranking_of(np.ones((9, 1))).missing


def test_ranks_and_probabilities_by_counting():
    rng = np.random.default_rng(5)
    scores = rng.normal(size=(15, 3)) + [0, 0.7, 2.5]
    found = ranking_of(scores)
    ranks = scipy.stats.rankdata(scores, axis=1)
    assert found.names == tuple("abc"[k] for k in np.argsort(ranks.mean(axis=0)))
    np.testing.assert_allclose(found.ranks, np.sort(ranks.mean(axis=0)))
    best = "abc".index(found.names[0])
    for name, p in found.probabilities.items():
        worse = int((scores[:, "abc".index(name)] > scores[:, best]).sum())
        assert p == pytest.approx(min(1.0, 3 * scipy.stats.binomtest(worse, 15).pvalue))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("shape", [(7, 2), (9, 3), (14, 4)])
def test_equal_ones_are_seldom_told_apart_over_data_sets(shape):
    rng = np.random.default_rng(1)
    assert np.mean([bool(ranking_of(rng.normal(size=shape)).behind) for _ in range(600)]) <= 0.05


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_a_solver_that_is_always_last_turns_no_tie_into_a_difference(seed):
    rng = np.random.default_rng(seed)
    scores = rng.normal(size=(12, 4)) + [0, 0.5, 1.0, 1.5]
    before, after = ranking_of(scores), ranking_of(np.column_stack([scores, scores.max(axis=1) + 1]))
    assert after.names[:4] == before.names and after.names[4] == "e"
    np.testing.assert_allclose(after.ranks[:4], before.ranks)
    assert {*after.behind} - {"e"} <= {*before.behind}


def test_failures_rank_last_and_tie():
    np.testing.assert_array_equal(ranks_of_problems(np.array([[2.0, NAN, 1.0, NAN]])), [[2, 3.5, 1, 3.5]])


# ---- growth


def test_the_length_of_a_problem_is_what_the_fits_see():
    """Samples held out are simulated on top, so that a length that is asked for is the length that is fitted."""
    rows = [run("a", p, samples=n, n_samples=round(n / 0.7), n_estimation=n) for p, n in enumerate((300, 1000, 3000))]
    assert list(tabulate(columns(rows)).n) == [300, 1000, 3000]
    growth = conclude([{**row, "seed": 0} for row in rows]).overall.standing("a").growth
    assert list(growth.lengths) == [300, 1000, 3000]


def test_growth_recovers_a_power_law_and_equals_linear_regression():
    n = np.repeat([100.0, 1000.0, 10000.0, 1e5], 5)
    rng = np.random.default_rng(2)
    t = 1e-4 * n**1.3 * np.exp(0.2 * rng.normal(size=n.size))
    found = time_growth(t, n, np.zeros(n.size))
    means = np.log([scipy.stats.gmean(t[n == v]) for v in np.unique(n)])
    line = scipy.stats.linregress(np.log(np.unique(n)), means)
    half = scipy.stats.t.ppf(0.975, 2) * line.stderr
    assert found.slope == pytest.approx(line.slope)
    assert (found.low, found.high) == pytest.approx((line.slope - half, line.slope + half))
    assert found.low < 1.3 < found.high
    assert time_growth(1000 * t, n, np.zeros(n.size)).slope == pytest.approx(found.slope)


def test_growth_is_taken_within_groups_so_that_slow_data_at_one_length_do_not_count():
    n = np.array([100.0, 1000, 10000, 100, 1000, 10000, 10000])
    group = np.array([0, 0, 0, 1, 1, 1, 2])
    t = np.array([1.0, 10, 100, 50, 500, 5000, 1e6])  # group 2 has one length only
    found = time_growth(t, n, group)
    assert found.slope == pytest.approx(1.0) and found.high - found.low < 1e-6


@pytest.mark.parametrize(
    ("n", "t", "word"),
    [
        ([], [], "there are at most 0"),
        ([100, 1000], [1, 2], "there are at most 2"),
        ([100, 150, 200], [1, 2, 3], "4 times the shortest"),
        ([100, 1000, 10000], [1, 2, NAN], "there are at most 2"),
        ([NAN, NAN, NAN], [1, 2, 3], "there are at most 0"),
    ],
)
def test_growth_that_cannot_be_told_says_what_is_missing(n, t, word):
    found = time_growth(np.array(t, dtype=float), np.array(n, dtype=float), np.zeros(len(n)))
    assert np.isnan(found.slope) and word in found.missing


def test_short_spans_of_different_data_are_no_growth_over_the_whole():
    n = np.array([100.0, 200, 1000, 2000])
    found = time_growth(n / 1000, n, np.array([0, 0, 1, 1]))
    assert np.isnan(found.slope) and "there are at most 2" in found.missing
    n, group = np.append(n, [100, 300, 900]), np.array([0, 0, 1, 1, 2, 2, 2])
    assert time_growth(n / 1000, n, group).slope == pytest.approx(1.0)


# ---- agreement


def test_agreement_counts_objectives_and_models_of_both_verified():
    poles = json.dumps([[0.5, 0.3], [0.5, -0.3]])
    turned, other = json.dumps([[0.5, -0.3], [0.5, 0.3]]), json.dumps([[0.6, 0.3], [0.6, -0.3]])
    rows = [run("a", p, poles=poles, simulation_fit=80.0) for p in range(4)]
    rows += [run("b", 0, poles=turned, simulation_fit=80.0), run("b", 1, poles=other, simulation_fit=80.0),
             run("b", 2, objective=1.1, poles=poles), run("b", 3, status_verified="failed", poles=poles)]  # fmt: skip
    table = columns(rows)
    found = agreement_matrix(tabulate(table), table)
    assert found.common[0, 1] == found.common[1, 0] == 3
    assert found.objective[0, 1] == 2 and found.compared[0, 1] == 2 and found.model[0, 1] == 1
    assert found.worst_objective[0, 1] == pytest.approx(0.1) and found.worst_model[1, 0] == pytest.approx(0.1)


def test_the_distance_of_models_matches_poles_the_best_way():
    rng = np.random.default_rng(5)
    one = rng.normal(size=(4, 2))
    two = one[rng.permutation(4)] + 1e-4 * rng.normal(size=(4, 2))
    table = columns([run("a", poles=json.dumps(p.tolist())) for p in (one, two)])
    orders = itertools.permutations(range(4))
    brute = min(max(np.hypot(*(one[i] - two[j])) for i, j in enumerate(order)) for order in orders)
    assert model_distance(table, 0, 1) == pytest.approx(brute, rel=1e-6)
    bad = columns([run("a", poles="not json"), run("b", poles="[[0.1, 0.2]]"), run("c", poles="[]")])
    assert np.isnan(model_distance(bad, 0, 1)) and model_distance(bad, 1, 2) == np.inf
