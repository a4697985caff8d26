"""A fit of processes: the search for the best optimum, and its confirmation under the constraints."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.identify.arguments import enough_rows
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.tangent_descent import CONFIRMED, refine
from optid.identify.prediction_error.tangent_fit import INSIDE, Places, TangentFit
from optid.identify.process.descent import (
    LONG,
    ProcessBox,
    ProcessPoint,
    descend,
    falls_along,
    join_equal,
    search_cells,
    sharpen,
)
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.outputs import OutputErrors
from optid.identify.process.profile import DeadTimeProfiles
from optid.identify.process.proof import REASON, applies, better_start, certify
from optid.identify.process.separation import (
    describe_bounds,
    describe_equal_ones,
    describe_flatness,
    refuse_inseparable,
    refuse_silence,
    warn_of_motion,
)
from optid.identify.process.starts import best_descents, usual_box
from optid.program.solution import Bound, Status
from optid.solving.solve import Evidence, Procedure

CELL = "cell"  # of the constraint that keeps a step within the cells of the dead times
BOUNDS = "usual bounds"  # of the constraint that keeps numbers at their usual bounds, and dead times from below zero
NEAR = 0.02  # of a logarithm from its bound, within which the bound is stated to solvers
LATE = 3.0  # samples; the bound of a later dead time, zero, plays no part in the confirmation of an optimum
ROUNDS = 3  # times that a better start is looked for over boxes


@dataclass(frozen=True, eq=False)
class Found:
    """What the search for the processes of one output ended with."""

    best: ProcessPoint
    points: Sequence[ProcessPoint]  # ends of the descents from the grid, the best first
    figures: Mapping[str, Any]
    steps: int = 0


def fit_processes(errors: OutputErrors, pose: Callable[[Array, Sequence[Any]], Problem], constraints: Sequence[Any],
                  known: Mapping[str, Any] | None = None) -> Procedure:
    """Search for the best optimum within the bounds that single constraints give, and confirm it under all.

    Every output is searched by itself; the confirmation, and constraints that tie several numbers, see all of them.

    Args:
        errors: the criterion.
        pose: states the problem of the fit about a point, with constraints.
        constraints: of the user.
        known: figures that are known already.

    Raises:
        RankError: too few samples, no visible response, or parameters that the record does not separate.
    """
    for one in errors.each:
        enough_rows(len(one.y), "output samples", one.unknowns.size, "poles")
    usual = [usual_box(one) for one in errors.each]
    middle = errors.join([_middle(one, box) for one, box in zip(errors.each, usual)])
    boxes, complete = read_boxes(pose(middle, constraints), errors, usual)
    found = [_searched(one, box, complete) for one, box in zip(errors.each, boxes)]
    names = errors.data.outputs if len(found) > 1 else ("",)
    figures = {**(known or {}), **{f"{name}{' of ' * bool(output)}{output}": said
                                   for output, one in zip(names, found) for name, said in one.figures.items()}}
    bests = [one.best for one in found]
    x = errors.join([best.x for best in bests])
    if complete:
        evidence = yield from _confirmed(errors, pose, constraints, x, figures, max(one.steps for one in found), LATE)
        if evidence is None:
            return None
        if evidence.status is Status.INACCURATE:
            evidence = _judged_along(errors, boxes, bests, evidence)
        if evidence.status is Status.LOCAL and not all(map(applies, errors.each)):
            evidence = replace(evidence, reason=REASON)
        return replace(evidence, profiles=DeadTimeProfiles(errors, boxes, [best.x for best in bests]),
                       bound=partial(_certified, errors, boxes, bests))
    ends = []
    for number in range(max(len(one.points) for one in found) + 1):
        start = x if not number else errors.join(
            [one.points[min(number, len(one.points)) - 1].x for one in found])
        within = replace(pose(start, constraints), restrictions=(partial(_cell, errors),))
        fit = TangentFit(within, errors, errors.compress)
        end = yield from refine(fit, _descent(errors, start), dict(figures), start)
        if end is None:
            return None
        at = fit.places.pack(end.values or {})
        ends.append((fit.excess(at) > INSIDE, end.objective, at))
    return (yield from _confirmed(errors, pose, constraints, min(ends, key=lambda one: one[:2])[2], figures))


def _searched(errors: ProcessErrors, box: ProcessBox, complete: bool) -> Found:
    """Search for the best optimum of one output; where the box is all there is, to the last digits."""
    points = best_descents(errors, box)
    several = points[: 2 if len(errors.y) <= LONG else 1]
    best, steps = min((search_cells(errors, one, box) for one in several), key=lambda one: one.value), 0
    figures = {"starts": _agreement(points, best)}
    if complete:
        best, steps = sharpen(errors, join_equal(errors, _past_the_grid(errors, box, best)), box)
        best = join_equal(errors, best)
        refuse_silence(errors, best)
        refuse_inseparable(errors, box, best)
        figures |= {name: said for name, said in {"start": warn_of_motion(errors, best),
                                                  "bounds": describe_bounds(errors, best),
                                                  "not determined": describe_flatness(errors, best),
                                                  "time constants": describe_equal_ones(errors, best)}.items() if said}
    return Found(best, points, figures, steps)


def _past_the_grid(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint) -> ProcessPoint:
    """Go on from what a coarse search over boxes finds to be better, if anything."""
    for _ in range(ROUNDS):
        point = better_start(errors, box, best.value)
        if point is None:
            break
        x = best.x.copy()
        x[errors.unknowns.dynamic] = point
        end = search_cells(errors, descend(errors, x, box)[0], box)
        if end.value >= best.value:
            break
        best = end
    return best


def _judged_along(errors: OutputErrors, boxes: Sequence[ProcessBox], bests: Sequence[ProcessPoint],
                  evidence: Evidence) -> Evidence:
    """Judge a point that the last programme would move far, in a direction that the record hardly shows."""
    falls = max(falls_along(*one) for one in zip(errors.each, bests, boxes))
    flat = [said for name, said in evidence.figures.items() if name.startswith("not determined")]
    if falls <= CONFIRMED:
        return replace(evidence, status=Status.LOCAL)
    return replace(evidence, reason=f"{evidence.reason}{'; not determined is ' * bool(flat)}{'; '.join(flat)}")


def _certified(errors: OutputErrors, boxes: Sequence[ProcessBox], bests: Sequence[ProcessPoint]) -> Bound:
    """Bound the sum of squares of every output from below, and so their sum."""
    found = [certify(*one) for one in zip(errors.each, boxes, (best.value for best in bests))]
    if len(found) == 1:
        return found[0]
    reasons = dict.fromkeys(bound.reason for bound in found)
    words = "; ".join(f"{name}: {bound.reason}" for name, bound in zip(errors.data.outputs, found))
    value = sum(bound.value / one.unit for bound, one in zip(found, errors.each))
    return Bound(value, all(bound.proved for bound in found), found[0].method,
                 words if len(reasons) > 1 else found[0].reason)


def _confirmed(errors: OutputErrors, pose: Callable[[Array, Sequence[Any]], Problem], constraints: Sequence[Any],
               x: Array, figures: Mapping[str, Any], steps: int = 0, late: float = np.inf) -> Procedure:
    """Let a back end confirm a point; numbers at their usual bounds, and dead times that are not late, stay within."""
    problem, held = pose(x, constraints), _at_bounds(errors, x, late)
    if held:
        problem = replace(problem, restrictions=(partial(_bounds, held),))
    fit = TangentFit(problem, errors, errors.compress)
    return (yield from refine(fit, _descent(errors, x, steps), figures, x))


def _descent(errors: OutputErrors, x: Array, steps: int = 0) -> Descent:
    return Descent(x, errors.linearise(x), steps, True)


def _middle(errors: ProcessErrors, box: ProcessBox) -> Array:
    x = np.ones(errors.unknowns.size)
    x[errors.unknowns.dynamic] = (box.low + box.high) / 2
    return x


def _agreement(points: Sequence[ProcessPoint], best: ProcessPoint) -> str:
    same = sum(one.value <= best.value * (1 + 1e-3) for one in points)
    return f"{same} of {len(points)} descents from the grid end within 0.1 % of the best"


# -- constraints ---------------------------------------------------------------------------------------------------


def read_boxes(problem: Problem, errors: OutputErrors, boxes: Sequence[ProcessBox]
               ) -> tuple[Sequence[ProcessBox], bool]:
    """Return the boxes within the constraints that bound one number each, and whether these are all."""
    low, high = (np.concatenate(ends) for ends in zip(*((box.low, box.high) for box in boxes)))
    complete = True
    names = [errors.key("dynamics", pair) for pair in range(len(errors.pairs))]
    places = np.concatenate([np.arange(problem.space.size)[problem.space.places[name]] for name in names])
    for one in problem.constraints():
        if one.name in problem.structural:
            continue
        if one.cone not in ("zero", "below"):
            complete = False
            continue
        for row, right in zip(one.rows, one.right):
            used = np.flatnonzero(row)
            if len(used) != 1 or used[0] not in places:
                complete = False
                continue
            j, end = int(np.flatnonzero(places == used[0])[0]), float(right / row[used[0]])
            if one.cone == "zero" or row[used[0]] > 0:
                high[j] = min(high[j], end)
            if one.cone == "zero":
                low[j] = high[j] = end
            elif row[used[0]] < 0:
                low[j] = max(low[j], end)
    if np.any(low > high):
        return boxes, False
    edges = np.cumsum([len(box.low) for box in boxes])[:-1]
    return [ProcessBox(*ends) for ends in zip(np.split(low, edges), np.split(high, edges))], complete


def _cell(errors: OutputErrors, view: Any) -> dict[str, Any]:
    """Keep every dead time in its cell about the point where the constraints are read, other numbers at usual sizes."""
    places = Places.of(errors)
    x = places.pack({name: view.reference[name] for name in places.names})
    lows, highs = [], []
    for one, part in zip(errors.each, errors.split(x)):
        box = usual_box(one)
        low, high = box.low.copy(), box.high.copy()
        for c, structure in enumerate(one.unknowns.structures):
            if structure.delay:
                low[one.place(c)], high[one.place(c)] = one.cell(part, c)
        lows.append(low)
        highs.append(high)
    numbers = cp.hstack([view.inner[errors.key("dynamics", pair)] for pair in range(len(errors.pairs))])
    return {CELL: [numbers >= np.concatenate(lows), numbers <= np.concatenate(highs)]}


def _at_bounds(errors: OutputErrors, x: Array, late: float) -> list[tuple[str, int, float, float]]:
    """Return (variable, entry, sign, bound) of numbers at their usual bounds, and of dead times up to a late one."""
    found, pair = [], 0
    for one, part in zip(errors.each, errors.split(x)):
        box, j = usual_box(one), 0
        for c, structure in enumerate(one.unknowns.structures):
            for i, name in enumerate(structure.names):
                value, near = part[one.unknowns.slices[f"dynamics{c}"]][i], late if name == "dead_time" else NEAR
                if value <= box.low[j] + near:
                    found.append((errors.key("dynamics", pair), i, 1.0, float(box.low[j])))
                if value >= box.high[j] - (1e-9 if name == "dead_time" else NEAR):
                    found.append((errors.key("dynamics", pair), i, -1.0, float(box.high[j])))
                j += 1
            pair += 1
    return found


def _bounds(held: Sequence[tuple[str, int, float, float]], view: Any) -> dict[str, Any]:
    return {BOUNDS: [sign * (view.inner[name][i] - bound) >= 0 for name, i, sign, bound in held]}
