"""Records in parts: sums of parts that are read apart are those of the whole record."""

import warnings
from functools import partial

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from test_regressors import assert_statistics, cases

import optid
from optid.data.reading import parquet
from optid.data.record import Data
from optid.data.reduction import FAN_IN, tree
from optid.errors import DataError, RankError
from optid.statistics import collect
from optid.statistics.blocks import Frame
from optid.statistics.sums import Sums, total_of_parts

da = pytest.importorskip("dask.array")
dd = pytest.importorskip("dask.dataframe")


class Cut:
    """A stream in parts of given lengths, with neither files nor Dask."""

    def __init__(self, data, lengths):
        self.inputs, self.outputs, self.m, self.l = data.inputs, data.outputs, data.m, data.l
        self.lengths = tuple(len(e.y) for e in data.experiments)
        self.parts = []
        for i, e in enumerate(data.experiments):
            borders = [0, *np.cumsum(lengths[i]), len(e.y)]
            for a, b in zip(borders, borders[1:]):
                self.parts.append(Piece(i, e.u[a:b], e.y[a:b]))

    def reduce(self, leaf, merge, threads):
        return tree((leaf(part, [(part.u, part.y, None)]) for part in self.parts), len(self.parts), merge)


class Piece:
    def __init__(self, experiment, u, y):
        self.experiment, self.u, self.y, self.label = experiment, u, y, "piece"


@given(cases(), st.data())
def test_sums_of_parts_equal_the_formed_regressor(case, draw):
    """Parts of any length, also empty and shorter than the lags; several experiments; missing samples."""
    _, data, layout, chunk = case
    borders = [sorted(draw.draw(st.lists(st.integers(0, len(e.y)), max_size=30))) for e in data.experiments]
    assert_statistics(Cut(data, [np.diff([0, *inside]) for inside in borders]), data, layout, chunk)


@given(cases())
def test_joining_changes_nothing_that_it_is_given(case):
    """Dask keeps results and may use them again."""
    _, data, layout, chunk = case
    stream = Cut(data, [[len(e.y) // 2] for e in data.experiments])
    seen = []

    def reduce(leaf, merge, threads):
        runs = [leaf(part, [(part.u, part.y, None)]) for part in stream.parts]
        before = [run.total.complete().copy() for run in runs]
        seen.append([merge(runs).total.complete() for _ in range(2)])
        for run, complete in zip(runs, before):
            np.testing.assert_array_equal(run.total.complete(), complete)
        return merge(runs)

    stream.reduce = reduce
    total_of_parts(stream, layout, partial(Sums, Frame.of(layout)), chunk, 1)
    np.testing.assert_array_equal(*seen[0])


@pytest.mark.parametrize("count", [1, 2, FAN_IN, FAN_IN + 1, FAN_IN**2, FAN_IN**2 + FAN_IN + 3, 700])
def test_tree_of_a_pass_is_the_tree_of_tasks(count):
    """The same brackets whether results are merged as they come or level by level."""
    level = [str(i) for i in range(count)]
    while len(level) > 1:
        level = [f"({' '.join(level[i:i + FAN_IN])})" for i in range(0, len(level), FAN_IN)]
    assert tree(map(str, range(count)), count, lambda group: f"({' '.join(group)})") == level[0]


@pytest.fixture(scope="module")
def record():
    return two_experiments()


def two_experiments():
    """Two experiments of a dead zone before dynamics of the second order, 2 % missing, with a clock."""
    rng = np.random.default_rng(5)
    us, ys = [], []
    for n in (4000, 2500):
        u = rng.uniform(-1, 1, n)
        w, y = np.sign(u) * np.maximum(np.abs(u) - 0.25, 0), np.zeros(n)
        for k in range(2, n):
            y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + w[k] + 0.75 * w[k - 1] + 0.1 * rng.standard_normal()
        y[rng.random(n) < 0.01], u[rng.random(n) < 0.01] = np.nan, np.nan
        us.append(u)
        ys.append(y)
    return Data(u=us, y=ys, dt=0.1)


def frame_of(experiment):
    return pd.DataFrame({"t": 0.1 * np.arange(len(experiment.y)), "u": experiment.u[:, 0], "y": experiment.y[:, 0]})


@pytest.fixture
def folders(record, tmp_path):
    return record_folders(record, tmp_path)


def record_folders(record, tmp_path):
    """One folder per experiment: 12 files, so that part.10 sorts before part.2 as text; several row groups each."""
    for i, e in enumerate(record.experiments):
        (tmp_path / f"run{i}").mkdir()
        for k, part in enumerate(np.array_split(np.arange(len(e.y)), 12)):
            frame_of(e).iloc[part].to_parquet(tmp_path / f"run{i}" / f"part.{k}.parquet", row_group_size=100)
    return [tmp_path / "run0", tmp_path / "run1"]


STRUCTURE = {"na": 2, "nb": 2, "basis": "triangular:8"}


def in_record_units(fit):
    """The Gram matrix of a fit with one output in the units of its record; a stream chooses its own by a chunk."""
    compressed = fit.problem.compressed
    size, level, n = compressed.units.y_scale[0], compressed.units.y_offset[0], compressed.layout.n_columns
    change = np.eye(n + 1)
    for column, sign in [*((i, -1.0) for i in range(compressed.layout.na)), (n, 1.0)]:
        change[column, column], change[n - 1, column] = size, sign * level
    return change.T @ compressed.statistics.gram @ change


def assert_same_fit(found, wanted):
    a, b = found.problem.compressed.statistics, wanted.problem.compressed.statistics
    assert (a.rows, a.candidates) == (b.rows, b.candidates)
    left, right = in_record_units(found), in_record_units(wanted)
    norms = np.sqrt(np.diag(right))
    np.testing.assert_allclose(left / norms[:, None] / norms, right / norms[:, None] / norms, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.model.a, wanted.model.a, rtol=1e-10)
    np.testing.assert_allclose(found.model.b[0], wanted.model.b[0], rtol=1e-10)


def test_folders_of_parquet_files_are_experiments(record, folders, monkeypatch):
    monkeypatch.setattr(parquet, "SAMPLES", 150)
    stream = optid.open_stream(folders)
    assert (stream.dt, stream.n_samples, stream.n_experiments) == (0.1, 6500, 2)
    assert len(stream.parts) > 24 and stream.lengths == (4000, 2500)
    np.testing.assert_array_equal(stream.ranges(), record.ranges())
    assert_same_fit(optid.fit(stream, **STRUCTURE), optid.fit(record, **STRUCTURE))
    refuses(DataError, "2 experiments", iter, stream)
    one = optid.open_stream(folders[0])
    np.testing.assert_array_equal(np.vstack([u for u, _ in one]), record.experiments[0].u)


def test_dask_collections_are_records(record, folders):
    wanted = optid.fit(record, **STRUCTURE)
    frames = [dd.from_pandas(frame_of(e), npartitions=7, sort=False) for e in record.experiments]
    assert_same_fit(optid.fit(optid.open_stream(frames), **STRUCTURE), wanted)
    read = [dd.read_parquet(folder) for folder in folders]
    stream = optid.open_stream(read)
    assert stream.n_samples is None and stream.lengths == (4000, 2500)
    assert_same_fit(optid.fit(stream, **STRUCTURE), wanted)
    arrays = [da.from_array(np.hstack([e.u, e.y]), chunks=(311, 1)) for e in record.experiments]
    stream = optid.open_stream(arrays, inputs={"u": 0}, outputs={"y": 1}, dt=0.1)
    assert stream.lengths == (4000, 2500)
    assert_same_fit(optid.fit(stream, **STRUCTURE), wanted)
    channels = [{"u": da.from_array(e.u[:, 0], chunks=500), "y": da.from_array(e.y[:, 0], chunks=500)}
                for e in record.experiments]
    assert_same_fit(optid.fit(optid.open_stream(channels, dt=0.1), **STRUCTURE), wanted)


def test_only_the_columns_of_the_channels_are_taken_of_a_frame(record):
    e = record.experiments[0]
    frame = dd.from_pandas(frame_of(e).assign(note="x", v=1.0), npartitions=3, sort=False)
    stream = optid.open_stream(frame, outputs={"thrust": "y"})
    assert all(list(part.content.compute().columns) == ["u", "y", "t"] for part in stream.parts)
    (u, y), *_ = stream
    np.testing.assert_array_equal(y, e.y[: len(y)])
    assert stream.outputs == ("thrust",) and u.shape == y.shape


def test_nullable_columns_and_chunks_of_unknown_length(record):
    e = record.experiments[0]
    frame = frame_of(e).astype({"u": "Float64", "y": "Float64"})
    stream = optid.open_stream(dd.from_pandas(frame, npartitions=5, sort=False), dt=0.1)
    one = optid.fit(Data(u=e.u, y=e.y, dt=0.1), **STRUCTURE)
    assert_same_fit(optid.fit(stream, **STRUCTURE), one)
    array = dd.from_pandas(frame_of(e)[["u", "y"]], npartitions=5, sort=False).to_dask_array()
    assert_same_fit(optid.fit(optid.open_stream(array, columns=["u", "y"], dt=0.1), **STRUCTURE), one)


def test_threads_read_parts_to_the_same_digits(record, folders):
    stream = optid.open_stream(folders)
    layout = optid.fit(record, **STRUCTURE).problem.compressed.statistics.layout
    one, several = (collect(stream, layout, threads=count) for count in (1, 3))
    np.testing.assert_array_equal(one.gram, several.gram)


def test_what_is_no_record_in_parts_is_refused(record, folders, tmp_path):
    frame = frame_of(record.experiments[0])
    (tmp_path / "above" / "below").mkdir(parents=True)
    refuses(DataError, "no .parquet file", optid.open_stream, tmp_path / "above")
    frame.to_parquet(tmp_path / "above" / "below" / "x.parquet")
    refuses(DataError, "below.*one per experiment", optid.open_stream, tmp_path / "above")
    refuses(DataError, "list of sources is empty", optid.open_stream, [])
    refuses(DataError, "use read for data in memory", optid.open_stream, frame)
    refuses(DataError, "more channels than samples", optid.open_stream, da.zeros((2, 9)))
    refuses(DataError, "3 dimensions", optid.open_stream, da.zeros((9, 2, 2)))
    refuses(DataError, "different lengths", optid.open_stream, {"u": da.zeros(9), "y": da.zeros(8)})
    with pytest.raises(DataError, match="weights are for records in memory"):
        layout = optid.fit(record, **STRUCTURE).problem.compressed.statistics.layout
        collect(optid.open_stream(folders), layout, weights=[np.ones(4000), np.ones(2500)])
    text = dd.from_pandas(frame.assign(u="x"), npartitions=2, sort=False)
    refuses(DataError, "partition ., column 'u', row 1 holds 'x'", optid.open_stream(text).ranges)
    frame.iloc[:3].to_parquet(tmp_path / "short.parquet")
    with pytest.raises(RankError, match="experiment 2: 3 samples, but the lags reach back 4"):
        optid.fit(optid.open_stream([folders[0], tmp_path / "short.parquet"]), na=4, nb=1, basis="triangular:4")


def test_parts_that_do_not_join_are_refused(record, folders):
    (folders[0] / "part.5.parquet").rename(folders[0] / "part.55.parquet")
    with pytest.raises(DataError, match=r"part.6.parquet begins 33.[45] after the last sample of part.4.parquet"):
        optid.open_stream(folders).ranges()
    other = pd.read_parquet(folders[1] / "part.3.parquet").rename(columns={"u": "v"})
    other.to_parquet(folders[1] / "part.3.parquet")
    refuses(DataError, "part.3.parquet has other columns than part.0.parquet .differing: u, v", optid.open_stream,
            folders[1])


def _timed(folder, *pieces, gap=0.0):
    """A folder with a Parquet file per piece; ``gap`` seconds are lost before the last."""
    folder.mkdir()
    start = 0
    for i, length in enumerate(pieces):
        t = 0.05 * np.arange(start, start + length) + (gap if i == len(pieces) - 1 else 0.0)
        pd.DataFrame({"t": t, "u": np.cos(7 * t), "y": np.sin(t)}).to_parquet(folder / f"p{i}.parquet")
        start += length
    return folder


def test_the_clock_is_compared_between_parts_on_every_pass(tmp_path):
    for u, y in optid.open_stream(_timed(tmp_path / "whole", 30, 1, 40), chunk=7):
        assert u.shape == y.shape
    stream = optid.open_stream(_timed(tmp_path / "torn", 30, 1, 40, gap=50.0), chunk=7)
    for _ in range(2):
        seen = 0
        with pytest.raises(DataError, match="p2.parquet begins 50.05 after the last sample of p1.parquet"):
            for u, _y in stream:
                seen += len(u)
        assert seen == 31


@pytest.mark.parametrize("pieces, chunk", [((0, 1, 50), 100), ((1, 50), 100), ((50, 1), 1)])
def test_the_sampling_time_comes_from_the_first_two_stamps_of_a_part(tmp_path, pieces, chunk):
    stream = optid.open_stream(_timed(tmp_path / "folder", *pieces), chunk=chunk)
    assert stream.dt == pytest.approx(0.05, rel=1e-9)
    assert sum(len(u) for u, _ in stream) == sum(pieces) and stream.ranges()[0].shape == (1,)


@pytest.mark.parametrize("source, words", [
    ({"u": np.zeros(9), "y": np.zeros(9)}, "channel 'u' is of type ndarray"),
    ({"u": "u.npy", "y": da.zeros(9)}, "channel 'y' is of type Array: a stream takes paths .* or Dask arrays for all"),
    ({}, "is empty; give every channel")])
def test_mappings_that_are_no_stream_are_refused(source, words):
    refuses(DataError, words, optid.open_stream, source)


def test_a_file_that_changes_after_opening_is_refused(record, folders):
    stream = optid.open_stream(folders)
    stream.ranges()
    frame = pd.read_parquet(folders[0] / "part.3.parquet")
    frame.assign(y=frame.y + 1).to_parquet(folders[0] / "part.3.parquet")
    refuses(DataError, "part.3.parquet.*differs from the file that was opened", optid.fit, stream, **STRUCTURE)
    (folders[0] / "part.3.parquet").unlink()
    refuses(DataError, "cannot read .*part.3.parquet.*No such file", optid.fit, stream, **STRUCTURE)


def test_an_infinite_sample_is_named_by_part(record):
    frame = frame_of(record.experiments[0])
    frame.loc[2100, "y"] = np.inf
    stream = optid.open_stream(dd.from_pandas(frame, chunksize=1000, sort=False))
    with warnings.catch_warnings(), pytest.raises(DataError, match="partition 2, column 'y'.*sample 100"):
        stream.ranges()
