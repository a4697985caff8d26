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
from optid.identify.validation import validate
from optid.identify.validation.gram_tests import FTest
from optid.identify.validation.structure import PRODUCTS, RANK, structure_test
from optid.identify.validation.structure_alternatives import alternatives, wider
from optid.identify.validation.structure_design import (
    Design,
    Family,
    convolved,
    delay_of,
    orthonormal_filters,
    poles_of,
)

benchmark = scripts.benchmark("structure")


def hammerstein(count=1500, seed=0, wiener=False, delay=0, noise=0.2):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2, 2, count)
    a, b = [1, -1.3, 0.6], np.r_[np.zeros(delay), 1.0, 0.5]
    y = np.tanh(lfilter(b, a, u)) if wiener else lfilter(b, a, np.tanh(2 * u))
    return Data(u, y + noise * y.std() * lfilter([1], [1, -0.8], rng.normal(size=count)))


def test_families_by_hand():
    data = Data(np.linspace(-1, 3, 401), np.zeros(401) + np.arange(401))
    family = Family.of(data, 0, 2, 3)
    assert family.size == 5 and np.allclose(family.nodes, [-1, 0, 1, 2, 3])
    values = family.values(np.array([0.5, 1.0, -7.0]))
    x = (0.5 - 1) / data.u.std()
    assert values[0] == pytest.approx([x, x**2 - 1, 0.5, 0.5, 0])
    assert values[1, 2:] == pytest.approx([0, 1, 0]) and values[2, 2:] == pytest.approx([0, 0, 0])
    three = Data(np.tile([0.0, 1.0, 2.0], 9), np.arange(27.0))
    assert Family.of(three, 0, 3, 5).size == 2
    refuses(RankError, "'u' is constant", Family.of, Data(np.ones(20), np.arange(20.0)), 0, 3, 5)


def test_filters_are_orthonormal_and_span_the_dynamics():
    poles = np.array([0.6 + 0.3j, 0.6 - 0.3j])
    filters = orthonormal_filters(poles, 2, 3, 300)
    assert filters.T @ filters == pytest.approx(np.eye(filters.shape[1]), abs=1e-12)
    assert not filters[:3].any()
    count = len(filters)
    near = np.real(np.poly(poles * 1.02))
    for numerator, a, tolerance in (([1.0], np.real(np.poly(poles)), 1e-3), ([0, 0, 1.0], [1.0], 1e-3),
                                    ([1.0, -2.0], near, 2e-2)):
        response = lfilter(np.r_[np.zeros(3), numerator], a, np.eye(1, count)[0])
        left = response - filters @ (filters.T @ response)
        assert np.linalg.norm(left) < tolerance * np.linalg.norm(response)
    assert orthonormal_filters(np.zeros(0, complex), 2, 0, 50) @ np.ones(3) == pytest.approx([1, 1, 1, 0])


def test_convolution_by_hand():
    rng = np.random.default_rng(0)
    values, filters = rng.normal(size=(30, 2)), rng.normal(size=(5, 3))
    found = convolved(values, filters)
    expected = [[[sum(filters[i, j] * values[t + 4 - i, p] for i in range(5)) for p in range(2)] for j in range(3)]
                for t in range(26)]
    assert found == pytest.approx(np.array(expected))


@pytest.mark.parametrize("delay", [0, 1, 7])
def test_delay_is_never_overestimated(delay):
    found = [delay_of(hammerstein(1500, seed, delay=delay)) for seed in range(20)]
    assert max(found) <= delay
    if delay > 1:
        assert np.median(found) == delay - 1


def test_poles_behind_a_nonlinearity_in_coloured_noise():
    poles = poles_of(hammerstein(6000, 1))
    truth = np.roots([1, -1.3, 0.6])
    assert all(np.abs(poles - pole).min() < 0.02 for pole in truth)


def test_f_tests_by_hand():
    from scipy.stats import f, ncf

    exact = FTest.of(6.0, 3, 20.0, 40, negligible=0.0)
    assert exact.p_value == pytest.approx(f.sf(6 / 3 / (20 / 40), 3, 40))
    assert exact.saving == pytest.approx(1 - (20 / 40) / (26 / 43))
    lenient = FTest.of(6.0, 3, 20.0, 40, negligible=0.02)
    assert lenient.p_value == pytest.approx(ncf.sf(6 / 3 / (20 / 40), 3, 40, 0.02 * 43))
    assert lenient.p_value > exact.p_value
    assert FTest.of(1.0, 0, 1.0, 10, 0.01) == FTest() and FTest.of(-1e-12, 2, 1.0, 10, 0.01).p_value == 1


def test_alternatives_by_hand():
    data = Data(np.random.default_rng(0).normal(size=500), np.random.default_rng(1).normal(size=500))
    design = replace(Design.of(data), poles=np.array([0.8 + 0j]), delay=1)
    reach = len(design.filters) - 1
    predicted = np.random.default_rng(2).normal(size=500 - reach)
    z = (predicted - predicted.mean()) / predicted.std()
    bent, time = 2 * np.tanh(z / 2), np.linspace(-1, 1, z.size + 1)[:-1]
    found = {words: group[0] for words, group in alternatives(design, [predicted]).items()}
    assert found["functions of the output"] == pytest.approx(np.column_stack([bent**2, bent**3, np.abs(bent)]))
    assert found["a gain that changes with time"][:, :2] == pytest.approx(np.column_stack([
        time * z, (1.5 * time**2 - 0.5) * z]))
    # fed back: square, cube and modulus, by what begins one sample later and decays with the pole 0.8
    fed = found["functions of the output that are fed back"].reshape(z.size, -1, 3)
    echo = lfilter([0, 1], [1, -0.8], bent**2)
    left = echo - fed[:, :, 0] @ np.linalg.lstsq(fed[:, :, 0], echo, rcond=None)[0]
    assert np.linalg.norm(left[2 * reach:]) < 2 * 0.8**reach * np.linalg.norm(echo[2 * reach:])
    words, behind = next((words, group) for words, group in found.items() if "behind poles" in words)
    assert words == "functions of 'u' behind poles at 0.8" and behind.shape == fed.reshape(z.size, -1).shape
    coefficients = np.arange(1.0, 1.0 + design.fine[0].size)
    slow, f = wider(design, [(design.fine[0], coefficients)])[0], design.fine[0].values(data.u[:, 0]) @ coefficients
    assert slow[:, 0] == pytest.approx(f[reach:]) and slow[:, 1] == pytest.approx(f[reach - 1 : -1])


def test_columns_do_not_depend_on_how_the_record_is_cut(monkeypatch):
    data = hammerstein(900)
    design = Design.of(data)
    whole = np.vstack([design.additive(u) for _, _, u, _, _ in design.stretches(0)])
    monkeypatch.setattr("optid.identify.validation.structure_design.CHUNK", 100)
    parts = np.vstack([design.additive(u) for _, _, u, _, _ in design.stretches(0)])
    assert parts == pytest.approx(whole, abs=1e-10) and len(whole) == 900 - len(design.filters) + 1
    several = structure_test(data)
    monkeypatch.undo()
    assert several.p_value == pytest.approx(structure_test(data).p_value, rel=1e-6)


@pytest.mark.slow
def test_the_level_holds_in_coloured_noise(monkeypatch):
    monkeypatch.setattr("optid.identify.validation.structure.NEGLIGIBLE", 0.0)
    found = [structure_test(hammerstein(800, seed)) for seed in range(60)]
    assert kstest([one.p_values["y"][PRODUCTS] for one in found], "uniform").pvalue > 1e-3
    assert all(one.passed for one in found)


@pytest.mark.slow
@pytest.mark.parametrize("n, power", [(400, 0.7), (2000, 0.95)])
def test_systems_of_every_kind_are_told_apart(n, power):
    rejected = {kind: sum(not structure_test(benchmark.record(kind, seed, n)).passed for seed in range(20))
                for kind in (*benchmark.HAMMERSTEIN, *benchmark.OTHERS)}
    assert sum(rejected[kind] for kind in benchmark.HAMMERSTEIN) <= 4
    assert all(rejected[kind] >= 20 * power - 2 for kind in benchmark.OTHERS), rejected


def test_a_second_path_is_found_by_rank():
    rng = np.random.default_rng(3)
    u = rng.uniform(-1, 1, 1500)
    w = np.tanh(3 * u)
    w[1:] += u[:-1] ** 2
    y = lfilter([1], [1, -0.5], w) + 0.1 * rng.normal(size=1500)
    found = structure_test(Data(u, y))
    assert not found.passed and found.p_values["y"][RANK] < 1e-6 < found.p_values["y"][PRODUCTS]
    assert "not consistent with a Hammerstein system: different nonlinearities at different lags" in found.finding
    wiener = structure_test(hammerstein(1500, wiener=True))
    assert not wiener.passed and wiener.p_values["y"][PRODUCTS] < 1e-6 and "not consistent" in wiener.finding


def test_records_without_noise():
    model = siso(Polynomial(3))
    u = inputs(model, 1200)
    assert structure_test(Data(u, model.simulate(u))).passed
    assert structure_test(Data(u, np.ones(1200) + 0 * u[:, 0])).p_value == 1


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("level", [0.0, 1e3, 1e6])
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


@pytest.mark.parametrize("short", [1, 4, 8, 30])
def test_experiments_shorter_than_the_responses_are_left_out(short):
    data = hammerstein(1500, 5)
    u, y = data.u, data.y
    whole, more = structure_test(data), structure_test(Data([u, u[:short]], [y, y[:short]]))
    assert more.passed and more.p_values["y"].keys() == whole.p_values["y"].keys()
    runs = [np.zeros_like(y), np.zeros_like(y[:short])]
    assert not structure_test(Data([u, u[:short]], [y, y[:short]]), runs).passed
    with pytest.raises(RankError, match="No experiment has 129 samples"):
        structure_test(Data(np.split(u[:1480], 40), np.split(y[:1480], 40)))


def test_several_inputs_and_outputs():
    model = mimo()
    u = inputs(model, 3000)
    rng = np.random.default_rng(1)
    clean = model.simulate(u)
    y = clean + 0.2 * clean.std(axis=0) * rng.normal(size=clean.shape)
    found = structure_test(Data(u, y))
    assert found.passed and set(found.p_values) == {"y1", "y2"} and set(found.ratios) == {"u1", "u2", "u3"}
    y[:, 1] += 0.5 * clean.std(axis=0)[1] * u[:, 0] * u[:, 1]
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
    with pytest.raises(RankError):
        structure_test(hammerstein(60))
    sine = np.sin(0.7 * np.arange(2000))
    with pytest.raises(RankError):
        structure_test(Data(sine, lfilter([1], [1, -0.5], sine) + 1e-3 * np.random.default_rng(0).normal(size=2000)))


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


def test_a_long_record_is_read_in_part(monkeypatch):
    data = hammerstein(4000, 7)
    monkeypatch.setattr("optid.identify.validation.structure.SAMPLES", 2000)
    assert structure_test(data) == structure_test(data.split(0.5)[0])
