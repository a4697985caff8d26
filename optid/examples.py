"""Built-in records: simulated systems whose truth is known, so that every command can be tried without data.

Each function takes the seed of all that is random and the number of samples n, some also the standard deviation of the
noise relative to the root of the power of the noise-free output, in place of the ratio that they state.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
    clean = 20.0 + lfilter(np.r_[np.zeros(5), 1.0 - pole], np.array([1.0, -pole]), _limited(u))
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
    power = variance_of_f * _DEAD_ZONE.energy(_DEAD_ZONE.b[0])
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
    whole = _THRUSTER.filter(_THRUSTER.b[0], left * _thrust(u[:, 0]))
    data = _THRUSTER.data(u, whole, thruster(seed).truth["sigma"], rng.standard_normal(n), "broken_thruster")
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


def pendulum(seed: int = 0, n: int = 4000, noise: float | None = None) -> Example:
    """Return a simulated reaction wheel pendulum: motor command to angle and wheel speed.

    Dead zone, friction, an encoder of 4000 counts (a perfect one where the noise is zero) and noise on the speed;
    uniform levels within 8, held five samples of 0.02 s (`optid.plants.pendulum`). Gravity and friction are nonlinear
    feedback of the outputs.
    """
    u = plants.pendulum_input("levels", n, seed)
    plant = plants.ReactionWheelPendulum()
    states = plant.states(u)
    sizes: dict[str, Any] = {} if noise is None else {"measurement": noise * float(np.std(states[:, 2]))}
    sizes |= {"quantum": 0.0} if noise == 0 else {}
    return Example(plants.pendulum(u, seed, **sizes), {"n": 3, "f": (plant.torque,), "noise_free": states[:, [0, 2]]},
                   fed_back(3))


def vanderpol(seed: int = 0, n: int = 6000, noise: float | None = None) -> Example:
    """Return a simulated Van der Pol oscillator driven through f(u) = u + 0.5 u |u|.

    White uniform input within 2, dt = 0.1 s, measurement noise 0.02 and process noise a quarter of it
    (`optid.plants.van_der_pol`). The cubic damping is nonlinear feedback of the measured output.
    """
    u = np.random.default_rng([seed, 1]).uniform(-2.0, 2.0, n)
    size = 0.02 if noise is None else noise * float(np.std(plants.van_der_pol(u).y))
    data = plants.van_der_pol(u, seed, process=size / 4, measurement=size)
    return Example(data, {"n": 2, "f": (plants.van_der_pol_drive,)}, fed_back(2))


def fed_back(order: int) -> dict[str, Any]:
    """Return the arguments that suit a plant of an order with nonlinear feedback of its outputs."""
    return {"na": order, "nb": 2, "nk": 1, "basis": "polynomial:4", "nx": order, "feedback_basis": "polynomial:4"}


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
class HammersteinSystem:
    """A y = sum_c B_c f_c(u_c) + C e, from rest, with the names of its channels and the arguments to fit it with.

    With C = 1 the noise is an equation error, with C = A white noise at the output.
    """

    a: np.ndarray  # (na,) behind the leading one
    b: tuple[np.ndarray, ...]
    f: tuple[Callable[[np.ndarray], np.ndarray], ...]
    c: np.ndarray = field(default_factory=lambda: np.ones(1))
    dt: float = 0.1
    inputs: Mapping[str, str] = field(default_factory=lambda: {"u": ""})  # name: unit
    outputs: Mapping[str, str] = field(default_factory=lambda: {"y": ""})
    name: str = ""
    suggestion: Mapping[str, Any] = field(default_factory=dict)

    def filter(self, b: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return B / A of x (N,)."""
        return lfilter(b, np.concatenate([[1.0], self.a]), x)

    def impulse(self, b: np.ndarray, count: int = 200) -> np.ndarray:
        """Return so many samples of the impulse response of B / A."""
        return self.filter(b, np.eye(1, count)[0])

    def energy(self, b: np.ndarray, count: int = 2000) -> float:
        """Return the energy of so many samples of it, the variance gain of B / A for white inputs."""
        return float(np.sum(self.impulse(b, count) ** 2))

    def output(self, u: np.ndarray) -> np.ndarray:
        """Return the noise-free output (N,) to the inputs (N, m)."""
        return np.sum([self.filter(b, f(x)) for b, f, x in zip(self.b, self.f, u.T)], axis=0)

    def data(self, u: np.ndarray, clean: np.ndarray, sigma: float, e: np.ndarray, name: str = "") -> Data:
        """Return the record of inputs (N, m), noise-free outputs (N,) and white noise e (N,) of deviation sigma."""
        return Data(u, clean + self.filter(sigma * self.c, e), self.dt, list(self.inputs), list(self.outputs),
                    list(self.inputs.values()), list(self.outputs.values()), name or self.name)

    def example(self, u: np.ndarray, ratio: float, noise: float | None, rng: np.random.Generator,
                power: float | None = None) -> Example:
        """Return the record to inputs u (N, m) with output noise of this ratio of powers, or of this relative size.

        The power of the noise-free output is its variance in this record when not given.
        """
        clean = self.output(u)
        power = float(np.var(clean)) if power is None else power
        wanted = power / ratio if noise is None else power * noise**2
        sigma = float(np.sqrt(wanted / self.energy(self.c)))
        truth = {"a": self.a.copy(), "b": tuple(b.copy() for b in self.b), "f": self.f, "sigma": sigma,
                 "noise_free": clean[:, None]}
        return Example(self.data(u, clean, sigma, rng.standard_normal(len(u))), truth, dict(self.suggestion))


def _currents(n: int, seed: int) -> np.ndarray:
    """The input (n, 1) of the thruster rig: a staircase plus a multisine."""
    staircase = signals.steps(n, -1.2, 1.2, levels=9, hold=12)
    ripple = signals.multisine(n, -0.5, 0.5, dt=0.1, band=(0.0, 2.0), phases="random", seed=seed)
    return np.clip(staircase + ripple, -1.5, 1.5)[:, None]


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


_DEAD_ZONE = HammersteinSystem(
    np.array([-1.5, 0.7]), (np.array([16 / 15, 0.8]),), (_dead_band,), name="dead_zone",
    suggestion={"na": 2, "nb": 2, "nk": 0, "basis": "triangular:8", "constraints": ["monotone:increasing"]})

_THRUSTER = HammersteinSystem(
    np.array([-1.2, 0.4]), (np.array([0.2]),), (_thrust,), inputs={"current": "A"}, outputs={"thrust": "N"},
    name="thruster",
    suggestion={"na": 2, "nb": 1, "nk": 0, "basis": "triangular:10", "constraints": ["monotone:increasing"]})

_TWO_INPUTS = HammersteinSystem(
    np.array([-1.1, 0.3]), (np.array([-0.6, -0.3]), np.array([0.5, 0.4])), (_saturation, _power), dt=1.0,
    inputs={"valve": "", "heater": "V"}, outputs={"temperature": "K"}, name="two_inputs",
    suggestion={"na": 2, "nb": 2, "nk": 0, "basis": "triangular:8",
                "constraints": ["monotone:decreasing,channel=valve", "monotone:increasing,channel=heater"]})


__dir__ = public_names(__name__)
