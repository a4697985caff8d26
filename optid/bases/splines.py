"""Local bases: B-splines on equal cells, of degree 0 (piecewise constants), 1 (hats) and above.

The complete family of each sums to one, so one function is dropped: the one nearest u = 0 (nearest the middle when 0 is
outside the interval). The other coefficients are then differences to the dropped one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases.basis import Basis, Outside, bernstein, span

PARTS = 8  # of every cell, by which the values of a spline of degree 2 or more are bounded


class _Splines(Basis):
    """Splines on p equal cells; the shape matrices compare neighbouring control points of the complete family."""

    p: int
    degree: Any

    @property
    def full_size(self) -> int:
        """Number of control points, p + degree: cells, nodes, or more."""
        return self.p + self.degree

    @cached_property
    def knots(self) -> Array:
        """(p + 2 degree + 1,) ends of the cells, those of the interval repeated."""
        return np.pad(np.linspace(*span(self), self.p + 1), self.degree, mode="edge")

    @property
    def _points(self) -> Array:
        """Where the functions sit, one point each: the Greville abscissae of the control points."""
        return np.lib.stride_tricks.sliding_window_view(self.knots[1:-1], self.degree).mean(axis=1)

    @cached_property
    def dropped(self) -> int:
        """Index of the function nearest 0, or nearest the middle when 0 is outside the interval."""
        lo, hi = span(self)
        return int(np.argmin(np.abs(self._points - (0.0 if lo <= 0.0 <= hi else (lo + hi) / 2))))

    def increments(self) -> Array:
        """(full_size - 1, P) differences of neighbouring coefficients."""
        return np.diff(self.contrast, axis=0)

    def slope_rows(self) -> Array:
        """(full_size - 1, P) control points of f', whose values lie between them; of steps, differences per cell."""
        return self._control_points(1) if self.degree else self.increments() / self._width

    def curvature(self) -> Array:
        """(full_size - 2, P) changes of the slope rows."""
        return np.diff(self.slope_rows(), axis=0)

    def value_rows(self, first: float, last: float) -> Array:
        """Values in the cells that [first, last] meets, or Bernstein coefficients of parts of them."""
        inner = np.unique(self.knots)
        if not self.degree:
            centres = (inner[:-1] + inner[1:]) / 2
            return self.values(centres[(inner[1:] > first) & (inner[:-1] <= last)])
        parts = 1 if self.degree == 1 else PARTS
        inner = np.interp(np.arange(parts * (len(inner) - 1) + 1) / parts, np.arange(len(inner)), inner)
        return bernstein(self.values, np.unique([first, *inner[(inner > first) & (inner < last)], last]), self.degree)

    def penalty(self, order: int = 2) -> Array:
        """Integral of (f^(order))^2, exact up to the degree; beyond it squared differences over the cell width."""
        if order not in (1, 2) or order <= self.degree:
            return super().penalty(order)
        rows = self.slope_rows() * np.sqrt(self._width) if order == 1 else self.curvature() / np.sqrt(self._width)
        return rows.T @ rows

    @property
    def _width(self) -> float:
        lo, hi = span(self)
        return (hi - lo) / self.p

    def _split(self, u: Array) -> tuple[NDArray[np.int32], Array]:
        """Return the cell (N,) of each finite sample, and its position in cells from the lower end."""
        lo, hi = span(self)
        x = (u - lo) * (self.p / (hi - lo))
        return np.clip(x, 0, self.p - 1).astype(np.int32), x

    def _quadrature(self) -> tuple[Array, int]:
        return np.linspace(*span(self), self.p + 1), self.degree

    def _evaluate(self, x: Array) -> tuple[NDArray[np.int32], Array]:
        if self.degree > 1:
            return _not_vanishing(x, self.knots, self.degree)
        cell, position = self._split(x)
        if self.degree == 0:
            return cell, np.ones((x.size, 1))
        weights = np.empty((x.size, 2))
        np.subtract(position, cell, out=weights[:, 1])
        np.subtract(1.0, weights[:, 1], out=weights[:, 0])
        return cell, weights

    def _derivative(self, x: Array, order: int) -> Array:
        if order > self.degree:
            return np.zeros((x.size, self.size))
        control, degree = self._control_points(order), self.degree - order
        if degree == 0:
            return control[self._split(x)[0]]
        first, weights = _not_vanishing(x, self.knots[order : len(self.knots) - order], degree)
        return sum((weights[:, [i]] * control[first + i] for i in range(degree + 1)), np.zeros((x.size, self.size)))

    def _control_points(self, order: int) -> Array:
        """Control points of the derivative of an order as rows that act on mu."""
        rows, knots = self.contrast, self.knots
        for degree in range(self.degree, self.degree - order, -1):
            knots = knots[1:-1]
            rows = np.diff(rows, axis=0) * (degree / (knots[degree:] - knots[:-degree]))[:, None]
        return rows


@dataclass(frozen=True)
class Triangular(_Splines):
    """Hats on p equal cells: f is piecewise linear and mu_j = f(u_j) - f(u_ref) at the p other nodes (thesis eq. 3.14).

    u_ref is the node nearest 0, or nearest the middle when 0 is outside the interval. Extrapolation continues the end
    slopes.

    Attributes:
        p: number of cells, >= 1; the basis has P = p functions (p + 1 nodes less the reference).
    """

    p: int
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"
    _sizes = {"p": (1, "cells")}
    degree = 1

    @property
    def nodes(self) -> Array:
        """(p + 1,) nodes, in units of the input."""
        return np.linspace(*span(self), self.p + 1)


@dataclass(frozen=True)
class PiecewiseConstant(_Splines):
    """Steps on p equal cells: f has one level a cell, mu the levels less that of the reference cell.

    The last cell contains its right end. `slopes` is zero; the shape matrices and the penalty compare levels between
    the middles of neighbouring cells. Extrapolation keeps the end level.

    Attributes:
        p: number of cells, >= 2; the basis has P = p - 1 functions.
    """

    p: int
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"
    _sizes = {"p": (2, "cells")}
    degree = 0

    @property
    def centres(self) -> Array:
        """(p,) middles of the cells."""
        return (self.knots[:-1] + self.knots[1:]) / 2

    _points = centres


@dataclass(frozen=True)
class BSpline(_Splines):
    """B-splines of a degree on p equal cells with repeated end knots; extrapolation continues the end polynomials.

    The rows of `increments`, `curvature` and `slope_rows` act on control points: sufficient for every degree, and also
    necessary up to degree 2 (de Boor, A Practical Guide to Splines, chapter 11).

    Attributes:
        p: number of cells, >= 1; the basis has P = p + degree - 1 functions.
        degree: polynomial degree of the pieces, >= 1.
    """

    p: int
    degree: int = 3
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"
    _sizes = {"p": (1, "cells"), "degree": (1, "degrees of a B-spline")}


def _not_vanishing(x: Array, knots: Array, degree: int) -> tuple[NDArray[np.int32], Array]:
    """Return the first B-spline that does not vanish at each sample (N,), and the values from it on (N, degree + 1)."""
    from scipy.interpolate import BSpline as Pieces

    matrix = Pieces.design_matrix(x, knots, degree, extrapolate=True)
    values = np.asarray(matrix.data, dtype=float).reshape(-1, degree + 1)
    return matrix.indices[:: degree + 1].astype(np.int32), values
