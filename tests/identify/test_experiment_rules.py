"""The rules of experiment design: numbers, limits and remedies, and that fit and design hold to the same ones."""

import numpy as np
import pytest
from problems import BASIS

import optid
from optid import plants, signals
from optid.errors import DataError, DataWarning
from optid.identify.design.rules import (
    check_condition,
    check_instruments,
    check_levels,
    check_lines,
    many_lines,
    remaining_shares,
)
from optid.identify.record_checks import examine, examine_figures

RNG = np.random.default_rng(0)
QUARTIC = optid.Polynomial(4).with_interval(-1, 1)
SINE = signals.sinusoid(3000, frequency=0.0237)


def hankel_rank(signals_, rows):
    """Numerical rank of the block Hankel matrix of (N, s), the rank the rule predicts."""
    windows = np.lib.stride_tricks.sliding_window_view(signals_, rows, axis=0).reshape(len(signals_) - rows + 1, -1)
    values = np.linalg.svd(np.column_stack([np.ones(len(windows)), windows]), compute_uv=False)
    return int(np.sum(values > 1e-9 * values[0]))


@pytest.mark.parametrize("p, frequencies", [(1, (0.0237,)), (2, (0.0237,)), (5, (0.0237,)), (1, (0.05, 0.131)),
                                            (3, (0.05, 0.131))])
def test_the_rank_of_the_expanded_regressor_is_what_the_lines_say(p, frequencies):
    u = sum(np.sin(2 * np.pi * f * np.arange(3000) + i) for i, f in enumerate(frequencies)) / len(frequencies)
    basis = optid.Polynomial(p).with_interval(-1, 1)
    check = check_lines("u", [u], basis, 40)
    assert check.number == hankel_rank(basis.values(u), 40) and check.severity == "error"
    if len(frequencies) == 1:
        assert check.number == 2 * p + 1 and "is a single sinusoid" in check.sentence
    else:
        assert "consists of a few sinusoids" in check.sentence


def test_few_lags_are_determined_by_a_sinusoid():
    """Nine regressors are excited: two lags of four functions are fine, three are not."""
    assert check_lines("u", [SINE], QUARTIC, 2).severity == "fine"
    check = check_lines("u", [SINE], QUARTIC, 3)
    assert (check.severity, check.number) == ("error", 9) and "12 are to be determined" in check.sentence


@pytest.mark.parametrize("noise, severity", [(1e-4, "error"), (0.005, "warning"), (0.5, "fine")])
def test_noise_hides_a_sinusoid_by_degrees(noise, severity):
    u = SINE + noise * RNG.standard_normal(SINE.size)
    assert check_lines("u", [u], optid.Polynomial(4).with_interval(u.min(), u.max()), 10).severity == severity


def test_quantisation_and_missing_samples_do_not_cure_it():
    u = np.round(40 * SINE) / 40
    u[1000:1010], u[2500] = np.nan, np.nan
    assert check_lines("u", [u], QUARTIC, 10).severity in ("error", "warning")


def test_experiments_at_other_frequencies_add_lines():
    runs = [signals.sinusoid(2000, frequency=f) for f in (0.021, 0.055, 0.083)]
    assert check_lines("u", runs[:1], QUARTIC, 5).severity == "error"
    assert check_lines("u", runs[:2], QUARTIC, 5).number == 17
    assert check_lines("u", runs, QUARTIC, 5).severity == "fine"


@pytest.mark.parametrize("kind", ["chirp", "noise", "levels"])
@pytest.mark.parametrize("n", [800, 4000])
def test_rich_inputs_are_fine(kind, n):
    u = plants.pendulum_input(kind, n)
    assert check_lines("u", [u], optid.Polynomial(4).with_interval(-8, 8), 10).severity == "fine"


def test_white_steps_and_multisines_are_fine_and_few_lines_are_not():
    for u in (RNG.uniform(-1, 1, 500), signals.steps(4000, levels=9), signals.prbs(500), signals.multisine(2000)):
        assert check_lines("u", [u], BASIS, 10).severity == "fine"
    few = signals.multisine(4000, lines=[3, 9], periods=4)
    assert check_lines("u", [few], QUARTIC, 30).severity == "error"


def test_pursuit_finds_the_lines_and_the_quick_test_never_contradicts_it():
    k = np.arange(1500)
    x = np.cos(0.3 * k) + 0.5 * np.sin(0.317 * k + 1) + 0.05 * np.cos(2.1 * k) + 3
    shares = remaining_shares(x[:, None], 10, 1e-6)
    assert shares.size == 4 and shares[-1] < 1e-6
    assert shares[2] == pytest.approx(0.05**2 / (1 + 0.25 + 0.05**2), rel=0.05)
    assert not many_lines(x, 3, 1e-2)
    assert many_lines(RNG.standard_normal(1500), 10, 1e-2)
    assert not many_lines(np.zeros(50), 1, 1e-2)
    assert remaining_shares(np.ones((50, 2)), 3, 1e-3).tolist() == [0.0]


def test_levels_against_the_basis():
    u = RNG.uniform(-1, 1, 500)
    assert check_levels("u", np.sign(u), BASIS).severity == "error"
    few = check_levels("u", np.round(2 * u), BASIS)
    assert (few.severity, few.number) == ("error", 5) and f"the basis has {BASIS.size}" in few.sentence
    assert check_levels("u", np.round(5 * u), BASIS).severity == "warning"
    assert check_levels("u", np.round(5 * u), BASIS, few=0).severity == "fine"
    assert check_levels("u", u, BASIS).severity == "fine"
    assert check_levels("u", np.sign(u), optid.Linear().with_interval(-1, 1)).severity == "fine"


def test_condition_numbers_have_a_limit():
    assert check_condition(1e6).severity == check_instruments(30).severity == "fine"
    assert check_condition(np.inf).severity == check_instruments(1e9).severity == "warning"
    assert "hammerstein_ss.asivid" in check_instruments(1e9).sentence and str(check_condition(1e9)).startswith("warn")


def test_fit_names_a_single_sinusoid():
    data = optid.Data(SINE, np.convolve(SINE + SINE**2, [0.5, 0.3])[:3000] + 0.01 * RNG.standard_normal(3000))
    with pytest.raises(DataError, match="'u' is a single sinusoid.*excite 9 regressors; 20 are to be determined"):
        optid.fit(data, na=1, nb=5, basis="polynomial:4")
    with pytest.warns(DataWarning, match="single sinusoid"):  # who sets a tolerance asks for a singular regressor
        examine(data, [QUARTIC], {"block_rows": None, "tolerance": 1e-6})
    with pytest.raises(DataError, match="'u' is a single sinusoid.*30 are to be determined.*10 lags of 3"):
        optid.fit(data, "hammerstein_ss.asivid", nx=2)  # block rows and basis by default
    assert examine(data, [QUARTIC], {"nb": [2]}) == [] == examine(data, [QUARTIC], {"nb": []})


def test_instruments_that_hardly_reach_are_told():
    assert examine_figures({"condition of R11": 1e5}) == []
    with pytest.warns(DataWarning, match="instruments hardly explain the regressors: cond.R11. = 1.0e\\+09"):
        assert len(examine_figures({"condition of R11": 1e9})) == 1


def test_a_fit_by_subspace_is_held_to_the_condition_of_its_instruments():
    """A chirp that is so slow that ten of its samples are too much alike."""
    u = signals.chirp(4000, f0=0.001, f1=0.07)
    data = plants.van_der_pol(2 * u, process=0.005, measurement=0.02)
    with pytest.warns(DataWarning, match="cond.R11."):
        fit = optid.fit(data, "hammerstein_ss.asivid", nx=2, basis="polynomial:3", feedback_basis="polynomial:3",
                        block_rows=10, noise="white", iterations=0, prove=False)
    assert any("cond(R11)" in sentence for sentence in fit.findings)
