"""The simulated plants against conservation of energy, small-signal theory, loops written out, and scipy."""

import numpy as np
import pytest
from refusals import refuses
from scipy.integrate import solve_ivp

from optid import plants
from optid.errors import DataError, StructureError
from optid.plants.sampling import gaussian

RNG = np.random.default_rng(5)
FREE = plants.ReactionWheelPendulum(damping=0, viscous=0, coulomb=0)


def test_parameters_are_mutually_consistent():
    p = plants.ReactionWheelPendulum()
    assert p.inertia == pytest.approx(4.572e-3, rel=1e-3) and p.weight == pytest.approx(0.355, rel=1e-3)
    assert p.frequency**2 == pytest.approx(77.6, rel=1e-3)
    assert p.torque_gain / p.inertia == pytest.approx(1.08, rel=1e-2)
    assert p.torque_gain / p.wheel_inertia == pytest.approx(198, rel=1e-3)


def test_without_friction_energy_is_conserved():
    states = FREE.states(np.zeros(2000), x0=[2.5, 0.0, 40.0], substeps=40)
    angle, rate, speed = states.T
    kinetic = 0.5 * FREE.inertia * rate**2 + 0.5 * FREE.wheel_inertia * (speed + rate) ** 2
    energy = FREE.weight * (1 - np.cos(angle)) + kinetic
    assert np.ptp(energy) < 1e-6 * energy[0]
    assert np.ptp(states[:, 0]) > 4.9  # it swings from 2.5 to -2.5


def test_the_wheel_exchanges_angular_momentum_without_gravity():
    """J th'' + J_r (w' + th'') = 0 without gravity and friction at the pivot: internal torques cancel."""
    light = plants.ReactionWheelPendulum(gravity=1e-12, damping=0)
    s = light.states(3 * RNG.standard_normal(300), x0=[0.1, 0.2, 5.0])
    momentum = light.inertia * s[:, 1] + light.wheel_inertia * (s[:, 2] + s[:, 1])
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-9)


def test_small_oscillations_have_the_frequency_and_damping_of_the_linearised_plant():
    p = plants.ReactionWheelPendulum(viscous=0, coulomb=0)
    angle = p.states(np.zeros(3000), x0=[1e-3, 0.0, 0.0])[:, 0]
    up = np.nonzero((angle[:-1] < 0) & (angle[1:] >= 0))[0]
    crossings = up + angle[up] / (angle[up] - angle[up + 1])
    measured = 2 * np.pi / (0.02 * np.diff(crossings).mean())
    assert measured == pytest.approx(8.81 * np.sqrt(1 - 0.02**2), rel=1e-3)
    peaks = np.array([np.abs(angle[a:b]).max() for a, b in zip(up[:-1], up[1:])])
    decrement = -np.polyfit(np.arange(peaks.size), np.log(peaks), 1)[0]
    assert decrement == pytest.approx(2 * np.pi * 0.02, rel=0.01)


def test_integration_is_of_fourth_order():
    u = 3 * np.repeat(RNG.standard_normal(20), 5)
    exact = FREE.states(u, substeps=256)
    errors = [np.abs(FREE.states(u, substeps=s) - exact).max() for s in (1, 2, 4, 8)]
    orders = np.diff(-np.log2(errors))
    assert np.all(np.abs(orders - 4) < 0.3), orders


def test_pendulum_agrees_with_an_adaptive_integrator():
    p, u, x = plants.ReactionWheelPendulum(), 6 * RNG.uniform(-1, 1, 40), np.array([0.2, -0.5, 10.0])
    states = p.states(u, x0=x, substeps=64)

    def rates(_, s, torque):
        friction = p.viscous * s[2] + p.coulomb * np.tanh(s[2] / p.threshold)
        pivot = 2 * p.damping * np.sqrt(p.inertia * p.weight)
        acceleration = (-p.weight * np.sin(s[0]) - torque + friction - pivot * s[1]) / p.inertia
        return [s[1], acceleration, (torque - friction) / p.wheel_inertia - acceleration]

    for k in range(40):
        np.testing.assert_allclose(states[k], x, rtol=1e-6, atol=1e-6)
        torque = 4.94e-3 * np.sign(u[k]) * max(abs(u[k]) - 0.4, 0)
        x = solve_ivp(rates, (0, 0.02), x, args=(torque,), rtol=1e-10, atol=1e-12).y[:, -1]


def test_actuator_has_a_dead_zone_and_a_saturation():
    torque = plants.ReactionWheelPendulum().torque([-20, -10, -0.4, 0.1, 0.5, 50]) / 4.94e-3
    np.testing.assert_allclose(torque, [-9.6, -9.6, 0, 0, 0.1, 9.6], atol=1e-12)


def test_pendulum_record_is_quantised_and_noisy_as_stated():
    u = plants.pendulum_input("levels", 5000)
    clean, data = plants.pendulum(u, measurement=0, quantum=0), plants.pendulum(u, seed=3)
    counts = data.y[:, 0] / (2 * np.pi / 4000)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(data.y[:, 0] - clean.y[:, 0]).max() <= np.pi / 4000 + 1e-12
    assert np.std(data.y[:, 1] - clean.y[:, 1]) == pytest.approx(0.2, rel=0.05)
    assert data.outputs == ("angle", "speed") and data.dt == 0.02
    np.testing.assert_array_equal(data.y, plants.pendulum(u, seed=3).y)
    assert not np.array_equal(data.y, plants.pendulum(u, seed=4).y)


@pytest.mark.parametrize("kind, peak", [("sinusoid", 3), ("chirp", 4), ("noise", 8), ("levels", 8)])
def test_the_four_inputs_of_the_pendulum(kind, peak):
    u = plants.pendulum_input(kind, 4001, seed=1)
    assert u.shape == (4001,) and 0.9 * peak < np.abs(u).max() <= peak + 1e-9
    spectrum, f = np.abs(np.fft.rfft(u - u.mean())) ** 2, np.fft.rfftfreq(4001, 0.02)
    if kind == "sinusoid":
        assert f[np.argmax(spectrum)] == pytest.approx(1.2, abs=0.02)
    elif kind == "levels":
        changes = np.nonzero(np.diff(u))[0]
        assert set((changes + 1) % 5) == {0}
    else:
        assert spectrum[f < 5].sum() > 0.97 * spectrum.sum()


def test_van_der_pol_against_the_recursion_written_out():
    u = RNG.uniform(-2, 2, 300)
    data = plants.van_der_pol(u, seed=7, process=0.005, measurement=0.02, eps=1.3, dt=0.05, x0=[0.5, -0.2])
    rng = np.random.default_rng(7)
    w, v = 0.005 * rng.standard_normal((300, 2)), 0.02 * rng.standard_normal((300, 1))[:, 0]
    x1, x2 = 0.5, -0.2
    for k in range(300):
        y = x1 + v[k]
        assert data.y[k, 0] == pytest.approx(y, rel=1e-12, abs=1e-12)
        f = u[k] + 0.5 * u[k] * abs(u[k])
        x1, x2 = (x1 + 0.05 * (x2 + 1.3 * (x1 - y**3 / 3)) + w[k, 0], x2 + 0.05 * (-x1 + f) + w[k, 1])


def test_van_der_pol_in_continuous_time_against_an_adaptive_integrator():
    u, x = RNG.uniform(-2, 2, 30), np.array([1.0, 0.3])
    y = plants.van_der_pol(u, method="rk4", substeps=50, x0=x).y[:, 0]
    for k in range(30):
        assert y[k] == pytest.approx(x[0], abs=1e-7)
        f = u[k] + 0.5 * u[k] * abs(u[k])
        x = solve_ivp(lambda _, s, f=f: [s[1] + s[0] - s[0] ** 3 / 3, f - s[0]], (0, 0.1), x, rtol=1e-10,
                      atol=1e-12).y[:, -1]


def test_van_der_pol_settles_on_its_limit_cycle():
    y = plants.van_der_pol(np.zeros(4000), method="rk4", x0=[0.01, 0.0]).y[2000:, 0]
    up = np.nonzero((y[:-1] < 0) & (y[1:] >= 0))[0]
    assert np.abs(y).max() == pytest.approx(2.0086, abs=0.01)  # amplitude and period known for eps = 1
    assert 0.1 * np.diff(up).mean() == pytest.approx(6.6633, abs=0.03)


@pytest.mark.parametrize("system", [plants.EXAMPLE1, plants.TWO_MODES], ids=lambda s: s.name)
def test_feedback_systems_against_the_recursion_written_out(system):
    u, x = RNG.uniform(-2, 2, (200, 2)), RNG.standard_normal(system.order)
    data = system.record(u, seed=2, process=0.05, measurement=0.3, colour=0.9, x0=x)
    rng = np.random.default_rng(2)
    w, v = gaussian(rng, 200, system.order, 0.05, 0, "w"), gaussian(rng, 200, 2, 0.3, 0.9, "v")
    for k in range(200):
        f = np.array([g(u[k, i]) for i, g in enumerate(system.f)])
        y = system.c @ x + system.d @ f + v[k]
        np.testing.assert_allclose(data.y[k], y, rtol=1e-10, atol=1e-12)
        g = [-np.sin(y[0]), -y[1] * abs(y[1]) / (1 + y[1] ** 2)]
        x = system.a @ x + system.b @ f + system.e @ g + w[k]


def test_systems_are_those_of_the_source():
    assert sorted(np.abs(np.linalg.eigvals(plants.TWO_MODES.a))) == pytest.approx([0.75, 0.75, 0.9, 0.9])
    angles = np.abs(np.angle(np.linalg.eigvals(plants.TWO_MODES.a)))
    assert sorted(angles) == pytest.approx([0.5, 0.5, 1.4, 1.4])
    assert not plants.TWO_MODES.e.any() and plants.EXAMPLE1.order == 3
    np.testing.assert_allclose(plants.EXAMPLE1.f[0](np.array([2.0])), 2 + 0.5 * 8)
    assert plants.NOISE_CASES["combined"] == (0.05, 0.2)


def test_coloured_noise_has_the_size_and_pole_stated():
    v = gaussian(np.random.default_rng(0), 100_000, 2, 0.3, 0.9, "v")
    np.testing.assert_allclose(v.std(axis=0), 0.3, rtol=0.05)
    np.testing.assert_allclose(np.mean(v[1:] * v[:-1], axis=0) / v.var(axis=0), 0.9, atol=0.01)
    starts = [gaussian(np.random.default_rng(s), 1, 1, 0.3, 0.9, "v")[0, 0] for s in range(2000)]
    assert np.std(starts) == pytest.approx(0.3, rel=0.06)


@pytest.mark.parametrize("call, words", [
    (lambda: plants.pendulum([1.0, np.nan]), "input channel 1 is nan at sample 1"),
    (lambda: plants.pendulum(np.zeros((3, 2))), r"takes \(N,\) or \(N, 1\)"),
    (lambda: plants.pendulum(np.zeros(0)), "N of at least 1"),
    (lambda: plants.EXAMPLE1.record(np.zeros(9)), r"takes \(N, 2\)"),
    (lambda: plants.pendulum(np.zeros(3), x0=[0, 1]), "3 finite numbers"),
    (lambda: plants.van_der_pol(np.full(100, 60.0)), "leaves all bounds at sample"),
    (lambda: plants.van_der_pol(np.zeros(3), x0=[np.inf, 0]), "2 finite numbers"),
])
def test_records_that_cannot_be_simulated(call, words):
    refuses(DataError, words, call)


@pytest.mark.parametrize("call, words", [
    (lambda: plants.pendulum(np.zeros(3), dt=0), "dt = 0"),
    (lambda: plants.pendulum(np.zeros(3), substeps=0.5), "substeps must be a positive integer; got 0.5"),
    (lambda: plants.pendulum(np.zeros(3), quantum=-1), "quantum = -1"),
    (lambda: plants.pendulum(np.zeros(3), measurement=-1), "measurement = -1"),
    (lambda: plants.ReactionWheelPendulum(threshold=0), "threshold = 0"),
    (lambda: plants.ReactionWheelPendulum(coulomb=-1e-3), "coulomb = -0.001"),
    (lambda: plants.pendulum_input("sine", 9), "no excitation 'sine'"),
    (lambda: plants.pendulum_input("chirp", 0), "n must be"),
    (lambda: plants.van_der_pol(np.zeros(3), method="rk45"), "method='rk45': use one of euler, rk4"),
    (lambda: plants.van_der_pol(np.zeros(3), process=np.nan), "process = nan"),
    (lambda: plants.TWO_MODES.record(np.zeros((3, 2)), colour=1.0), "colour = 1.0"),
])
def test_impossible_parameters(call, words):
    refuses(StructureError, words, call)
