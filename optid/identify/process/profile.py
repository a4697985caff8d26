"""Intervals of dead times by profile likelihood: everything else is fitted again at every dead time.

Errors have kinks in a dead time, and it may lie at zero; the profile says what the quadratic approximation behind a
standard error does not.
"""

import numpy as np

from optid.arrays import Array
from optid.identify.process.descent import ProcessBox, ProcessPoint, descend
from optid.identify.process.errors import ProcessErrors

LEVEL = 0.95
HALVINGS, DOUBLINGS = 20, 30  # of the way to the end of an interval, and of the step towards it
EXACT = 1e-3  # of the width of an interval, to which its ends are found


def profile_intervals(errors: ProcessErrors, box: ProcessBox, x: Array) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of the dead time of every input that has one, in units of time, for white errors."""
    best, found = ProcessPoint.of(errors, x), dict[str, tuple[float, float]]()
    for c, structure in enumerate(errors.unknowns.structures):
        place = errors.place(c)
        if structure.delay and box.low[place] < box.high[place]:
            ends = [_end(errors, box, best, place, sign) for sign in (-1.0, 1.0)]
            low, high = (float(end * errors.data.dt) for end in ends)
            found[errors.key("dead_time", c)] = low, high
    return found


def _end(errors: ProcessErrors, box: ProcessBox, best: ProcessPoint, place: int, sign: float) -> float:
    """Return where the profile crosses the level of the likelihood-ratio test, or the bound of the box."""
    from scipy.stats import f as fisher

    dof = len(errors.y) - errors.unknowns.size
    most = best.value * (1 + fisher.ppf(LEVEL, 1, dof) / dof)
    at = errors.unknowns.dynamic
    theta, bound = float(best.x[at[place]]), float(box.low[place] if sign < 0 else box.high[place])
    inside, outside, here, step = theta, None, best, _width(errors, best, place)
    for _ in range(DOUBLINGS):
        moved = min(max(inside + sign * step, box.low[place]), box.high[place])
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
