"""The structure test: its columns by hand, its level and power on simulated systems, real records."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scripts
from refusals import refuses
from scipy.signal import lfilter
from scipy.stats import kstest
from systems import inputs, mimo, siso

import optid
from optid.bases import Polynomial
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.informativity import processes
from optid.identify.validation import validate
from optid.identify.validation.checks import record_structure
from optid.identify.validation.score_tests import FTest, Regression, orthonormal, score_test
from optid.identify.validation.structure import structure_test
from optid.identify.validation.structure_alternatives import PRODUCTS, RANK, alternatives
from optid.identify.validation.structure_design import Design, Family, filter_rational
from optid.identify.validation.structure_hypothesis import fit_hammerstein

benchmark = scripts.benchmark("structure")


def hammerstein(count=1500, seed=0, wiener=False, delay=0, noise=0.2):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2, 2, count)
    a, b = [1, -1.3, 0.6], np.r_[np.zeros(delay), 1.0, 0.5]
    y = np.tanh(lfilter(b, a, u)) if wiener else lfilter(b, a, np.tanh(2 * u))
    return Data(u, y + noise * y.std() * lfilter([1], [1, -0.8], rng.normal(size=count)))


def test_families_by_hand():
    data = Data(np.linspace(-1, 3, 401), np.zeros(401) + np.arange(401))
    family = Family.of(data, 0)  # 401 samples: one coarse hat, and eight intervals between the nodes
    assert family.size == 7 + 7 and np.allclose(family.nodes, np.linspace(-1, 3, 9))
    values, x = family.values(np.array([0.25, 1.0, -7.0])), (0.25 - 1) / data.u.std()
    assert values[0, :3] == pytest.approx([x, x**2 - 1, x**3 - 3 * x])
    assert values[:, 7:] == pytest.approx(np.array([[0, 0.5, 0.5, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0], np.zeros(7)]))
    whole = family.values(data.u[:, 0])
    coarse = whole @ family.coarse
    hat = 1 - np.abs(data.u[:, 0] - 1) / 2
    for function in (*whole[:, :3].T, hat):
        left = np.linalg.lstsq(np.column_stack([np.ones(401), coarse]), function)[1]
        assert coarse.shape[1] == 4 and left < 1e-18
    few = Family.of(Data(np.tile([0.0, 1.0, 2.0, 7.0], 9), np.arange(36.0)), 0)
    assert np.linalg.matrix_rank(np.column_stack([np.ones(4), few.values(np.array([0.0, 1.0, 2.0, 7.0]))])) == 4
    refuses(RankError, "'u' is constant", Family.of, Data(np.ones(20), np.arange(20.0)), 0)


@pytest.mark.parametrize("poles", [[0.6 + 0.3j, 0.6 - 0.3j], [0.9, 0.5], [0.7], []])
def test_filters_span_the_dynamics_from_the_delay_on(poles):
    poles = np.array(poles, dtype=complex)
    responses = filter_rational(np.eye(300, 1), poles, 3)[:, :, 0]
    assert not responses[:3].any() and responses.shape[1] == 8 + 2 * poles.size
    assert np.linalg.cond(responses) < 1e4
    for numerator, a, tolerance in (([1.0], np.real(np.poly(poles)), 1e-12), ([0, 0, 1.0], [1.0], 1e-12),
                                    ([1.0, -2.0], np.real(np.poly(poles * 1.02)), 1e-2)):
        response = lfilter(np.r_[np.zeros(3), numerator], a, np.eye(1, 300)[0])
        left = response - responses @ np.linalg.lstsq(responses, response)[0]
        assert np.linalg.norm(left) < tolerance * np.linalg.norm(response)


def test_f_tests_by_hand():
    from scipy.stats import f, ncf

    exact = FTest.of(6.0, 3, 20.0, 40, negligible=0.0)
    assert exact.p_value == pytest.approx(f.sf(6 / 3 / (20 / 40), 3, 40))
    assert exact.saving == pytest.approx(1 - (20 / 40) / (26 / 43))
    lenient = FTest.of(6.0, 3, 20.0, 40, negligible=0.02)
    assert lenient.p_value == pytest.approx(ncf.sf(6 / 3 / (20 / 40), 3, 40, 0.02 * 43))
    assert lenient.p_value > exact.p_value
    assert FTest.of(1.0, 0, 1.0, 10, 0.01) == FTest() and FTest.of(-1e-12, 2, 1.0, 10, 0.01).p_value == 1


def test_the_score_test_is_the_comparison_of_two_regressions():
    from scipy.stats import f

    rng = np.random.default_rng(0)
    level, own, other, y = np.ones((60, 1)), rng.normal(size=(60, 3)), rng.normal(size=(60, 2)), rng.normal(size=60)
    regression = Regression((np.arange(60) != 7,), (level,), np.array([1.0, -0.5]))
    white = [(x[1:] - 0.5 * x[:-1])[[k for k in range(59) if k not in (6, 7)]] for x in (level, own, other, y)]
    null = np.hstack(white[:2])
    sums = [float(np.linalg.lstsq(x, white[3])[1][0]) for x in (null, np.hstack([null, white[2]]))]
    tangent = orthonormal(regression.reduce([own]))
    found = score_test(regression.reduce([y]), tangent, regression.reduce([other]), regression.spare, 0.0)
    assert regression.spare == 56 and found is not None
    assert found.p_value == pytest.approx(f.sf((sums[0] - sums[1]) / 2 / (sums[1] / 51), 2, 51))
    assert score_test(regression.reduce([y]), tangent, regression.reduce([own @ np.ones((3, 1))]), 56, 0.0) is None


def test_alternatives_by_hand():
    data = Data([np.random.default_rng(k).normal(size=n) for k, n in enumerate((500, 300))],
                [np.random.default_rng(k).normal(size=n) for k, n in enumerate((500, 300))])
    (process,) = processes(hammerstein())
    design = replace(Design.of(data, 0, process), poles=(np.array([0.8 + 0j]),), lags=(1,))
    fitted = fit_hammerstein(Design.of(data, 0, process), process.noise)
    predicted = [np.random.default_rng(2).normal(size=n) for n in (500, 300)]
    hypothesis = replace(fitted, design=design, predicted=predicted)
    whole = np.concatenate(predicted)
    z = (predicted[0] - whole.mean()) / whole.std()
    bent, time = 2 * np.tanh(z / 2), np.linspace(-1, 1, 501)[:-1]
    found = {words: columns(hypothesis)[0] for words, columns in alternatives(hypothesis).items()}
    assert found["functions of the output"] == pytest.approx(np.column_stack([
        bent**2, bent**3, np.abs(bent), bent * np.abs(bent)]))
    drift = found["a gain that changes with time"]  # within experiments, and from one to the next
    assert drift[:, :2] == pytest.approx(np.column_stack([time * z, (1.5 * time**2 - 0.5) * z]))
    assert drift[:, 4:] == pytest.approx(np.column_stack([z, 0 * z]))
    # fed back: square, cube and modulus, by what begins one sample later and decays with the pole 0.8
    fed = found["functions of the output that are fed back"].reshape(500, -1, 4)
    echo = lfilter([0, 1], [1, -0.8], bent**2 - bent[0] ** 2)
    assert np.linalg.norm(echo - fed[:, :, 0] @ np.linalg.lstsq(fed[:, :, 0], echo)[0]) < 1e-10
    assert "functions of 'u' behind poles at 0.8" in found and list(found)[:2] == [PRODUCTS, RANK]


def records():
    """Two kinds of three experiments: one that is kept, and one that is rejected."""
    for wiener in (False, True):
        data = hammerstein(1200, 5, wiener)
        cuts = ((0, 500), (500, 800), (800, 1200))
        yield [data.u[a:b] for a, b in cuts], [data.y[a:b] for a, b in cuts]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("change", ["order", "units of u", "units of y", "constants"])
def test_p_values_do_not_depend_on(change):
    for u, y in records():
        first = structure_test(Data(u, y))
        other = {"order": ([u[2], u[0], u[1]], [y[2], y[0], y[1]]), "units of u": ([-2e3 * x for x in u], y),
                 "units of y": (u, [3e-4 * x for x in y]),
                 "constants": ([x + 35 for x in u], [x - 71.3 for x in y])}[change]
        second = structure_test(Data(*other))
        assert second.passed == first.passed and second.p_value == pytest.approx(first.p_value, rel=1e-4, abs=1e-12)
        assert second.p_values["y"] == pytest.approx(first.p_values["y"], rel=1e-4, abs=1e-12)


@pytest.mark.slow
def test_the_level_holds_in_coloured_noise(monkeypatch):
    monkeypatch.setattr("optid.identify.validation.structure.NEGLIGIBLE", 0.0)
    monkeypatch.setattr("optid.identify.validation.structure.ROWS", 0.0)
    found = [structure_test(hammerstein(800, seed)) for seed in range(60)]
    assert kstest([one.p_values["y"][PRODUCTS] for one in found], "uniform").pvalue > 1e-3
    assert all(one.passed for one in found)


@pytest.mark.slow
def test_systems_of_every_kind_are_told_apart():
    def rejects(kind, seed):
        try:
            return not structure_test(benchmark.record(kind, seed, 2000)).passed
        except RankError:  # the dynamics of several inputs were not found: not tested
            return False

    rejected = {kind: sum(rejects(kind, seed) for seed in range(6))
                for kind in (*benchmark.HAMMERSTEIN, *benchmark.OTHERS)}
    assert sum(rejected[kind] for kind in benchmark.HAMMERSTEIN) <= 1
    assert all(rejected[kind] >= 5 for kind in benchmark.OTHERS), rejected


def test_a_second_path_is_found_by_rank():
    rng = np.random.default_rng(3)
    u = rng.uniform(-1, 1, 1500)
    w = np.tanh(3 * u)
    w[1:] += u[:-1] ** 2
    y = lfilter([1], [1, -0.5], w) + 0.1 * rng.normal(size=1500)
    found = structure_test(Data(u, y))
    assert not found.passed and found.alternative == RANK and found.p_values["y"][RANK] < 1e-6
    assert "not consistent with a Hammerstein system: different nonlinearities at different lags" in found.finding
    wiener = structure_test(hammerstein(1500, wiener=True))
    assert not wiener.passed and wiener.p_values["y"][PRODUCTS] < 1e-6 and "not consistent" in wiener.finding


@pytest.mark.parametrize("seed", range(3))
def test_what_a_drifting_gain_leaves_is_no_noise(seed):
    """A level is held for longer than the plant takes, so that what the gain leaves is as slow as coloured noise."""
    u = optid.signals.uniform_levels(2000, hold=38, seed=seed)
    e = np.random.default_rng(seed).normal(size=2000)
    y = lfilter([0, 0.05], [1, -0.95], u)
    still, moving = (Data(u, y * course + 0.05 * y.std() * e) for course in (1.0, np.linspace(1.0, 1.6, 2000)))
    assert structure_test(still).passed
    found = structure_test(moving)
    assert not found.passed and found.alternative == "a gain that changes with time"
    (process,) = processes(moving)
    fitted = fit_hammerstein(Design.of(moving, 0, process), process.noise)
    columns = alternatives(fitted)[found.alternative](fitted)
    sizes = [np.sum(one.regression.noise**2) for one in (fitted, fitted.beside(columns))]  # 1 for white noise, as it is
    assert sizes[1] < sizes[0]
    for one in fitted.predicted, fitted.directions:  # what the hypothesis itself explains leaves its noise as it is
        same = fitted.beside([x.reshape(2000, -1) for x in one]).regression.noise
        assert same == pytest.approx(fitted.regression.noise, abs=0.02)


def test_records_without_noise():
    model = siso(Polynomial(3))
    u = inputs(model, 1200)
    assert structure_test(Data(u, model.simulate(u))).passed
    assert structure_test(Data(u, np.ones(1200) + 0 * u[:, 0])).p_value == 1


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed, level", [(0, 0.0), (1, 1e3), (2, 1e6)])
def test_the_last_digits_of_records_without_noise(seed, level):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2, 2, (600, 1500)[seed % 2])
    scale_u, scale_y = 10.0 ** rng.uniform(-6, 6), 10.0 ** rng.uniform(-9, 9)

    def found(y):
        return structure_test(Data(scale_u * u, scale_y * (y + level)))

    f = u + 0.3 * u**2 - 0.2 * u**3
    finite = lfilter([1, 0.5, 0.2], [1], f)
    assert found(finite).p_value == 1  # the residuals are rounding
    slow = lfilter([1, 0.5, 0.2], np.real(np.poly([0.9, 0.5 + 0.3j, 0.5 - 0.3j])), f)
    assert found(slow).passed  # the residuals are what the filters cut off, 1e-5 of the output
    second = found(finite + 1e-3 * np.r_[0, u[:-1] ** 2])
    assert not second.passed and second.p_values["y"][RANK] < 1e-20
    product = found(finite + 3e-2 * np.r_[0, u[1:] * u[:-1]])
    assert not product.passed and product.p_values["y"][PRODUCTS] < 1e-20


@pytest.mark.slow
def test_missing_samples_and_experiments():
    for wiener in (False, True):
        data = hammerstein(3000, 5, wiener)
        u, y = data.u.copy(), data.y.copy()
        rng = np.random.default_rng(0)
        u[rng.uniform(size=3000) < 0.003] = np.nan
        y[rng.uniform(size=3000) < 0.02] = np.nan
        assert structure_test(Data(u, y)).passed != wiener
        assert structure_test(Data([u[:1000], u[1000:1700], u[1700:]], [y[:1000], y[1000:1700], y[1700:]])).passed \
            != wiener


@pytest.mark.parametrize("short", [1, 8, 30])
def test_short_experiments_are_read_or_left_out(short):
    data = hammerstein(1500, 5)
    u, y, found = data.u, data.y, processes(data)
    whole, more = structure_test(data, found=found), structure_test(Data([u, u[:short]], [y, y[:short]]), found=found)
    assert more.passed and more.p_values["y"].keys() >= whole.p_values["y"].keys()
    runs = [np.zeros_like(y), np.zeros_like(y[:short])]
    assert not structure_test(Data([u, u[:short]], [y, y[:short]]), runs, found).passed


def test_a_record_of_short_experiments():
    for wiener in (False, True):
        data = hammerstein(1500, 5, wiener)
        found = processes(data)
        for samples, pieces in ((37, 40), (20, 74)):
            pieces = [np.split(x[: samples * pieces], pieces) for x in (data.u, data.y)]
            if samples > 24:
                assert structure_test(Data(*pieces), found=found).passed != wiener
            else:
                refuses(RankError, "no experiment has 24 samples", structure_test, Data(*pieces), found=found)


@pytest.mark.slow
def test_several_inputs_and_outputs():
    model = mimo()
    u = inputs(model, 3000)
    rng = np.random.default_rng(1)
    clean = model.simulate(u)
    y = clean + 0.2 * clean.std(axis=0) * rng.normal(size=clean.shape)
    found = structure_test(Data(u, y))
    assert found.passed and set(found.p_values) == {"y1", "y2"} and set(found.ratios) == {"u1", "u2", "u3"}
    y[2:, 1] += 0.5 * clean.std(axis=0)[1] * u[1:-1, 0] * u[:-2, 1]
    found = structure_test(Data(u, y))
    assert not found.passed and found.p_values["y2"][PRODUCTS] < 1e-10 < found.p_values["y1"][PRODUCTS]


def test_a_binary_input_still_shows_products():
    rng = np.random.default_rng(0)
    u = rng.choice([-1.0, 1.0], 1000)
    y = lfilter([1, 0.5], [1, -0.7], u)
    noise = 0.1 * rng.normal(size=1000)
    assert structure_test(Data(u, y + noise)).passed
    assert not structure_test(Data(u, y + 0.5 * y**2 + noise)).passed


def test_refusals():
    refuses(RankError, "constant", structure_test, Data(np.ones(500), np.arange(500.0)))
    rng, k = np.random.default_rng(0), np.arange(300)
    for u, reason in ((np.where(k < 30, 0.0, 1.0), "'u' moves once"),
                      (np.where((k > 30) & (k < 150), 5.0, 0.0), "'u' moves 2 times")):
        y = 71.3 + lfilter([0, 0, 0.1], [1, -0.9], u) + 0.02 * rng.normal(size=300)
        refuses(RankError, reason, structure_test, Data(u, y))
    refuses(RankError, "no alternative can be distinguished", lambda: structure_test(hammerstein(26)))


@pytest.mark.slow
@pytest.mark.skipif("OPTID_DATA" not in os.environ, reason="OPTID_DATA names no folder with the real records")
def test_real_records():
    folder = Path(os.environ["OPTID_DATA"])
    wiener = structure_test(optid.read(folder / "nlid_mod1.csv", inputs=["u"], outputs=["y"], dt=0.001))
    assert not wiener.passed and wiener.p_value < 1e-9
    reflex = structure_test(optid.read(folder / "nlid_reflex.csv", inputs=["u"], outputs=["y"], dt=0.005))
    assert reflex.passed == (reflex.p_value >= 5e-3)


def test_validation_uses_it():
    model = siso(Polynomial(3))
    u = inputs(model, 1200)
    y = model.simulate(u)
    y = y + 0.1 * y.std() * np.random.default_rng(0).normal(size=y.shape)
    assert validate(model, Data(u, y, dt=0.1)).structure == structure_test(Data(u, y, dt=0.1))


@pytest.mark.parametrize("gain, moved, outcome", [(0.8, True, "not tested: feedback"), (0.0, True, "tested"),
                                                  (0.8, False, "not tested: feedback")])
def test_a_closed_loop_is_not_tested(gain, moved, outcome):
    rng = np.random.default_rng(0)
    setpoint, moves = moved * np.repeat(rng.uniform(-1, 1, 40), 20), np.repeat(rng.uniform(-1, 1, 40), 20)
    e, y, u = 0.1 * rng.normal(size=800), np.zeros(800), np.zeros(800)
    e, total = lfilter([1.0], [1.0, -0.9], e), 0.0
    for k in range(800):
        y[k] = e[k] + sum(0.15 * 0.9**i * u[k - 2 - i] for i in range(min(k - 1, 60)))
        total += 0.05 * (setpoint[k] - y[k])
        u[k] = gain * (setpoint[k] - y[k]) + total if gain else moves[k]
    notes = []
    found = record_structure(siso(Polynomial(3)), Data(u, y, dt=0.1), notes)
    assert (found is not None and found.passed) if outcome == "tested" else found is None
    assert any(outcome in note for note in notes) or outcome == "tested"


def test_nothing_is_concluded_from_numbers_that_are_not_finite():
    data = hammerstein(400)
    with pytest.raises(RankError, match="not available"):
        structure_test(data, [np.where(np.arange(400) < 300, 0 * data.y[:, 0], np.nan)[:, None]])


def test_a_long_record_is_read_in_part(monkeypatch):
    data = hammerstein(4000, 7)
    monkeypatch.setattr("optid.identify.validation.structure.SAMPLES", 2000)
    assert structure_test(data) == structure_test(data.split(0.5)[0])
