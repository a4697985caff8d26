"""Intervals of dead times by profile likelihood: everything else is fitted again at every dead time.

Errors have kinks in a dead time, and it may lie at zero; the profile says what the quadratic approximation behind a
standard error does not. Under coloured errors the likelihood ratio is divided by how much larger the variance of the
estimate is than under white ones (Chandler and Bate, Biometrika 94, 2007).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from optid.identify.process.descent import ProcessBox, ProcessPoint, descend
from optid.identify.process.errors import ProcessErrors

LONGEST = 5_000  # outputs up to which profiles are worth their time; with more of them errors are all but quadratic
DOUBLINGS = 30  # of the step towards the end of an interval
EXACT = 1e-4  # of the width of an interval, to which its ends are found


@dataclass(frozen=True, eq=False)
class DeadTimeProfiles:
    """Intervals of the dead times of a fit by their names, in units of time."""

    errors: ProcessErrors
    boxes: Sequence[ProcessBox]
    points: Sequence[ProcessPoint]  # optimum of every output
    found: dict[tuple[str, float, float | None], tuple[float, float]] = field(default_factory=dict, repr=False)

    def __call__(self, name: str, level: float, coloured: float | None = None) -> tuple[float, float] | None:
        """Return the interval of a dead time, None of anything else, of one that is fixed, and of a long record.

        Args:
            name: of the parameter.
            level: probability that the interval contains the truth.
            coloured: standard error under coloured errors, None where they are white.
        """
        pairs = range(len(self.errors.unknowns.pairs))
        p = next((p for p in pairs if self.errors.key("dead_time", p) == name), None)
        if p is None or p not in self.errors.unknowns.delays:
            return None
        o, first = self.errors.unknowns.pairs[p][0], [output for output, _ in self.errors.unknowns.pairs]
        box, best = self.boxes[o], self.points[o]
        place = best.errors.unknowns.delays[p - first.index(o)]
        if len(best.rest) > LONGEST or not box.low[place] < box.high[place]:
            return None
        if (name, level, coloured) not in self.found:
            dt = self.errors.data.dt
            low, high = _interval(best, box, place, level, None if coloured is None else coloured / dt)
            self.found[name, level, coloured] = low * dt, high * dt
        return self.found[name, level, coloured]


def _interval(best: ProcessPoint, box: ProcessBox, place: int, level: float, coloured: float | None
              ) -> tuple[float, float]:
    """Return the ends of the interval of the number at a place, in sampling times."""
    from scipy.stats import f as fisher

    dof, width = len(best.rest) - len(best.x), _width(best, place)
    # what the colour of errors lets intervals gain is smaller than what a short record is wrong about it
    ratio = 1.0 if coloured is None else max((coloured / width) ** 2, 1.0)
    most = best.value * (1 + ratio * float(fisher.ppf(level, 1, dof)) / dof)
    return _end(best, box, place, -width, most), _end(best, box, place, width, most)


def _end(best: ProcessPoint, box: ProcessBox, place: int, step: float, most: float) -> float:
    """Return where the profile reaches a value on the side of a step, or the bound of the box."""
    from scipy.optimize import root_scalar

    here = best

    def excess(theta: float) -> float:
        nonlocal here
        there = descend(best.errors, here.x, box.within(place, theta, theta), steps=30, tolerance=1e-8)[0]
        here = there if there.value <= most else here
        return there.value - most

    inside, bound = float(best.numbers[place]), float(box.low[place] if step < 0 else box.high[place])
    for _ in range(DOUBLINGS):
        outside = float(np.clip(inside + step, box.low[place], box.high[place]))
        if excess(outside) > 0:
            return float(root_scalar(excess, method="brentq", bracket=(inside, outside), xtol=EXACT * abs(step),
                                     rtol=1e-12).root)
        inside, step = outside, 1.5 * step
        if outside == bound:
            break
    return bound


def _width(best: ProcessPoint, place: int) -> float:
    """Return the standard error of a dead time by the derivatives at the optimum, the first step of the search."""
    slopes = best.slopes()
    others = np.delete(slopes, place, axis=1)
    own = np.linalg.norm(slopes[:, place] - others @ np.linalg.lstsq(others, slopes[:, place], rcond=1e-10)[0])
    return max(best.noise / max(float(own), 1e-300), 1e-6) if own > 0 else 1.0
