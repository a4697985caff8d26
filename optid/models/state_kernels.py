"""The compiled recursions of a state-space model with nonlinear feedback.

One recursion serves all simulators. At every sample the feedback sees the measured output where one is given and the
model's own output where it is NaN; the state is corrected by K times the innovation where an output is given. So

    P1, innovation form:     outputs given, K of the model
    P2, measured feedback:   outputs given, K = 0
    P3, free run:            no outputs given

A second one carries the derivatives of a run with respect to every unknown along it. The arguments are the named tuples
of `optid.models.state_signals` and `optid.models.feedback_tables`. Compiled at the first call and cached on disk.
"""

import numpy as np
from numba import njit

INSIDE, LEFT, REFUSED = 0, 1, 2
"""How a run ended: to the last sample, out of the range allowed, beyond the interval of a basis that refuses."""


@njit(cache=True, nogil=True, error_model="numpy")
def value_and_slope(tables, j, v):
    """Return (f_j(v), f_j'(v), whether v was refused)."""
    low, high = tables.low[j], tables.high[j]
    slack = 1e-12 * max(abs(low), abs(high))
    beyond = v < low - slack or v > high + slack
    refused = beyond and tables.outside[j] == 2
    frozen = (v < low or v > high) and tables.outside[j] != 0 and tables.outside[j] != 3
    excess = 0.0
    if tables.outside[j] != 0:
        excess = v - min(max(v, low), high) if tables.outside[j] == 3 else 0.0
        v = min(max(v, low), high)
    value, slope = 0.0, 0.0
    if tables.kind[j] == 0:
        rate = tables.cells[j] / (high - low)
        x = (v - low) * rate
        cell = int(min(max(np.floor(x), 0.0), tables.cells[j] - 1.0))
        x -= cell
        for d in range(tables.numbers.shape[2]):
            slope = slope * x + value
            value = value * x + tables.numbers[j, cell, d]
        slope *= rate
    elif tables.kind[j] == 1:
        rate = 2.0 / (high - low)
        x = (v - (low + high) / 2) * rate
        before, now, slope_before, slope_now = 1.0, x, 0.0, 1.0
        last = tables.numbers.shape[2] - 1
        for k in range(tables.cells[j]):
            value += tables.numbers[j, k, last] * now
            slope += tables.numbers[j, k, last] * slope_now
            n = k + 1
            later = ((2 * n + 1) * x * now - n * before) / (n + 1)
            slope_later = ((2 * n + 1) * (now + x * slope_now) - n * slope_before) / (n + 1)
            before, now, slope_before, slope_now = now, later, slope_now, slope_later
        slope *= rate
    elif tables.kind[j] == 2:
        last = tables.numbers.shape[2] - 1
        for k in range(tables.cells[j]):
            rate = (k + 1) * tables.rate[j]
            angle = rate * (v - (low + high) / 2)
            cosine, sine = np.cos(angle), np.sin(angle)
            value += tables.numbers[j, k, last - 1] * cosine + tables.numbers[j, k, last] * sine
            slope += rate * (tables.numbers[j, k, last] * cosine - tables.numbers[j, k, last - 1] * sine)
    return value + slope * excess, 0.0 if frozen else slope, refused


@njit(cache=True, nogil=True, error_model="numpy")
def march(parts, stretch, x, outputs, states):
    """Run over a stretch and leave the state behind.

    Args:
        parts: the model, a `Parts`.
        stretch: what drives it over T samples, a `Stretch`.
        x: (n,) state, changed in place.
        outputs: (T, l) written.
        states: (T, n) state before every sample, written; (0, n) for none.

    Returns:
        how the run ended and the sample at which it did.
    """
    A, C, E, L, K = parts.A, parts.C, parts.E, parts.L, parts.K
    Ez, Fz, Cz = parts.Ez, parts.Fz, parts.Cz
    n, l, s, latent = A.shape[0], C.shape[0], E.shape[1], Ez.shape[1]  # noqa: E741
    later, w = np.empty(n), np.empty(latent)
    for k in range(stretch.y.shape[0]):
        for j in range(latent):
            z = stretch.z[k, j]
            for i in range(n):
                z += Cz[j, i] * x[i]
            w[j], _, refused = value_and_slope(parts.tables, s + j, z)
            if refused:
                return REFUSED, k
        for i in range(n):
            if states.shape[0] > 0:
                states[k, i] = x[i]
            later[i] = stretch.drive[k, i]
            for j in range(n):
                later[i] += A[i, j] * x[j]
            for j in range(latent):
                later[i] += Ez[i, j] * w[j]
        for o in range(l):
            now = stretch.direct[k, o]
            for i in range(n):
                now += C[o, i] * x[i]
            for j in range(latent):
                now += Fz[o, j] * w[j]
            if not (stretch.low[o] <= now <= stretch.high[o]):
                return LEFT, k
            outputs[k, o] = now
            given = stretch.y[k, o]
            for i in range(n):
                later[i] += L[i, o] * now if np.isnan(given) else L[i, o] * given + K[i, o] * (given - now)
        for j in range(s):
            fed = stretch.feedback[k, j]
            if np.isnan(fed):
                fed, _, refused = value_and_slope(parts.tables, j, outputs[k, parts.output_of[j]])
                if refused:
                    return REFUSED, k
            for i in range(n):
                later[i] += E[i, j] * fed
        for i in range(n):
            x[i] = later[i]
    return INSIDE, stretch.y.shape[0]


@njit(cache=True, nogil=True, error_model="numpy")
def sensitivities(parts, direct, signals, turn, jacobian):
    """Carry the derivative S of the state along a run of T samples and leave it behind.

    With H(k) = dh(z)/dtheta = h' Cz S + (what theta changes in h(z) directly), and
    J(k) = dy/dtheta = C S + Fz H + (what theta changes in y directly),

        S(k+1) = A S + Ez H + (what theta changes in x(k+1) directly) + R J   where R is what comes back of the output.

    Args:
        parts: the model, a `Parts`.
        direct: what theta changes directly, a `Direct`; the initial state has the first n columns.
        signals: the run, a `Signals`.
        turn: (n, q) derivative S of the state, changed in place.
        jacobian: (T, l, q) written.
    """
    A, C, Ez, Fz, Cz = parts.A, parts.C, parts.Ez, parts.Fz, parts.Cz
    n, l, q, latent = A.shape[0], C.shape[0], turn.shape[1], Ez.shape[1]  # noqa: E741
    turned, inner = np.empty((n, q)), np.empty((latent, q))
    for k in range(jacobian.shape[0]):
        for c in range(latent):
            for p in range(q):
                inner[c, p] = 0.0
            for j in range(n):
                a = signals.slopes[k, c] * Cz[c, j]
                if a != 0.0:
                    for p in range(q):
                        inner[c, p] += a * turn[j, p]
        for e in range(direct.ends[0], direct.ends[1]):
            inner[direct.row[e], direct.column[e]] += direct.gain[e] * signals.values[k, direct.signal[e]]
        for o in range(l):
            row = jacobian[k, o]
            for p in range(q):
                row[p] = 0.0
            for j in range(n):
                a = C[o, j]
                if a != 0.0:
                    for p in range(q):
                        row[p] += a * turn[j, p]
            for c in range(latent):
                if Fz[o, c] != 0.0:
                    for p in range(q):
                        row[p] += Fz[o, c] * inner[c, p]
        for e in range(direct.ends[1], direct.ends[2]):
            jacobian[k, direct.row[e], direct.column[e]] += direct.gain[e] * signals.values[k, direct.signal[e]]
        for i in range(n):
            into = turned[i]
            for p in range(q):
                into[p] = 0.0
            for j in range(n):
                a = A[i, j]
                if a != 0.0:
                    for p in range(q):
                        into[p] += a * turn[j, p]
            for o in range(l):
                if signals.returned.shape[0] > 0 and signals.returned[k, i, o] != 0.0:
                    a = signals.returned[k, i, o]
                    for p in range(q):
                        into[p] += a * jacobian[k, o, p]
            for c in range(latent):
                if Ez[i, c] != 0.0:
                    for p in range(q):
                        into[p] += Ez[i, c] * inner[c, p]
        for e in range(direct.ends[2], direct.ends[3]):
            turned[direct.row[e], direct.column[e]] += direct.gain[e] * signals.values[k, direct.signal[e]]
        for i in range(n):
            for p in range(q):
                turn[i, p] = turned[i, p]
