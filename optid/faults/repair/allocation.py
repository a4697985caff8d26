"""Control of a damaged plant with the actuators that are left: what can be reached, and how."""

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataWarning, StructureError
from optid.faults.repair.allocation_problem import AllocationProblem, Member
from optid.faults.repair.inversion import Inverse, inverse
from optid.faults.repair.virtual_sensor import check_stabilisable

if TYPE_CHECKING:
    from optid.faults.repair.control import Controller
    from optid.models import HammersteinSS
    from optid.program.solution import Solution

REACHED = 1e-4
"""A target is reached when its distance is below this share of the scale of the outputs."""

ACTIVE = 1e-6
"""A bound limits when its multiplier is above this share of the largest."""


@dataclass(frozen=True, eq=False)
class Target:
    """The resting point nearest to a reference.

    Attributes:
        reference: (l,) outputs wanted.
        y: (l,) outputs at rest.
        u: (m,) inputs there.
        v: (r,) their f.
        x: (n,) state there.
        distance: weighted distance of y from the reference.
        reachable: whether there is none to speak of.
        limiting: {actuator: by how much the distance falls per unit of v by which its bound moves}, the most limiting
            first; empty where the reference is reached.
        solution: of the programme behind it; None on the NLP route.
        idle: why nothing can be done, where no actuator is left; "" otherwise.
    """

    reference: Array
    y: Array
    u: Array
    v: Array
    x: Array
    distance: float
    reachable: bool
    limiting: dict[str, float]
    solution: "Solution | None" = field(default=None, repr=False)
    idle: str = ""

    def __str__(self) -> str:
        """Say whether it is reached, how near one gets, and what is in the way."""
        wanted, got = (", ".join(f"{value:.4g}" for value in point) for point in (self.reference, self.y))
        if self.reachable:
            return f"({wanted}) is reached with inputs ({', '.join(f'{value:.4g}' for value in self.u)})"
        if self.idle:
            return f"({wanted}) is not reachable: {self.idle}; the outputs rest at ({got}) whatever the inputs are"
        words = ", ".join(f"{name} ({price:.3g} per unit)" for name, price in self.limiting.items())
        limit = f"; limited by {words}" if words else ""
        return f"({wanted}) cannot be reached: nearest is ({got}), weighted distance {self.distance:.4g}{limit}"


@dataclass(frozen=True, eq=False)
class Allocation:
    """What a plant can still do; `attainable` and `controller` use it.

    Attributes:
        model: the plant as it is now.
        problem: what is left of it in v = f(u); None where it is not linear in v.
        inverses: f^-1 of every function of the inputs.
        low: (m,) least inputs.
        high: (m,) largest inputs.
        weights: (l,) of the outputs.
        route: "qp" (in v, exact), or "nlp" (in u, by IPOPT).
        messages: why the route is what it is, and what is not as it was.
        solver: back end of the programmes.
    """

    model: "HammersteinSS"
    problem: AllocationProblem | None
    inverses: tuple[Inverse, ...]
    low: Array
    high: Array
    weights: Array
    route: str
    messages: tuple[str, ...] = ()
    solver: Any = "auto"

    def attainable(self, reference: ArrayLike) -> Target:
        """Return the resting point nearest to a reference, its weighted distance, and the actuators that limit it.

        Args:
            reference: (l,) outputs wanted.

        Raises:
            StructureError: a reference of the wrong size or not finite, or a solver that finds no point.
        """
        r = self._reference(reference)
        if not self.moving:
            return self._idle(r)
        if self.route == "nlp":
            return self._resting(r)
        from optid.registry import fault_formulation
        from optid.solving.solve import solve

        assert self.problem is not None
        program = fault_formulation("allocation.target")(self.problem, reference=r)
        solution = solve(program, self.solver)
        if not solution.has_point or solution.status.value not in ("optimal", "locally optimal", "inaccurate"):
            why = solution.reason or solution.claimed
            raise StructureError(f"no resting point was found: {solution.status} ({why})")
        v = np.clip(solution.values["v"], self.problem.low, self.problem.high)
        member = self.problem.members[0]
        x, y = member.rest_state(v), member.rest_output(v)
        distance = float(np.linalg.norm(self.weights * (y - r)))
        reachable = distance <= REACHED * np.sqrt(self.problem.scale)
        limiting = {} if reachable else self._limiting(v, y - r, distance)
        return Target(r, y, self.inputs(v), v, x, distance, reachable, limiting, solution)

    @property
    def idle(self) -> str:
        """Why nothing can be controlled, where no actuator moves; "" otherwise."""
        return "" if self.moving else f"nothing acts on {', '.join(self.model.outputs)}"

    def _idle(self, r: Array) -> Target:
        """Where the outputs come to rest by themselves, every actuator where it stands."""
        u = (self.low + self.high) / 2
        x, y = self.model.equilibrium(u)
        distance = float(np.linalg.norm(self.weights * (y - r)))
        scale = float(np.linalg.norm(self.weights * (np.abs(r) + np.abs(y)))) or 1.0
        reached = distance <= REACHED * scale
        limiting = {} if reached else {f"actuator:{name}": float("nan") for name in self.model.inputs}
        return Target(r, y, u, self.model.expanded(u[None, :])[0], x, distance, reached, limiting, None, self.idle)

    def _limiting(self, v: Array, miss: Array, distance: float) -> dict[str, float]:
        """Actuators at a bound beyond which the outputs would come nearer, with the multipliers of the distance."""
        assert self.problem is not None
        slopes = (self.weights * (self.weights * miss)) @ self.problem.members[0].gain() / distance
        prices = {}
        for i, word in enumerate(self.problem.names):
            held = self.problem.low[i] == self.problem.high[i]
            slack = 1e-6 * self.problem.half[i]
            at_low, at_high = v[i] <= self.problem.low[i] + slack, v[i] >= self.problem.high[i] - slack
            if held or (at_low and slopes[i] > 0) or (at_high and slopes[i] < 0):
                prices[word] = abs(float(slopes[i]))
        largest = max(prices.values(), default=0.0)
        kept = {word: price for word, price in prices.items() if price > ACTIVE * largest}
        return dict(sorted(kept.items(), key=lambda pair: -pair[1]))

    def _resting(self, r: Array) -> Target:
        from optid.registry import fault_formulation

        find = fault_formulation("allocation.resting")
        best: Any = None
        for start in self._starts():
            u, x, y, _ = find(self.model, self.low, self.high, self.weights, r, start)
            distance = float(np.linalg.norm(self.weights * (y - r)))
            if best is None or distance < best[0]:
                best = distance, u, x, y
        distance, u, x, y = best
        scale = float(np.linalg.norm(self.weights * (np.abs(r) + np.abs(y)))) or 1.0
        reachable = distance <= REACHED * scale
        slack = 1e-4 * (self.high - self.low)
        held = (u <= self.low + slack) | (u >= self.high - slack)
        limiting = {} if reachable else {
            f"actuator:{name}": float("nan") for name, bound in zip(self.model.inputs, held) if bound
        }
        return Target(r, y, u, self.model.expanded(u[None, :])[0], x, distance, reachable, limiting)

    def _starts(self) -> list[Array]:
        middle, third = (self.low + self.high) / 2, (self.high - self.low) / 3
        return [middle, middle + third, middle - third]

    def _reference(self, reference: ArrayLike) -> Array:
        r = np.atleast_1d(np.asarray(reference, dtype=float))
        if r.shape != (self.model.l,) or not np.all(np.isfinite(r)):
            raise StructureError(
                f"reference of shape {r.shape}: ({self.model.l},) finite numbers are needed, one per output "
                f"({', '.join(self.model.outputs)})."
            )
        return r

    def inputs(self, v: Array, near: Array | None = None) -> Array:
        """Return the inputs (m,) whose nonlinearities have the values v (r,); their bounds are kept exactly."""
        u = (self.low + self.high) / 2 if near is None else np.array(near, dtype=float)
        for i, (one, c) in enumerate(zip(self.inverses, self.model.input_of)):
            u[c] = float(one(np.array(v[i]), float(u[c])))
        return np.clip(u, self.low, self.high)

    def corners(self) -> Array:
        """Return the corners (k, 2) of the set of outputs that can be held at rest, two outputs, in order.

        With a limit that the actuators share this is the set without it.

        Raises:
            StructureError: other than two outputs, or the NLP route.
        """
        if self.model.l != 2 or self.problem is None:
            raise StructureError(
                "The attainable set is drawn for two outputs and a plant that is linear in f(u); ask "
                "attainable(reference) point by point."
            )
        gain, centre = self.problem.members[0].gain(), self.problem.members[0].rest_output(self.problem.middle)
        edges = (gain * ((self.problem.high - self.problem.low) / 2)).T
        edges = edges[np.linalg.norm(edges, axis=1) > 0]
        if not len(edges):
            return centre[None, :]
        edges = np.where((edges[:, [1]] < 0) | ((edges[:, [1]] == 0) & (edges[:, [0]] < 0)), -edges, edges)
        edges = edges[np.argsort(np.arctan2(edges[:, 1], edges[:, 0]))]
        start = centre - edges.sum(axis=0)
        half = start + np.vstack([np.zeros(2), 2 * np.cumsum(edges, axis=0)])
        return np.asarray(np.vstack([half, 2 * centre - half[1:-1]]) if len(edges) > 1 else half)

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """Names of the inputs that still move something."""
        live = {c for one, c in zip(self.inverses, self.model.input_of) if not one.dead}
        return tuple(self.model.inputs[c] for c in sorted(live))

    def controller(self, horizon: int = 40, *, effort: float = 1e-3, rates: ArrayLike | None = None,
                   route: str | None = None) -> "Controller":
        """Return a predictive controller for this plant; see `optid.faults.repair.control.Controller`."""
        from optid.faults.repair.control import Controller

        if self.idle:
            rest = ", ".join(f"{value:.4g}" for value in self.model.equilibrium((self.low + self.high) / 2)[1])
            raise StructureError(
                f"not reachable: {self.idle}, so that there is nothing to control. The outputs rest at ({rest}); "
                "attainable(reference) says how far that is from a reference, and the observer goes on watching."
            )
        return Controller(self, horizon, effort=effort, rates=rates, route=route or self.route)

    def __str__(self) -> str:
        """Say which actuators are left and by which route."""
        rows = [f"actuators that move: {', '.join(self.moving) or 'none'}; route {self.route}"]
        for one, c in zip(self.inverses, self.model.input_of):
            state = "does not move" if one.dead else f"f from {one.v_low:.4g} to {one.v_high:.4g}"
            rows.append(f"  {self.model.inputs[c]}: {state} over [{self.low[c]:.4g}, {self.high[c]:.4g}]")
        return "\n".join([*rows, *(f"  {message}" for message in self.messages)])


def allocate(
    model: "HammersteinSS", *, low: ArrayLike | None = None, high: ArrayLike | None = None,
    weights: ArrayLike | None = None, norm: ArrayLike | None = None, limit: float = np.inf, route: str = "auto",
    solver: Any = "auto",
) -> Allocation:
    """Prepare the control of a plant within the bounds of its inputs.

    Args:
        model: the plant as it is now; an actuator that moves nothing has a constant nonlinearity.
        low: (m,) least inputs; the intervals of their bases by default.
        high: (m,) largest inputs.
        weights: (l,) of the outputs in distances and costs; ones by default.
        norm: (k, r) matrix S of a limit ‖S f(u)‖ <= `limit` that the actuators share.
        limit: of the norm; with a limit and no norm S is the identity.
        route: "qp", "nlp", or "auto": in f(u) where every f has an inverse, else in u.
        solver: back end of the programmes.

    Raises:
        StructureError: bounds that are missing or empty, weights that are not positive, an unknown route, a plant that
            is not stabilisable by what is left (with the mode).

    Warns:
        DataWarning: a nonlinearity without an inverse, with the interval, and the route taken instead.
    """
    if route not in ("auto", "qp", "nlp"):
        raise StructureError(f"route={route!r}: use 'auto', 'qp' or 'nlp'.")
    least, most = _bounds(model, low, high)
    w = np.ones(model.l) if weights is None else np.broadcast_to(np.asarray(weights, dtype=float), (model.l,)).copy()
    if not np.all(np.isfinite(w) & (w > 0)):
        raise StructureError(f"weights {w.tolist()}: positive numbers are needed, one per output.")
    inverses = tuple(inverse(f, least[c], most[c]) for f, c in zip(model.nonlinearities, model.input_of))
    messages = [
        f"{model.inputs[c]}: {one.message}" for one, c in zip(inverses, model.input_of) if one.message
    ]
    check_stabilisable(model, [i for i, one in enumerate(inverses) if not one.dead])
    several = len(set(model.input_of)) < len(model.input_of)
    linear = not model.feedback and not several
    if several:
        messages.append("an input acts through several nonlinearities: their values are not free of one another")
    if model.feedback:
        messages.append("the plant has nonlinear feedback: it is not linear in f(u)")
    if route == "qp" and not linear:
        raise StructureError(f"route 'qp' is not possible: {messages[-1]}. Use route='nlp'.")
    taken = route if route != "auto" else "qp" if linear and not messages else "nlp"
    if taken == "nlp" and norm is not None:
        raise StructureError("A limit that actuators share is a cone in f(u); the route 'nlp' does not take it.")
    if messages and route == "auto":
        messages[-1] += "; the allocation falls back to the NLP route"
        warnings.warn("; ".join(messages), DataWarning, stacklevel=2)
    problem = None
    if linear:
        root = None
        if norm is not None or np.isfinite(limit):
            root = np.eye(len(inverses)) if norm is None else np.atleast_2d(np.asarray(norm, dtype=float))
            if root.shape[1] != len(inverses) or not limit > 0:
                raise StructureError(f"norm of shape {root.shape} and limit {limit!r}: ({len(inverses)} columns, and a "
                                     "positive limit are needed.")
        problem = AllocationProblem(
            (Member.of(model),), np.array([one.v_low for one in inverses]),
            np.array([one.v_low if one.dead else one.v_high for one in inverses]),
            tuple(f"actuator:{model.inputs[c]}" for c in model.input_of), model.outputs, w, root, limit,
        )
    return Allocation(model, problem, inverses, least, most, w, taken, tuple(messages), solver)


def _bounds(model: "HammersteinSS", low: Any, high: Any) -> tuple[Array, Array]:
    ends = []
    for word, given, side in (("low", low, 0), ("high", high, 1)):
        if given is not None:
            ends.append(np.broadcast_to(np.asarray(given, dtype=float), (model.m,)).copy())
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
            f"the range of input {model.inputs[c]!r}, [{ends[0][c]:g}, {ends[1][c]:g}], is empty or not finite."
        )
    return ends[0], ends[1]


