"""Predictive control in v = f(u): a quadratic over a box, compiled, and u = f^-1(v)."""

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_integer
from optid.errors import DataWarning, StructureError

if TYPE_CHECKING:
    from optid.faults.repair.allocation import Allocation

STEPS = 200
"""Projected Newton steps at most; five or six are usual."""

TOLERANCE = 1e-9
"""Projected gradient, relative, at which the compiled solver stops."""

CONVEXIFIED = 3
"""Rounds in which the limits of the rates are convexified anew."""


@dataclass(frozen=True, eq=False)
class Move:
    """What a controller does at one sample.

    Attributes:
        u: (m,) inputs, within their bounds.
        v: (r,) their f.
        reachable: whether the reference can be held.
        route: "qp" (compiled), "program" (by a back end) or "nlp".
        residual: of the optimality conditions, relative; NaN where a back end judged its point itself.
    """

    u: Array
    v: Array
    reachable: bool
    route: str
    residual: float


class Controller:
    """Model predictive control of a plant within the bounds of its inputs.

    The cost is ‖W (y_k - r)‖² over the horizon, with a small weight on the distance of v from that of the resting
    point, and the cost to go of the plant at rest. Calls of `step` start from the solution of the one before.

    Args:
        allocation: what is left of the plant.
        horizon: samples.
        effort: weight of the distance of v (of u on the NLP route) from its resting value.
        rates: (m,) largest step of each input.
        route: "qp" or "nlp".

    Raises:
        StructureError: a route that the plant does not allow.
    """

    def __init__(self, allocation: "Allocation", horizon: int = 40, *, effort: float = 1e-3,
                 rates: ArrayLike | None = None, route: str = "qp") -> None:
        if route not in ("qp", "nlp"):
            raise StructureError(f"route={route!r}: use 'qp' or 'nlp'.")
        if route == "qp" and allocation.problem is None:
            raise StructureError("The plant is not linear in f(u): use route='nlp'.")
        self.horizon = check_integer(horizon, "horizon")
        self.allocation, self.effort, self.route = allocation, float(effort), route
        m = allocation.model.m
        self.rates = None if rates is None else np.broadcast_to(np.asarray(rates, dtype=float), (m,)).copy()
        if self.rates is not None and not np.all(self.rates > 0):
            raise StructureError(f"rates {self.rates.tolist()}: positive numbers are needed, one per input.")
        self._goals: dict[bytes, Any] = {}
        self._last: Array | None = None
        self._warned: set[bytes] = set()
        self._program: Any = None
        self._tracker: Any = None
        if route == "qp":
            self._condense()

    def _condense(self) -> None:
        """Write the cost as z' H z / 2 + (rows [x; r; v_s])' z."""
        problem = self.allocation.problem
        assert problem is not None
        member, N, r = problem.members[0], self.horizon, problem.columns
        n, l = member.A.shape[0], member.C.shape[0]  # noqa: E741
        powers = [np.eye(n)]
        for _ in range(N):
            powers.append(member.A @ powers[-1])
        forced = np.zeros((N + 1, n, N * r))
        free = np.array(powers)
        fixed = np.zeros((N + 1, n))
        for k in range(N):
            forced[k + 1] = member.A @ forced[k]
            forced[k + 1, :, k * r : (k + 1) * r] += member.B
            fixed[k + 1] = member.A @ fixed[k] + member.d
        W = problem.weights
        outputs = np.einsum("ij,kjq->kiq", member.C, forced[:-1])
        for k in range(N):
            outputs[k, :, k * r : (k + 1) * r] += member.D
        root = problem.terminal_root(0)
        rows = np.vstack([(W[:, None] * outputs).reshape(N * l, -1), root @ forced[N]])
        by_state = np.vstack([(W[:, None] * (member.C @ free[:-1])).reshape(N * l, n), root @ free[N]])
        rest = np.linalg.pinv(np.eye(n) - member.A)
        constant = np.concatenate([
            (W * (fixed[:-1] @ member.C.T + member.c)).ravel(), root @ (fixed[N] - rest @ member.d)
        ])
        by_reference = np.vstack([np.tile(-np.diag(W), (N, 1)), np.zeros((n, l))])
        by_goal = np.vstack([np.zeros((N * l, r)), -root @ rest @ member.B])
        moved = self.effort * problem.scale / problem.half**2
        self.H = 2 * (rows.T @ rows + np.diag(np.tile(moved, N)))
        self.by_state, self.by_reference = 2 * rows.T @ by_state, 2 * rows.T @ by_reference
        self.by_goal = 2 * rows.T @ by_goal - 2 * np.tile(np.diag(moved), (N, 1))
        self.constant = 2 * rows.T @ constant
        self.low, self.high = np.tile(problem.low, N), np.tile(problem.high, N)

    def step(self, x: ArrayLike, reference: ArrayLike, previous: ArrayLike | None = None) -> Move:
        """Return the inputs of this sample.

        Args:
            x: (n,) predicted state of this sample.
            reference: (l,) outputs wanted.
            previous: (m,) inputs of the sample before; needed with rates.

        Raises:
            StructureError: sizes that do not fit, or rates without the inputs before.

        Warns:
            DataWarning: a reference that cannot be reached, once for each.
        """
        r = self.allocation._reference(reference)
        state = np.asarray(x, dtype=float)
        if state.shape != (self.allocation.model.nx,):
            raise StructureError(f"state of shape {state.shape}: ({self.allocation.model.nx},) is needed.")
        if self.rates is not None and previous is None:
            raise StructureError("With rates the inputs of the sample before are needed: previous=(m,).")
        before = None if previous is None else np.asarray(previous, dtype=float)
        goal = self._goal(r)
        if self.route == "nlp":
            return self._by_nlp(state, r, goal, before)
        assert self.allocation.problem is not None
        if self.rates is not None or self.allocation.problem.norm is not None:
            return self._by_program(state, r, goal, before)
        z, residual = self._quadratic(state, r, goal.v)
        self._last = z
        v = z[: self.allocation.problem.columns]
        return Move(self._inputs(v, before), v, goal.reachable, "qp", residual)

    def _quadratic(self, x: Array, r: Array, goal: Array) -> tuple[Array, float]:
        from optid.faults.repair.box_kernel import box_quadratic

        g = self.by_state @ x + self.by_reference @ r + self.by_goal @ goal + self.constant
        width = goal.size
        z = np.tile(goal, self.horizon) if self._last is None else np.append(self._last[width:], self._last[-width:])
        found: Any = box_quadratic(self.H, g, self.low, self.high, z, STEPS, TOLERANCE)
        return z, float(found[0])

    def _inputs(self, v: Array, before: Array | None) -> Array:
        a = self.allocation
        if any(one.refused and not one.dead for one in a.inverses):
            return a.inputs(v, before)
        u = np.array((a.low + a.high) / 2)
        for i, (one, c) in enumerate(zip(a.inverses, a.model.input_of)):
            if not one.dead:
                u[c] = one.quick(v[i])
        return np.minimum(np.maximum(u, a.low), a.high)

    def _goal(self, r: Array) -> Any:
        key = r.tobytes()
        if key not in self._goals:
            if len(self._goals) > 1000:  # a reference that never rests
                self._goals.clear()
            goal = self._goals[key] = self.allocation.attainable(r)
            if not goal.reachable and key not in self._warned:
                self._warned.add(key)
                warnings.warn(str(goal), DataWarning, stacklevel=4)
        return self._goals[key]

    def _by_program(self, x: Array, r: Array, goal: Any, before: Array | None) -> Move:
        from optid.registry import fault_formulation
        from optid.solving.solve import solve

        a, pose = self.allocation, fault_formulation("allocation.track")
        assert a.problem is not None
        how: dict[str, Any] = {"reference": r, "states": [x], "goal": goal.v, "horizon": self.horizon,
                               "effort": self.effort}
        width = a.problem.columns
        if self.rates is None:
            if self._program is None:
                self._program = pose(a.problem, **how)
            for name, value in (("reference", r), ("goal", goal.v), ("state", x),
                                ("rest", a.problem.members[0].rest_state(goal.v))):
                self._program.parameters[name].value = value
            solution = solve(self._program, a.solver, prove=False)
        else:
            assert before is not None
            course = np.tile(goal.u if self._last is None else before, (self.horizon, 1))
            solution = None
            for _ in range(CONVEXIFIED):
                rates = self._steps(np.vstack([before, course[:-1]]))
                v_before = a.model.expanded(before[None, :])[0]
                solution = solve(pose(a.problem, **how, rates=rates, previous=v_before), a.solver, prove=False)
                if not solution.has_point:
                    break
                course = np.array([a.inputs(v, before) for v in solution.values["v"]])
        if solution is None or not solution.has_point:
            raise StructureError(f"the controller found no point: {solution.status if solution else ''}")
        v = np.clip(np.asarray(solution.values["v"])[0], a.problem.low, a.problem.high)
        self._last = np.ravel(solution.values["v"])
        u = a.inputs(v, before)
        if self.rates is not None and before is not None:
            u = np.clip(u, before - self.rates, before + self.rates)
            u = np.clip(u, a.low, a.high)
        assert width == v.size
        return Move(u, v, goal.reachable, "program", float("nan"))

    def _steps(self, before: Array) -> tuple[Array, Array]:
        """Bounds of the steps of v from inputs (horizon, m) on: exact for the first, by local slopes for the others."""
        a, (low, high) = self.allocation, (np.empty((self.horizon, len(self.allocation.inverses))) for _ in range(2))
        assert self.rates is not None
        for i, (one, c) in enumerate(zip(a.inverses, a.model.input_of)):
            here = np.asarray(one.f(before[:, c]))
            down = np.asarray(one.f(np.clip(before[:, c] - self.rates[c], a.low[c], a.high[c]))) - here
            up = np.asarray(one.f(np.clip(before[:, c] + self.rates[c], a.low[c], a.high[c]))) - here
            low[:, i], high[:, i] = np.minimum(down, up), np.maximum(down, up)
        return low, high

    def _by_nlp(self, x: Array, r: Array, goal: Any, before: Array | None) -> Move:
        from optid.registry import fault_formulation

        a = self.allocation
        if self._tracker is None:
            terminal = a.problem.terminal_root(0) if a.problem is not None else np.zeros((a.model.nx, a.model.nx))
            scale = a.problem.scale if a.problem is not None else float(np.sum(a.weights**2))
            self._tracker = fault_formulation("allocation.nonlinear")(
                a.model, a.low, a.high, a.weights, terminal, horizon=self.horizon, effort=self.effort * scale,
                rates=self.rates,
            )
        now = goal.u if before is None else before
        start = np.tile(goal.u, (self.horizon, 1))
        if self._last is not None:
            start = np.vstack([self._last.reshape(self.horizon, -1)[1:], self._last.reshape(self.horizon, -1)[-1:]])
        elif a.problem is not None and self.rates is None:  # the programme in v is exact but for the choice of u
            start = self._from_quadratic(x, r, goal, now)
        u, _, word = self._tracker.solve(x, r, (goal.u, goal.x), now, start)
        if word not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            warnings.warn(f"IPOPT ended with {word}; its last point is used", DataWarning, stacklevel=3)
        self._last = u.ravel()
        return Move(u[0], a.model.expanded(u[:1])[0], goal.reachable, "nlp", float("nan"))

    def _from_quadratic(self, x: Array, r: Array, goal: Any, near: Array) -> Array:
        twin = Controller(replace(self.allocation, route="qp"), self.horizon, effort=self.effort, route="qp")
        z, _ = twin._quadratic(x, r, goal.v)
        rows = []
        for v in z.reshape(self.horizon, -1):
            near = self.allocation.inputs(v, near)
            rows.append(near)
        return np.array(rows)


