"""A term of a third party, squares of small errors and lengths of large ones, and a formulation that minimises it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import cvxpy as cp
import numpy as np

from optid import Data
from optid.core.problem import Problem
from optid.core.terms import Pull, Values, split, stack, stacked_expression
from optid_third_party.fir import facts, recover


@dataclass(frozen=True, eq=False)
class Huber:
    """``sum of huber(root z - target)``: r² up to a threshold t, 2 t |r| - t² beyond (Huber 1964)."""

    root: np.ndarray
    target: np.ndarray
    threshold: float
    z: tuple[str, ...]

    def _parts(self, y: Values) -> tuple[np.ndarray, np.ndarray]:
        r = self.root @ stack(y, self.z) - self.target
        return r, np.clip(r, -self.threshold, self.threshold)

    def value(self, y: Values) -> float:
        """Return the value at values of the leaves."""
        r, clipped = self._parts(y)
        return float(np.sum(clipped * (2 * r - clipped)))

    def pull(self, y: Values) -> Pull:
        """Return value and gradient."""
        _, clipped = self._parts(y)
        return Pull(self.value(y), split(2 * clipped @ self.root, y, self.z),
                    split(2 * np.abs(clipped) @ np.abs(self.root), y, self.z))

    def express(self, v: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the term in CVXPY expressions of the leaves."""
        return cp.sum(cp.huber(self.root @ stacked_expression(v, self.z) - self.target, self.threshold))


def robust(data: Data, *, length: int, threshold: float, constraints: tuple = ()) -> Problem:
    """Pose ``min sum huber(y - sum_j b_j u(t - j) - d)`` for one input and one output without gaps.

    Args:
        data: the record.
        length: number of coefficients.
        threshold: errors from which on outliers count by their length, in units of the output.
        constraints: on ``b`` and ``offset``.
    """
    rows, y = [], []
    for e in data.experiments:
        rows += [np.append(e.u[k - length + 1 : k + 1, 0][::-1], 1.0) for k in range(length - 1, len(e.u))]
        y.append(e.y[length - 1 :, 0])
    target = np.concatenate(y)
    energy = float(np.sum((target - target.mean()) ** 2))
    return Problem("fir.huber", {"b": np.zeros(length), "offset": np.full(1, target.mean())},
                   (Huber(np.array(rows), target, threshold, ("b", "offset")),), model=partial(recover, data),
                   facts=facts(data), builders=tuple(constraints), scale=energy, energy=energy)
