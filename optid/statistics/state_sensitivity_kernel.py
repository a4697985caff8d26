"""The compiled recursion of a state-space model and of its derivatives with respect to every unknown.

Compiled at the first call and cached on disk.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def sensitivities(point, places, signals, x, turn, outputs, jacobian):
    """Run over a stretch of T samples and leave the state and its derivative behind.

    With J(k) = dy/dtheta = C S + (what theta changes in y directly),

        S(k+1) = A S(k) + (what theta changes in x(k+1) directly) - K J(k)   over the outputs present
                                                                  + G(k) J(k) over those fed back by the model.

    Args:
        point: matrices, a `Matrices`.
        places: first column of every part in theta, a `Places`; -1 for parts that are not unknown.
        signals: what drives the stretch, a `Signals`.
        x: (n,) state, changed in place.
        turn: (n, q) derivative S of the state, changed in place.
        outputs: (T, l) written.
        jacobian: (T, l, q) written.
    """
    A, C, K, b, d, e = point.A, point.C, point.K, point.b, point.d, point.e
    n, l, q, m, s = A.shape[0], C.shape[0], turn.shape[1], b.shape[1], e.shape[1]  # noqa: E741
    later, turned = np.empty(n), np.empty((n, q))
    innovation, gain = np.empty(l), np.empty((n, l))
    for k in range(outputs.shape[0]):
        for o in range(l):
            now = signals.direct[k, o]
            row = jacobian[k, o]
            row[:] = 0.0
            for i in range(n):
                now += C[o, i] * x[i]
                for p in range(q):
                    row[p] += C[o, i] * turn[i, p]
                row[places.C + o * n + i] += x[i]
            if places.offset >= 0:
                row[places.offset + o] += 1.0
            for c in range(m):
                if places.d[c] >= 0:
                    row[places.d[c] + o] += signals.f[k, c]
                    if places.mu[c] >= 0:
                        for j in range(places.functions[c], places.functions[c + 1]):
                            row[places.mu[c] + j - places.functions[c]] += d[o, c] * signals.eta[k, j]
            outputs[k, o] = now
            given = signals.y[k, o]
            innovation[o] = 0.0 if np.isnan(given) else given - now
            for i in range(n):
                gain[i, o] = 0.0 if np.isnan(given) else -K[i, o]
                if signals.closed[k] >= 0:
                    gain[i, o] += signals.slopes[signals.closed[k], i, o]
        for i in range(n):
            later[i] = signals.drive[k, i]
            into = turned[i]
            into[:] = 0.0
            for j in range(n):
                later[i] += A[i, j] * x[j]
                for p in range(q):
                    into[p] += A[i, j] * turn[j, p]
                into[places.A + i * n + j] += x[j]
            for o in range(l):
                later[i] += K[i, o] * innovation[o]
                if places.K >= 0:
                    into[places.K + i * l + o] += innovation[o]
                if gain[i, o] != 0.0:
                    for p in range(q):
                        into[p] += gain[i, o] * jacobian[k, o, p]
            for c in range(m):
                into[places.b[c] + i] += signals.f[k, c]
                if places.mu[c] >= 0:
                    for j in range(places.functions[c], places.functions[c + 1]):
                        into[places.mu[c] + j - places.functions[c]] += b[i, c] * signals.eta[k, j]
            for c in range(s):
                into[places.e[c] + i] += signals.g[k, c]
                if places.nu[c] >= 0:
                    for j in range(places.coordinates[c], places.coordinates[c + 1]):
                        into[places.nu[c] + j - places.coordinates[c]] += e[i, c] * signals.zeta[k, j]
        for i in range(n):
            x[i] = later[i]
            for p in range(q):
                turn[i, p] = turned[i, p]
