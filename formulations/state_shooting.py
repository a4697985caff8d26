"""State-space models with the states at every sample as variables: one sparse programme for NLP back ends.

    minimise sum_k |W (y(k) - output(k))|²
    subject to x(k+1) = A x(k) + B f(u(k)) + E g(output(k)) + Ez h(z(k)),
               output(k) = C x(k) + D f(u(k)) + Fz h(z(k)) + d,    z(k) = Cz x(k) + Dz u(k) + const,

multiple shooting with one sample between the nodes (Bock 1981) for the free run, with the optima of ``ss.exact``,
``hammerstein_ss.exact`` and ``lfr.exact`` and another way there: a cross-check of their descents, and the way for
constraints on states. A start is found as there; the programme is posed at the end of its descent, with the weights W
found on the way, or at the best start itself with ``iterations=0``.

The matrices are full; what changes no output (changes of the states, the scales of products such as mu b, affine
changes of z) is fixed by linear rows: the step from the start is orthogonal to it. Courses stay within ten times
their size at the start; nothing else keeps the poles inside the unit circle. Constraints that the start violates by
much may lead to states that satisfy the equations backwards in time. A result whose run is unstable, or is not the
run of its model, says so in its status. The functions g and h need a formula: polynomials and trigonometric ones,
which the programme continues beyond their interval. The states are those of the start up to the small change that the
gauge allows: constraints on single states suit models given as ``initial``, constraints on ``output`` every model.

IPOPT takes records up to the limit in seconds; Uno and fatrop factorise densely and are for some hundred samples.

Named variables: those of `formulations.state_space` (``A``, ``C``, ``mu``, ``b``, ``z``, ...), with the exact products
``Theta``, and the courses ``states`` (N, nx) and ``output`` (N, l), with several experiments ``states[1]``, ...
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.latent_signals import latent_channels
from formulations.state_space import state_space_fit, state_space_model
from optid.bases import Bases
from optid.core.judge import largest_excess
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.arguments import in_memory
from optid.identify.prediction_error.compressed_errors import CompressedStates
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.simultaneous import expressed, judged_by_run
from optid.identify.prediction_error.state_errors import WILD, StateErrors
from optid.identify.prediction_error.tangent_descent import NO_BOUND
from optid.identify.prediction_error.tangent_fit import Places, with_signs
from optid.identify.subspace.plan import Plan
from optid.identify.subspace.steps import subspace_steps
from optid.models import HammersteinSS
from optid.program.sizes import GAUGE
from optid.program.solution import Bound, Status
from optid.program.units import outer_bases
from optid.program.view import View
from optid.solving.solve import Evidence, Procedure

Array = np.ndarray

LIMIT = 5_000  # samples up to which the programme is built


@subspace_steps({"ss.shooting": "NLP"})
def ss(data: Data, *, nx: int | str, block_rows: int | Sequence[int] | None = None, weighting: str = "auto",
       offset: bool = True, feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
       initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100, constraints: Sequence[Any] = ()
       ) -> Procedure:
    """Minimise the simulation error of a linear model with its states as variables.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``offset``, ``output``, ``states``, ``x0``.
    Arguments as in `hammerstein_ss`, as are the errors raised.
    """
    return _fit("ss", data, nx, block_rows=block_rows, weighting=weighting, offset=offset, feedthrough=feedthrough,
                stability=stability, initial=initial, iterations=iterations, constraints=constraints)


@subspace_steps({"hammerstein_ss.shooting": "NLP"})
def hammerstein_ss(data: Data, *, nx: int | str, basis: Bases = "polynomial:3", feedback_basis: Any = None,
                   block_rows: int | Sequence[int] | None = None, weighting: str = "auto", offset: bool = True,
                   feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
                   initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
                   constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a Hammerstein model, with output feedback or without, its states as variables.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``mu``, ``offset``, ``output``, ``states``,
    ``x0``. Other arguments as in `formulations.state_space.hammerstein_ss`.

    Args:
        feedback_basis: polynomials or trigonometric functions.
        iterations: Gauss-Newton steps per descent at most; 0 starts from the best subspace fit.
        constraints: builders of smooth constraints in the named variables.

    Raises:
        StructureError: as there, and too many samples, a rule about poles, a basis of the feedback without a formula.
        DataError, RankError: as there.
    """
    return _fit("hammerstein_ss", data, nx, basis=basis, feedback_basis=feedback_basis, block_rows=block_rows,
                weighting=weighting, offset=offset, feedthrough=feedthrough, stability=stability, initial=initial,
                iterations=iterations, constraints=constraints)


@subspace_steps({"lfr.shooting": "NLP"})
def lfr(data: Data, *, nx: int | str, channels: int = 1, latent_basis: Any = "polynomial:3",
        latent: str = "states+inputs", direct: bool = False, basis: Bases = "linear",
        block_rows: int | Sequence[int] | None = None, weighting: str = "auto", offset: bool = True,
        feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
        initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100, seed: int = 0,
        tries: int = 2, constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a model with functions of latent signals, its states as variables.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``b latent``, ``mu``, ``mu latent``, ``offset``, ``output``,
    ``signal of z``, ``states``, ``x0``, ``z``. Other arguments as in `formulations.latent_signals.lfr`,
    errors raised as in `hammerstein_ss`.

    Args:
        latent_basis: polynomials or trigonometric functions.
    """
    extend = latent_channels(channels, latent_basis, latent, direct, seed, iterations, tries)
    return _fit("lfr", data, nx, basis=basis, block_rows=block_rows, weighting=weighting, offset=offset,
                feedthrough=feedthrough, stability=stability, initial=initial, iterations=iterations,
                constraints=constraints, extend=extend)


def _fit(name: str, data: Data, nx: int | str, constraints: Sequence[Any], stability: str, **settings: Any
         ) -> Procedure:
    count = in_memory(data, "simulation errors").n_samples
    if count > LIMIT:
        raise StructureError(f"{count} samples: with the states of every sample as variables this formulation takes up "
                             f"to {LIMIT}. Use '{name}.exact', which has the same optima, or fewer samples")
    for rule in constraints:
        if getattr(rule, "about", frozenset()) == frozenset({"poles"}):
            raise StructureError(f"constraint {rule.name!r} is about poles, which this programme does not have: use it "
                                 f"with '{name}.exact'")
    return state_space_fit(f"{name}.shooting", data, nx, criterion="simulation", stability=stability,
                           constraints=constraints, finish=_shoot, **settings)


def _shoot(plan: Plan, errors: StateErrors, constraints: tuple[Any, ...], best: Descent,
           figures: Mapping[str, Any]) -> Procedure:
    """Solve the problem from the result of the descents, and judge the model by its run."""
    fit = StateShooting(plan.name, errors, constraints, plan.units)
    x = with_signs(errors, best.x, fit.excess if constraints else None)
    problem = replace(fit.pose(x), settled=best.converged)
    solution = yield problem
    if not solution.has_point:
        return None
    x = fit.places.pack(solution.values)
    status, reason = judged_by_run(errors, x, solution)
    if status is Status.LOCAL and isinstance(problem.compressed, CompressedStates):
        problem.compressed.settle(solution.values)
    model = fit.recover(solution.values)
    bound = Bound.none(NO_BOUND.format(errors.errors))
    return Evidence(model, solution.objective, bound, status, reason, {**figures, "Gauss-Newton steps": best.steps})


@dataclass(frozen=True, eq=False)
class StateShooting:
    """The programme of a record, and the model of its values."""

    name: str  # of the formulation
    criterion: StateErrors
    constraints: tuple[Any, ...]  # the user's
    units: Transform  # from those of the programme to those of the record

    @cached_property
    def places(self) -> Places:
        """The named unknowns in the order of their vector."""
        return Places.of(self.criterion)

    def recover(self, values: Mapping[str, Array]) -> HammersteinSS:
        """Return the model of the values of the variables, in the units of the programme."""
        return state_space_model(self.criterion, bool(self.constraints), values)

    def excess(self, z0: Array) -> float:
        """Return the largest relative violation of a constraint at the start z0."""
        problem = self.pose(z0)
        return largest_excess(problem, problem.start)

    def pose(self, z0: Array) -> Problem:
        """State the problem with the start z0."""
        errors, start = self.criterion, dict(self.places.values(z0))
        compressed = CompressedStates(errors, errors.linearise(z0), z0, self.units, fixed=True)
        rows = np.pad(errors.gauge_rows(z0), ((0, 0), (0, z0.size - errors.unknowns.shared)))
        if len(rows := np.vstack([rows, compressed.free])):
            rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        runs, terms, courses = errors.visited(errors.unknowns.unpack(z0)), [], {}
        for i, label in enumerate(errors.labels):
            courses |= self._courses(i, label, runs[i], start)
            weights, measured = errors.output_weights(i), np.nan_to_num(errors.data.experiments[i].y).ravel(order="F")
            terms.append(Squares(weights, weights @ measured, 0.0, (f"output{label}",)))
        limits = {name: np.broadcast_to(WILD * np.max(np.abs(one), axis=0), one.shape) for name, one in courses.items()}
        bounds = {name: (-limit, limit) for name, limit in limits.items()}
        unknowns, key = errors.unknowns, errors.key
        fixed = [c for c, free in enumerate(unknowns.free) if not free]

        def equations(v: View) -> dict[str, Any]:
            found = {GAUGE: rows @ (self.places.stacked(v.inner) - z0) == 0} if len(rows) else {}
            for i, label in enumerate(errors.labels):
                found |= self._equations(i, label, v.inner)
            return found

        return Problem(
            self.name, {**start, **courses}, tuple(terms),
            tuple(Product(key("mu", c), key("b", c), "") for c, free in enumerate(unknowns.free) if free), self.recover,
            {"gauge": "norm", "channels": unknowns.expansion.input_names, "outputs": unknowns.expansion.output_names,
             "reference": {**start, **courses}, "units": self.units,
             "bases": dict(zip(unknowns.expansion.input_names, outer_bases(unknowns.expansion.inputs, self.units)))},
            further=lambda v, _: {key("Theta", c): cp.reshape(v[key("b", c)], (1, -1), order="C") for c in fixed},
            restrictions=(equations,), scale=errors.energy, compressed=compressed, bounds=bounds,
            courses=frozenset(courses), proof=NO_BOUND.format(errors.errors)).subject_to(*self.constraints)

    def _courses(self, i: int, label: str, run: Array, start: Values) -> dict[str, Array]:
        """Return the courses of one experiment, its states those of a run."""
        v: dict[str, Any] = {name: cp.Constant(value) for name, value in start.items()}
        found = {f"states{label}": run}
        v[f"states{label}"] = cp.Constant(run)
        for name, argument in self._arguments(i, label, v).items():
            found[name] = np.asarray(argument.value)
            v[name] = cp.Constant(found[name])
        return {**found, f"output{label}": np.asarray(self._acting(i, label, v)[1].value)}

    def _arguments(self, i: int, label: str, v: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the latent signals of one experiment are equal to."""
        x, u, n, found = v[f"states{label}"], self.criterion.data.experiments[i].u, self.criterion.unknowns.n, {}
        for j, one in enumerate(self.criterion.unknowns.latent):
            name = self.criterion.key("z", j)
            row = v[name]
            found[f"signal of {name}{label}"] = x @ row[:n] + row[-1] + (u @ row[n:-1] if one.moved else 0.0)
        return found

    def _acting(self, i: int, label: str, v: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return the states that follow, without what outputs feed back, and the outputs."""
        e, unknowns, key, x = (self.criterion.data.experiments[i], self.criterion.unknowns, self.criterion.key,
                               v[f"states{label}"])
        n, following, shown = unknowns.n, x @ v["A"].T, x @ v["C"].T
        for c, basis in enumerate(unknowns.expansion.inputs):
            b, eta = v[key("b", c)], basis.values(e.u[:, c])
            f = eta @ v[key("mu", c)] if unknowns.free[c] else cp.Constant(eta[:, 0])
            following = following + cp.outer(f, b[:n])
            shown = shown + cp.outer(f, b[n:]) if unknowns.feedthrough[c] else shown
        for j, one in enumerate(unknowns.latent):
            matrix = v[key("g", j)]
            h = expressed(one.basis, v[f"signal of {key('z', j)}{label}"], one.vectors @ v[key("c", j)])
            following = following + cp.outer(h, matrix[:n])
            shown = shown + cp.outer(h, matrix[n:]) if one.direct else shown
        if unknowns.constant:
            shown = shown + cp.outer(cp.Constant(np.ones(e.n_samples)), v["offset"])
        return following, shown

    def _equations(self, i: int, label: str, v: Mapping[str, Any]) -> dict[str, Any]:
        """Return the equations that tie the courses of one experiment."""
        output, key = v[f"output{label}"], self.criterion.key
        following, shown = self._acting(i, label, v)
        for j, family in enumerate(self.criterion.unknowns.expansion.feedback):
            nu = v[key("nu", j)] if family.size > 1 else np.ones(1)
            g = (expressed(family.basis, output[:, family.output], family.vectors @ nu)
                 - family.intercept @ nu - output @ (family.slope.T @ nu))
            following = following + cp.outer(g, v[key("e", j)])
        first = v["x0"] if len(self.criterion.labels) == 1 else v["x0"][:, i]
        return {**{name: v[name] == argument for name, argument in self._arguments(i, label, v).items()},
                f"initial state{label}": v[f"states{label}"][0] == first,
                f"dynamics{label}": v[f"states{label}"][1:] == following[:-1], f"outputs{label}": output == shown}
