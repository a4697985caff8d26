"""Missing inputs cut a record: the stretches, the words, and fits equal to those of a record cut by hand."""

import numpy as np
import pytest
from refusals import refuses
from scipy.signal import lfilter

import optid
from optid.data.stretches import between_gaps, with_whole_inputs
from optid.errors import DataError, DataWarning, OptidError

ORDERS = {"na": 2, "nb": 2, "nk": 1}


def signals(samples=600, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, samples)
    y = lfilter([0, 0.8, 0.6], [1, -1.5, 0.7], u + 0.5 * u**2) + 0.2 * rng.standard_normal(samples)
    return u, y


def test_stretches_of_several_experiments():
    rng = np.random.default_rng(0)
    us, ys = [rng.normal(size=(30, 2)), rng.normal(size=(12, 2))], [rng.normal(size=30), rng.normal(size=12)]
    us[0][[0, 9, 14, 15], [0, 1, 0, 0]] = np.nan
    us[1][11, 1] = np.nan
    ys[1][3] = np.nan
    data = optid.Data(us, ys, dt=0.5, input_units=("V", "A")).scale()
    cut, places = between_gaps(data, 5), [(0, slice(1, 9)), (0, slice(16, 30)), (1, slice(0, 11))]
    assert cut.n_experiments == 3
    for e, (i, part) in zip(cut.experiments, places):
        assert np.array_equal(e.u, data.u[i][part]) and np.array_equal(e.y, data.y[i][part], equal_nan=True)
        assert e.start == data.experiments[i].start + part.start * 0.5
    assert cut.transform == data.transform and cut.input_units == ("V", "A")
    assert [e.n_samples for e in between_gaps(data, 11).experiments] == [14]  # ten outputs in the last stretch
    refuses(DataError, "no stretch of 15 samples", between_gaps, data, 15)
    with pytest.warns(DataWarning, match=r"'u1' \(3 samples\), 'u2' \(2 samples\).*33 of 42 samples.*3 stretches.*; 1 "
                                         "shorter than 5 outputs is left out"):
        assert with_whole_inputs(data, 5).n_samples == 33


def test_whole_records_stay_as_they_are():
    u, y = signals(50)
    data = optid.Data(u, y)
    assert with_whole_inputs(data, 3) is data


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("name", "orders"), [
    ("oe.exact", ORDERS),
    ("hammerstein_oe.exact", {**ORDERS, "basis": "polynomial:2"}),
    ("hammerstein_oe.shooting", {**ORDERS, "basis": "polynomial:2"}),
    ("bj.exact", {**ORDERS, "nc": 1, "nd": 1}),
    ("hammerstein_bj.exact", {**ORDERS, "nc": 1, "nd": 1, "basis": "polynomial:2"}),
    ("ss.exact", {"nx": 2}),
    ("hammerstein_ss.exact", {"nx": 2, "basis": "polynomial:2"}),
    ("hammerstein_ss.exact", {"nx": 2, "basis": "polynomial:2", "criterion": "prediction"}),
])
def test_fits_with_missing_inputs_are_those_of_a_record_cut_by_hand(name, orders):
    u, y = signals(300 if name.endswith("shooting") else 600)
    lost = u.copy()
    lost[[100, 101, 103, 200]] = np.nan
    parts = [slice(0, 100), slice(104, 200), slice(201, None)]
    with pytest.warns(DataWarning, match=r"missing inputs: 'u' \(4 samples\).*3 stretches.*1 shorter than 5 outputs"):
        fit = optid.fit(optid.Data(lost, y), name, **orders)
    hand = optid.fit(optid.Data([u[part] for part in parts], [y[part] for part in parts]), name, **orders)
    assert fit.solution.status == hand.solution.status
    assert fit.solution.objective == pytest.approx(hand.solution.objective, rel=1e-8)
    if np.isfinite(hand.solution.bound.value):
        assert fit.solution.bound.value == pytest.approx(hand.solution.bound.value, rel=1e-8)
    after = slice(50, None)  # what a state of zero is depends on the levels of the record
    assert fit.model.simulate(u)[after] == pytest.approx(hand.model.simulate(u)[after], abs=1e-3)
    assert fit.simulation_fit > 60  # from one gap to the next, each with a state of its own


def test_fits_of_detrended_records_with_missing_inputs_are_in_raw_units():
    u, y = signals()
    lost = u + 3.0
    lost[[150, 400]] = np.nan
    with pytest.warns(DataWarning, match="missing inputs"):
        fit = optid.fit(optid.Data(lost, y).detrend(), "hammerstein_oe.exact", **ORDERS, basis="polynomial:2")
    whole = optid.fit(optid.Data(u + 3.0, y), "hammerstein_oe.exact", **ORDERS, basis="polynomial:2")
    assert fit.model.a == pytest.approx(whole.model.a, abs=0.02)
    assert fit.model.static_gain(3.2) == pytest.approx(whole.model.static_gain(3.2), rel=0.05)


@pytest.mark.parametrize("name", ["oe.exact", "ss.exact"])
def test_nothing_useful_remains(name):
    u, y = signals(300)
    u[::3] = np.nan
    with pytest.raises(OptidError, match="no stretch" if name == "oe.exact" else "no window of .* is complete"):
        optid.fit(optid.Data(u, y), name, **({"nx": 2} if name == "ss.exact" else ORDERS))
