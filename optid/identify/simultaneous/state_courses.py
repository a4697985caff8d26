"""The courses of a state-space model: states, outputs, and latent signals.

    x(k+1) = A x(k) + B f(u(k)) + E g(output(k)) + Ez h(z(k)),
    output(k) = C x(k) + D f(u(k)) + Fz h(z(k)) + d,    z(k) = Cz x(k) + Dz u(k) + const

What changes no output (changes of the states, the scales of products such as mu b, affine changes of z) is fixed by
linear rows: the step from the start is orthogonal to it. Courses stay within ten times their size at the start; nothing
else keeps the poles inside the unit circle, so that the model is judged by its run in the end.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.bases.basis import Basis, span
from optid.bases.expansions import Polynomial, Trigonometric
from optid.core.judge import largest_excess
from optid.core.leaves import GAUGE
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.arguments import in_memory
from optid.identify.prediction_error.compressed_errors import CompressedStates
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.signs import with_signs
from optid.identify.prediction_error.state_errors import WILD, StateErrors
from optid.identify.prediction_error.tangent_descent import NO_BOUND
from optid.identify.simultaneous.courses import Courses, Expressions, Formula, Pose, Reading, check_size
from optid.identify.subspace.plan import Plan
from optid.models.roots import spectral_radius
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure

# relative difference between the objective and the squared errors of a run of the model that is rounding
SAME_RUN = 1e-6
LIMIT = 5_000  # samples up to which the programme is built


@dataclass(frozen=True, eq=False)
class StateCourses(Courses):
    """The courses ``states`` (N, n), ``output`` (N, l) and ``signal of z`` (N,), from a point x of the unknowns."""

    criterion: StateErrors
    x: Array

    def start(self) -> dict[str, Array]:
        """Return the unknowns with the courses of their run."""
        errors = self.criterion
        runs = errors.run_states(errors.unknowns.unpack(self.x))
        return self.complete({**errors.variables.values(self.x),
                              **dict(zip([f"states{label}" for label in errors.labels], runs))})

    def limits(self, start: Values) -> dict[str, tuple[Array, Array]]:
        """Return ten times the largest value of every column."""
        sizes = {name: WILD * np.max(np.abs(value), axis=0) * np.ones(value.shape) for name, value in start.items()
                 if name not in self.criterion.variables.names}
        return {name: (-size, size) for name, size in sizes.items()}

    def readings(self, i: int) -> Iterator[Reading]:
        """Yield all outputs, with the weights of the errors."""
        weights = self.criterion.output_weights(i)
        measured = np.nan_to_num(self.criterion.data.experiments[i].y).ravel(order="F")
        yield Reading(f"output{self.criterion.labels[i]}", weights, weights @ measured)

    @cached_property
    def compressed(self) -> CompressedStates:
        """The errors near x, without the directions that `confining` fixes."""
        return CompressedStates(self.criterion, self.criterion.linearise(self.x), self.x, fixed=True)

    @cached_property
    def _still(self) -> Array:
        """Directions (k, n) that change no output, as rows."""
        unseen = self.criterion.gauge_rows(self.x)
        rows = np.vstack([np.pad(unseen, ((0, 0), (0, self.x.size - unseen.shape[1]))), self.compressed.free])
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)

    def confining(self, v: Expressions) -> dict[str, Any]:
        """Return that the step from x is orthogonal to what changes no output."""
        step = self.criterion.variables.stack(v) - self.x
        return {GAUGE: self._still @ step == 0} if len(self._still) else {}

    def further(self, v: Expressions, x: Values) -> dict[str, Any]:
        """Return Theta of every linear input."""
        return self.criterion.linear_thetas(v)

    def formulas(self, i: int) -> dict[str, Formula]:
        """Return what the latent signals and the outputs are equal to."""
        label = self.criterion.labels[i]
        return {**{f"signal of {self.criterion.key('z', j)}{label}": partial(self._argument, i, j)
                   for j in range(len(self.criterion.unknowns.latent))},
                f"output{label}": lambda v: self._acting(i, v)[1]}

    def following(self, i: int, v: Expressions) -> dict[str, list[Any]]:
        """Return the step from every state to the next, and what the first one is."""
        errors, label = self.criterion, self.criterion.labels[i]
        states, output, after = v[f"states{label}"], v[f"output{label}"], self._acting(i, v)[0]
        for j, family in enumerate(errors.unknowns.expansion.feedback):
            nu = v[errors.key("nu", j)] if family.size > 1 else np.ones(1)
            g = (express(family.basis, output[:, family.output], family.vectors @ nu)
                 - family.intercept @ nu - output @ (family.slope.T @ nu))
            after = after + cp.outer(g, v[errors.key("e", j)])
        first = v["x0"] if len(errors.labels) == 1 else v["x0"][:, i]
        return {f"initial state{label}": [states[0] == first], f"dynamics{label}": [states[1:] == after[:-1]]}

    def _argument(self, i: int, j: int, v: Expressions) -> Any:
        """Return the combination of states and inputs that a latent signal is."""
        errors, row, n = self.criterion, v[self.criterion.key("z", j)], self.criterion.unknowns.n
        moved = errors.data.experiments[i].u @ row[n:-1] if errors.unknowns.latent[j].moved else 0.0
        return v[f"states{errors.labels[i]}"] @ row[:n] + row[-1] + moved

    def _acting(self, i: int, v: Expressions) -> tuple[Any, Any]:
        """Return the states that follow, without what outputs feed back, and the outputs."""
        errors, unknowns, key = self.criterion, self.criterion.unknowns, self.criterion.key
        e, x, n = errors.data.experiments[i], v[f"states{errors.labels[i]}"], unknowns.n
        after, shown = x @ v["A"].T, x @ v["C"].T
        for c, basis in enumerate(unknowns.expansion.inputs):
            b, eta = v[key("b", c)], basis.values(e.u[:, c])
            f = eta @ v[key("mu", c)] if unknowns.free[c] else cp.Constant(eta[:, 0])
            after = after + cp.outer(f, b[:n])
            shown = shown + cp.outer(f, b[n:]) if unknowns.feedthrough[c] else shown
        for j, one in enumerate(unknowns.latent):
            matrix = v[key("g", j)]
            h = express(one.basis, v[f"signal of {key('z', j)}{errors.labels[i]}"], one.vectors @ v[key("c", j)])
            after = after + cp.outer(h, matrix[:n])
            shown = shown + cp.outer(h, matrix[n:]) if one.direct else shown
        if unknowns.constant:
            shown = shown + cp.outer(cp.Constant(np.ones(e.n_samples)), v["offset"])
        return after, shown


def check_states(name: str, data: Data, constraints: Sequence[Any]) -> None:
    """Refuse what the ``.exact`` formulation of a name takes and this programme does not (`StructureError`)."""
    check_size(in_memory(data, "simulation errors").n_samples, LIMIT,
               f"'{name}.exact', which has the same optima, or fewer samples")
    for rule in constraints:
        if getattr(rule, "about", frozenset()) == frozenset({"poles"}):
            raise StructureError(f"constraint {rule.name!r} is about poles, which this programme does not have: use it "
                                 f"with '{name}.exact'")


def shoot(pose: Pose, plan: Plan, errors: StateErrors, constraints: Sequence[Any], best: Descent,
          figures: Mapping[str, Any]) -> Procedure:
    """Solve the problem from the result of the descents, and judge the model by its run.

    See `optid.identify.prediction_error.state_fit.fit_states`, of which this is an end.
    """
    def at(x: Array) -> tuple[StateCourses, Problem]:
        courses = StateCourses(errors, x)
        problem = pose(plan.name, courses, courses.start(), constraints)
        return courses, replace(problem, model=partial(errors.model, constrained=bool(constraints)))

    def excess(x: Array) -> float:
        problem = at(x)[1]
        return largest_excess(problem, problem.start)

    courses, problem = at(with_signs(errors, best.x, excess if constraints else None))
    solution = yield replace(problem, settled=best.converged)
    if not solution.has_point:
        return None
    status, reason = _judged_by_run(errors, errors.variables.pack(solution.values), solution)
    if status is Status.LOCAL:
        courses.compressed.settle(solution.values)
    return Evidence(problem.model(solution.values), solution.objective, Bound.none(NO_BOUND.format(errors.errors)),
                    status, reason, {**figures, "Gauss-Newton steps": best.steps})


def _judged_by_run(errors: StateErrors, x: Array, solution: Solution) -> tuple[Status, str]:
    """Take the solver's status only where the model is stable and its run has the errors of the programme."""
    if not solution.status.is_optimum:
        return solution.status, solution.reason
    radius = spectral_radius(errors.unknowns.unpack(x).A)
    if radius >= errors.limit:
        return Status.INACCURATE, (f"the model is unstable (spectral radius of A {radius:.6g}): its states satisfy the "
                                   "equations, but no run from x0 will; use the .exact formulation or stability='free'")
    value = errors.value(x)
    if not abs(value - solution.objective) <= SAME_RUN * abs(value) + 1e-9 * errors.energy:
        return Status.INACCURATE, (f"a run of the model has the squared errors {value:.6g}, the programme "
                                   f"{solution.objective:.6g}: it is unstable, or leaves the interval of a function, "
                                   "where this programme continues it; give that basis outside='extrapolate'")
    return Status.LOCAL, NO_BOUND.format(errors.errors)


def express(basis: Basis, v: Any, coefficients: Any) -> Any:
    """Return sum_j coefficients[j] eta_j(v) of a basis with a formula, as an expression of a course v."""
    low, high = span(basis)
    if isinstance(basis, Polynomial):
        t = (2 * v - low - high) / (high - low)
        before, now = cp.Constant(np.ones(v.size)), t
        functions = [t]
        for k in range(1, basis.p):
            before, now = now, ((2 * k + 1) * cp.multiply(t, now) - k * before) / (k + 1)
            functions.append(now)
    elif isinstance(basis, Trigonometric):
        angle = np.pi / (basis.half_range * (high - low) / 2) * (v - (low + high) / 2)
        atoms: Any = cp  # the stubs know no trigonometric functions
        functions = [atom(j * angle) for j in range(1, basis.p + 1) for atom in (atoms.cos, atoms.sin)]
    else:
        raise StructureError(f"a {type(basis).__name__.lower()} basis of outputs or latent signals has no formula that "
                             "NLP solvers can differentiate: use 'polynomial:p' or 'trigonometric:p', or the .exact "
                             "formulation")
    return sum(coefficients[j] * function for j, function in enumerate(functions))
