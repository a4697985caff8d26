"""Stability of A as a convex constraint on its coefficients.

Exact for na <= 2 (the stability triangle); above that a stated convex inner region around a reference polynomial C:
``Re(A(e^{iw}) / C(e^{iw})) > 0`` on the circle, which makes A as stable as C (strict positive realness; Henrion,
Sebek and Kucera 2003 use the same central polynomial in LMI form). It is imposed on a grid of frequencies that is
dense where a root of C is near the circle, as linear inequalities; the roots are verified after the fit.

In the steps of an output-error fit C is the current iterate, pulled inwards only as far as the
iterate stays inside the region: no step is therefore cut off, and every iterate is stable by construction. For the
matrix A of a state-space model the disc is an exact linear matrix inequality.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from formulations.constraints.pole_regions import disc_side, lmi
from formulations.constraints.rule import Rule
from optid.errors import StructureError
from optid.models.roots import pulled, roots_of
from optid.models.roots import radius as root_radius
from optid.program.limits import Limit
from optid.program.view import View

FREQUENCIES = 128
MARGIN = 1e-6  # by how much of the radius the disc is shrunk, so that a binding constraint leaves a stable model
NEARBY = 1e-4  # relative change of the radius by which the price of a larger one is found
GAP = 1e-3  # least Re(A / C) on the grid, for what happens between its points

LIMITS = (0.98, 0.99, 0.995, 0.998, 0.999, 0.9997, 0.9999)  # where the roots of the centre end, as shares of the radius


def stable(radius: float = 1.0, real: Sequence[float] | float | None = None) -> Rule:
    """All poles lie in the disc of a given radius; optionally real and separated by given points.

    Args:
        radius: largest modulus of a pole, in (0, 1].
        real: na - 1 separating points in decreasing order (one number for na = 2): ``A`` changes sign there, so all
            poles are real with exactly one between neighbouring points. A convex inner region of the real-rooted
            polynomials.

    Raises:
        StructureError: impossible radius, no A to constrain, several outputs, or wrong number of separating points.
    """
    if not 0 < radius <= 1:
        raise StructureError(f"the pole radius lies in (0, 1]; got {radius!r}")
    points = None if real is None else np.atleast_1d(np.asarray(real, dtype=float))
    name, radius = f"stable:{radius:g}", radius * (1 - MARGIN)

    def build(view: View) -> Any:
        a = view.poles
        if isinstance(a, tuple):
            if points is not None:
                raise StructureError("real= is defined for the coefficients of a polynomial, not for a matrix A")
            return lmi(view, [disc_side(radius)], name)
        if a is None:
            raise StructureError("there is nothing to stabilise: na is 0")
        if a.ndim != 1:
            raise StructureError("stable is defined for one output; constrain the entries of a instead")
        na = a.shape[0]
        if points is not None:
            return _real(a, na, radius, points)
        if na == 1:
            return [Limit(a <= radius), Limit(a >= -radius)]
        if na == 2:
            first, second = a[0] / radius, a[1] / radius**2
            along, across = first / radius, 2 * second / radius  # minus the derivatives by the radius
            return [Limit(1 + first + second >= 0, -along - across), Limit(1 - first + second >= 0, along - across),
                    Limit(second <= 1, across)]
        reference = np.asarray(view.reference.get("a", np.zeros(na)), dtype=float)
        rows, levels, centre = inner_region(reference, radius, keep=view.iterate)
        grid = frequencies(roots_of(scaled(centre, radius)))
        wider, narrower = ((1 + sign * NEARBY) * radius for sign in (1, -1))
        (above, high), (below, low) = (_positive_real(centre * (near / radius) ** np.arange(1, na + 1), near, grid)
                                       for near in (wider, narrower))
        width = wider - narrower
        return Limit(rows @ a >= levels, ((above - below) @ a - (high - low)) / width)

    def verify(model: Any) -> str:
        largest = float(np.max(np.abs(model.poles), initial=0.0))
        if largest <= radius * (1 + MARGIN):
            return ""
        return f"constraint {name!r}: the largest pole has modulus {largest:.6g}; ask for a smaller radius"

    return Rule(name, build, verify, frozenset({"poles"}))


def inner_region(reference: np.ndarray, radius: float, *, keep: bool = False
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (rows, levels, centre) such that every a with ``rows @ a >= levels`` has its roots in the disc.

    Args:
        reference: coefficients (na,) of the polynomial to centre on.
        radius: of the disc.
        keep: the reference itself has to lie inside, where its roots do: its centre is then pulled inwards no
            further than that allows.
    """
    whole = np.asarray(reference, dtype=float)
    inside = root_radius(whole) < radius
    for limit in LIMITS if keep and inside else LIMITS[:1]:
        centre = pulled(whole, limit * radius)
        rows, levels = _positive_real(centre, radius)
        if not (keep and inside) or np.all(rows @ whole >= levels):
            return rows, levels, centre
    return *_positive_real(whole, radius), whole


def scaled(a: np.ndarray, radius: float) -> np.ndarray:
    """Return the coefficients of the polynomial whose roots are those of A divided by a radius."""
    return a * radius ** -np.arange(1.0, a.size + 1)


def _positive_real(centre: np.ndarray, radius: float, grid: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the inequalities Re(A / C) >= `GAP` on a grid of the circle."""
    order = np.arange(1, centre.size + 1)
    powers = radius ** -order.astype(float)
    where = frequencies(roots_of(scaled(centre, radius))) if grid is None else grid
    lags = np.exp(-1j * where)[:, None] ** order
    values = 1 + lags @ scaled(centre, radius)
    size = np.abs(values) ** 2
    rows = np.real(np.conj(values)[:, None] * lags * powers) / size[:, None]
    levels = GAP - np.real(values) / size
    unit = np.maximum(np.max(np.abs(rows), axis=1), np.abs(levels))  # near a root of C rows are larger by decades
    return rows / unit[:, None], levels / unit


def frequencies(roots: np.ndarray) -> np.ndarray:
    """Frequencies in [0, pi], evenly spaced and as seen from every root (a Moebius map centres it)."""
    even = np.pi * np.arange(FREQUENCIES + 1) / FREQUENCIES
    parts = [even]
    for root in roots[np.imag(roots) >= 0]:
        near = (1 - abs(root)) / (1 + abs(root))
        parts.append(np.angle(root) + 2 * np.arctan(near * np.tan((even[1:] - np.pi / 2) * 0.999)))
    found = np.concatenate(parts)
    return np.unique(found[(found >= 0) & (found <= np.pi)])


def _real(a: Any, na: int, radius: float, points: np.ndarray) -> list[Any]:
    if points.size != na - 1 or np.any(np.diff(points) >= 0) or np.any(np.abs(points) >= radius):
        raise StructureError(f"real= needs {na - 1} separating points in decreasing order inside {radius:.3g}; "
                             f"got {points.tolist()}")
    where = np.concatenate([[radius], points, [-radius]])
    constraints = []
    for position, z in enumerate(where):
        value = z**na + (z ** np.arange(na - 1.0, -1, -1)) @ a if z else a[na - 1]
        constraints.append(value >= 0 if position % 2 == 0 else value <= 0)
    return constraints
