"""The courses of equations given by the user: every state at the steps of integration, every output at the samples.

    x(k+1) - x(k) = h/2 [f(x(k), u(k), p) + f(x(k+1), u(k), p)],    output(k) = g(x(k), u(k), p)

The rule is the trapezoidal one (direct collocation, Hargraves and Paris 1987), in discrete time x(k+1) = f(x(k), u(k),
p). Unknowns are in multiples of their usual sizes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from optid.arrays import LARGEST_INTEGER, Array, check_integer
from optid.core.terms import Values
from optid.data.record import Data
from optid.identify.physical import CompressedPhysical, PhysicalErrors
from optid.identify.prediction_error.descent import best_of
from optid.identify.simultaneous.courses import Courses, Expressions, Formula, Pose, Reading, check_size
from optid.models.equations import Equations
from optid.models.equations import equations as read
from optid.solving.solve import Procedure

LIMIT = 20_000  # states at all steps of integration up to which the programme is built
REWEIGHTED = 3  # times that outputs are weighted anew by their errors
LEAST = 1e-2  # parameters start from no less than this share of their usual size


@dataclass(frozen=True, eq=False)
class EquationCourses(Courses):
    """The courses ``states of h`` (steps,) of every state h but for its first value, and ``output y`` (N,)."""

    criterion: PhysicalErrors

    def readings(self, i: int) -> Iterator[Reading]:
        """Yield every output."""
        errors, e = self.criterion, self.criterion.data.experiments[i]
        for o, name in enumerate(errors.data.outputs):
            there, weight = np.isfinite(e.y[:, o]), float(np.sqrt(errors.weight[o, o]))
            yield Reading(f"output {name}{errors.labels[i]}", weight * sp.eye_array(e.n_samples).tocsr()[there],
                          weight * e.y[there, o])

    def following(self, i: int, v: Expressions) -> dict[str, list[Any]]:
        """Return the dynamics, and the bounds of the first states."""
        errors, label, found = self.criterion, self.criterion.labels[i], dict[str, list[Any]]()
        equations, courses, grid = errors.equations, self._courses(i, v), errors.grid(i)
        for j, name in enumerate(equations.states):
            first = v["x0"][j] if v["x0"].ndim == 1 else v["x0"][j, i]
            if ends := within(first, *(end / errors.usual[j] for end in equations.interval(name))):
                found[f"first value of {name}{label}"] = ends
        moves = self._right({name: course[:-1] for name, course in courses.items()}, grid[:-1], v)
        if errors.steps:
            half = errors.data.dt / errors.steps / 2  # of a step
            later = {name: course[1:] for name, course in courses.items()}
            ends = self._right(later, grid[:-1] if equations.hold == "zero" else grid[1:], v)
            moves = {name: course[:-1] + half * (moves[name] + ends[name]) for name, course in courses.items()}
        return {**found, f"dynamics{label}": [(course[1:] - moves[name]) / errors.usual[j] == 0
                                              for j, (name, course) in enumerate(courses.items())]}

    def formulas(self, i: int) -> dict[str, Formula]:
        """Return what the outputs are equal to."""
        return {f"output {name}{self.criterion.labels[i]}": partial(self._output, i, name)
                for name in self.criterion.data.outputs}

    def _output(self, i: int, name: str, v: Expressions) -> Any:
        apart = max(self.criterion.steps, 1)
        at = {state: course[::apart] for state, course in self._courses(i, v).items()}
        return self._right(at, self.criterion.data.experiments[i].u, v)[name]

    def further(self, v: Expressions, x: Values) -> dict[str, Any]:
        """Return parameters and states in the units of the equations."""
        errors, apart = self.criterion, max(self.criterion.steps, 1)
        sizes = errors.usual[errors.unknowns.n :]
        found = {name: size * v[name] for name, size in zip(errors.equations.parameters, sizes)}
        for i, label in enumerate(errors.labels):
            found |= {f"{name}{label}": course[::apart] for name, course in self._courses(i, v).items()}
        return found

    def limits(self, start: Values) -> dict[str, tuple[Array, Array]]:
        """Return the bounds of the states."""
        errors, found = self.criterion, {}
        for name, size in zip(errors.equations.states, errors.usual):
            low, high = errors.equations.interval(name)
            for key in (f"states of {name}{label}" for label in errors.labels):
                found[key] = np.full(start[key].shape, low / size), np.full(start[key].shape, high / size)
        return found

    @property
    def compressed(self) -> CompressedPhysical:
        """The errors, once a solution is known."""
        return CompressedPhysical(self.criterion)

    def bounds(self, view: Mapping[str, Any]) -> dict[str, list[Any]]:
        """Return the bounds of the parameters, which have prices."""
        equations = self.criterion.equations
        found = {f"bounds of {name}": within(view[name], *equations.interval(name)) for name in equations.parameters}
        return {name: limits for name, limits in found.items() if limits}

    def start(self, starts: int, seed: int) -> tuple[dict[str, Array], bool]:
        """Return the best run of several descents and that it is one; without any, courses that outputs show.

        Args:
            starts: how many starts descend.
            seed: of those after the first.
        """
        errors, n = self.criterion, self.criterion.unknowns.n
        found = best_of(errors, errors.starts(starts, seed), enough=2)
        if found and np.isfinite(found[0].value):
            x = found[0].x
            p, first = errors.split(x)
            runs = [errors.run_states(i, state, p)[1:] / errors.usual[:n] for i, state in enumerate(first)]
            return self._start(x, runs), True
        courses = [errors.course(i) / errors.usual[:n] for i in range(len(errors.labels))]
        p = np.array(list(errors.equations.parameters.values())) / errors.usual[n:]
        runs = [np.repeat(course[:-1], max(errors.steps, 1), axis=0) for course in courses]
        return self._start(np.concatenate([p, *(course[0] for course in courses)]), runs), False

    def _start(self, x: Array, runs: Sequence[Array]) -> dict[str, Array]:
        errors, x = self.criterion, np.array(x)
        shared = x[: errors.unknowns.shared]  # solvers scale variables by their start: avoid zero
        shared[np.abs(shared) < LEAST] = LEAST
        start = errors.variables.values(x)
        for label, run in zip(errors.labels, runs):  # which may pass a bound, beyond which equations stay as they are
            for j, name in enumerate(errors.equations.states):
                start[f"states of {name}{label}"] = np.clip(
                    run[:, j], *(end / errors.usual[j] for end in errors.equations.interval(name)))
        return self.complete(start)

    def _courses(self, i: int, v: Expressions) -> dict[str, Any]:
        """Return the states of an experiment at the steps of integration."""
        errors, x0 = self.criterion, v["x0"]
        return {name: errors.usual[j] * cp.hstack([x0[j] if x0.ndim == 1 else x0[j, i],
                                                   v[f"states of {name}{errors.labels[i]}"]])
                for j, name in enumerate(errors.equations.states)}

    def _right(self, states: Expressions, u: Array, v: Expressions) -> dict[str, Any]:
        """Evaluate the equations on courses of states and inputs (T, m)."""
        data, equations = self.criterion.data, self.criterion.equations
        inputs = {name: cp.Constant(u[:, c]) for c, name in enumerate(data.inputs)}
        parameters = {name: v[name] for name in equations.parameters}
        found = equations.evaluate({**inputs, **parameters, **states}, data.outputs)
        return {name: cp.Constant(np.zeros(len(u))) + value for name, value in found.items()}


def fit_equations(pose: Pose, data: Data, equations: Equations | str, constraints: Sequence[Any], starts: int, seed: int
                  ) -> Procedure:
    """Solve the problem from the best of several descents, weigh several outputs anew by their errors.

    Arguments and errors as of `formulations.simultaneous.physical`.
    """
    errors = PhysicalErrors.of(data, read(equations))
    count = sum(e.n_samples for e in errors.data.experiments) * max(errors.steps, 1) * errors.unknowns.n
    check_size(count, LIMIT, "fewer samples, or a longer step", "states at all steps of integration")
    check_integer(starts, "starts")
    check_integer(seed, "seed", 0, LARGEST_INTEGER)
    return _reweighted(pose, errors, constraints, starts, seed)


def _reweighted(pose: Pose, errors: PhysicalErrors, constraints: Sequence[Any], starts: int, seed: int) -> Procedure:
    start, settled = EquationCourses(errors).start(starts, seed)
    for left in reversed(range(REWEIGHTED + 1 if errors.data.l > 1 else 1)):
        courses = EquationCourses(errors)
        problem = replace(pose("physical", courses, start, (courses.bounds, *constraints)), settled=settled)
        solution = yield problem
        if not solution.has_point:
            return None
        if left:
            errors, settled = errors.reweight(errors.variables.pack(solution.values)), True
            start = {name: solution.values[name] for name in problem.start}
    problem.compressed.settle(solution.values)
    if solution.status.is_optimum:
        problem.compressed.refuse_undetermined(problem, solution.values)
    return problem.model(solution.values)


def within(expression: Any, low: float, high: float) -> list[Any]:
    """Return bounds as constraints, which have prices; none where open."""
    return [expression >= low] * bool(np.isfinite(low)) + [expression <= high] * bool(np.isfinite(high))
