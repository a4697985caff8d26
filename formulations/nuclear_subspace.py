"""Subspace identification with the nuclear norm in place of a truncated rank.

    min over yhat, T:   ‖ W1 ( H(yhat) - T_u H(eta) - T_z H(zeta) - T_y H(y) ) W2 ‖_*  +  lambda ‖ yhat - y ‖²

H is the block Hankel matrix of the record; what remains of the outputs when the known signals are taken off has the
rank of the order. Missing outputs are free variables. Three forms:

* "predictor": T_u lower block Toeplitz, T_z and T_y strictly so, no weights (N2SID of Verhaegen and Hansson 2016,
  here with functions of the inputs and of fed-back outputs). In predictor form feedback does no harm.
* "projection": T_u unstructured, which is the projection on the complement of the inputs (Liu and Vandenberghe 2009).
* "instruments": that projection, correlated with past inputs and outputs in the weights of the instrumental-variable
  method (Liu, Hansson and Vandenberghe 2013): a small matrix.

The dual bound of every programme is computed in closed form from a feasible dual point. The order and (A, C) are read
off the matrix; everything else is done by the steps of the other subspace methods.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from formulations.subspace_procedure import identified
from optid.arrays import LARGEST, one_of, shown
from optid.bases import Bases, FeedbackBases
from optid.core.low_rank import LowRank
from optid.core.problem import Problem
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.subspace.low_rank import Structured, choose_weight, structure
from optid.identify.subspace.plan import Plan, in_record_units, planned
from optid.identify.subspace.steps import subspace_steps
from optid.program.solution import Solution, Status
from optid.program.units import energy_unit
from optid.solving.solve import Evidence, Procedure

FORMS = ("predictor", "projection", "instruments")
# weights tried by default, each the inverse of a noise variance relative to the variance of the outputs
WEIGHTS = tuple(float(w) for w in np.logspace(-1, 4, 11))


@subspace_steps({"low rank": "SDP nuclear"})
def nuclear(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "linear",
            feedback_basis: FeedbackBases = None, form: str = "predictor",
            weight: float | str | Sequence[float] = "auto", noise: float | None = None, hold_out: float = 0.3,
            offset: bool = True, feedthrough: bool | Sequence[bool] = True, observer: str = "auto",
            split: str = "exact", stability: str = "auto", constraints: Sequence[Any] = ()) -> Procedure:
    """Identify a state-space model from a low-rank Hankel matrix found by convex optimisation.

    Named variables: ``T``, ``output``, ``yhat``. Other arguments as in `formulations.hammerstein_ss.sid`.

    Args:
        data: the record; missing outputs are estimated, windows with missing inputs left out.
        nx: order, or "auto": chosen with the weight by simulation of the parts held out; with one weight, the number
            of singular values above a thousandth of the largest, at most ten.
        block_rows: block rows, more than the order. None chooses.
        feedback_basis: basis of the feedback, None for none; needs form "predictor".
        form: "predictor", "projection" or "instruments".
        weight: weight of the misfit, or several, or "auto": the one that simulates the last part of every experiment
            best. It is the inverse of the noise variance relative to the variance of the outputs.
        noise: standard deviation of the noise in units of the output, instead of a weight (one output, or outputs of
            one size).
        hold_out: part of every experiment kept back to choose a weight.

    Raises:
        StructureError: words or orders that do not fit, or a record too long for the method.
        RankError: the record does not determine the model.
        DataError: a channel that is constant.
    """
    one_of("form", form, FORMS)
    if not 0 < hold_out < 1:
        raise StructureError(f"hold_out={hold_out!r}: it must be a fraction in (0, 1)")
    plan = planned("subspace.nuclear", data, nx=nx, block_rows=block_rows, basis=basis, feedback_basis=feedback_basis,
                   instruments=form, offset=offset, feedthrough=feedthrough, observer=observer, split=split,
                   stability=stability, constraints=tuple(constraints))
    weights = _weights(weight, noise)
    return in_record_units(_procedure(plan, weights, noise, hold_out), plan)


def _weights(weight: float | str | Sequence[float], noise: float | None) -> tuple[float, ...]:
    if noise is not None:
        if not 1 / LARGEST <= noise <= LARGEST or weight != "auto":
            raise StructureError(f"noise={shown(noise)} is a positive standard deviation that takes the place of "
                                 "weight=")
        return (1.0,)
    if isinstance(weight, str):
        one_of("weight", weight, ("auto",))
        return WEIGHTS
    found = tuple(float(w) for w in np.atleast_1d(np.asarray(weight, dtype=float)))
    if not found or not all(0 < w < np.inf for w in found):
        raise StructureError(f"weight={weight!r}: give a positive number, several, or 'auto'")
    return found


def _procedure(plan: Plan, weights: tuple[float, ...], noise: float | None, hold_out: float) -> Procedure:
    trials, weight = {}, weights[0]
    if len(weights) > 1:
        weight, nx, trials = yield from choose_weight(plan, weights, hold_out, partial(low_rank, weight=1.0))
        plan = replace(plan, nx=nx)
    structured = structure(plan)
    if noise is not None:
        weight = float(np.mean(structured.scale)) ** 2 / noise**2 * energy_unit(plan.units)
    solution: Solution = yield low_rank(structured, structured.penalty(weight))
    if not solution.has_point:
        return Evidence.pointless(solution.status, solution.reason)
    _, sizes = parts = structured.decomposed(solution.values)
    rank, nx = structured.rank(sizes), plan.order or structured.order(sizes)
    if nx > rank:
        return Evidence.pointless(Status.FAILED, f"order {nx}, but the low-rank matrix has rank {rank} at this weight: "
                                                 "use a larger weight or a smaller order")
    figures = {"order": nx, "block rows": structured.problem.rows, "form": plan.instruments, "singular values": sizes,
               **trials, "weight": weight, "lambda": structured.penalty(weight), "rank": rank,
               "objective of the convex programme": solution.objective,
               "its dual bound": -np.inf if solution.bound is None else solution.bound.value,
               "its relative gap": solution.gap,
               "missing outputs estimated": int(np.sum(~structured.problem.known))}
    found = replace(structured.observability(solution.values, parts, nx), figures=figures)
    evidence = yield from identified(plan, found)
    if evidence.model is None:
        return evidence
    evidence = replace(evidence, main="low rank", objective=solution.objective, bound=solution.bound or evidence.bound)
    if solution.status in (Status.INACCURATE, Status.LIMIT) and evidence.status in (Status.LOCAL, Status.OPTIMAL):
        evidence = replace(evidence, status=solution.status, reason=f"nuclear-norm programme: {solution.reason}")
    return evidence


def low_rank(structured: Structured, weight: float) -> Problem:
    """State the convex problem for a weight lambda.

    Named variables: ``yhat`` (samples, l), outputs of mean zero and unit variance, and, in predictor form, ``T``, one
    column per output. The expression ``output`` is yhat in units of the data.
    """
    matrix = LowRank(structured.problem)  # W1 (H(yhat) - T_u H(eta) - ...) W2
    misfit = matrix.misfit(weight)  # lambda ‖yhat - y‖²

    return Problem(
        "low rank", matrix.start(), (matrix, misfit), (), structured.decomposed,
        {"units": structured.windows.plan.units}, structured.in_units,
        scale=weight * float(np.sum(structured.problem.data**2)),
        weights={"weight": weight}, posed=partial(low_rank, structured))
