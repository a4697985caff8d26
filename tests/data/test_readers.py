import re
import sys
import time
from datetime import datetime, timedelta

import numpy as np
import pandas as pd
import polars as pl
import pytest
from refusals import refuses
from scipy.io import savemat

import optid
from optid.data.channels import Transform
from optid.data.readers import open_stream, read
from optid.data.reading import csvfile, textfile
from optid.data.record import Data
from optid.errors import DataError, DataWarning

U, Y = np.array([[0.5, -1.0], [1.5, 2.0], [2.5, 0.0]]), np.array([[10.0], [np.nan], [30.0]])
CSV = "u1,u2,y\n0.5,-1,10\n1.5,2,\n2.5,0,30\n"


def write(folder, text, name="record.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def same(data: Data, dt=1.0):
    np.testing.assert_array_equal(data.u, U)
    np.testing.assert_array_equal(data.y, Y)
    assert data.inputs == ("u1", "u2") and data.outputs == ("y",) and data.dt == dt


# -- every source gives the same record


def test_csv(tmp_path):
    same(read(write(tmp_path, CSV)))
    same(read(str(write(tmp_path, "\ufeff" + CSV.replace(",\n", ", NA \n") + "\n\n"))))
    same(read(write(tmp_path, CSV.replace(",", ";").replace(".", ",")), delimiter=";", decimal=","))
    same(read(write(tmp_path, CSV.replace(",", "\t"), "record.tsv")))
    same(read(write(tmp_path, '"u1", u2,"y"\n"0.5",-1,10\n1.5,2,null\n2.5,0,30')))
    same(read(write(tmp_path, CSV.split("\n", 1)[1]), columns=["u1", "u2", "y"]))
    data = read(tmp_path / "record.csv", columns=["a", "b", "c"], inputs={"valve": "b"}, outputs="c", dt=0.5,
                input_units="%")
    assert data.inputs == ("valve",) and data.dt == 0.5 and data.name == "record" and data.input_units == ("%",)


def test_parquet_and_frames(tmp_path):
    columns = {"u1": U[:, 0], "u2": [-1, 2, 0], "y": [10, None, 30]}
    same(read(pd.DataFrame(columns)))
    same(read(pd.DataFrame(columns).astype({"y": "Int64"})))
    same(read(pl.DataFrame(columns)))
    pl.DataFrame(columns).write_parquet(tmp_path / "r.parquet")
    same(read(tmp_path / "r.parquet"))


def test_parquet_without_pyarrow(tmp_path, monkeypatch):
    pl.DataFrame({"u": [1.0, 2.0], "y": [3.0, None]}).write_parquet(tmp_path / "r.parquet")
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    np.testing.assert_array_equal(read(tmp_path / "r.parquet").y, [[3.0], [np.nan]])
    refuses(DataError, r'needs pyarrow: pip install "optid\[tables\]"', open_stream, tmp_path / "r.parquet")


def test_arrays_npz_and_npy(tmp_path):
    same(read({"u": U, "y": Y}))
    same(read({"y": Y[:, 0], "u2": U[:, 1], "u1": U[:, 0], "note": "text is ignored"}))
    np.savez(tmp_path / "r.npz", u=U, y=Y, fs=10.0, note=np.array([None, "objects are ignored"]))
    same(read(tmp_path / "r.npz"), dt=0.1)
    np.save(tmp_path / "r.npy", np.hstack([U, Y]).astype(np.float32))
    same(read(tmp_path / "r.npy", inputs=[0, 1], outputs=2))
    same(read(tmp_path / "r.npy", columns=["u1", "u2", "y"]))
    same(read(np.hstack([U, Y]), inputs=[0, 1], outputs=[2]))
    assert read(tmp_path / "r.npy", columns=["a", "b", "c"], inputs=0, outputs=2).inputs == ("a",)


def test_bytes_at_their_limit_look_saturated():
    with pytest.warns(DataWarning, match="column 'u': 1 sample"):
        read({"u": np.array([255, 3], np.uint8), "y": np.ones(2)})


def test_real_records(real_data):
    reflex = read(real_data / "nlid_reflex.csv", dt=0.005)
    assert reflex.n_samples == 10000 and reflex.u[0, 0] == 0.052374516 and reflex.y[1, 0] == 0.00014307247
    table = np.loadtxt(real_data / "daisy_cstr.csv", delimiter=",", skiprows=1)
    cstr = read(real_data / "daisy_cstr.csv", inputs="u_coolant", outputs=["y1_Ca", "y2_T"], dt=0.1)
    np.testing.assert_array_equal(np.hstack([cstr.u, cstr.y]), table)
    valve = read(real_data / "damadics_actuator3_onehour.csv", ["CV_pct", "P1_kPa"], ["X_pct", "F_t_h"])
    assert valve.dt == 1.0 and valve.n_samples == 3600
    heating = read(real_data / "daisy_heating.csv", dt=2.0)
    assert heating.channels[0].levels == 6
    silverbox = read(real_data / "nlb_silverbox.npz", dt=1 / 610.35)
    assert silverbox.n_samples == 131072
    ced = Data.join(*(read(real_data / "nlb_ced_prbs.csv", {"u": f"u{k}"}, {"y": f"z{k}"}, dt=0.02) for k in (1, 2, 3)))
    assert ced.n_experiments == 3 and ced.n_samples == 1500
    stream = open_stream(real_data / "nlid_reflex.csv", dt=0.005, chunk=999)
    np.testing.assert_array_equal(np.vstack([u for u, _ in stream]), reflex.u)


# -- several experiments


def test_list_of_sources(tmp_path):
    first = write(tmp_path, "t,u,y\n0,1,1\n0.1,2,2\n0.2,3,3\n", "a.csv")
    second = write(tmp_path, "t,y,u\n5,9,8\n5.1,8,7\n", "b.csv")
    data = read([first, second])
    assert data.n_experiments == 2 and data.dt == 0.1 and data.experiments[1].start == 5.0
    np.testing.assert_array_equal(data.u[1][:, 0], [8.0, 7.0])
    third = write(tmp_path, "t,u,y\n0,1,1\n0.2,2,2\n", "c.csv")
    refuses(DataError, r"c.csv: dt = 0.1, but the time stamps step by 0.2", read, [first, third])
    refuses(DataError, "has channels", read, [first, {"u": np.ones((3, 2)), "y": np.ones(3)}])
    refuses(DataError, "list of sources is empty", read, [])


def test_experiment_column(tmp_path):
    path = write(tmp_path, "run,t,u,y\na,0,1,1\na,1,2,2\nb,0,3,3\nb,1,4,4\nb,2,5,5\n")
    data = read(path, experiment="run")
    assert [e.n_samples for e in data.experiments] == [2, 3] and data.dt == 1.0
    np.testing.assert_array_equal(data.u[1][:, 0], [3.0, 4.0, 5.0])
    frame = pl.DataFrame({"run": [1, 1, 2], "u": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0]})
    assert [e.n_samples for e in read(frame, experiment="run").experiments] == [2, 1]
    write(tmp_path, "run,u,y\na,1,1\nb,2,2\na,3,3\n")
    refuses(DataError, "experiment 'a' starts again at row 3. Sort", read, path, experiment="run")
    write(tmp_path, "run,u,y\na,1,1\n,2,2\n")
    refuses(DataError, "row 2 does not say which experiment", read, path, experiment="run")


# -- time stamps


def stamped(t):
    return {"time": np.asarray(t), "u": np.arange(float(len(t))), "y": np.arange(float(len(t)))}


def test_dt_and_start_come_from_the_stamps():
    data = read(stamped(2.0 + 0.1 * np.arange(50)))
    assert data.dt == 0.1 and data.experiments[0].start == 2.0
    assert read(stamped(np.round(np.arange(100) / 3, 3)), time_tolerance=0.01).dt == pytest.approx(1 / 3, rel=1e-4)
    assert read(stamped(np.zeros(9)), time=False, dt=3.0).dt == 3.0
    assert read(stamped([4.0])).dt == 1.0
    assert read({**stamped(np.arange(5.0)), "clock": 2 * np.arange(5.0)}, time="clock").dt == 2.0
    assert read(stamped(np.arange(5.0)), inputs="time").dt == 1.0


def test_dates_are_seconds(tmp_path):
    start = datetime(2024, 5, 1, 12)
    stamps = [start + timedelta(milliseconds=20 * k) for k in range(5)]
    values = {"u": np.arange(5.0), "y": np.arange(5.0)}
    epoch = (start - datetime(1970, 1, 1)).total_seconds()
    frames = [
        pd.DataFrame({"time": stamps, **values}),
        pd.DataFrame({"time": pd.to_datetime(stamps).tz_localize("UTC"), **values}),
        pl.DataFrame({"time": stamps, **values}),
        pl.DataFrame({"time": [s.isoformat() for s in stamps], **values}),
        {"time": np.array(stamps, dtype="M8[us]"), **values},
    ]
    pl.DataFrame({"time": [s.isoformat() + "Z" for s in stamps], **values}).write_csv(tmp_path / "r.csv")
    for source in [*frames, tmp_path / "r.csv"]:
        data = read(source)
        assert data.dt == 0.02 and data.experiments[0].start == epoch
    fast = read(stamped(np.datetime64("2024-05-01", "ns") + np.arange(9) * np.timedelta64(1000, "ns")))
    assert fast.dt == 1e-6


@pytest.mark.parametrize(("t", "arguments", "parts"), [
        ([0, 1, 2, 4, 5], {}, ["Sample 3", "t = 4.0", "comes 2 after", "median step is 1", "1.00%",
                               "1 row seems to be lost", "gaps='missing'"]),
        ([0, 1, 2, 2, 3], {}, ["Sample 3", "comes 0 after"]),
        ([0, 1, 2, 3.02], {}, ["Sample 3", "comes 1.02 after", "time_tolerance"]),
        ([3, 2, 2, 4], {}, ["time does not increase", "sort"]),
        ([0, np.nan, 2], {}, ["stamp of sample 1 is missing"]),
        ([0, 1, 2], {"dt": 0.1}, ["dt = 0.1", "step by 1", "unit", "time=False"]),
        (["x", "y", "z"], {}, ["neither numbers nor ISO dates", "'x'"]),
        (["0", "", "2"], {}, ["stamp of sample 1 is missing"]),
        ([True, False, True], {}, ["type bool"])])
def test_bad_stamps(t, arguments, parts):
    for part in parts:
        refuses(DataError, re.escape(part), read, stamped(t), **arguments)


# -- bad files


@pytest.mark.parametrize(("text", "arguments", "parts"), [
        ("", {}, ["record.csv is empty", "0 bytes"]),
        ("\n", {}, ["record.csv is empty"]),
        ("u,y\n", {}, ["header but no rows"]),
        ("u,y\n1,2\n3,oops\n", {}, ["'y'", "row 2", "'oops'", "blank"]),
        ("u,y\n1,2\n1_0,3\n", {}, ["'u'", "row 2", "'1_0'"]),
        ('u,y\n"1,5",2\n', {}, ["'1,5'", "decimal=','"]),
        ("u,y\n1,2\n3\n", {}, ["row 2 after the header has 1 cells", "keep the row"]),
        ("u,y\n1,2\n3,4,5\n", {}, ["row 2", "3 cells", "header has 2"]),
        ("u,y\n1,2\n\n3,4\n", {}, ["row 2", "is blank"]),
        ("u,y\n1,2\n3,inf\n", {}, ["'y'", "sample 1 is inf"]),
        ("u,u,y\n1,2,3\n", {}, ["two columns named 'u'"]),
        ("1,2\n3,4\n", {}, ["no header", "columns=[...]"]),
        ("u;y\n1;2\n", {"inputs": "u", "delimiter": ","}, ["no column 'u'", "delimiter"]),
        ("voltage,temp\n1,2\n", {}, ["no column 'u'", "inputs", "voltage, temp"]),
        ("voltage,temp\n1,2\n", {"inputs": "volt", "outputs": "temp"}, ["'volt'", "Did you mean 'voltage'?"]),
        ("u,y\n1,2\n", {"inputs": 2}, ["2 columns", "no column 2"]),
        ("u,y\n1,2\n", {"inputs": ["u", "u"]}, ["listed twice"]),
        ("u,y\n1,2\n", {"inputs": []}, ["inputs is empty"]),
        ("u,y\n1,2\n", {"inputs": "y"}, ["two channels are named 'y'"]),
        ("u,y\n1,2\n", {"time": "clock"}, ["no column 'clock'"]),
        ("u,y\n1,2\n", {"time": True}, ["no column t or time"]),
        ("u,y\n1,2\n", {"experiment": "run"}, ["no column 'run'"]),
        ("u,y\n1,2\n", {"columns": ["u"]}, ["2 columns", "names 1"]),
        ("u,y\n1,2\n", {"decimal": ";"}, ["decimal=';'"]),
        ("u,y\n1,2\n", {"dt": -1}, ["dt = -1", "positive"])])
@pytest.mark.parametrize("small", [1 << 20, -1])  # read by the csv module; by polars until it refuses
def test_bad_csv(tmp_path, monkeypatch, text, arguments, parts, small):
    monkeypatch.setattr(csvfile, "SMALL", small)
    for part in parts:
        refuses(DataError, re.escape(part), read, write(tmp_path, text), **arguments)


CELLS = ["1", "-2.5", "1e300", "3e-320", " 4", "5 ", "", "NA", " nan", "Null", "N/A", "inf", "1_0", "x", "0x1", '"7"',
         '"8,5"', "1,2", "-", "+6", ".5", "9.", "\u0663", "1\r", "\r", "\n", "\0", "true", "1d3", "Infinity", "-NaN"]


@pytest.mark.slow
@pytest.mark.parametrize("decimal", [".", ","])
def test_polars_and_the_csv_module_read_the_same(tmp_path, monkeypatch, decimal):
    """Random cells in a table of numbers: the same samples, or the same words about the same cell."""
    r = np.random.default_rng(5)
    monkeypatch.setattr(textfile, "BLOCK", 40)
    refused = 0
    for _ in range(400):
        cells = [[str(value) for value in row] for row in np.round(r.normal(size=(r.integers(1, 9), 3)), 3)]
        if r.random() < 0.7:
            cells[r.integers(len(cells))][r.integers(3)] = CELLS[r.integers(len(CELLS))]
        text = "u,y,z\n" + "\n".join(",".join(row) for row in cells) + "\n" * r.integers(0, 3)
        if decimal == ",":
            text = text.replace(",", ";").replace(".", ",")
        path = write(tmp_path, text)
        found, outputs = [], ["y", "z"][: r.integers(1, 3)]
        for small in (1 << 20, -1):
            monkeypatch.setattr(csvfile, "SMALL", small)
            try:
                data = read(path, outputs=outputs, delimiter="," if decimal == "." else ";", decimal=decimal)
                found.append((data.u.tobytes(), data.y.tobytes()))
            except DataError as error:
                found.append(str(error))
        refused += isinstance(found[0], str)
        assert found[0] == found[1], text
    assert 50 < refused < 350


def test_a_file_of_old_line_ends(tmp_path):
    same(read(write(tmp_path, CSV.replace("\n", "\r"))))


@pytest.mark.parametrize("delimiter", ["", ",,", "a", '"', "\n", 3])
def test_bad_delimiter(tmp_path, delimiter):
    refuses(DataError, "one character|must be a text", read, write(tmp_path, CSV), delimiter=delimiter)


@pytest.mark.slow
def test_columns_are_not_searched_one_by_one(tmp_path):
    """Ten times as many take about ten times as long, not a hundred times."""
    def spent(count):
        names, row = ["u", "y", *(f"c{k}" for k in range(count - 2))], ",".join(["0.5"] * count) + "\n"
        path, last = write(tmp_path, ",".join(names) + "\n" + row * 9), f"c{count - 3}"
        started = time.process_time()
        data = read(path, outputs=["y", "c7", last])
        assert data.n_samples == 9 and data.y[8, 2] == 0.5
        refuses(DataError, "no column 'voltage'.*and [0-9]* more", read, path, inputs="voltage")
        with pytest.raises(DataError, match=f"row 3 after the header has 1 cells, the header has {count}"):
            read(write(tmp_path, ",".join(names) + "\n" + row * 2 + "1\n"))
        return time.process_time() - started

    spent(100)  # what is imported
    assert min(spent(30_000) for _ in range(2)) < 16 * min(spent(3_000) for _ in range(2))


def test_bad_row_is_counted_across_blocks(tmp_path):
    rows = ["1,2"] * 70_000
    rows[69_998] = "1,x"
    refuses(DataError, "row 69999 ", read, write(tmp_path, "u,y\n" + "\n".join(rows)))
    rows[69_998] = "1"
    refuses(DataError, "row 69999 ", read, tmp_path / write(tmp_path, "u,y\n" + "\n".join(rows)))
    rows[69_998:] = [""] * 3
    assert read(write(tmp_path, "u,y\n" + "\n".join(rows))).n_samples == 69_998


def test_bad_files(tmp_path):
    write(tmp_path, CSV)
    refuses(DataError, "no file .*missing.csv.* There: record.csv", read, tmp_path / "missing.csv")
    refuses(DataError, r"unknown kind of file '.docx'. Known: .csv", read, tmp_path / "r.docx")
    (tmp_path / "r.csv").write_bytes(b"u,y\n\xff\xfe1,2\n")
    refuses(DataError, r"UTF-8|not a text table", read, tmp_path / "r.csv")
    np.savez(tmp_path / "r.npz", u=U, y=Y)
    pl.DataFrame({"u": [1.0], "y": [2.0]}).write_parquet(tmp_path / "r.parquet")
    savemat(tmp_path / "r.mat", {"u": U, "y": Y})
    np.save(tmp_path / "r.npy", U)
    for kind in ("npz", "parquet", "mat", "npy"):
        whole = (tmp_path / f"r.{kind}").read_bytes()
        for damaged in (whole[: len(whole) // 2], b"nonsense" * 40):
            (tmp_path / f"r.{kind}").write_bytes(damaged)
            refuses(DataError, f"r.{kind} is", read, tmp_path / f"r.{kind}")
        (tmp_path / f"r.{kind}").write_bytes(b"")
        refuses(DataError, "is empty", read, tmp_path / f"r.{kind}")
    np.save(tmp_path / "o.npy", np.array([None, 1]))
    refuses(DataError, "real numbers", read, tmp_path / "o.npy")


def test_bad_tables():
    refuses(DataError, "column 'u', row 1 holds 'a', not a number", read, pl.DataFrame({"u": ["a"], "y": [1.0]}))
    refuses(DataError, "column 'u' is of type Boolean", read, pd.DataFrame({"u": [True], "y": [1.0]}))
    refuses(DataError, "no rows", read, pl.DataFrame({"u": [], "y": []}))
    refuses(DataError, r"cannot read data from a LazyFrame: .*collect", read, pl.LazyFrame({"u": [1.0], "y": [1.0]}))
    refuses(DataError, "cannot read data from a int", read, 3)
    refuses(DataError, r"9007199254740994.*2\*\*53", read, pl.DataFrame({"u": [2**53 + 2, None], "y": [1.0, 2.0]}))
    refuses(DataError, "column 'u' has shape .*transpose", read, {"u": np.ones((1, 9)), "y": np.ones(9)})
    refuses(DataError, "u has 9 samples and y has 8", read, {"u": np.ones(9), "y": np.ones(8)})
    refuses(DataError, "'u2' has 8 samples, 'u1' has 9", read, {"u1": np.ones(9), "u2": np.ones(8), "y": np.ones(9)})
    refuses(DataError, "'t' has 8 stamps for 9 samples", read, {"u": np.ones(9), "y": np.ones(9), "t": np.arange(8)})
    refuses(DataError, "holds no arrays", read, {})
    refuses(DataError, r"shape \(2, 2, 2\)", read, np.ones((2, 2, 2)))


# -- streams


@pytest.fixture
def long_record(tmp_path):
    r = np.random.default_rng(0)
    table = r.normal(size=(1000, 3)).astype(np.float32)
    table[r.integers(0, 1000, 40), r.integers(0, 3, 40)] = np.nan
    np.save(tmp_path / "c.npy", table)
    np.save(tmp_path / "f.npy", np.asfortranarray(table))
    np.save(tmp_path / "big_endian.npy", table.astype(">f4"))
    for c, name in enumerate(("u1", "u2", "y")):
        np.save(tmp_path / f"{name}.npy", table[:, c])
    frame = pd.DataFrame(table, columns=["u1", "u2", "y"])
    frame.to_parquet(tmp_path / "r.parquet", row_group_size=300)
    frame.astype(float).to_csv(tmp_path / "r.csv", index=False)
    return tmp_path, table.astype(float)


@pytest.mark.parametrize("source", ["c.npy", "f.npy", "big_endian.npy", "r.parquet", "r.csv", "one file per channel"])
@pytest.mark.parametrize("chunk", [1, 300, 333, 5000])
def test_streams_equal_the_whole_record(long_record, source, chunk):
    folder, table = long_record
    if chunk == 1:
        table = table[:20]
    names = ("u1", "u2", "y")
    if source == "one file per channel":
        stream = open_stream({name: folder / f"{name}.npy" for name in names}, dt=0.1, chunk=chunk)
    elif source.endswith("npy"):
        stream = open_stream(folder / source, inputs=[0, 1], outputs=2, dt=0.1, chunk=chunk)
    else:
        stream = open_stream(folder / source, dt=0.1, chunk=chunk)
    assert (stream.m, stream.l, stream.dt, stream.inputs, stream.outputs) == (2, 1, 0.1, ("u1", "u2"), ("y",))
    assert stream.n_samples == (None if source == "r.csv" else 1000) and stream.transform.is_identity
    for _ in range(2):
        chunks = [part for part, _ in zip(stream, range(20))]
        assert all(u.dtype == np.float64 and len(u) == len(y) <= chunk for u, y in chunks)
        np.testing.assert_array_equal(np.vstack([np.hstack(part) for part in chunks]), table)
    if chunk > 1:
        lo, hi = stream.ranges()
        np.testing.assert_array_equal([lo, hi], [np.nanmin(table[:, :2], 0), np.nanmax(table[:, :2], 0)])


def test_ranges_take_one_pass(long_record):
    folder, _ = long_record
    stream = open_stream({name: folder / f"{name}.npy" for name in ("u1", "y")}, inputs="u1")
    lo, _ = stream.ranges()
    lo[0] = 99.0
    for name in ("u1", "y"):
        (folder / f"{name}.npy").unlink()
    assert stream.ranges()[0][0] < 0


def test_ranges_are_in_the_units_of_the_stream(long_record):
    folder, _ = long_record
    stream = open_stream([folder / "r.csv", folder / "r.parquet"])
    assert stream.lengths == (1000, 1000)
    for one in (stream, open_stream(folder / "r.csv")):
        lo, hi = one.ranges()
        units = Transform((2.0, 4.0), (1.0, 0.0), (1.0,), (0.0,))
        np.testing.assert_allclose(one.in_units(units).ranges(), [(lo - [1, 0]) / [2, 4], (hi - [1, 0]) / [2, 4]])


def test_stream_keeps_integers_and_finds_bad_samples(tmp_path):
    np.save(tmp_path / "i.npy", np.array([[1, 2], [3, 2**60]]))
    with pytest.raises(DataError, match=r"column '1': sample 1 is 1152921504606846976"):
        list(open_stream(tmp_path / "i.npy", inputs=0, outputs=1, chunk=1))
    np.save(tmp_path / "r.npy", np.array([[1.0, 2.0], [3.0, 4.0], [np.inf, 1.0]]))
    with pytest.raises(DataError, match="column 'valve': sample 2 is inf"):
        list(open_stream(tmp_path / "r.npy", inputs="valve", outputs="flow", columns=["valve", "flow"], chunk=2))
    np.save(tmp_path / "r.npy", np.full((5, 2), np.nan))
    with pytest.raises(DataError, match="'u': every sample is missing"):
        open_stream(tmp_path / "r.npy", inputs=0, outputs=1).ranges()


def test_stream_checks_time_across_chunks(tmp_path):
    t = 0.1 * np.arange(10)
    rows = [f"{a:.3f},1,2" for a in t]
    path = write(tmp_path, "t,u,y\n" + "\n".join(rows))
    stream = open_stream(path, chunk=4)
    assert stream.dt == 0.1 and sum(len(u) for u, _ in stream) == 10
    rows[8] = "0.95,1,2"
    write(tmp_path, "t,u,y\n" + "\n".join(rows))
    refuses(DataError, r"Sample 8 \(t = 0.95\) comes 0.25 after", lambda: list(open_stream(path, chunk=4)))
    assert sum(len(u) for u, _ in open_stream(path, time=False, chunk=4)) == 10
    stamps = pl.DataFrame({"time": [datetime(2024, 1, 1) + timedelta(seconds=2 * k) for k in range(9)],
                           "u": np.arange(9), "y": np.arange(9)})
    stamps.write_parquet(tmp_path / "r.parquet")
    assert open_stream(tmp_path / "r.parquet", chunk=4).dt == 2.0


def test_bad_streams(tmp_path):
    refuses(DataError, "chunk must be a positive integer", open_stream, write(tmp_path, CSV), chunk=0)
    refuses(DataError, "no file", open_stream, tmp_path / "missing.npy")
    refuses(DataError, "use read", open_stream, write(tmp_path, "x", "r.mat"))
    refuses(DataError, "no rows", lambda: list(open_stream(write(tmp_path, "u,y\n", "e.csv"))))
    refuses(DataError, "'oops'", lambda: list(open_stream(write(tmp_path, "u,y\n1,2\n3,oops\n", "e.csv"), chunk=1)))
    write(tmp_path, "nonsense", "r.parquet")
    refuses(DataError, "not a Parquet file", open_stream, tmp_path / "r.parquet")
    pl.DataFrame({"u": ["a"], "y": [1.0]}).write_parquet(tmp_path / "r.parquet")
    refuses(DataError, "column 'u', row 1 holds 'a', not a number", lambda: list(open_stream(tmp_path / "r.parquet")))
    for array, message in [
        (np.ones((2, 9)), "more channels than samples"),
        (np.ones((0, 2)), r"shape \(0, 2\)"),
        (np.ones(4, dtype=bool), "holds bool"),
    ]:
        np.save(tmp_path / "r.npy", array)
        refuses(DataError, message, open_stream, tmp_path / "r.npy")
    np.save(tmp_path / "r.npy", np.ones((9, 2)))
    whole = (tmp_path / "r.npy").read_bytes()
    (tmp_path / "r.npy").write_bytes(whole[:-8])
    refuses(DataError, "truncated: its header says 18 numbers, the file has 17", open_stream, tmp_path / "r.npy")
    (tmp_path / "r.npy").write_bytes(b"nonsense" * 9)
    refuses(DataError, "not an npy file", open_stream, tmp_path / "r.npy")
    np.save(tmp_path / "u.npy", np.ones(5))
    np.save(tmp_path / "y.npy", np.ones(6))
    refuses(DataError, r"different lengths: \{'u': 5, 'y': 6\}", open_stream, {"u": tmp_path / "u.npy",
            "y": tmp_path / "y.npy"})
    np.save(tmp_path / "y.npy", np.ones((5, 2)))
    refuses(DataError, "y.npy has 2 columns", open_stream, {"u": tmp_path / "u.npy", "y": tmp_path / "y.npy"})


# -- time indices and foreign tables


@pytest.mark.parametrize("index", [
    pd.date_range("2024-05-01", periods=5, freq="20ms"), pd.date_range("2024-05-01", periods=5, freq="20ms", tz="CET"),
    pd.timedelta_range(0, periods=5, freq="20ms"), pd.Index(0.02 * np.arange(5), name="time"),
    pd.date_range("2024-05-01", periods=5, freq="20ms", name="stamp"),
])
def test_a_time_index_sets_the_sampling_time(index):
    frame = pd.DataFrame({"u": np.arange(5.0), "y": np.arange(5.0)}, index=index)
    data = read(frame)
    assert data.dt == 0.02 and data.inputs == ("u",)
    assert read(frame, dt=0.02).dt == 0.02 and read(frame, time=False).dt == 1.0 and read(frame, time=True).dt == 0.02
    refuses(DataError, "dt = 1, but the time stamps step by 0.02", read, frame, dt=1.0)
    refuses(DataError, "not uniform", read, frame.drop(frame.index[2]))
    assert list(frame.columns) == ["u", "y"]  # the caller's frame is as it was
    if index.name == "stamp":
        assert read(frame, time="stamp").dt == 0.02
        assert read(frame.reset_index()).dt == 0.02  # the only column of dates


def test_a_frame_with_half_a_character_in_a_name_is_refused():
    pd = pytest.importorskip("pandas")
    for names in (["u", "y", "\ud800"], ["u", "\ud800", 0]):  # pandas finds the type of names that are made texts
        frame = pd.DataFrame(np.zeros((5, 3)), columns=pd.Index(names, dtype=object))
        refuses(DataError, "holds half a character; rename it", read, frame, inputs="u", outputs=1)


def test_an_index_without_time_is_ignored():
    frame = pd.DataFrame({"u": np.arange(5.0), "y": np.arange(5.0)}, index=[3, 1, 4, 1, 5])
    assert read(frame).dt == 1.0
    dates = pl.DataFrame({"when": [datetime(2024, 1, 1) + timedelta(seconds=3 * k) for k in range(5)],
                          "u": np.arange(5.0), "y": np.arange(5.0)})
    assert read(dates).dt == 3.0
    assert read(dates.with_columns(until=pl.col("when"))).dt == 3.0  # two columns of dates that agree
    refuses(DataError, "two clocks disagree: 'when' steps by 3 s from .*, 'until' steps by 6 s .*time='when'",
            read, dates.with_columns(until=pl.Series([datetime(2024, 1, 1, 0, 0, 6 * k) for k in range(5)])))


def test_dates_of_a_parquet_file_written_by_pandas(tmp_path):
    index = pd.date_range("2024-05-01", periods=5, freq="20ms")
    pd.DataFrame({"u": np.arange(5.0), "y": np.arange(5.0)}, index=index).to_parquet(tmp_path / "r.parquet")
    assert read(tmp_path / "r.parquet").dt == 0.02


def test_arrow_and_xarray(tmp_path):
    import pyarrow as pa

    same(read(pa.table({"u1": U[:, 0], "u2": U[:, 1], "y": Y[:, 0]})))
    xarray = pytest.importorskip("xarray")
    time_of = pd.date_range("2024-05-01", periods=3, freq="2s")
    same(read(xarray.Dataset({"u": (("time", "channel"), U), "y": ("time", Y[:, 0])}, {"time": time_of})), dt=2.0)


def test_fit_names_the_way_to_a_record():
    frame = pd.DataFrame({"u": U[:, 0], "y": Y[:, 0]})
    for source in (frame, pl.DataFrame(frame), {"u": U, "y": Y}, U):
        refuses(DataError, r"optid\.read\(df, ", optid.fit, source)
    refuses(DataError, r"fit\(optid.read\('r.csv', ", optid.fit, "r.csv")


def test_numbers_with_decimal_commas_are_no_tags(tmp_path):
    rows = "".join(f"{k};{(5, 4, 2.5, 1)[k // 5 % 4]:.6f};{k / 3:.6f}\n".replace(".", ",") for k in range(60))
    path = tmp_path / "comma.csv"
    path.write_text("Zeit;Ventil;Temperatur\n" + rows)
    refuses(DataError, "no column 'u' or 'u1'", read, path)
    assert read(path, inputs="Ventil", outputs="Temperatur", delimiter=";", decimal=",").n_samples == 60
