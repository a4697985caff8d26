"""Descents in the dynamics of processes, everything linear projected out, within bounds and from kink to kink.

Between two kinks of a dead time the errors are smooth. A descent first goes on over kinks as if there were none; then
the cells around its end are searched one by one, with the derivative of their inner side at their edges.
"""

from dataclasses import dataclass
from functools import cached_property

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

    errors: ProcessErrors
    x: Array  # the unknowns
    value: float  # sum of squared errors
    columns: Array  # (rows, L) of the linear unknowns
    rest: Array  # (rows,) record less model

    @classmethod
    def of(cls, errors: ProcessErrors, x: Array) -> "ProcessPoint":
        """Fit the linear unknowns to the dynamics in x."""
        columns, x, linear = errors.columns(x), np.array(x, dtype=float), errors.unknowns.linear
        x[linear] = _least_squares(columns, errors.y)
        rest = errors.y - columns @ x[linear]
        return cls(errors, x, float(rest @ rest), columns, rest)

    def at(self, numbers: Array) -> "ProcessPoint":
        """Return the point with other numbers (k,) of all processes."""
        x = self.x.copy()
        x[self.errors.unknowns.dynamic] = numbers
        return ProcessPoint.of(self.errors, x)

    @property
    def numbers(self) -> Array:
        """The numbers (k,) of all processes."""
        return self.x[self.errors.unknowns.dynamic]

    @cached_property
    def _basis(self) -> Array:
        return np.linalg.qr(self.columns)[0]

    def without_linear(self, columns: Array) -> Array:
        """Return what the linear unknowns leave of columns (rows, k)."""
        return columns - self._basis @ (self._basis.T @ columns)

    def slopes(self, late: bool = True) -> Array:
        """Return the derivatives (rows, k) of the outputs by the numbers, everything linear fitted again."""
        return self.without_linear(self.errors.slopes(self.x, late))

    def valley(self, place: int) -> Array:
        """Return how all numbers (k,) move with the one at a place along the valley of the errors."""
        slopes = self.slopes()
        others = np.arange(slopes.shape[1]) != place
        direction = np.ones(slopes.shape[1])
        direction[others] = -np.linalg.lstsq(slopes[:, others], slopes[:, place], rcond=1e-10)[0]
        return direction

    def falls_along(self, box: "ProcessBox") -> float:
        """Return by which share the sum of squares falls at most along the Gauss-Newton step, whole or in any part.

        Where the record hardly shows a direction the step is long, and what its linear model promises does not come.
        """
        step = np.linalg.lstsq(self.slopes(), self.rest, rcond=1e-14)[0]
        least = min(self.at(box.clip(self.numbers + part * step)).value for part in 0.25 ** np.arange(25))
        return max(1 - least / max(self.value, 1e-300), 0.0)

    def join_equal(self) -> "ProcessPoint":
        """Return the point with time constants made equal that differ little, where that costs nothing.

        The errors are symmetric in them: where a complex pair would fit better, the best real poles are equal.
        """
        x, u = self.x.copy(), self.errors.unknowns
        for p, structure in enumerate(u.structures):
            logs = x[u.slices[f"dynamics{p}"]][: structure.real]  # a view
            for i in range(1, structure.real):
                one, other = np.argsort(-logs)[i - 1 : i + 1]
                if logs[one] - logs[other] < EQUAL:
                    logs[[one, other]] = (logs[one] + logs[other]) / 2
        joined = ProcessPoint.of(self.errors, x)
        return joined if joined.value <= self.value * (1 + COSTS_NOTHING) else self

    @property
    def noise(self) -> float:
        """Standard deviation of the errors."""
        return float(np.sqrt(self.value / max(len(self.rest) - len(self.x), 1)))


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

    def within(self, place: int, low: float, high: float) -> "ProcessBox":
        """Return the box with one number between two values."""
        here = np.arange(len(self.low)) == place
        return ProcessBox(np.where(here, np.maximum(low, self.low), self.low),
                          np.where(here, np.minimum(high, self.high), self.high))

    def clip(self, numbers: Array) -> Array:
        """Return the nearest numbers inside."""
        return np.clip(numbers, self.low, self.high)


def descend(errors: ProcessErrors, x: Array, box: ProcessBox, *, steps: int = STEPS, late: bool = True,
            tolerance: float = ARRIVED) -> tuple[ProcessPoint, int]:
    """Lower the sum of squares by Levenberg-Marquardt steps; return the end, and the steps.

    Args:
        errors: the errors.
        x: where to start; the dynamics count.
        box: bounds of the dynamics.
        steps: at most.
        late: side of the derivative by dead times at a kink, see `ProcessDynamics.response`.
        tolerance: relative gain of a full step at which a descent has arrived.
    """
    x, at, logs = np.array(x, dtype=float), errors.unknowns.dynamic, errors.unknowns.logarithmic
    x[at] = box.clip(x[at])
    here, damping = ProcessPoint.of(errors, x), 1e-3
    for count in range(1, steps + 1):
        slopes, q = here.slopes(late), here.numbers
        pull, gram = slopes.T @ here.rest, slopes.T @ slopes
        free = ~(((q <= box.low) & (pull < 0)) | ((q >= box.high) & (pull > 0))) & (np.diag(gram) > 0)
        if not free.any():
            return here, count
        inner, side = gram[np.ix_(free, free)], pull[free]
        size = np.sqrt(np.diag(inner))
        scaled = inner / np.outer(size, size)
        if side / size @ np.linalg.lstsq(scaled, side / size, rcond=1e-12)[0] <= tolerance * here.value:
            return here, count
        while True:
            step = np.zeros(len(q))
            step[free] = np.linalg.solve(scaled + damping * np.eye(len(side)), side / size) / size
            step[logs] = np.clip(step[logs], -LARGEST, LARGEST)
            there = here.at(box.clip(q + step))
            if there.value < here.value or damping > 1e8:
                break
            damping *= 5
        if not there.value < here.value:
            return here, count
        gain, moved = here.value - there.value, there.numbers - q
        ratio = gain / max(2 * moved @ pull - moved @ gram @ moved, 1e-300)
        damping = max(damping / 10, 1e-10) if ratio > GOOD else max(5 * damping, 1e-6) if ratio < POOR else damping
        if gain <= tolerance * here.value:
            return there, count
        here = there
    return here, steps


def search_cells(start: ProcessPoint, box: ProcessBox) -> ProcessPoint:
    """Return the best point of the cells of all dead times around a point."""
    best = start
    for _ in range(3):
        before = best.value
        for p, place in start.errors.unknowns.delays.items():
            best = _best_cell(best, box, p, place)
        if best.value >= before * (1 - BETTER):
            break
    return best


def sharpen(start: ProcessPoint, box: ProcessBox) -> tuple[ProcessPoint, int]:
    """Return the optimum of the cells of a point to the last digits, and the steps that it took."""
    for p, place in start.errors.unknowns.delays.items():
        box = box.within(place, *start.errors.cell(start.x, p))
    end, steps = descend(start.errors, start.x, box, steps=VALLEY, tolerance=SHARP)
    return min(start, end, key=lambda one: one.value), steps


def _best_cell(start: ProcessPoint, box: ProcessBox, p: int, place: int) -> ProcessPoint:
    """Descend in the cell of a dead time, then in those whose middle a step along the valley finds promising."""
    errors, best, theta = start.errors, start, start.numbers[place]
    short, valley, promising = len(errors.y) <= LONG, start.valley(place), []
    for low, high in _cells(errors, p, theta, box.low[place], box.high[place]):
        tried = [start.at(box.clip(start.numbers + valley * (low + part * (high - low) - theta)))
                 for part in ([0.1, 0.5, 0.9] if short else [0.5])]
        promising.append((min(tried, key=lambda one: one.value), low, high))
    promising.sort(key=lambda one: one[0].value)
    for point, low, high in promising[: 4 if short else 2]:
        inside, x = box.within(place, low, high), point.x
        for late in (False, True):  # at the lower edge the right side is inside, at the upper edge the left one
            end = descend(errors, x, inside, late=late)[0]
            if end.value < best.value * (1 - BETTER):
                best = end
            if min(abs(end.numbers[place] - low), abs(end.numbers[place] - high)) > 1e-9:
                break
            x = end.x
        if point.value > best.value * 1.5:
            break
    return best


def _cells(errors: ProcessErrors, p: int, theta: float, least: float, most: float) -> list[tuple[float, float]]:
    """Return the cells (low, high) of a dead time on both sides of a value."""
    low, high = errors.kinks(p, theta)
    below, above = [low], [high]
    for _ in range(NEAR):
        if below[-1] > least:
            below.append(errors.kinks(p, below[-1])[0])
        if above[-1] < most:
            above.append(errors.kinks(p, above[-1] + 1e-7)[1])
    edges = np.clip([*below[::-1], *above], least, most).tolist()
    return [(a, b) for a, b in zip(edges, edges[1:]) if b > a]
