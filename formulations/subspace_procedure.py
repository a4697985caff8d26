"""The steps that the subspace methods of `formulations.hammerstein_ss` share."""

import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from formulations.constraints.stability import stable
from formulations.realisation import Factors, Realisation, least_squares_values, realisation_programme
from formulations.shift import constrained_shift
from formulations.simulation_bound import simulation_bound
from formulations.state_models import state_model
from formulations.subspace_plan import BEST, Plan
from optid.errors import DataWarning, RankError, StructureError
from optid.identify.noise import with_noise_or_reason
from optid.identify.subspace.imputation import count_windows, impute
from optid.identify.subspace.methods import (
    Projection,
    check_order,
    default_block_rows,
    project,
    signal_rank,
    simulate_clipped,
    tested_order,
    weakest_feedback,
)
from optid.identify.subspace.observer import ObserverForm, ObserverProblem, observer_gain, observer_problem
from optid.identify.subspace.realisation import WEIGHTINGS, largest_gap, scaled_pair
from optid.models.hammerstein_ss import HammersteinSS
from optid.models.roots import spectral_radius
from optid.program.solution import Solution, Status
from optid.solving.solve import Evidence, Procedure
from optid.statistics.channels import check_channels
from optid.statistics.expansion import Expansion

NOISES = ("white", "coloured")

WEAK = 0.1
"""Share of the energy of the feedback functions that the simulated ones explain below which the user is told."""

SCARCE, INTACT = 20, 0.8
"""Missing outputs are estimated where fewer complete windows than this are left per row of the Hankel matrix, and a
smaller share than this of all windows."""

INSIDE = 0.999
"""Modulus to which poles outside the unit circle are brought by ``stability="auto"``."""


def prepared(plan: Plan) -> tuple[Expansion, int]:
    """Return the signals of a plan and its number of block rows, after the checks of its channels."""
    expansion = plan.expansion()
    check_channels(plan.records, plan.data.inputs, plan.data.outputs)
    return expansion, _block_rows(plan, expansion)


def identified(plan: Plan) -> Procedure:
    """Run the steps of a plan: project, find the order, choose (A, C), then B, D, E and x0, then the noise model.

    Yields:
        The programmes of the steps under constraints and of the step in B, D, E and x0.

    Returns:
        The model with singular values, condition of R11 and further figures.
    """
    expansion, alpha = prepared(plan)
    records, imputed = plan.records, {}
    if _lacks_windows(plan, expansion, alpha):
        imputation = impute(plan.data, partial(_estimated, plan, expansion, alpha))
        records, imputed = imputation.records, {"missing outputs": str(imputation)}
        warnings.warn(f"missing outputs leave too few complete windows of {2 * alpha} samples; {imputation}. The "
                      "criterion of the last step uses the samples present", DataWarning, stacklevel=2)
    records, expansion, instruments = _instrumented(plan, records, expansion, alpha)
    projection = _projected(plan, records, expansion, alpha, instruments)
    nx, reason = _order(plan, projection, records, expansion)
    chosen = {}
    if plan.weighting == BEST:
        projection, word = _best_weighting(plan, records, expansion, projection, nx)
        chosen = {"weighting": word}
    figures = {"order": nx, **({"order chosen": reason} if reason else {}), "block rows": alpha,
               "windows": projection.statistics.windows, **imputed, "instruments": instruments, **chosen,
               "singular values": _height(plan) * projection.range.values,
               "condition of R11": projection.blocks.condition}
    if expansion.simulated:
        share, output = weakest_feedback(projection, expansion)
        figures["share of the feedback that the simulated one explains"] = share
        if share < WEAK:
            warnings.warn(f"the simulated feedback of output {output!r} explains {100 * share:.1f} % of the measured "
                          "one: its effect will be uncertain. Use noise='white' where the noise allows it, more "
                          "iterations or a stronger input.", DataWarning, stacklevel=2)
    if projection.blocks.discarded:
        figures["regressor directions left out"] = projection.blocks.discarded
    return (yield from completed(plan, records, expansion, projection.gamma(nx), projection.scale, figures))


def _height(plan: Plan) -> float:
    """Unit of the singular values: that of the outputs, unless their weighting takes it away."""
    return 1.0 if plan.weighting == "cva" else plan.units.y_scale[0]


def completed(plan: Plan, records: list[np.ndarray], expansion: Expansion, gamma: np.ndarray, scale: np.ndarray,
              figures: dict[str, Any]) -> Procedure:
    """Run the steps after the observability matrix: (A, C), then B, D, E and x0, then the noise model.

    Args:
        plan: what was asked for.
        records: raw channels, with simulated outputs where the expansion reads them.
        expansion: the signals.
        gamma: (rows l, n) observability matrix, in units of the outputs.
        scale: (l,) sizes of the outputs, by which it and the residuals are divided.
        figures: what was measured before.

    Yields:
        The programmes of the steps.

    Returns:
        The evidence, with figures added.
    """
    data, figures = plan.data, dict(figures)
    a, c, gamma = scaled_pair(gamma, scale)
    doubt = ""
    rules = plan.about("poles")
    unstable = plan.stability == "auto" and spectral_radius(a) >= 1
    if rules or unstable:
        shift = yield from constrained_shift(gamma[: -data.l], gamma[data.l :], rules or (stable(INSIDE),))
        if shift.a is None:
            return Evidence.pointless(shift.status, shift.reason)
        if shift.applied:
            figures["suboptimality of A under the pole constraints"] = shift.suboptimality
            if not rules:
                radius = spectral_radius(a)
                warnings.warn(f"the subspace estimate of A is unstable (largest modulus {radius:.4g}): its poles were "
                              f"brought to modulus {INSIDE}. Use stability='free' for a plant that is unstable without "
                              "its feedback.", DataWarning, stacklevel=2)
        a, doubt = shift.a, shift.reason if shift.status is Status.INACCURATE else ""
    step = _step(plan, records, expansion, a, c, scale)
    realisation, program = realisation_programme(step, plan.name, plan.about("coefficients"),
                                                 factored=plan.split == "exact", units=plan.units)
    solution: Solution = yield program
    if not solution.has_point:
        return Evidence.pointless(solution.status, solution.reason)
    model = _model(plan, step, realisation.factors(solution.values))
    model, remark = with_noise_or_reason(model, data)
    figures |= _ratios(step)
    if remark:
        figures["noise model"] = remark
    status, reason = (Status.INACCURATE, doubt) if doubt else (_status(solution), solution.reason)
    bound = simulation_bound(plan.records, step, solution.objective / program.unit, len(gamma) // data.l,
                             _said(solution))
    bound = replace(bound, value=program.unit * bound.value)
    return Evidence(model, solution.objective, bound, status, reason, figures)


def preliminary(plan: Plan, records: list[np.ndarray], expansion: Expansion, gamma: np.ndarray, scale: np.ndarray
                ) -> HammersteinSS:
    """Return the least-squares model of an observability matrix, for comparisons: no constraints, A contracted.

    Raises:
        RankError: the record does not determine it.
    """
    a, c, _ = scaled_pair(gamma, scale)
    step = _step(plan, records, expansion, _inside(a), c, scale)
    realisation = Realisation(step, False)
    return _model(plan, step, realisation.factors(least_squares_values(realisation)))


def _block_rows(plan: Plan, expansion: Expansion) -> int:
    given, nx = plan.block_rows, plan.order
    if given is None:
        alpha = default_block_rows(plan.records, expansion, nx)
    elif isinstance(given, bool) or not isinstance(given, int | np.integer) or given < 2:
        raise StructureError(f"block_rows={given!r}: a whole number from 2, larger than the order.")
    else:
        alpha = int(given)
    if nx is not None:
        check_order(nx, alpha, plan.data.l)
    return alpha


def _lacks_windows(plan: Plan, expansion: Expansion, alpha: int) -> bool:
    """Whether missing outputs cost many of the windows, and those left are few for the rows of the Hankel matrix.

    Block rows that were asked for stay: what is missing is then refused.
    """
    gaps = any(plan.data.missing[name] for name in plan.data.outputs)
    if not gaps or plan.block_rows is not None and not plan.imputes:
        return False
    complete, candidates = count_windows(plan.records, 2 * alpha)
    return complete < INTACT * candidates and complete < SCARCE * 2 * alpha * (expansion.p + expansion.q + expansion.l)


def _instrumented(plan: Plan, records: list[np.ndarray], expansion: Expansion, alpha: int
                  ) -> tuple[list[np.ndarray], Expansion, str]:
    """Return the records, with simulated outputs where these are instruments, their signals, and the instruments."""
    if not plan.instruments.startswith("simulated"):
        return records, expansion, plan.instruments
    if not expansion.q:
        return records, expansion, plan.instruments.replace("simulated", "inputs")
    return *_simulated(plan, records, expansion, alpha), plan.instruments


def _estimated(plan: Plan, expansion: Expansion, alpha: int, records: list[np.ndarray]) -> HammersteinSS:
    """Return the least-squares model with its noise model of records whose missing outputs are estimated."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # about a model that only serves to estimate
        if expansion.q and not plan.instruments.endswith("past"):  # a model that predicts; the last one is consistent
            plan = replace(plan, instruments=f"{plan.instruments}+past")
        records, expansion, instruments = _instrumented(plan, records, expansion, alpha)
        projection = _projected(plan, records, expansion, alpha, instruments)
        nx, _ = _order(plan, projection, records, expansion)
        model = preliminary(plan, records, expansion, projection.gamma(nx), projection.scale)
        return with_noise_or_reason(model, plan.data)[0]


def _projected(plan: Plan, records: list[np.ndarray], expansion: Expansion, alpha: int, instruments: str
               ) -> Projection:
    return project(records, expansion, alpha, instruments=instruments, offset=plan.offset, form=plan.form,
                   tolerance=plan.tolerance, weighting=WEIGHTINGS[0] if plan.weighting == BEST else plan.weighting)


def _best_weighting(plan: Plan, records: list[np.ndarray], expansion: Expansion, projection: Projection, nx: int
                    ) -> tuple[Projection, str]:
    """Return the projection in the weighting whose (A, C) leaves the smallest error on the record, and its word.

    None is best on all records: the canonical weighting has the smaller variance where the order suffices, the others
    keep the outputs with most energy where it does not. A stable estimate comes before one that had to be moved.
    """
    found = []
    for word in WEIGHTINGS:
        tried = projection.weighted(word, expansion.l)
        a, c, _ = scaled_pair(tried.gamma(nx), tried.scale)
        inside = _inside(a)
        form = _form(plan, records, expansion, inside, c, tried.scale)
        error = observer_problem(records, form, targets=_targets(plan)).problem.remainder
        found.append((inside is not a, error, word, tried))
    _, _, word, best = min(found, key=lambda one: one[:2])
    return best, f"{word}: the smallest error on the record"


def _order(plan: Plan, projection: Projection, records: list[np.ndarray], expansion: Expansion) -> tuple[int, str]:
    """Return the order, and where it was to be found the reason in words."""
    nx, values, reason = plan.order, projection.range.values, ""
    rank = signal_rank(projection)
    if plan.nx == "auto" and rank <= min(projection.block_rows - 1, values.size - 1):  # a record without noise
        nx, reason = rank, f"{rank}: the singular values after it are rounding"
    elif plan.nx == "auto":
        try:
            nx, reason = tested_order(records, expansion, projection.block_rows, instruments=projection.instruments,
                                      offset=plan.offset)
        except RankError:  # singular regressors, or a record too short for the distribution
            nx = None
    if nx is None:
        nx = largest_gap(values, min(projection.block_rows - 1, values.size // 2))
        following = values[nx] if nx < values.size else 0.0
        reason = f"{nx}: the largest gap of the singular values, {values[nx - 1]:.3g} before {following:.3g}"
    if nx > rank:
        raise RankError(f"order {nx}, but the projected outputs have rank {rank}: use nx={rank} or less, more block "
                        "rows or a richer input.")
    return nx, reason


def _form(plan: Plan, records: list[np.ndarray], expansion: Expansion, a: np.ndarray, c: np.ndarray,
          scale: np.ndarray) -> ObserverForm:
    unstable = spectral_radius(a) >= 1
    closed = plan.observer == "kalman" or (plan.observer == "auto" and unstable)
    gain = observer_gain(a, c) if closed else np.zeros((len(a), len(c)))
    return ObserverForm(a, c, gain, expansion, len(records), plan.direct(), plan.offset, 1 / scale)


def _step(plan: Plan, records: list[np.ndarray], expansion: Expansion, a: np.ndarray, c: np.ndarray,
          scale: np.ndarray) -> ObserverProblem:
    form = _form(plan, records, expansion, a, c, scale)
    # where past outputs may be instruments, the noise is white and least squares has the smaller variance
    coloured = expansion.simulated and not plan.instruments.endswith("past")
    return observer_problem(records, form, instruments=coloured, targets=_targets(plan))


def _targets(plan: Plan) -> list[np.ndarray]:
    """Return the measured outputs of every experiment."""
    return [record[:, plan.data.m :] for record in plan.records]


def _simulated(plan: Plan, raw: list[np.ndarray], expansion: Expansion, alpha: int
               ) -> tuple[list[np.ndarray], Expansion]:
    """Return the records with outputs simulated by a preliminary model, and the expansion that reads them.

    Any preliminary model will do: what it simulates depends on the inputs alone. The first one has past outputs as
    instruments; where the regressors are singular then, it has no feedback.
    """
    model, records, kind = expansion, raw, "inputs+past"
    for i in range(plan.iterations):
        try:
            projection = _projected(plan, records, model, alpha, kind)
        except RankError:
            if i:
                raise
            model, kind = expansion.without_feedback(), "inputs"
            projection = _projected(plan, records, model, alpha, kind)
        nx, _ = _order(plan, projection, records, model)
        a, c, _ = scaled_pair(projection.gamma(nx), projection.scale)
        step = _step(plan, records, model, _inside(a), c, projection.scale)
        bu, du, ez, d, _ = step.matrices(step.least_squares())
        outputs = simulate_clipped(raw, model, _inside(a), c, bu, du, ez, d)
        records = [np.hstack([record, y]) for record, y in zip(raw, outputs)]
        model, kind = expansion.with_simulated(), plan.instruments
    return records, model


def _inside(a: np.ndarray) -> np.ndarray:
    """Contract an unstable preliminary A: its simulation only serves as an instrument."""
    radius = spectral_radius(a)
    return a if radius < 1 else a * (INSIDE / radius)


def _model(plan: Plan, step: ObserverProblem, factors: Factors) -> HammersteinSS:
    form = step.form
    n, l = form.n, form.l  # noqa: E741
    b = np.column_stack([part[:n] for part in factors.bs])
    d = np.column_stack([part[n:] if len(part) > n else np.zeros(l) for part in factors.bs])
    e = np.column_stack([np.zeros((n, 0)), *factors.es])
    model = state_model(form.expansion, plan.data, (form.a, b, form.c, d), factors.mus, factors.nus, e,
                        offset=factors.offset)
    return replace(model, gauge="norm") if any(basis.size > 1 for basis in form.expansion.inputs) else model


def _ratios(step: ObserverProblem) -> dict[str, float]:
    """Second over first singular value of every channel's unrestricted matrix: zero for a channel of rank one."""
    x = step.form.expansion
    z = step.least_squares()
    names = [f"channel {name}" for name in x.input_names]
    names += [f"feedback of {x.output_names[family.output]}" for family in x.feedback]
    found = {}
    for i, (name, shape) in enumerate(zip(names, step.form.blocks)):
        if min(shape) > 1:
            values = np.linalg.svd(z[step.form.block(i)].reshape(shape, order="F"), compute_uv=False)
            found[f"second over first singular value, {name}"] = float(values[1] / values[0])
    return found


def _said(solution: Solution) -> str:
    said = "the (A, C) step minimises no criterion of the whole model"
    return said + "; for this (A, C) the coefficients are proved optimal" if solution.proof else said


def _status(solution: Solution) -> Status:
    return Status.LOCAL if solution.status is Status.OPTIMAL else solution.status
