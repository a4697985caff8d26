"""Robust losses as reweighted least squares: every pass is a programme over weighted statistics.

Each pass minimises a quadratic that majorises the loss at the residuals of the pass before, so the loss never rises.
For the convex formulations the weighted residuals of the last pass are a dual point, which gives a lower bound on the
loss itself.

A robust loss bounds the influence of a disturbance, not that of an outlier in an output: as a past output it is a
leverage point in the next ``na`` rows (Hampel et al., Robust Statistics, 1986, section 6.1; Maronna, Martin and Yohai,
Robust Statistics, 2006, section 8.4). Rows that contain an outlier, found in the record or by the residuals of a robust
fit, are therefore left out, as if it were missing; findings and figures list them. Loss, bound and one-step fit are
those of the remaining rows. ``loss="squares"`` leaves nothing out.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from optid.core.problem import Problem
from optid.core.statement import for_solvers
from optid.core.terms import Values
from optid.data.levels import remove_levels
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import StructureError, nearest
from optid.identify.equation_error.compression import EquationError, EquationStructure, compress
from optid.identify.outliers import MOST, NORMAL_MEDIAN, find_additive_outliers, find_outliers
from optid.identify.record_checks import BY_RESIDUALS, EXAMINED, LeftOut
from optid.program.solution import Bound, Solution, Status, relative_gap
from optid.program.units import in_units
from optid.solving.solve import Evidence, Procedure
from optid.statistics import Layout, residuals

HUBER = 1.345  # 95 % efficiency at the Gaussian (Huber 1981)
KINK = 1e-6  # half-width at which the rounded kink of l1 ends, in robust standard deviations
PASSES = 200
SETTLING = 3  # passes in which the robust scale is estimated
IDLE = 3  # passes without a smaller objective or a better bound: a solver's multipliers vary from pass to pass
CLOSED = 1e-9  # relative gap at which a convex loss needs no further pass


def parse_loss(loss: str) -> tuple[str, float]:
    """Return the kind and the threshold, in robust standard deviations, of "squares", "huber", "huber:1.5" or "l1".

    An unknown loss or an impossible threshold is a `StructureError`.
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
    if kind != "huber" or not 0 < threshold < np.inf:
        raise StructureError(f"loss {loss!r}: only huber takes a threshold, a positive number as in huber:1.345")
    return kind, threshold


def pose_with_loss(loss: str, data: Data | Stream, pose: Callable[[EquationError], Problem], *, convex: bool,
                   **words: Any) -> Any:
    """Return the plain problem for squares, a procedure of reweighted programmes for the other losses.

    Args:
        loss: see `parse_loss`.
        data: the record.
        pose: states the problem of a compressed record.
        convex: whether a dual bound exists.
        words: of an `EquationStructure`.
    """
    kind, threshold = parse_loss(loss)
    structure = EquationStructure(**words, degree=1 if kind == "l1" else 2)
    if kind == "squares":
        return pose(compress(data, structure))
    if structure.prior != "none":
        raise StructureError(f"loss {loss!r}: a prior takes its strength from the likelihood of Gaussian noise; use "
                             "loss='squares', or prior='none' with a ridge")
    if isinstance(data, Stream):
        raise StructureError(f"loss {loss!r} needs row weights, which a stream larger than memory does not keep; "
                             "use loss='squares' or read the record")
    return _reweighted(data, pose, structure, kind, threshold, convex)


def _reweighted(data: Data, pose: Callable[[EquationError], Problem], structure: EquationStructure, kind: str,
                threshold: float, convex: bool) -> Procedure:
    whole = compress(data, structure)
    record = data if whole.shifts is None else remove_levels(data)[0]
    used = _Rows(in_units(record, whole.units), whole.layout)

    def step(problem: EquationError) -> Problem:
        return for_solvers(replace(pose(problem), step=True))

    problem, base = whole, step(whole)
    scale = base.scale  # the weights of a pass are no unit of the data

    def weighted_program(sizes: list[np.ndarray], start: Values) -> tuple[Problem, list[np.ndarray]]:
        """Return the programme and the weights of a pass, which starts from the solution of the pass before."""
        weights = used.only(_weights(r, kind, width) for r in sizes)
        compressed = replace(compress(data, structure, weights=weights), unweighted=problem.statistics,
                             between=problem.between)
        return for_solvers(replace(pose(compressed), scale=scale, step=True)).beginning(start), weights

    while True:
        if used.count:
            problem = compress(data, structure, weights=used.only(np.ones(e.n_samples) for e in data.experiments))
            base = step(problem)
            scale = base.scale
        program, weights, spread, width = base, [], 0.0, 0.0
        for _ in range(SETTLING):  # the scale settles before the loss is fixed; afterwards the objective cannot rise
            solution: Solution = yield program
            if not solution.has_point:
                return None
            errors = used.residuals(problem, solution)
            spread = max(float(np.nanmedian(np.concatenate(_sizes(errors)))) / NORMAL_MEDIAN, 1e-300)
            width = spread * (1.0 if kind == "l1" else threshold)
            program, weights = weighted_program(_sizes(errors), dict(solution.values) if weights else base.start)
        if not used.leave_out(errors, problem.regression(solution.values)):
            break
    best = gap = np.inf
    idle, final = 0, width <= spread * threshold
    for _ in range(PASSES):
        solution = yield program
        if not solution.has_point:
            return None
        sizes = _sizes(used.residuals(problem, solution))
        # no residual has outgrown by much the weight it was given
        if kind == "l1" and all(float(np.nanmax(2 * w * r, initial=0.0)) < 1.03 for w, r in zip(weights, sizes)):
            width = max(width / 3, spread * threshold)  # the kink sharpens as the rounded problem is solved
        found = _evidence(program, solution, sizes, weights, kind, width, convex)
        stalled = final and best - found.objective <= 1e-12 * max(abs(found.objective), 1e-300)
        now = relative_gap(found.objective, found.bound.value, scale * program.unit)
        idle = idle + 1 if stalled and not now < 0.9 * gap else 0
        if (convex and now <= CLOSED) or idle == (IDLE if convex else 1):
            break
        best, gap = min(best, found.objective) if final else np.inf, now
        final = width <= spread * threshold
        program, weights = weighted_program(sizes, dict(solution.values))
    return replace(found, figures=used.figures(kind, problem.units.y_scale[0] * width))


class _Rows:
    """The rows of a record without those that contain an outlier as output or as past output."""

    def __init__(self, data: Data, layout: Layout) -> None:
        self._data, self._layout = data, layout
        self._outliers = [np.zeros(e.y.shape, dtype=bool) for e in data.experiments]
        for o in range(layout.l):
            for mask, samples in zip(self._outliers, find_outliers([e.y[:, o] for e in data.experiments])):
                mask[samples, o] = True
        self._examined = [mask.copy() for mask in self._outliers]

    @property
    def count(self) -> int:
        """Number of outliers."""
        return sum(int(mask.sum()) for mask in self._outliers)

    def only(self, weights: Iterable[np.ndarray]) -> list[np.ndarray]:
        """Return weights with zeros in the rows that do not count."""
        return [w * ~touched for w, touched in zip(weights, self._touched())]

    def _touched(self) -> list[np.ndarray]:
        return [np.convolve(np.any(mask, axis=1), np.ones(self._layout.na + 1))[: len(mask)] > 0
                for mask in self._outliers]

    def residuals(self, problem: EquationError, solution: Solution) -> list[np.ndarray]:
        """Return the one-step residuals (N, l), NaN in rows that do not count."""
        theta = problem.regression(solution.values)
        errors = residuals(self._data, self._layout, theta)
        if problem.means is not None:
            beyond = problem.means.constants(theta) - theta[self._layout.offset]
            errors = [e - level for e, level in zip(errors, beyond)]
        for error, touched in zip(errors, self._touched()):
            error[touched] = np.nan
        return errors

    def leave_out(self, errors: list[np.ndarray], theta: np.ndarray) -> bool:
        """Leave out the outliers by these residuals; return whether there are any."""
        na, l = self._layout.na, self._layout.l  # noqa: E741
        spread = np.nanmedian(np.abs(np.concatenate(errors)), axis=0) / NORMAL_MEDIAN
        found = find_additive_outliers(errors, theta[: na * l].reshape(na, l, l), np.maximum(spread, 1e-300))
        found = [new & ~mask & ~np.isnan(e.y) for new, mask, e in zip(found, self._outliers, self._data.experiments)]
        more = sum(int(new.sum()) for new in found)
        if not 0 < more <= MOST * self._data.n_samples - self.count:
            return False
        for mask, new in zip(self._outliers, found):
            mask |= new
        return True

    def figures(self, kind: str, width: float) -> dict[str, Any]:
        """Return the figures that the fit prints: the threshold of the loss, and the outliers."""
        found: dict[str, Any] = {"threshold of the loss": width} if kind == "huber" else {}
        by_residuals = [mask & ~known for mask, known in zip(self._outliers, self._examined)]
        for o, name in enumerate(self._layout.outputs):
            for word, masks in ((EXAMINED, self._examined), (BY_RESIDUALS, by_residuals)):
                samples = tuple(np.flatnonzero(mask[:, o]) for mask in masks)
                if any(part.size for part in samples):
                    found[f"{word} of {name}"] = LeftOut(name, samples)
        return found


def _sizes(errors: list[np.ndarray]) -> list[np.ndarray]:
    """Euclidean size of the residual of every row (over the outputs), NaN where a row does not count."""
    return [np.sqrt(np.sum(r * r, axis=1)) for r in errors]


def _loss(sizes: np.ndarray, kind: str, width: float) -> float:
    if kind == "l1":
        return float(np.sum(sizes))
    return float(np.sum(np.where(sizes <= width, sizes**2, 2 * width * sizes - width**2)))


def _weights(sizes: np.ndarray, kind: str, width: float) -> np.ndarray:
    safe = np.maximum(np.nan_to_num(sizes), width)
    return width / safe if kind == "huber" else 0.5 / safe


def _evidence(program: Problem, solution: Solution, sizes: list[np.ndarray], weights: list[np.ndarray],
              kind: str, width: float, convex: bool) -> Evidence:
    """Objective in the loss itself, and the bound that the weighted residuals of the pass give."""
    pooled, w = np.concatenate(sizes), np.concatenate(weights)
    keep = ~np.isnan(pooled)
    pooled, w = pooled[keep], w[keep]
    unit = program.unit
    penalty = max(0.0, solution.objective / unit - float(np.sum(w * pooled**2)))
    objective = _loss(pooled, kind, width) + penalty
    model = program.model(solution.values)
    status = Status.LOCAL if solution.status is Status.OPTIMAL else solution.status
    if not convex:
        bound = Bound.none(f"the exact form with the {kind} loss has no proof")
        return Evidence(model, unit * objective, bound, status, bound.reason)
    limit = 2 * width if kind == "huber" else 1.0
    dual = 2 * w * pooled  # satisfies the stationarity of the weighted pass, hence of the dual, exactly
    shrink = min(1.0, limit / max(float(np.max(dual, initial=0.0)), 1e-300))
    conjugate = float(np.sum(dual**2)) / 4 if kind == "huber" else 0.0
    value = shrink * float(dual @ pooled) - shrink**2 * conjugate + shrink * penalty
    gap = relative_gap(objective, value, program.scale)
    proved = gap < 1e-6
    bound = Bound(unit * value, proved, f"{kind} dual", f"dual point of the last pass, gap {gap:.1e}")
    status = Status.OPTIMAL if proved and status is Status.LOCAL else status
    return Evidence(model, unit * objective, bound, status, bound.reason)
