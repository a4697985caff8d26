"""The steps that fits of state-space models by their errors share: starts, descents, and programmes in the tangent.

1. Starts from subspace fits with several block rows, and models of the user.
2. Descents, the errors weighted anew by their own covariance: `optid.identify.prediction_error.state_search`.
3. Functions of latent signals where they are asked for: `optid.identify.prediction_error.latent_search`.
4. The programmes of `formulations.state_space`: `optid.identify.prediction_error.refinement`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.subspace_procedure import identified
from optid.arrays import check_integer, one_of
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import RankError, StructureError
from optid.identify.arguments import enough_rows, in_memory, outputs_present
from optid.identify.prediction_error.refinement import refine
from optid.identify.prediction_error.state_errors import STABLE, StateErrors
from optid.identify.prediction_error.state_search import complete, entered, quietly, search_states
from optid.identify.subspace.plan import Plan, in_record_units, planned
from optid.models import HammersteinSS
from optid.program.units import energy_unit, inverse
from optid.solving.solve import Procedure
from optid.statistics.state_unknowns import SIMULATORS, StateUnknowns

WORDS = {"criterion": tuple(SIMULATORS), "stability": ("stable", "free"),
         "weighting": ("auto", "scale", "variance", "determinant")}


def state_space_fit(name: str, data: Data, nx: int | str, fit: Callable[..., Any], *, criterion: str, stability: str,
                    weighting: str, iterations: int, constraints: Sequence[Any], initial: Any, block_rows: Any,
                    basis: Any = "linear", feedback_basis: Any = None, offset: bool = True, feedthrough: Any = True,
                    extend: Callable[..., Any] | None = None) -> Procedure:
    """Fit a model in the units of the samples, and return it in those of the record.

    ``fit`` makes the programmes of (name, errors, constraints, units), `formulations.state_space.StateSpaceFit`;
    ``extend`` makes (errors, optimum, figures) of a model with more functions from (errors, optimum), None for none.
    The other arguments are those of `formulations.state_space.hammerstein_ss`, as are the errors raised.
    """
    words = {"criterion": criterion, "stability": stability, "weighting": weighting}
    for what, word in words.items():
        one_of(what, word, WORDS[what])
    check_integer(iterations, "iterations")
    in_memory(data, f"{criterion} errors")
    instruments = "inputs+past" if feedback_basis is None else "simulated"
    if feedback_basis is not None and criterion == "prediction":
        instruments = "simulated+past"
    plan = planned(name, data, nx=nx, block_rows=None, basis=basis, feedback_basis=feedback_basis, offset=bool(offset),
                   instruments=instruments, feedthrough=feedthrough, stability="free",
                   iterations=2 * (feedback_basis is not None))
    models = [initial] if isinstance(initial, HammersteinSS) else list(initial)
    found = {f"start {i}": model.with_transform(inverse(plan.units)) for i, model in enumerate(models, start=1)}
    poles = tuple(rule for rule in constraints if getattr(rule, "about", frozenset()) == frozenset({"poles"}))
    for rule in poles:
        if getattr(rule, "verify", None) is None:
            raise StructureError(f"constraint {rule.name!r} cannot judge a model, which the steps of this fit need; "
                                 "use it with hammerstein_ss.asivid")

    def run() -> Procedure:
        given = _block_rows(plan) if block_rows is None else [int(rows) for rows in np.atleast_1d(block_rows)]
        nx = yield from _subspace_starts(plan, given, block_rows is None, found, criterion == "prediction")
        errors, starts = _entered(plan, nx, found, criterion, stability, tuple(rule.verify for rule in poles))
        errors, best, figures = search_states(errors, starts, weighting, int(iterations))
        if extend is not None:
            errors, best, more = extend(errors, best)
            figures = {**figures, **more}
        others = tuple(rule for rule in constraints if rule not in poles)
        programmes = fit(plan.name, errors, others, plan.units)
        evidence = yield from refine(programmes, best, {"order": nx, **figures}, programmes.signed(best.x))
        return None if evidence is None else complete(evidence, errors, energy_unit(plan.units))

    return in_record_units(run(), plan)


def _block_rows(plan: Plan) -> list[int | None]:
    """Three numbers of block rows: what the subspace fit would choose, and multiples of what the order needs."""
    if plan.order is None:
        return [None]
    least = plan.order // plan.data.l + 2
    shortest = min(e.n_samples for e in plan.data.experiments)
    most = max(shortest // (4 * (plan.data.m + plan.data.l + 1)), least)
    return list(dict.fromkeys([None, min(2 * least, most), min(4 * least, most)]))


def _subspace_starts(plan: Plan, block_rows: Sequence[int | None], imputes: bool, found: dict[str, HammersteinSS],
                     predicts: bool) -> Procedure:
    """Add the models of subspace fits to those found, and return the order.

    Raises:
        RankError: no fit has a point, and no other start is known.
    """
    refusal, nx = None, plan.order
    for rows in block_rows:
        try:
            start = replace(plan, nx=plan.nx if nx is None else nx, block_rows=rows, imputes=imputes)
            evidence = yield from quietly(identified(start))
        except (RankError, StructureError, np.linalg.LinAlgError) as error:
            refusal = refusal or error
            continue
        if evidence.model is not None:
            nx = nx or int(evidence.figures["order"])
            model = evidence.extended()[0] if predicts else evidence.model  # K counts there
            found[f"{evidence.figures['block rows']} block rows"] = model
    if nx is None or not found:
        raise refusal or RankError("no subspace fit has a point to start from; use another order")
    return nx


def _entered(plan: Plan, nx: int, found: dict[str, HammersteinSS], criterion: str, stability: str, checks: Any
             ) -> tuple[StateErrors, dict[str, np.ndarray]]:
    """Return the criterion, weighted by the variances of the outputs, and the starts as vectors of its unknowns."""
    data = with_whole_inputs(plan.data, 2 * nx + 1)
    unknowns = StateUnknowns(nx, plan.expansion(), data.n_experiments, plan.direct(), criterion, plan.offset)
    # similarity takes away the freedom of as many unknowns as A has entries
    enough_rows(outputs_present(data), "output samples", unknowns.size - nx**2, "states")
    variances = np.nanvar(np.vstack([e.y for e in data.experiments]), axis=0)
    errors = StateErrors(data, unknowns, np.diag(1 / np.where(variances > 0, variances, 1.0)),
                         STABLE if stability == "stable" else np.inf, checks)
    starts = {name: x for name, model in found.items() if (x := entered(errors, model)) is not None}
    if not starts:
        raise RankError("no start has a stable simulation that obeys the constraints on poles; use another order")
    return errors, starts
