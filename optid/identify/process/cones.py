"""Least squares over cones, and sums over samples, for bounds over boxes; loops that compile fast."""

import numpy as np

from optid.kernel_cache import cached_njit

RIDGE = 1e-13  # of scaled normal equations, for columns that are all but parallel


@cached_njit
def norm(values):
    """Return the Euclidean norm."""
    total = 0.0
    for k in range(len(values)):
        total += values[k] * values[k]
    return np.sqrt(total)


@cached_njit
def project(x, still):
    """Remove orthonormal columns (N, c) from rows (r, N)."""
    for c in range(still.shape[1]):
        for o in range(len(x)):
            total = 0.0
            for k in range(x.shape[1]):
                total += still[k, c] * x[o, k]
            for k in range(x.shape[1]):
                x[o, k] -= total * still[k, c]


@cached_njit
def products(x, y):
    """Return the Gram matrix (r, r) of rows (r, N), and their products with a signal (N,)."""
    r, n = x.shape
    gram, side = np.zeros((r, r)), np.zeros(r)
    for o in range(r):
        for k in range(n):
            side[o] += x[o, k] * y[k]
        for p in range(o, r):
            total = 0.0
            for k in range(n):
                total += x[o, k] * x[p, k]
            gram[o, p] = gram[p, o] = total
    return gram, side


@cached_njit
def most_explained(gram, side, h):
    """Return the most that K (x_0 + sum a_i x_i) explains with |a_i| <= h_i: faces of a cone, one by one.

    On a face some a_i are at their ends; the optimum of a face counts where it obeys the other bounds.

    Args:
        gram: Gram matrix (1 + d, 1 + d) of the columns x.
        side: (1 + d,) their products with the signal.
        h: (d,).
    """
    d, best = len(h), 0.0
    ends, basis = np.zeros(d), np.zeros((d + 1, d + 1))
    inner, right, scale, v = np.zeros((d + 1, d + 1)), np.zeros(d + 1), np.zeros(d + 1), np.zeros(d + 1)
    faces = 3**d
    for face in range(faces):
        code, size = (face + faces // 2) % faces, 1  # the interior first
        for p in range(d + 1):
            for q in range(d + 1):
                basis[p, q] = 0.0
        basis[0, 0] = 1.0
        for p in range(d):
            ends[p] = code % 3 - 1
            code //= 3
            if ends[p] == 0.0:
                basis[p + 1, size] = 1.0
                size += 1
            else:
                basis[p + 1, 0] = ends[p] * h[p]
        for p in range(size):
            right[p] = 0.0
            for k in range(d + 1):
                right[p] += basis[k, p] * side[k]
            for q in range(size):
                inner[p, q] = 0.0
                for k in range(d + 1):
                    for m in range(d + 1):
                        inner[p, q] += basis[k, p] * gram[k, m] * basis[m, q]
        for p in range(size):
            scale[p] = np.sqrt(inner[p, p]) if inner[p, p] > 0.0 else 1.0
        for p in range(size):
            for q in range(size):
                inner[p, q] /= scale[p] * scale[q]
            inner[p, p] += RIDGE
            right[p] /= scale[p]
        gain = _solve(inner, right, v, size)
        inside, at = True, 1
        for p in range(d):
            if ends[p] == 0.0:
                inside = inside and abs(v[at] / scale[at]) <= h[p] * abs(v[0] / scale[0]) * (1 + 1e-9)
                at += 1
        if inside:
            best = max(best, gain)
            if size == d + 1:
                return gain
    return best


@cached_njit
def _solve(a, b, x, n):
    """Write the solution of the first n positive definite equations a x = b, and return b x; a is overwritten."""
    for i in range(n):  # Cholesky factor, column by column
        for j in range(i):
            a[i, i] -= a[i, j] * a[i, j]
        a[i, i] = np.sqrt(max(a[i, i], 1e-300))
        for k in range(i + 1, n):
            for j in range(i):
                a[k, i] -= a[k, j] * a[i, j]
            a[k, i] /= a[i, i]
    value = 0.0
    for i in range(n):
        x[i] = b[i]
        for j in range(i):
            x[i] -= a[i, j] * x[j]
        x[i] /= a[i, i]
        value += x[i] * x[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= a[k, i] * x[k]
        x[i] /= a[i, i]
    return value
