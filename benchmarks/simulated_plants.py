"""Plants with dead time in engineering units, the controllers around them, and how far a model's response is off.

Time is counted in samples; the sampling time of a record only names their unit. The input is held over a sample, and
every transfer function is sampled exactly, with dead times of any fraction of a sample.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter, tf2ss

from optid.errors import OptidError

Array = np.ndarray
Curve = Callable[[Array], Array]
Controller = Callable[[float, float], float]  # of set-point and measurement at a sample; keeps its state


@dataclass(frozen=True, eq=False)
class Linear:
    """A transfer function N(s) / D(s) exp(-dead s), in samples.

    Attributes:
        numerator, denominator: coefficients of N and D, the highest power first.
        dead: dead time.
        memory: samples after which a step response has settled, dead time included (four time constants).
    """

    numerator: Array
    denominator: Array
    dead: float
    memory: int

    @property
    def nk(self) -> int:
        """Lag of the first sample that answers to an input."""
        return int(np.floor(self.dead)) + 1

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.denominator) - 1

    @property
    def integrates(self) -> bool:
        """Whether a pole is at the origin."""
        return self.denominator[-1] == 0

    @cached_property
    def discrete(self) -> tuple[Array, Array]:
        """Numerator, from lag 0 on, and denominator for an input held over a sample."""
        a, b, c, d = tf2ss(self.numerator, self.denominator)
        n, whole = len(a), int(np.floor(self.dead))
        both = np.zeros((n + 1, n + 1))  # the state, driven by a constant 1
        both[:n, :n], both[:n, n:] = a, b
        poles = np.exp(np.roots(self.denominator))
        denominator = np.real(np.poly(poles))
        state, rises = expm(both * (whole + 1 - self.dead))[:, n], []
        for _ in range(n + 1):
            rises.append(float(c[0] @ state[:n] + d[0, 0]))
            state = expm(both) @ state
        numerator = np.convolve(np.diff(rises, prepend=0.0), denominator)[: n + 1]
        return np.concatenate([np.zeros(whole + 1), numerator]), denominator

    def respond(self, v: Array) -> Array:
        """Return the output (N,) to an input (N,), from rest."""
        return np.asarray(lfilter(*self.discrete, v))


@dataclass(frozen=True, eq=False)
class Units:
    """Levels and spans that turn an input and an output of size one into engineering units."""

    u0: float
    du: float
    y0: float
    dy: float


@dataclass(frozen=True, eq=False)
class Plant:
    """A static curve, a transfer function, and what makes a plant no Hammerstein system.

    With v = (u - u0) / du the output is y0 + dy x, x = last(output(linear(curve(v)))); nonlinear feedback replaces the
    input of the transfer function by curve(v(k)) - feedback(x(k - 1)), and the gain is multiplied by `drift`.

    Attributes:
        linear: the dynamics behind `curve`.
        units: of the channels.
        curve, output: static functions of v and of the output of `linear`.
        last: dynamics behind `output`.
        feedback: function of the last output, or None.
        drift: (N,) course of the gain, or None.
    """

    linear: Linear
    units: Units
    curve: Curve = np.asarray
    output: Curve = np.asarray
    last: Linear | None = None
    feedback: Curve | None = None
    drift: Array | None = None

    @property
    def is_hammerstein(self) -> bool:
        """Whether static functions of the input are followed by linear dynamics."""
        return self.output is np.asarray and self.feedback is None and self.drift is None

    @property
    def is_linear(self) -> bool:
        """Whether the whole plant is linear and does not change."""
        return self.is_hammerstein and self.curve is np.asarray

    @property
    def memory(self) -> int:
        """Samples until a step response has settled."""
        return self.linear.memory + (self.last.memory if self.last else 0)

    def deviations(self, v: Array) -> Array:
        """Return x (N,), from rest."""
        drive = self.curve(v)
        if self.feedback is None:
            x = self.output(self.linear.respond(drive))
        else:
            x = self._fed_back(drive)
        x = self.last.respond(x) if self.last else x
        return x if self.drift is None else x * self.drift

    def _fed_back(self, drive: Array) -> Array:
        """Return the output (N,) with feedback around the dynamics; the dead time lies before the loop."""
        assert self.feedback is not None
        dead = int(self.linear.dead)
        b, a = replace(self.linear, dead=self.linear.dead - dead).discrete
        driven, x = np.concatenate([np.zeros(min(dead, len(drive))), drive])[: len(drive)], np.zeros(len(drive))
        for k in range(len(drive)):
            driven[k] -= self.feedback(x[k - 1] if k else np.zeros(()))
            x[k] = _next(b, a, driven, x, k)
        return x

    def respond(self, u: Array) -> Array:
        """Return the output without noise (N,) to an input (N,) in its units, from rest at u0."""
        return self.units.y0 + self.units.dy * self.deviations((u - self.units.u0) / self.units.du)

    def steady(self) -> "Plant":
        """Return the plant with its mean gain, where the gain drifts."""
        if self.drift is None:
            return self
        mean = float(np.mean(self.drift))
        return replace(self, units=replace(self.units, dy=self.units.dy * mean), drift=None)


def _next(b: Array, a: Array, v: Array, x: Array, k: int) -> float:
    """Return x(k) of the difference equation, from the samples before k and v(k)."""
    past, first = min(k, len(a) - 1), int(np.flatnonzero(b)[0])
    found = -float(a[1 : past + 1] @ x[k - past : k][::-1])
    if k >= first:
        last = min(k, len(b) - 1)
        found += float(b[first : last + 1] @ v[k - last : k - first + 1][::-1])
    return found


# -- loops -------------------------------------------------------------------------------------------------------------


@dataclass
class PID:
    """A PID controller in positional form; the derivative of the measurement passes a first-order filter."""

    gain: float
    integral: float = 0.0  # a sample
    derivative: float = 0.0  # samples
    smoothing: float = 0.0  # pole of the filter of the derivative
    limit: float = np.inf
    state: float = field(default=0.0, init=False)
    slope: float = field(default=0.0, init=False)
    last: float = field(default=0.0, init=False)

    def __call__(self, r: float, y: float) -> float:
        """Return the input at a sample; the integral stands still while the input is at its limit."""
        error = r - y
        self.slope = self.smoothing * self.slope + (1 - self.smoothing) * (y - self.last)
        self.last = y
        wanted = self.gain * (error - self.derivative * self.slope) + self.state + self.integral * error
        if abs(wanted) <= self.limit:
            self.state += self.integral * error
        return float(np.clip(wanted, -self.limit, self.limit))


@dataclass
class Relay:
    """On/off control with hysteresis; `size` is the input that raises the output."""

    size: float
    hysteresis: float
    on: bool = field(default=True, init=False)

    def __call__(self, r: float, y: float) -> float:
        """Return the input at a sample."""
        if abs(r - y) > self.hysteresis:
            self.on = r > y
        return self.size if self.on else -self.size


def run_loop(linear: Linear, controller: Controller, r: Array, disturbance: Array, sensor: Array, delay: int,
             actuator: float = 0.0, upset: Array | None = None) -> tuple[Array, Array]:
    """Run a loop around a plant; return its input and its measured output, (N,) each.

    Args:
        linear: the plant.
        controller: returns the input for a set-point and a measurement.
        r: set-point.
        disturbance: added to the output of the plant.
        sensor: noise of the measurement, which the controller sees.
        delay: samples by which the controller sees the measurement late.
        actuator: pole of an inner loop between controller and input; 0 for none.
        upset: added to what the inner loop delivers; the recorded input contains it.
    """
    n = len(r)
    u, x, y, inner = np.zeros(n), np.zeros(n), np.zeros(n), 0.0
    b, a = linear.discrete
    for k in range(n):
        x[k] = _next(b, a, u, x, k)
        y[k] = x[k] + disturbance[k] + sensor[k]
        wanted = controller(float(r[k]), float(y[k - delay]) if k >= delay else 0.0)
        inner = actuator * inner + (1 - actuator) * wanted
        u[k] = inner + (0.0 if upset is None else upset[k])
    return u, y


# -- the response of a model -------------------------------------------------------------------------------------------


def response_error(model: Any, plants: tuple[Plant | None, ...], u: Array, y: Array) -> float:
    """Return how far the step responses of a model are from the plant's, relative to the plant's step response.

    Three steps of every input between two levels, the others held at their medians: over the inner 80 % of its range
    and over either half of it. Each response is the difference of two simulations from rest; the error is its RMS over
    four time constants, relative to the largest change of the plant's response to the whole step, for an idle input
    that of the other inputs. The largest of all is returned; infinite where no input acts, where the model takes other
    inputs, or where it diverges. Around a plant that is no Hammerstein system the steps are made smaller until its
    outputs move by no more than those of the record, y (N,).
    """
    acting = [p.steady() for p in plants if p is not None]
    if not acting or getattr(model, "m", 0) != len(plants) or getattr(model, "l", 1) != 1:
        return np.inf
    n = max(p.memory for p in acting)
    middle, before, errors, sizes = np.nanmedian(u, axis=0), 6 * n, [], []
    for c, plant in enumerate(plants):
        low, high = levels_of(u[:, c])
        if plant is not None and not plant.is_hammerstein:
            low, high = _within(plant.steady(), low, high, before, y)

        def run(one: Array, c: int = c) -> Array:
            inputs = np.tile(middle, (len(one), 1))
            inputs[:, c] = one
            return np.ravel(np.asarray(model.simulate(inputs, x0="zero")))

        truth = np.zeros_like if plant is None else plant.steady().respond
        sizes.append(float(np.max(np.abs(step_response(truth, low, high, before, n)))))
        for start, end in ((low, high), (low, (low + high) / 2), ((low + high) / 2, high)):
            try:
                with np.errstate(all="ignore"):
                    found = step_response(run, start, end, before, n)
            except OptidError:  # it diverges
                return np.inf
            errors.append(float(np.sqrt(np.mean((found - step_response(truth, start, end, before, n)) ** 2)))
                          / (sizes[-1] or max(sizes)))
    worst = max(errors)
    return worst if np.isfinite(worst) else np.inf


def _within(plant: Plant, low: float, high: float, before: int, y: Array) -> tuple[float, float]:
    """Return levels, within two others, between which a plant moves by at most 80 % of the range of its record."""
    middle = (low + high) / 2
    for share in np.linspace(1.0, 0.2, 17):
        start, end = middle + share * (low - middle), middle + share * (high - middle)
        moved = plant.respond(np.full(before, end))[-1] - plant.respond(np.full(before, start))[-1]
        if abs(moved) <= 0.8 * np.ptp(y):
            break
    return start, end


def levels_of(u: Array) -> tuple[float, float]:
    """Return the levels between which the responses to an input (N,) are compared: the inner 80 % of its range."""
    low, high = np.nanquantile(u, [0.1, 0.9])
    return (low, high) if low < high else (np.nanmin(u), np.nanmax(u))


def step_response(simulate: Callable[[Array], Array], low: float, high: float, before: int, n: int) -> Array:
    """Return the answer (n,) to a step from low to high: the difference of two simulations, at rest before it."""
    level, step = np.full(before + n, low), np.full(before + n, low)
    step[before:] = high
    return (simulate(step) - simulate(level))[before:]
