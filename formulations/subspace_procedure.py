"""The steps that the subspace methods share.

1. The observability matrix from projections: `optid.identify.subspace.observability`, no programme.
2. (A, C) from its shift invariance, poles where the constraints want them: `formulations.shift`.
3. (B, D, E, offset, x0) with the constraints on coefficients: `formulations.realisation`.
4. The noise model from the prediction errors, when it is asked for: `optid.identify.noise`.
"""

import warnings
from dataclasses import replace
from functools import partial

from formulations.constraints.poles import stable
from formulations.realisation import realisation_programme
from formulations.shift import constrained_shift
from optid.certificate.hankel import simulation_bound
from optid.errors import DataWarning
from optid.identify.noise import with_noise_or_reason
from optid.identify.subspace.observability import INSIDE, Observability, estimate_observability
from optid.identify.subspace.plan import Plan
from optid.identify.subspace.realisation import Realisation
from optid.models.roots import spectral_radius
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure


def identified(plan: Plan, found: Observability | None = None) -> Procedure:
    """Run the steps of a plan and return the model with singular values, condition of R11 and further figures.

    The observability matrix, with what was measured before, is that of projections where it is None.
    """
    found = estimate_observability(plan) if found is None else found
    a, gamma, l, figures = found.least_squares(), found.scaled, plan.data.l, dict(found.figures)  # noqa: E741
    doubt, rules = "", plan.about("poles")
    if rules or plan.stability == "auto" and spectral_radius(a) >= 1:
        shift = yield from constrained_shift(gamma[:-l], gamma[l:], rules or (stable(INSIDE),))
        if shift.a is None:
            return Evidence.pointless(shift.status, shift.reason)
        if shift.applied:
            figures["suboptimality of A under the pole constraints"] = shift.suboptimality
            if not rules:
                warnings.warn(f"the subspace estimate of A is unstable (largest modulus {spectral_radius(a):.4g}): its "
                              f"poles were brought to modulus {INSIDE}. Use stability='free' for a plant that is "
                              "unstable without its feedback.", DataWarning, stacklevel=2)
        a, doubt = shift.a, shift.reason if shift.status is Status.INACCURATE else ""
    step = found.step(a)
    step = replace(step, factored=plan.split == "exact" and any(min(shape) > 1 for shape in step.form.blocks))
    program = realisation_programme(step, plan)
    solution: Solution = yield program
    if not solution.has_point:
        return Evidence.pointless(solution.status, solution.reason)
    model = program.recover(solution.values)
    status = Status.LOCAL if solution.status is Status.OPTIMAL else solution.status
    status, reason = (Status.INACCURATE, doubt) if doubt else (status, solution.reason)
    return Evidence(model, solution.objective, partial(_bound, plan, step, solution, program.unit, len(gamma) // l),
                    status, reason, figures | step.ratios(), partial(with_noise_or_reason, model, plan.data))


def _bound(plan: Plan, step: Realisation, solution: Solution, unit: float, block_rows: int) -> Bound:
    """Return the Hankel bound of the objective in units of the record; none where no proof was asked for."""
    said = "the (A, C) step minimises no criterion of the whole model"
    if solution.bound is None:
        return Bound.none(said)
    if solution.proof:
        said += "; for this (A, C) the coefficients are proved optimal"
    form = step.form
    bound = simulation_bound(plan.records, form.expansion, form.n, form.weights, solution.objective / unit, block_rows,
                             said, not form.injected and not form.extra)
    return replace(bound, value=unit * bound.value)
