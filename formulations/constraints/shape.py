"""Reusable constraints on the nonlinearity and the static behaviour: each works in exact and relaxed formulations.

Every function returns a `Rule`, to be passed in ``constraints=[...]``. Two kinds of statement exist:

* about the *shape* of f, free of scale (monotone, convex, odd, dead zone, known up to a factor). In the exact
  formulations they act on ``mu``, and an inequality (monotone, convex, concave) also keeps the sum of ``b`` from being
  negative, so that it holds for the static characteristic of a stable plant as for f. In the relaxed ones they act on
  ``Theta``; an inequality then acts on the static characteristic alone, the sum over the lags.
* about the *static characteristic* ``y = (f(u) sum(b) + d) / (1 + sum(a))``, in units of the output: slope, range,
  points, gain. They are linear in ``(a, Theta, offset)`` and mean the same in every formulation and gauge. They
  include ``1 + sum(a) > 0``, which every stable model satisfies: without it there is no static characteristic.

For state-space models they act in the step that chooses B and D ("realisation"), where the static characteristic
``C (I - A)^-1 B f(u) + D f(u) + d`` is linear in the unknowns; an output that is fed back through a nonlinearity or an
observer gain is held at its mean there. The rules of `formulations.constraints.responses` belong to that step alone.

Every rule takes the name of an input as ``channel`` (None means every input, or the only one where a static
characteristic is meant) and, about a static characteristic, that of an output, where there are several. Rules about
shape also take a latent signal, "z1", "z2", ...: those on the slope of its function (monotone, even, dead zones) only
where it is determined, as in Wiener models; otherwise the linear part of the function is not identifiable separately
from the matrices.
"""

from collections.abc import Callable, Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.poles import stable
from formulations.constraints.rule import Rule, check_bounds, label, record_arguments, sign_of
from optid.bases import PiecewiseConstant
from optid.errors import StructureError
from optid.program.limits import Limit
from optid.program.view import View

__all__ = ["coefficients", "concave", "convex", "dead_zone", "even", "fixed", "gain", "monotone", "odd", "saturation",
           "shared", "sign", "slope", "stable", "through", "value_range"]

RANGE = "the range of f"  # what the price of a bound is quoted in 1 % of
SETTLES = 1e-6  # least 1 + sum(a) of a model that has a static characteristic; imposed with every rule about it


@record_arguments
def monotone(direction: str = "increasing", channel: str | None = None) -> Rule:
    """The nonlinearity, and the static characteristic with it, is "increasing" or "decreasing" over its interval.

    On the whole interval; with sines, cosines and functions of your own, at 201 points of it. Exact for piecewise
    linear and constant bases, sufficient for splines (control points) and polynomials (Bernstein coefficients).

    Raises:
        StructureError: unknown direction or channel.
    """
    sign = sign_of("direction", direction, "increasing", "decreasing")
    return _cone("monotone", direction, channel, lambda basis: sign * basis.increments())


@record_arguments
def convex(channel: str | None = None) -> Rule:
    """The nonlinearity, and the static characteristic with it, is convex over the interval of its basis.

    It holds between samples as `monotone` does.

    Raises:
        StructureError: a basis of steps, which are neither convex nor concave.
    """
    return _cone("convex", "", channel, lambda basis: _smooth(basis, "convex").curvature(), heights=False)


@record_arguments
def concave(channel: str | None = None) -> Rule:
    """The nonlinearity, and the static characteristic with it, is concave over its interval; otherwise as `convex`."""
    return _cone("concave", "", channel, lambda basis: -_smooth(basis, "concave").curvature(), heights=False)


@record_arguments
def odd(channel: str | None = None) -> Rule:
    """f(u) - f(0) is odd; the offset of the model stays free.

    Exact where the interval of the basis is symmetric about zero; elsewhere it holds at as many points as the basis
    has functions of the other parity.
    """
    return _linear("odd", channel, lambda basis: _mirror(basis, +1.0))


@record_arguments
def even(channel: str | None = None) -> Rule:
    """The nonlinearity is even, in the sense of `odd`."""
    return _linear("even", channel, lambda basis: _mirror(basis, -1.0))


@record_arguments
def dead_zone(low: float, high: float, channel: str | None = None) -> Rule:
    """The nonlinearity is constant on [low, high]; cells that the zone only touches become constant as a whole.

    Raises:
        StructureError: an empty zone.
    """
    if not low < high:
        raise StructureError(f"dead_zone needs low < high; got {low!r}, {high!r}")
    return _linear(f"dead_zone:{low:g},{high:g}", channel, lambda basis: _flat(basis, low, high))


@record_arguments
def saturation(low: float | None = None, high: float | None = None, channel: str | None = None) -> Rule:
    """The nonlinearity is constant below ``low`` and above ``high``.

    Raises:
        StructureError: neither level given, or levels that cross.
    """
    check_bounds("saturation", low, high)

    def rows(basis: Any) -> np.ndarray:
        lo, hi = basis.interval
        parts = [_flat(basis, lo, low)] if low is not None and low > lo else []
        parts += [_flat(basis, high, hi)] if high is not None and high < hi else []
        if not parts:
            raise StructureError(f"saturation levels ({low}, {high}) lie outside the interval [{lo:g}, {hi:g}]")
        return np.vstack(parts)

    return _linear("saturation", channel, rows)


@record_arguments
def slope(low: float | None = None, high: float | None = None, channel: str | None = None,
          output: str | None = None) -> Rule:
    """The slope of the static characteristic lies in [low, high] (units of output per unit of input).

    It holds between samples as `monotone` does.

    Raises:
        StructureError: no bound, crossing bounds, or a basis of steps, which have no slope.
    """
    return _static("slope", low, high, channel, output, lambda basis: _smooth(basis, "slope").slope_rows(),
                   offset=False)


@record_arguments
def value_range(low: float | None = None, high: float | None = None, channel: str | None = None,
                output: str | None = None, first: float | None = None, last: float | None = None) -> Rule:
    """The static characteristic lies in [low, high] (units of the output) where the input lies in [first, last].

    On the whole corridor, also between samples; for sines, cosines and functions of your own at 201 points.

    Args:
        low: lower bound.
        high: upper bound.
        first: where the corridor begins; default the lower end of the interval of the basis.
        last: where it ends; default the upper end.

    Raises:
        StructureError: no bound, crossing bounds, or a corridor outside the interval.
    """
    def rows(basis: Any) -> np.ndarray:
        ends = [end if given is None else float(given) for given, end in zip((first, last), basis.interval)]
        inside = np.clip(ends, *basis.interval)
        if ends[0] > ends[1] or ends[1] < basis.interval[0] or ends[0] > basis.interval[1]:
            raise StructureError(f"the corridor [{ends[0]:g}, {ends[1]:g}] lies outside the interval "
                                 f"[{basis.interval[0]:g}, {basis.interval[1]:g}] of the input")
        return basis.value_rows(*inside)

    return _static("range", low, high, channel, output, rows, offset=True)


@record_arguments
def through(u: float | Sequence[float], y: float | Sequence[float], channel: str | None = None,
            output: str | None = None) -> Rule:
    """The static characteristic passes through the points (u, y).

    Args:
        u: input values inside the interval of the basis.
        y: output values in steady state.

    Raises:
        StructureError: different numbers of u and y.
    """
    us, ys = np.atleast_1d(np.asarray(u, dtype=float)), np.atleast_1d(np.asarray(y, dtype=float))
    if us.shape != ys.shape:
        raise StructureError(f"through needs as many outputs as inputs; got {us.size} and {ys.size}")
    return _static("through", ys, ys, channel, output, lambda basis: basis.values(us), offset=True)


@record_arguments
def gain(value: float | None = None, low: float | None = None, high: float | None = None, at: float | None = None,
         channel: str | None = None, output: str | None = None) -> Rule:
    """The static gain at an operating point equals ``value`` or lies in [low, high].

    Args:
        value: gain in units of output per unit of input.
        low: lower bound instead of a value.
        high: upper bound instead of a value.
        at: operating point; default the middle of the interval.

    Raises:
        StructureError: neither value nor bound given.
    """
    if value is None and low is None and high is None:
        raise StructureError("gain needs a value, or low= and/or high=")
    if value is not None:
        low = high = value
    return _static("gain", low, high, channel, output, lambda basis: slopes_at(basis, at), offset=False)


@record_arguments
def coefficients(name: str, low: float | None = None, high: float | None = None, index: int | None = None) -> Rule:
    """Bounds on the entries of a named variable: ``a``, ``offset``, or ``b`` where its scale is fixed.

    Args:
        name: name of the variable.
        low: lower bound.
        high: upper bound.
        index: a single entry, default all.

    Raises:
        StructureError: no bound, or ``b``/``mu`` in the gauge "norm", where their scale is not a fact of the plant.
    """
    check_bounds("coefficients", low, high)

    def build(view: View) -> Any:
        if view.gauge == "norm" and name not in ("a", "offset"):
            raise StructureError(f"bounds on {name!r} depend on the gauge, and 'norm' only fixes a length; choose "
                                 "gauge='b0' or gauge='gain', or bound the static gain or slope instead")
        variable = view[name] if index is None else cp.hstack([view[name][int(index)]])
        return ([Limit(variable >= low, bound="low")] if low is not None else []) + (
            [Limit(variable <= high, bound="high")] if high is not None else [])

    return Rule(f"coefficients:{name}", build)


@record_arguments
def fixed(name: str, value: Any) -> Rule:
    """A known parameter: ``a`` and ``offset`` by value, ``mu`` and ``b`` up to the factor between them.

    Args:
        name: variable name (``mu[valve]`` with several inputs).
        value: array of its shape.

    Raises:
        StructureError: wrong shape.
    """
    known = np.asarray(value, dtype=float)

    def build(view: View) -> Any:
        word, _, channel = name.partition("[")
        product = "Theta[" + channel if channel else "Theta"
        scaled = product in view or "mu" + name[len(word):] in view  # f and b are known up to a factor then
        if (not scaled or name in view) and known.shape != view[name].shape:
            raise StructureError(f"{name!r} has shape {view[name].shape}, the known value has {known.shape}")
        if word not in ("mu", "b") or not scaled:
            return view[name] == known
        direction = np.ravel(known, order="F") / np.linalg.norm(known)
        rest = _independent(np.eye(direction.size) - np.outer(direction, direction))
        if name in view:
            return rest @ (view[name] if view[name].ndim == 1 else cp.vec(view[name], order="F")) == 0
        return rest @ (view[product] if word == "mu" else view[product].T) == 0

    return Rule(f"fixed:{name}", build)


@record_arguments
def shared(name: str, first: str, second: str) -> Rule:
    """Two inputs share ``b`` (the dynamics) or ``mu`` (the nonlinearity), each in the gauge of the formulation."""

    def build(view: View) -> Any:
        equal = view[view.key(name, first)] == view[view.key(name, second)]
        return Limit(equal, band=np.eye(equal.size), span=np.eye(equal.size))

    return Rule(f"shared:{name}:{first},{second}", build)


@record_arguments
def sign(name: str = "b", direction: str = "positive") -> Rule:
    """All entries of a named variable have one sign; for ``b`` or ``mu`` this also fixes the sign of the other."""
    factor = sign_of("direction", direction, "positive", "negative")
    return Rule(f"sign:{name}:{direction}", lambda view: factor * view[name] >= 0)


def slopes_at(basis: Any, at: float | None) -> np.ndarray:
    """Return the slopes (1, P) of the functions at an operating point, None for the middle of the interval."""
    return _smooth(basis, "gain").slopes(np.array([float(np.mean(basis.interval)) if at is None else float(at)]))


def _smooth(basis: Any, word: str) -> Any:
    if isinstance(basis, PiecewiseConstant):
        raise StructureError(f"{word!r} is about slopes, and a piecewise constant function has none: choose "
                             f"'triangular:{basis.p}', or bound its steps by monotone or range")
    return basis


def _cone(word: str, direction: str, channel: str | None, rows: Callable[[Any], np.ndarray], heights: bool = True
          ) -> Rule:
    """Rows on f that are not negative; ``heights`` marks differences of its values."""

    def build(view: View) -> Any:
        if direction == "decreasing" and channel in view.spans:
            raise StructureError(f"the sign of {channel} is arbitrary, so that 'decreasing' and 'increasing' are "
                                 "equivalent: use 'increasing'")
        inputs = view.channels if channel is None else [channel]
        found = [Limit(_rows(view, one, rows) @ curve >= 0, bound=one,
                       step=_range_of(view.basis(one), curve) if heights else None, words=RANGE if heights else "")
                 for one in inputs for curve in view.curves(one)]
        ways: Any = [(one, view.direction(one)) for one in inputs]
        return found + [Limit(b >= 0, bound=f"direction of {one}") for one, b in ways if b is not None]

    return Rule(label(f"{word}:{direction}" if direction else word, channel), build)


def _linear(word: str, channel: str | None, rows: Callable[[Any], np.ndarray]) -> Rule:
    def build(view: View) -> list[Limit]:
        found = []
        for one in view.channels if channel is None else [channel]:
            whole, coefficients = _rows(view, one, rows), view.function(one)
            matrix, step = _independent(whole), _range_of(view.basis(one), coefficients)
            found.append(Limit(matrix @ coefficients == 0, band=whole, span=matrix, step=step, words=RANGE))
        return found

    return Rule(label(word, channel), build)


def _rows(view: View, channel: str, rows: Callable[[Any], np.ndarray]) -> np.ndarray:
    """Return the rows of a condition; refuse one on the slope of a latent function, if it is not determined."""
    basis = view.basis(channel)
    found, span = rows(basis), view.spans.get(channel)
    if span is None:
        return found
    z = basis.grid()
    straight = np.linalg.lstsq(basis.values(z), z)[0]
    apart = np.abs(straight - span @ (span.T @ straight)).max() > 1e-9 * np.abs(straight).max()
    if apart and np.abs(found @ straight).max() > 1e-9 * np.abs(found).max():
        raise StructureError(f"the slope of the function of {channel} is not determined: its linear part is not "
                             "identifiable separately from A, B, C and D. Use convex, concave or odd")
    sizes = np.linalg.norm(found @ span, axis=1)
    return found[sizes > 1e-9 * sizes.max()]  # the others hold for every function: natural splines end straight


def _static(word: str, low: Any, high: Any, channel: str | None, output: str | None,
            rows: Callable[[Any], np.ndarray], *, offset: bool) -> Rule:
    """Bounds on rows of the static characteristic; arrays give every row its own."""
    check_bounds(word, low, high)

    def build(view: View) -> Any:
        basis, theta, size = view.basis(channel), view.static(channel, output), view.static_scale
        curve = rows(basis) @ theta
        if offset:
            curve = curve + view.static_offset(output)
        settles = [Limit(size >= SETTLES, bound="settles")] if "a" in view else []
        meaning: dict[str, Any] = {"step": _range_of(basis, theta, size, 0 if offset else 1),
                                   "words": RANGE if offset else f"{RANGE} over the width of its interval"}
        if np.all(low == high):
            equal = curve - cp.multiply(low, size) == 0
            return [Limit(equal, size, None if np.ndim(low) else "value", **meaning), *settles]
        return ([Limit(curve - low * size >= 0, size, "low", **meaning)] if low is not None else []) + (
            [Limit(curve - high * size <= 0, size, "high", **meaning)] if high is not None else []) + settles

    return Rule(label(word, channel, output), build)


def _range_of(basis: Any, coefficients: Any, size: Any = 1.0, power: int = 0) -> Callable[[], float]:
    """Return what 1 % of the range of f is at the assigned point, per width of its interval to a power."""

    def step() -> float:
        matrix = np.asarray(coefficients.value, dtype=float)
        curve = basis.values(basis.grid()) @ (matrix if matrix.ndim == 1 else matrix.sum(axis=1))
        scale = float(np.asarray(size.value if isinstance(size, cp.Expression) else size))
        low, high = basis.interval or (0.0, 1.0)
        return 0.01 * float(np.ptp(curve)) / abs(scale) / (high - low) ** power

    return step


def _independent(rows: np.ndarray) -> np.ndarray:
    """Return independent rows that span the same conditions, so that solvers see no redundant equality."""
    _, values, vectors = np.linalg.svd(np.atleast_2d(rows), full_matrices=False)
    keep = values > 1e-10 * max(float(values[0]) if values.size else 0.0, 1e-300)
    if not np.any(keep):
        raise StructureError("the condition holds for every function of this basis: it constrains nothing")
    return vectors[keep]


def _mirror(basis: Any, parity: float) -> np.ndarray:
    lo, hi = basis.interval
    reach = min(-lo, hi)
    if reach <= 0:
        raise StructureError(f"the interval [{lo:g}, {hi:g}] of the input does not contain zero: "
                             "a symmetry about zero says nothing there")
    # as many points as the family has functions of the other parity: more would overdetermine a family whose nodes are
    # not mirror images of each other, and leave only straight lines
    count = max(basis.size // 2 if parity > 0 else (basis.size + 1) // 2, 1)
    points = reach * np.arange(1, count + 1) / count
    both = basis.values(points) + parity * basis.values(-points)
    return both - 2 * basis.values(np.zeros(1)) if parity > 0 else both


def _flat(basis: Any, low: float, high: float) -> np.ndarray:
    lo, hi = basis.interval
    low, high = max(low, lo), min(high, hi)
    if not low < high:
        raise StructureError(f"the zone lies outside the interval [{lo:g}, {hi:g}] of the input")
    points = np.linspace(low, high, max(64, 8 * basis.size))
    return basis.values(points) - basis.values(np.array([low]))
