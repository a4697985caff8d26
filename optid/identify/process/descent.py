"""Descents in the dynamics of processes, everything linear projected out, within bounds and from kink to kink.

Between two kinks of a dead time the errors are smooth. A descent first goes on over kinks as if there were none; then
the cells around its end are searched one by one, with the derivative of their inner side at their edges.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.identify.process.errors import ProcessErrors

STEPS, ARRIVED = 60, 1e-10  # steps of a descent; relative gain of a full step that is none
GOOD, POOR = 0.75, 0.25  # shares of the expected gain above, and below, which damping falls, and rises
SHARP, VALLEY = 1e-15, 300  # the same of a point that is reported, and steps to it
LARGEST = 2.0  # largest change of the logarithm of a time constant in a step
SHORT, GRAM = 1000, 1e-6  # rows up to which columns are factorised; least eigenvalue of a scaled Gram matrix
RANK = 1e-11  # singular value of the columns of the linear unknowns, relative to the largest, that counts as zero
EQUAL, COSTS_NOTHING = 0.05, 1e-4  # difference of logarithms of time constants that may vanish; relative cost then
NEAR = 8  # cells on either side that are searched
LONG = 2000  # outputs beyond which a cell is looked at in its middle alone, and two cells are searched
BETTER = 1e-9  # relative gain by which another cell is better


@dataclass(frozen=True, eq=False)
class ProcessPoint:
    """Dynamics with everything linear fitted."""

    x: Array  # the unknowns of the errors
    value: float  # sum of squared errors
    columns: Array  # (rows, L) of the linear unknowns
    errors: Array  # (rows,) record less model

    @classmethod
    def of(cls, errors: ProcessErrors, x: Array) -> "ProcessPoint":
        """Fit the linear unknowns to the dynamics in x."""
        columns = errors.columns(x)
        linear = _least_squares(columns, errors.y)
        rest = errors.y - columns @ linear
        return cls(errors.with_linear(x, linear), float(rest @ rest), columns, rest)


def _least_squares(columns: Array, y: Array) -> Array:
    """Solve for the coefficients (L,) of columns: by their Gram matrix where it has the digits, which is faster."""
    gram = columns.T @ columns
    sizes = np.sqrt(np.diag(gram))
    sizes = np.where(sizes > 0, sizes, 1.0)
    scaled = gram / np.outer(sizes, sizes)
    if len(y) > SHORT and np.linalg.eigvalsh(scaled)[0] > GRAM:
        return np.linalg.solve(scaled, columns.T @ y / sizes) / sizes
    return np.linalg.lstsq(columns / sizes, y, rcond=RANK)[0] / sizes


@dataclass(frozen=True, eq=False)
class ProcessBox:
    """Bounds (k,) of the numbers of all processes one after another."""

    low: Array
    high: Array

    def within(self, c: int, low: float, high: float) -> "ProcessBox":
        """Return the box with number c between two values."""
        place = np.arange(len(self.low)) == c
        return ProcessBox(np.where(place, np.maximum(low, self.low), self.low),
                          np.where(place, np.minimum(high, self.high), self.high))


def descend(errors: ProcessErrors, x: Array, box: ProcessBox, *, steps: int = STEPS, late: bool = True,
            tolerance: float = ARRIVED) -> tuple[ProcessPoint, bool, int]:
    """Lower the sum of squares by Levenberg-Marquardt steps; return the end, whether it arrived, and the steps.

    Args:
        errors: the errors.
        x: where to start; the dynamics count.
        box: bounds of the dynamics.
        steps: at most.
        late: side of the derivative by dead times at a kink, see `ProcessDynamics.response`.
        tolerance: relative gain of a full step at which a descent has arrived.
    """
    at, logs = errors.unknowns.dynamic, np.concatenate([one.logarithmic for one in errors.unknowns.structures])
    x = np.array(x, dtype=float)
    x[at] = np.clip(x[at], box.low, box.high)
    here, damping = ProcessPoint.of(errors, x), 1e-3
    for count in range(1, steps + 1):
        slopes = errors.slopes(here.x, late)
        basis = np.linalg.qr(here.columns)[0]
        slopes = slopes - basis @ (basis.T @ slopes)
        pull, gram, q = slopes.T @ here.errors, slopes.T @ slopes, here.x[at]
        free = ~(((q <= box.low) & (pull < 0)) | ((q >= box.high) & (pull > 0))) & (np.diag(gram) > 0)
        if not free.any():
            return here, True, count
        inner, side = gram[np.ix_(free, free)], pull[free]
        size = np.sqrt(np.diag(inner))
        scaled = inner / np.outer(size, size)
        if side / size @ np.linalg.lstsq(scaled, side / size, rcond=1e-12)[0] <= tolerance * here.value:
            return here, True, count
        while True:
            step = np.zeros(len(q))
            step[free] = np.linalg.solve(scaled + damping * np.eye(len(side)), side / size) / size
            step[logs] = np.clip(step[logs], -LARGEST, LARGEST)
            moved = here.x.copy()
            moved[at] = np.clip(q + step, box.low, box.high)
            there = ProcessPoint.of(errors, moved)
            if there.value < here.value or damping > 1e8:
                break
            damping *= 5
        if not there.value < here.value:
            return here, True, count
        settled = here.value - there.value <= tolerance * here.value
        moved = there.x[at] - q
        ratio = (here.value - there.value) / max(2 * moved @ pull - moved @ gram @ moved, 1e-300)
        damping = max(damping / 10, 1e-10) if ratio > GOOD else max(5 * damping, 1e-6) if ratio < POOR else damping
        here = there
        if settled:
            return here, True, count
    return here, False, steps


def search_cells(errors: ProcessErrors, start: ProcessPoint, box: ProcessBox) -> ProcessPoint:
    """Return the best point of the cells of all dead times around a point."""
    best = start
    for _ in range(3):
        before = best.value
        for c, place in _delays(errors):
            best = _best_cell(errors, best, box, c, place)
        if best.value >= before * (1 - BETTER):
            break
    return best


def sharpen(errors: ProcessErrors, start: ProcessPoint, box: ProcessBox) -> tuple[ProcessPoint, int]:
    """Return the optimum of the cells of a point to the last digits, and the steps that it took."""
    for c, place in _delays(errors):
        box = box.within(place, *errors.cell(start.x, c))
    end, _, steps = descend(errors, start.x, box, steps=VALLEY, tolerance=SHARP)
    return min(start, end, key=lambda one: one.value), steps


def falls_along(errors: ProcessErrors, start: ProcessPoint, box: ProcessBox) -> float:
    """Return by which share the sum of squares falls at most along the Gauss-Newton step, whole or in any part.

    Where the record hardly shows a direction the step is long, and what its linear model promises does not come.
    """
    at, basis = errors.unknowns.dynamic, np.linalg.qr(start.columns)[0]
    slopes = errors.slopes(start.x)
    slopes = slopes - basis @ (basis.T @ slopes)
    step = np.linalg.lstsq(slopes, start.errors, rcond=1e-14)[0]
    least = start.value
    for part in 0.25 ** np.arange(25):
        x = start.x.copy()
        x[at] = np.clip(x[at] + part * step, box.low, box.high)
        least = min(least, ProcessPoint.of(errors, x).value)
    return 1 - least / max(start.value, 1e-300)


def join_equal(errors: ProcessErrors, start: ProcessPoint) -> ProcessPoint:
    """Return the point with time constants made equal that differ little, where that costs nothing.

    The errors are symmetric in them: where a complex pair would fit better, the best real poles are equal.
    """
    x = start.x.copy()
    for c, structure in enumerate(errors.unknowns.structures):
        first = errors.unknowns.slices[f"dynamics{c}"].start
        logs = x[first : first + structure.real]
        for i in range(1, structure.real):
            order = np.argsort(-logs)
            one, other = order[i - 1], order[i]
            if logs[one] - logs[other] < EQUAL:
                logs[[one, other]] = (logs[one] + logs[other]) / 2
    joined = ProcessPoint.of(errors, x)
    return joined if joined.value <= start.value * (1 + COSTS_NOTHING) else start


def _delays(errors: ProcessErrors) -> Iterator[tuple[int, int]]:
    """Yield inputs with dead time, and the place of it among the numbers of all processes."""
    place = -1
    for c, structure in enumerate(errors.unknowns.structures):
        place += len(structure.names)
        if structure.delay:
            yield c, place


def _best_cell(errors: ProcessErrors, start: ProcessPoint, box: ProcessBox, c: int, place: int) -> ProcessPoint:
    """Descend in the cell of a dead time, then in those whose middle a step along the valley finds promising."""
    at = errors.unknowns.dynamic
    best = start
    cells = _cells(errors, c, float(start.x[at[place]]), box.low[place], box.high[place])
    valley = _valley(errors, start, place)
    promising = []
    for low, high in cells:
        values = []
        for theta in np.array([0.1, 0.5, 0.9] if len(errors.y) <= LONG else [0.5]) * (high - low) + low:
            x = start.x.copy()
            x[at] = np.clip(x[at] + valley * (theta - x[at[place]]), box.low, box.high)
            values.append((ProcessPoint.of(errors, x).value, x))
        promising.append((*min(values, key=lambda one: one[0]), low, high))
    promising.sort(key=lambda one: one[0])
    for value, x, low, high in promising[: 4 if len(errors.y) <= LONG else 2]:
        inside = box.within(place, low, high)
        for late in (False, True):  # at the lower edge the right side is inside, at the upper edge the left one
            end = descend(errors, x, inside, late=late)[0]
            if end.value < best.value * (1 - BETTER):
                best = end
            if not min(abs(end.x[at[place]] - low), abs(end.x[at[place]] - high)) <= 1e-9:
                break
            x = end.x
        if value > best.value * 1.5:
            break
    return best


def _cells(errors: ProcessErrors, c: int, theta: float, least: float, most: float) -> list[tuple[float, float]]:
    """Return the cells (low, high) of a dead time on both sides of a value."""
    low, high = errors.kinks(c, theta)
    if high <= theta + 1e-9:
        cells = [(low, high)]
    else:
        cells = [(low, min(high, most))]
    below, above = cells[0]
    for _ in range(NEAR):
        if below > least:
            under = errors.kinks(c, below)[0]
            cells.append((max(under, least), below))
            below = under
        if above < most:
            over = errors.kinks(c, above + 1e-7)[1]
            cells.append((above, min(over, most)))
            above = over
    return [(max(a, least), min(b, most)) for a, b in cells if min(b, most) > max(a, least)]


def _valley(errors: ProcessErrors, here: ProcessPoint, place: int) -> Array:
    """Return how all numbers move with the dead time at a place along the valley of the errors."""
    slopes = errors.slopes(here.x)
    basis = np.linalg.qr(here.columns)[0]
    slopes = slopes - basis @ (basis.T @ slopes)
    others = np.arange(slopes.shape[1]) != place
    direction = np.ones(slopes.shape[1])
    direction[others] = -np.linalg.lstsq(slopes[:, others], slopes[:, place], rcond=1e-10)[0]
    return direction
