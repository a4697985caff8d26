"""Profiles, averages and paired comparisons of a verdict, every figure by an independent route."""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from study_rows import share

from optid.studies.verdicts.averages import paired_mean, performance_profiles, shifted_geometric_mean, sign_test

NAN = float("nan")


# ---- profiles and averages


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
            assert share(profile, factor) == pytest.approx(count / len(times))
    for other in (times[rng.permutation(len(times))], 1024 * times):
        for one, two in zip(profiles, performance_profiles(other)):
            np.testing.assert_allclose(one, two, rtol=1e-12)
    dominated = np.column_stack([times, 3 * np.nanmax(np.where(np.isnan(times), -1, times), axis=1) + 1])
    dominated[np.isnan(times).all(axis=1), -1] = NAN
    for one, two in zip(profiles, performance_profiles(dominated)):
        np.testing.assert_array_equal(one[0], two[0])


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
    ratio, back = paired_mean(a, b), paired_mean(b, a)
    interval = scipy.stats.ttest_rel(np.log(a[both]), np.log(b[both])).confidence_interval()
    assert (ratio.low, ratio.high) == pytest.approx(tuple(np.exp(interval)))
    assert ratio.value == pytest.approx(1 / back.value) and ratio.low == pytest.approx(1 / back.high)
    assert ratio.n == 28
    assert paired_mean(a[:1], b[:1]).high == np.inf and paired_mean(a[3:4], b[3:4]).n == 0


@given(st.integers(0, 12), st.integers(0, 12))
def test_the_sign_test_counts_every_assignment_of_signs(lost, won):
    n = lost + won
    weights = np.array([math.comb(n, k) for k in range(n + 1)]) / 2**n
    assert sign_test(lost, won) == pytest.approx(weights[lost:].sum() if n else 1.0)


def test_the_interval_of_a_paired_difference_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(2000):
        pair = paired_mean(1.0 + rng.normal(size=8), np.zeros(8), ratio=False)
        hits += pair.low <= 1.0 <= pair.high
    assert hits / 2000 == pytest.approx(0.95, abs=0.015)
