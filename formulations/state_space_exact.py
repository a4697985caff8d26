"""The prediction-error programme of a state-space model: simulation or one-step errors of all outputs minimised.

    x(k+1) = A x + B f(u) + E g(y) + K e,    y(k) = C x + D f(u) + d + e

`exact` is the Hammerstein model with nonlinear output feedback, `linear` (registered as ``ss.exact``) the linear one.
``criterion="simulation"`` takes K = 0 and the simulation with measured feedback (P2); a noise model is estimated from
what it leaves. ``"prediction"`` estimates K with the other unknowns.
Both are procedures: starts from subspace fits with several block rows, Gauss-Newton descents on streamed sensitivities
(`formulations.state_error`), errors weighted anew by their own covariance, and at the optimum, or under constraints,
convex programmes in the tangent of the iterate (`formulations.prediction_error`,
`formulations.state_space_programme`). Constraints on poles are kept by every iterate through the length of the steps.

Named variables: ``A``, ``C``, ``offset``, ``x0`` ((n,), or (n, experiments)), ``K`` with "prediction", per input ``mu``
(not of a linear channel) and ``b`` (= [B_i; D_i]), per output fed back ``mu feedback`` and ``b feedback``, and the
affine expressions ``Theta = mu b0ᵀ + mu0 bᵀ - mu0 b0ᵀ`` (P, n + l) about the iterate. With several channels the names
carry the channel, as in ``mu[valve]``. Without feedback the static curves (`shape.gain`, `shape.value_range`, ...) are
constrained to first order about the iterate as well.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.arguments import enough_rows, in_memory, one_of, outputs_present
from formulations.prediction_error import AGREE, Descent, best_of, descend, refine
from formulations.simulation_bound import bounded
from formulations.state_error import STABLE, StateError, entered
from formulations.state_space_programme import Posing
from formulations.subspace_procedure import identified
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import DataWarning, RankError, StructureError
from optid.identify.design.expansion import Bases
from optid.identify.noise import with_noise
from optid.identify.subspace.plan import Plan, in_record_units, planned
from optid.models import HammersteinSS, NoiseCovariances
from optid.program.solution import Status
from optid.program.units import energy_unit, inverse
from optid.solving.solve import Evidence, Procedure
from optid.statistics.state_sensitivities import StateUnknowns

Array = np.ndarray

CRITERIA = ("simulation", "prediction")
STABILITIES = ("stable", "free")
WEIGHTINGS = ("auto", "scale", "variance", "determinant")
ROUNDS = 10
"""Times the errors are weighted anew at most."""

SAME_WEIGHT = 1e-4
FINALISTS = 2


def linear(
    data: Data, *, nx: int | str, criterion: str = "simulation", block_rows: int | Sequence[int] | None = None,
    weighting: str = "auto", offset: bool = True, feedthrough: bool | Sequence[bool] = True,
    stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
    constraints: Sequence[Any] = ()
) -> Procedure:
    """Minimise the simulation or prediction error of a linear state-space model.

    Named variables: ``B``, ``Bu``, ``D``, ``Du``, ``Theta``, ``offset``, ``x0``.

    Args:
        data: the record. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        nx: number of states, or "auto" (gap of the singular values of the first subspace fit).
        criterion: "simulation" (output error, K = 0) or "prediction" (innovation form, K estimated).
        block_rows: of the subspace fits to start from, one or several; None chooses three, for which missing outputs
            may be estimated as in `formulations.hammerstein_ss.sid`.
        weighting: of the outputs: "scale" (variances of the outputs), "variance" or "determinant" (variances or
            covariance of the errors, iterated); "auto" is "variance" for simulation and "determinant" (maximum
            likelihood of Gaussian noise) for prediction.
        offset: estimate a constant; False takes the record as it is.
        feedthrough: whether the inputs act on the outputs at once, one for all or one per input.
        stability: "stable" keeps every iterate stable (for prediction, its predictor); "free" lets the poles go where
            the errors are smallest, for plants that integrate or grow over the record.
        initial: models of the same structure to start from besides.
        iterations: Gauss-Newton steps per descent at most.
        constraints: rules about poles, builders of CVXPY constraints in the named variables.

    Raises:
        StructureError: words, orders or starts that do not fit.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns.
    """
    return _procedure("ss.exact", data, nx, "linear", None, criterion, block_rows, weighting, offset, feedthrough,
                      stability, initial, iterations, constraints)


def exact(
    data: Data, *, nx: int | str, basis: Bases = "polynomial:3", feedback_basis: Any = None,
    criterion: str = "simulation", block_rows: int | Sequence[int] | None = None, weighting: str = "auto",
    offset: bool = True, feedthrough: bool | Sequence[bool] = True,
    stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
    constraints: Sequence[Any] = ()
) -> Procedure:
    """Minimise the simulation or prediction error of a Hammerstein state-space model with output feedback.

    Every input acts through one nonlinearity (rank one). The feedback functions are taken in coordinates without a
    part that is linear in the outputs of the record, which A would repeat.

    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``.

    Args:
        data: as in `linear`.
        nx: as in `linear`.
        basis: basis of the input nonlinearity, one per input or one for all.
        feedback_basis: basis of the feedback, None for no feedback, one for all outputs or one per output.
        criterion: "simulation" (P2: measured feedback, K = 0) or "prediction" (P1: K estimated).
        block_rows: as in `linear`.
        weighting: as in `linear`.
        offset: as in `linear`.
        feedthrough: as in `linear`.
        stability: as in `linear`; what counts are the poles with the feedback taken as a given signal.
        initial: as in `linear`.
        iterations: as in `linear`.
        constraints: as in `linear`, also those of `formulations.constraints.shape`.

    Raises:
        StructureError, DataError, RankError: as `linear`; RankError also for a feedback basis that is linear in y.
    """
    return _procedure("hammerstein_ss.exact", data, nx, basis, feedback_basis, criterion, block_rows, weighting, offset,
                      feedthrough, stability, initial, iterations, constraints)


def _procedure(name: str, data: Data, nx: Any, basis: Any, feedback_basis: Any, criterion: str, block_rows: Any,
               weighting: str, offset: bool, feedthrough: Any, stability: str, initial: Any, iterations: int,
               constraints: Sequence[Any]) -> Procedure:
    for what, word, known in (("criterion", criterion, CRITERIA), ("weighting", weighting, WEIGHTINGS),
                              ("stability", stability, STABILITIES)):
        one_of(what, word, known)
    if isinstance(iterations, bool) or not isinstance(iterations, int | np.integer) or iterations < 1:
        raise StructureError(f"iterations={iterations!r}: a whole number from 1 is needed.")
    given = None if block_rows is None else [int(rows) for rows in np.atleast_1d(block_rows)]
    in_memory(data, f"{criterion} errors")
    # the fit lives in the units of the samples; what leaves it is taken back to raw units by the caller
    plan = planned(name, data, nx=nx, block_rows=None, basis=basis, feedback_basis=feedback_basis, offset=bool(offset),
                   instruments="inputs+past" if feedback_basis is None else "simulated", feedthrough=feedthrough,
                   stability="free", iterations=2 * (feedback_basis is not None))
    models = [initial] if isinstance(initial, HammersteinSS) else list(initial)
    models = [model.with_transform(inverse(plan.units)) for model in models]
    if criterion == "prediction" and feedback_basis is not None:
        plan = replace(plan, instruments="simulated+past")
    poles, others = _sorted(constraints)
    run = _run(plan, given, criterion, weighting, STABLE if stability == "stable" else np.inf, models, int(iterations),
               poles, others)
    return in_record_units(run, plan)


def _sorted(constraints: Sequence[Any]) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Split into rules about poles, which steps obey, and constraints that programmes carry."""
    poles = tuple(rule for rule in constraints if getattr(rule, "about", frozenset()) == frozenset({"poles"}))
    for rule in poles:
        if getattr(rule, "verify", None) is None:
            raise StructureError(f"constraint {rule.name!r} cannot judge a model, which the steps of this fit need; "
                                 "use it with hammerstein_ss.asivid")
    return poles, tuple(rule for rule in constraints if rule not in poles)


def _run(plan: Plan, block_rows: list[int] | None, criterion: str, weighting: str, limit: float,
         models: list[HammersteinSS], iterations: int, poles: tuple[Any, ...], constraints: tuple[Any, ...]
         ) -> Procedure:
    data, refusal = plan.data, None
    found: dict[str, HammersteinSS] = {f"start {i}": model for i, model in enumerate(models, start=1)}
    nx = plan.order
    for rows in block_rows if block_rows is not None else _block_rows(plan):
        try:
            start = replace(plan, nx=plan.nx if nx is None else nx, block_rows=rows, imputes=block_rows is None)
            evidence = yield from _quietly(identified(start))
        except (RankError, StructureError, np.linalg.LinAlgError) as error:
            refusal = refusal or error
            continue
        if evidence.model is not None:
            nx = nx or int(evidence.figures["order"])
            model = evidence.extended()[0] if criterion == "prediction" else evidence.model  # K counts there alone
            found[f"{evidence.figures['block rows']} block rows"] = model
    if nx is None or not found:
        raise refusal or RankError("no subspace fit has a point to start from; use another order")
    expansion = plan.expansion()
    data = with_whole_inputs(data, 2 * nx + 1)
    records = [np.hstack([e.u, e.y]) for e in data.experiments]
    unknowns = StateUnknowns(nx, expansion, data.n_experiments, plan.direct(), criterion == "prediction", plan.offset)
    # similarity takes away the freedom of as many unknowns as A has entries
    enough_rows(outputs_present(data), "output samples", unknowns.size - nx**2, "states")
    y = np.vstack([e.y for e in data.experiments])
    variances = np.nanvar(y, axis=0)
    error = StateError(data, unknowns, np.diag(1 / np.where(variances > 0, variances, 1.0)), limit,
                       tuple(rule.verify for rule in poles))
    starts = {name: x for name, model in found.items() if (x := entered(error, model)) is not None}
    if not starts:
        raise RankError("no start has a stable simulation that obeys the constraints on poles; use another order")
    error, best, figures = _searched(error, starts, criterion, weighting, iterations)
    posing = Posing(plan.name, error, constraints, plan.units)
    x = posing.signed(best.x)
    evidence = yield from refine(posing.posed(), replace(best, x=x), {"order": nx, **figures}, x)
    return _with_bound(_with_noise(evidence, error, energy_unit(plan.units)), error, records)


def _with_bound(evidence: Evidence | None, error: StateError, records: list[Array]) -> Evidence | None:
    """Add the Hankel bound where the objective is a simulation error with one weight per output."""
    weight, unknowns = error.weight, error.unknowns
    diagonal = not np.any(weight - np.diag(np.diag(weight)))
    if evidence is None or evidence.model is None or unknowns.innovations or not diagonal:
        return evidence
    bound = bounded(records, unknowns.expansion, unknowns.n, np.sqrt(np.diag(weight)), evidence.objective,
                    2 * (unknowns.n // unknowns.l + 2), "the errors are not convex in the poles, several starts are "
                    "compared")
    return replace(evidence, bound=bound, reason=bound.reason if evidence.status is Status.LOCAL else evidence.reason)


def _with_noise(evidence: Evidence | None, error: StateError, unit: float) -> Evidence | None:
    """Add the covariances of the noise: with K as it was fitted, or with one estimated from the simulation errors."""
    if evidence is None or evidence.model is None:
        return evidence
    figures = {**evidence.figures, "weight of the outputs": error.weight / unit}
    model, data = evidence.model, error.data
    try:
        if error.unknowns.innovations:
            errors = np.vstack([e.y for e in data.experiments]) - np.vstack(_listed(model.predict(data)))
            errors = errors[~np.isnan(errors).any(axis=1)]
            covariance = errors.T @ errors / max(len(errors), 1)
            model = replace(model, noise=NoiseCovariances.of_innovations(model.K, covariance))
        else:
            model = with_noise(model, data)
    except StructureError as reason:
        figures["noise model"] = f"none: {reason}"
    return replace(evidence, model=model, figures=figures)


def _listed(arrays: Any) -> list[Array]:
    return list(arrays) if isinstance(arrays, tuple) else [arrays]


def _quietly(procedure: Procedure) -> Procedure:
    """Run a procedure that only provides a start: its warnings are about an answer nobody sees."""
    answer: Any = None
    while True:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            try:
                program = procedure.send(answer)
            except StopIteration as stop:
                return stop.value
        answer = yield program


def _block_rows(plan: Plan) -> list[int | None]:
    """Three numbers of block rows: what the subspace fit would choose, and multiples of what the order needs."""
    if plan.order is None:
        return [None]
    least = plan.order // plan.data.l + 2
    shortest = min(e.n_samples for e in plan.data.experiments)
    most = max(shortest // (4 * (plan.data.m + plan.data.l + 1)), least)
    return list(dict.fromkeys([None, min(2 * least, most), min(4 * least, most)]))


def _searched(error: StateError, starts: Mapping[str, Array], criterion: str, weighting: str, iterations: int
              ) -> tuple[StateError, Descent, dict[str, Any]]:
    """Descend from every start, then weight the errors anew until the weights stay; the best end wins.

    With the determinant every start is weighted by its own errors from the first step on: weights from the outputs
    lead a third of short records to a zero of the noise on the unit circle, from where no step leads back.
    """
    if error.unknowns.l == 1:
        weighting = "scale"  # one output has nothing to be weighed against
    elif weighting == "auto":
        weighting = "determinant" if criterion == "prediction" else "variance"
    full = weighting == "determinant"
    if full:
        weighted = [_weighted(error, name, x, weighting, iterations) for name, x in starts.items()]
        found = [one for _, one in weighted]
        values = np.array([error.value(one.x) for one in found])
        sizes = np.array([own.level(one.x, full) for own, one in weighted])
        smallest = sizes <= sizes.min() + AGREE * error.unknowns.l
    else:
        found = best_of(error, starts.items(), iterations)
        values = np.array([one.value for one in found])
        levels = [error.level(one.x) if weighting != "scale" else one.value for one in found]
        order = sorted(range(len(found)), key=lambda i: (found[i].border, levels[i]))
        weighted = [_weighted(error, found[i].start, found[i].x, weighting, iterations, found[i].steps)
                    for i in order[:FINALISTS]]
        smallest = values <= (1 + AGREE) * values.min() + 1e-14 * error.energy
    ends = [(own.level(one.x, full) if weighting != "scale" else one.value, own, one) for own, one in weighted]
    _, final, best = min(ends, key=lambda end: (end[2].border, end[0]))
    agreed = [one.start for one, same in zip(found, smallest) if same]
    figures = {"starts": f"{len(agreed)} of {len(found)} starts arrive at the smallest error ({', '.join(agreed)})",
               "starts that agree": len(agreed), "errors of the starts": np.sort(values)[::-1]}
    return final, best, figures


def _weighted(error: StateError, start: str, x: Array, weighting: str, iterations: int, steps: int = 0
              ) -> tuple[StateError, Descent]:
    """Descend, the errors weighted by their own (co)variance until it stays; steps taken before are counted."""
    if weighting == "scale":
        one = descend(error, x, iterations=iterations, start=start)
        return error, replace(one, steps=steps + one.steps)
    for _ in range(ROUNDS):
        new = error.reweighted(x, full=weighting == "determinant")
        change = np.linalg.norm(new.weight - error.weight) / np.linalg.norm(new.weight)
        error = new
        one = descend(error, x, iterations=iterations, start=start)
        x, steps = one.x, steps + one.steps
        if change < SAME_WEIGHT:
            break
    return error, replace(one, steps=steps)
