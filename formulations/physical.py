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
import scipy.sparse as sp

from optid.arrays import LARGEST_INTEGER, check_integer
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.physical import CompressedPhysical, PhysicalErrors
from optid.identify.prediction_error.descent import best_of
from optid.models.equations import Equations
from optid.models.equations import equations as read
from optid.program.solution import Status
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
    problem = replace(collocation.problem(start), settled=settled).subject_to(*constraints)
    solution = yield problem
    for _ in range(REWEIGHTED if errors.data.l > 1 and solution.has_point else 0):
        errors = errors.reweighted(errors.places.pack(solution.values))
        start = {name: solution.values[name] for name in problem.start}
        problem = replace(_Collocation(errors).problem(start), settled=True).subject_to(*constraints)
        solution = yield problem
    if not solution.has_point:
        return None
    if isinstance(problem.compressed, CompressedPhysical):
        problem.compressed.settle(solution.values)
        if solution.status in (Status.LOCAL, Status.OPTIMAL):
            problem.compressed.refuse_undetermined(problem, solution.values)
    return problem.model(solution.values)


class _Collocation:
    """States the problem of one record."""

    def __init__(self, errors: PhysicalErrors) -> None:
        self.errors, self.data, self.equations = errors, errors.data, errors.equations
        self.labels, self.apart = errors.labels, max(errors.steps, 1)

    def problem(self, start: Values) -> Problem:
        """Return the problem with a start, under the bounds that the equations give their parameters."""
        errors, terms = self.errors, []
        bounds = {}
        for key, (name, size) in ((f"states of {name}{label}", (name, size)) for label in self.labels
                                  for name, size in zip(self.equations.states, errors.usual)):
            low, high = self.equations.interval(name)
            bounds[key] = np.full(np.shape(start[key]), low / size), np.full(np.shape(start[key]), high / size)
        for e, label in zip(self.data.experiments, self.labels):
            for o, name in enumerate(self.data.outputs):
                there, weight = np.isfinite(e.y[:, o]), float(np.sqrt(errors.weight[o, o]))
                terms.append(Squares(weight * sp.eye_array(e.n_samples).tocsr()[there], weight * e.y[there, o], 0.0,
                                     (f"output {name}{label}",)))
        return Problem(
            "physical", start, tuple(terms), model=lambda values: errors.model(errors.places.pack(values)),
            further=lambda v, _: self._in_words(v), restrictions=(self._equations,), builders=(self._within,),
            scale=errors.energy, unit=errors.unit, energy=errors.unit * errors.energy,
            compressed=CompressedPhysical(errors), bounds=bounds,
            courses=frozenset(name for name in start if name.startswith(("states of ", "output "))), proof=NO_BOUND)

    def _in_words(self, v: Mapping[str, Any]) -> dict[str, Any]:
        """Return parameters and states in the units of the equations."""
        sizes = self.errors.usual[self.errors.unknowns.n :]
        found = {name: size * v[name] for name, size in zip(self.equations.parameters, sizes)}
        for i, label in enumerate(self.labels):
            found |= {f"{name}{label}": course[:: self.apart] for name, course in self._courses(i, v).items()}
        return found

    def _courses(self, i: int, v: Mapping[str, Any]) -> dict[str, Any]:
        """Return the states of an experiment at the steps of integration."""
        x0, label = v["x0"], self.labels[i]
        return {name: self.errors.usual[j] * cp.hstack([x0[j] if x0.ndim == 1 else x0[j, i],
                                                        v[f"states of {name}{label}"]])
                for j, name in enumerate(self.equations.states)}

    def _within(self, view: View) -> dict[str, list[Any]]:
        """Return the bounds of the parameters, which have prices."""
        found = {f"bounds of {name}": _within(view[name], *self.equations.interval(name))
                 for name in self.equations.parameters}
        return {name: limits for name, limits in found.items() if limits}

    def _equations(self, view: View) -> dict[str, Any]:
        """Return the dynamics, the bounds of the first states, and what the outputs are."""
        errors, equations, v, found = self.errors, self.equations, view.inner, {}
        parameters = {name: view[name] for name in equations.parameters}
        for i, (e, label) in enumerate(zip(self.data.experiments, self.labels)):
            courses = self._courses(i, v)
            for j, name in enumerate(equations.states):
                first = v["x0"][j] if v["x0"].ndim == 1 else v["x0"][j, i]
                if ends := _within(first, *(end / errors.usual[j] for end in equations.interval(name))):
                    found[f"first value of {name}{label}"] = ends
            grid = errors.grid(i)
            now, after = (grid[:-1], grid[:-1] if equations.hold == "zero" else grid[1:])
            moves = self._right({name: course[:-1] for name, course in courses.items()}, now, parameters)
            if errors.steps:
                half = self.data.dt / self.apart / 2  # of a step
                ends = self._right({name: course[1:] for name, course in courses.items()}, after, parameters)
                moves = {name: course[:-1] + half * (moves[name] + ends[name]) for name, course in courses.items()}
            found[f"dynamics{label}"] = [(course[1:] - moves[name]) / errors.usual[j] == 0
                                         for j, (name, course) in enumerate(courses.items())]
            shown = self._right({name: course[:: self.apart] for name, course in courses.items()}, e.u, parameters)
            found[f"outputs{label}"] = [v[f"output {name}{label}"] == shown[name] for name in self.data.outputs]
        return found

    def _right(self, states: Mapping[str, Any], u: Array, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Evaluate the equations on courses of states and inputs (T, m)."""
        inputs = {name: cp.Constant(u[:, c]) for c, name in enumerate(self.data.inputs)}
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
        shared = x[: errors.unknowns.shared]  # solvers scale variables by their start: avoid zero
        shared[np.abs(shared) < LEAST] = LEAST
        start = errors.places.values(x)
        for label, course in zip(self.labels, courses):
            for j, name in enumerate(self.equations.states):  # a run may pass a bound, where equations stay as they are
                start[f"states of {name}{label}"] = np.clip(
                    course[:, j], *(end / errors.usual[j] for end in self.equations.interval(name)))
        v: dict[str, Any] = {name: cp.Constant(value) for name, value in start.items()}
        words = self._in_words(v)
        for i, (e, label) in enumerate(zip(self.data.experiments, self.labels)):
            at = {name: course[:: self.apart] for name, course in self._courses(i, v).items()}
            shown = self._right(at, e.u, {name: words[name] for name in self.equations.parameters})
            start |= {f"output {name}{label}": np.asarray(shown[name].value) for name in self.data.outputs}
        return start


def _within(expression: Any, low: float, high: float) -> list[Any]:
    """Return bounds as constraints, which have prices; none where open."""
    return [expression >= low] * bool(np.isfinite(low)) + [expression <= high] * bool(np.isfinite(high))
