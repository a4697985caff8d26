"""The inverse of a static nonlinearity over the range of its input, and the intervals without one."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from optid.arrays import Array
from optid.bases import BSpline, PiecewiseConstant, Triangular
from optid.errors import StructureError
from optid.models.nonlinearity import Nonlinearity

POINTS = 2049
"""Points at which a nonlinearity is tabulated."""

FLAT = 1e-9
"""A step below this share of the range, per point, is none: the inverse would divide by it."""

DEAD = 1e-9
"""A range of f below this share of its values is that of an actuator without effect."""

EXACT = 1e-13
"""Width of the bracket of an input, relative to its range, at which the search ends."""


@dataclass(frozen=True, eq=False)
class Inverse:
    """u = f^-1(v) for v between the least and the largest value of f."""

    f: Nonlinearity  # the nonlinearity
    low: float  # least input
    high: float  # largest input
    v_low: float  # least value of f there
    v_high: float  # largest value
    # intervals of the input on which f is flat or turns back, so that there is no inverse
    refused: tuple[tuple[float, float], ...]
    turns: bool  # whether f turns back on one of them; else it is only flat there
    points: Array = field(repr=False)  # (T,) inputs of a table
    values: Array = field(repr=False)  # (T,) of f

    @property
    def dead(self) -> bool:
        """Whether the actuator has no effect: f is constant."""
        return self.v_high - self.v_low <= DEAD * max(abs(self.v_low), abs(self.v_high), 1e-300)

    @property
    def message(self) -> str:
        """The intervals without an inverse and the reason; "" where there are none."""
        if not self.refused or self.dead:
            return ""
        parts = ", ".join(f"[{a:.4g}, {b:.4g}]" for a, b in self.refused)
        return f"no inverse on {parts}: f {'turns back' if self.turns else 'is flat'} there"

    def __call__(self, v: ArrayLike, near: float | None = None) -> Array:
        """Return inputs whose f is v, any shape, v limited to the range of f.

        Of several inputs (on a refused interval) the one nearest to `near`, or to the middle, is returned.
        """
        wanted = np.clip(np.asarray(v, dtype=float), self.v_low, self.v_high)
        middle = (self.low + self.high) / 2 if near is None else float(np.clip(near, self.low, self.high))
        if self.dead:
            return np.full(wanted.shape, middle)
        return np.reshape([self._nearest(value, middle) for value in wanted.ravel().tolist()], wanted.shape)

    def _nearest(self, v: float, near: float) -> float:
        """Return the root in the cell of the table that v crosses nearest to an input."""
        error = self.values - v
        crossing = np.flatnonzero(error[:-1] * error[1:] <= 0)
        best = np.clip(near, self.points[crossing], self.points[crossing + 1])
        cell = int(crossing[np.argmin(np.abs(best - near))])
        (a, b), ends = self.points[cell : cell + 2].tolist(), error[cell : cell + 2].tolist()
        if max(map(abs, ends)) <= FLAT * (self.v_high - self.v_low):
            return float(np.clip(near, a, b))

        def error_at(u: float) -> float:
            # at its points the error is that of the table: one rounded otherwise might lose its sign
            return ends[(a, b).index(u)] if u in (a, b) else float(self.f(u)) - v

        found: Any = brentq(error_at, a, b, xtol=EXACT * (self.high - self.low))
        return float(found)


def inverse(f: Nonlinearity, low: float, high: float) -> Inverse:
    """Return the inverse of a nonlinearity f over the inputs from low to high.

    Raises:
        StructureError: an empty range.
    """
    if not low < high:
        raise StructureError(f"the range of the input, [{low:g}, {high:g}], is empty.")
    points = np.linspace(low, high, POINTS)
    if isinstance(f.basis, Triangular | PiecewiseConstant | BSpline) and f.basis.interval is not None:
        corners = np.linspace(*f.basis.interval, f.basis.p + 1)
        points = np.union1d(points, corners[(corners > low) & (corners < high)])
        points = points[np.concatenate([[True], np.diff(points) > 1e-12 * (high - low)])]
        points[-1] = high
    values = np.asarray(f(points), dtype=float)
    steps, size = np.diff(values), float(np.ptp(values))
    sign = 1.0 if values[-1] >= values[0] else -1.0
    bad = sign * steps <= FLAT * size * np.diff(points) / (high - low)
    turns = bool(np.any(sign * steps < -FLAT * size))
    edges = np.flatnonzero(np.diff(bad.astype(int), prepend=0, append=0))
    refused = tuple((float(points[a]), float(points[b])) for a, b in zip(edges[::2], edges[1::2]))
    if turns:  # other parts take the values of a part that turns back, too
        back = np.concatenate([values[i : j + 1] for i, j in zip(edges[::2], edges[1::2])])
        inside = points[(values >= back.min()) & (values <= back.max())]
        refused = ((float(inside[0]), float(inside[-1])),)
    return Inverse(f, low, high, float(values.min()), float(values.max()), refused, turns, points, values)
