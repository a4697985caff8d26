"""Static nonlinearities as plain numbers, so that a compiled recursion can evaluate them inside a feedback loop.

Hats, steps, splines and lines are one polynomial per cell; Legendre and trigonometric sums keep their own recurrences.
Functions of the user cannot be compiled: a loop through them runs in Python.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.bases.basis import span
from optid.bases.expansions import Linear, Polynomial, Trigonometric
from optid.bases.splines import BSpline, PiecewiseConstant, Triangular
from optid.models.nonlinearity import Nonlinearity

USER, CELLS, LEGENDRE, TRIGONOMETRIC = -1, 0, 1, 2
FREE, CLAMPED, REFUSED, LINEAR = 0, 1, 2, 3


class Tables(NamedTuple):
    """s nonlinearities in the form the kernels read."""

    kind: np.ndarray  # (s,) one of USER, CELLS, LEGENDRE, TRIGONOMETRIC
    low: Array  # (s,) lower end of the interval
    high: Array  # (s,) upper end of the interval
    outside: np.ndarray  # (s,) FREE, CLAMPED, REFUSED or LINEAR beyond the interval
    cells: np.ndarray  # (s,) number of cells, or of coefficients
    rate: Array  # (s,) angle per unit of the argument (trigonometric sums)
    numbers: Array  # (s, cells, degree + 1) coefficients, highest power first in the position within the cell

    @property
    def compiled(self) -> bool:
        """Whether the kernels can evaluate every one of them."""
        return bool(np.all(self.kind != USER))


def tabulate(functions: Sequence[Nonlinearity]) -> Tables:
    """Write nonlinearities as tables; their values and slopes are those of `Nonlinearity` to rounding."""
    rows = [_row(f) for f in functions]
    width = max((r[-1].shape[0] for r in rows), default=1)
    depth = max((r[-1].shape[1] for r in rows), default=1)
    numbers = np.zeros((len(rows), width, depth))
    for j, row in enumerate(rows):
        part = row[-1]
        numbers[j, : part.shape[0], depth - part.shape[1] :] = part
    plain = list(zip(*(r[:-1] for r in rows))) or [()] * 6
    kinds = [np.int64, float, float, np.int64, np.int64, float]
    return Tables._make([*(np.array(column, dtype=kind) for column, kind in zip(plain, kinds)), numbers])


def _row(f: Nonlinearity) -> tuple[int, float, float, int, int, float, Array]:
    basis, mu = f.basis, np.asarray(f.mu)
    low, high = basis.interval if basis.interval is not None else (0.0, 1.0)
    outside = {"extrapolate": FREE, "clamp": CLAMPED, "error": REFUSED, "linear": LINEAR}[basis.outside]
    outside = FREE if basis.interval is None else outside
    if isinstance(basis, Linear):
        return CELLS, low, high, outside, 1, 0.0, np.array([[mu[0] * (high - low), mu[0] * low]])
    if isinstance(basis, Polynomial):
        return LEGENDRE, low, high, outside, mu.size, 0.0, mu[:, None]
    if isinstance(basis, Trigonometric):
        rate = np.pi / (basis.half_range * (high - low) / 2)
        return TRIGONOMETRIC, low, high, outside, basis.p, rate, mu.reshape(-1, 2)
    if isinstance(basis, Triangular | PiecewiseConstant | BSpline):
        return CELLS, low, high, outside, basis.p, 0.0, _pieces(replace(basis, interval=span(basis))) @ mu
    return USER, low, high, outside, 0, 0.0, np.zeros((1, 1))


@lru_cache(maxsize=64)
def _pieces(basis: Triangular | PiecewiseConstant | BSpline) -> Array:
    """Coefficients (cells, degree + 1, P) of the polynomials of all functions, from values inside the cells."""
    low, high = span(basis)
    degree = {Triangular: 1, PiecewiseConstant: 0}.get(type(basis), getattr(basis, "degree", 0))
    inside = (np.arange(degree + 1) + 0.5) / (degree + 1)
    points = low + (np.arange(basis.p)[:, None] + inside) * (high - low) / basis.p
    values = basis.values(points.ravel()).reshape(basis.p, degree + 1, basis.size)
    return np.linalg.solve(np.vander(inside), values)
