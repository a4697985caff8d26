"""The steps that the subspace methods share, for the problems that a formulation states, and their declaration.

1. The observability matrix from projections, no problem: `optid.identify.subspace.observability`.
2. (A, C) from its shift invariance, poles where the constraints want them: `optid.identify.subspace.shift`.
3. B, D, E, offset and x0 with the constraints on coefficients, for these (A, C).
4. The noise model from the prediction errors, when it is needed: `optid.identify.noise`.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from optid.bases import has_products
from optid.certificate.hankel import simulation_bound
from optid.certificate.lifting import certify_rank_one
from optid.core.least_squares import RankOneForm
from optid.core.problem import Problem
from optid.data.record import Data
from optid.errors import DataWarning
from optid.identify.noise import with_noise_or_reason
from optid.identify.subspace.observability import INSIDE, Observability, estimate_observability
from optid.identify.subspace.plan import Plan, in_record_units, make_plan
from optid.identify.subspace.realisation import Realisation
from optid.identify.subspace.shift import constrained_shift
from optid.models.roots import spectral_radius
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure
from optid.solving.steps import steps

# multipliers up to which the proof of the third step, which says nothing of (A, C), is worth a semidefinite programme
RELAXED = 150
MATRICES = {"shift": "SDP", "shift with fixed P": "SDP", "centre": "SDP"}
"""Those that bring poles to where the constraints want them, or an unstable A into the unit disc."""


@dataclass(frozen=True)
class SubspaceSteps:
    """How a formulation states the problems of the steps.

    Attributes:
        shift, centre: those of the second; see `optid.identify.subspace.shift.Programmes`.
        split: that of the third.
        stable: radius -> the rule that brings the poles of an unstable estimate inside it.
    """

    shift: Callable[..., Problem]
    centre: Callable[..., Problem]
    split: Callable[[Realisation], Problem]
    stable: Callable[[float], Any]

    def fit(self, name: str, data: Data, **settings: Any) -> Procedure:
        """Plan a method (`make_plan`), run it, and return its model in the units of the record."""
        plan = make_plan(name, data, **settings)
        return in_record_units(self.run(plan), plan)

    def run(self, plan: Plan, found: Observability | None = None) -> Procedure:
        """Run the steps of a plan and return the model with singular values, condition of R11 and further figures.

        The observability matrix, with what was measured before, is that of projections where it is None.
        """
        found = estimate_observability(plan) if found is None else found
        a, gamma, l, figures = found.least_squares(), found.scaled, plan.data.l, dict(found.figures)  # noqa: E741
        doubt, rules = "", plan.about("poles")
        if rules or plan.stability == "auto" and spectral_radius(a) >= 1:
            shift = yield from constrained_shift(
                gamma[:-l], gamma[l:], rules or (self.stable(INSIDE),), (self.shift, self.centre))
            if shift.a is None:
                return Evidence.pointless(shift.status, shift.reason)
            if shift.applied:
                figures["suboptimality of A under the pole constraints"] = shift.suboptimality
                if not rules:
                    warnings.warn(
                        f"the subspace estimate of A is unstable (largest modulus {spectral_radius(a):.4g}): its "
                        f"poles were brought to modulus {INSIDE}. Use stability='free' for a plant that is "
                        "unstable without its feedback.", DataWarning, stacklevel=2)
            a, doubt = shift.a, shift.reason if shift.status is Status.INACCURATE else ""
        step = found.step(a)
        step = replace(step, factored=plan.split == "exact" and any(min(shape) > 1 for shape in step.form.blocks))
        program = self.split(step)
        if RankOneForm.of(program) is not None:
            program = replace(program, proof=lambda problem, x, _: certify_rank_one(problem, x, RELAXED))
        solution: Solution = yield program
        if not solution.has_point:
            return Evidence.pointless(solution.status, solution.reason)
        model = program.model(solution.values)
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
    if form.injected or form.extra:  # an observer gain corrects the state, or instruments stand for the feedback
        return Bound.none(f"{said}; its objective is no simulation error, which the Hankel bound is about")
    bound = simulation_bound(plan.records, form.expansion, form.n, form.weights, solution.objective / unit, block_rows,
                             said)
    return replace(bound, value=unit * bound.value)


def subspace_steps(own: Mapping[str, str] | None = None, tangent: str = "") -> Callable[[Callable], Callable]:
    """Declare "split", which chooses B, D and E, and the steps that move poles, behind those of a formulation.

    Args:
        own: its own steps.
        tangent: the step whose programmes hold all constraints, in the tangent of a state-space model.
    """
    def declare(given: Mapping[str, Any]) -> dict[str, str]:
        rules = given["constraints"]
        inner = _about_coefficients(rules) if "split" in given else []  # starts obey rules about poles alone
        products = has_products([given.get("basis", "linear"), given.get("feedback_basis")])
        split = "NLP rank-one" if products and given.get("split", "exact") == "exact" else (
            _convex(inner) if inner else "QP linear")
        whole = {tangent: _convex(rules) if rules else "QP linear"} if tangent else {}
        return {**(own or {}), **whole, "split": split, **MATRICES}
    return steps(declare)


def _about_coefficients(rules: Sequence[Any]) -> list[Any]:
    """Return the constraints about coefficients; a function of the user is one."""
    return [rule for rule in rules if "coefficients" in getattr(rule, "about", {"coefficients"})]


def _convex(rules: Sequence[Any]) -> str:
    """Return the class of a least-squares programme under constraints of a state-space model."""
    return "SDP" if any(getattr(rule, "matrix", False) for rule in rules) else "QP"
