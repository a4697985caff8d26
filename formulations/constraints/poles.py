"""Constraints on the poles: regions for a matrix A, exact, and the radius of the roots of a polynomial A.

A region {z : L + z M + conj(z) Mᵀ > 0} with symmetric L holds all eigenvalues of A exactly when
``L kron P + M kron (A P) + Mᵀ kron (A P)ᵀ > 0`` for some P > 0 (Chilali and Gahinet 1996); with Q = A P the condition
is linear, which is what constrained subspace identification uses (Lacy and Bernstein 2003; Miller and de Callafon
2013). One P serves several regions at once, without loss. These rules act in the shift step of the state-space
formulations.

For the coefficients of a polynomial A there are `stable` and, up to na = 2, `disc`. The former is exact for na <= 2
(the stability triangle); above that it is a stated convex inner region around a reference polynomial C: ``Re(A(e^{iw})
/ C(e^{iw})) > 0`` on the circle, which makes A as stable as C (strict positive realness; Henrion, Sebek and Kucera 2003
use the same central polynomial in LMI form). It is imposed on a grid of frequencies that is dense where a root of C is
near the circle, as linear inequalities; the roots are verified after the fit. In the steps of an output-error fit C is
the current iterate, pulled inwards only as far as the iterate stays inside the region: no step is therefore cut off,
and every iterate is stable by construction.

`integrator` puts a pole at 1: the equality A(1) = 0, linear in the coefficients. The constant of the equation then is
the slope with which the level of the output drifts while the input is held where f vanishes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.optimize import root_scalar

from formulations.constraints.rule import Rule, check_bounds, record_arguments
from optid.errors import StructureError
from optid.models.roots import pull_roots, roots_of
from optid.models.roots import radius as root_radius
from optid.program.limits import Limit
from optid.program.view import View

__all__ = ["damped", "disc", "integrator", "sector", "stable", "strip"]

MARGIN = 1e-6  # by how much (of the radius of a disc) a region is shrunk, so that a binding constraint leaves it inside
CHORDS = 12  # sides of the polygon inscribed in half of the region of a damping ratio

FREQUENCIES = 128
NEARBY = 1e-4  # relative change of a bound by which its price is found
GAP = 1e-3  # least Re(A / C) on the grid, for what happens between its points
NO_EQUATION = ("constraint 'integrator' applies to the coefficients of A; a pole at 1 of a state-space model is no "
               "linear equation in its matrices. Use 'oe.exact' or 'hammerstein_oe.exact' with it, or 'ss.exact' with "
               "stability='free', where a pole may come to lie at 1")
LIMITS = (0.98, 0.99, 0.995, 0.998, 0.999, 0.9997, 0.9999)  # where the roots of the centre end, as shares of the radius


@dataclass(frozen=True)
class Side:
    """One inequality ``L + z M + conj(z) Mᵀ >= 0`` of a region."""

    constant: np.ndarray  # L, symmetric (k, k)
    linear: np.ndarray  # M, (k, k)

    def slack(self, z: complex) -> float:
        """Return the smallest eigenvalue at a point: negative outside."""
        matrix = self.constant + z * self.linear + np.conj(z) * self.linear.T
        return float(np.min(np.linalg.eigvalsh(matrix)))


@dataclass(frozen=True)
class Region:
    """Sides that move with one number of the user: its value, what it is called, and the sides as a function of it."""

    value: float
    words: str
    sides_at: Callable[[float], list[Side]]

    @property
    def sides(self) -> list[Side]:
        """The inequalities at the value."""
        return self.sides_at(self.value)

    @property
    def rates(self) -> list[Side]:
        """Derivatives of the inequalities by the value."""
        near = NEARBY * (abs(self.value) or 1.0)
        above, below = self.sides_at(self.value + near), self.sides_at(self.value - near)
        return [Side((one.constant - other.constant) / (2 * near), (one.linear - other.linear) / (2 * near))
                for one, other in zip(above, below)]

    def moving(self, member: Any, shift: Any) -> Limit:
        """Return an inequality whose rows move with the value."""
        return Limit(member, shift, self.words, step=lambda: 0.01 * abs(self.value), words=self.words)


def disc_side(radius: float, centre: float = 0.0) -> Side:
    """|z - centre| <= radius, by the Schur complement of ``radius² - |z - centre|²``."""
    return Side(np.array([[radius, -centre], [-centre, radius]]), np.array([[0.0, 1.0], [0.0, 0.0]]))


def wedge_side(angle: float, level: float) -> Side:
    """Re(exp(-i angle) z) <= level and the same for the conjugate of z: a wedge about the real axis.

    Angle 0 is the half plane Re z <= level, angle pi the half plane Re z >= -level.
    """
    c, s = float(np.cos(angle)), float(np.sin(angle))
    if abs(s) < 1e-12:
        return Side(np.array([[2 * level]]), np.array([[-c]]))
    return Side(2 * level * np.eye(2), np.array([[-c, s], [-s, -c]]))


def region_rule(name: str, regions: Sequence[Region], text: str) -> Rule:
    """Return a rule that keeps all poles in the intersection of regions, which are shrunk by `MARGIN` already."""
    sides = [side for region in regions for side in region.sides]

    def depth(poles: np.ndarray) -> float:
        return min((side.slack(z) for z in poles for side in sides), default=np.inf)

    def verify(model: Any) -> str:
        poles = np.atleast_1d(model.poles)
        if depth(poles) >= -10 * MARGIN:
            return ""
        worst = min(poles, key=lambda z: depth(np.array([z])))  # the one furthest outside
        shown = f"{worst.real:.6g}" if abs(worst.imag) < 1e-12 else f"{worst.real:.6g} {worst.imag:+.6g}i"
        return f"constraint {name!r}: the pole {shown} lies outside {text}"

    return Rule(name, lambda view: lmi(view, regions, name), verify, frozenset({"poles"}), depth=depth, matrix=True)


def lmi(view: View, regions: Sequence[Region], name: str) -> list[Any]:
    """Return the inequalities in the P and Q of a shift step; refuse a formulation without (`StructureError`).

    Their prices hold P: at an active pole the derivatives by A and by the bound are in the same proportion for any P.
    """
    if not isinstance(view.poles, tuple):
        raise StructureError(f"constraint {name!r} applies to the poles of a state-space model; this step has the "
                             "coefficients of a polynomial, for which only 'stable' is available, and up to na = 2 "
                             "'disc'")
    p, q = view.poles

    def matrix(side: Side) -> Any:
        return cp.kron(side.constant, p) + cp.kron(side.linear, q) + cp.kron(side.linear.T, q.T)

    return [region.moving(matrix(side) >> 0, matrix(rate))
            for region in regions for side, rate in zip(region.sides, region.rates)]


def disc_region(radius: float, centre: float = 0.0) -> Region:
    """The disc |z - centre| <= radius."""
    return Region(radius, "the radius", lambda r: [disc_side(r, centre)])


@record_arguments
def disc(centre: float, radius: float) -> Rule:
    """All poles lie in the disc of a given radius around a point of the real axis.

    For the coefficients of a polynomial it is defined, and exact, up to na = 2.

    Raises:
        StructureError: a centre that is not finite, a radius that is not a positive number.
    """
    if not (np.isfinite(centre) and 0 < radius < np.inf):
        raise StructureError(f"disc needs a finite centre and a positive radius; got {centre!r} and {radius!r}")
    held = radius * (1 - MARGIN)
    region = disc_region(held, float(centre))
    rule = region_rule(f"disc:{centre:g},{radius:g}", [region], f"the disc of radius {radius:g} around {centre:g}")

    def build(view: View) -> Any:
        a = view.poles
        if a is None or isinstance(a, tuple) or a.ndim != 1 or a.size > 2:
            return lmi(view, [region], rule.name)
        if a.size == 1:
            return [region.moving(centre + a <= held, 1.0), region.moving(centre + a >= -held, 1.0)]
        # the triangle of the polynomial in w, for z = centre + w
        first, second = 2 * centre + a[0], centre**2 + centre * a[0] + a[1]
        return _triangle(first, second, region)

    return replace(rule, build=build)


@record_arguments
def strip(low: float | None = None, high: float | None = None) -> Rule:
    """The real part of every pole lies in [low, high].

    Raises:
        StructureError: no bound, or an empty strip.
    """
    check_bounds("strip", low, high, apart=True)
    both: list[tuple[float | None, str, Callable[[float], list[Side]]]] = [
        (low, "the lower bound", lambda x: [wedge_side(np.pi, -x - MARGIN)]),
        (high, "the upper bound", lambda x: [wedge_side(0.0, x - MARGIN)])]
    regions = [Region(bound, words, sides) for bound, words, sides in both if bound is not None]
    ends = ["-inf" if low is None else f"{low:g}", "inf" if high is None else f"{high:g}"]
    return region_rule(f"strip:{','.join(ends)}", regions, f"the strip {ends[0]} <= Re z <= {ends[1]}")


@record_arguments
def sector(angle: float) -> Rule:
    """Every pole has an argument of at most ``angle`` radians: no oscillation above angle / dt rad per second.

    Raises:
        StructureError: an angle outside (0, pi/2], where the region is convex.
    """
    if not 0 < angle <= np.pi / 2 + 1e-12:
        raise StructureError(f"the angle of a sector must lie in (0, pi/2], where it is convex; got {angle!r}")
    region = Region(angle, "the angle", lambda x: [wedge_side(x + np.pi / 2, -MARGIN)])
    return region_rule(f"sector:{angle:g}", [region], f"the sector |arg z| <= {angle:g}")


@record_arguments
def damped(ratio: float) -> Rule:
    """Every pole has at least a given damping ratio.

    In discrete time that is the inside of a logarithmic spiral, ``|z| <= exp(-k |arg z|)`` with
    ``k = ratio / sqrt(1 - ratio²)``. Right of its crossing with the negative real axis the inside is convex, and a
    polygon inscribed there is what is imposed: an inner region. Poles left of the crossing are excluded with it.

    Raises:
        StructureError: a ratio outside (0, 1).
    """
    if not 0 < ratio < 1:
        raise StructureError(f"the damping ratio must lie in (0, 1); got {ratio!r}")
    region = Region(ratio, "the damping ratio", lambda x: damping_sides(float(x / np.sqrt(1 - x**2))))
    return region_rule(f"damped:{ratio:g}", [region], f"the region of damping ratio {ratio:g}")


def damping_sides(rate: float) -> list[Side]:
    """Sides of the polygon inscribed in ``|z| <= exp(-rate |arg z|)``, symmetric about the real axis."""
    left = -np.exp(-rate * np.pi)
    ends = [np.pi / 2, np.pi - np.arctan(rate)]
    spread = root_scalar(lambda t: np.exp(-rate * t) * np.cos(t) - left, bracket=ends).root
    # evenly spaced in arc length: the spiral's is proportional to the fall of its modulus
    falls = np.linspace(1.0, np.exp(-rate * spread), CHORDS + 1)
    angles = -np.log(falls) / rate
    angles[-1] = spread
    corners = falls * np.exp(1j * angles)
    sides = [wedge_side(np.pi, -left - MARGIN)]
    for first, second in zip(corners[:-1], corners[1:]):
        normal = -1j * (second - first) / abs(second - first)
        sides.append(wedge_side(float(np.angle(normal)), float(np.real(np.conj(normal) * first)) - MARGIN))
    return sides


@record_arguments
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
        raise StructureError(f"the pole radius must lie in (0, 1]; got {radius!r}")
    points = None if real is None else np.atleast_1d(np.asarray(real, dtype=float))
    name, radius = f"stable:{radius:g}", radius * (1 - MARGIN)
    region = disc_region(radius)

    def build(view: View) -> Any:
        a = view.poles
        if isinstance(a, tuple):
            if points is not None:
                raise StructureError("real= is defined for the coefficients of a polynomial, not for a matrix A")
            return lmi(view, [region], name)
        if a is None:
            raise StructureError("there is nothing to stabilise: na is 0")
        if a.ndim != 1:
            raise StructureError("stable is defined for one output; constrain the entries of a instead")
        na = a.shape[0]
        if points is not None:
            return _real(a, na, radius, points)
        if na == 1:
            return [region.moving(a <= radius, 1.0), region.moving(a >= -radius, 1.0)]
        if na == 2:
            return _triangle(a[0], a[1], region)
        reference = np.asarray(view.reference.get("a", np.zeros(na)), dtype=float)
        rows, levels, centre = inner_region(reference, radius, keep=view.iterate)
        grid = frequencies(roots_of(scale_roots(centre, radius)))
        wider, narrower = ((1 + sign * NEARBY) * radius for sign in (1, -1))
        (above, high), (below, low) = (_positive_real(centre * (near / radius) ** np.arange(1, na + 1), near, grid)
                                       for near in (wider, narrower))
        width = wider - narrower
        return region.moving(rows @ a >= levels, ((above - below) @ a - (high - low)) / width)

    def verify(model: Any) -> str:
        largest = float(np.max(np.abs(model.poles), initial=0.0))
        if largest <= radius * (1 + MARGIN):
            return ""
        return f"constraint {name!r}: the largest pole has modulus {largest:.6g}; use a smaller radius"

    def stand_in(arguments: Mapping[str, Any]) -> str:
        na = arguments.get("na", 0)
        return "an inner region" if points is not None or isinstance(na, int) and na > 2 else ""

    def depth(poles: np.ndarray) -> float:
        return radius - float(np.max(np.abs(poles), initial=0.0))

    return Rule(name, build, verify, frozenset({"poles"}), stand_in, depth if points is None else None, matrix=True)


def asks_for_integrator(constraints: Sequence[Any]) -> bool:
    """Whether one of the constraints is `integrator`."""
    return any("integrator" in getattr(rule, "about", ()) for rule in constraints)


def refuse_integrator(constraints: Sequence[Any], remedy: str) -> None:
    """Refuse the constraint `integrator` with a remedy (`StructureError`)."""
    if asks_for_integrator(constraints):
        raise StructureError(remedy)


@record_arguments
def integrator() -> Rule:
    """A pole lies at 1, ``1 + a_1 + ... + a_na = 0``: the output ramps while the inputs are held.

    It is defined for a transfer function with one output. There is no static characteristic then, and the constant of
    the equation is a drift, the same in every sample.

    Raises:
        StructureError: no A to constrain, several outputs, or a state-space model.
    """
    def build(view: View) -> Any:
        a = view.poles
        if isinstance(a, tuple):
            raise StructureError(NO_EQUATION)
        if a is None:
            raise StructureError("constraint 'integrator': there is no pole to be put at 1, since na is 0")
        if a.ndim != 1:
            raise StructureError("constraint 'integrator' is defined for one output: fit each output by itself")
        return cp.sum(a) == -1

    def verify(model: Any) -> str:
        if not hasattr(model, "a"):
            raise StructureError(NO_EQUATION)
        rest = 1 + float(np.sum(model.a))
        return "" if abs(rest) <= 1e-9 else f"constraint 'integrator': A(1) = {rest:.3g} instead of 0"

    return Rule("integrator", build, verify, frozenset({"poles", "integrator"}))


def _triangle(first: Any, second: Any, region: Region) -> list[Limit]:
    """The roots of ``z² + first z + second`` in a disc around zero."""
    radius = region.value
    first, second = first / radius, second / radius**2
    along, across = first / radius, 2 * second / radius  # minus the derivatives by the radius
    return [region.moving(1 + first + second >= 0, -along - across),
            region.moving(1 - first + second >= 0, along - across), region.moving(second <= 1, across)]


def inner_region(reference: np.ndarray, radius: float, *, keep: bool = False
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (rows, levels, centre) such that every a with ``rows @ a >= levels`` has its roots in the disc.

    The region is centred on a reference polynomial (na,). With ``keep`` the centre is pulled inwards no further than
    the reference, whose roots are inside, allows.
    """
    whole = np.asarray(reference, dtype=float)
    inside = root_radius(whole) < radius
    for limit in LIMITS if keep and inside else LIMITS[:1]:
        centre = pull_roots(whole, limit * radius)
        rows, levels = _positive_real(centre, radius)
        if not (keep and inside) or np.all(rows @ whole >= levels):
            return rows, levels, centre
    return *_positive_real(whole, radius), whole


def scale_roots(a: np.ndarray, radius: float) -> np.ndarray:
    """Return the coefficients of the polynomial whose roots are those of A divided by a radius."""
    return a * radius ** -np.arange(1.0, a.size + 1)


def _positive_real(centre: np.ndarray, radius: float, grid: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the inequalities Re(A / C) >= `GAP` on a grid of the circle."""
    order = np.arange(1, centre.size + 1)
    powers = radius ** -order.astype(float)
    where = frequencies(roots_of(scale_roots(centre, radius))) if grid is None else grid
    lags = np.exp(-1j * where)[:, None] ** order
    values = 1 + lags @ scale_roots(centre, radius)
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
    values = [z**na + (z ** np.arange(na - 1.0, -1, -1)) @ a if z else a[na - 1] for z in where]
    return [value >= 0 if position % 2 == 0 else value <= 0 for position, value in enumerate(values)]
