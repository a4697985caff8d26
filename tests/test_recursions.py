"""The linear recursion, by two routes."""

import numpy as np
import pytest
from scipy import signal

from optid.models.recursions import SHORT, lfilter


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
