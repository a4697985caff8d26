"""Intervals of dead times by profile likelihood: everything else is fitted again at every dead time.

Errors have kinks in a dead time, and it may lie at zero; the profile says what the quadratic approximation behind a
standard error does not. Under coloured errors the likelihood ratio is divided by how much larger the variance of the
estimate is than under white ones (Chandler and Bate, Biometrika 94, 2007).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from optid.arrays import Array
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.outputs import OutputErrors

LONGEST = 5_000  # outputs up to which profiles are worth their time; with more of them errors are all but quadratic
HALVINGS, DOUBLINGS = 20, 30  # of the way to the end of an interval, and of the step towards it
EXACT = 1e-3  # of the width of an interval, to which its ends are found


@dataclass(frozen=True, eq=False)
class DeadTimeProfiles:
    """Intervals of the dead times of a fit by their names, in units of time."""

    errors: OutputErrors
    boxes: Sequence[ProcessBox]
    points: Sequence[Array]  # unknowns of every output at the optimum
    found: dict[tuple[str, float, float | None], tuple[float, float]] = field(default_factory=dict, repr=False)

    def __call__(self, name: str, level: float, coloured: float | None = None) -> tuple[float, float] | None:
        """Return the interval of a dead time, None of anything else, of one that is fixed, and of a long record.

        Args:
            name: of the parameter.
            level: probability that the interval contains the truth.
            coloured: standard error under coloured errors, None where they are white.
        """
        if not name.startswith("dead_time"):
            return None
        for o, (one, box, x) in enumerate(zip(self.errors.each, self.boxes, self.points)):
            for c, structure in enumerate(one.unknowns.structures):
                place = one.place(c)
                if self.errors.outer(o, one.key("dead_time", c)) != name or not structure.delay:
                    continue
                if len(one.y) > LONGEST or not box.low[place] < box.high[place]:
                    return None
                if (name, level, coloured) not in self.found:
                    low, high = _interval(one, box, x, place, level, coloured)
                    self.found[name, level, coloured] = low * one.data.dt, high * one.data.dt
                return self.found[name, level, coloured]
        return None


def _interval(errors: ProcessErrors, box: ProcessBox, x: Array, place: int, level: float, coloured: float | None
              ) -> tuple[float, float]:
    """Return the ends of the interval of the number at a place, in sampling times."""
    from scipy.stats import f as fisher

    best, dof = ProcessPoint.of(errors, x), len(errors.y) - errors.unknowns.size
    width = _width(errors, best, place)
    # what the colour of errors lets intervals gain is smaller than what a short record is wrong about it
    ratio = 1.0 if coloured is None else max((coloured / errors.data.dt / width) ** 2, 1.0)
    most = best.value * (1 + ratio * float(fisher.ppf(level, 1, dof)) / dof)
    low, high = (_end(errors, box, best, place, sign * width, most) for sign in (-1.0, 1.0))
    return low, high


def _end(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint, place: int, step: float, most: float) -> float:
    """Return where the profile reaches a value on the side of a step, or the bound of the box."""
    at = errors.unknowns.dynamic
    theta, bound = float(best.x[at[place]]), float(box.low[place] if step < 0 else box.high[place])
    inside, outside, here = theta, None, best
    for _ in range(DOUBLINGS):
        moved = min(max(inside + step, box.low[place]), box.high[place])
        there = _fitted(errors, box, here, place, moved)
        if there.value > most:
            outside = moved
            break
        inside, here, step = moved, there, 1.5 * step
        if moved == bound:
            return bound
    if outside is None:
        return bound
    for _ in range(HALVINGS):
        if abs(outside - inside) <= EXACT * (abs(inside - theta) + 1e-9):
            break
        middle = (inside + outside) / 2
        there = _fitted(errors, box, here, place, middle)
        if there.value > most:
            outside = middle
        else:
            inside, here = middle, there
    return inside


def _fitted(errors: ProcessErrors, box: ProcessBox, start: ProcessPoint, place: int, theta: float) -> ProcessPoint:
    held = box.within(place, theta, theta)
    return descend(errors, start.x, ProcessBox(np.where(np.arange(len(box.low)) == place, theta, held.low),
                                               np.where(np.arange(len(box.low)) == place, theta, held.high)),
                   steps=30, tolerance=1e-8)[0]


def _width(errors: ProcessErrors, best: ProcessPoint, place: int) -> float:
    """Return the standard error of a dead time by the derivatives at the optimum, the first step of the search."""
    slopes = errors.slopes(best.x)
    basis = np.linalg.qr(best.columns)[0]
    slopes = slopes - basis @ (basis.T @ slopes)
    others = np.delete(slopes, place, axis=1)
    own = slopes[:, place] - others @ np.linalg.lstsq(others, slopes[:, place], rcond=1e-10)[0]
    noise = np.sqrt(best.value / max(len(errors.y) - errors.unknowns.size, 1))
    return max(float(noise / max(np.linalg.norm(own), 1e-300)), 1e-6) if np.linalg.norm(own) > 0 else 1.0
