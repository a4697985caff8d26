"""Local bases: hats, piecewise constants and B-splines on equal cells.

The complete family of each sums to one, so one function is dropped: the one nearest u = 0 (nearest the middle when 0 is
outside the interval). The other coefficients are then differences to the dropped one.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optid.arrays import Array
from optid.bases.basis import Basis, Outside, samples, span

COMPILED = 16384
"""Samples from which on loading the compiled loops pays."""


class _Cells(Basis):
    """Functions on p equal cells; the shape matrices compare neighbouring coefficients of the complete family."""

    p: int
    _points: Any  # where the functions sit, one point each

    @property
    def dropped(self) -> int:
        """Index of the function nearest 0, or nearest the middle when 0 is outside the interval."""
        lo, hi = span(self)
        return int(np.argmin(np.abs(self._points - (0.0 if lo <= 0.0 <= hi else (lo + hi) / 2))))

    def increments(self) -> Array:
        """(full_size - 1, P) differences of neighbouring coefficients."""
        return np.diff(self.contrast, axis=0)

    def slope_rows(self) -> Array:
        """(full_size - 1, P) differences over the width of a cell."""
        return self.increments() / self._width

    def curvature(self) -> Array:
        """(full_size - 2, P) changes of the slope rows."""
        return np.diff(self.slope_rows(), axis=0)

    def penalty(self, order: int = 2) -> Array:
        """Integral of (f^(order))^2, exact for hats and order 1; else squared differences over the cell width."""
        if order not in (1, 2):
            return super().penalty(order)
        rows = self.slope_rows() * np.sqrt(self._width) if order == 1 else self.curvature() / np.sqrt(self._width)
        return rows.T @ rows

    @property
    def _width(self) -> float:
        lo, hi = span(self)
        return (hi - lo) / self.p

    @property
    def _edges(self) -> Array:
        return np.linspace(*span(self), self.p + 1)

    def _split(self, u: Array) -> tuple[NDArray[np.int32], Array]:
        """Return the cell (N,) of each finite sample, and its position in cells from the lower end."""
        lo, hi = span(self)
        x = (u - lo) * (self.p / (hi - lo))
        return np.clip(x, 0, self.p - 1).astype(np.int32), x


@dataclass(frozen=True)
class Triangular(_Cells):
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
    shape_exact = True

    @property
    def full_size(self) -> int:
        """Number of nodes, p + 1."""
        return self.p + 1

    @property
    def nodes(self) -> Array:
        """(p + 1,) nodes, in units of the input."""
        return self._edges

    _points = nodes

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Evaluate the two hats of the cell of each sample; compiled for long records."""
        u = samples(u)
        if u.size < COMPILED:
            return super().local(u)
        from optid.bases import kernels

        lo, hi = span(self)
        return kernels.hats(self._clipped(u), lo, self.p / (hi - lo), self.p)

    def _evaluate(self, x: Array) -> tuple[NDArray[np.int32], Array]:
        cell, position = self._split(x)
        weights = np.empty((x.size, 2))
        np.subtract(position, cell, out=weights[:, 1])
        np.subtract(1.0, weights[:, 1], out=weights[:, 0])
        return cell, weights

    def _derivative(self, x: Array, order: int) -> Array:
        return self.slope_rows()[self._split(x)[0]]


@dataclass(frozen=True)
class PiecewiseConstant(_Cells):
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
    shape_exact = True

    @property
    def full_size(self) -> int:
        """Number of cells."""
        return self.p

    @property
    def centres(self) -> Array:
        """(p,) middles of the cells."""
        return (self._edges[:-1] + self._edges[1:]) / 2

    _points = centres

    def _evaluate(self, x: Array) -> tuple[NDArray[np.int32], Array]:
        return self._split(x)[0], np.ones((x.size, 1))

    def _derivative(self, x: Array, order: int) -> Array:
        return np.zeros((x.size, self.size))


@dataclass(frozen=True)
class BSpline(_Cells):
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

    @property
    def shape_exact(self) -> bool:
        """True up to degree 2."""
        return self.degree <= 2

    @property
    def full_size(self) -> int:
        """Number of control points, p + degree."""
        return self.p + self.degree

    @property
    def knots(self) -> Array:
        """(p + 2 degree + 1,) knots, the ends repeated."""
        return np.pad(self._edges, self.degree, mode="edge")

    @property
    def _points(self) -> Array:
        """Greville abscissae of the control points."""
        knots = self.knots
        return np.array([knots[i + 1 : i + self.degree + 1].sum() for i in range(self.full_size)]) / self.degree

    def slope_rows(self) -> Array:
        """(full_size - 1, P) control points of f'; its values lie between their extremes."""
        return self._control_points(1)

    def penalty(self, order: int = 2) -> Array:
        """Integral of (f^(order))^2, exact; for degree 1 and order 2 squared changes of slope over the cell width."""
        return super().penalty(order) if self.degree == 1 and order == 2 else Basis.penalty(self, order)

    def _quadrature(self) -> tuple[Array, int]:
        return self._edges, self.degree

    def _evaluate(self, x: Array) -> tuple[NDArray[np.int32], Array]:
        cell, _ = self._split(x)
        return cell, _not_vanishing(x, cell, self.knots, self.degree)

    def _derivative(self, x: Array, order: int) -> Array:
        lower, degree = self.knots[order : len(self.knots) - order], self.degree - order
        cell, _ = self._split(x)
        weights = _not_vanishing(x, cell, lower, degree)
        control = self._control_points(order)
        return sum((weights[:, [i]] * control[cell + i] for i in range(degree + 1)), np.zeros((x.size, self.size)))

    def _control_points(self, order: int) -> Array:
        """Control points of the derivative of an order as rows that act on mu."""
        rows, knots = self.contrast, self.knots
        for degree in range(self.degree, self.degree - order, -1):
            knots = knots[1:-1]
            rows = np.diff(rows, axis=0) * (degree / (knots[degree:] - knots[:-degree]))[:, None]
        return rows


def _not_vanishing(x: Array, cell: NDArray[np.int32], knots: Array, degree: int) -> Array:
    """Evaluate the degree + 1 B-splines of the cell of each sample by the Cox-de Boor recursion, (N, degree + 1)."""
    values = np.ones((degree + 1, x.size))
    at = cell + degree
    left = [x - knots[at - i] for i in range(degree)]
    right = [knots[at + 1 + i] - x for i in range(degree)]
    for d in range(1, degree + 1):
        saved = np.zeros(x.size)
        for r in range(d):
            part = values[r] / (right[r] + left[d - 1 - r])
            values[r] = saved + right[r] * part
            saved = left[d - 1 - r] * part
        values[d] = saved
    return np.ascontiguousarray(values.T)
