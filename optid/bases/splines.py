"""Local bases: hats, piecewise constants and B-splines on equal cells.

The complete family of each sums to one, so one function is dropped: the one nearest u = 0 (nearest the middle when 0 is
outside the interval). The other coefficients are then differences to the dropped one.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optid.arrays import Array
from optid.bases.basis import (
    Basis,
    Outside,
    brought_inside,
    check_count,
    check_interval,
    check_order,
    frozen_outside,
    integral_of_squares,
    samples,
    span,
)

COMPILED = 16384
"""Samples from which on loading the compiled loops pays."""


def _nearest_reference(points: Array, interval: tuple[float, float]) -> int:
    """Index of the point nearest 0, or nearest the middle when 0 is outside the interval."""
    lo, hi = interval
    return int(np.argmin(np.abs(points - (0.0 if lo <= 0.0 <= hi else (lo + hi) / 2))))


def _split_cells(u: ArrayLike, interval: tuple[float, float], p: int, outside: Outside) -> tuple[Any, Array, Any]:
    """Return the cell (N,) int32 of each sample, its position in cells from the lower end, the missing mask or None."""
    u = samples(u)
    lo, hi = interval
    x = brought_inside(u, interval, outside) - lo
    x *= p / (hi - lo)
    missing = np.isnan(x)
    if missing.any():
        x[missing] = 0.0
    else:
        missing = None
    return np.clip(x, 0, p - 1).astype(np.int32), x, missing


@dataclass(frozen=True)
class Triangular(Basis):
    """Hats on p equal cells: f is piecewise linear and mu_j = f(u_j) - f(u_ref) at the p other nodes (thesis eq. 3.14).

    u_ref is the node nearest 0, or nearest the middle when 0 is outside the interval. Extrapolation continues the end
    slopes.

    Attributes:
        p: number of cells, >= 1; the basis has P = p functions (p + 1 nodes less the reference).
    """

    p: int
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"

    def __post_init__(self) -> None:
        check_count(self.p, 1, "cells")
        check_interval(self.interval, self.outside)

    @property
    def shape_exact(self) -> bool:
        """True."""
        return True

    @property
    def full_size(self) -> int:
        """Number of nodes, p + 1."""
        return self.p + 1

    @property
    def nodes(self) -> Array:
        """(p + 1,) nodes, in units of the input."""
        return np.linspace(*span(self), self.p + 1)

    @property
    def dropped(self) -> int:
        """Index of the reference node."""
        return _nearest_reference(self.nodes, span(self))

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Evaluate the two hats of the cell of each sample."""
        u = samples(u)
        if u.size >= COMPILED:
            from optid.statistics import kernels

            lo, hi = span(self)
            return kernels.hats(brought_inside(u, (lo, hi), self.outside), lo, self.p / (hi - lo), self.p)
        cell, x, missing = _split_cells(u, span(self), self.p, self.outside)
        weights = np.empty((x.size, 2))
        np.subtract(x, cell, out=weights[:, 1])
        np.subtract(1.0, weights[:, 1], out=weights[:, 0])
        if missing is not None:
            weights[missing] = 0.0
        return cell, weights

    def slopes(self, u: ArrayLike) -> Array:
        """Slopes of the hats, (N, P): constant in a cell, to the right at a node."""
        u = samples(u)
        cell, _, _ = _split_cells(u, span(self), self.p, self.outside)
        return frozen_outside(self.slope_rows()[cell], u, span(self), self.outside)

    def increments(self) -> Array:
        """(p, P) differences of f between neighbouring nodes."""
        return np.diff(self.contrast, axis=0)

    def slope_rows(self) -> Array:
        """(p, P) slopes of f on the cells."""
        return self.increments() / self._cell

    def curvature(self) -> Array:
        """(p - 1, P) changes of slope at the inner nodes."""
        return np.diff(self.slope_rows(), axis=0)

    def penalty(self, order: int = 2) -> Array:
        """Integral of f'^2, exact; for order 2 the squared changes of slope over the cell width."""
        check_order(order)
        rows = self.slope_rows() * np.sqrt(self._cell) if order == 1 else self.curvature() / np.sqrt(self._cell)
        return rows.T @ rows

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types."""
        return {"type": "triangular", "p": int(self.p), "interval": self.interval, "outside": self.outside}

    @property
    def _cell(self) -> float:
        lo, hi = span(self)
        return (hi - lo) / self.p


@dataclass(frozen=True)
class PiecewiseConstant(Basis):
    """Steps on p equal cells: f has one level a cell, mu the levels less that of the reference cell.

    The last cell contains its right end. `slopes` is zero; the shape matrices compare neighbouring levels.
    Extrapolation keeps the end level.

    Attributes:
        p: number of cells, >= 2; the basis has P = p - 1 functions.
    """

    p: int
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"

    def __post_init__(self) -> None:
        check_count(self.p, 2, "cells")
        check_interval(self.interval, self.outside)

    @property
    def shape_exact(self) -> bool:
        """True."""
        return True

    @property
    def full_size(self) -> int:
        """Number of cells."""
        return self.p

    @property
    def centres(self) -> Array:
        """(p,) middles of the cells."""
        edges = np.linspace(*span(self), self.p + 1)
        return (edges[:-1] + edges[1:]) / 2

    @property
    def dropped(self) -> int:
        """Index of the reference cell."""
        return _nearest_reference(self.centres, span(self))

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Find the one cell of each sample."""
        cell, x, missing = _split_cells(u, span(self), self.p, self.outside)
        weights = np.ones((x.size, 1))
        if missing is not None:
            weights[missing] = 0.0
        return cell, weights

    def slopes(self, u: ArrayLike) -> Array:
        """Zero, (N, P)."""
        u = samples(u)
        brought_inside(u, span(self), self.outside)
        return frozen_outside(np.zeros((u.size, self.size)), u, span(self), self.outside)

    def increments(self) -> Array:
        """(p - 1, P) steps between neighbouring cells."""
        return np.diff(self.contrast, axis=0)

    def slope_rows(self) -> Array:
        """(p - 1, P) slopes between the middles of neighbouring cells."""
        return self.increments() / self._cell

    def curvature(self) -> Array:
        """(p - 2, P) changes of slope between the middles of the cells."""
        return np.diff(self.slope_rows(), axis=0)

    def penalty(self, order: int = 2) -> Array:
        """Difference analogue of the integral of (f^(order))^2, from the middles of the cells."""
        check_order(order)
        rows = self.slope_rows() * np.sqrt(self._cell) if order == 1 else self.curvature() / np.sqrt(self._cell)
        return rows.T @ rows

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types."""
        return {"type": "piecewiseconstant", "p": int(self.p), "interval": self.interval, "outside": self.outside}

    @property
    def _cell(self) -> float:
        lo, hi = span(self)
        return (hi - lo) / self.p


@dataclass(frozen=True)
class BSpline(Basis):
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

    def __post_init__(self) -> None:
        check_count(self.p, 1, "cells")
        check_count(self.degree, 1, "degrees of a B-spline")
        check_interval(self.interval, self.outside)

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
        lo, hi = span(self)
        return np.concatenate([np.full(self.degree, lo), np.linspace(lo, hi, self.p + 1), np.full(self.degree, hi)])

    @property
    def dropped(self) -> int:
        """Index of the control point whose Greville abscissa is nearest the reference."""
        greville = np.array([self.knots[i + 1 : i + self.degree + 1].mean() for i in range(self.full_size)])
        return _nearest_reference(greville, span(self))

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Evaluate the degree + 1 splines that do not vanish in the cell of each sample."""
        cell, _, missing = _split_cells(u, span(self), self.p, self.outside)
        x = brought_inside(samples(u), span(self), self.outside)
        weights = _not_vanishing(np.where(np.isnan(x), span(self)[0], x), cell, self.knots, self.degree)
        if missing is not None:
            weights[missing] = 0.0
        return cell, weights

    def slopes(self, u: ArrayLike) -> Array:
        """Slopes of the splines, (N, P)."""
        u = samples(u)
        x = brought_inside(u, span(self), self.outside)
        x = np.where(np.isnan(x), span(self)[0], x)
        return frozen_outside(self._derivative(x, 1), u, span(self), self.outside)

    def increments(self) -> Array:
        """(full_size - 1, P) differences of neighbouring control points."""
        return np.diff(self.contrast, axis=0)

    def slope_rows(self) -> Array:
        """(full_size - 1, P) control points of f'; its values lie between their extremes."""
        return self._control_points(1)

    def curvature(self) -> Array:
        """(full_size - 2, P) changes of the control points of f'."""
        return np.diff(self.slope_rows(), axis=0)

    def penalty(self, order: int = 2) -> Array:
        """Integral of (f^(order))^2, exact; for degree 1 and order 2 squared changes of slope over the cell width."""
        check_order(order)
        edges = np.linspace(*span(self), self.p + 1)
        if order > self.degree:
            rows = self.curvature() / np.sqrt(edges[1] - edges[0])
            return rows.T @ rows
        return integral_of_squares(lambda points: self._derivative(points, order), edges, self.degree)

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types."""
        return {
            "type": "bspline",
            "p": int(self.p),
            "degree": int(self.degree),
            "interval": self.interval,
            "outside": self.outside,
        }

    def _control_points(self, order: int) -> Array:
        """Control points of the derivative of an order as rows that act on mu."""
        rows, knots = self.contrast, self.knots
        for degree in range(self.degree, self.degree - order, -1):
            inner = knots[1:-1]
            widths = inner[degree:] - inner[:-degree]
            rows, knots = np.diff(rows, axis=0) * (degree / widths)[:, None], inner
        return rows

    def _derivative(self, points: Array, order: int) -> Array:
        lower, degree = self.knots[order : len(self.knots) - order], self.degree - order
        cell, _, _ = _split_cells(points, span(self), self.p, "extrapolate")
        weights = _not_vanishing(points, cell, lower, degree)
        control = self._control_points(order)
        return sum((weights[:, [i]] * control[cell + i] for i in range(degree + 1)), np.zeros((points.size, self.size)))


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
