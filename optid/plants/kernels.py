"""Compiled recursions of the simulated plants: the next sample needs the last, so no array expression serves."""

from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.kernel_cache import cached_njit

PENDULUM, VAN_DER_POL, TANKS = 0, 1, 2


class IntegrationScheme(NamedTuple):
    """Steps of equal length in a sample: the classical Runge-Kutta method has 4 stages, Euler's 1."""

    stages: int
    substeps: int
    step: float  # s


@cached_njit
def _rates(plant: int, x: Array, drive: float, v: float, p: Array, out: Array) -> None:
    """Write the time derivative of the state; p as `ReactionWheelPendulum.coefficients`, (eps,), or of the tanks."""
    if plant == PENDULUM:  # angle, rate, wheel speed, driven by a torque
        inertia, weight, wheel, damping, viscous, coulomb, threshold = p
        friction = viscous * x[2] + coulomb * np.tanh(x[2] / threshold)
        out[0] = x[1]
        out[1] = (-weight * np.sin(x[0]) - drive + friction - damping * x[1]) / inertia
        out[2] = (drive - friction) / wheel - out[1]
    elif plant == TANKS:  # levels
        between, out_flow = p[1] * np.sqrt(max(x[0], 0.0)), p[2] * np.sqrt(max(x[1], 0.0))
        out[0] = p[0] * drive - between
        out[1] = between - out_flow
    else:  # the measured output x1 + v is fed back
        out[0] = x[1] + p[0] * (x[0] - (x[0] + v) ** 3 / 3)
        out[1] = drive - x[0]


@cached_njit
def integrate(plant: int, drive: Array, v: Array, w: Array, x0: Array, p: Array, scheme: IntegrationScheme) -> Array:
    """Return the states (N, n) of `PENDULUM`, `VAN_DER_POL` or `TANKS` at the sampling instants, from x0 (n,).

    The drive (N,) and the measurement noise v (N,), which is fed back, are held over a sample; the process noise w
    (N, n) is added at its end. The parameters p are those of `_rates`.
    """
    stages, substeps, h = scheme
    n = x0.size
    states = np.empty((drive.size, n))
    x, at, rate, step = np.empty(n), np.empty(n), np.zeros(n), np.empty(n)
    for i in range(n):
        x[i] = x0[i]
    for k in range(drive.size):
        for i in range(n):
            states[k, i] = x[i]
        for _ in range(substeps):
            for i in range(n):
                step[i] = 0.0
            for stage in range(stages):
                reach = h if stage == 3 else 0.0 if stage == 0 else 0.5 * h
                weight = 1.0 if stage % 3 == 0 else 2.0
                for i in range(n):
                    at[i] = x[i] + reach * rate[i]
                _rates(plant, at, drive[k], v[k], p, rate)
                for i in range(n):
                    step[i] += weight * rate[i]
            for i in range(n):
                x[i] += h / (6.0 if stages == 4 else 1.0) * step[i]
        for i in range(n):
            x[i] += w[k, i]
    return states


@cached_njit
def with_feedback(a: Array, drive: Array, direct: Array, c: Array, e: Array, v: Array, x0: Array) -> Array:
    """Return the states (N, n) of a `FeedbackSystem`: x+ = A x + drive + E g(y), y = C x + direct + v, from x0 (n,).

    drive (N, n) and direct (N, 2) are what the input and the process noise add to the state and to the output.
    """
    n = a.shape[0]
    states = np.empty((drive.shape[0], n))
    x, new = x0.copy(), np.empty(n)
    for k in range(drive.shape[0]):
        for i in range(n):
            states[k, i] = x[i]
        y1, y2 = direct[k, 0] + v[k, 0], direct[k, 1] + v[k, 1]
        for i in range(n):
            y1 += c[0, i] * x[i]
            y2 += c[1, i] * x[i]
        g1, g2 = -np.sin(y1), -y2 * abs(y2) / (1.0 + y2 * y2)
        for i in range(n):
            s = drive[k, i] + e[i, 0] * g1 + e[i, 1] * g2
            for j in range(n):
                s += a[i, j] * x[j]
            new[i] = s
        x, new = new, x
    return states
