"""The compiled simulation of instruments."""

import numpy as np
from numba import njit

from optid.arrays import Array


@njit(cache=True, nogil=True, error_model="numpy")
def clipped_run(
    a: Array, c: Array, drive: Array, direct: Array, tables: Array, injection: Array, low: Array, high: Array,
    x: Array, out: Array
) -> None:
    """Simulate x+ = A x + drive + sum_o table_o(y_o) + injection y, y = C x + direct, with y clipped to [low, high].

    Args:
        a: (n, n).
        c: (l, n).
        drive: (T, n) what the inputs add to the state.
        direct: (T, l) what they add to the outputs.
        tables: (l, G, n) feedback of output o at G points spread evenly over [low, high]; read with straight lines.
        injection: (n, l).
        low: (l,).
        high: (l,).
        x: (n,) state at the first sample; left at the sample after the last.
        out: (T, l) clipped outputs, written.
    """
    n, l, last = x.size, low.size, tables.shape[1] - 1  # noqa: E741
    following = np.empty(n)
    for t in range(drive.shape[0]):
        for i in range(n):
            following[i] = drive[t, i]
            for h in range(n):
                following[i] += a[i, h] * x[h]
        for o in range(l):
            y = direct[t, o]
            for i in range(n):
                y += c[o, i] * x[i]
            y = min(max(y, low[o]), high[o])
            out[t, o] = y
            place = (y - low[o]) / (high[o] - low[o]) * last
            cell = min(int(place), last - 1)
            share = place - cell
            for i in range(n):
                following[i] += (1 - share) * tables[o, cell, i] + share * tables[o, cell + 1, i] + injection[i, o] * y
        size = 0.0
        for i in range(n):
            size = max(size, abs(following[i]))
        scale = 1.0 if size < 1e12 else 1e12 / size  # a diverging run stays finite; its outputs sit at the limits
        for i in range(n):
            x[i] = following[i] * scale
