"""Bases whose functions vanish nowhere in particular: polynomials, sines and cosines, the user's own, the identity.

The shape matrices of polynomials act on Bernstein coefficients, between the smallest and the largest of which a
polynomial lies (Farouki 2012): what they ask for holds on the whole interval. Those of sines, cosines and the user's
own functions act on values at the points of `grid`: f is monotone, convex or bounded in slope at those points.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases.basis import Basis, Outside, bernstein, span
from optid.errors import StructureError

Function = Callable[[Array], ArrayLike]
PIECES = 40  # of an interval, on each of which a polynomial lies between its Bernstein coefficients


@dataclass(frozen=True)
class Polynomial(Basis):
    """Legendre polynomials of degrees 1..p on the interval mapped to [-1, 1]; extrapolation continues them.

    Attributes:
        p: highest degree, >= 1; the basis has P = p functions.
    """

    p: int
    interval: tuple[float, float] | None = None
    outside: Outside = "clamp"
    _sizes = {"p": (1, "degrees of a polynomial")}

    @property
    def full_size(self) -> int:
        """Number of functions, p."""
        return self.p

    def increments(self) -> Array:
        """Bernstein coefficients of the slope on `PIECES` parts of the interval."""
        return self._bernstein(1)

    slope_rows = increments

    def curvature(self) -> Array:
        """Bernstein coefficients of the second derivative on `PIECES` parts of the interval."""
        return self._bernstein(2)

    def value_rows(self, first: float, last: float) -> Array:
        """Bernstein coefficients of the functions on `PIECES` parts of [first, last]."""
        return self._bernstein(0, first, last)

    def _bernstein(self, order: int, first: float | None = None, last: float | None = None) -> Array:
        lo, hi = span(self)
        edges = np.linspace(lo if first is None else first, hi if last is None else last, PIECES + 1)
        return bernstein(lambda x: self._derivative(x, order), edges, self.p - order)

    def _quadrature(self) -> tuple[Array, int]:
        return np.array(span(self)), self.p  # exact

    def _derivative(self, x: Array, order: int) -> Array:
        from numpy.polynomial import legendre

        lo, hi = span(self)
        coefficients = np.eye(self.p + 1)[:, 1:]
        if order:
            coefficients = legendre.legder(coefficients, order, scl=2 / (hi - lo))
        return np.array(legendre.legval((2 * x - lo - hi) / (hi - lo), coefficients).T, dtype=float, order="C")


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
    _sizes = {"p": (1, "harmonics")}

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (np.isfinite(self.half_range) and self.half_range >= 1):
            raise StructureError(f"half_range={self.half_range!r}: a finite factor >= 1, usually 1.25.")

    @property
    def full_size(self) -> int:
        """Number of functions, 2 p."""
        return 2 * self.p

    def _quadrature(self) -> tuple[Array, int]:
        return np.linspace(*span(self), self.p + 1), 20  # exact to rounding

    def _derivative(self, x: Array, order: int) -> Array:
        lo, hi = span(self)
        rate = np.pi / (self.half_range * (hi - lo) / 2)
        # powers of exp(i v) hold cosine and sine side by side, as the columns want them
        turn = np.exp(1j * rate * (x - (lo + hi) / 2))
        powers = np.empty((x.size, self.p), dtype=complex)
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

    @property
    def full_size(self) -> int:
        """One function."""
        return 1

    def in_units(self, scale: float, offset: float) -> tuple[Basis, Array, Array]:
        """Express u as (v - offset) / scale."""
        new = self if self.interval is None else super().in_units(scale, offset)[0]
        return new, np.array([[1 / scale]]), np.array([-offset / scale])

    def increments(self) -> Array:
        """The slope, (1, 1)."""
        return np.ones((1, 1))

    slope_rows = increments

    def curvature(self) -> Array:
        """No rows, (0, 1): a line is convex and concave."""
        return np.zeros((0, 1))

    def _quadrature(self) -> tuple[Array, int]:
        return np.array(span(self)), 1

    def _derivative(self, x: Array, order: int) -> Array:
        return np.array(x)[:, None] if order == 0 else np.full((x.size, 1), float(order == 1))


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
        super().__post_init__()
        functions = tuple(self.functions)
        if not functions or not all(callable(function) for function in functions):
            raise StructureError("UserFunctions needs a non-empty tuple of callables.")
        names = tuple(self.names) or tuple(
            getattr(function, "__name__", f"f{i}") for i, function in enumerate(functions, 1)
        )
        slopes = None if self.slopes_of is None else tuple(self.slopes_of)
        for given, what, noun in ((names, "names", "name"), (slopes, "slopes", "slope")):
            if given is not None and len(given) != len(functions):
                raise StructureError(f"{len(functions)} functions but {len(given)} {what}: give one {noun} each.")
        for name, given in (("functions", functions), ("names", names), ("slopes_of", slopes)):
            object.__setattr__(self, name, given)
        if self.interval is not None:
            self._refuse_constant()

    @property
    def full_size(self) -> int:
        """Number of functions."""
        return len(self.functions)

    def in_units(self, scale: float, offset: float) -> tuple[Basis, Array, Array]:
        """Refuse: functions of one unit are not known in another."""
        if (scale, offset) == (1.0, 0.0):
            return super().in_units(scale, offset)
        raise StructureError("A model with UserFunctions keeps the units it was identified in: identify it on data "
                             "that are neither scaled nor detrended.")

    def penalty(self, order: int = 2) -> Array:
        """Integral of f'^2 by quadrature; of f''^2 by second differences on the grid."""
        if order != 2:
            return super().penalty(order)
        rows = self.curvature() * np.sqrt(self.grid()[1] - self.grid()[0])
        return rows.T @ rows

    def to_dict(self) -> dict[str, Any]:
        """Describe the basis in JSON types: the functions by name only."""
        return {"type": "userfunctions", "names": list(self.names), "interval": self.interval, "outside": self.outside}

    def _quadrature(self) -> tuple[Array, int]:
        return self.grid(), 4

    def _derivative(self, x: Array, order: int) -> Array:
        if order == 0:
            return self._columns(self.functions, x)
        if self.slopes_of is not None:
            return self._columns(self.slopes_of, x)
        step = 1e-5 * (1.0 if self.interval is None else self.interval[1] - self.interval[0])
        return (self._columns(self.functions, x + step) - self._columns(self.functions, x - step)) / (2 * step)

    def _refuse_constant(self) -> None:
        grid = self.grid()
        columns = self._columns(self.functions, grid)
        for name, column in zip(self.names, columns.T, strict=True):
            if not np.all(np.isfinite(column)):
                raise StructureError(f"Function {name!r} is not finite at u = {grid[~np.isfinite(column)][0]:g}.")
            if np.ptp(column) <= 1e-12 * np.max(np.abs(column)):
                raise StructureError(f"Function {name!r} is constant on the interval: leave it out, the model has an "
                                     "offset.")
        rest = 1 - columns @ np.linalg.lstsq(columns, np.ones(grid.size))[0]
        if np.max(np.abs(rest)) < 1e-9:
            raise StructureError(f"Functions {', '.join(self.names)} contain the constant: drop one of them, the model "
                                 "has an offset.")

    def _columns(self, functions: Sequence[Function], x: Array) -> Array:
        columns = [np.asarray(function(x), dtype=float) for function in functions]
        for name, column in zip(self.names, columns):
            if column.shape != x.shape:
                raise StructureError(f"Function {name!r} maps shape {x.shape} to {column.shape}: it must be "
                                     "vectorised.")
        return np.column_stack(columns)
