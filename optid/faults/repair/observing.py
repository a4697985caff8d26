"""Compiled recursion of a predictor that starts in the middle of a record."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def observe(A, C, K, drive, direct, y, present, x, e0, held, states, innovations):
    """Run a predictor over measured outputs.

    Args:
        A: (n, n) of the model.
        C: (l, n) of the model.
        K: (n, l) gain.
        drive: (N, n) what is known of the step from k to k + 1.
        direct: (N, l) what is known of the output.
        y: (N, l) readings.
        present: (N, l) whether a reading is there.
        x: (n,) state at the first sample, changed in place.
        e0: (l,) innovation of the first sample.
        held: whether that innovation is given, not computed.
        states: (N, n) written.
        innovations: (N, l) written, zero where a reading is missing.
    """
    n, l = x.size, C.shape[0]  # noqa: E741
    later = np.empty(n)
    for k in range(y.shape[0]):
        for i in range(n):
            states[k, i] = x[i]
        for o in range(l):
            if k == 0 and held:
                innovations[k, o] = e0[o]
            elif present[k, o]:
                predicted = direct[k, o]
                for i in range(n):
                    predicted += C[o, i] * x[i]
                innovations[k, o] = y[k, o] - predicted
            else:
                innovations[k, o] = 0.0
        for i in range(n):
            later[i] = drive[k, i]
            for j in range(n):
                later[i] += A[i, j] * x[j]
            for o in range(l):
                later[i] += K[i, o] * innovations[k, o]
        for i in range(n):
            x[i] = later[i]
