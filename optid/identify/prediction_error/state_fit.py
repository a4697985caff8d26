"""A fit of a state-space model: subspace fits to start from, the search for the best optimum, and its confirmation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer, one_of
from optid.core.problem import Problem
from optid.data.levels import remove_levels
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import RankError, StructureError
from optid.identify.arguments import check_offset, in_memory
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.latent_search import STAGES, first_samples
from optid.identify.prediction_error.signs import with_required_signs
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.prediction_error.state_search import complete, errors_and_starts, on_whole, quietly, search_states
from optid.identify.prediction_error.tangent_descent import refine
from optid.identify.subspace.plan import Plan, in_record_units, make_plan
from optid.identify.subspace.procedure import SubspaceSteps
from optid.models import HammersteinSS
from optid.program.solution import Status
from optid.program.units import energy_unit, in_units, inverse
from optid.solving.solve import Evidence, Procedure
from optid.statistics.state_unknowns import SIMULATORS

Pose = Callable[[str, StateErrors, Array, Sequence[Any]], Problem]  # of name, errors, point and constraints
WORDS = {"criterion": tuple(SIMULATORS), "stability": ("stable", "free"),
         "weighting": ("auto", "scale", "variance", "determinant")}


@dataclass(frozen=True)
class StateSettings:
    """Arguments of a fit as those of `formulations.state_space.hammerstein_ss`."""

    nx: int | str
    criterion: str
    stability: str
    weighting: str
    iterations: int
    constraints: Sequence[Any]
    initial: HammersteinSS | Sequence[HammersteinSS]
    block_rows: int | Sequence[int] | None
    basis: Any = "linear"
    feedback_basis: Any = None
    offset: bool | str = True
    feedthrough: bool | Sequence[bool] = True


def fit_states(name: str, data: Data, *, pose: Pose, subspace: SubspaceSteps, extend: Callable[..., Any] | None = None,
               finish: Callable[..., Procedure] | None = None, **words: Any) -> Procedure:
    """Fit a state-space model in the units of the samples, and return it in those of the record.

    ``pose`` states the problem of a fit, ``subspace`` those of a subspace fit to start from.
    ``extend`` makes (errors, optimum, figures) of a model with more functions from (errors, optimum, initial models
    with these functions), None for none.
    ``finish`` is a procedure of (plan, errors, constraints, optimum, figures) that returns the evidence; None
    solves the programmes in the tangent. The words are those of `StateSettings`; errors are raised as by
    `formulations.state_space.hammerstein_ss`.
    """
    settings = StateSettings(**words)
    criterion, constraints, feedback_basis = settings.criterion, settings.constraints, settings.feedback_basis
    for what, allowed in WORDS.items():
        one_of(what, getattr(settings, what), allowed)
    check_integer(settings.iterations, "iterations", 1 if finish is None else 0)
    record = in_memory(data, f"{criterion} errors")
    constants = check_offset(settings.offset, record)
    if constants == "each":
        if feedback_basis is not None or extend is not None or finish is not None:
            raise StructureError(f"{name} with feedback, latent functions or states as variables has one constant for "
                                 "all experiments: offset='each' is for 'ss.exact' and 'hammerstein_ss.exact' without "
                                 "feedback, and for transfer functions")
        data = remove_levels(record)[0]
    instruments = "inputs+past" if feedback_basis is None else "simulated"
    if feedback_basis is not None and criterion == "prediction":
        instruments = "simulated+past"
    poles = tuple(rule for rule in constraints if getattr(rule, "about", frozenset()) == frozenset({"poles"}))
    for rule in poles:
        if getattr(rule, "verify", None) is None:
            raise StructureError(f"constraint {rule.name!r} cannot judge a model, which the steps of this fit need; "
                                 "use it with hammerstein_ss.asivid")
    plan = make_plan(name, data, nx=settings.nx, block_rows=None, basis=settings.basis, feedback_basis=feedback_basis,
                     offset=bool(constants), instruments=instruments, feedthrough=settings.feedthrough,
                     stability="free", iterations=2 * (feedback_basis is not None), constraints=poles)
    models = [settings.initial] if isinstance(settings.initial, HammersteinSS) else list(settings.initial)
    models = [model.with_transform(inverse(plan.units)) for model in models]
    known = [model for model in models if model.latent]  # with functions that `extend` adds to the others
    found = {f"start {i}": model for i, model in enumerate(models, start=1) if not model.latent}

    def run() -> Procedure:
        # what functions of latent signals are added to needs no more than a first part of a long record
        first = plan if extend is None else replace(plan, data=first_samples(plan.data, STAGES[0]))
        rows = settings.block_rows
        given = _block_rows(first) if rows is None else [int(one) for one in np.atleast_1d(rows)]
        nx = yield from _subspace_starts(subspace, first, given, rows is None, found, criterion == "prediction")
        if isinstance(nx, Evidence):
            return nx
        errors, starts = errors_and_starts(
            first, nx, found, criterion, settings.stability, tuple(rule.verify for rule in poles),
            in_units(record, plan.units) if constants == "each" else None)
        errors, best, figures = search_states(errors, starts, settings.weighting, int(settings.iterations))
        if extend is not None:
            errors, best = on_whole(errors, best, with_whole_inputs(plan.data, 2 * nx + 1))
            errors, best, more = extend(errors, best, known)
            figures = {**figures, **more}
        figures = {"order": nx, **figures}
        evidence = yield from (finish or partial(_refined, pose))(plan, errors, tuple(constraints), best, figures)
        return None if evidence is None else complete(evidence, errors, energy_unit(plan.units))

    return in_record_units(run(), plan)


def _refined(pose: Pose, plan: Plan, errors: StateErrors, constraints: tuple[Any, ...], best: Descent,
             figures: Mapping[str, Any]) -> Procedure:
    problem = pose(plan.name, errors, best.x, constraints)
    return (yield from refine(problem, best, figures, with_required_signs(problem, best.x)))


def _block_rows(plan: Plan) -> list[int | None]:
    """Three numbers of block rows: what the subspace fit would choose, and multiples of what the order needs."""
    if plan.order is None:
        return [None]
    least = plan.order // plan.data.l + 2
    shortest = min(e.n_samples for e in plan.data.experiments)
    most = max(shortest // (4 * (plan.data.m + plan.data.l + 1)), least)
    return list(dict.fromkeys([None, min(2 * least, most), min(4 * least, most)]))


def _subspace_starts(subspace: SubspaceSteps, plan: Plan, block_rows: Sequence[int | None],
                     imputes: bool, found: dict[str, HammersteinSS], predicts: bool) -> Procedure:
    """Add the models of subspace fits to those found, and return the order; or that no poles satisfy the constraints.

    Raises:
        RankError: no fit has a point, and no other start is known.
    """
    refusal, nx = None, plan.order
    for rows in block_rows:
        try:
            start = replace(plan, nx=plan.nx if nx is None else nx, block_rows=rows, imputes=imputes)
            evidence = yield from quietly(subspace.run(start))
        except (RankError, StructureError, np.linalg.LinAlgError) as error:
            refusal = refusal or error
            continue
        if evidence.status is Status.INFEASIBLE:
            return evidence
        if evidence.model is not None:
            nx = nx or int(evidence.figures["order"])
            model = evidence.run_extension()[0] if predicts else evidence.model  # K counts there
            found[f"{evidence.figures['block rows']} block rows"] = model
    if nx is None or not found:
        raise refusal or RankError("no subspace fit has a point to start from; use another order")
    return nx
