"""Predictive control: in v = f(u) a quadratic over a box and u = f^-1(v), or a programme for a back end."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_integer
from optid.errors import DataWarning, StructureError

if TYPE_CHECKING:
    from optid.faults.repair.allocation import Allocation, Target
    from optid.program.program import Program

STEPS = 200
"""Projected Newton steps at most; five or six are usual."""

TOLERANCE = 1e-9
"""Projected gradient, relative, at which the own solver stops."""


@dataclass(frozen=True, eq=False)
class Move:
    """The move of a controller at one sample."""

    u: Array  # (m,) inputs, within their bounds
    v: Array  # (r,) their f
    reachable: bool  # whether the reference can be held
    route: str  # "qp" (own solver), "program" (in v, by a back end) or "nlp" (in u, by a back end)
    residual: float  # of the optimality conditions, relative; NaN with a back end


class Controller:
    """Model predictive control of a plant within the bounds of its inputs.

    The cost is ‖W (y_k - r)‖² over the horizon, with a small weight on the distance of v from its steady value, and the
    cost to go. `step` is warm-started by the solution of the sample before.

    Args:
        allocation: the plant and its bounds.
        horizon: samples.
        effort: weight of the distance of v (of u on the NLP route) from its steady value.
        rates: (m,) largest step of each input; with them the programme is the one in u.
        route: "qp" or "nlp".

    Raises:
        StructureError: a route that the plant does not allow.
    """

    def __init__(self, allocation: "Allocation", horizon: int = 40, *, effort: float = 1e-3,
                 rates: ArrayLike | None = None, route: str = "qp") -> None:
        if route not in ("qp", "nlp"):
            raise StructureError(f"route={route!r}: use 'qp' or 'nlp'.")
        problem, m = allocation.problem, allocation.model.m
        if route == "qp" and not problem.linear:
            raise StructureError("The plant is not linear in f(u): use route='nlp'.")
        self.horizon = check_integer(horizon, "horizon")
        self.allocation, self.effort = allocation, float(effort)
        self.rates = None if rates is None else np.broadcast_to(np.asarray(rates, dtype=float), (m,)).copy()
        if self.rates is not None and not np.all(self.rates > 0):
            raise StructureError(f"rates {self.rates.tolist()}: they must be positive numbers, one per input.")
        several = len(problem.members) > 1
        if several and self.rates is not None:
            raise StructureError("Rates are bounds of the inputs, and several members share no input: leave them out.")
        self.route = "nlp" if route == "nlp" or self.rates is not None else "qp"
        if self.route == "qp" and (several or problem.norm is not None):
            self.route = "program"
        self._goals: dict[bytes, Target] = {}
        self._z: Array | None = None
        self._program: Program | None = None
        if problem.linear:
            self._condense()

    def _condense(self) -> None:
        """Write the cost as ‖S [z; p]‖², z = (v_0, v_1, ...), p = (x, r, v_s, 1)."""
        problem, N = self.allocation.problem, self.horizon
        member, W, r = problem.members[0], problem.weights[:, None], problem.low.size
        n, l = member.A.shape[0], W.size  # noqa: E741
        picks = np.split(np.eye(N * r + n + l + r + 1), np.cumsum([*[r] * N, n, l, r]))
        *moves, x, reference, goal, one = picks
        rows = []
        for v in moves:
            rows.append(W * (member.C @ x + member.D @ v + member.c[:, None] @ one - reference))
            x = member.A @ x + member.B @ v + member.d[:, None] @ one
        rest = np.linalg.pinv(np.eye(n) - member.A) @ (member.B @ goal + member.d[:, None] @ one)
        rows.append(member.terminal_root(problem) @ (x - rest))
        size = np.sqrt(self.effort * problem.scale) / problem.half[:, None]
        S = np.vstack([*rows, *(size * (v - goal) for v in moves)])
        self.H, self.by_given = 2 * S[:, : N * r].T @ S[:, : N * r], 2 * S[:, : N * r].T @ S[:, N * r :]
        self.low, self.high = np.tile(problem.low, N), np.tile(problem.high, N)

    def step(self, x: ArrayLike | Sequence[ArrayLike], reference: ArrayLike, previous: ArrayLike | None = None) -> Move:
        """Return the inputs of this sample.

        Args:
            x: (n,) predicted state of this sample; one for each of several members.
            reference: (l,) desired outputs.
            previous: (m,) inputs of the sample before; needed with rates.

        Raises:
            StructureError: sizes that do not fit, rates without the inputs before, or a solver that finds no point.

        Warns:
            DataWarning: a reference that cannot be reached, once for each reference.
        """
        a = self.allocation
        r, states = a.checked(reference), np.atleast_2d(np.asarray(x, dtype=float))
        if len(states) != len(a.problem.members):
            raise StructureError(f"{len(states)} states for {len(a.problem.members)} members ({', '.join(a.labels)}).")
        if states.shape[1] != a.model.nx:
            raise StructureError(f"state of shape {states.shape[1:]}: it must be ({a.model.nx},).")
        if self.rates is not None and previous is None:
            raise StructureError("With rates give the inputs of the sample before: previous=(m,).")
        before = None if previous is None else np.asarray(previous, dtype=float)
        goal = self._goal(r)
        if self.route != "qp":
            return self._by_program(states, r, goal, before)
        residual = self._quadratic(states[0], r, goal)
        assert self._z is not None
        v = self._z[: a.problem.low.size]
        return Move(a.inputs(v, before), v, goal.reachable, "qp", residual)

    def _goal(self, r: Array) -> "Target":
        """Return the steady state nearest to a reference, cached by the reference."""
        key = r.tobytes()
        if key not in self._goals:
            if len(self._goals) > 1000:  # a reference that changes all the time
                self._goals.clear()
            self._goals[key] = self.allocation.attainable(r)
            if not self._goals[key].reachable:
                warnings.warn(str(self._goals[key]), DataWarning, stacklevel=3)
        return self._goals[key]

    def _quadratic(self, x: Array, r: Array, goal: "Target") -> float:
        """Solve in v from the last solution, one sample on; return the residual."""
        width = goal.v.size
        start = np.tile(goal.v, self.horizon) if self._z is None else np.append(self._z[width:], self._z[-width:])
        g = self.by_given @ np.concatenate([x, r, goal.v, [1.0]])
        self._z, residual = box_quadratic(self.H, g, self.low, self.high, start)
        return residual

    def _by_program(self, states: Array, r: Array, goal: "Target", before: Array | None) -> Move:
        from optid.registry import fault_formulation

        a, inputs = self.allocation, self.route == "nlp"
        rests = [goal.x] if inputs else [member.rest_state(goal.v) for member in a.problem.members]
        given: dict[str, Any] = {"reference": r, "goal": goal.u if inputs else goal.v}
        program = self._program
        if program is None:
            how = {"horizon": self.horizon, "effort": self.effort, "states": states, "rests": rests, **given}
            if inputs:
                how |= {"rates": self.rates, "previous": before}
            formulation = fault_formulation("allocation.nonlinear" if inputs else "allocation.track")
            program = self._program = formulation(a.problem, **how)
        for number, (state, rest) in enumerate(zip(states, rests)):
            label = f"[{number + 1}]" if len(states) > 1 else ""
            given |= {f"state{label}": state, f"rest{label}": rest}
        if self.rates is not None:
            given["previous"] = before
        for name, value in given.items():
            program.parameters[name].value = value
        start = self._course(states[0], r, goal, before) if inputs else {}
        solution = a.solved(program, start, prove=False)
        if solution.status.value == "inaccurate":
            warnings.warn(f"the programme of the controller ended inaccurate ({solution.reason}); its point is used",
                          DataWarning, stacklevel=3)
        if not inputs:
            v = np.clip(solution.values["v"][0], a.problem.low, a.problem.high)
            return Move(a.inputs(v, before), v, goal.reachable, "program", float("nan"))
        u = np.clip(solution.values["u"][0], a.low, a.high)
        if self.rates is not None and before is not None:
            u = np.clip(u, before - self.rates, before + self.rates)
        return Move(u, a.model.expanded(u[None, :])[0], goal.reachable, "nlp", float("nan"))

    def _course(self, x: Array, r: Array, goal: "Target", near: Array | None) -> dict[str, Array]:
        """Return a start of the programme in u: the solution in v where there is one, else the steady state."""
        a = self.allocation
        u = np.tile(goal.u, (self.horizon, 1))
        if a.problem.linear:
            self._quadratic(x, r, goal)
            assert self._z is not None
            for k, v in enumerate(self._z.reshape(self.horizon, -1)):
                near = u[k] = a.inputs(v, near)
        one, states, columns, outputs = a.problem.members[0], [x], [], []
        for now in u:
            y = one.C @ states[-1] + one.D @ a.columns(now, np.zeros(a.model.l)) + one.c  # g(y) adds to no output
            columns.append(a.columns(now, y))
            states.append(one.A @ states[-1] + one.B @ columns[-1] + one.d)
            outputs.append(y)
        return {"u": u, "v": np.array(columns), "x": np.array(states), "y": np.array(outputs)}


def box_quadratic(H: Array, g: Array, low: Array, high: Array, z: Array) -> tuple[Array, float]:
    """Minimise z' H z / 2 + g' z over low <= z <= high by projected Newton steps (Bertsekas 1982), from z (q,).

    H (q, q) is positive definite. Returned are the solution and the largest component of its projected gradient,
    relative to that of g.
    """
    z, scale, residual = np.clip(z, low, high), max(float(np.abs(g).max()), 1e-300), np.inf
    for _ in range(STEPS):
        gradient = H @ z + g
        free = ~((z <= low) & (gradient > 0) | (z >= high) & (gradient < 0) | (low == high))
        residual = float(np.abs(gradient[free]).max(initial=0.0)) / scale
        if residual <= TOLERANCE:
            break
        direction = np.zeros(z.size)
        direction[free] = np.linalg.solve(H[np.ix_(free, free)], -gradient[free])
        slope, length = float(direction @ gradient), 1.0
        while length > 1e-12:
            move = np.clip(z + length * direction, low, high) - z
            change = float(move @ (gradient + 0.5 * (H @ move)))
            if change <= 1e-7 * length * slope or change <= 0 and length < 1e-6:
                break
            length /= 2
        else:
            break
        z = z + move
    return z, residual
