"""The examination of a record before it is fitted."""

import numpy as np
import pytest
from problems import BASIS, record
from refusals import refuses

import optid
from optid.errors import DataError, DataWarning
from optid.identify.record_checks import examine, examine_figures

RNG = np.random.default_rng(0)
U, Y = RNG.uniform(-1, 1, 400), RNG.normal(size=400)


def examined(u=U, y=Y, basis=BASIS):
    return examine(optid.Data(u=u, y=y), [basis])


def test_a_sound_record_draws_no_remark():
    assert examined() == []


@pytest.mark.parametrize("u, words", [
    (np.full(400, 2.0), r"'u' is constant \(2\).*drop the channel"),
    (np.sign(U), "'u' is binary.*two levels.*'arx'"),
    (np.round(2 * U), "5 levels.*at most 4 functions.*basis has 6"),
])
def test_inputs_that_cannot_identify_the_basis_are_errors(u, words):
    refuses(DataError, words, examined, u=u)
    with pytest.raises(DataError, match=words.split(".*")[0]):  # and fit examines first
        optid.fit(optid.Data(u=u, y=Y), na=1, nb=1, basis=BASIS)


def test_levels_are_counted_without_the_missing_and_beyond_the_first_samples():
    u = np.sign(np.random.default_rng(1).normal(size=9000))
    u[8000:] = np.random.default_rng(2).uniform(-1, 1, 1000)
    assert examined(u=u, y=np.random.default_rng(3).normal(size=9000)) == []
    u = np.sign(U)
    u[5] = np.nan
    refuses(DataError, "binary", examined, u=u)


def test_a_binary_input_is_enough_for_a_linear_model():
    rng = np.random.default_rng(3)
    fit = optid.fit(optid.Data(u=np.sign(U), y=Y + rng.normal(size=400)), "arx", na=1, nb=1)
    assert fit.findings == ()


def test_few_levels_are_a_warning_with_the_number():
    with pytest.warns(DataWarning, match="too few levels: input 'u' takes 9 distinct values for 6"):
        found = examined(u=np.round(4 * U) / 4)
    assert len(found) == 1


def test_samples_outside_the_interval_are_counted():
    with pytest.warns(DataWarning, match=r"% of input 'u' lies outside the interval \[-0.5, 0.5\].*'clamp'"):
        found = examined(basis=BASIS.__class__(6).with_interval(-0.5, 0.5))
    share = float(found[0].split(" %")[0])
    assert share == pytest.approx(100 * np.mean(np.abs(U) > 0.5), rel=0.1)


def test_outliers_are_counted_and_heavy_tails_are_not():
    y = Y.copy()
    y[[7, 70]] = 100
    with pytest.warns(DataWarning, match=r"2 outliers in output 'y' \(samples 7, 70\): .*NaN"):
        examined(y=y)
    u = U.copy()
    u[9] = 50
    with pytest.warns(DataWarning, match=r"1 outlier in input 'u' \(sample 9\): check the record"):
        examined(u=u, basis=BASIS.__class__(6).with_interval(-1, 60))
    assert examined(y=np.random.default_rng(4).standard_t(1.5, 400) ** 3) == []


@pytest.mark.parametrize("y, words", [
    (1e9 + Y, "leaves 6.* decimal digits"),
    (1e-6 * (3e9 - Y), "leaves 6.* decimal digits"),
])
def test_levels_that_cost_digits(y, words):
    with pytest.warns(DataWarning, match=words):
        examined(y=y)


def test_units_cost_nothing():
    assert examined(y=1e-12 * Y) == examined(y=1e12 * Y) == examined(y=1e6 + Y) == []


def test_a_constant_output_is_an_error():
    refuses(DataError, r"'y' is constant \(3\)", lambda: examined(y=np.full(400, 3.0)))


def test_every_channel_is_examined_by_name():
    data = optid.Data(u=np.column_stack([U, np.sign(U)]), y=Y, inputs=["valve", "switch"])
    refuses(DataError, "'switch' is binary", examine, data, [BASIS, BASIS])


def test_conditioning_and_missing_rows():
    figures = {"rows": 100, "candidates": 100, "condition": 10.0}
    assert examine_figures(figures) == []
    with pytest.warns(DataWarning, match="condition number 1.0e"):
        assert len(examine_figures(figures | {"condition": 1e9})) == 1
    assert examine_figures(figures | {"rows": 40}) == ["only 40 % of the rows are free of missing samples"]


def test_findings_belong_to_the_fit():
    data = record(count=300)
    y = data.y.copy()
    y[100] = 80
    with pytest.warns(DataWarning, match=r"1 outlier in .*sample 100\)"):
        fit = optid.fit(optid.Data(u=data.u, y=y), na=1, nb=1, basis=BASIS)
    assert len(fit.findings) == 1 and "huber" in fit.findings[0]
