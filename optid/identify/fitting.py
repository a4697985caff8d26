"""Fit a model: check the record, solve the problem, judge and prove the solution, report it."""

import pickle
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from optid.annotations import check_values
from optid.bases import Linear, fitted_bases
from optid.core.prices import Price, price_constraints
from optid.core.problem import Problem
from optid.data.record import Data, not_a_record
from optid.data.streams import Stream
from optid.errors import (
    DataError,
    DataWarning,
    InfeasibleError,
    OptidError,
    SolverFailed,
    StructureError,
    UnboundedError,
    nearest,
)
from optid.identify.arguments import violations
from optid.identify.dynamics import dynamics, input_levels
from optid.identify.parameters import Parameters, criteria, parameters, uncertainty_or_reason
from optid.identify.record_checks import examine, examine_figures, without_outliers
from optid.models.functions import has_feedback
from optid.phrases import plural
from optid.program.solution import Bound, Solution, Status
from optid.progress import log
from optid.registry import Rendered, annotations, check_arguments, defaults, formulation, read_constraints
from optid.solving.solve import Outcome, Procedure, run
from optid.solving.steps import Solvers, choose_solvers
from optid.threads import one_thread


@dataclass(frozen=True, repr=False)
class Fit(Rendered):
    """A fitted model with its formulation, arguments, record and outcome.

    A pickled fit keeps its results, but not its programme, which is built and solved again where it is needed (by
    `problem`, `uncertainty` or `resolve`); its constraints must then be picklable.

    Attributes:
        outcome: of the formulation; see `problem`, `solution`, `model`, `figures` and `steps`.
        prices: activity and price of every user constraint.
        findings: of the checks of the record, one sentence each.
        seconds: wall time of the whole call.
        settings: solver, accuracy and other settings of the solve.
        cross_validated: fits in % of the blocks that were left out when the structure was searched, and the pooled one.
    """

    outcome: Outcome = field(repr=False)
    formulation: str
    arguments: Mapping[str, Any] = field(repr=False)
    data: Data | Stream = field(repr=False)
    prices: tuple[Price, ...] = ()
    findings: tuple[str, ...] = ()
    seconds: float = 0.0
    settings: Mapping[str, Any] = field(default_factory=dict, repr=False)
    cross_validated: tuple[tuple[float, ...], float] | None = None

    @property
    def problem(self) -> Problem:
        """The last programme solved."""
        return self.outcome.problem

    @cached_property
    def steps(self) -> tuple[tuple[str, Solution], ...]:
        """Name and solution of every programme."""
        return self.outcome.steps

    @cached_property
    def solution(self) -> Solution:
        """Status, proof, residuals and times."""
        solution, evidence = self.outcome.solution, self.outcome.evidence
        if evidence and callable(evidence.bound):
            asked, started = self.settings.get("prove", True), time.perf_counter()
            bound = evidence.bound() if asked else Bound.none("no proof was asked for")
            closed = bound.proved and solution.status is Status.LOCAL
            late = time.perf_counter() - started if asked else 0.0
            times = replace(solution.times, prove=solution.times.prove + late, late=late)
            solution = replace(solution, bound=bound, times=times, **(
                {"status": Status.OPTIMAL, "reason": bound.reason} if closed else {}))
        reason, unbounded = _stand_in(self.arguments), solution.bound is not None and solution.bound.value == -np.inf
        if not reason or unbounded or solution.status not in (Status.OPTIMAL, Status.LOCAL):
            return solution
        return replace(solution, status=Status.LOCAL, bound=Bound.none(reason), reason=reason)

    @property
    def total_seconds(self) -> float:
        """The `seconds` of the fit and those of a proof that is tried when the solution is first asked for."""
        return self.seconds + self.solution.times.late

    @cached_property
    def _completed(self) -> tuple[Any, dict[str, Any]]:
        evidence = self.outcome.evidence
        try:
            model, figures = evidence.run_extension() if evidence else (self.outcome.model, {})
            return _in_raw_units(model, self.data), {**self.outcome.figures, **figures}
        except OptidError as reason:  # of the noise model: the model alone was accepted by `fit`
            model, figures = self.outcome.model, {"noise model": f"none: {reason}"}
            return _in_raw_units(model, self.data), {**self.outcome.figures, **figures}

    @property
    def model(self) -> Any:
        """The identified model in raw units, None without a point; its noise model is estimated on first use."""
        return self._completed[0]

    @property
    def figures(self) -> dict[str, Any]:
        """Rows used and available, condition number and method of the statistics, and figures of the formulation."""
        return self._completed[1]

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """Values at the solution of everything a constraint may refer to, by name, in the units of ``data``."""
        if not self.solution.has_point:
            return {}
        problem = self.problem
        return problem.named_quantities({name: self.solution.values[name] for name in problem.start})

    @cached_property
    def one_step_fit(self) -> np.ndarray:
        """One-step fit in % of every output, on the rows of the estimate or else on all samples of the record.

        NaN for a stream whose statistics do not contain it.
        """
        compressed = self.problem.compressed
        found = None if compressed is None else compressed.one_step_fit(self.solution.values)
        return self._fit("one step") if found is None else found

    @cached_property
    def simulation_fit(self) -> np.ndarray:
        """Simulation fit in % of every output on the estimation record, initial conditions fitted.

        NaN for a stream, and where the simulation diverges; missing inputs are left out, with an initial state after
        each.
        """
        return self._fit("simulation")

    @cached_property
    def measured_feedback_fit(self) -> np.ndarray:
        """As `simulation_fit`, with the outputs in the nonlinear feedback, if there is one, from the record."""
        return self._fit("measured feedback" if has_feedback(self.model) else "simulation")

    def _fit(self, word: str) -> np.ndarray:
        from optid.identify.validation.predictions import prediction_fit

        return (np.full(len(self.data.outputs), np.nan) if isinstance(self.data, Stream) else
                prediction_fit(self.model, self.data, word))

    @cached_property
    def uncertainty(self) -> Any:
        """Standard errors, intervals and bands (`optid.identify.uncertainty.Uncertainty`)."""
        from optid.identify.uncertainty import uncertainty

        return uncertainty(self)

    @property
    def informativity(self) -> Any:
        """What the record can tell (`optid.identify.informativity.Informativity`); None for a stream."""
        from optid.identify.informativity import informativity

        return informativity(self.data) if isinstance(self.data, Data) else None

    @property
    def record_findings(self) -> tuple[str, ...]:
        """What reading the record found, and what it can tell, one sentence each."""
        return (*self.data.findings, *(self.informativity.findings if self.informativity else ()))

    @cached_property
    def verdict(self) -> Any:
        """Tests of the model on the record (`optid.identify.verdict.Verdict`), without outliers that the loss left out.

        None for a stream, or no model.
        """
        from optid.identify.verdict import verdict

        if not isinstance(self.data, Data) or self.model is None:
            return None
        try:
            known = self.uncertainty
        except OptidError:
            known = None
        record = without_outliers(self.data, self.figures)
        return verdict(self.model, record, *(self.cross_validated or (None, None)), known)

    @cached_property
    def advice(self) -> tuple[Any, ...]:
        """At most five steps to improve the model (`optid.identify.advice.Advice`); some are tried."""
        from optid.identify.advice import advise

        return advise(self)

    def refit(self, *, data: Data | Stream | None = None, formulation: str | None = None,
              replaced: Mapping[str, Any] | None = None, **changes: Any) -> "Fit":
        """Fit again without a proof: the arguments of this fit, or `replaced`, with changes."""
        arguments = self.arguments if replaced is None else replaced
        return fit(self.data if data is None else data, formulation or self.formulation, prove=False,
                   **{**arguments, **changes})

    @cached_property
    def params(self) -> Parameters:
        """Estimates with standard errors and 95 % intervals, by name: ``fit.params["a1"]``."""
        return parameters(self)

    @cached_property
    def dynamics(self) -> Parameters:
        """Time constants, damping, dead time and static gain with their units, by name: ``fit.dynamics["dead time"]``.

        See `optid.identify.dynamics.dynamics` for what is counted as dead time, and for models that integrate.
        """
        record = self.data.raw() if isinstance(self.data, Data) else None
        return dynamics(self.model, input_levels(self.model, record), *uncertainty_or_reason(self))

    @property
    def poles(self) -> np.ndarray:
        """Poles of the model, complex, in the plane of z, the largest first (of a physical model: at its `point`)."""
        return self._fitted.poles

    @property
    def equation(self) -> str:
        """The equations of the model in raw units as text, one a line."""
        return self._fitted.equation()

    @property
    def _fitted(self) -> Any:
        """The model; a fit without one is refused."""
        if self.model is None:
            raise SolverFailed(f"the fit has no model: its status is {self.solution.status}")
        return self.model

    def conf_int(self, level: float = 0.95) -> Parameters:
        """Return the parameters with intervals of this level."""
        return parameters(self, level)

    def predict(self, data: Data | None = None, horizon: int = 1, *, interval: float | None = None) -> Any:
        """Predict so many samples ahead, as `Model.predict`; on the record of the fit when none is given.

        With an `interval`, a probability such as 0.95, return the `OutputInterval` (lower, value, upper) that contains
        a measured output with this probability; see `optid.identify.output_intervals.prediction_intervals`.
        """
        given = self._record() if data is None else data
        if not isinstance(given, Data):
            raise DataError(not_a_record(given, "fit.predict"))
        if interval is None:
            return self.model.predict(given, horizon)
        from optid.identify.output_intervals import prediction_intervals, with_notes

        return with_notes(prediction_intervals(self, given, horizon, interval), self, given)

    def simulate(self, u: Any = None, x0: Any = None, *, interval: float | None = None) -> Any:
        """Simulate from inputs (N, m) in raw units or a record, as `Model.simulate`; by default the record of the fit.

        By default the initial state x0 is zero for inputs, and fitted for a record. With an `interval`, a probability
        such as 0.95, return the `OutputInterval` (lower, value, upper) that contains a measured output with this
        probability; see `optid.identify.output_intervals.simulation_intervals`.
        """
        given = self._record() if u is None else u
        start = x0 if x0 is not None else "fit" if isinstance(given, Data) else "zero"
        if interval is None:
            return self.model.simulate(given, x0=start)
        from optid.identify.output_intervals import simulation_intervals, with_notes

        return with_notes(simulation_intervals(self, given, start, interval), self, given)

    @cached_property
    def residuals(self) -> Any:
        """One-step prediction errors (N, l) on the record, NaN where there are none; a tuple of several experiments."""
        return self.model.innovations(self._record())

    @cached_property
    def aic(self) -> float:
        """Akaike's information criterion of the one-step prediction errors."""
        return criteria(self)[0]

    @cached_property
    def bic(self) -> float:
        """The Bayesian information criterion of the one-step prediction errors."""
        return criteria(self)[1]

    def validate(self, data: Data | None = None, **options: Any) -> Any:
        """Compare the model with a record, as `optid.validate`; with that of the fit when none is given."""
        from optid.identify.validation import validate

        return validate(self.model, self._record() if data is None else data, **options)

    def save(self, path: str | Path) -> None:
        """Save the model as JSON; `optid.load` reads it."""
        self.model.save(path)

    def __repr__(self) -> str:
        """Say structure, verdict, fit and status, as far as they have been computed: nothing is computed for it."""
        known = vars(self)
        shown = [f"{key}={list(value) if isinstance(value, tuple) else value}"
                 for key, value in self.arguments.items() if _is_short(value)]
        rules = len(self.arguments.get("constraints", ()))
        parts = [" ".join([self.formulation, *shown, *([plural(rules, "constraint")] if rules else [])])]
        judged = known.get("verdict")
        if judged is not None:
            parts.append(f"verdict {judged.word}, fit {judged.score:.1f} %")
        else:
            parts.append("verdict not computed")
            parts += [f"{name.replace('_fit', '').replace('_', '-')} fit {np.min(known[name]):.1f} %"
                      for name in ("one_step_fit", "simulation_fit") if name in known]
        solution = known.get("solution") or (self.outcome.solution if "outcome" in known else None)
        return f"Fit({', '.join([*parts, *([str(solution.status)] if solution is not None else [])])})"

    def _record(self) -> Data:
        if not isinstance(self.data, Data):
            raise DataError("the fit is of a stream, whose samples are not kept: pass a record")
        return self.data

    def __copy__(self) -> "Fit":
        made = object.__new__(type(self))
        made.__dict__.update(vars(self))
        return made

    def __getstate__(self) -> dict[str, Any]:
        for name in ("solution", "_completed", "steps", "values"):
            getattr(self, name)
        constraints = tuple(_kept(one) for one in self.arguments.get("constraints", ()))
        arguments = {**self.arguments, **({"constraints": constraints} if constraints else {})}
        return {**{name: value for name, value in vars(self).items() if name != "outcome"}, "arguments": arguments}

    def __getattr__(self, name: str) -> Any:
        if name != "outcome" or "arguments" not in vars(self):  # a fit from a pickle has no outcome yet
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        settings = dict(self.settings)
        pose = formulation(self.formulation)[1]
        solvers = choose_solvers(self.formulation, pose, {**defaults(pose), **self.arguments},
                                 settings.pop("solver", "auto"))
        vars(self)["outcome"] = run(pose(self.data, **self.arguments), solvers, **settings)
        return self.outcome


def _is_short(value: Any) -> bool:
    """Whether an argument is a number, a word, or a short list of numbers."""
    numbers = isinstance(value, list | tuple) and len(value) <= 4 and all(isinstance(one, int | float) for one in value)
    return isinstance(value, int | float) or numbers or (isinstance(value, str) and len(value) <= 40)


@dataclass(frozen=True)
class _Lost:
    """Placeholder of a constraint that cannot be pickled."""

    name: str

    def __call__(self, view: Any) -> Any:
        raise StructureError(f"constraint {self.name!r} was not pickled with the fit, since it is an anonymous "
                             "function: use a rule of formulations.constraints, or a function of a module")


def _kept(constraint: Any) -> Any:
    try:
        pickle.dumps(constraint)
    except (pickle.PicklingError, AttributeError, TypeError):
        return _Lost(getattr(constraint, "name", getattr(constraint, "__name__", repr(constraint))))
    return constraint


@one_thread
def fit(data: Data | Stream, formulation_name: str | Callable[..., Any] = "hammerstein_arx.exact", *,
        solver: Any = "auto", accuracy: float = 1e-8, time_limit: float | None = None, isolate: bool | None = None,
        prove: bool = True, constraints: Sequence[Any] = (), solver_options: Mapping[str, Any] | None = None,
        raises: bool = True, **structure: Any) -> Fit:
    """Fit a model to a record: in raw units, with status, proof, constraint prices and times.

    Args:
        data: the record; a `Stream` for files larger than memory.
        formulation_name: name of a registered formulation, or the callable itself.
        solver: name of the back end, for the steps that take it; {step: name}, the other steps "auto"; or "auto".
        accuracy: requested relative accuracy.
        time_limit: seconds for each programme; the solver then runs in a separate process.
        isolate: run the solver in a separate process, so that a crash is an outcome.
        prove: ask for a proof of global optimality.
        constraints: builders (``formulations.constraints.shape``), callables of the named variables, or words such as
            "monotone:increasing", in the units of ``data``; one of them alone needs no list.
        solver_options: native options of the solver.
        raises: False returns failures as values (``fit.solution.status``) instead of raising.
        structure: arguments of the formulation (na, nb, nk, basis, loss, gauge, ...).

    Raises:
        DataError, RankError: the record does not determine the model.
        StructureError, LookupFailed, SolverMissing: an invalid request; the message gives the remedy.
        InfeasibleError: with the smallest conflicting subset of constraints found.
        UnboundedError, SolverFailed: no usable point, with the reason.
    """
    started = time.perf_counter()
    if not isinstance(data, Data | Stream):
        raise DataError(not_a_record(data, "fit"))
    name, pose = formulation(formulation_name)
    arguments = dict(structure)
    built = read_constraints(constraints)
    if built:
        arguments["constraints"] = built
    check_arguments(name, pose, arguments)
    if isinstance(data, Data) and not getattr(pose, "takes_any_times", False):
        data.refuse_irregular(f"{name!r}")
    whole = {**defaults(pose), **arguments}
    solvers = choose_solvers(name, pose, whole, solver)
    try:
        findings = _examined(data, whole)
        problem = pose(data, **arguments)
    except OptidError:
        raise
    except Exception:  # of a value that only the annotation refuses
        check_values(arguments, annotations(pose))
        raise
    check_values(arguments, annotations(pose))
    settings = {"accuracy": accuracy, "time_limit": time_limit, "isolate": isolate,
                "prove": prove and not _stand_in(arguments),
                "options": dict(solver_options or {})}
    outcome = _solved(problem, solvers, settings, raises, started)
    return _finished(outcome, data, name, arguments, findings, {**settings, "solver": solver}, started)


@one_thread
def resolve(fit: Fit, weights: Mapping[str, float], *, solver: Any = "auto", accuracy: float = 1e-8,
            raises: bool = True) -> Fit:
    """Solve the problem of a fit again with other weights of its penalties, starting from its solution.

    An unknown weight is a `StructureError`. The other arguments are as in `fit`.
    """
    started = time.perf_counter()
    problem = fit.problem
    if not problem.weights:
        raise StructureError(f"{problem.name!r} has no penalties with weights")
    for name in weights:
        if name not in problem.weights:
            raise StructureError(f"problem {problem.name!r} has no weight {name!r}. {nearest(name, problem.weights)}")
    again = problem.under_weights(**{name: float(value) for name, value in weights.items()})
    again = again.beginning({name: fit.solution.values[name] for name in again.start})
    outcome = _solved(again, Solvers(solver), {"accuracy": accuracy}, raises, started)
    return _finished(outcome, fit.data, fit.formulation, {**fit.arguments, **weights}, [],
                     {"accuracy": accuracy, "solver": solver}, started)


def _solved(problem: Problem | Procedure, solvers: Solvers, settings: Mapping[str, Any], raises: bool,
            started: float) -> Outcome:
    """Solve a problem that took the time since ``started`` to build."""
    built_at = time.perf_counter()
    outcome = run(problem, solvers, **settings)
    times = outcome.solution.times
    times = replace(times, build=times.build + built_at - started)
    outcome = replace(outcome, solution=replace(outcome.solution, times=times))
    if raises:
        _raise_failure(outcome)
    return outcome


def _finished(outcome: Outcome, data: Data | Stream, name: str, arguments: Mapping[str, Any], findings: list[str],
              settings: Mapping[str, Any], started: float) -> Fit:
    _in_raw_units(outcome.model, data)  # a model without an equivalent in raw units is refused here
    findings = findings + _violated(outcome.model, arguments.get("constraints", ()))
    compressed, words = outcome.problem.compressed, ("rows", "candidates", "condition", "method")
    told = {} if compressed is None else {word: getattr(compressed.statistics, word) for word in words}
    figures = {**told, **outcome.figures}
    findings = findings + examine_figures(figures)
    prices = _prices(outcome.problem, outcome.solution)
    here = outcome.problem.constraint_names
    # multipliers of an earlier step are in units of its own objective, which have no price in points of fit
    earlier = [replace(one, fit_points=np.nan) for name, (problem, solution) in outcome.constrained.items()
               if name not in here for one in _prices(problem, solution) if one.name == name]
    log.debug("fit %s: %s by %s in %.3g s", name, outcome.solution.status, outcome.solution.solver,
              time.perf_counter() - started)
    return Fit(replace(outcome, figures=figures), name, arguments, data, (*prices, *earlier), tuple(findings),
               time.perf_counter() - started, settings)


def _prices(problem: Problem, solution: Solution) -> tuple[Price, ...]:
    if not solution.has_point:
        return ()
    x = {name: solution.values[name] for name in problem.start}
    return price_constraints(problem, x, solution.duals, solution.objective / problem.unit)


def _examined(data: Data | Stream, arguments: Mapping[str, Any]) -> list[str]:
    """Return what the checks of a record in memory find, one sentence each."""
    return [] if isinstance(data, Stream) else examine(
        data, fitted_bases(data, arguments.get("basis", Linear())), arguments)


def _in_raw_units(model: Any, data: Data | Stream) -> Any:
    transform = getattr(data, "transform", None)
    return model if model is None or transform is None or transform.is_identity else model.with_transform(transform)


def _stand_in(arguments: Mapping[str, Any]) -> str:
    """Return which constraint is replaced by another condition, and by which; "" where none is."""
    for rule in arguments.get("constraints", ()):
        if (stand_in := getattr(rule, "stand_in", None)) and (how := stand_in(arguments)):
            return f"constraint {rule.name!r} is imposed by {how}"
    return ""


def _violated(model: Any, constraints: Sequence[Any]) -> list[str]:
    """Return the violations found by constraints that verify a model; every sentence is also a `DataWarning`."""
    found = [] if model is None else violations(model, constraints)
    for sentence in found:
        warnings.warn(sentence, DataWarning, stacklevel=4)
    return found


def _raise_failure(outcome: Outcome) -> None:
    solution, problem = outcome.solution, outcome.problem
    if solution.status is Status.INFEASIBLE:
        from optid.certificate.infeasibility import explain

        raise InfeasibleError(explain(problem))
    if solution.status is Status.UNBOUNDED:
        raise UnboundedError(f"{problem.name!r} has no minimum (according to {solution.solver}): the constraints or "
                             "the penalty leave a direction in which the objective falls without limit")
    if solution.status is Status.FAILED or not solution.has_point:
        raise SolverFailed(f"{solution.solver} gave no usable answer for {problem.name!r}: "
                           f"{solution.reason or solution.claimed}. Try another solver (optid solvers)")
    if solution.status in (Status.INACCURATE, Status.LIMIT):
        warnings.warn(f"{solution.solver} stopped with status '{solution.status}': {solution.reason}", DataWarning,
                      stacklevel=3)
