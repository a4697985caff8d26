"""Compiled evaluation of hats; compiled at the first call and cached on disk, single threaded."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optid.arrays import Array


@njit(cache=True, nogil=True, error_model="numpy")
def hats(u: Array, lo: float, scale: float, cells: int) -> tuple[NDArray[np.int32], Array]:
    """Evaluate the two hats of the cell of each sample.

    Args:
        u: (T,) samples, brought inside where that is wanted; NaN = missing.
        lo: lower end of the first cell.
        scale: cells per unit of u.
        cells: number of cells.

    Returns:
        first (T,), weights (T, 2): zeros where a sample is missing.
    """
    first, weights = np.empty(u.size, dtype=np.int32), np.empty((u.size, 2))
    for t in range(np.uintp(u.size)):  # unsigned: signed indices are tested for counting from the end
        x = (u[t] - lo) * scale
        if np.isnan(x):
            first[t] = 0
            weights[t, 0] = weights[t, 1] = 0.0
        else:
            cell = int(min(max(x, 0.0), cells - 1.0))
            first[t] = cell
            weights[t, 1] = x - cell
            weights[t, 0] = 1.0 - weights[t, 1]
    return first, weights
