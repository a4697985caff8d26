"""Block descent on the active groups, compiled."""

import numpy as np
from numba import njit


@njit(cache=True)
def sweep(gram: np.ndarray, edges: np.ndarray, squares: np.ndarray, levels: np.ndarray, slope: np.ndarray,
          a: np.ndarray, sweeps: int, tolerance: float) -> int:
    """Minimise over one group at a time, in place.

    Args:
        gram: (q, q) Gram matrix of the active columns.
        edges: (g + 1,) of the groups.
        squares: (g,) squared length of the columns of a group.
        levels: (g,) lambda times the weight of a group.
        slope: (q,) M'(r - M a), kept up to date.
        a: (q,) coefficients.
        sweeps: at most.
        tolerance: stop when no coefficient moves by more, measured in the fit.

    Returns:
        The number of sweeps.
    """
    for count in range(sweeps):
        moved = 0.0
        for g in range(edges.size - 1):
            lo, hi, square = edges[g], edges[g + 1], squares[g]
            if square == 0.0:
                continue
            length = 0.0
            for j in range(lo, hi):
                length += (slope[j] + square * a[j]) ** 2
            length = np.sqrt(length)
            factor = 0.0 if length <= levels[g] else (1.0 - levels[g] / length) / square
            for j in range(lo, hi):
                new = factor * (slope[j] + square * a[j])
                step = new - a[j]
                if step != 0.0:
                    for i in range(slope.size):
                        slope[i] -= gram[i, j] * step
                    a[j] = new
                    moved = max(moved, abs(step) * np.sqrt(square))
        if moved <= tolerance:
            return count + 1
    return sweeps
