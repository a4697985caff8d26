"""Intervals by profile likelihood: everything else is fitted again at every value of a dead time or a time constant.

Errors have kinks in a dead time, and it may lie at zero, as may a time constant that is hardly seen; the profile says
what the quadratic approximation behind a standard error does not. Under coloured errors the likelihood ratio is divided
by how much larger the variance of the estimate is than under white ones (Chandler and Bate, Biometrika 94, 2007).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from optid.arrays import Array
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.separation import TAUS

LONGEST = 5_000  # outputs up to which profiles are worth their time; with more of them errors are all but quadratic
DOUBLINGS = 30  # of the step towards the end of an interval
EXACT = 1e-4  # of the width of an interval, to which its ends are found
QUADRATIC = ("T", "tau_zero")  # parameters of which standard errors say enough
WIDE = 0.5  # standard error of the logarithm of a time constant from which on errors are not quadratic in it


@dataclass(frozen=True, eq=False)
class ProcessProfiles:
    """Intervals of dead times, and of time constants and dampings that are hardly seen, by their names."""

    errors: ProcessErrors
    boxes: Sequence[ProcessBox]
    points: Sequence[ProcessPoint]  # optimum of every output
    found: dict[tuple[str, float, bool], tuple[float, float]] = field(default_factory=dict, repr=False)

    def __call__(self, name: str, level: float, estimate: float, error: float, coloured: bool
                 ) -> tuple[float, float] | None:
        """Return the interval of a parameter; None where its standard error says it, or it is fixed.

        Args:
            name: of the parameter.
            level: probability that the interval contains the truth.
            estimate: of the parameter.
            error: its standard error.
            coloured: whether the standard error is one under coloured errors.
        """
        u, there = self.errors.unknowns, [(j, p, word) for j, (p, word) in enumerate(self.errors.unknowns.numbers)
                                          if self.errors.key(word, p) == name]
        if not there or there[0][2] in QUADRATIC or u.logarithmic[there[0][0]] and not error > WIDE * estimate:
            return None
        (j, p, word), log = there[0], u.logarithmic[there[0][0]]
        o = u.pairs[p][0]
        box, best, first = self.boxes[o], self.points[o], sum(len(one.low) for one in self.boxes[:o])
        place = _by_size(best.numbers, [i - first for i, (q, one) in enumerate(u.numbers) if q == p and one in TAUS],
                         j - first)
        if len(best.rest) > LONGEST or not box.low[place] < box.high[place]:
            return None
        if (name, level, coloured) not in self.found:
            unit = 1.0 if word == "zeta" else self.errors.data.dt
            ends = _interval(best, box, place, level, error / (estimate if log else unit) if coloured else None)
            low, high = (unit * (np.exp(ends) if log else np.array(ends))).tolist()
            self.found[name, level, coloured] = low, high
        return self.found[name, level, coloured]


def _by_size(numbers: Array, places: list[int], place: int) -> int:
    """Return where the time constant is that a model, which has the largest first, shows at a place."""
    if place not in places:
        return place
    return sorted(places, key=lambda one: -numbers[one])[places.index(place)]


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

    @cache  # the ends of a bracket are known to its search
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
    """Return the standard error of a number by the derivatives at the optimum, the first step of the search."""
    own = float(np.linalg.norm(best.slopes() @ best.valley(place)))
    return max(best.noise / max(own, 1e-300), 1e-6) if own > 0 else 1.0
