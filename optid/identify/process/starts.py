"""Starts of descents: a coarse grid over one time scale, the damping, the zero and the dead time of every input.

For every point of the grid the response gives a Gram matrix with the output and the columns that do not move; the sum
of squares follows from it. Responses to all dead times are run by one kernel.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from optid.arrays import Array
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend
from optid.identify.process.errors import ProcessErrors
from optid.kernel_cache import cached_njit
from optid.models.process_dynamics import ProcessDynamics, ProcessStructure
from optid.models.process_kernel import run

SCALES, DELAYS = 12, 24  # time scales and dead times of the grid
FASTEST = 0.05  # samples of the smallest time constant
RATIOS = (1.0, 0.4, 0.16)  # time constants over the scale
DAMPINGS, ZEROS = (0.2, 0.5, 1.0), (0.5, -0.5)  # of the grid; zeros over the scale
COARSE, CHANGES = 400, 1000  # samples of every experiment, and changes of its input, on which starts are compared
APART = 0.06  # share of the bounds in which two starts that are both kept differ at least
KEPT = 4  # starts that descend


@cached_njit
def gram_matrices(F, C, instants, course, thetas, still, settings):  # noqa: N803
    """Return the Gram matrices (D, M + s, M + s) of [responses, still columns] for all dead times (D,).

    The course are the times (J,) and values (J, M) of the input. The still columns (N, s) end with the output; the
    first M rows of `settings` (M + 1,) are what is added to every response, the last says whether the input goes
    straight.
    """
    changes, inputs = course
    m, s = inputs.shape[1], still.shape[1]
    found = np.zeros((len(thetas), m + s, m + s))
    row, later, start = np.zeros(m + s), np.zeros(len(changes)), np.zeros((len(F), m))
    for i in range(len(thetas)):
        for j in range(len(changes)):
            later[j] = changes[j] + thetas[i]
        sides = settings[m] > 0.0, settings[m] >= 0.0  # a literal True would have the kernel compiled once more
        response = run(F, C, instants, later, inputs, sides, start)
        for k in range(len(instants)):
            for c in range(m):
                row[c] = response[k, 0, c] + settings[c]
            for c in range(s):
                row[m + c] = still[k, c]
            for a in range(m + s):
                for b in range(m + s):
                    found[i, a, b] += row[a] * row[b]
    return found


def usual_box(errors: ProcessErrors) -> ProcessBox:
    """Return usual bounds: time constants from a twentieth of a sample to ten records, and dead times.

    These leave at least a quarter of what follows the first change of the input.
    """
    low, high, span = [], [], errors.length
    for c, structure in enumerate(errors.unknowns.structures):
        after = max((float(t[-1] - drives[c].changes[1]) for t, drives in zip(errors.instants, errors.drives)
                     if len(drives[c].changes) > 1), default=0.0)
        ends = {"zeta": (np.log(0.02), np.log(20.0)), "tau_zero": (-3 * span, 3 * span),
                "dead_time": (0.0, 0.75 * after)}
        for name in structure.names:
            one = ends.get(name, (np.log(FASTEST), np.log(10 * span)))
            low.append(one[0])
            high.append(one[1])
    return ProcessBox(np.array(low), np.array(high))


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


def scan(errors: ProcessErrors, c: int, box: ProcessBox, others: Array) -> list[tuple[float, Array]]:
    """Return (sum of squares, numbers) of input c on the grid, the best first, beside columns (rows, s) of others."""
    structure, first = errors.unknowns.structures[c], sum(len(s.names) for s in errors.unknowns.structures[:c])
    part = slice(first, first + len(structure.names))
    low, high = box.low[part], box.high[part]
    thetas = np.unique(np.linspace(low[-1], high[-1], DELAYS)) if structure.delay else np.zeros(1)
    still, found = np.column_stack([others, errors.y]), []
    m = errors.unknowns.sizes[c]
    for numbers in grid(structure, low, high):
        f, row = ProcessDynamics(structure, structure.parameters(numbers)).plain
        total = np.zeros((len(thetas), m + still.shape[1], m + still.shape[1]))
        for t, drives, span in zip(errors.read_at, errors.drives, errors.spans):
            drive = drives[c]
            level = np.zeros(m) if structure.integrator else drive.values[0]
            settings = np.append(level, float(errors.straight))
            course = drive.changes, np.ascontiguousarray(drive.about_rest)
            total += gram_matrices(f, row, t, course, thetas, np.ascontiguousarray(still[span]), settings)
        for theta, value in zip(thetas, _least(total)):
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
    u, x = errors.unknowns, np.zeros(errors.unknowns.size)
    at, m = u.dynamic, errors.data.m
    x[at] = (box.low + np.maximum(np.minimum(box.high, box.low + 4), box.low)) / 2
    constant = np.ones((len(errors.y), 1))[:, : int(u.constant or u.levels)]
    done: dict[int, Array] = {}
    chosen: list[Array] = []
    for _ in range(1 if m == 1 else 2):
        for c in range(m):
            others: list[Array] = [constant]
            for i, numbers in done.items():
                if i != c:
                    x[u.slices[f"dynamics{i}"]] = numbers
            whole = errors.columns(x) if done else constant
            position = 0
            for i in range(m):
                if i in done and i != c:
                    others.append(whole[:, position : position + u.sizes[i]])
                position += u.sizes[i]
            ranked = scan(errors, c, box, np.column_stack(others))
            done[c] = ranked[0][1]
            chosen = []
            for _, numbers in ranked:
                point = x.copy()
                for i, best in done.items():
                    point[u.slices[f"dynamics{i}"]] = best
                point[u.slices[f"dynamics{c}"]] = numbers
                width = np.maximum(box.high - box.low, 1e-300)
                if all(np.max(np.abs(point[at] - one[at]) / width) > APART for one in chosen):
                    chosen.append(point)
                if len(chosen) == KEPT:
                    break
    return chosen


def simpler(errors: ProcessErrors, box: ProcessBox) -> list[Array]:
    """Return the best processes of at most one real pole, without a zero, as points of types with more of them.

    A richer type then fits no worse: the poles that it adds are the fastest that are tried.
    """
    structures = errors.unknowns.structures
    fewer = tuple(replace(one, real=min(one.real + 2 * one.pair, 1), pair=False, zero=False) for one in structures)
    if fewer == structures:
        return []
    plain = replace(errors, unknowns=replace(errors.unknowns, structures=fewer))
    inner = usual_box(plain)
    found = []
    for point in (descend(plain, x, inner, steps=30, tolerance=1e-7)[0] for x in starts(plain, inner)[:2]):
        x = np.zeros(errors.unknowns.size)
        for c, (one, less, process) in enumerate(zip(structures, fewer, plain.processes(point.x))):
            fast, tau = 2 * FASTEST, process.value("tau")
            pair = (tau, fast) if not one.real else (fast, fast)
            value = {"tau": tau, "tau1": tau, "tau2": fast, "tau3": fast, "T": np.sqrt(np.prod(pair)),
                     "zeta": sum(pair) / 2 / np.sqrt(np.prod(pair)), "tau_zero": 0.0,
                     "dead_time": max(process.dead_time - fast * (one.order - less.order), 0.0)}
            x[errors.unknowns.slices[f"dynamics{c}"]] = one.numbers(np.array([value[name] for name in one.names]))
        x[errors.unknowns.dynamic] = np.clip(x[errors.unknowns.dynamic], box.low, box.high)
        found.append(x)
    return found


def best_descents(errors: ProcessErrors, box: ProcessBox) -> list[ProcessPoint]:
    """Descend from all starts, on part of a long record first, and return different ends, the best first."""
    coarse = errors.first_part(COARSE, CHANGES)
    ends = sorted((descend(coarse, x, box, steps=30, tolerance=1e-7)[0]
                   for x in (*starts(coarse, box), *simpler(coarse, box))), key=lambda one: one.value)
    kept: list[ProcessPoint] = []
    for end in ends:
        if end.value <= 3 * ends[0].value and all(
                np.max(np.abs(end.x - one.x)[errors.unknowns.dynamic]) > 0.05 for one in kept):
            kept.append(end)
    found = [descend(errors, one.x, box)[0] for one in kept[: 2 if coarse is not errors else 3]]
    return sorted(found, key=lambda one: one.value)
