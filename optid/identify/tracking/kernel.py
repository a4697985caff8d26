"""Compiled loop of the subspace trackers, one sample after the other.

PAST (Yang 1995) is a recursive least squares of x on y = W^T x. Its r x r information matrix is carried as a triangular
factor, R^T R = forgetting-weighted sum of y y^T, so that it stays positive definite however long the run is;
the gain g = (R^T R)^-1 y is that of the textbook recursion. OPAST (Abed-Meraim, Chkeif and Hua 2000) then multiplies
W + e g^T by the inverse square root of its Gram matrix I + |e|^2 g g^T, which keeps W orthonormal.
"""

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.identify.recursive.kernel import rotate
from optid.kernel_cache import cached_njit

WEAK = 1e-8  # relative pivot of the Gram matrix of the rows of W present below which the coordinates are undetermined


@cached_njit
def track(
    basis: Array, root: Array, sums: Array, counts: NDArray[np.int64], x: Array, forgetting: float, orthonormal: bool,
) -> Array:
    """Follow the subspace through one stretch of samples, and return the distances from it.

    The distance |x - W y| (T,) is over the entries present and before the update, NaN where a sample is not used. The
    state arrays change in place.

    Args:
        basis: (n, r) W.
        root: (r, r) upper triangular factor R, diagonal >= 0.
        sums: (2,) weighted count of samples used, and weighted sum of |e|^2 by entries present, scaled to n entries.
        counts: (3,) samples seen, used, and skipped because their entries do not determine the coordinates.
        x: (T, n) samples; NaN = missing.
        forgetting: in (0, 1].
        orthonormal: whether W is kept orthonormal (OPAST).
    """
    n, r = basis.shape
    fade = np.sqrt(forgetting)
    y, row, g, e = np.empty(r), np.empty(r), np.empty(r), np.empty(n)
    factor, residuals = np.empty((r, r)), np.empty(len(x))
    for t in range(len(x)):
        counts[0] += 1
        residuals[t] = np.nan
        present = 0
        for j in range(r):
            y[j] = 0.0
        for i in range(n):
            if not np.isnan(x[t, i]):
                present += 1
                for j in range(r):
                    y[j] += basis[i, j] * x[t, i]
        if present < r or present < n and not _solved(basis, x[t], factor, y):
            counts[2] += 1
            continue
        energy = 0.0
        for i in range(n):
            e[i] = 0.0
            if not np.isnan(x[t, i]):
                e[i] = x[t, i]
                for j in range(r):
                    e[i] -= basis[i, j] * y[j]
                energy += e[i] * e[i]
        residuals[t] = np.sqrt(energy)
        for j in range(r):
            row[j] = y[j]
        counts[1] += 1
        mean = sums[1] / sums[0] if sums[0] > 0.0 else 0.0
        sums[0] = forgetting * sums[0] + 1.0
        share = (present - r) / (n - r)
        sums[1] = forgetting * sums[1] + (energy / share if share > 0.0 else mean)
        rotate(root, row, 0, r, fade)
        _gain(root, y, g)
        size = 0.0
        for j in range(r):
            size += g[j] * g[j]
        stretch = np.sqrt(1.0 + energy * size)
        tau = -energy / (stretch * (1.0 + stretch)) if orthonormal else 0.0
        for i in range(n):
            step = (1.0 + tau * size) * e[i]
            if orthonormal:
                for j in range(r):
                    step += tau * basis[i, j] * g[j]
            for j in range(r):
                basis[i, j] += step * g[j]
    return residuals


@cached_njit
def _gain(root: Array, y: Array, g: Array) -> None:
    """Solve R^T R g = y; g may be y."""
    r = len(y)
    for i in range(r):
        total = y[i]
        for j in range(i):
            total -= root[j, i] * g[j]
        g[i] = total / root[i, i] if root[i, i] > 0.0 else 0.0
    for i in range(r - 1, -1, -1):
        total = g[i]
        for j in range(i + 1, r):
            total -= root[i, j] * g[j]
        g[i] = total / root[i, i] if root[i, i] > 0.0 else 0.0


@cached_njit
def _solved(basis: Array, x: Array, factor: Array, y: Array) -> bool:
    """Replace y = W_p^T x_p by the least-squares coordinates (W_p^T W_p)^-1 y of the rows p present, if they exist."""
    n, r = basis.shape
    for a in range(r):  # Cholesky, upper
        for b in range(a, r):
            total = 0.0
            for i in range(n):
                if not np.isnan(x[i]):
                    total += basis[i, a] * basis[i, b]
            least = WEAK * max(total, WEAK)
            for c in range(a):
                total -= factor[c, a] * factor[c, b]
            if b > a:
                factor[a, b] = total / factor[a, a]
            elif total > least:
                factor[a, a] = np.sqrt(total)
            else:
                return False
    _gain(factor, y, y)
    return True
