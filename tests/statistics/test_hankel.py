"""Statistics of Hankel matrices, and the RQ blocks from them, against matrices that are formed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from scipy.signal import lfilter

from optid.bases import Polynomial
from optid.errors import RankError, StructureError
from optid.statistics.hankel import dependent_signal, hankel_statistics
from optid.statistics.rq import rq


def formed(records, rows, centre=0.0):
    """[1; window] of every complete window, one row each."""
    found = []
    for record in records:
        for k in range(len(record) - rows + 1):
            window = record[k : k + rows] - centre
            if not np.isnan(window).any():
                found.append(np.concatenate([[1.0], window.ravel()]))
    return np.array(found)


def walks(rng, lengths, d, share=0.0):
    records = [np.cumsum(rng.standard_normal((n, d)), axis=0) for n in lengths]
    for record in records:
        record[rng.random(record.shape) < share] = np.nan
    return records


@given(seed=st.integers(0, 1000), rows=st.integers(1, 6), d=st.integers(1, 3), chunk=st.integers(1, 40),
       lengths=st.lists(st.integers(6, 60), min_size=1, max_size=3), share=st.sampled_from([0.0, 0.02, 0.1]),
       shifted=st.booleans())
def test_gram_is_that_of_the_formed_windows(seed, rows, d, chunk, lengths, share, shifted):
    rng = np.random.default_rng(seed)
    records, centre = walks(rng, lengths, d, share), rng.standard_normal(d) * shifted
    expected = formed(records, rows, centre)
    if not len(expected):
        refuses(RankError, "touches a missing sample", hankel_statistics, records, rows)
        return
    found = hankel_statistics(records, rows, centre=centre, method="gram", chunk=chunk)
    np.testing.assert_allclose(found.gram, expected.T @ expected, atol=1e-11 * np.abs(expected).max() ** 2 * 200)
    assert found.windows == len(expected)
    assert found.candidates == sum(len(r) - rows + 1 for r in records)
    streamed = hankel_statistics(records, rows, centre=centre, method="qr", chunk=chunk)
    np.testing.assert_allclose(streamed.factor.T @ streamed.factor, found.gram, atol=1e-10 * np.abs(found.gram).max())


def test_large_transient_does_not_cost_digits():
    rng = np.random.default_rng(0)
    record = rng.standard_normal((400, 1))
    record[:2] = 1e9
    found = hankel_statistics([record], 3, method="gram").gram
    np.testing.assert_allclose(found[3, 3], np.sum(formed([record], 3)[:, 3] ** 2), rtol=1e-12)


def test_signals_are_expanded_chunk_by_chunk():
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, (5000, 1))
    basis, seen = Polynomial(3).with_interval(-1, 1), []

    def expand(raw):
        seen.append(len(raw))
        return basis.values(raw[:, 0])

    found = hankel_statistics([u], 4, expand, chunk=500, method="gram")
    expected = formed([basis.values(u[:, 0])], 4)
    np.testing.assert_allclose(found.gram, expected.T @ expected, atol=1e-9)
    assert max(seen) <= 500


def test_means_as_centre():
    rng = np.random.default_rng(1)
    record = rng.standard_normal((300, 2)) + [1e6, -3e5]
    found = hankel_statistics([record], 3, centre="mean")
    np.testing.assert_allclose(found.centre + found.gram[0, 1:3] / found.windows, record.mean(axis=0), rtol=1e-5)
    assert found.condition < 10
    assert hankel_statistics([record], 3, method="gram").condition > 1e6


def test_ill_conditioned_windows_take_the_qr_way():
    rng = np.random.default_rng(2)
    x = rng.standard_normal((500, 1))
    record = np.hstack([x, x + 1e-7 * rng.standard_normal((500, 1))])
    found = hankel_statistics([record], 2)
    assert found.method == "qr"
    singular = np.linalg.svd(found.factor, compute_uv=False)
    np.testing.assert_allclose(singular, np.linalg.svd(formed([record], 2), compute_uv=False), rtol=1e-6)


def test_dependent_rows_are_named():
    x = np.random.default_rng(2).standard_normal((500, 1))
    found = hankel_statistics([np.hstack([x, 2 * x])], 2, names=["u1", "u2"])
    assert dependent_signal(found, np.arange(len(found.gram))) == "u2 at block row 1"
    assert dependent_signal(found, found.at([0])) is None


@pytest.mark.parametrize("records, rows, error, text", [
    ([np.zeros((5, 1))], 6, RankError, "experiment 1 has 5 samples"),
    ([np.zeros((9, 1)), np.zeros((5, 1))], 6, RankError, "experiment 2 has 5 samples"),
    ([np.full((9, 1), np.nan)], 6, RankError, "no window of 6 samples is complete"),
    ([np.zeros((9, 1))], 0, StructureError, "rows must be a positive integer"),
    ([np.zeros(9)], 2, ValueError, "array")])
def test_bad_input(records, rows, error, text):
    refuses(error, text, hankel_statistics, records, rows)


def test_too_few_windows():
    found = hankel_statistics([np.random.default_rng(0).standard_normal((20, 2))], 8, method="gram")
    refuses(RankError, "13 complete windows of 8 samples for 8 block rows of 2 signals: at least 17", found.check)


# -- RQ ---------------------------------------------------------------------------------------------------------------


def system(rng, count, noise=0.1):
    """A second-order system with two inputs and one output, driven by white noise."""
    u, x, y = rng.standard_normal((count, 2)), np.zeros(2), np.zeros((count, 1))
    a, b, c = np.array([[0.8, 0.3], [-0.3, 0.8]]), np.array([[1.0, 0.2], [0.0, 0.7]]), np.array([[1.0, 0.4]])
    for k in range(count):
        y[k] = c @ x + noise * rng.standard_normal()
        x = a @ x + b @ u[k]
    return np.hstack([u, y])


@pytest.mark.parametrize("form", ["projection", "correlation"])
@pytest.mark.parametrize("tolerance", [None, 1e-12])
@pytest.mark.parametrize("future", [True, False])
def test_blocks_against_projectors(form, tolerance, future):
    record, s = system(np.random.default_rng(5), 400), 4
    statistics, table = hankel_statistics([record], 2 * s), formed([record], 2 * s).T
    phi, y = statistics.at([0, 1], range(s, 2 * s)), statistics.at([2], range(s, 2 * s))
    z = np.concatenate([*[phi] * future, statistics.at([0, 1, 2], range(s))])
    found = rq(statistics, z, phi, y, form=form, tolerance=tolerance)
    onto = np.linalg.pinv(table[z]) @ table[z] if form == "projection" else table[z].T / table.shape[1]
    phi, y = table[phi] @ onto, table[y] @ onto
    perp = y - y @ np.linalg.pinv(phi) @ phi
    np.testing.assert_allclose(found.decomposition[1], np.linalg.svd(perp, compute_uv=False)[:s], rtol=1e-7, atol=1e-9)
    left, own = np.linalg.svd(perp)[0][:, :2], found.decomposition[0][:, :2]
    np.testing.assert_allclose(own @ own.T, left @ left.T, atol=1e-7)
    assert statistics.windows == 400 - 2 * s + 1 and found.discarded == 0


def test_centred_statistics_ask_for_the_constant():
    record = system(np.random.default_rng(5), 300) + [0, 0, 1e3]
    statistics = hankel_statistics([record], 6, centre="mean")
    z, phi, y = statistics.at([0, 1, 2], range(3)), statistics.at([0, 1], range(3, 6)), statistics.at([2], range(3, 6))
    refuses(StructureError, "constant", rq, statistics, z, phi, y)
    with_one = rq(statistics, [0, *z, *phi], [0, *phi], y)
    raw = hankel_statistics([record], 6, method="qr")
    without = rq(raw, [0, *z, *phi], [0, *phi], y)
    np.testing.assert_allclose(without.decomposition[1], with_one.decomposition[1], rtol=1e-6)


def test_condition_grows_where_instruments_do_not_reach_the_regressors():
    s, found = 2, []
    for count in (1000, 100_000):
        white = np.random.default_rng(1).standard_normal((count, 2))
        slow = lfilter([1], [1, -0.9], white[:, 0])
        statistics = hankel_statistics([np.column_stack([slow, white[:, 1]])], 2 * s + 1)
        past, future = statistics.at([0, 1], range(s)), statistics.at([0, 1], range(s, 2 * s))
        found.append(rq(statistics, past, future, statistics.at([0], [2 * s])).condition)
    assert found[1] > 4 * found[0]


def test_singular_regressors_are_refused_by_name_and_taken_with_a_tolerance():
    rng = np.random.default_rng(4)
    record = system(rng, 300)
    record[:, 1] = 3 * record[:, 0]
    statistics = hankel_statistics([record], 6, names=["valve", "pump", "level"])
    z = statistics.at([0, 2], range(6))
    phi, y = statistics.at([0, 1], range(3, 6)), statistics.at([2], range(3, 6))
    refuses(RankError, "pump at block row 4 depends", rq, statistics, z, phi, y)
    found = rq(statistics, z, phi, y, tolerance=1e-8)
    assert found.discarded == 3
    single = rq(statistics, z, statistics.at([0], range(3, 6)), y)
    np.testing.assert_allclose(found.decomposition[1][:3], single.decomposition[1], rtol=1e-6)


def test_fewer_instruments_than_regressors_and_silent_regressors():
    record = system(np.random.default_rng(4), 300)
    record[:, 1] = 0.0
    statistics = hankel_statistics([record], 6, names=["u1", "u2", "y"], method="gram")
    with pytest.raises(RankError, match="2 instruments for 6 regressors"):
        rq(statistics, [1, 2], statistics.at([0, 1], range(3, 6)), statistics.at([2], range(3, 6)))
    with pytest.raises(RankError, match="u2 at block row 4 is zero"):
        rq(statistics, statistics.at([0, 2]), statistics.at([0, 1], range(3, 6)), statistics.at([2], range(3, 6)))


def test_slicot_singular_values_of_the_hair_dryer(real_data):
    """SLICOT's example TIB01AD: 15 block rows, raw data, singular values to four decimals."""
    record = np.loadtxt(real_data / "daisy_hairdryer.csv", delimiter=",", skiprows=1)[:, -2:]
    s = 15
    statistics = hankel_statistics([record], 2 * s)
    future, past = range(s, 2 * s), range(s)
    found = rq(statistics, np.concatenate([statistics.at([0], future), statistics.at([0, 1], past)]),
               statistics.at([0], future), statistics.at([1], future))
    printed = [69.8841, 14.9963, 3.6675, 1.9677, 0.3000, 0.2078, 0.1651, 0.1373, 0.1133, 0.1059, 0.0856, 0.0784, 0.0733,
               0.0678, 0.0571]
    np.testing.assert_array_equal(np.round(found.decomposition[1], 4), printed)
