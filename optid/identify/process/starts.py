"""Starts of descents: a coarse grid over one time scale, the damping, the zero and the dead time of every pair.

For every point of the grid the response gives a Gram matrix with the output and the columns that do not move; the sum
of squares follows from it.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from optid.arrays import Array
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend
from optid.identify.process.errors import ProcessErrors
from optid.models.process_dynamics import ProcessDynamics, ProcessStructure

SCALES, DELAYS = 12, 24  # time scales and dead times of the grid
FASTEST = 0.05  # samples of the smallest time constant
RATIOS = (1.0, 0.4, 0.16)  # time constants over the scale
DAMPINGS, ZEROS = (0.2, 0.5, 1.0), (0.5, -0.5)  # of the grid; zeros over the scale
COARSE, CHANGES = 400, 1000  # samples of every experiment, and changes of its input, on which starts are compared
APART = 0.06  # share of the bounds in which two starts that are both kept differ at least
KEPT = 4  # starts that descend


def usual_box(errors: ProcessErrors) -> ProcessBox:
    """Return usual bounds: time constants from a twentieth of a sample to ten records, and dead times.

    These leave at least a quarter of what follows the first change of the input.
    """
    span, ends = errors.length, []
    for p, name in errors.unknowns.numbers:
        after = max((float(errors.instants[course.experiment][-1] - drive.changes[1])
                     for course, drive in errors.courses_of(p) if len(drive.changes) > 1), default=0.0)
        ends.append({"zeta": (np.log(0.02), np.log(20.0)), "tau_zero": (-3 * span, 3 * span),
                     "dead_time": (0.0, 0.75 * after)}.get(name, (np.log(FASTEST), np.log(10 * span))))
    low, high = np.array(ends, dtype=float).T
    return ProcessBox(low, high)


def grid(structure: ProcessStructure, low: Array, high: Array) -> Iterator[Array]:
    """Yield numbers of a process on the coarse grid within bounds, its dead time at the lower one."""
    logs = [i for i, name in enumerate(structure.names) if structure.logarithmic[i] and name != "zeta"]
    ends = (max(low[i] for i in logs), min(high[i] for i in logs)) if logs else (0.0, 0.0)
    inner = min(0.7, (ends[1] - ends[0]) / 2)
    scales = np.linspace(ends[0] + inner, ends[1] - inner, SCALES) if logs else [0.0]
    dampings, zeros = DAMPINGS if structure.pair else (1.0,), ZEROS if structure.zero else (0.0,)
    for scale, zeta, zero in product(scales, dampings, zeros):
        value = dict(zip(("tau1", "tau2", "tau3"), scale + np.log(RATIOS))) | {
            "tau": scale, "T": scale + np.log(RATIOS[min(structure.real, 2)]), "zeta": np.log(zeta),
            "tau_zero": zero * np.exp(scale)}
        yield np.clip([value.get(name, 0.0) for name in structure.names], low, high)


def scan(errors: ProcessErrors, p: int, box: ProcessBox, others: Array) -> list[tuple[float, Array]]:
    """Return (sum of squares, numbers) of a pair on the grid, the best first, beside columns (rows, s) of others."""
    structure, mine = errors.unknowns.structures[p], [pair == p for pair, _ in errors.unknowns.numbers]
    low, high = box.low[mine], box.high[mine]
    thetas = np.unique(np.linspace(low[-1], high[-1], DELAYS)) if structure.delay else np.zeros(1)
    found, m = [], errors.unknowns.sizes[p]
    columns = np.empty((len(thetas), len(errors.y), m + others.shape[1] + 1))
    columns[:, :, m:] = np.column_stack([others, errors.y])
    for numbers in grid(structure, low, high):
        one = ProcessDynamics(structure, structure.parameters(numbers))
        for course, drive in errors.courses_of(p):
            level, rest = np.zeros(m) if structure.integrator else drive.values[0], drive.about_rest
            for i, theta in enumerate(thetas):  # a dead time moves the instants at which the undelayed course is read
                columns[i, course.span, :m] = level + one.response(
                    course.instants - theta + one.dead_time, drive.changes, rest, straight=errors.straight)[:, 0]
        for theta, value in zip(thetas, _least(np.swapaxes(columns, 1, 2) @ columns)):
            point = numbers.copy()
            if structure.delay:
                point[-1] = theta
            found.append((float(value), point))
    return sorted(found, key=lambda one: one[0])


def _least(grams: Array) -> Array:
    """Return the least sums of squares (D,) of the last column by the others."""
    size = np.sqrt(np.maximum(np.einsum("dii->di", grams), 1e-300))
    scaled = grams / size[:, :, None] / size[:, None, :]
    inner = scaled[:, :-1, :-1] + 1e-11 * np.eye(grams.shape[1] - 1)
    side = scaled[:, :-1, -1:]
    explained = np.sum(side * np.linalg.solve(inner, side), axis=(1, 2))
    return size[:, -1] ** 2 * np.maximum(1 - explained, 0.0)


def starts(errors: ProcessErrors, box: ProcessBox) -> list[Array]:
    """Return different unknowns to start from, the best first; with several inputs one after another is scanned."""
    u, x, pairs = errors.unknowns, np.zeros(errors.unknowns.size), range(len(errors.unknowns.pairs))
    x[u.dynamic] = (box.low + np.maximum(np.minimum(box.high, box.low + 4), box.low)) / 2
    constant, width = np.ones((len(errors.y), int(u.constant or u.levels))), np.maximum(box.high - box.low, 1e-300)
    done: list[int] = []
    chosen: list[Array] = []
    for p in (*pairs, *pairs) if len(pairs) > 1 else pairs:
        mus = [np.arange(u.size)[u.slices[f"mu{q}"]] for q in done if q != p]
        beside = errors.columns(x)[:, np.isin(u.linear, np.concatenate(mus))] if mus else constant[:, :0]
        ranked = scan(errors, p, box, np.hstack([constant, beside]))
        done, chosen = [*done, p], []
        for _, numbers in ranked:
            point = x.copy()
            point[u.slices[f"dynamics{p}"]] = numbers
            if all(np.max(np.abs(point - one)[u.dynamic] / width) > APART for one in chosen):
                chosen.append(point)
            if len(chosen) == KEPT:
                break
        x = chosen[0].copy()
    return chosen


def simpler(errors: ProcessErrors, box: ProcessBox) -> list[Array]:
    """Return the best processes of at most one real pole, without a zero, as points of types with more of them.

    A richer type then fits no worse: the poles that it adds are the fastest that are tried.
    """
    u, fast, found = errors.unknowns, 2 * FASTEST, []
    fewer = tuple(replace(one, real=min(one.real + 2 * one.pair, 1), pair=False, zero=False) for one in u.structures)
    if fewer == u.structures:
        return []
    plain = replace(errors, unknowns=replace(u, structures=fewer))
    inner = usual_box(plain)
    for point in (descend(plain, x, inner, steps=30, tolerance=1e-7)[0] for x in starts(plain, inner)[:2]):
        x = np.zeros(u.size)
        for p, (one, less, process) in enumerate(zip(u.structures, fewer, plain.processes(point.x))):
            tau = process.value("tau")
            pair = (tau, fast) if not one.real else (fast, fast)
            value = {"tau": tau, "tau1": tau, "tau2": fast, "tau3": fast, "T": np.sqrt(np.prod(pair)),
                     "zeta": sum(pair) / 2 / np.sqrt(np.prod(pair)), "tau_zero": 0.0,
                     "dead_time": max(process.dead_time - fast * (one.order - less.order), 0.0)}
            x[u.slices[f"dynamics{p}"]] = one.numbers(np.array([value[name] for name in one.names]))
        x[u.dynamic] = box.clip(x[u.dynamic])
        found.append(x)
    return found


def best_descents(errors: ProcessErrors, box: ProcessBox) -> list[ProcessPoint]:
    """Descend from all starts, on part of a long record first, and return different ends, the best first."""
    coarse = errors.first_part(COARSE, CHANGES)
    ends = sorted((descend(coarse, x, box, steps=30, tolerance=1e-7)[0]
                   for x in (*starts(coarse, box), *simpler(coarse, box))), key=lambda one: one.value)
    kept: list[ProcessPoint] = []
    for end in ends:
        if end.value <= 3 * ends[0].value and all(np.max(np.abs(end.numbers - one.numbers)) > 0.05 for one in kept):
            kept.append(end)
    found = [descend(errors, one.x, box)[0] for one in kept[: 2 if coarse is not errors else 3]]
    return sorted(found, key=lambda one: one.value)
