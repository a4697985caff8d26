"""The search for the best optimum of a state-space model, the errors weighted by their own covariance."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.certificate.hankel import simulation_bound
from optid.data.levels import remove_levels
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.identify.arguments import enough_rows, outputs_present
from optid.identify.noise import with_noise
from optid.identify.prediction_error.descent import AGREE, STEPS, Descent, best_of, descend
from optid.identify.prediction_error.state_errors import STABLE, WILD, StateErrors
from optid.identify.subspace.plan import Plan
from optid.identify.validation.predictions import one_step, simulate_outputs, simulated_or_nan
from optid.models import HammersteinSS, NoiseCovariances
from optid.models.roots import spectral_radius
from optid.models.state_simulation import allowed_range
from optid.models.state_space import balancing
from optid.program.solution import Status
from optid.solving.solve import Evidence, Procedure
from optid.statistics.state_unknowns import StateUnknowns

ROUNDS = 10  # updates of the weights at most
SAME_WEIGHT = 1e-4
FINALISTS = 2
SHARES = (1.0, 0.3, 0.1, 0.0)  # of the step to the initial states, which a nonlinear run may not bear
RADII = (0.999, 0.98, 0.95, 0.9, 0.7, 0.4)  # spectral radii tried to make a start stable


def search_states(errors: StateErrors, starts: Mapping[str, Array], weighting: str, iterations: int = STEPS
                  ) -> tuple[StateErrors, Descent, dict[str, Any]]:
    """Descend from every start and update the weights until they converge; return errors, best optimum and figures.

    With the determinant every start is weighted by its own errors from the first step on: weights from the outputs
    lead on a third of short records to a zero of the noise on the unit circle, where descents end.

    Args:
        errors: weighted by the variances of the outputs.
        starts: admissible starts by name.
        weighting: "scale" (keep the weights), "variance", "determinant", or "auto": "determinant" for prediction,
            "variance" for simulation.
        iterations: of a descent at most.
    """
    if errors.unknowns.l == 1:
        weighting = "scale"
    elif weighting == "auto":
        weighting = "determinant" if errors.unknowns.innovations else "variance"
    full = weighting == "determinant"
    if full:
        weighted = [_weighted(errors, name, x, weighting, iterations) for name, x in starts.items()]
        found = [one for _, one in weighted]
        values = np.array([errors.value(one.x) for one in found])
        sizes = np.array([own.level(one.x, full) for own, one in weighted])
        smallest = sizes <= sizes.min() + AGREE * errors.unknowns.l
    else:
        found = best_of(errors, starts.items(), iterations)
        values = np.array([one.value for one in found])
        levels = [errors.level(one.x) if weighting != "scale" else one.value for one in found]
        order = sorted(range(len(found)), key=lambda i: (found[i].border, levels[i]))
        weighted = [_weighted(errors, found[i].start, found[i].x, weighting, iterations, found[i].steps)
                    for i in order[:FINALISTS]]
        smallest = values <= (1 + AGREE) * values.min() + 1e-14 * errors.energy
    ends = [(own.level(one.x, full) if weighting != "scale" else one.value, own, one) for own, one in weighted]
    _, final, best = min(ends, key=lambda end: (end[2].border, end[0]))
    agreed = [one.start for one, same in zip(found, smallest) if same]
    figures = {"starts": f"{len(agreed)} of {len(found)} starts converged to the smallest error ({', '.join(agreed)})",
               "starts that agree": len(agreed), "errors of the starts": np.sort(values)[::-1]}
    return final, best, figures


def _weighted(errors: StateErrors, start: str, x: Array, weighting: str, iterations: int, steps: int = 0
              ) -> tuple[StateErrors, Descent]:
    """Descend and weight the errors by their own (co)variance until it converges; add the steps taken before."""
    for _ in range(ROUNDS):
        new = errors if weighting == "scale" else errors.reweight(x, full=weighting == "determinant")
        change = np.linalg.norm(new.weight - errors.weight) / np.linalg.norm(new.weight)
        errors = new
        one = descend(errors, x, iterations=iterations, start=start)
        x, steps = one.x, steps + one.steps
        if change < SAME_WEIGHT:
            break
    return errors, replace(one, steps=steps)


def start_from_model(errors: StateErrors, model: HammersteinSS) -> Array | None:
    """Return an admissible vector of unknowns near a model, contracted where it is unstable, with fitted states.

    None where no contraction is admissible.
    """
    point = errors.point_of(_balanced(errors, model))
    still, largest = np.zeros_like(point.K), spectral_radius(point.A)
    candidates = [point, *([replace(point, K=still)] if errors.unknowns.innovations else []),
                  *(replace(point, A=point.A * (radius / max(largest, radius)), K=still) for radius in RADII)]
    for candidate in candidates:
        x = errors.normalise(errors.unknowns.pack(candidate))
        if not errors.admissible(x):
            continue
        try:
            at = errors.linearise(x)
        except (DataError, np.linalg.LinAlgError):
            continue
        if np.isfinite(at.value):
            p = errors.unknowns.shared
            step = np.concatenate([np.zeros(p), at.follow(np.zeros(p))])
            return next(x + share * step for share in SHARES if not share or errors.value(x + share * step) < at.value)
    return None


def _balanced(errors: StateErrors, model: HammersteinSS) -> HammersteinSS:
    """Balance the states, if possible, for the signals and weights of the fit."""
    data = errors.data
    f = model.expand_inputs(np.vstack([e.u for e in data.experiments]))
    y = np.vstack([e.y for e in data.experiments])
    g = [np.nanstd(function(y[:, o])) for function, o in zip(model.feedback, model.output_of)]
    driven = np.hstack([model.B * f.std(axis=0), model.E * np.array(g)])
    try:
        return model.transform(balancing(model.A, driven, np.linalg.cholesky(errors.weight).T @ model.C))
    except StructureError:
        return model


def complete(evidence: Evidence, errors: StateErrors, unit: float) -> Evidence:
    """Add the noise model, and the Hankel bound where the errors are linear in functions of measured signals.

    The weights of the errors must be diagonal. One squared unit of the outputs is ``unit`` in units of the record.
    """
    weight, unknowns, reason = errors.weight, errors.unknowns, evidence.reason
    model, remarks = _with_noise(evidence.model, errors)
    bound = evidence.bound
    linear = unknowns.criterion == "measured feedback" or (
        unknowns.criterion == "simulation" and not unknowns.expansion.feedback)
    if linear and not unknowns.latent and not np.any(weight - np.diag(np.diag(weight))):
        records = errors.data.records
        order, said = unknowns.memory, "the errors are not convex in the poles, several starts are compared"
        if unknowns.levels:
            said += "; in what follows the constants of an experiment count as states"
        bound = simulation_bound(records, unknowns.expansion, order, np.sqrt(np.diag(weight)), evidence.objective,
                                 2 * (order // unknowns.l + 2), said)
        reason = bound.reason if evidence.status is Status.LOCAL else reason
    figures = {**evidence.figures, "weight of the outputs": weight / unit, **remarks}
    if unknowns.expansion.feedback and unknowns.criterion != "simulation" and _diverges(model, errors.data):
        figures["free run"] = (
            f"leaves {WILD:g} times the range of the record: use the model where outputs are measured, or "
            "criterion='simulation', which minimises the error of the free run")
        reason = f"{reason}; its free run {figures['free run']}"
    return replace(evidence, model=model, bound=bound, reason=reason, figures=figures)


def _diverges(model: HammersteinSS, data: Data) -> bool:
    """Whether the simulation of a model leaves the range of the record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        runs = simulated_or_nan(model, data)
    ranges = [allowed_range([e.y], WILD) for e in data.experiments]
    return not all(np.all((low <= y) & (y <= high)) for y, (low, high) in zip(runs, ranges))


def _with_noise(model: HammersteinSS, errors: StateErrors) -> tuple[HammersteinSS, dict[str, Any]]:
    """Add the covariances of the noise, K as fitted or from simulation errors, or a figure with the reason."""
    data = errors.data
    try:
        if not errors.unknowns.innovations and not errors.unknowns.latent:
            return with_noise(model, data), {}
        # errors without a fitted gain count as white: with latent functions the optimal gain depends on the state
        found = one_step(model, data) if errors.unknowns.innovations else simulate_outputs(model, data)
        rest = np.vstack([e.y for e in data.experiments]) - np.vstack(found)
        rest = rest[~np.isnan(rest).any(axis=1)]
        covariance = rest.T @ rest / max(len(rest), 1)
        return replace(model, noise=NoiseCovariances.of_innovations(model.K, covariance)), {}
    except (StructureError, DataError) as reason:
        return model, {"noise model": f"none: {reason}"}


def quietly(procedure: Procedure) -> Procedure:
    """Run a procedure that only provides a start, without its warnings."""
    answer: Any = None
    while True:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            try:
                program = procedure.send(answer)
            except StopIteration as stop:
                return stop.value
        answer = yield program


def on_whole(errors: StateErrors, best: Descent, data: Data) -> tuple[StateErrors, Descent]:
    """Return the errors on the whole of a record whose first samples were fitted, and their optimum as a point of them.

    Missing inputs may cut the rest into more stretches, whose states are fitted.
    """
    if data.n_experiments == errors.unknowns.experiments:
        return replace(errors, data=data), best
    whole = replace(errors, data=data, unknowns=replace(errors.unknowns, experiments=data.n_experiments))
    x = start_from_model(whole, errors.at(errors.unknowns.unpack(best.x)))
    if x is None:
        raise RankError("the model of the first samples has no finite run on the rest of the record")
    return whole, replace(best, x=x)


def errors_and_starts(plan: Plan, nx: int, found: dict[str, HammersteinSS], criterion: str, stability: str, checks: Any,
                      several: Data | None) -> tuple[StateErrors, dict[str, Array]]:
    """Return the errors, weighted by the variances of the outputs, and the starts as vectors of its unknowns.

    Where every experiment has constants of its own, `several` is the record with its levels.
    """
    data, shifts = with_whole_inputs(plan.data if several is None else several, 2 * nx + 1), None
    if several is not None:
        data, shifts = remove_levels(data)
    unknowns = StateUnknowns(nx, plan.expansion(), data.n_experiments, plan.direct(), criterion,
                             plan.offset and shifts is None, levels=shifts is not None)
    # a similarity transformation removes nx² degrees of freedom
    enough_rows(outputs_present(data), "output samples", unknowns.size - nx**2, "states")
    variances = np.nanvar(np.vstack([e.y for e in data.experiments]), axis=0)
    errors = StateErrors(data, unknowns, np.diag(1 / np.where(variances > 0, variances, 1.0)), plan.units,
                         STABLE if stability == "stable" else np.inf, checks, shifts)
    starts = {name: x for name, model in found.items() if (x := start_from_model(errors, model)) is not None}
    if not starts:
        raise RankError("no start has a stable simulation that obeys the constraints on poles; use another order")
    return errors, starts
