"""Local solution of rank-one least squares: Newton's method on the manifold, and alternating least squares.

The method is Newton's with Levenberg damping on the manifold of rank-one matrices, in Kronecker-whitened coordinates,
from several starts. :func:`alternate` is the classical alternating least squares (Bai, Automatica 34, 1998), an
independent method for comparison.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_lapack_funcs

from optid.rank_one.problem import Array, Core, Point, RankOne, block_slices, matrices, reduce

(_posv,) = get_lapack_funcs(("posv",), dtype=float)


@dataclass(frozen=True, eq=False)
class LocalSolution:
    """What a local method returns.

    Attributes:
        point: in the gauge ||b|| = 1.
        value: objective there.
        iterations: steps taken.
        gradient: gradient in the tangent space over ||R^T s||, in whitened coordinates.
        converged: whether the gradient tolerance was reached.
    """

    point: Point
    value: float
    iterations: int
    gradient: float
    converged: bool


def starts(core: Core, count: int = 8, seed: int = 0) -> list[tuple[list[Array], list[Array]]]:
    """Starting factors in whitened coordinates: the whitened SVD, the plain SVD split, further pairs, random ones.

    Args:
        core: the reduced problem.
        count: how many.
        seed: of the random directions b.
    """
    if not core.shapes:  # linear least squares: nothing to start
        return [([], [])]
    estimates = matrices(core.least_squares, core.shapes)
    factors = list(zip(estimates, core.whitening.factors_mu, core.whitening.factors_b))
    white = [np.linalg.svd(left.T @ theta @ right, full_matrices=False) for theta, left, right in factors]
    plain = [np.linalg.svd(theta, full_matrices=False) for theta in estimates]
    rank = [min(shape) for shape in core.shapes]
    rng = np.random.default_rng(seed)

    def pair(svd, k):
        return svd[0][:, k] * svd[1][k], svd[2][k]

    found = []
    for k in range(count):
        if k == 1:
            mus, bs = core.whitening.forward(*zip(*(pair(svd, 0) for svd in plain)))
        elif k < 4:
            mus, bs = zip(*(pair(svd, max(k - 1, 0) % r) for svd, r in zip(white, rank)))
        else:
            bs = [rng.standard_normal(nb) for _, nb in core.shapes]
            mus = [u @ (d * (vt @ b)) / (b @ b) for (u, d, vt), b in zip(white, bs)]
        found.append((list(mus), list(bs)))
    return found


def descend(core: Core, mus: list[Array], bs: list[Array], tolerance: float = 1e-12, iterations: int = 200,
            alternations: int = 0) -> LocalSolution:
    """Newton with Levenberg damping from whitened factors; the objective never increases beyond roundoff.

    A step (d mu_i, d b_i) lives in the tangent space, with d b_i measured in units of ||mu_i|| so that one damping
    parameter fits all; the curvature of the manifold (residual gradient over ||mu_i||) is included.

    Args:
        core: the reduced problem; without blocks the answer is exact least squares.
        mus: whitened starting mu_i.
        bs: whitened starting b_i.
        tolerance: on the tangent gradient relative to ||R^T s||.
        iterations: at most.
        alternations: alternating half-steps for mu and b before Newton starts, for starts far away.
    """
    if not core.shapes:
        point = core.point([], [])
        return LocalSolution(point, core.problem.value(point.lift()), 0, 0.0, True)
    target, root = core.target, core.root
    pieces, start = [], 0
    for p, nb in core.shapes:  # (nb, k, P) contiguous, so that both half-Jacobians are plain products
        part = root[:, start:start + p * nb].reshape(-1, nb, p)
        pieces.append(np.ascontiguousarray(part.transpose(1, 0, 2)))
        start += p * nb
    reference = max(float(np.linalg.norm(root.T @ target)), np.finfo(float).tiny)
    noise = 1e-30 * float(target @ target)
    state = [_unit(mu, b) for mu, b in zip(mus, bs)]
    for _ in range(max(alternations, 1)):
        state = _half_steps(pieces, target, state, both=alternations > 0)
    damping, taken, gradient, settled, promise = 0.0, 0, np.inf, False, np.inf
    residual = _residual(pieces, target, state)
    value = float(residual @ residual)
    while True:
        jacobian, slope, curvature = _linearise(pieces, root, core.shapes, residual, state)
        before, gradient = gradient, float(np.linalg.norm(slope)) / reference
        settled = promise <= 1e-14 * value + noise and gradient > 0.5 * before  # what is left is rounding
        if gradient <= tolerance or taken >= iterations or settled:
            break
        hessian = jacobian.T @ jacobian + curvature
        improved, promise = False, np.inf
        while not improved and damping < 1e12:
            step = _newton_step(hessian, slope, damping)
            if step is not None:
                trial = _retract(state, step, core.shapes)
                trial_residual = _residual(pieces, target, trial)
                trial_value = float(trial_residual @ trial_residual)
                improved = trial_value <= value * (1 + 1e-14) + noise
                promise = min(promise, -float(slope @ step))
            if not improved:
                damping = max(4 * damping, 1e-3)
        if not improved:
            settled = promise <= 1e-13 * value + noise
            break
        state, residual, value = trial, trial_residual, trial_value
        damping = damping / 8 if damping > 1e-3 else 0.0
        taken += 1
    point = core.point([size * unit for size, unit, _ in state], [b for _, _, b in state])
    return LocalSolution(point, core.problem.value(point.lift()), taken, gradient, gradient <= tolerance or settled)


def _unit(mu: Array, b: Array) -> tuple[float, Array, Array]:
    """(||mu|| ||b||, unit mu, unit b); a zero factor keeps an arbitrary direction."""
    size_mu, size_b = float(np.linalg.norm(mu)), float(np.linalg.norm(b))
    unit_mu = mu / size_mu if size_mu else np.full(len(mu), len(mu) ** -0.5)
    unit_b = b / size_b if size_b else np.full(len(b), len(b) ** -0.5)
    return size_mu * size_b, unit_mu, unit_b


def _residual(pieces: list[Array], target: Array, state: list) -> Array:
    residual = -target
    for piece, (size, mu, b) in zip(pieces, state):
        residual = residual + b @ (piece @ (size * mu))
    return residual


def _half_steps(pieces: list[Array], target: Array, state: list, both: bool) -> list:
    """Least squares for all mu_i with the b_i fixed, then, if asked, for all b_i with the mu_i fixed."""
    design = np.concatenate([np.tensordot(b, piece, 1) for piece, (_, _, b) in zip(pieces, state)], axis=1)
    mus = np.split(_normal_equations(design, target), np.cumsum([piece.shape[2] for piece in pieces])[:-1])
    state = [_unit(mu, b) for mu, (_, _, b) in zip(mus, state)]
    if both:
        design = np.concatenate([(piece @ mu).T for piece, (_, mu, _) in zip(pieces, state)], axis=1)
        bs = np.split(_normal_equations(design, target), np.cumsum([piece.shape[0] for piece in pieces])[:-1])
        state = [_unit(mu, b) for b, (_, mu, _) in zip(bs, state)]
    return state


def _normal_equations(design: Array, target: Array) -> Array:
    """Least squares by Cholesky: in whitened coordinates the columns are nearly orthogonal."""
    gram = design.T @ design
    gram.flat[::len(gram) + 1] += 1e-13 * np.trace(gram) / len(gram)
    return _posv(gram, design.T @ target)[1]


def _linearise(pieces, root, shapes, residual, state) -> tuple[Array, Array, Array]:
    """Jacobian of the residual, gradient, and what the curvature of the manifold and the gauge add to J^T J."""
    jacobian = np.concatenate([part for piece, (_, mu, b) in zip(pieces, state)
                               for part in (np.tensordot(b, piece, 1), (piece @ mu).T)], axis=1)
    curvature = np.zeros((jacobian.shape[1],) * 2)
    start = 0
    slope = jacobian.T @ residual
    for (p, nb), (size, mu, b), gradient in zip(shapes, state, matrices(root.T @ residual, shapes)):
        own, other = slice(start, start + p), slice(start + p, start + p + nb)
        if size > 0:
            curvature[own, other] = gradient / size
            curvature[other, own] = gradient.T / size
        gauge = np.concatenate([mu, -b])
        start += p + nb
        curvature[own.start:start, own.start:start] += np.outer(gauge, gauge)
    return jacobian, slope, curvature


def _newton_step(hessian: Array, slope: Array, damping: float) -> Array | None:
    damped = hessian.copy()
    damped.flat[::len(damped) + 1] += damping * np.trace(hessian) / len(hessian) + 1e-15
    step, info = _posv(damped, -slope)[1:]
    return None if info else step


def _retract(state: list, step: Array, shapes) -> list:
    """Move along the tangent vector and return to rank one."""
    moved, start = [], 0
    for (p, nb), (size, mu, b) in zip(shapes, state):
        new_mu = size * mu + step[start:start + p]
        new_b = b + step[start + p:start + p + nb] / size if size > 0 else b
        moved.append(_unit(new_mu, new_b))
        start += p + nb
    return moved


def minimise(problem: RankOne, start: Point | None = None, *, count: int = 8, seed: int = 0,
             tolerance: float = 1e-12, iterations: int = 200) -> LocalSolution:
    """Best local minimiser over several starts, or the one reached from a given start.

    Args:
        problem: the least-squares problem.
        start: descend from here only.
        count: number of starts when none is given.
        seed: of the random starts.
        tolerance: relative gradient at which a descent stops.
        iterations: at most, each start.

    Raises:
        RankError: the compressed regressor is singular.
    """
    core = reduce(problem)
    if start is not None:
        _, mus, bs = core.factors(start)
        return descend(core, mus, bs, tolerance, iterations)
    return best_of(core, count, seed, tolerance, iterations)


def best_of(core: Core, count: int = 8, seed: int = 0, tolerance: float = 1e-12, iterations: int = 200,
            first: int = 0) -> LocalSolution:
    """Best local minimiser of a reduced problem over the starts ``first .. count - 1``."""
    if not core.shapes:
        return descend(core, [], [])
    found = [descend(core, mus, bs, tolerance, iterations, alternations=0 if k < 2 else 2)
             for k, (mus, bs) in enumerate(starts(core, count, seed)) if k >= first]
    return min(found, key=lambda solution: solution.value)


def alternate(problem: RankOne, start: Point, *, tolerance: float = 1e-12, sweeps: int = 5000) -> LocalSolution:
    """Alternating least squares on the original root: all mu_i and w for fixed b_i, then all b_i and w.

    Independent of the whitening and of Newton's method; converges linearly.

    Args:
        problem: the least-squares problem.
        start: starting factors.
        tolerance: on the relative decrease of the objective in one sweep.
        sweeps: at most.
    """
    w, mus, bs = start.w, list(start.mus), list(start.bs)
    pieces = [problem.root[:, columns].reshape(-1, nb, p)
              for columns, (p, nb) in zip(block_slices(problem), problem.blocks)]
    head = problem.root[:, :problem.linear]
    value, done, sweep = np.inf, False, 0
    while not done and sweep < sweeps:
        designs = [np.einsum("njp,j->np", piece, b) for piece, b in zip(pieces, bs)]
        _, *mus = _split_solution(head, designs, problem.target)
        designs = [piece @ mu for piece, mu in zip(pieces, mus)]
        w, *bs = _split_solution(head, designs, problem.target)
        point = Point(w, tuple(mus), tuple(bs)).normalised()
        mus, bs = list(point.mus), list(point.bs)
        new = problem.value(point.lift())
        done = value - new <= tolerance * max(new, 1e-16 * problem.scale)
        value, sweep = new, sweep + 1
    core = reduce(problem)
    _, white_mus, white_bs = core.factors(point)
    gradient = descend(core, white_mus, white_bs, iterations=0).gradient
    return LocalSolution(point, value, sweep, gradient, done)


def _split_solution(head: Array, designs: Sequence[Array], target: Array) -> list[Array]:
    whole = np.concatenate([head, *designs], axis=1)
    solution = np.linalg.lstsq(whole, target, rcond=None)[0]
    return np.split(solution, np.cumsum([head.shape[1], *(d.shape[1] for d in designs)])[:-1])
