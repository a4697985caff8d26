"""State equations given by the user, with named parameters: one sparse programme for NLP back ends.

The states at every sample are variables (direct collocation, Hargraves and Paris 1987), tied by the trapezoidal rule,

    minimise sum_k |W (y(k) - g(x(k), u(k), p))|²
    subject to x(k+1) - x(k) = h/2 [f(x(k), u(k), p) + f(x(k+1), u(k), p)],

in discrete time x(k+1) = f(x(k), u(k), p), so that the errors are those of the free run, whose initial state is
estimated. It starts from the best of several descents in the parameters alone (`optid.identify.physical`). Constraints
may use parameters and states. W is the inverse of the spread of every output at first and, with several
outputs, of their errors then. Named variables: the parameters and the states, by their names (with several experiments
``h[1]``, ``h[2]``, ...).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import LARGEST_INTEGER, check_integer
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.physical import CompressedPhysical, PhysicalErrors
from optid.identify.prediction_error.descent import best_of
from optid.models.equations import Equations
from optid.models.equations import equations as read
from optid.program.program import Program, Values
from optid.program.solution import Bound, Status
from optid.program.view import View
from optid.solving.solve import Procedure
from optid.solving.steps import steps

Array = np.ndarray

LIMIT = 20_000  # states at all steps of integration up to which the programme is built
REWEIGHTED = 3  # times that outputs are weighted anew by their errors
LEAST = 1e-2  # parameters start from no less than this share of their usual size
NO_BOUND = "the equations are not convex: no lower bound is known"


@steps(lambda given: {"physical": "NLP"})
def physical(data: Data, *, equations: Equations | str, starts: int = 6, seed: int = 0, constraints: Sequence[Any] = ()
             ) -> Procedure:
    """Fit the parameters of state equations by least squares of the simulation errors.

    Named variables: the parameters and states of the equations.

    Args:
        data: the record. Outputs may be missing; it is cut where inputs are.
        equations: `optid.Equations`, or their place in a file: "plant.py:name".
        starts: how many starts descend, random but for the first; fewer where two agree on a model that explains nine
            tenths of the output.
        seed: of the random starts.
        constraints: builders such as ``lambda v: v["k1"] <= v["k2"]``.

    Raises:
        StructureError: equations that do not fit the record, have no value at the start, or whose run explodes; too
            many samples.
        DataError: no stretch of some length in which every input is present.
        RankError: parameters that the record does not determine, by name.
    """
    errors = PhysicalErrors.of(data, read(equations))
    count = sum(e.n_samples for e in errors.data.experiments) * max(errors.steps, 1) * errors.unknowns.n
    if count > LIMIT:
        raise StructureError(f"{count} states at all steps of integration: this formulation takes up to {LIMIT}. Use "
                             "fewer samples, or a longer step")
    return _procedure(errors, check_integer(starts, "starts"),
                      check_integer(seed, "seed", 0, LARGEST_INTEGER), tuple(constraints))


def _procedure(errors: PhysicalErrors, starts: int, seed: int, constraints: tuple[Any, ...]) -> Procedure:
    """Descend from several starts, solve, weigh several outputs by their errors, refuse what is not determined."""
    found = best_of(errors, errors.starts(starts, seed), enough=2)
    collocation = _Collocation(errors)
    settled = bool(found) and np.isfinite(found[0].value)
    start = collocation.along(found[0].x) if settled else collocation.measured()
    program = replace(collocation.program(constraints, start), settled=settled)
    solution = yield program
    for _ in range(REWEIGHTED if errors.data.l > 1 and solution.has_point else 0):
        errors = errors.reweighted(errors.places.pack(solution.values))
        program = replace(_Collocation(errors).program(constraints, solution.values), settled=True)
        solution = yield program
    if not solution.has_point:
        return None
    program.assign(solution.values)
    if isinstance(program.compressed, CompressedPhysical):
        program.compressed.settle(program)
        if solution.status in (Status.LOCAL, Status.OPTIMAL):
            program.compressed.refuse_undetermined(program)
    return program.recover(solution.values)


class _Collocation:
    """Writes the programme of one record."""

    def __init__(self, errors: PhysicalErrors) -> None:
        self.errors, self.data, self.equations = errors, errors.data, errors.equations
        self.labels = errors.labels
        self.variables = errors.places.variables()
        sizes = errors.usual[errors.unknowns.n :]
        self.view = {name: size * self.variables[name] for name, size in zip(self.equations.parameters, sizes)}
        self.derived: dict[str, Any] = {}
        self.structural: dict[str, Any] = {}
        self.residuals = [one for i, label in enumerate(self.labels) for one in self._experiment(i, label)]

    def program(self, constraints: Sequence[Any], start: Values) -> Program:
        """Return the programme under the user's constraints."""
        errors = self.errors
        objective = cp.Minimize(sum(cp.sum_squares(one) for one in self.residuals))
        bounds = {f"bounds of {name}": limits for name in self.equations.parameters
                  if (limits := _within(self.view[name], *self.equations.interval(name)))}
        for name, value in start.items():
            self.variables[name].value = value
        start = {**start, **{name: np.asarray(expression.value) for name, expression in self.derived.items()}}
        bound = Bound.none(NO_BOUND)
        program = Program(
            "physical", objective, self.structural, self.variables, start,
            lambda values: errors.model(errors.places.pack(values)), View(self.view),
            frozenset(self.structural), derived=self.derived, scale=errors.energy,
            certify=lambda program, values, duals: (bound, None), note=NO_BOUND,
            compressed=CompressedPhysical(errors), unit=errors.unit,
            courses=frozenset(name for name in self.variables if name.startswith("states of ")))
        return program.subject_to(*([bounds] if bounds else []), *constraints, convex=False)

    def _experiment(self, i: int, label: str) -> list[Any]:
        """Enter the dynamics of one experiment; return its residuals, one variable per output."""
        errors, equations, e = self.errors, self.equations, self.data.experiments[i]
        names, apart = tuple(equations.states), max(errors.steps, 1)
        x0, courses = self.variables["x0"], {}
        for j, name in enumerate(names):
            low, high = (end / errors.usual[j] for end in equations.interval(name))
            rest = cp.Variable((e.n_samples - 1) * apart, name=f"states of {name}{label}", bounds=[low, high])
            self.variables[rest.name()] = rest
            first = x0[j] if x0.ndim == 1 else x0[j, i]
            courses[name] = errors.usual[j] * cp.hstack([first, rest])
            self.view[f"{name}{label}"] = courses[name][::apart]
            if ends := _within(first, low, high):
                self.structural[f"first value of {name}{label}"] = tuple(ends)
        grid = errors.grid(i)
        now, after = (grid[:-1], grid[:-1] if equations.hold == "zero" else grid[1:])
        moves = self._right({name: course[:-1] for name, course in courses.items()}, now)
        if errors.steps:
            half = self.data.dt / apart / 2  # of a step
            ends = self._right({name: course[1:] for name, course in courses.items()}, after)
            moves = {name: courses[name][:-1] + half * (moves[name] + ends[name]) for name in names}
        self.structural[f"dynamics{label}"] = tuple(
            (courses[name][1:] - moves[name]) / errors.usual[j] == 0 for j, name in enumerate(names))
        at = {name: course[::apart] for name, course in courses.items()}
        shown, residuals = self._right(at, e.u), []
        for o, name in enumerate(self.data.outputs):
            there = np.flatnonzero(np.isfinite(e.y[:, o]))
            key = f"residual of {name}{label}"
            residuals.append(cp.Variable(there.size, name=key))
            self.variables[key] = residuals[-1]
            value = shown[name] if there.size == e.n_samples else shown[name][there]
            self.derived[key] = float(np.sqrt(errors.weight[o, o])) * (value - e.y[there, o])
            self.structural[key] = (residuals[-1] == self.derived[key],)
        return residuals

    def _right(self, states: Mapping[str, Any], u: Array) -> dict[str, Any]:
        """Evaluate the equations on courses of states and inputs (T, m)."""
        inputs = {name: cp.Constant(u[:, c]) for c, name in enumerate(self.data.inputs)}
        parameters = {name: self.view[name] for name in self.equations.parameters}
        found = self.equations.evaluated({**inputs, **parameters, **states}, self.data.outputs)
        return {name: cp.Constant(np.zeros(len(u))) + value for name, value in found.items()}

    def along(self, x: Array) -> dict[str, Array]:
        """Return the start at unknowns x, with the states of its run."""
        errors, usual = self.errors, self.errors.usual[: self.errors.unknowns.n]
        p, first = errors.split(x)
        return self._start(x, [errors.visited(i, state, p)[1:] / usual for i, state in enumerate(first)])

    def measured(self) -> dict[str, Array]:
        """Return the start that the user gave, with states that outputs show as measured."""
        errors, usual = self.errors, self.errors.usual[: self.errors.unknowns.n]
        courses = [errors.course(i) / usual for i in range(self.data.n_experiments)]
        p = np.array(list(self.equations.parameters.values())) / errors.usual[errors.unknowns.n :]
        return self._start(np.concatenate([p, *(course[0] for course in courses)]),
                           [np.repeat(course[:-1], max(errors.steps, 1), axis=0) for course in courses])

    def _start(self, x: Array, courses: Sequence[Array]) -> dict[str, Array]:
        errors, x = self.errors, np.array(x)
        shared = x[: errors.unknowns.shared]  # what a variable starts with tells its size, which is never zero
        shared[np.abs(shared) < LEAST] = LEAST
        start = errors.places.values(x)
        for label, course in zip(self.labels, courses):
            for j, name in enumerate(self.equations.states):  # a run may pass a bound, where equations stay as they are
                start[f"states of {name}{label}"] = np.clip(
                    course[:, j], *(end / errors.usual[j] for end in self.equations.interval(name)))
        return start


def _within(expression: Any, low: float, high: float) -> list[Any]:
    """Return bounds as constraints, which have prices; none where open."""
    return [expression >= low] * bool(np.isfinite(low)) + [expression <= high] * bool(np.isfinite(high))
