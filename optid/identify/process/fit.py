"""A fit of processes: the search for the best optimum, and its confirmation under the constraints."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.errors import InfeasibleError
from optid.identify.arguments import enough_rows
from optid.identify.prediction_error.criterion import INSIDE, excess
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.tangent_descent import CONFIRMED, refine
from optid.identify.process.descent import LONG, ProcessBox, ProcessPoint, descend, search_cells, sharpen
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.order import choose_types
from optid.identify.process.pairs import for_outputs
from optid.identify.process.profile import ProcessProfiles
from optid.identify.process.proof import REASON, applies, better_start, certify
from optid.identify.process.separation import examine
from optid.identify.process.starts import best_descents, usual_box
from optid.program.solution import Bound, Status
from optid.solving.solve import Evidence, Procedure

BOUNDS = "usual bounds"  # of the constraint that keeps numbers within them, and dead times in their cells
NEAR = 0.02  # of a logarithm from its bound, within which the bound is stated to solvers
LATE = 3.0  # samples; the bound of a later dead time, zero, plays no part in the confirmation of an optimum
ROUNDS = 3  # times that a better start is looked for over boxes


@dataclass(frozen=True, eq=False)
class ProcessFit:
    """Errors, and the problem of the fit about a point."""

    errors: ProcessErrors
    pose: Callable[[ProcessErrors, Array], Problem]
    constraints: tuple[Any, ...]

    def problem(self, x: Array) -> Problem:
        """Return the problem about a point, under constraints that are each about one output."""
        return self.pose(self.errors, x).subject_to(*for_outputs(self.errors, self.constraints))

    def refine(self, problem: Problem, x: Array, figures: Mapping[str, Any], steps: int = 0) -> Procedure:
        """Let a back end confirm a point, or go on from it."""
        return (yield from refine(problem, Descent(x, self.errors.linearise(x), steps, True), figures, x))

    def confirm(self, x: Array, figures: Mapping[str, Any], steps: int = 0, late: float = np.inf) -> Procedure:
        """Confirm a point; numbers at their usual bounds, and dead times that are not late, stay within."""
        problem, near = self.problem(x), _at_bounds(self.errors, x, late)
        if np.isfinite(near).any():
            problem = replace(problem, restrictions=(partial(_within, self.errors, near),))
        return (yield from self.refine(problem, x, figures, steps))


def fit_processes(errors: ProcessErrors, pose: Callable[[ProcessErrors, Array], Problem], constraints: Sequence[Any],
                  auto: bool = False) -> Procedure:
    """Search for the best optimum within the bounds that single constraints give, and confirm it under all.

    Every output is searched by itself; the confirmation, and constraints that tie several numbers, see all of them.

    Args:
        errors: the criterion.
        pose: states the problem of the fit about a point, without constraints of the user.
        constraints: these.
        auto: whether the types of the processes are chosen first.

    Raises:
        RankError: too few samples, no visible response, or parameters that the record does not separate.
    """
    errors, said = choose_types(errors) if auto else (errors, "")
    fit = ProcessFit(errors, pose, tuple(constraints))
    for one in errors.each:
        enough_rows(len(one.y), "output samples", one.unknowns.size, "poles")
    usual = [usual_box(one) for one in errors.each]
    boxes, complete, cone = read_boxes(fit.problem(errors.join(list(map(_middle, errors.each, usual)))), errors, usual)
    bests, several, told, steps = zip(*map(_searched, errors.each, boxes, (complete,) * len(boxes)))
    names = errors.data.outputs if len(bests) > 1 else ("",)
    figures = {**({"process type": said} if auto else {}), **{f"{name}{' of ' * bool(output)}{output}": word
               for output, one in zip(names, told) for name, word in one.items()}}
    x = errors.join([best.x for best in bests])
    if complete:
        evidence = yield from fit.confirm(x, figures, max(steps), LATE)
        if evidence is None:
            return None
        if evidence.status is Status.INACCURATE:
            evidence = _judged_along(bests, boxes, evidence)
        if evidence.status is Status.LOCAL and not all(map(applies, errors.each)):
            evidence = replace(evidence, reason=REASON)
        return replace(evidence, profiles=ProcessProfiles(errors, boxes, bests),
                       bound=partial(_certified, errors, boxes, bests))
    ends = []
    for number in range(max(map(len, several)) + 1):
        start = x if not number else errors.join([points[min(number, len(points)) - 1].x for points in several])
        within = replace(fit.problem(start), restrictions=(partial(_cell, errors),))
        end = yield from fit.refine(within, start, dict(figures))
        if end is None:
            return None
        at = errors.variables.pack(end.values or {})
        ends.append((excess(within, at) > INSIDE, end.objective, at))
    evidence = yield from fit.confirm(min(ends, key=lambda one: one[:2])[2], figures)
    if evidence is None or cone is None or not np.isfinite(evidence.objective):
        return evidence
    return replace(evidence, bound=partial(certify, errors, evidence.objective / errors.unit, boxes[0], cone))


def _searched(errors: ProcessErrors, box: ProcessBox, complete: bool
              ) -> tuple[ProcessPoint, Sequence[ProcessPoint], dict[str, str], int]:
    """Return the best optimum of one output, where the box is all there is to the last digits.

    Then the ends of the descents from the grid, the best first, figures, and the steps to the last digits.
    """
    points = best_descents(errors, box)
    several = points[: 2 if len(errors.y) <= LONG else 1]
    best, steps = min((search_cells(one, box) for one in several), key=lambda one: one.value), 0
    same = sum(one.value <= best.value * (1 + 1e-3) for one in points)
    figures = {"starts": f"{same} of {len(points)} descents from the grid end within 0.1 % of the best"}
    if complete:
        best, steps = sharpen(_past_the_grid(best, box).join_equal(), box)
        best = best.join_equal()
        figures |= examine(best, box)
    return best, points, figures, steps


def _past_the_grid(best: ProcessPoint, box: ProcessBox) -> ProcessPoint:
    """Go on from what a coarse search over boxes finds to be better, if anything."""
    for _ in range(ROUNDS):
        point = better_start(best.errors, box, best.value)
        if point is None:
            break
        end = search_cells(descend(best.errors, best.at(point).x, box)[0], box)
        if end.value >= best.value:
            break
        best = end
    return best


def _judged_along(bests: Sequence[ProcessPoint], boxes: Sequence[ProcessBox], evidence: Evidence) -> Evidence:
    """Judge a point that the last programme would move far, in a direction that the record hardly shows."""
    flat = [said for name, said in evidence.figures.items() if name.startswith("not determined")]
    if max(map(ProcessPoint.falls_along, bests, boxes)) <= CONFIRMED:
        return replace(evidence, status=Status.LOCAL)
    return replace(evidence, reason=f"{evidence.reason}{'; not determined is ' * bool(flat)}{'; '.join(flat)}")


def _certified(errors: ProcessErrors, boxes: Sequence[ProcessBox], bests: Sequence[ProcessPoint]) -> Bound:
    """Bound the sum of squares of every output from below, and so their sum."""
    found = [certify(best.errors, best.value, box) for best, box in zip(bests, boxes)]
    if len(found) == 1:
        return found[0]
    reasons = dict.fromkeys(bound.reason for bound in found)
    words = "; ".join(f"{name}: {bound.reason}" for name, bound in zip(errors.data.outputs, found))
    value = sum(bound.value / one.unit for bound, one in zip(found, errors.each))
    return Bound(value, all(bound.proved for bound in found), found[0].method,
                 words if len(reasons) > 1 else found[0].reason)


def _middle(errors: ProcessErrors, box: ProcessBox) -> Array:
    x = np.ones(errors.unknowns.size)
    x[errors.unknowns.dynamic] = (box.low + box.high) / 2
    return x


# -- constraints ---------------------------------------------------------------------------------------------------


def read_boxes(problem: Problem, errors: ProcessErrors, boxes: Sequence[ProcessBox]
               ) -> tuple[Sequence[ProcessBox], bool, Array | None]:
    """Return the boxes within the constraints that bound one number each, whether these are all, and a cone.

    Where the others are as many rows about mu as it has coefficients, these are non-negative sums of the columns of the
    cone (size, size).

    Raises:
        InfeasibleError: a number is bounded to values that are not tried.
    """
    usual = _ends(boxes)
    low, high = usual[0].copy(), usual[1].copy()
    others, every = list[tuple[str, Array, float]](), np.arange(problem.space.size)
    places = np.concatenate([every[problem.space.places[errors.key("dynamics", p)]]
                             for p in range(len(errors.unknowns.pairs))])
    for one in problem.constraints():
        if one.name in problem.structural:
            continue
        for row, right in zip(one.rows, one.right):
            used = np.flatnonzero(row)
            if one.cone not in ("zero", "below") or len(used) != 1 or used[0] not in places:
                others.append((one.cone, row, float(right)))
                continue
            j, end = int(np.flatnonzero(places == used[0])[0]), float(right / row[used[0]])
            if one.cone == "zero" or row[used[0]] > 0:
                high[j] = min(high[j], end)
            if one.cone == "zero" or row[used[0]] < 0:
                low[j] = max(low[j], end)
    untried = np.flatnonzero((low > usual[1]) | (high < usual[0]))
    if untried.size:
        _refuse_untried(errors, int(untried[0]), *(float(end[untried[0]]) for end in usual))
    if np.any(low > high):
        return boxes, False, None
    edges = np.cumsum([len(box.low) for box in boxes])[:-1]
    found = [ProcessBox(*ends) for ends in zip(np.split(low, edges), np.split(high, edges))]
    mu = problem.space.places[errors.key("mu", 0)]
    rows = np.array([row for cone, row, right in others if cone == "below" and right == 0 and not np.delete(
        row, every[mu]).any()]).reshape(-1, problem.space.size)[:, mu]
    simplicial = len(rows) == len(others) == rows.shape[1] == np.linalg.matrix_rank(rows) and len(errors.each) == 1
    return found, not others, -np.linalg.inv(rows) if simplicial else None


def _refuse_untried(errors: ProcessErrors, j: int, low: float, high: float) -> None:
    """Refuse constraints that ask for a number beyond its usual bounds."""
    p, name = errors.unknowns.numbers[j]
    ends = np.exp([low, high]) if errors.unknowns.logarithmic[j] else np.array([low, high])
    words = [f"{end * (1 if name == 'zeta' else errors.data.dt):.4g}" for end in ends]
    raise InfeasibleError(f"the constraints leave no value of {errors.key(name, p)} from {' to '.join(words)} "
                          f"{errors.data.time_unit * (name != 'zeta')}".rstrip() + ", which is all that a record of "
                          "this length and sampling time can show: relax them, or use a longer or faster record")


def _ends(boxes: Sequence[ProcessBox]) -> tuple[Array, Array]:
    """Return the bounds of the numbers of all outputs one after another."""
    return np.concatenate([box.low for box in boxes]), np.concatenate([box.high for box in boxes])


def _within(errors: ProcessErrors, ends: tuple[Array, Array], view: Any) -> dict[str, Any]:
    """Keep the numbers of all processes between ends, where these are finite."""
    numbers = [number for p in range(len(errors.unknowns.pairs)) for number in view.inner[errors.key("dynamics", p)]]
    return {BOUNDS: [rule for number, low, high in zip(numbers, *ends) for rule, end in (
        (number >= low, low), (number <= high, high)) if np.isfinite(end)]}


def _cell(errors: ProcessErrors, view: Any) -> dict[str, Any]:
    """Keep every dead time in its cell about the point where the constraints are read, other numbers at usual sizes."""
    x = errors.variables.pack({name: view.reference[name] for name in errors.variables.names})
    low, high = _ends([*map(usual_box, errors.each)])
    for p, place in errors.unknowns.delays.items():
        low[place], high[place] = errors.cell(x, p)
    return _within(errors, (low, high), view)


def _at_bounds(errors: ProcessErrors, x: Array, late: float) -> tuple[Array, Array]:
    """Return the usual bounds of numbers that lie there, and of dead times up to a late one; others are infinite."""
    numbers, (low, high) = x[errors.unknowns.dynamic], _ends([*map(usual_box, errors.each)])
    delayed = np.isin(np.arange(len(numbers)), [*errors.unknowns.delays.values()])
    return (np.where(numbers <= low + np.where(delayed, late, NEAR), low, -np.inf),
            np.where(numbers >= high - np.where(delayed, 1e-9, NEAR), high, np.inf))
