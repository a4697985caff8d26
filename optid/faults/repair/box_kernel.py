"""Compiled minimisation of a convex quadratic over a box."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def box_quadratic(H, g, low, high, z, steps, tolerance):
    """Minimise z' H z / 2 + g' z over low <= z <= high by projected Newton steps (Bertsekas 1982).

    Args:
        H: (q, q) positive definite.
        g: (q,).
        low: (q,) lower bounds.
        high: (q,) upper bounds, not below low.
        z: (q,) start; the solution is written into it.
        steps: at most.
        tolerance: of the projected gradient, relative to its largest term.

    Returns:
        the largest component of the projected gradient, relative; the number of steps.
    """
    q = z.size
    for i in range(q):
        z[i] = min(max(z[i], low[i]), high[i])
    gradient, curved, trial = np.empty(q), np.empty(q), np.empty(q)
    free = np.empty(q, dtype=np.int64)
    scale = 1e-300
    for i in range(q):
        gradient[i] = g[i]
        scale = max(scale, abs(g[i]))
        for j in range(q):
            gradient[i] += H[i, j] * z[j]
    residual = np.inf
    for step in range(steps):
        count, residual = 0, 0.0
        for i in range(q):
            held = (z[i] <= low[i] and gradient[i] > 0) or (z[i] >= high[i] and gradient[i] < 0) or low[i] == high[i]
            if not held:
                free[count] = i
                count += 1
                residual = max(residual, abs(gradient[i]))
        if residual <= tolerance * scale:
            return residual / scale, step
        block = np.empty((count, count))
        right = np.empty(count)
        for a in range(count):
            right[a] = -gradient[free[a]]
            for b in range(count):
                block[a, b] = H[free[a], free[b]]
        direction = np.linalg.solve(block, right)
        length, slope = 1.0, 0.0
        for a in range(count):
            slope -= direction[a] * gradient[free[a]]
        moved = False
        for _ in range(40):
            for i in range(q):
                trial[i] = z[i]
            for a in range(count):
                i = free[a]
                trial[i] = min(max(z[i] + length * direction[a], low[i]), high[i])
            decrease = 0.0
            for i in range(q):
                curved[i] = 0.0
                for j in range(q):
                    curved[i] += H[i, j] * (trial[j] - z[j])
                decrease += (gradient[i] + 0.5 * curved[i]) * (trial[i] - z[i])
            if decrease <= -1e-4 * length * slope * 1e-3 or decrease <= 0.0 and length < 1e-6:
                moved = True
                break
            length /= 2
        if not moved:
            return residual / scale, step
        for i in range(q):
            z[i] = trial[i]
            gradient[i] += curved[i]
        for i in range(q if step % 8 == 7 else 0):  # sums of changes lose digits
            gradient[i] = g[i]
            for j in range(q):
                gradient[i] += H[i, j] * z[j]
    return residual / scale, steps
