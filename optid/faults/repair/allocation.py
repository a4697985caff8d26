"""What the remaining actuators of a damaged plant can hold: attainable outputs, the inputs for them, what limits."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataWarning, StructureError
from optid.faults.repair.damage import Damage
from optid.faults.repair.inversion import Inverse, inverse
from optid.faults.repair.member import Member
from optid.faults.repair.virtual_sensor import check_stabilisable
from optid.models import HammersteinSS
from optid.models.nonlinearity import Nonlinearity
from optid.program.solution import Solution

if TYPE_CHECKING:
    from optid.core.problem import Problem

REACHED = 1e-4
"""A target is reached when its distance is below this share of the scale of the outputs."""

ACTIVE = 1e-6
"""A bound limits when its multiplier is above this share of the largest, and of the scale of the outputs."""


@dataclass(frozen=True, eq=False)
class Target:
    """The steady state nearest to a reference."""

    reference: Array  # (l,) desired outputs
    y: Array  # (l,) steady outputs
    u: Array  # (m,) inputs
    v: Array  # (r,) their f
    x: Array  # (n,) steady state
    distance: float  # weighted distance of y from the reference
    reachable: bool  # whether it is negligible
    # {actuator: reduction of the distance per unit of v (of u on the NLP route) by which its bound is relaxed},
    # the most limiting first; empty where the reference is reached
    limiting: dict[str, float]
    # of the programme behind it; None where no actuator has an effect
    solution: Solution | None = field(default=None, repr=False)
    idle: str = ""  # the reason where no actuator has an effect; "" otherwise

    def __str__(self) -> str:
        wanted, got = (", ".join(f"{value:.4g}" for value in point) for point in (self.reference, self.y))
        if self.reachable:
            return f"({wanted}) is reached with inputs ({', '.join(f'{value:.4g}' for value in self.u)})"
        if self.idle:
            return f"({wanted}) is not reachable: {self.idle}; the outputs settle at ({got}) for any inputs"
        words = ", ".join(f"{name} ({price:.3g} per unit)" for name, price in self.limiting.items())
        limit = f"; limited by {words}" if words else ""
        return f"({wanted}) cannot be reached: nearest is ({got}), weighted distance {self.distance:.4g}{limit}"


@dataclass(frozen=True, eq=False)
class Allocation:
    """What a plant of r functions f of m inputs can hold within the bounds of its inputs.

    With several members (`robust_allocation`) the cost of the worst of them is minimised.

    Attributes:
        model: the plant now; the healthy one with several members.
        low: (m,) least inputs.
        high: (m,) largest inputs.
        weights: (l,) of the outputs.
        inverses: (r) f and f^-1.
        members: the plant, linear in v = f(u); several where the damage is ambiguous.
        v_low: (r,) least v.
        v_high: (r,) largest v.
        norm: (k, r) matrix S of ‖S v‖ <= limit; None for none.
        limit: of the norm.
        route: "qp" (in v, exact), or "nlp" (in u).
        messages: the reasons for the route.
        solver: back end of the programmes; on the NLP route "auto" replaces one that takes no such programmes.
    """

    model: HammersteinSS
    low: Array
    high: Array
    weights: Array
    inverses: tuple[Inverse, ...]
    members: tuple[Member, ...]
    v_low: Array
    v_high: Array
    norm: Array | None = None
    limit: float = np.inf
    route: str = "qp"
    messages: tuple[str, ...] = ()
    solver: Any = "auto"

    @property
    def middle(self) -> Array:
        """(m,) middle of the ranges of the inputs."""
        return (self.low + self.high) / 2

    @property
    def v_middle(self) -> Array:
        """(r,) middle of the ranges of v."""
        return (self.v_low + self.v_high) / 2

    @property
    def v_half(self) -> Array:
        """(r,) half of the ranges of v; one for an actuator without effect."""
        half = (self.v_high - self.v_low) / 2
        return np.where(half > 0, half, 1.0)

    @property
    def names(self) -> tuple[str, ...]:
        """(r) of the actuators, one per function."""
        return tuple(f"actuator:{self.model.inputs[c]}" for c in self.model.input_of)

    @property
    def feedback(self) -> tuple[tuple[Nonlinearity, int], ...]:
        """Function and output of the columns of v beyond r."""
        return tuple(zip(self.model.feedback, self.model.output_of))

    @property
    def linear(self) -> bool:
        """Whether the plant is linear in v and every v can be chosen independently."""
        return not self.feedback and len(set(self.model.input_of)) == len(self.model.input_of)

    @cached_property
    def scale(self) -> float:
        """Weighted square of the largest change of the steady outputs by one actuator."""
        reach = np.abs(self.weights[:, None] * self.members[0].gain()[:, : self.v_low.size]) * self.v_half
        return float(np.max(np.sum(reach**2, axis=0), initial=0.0)) or 1.0

    def attainable(self, reference: ArrayLike) -> Target:
        """Return the steady state nearest to a reference (l,), its weighted distance, and the limiting actuators.

        Several members share the inputs, and y is that of the worst.

        Raises:
            StructureError: a reference of the wrong size or not finite, or a solver that finds no point.
        """
        from optid.registry import fault_formulation

        r = self._read(reference)
        if not self.moving:
            return self._target(r, self.middle, None)
        if self.route == "qp":
            posed = fault_formulation("allocation.target")(self, reference=r)
            solution = self._solved(posed, posed.start)
            v = np.clip(solution.values["v"], self.v_low, self.v_high)
            return self._target(r, self._inputs(v), solution, v)
        posed, third = fault_formulation("allocation.resting")(self, reference=r), (self.high - self.low) / 3
        found, failure = [], None
        for u in (self.middle, self.middle + third, self.middle - third):
            v = self.model.expand_inputs(u[None, :])[0]
            x, y = self._rests(u, v)[0]
            fed = [float(g(y[o])) for g, o in self.feedback]
            try:
                solution = self._solved(posed, {"u": u, "v": np.append(v, fed), "x": x, "y": y})
            except StructureError as error:
                failure = error
                continue
            found.append(self._target(r, np.clip(solution.values["u"], self.low, self.high), solution))
        if failure is not None and not found:
            raise failure
        return min(found, key=lambda one: one.distance)

    def _target(self, r: Array, u: Array, solution: Solution | None, v: Array | None = None) -> Target:
        """The steady state of the plant, of several members the worst, at u and its v."""
        reached: Array = self.model.expand_inputs(u[None, :])[0] if v is None else v
        weights, points = self.weights, self._rests(u, reached)
        distances = [float(np.linalg.norm(weights * (y - r))) for _, y in points]
        distance, (x, y) = max(distances), points[int(np.argmax(distances))]
        scale = self.scale if self.moving else np.sum((weights * (np.abs(r) + np.abs(y))) ** 2)
        reachable = distance <= REACHED * (np.sqrt(scale) or 1.0)
        limiting = {} if reachable else self._limiting(solution, distance)
        return Target(r, y, u, reached, x, distance, reachable, limiting, solution, self.idle)

    def _rests(self, u: Array, v: Array) -> list[tuple[Array, Array]]:
        """Return the steady state and outputs of every member."""
        if self.feedback:
            return [self.model.equilibrium(u)]
        return [(one.rest_state(v), one.rest_output(v)) for one in self.members]

    def _limiting(self, solution: Solution | None, distance: float) -> dict[str, float]:
        """Actuators at a bound whose relaxation reduces the distance, with the multipliers of the distance."""
        if solution is None:
            return {f"actuator:{name}": float("nan") for name in self.model.inputs}
        prices = {}
        for name, dual in solution.duals.items():  # of the square of the distance
            side, _, word = name.partition(" ")
            if side in ("held", "least", "most"):
                prices[word] = prices.get(word, 0.0) + abs(float(dual[0])) / (2 * distance)
        least = ACTIVE * max([np.sqrt(self.scale), *prices.values()])
        kept = {word: price for word, price in prices.items() if price > least}
        return dict(sorted(kept.items(), key=lambda pair: -pair[1]))

    @property
    def idle(self) -> str:
        """The reason why nothing can be controlled, where no actuator has an effect; "" otherwise."""
        return "" if self.moving else f"nothing acts on {', '.join(self.model.outputs)}"

    def _read(self, reference: ArrayLike) -> Array:
        """Return a reference as an array (l,); refuse another size, and numbers that are not finite."""
        r = np.atleast_1d(np.asarray(reference, dtype=float))
        if r.shape != (self.model.l,) or not np.all(np.isfinite(r)):
            raise StructureError(f"reference of shape {r.shape}: it must be ({self.model.l},) finite numbers, one per "
                                 f"output ({', '.join(self.model.outputs)}).")
        return r

    def _solved(self, posed: "Problem", start: Mapping[str, Array]) -> Solution:
        """Return the solution of a problem from a start; `StructureError` where there is no point."""
        from optid.backends.choice import find
        from optid.core.statement import for_solvers
        from optid.solving.solve import solve

        program, solver = for_solvers(posed.beginning(start)), self.solver
        if isinstance(solver, str) and solver != "auto" and self.route == "nlp" and find(solver).refuses(program):
            solver = "auto"
        solution = solve(program, solver)
        if not solution.has_point or solution.status.value not in ("optimal", "locally optimal", "inaccurate"):
            said = solution.reason or solution.claimed
            raise StructureError(f"no steady state was found: {solution.status} ({said})")
        return solution

    def _inputs(self, v: Array) -> Array:
        """Return the inputs (m,) whose nonlinearities have the values v (r,); their bounds are kept exactly."""
        u = self.middle
        for value, one, c in zip(v, self.inverses, self.model.input_of):
            u[c] = float(one(value, float(u[c])))
        return np.clip(u, self.low, self.high)

    def corners(self) -> Array:
        """Return the corners (k, 2), in order, of the set of attainable steady outputs, without a shared limit.

        Raises:
            StructureError: other than two outputs, or a plant that is not linear in f(u).
        """
        if self.model.l != 2 or not self.linear:
            raise StructureError("The attainable set is drawn for two outputs and a plant that is linear in f(u); call "
                                 "attainable(reference) point by point.")
        gain, centre = self.members[0].gain(), self.members[0].rest_output(self.v_middle)
        edges = (gain * ((self.v_high - self.v_low) / 2)).T
        edges = edges[np.linalg.norm(edges, axis=1) > 0]
        angles = np.arctan2(edges[:, 1], edges[:, 0])
        flipped = (angles < 0) | (angles == np.pi)  # every edge points into the upper half plane
        edges = np.where(flipped[:, None], -edges, edges)[np.argsort(angles % np.pi)]
        half = centre - edges.sum(axis=0) + np.vstack([np.zeros(2), 2 * np.cumsum(edges, axis=0)])
        return np.vstack([half, 2 * centre - half[1:-1]]) if len(edges) > 1 else half

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """Names of the inputs that have an effect."""
        live = {c for one, c in zip(self.inverses, self.model.input_of) if not one.dead}
        return tuple(self.model.inputs[c] for c in sorted(live))

    def __str__(self) -> str:
        rows = [f"actuators that move: {', '.join(self.moving) or 'none'}; route {self.route}"]
        for one, c in zip(self.inverses, self.model.input_of):
            state = "does not move" if one.dead else f"f from {one.v_low:.4g} to {one.v_high:.4g}"
            rows.append(f"  {self.model.inputs[c]}: {state} over [{self.low[c]:.4g}, {self.high[c]:.4g}]")
        return "\n".join([*rows, *(f"  {message}" for message in self.messages)])


def allocate(
    model: HammersteinSS, *, low: ArrayLike | None = None, high: ArrayLike | None = None,
    weights: ArrayLike | None = None, norm: ArrayLike | None = None, limit: float = np.inf, route: str = "auto",
    solver: Any = "auto",
) -> Allocation:
    """Prepare the control of a plant within the bounds of its inputs.

    Args:
        model: the plant now; an actuator without effect has a constant nonlinearity.
        low: (m,) least inputs; the intervals of their bases by default.
        high: (m,) largest inputs.
        weights: (l,) of the outputs in distances and costs; ones by default.
        norm: (k, r) matrix S of a shared limit ‖S f(u)‖ <= `limit`.
        limit: of the norm; with a limit and no norm S is the identity.
        route: "qp", "nlp", or "auto": in f(u) where every f has an inverse, else in u.
        solver: back end of the programmes.

    Raises:
        StructureError: bounds that are missing or empty, weights that are not positive, an unknown route, a plant that
            the remaining actuators do not stabilise (with the mode).

    Warns:
        DataWarning: a nonlinearity without an inverse, with the interval, and the route taken instead.
    """
    if route not in ("auto", "qp", "nlp"):
        raise StructureError(f"route={route!r}: use 'auto', 'qp' or 'nlp'.")
    found = _within(model, low, high, weights, solver)
    inverses = found.inverses
    messages = [f"{model.inputs[c]}: {one.message}" for one, c in zip(inverses, model.input_of) if one.message]
    check_stabilisable(model, [i for i, one in enumerate(inverses) if not one.dead])
    if len(set(model.input_of)) < len(model.input_of):
        messages.append("an input acts through several nonlinearities: their values are not independent")
    if model.feedback:
        messages.append("the plant has nonlinear feedback: it is not linear in f(u)")
    if route == "qp" and not found.linear:
        raise StructureError(f"route 'qp' is not possible: {messages[-1]}. Use route='nlp'.")
    if messages and route == "auto":
        messages[-1] += "; the allocation falls back to the NLP route"
        warnings.warn("; ".join(messages), DataWarning, stacklevel=2)
    taken = route if route != "auto" else "nlp" if messages else "qp"
    if norm is not None or np.isfinite(limit):
        root = np.eye(len(inverses)) if norm is None else np.atleast_2d(np.asarray(norm, dtype=float))
        if root.shape[1] != len(inverses) or not limit > 0:
            raise StructureError(f"norm of shape {root.shape} and limit {limit!r}: the norm must have {len(inverses)} "
                                 "columns, and the limit must be positive.")
        found = replace(found, norm=root, limit=limit)
    return replace(found, route=taken, messages=tuple(messages))


def robust_allocation(model: HammersteinSS, members: Sequence[Damage], *, low: Any, high: Any, weights: Any,
                      solver: Any = "auto") -> Allocation:
    """Prepare the control of a plant with several explanations; arguments as of `allocate`.

    Every member has the gains and constants of v that the diagnosis estimates.

    Raises:
        StructureError: an input with several nonlinearities, a nonlinearity that turns back, or nonlinear feedback.
    """
    found = _within(model, low, high, weights, solver)
    if len(set(model.input_of)) < len(model.input_of) or any(one.turns for one in found.inverses):
        raise StructureError("The members share no v: an input has several nonlinearities, or one that turns back.")
    if model.feedback:
        raise StructureError("The model has nonlinear feedback: it is not linear in f(u). Use route='nlp'.")
    return replace(found, members=tuple(Member.of(model, one.gains, one.constants, one.added) for one in members))


def _within(model: HammersteinSS, low: Any, high: Any, weights: Any, solver: Any) -> Allocation:
    least, most = input_bounds(model, low, high)
    w = np.ones(model.l) if weights is None else np.broadcast_to(np.asarray(weights, dtype=float), (model.l,)).copy()
    if not np.all(np.isfinite(w) & (w > 0)):
        raise StructureError(f"weights {w.tolist()}: they must be positive numbers, one per output.")
    inverses = tuple(inverse(f, least[c], most[c]) for f, c in zip(model.nonlinearities, model.input_of))
    return Allocation(model, least, most, w, inverses, (Member.of(model),), np.array([one.v_low for one in inverses]),
                      np.array([one.v_low if one.dead else one.v_high for one in inverses]), solver=solver)


def input_bounds(model: HammersteinSS, low: Any, high: Any) -> tuple[Array, Array]:
    """Return the least and largest inputs (m,), those of the bases where none are given.

    Raises:
        StructureError: bounds that are missing, empty or not finite, or other than one or one per input.
    """
    ends = []
    for word, given, side in (("low", low, 0), ("high", high, 1)):
        if given is not None:
            numbers = np.asarray(given, dtype=float)
            if numbers.shape not in ((), (1,), (model.m,)):
                raise StructureError(f"{word}={numbers.tolist()}: it must be one number, or one per input ({model.m}).")
            ends.append(np.broadcast_to(numbers, (model.m,)).copy())
            continue
        found = np.full(model.m, np.nan)
        for f, c in zip(model.nonlinearities, model.input_of):
            if f.basis.interval is not None:
                found[c] = f.basis.interval[side]
        if np.isnan(found).any():
            name = model.inputs[int(np.argmax(np.isnan(found)))]
            raise StructureError(f"input {name!r} has no interval: give {word}=, one number per input.")
        ends.append(found)
    if not np.all(np.isfinite(ends[0]) & np.isfinite(ends[1]) & (ends[0] < ends[1])):
        c = int(np.argmin(ends[0] < ends[1]))
        raise StructureError(
            f"the range of input {model.inputs[c]!r}, [{ends[0][c]:g}, {ends[1][c]:g}], is empty or not finite.")
    return ends[0], ends[1]
