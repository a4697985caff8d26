"""Compiled recursions of faulty plants, and of the effect of faults on the innovations."""

import numpy as np

from optid.kernel_cache import cached_njit
from optid.models.state_kernels import INSIDE, LEFT, REFUSED, value_and_slope


@cached_njit
def march_faulty(parts, A, drive, direct, sensors, true_feedback, start):
    """Run a plant with faults.

    Args:
        parts: matrices and tables of the plant.
        A: (1, n, n), or (N, n, n) of every step from k to k + 1.
        drive: (N, n) inputs, constants, faults and process noise in the step from k to k + 1.
        direct: (N, l) inputs and constants in the output.
        sensors: `optid.faults.faulty_plant.Sensors`.
        true_feedback: whether the plant feeds back its true outputs, not those of the faulty sensors.
        start: (n,) state of the first sample.

    Returns:
        the outcome of the run, the sample at which it ended, the states (N, n) and the readings (N, l).
    """
    C, E, L = parts.C, parts.E, parts.L
    gain, shift, v, fixed, hold = sensors
    n, l, s = start.size, C.shape[0], E.shape[1]  # noqa: E741
    states, outputs = np.empty(drive.shape), np.empty(direct.shape)
    x, later, seen = start.copy(), np.empty(n), np.empty(l)
    for k in range(outputs.shape[0]):
        t = k if A.shape[0] > 1 else 0
        for o in range(l):
            true = direct[k, o]
            for i in range(n):
                true += C[o, i] * x[i]
            reading = gain[k, o] * true + shift[k, o] + v[k, o]
            if not np.isnan(fixed[k, o]):
                reading = fixed[k, o]
            if hold[k, o] and k > 0:
                reading = outputs[k - 1, o]
            if not np.isfinite(reading):
                return LEFT, k, states, outputs
            outputs[k, o] = reading
            seen[o] = true + v[k, o] if true_feedback else reading
        for i in range(n):
            states[k, i] = x[i]
            later[i] = drive[k, i]
            for j in range(n):
                later[i] += A[t, i, j] * x[j]
            for o in range(l):
                later[i] += L[i, o] * seen[o]
        for j in range(s):
            fed, slope, refused = value_and_slope(parts.tables, j, seen[parts.output_of[j]])
            if refused:
                return REFUSED, k, states, outputs
            for i in range(n):
                later[i] += E[i, j] * fed
        for i in range(n):
            x[i] = later[i]
    return INSIDE, outputs.shape[0], states, outputs


@cached_njit
def respond(A, C, K, L, present, into_state, into_output):
    """Return the response (N, l, d) of the innovations of the steady predictor to additions to state and output.

    Args:
        A: (1, n, n), or (N, n, n) of every sample.
        C: (l, n).
        K: (n, l) gain.
        L: (n, l) output injection of the plant.
        present: (N, l) whether there is a reading; a missing one is not used for correction.
        into_state: (N, n, d) added to x(k).
        into_output: (N, l, d) added to y(k).
    """
    n, l, d = A.shape[1], C.shape[0], into_state.shape[2]  # noqa: E741
    x, later, response = np.zeros((n, d)), np.zeros((n, d)), np.empty(into_output.shape)
    for k in range(present.shape[0]):
        t = k if A.shape[0] > 1 else 0
        for p in range(d):
            for i in range(n):
                x[i, p] += into_state[k, i, p]
            for o in range(l):
                now = into_output[k, o, p]
                for i in range(n):
                    now += C[o, i] * x[i, p]
                response[k, o, p] = now
            for i in range(n):
                later[i, p] = 0.0
                for j in range(n):
                    later[i, p] += A[t, i, j] * x[j, p]
                for o in range(l):
                    later[i, p] += (-K[i, o] if present[k, o] else L[i, o]) * response[k, o, p]
            for i in range(n):
                x[i, p] = later[i, p]
    return response


@cached_njit
def add_product(M, v, out):
    """Add M v(k) to out(k) for every sample; the same digits for blocks of any length."""
    for k in range(v.shape[0]):
        for i in range(M.shape[0]):
            total = 0.0
            for j in range(M.shape[1]):
                total += M[i, j] * v[k, j]
            out[k, i] += total


@cached_njit
def predict(A, C, K, root, drive, y, start):
    """Run the steady predictor from a state (n,); return states (T + 1, n) and whitened innovations (T, l).

    y (T, l) are the readings less what inputs and constants add to them, drive (T, n) what these, the feedback and the
    readings themselves add to the next state.
    """
    n, l = A.shape[0], C.shape[0]  # noqa: E741
    x, r, e = np.empty((y.shape[0] + 1, n)), np.empty(y.shape), np.empty(l)
    for i in range(n):
        x[0, i] = start[i]
    for k in range(y.shape[0]):
        for o in range(l):
            e[o] = y[k, o]
            for i in range(n):
                e[o] -= C[o, i] * x[k, i]
        for o in range(l):
            r[k, o] = 0.0
            for p in range(o + 1):
                r[k, o] += root[o, p] * e[p]
        for i in range(n):
            total = drive[k, i]
            for j in range(n):
                total += A[i, j] * x[k, j]
            for o in range(l):
                total += K[i, o] * e[o]
            x[k + 1, i] = total
    return x, r
