"""A proof that no other time constants and dead time fit better: branch and bound for one or two poles with dead time.

With a held input that moves by w_j at s_j the response of a pole with dead time is

    x(t) = w_0 + sum_j w_j S((t - s_j - theta) / tau),    S(z) = 1 - exp(-z) for z > 0, else 0,

and V(log tau, theta) = min over gain and levels of |y - K x|². A box of (log tau, theta) is discarded where a lower
bound of V there lies above what was found. In a box across kinks x is known up to an interval, since S falls in both
unknowns. In a cell, x = x0 + a x1 + b x2 + r with |a| <= h1, |b| <= h2 and r within an envelope of its second
derivatives: least squares over K, K a and K b in their cone, less the largest K |r|, is a lower bound. Boxes are halved
at kinks first. What is not discarded holds the optimum: its middle is a start that no grid can miss. Two real poles are
searched likewise, in three unknowns and without kinks, see `two_poles`.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.identify.process.cones import most_explained, norm, products, project
from optid.identify.process.descent import ProcessBox
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.two_poles import two_pole_bounds
from optid.kernel_cache import cached_njit
from optid.models.process_dynamics import ProcessStructure
from optid.program.solution import Bound

GAP = 1e-6  # relative gap at which a fit counts as proved
COARSE = 1e-2  # gap of the pass that looks for better starts before a fit is confirmed
PIECES = 8  # of the range of every unknown at the beginning
SECONDS = {2: 20.0, 3: 15.0}  # of the processor, after which a proof is given up, by unknowns
WORK, LEAST = 2e6, 1000  # responses to single moves that the coarse pass may compute; boxes that it needs at least
MOST = {2: 5e6, 3: 1e3}  # responses to single moves in one bound beyond which no proof is tried, by unknowns
METHOD = "branch and bound over time constants and dead time"
REASON = ("a lower bound is known for one or two real poles with dead time, one held input, a straight static curve "
          "and a start at rest alone; elsewhere several starts are compared")


@cached_njit
def box_bounds(boxes, smooth, record, moves, edges):
    """Return (lower bound, V at the middle, effects of both halves) of boxes.

    Args:
        boxes: (B, 4) log tau from, to; theta from, to.
        smooth: (B,) whether no kink lies inside.
        record: of all experiments one after another: instants (N,), outputs (N,) and orthonormal columns (N, c), which
            are projected out of the outputs already, response (N,) before the moves.
        moves: times (J,) and sizes (J,) of the moves, by experiment.
        edges: (E + 1, 2) first sample, and first move, of every experiment.
    """
    t, y, still, base = record
    s, w = moves
    count, n = len(boxes), len(t)
    found = np.zeros((count, 4))
    x, envelope = np.zeros((3, n)), np.zeros(n)
    energy = 0.0
    for k in range(n):
        energy += y[k] * y[k]
    for i in range(count):
        l1, l2, a, b = boxes[i]
        low_tau, high_tau, tau = np.exp(l1), np.exp(l2), np.exp((l1 + l2) / 2)
        h1, h2, theta = (l2 - l1) / 2, (b - a) / 2, (a + b) / 2
        for e in range(len(edges) - 1):
            for k in range(edges[e, 0], edges[e + 1, 0]):
                x0, x1, x2, rest = base[k], 0.0, 0.0, 0.0
                for j in range(edges[e, 1], edges[e + 1, 1]):
                    since = t[k] - s[j] - theta
                    size = abs(w[j])
                    if smooth[i]:
                        if since <= 0.0:
                            continue
                        z = since / tau
                        decay = np.exp(-z)
                        x0 += w[j] * (1 - decay)
                        x1 -= w[j] * z * decay
                        x2 -= w[j] * decay / tau
                        za, zb = max(since - h2, 0.0) / high_tau, (since + h2) / low_tau
                        m = max(abs(1 - za), abs(1 - zb))
                        rest += size * np.exp(-za) * (h1 * h1 / 2 * zb * m + h1 * h2 * m / low_tau
                                                      + h2 * h2 / (2 * low_tau * low_tau))
                    elif since + h2 > 0.0:
                        middle = 1 - np.exp(-since / tau) if since > 0.0 else 0.0
                        up = 1 - np.exp(-(since + h2) / low_tau)
                        down = 1 - np.exp(-(since - h2) / high_tau) if since > h2 else 0.0
                        x0 += w[j] * middle
                        rest += size * max(up - middle, middle - down)
                x[0, k], x[1, k], x[2, k], envelope[k] = x0, x1, x2, rest
        project(x, still)
        gram, side = products(x, y)
        rho = norm(envelope)
        first, second = h1 * np.sqrt(gram[1, 1]), h2 * np.sqrt(gram[2, 2])
        change, length = rho + first + second, np.sqrt(gram[0, 0])
        at_middle = energy - side[0] * side[0] / gram[0, 0] if gram[0, 0] > 0.0 else energy
        lower = 0.0
        if change < length:
            largest = np.sqrt(energy) / (length - change)  # of the gain anywhere in the box
            least = energy - most_explained(gram, side, np.array([h1, h2])) if smooth[i] else at_middle
            lower = max(np.sqrt(max(least, 0.0)) - largest * rho, 0.0) ** 2
        found[i, 0], found[i, 1] = lower, at_middle
        found[i, 2] = first if smooth[i] else h1 * length
        found[i, 3] = second if smooth[i] else h2 / tau * length
    return found


@dataclass(frozen=True, eq=False)
class Search:
    """What a search over boxes ended with: the least bound of discarded boxes, the best middle, and what is left."""

    bound: float
    best: float
    point: Array  # (d,) logarithms of the time constants and theta of the best middle
    left: Array  # (B, 2 d) boxes that were not discarded
    boxes: int


@dataclass(frozen=True, eq=False)
class BranchAndBound:
    """Boxes of the logarithms of one or two time constants and theta, in sampling times."""

    errors: ProcessErrors
    box: ProcessBox

    @cached_property
    def compiled(self) -> tuple[tuple[Array, ...], tuple[Array, ...], NDArray[np.intp], Array]:
        """Moves, record and edges as `box_bounds` takes them, and the dead times at which a move meets a sample."""
        s, w, edges, base = [], [], [(0, 0)], []
        for t, drives in zip(self.errors.read_at, self.errors.drives):
            drive = drives[0]
            s.append(drive.changes[1:])
            w.append(np.diff(drive.values[:, 0]))
            base.append(np.full(len(t), drive.values[0, 0]))
            edges.append((edges[-1][0] + len(t), edges[-1][1] + len(s[-1])))
        kinks = np.unique(np.concatenate([np.subtract.outer(t, one).ravel()
                                          for t, one in zip(self.errors.read_at, s)]))
        inside = (kinks > self.box.low[-1]) & (kinks < self.box.high[-1])
        kinks = kinks[inside]
        kept = np.concatenate([[True], np.diff(kinks) > 1e-9]) if len(kinks) else np.zeros(0, dtype=bool)
        still, y = self._projected()
        record = np.concatenate(self.errors.read_at), y, still, np.concatenate(base)
        return (np.concatenate(s), np.concatenate(w)), record, np.array(edges), kinks[kept]

    def _projected(self) -> tuple[Array, Array]:
        """Orthonormal columns that do not move, and the outputs without them."""
        errors = self.errors
        x = np.zeros(errors.unknowns.size)
        x[errors.unknowns.dynamic] = (self.box.low + self.box.high) / 2
        still = np.linalg.qr(errors.columns(x)[:, 1:])[0]
        return np.ascontiguousarray(still), errors.y - still @ (still.T @ errors.y)

    @property
    def work(self) -> int:
        """Responses to single moves in one bound."""
        moves = sum(len(t) * (len(drives[0].changes) - 1) for t, drives in zip(self.errors.read_at, self.errors.drives))
        return max(moves, 1)

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
        boxes = np.column_stack([side.ravel() for pair in zip(lows, highs) for side in pair])
        count, bound, begun, best, point = 0, np.inf, time.thread_time(), np.inf, self.box.low
        while len(boxes := self._different(boxes)):
            if time.thread_time() - begun > seconds or count > most:
                break
            part, boxes = boxes[-2000:], boxes[:-2000]
            found, middles = self._bounded(part)
            count += len(part)
            k = int(np.argmin(found[:, 1]))
            if found[k, 1] < best:
                best, point = float(found[k, 1]), part[k].reshape(-1, 2).mean(axis=1)
            out = found[:, 0] >= min(value, best) * (1 - gap)
            bound = min(bound, float(np.min(found[out, 0], initial=np.inf)))
            boxes = np.vstack([boxes, _halves(part[~out], np.argmax(found[~out, 2:], axis=1), middles[~out])])
        return Search(min(bound, value), best, point, boxes, count)

    def _different(self, boxes: Array) -> Array:
        """Leave out boxes in which the second time constant is the larger one everywhere: they are mirrored."""
        low, high = self.box.low, self.box.high
        if len(low) == 2 or low[0] != low[1] or high[0] != high[1]:
            return boxes
        return boxes[boxes[:, 1] > boxes[:, 2]]

    def _bounded(self, boxes: Array) -> tuple[Array, Array]:
        """Return what the kernel says of boxes, and where every unknown is halved: a dead time at a kink near there."""
        moves, record, edges, kinks = self.compiled
        middles = boxes.reshape(len(boxes), boxes.shape[1] // 2, 2).mean(axis=2)
        if middles.shape[1] == 3:
            return two_pole_bounds(boxes, record, moves, edges), middles
        early, late = boxes[:, 2], boxes[:, 3]
        inside = np.searchsorted(kinks, late - 1e-10) - np.searchsorted(kinks, early + 1e-10)
        if len(kinks):
            at = np.searchsorted(kinks, middles[:, 1])
            before, after = kinks[np.maximum(at - 1, 0)], kinks[np.minimum(at, len(kinks) - 1)]
            near = np.where(np.abs(before - middles[:, 1]) < np.abs(after - middles[:, 1]), before, after)
            kink = (inside > 0) & (near > early + 1e-10) & (near < late - 1e-10)
            middles[:, 1] = np.where(kink, near, middles[:, 1])
        return box_bounds(boxes, inside == 0, record, moves, edges), middles

    def certify(self, value: float) -> Bound:
        """Return the lower bound on V within the box for a point with this value."""
        if self.work > MOST[len(self.box.low)]:
            return Bound.none(f"{self.work:.1e} pairs of a sample and a move of the input: a proof would take too "
                              "long; several starts are compared")
        begun = time.thread_time()
        found = self.search(value, GAP, SECONDS[len(self.box.low)])
        words = f"{found.boxes} boxes in {time.thread_time() - begun:.2g} s"
        if len(found.left):
            return Bound(0.0, False, METHOD, f"given up after {words}: {len(found.left)} boxes are left, down to a "
                         f"dead time of {self._time(found.left[:, -2].min())}")
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


def _halves(boxes: Array, wide: NDArray[np.intp], middles: Array) -> Array:
    """Return both halves of boxes (B, 2 d): of the unknown (B,) that changes more, at its middle (B, d)."""
    ends = boxes.reshape(len(boxes), boxes.shape[1] // 2, 2)
    split = np.equal.outer(wide, np.arange(ends.shape[1]))
    first = np.stack([ends[:, :, 0], np.where(split, middles, ends[:, :, 1])], axis=2)
    second = np.stack([np.where(split, middles, ends[:, :, 0]), ends[:, :, 1]], axis=2)
    return np.vstack([first.reshape(boxes.shape), second.reshape(boxes.shape)])


def applies(errors: ProcessErrors) -> bool:
    """Whether a lower bound is known: one or two real poles with dead time, straight f, held input, start at rest."""
    u, known = errors.unknowns, (ProcessStructure(1), ProcessStructure(2))
    return (len(u.structures) == 1 and u.structures[0] in known and u.sizes == (1,) and not u.free
            and not errors.straight and type(errors.bases[0]).__name__ == "Linear")


def better_start(errors: ProcessErrors, box: ProcessBox, value: float) -> Array | None:
    """Return a point (log tau, theta) with a smaller sum of squares than a value, where a coarse search finds one."""
    if not applies(errors) or len(box.low) > 2:  # where it would take longer than all descents
        return None
    bound = BranchAndBound(errors, box)
    if bound.work > WORK / LEAST:
        return None
    found = bound.search(value, COARSE, 0.5, WORK / bound.work)
    return found.point if found.best < value * (1 - GAP) else None


def certify(errors: ProcessErrors, box: ProcessBox, value: float) -> Bound:
    """Bound the errors of a fit within a box from below, in units of the record, where there is a method."""
    if not applies(errors):
        return Bound.none(REASON)
    found = BranchAndBound(errors, box).certify(value)
    return replace(found, value=errors.unit * found.value)
