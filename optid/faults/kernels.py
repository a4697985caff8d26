"""Compiled recursions of faulty plants, and of the effect of faults on the innovations."""

import numpy as np

from optid.kernel_cache import cached_njit
from optid.models.state_kernels import INSIDE, LEFT, REFUSED, value_and_slope


@cached_njit
def march_faulty(parts, A, which, jolt, direct, w, gain, shift, v, fixed, hold, true_feedback, x, states, outputs):
    """Run a plant with faults.

    Args:
        parts: matrices and tables of the plant.
        A: (M, n, n) the values of A(k).
        which: (N,) index into A of the step from sample k to k + 1.
        jolt: (N, n) inputs, constants and faults in the step from k to k + 1.
        direct: (N, l) inputs and constants in the output.
        w: (N, n) process noise.
        gain: (N, l) factor of the output.
        shift: (N, l) added to the output after it.
        v: (N, l) measurement noise.
        fixed: (N, l) reading that replaces the output; NaN for none.
        hold: (N, l) whether the reading of the sample before is repeated.
        true_feedback: whether the plant feeds back its true outputs, not those of the faulty sensors.
        x: (n,) state, changed in place.
        states: (N, n) written.
        outputs: (N, l) written.

    Returns:
        the outcome of the run and the sample at which it ended.
    """
    C, E, L = parts.C, parts.E, parts.L
    n, l, s = x.size, C.shape[0], E.shape[1]  # noqa: E741
    later, seen = np.empty(n), np.empty(l)
    for k in range(outputs.shape[0]):
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
                return LEFT, k
            outputs[k, o] = reading
            seen[o] = true + v[k, o] if true_feedback else reading
        for i in range(n):
            states[k, i] = x[i]
            later[i] = jolt[k, i] + w[k, i]
            for j in range(n):
                later[i] += A[which[k], i, j] * x[j]
            for o in range(l):
                later[i] += L[i, o] * seen[o]
        for j in range(s):
            fed, slope, refused = value_and_slope(parts.tables, j, seen[parts.output_of[j]])
            if refused:
                return REFUSED, k
            for i in range(n):
                later[i] += E[i, j] * fed
        for i in range(n):
            x[i] = later[i]
    return INSIDE, outputs.shape[0]


@cached_njit
def respond(A, C, K, L, present, into_state, into_output, response):
    """Write the response of the innovations of the steady predictor to additions to state and output.

    Args:
        A: (1, n, n), or (N, n, n) of every sample.
        C: (l, n).
        K: (n, l) gain.
        L: (n, l) output injection of the plant.
        present: (N, l) whether there is a reading; a missing one is not used for correction.
        into_state: (N, n, d) added to x(k).
        into_output: (N, l, d) added to y(k).
        response: (N, l, d) written.
    """
    n, l, d = A.shape[1], C.shape[0], into_state.shape[2]  # noqa: E741
    x, later = np.zeros((n, d)), np.zeros((n, d))
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
def predict(A, C, K, root, drive, y, direct, x, r):
    """Run the steady predictor; write states x (T + 1, n) from x[0] on and whitened innovations r (T, l)."""
    n, l = A.shape[0], C.shape[0]  # noqa: E741
    e = np.empty(l)
    for k in range(y.shape[0]):
        for o in range(l):
            e[o] = y[k, o] - direct[k, o]
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
