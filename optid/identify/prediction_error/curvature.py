"""What squares of linear errors leave out of the curvature of a sum of squares, learnt from the steps of a descent.

Under constraints that the record contradicts, errors stay large, and so does the sum over them of error times second
derivative, which Gauss and Newton neglect: their steps are then too short or too long by a factor, and converge slowly.
A symmetric matrix of secants stands for it (Dennis, Gay & Welsch, ACM Transactions on Mathematical Software 7 (1981),
348-368), used as far as the whole stays convex.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.statistics.linearised import Linearised

LEAST, MOST = 0.05, 1e6  # curvature of a direction beside that of the linear errors
STEP = 1e-5  # of the differences that measure it, in errors beside all of them
FLAT = 1e-10  # curvature of a direction, beside that of single unknowns, at least


class Curvature:
    """The second derivatives (n, n) that linear errors lack, and whether they have told the falls better."""

    def __init__(self, size: int) -> None:
        self.matrix = np.zeros((size, size))
        self.used = False

    def learn(self, old: Linearised, new: Linearised, step: Array) -> None:
        """Take in a step (n,) between two points; what would have told its fall better serves the next."""
        factor = new.whole[0]
        change = new.pulled - old.pulled
        lack = change - factor.T @ (factor @ step)
        bend = float(change @ step)
        if not bend > 0:
            self.used = False
            return
        now = float(step @ self.matrix @ step)
        size = min(1.0, abs(float(step @ lack)) / abs(now)) if now else 1.0
        matrix = size * self.matrix
        rest = lack - matrix @ step
        matrix += (np.outer(rest, change) + np.outer(change, rest)) / bend
        matrix -= float(step @ rest) * np.outer(change, change) / bend**2
        fall, plain = old.value - new.value, old.value - old.after(step)
        self.used = bool(abs(plain - now - fall) < abs(plain - fall)) or not self.matrix.any()
        self.matrix = matrix

    def add_to(self, at: Linearised) -> Linearised:
        """Return errors with the same sum of squares and gradient at the point, and with the curvature."""
        factor, errors = at.whole
        try:
            half = np.linalg.solve(factor.T, self.matrix)
            values, vectors = np.linalg.eigh((both := np.linalg.solve(factor.T, half.T)) + both.T)
        except np.linalg.LinAlgError:
            return at
        roots = np.sqrt(np.clip(1.0 + values / 2, LEAST, MOST))
        return replace(at, given=((vectors * roots) @ vectors.T @ factor, (vectors / roots) @ vectors.T @ errors))


def measure_curvature(criterion: Any, x: Array, at: Linearised) -> Linearised:
    """Return the errors of a criterion at x (n,) with their whole curvature, by central differences of the gradient.

    Along a flat valley linear errors promise next to nothing, and a step that heeds their bends goes on. Directions in
    which the sum of squares bends down count with the size of their curvature.
    """
    factor = at.whole[0]
    sizes = np.linalg.norm(factor, axis=0)
    sizes = np.maximum(sizes, 1e-8 * float(sizes.max(initial=1e-300)))
    slopes = []
    for step, moved in zip(STEP * np.sqrt(at.value) / sizes, np.diag(STEP * np.sqrt(at.value) / sizes)):
        sides = [criterion.admissible(x + moved), criterion.admissible(x - moved)]  # at a border there is one
        high, low = (criterion.linearise(end) if side else at for side, end in zip(sides, (x + moved, x - moved)))
        if not any(sides) or not np.isfinite(high.value + low.value):
            return at
        slopes.append((high.pulled - low.pulled) / (sum(sides) * step))
    scaled = (np.array(slopes) + np.transpose(slopes)) / np.outer(2 * sizes, sizes)
    values, vectors = np.linalg.eigh(scaled)
    roots = np.sqrt(np.maximum(np.abs(values), FLAT))
    return replace(at, given=((vectors * roots).T * sizes, (vectors / roots).T @ (at.pulled / sizes)))
