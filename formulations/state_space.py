"""State-space models by simulation or prediction errors of all outputs, with static functions of many kinds.

    x(k+1) = A x + B f(u) + E g(y) + Ez h(z) + K e,    y(k) = C x + D f(u) + Fz h(z) + d + e,    z = Cz x + Dz u + const

The parts there are make the formulation: none of f, g, h (`ss`), f and g (`hammerstein_ss`), h of latent signals or in
the place of C x + D f(u) (`formulations.latent_signals`). ``criterion="simulation"`` takes K = 0 and the free run,
``"measured feedback"`` K = 0 with the measured outputs in g, ``"prediction"`` estimates K with the other unknowns. All
are procedures: starts from subspace fits with several block rows and models of the user, descents on streamed
sensitivities, the errors weighted anew by their own covariance, functions of latent signals where they are requested,
and at the optimum z0, or under constraints, convex programmes in the tangent of the iterate,

    minimise ‖r‖² + remainder    subject to    r = R (z - z0) + e0,  the user's constraints,

where R (z - z0) + e0 are the errors to first order in the unknowns z, compressed; directions of z that change no output
are part of R. Constraints on poles are matrix inequalities in A, with P held at that of the iterate: an inner region
that touches the true one there. Every iterate keeps them.

Named variables: ``A``, ``C``, ``offset``, ``x0`` ((n,), or (n, experiments)), ``K`` with "prediction", per input ``mu``
(not of a linear channel) and ``b`` (= [B_i; D_i]), per output fed back ``mu feedback`` and ``b feedback``, per latent
signal ``mu latent``, ``b latent`` (= [Ez_i; Fz_i]) and ``z`` (= [Cz_i, Dz_i, constant]), and the products
``Theta = mu bᵀ`` (P, n + l); without feedback and latent signals also the static curves ``static`` (`shape.gain`,
`shape.value_range`, ...). Steps take both to first order about the iterate. With several channels the names carry the
channel, as in ``mu[valve]``. Rules about poles read ``P`` (held) and ``Q = A P``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.poles import NO_EQUATION, asks_for_integrator
from formulations.subspace_procedure import identified
from optid.arrays import check_integer, one_of
from optid.bases import Bases
from optid.core.leaves import Leaf, Product
from optid.core.problem import Problem
from optid.core.terms import Errors, Values
from optid.data.channels import Transform
from optid.data.levels import levelled
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import RankError, StructureError
from optid.identify.arguments import check_offset, in_memory
from optid.identify.prediction_error.compressed_errors import CompressedStates
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.latent_search import STAGES, first_samples
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.prediction_error.state_search import complete, errors_and_starts, on_whole, quietly, search_states
from optid.identify.prediction_error.static_curve import static_curve
from optid.identify.prediction_error.tangent_descent import refine
from optid.identify.prediction_error.tangent_fit import Places, TangentFit
from optid.identify.subspace.plan import Plan, in_record_units, planned
from optid.identify.subspace.steps import subspace_steps
from optid.models import HammersteinSS
from optid.models.roots import modal_weight
from optid.program.solution import Status
from optid.program.units import energy_unit, in_units, inverse, outer_bases
from optid.solving.solve import Evidence, Procedure
from optid.statistics.state_unknowns import SIMULATORS

Array = np.ndarray

WORDS = {"criterion": tuple(SIMULATORS), "stability": ("stable", "free"),
         "weighting": ("auto", "scale", "variance", "determinant")}


@subspace_steps(tangent="hammerstein_ss.exact")
def hammerstein_ss(data: Data, *, nx: int | str, basis: Bases = "polynomial:3", feedback_basis: Any = None,
                   criterion: str = "simulation", block_rows: int | Sequence[int] | None = None,
                   weighting: str = "auto", offset: bool | str = True, feedthrough: bool | Sequence[bool] = True,
                   stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (),
                   iterations: int = 100, constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation or prediction error of a Hammerstein state-space model with output feedback.

    Every input acts through one nonlinearity (rank one). The feedback functions are taken in coordinates without a
    part that is linear in the outputs of the record, which A would repeat.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``mu``, ``offset``, ``static``, ``x0``.

    Args:
        data: the record. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        nx: number of states, or "auto" (gap of the singular values of the first subspace fit).
        basis: basis of the input nonlinearity, one per input or one for all.
        feedback_basis: basis of the feedback, None for no feedback, one for all outputs or one per output.
        criterion: "simulation" (P3: the free run), "measured feedback" (P2: the measured outputs are fed back) or
            "prediction" (P1: innovation form, K estimated).
        block_rows: of the subspace fits to start from, one or several; None chooses three, for which missing outputs
            may be estimated as in `formulations.hammerstein_ss.sid`.
        weighting: of the outputs: "scale" (variances of the outputs), "variance" or "determinant" (variances or
            covariance of the errors, iterated); "auto" is "variance" for simulation and "determinant" (maximum
            likelihood of Gaussian noise) for prediction.
        offset: True for one constant of every output, "each" for one in every experiment (and stretch between missing
            inputs), as of sensors with other zeros, in models without feedback; False takes the record as it is.
        feedthrough: whether the inputs act on the outputs at once, one for all or one per input.
        stability: "stable" keeps every iterate stable (for prediction, its predictor), with the feedback taken as a
            given signal; "free" lets the poles go where the errors are smallest, for plants that integrate or grow
            over the record.
        initial: models of the same structure as additional starting points.
        iterations: maximum number of Gauss-Newton steps per descent.
        constraints: rules about poles, builders of CVXPY constraints in the named variables.

    Raises:
        StructureError: words, orders or starts that do not fit.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, or a feedback basis that is linear in y.
    """
    return state_space_fit(
        "hammerstein_ss.exact", data, nx, basis=basis, feedback_basis=feedback_basis,
        criterion=criterion, block_rows=block_rows, weighting=weighting, offset=offset, feedthrough=feedthrough,
        stability=stability, initial=initial, iterations=iterations, constraints=constraints)


@subspace_steps(tangent="ss.exact")
def ss(data: Data, *, nx: int | str, criterion: str = "simulation", block_rows: int | Sequence[int] | None = None,
       weighting: str = "auto", offset: bool | str = True, feedthrough: bool | Sequence[bool] = True,
       stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
       constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation or prediction error of a linear state-space model.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``offset``, ``static``, ``x0``. Arguments as in `hammerstein_ss`,
    as are the errors raised.
    """
    return state_space_fit(
        "ss.exact", data, nx, criterion=criterion, block_rows=block_rows, weighting=weighting,
        offset=offset, feedthrough=feedthrough, stability=stability, initial=initial, iterations=iterations,
        constraints=constraints)


def _problem(name: str, errors: StateErrors, units: Transform, x: Array, constraints: Sequence[Any]) -> Problem:
    """Minimise ‖e‖² over A, [B; D] and f of every input, C, feedback, latent functions and initial states, from x."""
    expansion, places = errors.unknowns.expansion, Places.of(errors)
    start = places.values(x)
    names = [tuple(errors.key(word, c) for word in ("mu", "b", "static")) for c in range(expansion.m)]
    leaves: list[Leaf] = [Product(mu, b, gauge="") for mu, b, _ in names if mu in start]
    if not expansion.feedback and not errors.unknowns.latent:
        leaves += [static_curve(*three) for three in names]
    latent = {f"z{i}": one for i, one in enumerate(errors.unknowns.latent, start=1)}
    bases = dict(zip(expansion.input_names, outer_bases(expansion.inputs, units)))
    return Problem(
        name, start, terms=(Errors(places.squares, places.value),), leaves=tuple(leaves),
        further=partial(_signals, errors), about=frozenset({"P", "Q"}),
        model=partial(state_space_model, errors, bool(constraints)),
        facts={"iterate": True, "gauge": "norm", "channels": expansion.input_names, "outputs": expansion.output_names,
               "units": units, "bases": bases | {z: one.basis for z, one in latent.items()},
               "spans": {z: one.vectors for z, one in latent.items()}},
        builders=tuple(constraints), scale=errors.energy, energy=errors.energy_of_record)


def _signals(errors: StateErrors, variables: Mapping[str, Any], x: Values) -> dict[str, Any]:
    """Return what constraints may also use: P held and Q = A P, Theta of linear inputs, functions of latent signals."""
    unknowns, weight = errors.unknowns, modal_weight(x["A"])
    found = {"P": cp.Constant(weight), "Q": variables["A"] @ weight}
    for c in range(unknowns.expansion.m):
        if errors.key("mu", c) not in variables:
            b = variables[errors.key("b", c)]
            found[errors.key("Theta", c)] = cp.reshape(b, (1, b.size), order="F")
    for i, one in enumerate(unknowns.latent):
        if one.row is None:
            found[f"mu latent[z{i + 1}]"] = one.vectors @ variables[errors.key("c", i)]
    if unknowns.levels:
        states = cp.reshape(variables["x0"], (unknowns.memory, unknowns.experiments), order="F")
        found |= {"offset": cp.sum(states[unknowns.n :], axis=1) / unknowns.experiments, "x0": states[: unknowns.n]}
    return found


def state_space_model(errors: StateErrors, constrained: bool, values: Values) -> HammersteinSS:
    """Return the model of the values of the unknowns, in the units of the problem."""
    found = errors.at(errors.unknowns.unpack(Places.of(errors).pack(values)))
    return found.regauge("norm") if any(errors.unknowns.free) and not constrained else found


def state_space_fit(name: str, data: Data, nx: int | str, *, criterion: str, stability: str,
                    weighting: str, iterations: int, constraints: Sequence[Any], initial: Any, block_rows: Any,
                    basis: Any = "linear", feedback_basis: Any = None, offset: Any = True, feedthrough: Any = True,
                    extend: Callable[..., Any] | None = None, finish: Callable[..., Procedure] | None = None
                    ) -> Procedure:
    """Fit a model in the units of the samples, and return it in those of the record.

    ``extend`` makes (errors, optimum, figures) of a model with more functions from (errors, optimum, initial models
    with these functions), None for none.
    ``finish`` is a procedure of (plan, errors, constraints, optimum, figures) that returns the evidence; None
    solves the programmes in the tangent.
    The other arguments are those of `hammerstein_ss`, as are the errors raised.
    """
    for what, word in {"criterion": criterion, "stability": stability, "weighting": weighting}.items():
        one_of(what, word, WORDS[what])
    if asks_for_integrator(constraints):
        raise StructureError(NO_EQUATION)
    check_integer(iterations, "iterations", 1 if finish is None else 0)
    record = in_memory(data, f"{criterion} errors")
    constants = check_offset(offset, record)
    if constants == "each":
        if feedback_basis is not None or extend is not None or finish is not None:
            raise StructureError(f"{name} with feedback, latent functions or states as variables has one constant for "
                                 "all experiments: offset='each' is for 'ss.exact' and 'hammerstein_ss.exact' without "
                                 "feedback, and for transfer functions")
        data = levelled(record)[0]
    instruments = "inputs+past" if feedback_basis is None else "simulated"
    if feedback_basis is not None and criterion == "prediction":
        instruments = "simulated+past"
    poles = tuple(rule for rule in constraints if getattr(rule, "about", frozenset()) == frozenset({"poles"}))
    for rule in poles:
        if getattr(rule, "verify", None) is None:
            raise StructureError(f"constraint {rule.name!r} cannot judge a model, which the steps of this fit need; "
                                 "use it with hammerstein_ss.asivid")
    plan = planned(name, data, nx=nx, block_rows=None, basis=basis, feedback_basis=feedback_basis,
                   offset=bool(constants), instruments=instruments, feedthrough=feedthrough, stability="free",
                   iterations=2 * (feedback_basis is not None), constraints=poles)
    models = [initial] if isinstance(initial, HammersteinSS) else list(initial)
    models = [model.with_transform(inverse(plan.units)) for model in models]
    known = [model for model in models if model.latent]  # with functions that `extend` adds to the others
    found = {f"start {i}": model for i, model in enumerate(models, start=1) if not model.latent}

    def run() -> Procedure:
        # what functions of latent signals are added to needs no more than a first part of a long record
        first = plan if extend is None else replace(plan, data=first_samples(plan.data, STAGES[0]))
        given = _block_rows(first) if block_rows is None else [int(rows) for rows in np.atleast_1d(block_rows)]
        nx = yield from _subspace_starts(first, given, block_rows is None, found, criterion == "prediction")
        if isinstance(nx, Evidence):
            return nx
        errors, starts = errors_and_starts(first, nx, found, criterion, stability, tuple(rule.verify for rule in poles),
                                  in_units(record, plan.units) if constants == "each" else None)
        errors, best, figures = search_states(errors, starts, weighting, int(iterations))
        if extend is not None:
            errors, best = on_whole(errors, best, with_whole_inputs(plan.data, 2 * nx + 1))
            errors, best, more = extend(errors, best, known)
            figures = {**figures, **more}
        evidence = yield from (finish or _refined)(plan, errors, tuple(constraints), best, {"order": nx, **figures})
        return None if evidence is None else complete(evidence, errors, energy_unit(plan.units))

    return in_record_units(run(), plan)


def _refined(plan: Plan, errors: StateErrors, constraints: tuple[Any, ...], best: Descent, figures: Mapping[str, Any]
             ) -> Procedure:
    problem = _problem(plan.name, errors, plan.units, best.x, constraints)
    fit = TangentFit(problem, errors, lambda at, z0: CompressedStates(errors, at, z0, plan.units))
    return (yield from refine(fit, best, figures, fit.signed(best.x)))


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
    """Add the models of subspace fits to those found, and return the order; or that no poles satisfy the constraints.

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
        if evidence.status is Status.INFEASIBLE:
            return evidence
        if evidence.model is not None:
            nx = nx or int(evidence.figures["order"])
            model = evidence.extended()[0] if predicts else evidence.model  # K counts there
            found[f"{evidence.figures['block rows']} block rows"] = model
    if nx is None or not found:
        raise refusal or RankError("no subspace fit has a point to start from; use another order")
    return nx
