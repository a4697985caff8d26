"""The reaction wheel pendulum, the Van der Pol oscillator and two tanks: plants of known physics.

The arguments that they share are those of `optid.plants`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid import signals
from optid.arrays import Array, check_integer, one_of
from optid.data.record import Data
from optid.errors import StructureError, nearest
from optid.models.equations import Equations
from optid.plants.sampling import as_input, as_state, check_bounded, check_parameters, gaussian

if TYPE_CHECKING:
    from optid.plants.kernels import IntegrationScheme

STAGES = {"euler": 1, "rk4": 4}  # stages of the methods of integration


@dataclass(frozen=True)
class ReactionWheelPendulum:
    """A hanging pendulum with a motor and a wheel at its end.

    J th'' = -mgl sin th - k f(u) + tau(w) - c th',  J_r (w' + th'') = k f(u) - tau(w),
    tau(w) = viscous w + coulomb tanh(w / threshold); f is a dead zone within a saturation. Masses, lengths and
    inertias after D. J. Block, K. J. Astrom, M. W. Spong, The Reaction Wheel Pendulum, 2007 (from memory, mutually
    consistent); the friction is assumed.

    Attributes:
        pendulum_mass: kg.
        wheel_mass: kg.
        pendulum_inertia: about its centre of mass, kg m^2.
        wheel_inertia: about its axle, kg m^2.
        pendulum_length: pivot to the centre of mass of the pendulum, m.
        wheel_length: pivot to the axle of the wheel, m.
        gravity: m/s^2.
        torque_gain: N m per command unit.
        dead_zone: half width, command units.
        saturation: largest command.
        damping: damping ratio of small oscillations, from friction at the pivot.
        viscous: friction of the wheel, N m s.
        coulomb: friction of the wheel, N m.
        threshold: speed at which its Coulomb friction is 76 % developed, rad/s.
    """

    pendulum_mass: float = 0.2164
    wheel_mass: float = 0.0850
    pendulum_inertia: float = 2.233e-4
    wheel_inertia: float = 2.495e-5
    pendulum_length: float = 0.1173
    wheel_length: float = 0.1270
    gravity: float = 9.81
    torque_gain: float = 4.94e-3
    dead_zone: float = 0.4
    saturation: float = 10.0
    damping: float = 0.02
    viscous: float = 6e-5
    coulomb: float = 5e-4
    threshold: float = 3.0

    def __post_init__(self) -> None:
        values = vars(self)
        strict = ("pendulum_mass", "wheel_inertia", "pendulum_length", "gravity", "saturation", "threshold")
        check_parameters(**{name: values[name] for name in strict})
        check_parameters(positive=False, **{name: value for name, value in values.items() if name != "torque_gain"})

    @property
    def inertia(self) -> float:
        """Inertia about the pivot, the wheel as a point mass, kg m^2."""
        return (self.pendulum_inertia + self.pendulum_mass * self.pendulum_length**2
                + self.wheel_mass * self.wheel_length**2)

    @property
    def weight(self) -> float:
        """Largest torque of gravity (mgl), N m."""
        return self.gravity * (self.pendulum_mass * self.pendulum_length + self.wheel_mass * self.wheel_length)

    @property
    def frequency(self) -> float:
        """Natural frequency of small oscillations with the wheel blocked by nothing, rad/s."""
        return float(np.sqrt(self.weight / self.inertia))

    @property
    def coefficients(self) -> Array:
        """(7,) inertia, weight, wheel inertia, pivot friction (N m s), viscous, coulomb, threshold."""
        pivot = 2 * self.damping * self.inertia * self.frequency
        return np.array([self.inertia, self.weight, self.wheel_inertia, pivot, self.viscous, self.coulomb,
                         self.threshold])

    def torque(self, u: ArrayLike) -> Array:
        """Return the motor torque (N m) of commands of any shape: saturation, then dead zone."""
        u = np.clip(np.asarray(u, dtype=float), -self.saturation, self.saturation)
        return self.torque_gain * np.sign(u) * np.maximum(np.abs(u) - self.dead_zone, 0.0)

    def states(self, u: ArrayLike, *, dt: float = 0.02, substeps: int = 4, x0: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Return angle (rad), rate (rad/s) and wheel speed (rad/s), (N, 3), under commands (N,) held over a sample."""
        from optid.plants.kernels import PENDULUM, integrate

        scheme = _scheme(dt, substeps)
        torque = self.torque(as_input(u, 1)[:, 0])
        quiet = np.zeros((len(torque), 3))
        states = integrate(PENDULUM, torque, quiet[:, 0], quiet, as_state(x0, 3), self.coefficients, scheme)
        check_bounded(states, "pendulum")
        return states


def pendulum(u: ArrayLike, seed: int | np.random.Generator = 0, *, measurement: float = 0.2,
             quantum: float = 2 * np.pi / 4000, dt: float = 0.02, substeps: int = 4,
             x0: ArrayLike = (0.0, 0.0, 0.0)) -> Data:
    """Simulate the reaction wheel pendulum: command to angle (rad, from an encoder) and wheel speed (rad/s).

    Further arguments:
        u: (N,) commands, useful up to 10 either way.
        measurement: standard deviation of the noise on the speed, rad/s.
        quantum: resolution of the encoder, rad; 0 for none.
        x0: angle, rate and wheel speed at the first sample.
    """
    u = as_input(u, 1)
    check_parameters(positive=False, quantum=quantum)
    states = ReactionWheelPendulum().states(u, dt=dt, substeps=substeps, x0=x0)
    angle = np.round(states[:, 0] / quantum) * quantum if quantum else states[:, 0]
    speed = states[:, 2] + gaussian(np.random.default_rng(seed), len(u), 1, measurement, 0.0, "measurement")[:, 0]
    return Data(u, np.column_stack([angle, speed]), dt, inputs="command", outputs=["angle", "speed"],
                output_units=["rad", "rad/s"], name="pendulum")


def pendulum_input(kind: str, n: int, seed: int = 0, *, dt: float = 0.02) -> Array:
    """Return one of the four excitations (N,) of the pendulum experiments.

    "sinusoid": 3 sin(2 pi 1.2 t); "chirp": 0.1 to 4 Hz, four sweeps, amplitude 4; "noise": white noise below 4 Hz
    (fourth-order Butterworth, clipped at 8); "levels": uniform within 8, held five samples. Another word or a length n
    that is not positive raises a `StructureError`.
    """
    makers = {
        "sinusoid": lambda: signals.sinusoid(n, -3.0, 3.0, frequency=1.2, dt=dt),
        "chirp": lambda: signals.chirp(4 * -(-n // 4), -4.0, 4.0, f0=0.1, f1=4.0, dt=dt, repeats=4)[:n],
        "noise": lambda: signals.band_limited_noise(n, -8.0, 8.0, cutoff=4.0, dt=dt, seed=seed),
        "levels": lambda: signals.uniform_levels(n, -8.0, 8.0, hold=5, seed=seed),
    }
    if kind not in makers:
        raise StructureError(f"no excitation {kind!r}. {nearest(kind, makers)}")
    return makers[kind]()


def van_der_pol_drive(u: Array) -> Array:
    """Return f(u) = u + 0.5 u |u| of inputs of any shape."""
    return u + 0.5 * u * np.abs(u)


def van_der_pol(u: ArrayLike, seed: int | np.random.Generator = 0, *, process: float = 0.0, measurement: float = 0.0,
                colour: float = 0.0, eps: float = 1.0, dt: float = 0.1, method: str = "euler", substeps: int = 4,
                x0: ArrayLike = (0.0, 0.0)) -> Data:
    """Simulate a Van der Pol oscillator in Lienard form, driven through f(u) = u + 0.5 u |u|.

    x1+ = x1 + dt (x2 + eps (x1 - y^3 / 3)) + w1, x2+ = x2 + dt (f(u) - x1) + w2, y = x1 + v: one measured output enters
    the feedback (method "euler", the plant within the model class). Method "rk4" integrates the differential equation
    instead, which no difference equation of order two describes exactly.

    Further arguments:
        u: (N,) input, of the order of 2.
        process: standard deviation of w1 and w2.
        measurement: standard deviation of v, which the feedback sees.
        eps: strength of the nonlinear damping.
        method: "euler" or "rk4".
    """
    from optid.plants.kernels import VAN_DER_POL, integrate

    u = as_input(u, 1)
    scheme = _scheme(dt, substeps, method)
    rng = np.random.default_rng(seed)
    w = gaussian(rng, len(u), 2, process, 0.0, "process")
    v = gaussian(rng, len(u), 1, measurement, colour, "measurement")[:, 0]
    states = integrate(VAN_DER_POL, van_der_pol_drive(u[:, 0]), v, w, as_state(x0, 2), np.array([float(eps)]), scheme)
    check_bounded(states, "Van der Pol oscillator")
    return Data(u, states[:, 0] + v, dt, name="vanderpol")


def two_tanks(u: ArrayLike, seed: int | np.random.Generator = 0, *, measurement: float = 0.0, pump: float = 0.4,
              upper: float = 0.3, lower: float = 0.25, dt: float = 1.0) -> Data:
    """Simulate two tanks, the upper one emptying into the lower one; the level of the lower one is measured.

    h1' = pump u - upper sqrt h1, h2' = upper sqrt h1 - lower sqrt h2, y = h2 + v (Torricelli's law), from levels of 1.
    `TWO_TANKS` are these equations with the parameters unknown.

    Further arguments:
        u: (N,) voltage of the pump, held over a sample.
        measurement: standard deviation of v.
        pump: flow per volt.
        upper: coefficient of the outlet of the upper tank.
        lower: coefficient of the outlet of the lower tank.
    """
    from optid.plants.kernels import TANKS, integrate

    u = as_input(u, 1)
    scheme = _scheme(dt, substeps=10)
    check_parameters(pump=pump, upper=upper, lower=lower)
    v = gaussian(np.random.default_rng(seed), len(u), 1, measurement, 0.0, "measurement")[:, 0]
    still = np.zeros(len(u)), np.zeros((len(u), 2))
    levels = integrate(TANKS, u[:, 0], *still, np.ones(2), np.array([pump, upper, lower]), scheme)
    check_bounded(levels, "pair of tanks")
    return Data(u, levels[:, 1] + v, dt, name="two_tanks")


def _scheme(dt: float, substeps: int, method: str = "rk4") -> "IntegrationScheme":
    """Return the scheme of a method of `STAGES`; one of Euler takes one step per sample."""
    from optid.plants.kernels import IntegrationScheme

    check_parameters(dt=dt, substeps=substeps)
    one_of("method", method, tuple(STAGES))
    count = check_integer(substeps, "substeps") if method == "rk4" else 1
    return IntegrationScheme(STAGES[method], count, float(dt) / count)


def _torricelli(v: Mapping[str, Any]) -> dict[str, Any]:
    between, out = v["upper"] * v["h1"] ** 0.5, v["lower"] * v["h2"] ** 0.5
    return {"h1": v["pump"] * v["u"] - between, "h2": between - out, "y": v["h2"]}


TWO_TANKS = Equations(_torricelli, states={"h1": 1.0, "h2": 1.0}, bounds={"h1": (0.0, None), "h2": (0.0, None)},
                      parameters={"pump": 1.0, "upper": 1.0, "lower": 1.0})
"""The equations of `two_tanks`, their parameters started at one."""
