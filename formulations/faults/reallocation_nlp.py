"""Re-allocation in the inputs themselves by IPOPT: for nonlinearities that have no inverse, and for comparison.

    minimise sum ‖W (y_k - r)‖² + effort ‖(u_k - u_s) / half the range‖² + terminal cost
    subject to x_k+1 = A x_k + B f(u_k) + E g(y_k) + L y_k + d, y_k = C x_k + D f(u_k) + c, bounds and rates of u

by multiple shooting (Bock 1984) in CasADi, exact Hessians. A nonlinearity without a symbolic form (functions of the
user) is replaced by a cubic spline through many of its points. Local minima: there is no bound.
"""

from typing import Any

import numpy as np

from optid.errors import StructureError
from optid.models.export import symbolic

Array = np.ndarray

POINTS = 401
"""Points of the spline in place of a function of the user."""


class Tracker:
    """A compiled programme of one horizon; state, reference and the input before are its parameters.

    Args:
        model: the plant.
        low: (m,) least inputs.
        high: (m,) largest inputs.
        weights: (l,) of the outputs.
        terminal: (n, n) T with the terminal cost ‖T (x_N - x_s)‖².
        horizon: samples.
        effort: weight of ((u - u_s) / half its range)².
        rates: (m,) largest step of each input; None for none.
    """

    def __init__(self, model: Any, low: Array, high: Array, weights: Array, terminal: Array, *, horizon: int,
                 effort: float, rates: Array | None = None) -> None:
        import casadi as ca

        self.model, self.low, self.high, self.horizon = model, low, high, horizon
        n, m = model.nx, model.m
        f = [_function(one, float(low[c]), float(high[c])) for one, c in zip(model.nonlinearities, model.input_of)]
        g = [_function(one, None, None) for one in model.feedback]
        u, x = ca.MX.sym("u", m, horizon), ca.MX.sym("x", n, horizon)
        x0, r = ca.MX.sym("x0", n), ca.MX.sym("r", model.l)
        us, xs, before = ca.MX.sym("us", m), ca.MX.sym("xs", n), ca.MX.sym("before", m)
        half = (high - low) / 2
        cost, rows, state = ca.MX(0), [], x0
        for k in range(horizon):
            v = ca.vertcat(*(one(u[c, k]) for one, c in zip(f, model.input_of)))
            y = ca.DM(model.C) @ state + ca.DM(model.D) @ v + ca.DM(model.offset_y)
            cost += ca.sumsqr(ca.DM(weights) * (y - r)) + effort * ca.sumsqr((u[:, k] - us) / ca.DM(half))
            following = ca.DM(model.A) @ state + ca.DM(model.B) @ v + ca.DM(model.L) @ y + ca.DM(model.offset_x)
            for j, (one, o) in enumerate(zip(g, model.output_of)):
                following += ca.DM(model.E[:, j]) * one(y[o])
            rows.append(x[:, k] - following)
            state = x[:, k]
        cost += ca.sumsqr(ca.DM(terminal) @ (state - xs))
        equal = len(rows) * n
        if rates is not None:
            rows.append(ca.vec(u - ca.horzcat(before, u[:, :-1])))
        problem = {"x": ca.vertcat(ca.vec(u), ca.vec(x)), "p": ca.vertcat(x0, r, us, xs, before), "f": cost,
                   "g": ca.vertcat(*rows)}
        options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.max_iter": 300,
                   "ipopt.tol": 1e-8, "ipopt.warm_start_init_point": "yes", "ipopt.mu_strategy": "adaptive"}
        self.solver = ca.nlpsol("track", "ipopt", problem, options)
        steps = np.zeros(0) if rates is None else np.tile(rates, horizon)
        self.row_low = np.concatenate([np.zeros(equal), -steps])
        self.row_high = np.concatenate([np.zeros(equal), steps])
        self.x_low = np.concatenate([np.tile(low, horizon), np.full(n * horizon, -np.inf)])
        self.x_high = np.concatenate([np.tile(high, horizon), np.full(n * horizon, np.inf)])

    def solve(self, x0: Array, reference: Array, goal: tuple[Array, Array], before: Array, start: Array
              ) -> tuple[Array, float, str]:
        """Solve one horizon.

        Args:
            x0: (n,) state.
            reference: (l,).
            goal: inputs (m,) and state (n,) of the resting point.
            before: (m,) inputs of the sample before.
            start: (horizon, m) inputs to start from.

        Returns:
            inputs (horizon, m), cost, the solver's word.
        """
        states = np.empty((self.horizon, self.model.nx))
        x = np.array(x0, dtype=float)
        for k in range(self.horizon):
            x = self._next(x, start[k])
            states[k] = x
        found = self.solver(
            x0=np.concatenate([start.ravel(), states.ravel()]), p=np.concatenate([x0, reference, *goal, before]),
            lbx=self.x_low, ubx=self.x_high, lbg=self.row_low, ubg=self.row_high,
        )
        u = np.array(found["x"]).ravel()[: start.size].reshape(start.shape)
        return np.clip(u, self.low, self.high), float(found["f"]), str(self.solver.stats()["return_status"])

    def _next(self, x: Array, u: Array) -> Array:
        m = self.model
        v = m.expanded(u[None, :])[0]
        y = m.C @ x + m.D @ v + m.offset_y
        fed = sum((m.E[:, j] * g(y[o]) for j, (g, o) in enumerate(zip(m.feedback, m.output_of))), np.zeros(m.nx))
        return np.asarray(m.A @ x + m.B @ v + m.L @ y + m.offset_x + fed)


def tracker(model: Any, low: Array, high: Array, weights: Array, terminal: Array, **how: Any) -> Tracker:
    """Compile the programme of one horizon; see `Tracker`."""
    return Tracker(model, low, high, weights, terminal, **how)


def resting(model: Any, low: Array, high: Array, weights: Array, reference: Array, start: Array
            ) -> tuple[Array, Array, Array, str]:
    """Find the resting point nearest to a reference in the inputs themselves; a local minimum.

    Returns:
        inputs (m,), state (n,), outputs (l,), the solver's word.
    """
    import casadi as ca

    n, m = model.nx, model.m
    u, x, y = ca.MX.sym("u", m), ca.MX.sym("x", n), ca.MX.sym("y", model.l)
    f = [_function(one, float(low[c]), float(high[c])) for one, c in zip(model.nonlinearities, model.input_of)]
    v = ca.vertcat(*(one(u[c]) for one, c in zip(f, model.input_of)))
    following = ca.DM(model.A) @ x + ca.DM(model.B) @ v + ca.DM(model.L) @ y + ca.DM(model.offset_x)
    for j, (one, o) in enumerate(zip(model.feedback, model.output_of)):
        following += ca.DM(model.E[:, j]) * _function(one, None, None)(y[o])
    rows = ca.vertcat(following - x, ca.DM(model.C) @ x + ca.DM(model.D) @ v + ca.DM(model.offset_y) - y)
    tie = 1e-8 * ca.sumsqr((u - ca.DM((low + high) / 2)) / ca.DM((high - low) / 2))
    cost = ca.sumsqr(ca.DM(weights) * (y - ca.DM(reference))) + tie
    solver = ca.nlpsol("rest", "ipopt", {"x": ca.vertcat(u, x, y), "f": cost, "g": rows},
                       {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-9})
    free = np.full(n + model.l, np.inf)
    x0, y0 = model.equilibrium(start)
    found = solver(x0=np.concatenate([start, x0, y0]), lbx=np.concatenate([low, -free]),
                   ubx=np.concatenate([high, free]), lbg=0, ubg=0)
    point = np.array(found["x"]).ravel()
    return np.clip(point[:m], low, high), point[m : m + n], point[m + n :], str(solver.stats()["return_status"])


def _function(one: Any, low: float | None, high: float | None) -> Any:
    """Return u -> f(u) as CasADi takes it."""
    import casadi as ca

    try:
        symbolic(one, ca.MX.sym("u"))
        return lambda u: symbolic(one, u)
    except StructureError:
        if low is None or high is None:
            raise
    margin = 0.05 * (high - low)
    grid = np.linspace(low - margin, high + margin, POINTS)
    inside = np.clip(grid, low, high)
    values = np.asarray(one(inside)) + np.asarray(one.slope(inside)) * (grid - inside)
    return ca.interpolant("f", "bspline", [grid.tolist()], values.tolist())
