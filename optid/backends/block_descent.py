"""Own solver for group-sparse least squares: block descent on the groups that matter, finished by Newton steps.

Neighbouring onsets of a fault are nearly collinear, which makes plain block descent slow. On the groups that are not
zero the objective is smooth, so that a Newton step converges quickly; groups enter when the gradient violates
the optimality conditions. The iteration stops by the duality gap, whose dual point is feasible by construction.
"""

import numpy as np

from optid.arrays import Array
from optid.backends.back_end import Answer, Minimum, Settings
from optid.core.group_sparse import GroupSparseForm
from optid.core.problem import Problem
from optid.kernel_cache import cached_njit
from optid.program.solution import Status, tolerance
from optid.structures.group_sparse import GroupProblem

ENTER = 40  # groups that may enter at a time
SWEEPS = 25  # sweeps of block descent between Newton steps
STALLED = 30  # rounds without a better gap or value after which nothing more is to be gained in floating point


def run(problem: Problem, settings: Settings) -> Answer:
    """Solve a programme of the form `GroupSparseForm` without further constraints.

    Options: ``limit`` (rounds at most, default 2,000).
    """
    form = GroupSparseForm.of(problem)
    assert form is not None
    if not form.penalty > 0:
        return Answer(Status.FAILED, f"the penalty is {form.penalty}; this method needs a positive one")
    start = form.flat(problem.start) if settings.warm and problem.start else None
    limit = int(dict(settings.options).get("limit", 2000))
    found = minimise(form.problem, form.penalty, settings.accuracy, limit, start)
    return found.answer(tolerance(settings.accuracy), form.unpack(found.point), form.duals(found.dual))


def minimise(problem: GroupProblem, penalty: float, gap: float = 1e-9, limit: int = 2000,
             start: Array | None = None) -> Minimum:
    """Minimise ``1/2 ‖r - M a‖² + penalty sum_g w_g ‖a_g‖`` for a positive penalty: point a (p,), dual point (m,).

    It stops at a relative duality gap, or at a number of rounds; a start (p,) shortens the way.
    """
    a = np.zeros(problem.design.shape[1]) if start is None else np.array(start, dtype=float)
    active = np.flatnonzero(problem.norms(a) > 0)
    best, since, lowest = None, 0, np.inf
    for count in range(limit + 1):
        bound, point = problem.dual(problem.target - problem.design @ a, penalty)
        found = Minimum(a.copy(), point, problem.value(a, penalty), bound, count)
        since = 0 if found.value < lowest * (1 - 1e-14) or best is None or found.gap < 0.9 * best.gap else since + 1
        lowest = min(lowest, found.value)
        if best is None or found.gap < best.gap:
            best = found
        if found.gap <= gap or count == limit or since > STALLED:
            break
        active = _entered(problem, a, penalty, active)
        a = _descended(problem, a, penalty, active)
        active = active[problem.norms(a)[active] > 0]
    assert best is not None
    return best


def _entered(problem: GroupProblem, a: Array, penalty: float, active: np.ndarray) -> np.ndarray:
    """Add the groups outside that violate the optimality conditions most."""
    slopes = problem.norms(problem.design.T @ (problem.target - problem.design @ a)) / (penalty * problem.weights)
    slopes[active] = 0.0
    worst = np.argsort(slopes)[::-1][:ENTER]
    return np.sort(np.concatenate([active, worst[slopes[worst] > 1.0]]))


def _descended(problem: GroupProblem, a: Array, penalty: float, active: np.ndarray) -> Array:
    """Improve the active groups: sweeps of block descent, then a Newton step on those that are not zero."""
    if not active.size:
        return a
    columns, edges = _columns(problem.edges, active)
    part = problem.design[:, columns]
    gram, pull = part.T @ part, part.T @ problem.target
    own = a[columns].copy()
    levels = penalty * problem.weights[active]
    _sweep(gram, edges, problem.lengths[active] ** 2, levels, pull - gram @ own, own)
    own = _newton(gram, pull, edges, levels, own)
    result = np.zeros_like(a)
    result[columns] = own
    return result


def _columns(edges: np.ndarray, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns of some groups, and the edges of these groups among them."""
    return (np.concatenate([np.arange(int(edges[g]), int(edges[g + 1])) for g in groups]),
            np.concatenate([[0], np.cumsum(np.diff(edges)[groups])]))


def _newton(gram: Array, pull: Array, edges: np.ndarray, levels: Array, a: Array) -> Array:
    """Take one Newton step on the groups that are not zero, where it descends; scalars that change sign become zero."""
    norms = np.sqrt(np.add.reduceat(a**2, edges[:-1]))
    kept = np.flatnonzero(norms > 0)
    if not kept.size:
        return a
    columns, inner = _columns(edges, kept)
    x, H = a[columns], gram[np.ix_(columns, columns)].copy()
    gradient = H @ x - pull[columns]
    for g, (lo, hi) in zip(kept, zip(inner, inner[1:])):
        direction = x[lo:hi] / norms[g]
        gradient[lo:hi] += levels[g] * direction
        if hi - lo > 1:
            H[lo:hi, lo:hi] += levels[g] / norms[g] * (np.eye(hi - lo) - np.outer(direction, direction))
    step = -np.linalg.lstsq(H, gradient, rcond=1e-13)[0]

    def value(y: Array) -> float:
        smooth = 0.5 * y @ (gram[np.ix_(columns, columns)] @ y) - pull[columns] @ y
        return float(smooth + levels[kept] @ np.sqrt(np.add.reduceat(y**2, inner[:-1])))

    single = np.repeat(np.diff(inner) == 1, np.diff(inner))
    crossing, trials, lengths = single & (x * (x + step) < 0), [], [1.0, 0.5, 0.1]
    if crossing.any():  # up to the first kink, which the step then ends on
        lengths = [float(np.min(-x[crossing] / step[crossing])), 1.0]
    for length in lengths:
        y = x + length * step
        y[single & (x * y <= 1e-14 * x**2)] = 0.0
        trials.append((value(y), y))
    reached, y = min(trials, key=lambda pair: pair[0])
    if reached > value(x):
        return a
    result = a.copy()
    result[columns] = y
    return result


@cached_njit
def _sweep(gram: np.ndarray, edges: np.ndarray, squares: np.ndarray, levels: np.ndarray, slope: np.ndarray,
           a: np.ndarray) -> None:
    """Minimise over one group at a time, in place: the coefficients a (q,) and the slope M'(r - M a) (q,).

    Gram matrix (q, q) and edges (g + 1,) are those of the active columns; for every group (g,) there are the squared
    length of its columns and lambda times its weight.
    """
    for _ in range(SWEEPS):
        moved = False
        for g in range(edges.size - 1):
            lo, hi, square = edges[g], edges[g + 1], squares[g]
            if square == 0.0:
                continue
            length = 0.0
            for j in range(lo, hi):
                length += (slope[j] + square * a[j]) ** 2
            length = np.sqrt(length)
            factor = 0.0 if length <= levels[g] else (1.0 - levels[g] / length) / square
            for j in range(lo, hi):
                new = factor * (slope[j] + square * a[j])
                step = new - a[j]
                if step != 0.0:
                    for i in range(slope.size):
                        slope[i] -= gram[i, j] * step
                    a[j] = new
                    moved = True
        if not moved:
            return
