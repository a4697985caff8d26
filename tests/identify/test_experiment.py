"""Designed excitations: their spectrum, levels and range, and that records taken with them keep the promise."""

import numpy as np
import pytest
from refusals import refuses
from scipy.signal import lfilter
from typer.testing import CliRunner

import optid
from optid import plants
from optid.bases import feedback_bases
from optid.cli.app import app
from optid.errors import DataError, DataWarning, LookupFailed, StructureError
from optid.identify.design import design, frequency_response
from optid.identify.design.excitation import expanded_condition
from optid.identify.design.rules import check_feedback
from optid.statistics.expansion import expand

QUARTIC = "polynomial:4"
B, A = [0.0, 0.3, 0.1], [1.0, -1.2, 0.5]


def linear_record(n=4000, noise=0.05, seed=0, m=1):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (n, m))
    y = sum((c + 1) * lfilter(np.roll(B, c), A, u[:, c]) for c in range(m))
    return optid.Data(u, y + noise * rng.standard_normal(n), dt=0.1)


def true_response(f, c=0):
    z = np.exp(-2j * np.pi * np.asarray(f) * 0.1)
    return (c + 1) * np.polyval(np.roll(B, c)[::-1], z) / np.polyval(A[::-1], z)


def condition_of(data, basis, feedback, rows):
    return expanded_condition(data, expand(data, basis, feedback), rows)


PENDULUM = plants.pendulum(plants.pendulum_input("chirp", 4000))


def test_response_of_a_linear_plant_is_found_with_its_coherence_and_disturbance():
    data = linear_record(40_000)
    found = frequency_response(data, segment=256)
    true = true_response(found.frequency)
    assert np.abs(found.response[:, 0, 0] - true).max() < 0.03 * np.abs(true).max()
    power = 0.05**2 * 2 * 0.1  # one-sided density of white noise
    assert np.median(found.disturbance) == pytest.approx(power, rel=0.1)
    signal = np.abs(true) ** 2 * (1 / 3) * 2 * 0.1
    np.testing.assert_allclose(found.coherence[:, 0], signal / (signal + power), atol=0.12)
    assert found.segments == 311 and found.frequency[-1] == 5.0


def test_response_of_two_inputs_experiments_and_gaps():
    parts = [linear_record(8000, seed=s, m=2) for s in (1, 2)]
    u, y = [p.u for p in parts], [p.y.copy() for p in parts]
    y[0][100] = np.nan
    found = frequency_response(optid.Data(u, y, dt=0.1), segment=200)
    assert found.segments == 79 + 77  # the gap costs two segments that overlap there
    for c in (0, 1):
        true = true_response(found.frequency, c)
        assert np.sqrt(np.mean(np.abs(found.response[:, 0, c] - true) ** 2)) < 0.03 * np.abs(true).max()
    f = np.array([0.5, 1.23])
    np.testing.assert_allclose(found.at(f)[:, 0, 1], true_response(f, 1), atol=0.1)


def test_response_knows_where_it_knows_nothing():
    found = frequency_response(PENDULUM)
    assert np.isnan(found.response[found.frequency > 12]).all() and not np.isnan(found.at(np.array([20.0]))).any()
    peak = found.frequency[np.nanargmax(np.abs(found.response[:, 0, 0]))]
    assert 2 * np.pi * peak == pytest.approx(8.81, rel=0.1)  # the pendulum resonates there


@pytest.mark.parametrize("make, error, words", [
    (lambda: frequency_response(PENDULUM, segment=4), StructureError, "segment must be an integer of at least 8"),
    (lambda: frequency_response(PENDULUM.window(0, 40)), DataError, "1 complete segments of 32 samples"),
    (lambda: frequency_response(optid.Data(np.column_stack([PENDULUM.u, PENDULUM.u]), PENDULUM.y)), DataError,
     "collinear"),
])
def test_records_that_show_no_response(make, error, words):
    refuses(error, words, make)


@pytest.mark.parametrize("kind", ["multisine", "chirp", "noise", "levels"])
def test_excitations_keep_range_length_band_and_channels(kind):
    like = linear_record(2000, m=2)
    band = None if kind == "levels" else (0.2, 2.0)
    found = design(like, kind, n=1500, band=band, amplitude=[(-2, 3), (0, 1)], seed=3)
    assert found.u.shape == (1500, 2) and not found.u.flags.writeable and found.inputs == like.inputs
    assert (found.u.min(axis=0) >= [-2 - 1e-9, -1e-9]).all() and (found.u.max(axis=0) <= [3 + 1e-9, 1 + 1e-9]).all()
    assert abs(np.corrcoef(found.u.T)[0, 1]) < 0.2
    if band:
        power = np.abs(np.fft.rfft(found.u - found.u.mean(axis=0), axis=0)) ** 2
        f = np.fft.rfftfreq(1500, 0.1)
        assert power[(f > 0.15) & (f < 2.2)].sum() > 0.95 * power.sum()
    again = design(like, kind, n=1500, band=band, amplitude=[(-2, 3), (0, 1)], seed=3)
    np.testing.assert_array_equal(found.u, again.u)


def test_multisine_has_the_lines_of_its_period_and_no_others():
    found = design(linear_record(2000), n=2000, periods=4, band=(0.5, 1.0), rows=2)
    power = np.abs(np.fft.rfft(found.u[:, 0])) ** 2
    lines = np.flatnonzero(power[1:] > 1e-12 * power.max()) + 1
    np.testing.assert_array_equal(lines, np.arange(100, 201, 4))  # 0.5 to 1 Hz in steps of 1 / 50 s
    np.testing.assert_allclose(power[lines], power[lines[0]], rtol=1e-9)
    np.testing.assert_allclose(found.u[:500], found.u[500:1000], atol=1e-12)


def test_shaping_levels_the_output():
    like = linear_record(20_000)
    plain, shaped = (design(like, n=4000, band=(0.1, 3.0), shaped=s, candidates=1) for s in (False, True))
    f = np.fft.rfftfreq(4000, 0.1)
    inside = (f > 0.15) & (f < 2.9)
    spread = []
    for found in (plain, shaped):
        y = np.abs(np.fft.rfft(found.u[:, 0]) * true_response(f))[inside]
        spread.append(np.std(np.log(y)))
    assert spread[1] < 0.4 * spread[0]


def test_a_shaped_chirp_moves_the_pendulum_more_evenly():
    spread = []
    for shaped in (False, True):
        found = design(PENDULUM, "chirp", shaped=shaped, band=(0.1, 3.0))
        speed = plants.pendulum(found.u).y[:1000, 1]
        envelope = [np.ptp(part) for part in np.array_split(speed[100:], 6)]
        spread.append(np.std(envelope) / np.mean(envelope))
    assert spread[1] < 0.6 * spread[0]


def test_levels_are_counted_and_those_asked_for_draw_no_warning():
    found = design(PENDULUM, levels=12)
    assert np.unique(found.u).size == 12 and "levels                     12" in str(found)
    assert np.ptp(np.diff(np.unique(found.u))) < 1e-12


def test_a_band_that_was_not_asked_for_grows_until_the_lags_differ():
    slow = plants.van_der_pol(np.random.default_rng(1).uniform(-2, 2, 6000), measurement=0.02)
    found = design(slow)
    assert found.condition < 1e4 and found.band[1] > 1.5
    with pytest.warns(DataWarning, match="poorly excited"):  # who asks for a band gets it, and is told
        assert design(slow, band=(0.0, 0.6)).band == (0.0, 0.6)


def test_the_best_of_several_realisations_is_kept():
    conditions = [design(PENDULUM, "levels", candidates=1, seed=s).condition for s in range(5)]
    assert design(PENDULUM, "levels", candidates=5).condition == min(conditions)


@pytest.mark.parametrize("kind", ["multisine", "noise", "levels"])
def test_without_feedback_functions_the_promise_is_kept_to_the_last_digit(kind):
    found = design(PENDULUM, kind, amplitude=(-6, 6), rows=8)
    for seed in range(3):
        taken = plants.pendulum(found.u, seed=seed)
        eta = optid.Polynomial(4).with_interval(found.u.min(), found.u.max()).values(taken.u[:, 0])
        windows = np.lib.stride_tricks.sliding_window_view(eta, 8, axis=0).reshape(len(eta) - 7, -1)
        centred = windows - windows.mean(axis=0)
        exact = np.linalg.cond(centred / np.linalg.norm(centred, axis=0), 2)
        assert exact / 4 < found.condition < 4 * exact  # the promise is an estimate in the 1-norm
        assert found.functions == 4


@pytest.mark.parametrize("kind, factor", [("multisine", 3), ("levels", 3), ("noise", 3)])
def test_with_feedback_functions_the_promise_is_kept_within_a_factor(kind, factor):
    """Monte Carlo: outputs are predicted linearly and the pendulum is not linear, so digits are not promised."""
    found = design(plants.pendulum(plants.pendulum_input("levels", 4000)), kind, feedback_basis=QUARTIC, seed=2)
    taken = []
    for seed in range(8):
        data = plants.pendulum(found.u, seed=seed)
        taken.append(condition_of(data, QUARTIC, QUARTIC, 10))
    assert np.median(taken) / factor < found.condition < factor * np.median(taken)
    y = plants.pendulum(found.u).y.std(axis=0)
    assert found.outputs[1] == pytest.approx(y[1], rel=0.25)
    assert y[0] / 1.6 < found.outputs[0] < 1.6 * y[0]  # a light resonance, broadened by the segments


def test_on_a_linear_plant_the_promise_is_close():
    like = linear_record(10_000)
    found = design(like, "noise", band=(0.0, 3.0), feedback_basis="polynomial:3", n=4000)
    rng, taken = np.random.default_rng(9), []
    for _ in range(20):
        y = lfilter(B, A, found.u[:, 0]) + 0.05 * rng.standard_normal(4000)
        taken.append(condition_of(optid.Data(found.u, y, dt=0.1), QUARTIC, "polynomial:3", 10))
    assert found.condition == pytest.approx(np.mean(taken), rel=0.25)
    assert found.outputs[0] == pytest.approx(y.std(), rel=0.05)


@pytest.mark.parametrize("share, severity", [(1e-4, "error"), (0.02, "warning"), (0.3, "fine")])
def test_a_feedback_that_is_nearly_linear_is_named(share, severity):
    check = check_feedback("angle", share)
    assert check.severity == severity and check.number == share and "'angle'" in check.sentence


def test_the_share_that_is_not_linear_is_that_of_the_record():
    small = plants.pendulum(plants.pendulum_input("levels", 2000), measurement=0, quantum=0)
    sine = optid.UserFunctions((np.sin,), ("sin",))
    with pytest.warns(optid.errors.DataWarning, match="nearly linear"):
        share = expand(small, QUARTIC, [sine, None]).feedback[0].share
    x = np.column_stack([np.ones(2000), small.y])
    g = np.sin(small.y[:, 0])
    rest = g - x @ np.linalg.lstsq(x, g, rcond=None)[0]
    assert share == pytest.approx(rest.std() / g.std(), rel=1e-6) and share < 0.05
    assert feedback_bases(small, "none") == [None, None]


def test_a_record_with_gaps_and_two_experiments_serves_as_well():
    parts = [linear_record(3000, seed=s) for s in (1, 2)]
    y = [p.y.copy() for p in parts]
    y[0][50:60], y[1][700] = np.nan, np.nan
    found = design(optid.Data([p.u for p in parts], y, dt=0.1), n=1000, feedback_basis="polynomial:3")
    whole = design(optid.Data([p.u for p in parts], [p.y for p in parts], dt=0.1), n=1000, band=found.band,
                   feedback_basis="polynomial:3")
    assert found.condition == pytest.approx(whole.condition, rel=0.3)
    assert found.outputs[0] == pytest.approx(whole.outputs[0], rel=0.1)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("call, error, words", [
    (lambda: design(optid.Data(np.ones(4000), PENDULUM.y)), DataError, "collinear or without power"),
    (lambda: design(PENDULUM, "prbs"), StructureError, "'prbs' is refused: two levels"),
    (lambda: design(PENDULUM, "sinusoid"), StructureError, "'sinusoid' is refused: .*2 p \\+ 1"),
    (lambda: design(PENDULUM, "multisin"), StructureError, "Did you mean 'multisine'"),
    (lambda: design(PENDULUM, "levels", shaped=True), StructureError, "shaping"),
    (lambda: design(PENDULUM, "levels", band=(0, 1)), StructureError, "set hold"),
    (lambda: design(PENDULUM, levels=1), StructureError, "levels must be"),
    (lambda: design(PENDULUM, levels=4), StructureError, "breaks a rule of design.*takes 4 levels"),
    (lambda: design(PENDULUM, levels=2), StructureError, "is binary"),
    (lambda: design(PENDULUM, n=4000, periods=200), StructureError, "breaks a rule of design.*spectral lines"),
    (lambda: design(PENDULUM, band=(3, 1)), StructureError, r"band = \(3, 1\)"),
    (lambda: design(PENDULUM, band=(0, 99)), StructureError, "half the sampling rate, 25"),
    (lambda: design(PENDULUM, amplitude=(1, 2, 3)), StructureError, "one such pair for each of the 1 inputs"),
    (lambda: design(PENDULUM, amplitude=(2, 1)), StructureError, "low must be below high"),
    (lambda: design(PENDULUM, candidates=0), StructureError, "candidates must be"),
    (lambda: design(PENDULUM, rows=2.5), StructureError, "rows must.*got 2.5"),
    (lambda: design(PENDULUM, n=0), StructureError, "n must be a positive integer; got 0"),
    (lambda: design(PENDULUM, n=8), DataError, "samples"),
    (lambda: design(PENDULUM, basis="polynom:4"), LookupFailed, "polynomial"),
    (lambda: design(PENDULUM, feedback_basis=[QUARTIC]), StructureError, "1 feedback bases for 2 outputs"),
    (lambda: design(optid.Data(PENDULUM.u, np.random.default_rng(0).normal(size=4000))), DataError, "shows no band"),
])
def test_what_cannot_be_designed(call, error, words):
    refuses(error, words, call)


def run(*words):
    return CliRunner().invoke(app, ["design", *map(str, words)])


def test_the_command_writes_what_the_function_designs(tmp_path):
    csv, out = tmp_path / "data.csv", tmp_path / "excitation.csv"
    np.savetxt(csv, np.column_stack([PENDULUM.time, PENDULUM.u, PENDULUM.y]), delimiter=",",
               header="time,command,angle,speed", comments="")
    result = run("--like", csv, "--inputs", "command", "--outputs", "angle", "speed", "--kind", "multisine",
                 "--levels", 12, "--amplitude", -6, 6, "--band", 0.1, 4, "-o", out)
    assert result.exit_code == 0, result.output
    for words in ("expected condition number", "levels                     12", "0.1 to 4", "-6 to 6", str(out)):
        assert words in result.output
    written = np.loadtxt(out, delimiter=",", skiprows=1)
    expected = design(PENDULUM, levels=12, amplitude=(-6, 6), band=(0.1, 4.0))
    np.testing.assert_allclose(written[:, 1], expected.u[:, 0], rtol=1e-12)
    assert out.read_text().startswith("time,command\n") and np.unique(written[:, 1]).size == 12


@pytest.mark.parametrize("words, said", [
    ([], "--like FILE"),
    (["--like", "a.csv", "--example", "pendulum"], "not both"),
    (["--example", "pendulum", "--kind", "prbs"], "refused"),
    (["--example", "pendulum", "--band", "1"], "give two numbers"),
    (["--example", "pendulum", "--amplitude", "1", "2", "3"], "give two numbers"),
    (["--example", "pendulum", "-o", "/nowhere/at/all.csv"], "no folder"),
    (["--like", "missing.csv"], "missing.csv"),
])
def test_the_command_refuses_in_one_message(words, said):
    result = run(*words)
    assert result.exit_code == 2 and said in result.output and "Traceback" not in result.output


def test_the_command_takes_an_example_and_feedback():
    result = run("--example", "pendulum", "--kind", "levels", "--feedback-basis", QUARTIC, "--samples", 2000)
    assert result.exit_code == 0 and "of 10 functions at 10 lags" in result.output
