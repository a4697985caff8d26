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

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.poles import NO_EQUATION, refuse_integrator
from formulations.hammerstein_ss import SUBSPACE
from optid.bases import Bases
from optid.core.problem import Problem
from optid.core.terms import Errors, Values
from optid.data.record import Data
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.prediction_error.state_fit import fit_states
from optid.identify.prediction_error.static_curve import static_curve
from optid.identify.subspace.procedure import subspace_steps
from optid.models import HammersteinSS
from optid.models.roots import modal_weight
from optid.solving.solve import Procedure


@subspace_steps(tangent="hammerstein_ss.exact")
def hammerstein_ss(data: Data, *, nx: int | str, basis: Bases = "polynomial:3", feedback_basis: Any = None,
                   criterion: str = "simulation", block_rows: int | Sequence[int] | None = None,
                   weighting: str = "auto", offset: bool | str = True, feedthrough: bool | Sequence[bool] = True,
                   stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (),
                   iterations: int = 100, constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation or prediction error of a Hammerstein state-space model with output feedback.

    Every input acts through one nonlinearity (rank one). The feedback functions are taken in coordinates without a
    part that is linear in the outputs of the record, which A would repeat.

    Named variables: ``A``, ``C``, ``P``, ``Q``, ``Theta``, ``b``, ``mu``, ``offset``, ``static``, ``x0``.

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
            inputs), where sensors have different zeros, in models without feedback; False takes the record as it is.
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
        "hammerstein_ss.exact", data, nx=nx, basis=basis, feedback_basis=feedback_basis,
        criterion=criterion, block_rows=block_rows, weighting=weighting, offset=offset, feedthrough=feedthrough,
        stability=stability, initial=initial, iterations=iterations, constraints=constraints)


@subspace_steps(tangent="ss.exact")
def ss(data: Data, *, nx: int | str, criterion: str = "simulation", block_rows: int | Sequence[int] | None = None,
       weighting: str = "auto", offset: bool | str = True, feedthrough: bool | Sequence[bool] = True,
       stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
       constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation or prediction error of a linear state-space model.

    Named variables: ``A``, ``C``, ``P``, ``Q``, ``Theta``, ``b``, ``offset``, ``static``, ``x0``. Arguments as in
    `hammerstein_ss`, as are the errors raised.
    """
    return state_space_fit(
        "ss.exact", data, nx=nx, criterion=criterion, block_rows=block_rows, weighting=weighting,
        offset=offset, feedthrough=feedthrough, stability=stability, initial=initial, iterations=iterations,
        constraints=constraints)


def _problem(name: str, errors: StateErrors, x: np.ndarray, constraints: Sequence[Any]) -> Problem:
    """Minimise ‖e‖² over A, [B; D] and f of every input, C, feedback and initial states, from x."""
    variables, leaves = errors.variables, errors.factors()  # Theta = mu bᵀ
    if not errors.unknowns.expansion.feedback:
        leaves += tuple(static_curve(*(errors.key(word, c) for word in ("mu", "b", "static")))
                        for c in range(errors.data.m))
    return Problem(
        name,
        start=variables.values(x),
        terms=(Errors(variables.squares, variables.value, errors),),
        leaves=leaves, further=partial(signals, errors), about=frozenset({"P", "Q"}),
        model=partial(errors.model, constrained=bool(constraints)), facts={"iterate": True, **errors.facts()},
        builders=tuple(constraints), **errors.common())


def signals(errors: StateErrors, variables: Mapping[str, Any], x: Values) -> dict[str, Any]:
    """Return what constraints may also use: P held and Q = A P, Theta of linear inputs, the mean of several levels."""
    unknowns, weight = errors.unknowns, modal_weight(x["A"])
    found = {"P": cp.Constant(weight), "Q": variables["A"] @ weight, **errors.linear_thetas(variables)}
    if unknowns.levels:
        states = cp.reshape(variables["x0"], (unknowns.memory, unknowns.experiments), order="F")
        found |= {"offset": cp.sum(states[unknowns.n :], axis=1) / unknowns.experiments, "x0": states[: unknowns.n]}
    return found


def state_space_fit(name: str, data: Data, *, constraints: Sequence[Any], pose: Any = _problem, **settings: Any
                    ) -> Procedure:
    """Fit a model in the units of the samples, and return it in those of the record; see `fit_states`."""
    refuse_integrator(constraints, NO_EQUATION)
    return fit_states(name, data, constraints=constraints, pose=pose, subspace=SUBSPACE, **settings)
