"""Robust losses as reweighted least squares: every pass is a programme over weighted statistics.

Each pass minimises a quadratic that touches the loss at the residuals of the pass before (majorise-minimise), so the
loss never rises. For the convex formulations the weighted residuals of the last pass are a dual point, which gives a
lower bound on the loss itself.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from formulations.equation_error import EquationError
from optid.data import Data
from optid.errors import StructureError, nearest
from optid.program import Program
from optid.regressors import residuals
from optid.solution import Bound, Solution, Status, relative_gap
from optid.solving import Evidence, Procedure
from optid.streams import Stream
from optid.units import in_units

Pose = Callable[[list[np.ndarray] | None], tuple[Program, EquationError]]

HUBER = 1.345  # 95 % efficiency at the Gaussian (Huber 1981)
KINK = 1e-6  # half-width at which the rounded kink of l1 ends, in robust standard deviations
PASSES = 200
SETTLING = 3  # passes in which the robust scale is estimated
CLOSED = 1e-9  # relative gap at which a convex loss needs no further pass


def parse_loss(loss: str) -> tuple[str, float]:
    """Read "squares", "huber", "huber:1.5" or "l1".

    Returns:
        The kind and its threshold in robust standard deviations.

    Raises:
        StructureError: unknown loss or impossible threshold.
    """
    kind, _, number = str(loss).partition(":")
    if kind not in ("squares", "huber", "l1"):
        raise StructureError(f"no loss is called {loss!r}. {nearest(kind, ('squares', 'huber', 'l1'))}")
    if not number:
        return kind, {"huber": HUBER, "l1": KINK}.get(kind, 0.0)
    try:
        threshold = float(number)
    except ValueError:
        threshold = -1.0
    if kind != "huber" or not threshold > 0:
        raise StructureError(f"loss {loss!r}: only huber takes a threshold, a positive number as in huber:1.345")
    return kind, threshold


def degree(loss: str) -> int:
    """Return the degree of a loss in the units of the residuals: 1 for "l1", 2 otherwise."""
    return 1 if parse_loss(loss)[0] == "l1" else 2


def with_loss(loss: str, data: Data | Stream, pose: Pose, *, convex: bool) -> Program | Procedure:
    """Return the plain programme for squares, a procedure of reweighted programmes for the other losses.

    Args:
        loss: see `parse_loss`.
        data: the record.
        pose: weights -> (programme, compressed problem).
        convex: whether a dual bound exists.
    """
    kind, threshold = parse_loss(loss)
    if kind == "squares":
        return pose(None)[0]
    if isinstance(data, Stream):
        raise StructureError(f"loss {loss!r} needs row weights, which a stream larger than memory does not keep; "
                             "use loss='squares' or read the record")
    return _reweighted(data, pose, kind, threshold, convex)


def _reweighted(data: Data, pose: Pose, kind: str, threshold: float, convex: bool) -> Procedure:
    program, problem = pose(None)
    record = in_units(data, problem.units)
    scale, unweighted = program.scale, problem.statistics  # the weights of a pass are no unit of the data
    weights: list[np.ndarray] | None = None
    spread = width = 0.0
    final, best, gap = False, np.inf, np.inf
    for step in range(PASSES):
        solution: Solution = yield program
        if not solution.has_point:
            return None
        sizes = _row_sizes(record, problem, solution)
        if step < SETTLING:  # the scale settles before the loss is fixed; afterwards the objective cannot rise
            spread = max(float(np.nanmedian(np.concatenate(sizes))) / 0.6745, 1e-300)
            width = spread * (1.0 if kind == "l1" else threshold)
        elif kind == "l1" and weights is not None and _steady(sizes, weights):
            width = max(width / 3, spread * threshold)  # the kink sharpens as the rounded problem is solved
        found = _evidence(program, solution, sizes, weights, kind, width, convex)
        stalled = final and best - found.objective <= 1e-12 * max(abs(found.objective), 1e-300)
        now = relative_gap(found.objective, found.bound.value, scale * program.unit)
        if (convex and step >= SETTLING and now <= CLOSED) or (stalled and not now < 0.9 * gap):
            break
        best, gap = min(best, found.objective) if final else np.inf, now
        final = step >= SETTLING and width <= spread * threshold
        weights = [_weights(r, kind, width) for r in sizes]
        program, problem = pose(weights)
        # the answer of the pass before is the best start, and no proof belongs to a weighted pass
        start = dict(solution.values) if step else program.start
        program = replace(program, start=start, certify=None, scale=scale,
                          compressed=replace(problem, unweighted=unweighted))
    return found


def _steady(sizes: list[np.ndarray], weights: list[np.ndarray]) -> bool:
    """Whether no residual has outgrown by much the weight it was given."""
    return all(float(np.nanmax(2 * w * r, initial=0.0)) < 1.03 for w, r in zip(weights, sizes))


def _row_sizes(data: Data, problem: EquationError, solution: Solution) -> list[np.ndarray]:
    """Euclidean size of the residual of every row (over the outputs), NaN where a row is not used."""
    theta = problem.regression(solution.values)
    return [np.sqrt(np.sum(r * r, axis=1)) for r in residuals(data, problem.layout, theta)]


def _loss(sizes: np.ndarray, kind: str, width: float) -> float:
    if kind == "l1":
        return float(np.sum(sizes))
    return float(np.sum(np.where(sizes <= width, sizes**2, 2 * width * sizes - width**2)))


def _weights(sizes: np.ndarray, kind: str, width: float) -> np.ndarray:
    safe = np.maximum(np.nan_to_num(sizes), width)
    return width / safe if kind == "huber" else 0.5 / safe


def _evidence(program: Program, solution: Solution, sizes: list[np.ndarray], weights: list[np.ndarray] | None,
              kind: str, width: float, convex: bool) -> Evidence:
    """Objective in the loss itself, and the bound that the weighted residuals of the pass give."""
    pooled, w = np.concatenate(sizes), np.concatenate(weights or [np.ones_like(r) for r in sizes])
    keep = ~np.isnan(pooled)
    pooled, w = pooled[keep], w[keep]
    unit = program.unit
    penalty = max(0.0, solution.objective / unit - float(np.sum(w * pooled**2)))
    objective = _loss(pooled, kind, width) + penalty
    model = program.recover(solution.values)
    if not convex:
        bound = Bound.none(f"the exact form with the {kind} loss has no proof")
        return Evidence(model, unit * objective, bound, _settled(solution), bound.reason)
    limit = 2 * width if kind == "huber" else 1.0
    dual = 2 * w * pooled  # satisfies the stationarity of the weighted pass, hence of the dual, exactly
    shrink = min(1.0, limit / max(float(np.max(dual, initial=0.0)), 1e-300))
    conjugate = float(np.sum(dual**2)) / 4 if kind == "huber" else 0.0
    value = shrink * float(dual @ pooled) - shrink**2 * conjugate + shrink * penalty
    gap = relative_gap(objective, value, program.scale)
    proved = gap < 1e-6
    bound = Bound(unit * value, proved, f"{kind} dual", f"dual point of the last pass, gap {gap:.1e}")
    status = Status.OPTIMAL if proved and _settled(solution) is Status.LOCAL else _settled(solution)
    return Evidence(model, unit * objective, bound, status, bound.reason)


def _settled(solution: Solution) -> Status:
    return Status.LOCAL if solution.status in (Status.OPTIMAL, Status.LOCAL) else solution.status
