"""The steps that the subspace methods share, and the programme of the third of them.

1. The observability matrix from projections: `optid.identify.subspace.observability`, no programme.
2. (A, C) from its shift invariance, poles where the constraints want them: `formulations.shift`.
3. B, D, E, offset and x0 with the constraints on coefficients, for these (A, C): `realisation_programme`,

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
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.poles import stable
from formulations.shift import constrained_shift
from optid.bases import Linear
from optid.certificate.hankel import simulation_bound
from optid.certificate.lifting import certify_rank_one
from optid.data.channels import Transform
from optid.errors import DataWarning
from optid.identify.noise import with_noise_or_reason
from optid.identify.subspace.observability import INSIDE, Observability, estimate_observability
from optid.identify.subspace.plan import Plan
from optid.identify.subspace.realisation import Realisation
from optid.models.roots import spectral_radius
from optid.program.expressions import flat
from optid.program.program import Program
from optid.program.solution import Bound, Solution, Status
from optid.program.units import energy_unit, outer_bases
from optid.program.view import View
from optid.solving.solve import Evidence, Procedure
from optid.structures.least_squares import LinearStructure, RankOneStructure

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


def realisation_programme(realisation: Realisation, plan: Plan) -> Program:
    """Build the least squares of a plan under its constraints on coefficients; ``recover`` gives the model."""
    problem, form, units = realisation.problem, realisation.form, plan.units
    names, linear = realisation.names, ("x0", "offset") if form.offset else ("x0",)
    if realisation.factored:
        structure = RankOneStructure(problem, linear, tuple((mu, b) for mu, b, _ in names), "norm")
        certify, structural = partial(certify_rank_one, max_size=RELAXED), frozenset({"residual", "gauge"})
    else:
        structure = LinearStructure(problem, (*linear, *(theta for _, _, theta in names)))
        certify, structural = None, frozenset({"residual"})

    def statement() -> dict[str, Any]:
        shape = form.n if form.experiments == 1 else (form.n, form.experiments)
        variables = {name: cp.Variable(shape if name == "x0" else form.l, name=name) for name in linear}
        gauge = {}
        if realisation.factored:
            mus = [cp.Variable(p, name=mu) for (mu, _, _), (p, _) in zip(names, form.blocks)]
            bs = [cp.Variable(entries, name=b) for (_, b, _), (_, entries) in zip(names, form.blocks)]
            thetas = [cp.outer(mu, b) for mu, b in zip(mus, bs)]
            factors = {one.name(): one for pair in zip(mus, bs) for one in pair}
            gauge = {"gauge": tuple(cp.sum_squares(b) == 1 for b in bs)}
        else:
            thetas = [cp.Variable(shape, name=theta) for (_, _, theta), shape in zip(names, form.blocks)]
            factors = {theta.name(): theta for theta in thetas}
        error = problem.root @ cp.hstack([flat(part) for part in (*variables.values(), *thetas)]) - problem.target
        residual = cp.Variable(error.size, name="residual")
        variables |= factors
        return {"objective": cp.Minimize(cp.sum_squares(residual) + problem.remainder),
                "constraints": {"residual": (residual == error,), **gauge}, "derived": {"residual": error},
                "variables": {**variables, "residual": residual}, "view": _view(realisation, units, variables, thetas)}

    relative = np.any(form.weights != 1)  # to the sizes of the outputs, which have the same unit as the residuals
    return Program.deferred(
        "split", statement, start=realisation.start(), recover=partial(realisation.model, plan.data),
        structural=structural, scale=problem.scale, unit=1.0 if relative else energy_unit(units),
        structure=structure, certify=certify).subject_to(*plan.about("coefficients"))


def _view(realisation: Realisation, units: Transform, variables: dict[str, Any], thetas: Sequence[cp.Expression]
          ) -> View:
    """Return what constraints may speak about; Theta_i is (P, n + l) or, without feedthrough, (P, n)."""
    form, x, n = realisation.form, realisation.form.expansion, realisation.form.n
    expressions = variables | {name: theta for (_, _, name), theta in zip(realisation.names, thetas)}
    inner = [theta[:, :n].T for theta in thetas]
    direct = [theta[:, n:].T if direct else np.zeros((form.l, theta.shape[0]))
              for theta, direct in zip(thetas, form.feedthrough)]
    expressions["Bu"], expressions["Du"] = cp.hstack(inner[: x.m]), cp.hstack(direct)
    if x.q:
        expressions["Ez"] = cp.hstack(inner[x.m :])
    if all(isinstance(basis, Linear) for basis in x.inputs):
        expressions["B"], expressions["D"] = expressions["Bu"], expressions["Du"]
    return View(expressions, channels=x.input_names, outputs=x.output_names,
                bases=dict(zip(x.input_names, outer_bases(x.inputs, units))),
                gauge="norm" if realisation.factored else "", reference={"A": form.a, "C": form.c}, units=units)
