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

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.subspace_plan import Plan, in_record_units, planned
from formulations.subspace_procedure import completed, preliminary, prepared
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError
from optid.identify.arguments import one_of
from optid.identify.design.expansion import Bases, FeedbackBases
from optid.identify.subspace.realisation import realise
from optid.identify.validation import fit_percent
from optid.program.program import Program, Values
from optid.program.solution import Bound, Solution, Status, relative_gap
from optid.program.units import energy_unit
from optid.program.view import View
from optid.solving.solve import Evidence, Procedure
from optid.statistics.expansion import Expansion
from optid.structures.nuclear_norm import NuclearNormStructure, NuclearProblem, Predictor, window_starts

FORMS = ("predictor", "projection", "instruments")
WEIGHTS = tuple(float(w) for w in np.logspace(-1, 4, 11))
"""Weights tried by default, each the inverse of a noise variance relative to the variance of the outputs."""

RANK = 1e-3  # singular values below this part of the largest are none
NOTHING = 1e-5  # of the largest singular value of the measured outputs' matrix
LARGEST = 10  # order at most where it is chosen
SAMPLES = 4000  # outputs at most: the cube of their number is what a decomposition costs


@dataclass(frozen=True, eq=False)
class Structured:
    """The structured problem of a record, in outputs of mean zero and unit variance.

    Attributes:
        problem: the numbers.
        centre: (l,) subtracted from the outputs.
        scale: (l,) by which they were divided.
        size: largest singular value of the matrix of the measured outputs.
    """

    problem: NuclearProblem
    centre: np.ndarray
    scale: np.ndarray
    size: float

    @property
    def floor(self) -> float:
        """Singular values below it are none: a weight so small that nothing is left of the matrix has rank zero."""
        return NOTHING * self.size

    def penalty(self, weight: float) -> float:
        """Return lambda for a weight: the inverse noise variance times the size per output sample."""
        return weight * self.size / max(int(np.sum(self.problem.known)), 1)

    def decomposed(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        """Return the left singular vectors, weights undone, in units of the outputs, and the singular values."""
        problem = self.problem
        theta = np.asarray(values["T"]) if "T" in values else np.zeros((0, problem.l))
        left, sizes, _ = np.linalg.svd(problem.matrix(np.asarray(values["yhat"]), theta), full_matrices=False)
        if problem.left is not None:
            left = np.linalg.solve(problem.left, left)
        return left * np.tile(self.scale, problem.rows)[:, None], sizes

    def gamma(self, vectors: np.ndarray, sizes: np.ndarray, nx: int, values: Values) -> np.ndarray:
        """Return the observability matrix (rows l, nx) of (A, C) in coordinates with states of about unit size.

        What the predictor form leaves is that of (A - K C, C), and the Markov parameters of K stand in T.
        """
        found = vectors[:, :nx] * np.sqrt(sizes[:nx]) / self.problem.shape[1] ** 0.25
        predictor, l = self.problem.predictor, self.problem.l  # noqa: E741
        if predictor is None:
            return found
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
        return np.vstack(blocks)


def nuclear(
    data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "linear",
    feedback_basis: FeedbackBases = None, form: str = "predictor", weight: float | str | Sequence[float] = "auto",
    noise: float | None = None, hold_out: float = 0.3, offset: bool = True,
    feedthrough: bool | Sequence[bool] = True, observer: str = "auto", split: str = "exact", stability: str = "auto",
    constraints: Sequence[Any] = ()
) -> Procedure:
    """Identify a state-space model from a low-rank Hankel matrix found by convex optimisation.

    Named variables: ``output``, ``yhat``.

    Args:
        data: the record; missing outputs are estimated, windows with missing inputs left out.
        nx: order, or "auto": chosen with the weight by simulation of the parts held out; with one weight, the number
            of singular values above a thousandth of the largest, at most ten.
        block_rows: block rows, more than the order. None chooses.
        basis: basis of the input nonlinearity, one per input or one for all; linear by default.
        feedback_basis: basis of the feedback, None for none; needs form "predictor".
        form: "predictor", "projection" or "instruments".
        weight: weight of the misfit, or several, or "auto": the one that simulates the last part of every experiment
            best. It is the inverse of the noise variance relative to the variance of the outputs.
        noise: standard deviation of the noise in units of the output, instead of a weight (one output, or outputs of
            one size).
        hold_out: part of every experiment kept back to choose a weight.
        offset: as in `formulations.hammerstein_ss.sid`.
        feedthrough: as there.
        observer: as there.
        split: as there.
        stability: as there.
        constraints: rules about poles and about coefficients, as there.

    Raises:
        StructureError: words or orders that do not fit, or a record too long for the method.
        RankError: the record does not determine the model.
        DataError: a channel that is constant.
    """
    one_of("form", form, FORMS)
    if not 0 < hold_out < 1:
        raise StructureError(f"hold_out={hold_out!r}: a fraction in (0, 1) is needed")
    plan = planned("subspace.nuclear", data, nx, block_rows, basis, feedback_basis, form, offset=offset,
                   feedthrough=feedthrough, observer=observer, split=split, stability=stability,
                   constraints=tuple(constraints))
    weights = _weights(weight, noise)
    return in_record_units(_procedure(plan, weights, noise, hold_out), plan)


def _weights(weight: float | str | Sequence[float], noise: float | None) -> tuple[float, ...]:
    if noise is not None:
        if not noise > 0 or weight != "auto":
            raise StructureError(f"noise={noise!r} is a positive standard deviation that takes the place of weight=")
        return (1.0,)
    if isinstance(weight, str):
        one_of("weight", weight, ("auto",))
        return WEIGHTS
    found = tuple(float(w) for w in np.atleast_1d(np.asarray(weight, dtype=float)))
    if not found or not all(0 < w < np.inf for w in found):
        raise StructureError(f"weight={weight!r}: a positive number, several, or 'auto'")
    return found


def _procedure(plan: Plan, weights: tuple[float, ...], noise: float | None, hold_out: float) -> Procedure:
    trials, weight = {}, weights[0]
    if len(weights) > 1:
        weight, nx, trials = yield from _chosen(plan, weights, hold_out)
        plan = replace(plan, nx=nx)
    expansion, alpha = prepared(plan)
    structured = structure(plan, expansion, alpha)
    if noise is not None:
        weight = float(np.mean(structured.scale)) ** 2 / noise**2 * energy_unit(plan.units)
    program = nuclear_programme(structured, structured.penalty(weight), plan.units)
    solution = yield program
    if not solution.has_point:
        return Evidence.pointless(solution.status, solution.reason)
    vectors, sizes = structured.decomposed(solution.values)
    rank = rank_of(sizes, structured.floor)
    nx = plan.order or order_of(sizes, alpha - 1, structured.floor)
    if nx > rank:
        return Evidence.pointless(Status.FAILED, f"order {nx}, but the low-rank matrix has rank {rank} at this weight: "
                                                 "use a larger weight or a smaller order")
    figures = {"order": nx, "block rows": alpha, "form": plan.instruments, "singular values": sizes, **trials,
               "weight": weight, "lambda": structured.penalty(weight), "rank": rank,
               "objective of the convex programme": solution.objective,
               "its dual bound": -np.inf if solution.bound is None else solution.bound.value,
               "its relative gap": solution.gap,
               "missing outputs estimated": int(np.sum(~structured.problem.known))}
    evidence = yield from completed(plan, plan.records, expansion,
                                    structured.gamma(vectors, sizes, nx, solution.values), structured.scale, figures)
    if solution.status in (Status.INACCURATE, Status.LIMIT) and evidence.status in (Status.LOCAL, Status.OPTIMAL):
        evidence = replace(evidence, status=solution.status, reason=f"nuclear-norm programme: {solution.reason}")
    return evidence


def _chosen(plan: Plan, weights: tuple[float, ...], hold_out: float
            ) -> Generator[Program, Solution, tuple[float, int | str, dict[str, Any]]]:
    """Choose the weight, and where it is free the order, whose model simulates the parts held out best."""
    part, rest = plan.data.split(1 - hold_out)
    train = replace(plan, data=part)
    expansion, alpha = prepared(replace(train, block_rows=prepared(plan)[1]))
    structured = structure(train, expansion, alpha)
    trials: list[tuple[float, float, int]] = []
    program = nuclear_programme(structured, 1.0, plan.units)
    for weight in weights:
        program.parameters["weight"].value = structured.penalty(weight)
        solution = yield program
        if solution.has_point:
            program = replace(program, start={name: solution.values[name] for name in program.start})
            trials += [(score, weight, nx) for nx, score in
                       order_scores(train, expansion, structured, solution.values, rest).items()]
    if not trials:
        return weights[-1], plan.nx, {"weights tried": len(weights)}
    score, weight, nx = max(trials)
    return weight, nx, {"weights tried": len(weights), "simulation fit on the part held out in %": score}


def order_scores(plan: Plan, expansion: Expansion, structured: Structured, values: Values, rest: Data
                 ) -> dict[int, float]:
    """Return the simulation fit in % on another record of the model of every order that a point allows.

    Args:
        plan: what was asked for; with an order, that one alone.
        expansion: the signals of its record.
        structured: the problem.
        values: a point of its programme.
        rest: the other record.
    """
    vectors, sizes = structured.decomposed(values)
    most = min(rank_of(sizes, structured.floor), structured.problem.rows - 1)
    orders = range(1, min(most, LARGEST) + 1) if plan.order is None else [plan.order] * (plan.order <= most)
    found = {}
    for nx in orders:
        try:
            gamma = structured.gamma(vectors, sizes, nx, values)
            model = preliminary(plan, plan.records, expansion, gamma, structured.scale)
            found[nx] = held_out_fit(model, rest)
        except (RankError, DataError):  # an order this part of the record cannot carry is no candidate
            continue
    return {nx: score for nx, score in found.items() if np.isfinite(score)}


def held_out_fit(model: Any, data: Data) -> float:
    """Mean simulation fit in % over the outputs, initial states fitted; with feedback that of measured outputs."""
    simulate = model.simulate_measured_feedback if model.feedback else model.simulate
    found = simulate(data, x0="fit")
    several = found if isinstance(found, tuple | list) else [found]
    return float(np.mean(fit_percent(np.vstack([e.y for e in data.experiments]), np.vstack(several))))


def rank_of(sizes: np.ndarray, floor: float = 0.0) -> int:
    """Return the number of singular values above a thousandth of the largest and above a floor."""
    return int(np.sum((sizes > RANK * sizes[0]) & (sizes > floor)))


def order_of(sizes: np.ndarray, most: int, floor: float = 0.0) -> int:
    """Return the rank, one at least, `LARGEST` at most."""
    return int(np.clip(rank_of(sizes, floor), 1, min(LARGEST, most)))


def structure(plan: Plan, expansion: Expansion, alpha: int) -> Structured:
    """Build the structured problem of a record.

    Args:
        plan: what was asked for; its instruments word is the form.
        expansion: the signals.
        alpha: number of block rows.

    Raises:
        StructureError: feedback in a form other than "predictor", or a record too long.
        RankError: too few usable windows.
    """
    l, form = expansion.l, plan.instruments  # noqa: E741
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
    windows = np.stack([signals[starts + i].T for i in range(alpha)])
    problem = NuclearProblem(outputs, starts, alpha)
    if form == "predictor":
        direct = np.repeat([*plan.direct(), False], [*expansion.input_sizes, expansion.q + l])
        problem = replace(problem, predictor=Predictor(windows, direct, plan.offset))
    else:
        known = windows.reshape(-1, len(starts))
        known = np.vstack([known, np.ones(len(starts))]) if plan.offset else known
        problem = _weighted(problem, known, np.nan_to_num(np.hstack([signals, outputs])) if past else None)
    measured = problem.matrix(problem.data, problem.explained(problem.hankel(problem.data)))
    return Structured(problem, centre, scale, float(np.linalg.norm(measured, 2)))


def _weighted(problem: NuclearProblem, known: np.ndarray, instruments: np.ndarray | None) -> NuclearProblem:
    """Put the projection and, with instruments, the weights of the instrumental-variable method in place."""
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


def _inverse_root(gram: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(gram)
    values = np.maximum(values, 1e-10 * values[-1])
    return (vectors / np.sqrt(values)) @ vectors.T


def nuclear_programme(structured: Structured, penalty: float, units: Transform | None = None) -> Program:
    """Pose the convex programme.

    Named variables: ``yhat`` (samples, l), outputs of mean zero and unit variance, and, in predictor form, ``T``, one
    column per output. The expression ``output`` is yhat in units of the data.

    Args:
        structured: the numbers.
        penalty: lambda.
        units: from those of ``structured`` to those of the record.
    """
    problem = structured.problem
    yhat = cp.Variable(problem.y.shape, name="yhat")
    flat = cp.vec(yhat, order="C")
    matrix: Any = cp.reshape(flat[problem.index.ravel(order="F")], problem.index.shape, order="F")
    matrix = matrix if problem.left is None else problem.left @ matrix
    matrix = matrix if problem.right is None else matrix @ problem.right
    start: dict[str, np.ndarray] = {"yhat": problem.data}
    variables: dict[str, cp.Variable] = {"yhat": yhat}
    if problem.predictor is not None:
        variables["T"] = cp.Variable((problem.parameters, problem.l), name="T")
        matrix = matrix - _explained(problem, problem.predictor, variables["T"])
        start["T"] = problem.explained(problem.hankel(problem.data))
    known = np.flatnonzero(problem.known.ravel())
    misfit = flat[known] - problem.data.ravel()[known]
    inner = cp.Variable(problem.shape, name="X")
    residual = cp.Variable(known.size, name="residual")
    weight = cp.Parameter(nonneg=True, name="weight", value=penalty)
    constraints = {"structure": (inner == matrix,), "residual": (residual == misfit,)}
    view = View({"yhat": yhat, "output": cp.multiply(yhat, np.tile(structured.scale, (len(problem.y), 1)))
                 + np.tile(structured.centre, (len(problem.y), 1))}, units=units)
    return Program(
        "subspace.nuclear", cp.Minimize(cp.normNuc(inner) + weight * cp.sum_squares(residual)), constraints,
        {**variables, "X": inner, "residual": residual}, start, structured.decomposed, view,
        structural=frozenset(constraints), parameters={"weight": weight},
        derived={"X": matrix, "residual": misfit}, structure=NuclearNormStructure(problem),
        certify=partial(certify, problem),
        scale=penalty * float(np.sum(problem.data**2)))


def _explained(problem: NuclearProblem, predictor: Predictor, theta: cp.Variable) -> Any:
    """``T(theta) Phi`` plus constants as an expression: one regression matrix serves all outputs."""
    regressors = np.stack([predictor.apply(column[:, None]).ravel() for column in np.eye(predictor.size)], axis=1)
    l, (rows, j) = problem.l, (problem.rows, len(problem.starts))  # noqa: E741
    flat = cp.vec(regressors @ theta, order="C")  # by block row, window, output
    where = (np.arange(rows)[:, None, None] * j + np.arange(j)[None, None, :]) * l + np.arange(l)[None, :, None]
    return cp.reshape(flat[where.reshape(rows * l, j).ravel(order="F")], (rows * l, j), order="F")


def certify(problem: NuclearProblem, program: Program, values: Values, duals: Values) -> tuple[Bound, None]:
    """Return the dual bound, recomputed from a feasible dual point near the multipliers, or near the subgradient."""
    if program.user_constraints:
        return Bound.none("the dual bound is that of the programme without constraints"), None
    penalty = float(np.asarray(program.parameters["weight"].value))
    program.assign({name: values[name] for name in values if name not in program.derived})
    objective = float(np.asarray(program.objective.expr.value))
    candidates = []
    if "structure" in duals:
        candidates.append(-np.reshape(duals["structure"], problem.shape, order="F"))
    left, _, right = np.linalg.svd(np.asarray(program.variables["X"].value), full_matrices=False)
    candidates.append(left @ right)
    bounds = [problem.dual(candidate, penalty) for candidate in candidates]
    value, point = max(bounds, key=lambda pair: pair[0])
    gap = relative_gap(objective, value, program.scale)
    return Bound(value, gap < 1e-6, "nuclear dual", f"feasible dual point, relative gap {gap:.1e}",
                 multipliers=point), None
