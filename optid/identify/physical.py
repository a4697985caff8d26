"""The simulation errors of equations with named parameters: compiled, started, and linearised at an optimum."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.backends.casadi import function_of
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.data.channels import Transform, model_meta
from optid.data.record import Data
from optid.data.stretches import interpolate_missing, with_whole_inputs
from optid.errors import RankError, StructureError
from optid.identify.prediction_error.compressed_errors import CompressedStates
from optid.identify.prediction_error.criterion import Criterion
from optid.identify.tangent import constraint_rows
from optid.models.equations import Equations
from optid.models.physical import PhysicalModel, Runs
from optid.program.compressed import Spread
from optid.statistics.linearised import Linearised, Method, linearise_errors
from optid.statistics.unknowns import Unknowns

NO_EFFECT = 1e-7  # relative singular value of the scaled sensitivities below which parameters are not identifiable
BINDING = 1e-6  # slack of a constraint, relative to the largest, below which it binds
NAMED = 0.1  # share of the largest entry of a direction without effect from which on a parameter is named
LIMIT = 1e50  # errors and sensitivities, relative to the spread of the output, beyond which a run is not finite
FLOOR = 1e-14  # share of the energy of an output below which its errors are rounding
SPREAD = 4.0  # factor by which random starts differ from the given one at most


@dataclass(frozen=True)
class PhysicalUnknowns(Unknowns):
    """Parameters, then the initial states of every experiment, all in multiples of their usual sizes."""

    names: tuple[str, ...]
    n: int
    l: int  # noqa: E741 - the field's letter
    experiments: int
    innovations = False
    latent = ()
    free = ()

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Every parameter is a number."""
        return dict.fromkeys(self.names, ())


@dataclass(frozen=True, eq=False)
class PhysicalErrors(Criterion):
    """The weighted simulation errors of equations on a record."""

    data: Data  # the record in raw units; no input is missing
    equations: Equations
    weight: Array  # (l, l) diagonal weight of the errors
    usual: Array = field(repr=False)  # sizes of the states, then of the parameters
    gauge: ClassVar[str] = "none"  # pyright: ignore[reportIncompatibleVariableOverride]

    @classmethod
    def of(cls, data: Data, equations: Equations) -> "PhysicalErrors":
        """Prepare a record; states and parameters are scaled by their starts.

        A state or parameter with the name of a channel is a `StructureError`.
        """
        raw = data.raw()
        for name in {*equations.states, *equations.parameters} & {*raw.inputs, *raw.outputs}:
            raise StructureError(f"{name!r} is a channel of the record and a state or parameter of the equations: give "
                                 "it another name there")
        raw = with_whole_inputs(raw, 2 * len(equations.states) + 1)
        spread = np.nanstd(np.vstack([e.y for e in raw.experiments]), axis=0)
        starts = np.array([*equations.states.values(), *equations.parameters.values()], dtype=float)
        return cls(raw, equations, np.diag(1 / np.where(spread > 0, spread, 1.0) ** 2),
                   np.where(starts != 0, np.abs(starts), 1.0))

    @cached_property
    def unknowns(self) -> PhysicalUnknowns:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The order of the unknowns."""
        return PhysicalUnknowns(tuple(self.equations.parameters), len(self.equations.states), self.data.l,
                                self.data.n_experiments)

    @cached_property
    def steps(self) -> int:
        """Steps of integration in a sampling time; 0 in discrete time."""
        return self.equations.substeps(self.data.dt) if self.equations.time == "continuous" else 0

    @cached_property
    def _scalars(self) -> tuple[list[cp.Variable], ...]:
        groups = tuple(self.equations.states), self.data.inputs, tuple(self.equations.parameters)
        return tuple([cp.Variable(name=name) for name in group] for group in groups)

    @cached_property
    def _evaluated(self) -> dict[str, Any]:
        named = {one.name(): one for group in self._scalars for one in group}
        found = self.equations.evaluate(named, self.data.outputs)
        used = {one.id for value in found.values() if isinstance(value, cp.Expression) for one in value.variables()}
        if idle := [one.name() for one in self._scalars[2] if one.id not in used]:
            raise StructureError(f"no equation uses the parameter {idle[0]!r}: use it, or leave it out")
        return found

    @cached_property
    def measured(self) -> dict[str, int]:
        """States that are measured directly, with the position of the output."""
        by_id = {state.id: state.name() for state in self._scalars[0]}
        return {by_id[one.id]: o for o, name in enumerate(self.data.outputs)
                if (one := self._evaluated[name]) is not None and getattr(one, "id", None) in by_id}

    @cached_property
    def code(self) -> str:
        """The equations as serialised by CasADi."""
        n = len(self.equations.states)
        values = list(self._evaluated.values())
        return str(function_of(self._scalars, (values[:n], values[n:])).serialize())

    @cached_property
    def runs(self) -> Runs:
        """The simulator of the equations."""
        return Runs.of(self.code, self.bounds, self.steps, self.equations.hold, self.data.dt)

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Of every state, infinite where open."""
        return tuple(self.equations.interval(name) for name in self.equations.states)

    def in_words(self) -> tuple[str, ...]:
        """Return the equations as text."""
        following = "d{}/dt" if self.steps else "{}(k+1)"
        return tuple(f"{following.format(name) if name in self.equations.states else name} = {_in_words(expression)}"
                     for name, expression in self._evaluated.items())

    def split(self, x: Array) -> tuple[Array, Array]:
        """Return the parameters (q,) and the initial states (E, n) of the unknowns, in raw units."""
        unknowns = self.unknowns
        states = x[unknowns.shared :].reshape(unknowns.experiments, unknowns.n)
        return x[: unknowns.shared] * self.usual[unknowns.n :], states * self.usual[: unknowns.n]

    @property
    def units(self) -> Transform:
        """Models have the units of the record."""
        return Transform.identity(self.data.m, self.data.l)

    def model(self, values: Values) -> PhysicalModel:
        """Return the model of named values."""
        data, equations = self.data, self.equations
        p, states = self.split(self.variables.pack(values))
        mean = np.mean(np.vstack([e.u for e in data.experiments]), axis=0)
        return PhysicalModel(
            self.code, self.in_words(), tuple(equations.states), dict(zip(equations.parameters, p)), states[0],
            mean, self.bounds, self.steps, equations.hold, **model_meta(data))

    # -- errors and their sensitivities --------------------------------------------------------------------------

    def residuals(self, x: Array) -> list[Array]:
        """Return the errors (N, l) of every experiment, NaN where an output is missing."""
        p, states = self.split(x)
        return [np.vstack([y for _, y in self.runs.over(e.u, state, p)]) - e.y
                for e, state in zip(self.data.experiments, states)]

    def gauge_rows(self, x: Array) -> Array:
        """Return no directions."""
        return np.zeros((0, self.unknowns.shared))

    def rows(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return a generator of weighted rows [x0 | parameters | errors] of experiment i, zero if y is missing."""
        p, states = self.split(x)
        weigh = np.sqrt(np.diag(self.weight))

        def of(i: int) -> Iterator[tuple[Array, int]]:
            e, done = self.data.experiments[i], 0
            for _, y, slopes in self.runs.sensitive(e.u, states[i], p):
                measured = e.y[done : done + len(y)]
                with np.errstate(over="ignore", invalid="ignore"):
                    rows = np.concatenate([slopes * self.usual, (y - measured)[:, :, None]], axis=2) * weigh[:, None]
                there = np.isfinite(measured)
                rows[~there] = 0.0
                yield rows.reshape(-1, rows.shape[2]), int(there.sum())
                done += len(y)

        return of

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x; of infinite size where they or their sensitivities are not finite."""
        unknowns, rows, infinite = self.unknowns, self.rows(x), []

        def bounded_blocks(i: int) -> Iterator[tuple[Array, int]]:
            for block, count in rows(i):
                finite = np.abs(block) < LIMIT
                infinite.extend([i] * (not finite.all()))
                yield np.where(finite, block, 0.0), count

        found = linearise_errors(bounded_blocks, unknowns.experiments, unknowns.n, unknowns.shared, method=method)
        return replace(found, remainder=np.inf) if infinite else found

    def value(self, x: Array) -> float:
        """Return the weighted sum of squared errors."""
        errors = np.vstack(self.residuals(x)) * np.sqrt(np.diag(self.weight))
        there = np.isfinite(np.vstack([e.y for e in self.data.experiments]))
        used = np.where(there, errors, 0.0)
        return float(np.sum(used**2)) if np.all(np.abs(used) < LIMIT) else np.inf

    def admissible(self, x: Array) -> bool:
        """Whether the parameters are within their bounds."""
        p, states = self.split(x)
        named = zip((*self.equations.parameters, *self.equations.states), (*p, *states.T))
        return bool(np.all(np.isfinite(x))) and all(
            np.all((low <= value) & (value <= high)) for name, value in named
            for low, high in [self.equations.interval(name)])

    def key(self, name: str, number: int) -> str:
        """Return the name of a parameter that ends in a number."""
        return f"{name}{number}"

    @property
    def unit(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """One unit of the weighted errors in squared units of the output; one for several outputs."""
        return float(1 / self.weight[0, 0]) if self.data.l == 1 else 1.0

    def reweight(self, x: Array) -> "PhysicalErrors":
        """Return the errors weighted by their inverse variances at x."""
        variances = np.nanmean(np.vstack(self.residuals(x)) ** 2, axis=0)
        return replace(self, weight=np.diag(1 / np.maximum(variances, FLOOR / np.diag(self.weight))))

    def grid(self, i: int) -> Array:
        """Return the inputs (G, m) of an experiment at the steps of integration."""
        u, apart = self.data.experiments[i].u, max(self.steps, 1)
        if self.equations.hold == "zero":
            return np.vstack([np.repeat(u[:-1], apart, axis=0), u[-1:]])
        at = np.arange((len(u) - 1) * apart + 1) / apart
        return np.column_stack([np.interp(at, np.arange(len(u)), column) for column in u.T])

    def run_states(self, i: int, x0: Array, p: Array) -> Array:
        """Return the states (G, n) of a run of an experiment at the steps of integration."""
        apart = max(self.steps, 1)
        fine = Runs.of(self.code, self.bounds, min(self.steps, 1), self.equations.hold, self.data.dt / apart)
        return np.vstack([states for states, _ in fine.over(self.grid(i), x0, p)])

    # -- starts --------------------------------------------------------------------------------------------------

    def starts(self, count: int, seed: int) -> Iterator[tuple[str, Array]]:
        """Yield named starts: the one given, then random parameters within their bounds."""
        given, rng = np.array(list(self.equations.parameters.values()), dtype=float), np.random.default_rng(seed)
        low, high = np.array([self.equations.interval(name) for name in self.equations.parameters]).T
        n, states = self.unknowns.n, np.array(list(self.equations.states.values()), dtype=float)
        for i in range(count):
            drawn = given * SPREAD ** rng.uniform(-1, 1, given.shape)
            drawn = np.where(given != 0, drawn, rng.normal(size=given.shape))
            between = np.isfinite(low) & np.isfinite(high)
            drawn[between] = rng.uniform(low[between], high[between])
            p = np.clip(drawn, low, high) if i else given
            yield (f"random {i}" if i else "as given",
                   np.concatenate([p / self.usual[n:], np.tile(states / self.usual[:n], self.unknowns.experiments)]))

    def course(self, i: int) -> Array:
        """Return states (N, n) of an experiment to start from: measured, simulated, or as given, within their bounds.

        An equation without a value there, such as the root of a negative number, is a `StructureError`.
        """
        e, states = self.data.experiments[i], self.equations.states
        given = np.array(list(states.values()), dtype=float)
        p = np.array(list(self.equations.parameters.values()), dtype=float)
        found = np.vstack([visited for visited, _ in self.runs.over(e.u, given, p)])
        found = np.where(np.isfinite(found).all(axis=1, keepdims=True), found, given)
        seen = interpolate_missing(e.y)
        for j, name in enumerate(states):
            if name in self.measured:
                found[:, j] = seen[:, self.measured[name]]
            low, high = self.equations.interval(name)
            found[:, j] = np.clip(found[:, j], low, high)
        values = self.runs.right.map(len(found))(found.T, e.u.T, np.tile(p[:, None], len(found)))
        for names, value in zip((tuple(states), self.data.outputs), values):
            bad = np.argwhere(~np.isfinite(np.array(value)))
            if len(bad):
                o, k = bad[0]
                at = ", ".join(f"{name} = {x:.4g}" for name, x in zip(
                    (*states, *self.data.inputs, *self.equations.parameters), (*found[k], *e.u[k], *p)))
                raise StructureError(
                    f"the equation of {names[o]!r} has no value at the start, sample {k}: {at}. Roots and logarithms "
                    "need other starts, or bounds of the states that keep their arguments positive")
        return found


def _in_words(expression: Any) -> str:
    """Return an expression of scalars in mathematical notation."""
    name, args = type(expression).__name__, getattr(expression, "args", ())
    if not args or name not in ("AddExpression", "NegExpression", "multiply", "MulExpression", "Power", "PowerApprox"):
        return str(expression)
    words = [_in_words(arg) for arg in args]
    if name == "AddExpression":
        return " + ".join(words).replace("+ -", "- ")
    closed = [f"({text})" if type(arg).__name__ in ("AddExpression", "NegExpression") else text
              for text, arg in zip(words, args)]
    if name == "NegExpression":
        return f"-{closed[0]}"
    if name in ("multiply", "MulExpression"):
        return " ".join(closed)
    exponent = float(expression.p.value)
    return f"sqrt({words[0]})" if exponent == 0.5 else f"{f'({words[0]})' if args[0].args else words[0]}^{exponent:g}"


class CompressedPhysical(CompressedStates):
    """The errors at the optimum, once `settle` was called."""

    criterion: PhysicalErrors  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, errors: PhysicalErrors) -> None:
        self.criterion = errors

    def settle(self, values: Values) -> None:
        """Linearise the errors at values of the unknowns; a run that diverges there is a `StructureError`."""
        super().settle(values)
        if not np.isfinite(self.at.value):
            names, (p, _) = self.criterion.unknowns.names, self.criterion.split(self.reference)
            at = ", ".join(f"{name} = {value:.4g}" for name, value in zip(names, p))
            raise StructureError(f"the run of the equations, or its slope, leaves the range of numbers at the solution "
                                 f"of the solver: {at}. Give better starts of the parameters, or bounds")

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter, with the noise in units of the objective."""
        found = super().spread(z, moves)
        return replace(found, noise=found.noise / self.criterion.unit)

    def refuse_undetermined(self, problem: Problem, values: Values) -> None:
        """Refuse parameters that neither the record nor binding constraints determine (`RankError`)."""
        equal, above, slack = constraint_rows(problem, values, tuple(self.criterion.variables.names))
        rows = np.vstack([equal, above[slack <= BINDING * (1 + np.abs(slack).max(initial=0.0))]])
        matrix, errors = self.at.whole[0], self.criterion
        initial = [f"initial {name}" for name in errors.equations.states] * errors.unknowns.experiments
        names = [*errors.unknowns.names, *initial]
        sizes = np.linalg.norm(matrix, axis=0)
        scale = np.where(sizes > NO_EFFECT * sizes.max(), sizes, sizes.max())
        lengths = np.linalg.norm(rows / scale, axis=1, keepdims=True)
        stacked = np.vstack([matrix / scale, rows / scale / np.where(lengths > 0, lengths, 1.0)])
        sizes, vectors = np.linalg.svd(stacked)[1:]
        still = vectors[: len(scale)][sizes[: len(scale)] <= NO_EFFECT * sizes[0]]
        if not len(still):
            return
        part = np.abs(still).max(axis=0)
        found = [names[j] for j in np.flatnonzero(part > NAMED * part.max())]
        listed = ", ".join(map(repr, found))
        what = "can change together without any" if len(found) > len(still) else f"ha{'ve' if found[1:] else 's'} no"
        raise RankError(f"{listed} {what} effect on the outputs of this record. Write a known value in place of a "
                        f"parameter, hold one by a constraint such as lambda v: v[{found[0]!r}] == 1, or record what "
                        "moves it")
