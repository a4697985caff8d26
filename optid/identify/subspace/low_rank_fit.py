"""A fit by the nuclear norm: its weight, the low-rank problem, and the steps of the other subspace methods."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from optid.arrays import LARGEST, one_of, short_repr
from optid.core.problem import Problem
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.subspace.low_rank import choose_weight, structure
from optid.identify.subspace.plan import Plan, in_record_units, make_plan
from optid.identify.subspace.procedure import SubspaceSteps
from optid.program.solution import Solution, Status
from optid.program.units import energy_unit
from optid.solving.solve import Evidence, Procedure

# weights tried by default, each the inverse of a noise variance relative to the variance of the outputs
WEIGHTS = tuple(float(w) for w in np.logspace(-1, 4, 11))
Pose = Callable[..., Problem]  # (the structured problem of a record, lambda) -> the problem


def fit_low_rank(pose: Pose, steps: SubspaceSteps, data: Data, weight: float | str | Sequence[float],
                 noise: float | None, hold_out: float, **settings: Any) -> Procedure:
    """Choose a weight where there are several, solve the problem, and go on as the other subspace methods.

    Arguments and errors as of `formulations.nuclear_subspace.nuclear`; the settings are those of `make_plan`.
    """
    if not 0 < hold_out < 1:
        raise StructureError(f"hold_out={hold_out!r}: it must be a fraction in (0, 1)")
    plan = make_plan("subspace.nuclear", data, **settings)
    return in_record_units(_fit(pose, steps, plan, _weights(weight, noise), noise, hold_out), plan)


def _weights(weight: float | str | Sequence[float], noise: float | None) -> tuple[float, ...]:
    if noise is not None:
        if not 1 / LARGEST <= noise <= LARGEST or weight != "auto":
            raise StructureError(f"noise={short_repr(noise)} is a positive standard deviation that takes the place of "
                                 "weight=")
        return (1.0,)
    if isinstance(weight, str):
        one_of("weight", weight, ("auto",))
        return WEIGHTS
    found = tuple(float(w) for w in np.atleast_1d(np.asarray(weight, dtype=float)))
    if not found or not all(0 < w < np.inf for w in found):
        raise StructureError(f"weight={weight!r}: give a positive number, several, or 'auto'")
    return found


def _fit(pose: Pose, steps: SubspaceSteps, plan: Plan, weights: tuple[float, ...], noise: float | None, hold_out: float
         ) -> Procedure:
    trials, weight = {}, weights[0]
    if len(weights) > 1:
        weight, nx, trials = yield from choose_weight(plan, weights, hold_out, partial(pose, weight=1.0))
        plan = replace(plan, nx=nx)
    structured = structure(plan)
    if noise is not None:
        weight = float(np.mean(structured.scale)) ** 2 / noise**2 * energy_unit(plan.units)
    solution: Solution = yield pose(structured, structured.penalty(weight))
    if not solution.has_point:
        return Evidence.pointless(solution.status, solution.reason)
    _, sizes = parts = structured.decompose(solution.values)
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
    evidence = yield from steps.run(plan, found)
    if evidence.model is None:
        return evidence
    evidence = replace(evidence, main="low rank", objective=solution.objective, bound=solution.bound or evidence.bound)
    if solution.status in (Status.INACCURATE, Status.LIMIT) and evidence.status.is_optimum:
        evidence = replace(evidence, status=solution.status, reason=f"nuclear-norm programme: {solution.reason}")
    return evidence
