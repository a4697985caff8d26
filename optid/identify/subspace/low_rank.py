"""A fit by the nuclear norm: the low-rank problem of a record, its weight, and the steps of the other methods."""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import LARGEST, Array, one_of, short_repr
from optid.core.problem import Problem
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError
from optid.identify.subspace.observability import Observability, Windows
from optid.identify.subspace.plan import Plan, in_record_units, make_plan
from optid.identify.subspace.procedure import SubspaceSteps
from optid.identify.subspace.projection import realise
from optid.identify.validation.predictions import MEASURED, SIMULATION, prediction_fit
from optid.program.solution import Solution, Status
from optid.program.units import energy_unit
from optid.solving.solve import Evidence, Procedure
from optid.statistics.expansion import check_channels
from optid.structures.nuclear_norm import KnownSignals, NuclearProblem, window_starts

Values = Mapping[str, Array]

RANK, NOTHING = 1e-3, 1e-5  # singular values below this part of the largest, of that of measured outputs, are none
HIGHEST = 10  # order at most where it is chosen
SAMPLES = 4000  # outputs at most: the cube of their number is what a decomposition costs
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


@dataclass(frozen=True, eq=False)
class Structured:
    """The structured problem of a record, in outputs of mean zero and unit variance."""

    windows: Windows  # the record
    problem: NuclearProblem  # the numbers
    centre: Array  # (l,) subtracted from the outputs
    scale: Array  # (l,) by which they were divided
    size: float  # largest singular value of the matrix of the measured outputs

    def rank(self, sizes: Array) -> int:
        """Return the number of significant singular values."""
        return int(np.sum((sizes > RANK * sizes[0]) & (sizes > NOTHING * self.size)))

    def order(self, sizes: Array) -> int:
        """Return the rank, one at least, `HIGHEST` and what the block rows can carry at most."""
        return int(np.clip(self.rank(sizes), 1, min(HIGHEST, self.problem.rows - 1)))

    def in_units(self, view: Mapping[str, Any], _: Values) -> dict[str, Any]:
        """Return the expression ``output``: yhat in units of the record, beside the unknowns themselves."""
        shape = (len(self.problem.y), 1)
        return {"output": cp.multiply(view["yhat"], np.tile(self.scale, shape)) + np.tile(self.centre, shape)}

    def penalty(self, weight: float) -> float:
        """Return lambda for a weight: the inverse noise variance times the size per output sample."""
        return weight * self.size / max(int(np.sum(self.problem.known)), 1)

    def decompose(self, values: Values) -> tuple[Array, Array]:
        """Return the left singular vectors, weights undone, in units of the outputs, and the singular values."""
        problem = self.problem
        theta = np.asarray(values["T"]) if "T" in values else np.zeros((0, problem.l))
        left, sizes, _ = np.linalg.svd(problem.matrix(np.asarray(values["yhat"]), theta), full_matrices=False)
        if problem.left is not None:
            left = np.linalg.solve(problem.left, left)
        return left * np.tile(self.scale, problem.rows)[:, None], sizes

    def observability(self, values: Values, parts: tuple[Array, Array], nx: int) -> Observability:
        """Return the observability matrix of a decomposed point, in coordinates with states of about unit size.

        The predictor form gives that of (A - K C, C); the Markov parameters of K are in T.
        """
        vectors, sizes = parts
        found = vectors[:, :nx] * np.sqrt(sizes[:nx]) / self.problem.shape[1] ** 0.25
        predictor, l = self.problem.predictor, self.problem.l  # noqa: E741
        if predictor is None:
            return Observability(self.windows, found, self.scale)
        inner, c = realise(found, l)
        k, signal = predictor.places.T
        first = predictor.windows.shape[1] - l  # the outputs come last
        theta = np.asarray(values["T"])[: len(k)]
        markov = [theta[(k == lag) & (signal >= first)].T for lag in range(1, self.problem.rows)]
        stacked = np.vstack([self.scale[:, None] * block / self.scale for block in markov])
        gain = np.linalg.lstsq(found[:-l], stacked, rcond=None)[0]
        a, blocks = inner + gain @ c, [c]
        for _ in range(self.problem.rows - 1):
            blocks.append(blocks[-1] @ a)
        return Observability(self.windows, np.vstack(blocks), self.scale)


def choose_weight(plan: Plan, weights: tuple[float, ...], hold_out: float, pose: Callable[[Structured], Problem]
                  ) -> Generator[Problem, Solution, tuple[float, int | str, dict[str, Any]]]:
    """Return the weight, and where it is free the order, with the best simulation of the parts held out, and figures.

    ``hold_out`` is a fraction of every experiment; ``pose`` states the problem, with a penalty called "weight".
    """
    part, rest = plan.data.split(1 - hold_out)
    structured, trials = structure(replace(plan, data=part, block_rows=Windows.of(plan).alpha)), []
    problem = pose(structured)
    for weight in weights:
        problem = problem.under_weights(weight=structured.penalty(weight)).beginning(problem.start)
        solution = yield problem
        if solution.has_point:
            problem = problem.beginning({name: solution.values[name] for name in problem.start})
            scores = order_scores(structured, solution.values, rest)
            trials += [(score, weight, nx) for nx, score in scores.items()]
    if not trials:
        return weights[-1], plan.nx, {"weights tried": len(weights)}
    score, weight, nx = max(trials)
    return weight, nx, {"weights tried": len(weights), "simulation fit on the part held out in %": score}


def order_scores(structured: Structured, values: Values, rest: Data) -> dict[int, float]:
    """Return the simulation fit in %, on another record, of the models of a point, by order: as given, or all."""
    order, parts, found = structured.windows.plan.order, structured.decompose(values), {}
    most = min(structured.rank(parts[1]), structured.problem.rows - 1)
    for nx in range(1, min(most, HIGHEST) + 1) if order is None else [order] * (order <= most):
        try:
            score = held_out_fit(structured.observability(values, parts, nx).model(), rest)
        except (RankError, DataError):  # an order this part of the record cannot carry is no candidate
            continue
        if np.isfinite(score):
            found[nx] = score
    return found


def held_out_fit(model: Any, data: Data) -> float:
    """Return the mean simulation fit in % over the outputs, with measured feedback if there is any; NaN without one."""
    return float(np.mean(prediction_fit(model, data, MEASURED if model.feedback else SIMULATION)))


def structure(plan: Plan) -> Structured:
    """Build the structured problem of the record of a plan, whose instruments word is the form.

    Feedback in a form other than "predictor", a record too long (`StructureError`), too few usable windows and channels
    that depend on others (`RankError`) are refused.
    """
    windows = Windows.of(plan)
    check_channels(plan.records, plan.data.inputs, plan.data.outputs)
    expansion, alpha, form = windows.expansion, windows.alpha, plan.instruments
    l = expansion.l  # noqa: E741
    if form != "predictor" and expansion.q:
        raise StructureError(f"form={form!r} projects on the complement of the inputs, which outputs that are fed back "
                             "do not allow: use form='predictor'")
    y = np.concatenate([record[:, expansion.m :] for record in plan.records])
    if y.size > SAMPLES:
        raise StructureError(f"{y.size} output samples: the nuclear-norm subspace method is for short records, up to "
                             f"{SAMPLES}. Use hammerstein_ss.asivid or a part of the record")
    centre = np.nanmean(y, axis=0) if plan.offset else np.zeros(l)
    scale = np.nanstd(y, axis=0) if plan.offset else np.sqrt(np.nanmean(y**2, axis=0))
    signals = np.concatenate([expansion(record) for record in plan.records])
    signals = signals[:, list(expansion.eta) + (list(expansion.zeta) + list(expansion.y)) * (form == "predictor")]
    if form == "predictor":
        signals[:, -l:] = (signals[:, -l:] - centre) / scale
    usable = ~np.isnan(signals).any(axis=1)
    past = alpha if form == "instruments" else 0
    lengths = [len(record) for record in plan.records]
    starts = window_starts(lengths, alpha + past, np.split(usable, np.cumsum(lengths)[:-1])) + past
    rows = expansion.p * alpha + 1 + (alpha * l if past else 0)
    if len(starts) <= rows:
        gaps = any(plan.data.missing[name] for name in plan.data.outputs) and form == "predictor"
        remedy = ", or form='projection', whose windows may lack outputs" if gaps and not expansion.q else ""
        raise RankError(f"{len(starts)} usable windows of {alpha + past} samples for {rows} known rows: use a longer "
                        f"record, fewer block rows or fewer functions{remedy}")
    outputs = (y - centre) / scale
    known = np.stack([signals[starts + i].T for i in range(alpha)])
    problem = NuclearProblem(outputs, starts, alpha)
    if form == "predictor":
        direct = np.repeat([*plan.direct(), False], [*expansion.input_sizes, expansion.q + l])
        problem = replace(problem, predictor=KnownSignals(known, direct, plan.offset))
    else:
        known = known.reshape(-1, len(starts))
        known = np.vstack([known, np.ones(len(starts))]) if plan.offset else known
        problem = _weighted(problem, known, np.nan_to_num(np.hstack([signals, outputs])) if past else None)
    measured = problem.matrix(problem.data, problem.predictor_coefficients(problem.hankel(problem.data)))
    return Structured(windows, problem, centre, scale, float(np.linalg.norm(measured, 2)))


def _weighted(problem: NuclearProblem, known: Array, instruments: Array | None) -> NuclearProblem:
    """Return the problem with its projection and, with instruments, the weights of the instrumental-variable method."""
    basis, sizes, _ = np.linalg.svd(known.T, full_matrices=True)
    rank = int(np.sum(sizes > 1e-10 * sizes[0]))
    if instruments is None:
        return replace(problem, right=basis[:, rank:])
    starts, alpha = problem.starts, problem.rows
    past = np.concatenate([instruments[starts - alpha + i].T for i in range(alpha)])
    future = replace(problem, left=None, right=basis[:, rank:]).hankel(problem.data)
    count = len(starts)
    right = basis[:, rank:] @ (basis[:, rank:].T @ past.T) @ _inverse_root(past @ past.T / count) / count
    return replace(problem, left=_inverse_root(future @ future.T / count), right=right)


def _inverse_root(gram: Array) -> Array:
    values, vectors = np.linalg.eigh(gram)
    values = np.maximum(values, 1e-10 * values[-1])
    return (vectors / np.sqrt(values)) @ vectors.T
