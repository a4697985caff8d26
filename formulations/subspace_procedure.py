"""The steps that the subspace methods share, and the programme of the third of them.

1. The observability matrix from projections: `optid.identify.subspace.observability`, no programme.
2. (A, C) from its shift invariance, poles where the constraints want them: `formulations.shift`.
3. B, D, E, offset and x0 with the constraints on coefficients, for these (A, C): `realisation_problem`,

       min ‖R [x0; offset; vec Theta_1; ...] - s‖²,    Theta_i = mu_i [B_i; D_i]ᵀ

   R and s are the record, compressed (`optid.identify.subspace.realisation`).
4. The noise model from the prediction errors, when it is needed: `optid.identify.noise`.

The third programme has two forms:

* factored: every channel is rank one; solved and certified by the machinery of rank-one blocks. Named variables:
  ``x0``, ``offset``, ``mu``, ``b`` (= [B_i; D_i]) and, for an output that is fed back, ``mu feedback``,
  ``b feedback``.
* lumped: ``Theta_i`` as it comes, convex; the factors are split off afterwards in the metric of the least squares.
  Named variables: ``x0``, ``offset``, ``Theta``, ``Theta feedback``. Linear channels alone always take this form.

With several inputs the per-channel names carry the input, as in ``mu[valve]``. Expressions for constraints in either
form: ``Theta`` (P, n + l), the lumped ``Bu`` (n, p), ``Du`` (l, p) and ``Ez`` (n, q); where every channel is linear
``B`` (n, m) and ``D`` (l, m) too. ``reference`` of the view holds A and C.
"""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.poles import stable
from formulations.shift import constrained_shift
from optid.bases import Linear
from optid.certificate.hankel import simulation_bound
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.program import as_program
from optid.core.terms import Squares
from optid.errors import DataWarning
from optid.identify.noise import with_noise_or_reason
from optid.identify.subspace.observability import INSIDE, Observability, estimate_observability
from optid.identify.subspace.plan import Plan
from optid.identify.subspace.realisation import Realisation
from optid.models.roots import spectral_radius
from optid.program.solution import Bound, Solution, Status
from optid.program.units import energy_unit, outer_bases
from optid.solving.solve import Evidence, Procedure

# multipliers up to which the proof of this step, which says nothing of (A, C), is worth a semidefinite programme
RELAXED = 150


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
    program = as_program(realisation_problem(step, plan), RELAXED)
    solution: Solution = yield program
    if not solution.has_point:
        return Evidence.pointless(solution.status, solution.reason)
    model = program.recover(solution.values)
    status = Status.LOCAL if solution.status is Status.OPTIMAL else solution.status
    status, reason = (Status.INACCURATE, doubt) if doubt else (status, solution.reason)
    return Evidence(model, solution.objective, partial(_bound, plan, step, solution, program.unit, len(gamma) // l),
                    status, reason, figures | step.ratios(), partial(with_noise_or_reason, model, plan.data))


def _bound(plan: Plan, step: Realisation, solution: Solution, unit: float, block_rows: int) -> Bound:
    """Return the Hankel bound of the objective in units of the record; none where no proof was requested."""
    said = "the (A, C) step minimises no criterion of the whole model"
    if solution.bound is None:
        return Bound.none(said)
    if solution.proof:
        said += "; for this (A, C) the coefficients are proved optimal"
    form = step.form
    bound = simulation_bound(plan.records, form.expansion, form.n, form.weights, solution.objective / unit, block_rows,
                             said, not form.injected and not form.extra)
    return replace(bound, value=unit * bound.value)


def realisation_problem(realisation: Realisation, plan: Plan) -> Problem:
    """Return the least squares of a plan for given (A, C), ``‖R [x0; offset; vec Theta_1; ...] - s‖²``."""
    form, units = realisation.form, plan.units
    start = realisation.start()
    linear, thetas = ("x0", "offset") if form.offset else ("x0",), tuple(name for _, _, name in realisation.names)
    products = tuple(Product(mu, b) for mu, b, _ in realisation.names) if realisation.factored else ()

    objective = Squares.of(realisation.problem, (*linear, *thetas))

    x, relative = form.expansion, np.any(form.weights != 1)  # to the sizes of outputs in the unit of the residuals
    facts = {"channels": x.input_names, "outputs": x.output_names, "units": units,
             "bases": dict(zip(x.input_names, outer_bases(x.inputs, units))),
             "gauge": "norm" if realisation.factored else "", "reference": {"A": form.a, "C": form.c}}
    return Problem("split", start, (objective,), products, partial(realisation.model, plan.data), facts,
                   partial(_matrices, realisation), builders=plan.about("coefficients"),
                   scale=realisation.problem.scale, unit=1.0 if relative else energy_unit(units))


def _matrices(realisation: Realisation, variables: Mapping[str, Any], x: object) -> dict[str, Any]:
    """Return the matrices that constraints may use besides Theta_i, (P, n + l) or, without feedthrough, (P, n)."""
    form, n = realisation.form, realisation.form.n
    expansion, thetas = form.expansion, [variables[name] for _, _, name in realisation.names]
    inner = [theta[:, :n].T for theta in thetas]
    direct = [theta[:, n:].T if direct else np.zeros((form.l, theta.shape[0]))
              for theta, direct in zip(thetas, form.feedthrough)]
    found = {"Bu": cp.hstack(inner[: expansion.m]), "Du": cp.hstack(direct)}
    if expansion.q:
        found["Ez"] = cp.hstack(inner[expansion.m :])
    if all(isinstance(basis, Linear) for basis in expansion.inputs):
        found |= {"B": found["Bu"], "D": found["Du"]}
    return found
