"""A fit of processes: the search for the best optimum, and its confirmation under the constraints."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.errors import RankError
from optid.identify.arguments import enough_rows
from optid.identify.prediction_error.compressed_errors import CompressedErrors
from optid.identify.prediction_error.descent import Descent
from optid.identify.prediction_error.tangent_descent import refine
from optid.identify.prediction_error.tangent_fit import INSIDE, TangentFit
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend, search_cells, sharpened
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.profile import profile_intervals
from optid.identify.process.proof import better_start
from optid.identify.process.starts import best_descents, usual_box
from optid.program.solution import Bound
from optid.solving.solve import Evidence, Procedure

CELL = "cell"  # of the constraint that keeps a step within the cells of the dead times
BOUNDS = "bounds"  # of the constraint that keeps numbers at their usual bounds
CHANCE = 1e-3  # p value of the F test above which the output does not visibly respond
PROFILED = 5_000  # outputs up to which profiles are worth their time; with more of them errors are all but quadratic
ROUNDS = 3  # times that a better start is looked for over boxes
ALIKE = 1e-7  # singular value of the scaled derivatives, relative to the largest, at which parameters are not separable

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
    best = min((search_cells(errors, one, box) for one in points[:2]), key=lambda one: one.value)
    figures: dict[str, Any] = {**(known or {}), "starts": _agreement(points, best)}
    if complete:
        best = sharpened(errors, _past_the_grid(errors, box, best), box)
        refuse_silence(errors, best)
        refuse_inseparable(errors, box, best)
        bound = partial(_proved, errors, box, best, certify)
        evidence = yield from _confirmed(errors, pose, constraints, best.x, figures)
        if evidence is None:
            return None
        evidence = replace(evidence, extend=partial(_with_profiles, errors, box, best.x, evidence))
        return evidence if certify is None else replace(evidence, bound=bound)
    ends = []
    for point in [best, *points][: 1 + len(points)]:
        within = pose(point.x, (*constraints, partial(_cell, errors)))
        within = replace(within, structural=within.structural | {CELL})
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
               x: Array, figures: Mapping[str, Any]) -> Procedure:
    """Let a back end confirm a point; numbers at their usual bounds stay within these."""
    problem, held = pose(x, constraints), _at_bounds(errors, x)
    if held:
        problem = replace(problem.subject_to(partial(_bounds, held)), structural=problem.structural | {BOUNDS})
    fit = TangentFit(problem, errors, partial(CompressedErrors, errors))
    return (yield from refine(fit, _descent(errors, x), figures, x))


def _descent(errors: ProcessErrors, x: Array) -> Descent:
    return Descent(x, errors.linearise(x), 0, True)


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
    names = [errors.key("dynamics", c) for c in range(errors.data.m)]
    x = np.zeros(errors.unknowns.size)
    for name in (*view.inner,):
        if name in view.reference:
            part = {**{errors.key("mu", c): f"mu{c}" for c in range(errors.data.m)},
                    **{one: f"dynamics{c}" for c, one in enumerate(names)}, "offset": "offset", "drift": "drift"}.get(name)
            if part is not None:
                x[errors.unknowns.slices[part]] = view.reference[name]
    if "x0" in view.reference:
        x[errors.unknowns.shared :] = np.ravel(view.reference["x0"], order="F")
    box = usual_box(errors)
    low, high = box.low.copy(), box.high.copy()
    for c, structure in enumerate(errors.unknowns.structures):
        if structure.delay:
            low[errors.place(c)], high[errors.place(c)] = errors.cell(x, c)
    numbers = cp.hstack([view.inner[name] for name in names])
    return {CELL: [numbers >= low, numbers <= high]}


def _at_bounds(errors: ProcessErrors, x: Array) -> list[tuple[str, int, float, float]]:
    """Return (variable, entry, sign, bound) of the numbers at their usual bounds, and of dead times near zero."""
    box, found, j = usual_box(errors), [], 0
    for c, structure in enumerate(errors.unknowns.structures):
        for i, name in enumerate(structure.names):
            value, near = x[errors.unknowns.slices[f"dynamics{c}"]][i], 3.0 if name == "dead_time" else 1e-9
            if value <= box.low[j] + near:
                found.append((errors.key("dynamics", c), i, 1.0, float(box.low[j])))
            if value >= box.high[j] - 1e-9:
                found.append((errors.key("dynamics", c), i, -1.0, float(box.high[j])))
            j += 1
    return found


def _bounds(held: Sequence[tuple[str, int, float, float]], view: Any) -> dict[str, Any]:
    return {BOUNDS: [sign * (view.inner[name][i] - bound) >= 0 for name, i, sign, bound in held]}


# -- what the record does not determine ----------------------------------------------------------------------------


def refuse_silence(errors: ProcessErrors, best: ProcessPoint) -> None:
    """Refuse a record in which the output shows no response to any input (`RankError`)."""
    from scipy.stats import f as fisher

    u = errors.unknowns
    still = best.columns[:, sum(u.sizes) :]
    rest = errors.y - still @ np.linalg.lstsq(still, errors.y, rcond=None)[0] if still.shape[1] else errors.y
    used, dof = len(u.dynamic) + sum(u.sizes), len(errors.y) - u.size
    before = float(rest @ rest)
    ratio = (before - best.value) / used / max(best.value / dof, 1e-300)
    if fisher.sf(ratio, used, dof) < CHANCE:
        return
    level = errors.units.y_offset[0] + errors.units.y_scale[0] * float(np.mean(errors.y))
    size = errors.units.y_scale[0] * np.sqrt(before / len(errors.y))
    raise RankError(
        f"output {errors.data.outputs[0]!r} shows no response to {', '.join(errors.data.inputs)} (p = "
        f"{fisher.sf(ratio, used, dof):.2g}): the dead time may be longer than the record, or the gain small beside the "
        f"noise. Determined is its level alone, {level:.4g} (standard deviation {size:.2g}). Use a longer record or a "
        "larger step")


def refuse_inseparable(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint) -> None:
    """Refuse time constants and dead times that the record shows only together (`RankError`)."""
    u, at = errors.unknowns, errors.unknowns.dynamic
    _refuse_instant(errors, box, best)
    basis = np.linalg.qr(best.columns)[0]
    slopes = errors.slopes(best.x)
    left = slopes - basis @ (basis.T @ slopes)
    names = [errors.key(name, c) for c, one in enumerate(u.structures) for name in one.names]
    sizes, box = np.linalg.norm(left, axis=0), usual_box(errors)
    inner = (best.x[at] > box.low + 1e-9) & (best.x[at] < box.high - 1e-9)
    whole = np.linalg.norm(slopes, axis=0)
    silent = [name for name, size, much, free in zip(names, sizes, whole, inner) if free and size <= ALIKE * much]
    if silent:
        raise RankError(f"{', '.join(silent)} {'have' if silent[1:] else 'has'} no effect on this record that the gain "
                        f"does not have as well. {_determined(errors, best)}")
    used = left[:, inner & (sizes > 0)] / sizes[inner & (sizes > 0)]
    if used.shape[1] < 2:
        return
    values, vectors = np.linalg.svd(used, full_matrices=False)[1:]
    if values[-1] > ALIKE * values[0]:
        return
    kept = [name for name, there in zip(names, inner & (sizes > 0)) if there]
    parts = [name for name, part in zip(kept, np.abs(vectors[-1])) if part > 0.1]
    raise RankError(f"{', '.join(parts)} can change together without any effect on this record: it does not separate "
                    f"them. {_determined(errors, best)}")


def _refuse_instant(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint) -> None:
    """Refuse a time constant below a sampling time that is not told from zero beside a dead time (`RankError`)."""
    from scipy.stats import f as fisher

    dof = len(errors.y) - errors.unknowns.size
    for c, one in enumerate(errors.unknowns.structures):
        first = errors.unknowns.slices[f"dynamics{c}"].start
        place = errors.place(c) - len(one.names) + 1
        if one.names != ("tau", "dead_time") or best.x[first] > 0 or box.low[place] == box.high[place]:
            continue
        x = best.x.copy()
        x[first + 1] += np.exp(best.x[first])
        x[first] = box.low[place]
        held = box.within(place, box.low[place], box.low[place])
        found = search_cells(errors, descend(errors, x, held)[0], held)
        if found.value <= best.value * (1 + fisher.ppf(0.95, 1, dof) / dof):
            name = errors.key("tau", c)
            raise RankError(f"{name} lies below a sampling time and is not told from zero: it does not separate from "
                            f"{errors.key('dead_time', c)}. {_determined(errors, best)}")


def _determined(errors: ProcessErrors, best: ProcessPoint) -> str:
    """Say which sum of times the record determines all the same, and what to do."""
    found = []
    for c, one in enumerate(errors.processes(best.x)):
        lag = one.in_unit(1 / errors.data.dt)
        total = lag.p[: one.structure.real].sum() + 2 * lag.value("zeta") * lag.value("T") + lag.dead_time
        found.append(f"{total - lag.value('tau_zero'):.4g}" + (f" ({errors.data.inputs[c]})" if errors.data.m > 1 else ""))
    return (f"Determined is their sum, the mean delay of the response: {', '.join(found)} {errors.data.time_unit}".rstrip()
            + ". Sample faster, choose fewer poles, or hold one by a constraint such as dead_time:0")


def _with_profiles(errors: ProcessErrors, box: ProcessBox, x: Array, evidence: Evidence) -> tuple[Any, dict[str, Any]]:
    """Return the model, and the intervals of dead times by profile likelihood as figures."""
    unit = errors.data.time_unit
    if len(errors.y) > PROFILED:
        return evidence.model, {}
    return evidence.model, {f"{name}, 95 % by profile likelihood": f"{low:.4g} to {high:.4g} {unit}".rstrip()
                            for name, (low, high) in profile_intervals(errors, box, x).items()}


def _proved(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint, certify: Certify) -> Bound:
    return certify(errors, box, best.value)

