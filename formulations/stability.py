"""Stability of A as a convex constraint on its coefficients.

Exact for na <= 2 (the stability triangle); above that a stated convex inner region around a reference polynomial C:
``Re(A(e^{iw}) / C(e^{iw})) > 0`` on the circle, which makes A as stable as C (strict positive realness; Henrion,
Sebek and Kucera 2003 use the same central polynomial in LMI form). It is imposed on a grid of frequencies that is
dense where a root of C is near the circle, as linear inequalities; the roots are verified after the fit.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from formulations.rule import Rule
from optid.errors import StructureError
from optid.program import View

FREQUENCIES = 128
MARGIN = 1e-6  # by how much of the radius the disc is shrunk, so that a binding constraint leaves a stable model
GAP = 1e-3  # least Re(A / C) on the grid, for what happens between its points


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
        if "a" not in view:
            raise StructureError("there is nothing to stabilise: na is 0")
        a = view["a"]
        if a.ndim != 1:
            raise StructureError("stable is defined for one output; constrain the entries of a instead")
        na = a.shape[0]
        powers = radius ** -np.arange(1.0, na + 1)
        if points is not None:
            return _real(a, na, radius, points)
        if na == 1:
            return [a <= radius, a >= -radius]
        if na == 2:
            scaled = [powers[0] * a[0], powers[1] * a[1]]
            return [1 + scaled[0] + scaled[1] >= 0, 1 - scaled[0] + scaled[1] >= 0, scaled[1] <= 1]
        reference = central(np.asarray(view.reference.get("a", np.zeros(na))), radius) * powers
        lags = np.exp(-1j * frequencies(np.roots([1.0, *reference])))[:, None] ** np.arange(1, na + 1)
        centre = 1 + lags @ reference
        rows = np.real(np.conj(centre)[:, None] * lags * powers)
        size = np.abs(centre) ** 2
        return (rows / size[:, None]) @ a + np.real(centre) / size >= GAP

    def verify(model: Any) -> str:
        largest = float(np.max(np.abs(model.poles), initial=0.0))
        if largest <= radius * (1 + MARGIN):
            return ""
        return f"constraint {name!r}: the largest pole has modulus {largest:.6g}; ask for a smaller radius"

    return Rule(name, build, verify)


def frequencies(roots: np.ndarray) -> np.ndarray:
    """Frequencies in [0, pi], evenly spaced and as seen from every root (a Moebius map centres it)."""
    even = np.pi * np.arange(FREQUENCIES + 1) / FREQUENCIES
    parts = [even]
    for root in roots[np.imag(roots) >= 0]:
        near = (1 - abs(root)) / (1 + abs(root))
        parts.append(np.angle(root) + 2 * np.arctan(near * np.tan((even[1:] - np.pi / 2) * 0.999)))
    found = np.concatenate(parts)
    return np.unique(found[(found >= 0) & (found <= np.pi)])


def central(a: np.ndarray, radius: float) -> np.ndarray:
    """Return the coefficients of ``A`` with every pole outside ``0.98 radius`` pulled back onto that circle."""
    roots = np.roots(np.concatenate([[1.0], a]))
    limit = 0.98 * radius
    sizes = np.abs(roots)
    pulled = np.where(sizes > limit, roots * limit / np.maximum(sizes, 1e-300), roots)
    return np.real(np.poly(pulled))[1:]


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
