"""The clock of a record is found alike in every source, or its absence is said."""

import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pandas as pd
import polars as pl
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from scipy.io import savemat

import optid
from optid.data.reading import dates
from optid.data.reading.clock import is_time_name
from optid.data.reading.rows import RowReader
from optid.data.reading.uniform import sampling_time
from optid.errors import DataError

U = np.repeat([0.0, 1.0, 3.0, 2.0, 5.0], 8)
Y = np.cumsum(U) / 7
N = len(U)
MINUTES = pd.date_range("2024-05-01 06:00", periods=N, freq="5min")


@pytest.mark.parametrize("name", [
    "t", "T", "time", "Time", "TIMESTAMP", "Timestamp", "time_stamp", "datetime", "DateTime", "Date", "Date/Time",
    "Zeit", "Zeitstempel", "Datum Uhrzeit", "Time (s)", "time [ms]", "t [s]", "t/s", "time_s", "time_us", "Time (UTC)",
    "Elapsed Time", "X_Value", "seconds", "Timestamp (Europe/Berlin)", "Zeit in min", "Čas", "Czas [s]", "Время, с",
    "时间", "Messzeit [s]", "Temps (heures)", "Fecha hora"])
def test_names_of_clocks_are_recognised(name):
    assert is_time_name(name)


@pytest.mark.parametrize("name", ["temp", "u", "y", "temperature (s)", "rate", "timer_value", "CAS", "Hours",
                                  "date_code_2", "status", ""])
def test_other_names_are_not(name):
    assert not is_time_name(name)


@pytest.mark.parametrize("name", ["Timestamp", "when"])
def test_dates_are_found_in_every_source(tmp_path, name):
    frame = pd.DataFrame({name: MINUTES, "u": U, "y": Y})
    text = frame.assign(**{name: MINUTES.astype(str)})
    frame.to_csv(tmp_path / "r.csv", index=False)
    pl.from_pandas(frame).write_parquet(tmp_path / "r.parquet")
    pl.from_pandas(text).write_parquet(tmp_path / "text.parquet")
    sources = [tmp_path / "r.csv", tmp_path / "r.parquet", tmp_path / "text.parquet", frame, text,
               pl.from_pandas(frame), pl.from_pandas(text), frame.set_index(name),
               text.set_index(name) if name == "Timestamp" else frame,
               {name: MINUTES.to_numpy(), "u": U, "y": Y}, frame.set_index(MINUTES.to_period("5min"))[["u", "y"]],
               xr.Dataset({"u": (name, U), "y": (name, Y)}, coords={name: MINUTES.to_numpy()})]
    for source in sources:
        data = optid.read(source)
        assert data.dt == 300.0 and data.time_unit == "s" and data.dated and not data.findings
        assert data.start == np.datetime64("2024-05-01T06:00") and data.time[-1] == MINUTES[-1].to_datetime64()
    for stream in (optid.open_stream(tmp_path / "r.csv"), optid.open_stream(tmp_path / "text.parquet")):
        assert stream.dt == 300.0 and stream.time_unit == "s" and not stream.findings
        assert sum(len(u) for u, _ in stream) == N


@pytest.mark.parametrize(("unit", "step", "dt"), [("s", 0.5, 0.5), ("ms", 20, 0.02), ("us", 500, 5e-4),
                                                  ("min", 5, 300.0), ("h", 1, 3600.0), ("d", 1, 86400.0)])
def test_units_of_time_are_read_alike(tmp_path, unit, step, dt):
    named, plain = f"Time ({unit})", {"u": U, "y": Y}
    stamps = step * np.arange(N)
    savemat(tmp_path / "r.mat", {f"time_{unit}": stamps, **plain})
    pd.DataFrame({named: stamps, **plain}).to_csv(tmp_path / "r.csv", index=False)
    (tmp_path / "units.csv").write_text("time,u,y\n" + f"{unit},V,A\n" + "".join(
        f"{a},{b},{c}\n" for a, b, c in zip(stamps.tolist(), U, Y)))
    for source in (pd.DataFrame({named: stamps, **plain}), {named: stamps, **plain}, tmp_path / "r.csv",
                   tmp_path / "r.mat", tmp_path / "units.csv"):
        data = optid.read(source)
        assert data.dt == pytest.approx(dt, rel=1e-12) and data.time_unit == "s" and not data.dated
    assert optid.read(tmp_path / "units.csv").input_units == ("V",)


@pytest.mark.parametrize(("values", "dt", "first"), [
    (1714543200 + 2 * np.arange(N), 2.0, "2024-05-01T06:00"), (1714543200.5 + 0.25 * np.arange(N), 0.25, None),
    (1714543200000 + 100 * np.arange(N), 0.1, "2024-05-01T06:00"),
    (1714543200000000 + 50 * np.arange(N), 5e-5, "2024-05-01T06:00"),
    (1714543200000000000 + 10**9 * np.arange(N), 1.0, "2024-05-01T06:00"),
    (45413.25 + np.arange(N) / 1440, 60.0, "2024-05-01T06:00"),
    (739373.25 + np.arange(N) / 24, 3600.0, "2024-05-01T06:00")])
def test_counts_of_seconds_and_days_are_dates(values, dt, first):
    data = optid.read({"time": values, "u": U, "y": Y})
    assert data.dt == pytest.approx(dt, rel=1e-7) and data.dated and len(data.findings) == 1
    assert first is None or abs(data.start - np.datetime64(first)) < np.timedelta64(50, "us")


@pytest.mark.parametrize("values", [36600 + 0.1 * np.arange(N), 40000 + np.arange(N), 45413 + 0.25 * np.arange(N),
                                    1e6 + np.arange(N), 50.0 * np.arange(N)])
def test_seconds_of_a_day_are_no_dates(values):
    data = optid.read({"time": values, "u": U, "y": Y})
    assert not data.dated and data.dt == pytest.approx(values[1] - values[0])
    assert all("read as seconds; if" in one and "pass date_format='excel'" in one for one in data.findings)


def test_without_a_clock_time_counts_samples_and_that_is_said_first(tmp_path):
    data = optid.read({"u": U, "y": Y})
    assert (data.dt, data.time_unit) == (1.0, "") and data.findings[0].startswith("no time column: 1 sample = 1")
    assert "no time column" in str(data).splitlines()[1]
    assert optid.read({"u": U, "y": Y}, dt=0.1).findings == () and optid.read({"u": U, "y": Y}, dt=0.1).time_unit == "s"
    pd.DataFrame({"u": U, "y": Y}).to_csv(tmp_path / "r.csv", index=False)
    assert optid.open_stream(tmp_path / "r.csv").findings[0].startswith("no time column")
    assert optid.Data(U, Y).time_unit == "" and optid.Data(U, Y, 2.0).time_unit == "s"


def test_a_clock_that_is_read_as_a_signal_is_said():
    source = {"log.time": 0.1 * np.arange(N), "y": Y}
    assert "channel 'log.time' is named as a clock" in " ".join(optid.read(source, "log.time", "y").findings)
    assert not [one for one in optid.read(source, "log.time", "y", time=False).findings if "named as a clock" in one]


def test_two_clocks_must_agree():
    both = {"Timestamp": MINUTES.to_numpy(), "u": U, "y": Y}
    refuses(DataError, "two clocks disagree: 'Timestamp' steps by 300 s from .*, 't' steps by 0.1 s from 0.*time='t'",
            optid.read, {**both, "t": 0.1 * np.arange(N)})
    assert optid.read({**both, "t": 0.1 * np.arange(N)}, time="t").dt == pytest.approx(0.1)
    assert optid.read({**both, "t": 300.0 * np.arange(N)}).dated
    assert optid.read({**both, "Date": np.full(N, "2024-05-01")}).dt == 300.0  # a constant is no clock
    found = optid.read({**both, "time": np.array(["a", "b"] * (N // 2), dtype=object)})
    assert found.dated and "column 'time' holds no time stamps" in found.findings[0]


def test_a_stream_settles_its_clocks_as_a_reader_does(tmp_path):
    """Rivals must agree, a date and a time of day are one clock, and midnight does not end it."""
    moments = pd.date_range("2024-05-01 23:50", periods=N, freq="1min")
    tables = {"rival": {"time": 0.1 * np.arange(N), "timestamp": moments},
              "pairs": {"u Time": MINUTES, "y Time": moments},
              "split": {"Date": moments.strftime("%Y-%m-%d"), "Time": moments.strftime("%H:%M:%S")},
              "hours": {"Time": moments.strftime("%H:%M:%S")}, "agree": {"time": 60 * np.arange(N), "stamp": moments}}
    for name, clocks in tables.items():
        for kind in ("csv", "parquet"):
            frame, path = pd.DataFrame({**clocks, "u": U, "y": Y}), tmp_path / f"{name}.{kind}"
            frame.to_csv(path, index=False) if kind == "csv" else frame.to_parquet(path)
            if name in ("rival", "pairs"):
                for opened in (optid.read, optid.open_stream):
                    refuses(DataError, "two clocks disagree", opened, path)
                continue
            for chunk in (7, 1, 1000):
                stream = optid.open_stream(path, chunk=chunk)
                assert stream.dt == optid.read(path).dt == 60.0
                assert np.concatenate([u[:, 0] for u, _ in stream]) == pytest.approx(U)
    coarse = tmp_path / "coarse.csv"
    pd.DataFrame({"time": np.arange(N) // 4, "u": U, "y": Y}).to_csv(coarse, index=False)
    refuses(DataError, "does not spread them: pass time=False with dt=0.25", optid.open_stream, coarse, dt=0.25)


def test_a_frame_with_a_row_of_units_is_refused_with_that_row():
    frame = pd.DataFrame({"time": ["s", *map(str, range(N))], "u": ["V", *map(str, U)], "y": ["rpm", *map(str, Y)]})
    for source in (frame, pl.from_pandas(frame)):
        refuses(DataError, "row 1 holds 's', no number like the others", optid.read, source)
        refuses(DataError, r"row 1 holds 'V', not a number. The whole row is text \(V, rpm, s\)", optid.read,
                source.rename(columns={"time": "k"}) if source is frame else source.rename({"time": "k"}), time=False,
                quality={"k": "1"})


def test_a_wrong_word_is_never_ignored_for_another_clock():
    both = {"Timestamp": np.array(MINUTES.astype(str)), "t": 300.0 * np.arange(N), "u": U, "y": Y}
    refuses(DataError, "time_zone='Mars': there is no such zone", optid.read, both, time_zone="Mars")
    refuses(DataError, "is not a date of the format '%d.%m.%Y'", optid.read, both, date_format="%d.%m.%Y")


def test_daily_files_continue_each_other(tmp_path):
    paths = []
    for day in range(3):
        part = slice(13 * day, 13 * day + 13)
        paths.append(tmp_path / f"day{day}.csv")
        pd.DataFrame({"Timestamp": MINUTES[part], "u": U[part], "y": Y[part]}).to_csv(paths[-1], index=False)
    whole = optid.read(paths)
    assert whole.n_experiments == 1 and whole.n_samples == 39 and "continues" in whole.findings[0]
    np.testing.assert_array_equal(whole.y[:, 0], Y[:39])
    turned = optid.read(paths[::-1])
    np.testing.assert_array_equal(turned.y, whole.y)
    assert "in the order of their dates" in turned.findings[0]
    frames = [pd.read_csv(path) for path in paths]  # without names of their own
    np.testing.assert_array_equal(optid.read(frames[::-1]).y, whole.y)
    twice = optid.read([frames[0], frames[0]])
    assert twice.n_experiments == 2 and "overlaps" in twice.findings[0]
    apart = optid.read([paths[0], paths[2]])
    assert [e.n_samples for e in apart.experiments] == [13, 13] and not apart.findings
    filled = optid.read([paths[0], paths[2]], gaps="missing")
    assert filled.n_experiments == 1 and np.isnan(filled.u[13:26]).all() and filled.n_samples == 39
    assert optid.read([paths[0], paths[2]], gaps="experiments").n_experiments == 2
    assert optid.read([{"u": U, "y": Y}] * 2, dt=1.0).n_experiments == 2  # without clocks nothing continues


def test_local_time_becomes_utc():
    """The hour that the end of summer time repeats is told by the order of the stamps."""
    utc = pd.date_range("2024-10-26 22:00", periods=N, freq="10min")
    local = utc.tz_localize("UTC").tz_convert("Europe/Berlin").tz_localize(None)
    data = optid.read({"time": local.to_numpy(), "u": U, "y": Y}, time_zone="Europe/Berlin")
    np.testing.assert_array_equal(data.time, utc.to_numpy().astype("M8[ns]"))
    refuses(DataError, "Daylight saving time ends there.*time_zone=", optid.read,
            {"time": local.to_numpy(), "u": U, "y": Y})
    skipped = np.datetime64("2024-03-31T02:00") + np.arange(N) * np.timedelta64(60, "s")
    refuses(DataError, "does not exist in Europe/Berlin", optid.read, {"time": skipped, "u": U, "y": Y},
            time_zone="Europe/Berlin")
    refuses(DataError, "runs backwards there", optid.read, {
        "time": np.r_[np.arange(20), np.arange(15, 35)], "u": U, "y": Y})


@settings(deadline=None, max_examples=40)
@given(st.sampled_from([0.1, 1 / 3, 0.02, 5.0, 60.0, 0.0125]), st.integers(20, 400), st.floats(0, 0.2),
       st.integers(0, 99))
def test_the_sampling_time_keeps_its_digits_under_jitter(dt, n, jitter, seed):
    """Stamps with jitter give the sampling time within three standard errors of the line through them."""
    r = np.random.default_rng(seed)
    stamps = dt * (np.arange(n) + jitter * r.uniform(-1, 1, n))
    found = sampling_time(stamps)
    assert abs(found / dt - 1) < 8 * jitter / n**1.5 * np.sqrt(12 / 3) + 1e-11


@settings(deadline=None, max_examples=60)
@given(st.datetimes(datetime(1990, 1, 1), datetime(2060, 1, 1)), st.sampled_from([
    "%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M:%S.%f", "%Y/%m/%d %H:%M", "%d-%b-%Y %H:%M:%S", "%Y-%m-%d %I:%M:%S %p",
    "%Y%m%dT%H%M%S", "%Y-%m-%d", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S", "%d.%m.%y %H:%M", "%Y-%m-%d %H:%M:%S,%f"]))
def test_every_format_of_dates_is_recognised_and_read_as_strptime_reads_it(moment, form):
    text = moment.strftime(form).replace(f"{moment.year}", f"{moment.year:04d}")
    found = dates.formats(text)
    assert form in found and (len(found) == 1 or not dates.is_unambiguous(found[0]))
    stamps, _ = dates.parse([text, text], form, "x")
    assert stamps[1] == np.datetime64(datetime.strptime(text, form), "us")


def test_time_stamps_return_to_pandas_and_slices_take_dates():
    data = optid.read({"time": MINUTES.to_numpy(), "u": U, "y": Y})
    assert list(data.to_pandas().index) == list(MINUTES)
    part = data["2024-05-01T07:00":np.datetime64("2024-05-01T08:00")]
    assert part.n_samples == 12 and part.start == np.datetime64("2024-05-01T07:00")
    assert data[3:5].start == MINUTES[3].to_datetime64()
    assert "from 2024-05-01 06:00:00 to 2024-05-01 09:15:00" in str(data)
    assert optid.read({"time": MINUTES.to_numpy(), "u": U, "y": Y}, from_="2024-05-01T07:00",
                      to="2024-05-01 07:55").n_samples == 12
    refuses(DataError, "no sample lies between; the dictionary has 2024-05-01T06:00", optid.read,
            {"time": MINUTES.to_numpy(), "u": U, "y": Y}, from_="2025-01-01")
    dated = optid.Data(U, Y, 60.0, start=["2024-05-01"])
    assert dated.dated and dated.time[1] == np.datetime64("2024-05-01T00:01")


def test_resampling_fills_what_a_line_fills():
    r = np.random.default_rng(2)
    t = np.cumsum(r.uniform(0.05, 0.15, 400))
    data = optid.read({"t": t - t[0], "u": np.floor(t), "y": 3 * t}, resample="0.1s")
    instants = data.time + t[0]
    np.testing.assert_allclose(data.y[:, 0], 3 * instants, rtol=1e-12)
    held = np.floor(t)[np.searchsorted(t, instants + 1e-9, "right") - 1]
    np.testing.assert_array_equal(data.u[:, 0], held)
    coarse = optid.read({"t": 0.1 * np.arange(400), "u": np.ones(400), "y": np.arange(400.0)}, resample=1.0)
    assert coarse.dt == 1.0 and abs(np.diff(coarse.y[1:-1, 0]) - 10).max() < 1e-12  # averages of ten


def test_a_live_stream_reads_the_clock_as_a_file_does():
    how = optid.Format(decimal=",", date_format="%d.%m.%Y %H:%M:%S", missing="BAD")
    reader = RowReader(["u"], ["y"], dt=2.0, how=how)
    lines = ["Zeit;u;y", "-;V;rpm"] + [f"01.05.2024 06:00:{2 * k:02d};{k},5;{k if k != 4 else 'BAD'}" for k in range(9)]
    rows = [reader.read(lines[:5]), reader.read(lines[5:])]
    assert np.concatenate([part.u for part in rows])[:, 0].tolist() == [k + 0.5 for k in range(9)]
    assert np.isnan(rows[1].y[1, 0]) and not any(part.error or part.bad for part in rows)
    late = reader.read(["01.05.2024 06:00:30;1;1"])
    assert "comes 14 after the one before" in late.error
    both = RowReader(["u"], ["y"], dt=60.0)
    lines = ["Date,Time,u,y"] + [f"{(datetime(2024, 5, 1, 23, 55) + timedelta(minutes=k)):%Y-%m-%d,%H:%M:%S},1,2"
                                 for k in range(9)]
    assert not both.read(lines).error
    refuses(DataError, "gaps= needs the whole record.*--fill-gaps", RowReader, ["u"], ["y"], dt=1.0,
            how=optid.Format(gaps="missing"))


def lines(clocks, head="time,u,y"):
    """Return a table whose rows begin with some stamps."""
    return "\n".join([head, *(f"{stamp},{k % 3},{k}" for k, stamp in enumerate(clocks))]) + "\n"


SECONDS = [f"06:07:{k:02d}" for k in range(9)]


@pytest.mark.parametrize(("text", "words", "dt", "said"), [
    (lines(["00:00", "00:01", "00:02"], "Time (mm:ss),u,y"), {}, 1.0, "minutes:seconds"),
    (lines(["00:00", "00:01", "00:02"]), {}, 60.0, "hours:minutes"),
    (lines(["00:00", "00:01", "00:02"]), {"date_format": "%M:%S"}, 1.0, ""),
    (lines(["20240305", "20240306", "20240307"]), {"date_format": "%Y%m%d"}, 86400.0, ""),
    (lines([one.replace(":", "") for one in SECONDS]), {"date_format": "%H%M%S"}, 1.0, ""),
    (lines(["45356.25", "45357.25", "45358.25"]), {}, 1.0, "pass date_format='excel'"),
    (lines(["45356.25", "45357.25", "45358.25"]), {"date_format": "excel"}, 86400.0, "as of Excel"),
    (lines(["2460374.75", "2460374.76", "2460374.77"]), {}, 0.01, "pass date_format='julian'"),
    (lines([f"{133540924280000000 + 10**7 * k}" for k in range(5)]), {}, 1.0, "as of Windows"),
    (lines([f"{3792463628 + k}" for k in range(5)]), {}, 1.0, "as of LabVIEW"),
    (lines(range(0, 9000, 1000), "Time (ticks),u,y"), {}, 1000.0, "'ticks' is not known"),
    (lines(["2024-03-05 23:00:00", "2024-03-06", "2024-03-06 01:00:00"]), {}, 3600.0, ""),
    (lines(["2024-03-05 00:00:02", "2024-03-05 00:00:01", "2024-03-05 00:00:00"]), {}, 1.0, "turned round"),
    (lines([f'"Mar 05, 2024 {one} AM"' for one in SECONDS]), {}, 1.0, ""),
    (lines([f"{0.05 * k:.2f}" for k in range(9)], "x-axis,u,y"), {}, 1.0, "pass time='x-axis' if it is the clock"),
    ("t,u,y\n(ms),(V),(mV)\n\n0,1,2\n1,2,3\n2,3,4\n", {}, 0.001, "units t ms, u V, y mV"),
    (lines([f"{k}" for k in range(9)], "Temps (heures),u,y"), {}, 3600.0, "in h, read as seconds"),
    (lines([f"{k}" for k in range(9)], "time [min.],u,y"), {}, 60.0, "in min, read as seconds"),
    (lines([f"{k}" for k in range(9)], "Tiempo segundos,u,y"), {}, 1.0, ""),
    (lines([f"{k}" for k in range(9)], "Minutes,u,y"), {"time": "Minutes"}, 60.0, "in min, read as seconds"),
    (lines([f"{1709618828 + k}" for k in range(9)], "Fecha hora,u,y"), {}, 1.0, "seconds since 1970"),
    (lines([f"{k}" for k in range(9)], "ms,u,y"), {"time": "ms"}, 1e-3, "in ms, read as seconds"),
    (lines(["time,u,y", *range(9)]).replace("time,u,y,0,0", "time,u,y"), {}, 1.0, "1 row of descriptions skipped"),
    (lines(range(9)).replace(",2\n", ",-inf\n"), {"missing": "-inf"}, 1.0, ""),
    ('t,u,y\n0,"57,5",1\n1,"57,5",2\n', {"decimal": ","}, 1.0, ""),
    ("t,u,y,Status\n0,1,2,192\n1,2,3,216\n2,3,4,0\n", {}, 1.0, "Pass quality='Status:192|216'"),
])
def test_other_clocks_and_tables_are_read_and_said(tmp_path, text, words, dt, said):
    (tmp_path / "r.csv").write_text(text)
    data = optid.read(tmp_path / "r.csv", **words)
    assert data.dt == pytest.approx(dt, rel=1e-9) and (said in " ".join(data.findings) if said else True)


@pytest.mark.parametrize(("text", "words", "said"), [
    ("Timestamp,u,Timestamp.1,y\n00:00:00,1,00:00:03,2\n00:00:01,1,00:00:04,2\n00:00:02,1,00:00:05,2\n", {},
     "two clocks disagree"),
    ("Time u,u,Time y,y\n0,1,3,2\n1,1,4,2\n2,1,5,2\n", {}, "two clocks disagree"),
    (lines(["20240305", "20240306"]), {}, "Pass date_format='%Y%m%d'"),
    (lines(["2024030506", "2024030507"]), {}, "Pass date_format='%Y%m%d%H'"),
    (lines(["2567-03-05", "2567-03-06"]), {}, "outside the years"),
    (lines(["1990", "1991", "1992"], "Date,u,y"), {}, "look like years"),
    (lines([f"{1709618828000 + 1000 * k}" for k in range(4)], "Time (s),u,y"), {},
     "by its size in milliseconds since 1970"),
    ("Time (s),u,y\nms,V,V\n0,1,2\n50,1,2\n", {}, "its name says s, its unit ms"),
    ("0,1,2\n0,57.5,100\n1,57.5,101\n", {"inputs": "1", "outputs": "2"}, "a header of numbers, or samples"),
    ("0.0,BAD,100\n0.1,57.5,101\n0.2,58,102\n", {"inputs": 1, "outputs": 2}, "would be the header, but holds '0.0'"),
    ("t,u,y\n0,1,2\n", {"columns": ["t", "u", "y"]}, "has a header"),
    ("t,u,y\n0,1,2\n1,2,3\n", {"units_row": 1}, "row 1 after the header holds numbers"),
    ("t,u,y\n0,On,2\n1,Off,2\n", {}, "Write 0 and 1"),
    ("t,u,y\n0,12.5 V,1\n1,13 V,2\n", {}, "a number with its unit"),
    (lines(["24-03-05 06:07:08", "24-03-05 06:07:09"]), {}, "'%y-%m-%d %H:%M:%S'"),
    ("t;u;y\n0,0;57;1\n0,5;57;1\n1,0;57;1\n", {}, "Pass delimiter=';', decimal=','"),
    ("t;u;y\n0;1,000;0.12\n1;2,500;0.25\n", {}, "pass delimiter=';', thousands=','"),
    ("t;u;y\n0;1,000;120\n1;2,500;250\n", {}, "pass delimiter=';', decimal=','"),
    ("t u y\n0 1D+00 2\n1 2.5D+00 3\n", {}, "Write E in place of D"),
    ("t,u,y\n0,1,2\n1,-1.#IND,3\n", {}, "missing='-1.#IND'"),
    ("time [0.1 s],u,y\n0,1,2\n1,2,3\n", {}, "counts steps of '0.1 s'"),
    (lines([0, 1, "BAD", 3, 4]), {"missing": "x"}, "row 3 holds 'BAD', no number like the others"),
    (lines([*SECONDS[:5], "05.03.2024 06:07:08"]), {}, "row 6 holds '05.03.2024 06:07:08', no date like the others"),
    ("t,u,y\n0,1,5\n0,1,5\n1,2,6\n1,2,6\n2,1,7\n2,1,7\n", {}, "are equal: pass gaps='missing'"),
])
def test_what_could_be_meant_otherwise_is_refused(tmp_path, text, words, said):
    (tmp_path / "r.csv").write_text(text)
    refuses(DataError, re.escape(said), optid.read, tmp_path / "r.csv", **words)


def test_data_sets_keep_their_units_and_dimensions():
    def of(t, **attributes):
        return xr.Dataset({"u": ("time", U, {"units": "V"}), "y": ("time", Y)},
                          coords={"time": ("time", t, attributes)})

    data = optid.read(of(250.0 * np.arange(N), units="ms"))
    assert data.dt == 0.25 and data.input_units == ("V",)
    since = optid.read(of(np.arange(N), units="minutes since 2024-03-05"))
    assert since.dt == 60.0 and since.start == np.datetime64("2024-03-05")
    apart = xr.Dataset({"u": ("a", U), "y": ("b", Y)}, coords={"a": np.arange(N), "b": 3.0 + np.arange(N)})
    refuses(DataError, r"different dimensions: u \(a\), y \(b\)", optid.read, apart)


@pytest.mark.parametrize("values", [
    lambda t: t, lambda t: np.array(t), lambda t: [one.replace(tzinfo=UTC) for one in t],
    lambda t: [str(one) for one in t], lambda t: pd.Series(t).dt.time.to_list(), lambda t: pd.Series(t, dtype=object)])
def test_dates_of_python_are_read(values):
    stamps = values([datetime(2024, 5, 1, 6) + timedelta(seconds=2 * k) for k in range(N)])
    for source in ({"time": stamps, "u": U, "y": Y}, pd.DataFrame({"time": stamps, "u": U, "y": Y})):
        assert optid.read(source).dt == 2.0


def test_impossible_instants_and_encodings_are_named(tmp_path):
    values = np.append(1714543200.0 + np.arange(N - 1), 1e300)
    refuses(DataError, rf"row {N}: 1e\+300 is outside the years", optid.read, {"time": values, "u": U, "y": Y})
    (tmp_path / "r.csv").write_text("t,u,y\n0,1,2\n1,2,3\n")
    refuses(DataError, "r.csv is not utf-16 text.*encoding='latin-1'", optid.read, tmp_path / "r.csv",
            encoding="utf-16")
