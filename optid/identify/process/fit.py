"""A fit of processes: the search for the best optimum, and its confirmation under the constraints."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.identify.arguments import enough_rows
from optid.identify.prediction_error.compressed_errors import CompressedErrors
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.tangent_descent import refine
from optid.identify.prediction_error.tangent_fit import INSIDE, Places, TangentFit
from optid.identify.process.descent import LONG, ProcessBox, ProcessPoint, descend, join_equal, search_cells, sharpen
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.profile import profile_intervals
from optid.identify.process.proof import REASON, applies, better_start
from optid.identify.process.separation import (
    describe_bounds,
    describe_equal_ones,
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
PROFILED = 5_000  # outputs up to which profiles are worth their time; with more of them errors are all but quadratic
ROUNDS = 3  # times that a better start is looked for over boxes

Certify = Callable[[ProcessErrors, ProcessBox, float], Bound]


def fit_processes(errors: ProcessErrors, pose: Callable[[Array, Sequence[Any]], Problem], constraints: Sequence[Any],
                  certify: Certify | None = None, known: Mapping[str, Any] | None = None) -> Procedure:
    """Search for the best optimum within the bounds that single constraints give, and confirm it under all.

    Args:
        errors: the criterion.
        pose: states the problem of the fit about a point, with constraints.
        constraints: of the user.
        certify: returns a lower bound on the sum of squares within a box; None where there is no method.
        known: figures that are known already.

    Raises:
        RankError: too few samples, no visible response, or parameters that the record does not separate.
    """
    enough_rows(len(errors.y), "output samples", errors.unknowns.size, "poles")
    middle = _middle(errors, usual_box(errors))
    box, complete = read_box(pose(middle, constraints), errors, usual_box(errors))
    points = best_descents(errors, box)
    several = points[: 2 if len(errors.y) <= LONG else 1]
    best = min((search_cells(errors, one, box) for one in several), key=lambda one: one.value)
    figures: dict[str, Any] = {**(known or {}), "starts": _agreement(points, best)}
    if complete:
        best, steps = sharpen(errors, join_equal(errors, _past_the_grid(errors, box, best)), box)
        best = join_equal(errors, best)
        refuse_silence(errors, best)
        refuse_inseparable(errors, box, best)
        figures |= {name: said for name, said in {"start": warn_of_motion(errors, best),
                                                  "bounds": describe_bounds(errors, best),
                                                  "time constants": describe_equal_ones(errors, best)}.items() if said}
        evidence = yield from _confirmed(errors, pose, constraints, best.x, figures, steps)
        if evidence is None:
            return None
        if evidence.status is Status.LOCAL and not applies(errors):
            evidence = replace(evidence, reason=REASON)
        evidence = replace(evidence, extend=partial(_with_profiles, errors, box, best.x, evidence))
        return evidence if certify is None else replace(evidence, bound=partial(certify, errors, box, best.value))
    ends = []
    for point in [best, *points][: 1 + len(points)]:
        within = replace(pose(point.x, constraints), restrictions=(partial(_cell, errors),))
        fit = TangentFit(within, errors, partial(CompressedErrors, errors))
        end = yield from refine(fit, _descent(errors, point.x), dict(figures), point.x)
        if end is None:
            return None
        x = fit.places.pack(end.values or {})
        ends.append((fit.excess(x) > INSIDE, end.objective, x))
    return (yield from _confirmed(errors, pose, constraints, min(ends, key=lambda one: one[:2])[2], figures))


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


def _confirmed(errors: ProcessErrors, pose: Callable[[Array, Sequence[Any]], Problem], constraints: Sequence[Any],
               x: Array, figures: Mapping[str, Any], steps: int = 0) -> Procedure:
    """Let a back end confirm a point; numbers at their usual bounds stay within these."""
    problem, held = pose(x, constraints), _at_bounds(errors, x)
    if held:
        problem = problem.subject_to(partial(_bounds, held))
    fit = TangentFit(problem, errors, partial(CompressedErrors, errors))
    return (yield from refine(fit, _descent(errors, x, steps), figures, x))


def _descent(errors: ProcessErrors, x: Array, steps: int = 0) -> Descent:
    return Descent(x, errors.linearise(x), steps, True)


def _middle(errors: ProcessErrors, box: ProcessBox) -> Array:
    x = np.ones(errors.unknowns.size)
    x[errors.unknowns.dynamic] = (box.low + box.high) / 2
    return x


def _agreement(points: Sequence[ProcessPoint], best: ProcessPoint) -> str:
    same = sum(one.value <= best.value * (1 + 1e-3) for one in points)
    return f"{same} of {len(points)} descents from the grid end within 0.1 % of the best"


# -- constraints ---------------------------------------------------------------------------------------------------


def read_box(problem: Problem, errors: ProcessErrors, box: ProcessBox) -> tuple[ProcessBox, bool]:
    """Return the box within the constraints that bound one number each, and whether these are all."""
    low, high, complete = box.low.copy(), box.high.copy(), True
    names = [errors.key("dynamics", c) for c in range(errors.data.m)]
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
        return box, False
    return ProcessBox(low, high), complete


def _cell(errors: ProcessErrors, view: Any) -> dict[str, Any]:
    """Keep every dead time in its cell about the point where the constraints are read, other numbers at usual sizes."""
    places = Places.of(errors)
    x = places.pack({name: view.reference[name] for name in places.names})
    box = usual_box(errors)
    low, high = box.low.copy(), box.high.copy()
    for c, structure in enumerate(errors.unknowns.structures):
        if structure.delay:
            low[errors.place(c)], high[errors.place(c)] = errors.cell(x, c)
    numbers = cp.hstack([view.inner[errors.key("dynamics", c)] for c in range(errors.data.m)])
    return {CELL: [numbers >= low, numbers <= high]}


def _at_bounds(errors: ProcessErrors, x: Array) -> list[tuple[str, int, float, float]]:
    """Return (variable, entry, sign, bound) of the numbers at their usual bounds, and of dead times near zero."""
    box, found, j = usual_box(errors), [], 0
    for c, structure in enumerate(errors.unknowns.structures):
        for i, name in enumerate(structure.names):
            value, near = x[errors.unknowns.slices[f"dynamics{c}"]][i], 3.0 if name == "dead_time" else NEAR
            if value <= box.low[j] + near:
                found.append((errors.key("dynamics", c), i, 1.0, float(box.low[j])))
            if value >= box.high[j] - (1e-9 if name == "dead_time" else NEAR):
                found.append((errors.key("dynamics", c), i, -1.0, float(box.high[j])))
            j += 1
    return found


def _bounds(held: Sequence[tuple[str, int, float, float]], view: Any) -> dict[str, Any]:
    return {BOUNDS: [sign * (view.inner[name][i] - bound) >= 0 for name, i, sign, bound in held]}


def _with_profiles(errors: ProcessErrors, box: ProcessBox, x: Array, evidence: Evidence
                   ) -> tuple[Any, dict[str, Any]]:
    """Return the model, and the intervals of dead times by profile likelihood as figures."""
    unit = errors.data.time_unit
    if len(errors.y) > PROFILED:
        return evidence.model, {}
    found = {name.replace("_", " "): ends for name, ends in profile_intervals(errors, box, x).items()}
    return evidence.model, {f"{name}, 95 % by profile likelihood": f"{low:.4g} to {high:.4g} {unit}".rstrip()
                            for name, (low, high) in found.items()}
