import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from scipy.signal import decimate

from optid.data.channels import MOST_LEVELS, count_levels
from optid.data.readers import read
from optid.data.record import Data, Transform
from optid.errors import DataError, DataWarning


@pytest.fixture
def record() -> Data:
    r = np.random.default_rng(1)
    u, y = r.normal(2.0, 3.0, (200, 2)), r.normal(-1.0, 0.5, (200, 1))
    y[7] = np.nan
    return Data(u, y, 0.1, ["valve", "pump"], "level", ["%", "V"], "m", name="tank")


# -- what Data holds


def test_arrays_are_frozen_copies():
    u, y = np.arange(6.0).reshape(3, 2), np.arange(3.0)
    data = Data(u, y)
    u[0, 0] = 99.0
    assert data.u[0, 0] == 0.0 and data.u.dtype == np.float64 and data.y.shape == (3, 1)
    assert data.inputs == ("u1", "u2") and data.outputs == ("y",) and (data.m, data.l, data.n_samples) == (2, 1, 3)
    for part in (data, data.split(2)[1], data.select(inputs="u2"), data.detrend()):
        for array in (part.u, part.y):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 1.0
    with pytest.raises(AttributeError):
        data.dt = 2.0  # pyright: ignore[reportAttributeAccessIssue]


def test_several_experiments_of_unequal_length():
    data = Data([np.ones(3), np.zeros((5, 1))], [np.ones((3, 1)), np.arange(5)], dt=0.5, start=[0.0, 10.0])
    assert data.n_experiments == 2 and data.n_samples == 8
    assert [u.shape for u in data.u] == [(3, 1), (5, 1)] and isinstance(data.y, tuple)
    np.testing.assert_array_equal(data.time[1], [10.0, 10.5, 11.0, 11.5, 12.0])
    assert data.experiments[1].start == 10.0


def test_one_record_may_be_a_plain_list_or_masked():
    np.testing.assert_array_equal(Data([1, 2, 3], [1.5, 2, 3]).u[:, 0], [1.0, 2.0, 3.0])
    masked = np.ma.array([1, 2, 3], mask=[False, True, False])
    np.testing.assert_array_equal(Data(masked, [1, 2, 3]).u[:, 0], [1.0, np.nan, 3.0])


def test_repr_says_what_a_person_wants_to_know(record):
    assert repr(record) == "Data('tank': 200 samples every 0.1 s, valve, pump -> level)"
    assert "'tank': 2 experiments, 200 samples" in repr(Data.join(*record.split(0.5)))
    text = str(record)
    assert text.startswith("tank: 200 samples every 0.1") and text == str(record.describe())
    rows = [line.split() for line in text.splitlines()]
    assert ["valve", "input", "%"] in [row[:3] for row in rows] and rows[-1][:3] == ["level", "output", "m"]
    assert rows[-1][-1] == "0.50%" and str(record.detrend()).endswith("reports are in raw units")
    assert "experiment 2: " in str(Data.join(*record.split(0.5)))
    assert "20 experiments of 10 to 10 samples" in str(Data([np.zeros(10)] * 20, [np.ones(10)] * 20))


def test_summaries_ignore_missing_samples(record):
    level = record.channels[2]
    y = np.delete(record.y[:, 0], 7)
    assert (level.name, level.unit, level.role, level.levels) == ("level", "m", "output", 199)
    np.testing.assert_allclose([level.low, level.high, level.mean, level.std], [y.min(), y.max(), y.mean(), y.std()])
    assert record.missing == {"valve": 0.0, "pump": 0.0, "level": 1 / 200}


def test_levels_are_counted_up_to_a_limit():
    assert count_levels(np.tile([1.0, 2.0, 5.0], 50_000)) == 3
    assert count_levels(np.arange(200_000.0)) > MOST_LEVELS


# -- bad input: the message names the thing and the remedy


@pytest.mark.parametrize(("u", "y", "parts"), [
        (np.ones((1, 50)), np.ones(50), ["(1, 50)", "50 channels", "transpose"]),
        (np.ones((2, 50)), np.ones(50), ["u", "(2, 50)", "x.T"]),
        (np.ones(50), np.ones((3, 50)), ["y", "3 sample(s)", "x.T"]),
        (np.ones(50), np.ones(49), ["50 samples", "49", "Cut both"]),
        ([np.ones(5), np.ones(6)], [np.ones(5), np.ones(7)], ["experiment 2", "6 samples", "7"]),
        ([np.ones(5), np.ones(6)], [np.ones(5)], ["2 experiments", "has 1"]),
        ([np.ones(5), np.ones((6, 2))], [np.ones(5), np.ones(6)], ["[1, 2] channels"]),
        ([], [], ["u is empty"]),
        (np.ones((0, 2)), np.ones(0), ["u is empty", "(0, 2)"]),
        (np.ones((5, 1, 1)), np.ones(5), ["(5, 1, 1)"]),
        ([[1.0, 2.0], [3.0, 4.0]], [1.0, 2.0], ["nested", "numpy.asarray"]),
        ([np.ones(3), [1, 2, 3]], [np.ones(3), np.ones(3)], ["nested or mixed"]),
        (np.array([True, False]), [1.0, 2.0], ["u", "truth values", "bool"]),
        (np.array([1j, 2.0]), [1.0, 2.0], ["complex"]),
        (np.array(["1", "2"]), [1.0, 2.0], ["text", "dtype=float"]),
        (np.array([1, None, 2], dtype=object), np.ones(3), ["objects", "NaN where a sample is missing"]),
        ([1.0, np.inf, 2.0], np.ones(3), ["u: sample 1 is inf", "NaN"]),
        (np.ones(3), [1.0, 2.0, -np.inf], ["y: sample 2 is -inf"]),
        (np.ones(3), [1.0, 1e300, 2.0], ["y: sample 1 is 1e+300"]),
        (np.array([1, 2**53 + 2]), [1.0, 2.0], ["sample 1", "9007199254740994", "2**53"]),
        (np.array([0, -1]).astype(np.uint64), [1.0, 2.0], ["sample 1", "unsigned"]),
        ([np.nan, np.nan], [1.0, 2.0], ["'u'", "every sample is missing"])])
def test_bad_arrays(u, y, parts):
    for part in parts:
        refuses(DataError, re.escape(part), Data, u, y)


def test_infinite_sample_names_channel_and_experiment():
    u = np.ones((4, 2))
    bad = u.copy()
    bad[3, 1] = np.inf
    with pytest.raises(DataError, match="u of experiment 2, channel 'pump': sample 3 is inf"):
        Data([u, bad], [np.ones(4), np.ones(4)], inputs=["valve", "pump"])


@pytest.mark.parametrize(("arguments", "part"), [
        ({"dt": 0.0}, "dt = 0.0"),
        ({"dt": np.nan}, "positive"),
        ({"dt": "1"}, "dt = '1'"),
        ({"inputs": ["a", "b"]}, "each of the 1 channels"),
        ({"inputs": "y"}, "two channels are named 'y'"),
        ({"outputs": [""]}, "non-empty"),
        ({"input_units": ["A", "V"]}, "one unit for each of the 1"),
        ({"start": [0.0, 1.0]}, "one finite time")])
def test_bad_descriptions(arguments, part):
    refuses(DataError, re.escape(part), Data, np.ones(3), np.arange(3.0), **arguments)


def test_integers_that_saturate_or_wrap_are_warned_about():
    y = np.arange(4.0)
    with pytest.warns(DataWarning, match=r"u: 2 sample\(s\) at the limits of int8 \(first at sample 1\)"):
        Data(np.array([3, 127, -128, 5], np.int8), y)
    with pytest.warns(DataWarning, match=r"1 step\(s\) above 75% of the range of uint16 \(first at sample 2\)"):
        Data(np.array([3, 2, 65530, 65000], np.uint16), y)
    # A full-range unsigned converter at rest reads zero; flags and counters within range are no sign of trouble.
    for harmless in (np.array([0, 0, 1, 100], np.uint8), np.array([-100, 0, 10, 80], np.int8), np.arange(4)):
        np.testing.assert_array_equal(Data(harmless, y).u[:, 0], harmless)


# -- parts


def test_split_window_and_join_are_inverse(record):
    first, second = record.split(0.7)
    assert (first.n_samples, second.n_samples) == (140, 60)
    assert second.experiments[0].start == pytest.approx(14.0)
    np.testing.assert_array_equal(np.vstack([first.y, second.y]), record.y)
    np.testing.assert_array_equal(record.window(140, 200).u, second.u)
    both = Data.join(first, second)
    assert both.n_experiments == 2 and both.name == "tank" and both.input_units == ("%", "V")
    assert [p.n_samples for p in both.split(10)] == [20, 180]


@pytest.mark.parametrize("at", [0, 200, -1, 1.0, 0.0, 0.001, True, "half", np.nan])
def test_split_refuses_empty_parts(record, at):
    refuses(DataError, "split at", record.split, at)


def test_select_keeps_order_and_names(record):
    part = record.select(inputs=["pump", "valve"])
    np.testing.assert_array_equal(part.u, record.u[:, ::-1])
    assert part.input_units == ("V", "%")
    assert Data.join(*record.split(50)).select(experiments=1).n_samples == 150
    refuses(DataError, r"no input 'vlave'. Did you mean 'valve'\?", record.select, inputs="vlave")
    refuses(DataError, "experiment 1 does not exist", record.select, experiments=[1])
    refuses(DataError, "at least one", record.select, inputs=[])
    refuses(DataError, "window 150:201", record.window, 150, 201)


def test_join_refuses_what_does_not_belong_together(record):
    other = Data(record.u, record.y, 0.1, ["valve", "fan"], "level", ["%", "V"], "m")
    refuses(DataError, r"data set 2 has inputs \('valve', 'fan'\)", Data.join, record, other)
    slow = Data(record.u, record.y, 0.2, ["valve", "pump"], "level", ["%", "V"], "m")
    refuses(DataError, "data set 2 is sampled every 0.2 s, the first every 0.1 s", Data.join, record, slow)
    refuses(DataError, r"raw\(\)", Data.join, record, record.detrend())
    refuses(DataError, "at least one", Data.join)


# -- changes of the samples


def test_detrend_and_scale_leave_zero_mean_and_unit_deviation(record):
    data = Data.join(*record.split(0.4)).detrend().scale()
    u = np.vstack(data.u)
    np.testing.assert_allclose(u.mean(axis=0), 0.0, atol=1e-14)
    np.testing.assert_allclose(u.std(axis=0), 1.0)
    np.testing.assert_allclose(data.transform.u_scale, record.u.std(axis=0))
    np.testing.assert_allclose(data.transform.y_offset, np.nanmean(record.y))
    assert np.isnan(data.y[0][7, 0]) and data.missing == record.missing


@given(st.lists(st.sampled_from(["mean", "std", "factor"]), min_size=1, max_size=4), st.floats(1e-3, 1e3),
       st.integers(0, 1000))
def test_raw_undoes_any_sequence_of_changes(steps, factor, seed):
    r = np.random.default_rng(seed)
    record = Data(r.normal(5, 2, (40, 2)), r.normal(-3, 1, 40))
    data = record
    for step in steps:
        data = {"mean": data.detrend, "std": data.scale, "factor": lambda d=data: d.scale({"u2": factor})}[step]()
    np.testing.assert_allclose(data.raw().u, record.u, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(data.transform.raw_y(data.y), record.y, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(data.transform.apply_u(record.u), data.u, rtol=1e-10, atol=1e-10)
    assert data.raw().transform.is_identity and record.transform == Transform.identity(2, 1)


def test_a_drift_leaves_the_outputs_and_only_them():
    t = np.arange(300.0)
    u, clean = np.sin(0.1 * t), np.cos(0.1 * t)
    drifting = clean + 0.01 * (t - t.mean())
    drifting[5] = np.nan
    data = Data(u, drifting).detrend(order=1)
    slope = np.polyfit(t[~np.isnan(drifting)], data.y[~np.isnan(drifting), 0], 1)[0]
    assert abs(slope) < 1e-12
    np.testing.assert_allclose(data.u[:, 0], u - u.mean())
    # The level about which the drift turns is kept and restored; the drift is not.
    raw = data.raw().y[:, 0]
    keep = ~np.isnan(raw)
    expected = drifting[keep] - np.polyfit(t[keep], drifting[keep], 1)[0] * (t[keep] - t.mean())
    np.testing.assert_allclose(raw[keep], expected)
    refuses(DataError, "order 2", data.detrend, 2)


def test_scale_refuses_what_has_no_scale(record):
    flat = Data(np.column_stack([np.ones(9) * 0.1, np.arange(9.0)]), np.arange(9.0))
    refuses(DataError, "'u1' is constant", flat.scale)
    refuses(DataError, r"no channel 'valv'. Did you mean 'valve'\?", record.scale, {"valv": 2.0})
    refuses(DataError, "'pump' is -1", record.scale, {"pump": -1.0})


def test_decimate_is_the_filter_of_scipy_inside_and_true_at_the_ends():
    r = np.random.default_rng(3)
    u, ramp = r.normal(size=400), 5.0 + 0.1 * np.arange(400)
    data = Data(u, ramp, dt=0.1).decimate(4)
    assert data.dt == pytest.approx(0.4) and data.n_samples == 100
    reference = decimate(u, 4, ftype="fir", zero_phase=True)
    np.testing.assert_allclose(data.u[10:-10, 0], reference[10:-10], atol=1e-12)
    np.testing.assert_allclose(data.y[:, 0], ramp[::4], atol=1e-9)


def test_decimate_refuses_gaps_and_short_records(record):
    refuses(DataError, "'level': 0.50% of the samples are missing", record.decimate, 2)
    whole = record.window(8, 200)
    assert whole.decimate(1) is whole
    refuses(DataError, "192 samples, the anti-alias filter for q = 10 has 201 taps", whole.decimate, 10)
    with pytest.raises(DataError, match="positive integer"):
        whole.decimate(1.5)  # pyright: ignore[reportArgumentType]


# -- slices, frames, descriptions


def two_runs():
    u = np.arange(10.0)
    return Data(u=[u, u + 10], y=[np.stack([u, -u], 1), np.stack([u + 1, u], 1)], dt=0.5, start=[0.0, 100.0],
                inputs="valve", outputs=["flow", "head"], input_units="%", name="rig")


def test_length_and_slices():
    data = two_runs()
    assert len(data) == 20 and len(data.select(experiments=0)) == 10
    part = data[2:-1]
    assert [e.n_samples for e in part.experiments] == [7, 7] and part.experiments[1].start == 101.0
    np.testing.assert_array_equal(part.u[0][:, 0], np.arange(2.0, 9.0))
    assert len(data[:100]) == 20 and len(data[:]) == 20
    early = data[1.0:2.5]
    assert early.n_experiments == 1 and early.time.tolist() == [1.0, 1.5, 2.0]
    assert data[101.1:].time.tolist() == [101.5, 102.0, 102.5, 103.0, 103.5, 104.0, 104.5]
    assert len(data[-np.inf:np.inf]) == 20
    tenths = Data(u=np.zeros(40), y=np.ones(40), dt=0.1)
    assert all(len(tenths[k * 0.1 : (k + 3) * 0.1]) == 3 for k in range(30))
    for wrong in (slice(0, 9, 2), slice(1, 2.0), slice("a", None), slice(50.0, 60.0), slice(5, 5), slice(np.nan, None),
                  3, "valve", slice(True, None)):
        with pytest.raises(DataError):
            data[wrong]
    refuses(TypeError, "not iterable", iter, data)


def test_pandas_frames_go_out_and_come_back():
    pd = pytest.importorskip("pandas")
    first = two_runs().select(experiments=1)
    frame = first.to_pandas()
    assert list(frame.columns) == ["valve", "flow", "head"] and frame.index.name == "time"
    again = read(frame, inputs="valve", outputs=["flow", "head"])
    np.testing.assert_array_equal(again.y, first.y)
    assert again.dt == 0.5 and again.experiments[0].start == 100.0
    both = two_runs().to_pandas()
    again = read(both.reset_index(), "valve", ["flow", "head"], experiment="experiment")
    assert [e.start for e in again.experiments] == [0.0, 100.0] and again.dt == 0.5
    assert isinstance(both.index, pd.MultiIndex)


def test_a_description_has_every_figure():
    u = np.tile([1.0, 2.0, np.nan, 4.0], 3)
    shown = Data(u=u, y=np.arange(12.0), dt=0.5, name="rig", input_units="%", start=2.0).describe()
    assert shown.channels[0].levels == 3 and shown.lengths == (12,) and shown.ends == ((2.0, 7.5),)
    assert [line.split() for line in str(shown).splitlines()] == [
        "rig: 12 samples every 0.5 s".split(), "from 2 to 7.5".split(),
        "channel role unit low high mean std levels missing".split(),
        "u input % 1 4 2.333 1.247 3 25.00%".split(), "y output 0 11 5.5 3.452 12 none".split()]
    assert "experiment 2: 10 samples from 100 to 104.5" in str(two_runs().describe())


def test_a_record_is_drawn():
    figure = two_runs().plot()
    assert [len(axes.lines) for axes in figure.axes] == [2, 2, 2] and figure.axes[0].get_ylabel() == "valve [%]"
    long = np.zeros(100_003)
    long[[40_000, 100_002]] = 7.0, 5.0
    long[500:90_00] = np.nan
    x, y = Data(u=long, y=long + 1).plot().axes[0].lines[0].get_data()
    assert len(x) < 8200 and y[list(x).index(40_000)] == 7.0 and x[-1] == 100_002


@pytest.mark.parametrize("odd", ["a\nb", "a\r", "\t", "a\0b", "\x1b[31mred", "a\x85", "a\u2028b", "a\u202eb",
                                 "\u2066a\u2069", "a\ud800"])
def test_names_and_units_with_control_characters_are_refused(odd):
    u, shown = np.ones(9), re.escape(repr(odd))
    refuses(DataError, f"name of an input is {shown}.*control character U", Data, u, u, inputs=odd)
    refuses(DataError, f"name of an output is {shown}", Data, u, u, outputs=[odd])
    refuses(DataError, f"unit of an output is {shown}", Data, u, u, output_units=[odd])


@pytest.mark.parametrize("odd", ["a*/ b", "a\\", "°C", "Ω", "温度", "درجة", "a\u200db", "??/"])
def test_other_names_are_kept_as_they_are(odd):
    u = np.ones(9)
    assert Data(u, u, inputs=odd, input_units=[odd]).inputs == (odd,)
