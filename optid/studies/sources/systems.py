"""Simulated systems by name: a record of any length and noise from a seed, with the truth behind it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from optid import examples, plants
from optid.data.record import Data
from optid.errors import DataError, LookupFailed, nearest
from optid.models.recursions import lfilter
from optid.plants.feedback import EXAMPLE1, TWO_MODES, FeedbackSystem
from optid.studies.sources.truth import Truth

LENGTH = 200  # samples of an impulse response: it has decayed by then in every system here


@dataclass(frozen=True)
class System:
    """A system that can be simulated."""

    about: str  # one sentence
    samples: int  # of its record when none are asked for
    noise: float  # standard deviation relative to that of the noise-free output, when none is asked for
    simulate: Callable[[int, float, int], tuple[Data, Truth]] = field(repr=False)  # of samples, noise and seed
    suggestion: Mapping[str, Any] = field(default_factory=dict)  # arguments that suit it; a formulation takes its own


def system(name: str) -> System:
    """Return a system by name (`LookupFailed` with the nearest name)."""
    if name not in SYSTEMS:
        raise LookupFailed(f"no system is called {name!r}. {nearest(name, SYSTEMS)}")
    return SYSTEMS[name]


def simulate(name: str, samples: int | None = None, noise: float | None = None, seed: int = 0) -> tuple[Data, Truth]:
    """Simulate a system: its record and its truth.

    Args:
        name: of the system.
        samples: length of the record; by default that of the system.
        noise: standard deviation relative to that of the noise-free output; by default that of the system.
        seed: of input and noise.

    Raises:
        LookupFailed: no such system.
        DataError: no sample, or a negative noise.
    """
    chosen = system(name)
    samples = chosen.samples if samples is None else samples
    noise = chosen.noise if noise is None else noise
    if samples < 1 or not (np.isfinite(noise) and noise >= 0):
        raise DataError(f"system {name!r}: {samples} samples with noise {noise}; samples must be positive, the "
                        "noise finite and not negative")
    return chosen.simulate(samples, noise, seed)


def _impulse(b: np.ndarray, a: np.ndarray) -> np.ndarray:
    return lfilter(b, np.concatenate([[1.0], a]), np.eye(1, LENGTH)[0])


def _example(make: Callable[..., examples.Example], ranges: tuple[tuple[float, float], ...], samples: int, noise: float,
             seed: int) -> tuple[Data, Truth]:
    found = make(seed=seed, n=samples, noise=noise)
    response = np.stack([_impulse(b, found.truth["a"]) for b in found.truth["b"]], axis=-1)[:, None, :]
    return found.data, Truth(found.truth["f"], ranges, response)


# -- one input, one output, written as difference equations ------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DifferenceEquation:
    """A y = B f(u) + C e, or y = (B / A) f(u) + e with c = a, from rest."""

    a: np.ndarray  # (na,) behind the leading one
    b: np.ndarray
    c: np.ndarray
    f: Callable[[np.ndarray], np.ndarray]
    most: float = 1.0  # largest input, uniform
    dt: float = 0.1
    gaussian: bool = False  # whether the input is standard normal instead
    power: float | None = None  # variance of the noise-free output; that of the record where None
    hold: int = 1  # samples for which the input keeps a value; if there are several, the first value is zero

    def simulate(self, samples: int, noise: float, seed: int) -> tuple[Data, Truth]:
        """Simulate with a noise relative to the standard deviation of the noise-free output."""
        rng = np.random.default_rng(seed)
        moves = -(-samples // self.hold)
        levels = rng.standard_normal(moves) if self.gaussian else rng.uniform(-self.most, self.most, moves)
        u = np.repeat(levels, self.hold)[:samples]
        u[: self.hold] *= self.hold == 1
        e = rng.standard_normal(samples)
        poles = np.concatenate([[1.0], self.a])
        clean = lfilter(self.b, poles, self.f(u))
        power = float(np.var(clean)) if self.power is None else self.power
        sigma = noise * float(np.sqrt(power / np.sum(_impulse(self.c, self.a) ** 2)))
        data = Data(u, clean + lfilter(sigma * self.c, poles, e), self.dt)
        return data, Truth((self.f,), ((-self.most, self.most),), _impulse(self.b, self.a)[:, None, None])


_NODES = np.linspace(-1.0, 1.0, 9)
_AT_NODES = 4 / 3 * np.sign(_NODES) * np.maximum(np.abs(_NODES) - 0.25, 0.0)


def _dead_zone_in_span(u: np.ndarray) -> np.ndarray:
    return np.interp(u, _NODES, _AT_NODES)


_A, _B = np.array([-1.5, 0.7]), np.array([0.8, 0.6])
_IN_SPAN_POWER = float(np.var(_dead_zone_in_span(np.linspace(-1.0, 1.0, 20001))) * np.sum(_impulse(_B, _A) ** 2))
_DING_A, _DING_B, _DING_D = np.array([-1.60, 0.80]), np.array([0.0, 0.85, 0.65]), np.array([1.0, -0.64])
# Moments of the standard normal distribution: var(u + u^2 / 2 + u^3 / 4) = 1 + 2 / 4 + 15 / 16 + 2 * 3 / 4.
_DING_POWER = 3.9375 * float(np.sum(_impulse(_DING_B, _DING_A) ** 2))
_DING_NOISE = 0.5 * float(np.sqrt(np.sum(_impulse(_DING_D, _DING_A) ** 2) / _DING_POWER))
_STEP_TAU, _STEP_LATE = 8.0, 0.4  # samples; the dead time is five whole ones longer
_STEP_B = np.r_[np.zeros(6), -np.diff(np.exp(-np.array([0.0, 1 - _STEP_LATE, 1.0]) / _STEP_TAU))]


# -- plants with states ------------------------------------------------------------------------------------------------


def _fed_back(plant: FeedbackSystem, bound: float, samples: int, noise: float, seed: int) -> tuple[Data, Truth]:
    """Simulate with white uniform inputs within the bound, and noise relative to the RMS deviation of the outputs."""
    u = np.random.default_rng([seed, 1]).uniform(-bound, bound, (samples, 2))
    size = float(np.sqrt(np.mean(np.var(plant.record(u).y, axis=0))))
    data = plant.record(u, seed, measurement=noise * size)
    response = None
    if not plant.e.any():
        states = np.array([np.linalg.matrix_power(plant.a, k) for k in range(LENGTH - 1)])
        response = np.concatenate([plant.d[None], plant.c @ states @ plant.b])
    return data, Truth(plant.f, ((-bound, bound),) * 2, response)


def _van_der_pol(samples: int, noise: float, seed: int) -> tuple[Data, Truth]:
    u = np.random.default_rng([seed, 1]).uniform(-2.0, 2.0, samples)
    size = noise * float(np.std(plants.van_der_pol(u).y))
    data = plants.van_der_pol(u, seed, process=size / 4, measurement=size)
    return data, Truth((lambda u: u + 0.5 * u * np.abs(u),), ((-2.0, 2.0),))


def _pendulum(samples: int, noise: float, seed: int) -> tuple[Data, Truth]:
    u = plants.pendulum_input("levels", samples, seed)
    plant = plants.ReactionWheelPendulum()
    size = noise * float(np.std(plant.states(u)[:, 2]))
    perfect: dict[str, Any] = {} if noise else {"quantum": 0.0}  # a perfect encoder, too
    data = plants.pendulum(u, seed, measurement=size, **perfect)
    return data, Truth((plant.torque,), ((-8.0, 8.0),))


_HAMMERSTEIN_MODES = replace(TWO_MODES, f=EXAMPLE1.f, name="two_modes_nonlinear")

_SISO = {"na": 2, "nb": 2, "basis": "triangular:8"}

SYSTEMS: dict[str, System] = {
    "dead_zone": System(
        "Example 3 of the dissertation: a dead zone before second-order dynamics, noise e / A (optid.examples)",
        1000, 22**-0.5, partial(_example, examples.dead_zone, ((-1.0, 1.0),)), _SISO | {"nx": 2}),
    "dead_zone_in_span": System(
        "the same with a dead zone that is linear between nine nodes, so that triangular:8 holds the truth",
        1000, 22**-0.5, DifferenceEquation(_A, _B, np.ones(1), _dead_zone_in_span, power=_IN_SPAN_POWER).simulate,
        _SISO | {"nx": 2}),
    "thruster": System(
        "a marine thruster rig, current to thrust, noise e / A (optid.examples)",
        600, 30**-0.5, partial(_example, examples.thruster, ((-1.5, 1.5),)),
        {"na": 2, "nb": 1, "basis": "triangular:10", "nx": 2}),
    "two_inputs": System(
        "a heated tank with a saturating valve and a quadratic heater: two inputs, noise e / A (optid.examples)",
        2000, 0.2, partial(_example, examples.two_inputs, ((-1.0, 1.0), (0.0, 2.0))),
        {"na": 2, "nb": 2, "basis": "triangular:8", "nx": 2}),
    "linear": System(
        "second-order dynamics without a nonlinearity, white noise on the output",
        1000, 0.1, DifferenceEquation(_A, _B, np.r_[1.0, _A], lambda u: u).simulate, {"na": 2, "nb": 2, "nx": 2}),
    "saturation": System(
        "f(u) = tanh(1.5 u) before second-order dynamics, white noise on the output",
        1000, 0.1, DifferenceEquation(_A, _B, np.r_[1.0, _A], lambda u: np.tanh(1.5 * u)).simulate,
        {"na": 2, "nb": 2, "basis": "polynomial:5", "nx": 2}),
    "step_test": System(
        "one time constant of 8 s behind a dead time of 5.4 s, moved every 25 samples, white noise on the output",
        400, 0.1, DifferenceEquation(-np.exp([-1 / _STEP_TAU]), _STEP_B, np.r_[1.0, -np.exp(-1 / _STEP_TAU)],
                                     lambda u: u, dt=1.0, hold=25).simulate,
        {"na": 1, "nb": 2, "nk": 6, "nx": 2, "process": "P1D"}),
    "ding_chen": System(
        "the Hammerstein ARMAX example of Ding and Chen (Automatica 41, 2005), a cubic and coloured noise",
        3000, _DING_NOISE,
        DifferenceEquation(_DING_A, _DING_B, _DING_D, lambda u: u + 0.5 * u**2 + 0.25 * u**3, most=2.0, dt=1.0,
                           gaussian=True, power=_DING_POWER).simulate,
        {"na": 2, "nb": 2, "nk": 1, "nc": 1, "basis": "polynomial:3", "nx": 2}),
    "vanderpol": System(
        "a driven Van der Pol oscillator: its cubic damping is nonlinear feedback (optid.plants)",
        6000, 0.02, _van_der_pol, {"na": 2, "nb": 2, "nk": 1, "basis": "polynomial:4", "nx": 2,
                                   "feedback_basis": "polynomial:4"}),
    "pendulum": System(
        "a reaction wheel pendulum, command to angle and wheel speed, with gravity and friction (optid.plants)",
        4000, 0.01, _pendulum, {"na": 3, "nb": 2, "nk": 1, "basis": "polynomial:4", "nx": 3,
                                "feedback_basis": "polynomial:4"}),
    "example1": System(
        "three states, two inputs and two outputs with nonlinear feedback of both (optid.plants)",
        4000, 0.05, partial(_fed_back, EXAMPLE1, 2.0),
        {"na": 3, "nb": 2, "nk": 1, "basis": "polynomial:4", "nx": 3, "feedback_basis": "polynomial:4"}),
    "two_modes": System(
        "two lightly damped modes, linear, two inputs and two outputs (optid.plants)",
        2000, 0.1, partial(_fed_back, TWO_MODES, 1.0), {"na": 4, "nb": 5, "nx": 4, "basis": "linear"}),
    "two_modes_nonlinear": System(
        "the same four states behind a cubic and a saturation",
        2000, 0.1, partial(_fed_back, _HAMMERSTEIN_MODES, 2.0), {"na": 4, "nb": 5, "nx": 4, "basis": "polynomial:5"}),
}
"""The systems by the name that a study file takes."""
