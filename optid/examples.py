"""Built-in records: simulated systems whose truth is known, so that every command can be tried without data.

Each function takes the seed of all that is random and the number of samples n, some also the standard deviation of the
noise relative to the root of the power of the noise-free output, in place of the ratio that they state.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid import plants, signals
from optid.data.record import Data
from optid.errors import LookupFailed, nearest
from optid.lazy import public_names
from optid.models.recursions import lfilter


@dataclass(frozen=True, eq=False)
class Example:
    """A record, the system it came from, and how to fit it.

    Attributes:
        data: the record.
        truth: of a Hammerstein-ARX system a (na,), b (one (nb,) array per input), f (one function per input), sigma
            (standard deviation of the equation error e), noise_free (N, l) output; of a simulated plant f, the number
            of states n, and noise_free where the noise is not fed back.
        suggestion: arguments of `fit`: na, nb, nk, basis (text, as on the command line), constraints (texts), nx and
            feedback_basis for state-space formulations, and formulation_name where it is not the default.
    """

    data: Data
    truth: dict[str, Any]
    suggestion: dict[str, Any]


def heater(seed: int = 0, n: int = 1500) -> Example:
    """Return a simulated electric heater, dated: setting in % to temperature in degC.

    The power saturates at 70 %; the temperature follows it 20 s later, with a time constant of 120 s and 0.6 degC per
    %, from 20 degC with the heater off. Settings are held for 25 samples of 5 s: off, full, then whole percents drawn
    uniformly. The sensor adds white noise of 0.3 degC and shows two decimals.
    """
    rng = np.random.default_rng([seed, 1])
    u = np.round(signals.uniform_levels(n, 0.0, 100.0, hold=25, seed=seed))
    u[:25], u[25:50] = 0.0, 100.0
    pole = np.exp(-5.0 / 120.0)
    clean = 20.0 + _filter(np.r_[np.zeros(5), 1.0 - pole], np.array([-pole]), _limited(u))
    data = Data(u, np.round(clean + 0.3 * rng.standard_normal(n), 2), 5.0, inputs="heater", outputs="temperature",
                input_units="%", output_units="degC", name="heater", start="2024-03-01T08:00")
    suggestion = {"formulation_name": "hammerstein_oe.exact", "na": 1, "nb": 1, "nk": 5, "basis": "triangular:10",
                  "constraints": ["monotone:increasing"]}
    return Example(data, {"n": 1, "f": (_limited,), "noise_free": clean[:, None]}, suggestion)


def dead_zone(seed: int = 0, n: int = 1000, noise: float | None = None) -> Example:
    """Return the simulation example of chapter 3: a dead zone of half width 0.25 before second-order dynamics.

    A = 1 - 1.5 q^-1 + 0.7 q^-2, b = (16/15, 0.8), f(u) = sign(u) max(|u| - 0.25, 0), u white and uniform on [-1, 1].
    The output noise is v = e / A with white Gaussian e, and the ratio of the variances of the noise-free output and
    of v is 22 (D. Luo, PhD dissertation, University of Central Florida, 2005, section 3.4; A, b and f are chosen here,
    the source does not print them). The system starts at rest, dt = 0.1 s.
    """
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, n)
    variance_of_f = 0.75**3 / 3  # integral of (|u| - 0.25)^2 over the density 1/2, f has zero mean
    power = variance_of_f * _energy(_DEAD_ZONE.b[0], _DEAD_ZONE.a)
    return _DEAD_ZONE.example(u[:, None], 22, noise, rng, power)


def thruster(seed: int = 0, n: int = 600, noise: float | None = None) -> Example:
    """Return a simulated marine thruster rig: servo current to thrust.

    Thrust is quadratic in the current, weaker astern (0.7), zero in a dead band of 0.1 A either way, and follows with
    A = 1 - 1.2 q^-1 + 0.4 q^-2, b_0 = 0.2 (unit static gain), dt = 0.1 s. The input is a staircase plus a multisine, at
    most 1.5 A; the ratio of the energies of noise-free thrust and noise is 30. Modelled on section 3.5 of the same
    dissertation as `dead_zone`, whose data are not public.
    """
    rng = np.random.default_rng(seed)
    u = _currents(n, seed)
    return _THRUSTER.example(u, 30, noise, rng, float(np.mean(_THRUSTER.output(u) ** 2)))


def broken_thruster(seed: int = 0, n: int = 400) -> Example:
    """Return the rig of `thruster` with a propeller that breaks after five eighths of the record.

    From then on the current drives half the thrust; input, dynamics and noise are of the same
    kind. For `optid diagnose`, with a state-space model of `thruster`.
    """
    rng = np.random.default_rng([seed, 2])
    u = _currents(n, seed + 1)
    left = np.where(np.arange(n) < 5 * n // 8, 1.0, 0.5)
    whole = _filter(_THRUSTER.b[0], _THRUSTER.a, left * _thrust(u[:, 0]))
    data = _THRUSTER.data(u, whole + _THRUSTER.noise(thruster(seed).truth["sigma"], n, rng), "broken_thruster")
    truth = {"f": (_thrust,), "noise_free": whole[:, None], "onset": 5 * n // 8, "lost": 0.5}
    return Example(data, truth, dict(_THRUSTER.suggestion))


def two_inputs(seed: int = 0, n: int = 2000, noise: float | None = None) -> Example:
    """Return a simulated heated tank: a valve that saturates and a heater whose power is quadratic in the voltage.

    A = 1 - 1.1 q^-1 + 0.3 q^-2; valve: f(u) = tanh(2 u), b = (-0.6, -0.3), u in [-1, 1]; heater: f(u) = u^2 / 4,
    b = (0.5, 0.4), u in [0, 2]. White uniform inputs, dt = 1 s; the ratio of the energies of the noise-free output,
    about its mean, and of the noise is 25.
    """
    rng = np.random.default_rng(seed)
    u = np.column_stack([rng.uniform(-1.0, 1.0, n), rng.uniform(0.0, 2.0, n)])
    return _TWO_INPUTS.example(u, 25, noise, rng)


def pendulum(seed: int = 0, n: int = 4000) -> Example:
    """Return a simulated reaction wheel pendulum: motor command to angle and wheel speed.

    Dead zone, friction, an encoder of 4000 counts and noise on the speed; uniform levels within 8, held five samples
    of 0.02 s (`optid.plants.pendulum`). Gravity and friction are nonlinear feedback of the outputs.
    """
    u = plants.pendulum_input("levels", n, seed)
    plant = plants.ReactionWheelPendulum()
    truth = {"n": 3, "f": (plant.torque,), "noise_free": plant.states(u)[:, [0, 2]]}
    suggestion = {"na": 3, "nb": 2, "nk": 1, "basis": "polynomial:4", "nx": 3, "feedback_basis": "polynomial:4"}
    return Example(plants.pendulum(u, seed), truth, suggestion)


def vanderpol(seed: int = 0, n: int = 6000) -> Example:
    """Return a simulated Van der Pol oscillator driven through f(u) = u + 0.5 u |u|.

    White uniform input within 2, dt = 0.1 s, process noise 0.005, measurement noise 0.02 (`optid.plants.van_der_pol`).
    The cubic damping is nonlinear feedback of the measured output.
    """
    u = np.random.default_rng([seed, 1]).uniform(-2.0, 2.0, n)
    data = plants.van_der_pol(u, seed, process=0.005, measurement=0.02)
    suggestion = {"na": 2, "nb": 2, "nk": 1, "basis": "polynomial:4", "nx": 2, "feedback_basis": "polynomial:4"}
    return Example(data, {"n": 2, "f": (plants.van_der_pol_drive,)}, suggestion)


def two_tanks(seed: int = 0, n: int = 600) -> Example:
    """Return two simulated tanks with square-root outflow: pump voltage to the level of the lower one.

    Levels of 0.5 to 3 V, held 20 samples of 1 s, measurement noise 0.02 (`optid.plants.two_tanks`). The equations with
    unknown parameters are `optid.plants.TWO_TANKS`, for the formulation "physical".
    """
    u = signals.uniform_levels(n, 0.5, 3.0, hold=20, seed=seed)
    truth = {"n": 2, "parameters": {"pump": 0.4, "upper": 0.3, "lower": 0.25},
             "noise_free": plants.two_tanks(u, seed).y}
    suggestion = {"na": 2, "nb": 2, "nk": 1, "basis": "polynomial:2", "nx": 2,
                  "equations": "optid.plants:TWO_TANKS"}
    return Example(plants.two_tanks(u, seed, measurement=0.02), truth, suggestion)


EXAMPLES: dict[str, Callable[..., Example]] = {
    function.__name__: function for function in (
        heater, thruster, broken_thruster, dead_zone, two_inputs, pendulum, vanderpol, two_tanks)
}
"""The built-in records by the name that the command line takes."""


def example(name: str, **arguments: Any) -> Example:
    """Return a built-in record by name; `arguments` are its seed and n.

    Raises:
        LookupFailed: no such example; the message names the nearest.
    """
    if name not in EXAMPLES:
        raise LookupFailed(f"no example {name!r}. {nearest(name, EXAMPLES)}")
    return EXAMPLES[name](**arguments)


@dataclass(frozen=True, eq=False)
class _System:
    """A Hammerstein-ARX system with the names of its channels and the arguments to fit it with."""

    name: str
    dt: float
    inputs: dict[str, str]  # name: unit
    outputs: dict[str, str]
    a: np.ndarray
    b: tuple[np.ndarray, ...]
    f: tuple[Callable[[np.ndarray], np.ndarray], ...]
    suggestion: dict[str, Any]

    def output(self, u: np.ndarray) -> np.ndarray:
        """Return the noise-free output (N,) to the inputs (N, m), from rest."""
        return np.sum([_filter(b, self.a, f(x)) for b, f, x in zip(self.b, self.f, u.T)], axis=0)

    def noise(self, sigma: float, n: int, rng: np.random.Generator) -> np.ndarray:
        """Return output noise e / A (n,), with e of standard deviation sigma."""
        return _filter(np.ones(1), self.a, sigma * rng.standard_normal(n))

    def data(self, u: np.ndarray, y: np.ndarray, name: str = "") -> Data:
        """Return a record with the names and units of the channels."""
        return Data(u, y, self.dt, inputs=list(self.inputs), outputs=list(self.outputs),
                    input_units=list(self.inputs.values()), output_units=list(self.outputs.values()),
                    name=name or self.name)

    def example(self, u: np.ndarray, ratio: float, noise: float | None, rng: np.random.Generator,
                power: float | None = None) -> Example:
        """Return the record to inputs u (N, m) with output noise of this ratio of powers, or of this relative size.

        The power of the noise-free output is its variance in this record when not given.
        """
        clean = self.output(u)
        power = float(np.var(clean)) if power is None else power
        wanted = power / ratio if noise is None else power * noise**2
        sigma = float(np.sqrt(wanted / _energy(np.ones(1), self.a)))
        truth = {"a": self.a.copy(), "b": tuple(b.copy() for b in self.b), "f": self.f, "sigma": sigma,
                 "noise_free": clean[:, None]}
        return Example(self.data(u, clean + self.noise(sigma, len(u), rng)), truth, dict(self.suggestion))


def _currents(n: int, seed: int) -> np.ndarray:
    """The input (n, 1) of the thruster rig: a staircase plus a multisine."""
    staircase = signals.steps(n, -1.2, 1.2, levels=9, hold=12)
    ripple = signals.multisine(n, -0.5, 0.5, dt=0.1, band=(0.0, 2.0), phases="random", seed=seed)
    return np.clip(staircase + ripple, -1.5, 1.5)[:, None]


def _filter(b: np.ndarray, a: np.ndarray, x: np.ndarray) -> np.ndarray:
    return lfilter(b, np.concatenate([[1.0], a]), x)


def _energy(b: np.ndarray, a: np.ndarray) -> float:
    """Return the energy of the impulse response of B / A, its variance gain for white inputs."""
    return float(np.sum(_filter(b, a, np.eye(1, 2000)[0]) ** 2))


def _dead_band(u: np.ndarray) -> np.ndarray:
    return np.sign(u) * np.maximum(np.abs(u) - 0.25, 0.0)


def _saturation(u: np.ndarray) -> np.ndarray:
    return np.tanh(2.0 * u)


def _power(u: np.ndarray) -> np.ndarray:
    return u**2 / 4


def _limited(u: np.ndarray) -> np.ndarray:
    return 0.6 * np.minimum(u, 70.0)


def _thrust(u: np.ndarray) -> np.ndarray:
    return np.where(np.abs(u) < 0.1, 0.0, np.where(u > 0, 1.0, 0.7) * u * np.abs(u))


_DEAD_ZONE = _System(
    "dead_zone", 0.1, {"u": ""}, {"y": ""}, np.array([-1.5, 0.7]), (np.array([16 / 15, 0.8]),), (_dead_band,),
    {"na": 2, "nb": 2, "nk": 0, "basis": "triangular:8", "constraints": ["monotone:increasing"]})

_THRUSTER = _System(
    "thruster", 0.1, {"current": "A"}, {"thrust": "N"}, np.array([-1.2, 0.4]), (np.array([0.2]),), (_thrust,),
    {"na": 2, "nb": 1, "nk": 0, "basis": "triangular:10", "constraints": ["monotone:increasing"]})

_TWO_INPUTS = _System(
    "two_inputs", 1.0, {"valve": "", "heater": "V"}, {"temperature": "K"}, np.array([-1.1, 0.3]),
    (np.array([-0.6, -0.3]), np.array([0.5, 0.4])), (_saturation, _power),
    {"na": 2, "nb": 2, "nk": 0, "basis": "triangular:8",
     "constraints": ["monotone:decreasing,channel=valve", "monotone:increasing,channel=heater"]})


__dir__ = public_names(__name__)
