"""The linear recursion, by two routes."""

import numpy as np
import pytest
from scipy import signal

from optid.models.recursions import SHORT, lfilter, propagate
from optid.statistics.sensitivities import _all_pole


@pytest.mark.parametrize("seed", range(40))
def test_short_and_long_records_are_filtered_as_scipy_does(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 40)) if seed % 4 else SHORT + 7
    x = rng.standard_normal((count, 3) if seed % 2 else count)
    before = x.copy()
    b, a = rng.standard_normal(rng.integers(1, 6)), np.real(np.poly(rng.uniform(-1.1, 0.99, rng.integers(0, 5))))
    y, expected = lfilter(b, np.atleast_1d(a), x), signal.lfilter(b, np.atleast_1d(a), x, axis=0)
    assert y.shape == x.shape and np.array_equal(x, before)
    assert np.max(np.abs(y - expected)) <= 1e-11 * max(np.max(np.abs(expected)), 1e-300)


def test_what_grows_is_not_finite():
    assert not np.isfinite(lfilter([1.0], [1.0, -3.0], np.ones(2000))[-1])
    assert lfilter([1.0, 2.0], [1.0, -3.0], np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("n, count, d", [(1, 1, 1), (2, 7, 3), (4, 60, 2)])
def test_states_by_a_triangular_system_are_those_of_the_recursion(n, count, d):
    rng = np.random.default_rng(n)
    matrix, drive = rng.standard_normal((n, n)) / n, rng.standard_normal((count, n, d))
    found, expected = propagate(matrix, drive), np.empty((count, n))
    for i in range(d):
        x = np.zeros(n)
        for k in range(count):
            expected[k] = x = matrix @ x + drive[k, :, i]
        assert found[:, :, i] == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("na, first, count", [(1, 1, 1), (2, 3, 1), (3, 5, 2), (3, 3, 50)])
def test_a_table_with_a_past_is_filtered_on(na, first, count):
    rng = np.random.default_rng(na)
    a, table = np.real(np.poly(rng.uniform(-0.9, 0.9, na)))[1:], rng.standard_normal((first + count, 4))
    expected = table.copy()
    for k in range(first, len(table)):
        expected[k] -= sum(weight * expected[k - lag] for lag, weight in enumerate(a, start=1))
    _all_pole(a, table, first)
    assert table == pytest.approx(expected, abs=1e-13)
