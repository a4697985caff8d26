"""Bases whose functions vanish nowhere in particular: polynomials, sines and cosines, the user's own, the identity.

Their shape matrices act on values at the points of `grid`: f is monotone, convex or bounded in slope at those points.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

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
from optid.errors import StructureError

Function = Callable[[Array], ArrayLike]


def _dense_local(basis: Basis, u: ArrayLike, evaluate: Function) -> tuple[NDArray[np.int32], Array]:
    """Evaluate all functions at the samples brought inside, with zero rows for missing samples."""
    u = samples(u)
    x = u if basis.interval is None else brought_inside(u, basis.interval, basis.outside)
    missing = np.isnan(x)
    weights = np.array(evaluate(np.where(missing, 0.0, x)), dtype=float)
    weights[missing] = 0.0
    return np.zeros(u.size, np.int32), weights


def _dense_slopes(basis: Basis, u: ArrayLike, evaluate: Function) -> Array:
    """Evaluate all slopes with the rule for samples outside the interval."""
    u = samples(u)
    if basis.interval is None:
        slopes = np.array(evaluate(u), dtype=float)
        slopes[np.isnan(u)] = np.nan
        return slopes
    x = brought_inside(u, basis.interval, basis.outside)
    return frozen_outside(np.array(evaluate(x), dtype=float), u, basis.interval, basis.outside)


def _polynomial_derivative(u: Array, interval: tuple[float, float], degree: int, order: int) -> Array:
    """Derivatives of the Legendre polynomials 1..degree mapped to the interval, (N, degree)."""
    from numpy.polynomial import legendre

    lo, hi = interval
    coefficients = np.eye(degree + 1)[:, 1:]
    if order:
        coefficients = legendre.legder(coefficients, order, scl=2 / (hi - lo))
    return np.asarray(legendre.legval((2 * u - lo - hi) / (hi - lo), coefficients).T, dtype=float)


@dataclass(frozen=True)
class Polynomial(Basis):
    """Legendre polynomials of degrees 1..p on the interval mapped to [-1, 1]; extrapolation continues them.

    Attributes:
        p: highest degree, >= 1; the basis has P = p functions.
    """

    p: int
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"

    def __post_init__(self) -> None:
        check_count(self.p, 1, "degrees of a polynomial")
        check_interval(self.interval, self.outside)

    @property
    def full_size(self) -> int:
        """Number of functions, p."""
        return self.p

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Evaluate all polynomials."""
        return _dense_local(self, u, lambda x: _polynomial_derivative(x, span(self), self.p, 0))

    def slopes(self, u: ArrayLike) -> Array:
        """Slopes of the polynomials, (N, P)."""
        return _dense_slopes(self, u, lambda x: _polynomial_derivative(x, span(self), self.p, 1))

    def penalty(self, order: int = 2) -> Array:
        """Integral of (f^(order))^2, exact."""
        check_order(order)
        return integral_of_squares(
            lambda x: _polynomial_derivative(x, span(self), self.p, order), np.array(span(self)), self.p
        )

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types."""
        return {"type": "polynomial", "p": int(self.p), "interval": self.interval, "outside": self.outside}


@dataclass(frozen=True)
class Trigonometric(Basis):
    """Columns cos(pi j v), sin(pi j v), j = 1..p, v = (u - middle) / (half_range * half width) (thesis eq. 3.19).

    A half_range above 1 makes the period longer than the interval: with 1 the two ends of f meet, and an odd f rings
    there. Above about 1.5 the functions become nearly dependent. The cosines are not zero-mean over the interval; the
    offset of the model takes up the difference.

    Attributes:
        p: highest harmonic, >= 1; the basis has P = 2 p functions (cos 1, sin 1, cos 2, ...).
        half_range: half period over half width of the interval, >= 1.
    """

    p: int
    half_range: float = 1.25
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"

    def __post_init__(self) -> None:
        check_count(self.p, 1, "harmonics")
        check_interval(self.interval, self.outside)
        if not (np.isfinite(self.half_range) and self.half_range >= 1):
            raise StructureError(f"half_range={self.half_range!r}: a finite factor >= 1, usually 1.25.")

    @property
    def full_size(self) -> int:
        """Number of functions, 2 p."""
        return 2 * self.p

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Evaluate all sines and cosines."""
        return _dense_local(self, u, lambda x: self._derivative(x, 0))

    def slopes(self, u: ArrayLike) -> Array:
        """Slopes of the sines and cosines, (N, P)."""
        return _dense_slopes(self, u, lambda x: self._derivative(x, 1))

    def penalty(self, order: int = 2) -> Array:
        """Integral of (f^(order))^2 over the interval, by quadrature to rounding."""
        check_order(order)
        edges = np.linspace(*span(self), self.p + 1)
        return integral_of_squares(lambda x: self._derivative(x, order), edges, 20)

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types."""
        return {
            "type": "trigonometric",
            "p": int(self.p),
            "half_range": float(self.half_range),
            "interval": self.interval,
            "outside": self.outside,
        }

    def _derivative(self, u: Array, order: int) -> Array:
        lo, hi = span(self)
        rate = np.pi / (self.half_range * (hi - lo) / 2)
        # powers of exp(i v) hold cosine and sine side by side, as the columns want them
        turn = np.exp(1j * rate * (u - (lo + hi) / 2))
        powers = np.empty((u.size, self.p), dtype=complex)
        powers[:, 0] = turn
        for j in range(1, self.p):
            np.multiply(powers[:, j - 1], turn, out=powers[:, j])
        if order:
            powers *= (1j * rate * np.arange(1, self.p + 1)) ** order
        return powers.view(float)


@dataclass(frozen=True)
class Linear(Basis):
    """The identity, eta(u) = u: turns a Hammerstein model into a linear one. It needs no interval and extrapolates."""

    interval: tuple[float, float] | None = None
    outside: Outside = "extrapolate"

    def __post_init__(self) -> None:
        check_interval(self.interval, self.outside)

    @property
    def full_size(self) -> int:
        """One function."""
        return 1

    @property
    def shape_exact(self) -> bool:
        """True."""
        return True

    def mapped(self, scale: float, offset: float) -> tuple[Basis, Array, Array]:
        """Express u as (v - offset) / scale."""
        new = self if self.interval is None else super().mapped(scale, offset)[0]
        return new, np.array([[1 / scale]]), np.array([-offset / scale])

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Return u itself."""
        return _dense_local(self, u, lambda x: x[:, None])

    def slopes(self, u: ArrayLike) -> Array:
        """One, (N, 1)."""
        return _dense_slopes(self, u, lambda x: np.ones((x.size, 1)))

    def increments(self) -> Array:
        """The slope, (1, 1)."""
        return np.ones((1, 1))

    def slope_rows(self) -> Array:
        """The slope, (1, 1)."""
        return np.ones((1, 1))

    def curvature(self) -> Array:
        """No rows, (0, 1): a line is convex and concave."""
        return np.zeros((0, 1))

    def penalty(self, order: int = 2) -> Array:
        """Width of the interval for order 1, zero for order 2."""
        check_order(order)
        return np.array([[span(self)[1] - span(self)[0] if order == 1 else 0.0]])

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types."""
        return {"type": "linear", "interval": self.interval, "outside": self.outside}


@dataclass(frozen=True)
class UserFunctions(Basis):
    """Functions given by the user, each vectorised over an array (N,) and none of them constant.

    A file stores their names only; loading it asks for the functions again.

    Attributes:
        functions: P callables.
        names: P names.
        slopes_of: P callables for the derivatives; None takes central differences (relative accuracy about 1e-9).
    """

    functions: tuple[Function, ...]
    names: tuple[str, ...] = ()
    slopes_of: tuple[Function, ...] | None = None
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"

    def __post_init__(self) -> None:
        check_interval(self.interval, self.outside)
        object.__setattr__(self, "functions", tuple(self.functions))
        if not self.functions or not all(callable(function) for function in self.functions):
            raise StructureError("UserFunctions needs a non-empty tuple of callables.")
        names = tuple(self.names) or tuple(
            getattr(function, "__name__", f"f{i}") for i, function in enumerate(self.functions, 1)
        )
        if len(names) != len(self.functions):
            raise StructureError(f"{len(self.functions)} functions but {len(names)} names: give one name each.")
        object.__setattr__(self, "names", names)
        if self.slopes_of is not None:
            object.__setattr__(self, "slopes_of", tuple(self.slopes_of))
            if len(self.slopes_of) != len(self.functions):
                raise StructureError(
                    f"{len(self.functions)} functions but {len(self.slopes_of)} slopes: give one each."
                )
        if self.interval is not None:
            self._refuse_constant()

    @property
    def full_size(self) -> int:
        """Number of functions."""
        return len(self.functions)

    def mapped(self, scale: float, offset: float) -> tuple[Basis, Array, Array]:
        """Refuse: functions of one unit are not known in another."""
        if (scale, offset) == (1.0, 0.0):
            return self, np.eye(self.size), np.zeros(self.size)
        raise StructureError(
            "A model with UserFunctions keeps the units it was identified in: identify it on data that are neither "
            "scaled nor detrended."
        )

    def local(self, u: ArrayLike) -> tuple[NDArray[np.int32], Array]:
        """Evaluate all functions."""
        return _dense_local(self, u, lambda x: self._columns(self.functions, x))

    def slopes(self, u: ArrayLike) -> Array:
        """Slopes, (N, P): the user's, or central differences."""
        return _dense_slopes(self, u, self._derivative)

    def penalty(self, order: int = 2) -> Array:
        """Integral of f'^2 by quadrature; of f''^2 by second differences on the grid."""
        check_order(order)
        if order == 1:
            return integral_of_squares(self._derivative, self.grid(), 4)
        step = self.grid()[1] - self.grid()[0]
        rows = self.curvature() * np.sqrt(step)
        return rows.T @ rows

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types: the functions by name only."""
        return {
            "type": "userfunctions",
            "names": list(self.names),
            "interval": self.interval,
            "outside": self.outside,
        }

    def _columns(self, functions: tuple[Function, ...], x: Array) -> Array:
        columns = np.empty((x.size, len(functions)))
        for j, function in enumerate(functions):
            column = np.asarray(function(x), dtype=float)
            if column.shape != x.shape:
                raise StructureError(
                    f"Function {self.names[j]!r} maps shape {x.shape} to {column.shape}: it must be vectorised."
                )
            columns[:, j] = column
        return columns

    def _derivative(self, x: Array) -> Array:
        if self.slopes_of is not None:
            return self._columns(self.slopes_of, x)
        width = 1.0 if self.interval is None else self.interval[1] - self.interval[0]
        step = 1e-5 * width
        return (self._columns(self.functions, x + step) - self._columns(self.functions, x - step)) / (2 * step)

    def _refuse_constant(self) -> None:
        grid = np.linspace(*cast(tuple[float, float], self.interval), 201)
        columns = self._columns(self.functions, grid)
        for name, column in zip(self.names, columns.T, strict=True):
            if not np.all(np.isfinite(column)):
                raise StructureError(f"Function {name!r} is not finite at u = {grid[~np.isfinite(column)][0]:g}.")
            if np.ptp(column) <= 1e-12 * np.max(np.abs(column)):
                raise StructureError(
                    f"Function {name!r} is constant on the interval: leave it out, the model has an offset."
                )
        rest = 1 - columns @ np.linalg.lstsq(columns, np.ones(grid.size))[0]
        if np.max(np.abs(rest)) < 1e-9:
            raise StructureError(
                f"Functions {', '.join(self.names)} contain the constant: drop one of them, the model has an offset."
            )


def restore(names: list[str], known: dict[str, Any]) -> tuple[tuple[Function, ...], tuple[Function, ...] | None]:
    """Find stored functions by name.

    Args:
        names: names read from a file.
        known: what the user supplies: {name: function} or {name: (function, slope)}.

    Raises:
        StructureError: when a name is not supplied.
    """
    missing = [name for name in names if name not in known]
    if missing:
        raise StructureError(
            f"The model uses functions that a file does not hold: {', '.join(map(repr, missing))}. "
            "Supply them: load(path, functions={" + ", ".join(f"{name!r}: ..." for name in missing) + "})."
        )
    pairs = [known[name] if isinstance(known[name], tuple) else (known[name], None) for name in names]
    slopes = tuple(slope for _, slope in pairs)
    return tuple(function for function, _ in pairs), None if None in slopes else cast(Any, slopes)
