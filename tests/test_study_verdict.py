"""The verdict of a study, every figure by an independent route."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from study_rows import rows as synthetic

from optid import solving
from optid.backends import Answer
from optid.errors import DataError
from optid.solution import Residuals, Status
from optid.studies.verdicts.agreement import agreement_matrix, model_distance
from optid.studies.verdicts.averages import paired_difference, paired_ratio, shifted_geometric_mean
from optid.studies.verdicts.choice import CANNOT_TELL, FIRST, NOBODY, ONLY_ONE, TIE, choose, listed
from optid.studies.verdicts.comparison import compare
from optid.studies.verdicts.growth import time_growth
from optid.studies.verdicts.outcomes import columns, states_of_rows, tabulate
from optid.studies.verdicts.profiles import performance_profiles, time_ratios
from optid.studies.verdicts.ranks import (
    MINIMUM_DATA_SETS,
    critical_difference,
    friedman,
    rank_over_data_sets,
    ranks_of_problems,
    signed_ranks,
)
from optid.studies.verdicts.verdict import conclude

NAN = float("nan")

# Ranks of four classifiers on 14 data sets: table 6 of Demsar (2006).
DEMSAR = np.array([[4, 3, 2, 1], [1, 2, 3, 4], [4, 1, 2, 3], [4, 1, 3, 2], [4, 2, 3, 1], [1, 2.5, 4, 2.5], [3, 2, 4, 1],
                   [2.5, 2.5, 4, 1], [4, 3, 2, 1], [2.5, 2.5, 2.5, 2.5], [4, 2.5, 1, 2.5], [3, 2, 4, 1], [4, 1, 2, 3],
                   [3, 1, 4, 2]])  # fmt: skip
# AUC of C4.5 and C4.5+m on the same data sets: table 2 there.
C45 = np.array([.763, .599, .954, .628, .882, .936, .661, .583, .775, 1.0, .940, .619, .972, .957])
C45M = np.array([.768, .591, .971, .661, .888, .931, .668, .583, .838, 1.0, .962, .666, .981, .978])


def run(solver, problem=0, data="tank", seconds=1.0, *, formulation="exact", objective: float | None = 1.0, **more):
    """One row: solved unless said otherwise."""
    return {"study": "s", "data": data, "formulation": formulation, "solver": solver, "seed": problem, "samples": 1000,
            "noise": 0.1, "n_samples": 1000, "accuracy": 1e-8, "outcome": "done", "status_claimed": "optimal",
            "status_verified": "optimal", "objective": objective, "scale": 10.0, "solve_s": seconds, "violation": 0.0,
            "stationarity": 1e-10, "time_limit": 60.0, "false_claim": False, "proved": True, **more}  # fmt: skip


def table_of(times, **more):
    """Rows of times (P, S), solvers a, b, ...; NaN fails."""
    return [run("abcdefgh"[s], p, seconds=t, **more) if np.isfinite(t) else
            run("abcdefgh"[s], p, seconds=1.0, status_verified="failed", reason="gave up", **more)
            for p, row in enumerate(times) for s, t in enumerate(row)]  # fmt: skip


# ---- which runs count


@given(st.sampled_from([1e-3, 1e-6, 1e-8, 1e-12]), st.tuples(*[st.floats(-12.0, 1.0)] * 3))
def test_at_its_own_accuracy_a_run_counts_exactly_where_solving_says_so(accuracy, exponents):
    violation, stationarity, complementarity = (float(10**e) for e in exponents)
    residuals = Residuals(violation, "gain", stationarity, complementarity)
    status, _ = solving._status(Answer(Status.OPTIMAL, "solved"), residuals, accuracy, "a")
    row = run("a", accuracy=accuracy, violation=violation, stationarity=stationarity, complementarity=complementarity)
    assert (tabulate(columns([row])).state[0, 0] == "solved") == (status is Status.LOCAL)


@pytest.mark.parametrize(
    ("change", "state"),
    [
        ({}, "solved"),
        ({"status_verified": "locally optimal"}, "solved"),
        ({"outcome": "time limit", "status_verified": None, "objective": None}, "time limit"),
        ({"outcome": "crashed", "status_verified": None}, "crashed"),
        ({"outcome": "refused", "status_verified": None}, "refused"),
        ({"false_claim": True, "status_verified": "inaccurate"}, "false claim"),
        ({"false_claim": True}, "false claim"),
        ({"status_verified": "inaccurate"}, "inaccurate"),
        ({"status_verified": ""}, "failed"),
        ({"objective": NAN}, "non-finite"),
        ({"violation": 2e-6}, "less accurate"),
        ({"stationarity": 2e-6}, "solved"),  # gradients may be ten times as large
        ({"stationarity": 2e-5}, "less accurate"),
        ({"complementarity": 2e-6}, "less accurate"),
        ({"stationarity": NAN}, "solved"),
        ({"objective": 1.0 + 2e-6}, "worse minimum"),
        ({"objective": 1.0 + 5e-7}, "solved"),
        ({"status_verified": "infeasible", "objective": None}, "contradicted"),
        ({"status_verified": "unbounded", "objective": None}, "contradicted"),
        ({"outcome": ""}, "error"),
    ],
)
def test_a_run_counts_only_where_the_accuracy_was_verified_at_the_best_objective(change, state):
    found = tabulate(columns([run("good"), run("other", **change)]))
    assert found.solvers == ("good", "other")
    assert list(found.state[0]) == ["solved", state]
    assert np.isfinite(found.time[0, 1]) == (state == "solved")
    assert list(states_of_rows(columns([run("good"), run("other", **change)]), found)) == ["solved", state]


def test_a_vanishing_objective_is_compared_on_the_scale_of_the_problem():
    found = tabulate(columns([run("a", objective=1e-14), run("b", objective=1e-9), run("c", objective=1e-6)]))
    assert list(found.state[0]) == ["solved", "solved", "worse minimum"]  # a hundredth of 10 is the yardstick


def test_a_worse_run_cannot_set_the_objective_to_beat():
    liar = run("liar", objective=0.5, false_claim=True, status_verified="inaccurate")
    loose = run("loose", objective=0.6, violation=1e-3)
    found = tabulate(columns([run("good"), liar, loose]))
    assert list(found.state[0]) == ["solved", "false claim", "less accurate"]


def test_an_answer_to_a_looser_accuracy_of_its_own_is_held_to_the_common_one():
    rows = [run("a", p) for p in range(3)] + [run("loose", p, accuracy=1e-3, stationarity=1e-3) for p in range(2)]
    assert list(tabulate(columns(rows)).state[:, 1]) == ["less accurate", "less accurate", "not run"]
    assert list(tabulate(columns(rows), accuracy=1e-3).state[:, 1]) == ["solved", "solved", "not run"]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_of_several_requested_accuracies_one_counts_for_every_entry(seed):
    """Which one, counted by hand; the others change neither time nor state."""
    rng = np.random.default_rng(seed)
    common = float(rng.choice([1e-3, 1e-6, 1e-8]))
    rows = []
    for solver in "abc":
        asked = rng.choice([1e-2, 1e-3, 1e-5, 1e-6, 1e-8, 1e-10], size=rng.integers(1, 5), replace=False)
        strict = [value for value in asked if value <= common]
        suits = max(strict) if strict else min(asked)
        for value in asked:
            fate = {} if rng.random() < 0.7 else {"outcome": "crashed", "status_verified": None, "objective": None}
            rows.append(run(solver, seconds=float(np.exp(rng.normal())), accuracy=value, suits=value == suits, **fate))
    table = columns(rows)
    found = tabulate(table, accuracy=common)
    alone = tabulate(columns([row for row in rows if row["suits"]]), accuracy=common)
    np.testing.assert_array_equal(found.time, alone.time)
    np.testing.assert_array_equal(found.state, alone.state)
    other = states_of_rows(table, found) == "other accuracy"
    assert list(~other) == [row["suits"] for row in rows]


def test_a_study_of_several_accuracies_compares_at_one_and_says_so():
    rows = [run("a", p, seconds=s, accuracy=a, violation=v) for p in range(8)
            for s, a, v in ((0.1, 1e-8, 1e-9), (0.01, 1e-3, 1e-4))]  # fmt: skip
    rows += [run("b", p, seconds=0.3, accuracy=a) for p in range(8) for a in (1e-8, 1e-3)]
    strict, loose = conclude(rows), conclude(rows, accuracy=1e-3)
    assert strict.recommended == loose.recommended == ("a",)
    assert [v.overall.standing("a").time for v in (strict, loose)] == pytest.approx([0.1, 0.01])
    assert any("16 runs asked for 1e-03" in s.text for s in strict.statements)


def test_of_repetitions_every_one_must_count_and_the_median_time_does():
    times = (3.0, 1.0, 2.0)
    rows = [run("a", seconds=t, repetition=r) for r, t in enumerate(times)]
    rows += [run("b", seconds=1.0), run("b", seconds=1.0, repetition=1, status_verified="limit", reason="iterations")]
    found = tabulate(columns(rows))
    assert found.time[0, 0] == 2.0 and list(found.state[0]) == ["solved", "limit"]
    assert found.reason[0, 1] == "iterations"


def test_time_is_compile_and_solve_or_what_is_asked_for():
    row = run("a", seconds=2.0, compile_s=0.5, fit_s=9.0, warm_s=0.25, warm_status="optimal")
    assert [tabulate(columns([row]), time=t).time[0, 0] for t in ("solve", "fit", "warm")] == [2.5, 9.0, 0.25]
    assert tabulate(columns([run("a", seconds=0.0)])).time[0, 0] == 1e-6
    with pytest.raises(DataError, match="time is one of solve, fit, warm"):
        tabulate(columns([row]), time="build")


def test_a_warm_time_counts_only_where_the_warm_solve_was_verified():
    rows = [run("a", p, seconds=1.0, warm_s=0.1, warm_status="optimal" if p < 7 else "inaccurate") for p in range(9)]
    rows += [run("b", p, seconds=0.5, warm_s=0.2, warm_status="locally optimal") for p in range(9)]
    assert conclude(rows).recommended == ("b",)
    verdict = conclude(rows, time="warm")
    assert np.isfinite(verdict.found.time).sum(axis=0).tolist() == [7, 9]
    assert verdict.recommended == ("a",) and "b, solved 9, no difference beyond chance" in verdict.headline.text
    a = verdict.overall.standing("a")
    assert (a.solved, a.problems, a.failures) == (7, 9, {"warm solve failed": 2})
    assert a.penalised == pytest.approx(np.exp(np.mean(np.log(np.array([0.1] * 7 + [60.0] * 2) + 0.01))) - 0.01)
    cold = conclude(table_of(times_of(1.0, 2.0)), time="warm")
    assert "warm = true" not in str(verdict)
    procedures = [run("a", p, formulation="steps", seconds=1.0) for p in range(9)]
    assert conclude(rows + procedures, time="warm").overall.standing("a").problems == 9  # a procedure is no failure
    assert cold.headline.word == "Cannot tell" and "warm = true" in cold.headline.text and not cold.recommended


def test_problems_that_all_agree_to_be_infeasible_are_taken_out_and_said():
    rows = [run(s, p) for s in "ab" for p in range(8)]
    rows += [run(s, 9, status_verified="infeasible", objective=None) for s in "ab"]
    verdict = conclude(rows)
    assert verdict.overall.infeasible == 1 and len(verdict.overall.found.data) == 8
    assert not verdict.false_claims and "1 problem has no solution: 2 of 2 solvers say so" in str(verdict)


def infeasible(solver, problem):
    return run(solver, problem, status_verified="infeasible", objective=None, reason="said so")


def dead(solver, problem, outcome):
    return run(solver, problem, outcome=outcome, status_verified=None, objective=None, reason=outcome)


def test_one_claim_of_infeasibility_is_not_enough():
    rows = [row for p in range(10) for row in (infeasible("a", p), dead("b", p, "crashed"), dead("c", p, "time limit"))]
    verdict = conclude(rows)
    assert verdict.overall.infeasible == 0 and verdict.headline.tone == "bad"
    assert {s.solver: s.failures for s in verdict.overall.standings} == {
        "a": {"infeasible": 10}, "b": {"crashed": 10}, "c": {"time limit": 10}}  # fmt: skip
    doubted = [infeasible("a", 0), infeasible("b", 0), run("c", 0, status_verified="failed")]
    assert conclude(doubted).overall.infeasible == 0  # one that came to an answer does not say so


def test_who_crashes_on_a_problem_without_a_solution_has_failed_on_it_all_the_same():
    rows = [run(s, p) for s in "abc" for p in range(8)]
    rows += [infeasible("a", 8), infeasible("b", 8), dead("c", 8, "crashed")]
    verdict = conclude(rows)
    assert verdict.overall.infeasible == 1 and "2 of 3 solvers say so" in str(verdict)
    a, c = verdict.overall.standing("a"), verdict.overall.standing("c")
    assert (a.problems, a.solved, a.failures) == (8, 8, {})
    assert (c.problems, c.solved, c.failures) == (9, 8, {"crashed": 1}) and c.penalised > a.penalised


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
    ratio, back = paired_ratio(a, b), paired_ratio(b, a)
    interval = scipy.stats.ttest_rel(np.log(a[both]), np.log(b[both])).confidence_interval()
    assert (ratio.low, ratio.high) == pytest.approx(tuple(np.exp(interval)))
    assert ratio.value == pytest.approx(1 / back.value) and ratio.low == pytest.approx(1 / back.high)
    assert ratio.n == 28
    assert paired_ratio(a[:1], b[:1]).high == np.inf and paired_ratio(a[3:4], b[3:4]).n == 0


def test_the_interval_of_a_paired_difference_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(2000):
        pair = paired_difference(1.0 + rng.normal(size=8), np.zeros(8))
        hits += pair.low <= 1.0 <= pair.high
    assert hits / 2000 == pytest.approx(0.95, abs=0.015)


# ---- ranks


def test_published_friedman_test_and_critical_difference():
    """Demsar (2006), section 3.2.3: 9.28 and 3.69 (without a correction for ties), F(3, 39) and CD 1.25."""
    n, k = DEMSAR.shape
    np.testing.assert_allclose(DEMSAR.mean(axis=0), [3.143, 2.000, 2.893, 1.964], atol=5e-4)
    corrected, p = friedman(DEMSAR)
    ties = sum(np.sum(c**3 - c) for c in (np.unique(row, return_counts=True)[1] for row in DEMSAR))
    plain = corrected * (1 - ties / (n * k * (k * k - 1)))
    assert plain == pytest.approx(9.28, abs=0.01)
    assert (n - 1) * plain / (n * (k - 1) - plain) == pytest.approx(3.69, abs=0.01)
    assert corrected == pytest.approx(scipy.stats.friedmanchisquare(*DEMSAR.T).statistic)
    assert p < scipy.stats.f.sf(3.69, k - 1, (k - 1) * (n - 1)) < 0.05
    assert critical_difference(4, 14) == pytest.approx(1.25, abs=0.005)
    assert critical_difference(4, 14, 0.10) == pytest.approx(1.12, abs=0.006)
    ranking = rank_over_data_sets(DEMSAR, ("C4.5", "C4.5+m", "C4.5+cf", "C4.5+m+cf"))
    assert ranking.names[0] == "C4.5+m+cf" and ranking.told
    assert not any(ranking.differ(*pair) for pair in itertools.combinations(ranking.names, 2))  # as printed
    assert rank_over_data_sets(DEMSAR, tuple("wxyz"), level=0.10).differ("w", "z")  # 3.143 - 1.964 > 1.12, as printed


def test_critical_values_are_those_printed():
    """Table 5a of Demsar (2006)."""
    printed = {2: 1.960, 3: 2.343, 4: 2.569, 5: 2.728, 6: 2.850, 7: 2.949, 8: 3.031, 9: 3.102, 10: 3.164}
    for k, q in printed.items():
        assert critical_difference(k, 10) / np.sqrt(k * (k + 1) / 60) == pytest.approx(q, abs=1.5e-3)


def test_published_wilcoxon_test():
    """Demsar (2006), section 3.1.3: the two differ at 0.05; every assignment of signs counted."""
    d = C45M - C45
    rounded = np.round(d, 3)
    exact = signed_ranks(rounded)
    assert exact < 0.05
    left = rounded[rounded != 0]
    r = scipy.stats.rankdata(np.abs(left))
    observed = min(r[left > 0].sum(), r[left < 0].sum())
    brute = [min(r[s].sum(), r[~s].sum()) <= observed + 1e-9
             for s in (np.array(signs) for signs in itertools.product([True, False], repeat=left.size))]  # fmt: skip
    assert exact == pytest.approx(np.mean(brute))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_signed_ranks_against_scipy_and_every_sign(seed):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=rng.integers(1, 12)) + 0.4
    assert signed_ranks(d) == pytest.approx(scipy.stats.wilcoxon(d, mode="exact").pvalue)
    assert signed_ranks(-d) == pytest.approx(signed_ranks(d)) and signed_ranks(7 * d) == pytest.approx(signed_ranks(d))
    tied = np.append(np.round(d, 1), [9.0, 9.0])
    tied = tied[tied != 0]
    r = scipy.stats.rankdata(np.abs(tied))
    observed = min(r[tied > 0].sum(), r[tied < 0].sum())
    if tied.size <= 10:
        signs = np.array(list(itertools.product([0, 1], repeat=tied.size)))
        sums = signs @ r
        assert signed_ranks(tied) == pytest.approx(np.mean(np.minimum(sums, r.sum() - sums) <= observed + 1e-9))


def test_the_probability_of_friedman_is_the_one_of_all_permutations():
    """Iman and Davenport's F against the permutation distribution, which is exact."""
    rng = np.random.default_rng(3)
    scores = rng.normal(size=(8, 4)) + [0, 0.4, 0.8, 1.6]
    statistic, p = friedman(scores)
    ranks = scipy.stats.rankdata(scores, axis=1)
    at = np.argsort(rng.random((20000, *ranks.shape)), axis=2)
    shuffled = np.take_along_axis(np.broadcast_to(ranks, at.shape), at, axis=2).sum(axis=1)
    spread = ((shuffled - shuffled.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    own = ((ranks.sum(axis=0) - ranks.sum(axis=0).mean()) ** 2).sum()
    assert p == pytest.approx(np.mean(spread >= own - 1e-9), abs=0.01)
    assert statistic == pytest.approx(scipy.stats.friedmanchisquare(*scores.T).statistic)


def test_the_test_over_data_sets_keeps_its_level():
    rng = np.random.default_rng(1)
    found = [rank_over_data_sets(rng.normal(size=(7, 4)), tuple("abcd")).probability for _ in range(1000)]
    assert np.mean(np.array(found) < 0.05) == pytest.approx(0.05, abs=0.02)
    pairs = sum(rank_over_data_sets(rng.normal(size=(9, 2)), tuple("ab")).probability < 0.05 for _ in range(1000))
    assert pairs / 1000 <= 0.065


def test_the_minimum_of_data_sets_is_where_a_unanimous_pair_can_first_be_told():
    assert signed_ranks(np.ones(MINIMUM_DATA_SETS)) < 0.05 <= signed_ranks(np.ones(MINIMUM_DATA_SETS - 1))
    few = rank_over_data_sets(np.tile([1.0, 2.0, 3.0], (5, 1)), tuple("abc"))
    assert not few.told and "at least 6 data sets; there are 5" in few.missing and not few.differ("a", "c")
    alone = rank_over_data_sets(np.ones((9, 1)), ("a",))
    assert not alone.told and "at least 2 solvers" in alone.missing


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_a_solver_that_is_always_last_changes_no_rank_and_turns_no_tie_into_a_difference(seed):
    rng = np.random.default_rng(seed)
    scores = rng.normal(size=(10, 4)) + [0, 0.5, 1.0, 1.5]
    before = rank_over_data_sets(scores, tuple("abcd"))
    after = rank_over_data_sets(np.column_stack([scores, scores.max(axis=1) + 1]), tuple("abcde"))
    assert after.names[:4] == before.names and after.names[4] == "e"
    np.testing.assert_allclose(after.ranks[:4], before.ranks)
    if before.probability < 0.05:
        for one, two in itertools.combinations("abcd", 2):
            assert before.differ(one, two) or not after.differ(one, two)


@pytest.mark.parametrize("row", [[1, 2, 3], [1, 2, 2], [2, 2, 1], [1, 1, 1], [3, 1, 1, 1]])
def test_the_probability_of_the_same_order_everywhere_counts_ties(row):
    """Against all permutations within the data sets."""
    ranks = scipy.stats.rankdata(row)
    orders = set(itertools.permutations(ranks))
    same = [len(set(drawn)) == 1 for drawn in itertools.product(orders, repeat=4)]
    assert friedman(np.tile(row, (4, 1)))[1] == pytest.approx(np.mean(same))


def test_failures_rank_last_and_tie():
    np.testing.assert_array_equal(ranks_of_problems(np.array([[2.0, NAN, 1.0, NAN]])), [[2, 3.5, 1, 3.5]])


# ---- growth


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


# ---- the choice


def times_of(*factors, problems=20, spread=0.1, seed=0):
    rng = np.random.default_rng(seed)
    base = np.exp(rng.normal(size=(problems, 1)))
    return base * np.array(factors) * np.exp(spread * rng.normal(size=(problems, len(factors))))


def test_the_faster_of_the_reliable_comes_first():
    choice = conclude(table_of(times_of(1.0, 3.0, 2.0))).overall.choice
    assert choice.kind == FIRST and choice.first == "a"
    assert choice.against["c"].value == pytest.approx(2.0, rel=0.1)


def test_reliability_goes_before_speed_and_the_quick_one_is_named():
    times = times_of(1.0, 0.2)
    times[:5, 1] = NAN  # five problems to none: a probability of 1/32
    verdict = conclude(table_of(times))
    assert verdict.recommended == ("a",)
    value = verdict.overall.choice.against["b"].value
    assert f"The next, b, solved only 15, in {value:.3g} × the time" in verdict.headline.text
    third = np.column_stack([times, 9 * times[:, 0]])
    assert "b is" in (text := conclude(table_of(third)).headline.text) and "solved only 15 of 20 problems" in text


def test_one_failure_more_is_no_lack_of_reliability():
    times = times_of(1.0, 0.002)
    times[0, 1] = NAN
    headline = conclude(table_of(times)).headline
    assert headline.word == "Use b" and "b reached the accuracy on 19 of 20 problems" in headline.text
    assert "The next, a, solved 20, no difference beyond chance or 1 %, and takes" in headline.text
    third = np.column_stack([0.004 * times[:, 0], times[:, 1], times[:, 0]])
    third[:2, 0] = NAN
    assert "c solved 20, no difference beyond chance" in conclude(table_of(third)).headline.text


def test_who_refuses_many_and_is_ahead_is_for_where_it_runs():
    for limit, word in ((14, "Solves most: a"), (16, "Use a where it runs")):
        rows = table_of(times_of(1.0, 3.0, problems=60))
        for row in rows:
            if row["seed"] < 30 and (row["solver"] == "a") == (row["seed"] < limit):
                row |= {"outcome": "refused", "status_verified": None, "objective": None}
        assert conclude(rows).headline.word == word


def test_failures_by_chance_do_not_decide_and_those_beyond_it_do():
    rng = np.random.default_rng(5)

    def first(fail_slow, fail_fast):
        times = np.exp(0.1 * rng.normal(size=(40, 2))) * [5.0, 0.1]
        times[rng.random((40, 2)) < [fail_slow, fail_fast]] = NAN
        return choose(times, ("slow", "fast"), 0.1, paired_ratio, none=1.0).first

    assert sum(first(0.05, 0.05) == "slow" for _ in range(300)) / 300 <= 0.05
    assert sum(first(0.02, 0.35) == "slow" for _ in range(100)) / 100 >= 0.95


def test_who_is_faster_than_the_leader_of_the_common_problems_is_not_called_tied():
    """The mean on the problems that all solve misleads where they are few and unlike the others."""
    rng = np.random.default_rng(0)
    times = np.full((100, 3), NAN)
    times[:60, 0] = 1.0
    times[:10, 1], times[10:50, 1], times[50:60, 1] = 1.2, 0.6, 1.2
    times[:10, 2] = times[52:100, 2] = 3.0
    times *= np.exp(0.05 * rng.normal(size=times.shape))
    choice = choose(times, ("a", "b", "c"), 0.1, paired_ratio, none=1.0)
    assert paired_ratio(times[:, 1], times[:, 0]).high < 0.9
    assert (choice.kind, choice.first, choice.tied) == (FIRST, "b", ())


def test_an_order_that_goes_in_a_circle_cannot_be_told():
    times = np.full((30, 3), NAN)
    for k, (one, other) in enumerate([(0, 1), (1, 2), (2, 0)]):
        times[10 * k : 10 * k + 10, one], times[10 * k : 10 * k + 10, other] = 1.0, 2.0
    verdict = conclude(table_of(times))
    assert verdict.headline.word == "Cannot tell" and "goes in a circle: each of a, b and c" in verdict.headline.text
    assert verdict.recommended == ()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_nobody_is_ahead_of_the_first(seed):
    rng = np.random.default_rng(seed)
    times = np.exp(rng.normal(size=(40, 4)) * 0.2 + rng.normal(size=4) * 0.3)
    times[rng.random(times.shape) < rng.choice([0.02, 0.2, 0.5])] = NAN
    choice = choose(times, tuple("abcd"), 0.1, paired_ratio, none=1.0)
    for name in choice.candidates:
        if choice.first and name != choice.first:
            pair = choice.against[name]
            assert not (pair.enough and pair.high < 1 and pair.value < 1 / 1.1)
            assert (name in choice.tied) == (not (pair.enough and pair.low > 1 and pair.value > 1.1))


def test_who_fails_on_most_problems_is_not_recommended():
    rows = [run(s, p, formulation=f, status_verified="optimal" if p < limit else "failed")
            for f in "fg" for p in range(20) for s, limit in (("a", 6), ("b", 4))]  # fmt: skip
    verdict = conclude(rows)
    assert verdict.headline.word == "No solver can be recommended" and verdict.headline.tone == "bad"
    assert "12 of 40 problems" in verdict.headline.text and verdict.recommended == ()
    assert all(section.recommended == () for section in verdict.sections)
    few = [run(s, p, status_verified="optimal" if (s, p) == ("a", 0) else "failed") for p in range(100) for s in "ab"]
    assert conclude(few).headline.word == "No solver can be recommended"


def test_the_tone_of_one_solver_for_every_formulation_is_that_of_its_figures():
    times = times_of(1.0, 3.0, problems=40)
    times[:8, 0], times[:16, 1] = NAN, NAN
    headline = conclude(table_of(times) + table_of(times, formulation="linear")).headline
    assert (headline.word, headline.tone) == ("Use a", "fair") and "64 of 80 problems" in headline.text
    only = table_of(times) + table_of(times[:, ::-1], formulation="linear")
    assert conclude(only).headline.tone == "fair"


def test_ties_are_called_ties():
    verdict = conclude(table_of(times_of(1.0, 1.0, 4.0)))
    assert verdict.headline.word == "A tie: a and b" or verdict.headline.word == "A tie: b and a"
    trifle = conclude(table_of(times_of(1.0, 1.05, spread=1e-3)))
    assert trifle.overall.choice.kind == TIE  # certain, but below 10 %


def test_too_few_problems_cannot_tell_and_say_how_many_are_needed():
    for problems in (1, 2, 5):
        verdict = conclude(table_of(times_of(1.0, 9.0, problems=problems)))
        assert verdict.overall.choice.kind == CANNOT_TELL and not verdict.recommended
        assert "at least 6 problems" in verdict.headline.text and verdict.headline.word == "Cannot tell yet"
    assert conclude(table_of(times_of(1.0, 9.0, problems=6))).recommended == ("a",)


def test_a_wide_interval_is_no_tie():
    times = np.ones((8, 2))
    times[:, 1] = [0.05, 40.0, 0.1, 20.0, 9.0, 0.2, 30.0, 5.0]
    verdict = conclude(table_of(times))
    assert verdict.overall.choice.kind == CANNOT_TELL and not verdict.recommended
    assert "needs more than 8 problems to tell a and b apart" in verdict.headline.text


def test_too_few_problems_in_common_cannot_tell():
    times = times_of(1.0, 9.0, problems=400)
    times[:2, 0] = times[2:, 1] = NAN
    choice = conclude(table_of(times)).overall.choice
    assert choice.kind == FIRST and choice.first == "a"  # b is not as reliable
    split = np.full((20, 2), NAN)
    split[:10, 0] = split[10:, 1] = 1.0
    choice = conclude(table_of(split)).overall.choice
    assert choice.kind == CANNOT_TELL and "a problem that a and b all solve" in choice.missing


def test_a_solver_that_never_solved_anything_is_never_recommended():
    times = times_of(1.0, 1.0)
    times[:, 1] = NAN
    verdict = conclude(table_of(times))
    assert verdict.recommended == ("a",) and "b" not in verdict.overall.choice.candidates
    (never,) = [s.text for s in verdict.statements if s.word == "Never reached the accuracy"]
    assert "b: 20 problems, failed 20" in never
    nobody = conclude(table_of(np.full((8, 2), NAN)))
    assert nobody.overall.choice.kind == NOBODY and not nobody.recommended and nobody.headline.tone == "bad"
    assert "No solver can be recommended" == nobody.headline.word


def test_a_lie_is_a_failure_and_is_listed():
    rows = table_of(times_of(1.0, 3.0))
    for row in rows:
        if row["solver"] == "a" and row["seed"] < 15:
            row |= {"false_claim": True, "status_verified": "inaccurate", "reason": f"violation {row['seed']}e-3"}
    verdict = conclude(rows)
    assert verdict.recommended == ("b",)
    (claim,) = verdict.false_claims
    assert (claim.solver, claim.count, claim.claimed) == ("a", 15, "optimal")
    assert verdict.overall.standing("a").false_claims == 15 and verdict.overall.standing("a").solved == 5
    (failure,) = verdict.failures
    assert failure.count == 15 and failure.reason == "violation …"


def test_a_claim_of_infeasibility_that_a_verified_point_contradicts_is_listed():
    rows = table_of(times_of(1.0, 3.0))
    rows[1] |= {"status_verified": "infeasible", "status_claimed": "primal infeasible", "objective": None}
    verdict = conclude(rows)
    (claim,) = verdict.false_claims
    assert claim.solver == "b" and claim.reason == "a has a verified point"
    assert verdict.overall.standing("b").false_claims == 1


def test_a_proof_that_another_point_contradicts_is_reported():
    rows = [run(s, p, bound=1.0) for s in "ab" for p in range(7)]
    assert not any(s.about == "claims" for s in conclude(rows).statements)
    rows.append(run("c", 0, objective=0.9))
    assert any(s.word == "A proof is contradicted" for s in conclude(rows).statements)


def test_one_solver_only_is_said():
    verdict = conclude(table_of(times_of(1.0)))
    assert verdict.overall.choice.kind == ONLY_ONE and verdict.headline.word == "Only one solver"
    assert not verdict.recommended


def test_it_depends_on_the_formulation_where_it_does():
    rows = table_of(times_of(1.0, 5.0), formulation="exact") + table_of(times_of(5.0, 1.0), formulation="linear")
    for row in rows:
        if row["formulation"] == "exact" and row["solver"] == "b":
            row |= {"outcome": "refused", "status_verified": None, "objective": None}
        if row["formulation"] == "linear" and row["solver"] == "a":
            row |= {"outcome": "refused", "status_verified": None, "objective": None}
    verdict = conclude(rows)
    assert verdict.headline.word == "a for exact; b for linear"
    assert [section.choice.kind for section in verdict.sections] == [ONLY_ONE, ONLY_ONE]
    few = [row for row in rows if row["formulation"] == "exact" or row["seed"] < 3]
    headline = conclude(few).headline
    assert headline.word == "a for exact; b for linear" and headline.tone == "good"  # each the only one to take it
    short = table_of(times_of(1.0, 5.0)) + table_of(times_of(NAN, 1.0, 2.0, problems=3), formulation="linear")
    headline = conclude(short).headline
    assert headline.word == "a for exact" and "For 1 of 2 formulations it cannot be told" in headline.text
    ahead = table_of(times_of(1.0, 9.0, problems=90)) + table_of(times_of(2.0, 1.0, problems=9), formulation="linear")
    assert conclude(ahead).overall.choice.first == "a"  # on the whole, but not everywhere
    assert conclude(ahead).headline.word == "a for exact; b for linear"
    same = conclude(table_of(times_of(1.0, 5.0)) + table_of(times_of(1.0, 5.0), formulation="linear"))
    assert same.headline.word == "Use a" and same.recommended == ("a",)


def test_a_standing_counts_what_it_says():
    times = np.array([[1.0, 2.0], [4.0, 1.0], [3.0, NAN], [2.0, 2.0], [1.0, 8.0], [1.0, 2.0]])
    verdict = conclude(table_of(times))
    a, b = verdict.overall.standing("a"), verdict.overall.standing("b")
    assert (a.solved, a.problems, a.fastest) == (6, 6, 5) and (b.solved, b.problems, b.fastest) == (5, 6, 2)
    expected = np.exp(np.mean(np.log(np.array([2.0, 1, 60, 2, 8, 2]) + 0.01))) - 0.01
    assert b.penalised == pytest.approx(expected) and b.failures == {"failed": 1}
    rows = [{**row, "time_limit": None} for row in table_of(times)]
    assert conclude(rows).overall.standing("b").penalised == np.inf  # a failure of unknown cost is not left out
    assert a.share == 1.0 and b.against is not None and b.against.n == 5


# ---- formulations by their models


def models(fits, problems=12, truth=True):
    rng = np.random.default_rng(0)
    level = 80 + 5 * rng.normal(size=problems)
    return [run("a", p, formulation=name, simulation_fit=level[p] + fit + 0.05 * rng.normal(), one_step_fit=90.0,
                parameter_error=0.02 if truth else None, nonlinearity_error=0.03 if truth else None)
            for p in range(problems) for name, fit in fits.items()]  # fmt: skip


def test_formulations_are_compared_by_simulation_fit_record_by_record():
    verdict = conclude(models({"exact": 0.0, "relaxed": -1.5, "linear": -9.0}))
    choice = verdict.quality.choice
    assert choice.kind == FIRST and choice.first == "exact"
    assert choice.against["relaxed"].value == pytest.approx(1.5, abs=0.1)
    assert verdict.headline.word == "Best models: exact"  # a single solver: the formulations are what is compared
    assert f"the next, relaxed, stays {choice.against['relaxed'].value:.2f} points behind" in verdict.headline.text
    blind = models({"exact": 0.0, "relaxed": -1.5})
    for k, row in enumerate(blind):
        size = 0.01 if row["formulation"] == "exact" else 0.03
        row |= {"simulation_fit": None, "parameter_error": (1 + k % 5) * size}
    verdict = conclude(blind)
    assert verdict.quality.measure == "parameter_error" and verdict.headline.word == "Best models: exact"
    value = verdict.quality.choice.against["relaxed"].value
    assert f"relaxed, has {value:.3g} times the error" in verdict.headline.text and value > 2
    assert any(s.word == "Only one solver" for s in verdict.statements)
    tie = conclude(models({"exact": 0.0, "relaxed": -0.02}))
    assert tie.quality.choice.kind == TIE and tie.headline.word.startswith("Equal models")
    few = conclude(models({"exact": 0.0, "relaxed": -5.0}, problems=3))
    assert few.quality.choice.kind == CANNOT_TELL


def test_the_model_of_the_best_verified_objective_speaks_for_a_formulation():
    rows = []
    for p in range(7):
        rows += [run("a", p, simulation_fit=80.0), run("b", p, simulation_fit=70.0, objective=1.5),
                 run("lie", p, simulation_fit=99.0, objective=0.1, false_claim=True)]  # fmt: skip
    assert conclude(rows).quality.figures["simulation_fit"]["exact"].mean == 80.0


def test_a_formulation_that_is_solved_less_often_is_compared_where_it_is_solved():
    rows = models({"exact": 0.0, "linear": -9.0})
    for row in rows:
        if row["formulation"] == "exact" and row["seed"] < 3:
            row |= {"status_verified": "limit"}
    choice = conclude(rows).quality.choice
    assert choice.kind == FIRST and choice.first == "exact" and choice.against["linear"].n == 9
    for row in rows:
        if row["formulation"] == "exact" and row["seed"] < 11:
            row |= {"status_verified": "limit"}
    assert conclude(rows).quality.choice.candidates == ("linear",)
    assert "no other has a simulation fit on half as many records" in str(conclude(rows))


def test_models_are_compared_by_what_most_formulations_have_on_most_records():
    rows = [run("a", p, formulation=f, parameter_error=(1 + p) * e, simulation_fit=90.0 if (f, p) == ("g", 0) else None)
            for p in range(8) for f, e in (("f", 0.01), ("g", 0.05))]  # fmt: skip
    quality = conclude(rows).quality
    assert (quality.measure, quality.choice.kind, quality.choice.first) == ("parameter_error", FIRST, "f")
    both = [{**row, "simulation_fit": 80.0 + 5 * (row["formulation"] == "g")} for row in rows]
    assert conclude(both).quality.measure == "simulation_fit"


def test_the_level_is_that_of_every_ranking():
    rows = [run("a", data=f"set {d}", formulation=f, simulation_fit=80.0 - loss)
            for d in range(7) for f, loss in (("x", 0), ("y", 3))]  # fmt: skip
    for level in (0.05, 1e-6):
        verdict = conclude(rows, level=level)
        assert verdict.quality.ranking.level == verdict.overall.ranking.level == level
        assert verdict.quality.ranking.differ("x", "y") == (level == 0.05)


def test_formulations_rank_over_the_data_sets_they_were_all_tried_on():
    rows = [run("a", seed, data=f"set {d}", formulation=f, simulation_fit=80.0 - loss + 0.01 * seed)
            for d in range(8) for seed in range(2) for f, loss in (("x", 0), ("y", 3), ("z", 9))
            if f != "z" or d == 0]  # fmt: skip
    ranking = conclude(rows).quality.ranking
    assert ranking.names == ("x", "y") and ranking.left_out == ("z",) and ranking.differ("x", "y")
    assert any(s.word == "Other data: x leads" for s in conclude(rows).statements)


def test_one_simulation_that_runs_away_does_not_decide():
    rows = models({"exact": 0.0, "relaxed": -1.5})
    next(r for r in rows if r["formulation"] == "exact")["simulation_fit"] = -1e9
    figures = conclude(rows).quality.figures["simulation_fit"]
    assert figures["exact"].mean == pytest.approx((11 * 80 - 100) / 12, abs=5)


def test_an_unknown_truth_is_said():
    said = conclude(models({"exact": 0.0, "relaxed": -1.5}, truth=False)).statements
    assert any(s.word == "Truth unknown" for s in said)
    assert not any(s.word == "Truth unknown" for s in conclude(models({"exact": 0.0})).statements)


# ---- over data sets, and as a whole


def study_over(sets, factors=(1.0, 3.0, 9.0), seeds=4):
    rng = np.random.default_rng(7)
    return [run("abc"[s], seed, data=f"set {d}", seconds=f * np.exp(0.2 * rng.normal()))
            for d in range(sets) for seed in range(seeds) for s, f in enumerate(factors)]  # fmt: skip


def test_seeds_are_no_data_sets():
    few = conclude(study_over(3, seeds=40)).overall.ranking
    assert few.n == 3 and not few.told
    many = conclude(study_over(8)).overall.ranking
    assert many.n == 8 and many.told and many.names == ("a", "b", "c") and many.differ("a", "c")
    said = [s for s in conclude(study_over(8)).statements if s.about == "data sets"]
    assert said and "8 data sets" in said[0].text
    assert "at least 6 data sets; there are 3" in str(conclude(study_over(3)))


@pytest.mark.parametrize("seed", range(5))
def test_the_verdict_depends_neither_on_the_order_of_the_rows_nor_on_the_unit_of_time(seed):
    rows = synthetic(600, seed)
    rng = np.random.default_rng(seed)
    verdict = conclude(rows)
    shuffled = conclude([rows[i] for i in rng.permutation(len(rows))])
    assert str(shuffled) == str(verdict)
    assert shuffled.headline.word == verdict.headline.word
    assert [s.choice.first for s in shuffled.sections] == [s.choice.first for s in verdict.sections]
    fast = [{**row, **{c: row[c] / 1024 for c in ("solve_s", "compile_s") if row[c] is not None}} for row in rows]
    for one, two in zip(verdict.sections, conclude(fast).sections):
        assert one.choice.first == two.choice.first and one.choice.kind == two.choice.kind
        for name, profile in one.profiles.items():
            np.testing.assert_allclose(profile.factors, two.profiles[name].factors, rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_dominated_solver_changes_no_choice(seed):
    rows = synthetic(720, seed)
    bad = [{**row, "solver": "zzz", "outcome": "error", "status_verified": None, "false_claim": False}
           for row in rows if row["solver"] == "clarabel"]  # fmt: skip
    before, after = conclude(rows), conclude(rows + bad)
    for one, two in zip(before.sections, after.sections):
        assert (one.choice.first, one.choice.tied) == (two.choice.first, two.choice.tied)
        assert "zzz" not in (two.choice.first, *two.choice.tied, *two.choice.candidates)
    assert "zzz" not in after.recommended


def test_every_sentence_has_its_evidence_in_numbers():
    verdict = conclude(synthetic(3000, 3))
    for statement in (verdict.headline, *verdict.statements):
        assert any(character.isdigit() for character in statement.text) or statement.word == "Truth unknown"
        assert statement.tone in ("good", "fair", "bad") and statement.word


def test_the_counts_add_up():
    rows = synthetic(2000, 5)
    verdict = conclude(rows)
    for section in (verdict.overall, *verdict.sections):
        for s in section.standings:
            assert s.solved + sum(s.failures.values()) == s.problems
            assert section.profiles[s.solver](1e9) == pytest.approx(s.solved / len(section.found.data))
    assert sum(f.count for f in verdict.failures) == (verdict.found.state != "solved").sum() - (
        verdict.found.state == "not run").sum()  # fmt: skip


def test_the_standings_equal_those_of_a_data_frame():
    """The same figures by grouping and pivoting in pandas."""
    import pandas

    rows = [row for row in synthetic(1800, 8) if row["system"]]  # one repetition each
    frame = pandas.DataFrame(rows)
    good = (frame.outcome == "done") & frame.status_verified.isin(["optimal", "locally optimal"]) & ~frame.false_claim
    frame["t"] = (frame.compile_s + frame.solve_s).where(good)
    at = ["data", "formulation", "samples", "noise", "seed"]
    wide = frame.pivot_table(index=at, columns="solver", values="t", dropna=False, sort=False)
    wide = wide.dropna(how="all").loc[:, lambda w: w.notna().any()]
    section = conclude(rows).overall
    ran = frame[frame.outcome != "refused"].groupby("solver").size()
    fastest = wide.eq(wide.min(axis=1), axis=0).sum()
    for s in section.standings:
        t = wide[s.solver].dropna()
        assert (s.solved, s.problems, s.fastest) == (len(t), ran[s.solver], fastest[s.solver])
        assert s.time == pytest.approx(scipy.stats.gmean(t + 0.01) - 0.01)
        if s.against is not None and s.against.n:
            both = (wide[s.solver] / wide[section.choice.first]).dropna()
            assert s.against.n == len(both) and s.against.value == pytest.approx(scipy.stats.gmean(both))
    for section in conclude(rows).sections:
        part = wide.xs(section.name, level="formulation")
        known, n = part.notna(), len(section.found.data)
        best = known[known.sum().idxmax()]
        behind = {c: ((best & ~known[c]).sum(), (known[c] & ~best).sum()) for c in part}
        able = [c for c, (lost, won) in behind.items() if known[c].any() and not (lost - won > int(0.01 * n) and
                scipy.stats.binomtest(lost, lost + won, alternative="greater").pvalue < 0.05)]  # fmt: skip
        logs = np.log(part[able])

        def beaten(c, logs=logs):
            ratios = [(logs[c] - logs[o]).dropna() for o in logs if o != c]
            return any(len(d) > 5 and d.mean() > np.log(1.1) and
                       scipy.stats.ttest_1samp(d, 0).confidence_interval().low > 0 for d in ratios)  # fmt: skip

        unbeaten = [c for c in able if not beaten(c)]
        most = max(known[c].sum() for c in unbeaten)
        leaders = [c for c in unbeaten if known[c].sum() >= most - int(0.01 * n)]
        assert section.choice.first == logs[leaders].dropna().mean().idxmin()
        assert set(section.choice.candidates) == set(able)


@pytest.mark.parametrize("problems", [6, 12, 60])
def test_equal_solvers_are_seldom_told_apart(problems):
    rng = np.random.default_rng(problems)
    kinds = []
    for _ in range(400):
        times = np.exp(rng.normal(size=(problems, 1)) + 0.4 * rng.normal(size=(problems, 2)))
        kinds.append(choose(times, ("a", "b"), 0.1, paired_ratio, none=1.0).kind)
    assert kinds.count(FIRST) / 400 <= 0.075
    assert kinds.count(TIE) / 400 >= {6: 0.35, 12: 0.85, 60: 0.925}[problems]  # of few problems some cannot be told
    assert kinds.count(FIRST) + kinds.count(TIE) + kinds.count(CANNOT_TELL) == 400


def test_solvers_that_differ_are_told_apart():
    rng = np.random.default_rng(1)
    first = [choose(np.exp(0.4 * rng.normal(size=(30, 2)) + [0.0, 0.5]), ("a", "b"), 0.1, paired_ratio, none=1.0)
             for _ in range(200)]  # fmt: skip
    assert sum(c.kind == FIRST and c.first == "a" for c in first) / 200 > 0.9
    assert not any(c.kind == FIRST and c.first == "b" for c in first)


# ---- what is given


def test_rows_come_as_dicts_columns_or_frames():
    import pandas
    import polars

    rows = synthetic(300, 2)
    expected = str(conclude(rows))
    names = list(rows[0])
    frame = pandas.DataFrame(rows)
    assert str(conclude({name: [row[name] for row in rows] for name in names})) == expected
    assert str(conclude(frame)) == expected
    assert str(conclude(frame.convert_dtypes())) == expected
    assert str(conclude(polars.DataFrame(rows, infer_schema_length=None))) == expected


def test_studies_of_one_database_are_kept_apart():
    rows = table_of(times_of(1.0, 3.0, problems=4)) + [
        {**row, "study": "other", "objective": 2.0} for row in table_of(times_of(1.0, 3.0, problems=4, seed=1))]
    verdict = conclude(rows)
    assert len(verdict.found.data) == 8 and verdict.found.solved.all() and verdict.overall.ranking.n == 2


def test_a_database_is_read(tmp_path):
    pytest.importorskip("duckdb")
    from optid.studies.storage import database

    rows = synthetic(300, 2)
    database.append(tmp_path / "s.duckdb", rows)
    assert conclude(tmp_path / "s.duckdb").headline == conclude(rows).headline


@pytest.mark.parametrize(
    ("given_rows", "message"),
    [
        ({"solver": ["a"]}, "no column data, formulation"),
        ([{"what": 1}, 3], "one of them is not a dict"),
        (7, "not int"),
        ({**{name: ["a"] for name in ("data", "formulation", "solver", "outcome", "status_verified")},
          "objective": ["many"], "solve_s": [1.0]}, "'objective' holds something that is not a number"),
        ({"data": ["a", "b"], "solver": ["a"]}, "has 1 values, others have 2"),
    ],
)  # fmt: skip
def test_what_is_no_table_of_runs_is_refused(given_rows, message):
    with pytest.raises(DataError, match=message):
        conclude(given_rows)


def test_numbers_of_one_thing_are_singular():
    rows = [run("a", 0, status_verified="failed"), run("b", 0, status_verified="failed")]
    assert "on the only problem (failed 2)" in conclude(rows).headline.text
    rows = [run("a", bound=1.0), run("b", objective=0.9)]
    assert any(s.text.startswith("On 1 problem a proved") for s in conclude(rows).statements)


def test_a_comparison_of_no_rows_is_refused():
    with pytest.raises(DataError, match="no rows to compare"):
        compare([])


@pytest.mark.parametrize("nothing", [[], {}])
def test_no_rows_at_all_say_so(nothing):
    verdict = conclude(nothing)
    assert verdict.headline.word == "Nothing to compare" and not verdict.recommended and not verdict.statements


def test_a_verdict_is_frozen_and_prints():
    verdict = conclude(synthetic(200, 1))
    with pytest.raises(dataclasses.FrozenInstanceError):
        verdict.time = "fit"
    assert str(verdict).startswith(verdict.headline.word)


def test_names_are_listed_as_in_a_sentence():
    texts = [listed(list("abcdef"[:k])) for k in (0, 1, 2, 4, 6)]
    assert texts == ["", "a", "a and b", "a, b, c and d", "a, b, c and 3 more"]
    assert listed(["free", "monotone, odd"]) == "\u201cfree\u201d and \u201cmonotone, odd\u201d"


def test_choose_alone_has_nothing_to_choose_from_nothing():
    assert choose(np.zeros((0, 0)), (), 0.1, paired_ratio, none=1.0).kind == NOBODY
    np.testing.assert_array_equal(time_ratios(np.array([[NAN, NAN]])), [[np.inf, np.inf]])
