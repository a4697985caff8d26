"""Local solution of rank-one least squares by Newton's method on the manifold, from several starts.

Newton's method with Levenberg damping acts in one factor, the other one eliminated, in Kronecker-whitened coordinates.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from scipy.linalg import get_lapack_funcs

from optid.structures.rank_one import Array, Core, Point, RankOne, matrices
from optid.structures.whitening import block_slices

_posv, _trtrs = get_lapack_funcs(("posv", "trtrs"), dtype=float)

TOLERANCE = 1e-12  # on the tangent gradient relative to ||R^T s||


@dataclass(frozen=True, eq=False)
class LocalSolution:
    """What a local method returns."""

    point: Point  # in the gauge ||b|| = 1
    value: float  # objective there
    iterations: int  # steps taken
    gradient: float  # gradient in the tangent space over ||R^T s||, in whitened coordinates
    converged: bool  # whether the gradient tolerance was reached


def starts(core: Core, count: int = 8, seed: int = 0) -> list[tuple[list[Array], list[Array]]]:
    """Starting factors in whitened coordinates: the whitened SVD, the plain SVD split, further pairs, random ones."""
    if not core.shapes:  # linear least squares: nothing to start
        return [([], [])]
    estimates = matrices(core.least_squares, core.shapes)
    factors = list(zip(estimates, core.whitening.factors_mu, core.whitening.factors_b))
    white = [np.linalg.svd(left.T @ theta @ right, full_matrices=False) for theta, left, right in factors]
    rank = [min(shape) for shape in core.shapes]
    rng = np.random.default_rng(seed) if count > 4 else None

    def pair(svd, k):
        return svd[0][:, k] * svd[1][k], svd[2][k]

    found = []
    for k in range(count):
        if k == 1:
            plain = [pair(np.linalg.svd(theta, full_matrices=False), 0) for theta in estimates]
            mus, bs = core.whitening.forward(*zip(*plain))
        elif k < 4 or rng is None:
            mus, bs = zip(*(pair(svd, max(k - 1, 0) % r) for svd, r in zip(white, rank)))
        else:
            bs = [rng.standard_normal(nb) for _, nb in core.shapes]
            mus = [u @ (d * (vt @ b)) / (b @ b) for (u, d, vt), b in zip(white, bs)]
        found.append((list(mus), list(bs)))
    return found


def descend(core: Core, bs: list[Array], iterations: int = 1000, alternations: int = 0) -> LocalSolution:
    """Newton's method in the b alone, every mu the best for them; the objective never increases beyond roundoff.

    The mu are eliminated at every step (variable projection, Golub and Pereyra 1973), so that a valley along which
    large mu of correlated inputs cancel, however narrow, is no obstacle. A step d b_i is measured in units of
    ||mu_i||; directions of negative curvature are followed downwards. For whitened starts b_i far away, alternating
    half-steps for mu and b come first. Without blocks the answer is exact least squares.
    """
    if not core.shapes:
        point = core.point([], [])
        return LocalSolution(point, core.problem.value(point.lift()), 0, 0.0, True)
    target, root = core.target, core.root
    pieces = [np.ascontiguousarray(root[:, where].reshape(-1, nb, p).transpose(1, 0, 2))  # (nb, k, P) contiguous, so
              for where, (p, nb) in zip(block_slices(core.shapes), core.shapes)]  # both half-Jacobians are products
    reference = max(float(np.linalg.norm(root.T @ target)), np.finfo(float).tiny)
    noise = 1e-30 * float(target @ target)
    for _ in range(alternations):
        bs = _half_steps(pieces, target, bs)
    here = _Projected.at(pieces, target, bs)
    damping, taken, gradient, settled, promise = 0.0, 0, np.inf, False, np.inf
    while True:
        slope, hessian = here.curvature(root, core.shapes)
        before, gradient = gradient, float(np.linalg.norm(slope)) / reference
        settled = promise <= 1e-14 * here.value + noise and gradient > 0.5 * before  # what is left is rounding
        if gradient <= TOLERANCE or taken >= iterations or settled:
            break
        sizes, directions = np.linalg.eigh(hessian)
        sizes = np.maximum(np.abs(sizes), 1e-14 * np.max(np.abs(sizes)))
        along, improved, promise = directions.T @ slope, False, np.inf
        while not improved and damping < 1e12:
            forces = along / (sizes + damping * float(np.mean(sizes)))
            trial = _Projected.at(pieces, target, here.move(-directions @ forces))
            improved = trial.value <= here.value * (1 + 1e-14) + noise
            promise = min(promise, float(along @ forces))
            if not improved:
                damping = max(4 * damping, 1e-3)
        if not improved:
            settled = promise <= 1e-13 * here.value + noise
            break
        fall, here = here.value - trial.value, trial
        damping = damping / 8 if damping > 1e-3 and fall > 0.25 * promise else damping if damping > 1e-3 else 0.0
        taken += 1
    point = core.point(here.mus, here.bs)
    return LocalSolution(point, core.problem.value(point.lift()), taken, gradient, gradient <= TOLERANCE or settled)


@dataclass(frozen=True, eq=False)
class _Projected:
    """The best mu_i for some b_i of unit length, from pieces (nb, k, P), and the least squares that gave them.

    The regressors of the mu_i are basis @ triangle, (k, sum P), regular where the effects of the mu_i are independent.
    """

    pieces: list[Array]
    bs: list[Array]
    mus: list[Array]
    basis: Array
    triangle: Array
    regular: bool
    residual: Array

    @classmethod
    def at(cls, pieces: list[Array], target: Array, bs: list[Array]) -> "_Projected":
        units = [_unit(b) for b in bs]
        design = _regressors(pieces, units)
        basis, triangle = np.linalg.qr(design)
        diagonal = np.abs(triangle.diagonal())
        regular = bool(diagonal.min() > 1e-13 * diagonal.max())  # no input without effect, no two that are one
        mus = _trtrs(triangle, basis.T @ target)[0] if regular else np.linalg.lstsq(design, target, rcond=1e-13)[0]
        split = _split(mus, [piece.shape[2] for piece in pieces])
        return cls(pieces, units, split, basis, triangle, regular, design @ mus - target)

    @property
    def value(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    @property
    def sizes(self) -> list[float]:
        """Length of every mu_i."""
        return [float(np.linalg.norm(mu)) for mu in self.mus]

    def move(self, step: Array) -> list[Array]:
        """Return the b_i after a step in units of the mu_i; those of a mu_i that vanishes stay."""
        parts = _split(step, [b.size for b in self.bs])
        return [b + part / size if size > 0 else b for b, part, size in zip(self.bs, parts, self.sizes)]

    def curvature(self, root: Array, shapes: Sequence[tuple[int, int]]) -> tuple[Array, Array]:
        """Gradient and Hessian of half the value in the b_i, definite along each b_i, which changes nothing."""
        regressors, row, column = [], 0, 0
        forces = np.zeros((len(self.triangle), sum(b.size for b in self.bs)))
        gradients = matrices(root.T @ self.residual, tuple(shapes))
        for piece, mu, b, size, gradient in zip(self.pieces, self.mus, self.bs, self.sizes, gradients):
            scale = 1.0 / size if size > 0 else 0.0
            regressors.append((piece @ (scale * mu)).T)
            forces[row : row + mu.size, column : column + b.size] = scale * gradient
            row, column = row + mu.size, column + b.size
        across = np.concatenate(regressors, axis=1)
        mixed = self.basis.T @ across
        if self.regular:
            mixed = mixed + _trtrs(self.triangle, forces, trans=1)[0]
        hessian = across.T @ across - mixed.T @ mixed
        weight, column = max(float(hessian.trace()) / len(hessian), np.finfo(float).tiny), 0
        for b in self.bs:
            hessian[column : column + b.size, column : column + b.size] += weight * np.outer(b, b)
            column += b.size
        return across.T @ self.residual, hessian


def _unit(factor: Array) -> Array:
    """Return the direction of a factor; a zero factor has an arbitrary one."""
    size = float(np.linalg.norm(factor))
    return factor / size if size else np.full(len(factor), len(factor) ** -0.5)


def _half_steps(pieces: list[Array], target: Array, bs: list[Array]) -> list[Array]:
    """Least squares for all mu_i with the b_i fixed, then for all b_i with the mu_i fixed; directions alone count."""
    design = _regressors(pieces, [_unit(b) for b in bs])
    mus = _split(_normal_equations(design, target), [piece.shape[2] for piece in pieces])
    design = np.concatenate([(piece @ _unit(mu)).T for piece, mu in zip(pieces, mus)], axis=1)
    return _split(_normal_equations(design, target), [piece.shape[0] for piece in pieces])


def _regressors(pieces: list[Array], bs: list[Array]) -> Array:
    """Regressors (k, sum P) of all mu_i with the b_i fixed."""
    return np.concatenate([np.dot(b, piece.reshape(len(b), -1)).reshape(piece.shape[1:])
                           for piece, b in zip(pieces, bs)], axis=1)


def _split(vector: Array, sizes: Sequence[int]) -> list[Array]:
    """Cut a vector into parts of these sizes."""
    return [vector[start:stop] for start, stop in pairwise(accumulate(sizes, initial=0))]


def _normal_equations(design: Array, target: Array) -> Array:
    """Least squares by Cholesky: in whitened coordinates the columns are nearly orthogonal."""
    gram = design.T @ design
    gram.flat[::len(gram) + 1] += 1e-13 * np.trace(gram) / len(gram)
    return _posv(gram, design.T @ target)[1]


def minimise(problem: RankOne, start: Point | None = None, *, count: int = 8, seed: int = 0) -> LocalSolution:
    """Best local minimiser over several starts, or the one reached from a given start.

    Raises:
        RankError: the compressed regressor is singular.
    """
    core = problem.core
    if start is not None:
        return descend(core, core.factors(start)[2])
    return best_of(core, count, seed)


def best_of(core: Core, count: int = 8, seed: int = 0, iterations: int = 1000, first: int = 0) -> LocalSolution:
    """Best local minimiser of a reduced problem over the starts ``first .. count - 1``."""
    found = [descend(core, bs, iterations, alternations=0 if k < 2 else 2)
             for k, (_, bs) in enumerate(starts(core, count, seed)) if k >= first]
    return min(found, key=lambda solution: solution.value)
