"""The compiled recursions of a state-space model with nonlinear feedback.

One recursion serves all simulators. At every sample the feedback sees the measured output where one is given and the
model's own output where it is NaN; the state is corrected by K times the innovation where an output is given. So

    P1, innovation form:     outputs given, K of the model
    P2, measured feedback:   outputs given, K = 0
    P3, free run:            no outputs given

The arguments are the named tuples `Parts` and `Tables` of `optid.models.feedback_tables` and `Stretch` of
`optid.models.state_simulation`. Compiled at the first call and cached on disk.
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
    frozen = (v < low or v > high) and tables.outside[j] != 0
    if tables.outside[j] != 0:
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
    return value, 0.0 if frozen else slope, refused


@njit(cache=True, nogil=True, error_model="numpy")
def march(parts, stretch, x, turn, outputs, jacobian, states):
    """Run over a stretch and leave the state behind.

    Args:
        parts: matrices and tables.
        stretch: what drives them, T samples.
        x: (n,) state, changed in place.
        turn: (n, q) derivative of the state with respect to q numbers, changed in place; q = 0 for none.
        outputs: (T, l) written.
        jacobian: (T, l, q) derivative of the outputs, written.
        states: (T, n) state before every sample, written; (0, n) for none.

    Returns:
        how the run ended and the sample at which it did.
    """
    A, C, E, L, K = parts.A, parts.C, parts.E, parts.L, parts.K
    n, l, s, q = A.shape[0], C.shape[0], E.shape[1], turn.shape[1]  # noqa: E741
    later, turned = np.empty(n), np.empty((n, q))
    for k in range(stretch.y.shape[0]):
        for i in range(n):
            if states.shape[0] > 0:
                states[k, i] = x[i]
            later[i] = stretch.drive[k, i]
            for j in range(n):
                later[i] += A[i, j] * x[j]
        for i in range(n):
            for p in range(q):
                turned[i, p] = 0.0
                for j in range(n):
                    turned[i, p] += A[i, j] * turn[j, p]
        for o in range(l):
            now = stretch.direct[k, o]
            for i in range(n):
                now += C[o, i] * x[i]
            if not (stretch.low[o] <= now <= stretch.high[o]):
                return LEFT, k
            outputs[k, o] = now
            for p in range(q):
                jacobian[k, o, p] = 0.0
                for i in range(n):
                    jacobian[k, o, p] += C[o, i] * turn[i, p]
            given = stretch.y[k, o]
            if np.isnan(given):
                for i in range(n):
                    later[i] += L[i, o] * now
                    for p in range(q):
                        turned[i, p] += L[i, o] * jacobian[k, o, p]
            else:
                for i in range(n):
                    later[i] += L[i, o] * given + K[i, o] * (given - now)
                    for p in range(q):
                        turned[i, p] -= K[i, o] * jacobian[k, o, p]
        for j in range(s):
            fed = stretch.feedback[k, j]
            if np.isnan(fed):
                o = parts.output_of[j]
                fed, slope, refused = value_and_slope(parts.tables, j, outputs[k, o])
                if refused:
                    return REFUSED, k
                for i in range(n):
                    for p in range(q):
                        turned[i, p] += E[i, j] * slope * jacobian[k, o, p]
            for i in range(n):
                later[i] += E[i, j] * fed
        for i in range(n):
            x[i] = later[i]
            for p in range(q):
                turn[i, p] = turned[i, p]
    return INSIDE, stretch.y.shape[0]
