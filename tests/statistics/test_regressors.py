"""Statistics in one pass against the regressor formed row by row."""

import threading
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from optid.bases import BSpline, Linear, PiecewiseConstant, Polynomial, Triangular, Trigonometric
from optid.data.record import Data
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.statistics import Layout, accumulate, collect, factorise, residuals
from optid.statistics.blocks import Frame, make_block, stretches
from optid.statistics.sums import Sums

BASES = (Triangular(1), Triangular(5), Triangular(3, outside="extrapolate"), Trigonometric(3), Polynomial(3),
         BSpline(4), PiecewiseConstant(3), Linear())


class Chunks:
    """A stream that hands out a record in pieces of given lengths."""

    def __init__(self, data, lengths):
        (self.experiment,) = data.experiments
        self.inputs, self.outputs, self.lengths, self.passes = data.inputs, data.outputs, lengths, 0

    def __iter__(self):
        self.passes += 1
        start = 0
        for length in self.lengths:
            yield self.experiment.u[start:start + length], self.experiment.y[start:start + length]
            start += length
        yield self.experiment.u[start:], self.experiment.y[start:]


def layout_of(data, bases, na, nb, nk):
    fitted = tuple(basis.with_interval(-1, 1) for basis in bases)
    return Layout(na=na, nb=tuple(nb), nk=tuple(nk), bases=fitted, outputs=data.outputs, inputs=data.inputs)


def random_data(rng, lengths, m, outs, share=0.0, offset=0.0):
    us = [rng.uniform(-1.1, 1.1, (n, m)) for n in lengths]
    ys = [rng.standard_normal((n, outs)) + offset for n in lengths]
    for array in us + ys:
        array[rng.random(array.shape) < share] = np.nan
    return Data(u=us, y=ys)


def formed(data, layout, weights=None):
    """[Phi | Y] by the definition, one list of used rows with their weights; (rows, weights, positions)."""
    rows, scales, positions = [], [], []
    for e, experiment in enumerate(data.experiments):
        values = [basis.values(channel) for basis, channel in zip(layout.bases, experiment.u.T)]
        for k in range(layout.first_row, len(experiment.y)):
            row = [-experiment.y[k - i] for i in range(1, layout.na + 1)]
            for value, nb, nk in zip(values, layout.nb, layout.nk):
                row += [value[k - nk - j] for j in range(nb)]
            row = np.concatenate([*row, [1.0], experiment.y[k]])
            weight = 1.0 if weights is None else weights[e][k]
            if weight > 0 and not np.isnan(row).any():
                rows.append(row)
                scales.append(weight)
                positions.append((e, k))
    width = layout.n_columns + layout.l
    return np.array(rows).reshape(-1, width), np.array(scales), positions


def assert_gram(gram, rows, weights, tolerance=1e-12):
    """Entries to the tolerance relative to the norms of their two columns."""
    expected = rows.T @ (rows * weights[:, None])
    norms = np.sqrt(np.maximum(np.diag(expected), 1e-300))
    np.testing.assert_allclose(gram / norms[:, None] / norms, expected / norms[:, None] / norms, rtol=0, atol=tolerance)


@st.composite
def cases(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m, outs, na = draw(st.integers(1, 3)), draw(st.integers(1, 2)), draw(st.integers(0, 3))
    bases = [draw(st.sampled_from(BASES)) for _ in range(m)]
    nb, nk = ([draw(st.integers(low, 4)) for _ in range(m)] for low in (1, 0))
    share = draw(st.sampled_from([0.0, 0.002, 0.02, 0.15]))
    lengths = draw(st.lists(st.integers(12, 150), min_size=1, max_size=3))
    data = random_data(rng, lengths, m, outs, share, offset=draw(st.sampled_from([0.0, 10.0])))
    return rng, data, layout_of(data, bases, na, nb, nk), draw(st.integers(1, 200))


def assert_statistics(source, data, layout, chunk):
    """Of a record, or of a stream of it, both ways."""
    rows, ones, _ = formed(data, layout)
    for take in (accumulate, factorise):
        statistics = take(source, layout, chunk=chunk)
        assert statistics.rows == len(rows)
        assert statistics.candidates == sum(len(e.y) - layout.first_row for e in data.experiments)
        assert_gram(statistics.gram, rows, ones)


@given(cases())
def test_statistics_equal_the_formed_regressor(case):
    rng, data, layout, chunk = case
    assert_statistics(data, data, layout, chunk)
    weights = [rng.random(len(e.y)) * (rng.random(len(e.y)) > 0.2) for e in data.experiments]
    rows, scales, _ = formed(data, layout, weights)
    for take in (accumulate, factorise):
        statistics = take(data, layout, weights, chunk=chunk)
        assert statistics.rows == len(rows)
        assert_gram(statistics.gram, rows, scales)


@given(cases())
def test_residuals_equal_the_formed_regressor(case):
    rng, data, layout, chunk = case
    theta = rng.standard_normal((layout.n_columns, layout.l))
    rows, _, positions = formed(data, layout)
    found = residuals(data, layout, theta, chunk=chunk)
    assert [r.shape for r in found] == [e.y.shape for e in data.experiments]
    assert sum(int((~np.isnan(r)).sum()) for r in found) == len(rows) * layout.l
    for row, (e, k) in zip(rows, positions):
        expected = row[layout.n_columns:] - row[: layout.n_columns] @ theta
        np.testing.assert_allclose(found[e][k], expected, rtol=0, atol=1e-11)


@given(cases(), st.lists(st.integers(1, 40), max_size=5))
def test_stream_equals_record(case, lengths):
    _, data, layout, chunk = case
    one = Data(u=data.experiments[0].u, y=data.experiments[0].y)
    assert_statistics(Chunks(one, lengths), one, layout, chunk)


@given(cases(), st.integers(2, 4))
def test_threads_do_not_change_a_digit(case, threads):
    rng, data, layout, chunk = case
    weights = [rng.random(len(e.y)) for e in data.experiments]
    stream = Chunks(Data(u=data.experiments[0].u, y=data.experiments[0].y), [7, 20])
    for source, scales in ((data, None), (data, weights), (stream, None)):
        one, several = (accumulate(source, layout, scales, chunk, threads=count) for count in (1, threads))
        assert (one.rows, one.candidates) == (several.rows, several.candidates)
        np.testing.assert_array_equal(one.gram, several.gram)


@pytest.mark.parametrize("threads", [1, 2])
def test_failing_reader_is_heard_and_leaves_no_thread(threads):
    class Failing(Chunks):
        def __iter__(self):
            for i, chunk in enumerate(super().__iter__()):
                if i == 20:
                    raise DataError("column 'u': sample 1000 is inf")
                yield chunk

    data = random_data(np.random.default_rng(19), [2000], 1, 1)
    before = threading.active_count()
    with pytest.raises(DataError, match="sample 1000 is inf"):
        collect(Failing(data, [50] * 39), layout_of(data, (Triangular(3),), 1, [1], [0]), chunk=30, threads=threads)
    assert threading.active_count() == before


def test_short_record_starts_no_thread(monkeypatch):
    def refuse(*_):
        raise AssertionError("a pool was started")

    monkeypatch.setattr("optid.data.reduction.ThreadPoolExecutor", refuse)
    data = random_data(np.random.default_rng(20), [3000], 1, 1)
    layout = layout_of(data, (Triangular(3),), 1, [1], [0])
    collect(data, layout, threads=2)
    refuses(AssertionError, "a pool", collect, data, layout, chunk=100, threads=2)


@pytest.mark.parametrize("bases", [(Triangular(4),), (Polynomial(3),), (Triangular(4), Trigonometric(2))])
def test_both_ways_of_summing_agree(bases):
    data = random_data(np.random.default_rng(1), [300], len(bases), 2, share=0.05)
    layout = layout_of(data, bases, 2, [3] * len(bases), [1] * len(bases))
    (experiment,) = data.experiments
    both = [Sums(Frame.of(layout)), Sums(Frame.of(layout))]
    for sums, direct in zip(both, (False, True)):
        sums._direct_is_cheaper, sums._is_small = lambda *_, direct=direct: direct, lambda *_: False
        for u, y in stretches([(experiment.u, experiment.y)], layout.first_row, 100):
            sums.add(make_block(u, y, None, layout))
    grams = [sums.complete() for sums in both]
    np.testing.assert_allclose(grams[0], grams[1], atol=1e-11)
    assert both[0]._stretched and not both[1]._stretched


def test_outlier_beside_a_missing_sample_costs_no_digits():
    data = random_data(np.random.default_rng(2), [5000], 1, 1)
    (u,), (y,) = [e.u.copy() for e in data.experiments], [e.y.copy() for e in data.experiments]
    u[1000], y[1000] = np.nan, 1e9  # the row at 1000 is lost; those after it hold the outlier as a lagged output
    y[1001:1004] = np.nan
    data = Data(u=u, y=y)
    layout = layout_of(data, (Triangular(6),), 2, [2], [0])
    rows, ones, _ = formed(data, layout)
    assert np.abs(rows).max() < 10
    assert_gram(accumulate(data, layout).gram, rows, ones)


def test_order_of_the_columns():
    data = random_data(np.random.default_rng(3), [60], 2, 2)
    data = Data(u=data.u, y=data.y, inputs=["v", "w"], outputs=["p", "q"])
    layout = layout_of(data, (Polynomial(2), Linear()), 2, [2, 1], [0, 3])
    assert layout.names() == [
        "-p(k-1)", "-q(k-1)", "-p(k-2)", "-q(k-2)", "polynomial1(v(k))", "polynomial2(v(k))", "polynomial1(v(k-1))",
        "polynomial2(v(k-1))", "linear1(w(k-3))", "1"]
    assert (layout.block(0), layout.block(1)) == (slice(4, 8), slice(8, 9))
    assert (layout.n_columns, layout.offset, layout.first_row) == (10, 9, 3)


def test_recovers_a_system_without_noise():
    rng = np.random.default_rng(4)
    u, y = rng.uniform(-1, 1, 4000), np.zeros(4000)
    basis = Triangular(8).with_interval(-1, 1)
    mu, b, a, offset = rng.standard_normal(8), np.array([0.8, 0.6]), np.array([-1.5, 0.7]), 0.3
    f = basis.values(u) @ mu
    for k in range(2, 4000):
        y[k] = -a @ [y[k - 1], y[k - 2]] + b @ [f[k - 1], f[k - 2]] + offset
    data = Data(u=u, y=y)
    layout = layout_of(data, (Triangular(8),), 2, [2], [1])
    statistics = collect(data, layout)
    n = layout.n_columns
    theta = np.linalg.solve(statistics.root[:n, :n], statistics.root[:n, n])
    np.testing.assert_allclose(theta, np.concatenate([a, np.kron(b, mu), [offset]]), atol=1e-9)
    assert 0 <= statistics.root[n, n] <= 1e-6 * np.linalg.norm(y)
    assert np.nanmax(np.abs(residuals(data, layout, theta[:, None])[0])) < 1e-8


def test_root_is_upper_triangular_and_squares_to_the_gram():
    rng = np.random.default_rng(5)
    data = random_data(rng, [800], 1, 3, offset=100.0)
    scaled = Data(u=data.u, y=data.y * [1e-3, 1.0, 1e4])
    layout = layout_of(scaled, (Triangular(5),), 1, [2], [0])
    for statistics in (accumulate(scaled, layout), factorise(scaled, layout)):
        root = statistics.root
        assert (np.tril(root, -1) == 0).all() and (np.diag(root) >= 0).all()
        norms = np.sqrt(np.diag(statistics.gram))
        np.testing.assert_allclose((root.T @ root) / norms[:, None] / norms,
                                   statistics.gram / norms[:, None] / norms, atol=1e-13)
    both = [take(scaled, layout).root for take in (accumulate, factorise)]
    np.testing.assert_allclose(both[0] / norms, both[1] / norms, atol=1e-9)


def test_condition_is_within_a_factor_of_the_singular_values():
    data = random_data(np.random.default_rng(6), [3000], 1, 1, offset=50.0)
    layout = layout_of(data, (Trigonometric(4),), 3, [3], [0])
    rows, _, _ = formed(data, layout)
    phi = rows[:, : layout.n_columns]
    true = np.linalg.cond(phi / np.linalg.norm(phi, axis=0))
    assert true / np.sqrt(layout.n_columns) <= collect(data, layout).condition <= true * layout.n_columns


def test_falls_back_to_qr_and_says_so():
    rng = np.random.default_rng(7)
    u = rng.uniform(-1, 1, 2000)
    inputs = np.column_stack([u, u + 1e-8 * rng.uniform(-1, 1, 2000)])
    y = inputs @ [1.0, 2.0]
    data = Data(u=inputs, y=y)
    layout = Layout(na=0, nb=(1, 1), nk=(0, 0), bases=(Linear(), Linear()), outputs=("y",), inputs=("u1", "u2"))
    statistics = collect(data, layout)
    assert statistics.method == "qr" and statistics.condition > 1e7
    np.testing.assert_allclose(np.linalg.solve(statistics.root[:3, :3], statistics.root[:3, 3]), [1, 2, 0], atol=1e-5)
    well = layout_of(random_data(rng, [500], 2, 1), (Triangular(3), Linear()), 1, [1, 1], [0, 0])
    assert collect(random_data(rng, [500], 2, 1), well).method == "gram"


@pytest.mark.parametrize("take", [collect, accumulate, factorise])
def test_dependent_columns_are_named(take):
    u = np.random.default_rng(8).uniform(-1, 1, 500)
    data = Data(u=np.column_stack([u, -u]), y=u**2, inputs=["left", "right"])
    layout = Layout(na=0, nb=(2, 1), nk=(0, 1), bases=(Linear(), Linear()), outputs=("y",), inputs=("left", "right"))
    with pytest.raises(RankError, match=r"linear1\(right\(k-1\)\) .* depends on linear1\(left\(k-1\)\)"):
        _ = take(data, layout).root


def undetermined():
    """Records of one input, the basis with na, nb and nk, and the words that refuse them."""
    rng = np.random.default_rng(10)
    u, y = rng.uniform(0.5, 1, 400), rng.standard_normal(400)
    yield Data(u, u, inputs=["current"]), Triangular(4), 0, 2, 0, (
        r"Function 1 of 4 of Triangular .*'current'.*\[-1, -0\.\d+\].*never excited")
    yield Data(rng.uniform(-1, 1, 400), 0 * u, outputs=["thrust"]), Triangular(4), 1, 2, 0, "Output 'thrust' is zero"
    u[200], y[200:204] = -1.0, np.nan  # reached in lost rows only
    yield Data(u, y), Triangular(4), 1, 2, 0, "Function 1 of 4"
    yield random_data(rng, [30], 1, 1), Triangular(10), 2, 3, 0, "28 rows for 33 parameters: at least 37"
    yield random_data(rng, [200], 1, 1, 0.3), Triangular(10), 2, 3, 0, r"Missing samples cost \d+ % of 198 rows"
    yield random_data(rng, [100, 4], 1, 1), Triangular(3), 2, 2, 3, "experiment 2: 4 samples, but the lags reach back 4"


@pytest.mark.parametrize("data, basis, na, nb, nk, words", list(undetermined()))
def test_what_a_record_does_not_determine_is_named(data, basis, na, nb, nk, words):
    refuses(RankError, words, collect, data, layout_of(data, (basis,), na, [nb], [nk]))


def test_warns_below_half_of_the_rows():
    data = random_data(np.random.default_rng(13), [2000], 1, 1, share=0.12)
    with pytest.warns(DataWarning, match=r"leave \d+ of 1998 rows \(\d+ %\)"):
        collect(data, layout_of(data, (Triangular(3),), 2, [3], [0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        collect(data, layout_of(data, (Triangular(3),), 0, [1], [0]))


def test_weights_that_do_not_fit():
    data = random_data(np.random.default_rng(14), [50, 60], 1, 1)
    layout = layout_of(data, (Triangular(3),), 1, [1], [0])
    refuses(DataError, "1 arrays of weights for 2 experiments", collect, data, layout, [np.ones(50)])
    refuses(DataError, r"experiment 2: weights have shape \(50,\)", collect, data, layout, [np.ones(50), np.ones(50)])
    with pytest.raises(DataError, match="experiment 1: weight of sample 7 is -1"):
        collect(data, layout, [np.where(np.arange(50) == 7, -1.0, 1.0), np.ones(60)])
    refuses(DataError, "stream", collect, Chunks(Data(u=data.u[0], y=data.y[0]), []), layout, [np.ones(50)])


@pytest.mark.parametrize("threads", [1, 2])
def test_sample_outside_is_named(threads):
    u = np.random.default_rng(15).uniform(-1, 1, 300)
    u[217] = 1.5
    data = Data(u=u, y=u, inputs=["current"])
    layout = layout_of(data, (Triangular(3, outside="error"),), 1, [1], [0])
    refuses(DataError, "'current', sample 217: 1.5", collect, data, layout, chunk=10, threads=threads)


def test_arguments_are_refused():
    data = random_data(np.random.default_rng(16), [100], 2, 1)
    basis = Triangular(3).with_interval(-1, 1)
    good = {"na": 1, "nb": (1, 1), "nk": (0, 0), "bases": (basis, basis), "outputs": ("y",), "inputs": ("u1", "u2")}
    for change, words in (({"nb": (1,)}, "nb has 1 entries for 2 inputs"), ({"na": -1}, "na must be"),
                          ({"nk": (0, -1)}, "nk of input 'u2'"), ({"nb": (0, 1)}, "nb of input 'u1'"),
                          ({"outputs": ()}, "at least one")):
        refuses(StructureError, words, Layout, **good | change)
    layout = Layout(**good)
    refuses(DataError, "The data have 1 inputs", collect, Data(u=data.u[:, 0], y=data.y), layout)
    for threads in (0, True, 1.5):
        refuses(StructureError, "threads", collect, data, layout, threads=threads)


def test_basis_that_points_outside_its_family_is_refused():
    class Broken(Triangular):
        def local(self, u):
            first, weights = super().local(u)
            return first + 2, weights

    data = random_data(np.random.default_rng(17), [100], 1, 1)
    refuses(StructureError, "outside the family", collect, data, layout_of(data, (Broken(3),), 1, [1], [0]))


def test_memory_does_not_grow_with_the_record():
    rng = np.random.default_rng(18)
    peaks = []
    for count in (100_000, 400_000):
        data = Data(u=rng.uniform(-1, 1, count), y=rng.standard_normal(count))
        layout = layout_of(data, (Triangular(20),), 2, [10], [0])
        collect(data, layout)
        tracemalloc.start()
        collect(data, layout)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.05 * peaks[0] < 2e7
