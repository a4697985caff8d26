"""A proof that no other time constants and dead time fit better: branch and bound for one or two poles with dead time.

V(log tau, theta) = min over gain and levels of |y - K x|². A box is discarded where a lower bound of V there lies above
what was found. Anywhere in it the response is x = x0 + r with |r| bounded; where there is no kink inside also
x = x0 + sum a_i x_i + r with |a_i| <= h_i and a smaller r: least squares over K and K a_i in their cone, less the
largest K |r|, is a lower bound (`step_courses` bounds r). Boxes are halved at kinks first. What is not discarded holds
the optimum: its middle is a start that no grid can miss.

A static curve whose constraints are a cone of as many rows as coefficients, such as a monotone one of few cells, is a
sum of c_k g_k with c >= 0: the response is one of the c_k (x_k0 + sum a_i x_ki + r_k), which lies in the cone of the
corners of the box, and non-negative least squares takes the place of least squares.
"""

import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.identify.process.descent import ProcessBox
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.step_courses import one_pole_courses, two_pole_courses
from optid.models.process_dynamics import ProcessStructure
from optid.program.solution import Bound

GAP = 1e-6  # relative gap at which a fit counts as proved
COARSE = 1e-2  # gap of the pass that looks for better starts before a fit is confirmed
PIECES = 8  # of the range of every unknown at the beginning
SECONDS = {2: 20.0, 3: 15.0}  # of the processor, after which a proof is given up, by unknowns
WORK, LEAST = 2e6, 1000  # responses to single moves that the coarse pass may compute; boxes that it needs at least
MOST = {2: 5e6, 3: 1e3}  # responses to single moves in one bound beyond which no proof is tried, by unknowns
BATCH, ENTRIES = 2000, 200_000  # boxes that are bounded together, and entries of their courses
RIDGE = 1e-13  # of scaled normal equations, for columns that are all but parallel
FEW = 4  # increments of a static curve up to which a proof is tried
RAMP = 10.0  # of so many parts of a record one is the longest time that a dead time is compared with
MOVED, FURTHER = 8, 1.05  # times that errors are moved until they bound, and how far beyond
ROUNDING = 1e-9  # of the conditions that they then obey, relative to their size
METHOD = "branch and bound over time constants and dead time"
REASON = ("a lower bound is known for one or two real poles with dead time, one held input, a static curve that is "
          "straight or whose constraints are as many as its coefficients (such as a monotone one), and a start at rest "
          "alone; elsewhere several starts are compared")


def most_explained(gram: Array, side: Array, h: Array) -> Array:
    """Return the most (B,) of the energy of a signal that K (x_0 + sum a_i x_i) explains with |a_i| <= h_i.

    The faces of the cone are tried one by one, its interior first. On a face some a_i are at their ends; the optimum of
    a face counts where it obeys the other bounds.

    Args:
        gram: (B, 1 + d, 1 + d) Gram matrices of the columns x.
        side: (B, 1 + d) their products with the signal.
        h: (B, d).
    """
    best, left = np.zeros(len(gram)), np.arange(len(gram))
    for ends in sorted(product((0, -1, 1), repeat=h.shape[1]), key=lambda one: sum(map(abs, one))):
        inside = np.flatnonzero(np.equal(ends, 0))
        basis = np.zeros((len(left), h.shape[1] + 1, len(inside) + 1))
        basis[:, 0, 0], basis[:, 1:, 0] = 1.0, np.array(ends) * h[left]
        basis[:, inside + 1, np.arange(len(inside)) + 1] = 1.0
        flipped = np.swapaxes(basis, 1, 2)
        inner, right = flipped @ gram[left] @ basis, (flipped @ side[left][:, :, None])[:, :, 0]
        scale = np.sqrt(np.maximum(np.einsum("bii->bi", inner), 1e-300))
        inner = inner / scale[:, :, None] / scale[:, None, :] + RIDGE * np.eye(len(inside) + 1)
        v = np.linalg.solve(inner, (right / scale)[:, :, None])[:, :, 0]
        obeyed = np.all(np.abs(v[:, 1:] / scale[:, 1:]) <= h[left][:, inside] * np.abs(v[:, :1] / scale[:, :1])
                        * (1 + 1e-9), axis=1)
        best[left] = np.maximum(best[left], np.where(obeyed, np.sum(v * right / scale, axis=1), 0.0))
        if len(inside) == h.shape[1]:  # an optimum inside the cone is that of the cone
            left = left[~obeyed]
    return best


def least_from_cone(rays: Array, rest: Array, y: Array) -> tuple[float, float]:
    """Return |y - sum c_j ray_j| at its least over c >= 0, and a bound on it with ray_j + e_j, |e_j| <= rest_j.

    Any l with rays' l <= -rest |l| gives the bound l'y / |l|: here the errors of non-negative least squares, moved
    until they obey.

    Args:
        rays: (rows, k).
        rest: (k,) sizes.
        y: (rows,).
    """
    from scipy.optimize import nnls

    triangle: Any = np.linalg.qr(np.column_stack([rays, y]), mode="r")
    rays, y = triangle[:, :-1], triangle[:, -1]
    dual = y
    with suppress(RuntimeError):  # too many steps: any dual serves
        dual = y - rays @ nnls(rays, y)[0]
    least, held = float(np.linalg.norm(dual)), np.zeros(rest.size, dtype=bool)
    for _ in range(MOVED):
        size = float(np.linalg.norm(dual))
        excess = rays.T @ dual + rest * size
        if np.all(excess <= ROUNDING * size):
            return least, max(float(dual @ y), 0.0) / size if size else 0.0
        held |= excess > 0
        dual = dual - np.linalg.lstsq(rays[:, held].T, FURTHER * np.maximum(excess[held], 0.0), rcond=1e-12)[0]
    return least, 0.0


@dataclass(frozen=True, eq=False)
class Search:
    """What a search over boxes ended with: the least bound of discarded boxes, the best middle, and what is left."""

    bound: float
    best: float
    point: Array  # the middle
    left: Array  # (B, d, 2) boxes that were not discarded
    boxes: int


@dataclass(frozen=True, eq=False)
class BranchAndBound:
    """Boxes of the logarithms of one or two time constants and theta, in sampling times."""

    errors: ProcessErrors
    box: ProcessBox
    cone: Array | None = None  # (size, k) coefficients mu are sums of its columns; a straight f has any gain

    @cached_property
    def kinks(self) -> Array:
        """The dead times at which a move of the input meets a sample."""
        found = np.unique(np.concatenate([np.subtract.outer(one.instants, drive.changes[1:]).ravel()
                                          for one, drive in self.errors.courses_of(0)]))
        found = found[(found > self.box.low[-1]) & (found < self.box.high[-1])]
        return found[np.diff(found, prepend=-np.inf) > 1e-9]

    @cached_property
    def record(self) -> tuple[Array, Array]:
        """Orthonormal columns (rows, c) that do not move, and the outputs (rows,) without them."""
        x = np.zeros(self.errors.unknowns.size)
        x[self.errors.unknowns.dynamic] = (self.box.low + self.box.high) / 2
        still = np.linalg.qr(self.errors.columns(x)[:, self.errors.unknowns.sizes[0] :])[0]
        return still, self.errors.y - still @ (still.T @ self.errors.y)

    @property
    def work(self) -> int:
        """Responses to single moves in one bound."""
        return max(sum(len(one.instants) * (len(drive.changes) - 1) for one, drive in self.errors.courses_of(0)), 1)

    def _courses(self, boxes: Array, coefficients: Array) -> tuple[Array, Array, Array]:
        """Return the courses (B, 1 + d, rows) of a static curve and their derivatives at the middles of boxes.

        Then the sizes (B,) of what is left out by these courses, and by their tangents.
        """
        still, _ = self.record
        parts, smooth = [], self._inside(boxes) == 0
        for one, drive in self.errors.courses_of(0):
            values = drive.values @ coefficients
            moves = one.instants, drive.changes[1:], np.diff(values)
            x, *rests = one_pole_courses(boxes, smooth, *moves) if boxes.shape[1] == 2 else two_pole_courses(
                boxes, *moves)
            x[:, 0] += values[0]
            parts.append((x, *rests))
        x, rough, fine = (np.concatenate(part, axis=-1) if part[1:] else part[0] for part in zip(*parts))
        flat = x.reshape(-1, x.shape[2])
        flat -= (flat @ still) @ still.T
        return x, np.linalg.norm(rough, axis=1), np.linalg.norm(fine, axis=1)

    def bounds(self, boxes: Array) -> tuple[Array, Array, Array]:
        """Return lower bounds (B,) on V over boxes (B, d, 2), V at their middles, and the effects (B, d) of halves."""
        h, slowest = np.diff(boxes)[:, :, 0] / 2, np.exp(boxes[:, :-1].mean(axis=2).max(axis=1))
        plain = np.column_stack([h[:, :-1], h[:, -1] / np.clip(slowest, 1.0, max(self.errors.length / RAMP, 1.0))])
        if self.cone is not None:
            return self._cone_bounds(self.cone, boxes, h, plain)
        _, y = self.record
        x, rough, rest = self._courses(boxes, np.ones(1))
        gram, side, energy = np.einsum("bin,bjn->bij", x, x), x @ y, float(y @ y)
        sizes = np.sqrt(np.einsum("bii->bi", gram))
        length, effects = sizes[:, 0], h * sizes[:, 1:]
        middle = energy - np.where(length > 0, side[:, 0] / np.where(length > 0, length, 1.0), 0.0) ** 2
        tangent = energy - most_explained(gram, side, h)
        lower = np.zeros(len(boxes))
        for least, away, moved in ((middle, rough, 0.0), (tangent, rest, effects.sum(axis=1))):
            shortest = length - away - moved  # of x anywhere in the box
            known = shortest > 0
            largest = np.sqrt(energy) / shortest[known]  # of the gain
            found = np.sqrt(np.maximum(least[known], 0.0)) - largest * away[known]
            lower[known] = np.maximum(lower[known], np.maximum(found, 0.0) ** 2)
        return lower, middle, np.where((rest + effects.sum(axis=1) < 2 * length)[:, None], effects, plain)

    def _cone_bounds(self, cone: Array, boxes: Array, h: Array, plain: Array) -> tuple[Array, Array, Array]:
        """Return `bounds` over boxes with half widths (B, d) within the cone; effects are plain in large boxes."""
        y = self.record[1]
        x, rough, fine = map(np.array, zip(*(self._courses(boxes, one) for one in cone.T)))
        lower, middle = np.zeros((2, len(boxes)))
        corners = np.array([(1, *signs) for signs in product((-1, 1), repeat=h.shape[1])])
        for b, half in enumerate(h):
            middle[b], lower[b] = least_from_cone(x[:, b, 0].T, rough[:, b], y)
            if np.isfinite(fine[:, b]).all():
                rays = ((corners * [1.0, *half]) @ x[:, b]).reshape(-1, len(y)).T
                lower[b] = max(lower[b], least_from_cone(rays, fine[:, b].repeat(len(corners)), y)[1])
        sizes = np.linalg.norm(x, axis=(0, 3))
        effects = h * sizes[:, 1:]
        small = np.linalg.norm(fine, axis=0) + effects.sum(axis=1) < 2 * sizes[:, 0]
        return lower**2, middle**2, np.where(small[:, None], effects, plain)

    def search(self, value: float, gap: float, seconds: float, most: float = np.inf) -> Search:
        """Discard boxes whose bound lies above (1 - gap) times a value, or times a better one found on the way.

        Args:
            value: sum of squares that was found.
            gap: relative.
            seconds: after which it ends.
            most: boxes after which it ends.
        """
        ends = [np.linspace(low, high, PIECES + 1) for low, high in zip(self.box.low, self.box.high)]
        lows, highs = (np.meshgrid(*(end[part] for end in ends)) for part in (slice(None, -1), slice(1, None)))
        boxes = np.ascontiguousarray(np.array([lows, highs]).reshape(2, len(ends), -1).T)
        count, bound, begun, best, point = 0, np.inf, time.thread_time(), np.inf, self.box.low
        size = int(np.clip(ENTRIES // len(self.errors.y), 10, BATCH))
        while len(boxes := self._different(boxes)):
            if time.thread_time() - begun > seconds or count > most:
                break
            part, boxes = boxes[-size:], boxes[:-size]
            lower, middle, effects = self.bounds(part)
            count += len(part)
            k = int(np.argmin(middle))
            if middle[k] < best:
                best, point = float(middle[k]), part[k].mean(axis=1)
            out = lower >= min(value, best) * (1 - gap)
            bound = min(bound, float(np.min(lower[out], initial=np.inf)))
            boxes = np.concatenate([boxes, self._halves(part[~out], np.argmax(effects[~out], axis=1))])
        return Search(min(bound, value), best, point, boxes, count)

    def _different(self, boxes: Array) -> Array:
        """Leave out boxes in which the second time constant is the larger one everywhere: they are mirrored."""
        low, high = self.box.low, self.box.high
        if len(low) == 2 or low[0] != low[1] or high[0] != high[1]:
            return boxes
        return boxes[boxes[:, 0, 1] > boxes[:, 1, 0]]

    def _inside(self, boxes: Array) -> NDArray[np.intp]:
        """Return how many kinks lie inside of boxes; two poles have none."""
        if boxes.shape[1] > 2:
            return np.zeros(len(boxes), dtype=np.intp)
        low, high = boxes[:, 1].T
        return np.searchsorted(self.kinks, high - 1e-10) - np.searchsorted(self.kinks, low + 1e-10)

    def _halves(self, boxes: Array, wide: NDArray[np.intp]) -> Array:
        """Return both halves of boxes (B, d, 2), of the unknown (B,) that changes more; theta at a kink near there."""
        middles, kinked = boxes.mean(axis=2), self._inside(boxes) > 0
        if kinked.any():
            at = np.searchsorted(self.kinks, middles[:, 1])
            before, after = self.kinks[np.maximum(at - 1, 0)], self.kinks[np.minimum(at, len(self.kinks) - 1)]
            near = np.where(np.abs(before - middles[:, 1]) < np.abs(after - middles[:, 1]), before, after)
            kinked &= (near > boxes[:, 1, 0] + 1e-10) & (near < boxes[:, 1, 1] - 1e-10)
            middles[:, 1] = np.where(kinked, near, middles[:, 1])
        first, second, every = boxes.copy(), boxes.copy(), np.arange(len(boxes))
        first[every, wide, 1] = second[every, wide, 0] = middles[every, wide]
        return np.concatenate([first, second])

    def certify(self, value: float) -> Bound:
        """Return the lower bound on V within the box for a point with this value."""
        if self.cone is not None and self.cone.shape[1] > FEW:
            return Bound.none(f"{self.cone.shape[1]} increments of the static curve: a proof would take too long with "
                              f"more than {FEW}; several starts are compared")
        if self.work * (1 if self.cone is None else self.cone.shape[1]) > MOST[len(self.box.low)]:
            return Bound.none(f"{self.work:.1e} pairs of a sample and a move of the input: a proof would take too "
                              "long; several starts are compared")
        begun = time.thread_time()
        found = self.search(value, GAP, SECONDS[len(self.box.low)])
        words = f"{found.boxes} boxes in {time.thread_time() - begun:.2g} s"
        if len(found.left):
            return Bound(0.0, False, METHOD, f"given up after {words}: {len(found.left)} boxes are left, down to a "
                         f"dead time of {self._time(found.left[:, -1, 0].min())}")
        gap = max(0.0, 1 - found.bound / value) if value > 0 else 0.0
        if found.best < value * (1 - GAP):
            return Bound(found.bound, False, METHOD, f"a better point was found by the proof ({words}): time constant "
                         f"{', '.join(self._time(np.exp(one)) for one in found.point[:-1])}, dead time "
                         f"{self._time(found.point[-1])}; hold it by constraints, or fit again from there")
        return Bound(found.bound, True, METHOD, "proved up to rounding for time constants from "
                     f"{self._time(np.exp(self.box.low[0]))} to {self._time(np.exp(self.box.high[0]))} and dead times "
                     f"from {self._time(self.box.low[-1])} to {self._time(self.box.high[-1])}: {words}, relative gap "
                     f"{gap:.1e}")

    def _time(self, samples: float) -> str:
        return f"{samples * self.errors.data.dt:.4g} {self.errors.data.time_unit}".rstrip()


def applies(errors: ProcessErrors) -> bool:
    """Whether a lower bound is known for the dynamics: one or two real poles with dead time, held input, at rest."""
    u = errors.unknowns
    return u.structures in ((ProcessStructure(1),), (ProcessStructure(2),)) and not u.free and not errors.straight


def better_start(errors: ProcessErrors, box: ProcessBox, value: float) -> Array | None:
    """Return a point (log tau, theta) with a smaller sum of squares than a value, where a coarse search finds one."""
    if not (applies(errors) and errors.is_line(0)) or len(box.low) > 2:  # where it would take longer than all descents
        return None
    bound = BranchAndBound(errors, box)
    if bound.work > WORK / LEAST:
        return None
    found = bound.search(value, COARSE, 0.5, WORK / bound.work)
    return found.point if found.best < value * (1 - GAP) else None


def certify(errors: ProcessErrors, value: float, box: ProcessBox, cone: Array | None = None) -> Bound:
    """Bound the errors of a fit of a value within a box from below, in units of the record, where there is a method."""
    if not applies(errors) or cone is None and not errors.is_line(0):
        return Bound.none(REASON)
    found = BranchAndBound(errors, box, cone).certify(value)
    return replace(found, value=errors.unit * found.value)
