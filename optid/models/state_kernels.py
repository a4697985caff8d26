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

from optid.kernel_cache import cached_njit

# how a run ended: to the last sample, out of the range allowed, beyond the interval of a basis that refuses
INSIDE, LEFT, REFUSED = 0, 1, 2
FORGOTTEN = 1e-150  # derivatives of the state below this size count as zero


@cached_njit
def value_and_slope(tables, j, v):
    """Return (f_j(v), f_j'(v), whether v was refused)."""
    kind, low, high, outside = tables.kind[j], tables.low[j], tables.high[j], tables.outside[j]
    cells, angular, numbers = tables.cells[j], tables.rate[j], tables.numbers[j]
    slack = 1e-12 * max(abs(low), abs(high))
    beyond = v < low - slack or v > high + slack
    refused = beyond and outside == 2
    frozen = (v < low or v > high) and outside != 0 and outside != 3
    excess = 0.0
    if outside != 0:
        excess = v - min(max(v, low), high) if outside == 3 else 0.0
        v = min(max(v, low), high)
    value, slope = 0.0, 0.0
    if kind == 0:
        rate = cells / (high - low)
        x = (v - low) * rate
        cell = int(min(max(np.floor(x), 0.0), cells - 1.0))
        x -= cell
        for d in range(numbers.shape[1]):
            slope = slope * x + value
            value = value * x + numbers[cell, d]
        slope *= rate
    elif kind == 1:
        rate = 2.0 / (high - low)
        x = (v - (low + high) / 2) * rate
        before, now, slope_before, slope_now = 1.0, x, 0.0, 1.0
        last = numbers.shape[1] - 1
        for k in range(cells):
            value += numbers[k, last] * now
            slope += numbers[k, last] * slope_now
            n = k + 1
            later = ((2 * n + 1) * x * now - n * before) / (n + 1)
            slope_later = ((2 * n + 1) * (now + x * slope_now) - n * slope_before) / (n + 1)
            before, now, slope_before, slope_now = now, later, slope_now, slope_later
        slope *= rate
    elif kind == 2:
        last = numbers.shape[1] - 1
        for k in range(cells):
            rate = (k + 1) * angular
            angle = rate * (v - (low + high) / 2)
            cosine, sine = np.cos(angle), np.sin(angle)
            value += numbers[k, last - 1] * cosine + numbers[k, last] * sine
            slope += rate * (numbers[k, last] * cosine - numbers[k, last - 1] * sine)
    return value + slope * excess, 0.0 if frozen else slope, refused


@cached_njit
def slopes(tables, first, z, found):
    """Write the slopes (T, k) of the k functions of a table behind the first ones at arguments z (T, k)."""
    for k in range(z.shape[0]):
        for j in range(z.shape[1]):
            found[k, j] = value_and_slope(tables, first + j, z[k, j])[1]


@cached_njit
def march(parts, stretch, x, outputs, states):
    """Run a model (`Parts`) over a `Stretch` and return how and at which sample the run ended.

    Written are the state x (n,) after it, the outputs (T, l), and the states (T, n) before every sample; (0, n): none.
    """
    # fields of tuples are taken out of them once: reading one in a loop counts references every time
    A, C, E, L, K, output_of = parts.A, parts.C, parts.E, parts.L, parts.K, parts.output_of
    Ez, Fz, Cz = parts.Ez, parts.Fz, parts.Cz
    drive, direct, feedback, measured, inward, least, most = stretch
    tables = parts.tables
    n, l, s, latent = A.shape[0], C.shape[0], E.shape[1], Ez.shape[1]  # noqa: E741
    later, w = np.empty(n), np.empty(latent)
    for k in range(measured.shape[0]):
        for j in range(latent):
            z = inward[k, j]
            for i in range(n):
                z += Cz[j, i] * x[i]
            w[j], _, refused = value_and_slope(tables, s + j, z)
            if refused:
                return REFUSED, k
        for i in range(n):
            if states.shape[0] > 0:
                states[k, i] = x[i]
            later[i] = drive[k, i]
            for j in range(n):
                later[i] += A[i, j] * x[j]
            for j in range(latent):
                later[i] += Ez[i, j] * w[j]
        for o in range(l):
            now = direct[k, o]
            for i in range(n):
                now += C[o, i] * x[i]
            for j in range(latent):
                now += Fz[o, j] * w[j]
            if not (least[o] <= now <= most[o]):
                return LEFT, k
            outputs[k, o] = now
            given = measured[k, o]
            for i in range(n):
                later[i] += L[i, o] * now if np.isnan(given) else L[i, o] * given + K[i, o] * (given - now)
        for j in range(s):
            fed = feedback[k, j]
            if np.isnan(fed):
                fed, _, refused = value_and_slope(tables, j, outputs[k, output_of[j]])
                if refused:
                    return REFUSED, k
            for i in range(n):
                later[i] += E[i, j] * fed
        for i in range(n):
            x[i] = later[i]
    return INSIDE, measured.shape[0]


@cached_njit
def combine(weights, rows, into):
    """Write sum_j weights[j] rows[j] of as many rows as there are weights; four at a time saves memory traffic.

    ``into`` may have further columns, which are left as they are.
    """
    count, q = weights.size, rows.shape[1]
    left = count % 4
    if left == 0:
        for p in range(q):
            into[p] = 0.0
    elif left == 1:
        a = weights[0]
        for p in range(q):
            into[p] = a * rows[0, p]
    elif left == 2:
        a, b = weights[0], weights[1]
        for p in range(q):
            into[p] = a * rows[0, p] + b * rows[1, p]
    else:
        a, b, c = weights[0], weights[1], weights[2]
        for p in range(q):
            into[p] = a * rows[0, p] + b * rows[1, p] + c * rows[2, p]
    for j in range(left, count, 4):
        a, b, c, d = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
        for p in range(q):
            into[p] += a * rows[j, p] + b * rows[j + 1, p] + c * rows[j + 2, p] + d * rows[j + 3, p]


@cached_njit
def sensitivities(parts, direct, signals, turn, jacobian):
    """Carry the derivative S of the state along a run (`Signals`) of a model (`Parts`), and leave it behind.

    With H(k) = dh(z)/dtheta = h' Cz S + (what theta changes in h(z) directly), and
    J(k) = dy/dtheta = C S + Fz H + (what theta changes in y directly),

        S(k+1) = A S + Ez H + (what theta changes in x(k+1) directly) + R J   where R is the output-feedback gain.

    The direct changes are a `Direct`; the initial state has the first n columns. Written are ``turn`` S (n, q) and the
    ``jacobian`` J, the first q columns of (T, l, q or more).
    """
    n, l, q, latent = parts.A.shape[0], parts.C.shape[0], turn.shape[1], parts.Ez.shape[1]  # noqa: E741
    returned, bent, values = signals
    row, column, signal, gain, ends = direct
    Cz, returns = parts.Cz, returned.shape[0] > 0
    stack, later = np.empty((n + latent + l, q)), np.empty((n, q))  # [S; H; J] and the next S
    of_latent, of_output = np.empty((latent, n)), np.empty((l, n + latent))
    of_state = np.empty((n, n + latent + l * returns))
    for i in range(n):
        for p in range(q):
            stack[i, p] = turn[i, p]
        for j in range(n):
            of_state[i, j] = parts.A[i, j]
        for c in range(latent):
            of_state[i, n + c] = parts.Ez[i, c]
    for o in range(l):
        for j in range(n):
            of_output[o, j] = parts.C[o, j]
        for c in range(latent):
            of_output[o, n + c] = parts.Fz[o, c]
    for k in range(jacobian.shape[0]):
        for c in range(latent):
            for j in range(n):
                of_latent[c, j] = bent[k, c] * Cz[c, j]
            combine(of_latent[c], stack, stack[n + c])
        for e in range(ends[0], ends[1]):
            stack[n + row[e], column[e]] += gain[e] * values[k, signal[e]]
        for o in range(l):
            combine(of_output[o], stack, jacobian[k, o])
        for e in range(ends[1], ends[2]):
            jacobian[k, row[e], column[e]] += gain[e] * values[k, signal[e]]
        if returns:
            for o in range(l):
                for p in range(q):
                    stack[n + latent + o, p] = jacobian[k, o, p]
                for i in range(n):
                    of_state[i, n + latent + o] = returned[k, i, o]
        for i in range(n):
            combine(of_state[i], stack, later[i])
        for e in range(ends[2], ends[3]):
            later[row[e], column[e]] += gain[e] * values[k, signal[e]]
        for i in range(n):
            for p in range(q):  # what is forgotten is zero: numbers below the normal range are slow
                stack[i, p] = later[i, p] if abs(later[i, p]) > FORGOTTEN else 0.0
    for i in range(n):
        for p in range(q):
            turn[i, p] = stack[i, p]
