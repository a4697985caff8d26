"""Simulated systems by name: a record of any length and noise from a seed, with the truth behind it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from optid import examples
from optid.data.record import Data
from optid.errors import DataError, LookupFailed, nearest
from optid.examples import HammersteinSystem
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


def _example(make: Callable[..., examples.Example], ranges: tuple[tuple[float, float], ...], samples: int, noise: float,
             seed: int) -> tuple[Data, Truth]:
    found = make(seed=seed, n=samples, noise=noise)
    b = found.truth.get("b")  # None with nonlinear feedback
    response = None if b is None else np.stack(
        [HammersteinSystem(found.truth["a"], b, ()).impulse(one, LENGTH) for one in b], axis=-1)[:, None, :]
    return found.data, Truth(found.truth["f"], ranges, response)


# -- one input, one output, driven by levels ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DrivenSystem:
    """A system of one input and its levels."""

    system: HammersteinSystem
    most: float = 1.0  # largest input, uniform
    gaussian: bool = False  # whether the input is standard normal instead
    power: float | None = None  # variance of the noise-free output; that of the record where None
    hold: int = 1  # samples for which the input keeps a value; if there are several, the first value is zero

    def simulate(self, samples: int, noise: float, seed: int) -> tuple[Data, Truth]:
        """Simulate with a noise relative to the standard deviation of the noise-free output."""
        rng, one = np.random.default_rng(seed), self.system
        moves = -(-samples // self.hold)
        levels = rng.standard_normal(moves) if self.gaussian else rng.uniform(-self.most, self.most, moves)
        u = np.repeat(levels, self.hold)[:samples]
        u[: self.hold] *= self.hold == 1
        clean = one.output(u[:, None])
        power = float(np.var(clean)) if self.power is None else self.power
        sigma = noise * float(np.sqrt(power / one.energy(one.c, LENGTH)))
        return one.data(u, clean, sigma, rng.standard_normal(samples)), Truth(
            one.f, ((-self.most, self.most),), one.impulse(one.b[0], LENGTH)[:, None, None])


_NODES = np.linspace(-1.0, 1.0, 9)
_AT_NODES = 4 / 3 * np.sign(_NODES) * np.maximum(np.abs(_NODES) - 0.25, 0.0)


def _dead_zone_in_span(u: np.ndarray) -> np.ndarray:
    return np.interp(u, _NODES, _AT_NODES)


def _system(a: Sequence[float], b: Sequence[float], f: Callable[[np.ndarray], np.ndarray],
            c: Sequence[float] | None = None, dt: float = 0.1) -> HammersteinSystem:
    """Return a system with white noise on the output, unless c says otherwise."""
    return HammersteinSystem(np.array(a), (np.array(b),), (f,), np.array([1.0, *a] if c is None else c), dt)


_A, _B = (-1.5, 0.7), (0.8, 0.6)
_IN_SPAN = _system(_A, _B, _dead_zone_in_span, [1.0])
_IN_SPAN_POWER = float(np.var(_dead_zone_in_span(np.linspace(-1.0, 1.0, 20001))) * _IN_SPAN.energy(
    _IN_SPAN.b[0], LENGTH))
_DING = _system([-1.60, 0.80], [0.0, 0.85, 0.65], lambda u: u + 0.5 * u**2 + 0.25 * u**3, [1.0, -0.64], 1.0)
# Moments of the standard normal distribution: var(u + u^2 / 2 + u^3 / 4) = 1 + 2 / 4 + 15 / 16 + 2 * 3 / 4.
_DING_POWER = 3.9375 * _DING.energy(_DING.b[0], LENGTH)
_DING_NOISE = 0.5 * float(np.sqrt(_DING.energy(_DING.c, LENGTH) / _DING_POWER))
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


_HAMMERSTEIN_MODES = replace(TWO_MODES, f=EXAMPLE1.f, name="two_modes_nonlinear")

_SISO = {"na": 2, "nb": 2, "basis": "triangular:8"}

SYSTEMS: dict[str, System] = {
    "dead_zone": System(
        "Example 3 of the dissertation: a dead zone before second-order dynamics, noise e / A (optid.examples)",
        1000, 22**-0.5, partial(_example, examples.dead_zone, ((-1.0, 1.0),)), _SISO | {"nx": 2}),
    "dead_zone_in_span": System(
        "the same with a dead zone that is linear between nine nodes, so that triangular:8 holds the truth",
        1000, 22**-0.5, DrivenSystem(_IN_SPAN, power=_IN_SPAN_POWER).simulate,
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
        1000, 0.1, DrivenSystem(_system(_A, _B, lambda u: u)).simulate, {"na": 2, "nb": 2, "nx": 2}),
    "saturation": System(
        "f(u) = tanh(1.5 u) before second-order dynamics, white noise on the output",
        1000, 0.1, DrivenSystem(_system(_A, _B, lambda u: np.tanh(1.5 * u))).simulate,
        {"na": 2, "nb": 2, "basis": "polynomial:5", "nx": 2}),
    "step_test": System(
        "one time constant of 8 s behind a dead time of 5.4 s, moved every 25 samples, white noise on the output",
        400, 0.1, DrivenSystem(_system([-np.exp(-1 / _STEP_TAU)], _STEP_B, lambda u: u, dt=1.0), hold=25).simulate,
        {"na": 1, "nb": 2, "nk": 6, "nx": 2, "process": "P1D"}),
    "ding_chen": System(
        "the Hammerstein ARMAX example of Ding and Chen (Automatica 41, 2005), a cubic and coloured noise",
        3000, _DING_NOISE, DrivenSystem(_DING, most=2.0, gaussian=True, power=_DING_POWER).simulate,
        {"na": 2, "nb": 2, "nk": 1, "nc": 1, "basis": "polynomial:3", "nx": 2}),
    "vanderpol": System(
        "a driven Van der Pol oscillator: its cubic damping is nonlinear feedback (optid.plants)",
        6000, 0.02, partial(_example, examples.vanderpol, ((-2.0, 2.0),)), examples.fed_back(2)),
    "pendulum": System(
        "a reaction wheel pendulum, command to angle and wheel speed, with gravity and friction (optid.plants)",
        4000, 0.01, partial(_example, examples.pendulum, ((-8.0, 8.0),)), examples.fed_back(3)),
    "example1": System(
        "three states, two inputs and two outputs with nonlinear feedback of both (optid.plants)",
        4000, 0.05, partial(_fed_back, EXAMPLE1, 2.0), examples.fed_back(3)),
    "two_modes": System(
        "two lightly damped modes, linear, two inputs and two outputs (optid.plants)",
        2000, 0.1, partial(_fed_back, TWO_MODES, 1.0), {"na": 4, "nb": 5, "nx": 4, "basis": "linear"}),
    "two_modes_nonlinear": System(
        "the same four states behind a cubic and a saturation",
        2000, 0.1, partial(_fed_back, _HAMMERSTEIN_MODES, 2.0), {"na": 4, "nb": 5, "nx": 4, "basis": "polynomial:5"}),
}
"""The systems by the name that a study file takes."""
