"""Least squares in rank-one blocks: the problem, its elimination to the bilinear core, and its local solution.

    minimise  F(z) = ||R z - s||^2 + remainder,   z = [w; vec Theta_1; ...; vec Theta_B],   Theta_i = mu_i b_i^T

R is the compressed regressor of a Hammerstein model, one block per input channel. The local method is Newton's with
Levenberg damping on the manifold of rank-one matrices, in Kronecker-whitened coordinates; :func:`alternate` is the
classical alternating least squares (Bai, Automatica 34, 1998), an independent method for comparison.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack, solve_triangular

from optid.errors import RankError, StructureError
from optid.whitening import Whitening, whiten

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RankOne:
    """A least-squares problem in rank-one blocks.

    Attributes:
        root: (n, n) upper triangular R.
        target: (n,) right-hand side s.
        remainder: the part of the objective no parameter changes, >= 0.
        blocks: shape (P_i, nb_i) of every Theta_i; column order as in vec_F, that is kron(b_i, mu_i).
        linear: number of leading unknowns w outside the blocks.
        scale: Y^T Y, the energy against which a vanishing objective is judged; by default ||s||^2 + remainder.

    Raises:
        StructureError: shapes that do not fit together, or a root that is not triangular.
    """

    root: Array
    target: Array
    remainder: float
    blocks: tuple[tuple[int, int], ...]
    linear: int = 0
    scale: float = field(default=float("nan"))

    def __post_init__(self):
        n = self.linear + sum(p * nb for p, nb in self.blocks)
        if self.root.shape != (n, n) or self.target.shape != (n,):
            raise StructureError(f"{self.linear} linear unknowns and blocks {self.blocks} need a root ({n}, {n}) and a "
                                 f"target ({n},), not {self.root.shape} and {self.target.shape}")
        if not self.remainder >= 0:
            raise StructureError(f"remainder must be >= 0, not {self.remainder}")
        if np.tril(self.root, -1).any():
            raise StructureError("root must be upper triangular: take the R factor of the stacked regressor")
        if np.isnan(self.scale):
            object.__setattr__(self, "scale", float(self.target @ self.target) + self.remainder)

    @property
    def H(self) -> Array:  # noqa: N802 - the letter of the quadratic form
        """Gram matrix R^T R (n, n)."""
        return self.root.T @ self.root

    @property
    def g(self) -> Array:
        """R^T s (n,)."""
        return self.root.T @ self.target

    @property
    def c(self) -> float:
        """Objective at z = 0."""
        return float(self.target @ self.target) + self.remainder

    def value(self, z: Array) -> float:
        """Objective at the lifted vector z (n,)."""
        residual = self.root @ z - self.target
        return float(residual @ residual) + self.remainder

    def gap(self, value: float, bound: float) -> float:
        """Relative gap (F - D) / max(F, 1e-9 Y^T Y)."""
        return max(value - bound, 0.0) / max(value, 1e-9 * self.scale, np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Point:
    """A point of the factored problem: w (linear,), mus[i] (P_i,), bs[i] (nb_i,)."""

    w: Array
    mus: tuple[Array, ...]
    bs: tuple[Array, ...]

    def lift(self) -> Array:
        """Return z = [w; kron(b_1, mu_1); ...]."""
        return np.concatenate([self.w, *(np.kron(b, mu) for mu, b in zip(self.mus, self.bs))])

    def normalised(self) -> "Point":
        """The same model in the gauge ||b_i|| = 1, first non-zero of b_i positive."""
        pairs = [_gauge(mu, b) for mu, b in zip(self.mus, self.bs)]
        return Point(self.w, tuple(mu for mu, _ in pairs), tuple(b for _, b in pairs))


def _gauge(mu: Array, b: Array) -> tuple[Array, Array]:
    length = float(np.linalg.norm(b))
    if length == 0.0:
        return np.zeros_like(mu), np.eye(len(b))[0]
    first = b[np.argmax(np.abs(b) > 1e-12 * length)]
    length = np.copysign(length, first)
    return mu * length, b / length


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


@dataclass(frozen=True, eq=False)
class Core:
    """The bilinear core of a problem: linear unknowns eliminated, the blocks in whitened coordinates.

    Blocks with one row or one column are linear too. Blocks that carry constraints can be kept, and with them w.

    Attributes:
        problem: the problem it comes from.
        order: columns of the problem, eliminated ones first.
        triangle: R factor (n, n) of the reordered root.
        target: (n,) rotated with it.
        kept: indices of the blocks in the core.
        linear: number of linear unknowns kept in the core (all of w, or none).
        whitening: its coordinates.
    """

    problem: RankOne
    order: NDArray[np.intp]
    triangle: Array
    rotated: Array
    kept: tuple[int, ...]
    linear: int
    whitening: Whitening

    @property
    def eliminated(self) -> int:
        """Number of eliminated unknowns."""
        return len(self.order) - self.linear - sum(p * nb for p, nb in self.shapes)

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """(P_i, nb_i) of the blocks in the core."""
        return self.whitening.shapes

    @cached_property
    def root(self) -> Array:
        """Root (k, k) of the core in whitened coordinates; no longer triangular."""
        return self.whitening.columns(self.triangle[self.eliminated:, self.eliminated:])

    @property
    def target(self) -> Array:
        """Target (k,) of the core."""
        return self.rotated[self.eliminated:]

    @cached_property
    def gram(self) -> Array:
        """Gram matrix (k, k) in whitened coordinates."""
        return self.root.T @ self.root

    @cached_property
    def least_squares(self) -> Array:
        """Unrestricted minimiser (k,) in the original coordinates of the core."""
        part = self.triangle[self.eliminated:, self.eliminated:]
        return _solve_upper(part, self.target)

    def factors(self, point: Point) -> tuple[Array, list[Array], list[Array]]:
        """Whitened (w, mus, bs) of a point, balanced so that every b has unit length."""
        w = self.whitening.factor_w @ point.w if self.linear else np.empty(0)
        mus, bs = self.whitening.forward(tuple(point.mus[i] for i in self.kept), tuple(point.bs[i] for i in self.kept))
        pairs = [_gauge(mu, b) for mu, b in zip(mus, bs)]
        return w, [mu for mu, _ in pairs], [b for _, b in pairs]

    def point(self, mus: list[Array], bs: list[Array]) -> Point:
        """Back substitution: the best point of the problem for these whitened factors (w not kept)."""
        mus, bs = self.whitening.back(mus, bs)
        theta = np.concatenate([np.kron(b, mu) for mu, b in zip(mus, bs)]) if mus else np.empty(0)
        k = self.eliminated
        z = np.empty(len(self.order))
        z[self.order[:k]] = _solve_upper(self.triangle[:k, :k], self.rotated[:k] - self.triangle[:k, k:] @ theta)
        all_mus, all_bs = [], []
        for i, (columns, (p, nb)) in enumerate(zip(block_slices(self.problem), self.problem.blocks)):
            if i in self.kept:
                mu, b = mus[self.kept.index(i)], bs[self.kept.index(i)]
            else:
                mu, b = (z[columns], np.ones(1)) if nb == 1 else (np.ones(1), z[columns])
            all_mus.append(mu)
            all_bs.append(b)
        return Point(z[:self.problem.linear], tuple(all_mus), tuple(all_bs)).normalised()


def block_slices(problem: RankOne) -> list[slice]:
    """Columns of every block in the lifted vector."""
    edges = problem.linear + np.cumsum([0, *(p * nb for p, nb in problem.blocks)])
    return [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:])]


def _solve_upper(triangle: Array, right: Array) -> Array:
    if not len(right):
        return right
    solution, info = lapack.dtrtrs(triangle, right)
    if info:
        raise RankError(f"the data do not determine the parameters: the compressed regressor is singular at column "
                        f"{info - 1}; use fewer basis functions or lags, or a penalty")
    return solution


def reduce(problem: RankOne, keep: tuple[int, ...] = (), keep_linear: bool = False) -> Core:
    """Eliminate what is linear and whiten the rest.

    The Schur complement of leading columns is the trailing triangle of the root itself, so nothing is squared.

    Args:
        problem: the problem.
        keep: blocks that stay in the core although they have one row or one column.
        keep_linear: keep w, because constraints act on it.
    """
    slices = block_slices(problem)
    kept = tuple(i for i, shape in enumerate(problem.blocks) if min(shape) > 1 or i in keep)
    chunks = [slices[i] for i in range(len(slices)) if i not in kept]
    w = slice(0, problem.linear)
    chunks = [*chunks, w] if keep_linear else [w, *chunks]
    columns = np.arange(len(problem.target))
    order = np.concatenate([*(columns[c] for c in chunks), *(columns[slices[i]] for i in kept), np.empty(0, np.intp)])
    triangle, rotated = problem.root, problem.target
    if (np.diff(order) != 1).any():
        stacked = np.linalg.qr(np.column_stack([triangle[:, order], rotated]), mode="r")
        triangle, rotated = stacked[:, :-1], stacked[:, -1]
    shapes = tuple(problem.blocks[i] for i in kept)
    linear = problem.linear if keep_linear else 0
    size = linear + sum(p * nb for p, nb in shapes)
    whitening = whiten(triangle[len(order) - size:, len(order) - size:], shapes, linear)
    return Core(problem, order, triangle, rotated, kept, linear, whitening)


def starts(core: Core, count: int = 8, seed: int = 0) -> list[tuple[list[Array], list[Array]]]:
    """Starting factors in whitened coordinates: the whitened SVD, the plain SVD split, further pairs, random ones.

    Args:
        core: the reduced problem.
        count: how many.
        seed: of the random directions b.
    """
    estimates = _matrices(core.least_squares, core.shapes)
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


def _matrices(theta: Array, shapes: tuple[tuple[int, int], ...]) -> list[Array]:
    """Split a vector into its matrices (P_i, nb_i)."""
    edges = np.cumsum([p * nb for p, nb in shapes])[:-1]
    return [part.reshape(nb, p).T for part, (p, nb) in zip(np.split(theta, edges), shapes)]


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
    damping, taken, gradient = 0.0, 0, np.inf
    residual = _residual(pieces, target, state)
    value = float(residual @ residual)
    while True:
        jacobian, slope, curvature = _linearise(pieces, root, core.shapes, residual, state)
        gradient = float(np.linalg.norm(slope)) / reference
        if gradient <= tolerance or taken >= iterations:
            break
        hessian = jacobian.T @ jacobian + curvature
        improved = False
        while not improved and damping < 1e12:
            step = _newton_step(hessian, slope, damping)
            if step is not None:
                trial = _retract(state, step, core.shapes)
                trial_residual = _residual(pieces, target, trial)
                trial_value = float(trial_residual @ trial_residual)
                improved = trial_value <= value * (1 + 1e-14) + noise
            if not improved:
                damping = max(4 * damping, 1e-3)
        if not improved:
            break
        state, residual, value = trial, trial_residual, trial_value
        damping = damping / 8 if damping > 1e-3 else 0.0
        taken += 1
    point = core.point([size * unit for size, unit, _ in state], [b for _, _, b in state])
    return LocalSolution(point, core.problem.value(point.lift()), taken, gradient, gradient <= tolerance)


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
    return lapack.dposv(gram, design.T @ target)[1]


def _linearise(pieces, root, shapes, residual, state) -> tuple[Array, Array, Array]:
    """Jacobian of the residual, gradient, and what the curvature of the manifold and the gauge add to J^T J."""
    jacobian = np.concatenate([part for piece, (_, mu, b) in zip(pieces, state)
                               for part in (np.tensordot(b, piece, 1), (piece @ mu).T)], axis=1)
    curvature = np.zeros((jacobian.shape[1],) * 2)
    start = 0
    slope = jacobian.T @ residual
    for (p, nb), (size, mu, b), gradient in zip(shapes, state, _matrices(root.T @ residual, shapes)):
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
    step, info = lapack.dposv(damped, -slope)[1:]
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


def _split_solution(head: Array, designs: list[Array], target: Array) -> list[Array]:
    whole = np.concatenate([head, *designs], axis=1)
    solution = np.linalg.lstsq(whole, target, rcond=None)[0]
    return np.split(solution, np.cumsum([head.shape[1], *(d.shape[1] for d in designs)])[:-1])
