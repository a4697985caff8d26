"""Models from a user's own state equations: parameters with names, and the equations as one CasADi function."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from scipy.optimize import least_squares, root

from optid.arrays import Array, finite
from optid.data.channels import check_texts
from optid.errors import DataError, StructureError
from optid.models.experiments import Record, check_inputs, signal_units
from optid.models.held_inputs import held_step
from optid.models.linear import static_solution
from optid.models.model import Model
from optid.models.nonlinearity import Nonlinearity
from optid.models.state_simulation import allowed_range

CHUNK = 64  # samples run at a time, after which a run that has left the numbers ends
NEWTON = {"abstol": 1e-13, "abstolStep": 1e-13, "max_iter": 20, "error_on_fail": False, "show_eval_warnings": False}
SOLVED = 1e-8  # error of an implicit step, relative to the state, beyond which it has no solution and the run ends
EDGE = 1e-12  # distance from a lower bound, relative, at which roots and logarithms that end there have a slope
LEAST = 1e-9  # size of a state, as a share of the largest, that its tolerance is relative to at least


@dataclass(frozen=True, eq=False, repr=False)
class PhysicalModel(Model):
    """State equations written by a user, with estimated parameters, in raw units.

    Continuous equations are integrated by the trapezoidal rule, as they were in the fit.

    Attributes:
        dt, time_unit, inputs, outputs, input_units, output_units, gauge: see `Model`.
    """

    # the equations as a serialised `casadi.Function` (x, u, p) -> (right, y) of the states x, inputs u and parameters p
    code: str = field(repr=False)
    text: tuple[str, ...]  # the equations in words, one line per state and output
    states: tuple[str, ...]  # names of the n states
    parameters: Mapping[str, float]  # {name: value}
    start: Array  # (n,) state from which a simulation starts where none is given
    # (m,) inputs at whose state of rest poles and responses of the linear part are given; `start` where there is no
    # such state
    point: Array
    # (low, high) of every state, infinite where open; equations are evaluated no further than there
    bounds: tuple[tuple[float, float], ...]
    steps: int = 1  # steps of integration in a sampling time; 0 for equations in discrete time
    hold: str = "zero"  # what an input does between its samples, "zero" (stays) or "first" (straight lines)
    dt: float = 1.0
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    gauge: str = "none"
    time_unit: str = ""
    GAUGES = ("none",)
    SIMULATORS = ("free", "predict")
    nonlinearities: ClassVar[tuple[Nonlinearity, ...]] = ()
    structure = "physical"
    title = "Physical model"  # pyright: ignore[reportAssignmentType]
    memory = 0
    c0 = None
    offset_note = ""

    def __post_init__(self) -> None:
        names = {name: tuple(getattr(self, name)) for name in ("text", "states")}
        bounds = tuple((-np.inf if low is None else float(low), np.inf if high is None else float(high))
                       for low, high in self.bounds)
        given = {"nonlinearities": (), "start": finite(self.start, "start"), "point": finite(self.point, "point"),
                 "parameters": {name: float(value) for name, value in self.parameters.items()}, "bounds": bounds}
        check_texts("the name of a state or parameter", map(str, (*names["states"], *self.parameters)), StructureError)
        self._fix({**given, **names}, len(self.inputs), len(self.outputs))

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def orders(self) -> dict[str, int]:
        """Number of states and of parameters, for tables."""
        return {"nx": self.nx, "parameters": len(self.parameters)}

    @property
    def p(self) -> Array:
        """Values of the parameters, (q,)."""
        return np.array(list(self.parameters.values()))

    @cached_property
    def runs(self) -> "Runs":
        """What runs the equations."""
        return Runs.of(self.code, self.bounds, self.steps, self.hold, self.dt)

    def _linear(self, x: Array, u: Array) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of one sampling time about a state and inputs."""
        a, b, c, d = (np.array(one) for one in self.runs.slopes(x, u, self.p))
        if self.steps:
            a, b = held_step(a, b, self.dt)
        return a, b, c, d

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of the linear part about `point`, inputs held between samples."""
        try:
            return self._linear(self.rest(self.point), self.point)
        except StructureError:
            return self._linear(self.start, self.point)

    @property
    def poles(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Poles (n,) about `point`, largest first."""
        values: Any = np.linalg.eigvals(self.matrices[0])
        return values[np.argsort(-np.abs(values), kind="stable")]

    def _static_gain(self, u0: Array) -> Array:
        a, b, c, d = self._linear(self.rest(u0), u0)
        return c @ static_solution(np.eye(self.nx) - a, b) + d

    def rest(self, u0: Array) -> Array:
        """Return the state (n,) at rest under constant inputs (m,); refuse where none is found (`StructureError`)."""
        with np.errstate(all="ignore"):
            found = root(lambda x: self.runs.still(x, u0, self.p), self.start, method="hybr", tol=1e-12)
        if not np.all(np.isfinite(found.x)) or not np.abs(found.fun).max() < 1e-8 * (1 + np.abs(found.x).max()):
            raise StructureError(f"no state of rest was found for inputs {np.round(u0, 6).tolist()}")
        return found.x

    def equation(self) -> str:
        """Return the equations, one a line."""
        return "\n".join(self.text)

    def coefficients(self) -> list[tuple[str, float]]:
        """Return the parameters by name."""
        return list(self.parameters.items())

    def to_casadi(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the model as a `casadi.Function` (x, u) -> (x_next, y); inputs stay between samples."""
        x, u = ca.MX.sym("x", self.nx), ca.MX.sym("u", self.m)
        following, y = self.runs.step(x, ca.vertcat(u, u), ca.DM(self.p))
        return ca.Function("physical", [x, u], [following, y], ["x", "u"], ["x_next", "y"])

    # -- running over records ------------------------------------------------------------------------------------

    def simulate(self, data: Any, x0: Any = "start") -> Any:
        """As `Model.simulate`; from `start` where no initial state is given."""
        return super().simulate(data, self.start if isinstance(x0, str) and x0 == "start" else x0)

    @property
    def _state_shape(self) -> tuple[int]:
        return (self.nx,)

    def _run(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        states = self._states(simulator, records, x0)
        limits, found = allowed_range([y for _, y, _ in records]), []
        low, high = limits or (-np.inf, np.inf)
        for (u, _, label), state in zip(records, states):
            check_inputs(self, u, label)
            y = np.vstack([block[1] for block in self.runs.over(u, state, self.p)])
            outside = ~(np.isfinite(y) & (y >= low) & (y <= high))
            if outside.any():
                k, o = np.argwhere(outside)[0]
                raise DataError(f"{label}The simulation leaves the range of the data in output {self.outputs[o]!r} at "
                                f"sample {k}: the parameters or the initial state do not belong to this record.")
            found.append(y)
        return found

    def _fitted(self, simulator: str, u: Array, y: Any, label: str) -> Array:
        check_inputs(self, u, label)
        there, scale = np.isfinite(y), signal_units(y)
        low, high = np.array(self.bounds).T

        def errors(x: Array) -> Array:
            found = np.vstack([block[1] for block in self.runs.over(u, x, self.p)])
            return ((found - y) / scale)[there]

        def slopes(x: Array) -> Array:
            blocks = [block[2][:, :, : self.nx] for block in self.runs.sensitive(u, x, self.p)]
            return (np.concatenate(blocks) / scale[:, None])[there]

        inside = 1e-9 * (1 + np.abs(self.start))
        start = np.clip(self.start, low + inside, high - inside)
        if not np.all(np.isfinite(errors(start))):
            raise DataError(f"{label}The simulation from the usual initial state leaves the range of numbers.")
        size = np.maximum(np.abs(start), 1e-6)
        solve: Any = least_squares
        return solve(errors, start, slopes, bounds=(low, high), x_scale=size, xtol=1e-12, ftol=1e-12).x

    # -- gauge, units, files -------------------------------------------------------------------------------------

    def with_transform(self, transform: Any) -> Self:
        """Return the model as it is: its equations are stated in raw units."""
        return self

    def to_dict(self) -> dict[str, Any]:
        """Describe the model in JSON types."""
        return {**super().to_dict(), "parameters": dict(self.parameters),
                "bounds": [[end if np.isfinite(end) else None for end in pair] for pair in self.bounds]}


@dataclass(frozen=True, eq=False)
class Runs:
    """Equations compiled for simulation; the inputs of a step are those at its beginning and its end."""

    right: Any  # (x, u, p) -> (right, y); beyond the bounds of a state it is as at the bound
    steps: int  # steps of integration in a sampling time; 0 for equations in discrete time
    hold: str  # what an input does between its samples
    dt: float  # sampling time

    @classmethod
    @cache
    def of(cls, code: str, bounds: tuple[tuple[float, float], ...], steps: int, hold: str, dt: float) -> "Runs":
        """Compile serialised equations; refuse what is no plain expression (`StructureError`)."""
        try:
            right = ca.Function.deserialize(code)
        except (RuntimeError, NotImplementedError) as error:
            raise StructureError("the equations of the model file cannot be read by this version of CasADi") from error
        if not right.is_a("SXFunction"):
            raise StructureError("the equations of the model file are not plain expressions")
        low, high = np.array(bounds).T
        low = low + EDGE * np.abs(np.nan_to_num(low, neginf=0.0)) + 1e-100
        x, u, p = (ca.SX.sym(name, right.size1_in(i)) for i, name in enumerate("xup"))
        inside = right(ca.fmin(ca.fmax(x, ca.DM(low)), ca.DM(high)), u, p)
        return cls(ca.Function("right", [x, u, p], list(inside)), steps, hold, dt)

    @cached_property
    def slopes(self) -> Any:
        """The function (x, u, p) -> (dright/dx, dright/du, dy/dx, dy/du)."""
        x, u, p = (ca.SX.sym(name, self.right.size1_in(i)) for i, name in enumerate("xup"))
        return ca.Function("slopes", [x, u, p], [ca.jacobian(one, by) for one in self.right(x, u, p) for by in (x, u)])

    def still(self, x: Array, u: Array, p: Array) -> Array:
        """Return what vanishes at rest."""
        right = np.array(self.right(x, u, p)[0]).ravel()
        return right if self.steps else right - x

    @cached_property
    def step(self) -> Any:
        """The function (x, [u now, u next], p) -> (state after a sampling time, y now)."""
        x, both, p = self._symbols()
        m = both.numel() // 2
        now, after, (state, y) = both[:m], both[m:], self.right(x, both[:m], p)
        if self.steps:
            ends = [now + (self.hold == "first") * (i / self.steps) * (after - now) for i in range(self.steps + 1)]
            state = x
            for first, last in zip(ends, ends[1:]):
                state = self._trapezoid(ca.vertcat(state, first, last, p))
        return ca.Function("step", [x, both, p], [state, y])

    @cached_property
    def _sensitive_step(self) -> Any:
        """As `step`, with the derivatives S (n, n + q) of the state with respect to x0 and p carried behind it."""
        x, both, p = self._symbols()
        n, q = x.numel(), p.numel()
        carried, results = ca.MX.sym("S", n, n + q), self.step(x, both, p)
        by_p = ca.horzcat(ca.DM(q, n), ca.DM.eye(q))
        moved = [ca.jacobian(one, x) @ carried + ca.jacobian(one, p) @ by_p for one in results]
        inner = ca.Function("inner", [x, carried, both, p],
                            [ca.vertcat(one, ca.vec(slopes)) for one, slopes in zip(results, moved)])
        z = ca.MX.sym("z", n * (1 + n + q))
        return ca.Function("sensitive", [z, both, p], list(inner(z[:n], ca.reshape(z[n:], n, n + q), both, p)))

    def _symbols(self) -> list[Any]:
        """Return symbols of x, [u now, u next] and p."""
        return [ca.MX.sym(name, (1 + (name == "u")) * self.right.size1_in(i)) for i, name in enumerate("xup")]

    @cached_property
    def _trapezoid(self) -> Any:
        """One step of the trapezoidal rule, solved by Newton's method; NaN where there is no solution."""
        n, m, q = (self.right.size1_in(i) for i in range(3))
        w, given = ca.SX.sym("w", n), ca.SX.sym("g", n + 2 * m + q)
        x, u, after, p = (given[a:b] for a, b in zip((0, n, n + m, n + 2 * m), (n, n + m, n + 2 * m, n + 2 * m + q)))
        half = self.dt / self.steps / 2
        now = half * self.right(x, u, p)[0]
        size = ca.fabs(x) + ca.fabs(now) + ca.fabs(half * self.right(x + 2 * now, after, p)[0])
        size = ca.fmax(size, LEAST * ca.mmax(size) + 1e-100)
        z = x + size * w
        rest = (z - x - now - half * self.right(z, after, p)[0]) / size
        solved = ca.rootfinder("trapezoid", "newton", {"x": w, "p": given, "g": rest}, NEWTON)
        found = ca.Function("found", [w, given], [ca.if_else(ca.mmax(ca.fabs(rest)) < SOLVED, z, ca.SX.nan(n))])
        known = ca.MX.sym("g", given.numel())
        return ca.Function("trapezoid", [known], [found(solved(ca.DM.zeros(n), known), known)])

    def over(self, u: Array, x0: Array, p: Array) -> Iterator[tuple[Array, Array]]:
        """Yield (states, outputs) of a run, some samples at a time."""
        yield from self._accumulated(self.step, u, x0, p)

    def sensitive(self, u: Array, x0: Array, p: Array) -> Iterator[tuple[Array, Array, Array]]:
        """Yield (states, outputs (T, l), their derivatives (T, l, n + q) by the initial state and the parameters)."""
        n, q, outputs = len(x0), len(p), self.right.size1_out(1)
        start = np.concatenate([x0, np.eye(n, n + q).ravel(order="F")])
        for state, found in self._accumulated(self._sensitive_step, u, start, p):
            slopes = found[:, outputs:].reshape(len(found), n + q, outputs).transpose(0, 2, 1)
            yield state[:, :n], found[:, :outputs], slopes

    def _accumulated(self, step: Any, u: Array, start: Array, p: Array) -> Iterator[tuple[Array, Array]]:
        after = np.vstack([u[1:], u[-1:]])
        both, run = np.hstack([u, after]), step.mapaccum(CHUNK)
        for first in range(0, len(u), CHUNK):
            part = both[first : first + CHUNK]
            used = run if len(part) == CHUNK else step.mapaccum(len(part))
            states, found = (np.array(one).T for one in used(start, part.T, p))
            yield np.vstack([start[None], states[:-1]]), found
            start, rest = states[-1], len(u) - first - len(part)
            if rest and not np.isfinite(start).all():
                yield np.full((rest, start.size), np.nan), np.full((rest, step.size1_out(1)), np.nan)
                return
