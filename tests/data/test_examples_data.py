import numpy as np
import pytest
from refusals import refuses

from optid.data.record import Data
from optid.errors import LookupFailed
from optid.examples import EXAMPLES, dead_zone, example, thruster
from optid.identify.fitting import fit

ARX = [name for name, make in EXAMPLES.items() if "a" in make(n=100).truth]


@pytest.mark.parametrize("name", ARX)
def test_truth_leaves_white_residuals_of_the_stated_size(name):
    ex = EXAMPLES[name](seed=3, n=4000)
    data, truth = ex.data, ex.truth
    assert isinstance(data, Data) and data.name == name and data.n_samples == 4000
    assert len(truth["b"]) == len(truth["f"]) == data.m
    # The difference equation A y = B f(u) + e, written out sample by sample.
    e = np.empty(3990)
    w = [f(data.u[:, c]) for c, f in enumerate(truth["f"])]
    for k in range(10, 4000):
        past = sum(a * data.y[k - 1 - i, 0] for i, a in enumerate(truth["a"]))
        drive = sum(bj * wc[k - j] for wc, b in zip(w, truth["b"]) for j, bj in enumerate(b))
        e[k - 10] = data.y[k, 0] + past - drive
    assert e.std() == pytest.approx(truth["sigma"], rel=0.05)
    r = np.array([e[lag:] @ e[: e.size - lag] for lag in range(1, 11)]) / (e @ e)
    assert np.abs(r).max() < 4 / np.sqrt(e.size)


@pytest.mark.parametrize("name", EXAMPLES)
def test_records_depend_on_the_seed_alone(name):
    np.testing.assert_array_equal(EXAMPLES[name](seed=1).data.y, EXAMPLES[name](seed=1).data.y)
    assert not np.array_equal(EXAMPLES[name](seed=1).data.y, EXAMPLES[name](seed=2).data.y)


@pytest.mark.parametrize("name", EXAMPLES)
def test_suggestions_have_the_orders_of_the_truth(name):
    ex = EXAMPLES[name]()
    if name == "broken_thruster":
        assert ex.suggestion == thruster().suggestion
    elif name in ARX:
        assert set(ex.suggestion) == {"na", "nb", "nk", "basis", "constraints"}
        assert (ex.suggestion["na"], ex.suggestion["nb"]) == (ex.truth["a"].size, ex.truth["b"][0].size)
    elif name == "heater":
        assert set(ex.suggestion) == {"formulation_name", "na", "nb", "nk", "basis", "constraints"}
        assert ex.suggestion["na"] == ex.truth["n"]
    else:
        more = "equations" if name == "two_tanks" else "feedback_basis"
        assert set(ex.suggestion) == {"na", "nb", "nk", "basis", "nx", more}
        assert ex.suggestion["nx"] == ex.truth["n"]


def test_half_of_the_thrust_is_lost_in_the_broken_rig():
    ex = EXAMPLES["broken_thruster"](n=800)
    f, onset, clean = ex.truth["f"][0], ex.truth["onset"], ex.truth["noise_free"][:, 0]
    drive = 0.2 * f(ex.data.u[:, 0])  # b_0 of the rig
    part = np.r_[0.0, 0.0, clean[2:] - 1.2 * clean[1:-1] + 0.4 * clean[:-2]]
    np.testing.assert_allclose(part[2:onset], drive[2:onset], atol=1e-12)
    np.testing.assert_allclose(part[onset:], (1 - ex.truth["lost"]) * drive[onset:], atol=1e-12)


def test_dead_zone_has_the_noise_of_the_source():
    energies = []
    for seed in range(40):
        ex = dead_zone(seed=seed, n=2000)
        clean = ex.truth["noise_free"]
        energies.append([np.sum(clean**2), np.sum((ex.data.y - clean) ** 2)])
    signal, noise = np.mean(energies, axis=0)
    assert signal / noise == pytest.approx(22, rel=0.03)
    f = ex.truth["f"][0]
    np.testing.assert_array_equal(f(np.array([-1.0, -0.25, 0.1, 0.25, 0.5])), [-0.75, 0.0, 0.0, 0.0, 0.25])
    assert np.abs(ex.data.u).max() <= 1 and ex.data.n_samples == 2000 and ex.data.dt == 0.1


def test_thruster_is_the_rig_described():
    ex = thruster()
    data = ex.data
    assert (data.inputs, data.input_units) == (("current",), ("A",))
    assert (data.outputs, data.output_units) == (("thrust",), ("N",))
    assert (data.n_samples, data.dt) == (600, 0.1) and data.channels[0].levels > 100
    assert data.u.min() < -1.3 and data.u.max() > 1.3 and np.abs(data.u).max() <= 1.5
    # Every cell of the suggested basis is visited.
    assert np.histogram(data.u, bins=10)[0].min() >= 10
    f = ex.truth["f"][0]
    np.testing.assert_allclose(f(np.array([-1.0, -0.05, 0.0, 0.09, 0.5, 1.5])), [-0.7, 0, 0, 0, 0.25, 2.25])
    assert ex.truth["b"][0][0] / (1 + ex.truth["a"].sum()) == pytest.approx(1.0)
    ratios = [np.sum(t.truth["noise_free"] ** 2) / np.sum((t.data.y - t.truth["noise_free"]) ** 2)
              for t in (thruster(seed=s) for s in range(30))]
    assert np.median(ratios) == pytest.approx(30, rel=0.15)


def test_heater_is_the_plant_described():
    ex = EXAMPLES["heater"](seed=2, n=6000)
    u, y, clean = ex.data.u[:, 0], ex.data.y[:, 0], ex.truth["noise_free"][:, 0]
    assert (ex.data.input_units, ex.data.output_units) == (("%",), ("degC",))
    assert (ex.data.dt, str(ex.data.time[12])) == (5.0, "2024-03-01T08:01:00.000000000")
    # The differential equation 120 s dx/dt = 0.6 min(u, 70) - x, 20 s late, in steps of 0.05 s.
    x, expected = 0.0, []
    for level in np.r_[np.zeros(4), u][:600]:
        expected.append(20 + x)
        for _ in range(100):
            x += 0.05 / 120 * (0.6 * min(level, 70) - x)
    np.testing.assert_allclose(clean[:600], expected, atol=0.01)
    np.testing.assert_array_equal(u, np.round(u))
    assert u[0] == 0 and u.max() == 100 and np.std(y - clean) == pytest.approx(0.3, rel=0.03)
    np.testing.assert_array_equal(y, np.round(y, 2))


@pytest.mark.parametrize("seed", range(3))
def test_heater_as_suggested_is_a_good_model_whose_intervals_cover_the_truth(seed):
    ex = EXAMPLES["heater"](seed=seed)
    found = fit(ex.data, **ex.suggestion)
    pole = found.params["a1"]
    assert found.verdict.word == "good" and not found.verdict.failed
    assert -np.exp(-5 / 120) == pytest.approx(pole.estimate, abs=3 * pole.error)


def test_unknown_example_names_the_nearest():
    assert example("thruster", seed=0, n=50).data.n_samples == 50
    refuses(LookupFailed, "Did you mean 'thruster'", example, "truster")
