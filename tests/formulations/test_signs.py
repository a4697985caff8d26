"""f rises where the output of the plant rises: the sign of (f, B) follows from the plant, not from one coefficient."""

import warnings

import numpy as np
import pytest

import optid
from optid.bases import Polynomial
from optid.errors import DataWarning
from optid.models import HammersteinSS, HammersteinTF, Nonlinearity
from optid.models.gauges import plant_sign


def polynomial_of(poles):
    return np.atleast_1d(np.real(np.poly(poles)))[1:]


def as_states(a, b):
    """The observer form of B/A of one input and output, B without direct feedthrough."""
    n = max(len(a), len(b))
    a, b = np.pad(a, (0, n - len(a))), np.pad(b, (0, n - len(b)))
    return HammersteinSS(np.column_stack([-a, np.eye(n, n - 1)]), b[:, None], np.eye(1, n))


@pytest.mark.parametrize("seed", range(10))
def test_the_sign_is_that_of_the_static_gain_of_a_stable_plant(seed):
    rng = np.random.default_rng(seed)
    a, b = polynomial_of(rng.uniform(-0.95, 0.99, 3)), rng.normal(size=4)
    gain = b.sum() / (1 + a.sum())
    assert plant_sign(a, b) == np.sign(gain)
    states = as_states(a, b)
    assert states.gain_signs == np.sign(gain)
    assert states.transform(rng.normal(size=(4, 4))).gain_signs == np.sign(gain)
    assert states.inject_output(rng.normal(size=(4, 1))).gain_signs == np.sign(gain)
    matrices = np.array([np.diag(rng.uniform(-0.9, 0.9, 2)) + [[0, 0.3], [0, 0]]])
    several = rng.normal(size=(3, 2))
    gains = np.linalg.solve(np.eye(2) + matrices[0], several.sum(axis=0))
    assert plant_sign(matrices, several) == np.sign(gains[np.argmax(np.abs(gains))])


@pytest.mark.parametrize("pole", [1 - 1e-3, 1 - 1e-14, 1.0, 1 + 1e-14, 1 + 1e-3])
@pytest.mark.parametrize("second", [0.0, 0.9, -0.5])
def test_the_sign_does_not_turn_as_a_pole_passes_one(pole, second):
    a, b = polynomial_of([pole, second]), np.array([-0.1, 0.4])
    assert plant_sign(a, b) == as_states(a, b).gain_signs == 1
    assert plant_sign(a, -b) == as_states(a, -b).gain_signs == -1
    several = np.array([np.diag([-pole, -second]), np.zeros((2, 2))])  # the output that integrates is the larger one
    assert plant_sign(several, np.array([[0.4, -0.1]])) == 1 and plant_sign(several, np.array([[-0.4, 0.1]])) == -1


def test_without_a_static_gain_the_largest_coefficient_decides():
    assert plant_sign(np.array([-0.5]), np.array([0.5, -1.0, 0.5])) == -1
    assert plant_sign(np.array([-0.5]), np.zeros(2)) == 1
    assert HammersteinSS([[0.5]], [[1.0]], [[1.0]], [[-2.0]]).gain_signs == -1


def test_turning_f_and_b_leaves_the_predictions_as_they_are():
    rng = np.random.default_rng(0)
    f = Nonlinearity(Polynomial(3).with_interval(-1, 1), rng.normal(size=3))
    u, y = rng.uniform(-1, 1, (50, 1)), rng.normal(size=(50, 1))
    data = optid.Data(u, y, 1.0)
    for model in (HammersteinTF([-0.5], [[-1.0, 0.2]], (f,), (0,), 0.3),
                  HammersteinSS([[0.5]], [[1.0]], [[1.0]], [[-2.0]], (f,))):
        turned = model.with_signs(model.gain_signs)
        assert model.gain_signs == -1 and turned.gain_signs == 1
        assert turned.predict(data) == pytest.approx(model.predict(data), abs=1e-12, nan_ok=True)
        assert turned.nonlinearities[0].mu == pytest.approx(-f.mu)
        assert model.regauge("norm").gain_signs == 1


def rising_plant(seed, gain=1.0, n=600):
    """A plant whose output rises with its input, after a delay of two samples."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat(rng.uniform(0, 1, n // 5), 5), np.zeros(n)
    for k in range(2, n):
        y[k] = 0.9 * y[k - 1] + gain * 0.4 * np.tanh(2 * u[k - 2]) + 0.01 * rng.standard_normal()
    return optid.Data(u, y, 1.0)


TRANSFER = {"na": 1, "nb": 3}
FITS = [("hammerstein_arx.exact", TRANSFER, []), ("hammerstein_arx.exact", TRANSFER, ["dead_zone:0,.3"]),
        ("hammerstein_arx.exact", TRANSFER, ["monotone"]), ("hammerstein_arx.overparametrised", TRANSFER, []),
        ("hammerstein_oe.exact", TRANSFER, []), ("hammerstein_oe.exact", TRANSFER, ["dead_zone:0,.3"]),
        ("hammerstein_oe.exact", TRANSFER, ["monotone"]), ("hammerstein_bj.exact", {**TRANSFER, "nc": 1, "nd": 1}, []),
        ("hammerstein_oe.shooting", TRANSFER, []), ("hammerstein_ss.sid", {"nx": 2}, []),
        ("hammerstein_ss.sid", {"nx": 2}, ["monotone"]), ("hammerstein_ss.exact", {"nx": 2}, []),
        pytest.param("hammerstein_ss.exact", {"nx": 2}, ["dead_zone:0,.3"], marks=pytest.mark.slow)]


@pytest.mark.sampled(3)
@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize(("name", "orders", "words"), FITS, ids=lambda part: str(part) if part else "free")
def test_f_rises_where_the_plant_rises(name, orders, words, gain):
    for seed in range(2):
        constraints = [f"monotone:{'increasing' if gain > 0 else 'decreasing'}" if word == "monotone" else word
                       for word in words]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            model = optid.fit(rising_plant(seed, gain), name, basis="triangular:6", constraints=constraints,
                              **orders).model
            low, high = model.nonlinearities[0](np.array([0.1, 0.9]))
            step = np.ravel(model.step_response(200))[-1] * (high - low)
        assert np.sign(high - low) == np.sign(step) == gain
        assert model.gain_signs == 1
