"""Compiled least squares between bounds, for a few magnitudes at every onset."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def boxed(products, correlations, low, high, rounding, sizes, values):
    """Maximise 2 b'nu - nu'G nu over low <= nu <= high for many G and b.

    Every face of the box is tried: on the right one its stationary point is the maximum, on the others it is no more.

    Args:
        products: (T, d, d) G, positive semidefinite.
        correlations: (T, d) b.
        low: (d,) -inf where there is no bound.
        high: (d,) inf where there is no bound.
        rounding: pivots below this share of the diagonal are zero.
        sizes: (T, d) written: nu, NaN where no face has a finite stationary point.
        values: (T,) written: the maximum, NaN there.
    """
    count, d = correlations.shape
    faces = 3**d
    nu, left, matrix = np.zeros(d), np.zeros(d), np.zeros((d, d))
    state, free = np.zeros(d, dtype=np.int64), np.zeros(d, dtype=np.int64)
    for t in range(count):
        values[t] = np.nan
        for j in range(d):
            sizes[t, j] = np.nan
        for face in range(faces):
            rest, size, possible = face, 0, True
            for j in range(d):
                state[j] = rest % 3
                rest //= 3
                if state[j] == 0:
                    free[size] = j
                    size += 1
                    nu[j] = 0.0
                else:
                    nu[j] = low[j] if state[j] == 1 else high[j]
                    possible = possible and np.isfinite(nu[j])
            if not possible:
                continue
            for a in range(size):
                left[a] = correlations[t, free[a]]
                for j in range(d):
                    if state[j] != 0:
                        left[a] -= products[t, free[a], j] * nu[j]
                for b in range(size):
                    matrix[a, b] = products[t, free[a], free[b]]
            for a in range(size):  # Gauss, no pivots needed: positive definite or not possible
                if not matrix[a, a] > rounding * products[t, free[a], free[a]]:
                    possible = False
                    break
                for i in range(a + 1, size):
                    share = matrix[i, a] / matrix[a, a]
                    left[i] -= share * left[a]
                    for b in range(a, size):
                        matrix[i, b] -= share * matrix[a, b]
            if not possible:
                continue
            for back in range(size):
                a = size - 1 - back
                for b in range(a + 1, size):
                    left[a] -= matrix[a, b] * left[b]
                left[a] /= matrix[a, a]
                if not (low[free[a]] <= left[a] <= high[free[a]]):
                    possible = False
                    break
            if not possible:
                continue
            for a in range(size):
                nu[free[a]] = left[a]
            value = 0.0
            for i in range(d):
                value += 2.0 * correlations[t, i] * nu[i]
                for j in range(d):
                    value -= nu[i] * products[t, i, j] * nu[j]
            if not value <= values[t]:
                values[t] = value
                for j in range(d):
                    sizes[t, j] = nu[j]
