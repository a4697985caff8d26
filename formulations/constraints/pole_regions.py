"""Regions of the complex plane for the poles, as linear matrix inequalities in P and Q = A P.

A region {z : L + z M + conj(z) Mᵀ > 0} with symmetric L holds all eigenvalues of A exactly when
``L kron P + M kron (A P) + Mᵀ kron (A P)ᵀ > 0`` for some P > 0 (Chilali and Gahinet 1996); with Q = A P the condition
is linear, which is what constrained subspace identification uses (Lacy and Bernstein 2003; Miller and de Callafon
2013). One P serves several regions at once, without loss.

The functions return a `Rule` about the poles. They act in the shift step of the state-space formulations; for the
coefficients of a polynomial A there is `formulations.constraints.stability.stable`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.optimize import root_scalar

from formulations.constraints.rule import Rule
from optid.errors import StructureError
from optid.program.view import View

__all__ = ["damped", "disc", "sector", "strip"]

MARGIN = 1e-6  # by how much a region is shrunk, so that a binding constraint leaves the poles inside
CHORDS = 12  # sides of the polygon inscribed in half of the region of a damping ratio


@dataclass(frozen=True)
class Side:
    """One inequality ``L + z M + conj(z) Mᵀ >= 0`` of a region.

    Attributes:
        constant: L, symmetric (k, k).
        linear: M, (k, k).
    """

    constant: np.ndarray
    linear: np.ndarray

    def slack(self, z: complex) -> float:
        """Return the smallest eigenvalue at a point: negative outside."""
        matrix = self.constant + z * self.linear + np.conj(z) * self.linear.T
        return float(np.min(np.linalg.eigvalsh(matrix)))

    def inequality(self, p: Any, q: Any) -> Any:
        """Return the CVXPY constraint on P and Q = A P, both (n, n)."""
        if self.constant.shape == (1, 1):
            return float(self.constant[0, 0]) * p + float(self.linear[0, 0]) * (q + q.T) >> 0
        whole = cp.kron(self.constant, p) + cp.kron(self.linear, q) + cp.kron(self.linear.T, q.T)
        return whole >> 0


def disc_side(radius: float, centre: float = 0.0) -> Side:
    """|z - centre| <= radius, by the Schur complement of ``radius² - |z - centre|²``."""
    constant = np.array([[radius, -centre], [-centre, radius]])
    return Side(constant, np.array([[0.0, 1.0], [0.0, 0.0]]))


def wedge_side(angle: float, level: float) -> Side:
    """Re(exp(-i angle) z) <= level and the same for the conjugate of z: a wedge about the real axis.

    Angle 0 is the half plane Re z <= level, angle pi the half plane Re z >= -level.
    """
    c, s = float(np.cos(angle)), float(np.sin(angle))
    if abs(s) < 1e-12:
        return Side(np.array([[2 * level]]), np.array([[-c]]))
    return Side(2 * level * np.eye(2), np.array([[-c, s], [-s, -c]]))


def region_rule(name: str, sides: Sequence[Side], text: str) -> Rule:
    """Return a rule that keeps all poles in the intersection of several sides.

    Args:
        name: name under which it is reported.
        sides: already shrunk by `MARGIN`.
        text: the region in words, for refusals.
    """

    def build(view: View) -> Any:
        return lmi(view, sides, name)

    def verify(model: Any) -> str:
        poles = np.atleast_1d(model.poles)
        slack = [min(side.slack(z) for side in sides) for z in poles]
        if not slack or min(slack) >= -10 * MARGIN:
            return ""
        worst = poles[int(np.argmin(slack))]  # the one furthest outside
        shown = f"{worst.real:.6g}" if abs(worst.imag) < 1e-12 else f"{worst.real:.6g} {worst.imag:+.6g}i"
        return f"constraint {name!r}: the pole {shown} lies outside {text}"

    return Rule(name, build, verify, frozenset({"poles"}))


def lmi(view: View, sides: Sequence[Side], name: str) -> list[Any]:
    """Return the inequalities in the P and Q of a shift step.

    Raises:
        StructureError: the formulation has no such step.
    """
    if not isinstance(view.poles, tuple):
        raise StructureError(f"constraint {name!r} speaks about the poles of a state-space model; this step has the "
                             "coefficients of a polynomial, for which only 'stable' is available")
    return [side.inequality(*view.poles) for side in sides]


def disc(centre: float, radius: float) -> Rule:
    """All poles lie in the disc of a given radius around a point of the real axis.

    Raises:
        StructureError: a radius that is not positive.
    """
    if not radius > 0:
        raise StructureError(f"disc needs a positive radius; got {radius!r}")
    return region_rule(f"disc:{centre:g},{radius:g}", [disc_side(radius * (1 - MARGIN), float(centre))],
                       f"the disc of radius {radius:g} around {centre:g}")


def strip(low: float | None = None, high: float | None = None) -> Rule:
    """The real part of every pole lies in [low, high].

    Raises:
        StructureError: no bound, or an empty strip.
    """
    if low is None and high is None:
        raise StructureError("strip needs low= and/or high=")
    if low is not None and high is not None and not low < high:
        raise StructureError(f"strip needs low < high; got {low!r}, {high!r}")
    sides = ([wedge_side(np.pi, -low - MARGIN)] if low is not None else []) + (
        [wedge_side(0.0, high - MARGIN)] if high is not None else [])
    ends = ["-inf" if low is None else f"{low:g}", "inf" if high is None else f"{high:g}"]
    return region_rule(f"strip:{','.join(ends)}", sides, f"the strip {ends[0]} <= Re z <= {ends[1]}")


def sector(angle: float) -> Rule:
    """Every pole has an argument of at most ``angle`` radians: no oscillation above angle / dt rad per second.

    Args:
        angle: in (0, pi/2].

    Raises:
        StructureError: an angle outside that range, beyond which the region is not convex.
    """
    if not 0 < angle <= np.pi / 2 + 1e-12:
        raise StructureError(f"the angle of a sector lies in (0, pi/2], where it is convex; got {angle!r}")
    return region_rule(f"sector:{angle:g}", [wedge_side(angle + np.pi / 2, -MARGIN)],
                       f"the sector |arg z| <= {angle:g}")


def damped(ratio: float) -> Rule:
    """Every pole has at least a given damping ratio.

    In discrete time that is the inside of a logarithmic spiral, ``|z| <= exp(-k |arg z|)`` with
    ``k = ratio / sqrt(1 - ratio²)``. Right of its crossing with the negative real axis the inside is convex, and a
    polygon inscribed there is what is imposed: an inner region. Poles left of the crossing are excluded with it.

    Args:
        ratio: in (0, 1).

    Raises:
        StructureError: a ratio outside (0, 1).
    """
    if not 0 < ratio < 1:
        raise StructureError(f"the damping ratio lies in (0, 1); got {ratio!r}")
    rate = float(ratio / np.sqrt(1 - ratio**2))
    return region_rule(f"damped:{ratio:g}", damping_sides(rate), f"the region of damping ratio {ratio:g}")


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
