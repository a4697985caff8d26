"""Compiled recursions of the simulated plants: the next sample needs the last, so no array expression serves."""

import numpy as np
from numba import njit

from optid.arrays import Array


@njit(cache=True, nogil=True, error_model="numpy")
def _pendulum_rates(x: Array, torque: float, p: Array, out: Array) -> None:
    """Write the time derivative of (angle, rate, wheel speed); p as `ReactionWheelPendulum.coefficients`."""
    inertia, weight, wheel, damping, viscous, coulomb, threshold = p
    friction = viscous * x[2] + coulomb * np.tanh(x[2] / threshold)
    acceleration = (-weight * np.sin(x[0]) - torque + friction - damping * x[1]) / inertia
    out[0] = x[1]
    out[1] = acceleration
    out[2] = (torque - friction) / wheel - acceleration


@njit(cache=True, nogil=True, error_model="numpy")
def pendulum(torque: Array, x0: Array, p: Array, dt: float, substeps: int) -> Array:
    """Return the states (N, 3) at the sampling instants, the motor torque (N,) held in between; classical RK4."""
    states = np.empty((torque.size, 3))
    h = dt / substeps
    x, at = np.empty(3), np.empty(3)
    a, b, c, d = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        x[i] = x0[i]
    for k in range(torque.size):
        for i in range(3):
            states[k, i] = x[i]
        for _ in range(substeps):
            _pendulum_rates(x, torque[k], p, a)
            for i in range(3):
                at[i] = x[i] + 0.5 * h * a[i]
            _pendulum_rates(at, torque[k], p, b)
            for i in range(3):
                at[i] = x[i] + 0.5 * h * b[i]
            _pendulum_rates(at, torque[k], p, c)
            for i in range(3):
                at[i] = x[i] + h * c[i]
            _pendulum_rates(at, torque[k], p, d)
            for i in range(3):
                x[i] = x[i] + h / 6 * (a[i] + 2 * b[i] + 2 * c[i] + d[i])
    return states


@njit(cache=True, nogil=True, error_model="numpy")
def van_der_pol_euler(drive: Array, w: Array, v: Array, x0: Array, eps: float, dt: float) -> Array:
    """Return the states (N, 2) of the difference equation; the measured output x1 + v is what is fed back."""
    states = np.empty((drive.size, 2))
    x1, x2 = x0[0], x0[1]
    for k in range(drive.size):
        states[k, 0], states[k, 1] = x1, x2
        y = x1 + v[k]
        x1, x2 = (
            x1 + dt * (x2 + eps * (x1 - y**3 / 3)) + w[k, 0],
            x2 + dt * (drive[k] - x1) + w[k, 1],
        )
    return states


@njit(cache=True, nogil=True, error_model="numpy")
def van_der_pol_rk4(drive: Array, w: Array, v: Array, x0: Array, eps: float, dt: float, substeps: int) -> Array:
    """Return the states (N, 2) of the differential equation; the feedback is continuous, v held between samples."""
    states = np.empty((drive.size, 2))
    h = dt / substeps
    x1, x2 = x0[0], x0[1]
    weights = (1.0, 2.0, 2.0, 1.0)
    reach = (0.0, 0.5, 0.5, 1.0)
    for k in range(drive.size):
        states[k, 0], states[k, 1] = x1, x2
        for _ in range(substeps):
            s1 = s2 = r1 = r2 = 0.0
            for stage in range(4):
                z1, z2 = x1 + reach[stage] * h * r1, x2 + reach[stage] * h * r2
                r1, r2 = z2 + eps * (z1 - (z1 + v[k]) ** 3 / 3), drive[k] - z1
                s1 += weights[stage] * r1
                s2 += weights[stage] * r2
            x1 += h / 6 * s1
            x2 += h / 6 * s2
        x1 += w[k, 0]
        x2 += w[k, 1]
    return states


@njit(cache=True, nogil=True, error_model="numpy")
def with_feedback(a: Array, drive: Array, direct: Array, c: Array, e: Array, v: Array, x0: Array) -> Array:
    """Return the states (N, n) of x+ = A x + drive + E g(y), y = C x + direct + v, with the two feedbacks of Example 1.

    Args:
        a: (n, n).
        drive: (N, n) what input and process noise add to the state.
        direct: (N, 2) what the input adds to the output.
        c: (2, n).
        e: (n, 2).
        v: (N, 2) measurement noise, inside the loop.
        x0: (n,).
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
