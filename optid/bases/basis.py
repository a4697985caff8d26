"""The base class of every basis of a static nonlinearity: the rules all of them share, and the defaults.

A basis spans f(u) = eta(u)^T mu and never contains the constant function: hats and cosines contain it, and then the
regressor matrix of a model with two or more numerator lags is singular whatever the data. The model carries one offset.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, ClassVar, Literal, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optid.arrays import Array, check_integer, one_of
from optid.errors import DataError, StructureError

Outside = Literal["clamp", "linear", "extrapolate", "error"]
OUTSIDE = ("clamp", "linear", "extrapolate", "error")

MOST = 5000  # functions of a basis; it has matrices of their number squared


class Basis:
    """A family of P functions eta(u) without the constant, on an interval of the input.

    A frozen dataclass that inherits from it has the fields `interval` and `outside`, and supplies `full_size`,
    `_derivative`, `_quadrature` and, where functions vanish, `_evaluate`, and better shape matrices where it has them.

    Attributes:
        interval: (lower, upper) in units of the input; None until `with_interval`.
        outside: what happens beyond the interval: "clamp" (f stays at its end value), "linear" (it goes on straight),
            "extrapolate" (its formula goes on) or "error".
        dropped: index of the function left out of a complete family that sums to one; None when nothing is redundant.
    """

    interval: tuple[float, float] | None
    outside: Outside
    dropped: Any = None
    _sizes: ClassVar[dict[str, tuple[int, str]]] = {}  # integer fields: least value, and what they count

    def __post_init__(self) -> None:
        for name, (smallest, meaning) in self._sizes.items():
            check_integer(getattr(self, name), f"The number of {meaning}", smallest, MOST)
        one_of("outside", self.outside, OUTSIDE)
        if self.interval is None:
            return
        if len(self.interval) != 2 or not np.all(np.isfinite(self.interval)):
            raise StructureError(f"interval={self.interval!r}: give two finite numbers (lower, upper).")
        if self.interval[1] <= self.interval[0]:
            raise StructureError(f"interval={self.interval!r} is empty: the upper end must exceed the lower end.")

    @property
    def full_size(self) -> int:
        """Number of functions of the complete family that `local` evaluates."""
        raise NotImplementedError

    @property
    def size(self) -> int:
        """Number P of functions, the constant excluded."""
        return self.full_size - (self.dropped is not None)

    @property
    def contrast(self) -> Array:
        """(full_size, P) matrix T with values(u) = complete(u) @ T; the identity where nothing is redundant."""
        return self._reduced(np.eye(self.full_size))

    def with_interval(self, lo: float, hi: float) -> Self:
        """Return the same basis on [lo, hi], or itself when it already has an interval.

        Raises:
            DataError: when hi <= lo, as for a constant input.
        """
        if self.interval is not None:
            return self
        if not (np.isfinite(lo) and np.isfinite(hi)):
            raise DataError(f"The range of the input is [{lo}, {hi}]: it needs finite samples.")
        if hi <= lo:
            raise DataError(f"The input is constant at {lo:g}: a nonlinearity cannot be identified from it. Use a "
                            "record in which the input moves, or give the basis its interval.")
        return replace(cast(Any, self), interval=(float(lo), float(hi)))

    def in_units(self, scale: float, offset: float) -> tuple["Basis", Array, Array]:
        """Express the basis in the units v = scale * u + offset.

        Returns:
            (basis in v, matrix M (P, P), constant c (P,)) with eta(u) = eta_v(v) @ M + c, inside and outside.

        Raises:
            StructureError: when scale <= 0.
        """
        if (scale, offset) == (1.0, 0.0):
            return self, np.eye(self.size), np.zeros(self.size)
        if not scale > 0:
            raise StructureError(f"A change of units needs a positive scale; got {scale!r}.")
        lo, hi = span(self)
        new = replace(cast(Any, self), interval=(scale * lo + offset, scale * hi + offset))
        if new.dropped == self.dropped:
            return new, np.eye(self.size), np.zeros(self.size)
        lost = self.contrast[new.dropped]
        return new, np.delete(self.contrast - lost, new.dropped, axis=0), lost

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Evaluate the complete family where it does not vanish.

        Args:
            u: (N,) input; NaN is a missing sample and gets weights 0 at position 0.

        Returns:
            first (N,), weights (N, s): function first[k] + i of the complete family has the value weights[k, i].

        Raises:
            DataError: outside="error" and a sample lies outside the interval.
            StructureError: the basis has no interval yet.
        """
        x, missing = self._inside(samples(u))
        first, weights = self._evaluate(x)
        if self.outside == "linear" and (beyond := self.is_outside(u)).any():
            excess = samples(u)[beyond] - x[beyond]
            slopes = self._derivative(x[beyond], 1)
            if self.dropped is not None:  # the complete family sums to one, its slopes to zero
                slopes = np.insert(slopes, self.dropped, -slopes.sum(axis=1), axis=1)
            columns = first[beyond][:, None] + np.arange(weights.shape[1])
            weights[beyond] += excess[:, None] * np.take_along_axis(slopes, columns, axis=1)
        if missing is not None:
            weights[missing] = 0.0
        return first, weights

    def values(self, u: ArrayLike) -> Array:
        """Evaluate eta, (N, P), at u (N,); rows of missing samples (NaN) are NaN; errors as `local`."""
        u = samples(u)
        complete = spread(*self.local(u), self.full_size)
        if (missing := np.isnan(u)).any():
            complete[missing] = np.nan
        return self._reduced(complete)

    def slopes(self, u: ArrayLike) -> Array:
        """Evaluate d eta / du, (N, P); zero where the value is clamped, the slope to the right at kinks."""
        u = samples(u)
        x, missing = self._inside(u)
        slopes = self._derivative(x, 1)
        if self.outside == "clamp" and self.interval is not None:
            slopes[(u < self.interval[0]) | (u > self.interval[1])] = 0.0
        if missing is not None:
            slopes[missing] = np.nan
        return slopes

    def increments(self) -> Array:
        """(r, P): all rows @ mu >= 0 makes f nondecreasing; here the steps of f between points of `grid`."""
        return np.diff(self.values(self.grid()), axis=0)

    def slope_rows(self) -> Array:
        """(r, P): bounds on all rows @ mu bound the slope of f; here the slopes at the points of `grid`."""
        return self.slopes(self.grid())

    def value_rows(self, first: float, last: float) -> Array:
        """(r, P): bounds on all rows @ mu bound f on [first, last] of the interval; here the points of `grid` there."""
        points = self.grid()
        return self.values(np.unique([first, last, *points[(points > first) & (points < last)]]))

    def curvature(self) -> Array:
        """(r, P): all rows @ mu >= 0 makes f convex; here second differences at the points of `grid`."""
        points = self.grid()
        return np.diff(self.values(points), n=2, axis=0) / (points[1] - points[0]) ** 2

    def penalty(self, order: int = 2) -> Array:
        """(P, P) psd matrix of the integral of (f^(order))^2 over the interval, order 1 or 2.

        Where that derivative does not exist as a function, differences take its place.
        """
        if order not in (1, 2):
            raise StructureError(f"penalty(order={order!r}): the order is 1 (slope) or 2 (curvature).")
        edges, nodes = self._quadrature()
        x, w = np.polynomial.legendre.leggauss(nodes)
        half = np.diff(edges)[:, None] / 2
        rows = self._derivative(((edges[:-1] + edges[1:])[:, None] / 2 + half * x).ravel(), order)
        return rows.T @ ((half * w).ravel()[:, None] * rows)

    def grid(self, n: int = 201) -> Array:
        """(n,) points that cover the interval evenly."""
        return np.linspace(*span(self), n)

    def is_outside(self, u: ArrayLike) -> NDArray[np.bool_]:
        """Mark the samples of u (N,) outside the interval (none when there is no interval).

        A change of units may move an end by a few ulp, which does not count.
        """
        lo, hi = self.interval or (-np.inf, np.inf)
        slack = 1e-12 * max(abs(lo), abs(hi)) if self.interval else 0.0
        u = samples(u)
        return (u < lo - slack) | (u > hi + slack)

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types; `optid.bases.from_dict` is the inverse."""
        given = ((field.name, getattr(self, field.name)) for field in fields(cast(Any, self)))
        return {"type": type(self).__name__.lower(),
                **{name: value.item() if isinstance(value, np.generic) else value for name, value in given}}

    def _evaluate(self, x: Array) -> tuple[NDArray[np.int32], Array]:
        """Evaluate the complete family as `local` does, at finite x to which the rule for outside was applied."""
        return np.zeros(x.size, np.int32), self._derivative(x, 0)

    def _derivative(self, x: Array, order: int) -> Array:
        """Evaluate the derivatives of eta of order 1, 2 (and 0, where no function vanishes) at finite x, (N, P)."""
        raise NotImplementedError

    def _quadrature(self) -> tuple[Array, int]:
        """Ends (c + 1,) of the cells, and Gauss-Legendre points in each, by which `penalty` integrates."""
        raise NotImplementedError

    def _inside(self, u: Array) -> tuple[Array, NDArray[np.bool_] | None]:
        """Apply the rule for outside, put the lower end (or 0) where a sample is missing, and mark those, if any."""
        if self.outside == "error" and (out := self.is_outside(u)).any():
            k, (lo, hi) = int(np.argmax(out)), span(self)
            raise DataError(f"Sample {k} of the input is {u[k]:g}, outside the interval [{lo:g}, {hi:g}] of the basis "
                            f"({int(out.sum())} such samples). Use data inside it, or outside='clamp', "
                            "'linear' or 'extrapolate'.")
        x = u if self.interval is None or self.outside == "extrapolate" else np.clip(u, *self.interval)
        missing = np.isnan(x)
        if not missing.any():
            return x, None
        return np.where(missing, 0.0 if self.interval is None else self.interval[0], x), missing

    def _reduced(self, complete: Array) -> Array:
        """Multiply the complete family by the contrast: remove the column that is redundant."""
        return complete if self.dropped is None else np.delete(complete, self.dropped, axis=1)


def bernstein(function: Callable[[Array], Array], edges: Array, degree: int) -> Array:
    """Return Bernstein coefficients (r, P) of functions that are polynomials of a degree between edges (c + 1,).

    On every part a combination of the functions lies between the smallest and the largest of its coefficients there;
    the smaller the part, the nearer.
    """
    from scipy.special import comb

    if degree < 0 or not edges[0] < edges[-1]:
        return function(edges[[0, -1]])
    j = np.arange(degree + 1)
    x = (1 - np.cos((2 * j + 1) * np.pi / (2 * degree + 2))) / 2
    matrix = comb(degree, j) * x[:, None] ** j * (1 - x[:, None]) ** (degree - j)
    points = edges[:-1, None] + np.diff(edges)[:, None] * x
    values = function(points.ravel())
    found = np.linalg.solve(matrix, values.reshape(len(points), degree + 1, values.shape[1]))
    # continuous functions share a coefficient with their neighbours, the value between them
    return np.vstack([found[0, :1], found[:, 1:].reshape(-1, values.shape[1])]) if degree else found[:, 0]


def spread(first: NDArray[np.int32], weights: Array, size: int) -> Array:
    """Return all values (N, size) of a family from those that do not vanish, as `Basis.local` returns them."""
    if weights.shape[1] == size:
        return weights
    values = np.zeros((len(weights), size))
    np.put_along_axis(values, first[:, None] + np.arange(weights.shape[1]), weights, axis=1)
    return values


def samples(u: ArrayLike) -> Array:
    """Return u as (N,) float64, or refuse its shape."""
    array = np.asarray(u, dtype=float)
    if array.ndim != 1:
        raise DataError(f"A basis is evaluated on one channel, an array (N,); got shape {array.shape}.")
    return array


def span(basis: Basis) -> tuple[float, float]:
    """Return the interval of a basis, or refuse when it has none yet."""
    if basis.interval is None:
        raise StructureError(f"{type(basis).__name__} has no interval yet: use .with_interval(lower, upper) or give "
                             "interval=(lower, upper).")
    return basis.interval
