"""Responses of processes against closed forms and matrix exponentials; their derivatives against differences."""

import numpy as np
import pytest
from refusals import refuses
from scipy.linalg import expm

from optid.errors import StructureError
from optid.models.process_dynamics import TYPES, ProcessDynamics, ProcessStructure
from optid.models.process_kernel import thin_out

VALUES = {"tau": 12.0, "tau1": 12.0, "tau2": 5.0, "tau3": 2.0, "T": 7.0, "zeta": 0.4, "tau_zero": -3.0,
          "dead_time": 4.37}
REGULAR = np.arange(200.0)
IRREGULAR = np.sort(np.random.default_rng(0).uniform(0, 200, 150))
STEP = np.array([0.0, 10.0]), np.array([[0.0], [1.0]])


def dynamics(word: str, **values: float) -> ProcessDynamics:
    structure = ProcessStructure.read(word)
    return ProcessDynamics(structure, np.array([{**VALUES, **values}[name] for name in structure.names]))


def after(t: np.ndarray, theta: float) -> np.ndarray:
    return np.maximum(t - 10 - theta, 0)


@pytest.mark.parametrize("t", [REGULAR, IRREGULAR], ids=["regular", "irregular"])
@pytest.mark.parametrize("theta", [0.0, 4.37, 12.0, 33.3333])
@pytest.mark.parametrize("tau", [0.05, 3.0, 30.0, 4000.0])
def test_first_order_step(t, theta, tau):
    found = dynamics("P1D", tau=tau, dead_time=theta).response(t, *STEP)[:, 0, 0]
    np.testing.assert_allclose(found, -np.expm1(-after(t, theta) / tau), atol=1e-12, rtol=0)


@pytest.mark.parametrize("t", [REGULAR, IRREGULAR], ids=["regular", "irregular"])
@pytest.mark.parametrize("other", [30.0, 30 * (1 + 1e-9), 30 * (1 + 1e-4), 5.0])
def test_two_poles_equal_ones_included(t, other):
    found = dynamics("P2D", tau1=30.0, tau2=other, dead_time=12.4).response(t, *STEP)[:, 0, 0]
    x = after(t, 12.4)
    if abs(other / 30 - 1) < 1e-6:  # the limit, with its first correction by the difference of the poles
        exact = 1 - (1 + x / 30) * np.exp(-x / 30) - (other / 30 - 1) * (x / 30) ** 2 / 2 * np.exp(-x / 30)
    else:
        exact = 1 - (30 * np.exp(-x / 30) - other * np.exp(-x / other)) / (30 - other)
    cancels = 1e-6 < abs(other / 30 - 1) < 1e-2  # digits that the closed form itself loses
    np.testing.assert_allclose(found, exact, atol=1e-11 if cancels else 1e-12, rtol=0)


def oscillation(x: np.ndarray, zeta: float, period: float) -> np.ndarray:
    """Motion of a pair of poles from one, without speed."""
    root = np.sqrt(1 - zeta**2)
    return np.exp(-zeta / period * x) * (np.cos(root / period * x) + zeta / root * np.sin(root / period * x))


@pytest.mark.parametrize(("word", "values", "exact"), [
    ("P3D", {"tau1": 8.0, "tau2": 8.0, "tau3": 8.0}, lambda x: 1 - (1 + x / 8 + (x / 8) ** 2 / 2) * np.exp(-x / 8)),
    ("P2DU", {"T": 8.0, "zeta": 1.0}, lambda x: 1 - (1 + x / 8) * np.exp(-x / 8)),
    ("P2DU", {}, lambda x: 1 - oscillation(x, 0.4, 7)), ("P1DI", {}, lambda x: x - 12 * -np.expm1(-x / 12)),
    ("P1DZ", {}, lambda x: np.where(x > 0, 1 - (1 + 3 / 12) * np.exp(-x / 12), 0))])
def test_steps_against_closed_forms(word, values, exact):
    found, expected = dynamics(word, **values).response(IRREGULAR, *STEP)[:, 0, 0], exact(after(IRREGULAR, 4.37))
    np.testing.assert_allclose(found, expected, atol=1e-12 * (200 if word == "P1DI" else 1), rtol=0)


def test_a_ramp_is_exact():
    x = after(IRREGULAR, 4.37)
    ramp = dynamics("P1D").response(IRREGULAR, np.array([0.0, 10.0, 300.0]), np.array([[0.0], [0.0], [290.0]]),
                                    straight=True)[:, 0, 0]
    np.testing.assert_allclose(ramp, x - 12 * -np.expm1(-x / 12), atol=1e-11, rtol=0)


@pytest.mark.parametrize("word", TYPES)
@pytest.mark.parametrize("straight", [False, True], ids=["held", "straight"])
def test_every_type_against_matrix_exponentials(word, straight):
    """A second route: the controller form of the transfer function, run by scipy's expm from event to event."""
    one, rng = dynamics(word), np.random.default_rng(3)
    changes, values = np.cumsum(rng.uniform(0.5, 9, 12)), rng.normal(size=12)
    values[0] = 0.0
    found = one.response(IRREGULAR, changes, values[:, None], straight=straight)[:, 0, 0]
    np.testing.assert_allclose(found, by_exponentials(one, IRREGULAR, changes, values, straight),
                               atol=2e-12 * max(1.0, float(np.abs(found).max())), rtol=0)


def by_exponentials(one, t, changes, values, straight, unit=7.0):
    """In a unit of time about that of the process, in which its controller form has entries of one size."""
    size = unit if one.structure.integrator else 1.0
    one, t, changes, values = one.in_unit(unit), t / unit, changes / unit, size * values
    above, below = np.array([1.0]), np.array([1.0])
    for tau in one.p[: one.structure.real]:
        below = np.polymul(below, [tau, 1.0])
    if one.structure.pair:
        below = np.polymul(below, [one.value("T") ** 2, 2 * one.value("zeta") * one.value("T"), 1.0])
    if one.structure.zero:
        above = np.array([one.value("tau_zero"), 1.0])
    if one.structure.integrator:
        below = np.polymul(below, [1.0, 0.0])
    n = len(below) - 1
    above, below = np.concatenate([np.zeros(n + 1 - len(above)), above]) / below[0], below / below[0]
    a = np.vstack([-below[1:], np.eye(n - 1, n)])
    c, d = above[1:] - above[0] * below[1:], above[0]
    f = np.zeros((n + 2, n + 2))  # [states; input; slope]
    f[:n, :n], f[0, n], f[n, n + 1] = a, 1.0, 1.0
    found = []
    for instant in t - one.dead_time:
        x, u = np.zeros(n + 2), 0.0
        for j in range(len(changes)):
            if changes[j] > instant:
                break
            last = j + 1 == len(changes)
            to = instant if last else min(changes[j + 1], instant)
            x[n] = values[j]
            x[n + 1] = 0.0 if last or not straight else (values[j + 1] - values[j]) / (changes[j + 1] - changes[j])
            x = expm(f * (to - changes[j])) @ x
            u = x[n]
        found.append(c @ x[:n] + d * u)
    return np.array(found)


@pytest.mark.parametrize("word", TYPES)
@pytest.mark.parametrize("straight", [False, True], ids=["held", "straight"])
def test_derivatives(word, straight):
    one, rng = dynamics(word), np.random.default_rng(1)
    u = np.repeat(rng.normal(size=20), 10)[:, None]
    u = u - u[0]
    found = one.response(IRREGULAR, REGULAR, u, straight=straight, sensitive=True)
    for i, name in enumerate(one.structure.names):
        step = 1e-6 * VALUES[name]
        ends = [dynamics(word, **{name: VALUES[name] + sign * step}).response(IRREGULAR, REGULAR, u, straight=straight)
                for sign in (1, -1)]
        quotient = (ends[0] - ends[1])[:, 0, 0] / (2 * step)
        size = max(1.0, float(np.abs(ends[0]).max()))
        assert np.median(np.abs(quotient - found[:, 1 + i, 0])) < 2e-9 * size / abs(step) * 1e-5


def test_sides_of_a_kink():
    """Where a delayed change meets a sample, the derivative by the dead time is that of the side asked for."""
    one = dynamics("P1D", tau=5.0, dead_time=4.0)
    left, right = (one.response(REGULAR, *STEP, late=late, sensitive=True)[14, 2, 0] for late in (True, False))
    assert left == pytest.approx(-1 / 5) and right == 0.0


def test_free_motion_and_poles():
    motion = dynamics("P2U", T=8.0, zeta=0.3).free_response(IRREGULAR, 0.0)
    np.testing.assert_allclose(motion[:, 0], oscillation(IRREGULAR, 0.3, 8), atol=1e-12)
    np.testing.assert_allclose(np.poly(dynamics("P3DU", zeta=3.0).poles).real,
                               np.polymul([1, 1 / 12], [1, 6 / 7, 1 / 49]), rtol=1e-12)


def test_repeated_steps_are_thinned_but_not_straight_ones():
    changes, values = thin_out(np.arange(4.0), np.array([[0.0], [0], [1], [1]]), False)
    assert changes.tolist() == [0, 2] and values.ravel().tolist() == [0, 1]
    assert len(thin_out(np.arange(4.0), np.array([[0.0], [0], [1], [1]]), True)[0]) == 4


def test_the_callers_inputs_stay():
    u = np.array([[0.0], [1.0]])
    dynamics("P1D").response(REGULAR, STEP[0], u, sensitive=True)
    assert u.tolist() == [[0.0], [1.0]]


@pytest.mark.parametrize("word", TYPES)
def test_words_are_read_as_written(word):
    structure = ProcessStructure.read(word)
    assert ProcessStructure.read(structure.word) == structure
    assert sorted(structure.word) == sorted(word)


@pytest.mark.parametrize(("word", "message"), [
    ("P4", "no process type"), ("P1U", "needs two poles"), ("Q1", "no process type"), ("P1DD", "no process type"),
    ("P0", "without poles"), ("P0IZ", "acts at once"), (3, "no process type")])
def test_impossible_types_are_refused(word, message):
    refuses(StructureError, message, ProcessStructure.read, word)


def test_impossible_values_are_refused():
    refuses(StructureError, "tau = -1", dynamics, "P1D", tau=-1.0)
    refuses(StructureError, "has the parameters", ProcessDynamics, ProcessStructure(), np.ones(1))
