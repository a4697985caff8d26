"""Fit a model: examine the record, pose the problem, solve it, judge and prove the answer, report it."""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from optid.bases import Linear, fitted_bases
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import DataError, DataWarning, InfeasibleError, SolverFailed, StructureError, UnboundedError, nearest
from optid.identify.record_checks import examine, examine_figures
from optid.models.functions import has_feedback
from optid.program.prices import Price, price_constraints, price_earlier_steps
from optid.program.program import Program
from optid.program.solution import Bound, Solution, Status
from optid.registry import check_arguments, defaults, formulation, named_constraint, render
from optid.solving.solve import Outcome, Procedure, run


@dataclass(frozen=True)
class Fit:
    """A fitted model with the evidence for it.

    Attributes:
        identified: the identified model as far as it is needed at once, in raw units; None only with
            ``raises=False``. See `model`.
        solved: status, proof, residuals and times, as far as they were needed at once. See `solution`.
        formulation: its name.
        arguments: what it was called with.
        program: the last programme solved.
        data: the record.
        prices: activity and price of every user constraint.
        findings: what the examination of the record found, one sentence each.
        measured: rows used, rows there are, condition number, method of the statistics; for a procedure what it
            measured on its way (singular values, number of starts, ...). See `figures`.
        steps: (name, solution) of every programme on the way.
        procedure: whether a procedure of several steps judged the whole: its bound may be that of a step.
        seconds: wall time of the whole call.
        bound: returns a bound that was not needed at once, or None.
        extend: as in `optid.solving.solve.Evidence`.
    """

    identified: Any
    solved: Solution
    formulation: str
    arguments: Mapping[str, Any] = field(repr=False)
    program: Program = field(repr=False)
    data: Data | Stream = field(repr=False)
    prices: tuple[Price, ...] = ()
    findings: tuple[str, ...] = ()
    measured: Mapping[str, Any] = field(default_factory=dict, repr=False)
    steps: tuple[tuple[str, Solution], ...] = field(default=(), repr=False)
    procedure: bool = False
    seconds: float = 0.0
    bound: Callable[[], Bound] | None = field(default=None, repr=False)
    extend: Callable[[], tuple[Any, dict[str, Any]]] | None = field(default=None, repr=False)

    @cached_property
    def solution(self) -> Solution:
        """Status, proof, residuals and times."""
        return self.solved if self.bound is None else replace(self.solved, bound=self.bound())

    @cached_property
    def _extended(self) -> tuple[Any, dict[str, Any]]:
        if self.extend is None:
            return self.identified, {}
        model, figures = self.extend()
        return _in_raw_units(model, self.data), figures

    @property
    def model(self) -> Any:
        """The identified model, in raw units; parts such as its noise model are estimated at the first call."""
        return self._extended[0]

    @property
    def figures(self) -> dict[str, Any]:
        """What was measured on the way, the estimation of the parts of the model included."""
        return {**self.measured, **self._extended[1]}

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """Values at the solution of everything a constraint may speak about, by name, in the units of ``data``."""
        if not self.solution.has_point:
            return {}
        self.program.assign(self.solution.values)
        return {name: np.asarray(expression.value, dtype=float) for name, expression in self.program.view.items()}

    @cached_property
    def one_step_fit(self) -> np.ndarray:
        """One-step fit in % of every output: on the rows used for the estimate where the programme knows them.

        Otherwise over the samples of the record that the model can predict; NaN for a stream then.
        """
        from optid.identify.validation.predictions import common_fits, one_step

        if self.program.compressed is not None:
            return self.program.compressed.one_step_fit(self.solution.values)
        if isinstance(self.data, Stream):
            return np.full(len(self.data.outputs), np.nan)
        raw = self.data.raw()
        return common_fits(raw, [one_step(self.model, raw)])[0]

    @cached_property
    def simulation_fit(self) -> np.ndarray:
        """Simulation fit in % of every output on the estimation record, initial conditions fitted.

        NaN for a stream, where an input has missing samples (a simulation needs every one of them), and where the
        simulation runs away.
        """
        return self._simulated_fit("simulation")

    @cached_property
    def measured_feedback_fit(self) -> np.ndarray:
        """Fit in % of the simulation that takes the outputs in the feedback from the record.

        The same as `simulation_fit` for a model without nonlinear feedback.
        """
        return self._simulated_fit("measured feedback" if has_feedback(self.model) else "simulation")

    def _simulated_fit(self, word: str) -> np.ndarray:
        from optid.identify.validation.predictions import common_fits, simulated

        if not isinstance(self.data, Stream) and not any(self.data.missing[name] for name in self.data.inputs):
            raw = self.data.raw()
            try:
                return common_fits(raw, [simulated(self.model, raw, word)])[0]
            except DataError:  # it leaves the range of the data
                pass
        return np.full(len(self.data.outputs), np.nan)

    @cached_property
    def uncertainty(self) -> Any:
        """Standard errors, intervals and bands (`optid.identify.uncertainty.Uncertainty`)."""
        from optid.identify.uncertainty import uncertainty

        return uncertainty(self)

    def __str__(self) -> str:
        return render(self)

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text("Fit(...)" if cycle else str(self))


def fit(data: Data | Stream, formulation_name: str | Callable[..., Any] = "hammerstein_arx.exact", *,
        solver: Any = "auto", accuracy: float = 1e-8, time_limit: float | None = None, isolate: bool | None = None,
        prove: bool = True, constraints: Sequence[Any] = (), solver_options: Mapping[str, Any] | None = None,
        raises: bool = True, **structure: Any) -> Fit:
    """Fit a model to a record.

    Args:
        data: the record; a `Stream` for files larger than memory.
        formulation_name: name of a registered formulation, or the callable itself.
        solver: the back end's word, or "auto".
        accuracy: requested relative accuracy.
        time_limit: seconds for each programme; the solver then runs in a process of its own.
        isolate: run the solver in a process of its own, so that a crash is an outcome.
        prove: ask for a proof of global optimality.
        constraints: builders (``formulations.constraints.shape``), callables of the named variables, or words such as
            "monotone:increasing". They are stated in the units of ``data``.
        solver_options: native options of the solver.
        raises: False returns failures as values (``fit.solution.status``) instead of raising.
        structure: arguments of the formulation (na, nb, nk, basis, loss, gauge, ...).

    Returns:
        The model in raw units with status, proof, constraint prices and times.

    Raises:
        DataError, RankError: the record cannot determine the model.
        StructureError, LookupFailed, SolverMissing: the request cannot be met; the message says what to change.
        InfeasibleError: with the smallest conflicting subset of constraints found.
        UnboundedError, SolverFailed: no usable point, with the reason.
    """
    started = time.perf_counter()
    if not isinstance(data, Data | Stream):
        raise DataError(f"fit takes optid.Data (or a stream), not {type(data).__name__}; use optid.Data(u=, y=, dt=)")
    name, pose = formulation(formulation_name)
    arguments = dict(structure)
    built = tuple(named_constraint(c) if isinstance(c, str) else c for c in constraints)
    if built:
        arguments["constraints"] = built
    check_arguments(name, pose, arguments)
    findings = _examined(data, {**defaults(pose), **arguments})
    problem = pose(data, **arguments)
    settings = {"accuracy": accuracy, "time_limit": time_limit, "isolate": isolate, "prove": prove,
                **(solver_options or {})}
    return _finished(data, name, arguments, findings, problem, solver, settings, raises, started)


def resolve(fit: Fit, parameters: Mapping[str, float], *, solver: Any = "auto", accuracy: float = 1e-8,
            raises: bool = True) -> Fit:
    """Solve the programme of a fit again with other parameter values, starting from its solution.

    Nothing is compressed or compiled again.

    Args:
        fit: an earlier fit.
        parameters: new values of the programme's parameters, such as ``weight`` of the nuclear norm.
        solver: as in `fit`.
        accuracy: as in `fit`.
        raises: as in `fit`.

    Raises:
        StructureError: the programme has no such parameter; names the nearest.
    """
    started = time.perf_counter()
    program = fit.program
    for name, value in parameters.items():
        if name not in program.parameters:
            raise StructureError(f"programme {program.name!r} has no parameter {name!r}. "
                                 f"{nearest(name, program.parameters)}")
        program.parameters[name].value = np.asarray(value, dtype=float)
    program.assign(fit.solution.values)
    return _finished(fit.data, fit.formulation, {**fit.arguments, **parameters}, [], program, solver,
                     {"accuracy": accuracy}, raises, started)


def _finished(data: Data | Stream, name: str, arguments: Mapping[str, Any], findings: list[str],
              problem: Program | Procedure, solver: Any, settings: Mapping[str, Any], raises: bool,
              started: float) -> Fit:
    built_at = time.perf_counter()
    outcome = run(problem, solver, **settings)
    times = outcome.solution.times
    times = replace(times, build=times.build + built_at - started)
    outcome = replace(outcome, solution=replace(outcome.solution, times=times))
    if raises:
        _raise_failure(outcome)
    model = outcome.model
    findings = findings + _disobeyed(model, arguments.get("constraints", ()))
    compressed, figures, whole = outcome.program.compressed, dict(outcome.figures), outcome.evidence
    if compressed is not None:
        figures |= {key: getattr(compressed.statistics, key) for key in ("rows", "candidates", "condition", "method")}
    findings = findings + examine_figures(figures)
    return Fit(identified=_in_raw_units(model, data), solved=outcome.solution, formulation=name, arguments=arguments,
               program=outcome.program, data=data,
               prices=(*price_constraints(outcome.program, outcome.solution),
                       *price_earlier_steps(outcome.constrained, outcome.program)),
               findings=tuple(findings), measured=figures, steps=outcome.steps, procedure=whole is not None,
               seconds=time.perf_counter() - started, extend=whole.extend if whole else None,
               bound=whole.bound if whole and callable(whole.bound) else None)


def _in_raw_units(model: Any, data: Data | Stream) -> Any:
    transform = getattr(data, "transform", None)
    return model if model is None or transform is None or transform.is_identity else model.with_transform(transform)


def _examined(data: Data | Stream, arguments: Mapping[str, Any]) -> list[str]:
    if isinstance(data, Stream):
        return []
    return examine(data, fitted_bases(data, arguments.get("basis", Linear())), arguments)


def _disobeyed(model: Any, constraints: Sequence[Any]) -> list[str]:
    """What the constraints that can verify a model say of it; every sentence is also a `DataWarning`."""
    checks = [rule.verify for rule in constraints if getattr(rule, "verify", None) is not None]
    found = [sentence for check in checks if model is not None and (sentence := check(model))]
    for sentence in found:
        warnings.warn(sentence, DataWarning, stacklevel=4)
    return found


def _raise_failure(outcome: Outcome) -> None:
    solution, program = outcome.solution, outcome.program
    if solution.status is Status.INFEASIBLE:
        from optid.certificate.infeasibility import explain

        raise InfeasibleError(explain(program))
    if solution.status is Status.UNBOUNDED:
        raise UnboundedError(f"{program.name!r} has no minimum (according to {solution.solver}): the constraints or "
                             "the penalty leave a direction in which the objective falls for ever")
    if solution.status is Status.FAILED or not solution.has_point:
        raise SolverFailed(f"{solution.solver} gave no usable answer for {program.name!r}: "
                           f"{solution.reason or solution.claimed}. Try another solver (optid solvers)")
    if solution.status in (Status.INACCURATE, Status.LIMIT):
        warnings.warn(f"{solution.solver} stopped with status '{solution.status}': {solution.reason}", DataWarning,
                      stacklevel=3)
