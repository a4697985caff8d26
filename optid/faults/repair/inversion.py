"""The inverse of a static nonlinearity over the range of its input, and where there is none."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases import BSpline, PiecewiseConstant, Triangular
from optid.errors import StructureError
from optid.models.nonlinearity import Nonlinearity

POINTS = 2049
"""Points at which a nonlinearity is looked at."""

FLAT = 1e-9
"""A step below this share of the range, per point, is none: the inverse would divide by it."""

DEAD = 1e-9
"""A range below this share of the values is that of an actuator that no longer moves anything."""

STEPS = 40

EXACT = 1e-13
"""Error of f(f^-1(v)), relative to the range, at which the search ends."""


@dataclass(frozen=True, eq=False)
class Inverse:
    """u = f^-1(v) for v between the least and the largest value of f.

    Attributes:
        f: the nonlinearity.
        low: least input.
        high: largest input.
        v_low: least value of f there.
        v_high: largest value.
        refused: intervals of the input on which f is flat or turns back, so that there is no inverse.
        turns: whether f turns back on one of them; else it is only flat there.
        points: (T,) inputs of a table.
        values: (T,) of f.
    """

    f: Nonlinearity
    low: float
    high: float
    v_low: float
    v_high: float
    refused: tuple[tuple[float, float], ...]
    turns: bool
    points: Array = field(repr=False)
    values: Array = field(repr=False)

    @property
    def dead(self) -> bool:
        """Whether the actuator moves nothing: f is the same everywhere."""
        return self.v_high - self.v_low <= DEAD * max(abs(self.v_low), abs(self.v_high), 1e-300)

    @property
    def message(self) -> str:
        """Where there is no inverse and why, "" where there is one everywhere."""
        if not self.refused or self.dead:
            return ""
        parts = ", ".join(f"[{a:.4g}, {b:.4g}]" for a, b in self.refused)
        return f"no inverse on {parts}: f {'turns back' if self.turns else 'is flat'} there"

    def __call__(self, v: ArrayLike, near: float | None = None) -> Array:
        """Return inputs whose f is v, any shape; v beyond the range of f gets the end.

        Where several inputs give v (on a refused interval), the one nearest to `near` is returned, or to the middle.
        """
        wanted = np.clip(np.asarray(v, dtype=float), self.v_low, self.v_high)
        middle = (self.low + self.high) / 2 if near is None else float(np.clip(near, self.low, self.high))
        if self.dead:
            return np.full(wanted.shape, middle)
        flat = wanted.ravel()
        found = self._nearest(flat, middle) if self.refused else self._table(flat)
        return found.reshape(wanted.shape)

    def quick(self, v: float) -> float:
        """Return one input from the table alone, good to about 1e-6 of the range; for a controller's clock."""
        rising = self.values[-1] >= self.values[0]
        values, points = (self.values, self.points) if rising else (self.values[::-1], self.points[::-1])
        return float(np.interp(v, values, points))

    def strict(self, v: ArrayLike) -> Array:
        """Return the only inputs whose f is v.

        Raises:
            StructureError: a value that f takes on an interval where it has no inverse.
        """
        wanted = np.asarray(v, dtype=float)
        for a, b in self.refused:
            inside = (self.points >= a) & (self.points <= b)
            least, most = self.values[inside].min(), self.values[inside].max()
            slack = FLAT * (self.v_high - self.v_low)
            if np.any((wanted >= least - slack) & (wanted <= most + slack)):
                raise StructureError(
                    f"f has no inverse on [{a:.4g}, {b:.4g}], where it takes the values [{least:.4g}, {most:.4g}]: it "
                    f"{'turns back' if self.turns else 'is flat'} there."
                )
        return self(wanted)

    def _table(self, v: Array) -> Array:
        rising = self.values[-1] >= self.values[0]
        values, points = (self.values, self.points) if rising else (self.values[::-1], self.points[::-1])
        at = np.clip(np.searchsorted(values, v, side="right") - 1, 0, values.size - 2)
        return self._between(v, points[at], points[at + 1], values[at], values[at + 1])

    def _between(self, v: Array, a: Array, b: Array, at_a: Array, at_b: Array) -> Array:
        """False position with halving (Illinois) between two inputs whose values enclose v."""
        left, right = at_a - v, at_b - v
        u = np.where(left == right, a, a - left * (b - a) / np.where(left == right, 1.0, right - left))
        for _ in range(STEPS):
            error = np.asarray(self.f(u)) - v
            if np.all(np.abs(error) <= EXACT * (self.v_high - self.v_low)):
                break
            same = np.sign(error) == np.sign(left)
            right = np.where(same, right / 2, error)  # the end that stays counts half
            left = np.where(same, error, left / 2)
            a, b = np.where(same, u, a), np.where(same, b, u)
            width = right - left
            new = np.where(width == 0, u, a - left * (b - a) / np.where(width == 0, 1.0, width))
            if np.all(np.abs(new - u) <= EXACT * (self.high - self.low)):
                break
            u = new
        return np.clip(u, self.low, self.high)

    def _nearest(self, v: Array, near: float) -> Array:
        found = np.empty(v.size)
        for i, value in enumerate(v):
            error = self.values - value
            slack = FLAT * (self.v_high - self.v_low)
            crossing = np.flatnonzero(error[:-1] * error[1:] <= 0)
            if not crossing.size:
                crossing = np.array([int(np.clip(np.argmin(np.abs(error)), 0, error.size - 2))])
            best = np.clip(near, self.points[crossing], self.points[crossing + 1])
            cell = crossing[int(np.argmin(np.abs(best - near)))]
            a, b = self.points[cell], self.points[cell + 1]
            if abs(error[cell]) <= slack and abs(error[cell + 1]) <= slack:
                found[i] = np.clip(near, a, b)
            else:
                ends = (np.array([part]) for part in (value, a, b, self.values[cell], self.values[cell + 1]))
                found[i] = self._between(*ends)[0]
        return found


def inverse(f: Nonlinearity, low: float, high: float) -> Inverse:
    """Look at a nonlinearity over a range of its input and prepare its inverse.

    Args:
        f: the nonlinearity.
        low: least input.
        high: largest input.

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
    steps = np.diff(values)
    size = float(values.max() - values.min())
    sign = 1.0 if values[-1] >= values[0] else -1.0
    bad = sign * steps <= FLAT * size * np.diff(points) / (high - low)
    turns = bool(np.any(sign * steps < -FLAT * size))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.astype(int), [0]])))
    refused = tuple((float(points[a]), float(points[b])) for a, b in zip(edges[::2], edges[1::2]))
    if turns:  # the values of a part that turns back are those of other parts, too
        low_v, high_v = (
            min(float(values[i : j + 1].min()) for i, j in zip(edges[::2], edges[1::2])),
            max(float(values[i : j + 1].max()) for i, j in zip(edges[::2], edges[1::2])),
        )
        inside = np.flatnonzero((values >= low_v) & (values <= high_v))
        refused = ((float(points[inside[0]]), float(points[inside[-1]])),)
    return Inverse(f, low, high, float(values.min()), float(values.max()), refused, turns, points, values)
