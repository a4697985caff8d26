"""Least squares in rank-one blocks: the problem and its reduction to a whitened bilinear core.

    minimise  F(z) = ||R z - s||^2 + remainder,   z = [w; vec Theta_1; ...; vec Theta_B],   Theta_i = mu_i b_i^T

R is the compressed regressor of a Hammerstein model, one block per input channel. Everything that is linear is
eliminated; what remains is written in coordinates where its Gram matrix is nearly the identity.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

from optid.arrays import Array
from optid.errors import RankError, StructureError
from optid.structures.whitening import Whitening, block_slices, whiten

(_trtrs,) = get_lapack_funcs(("trtrs",), dtype=float)


@dataclass(frozen=True, eq=False)
class RankOne:
    """A least-squares problem in rank-one blocks.

    Raises:
        StructureError: shapes that do not fit together, or a root that is not triangular.
    """

    root: Array  # (n, n) upper triangular R
    target: Array  # (n,) right-hand side s
    remainder: float  # the part of the objective no parameter changes, >= 0
    # shape (P_i, nb_i) of every Theta_i; column order as in vec_F, that is kron(b_i, mu_i)
    blocks: tuple[tuple[int, int], ...]
    linear: int = 0  # number of leading unknowns w outside the blocks
    # Y^T Y, the energy against which a vanishing objective is judged; by default ||s||^2 + remainder
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

    @cached_property
    def slices(self) -> list[slice]:
        """Columns of every block in the lifted vector."""
        return block_slices(self.blocks, self.linear)

    @cached_property
    def core(self) -> "Core":
        """The reduction that keeps nothing in the core (`reduce`): start, solver and proof share it."""
        return reduce(self)

    @cached_property
    def proofs(self) -> list[tuple[float, Any]]:
        """The objective that was proved to be the smallest, with its certification, so that it is proved once."""
        return []

    def value(self, z: Array) -> float:
        """Objective at the lifted vector z (n,)."""
        residual = self.root @ z - self.target
        return float(residual @ residual) + self.remainder


@dataclass(frozen=True, eq=False)
class Point:
    """A point of the factored problem: w (linear,), mus[i] (P_i,), bs[i] (nb_i,)."""

    w: Array
    mus: tuple[Array, ...]
    bs: tuple[Array, ...]

    def lift(self) -> Array:
        """Return z = [w; kron(b_1, mu_1); ...]."""
        return np.concatenate([self.w, *(np.outer(b, mu).ravel() for mu, b in zip(self.mus, self.bs))])

    def tangent(self) -> Array:
        """Return the Jacobian of `lift` in [w; mu_1; b_1; mu_2; ...]."""
        row = column = len(self.w)
        found = np.zeros((row + sum(mu.size * b.size for mu, b in zip(self.mus, self.bs)),
                          row + sum(mu.size + b.size for mu, b in zip(self.mus, self.bs))))
        found[:row, :row] = np.eye(row)
        for mu, b in zip(self.mus, self.bs):
            p, q = mu.size, b.size
            block = found[row : row + p * q, column : column + p + q].reshape(q, p, p + q)
            block[:, :, :p] = b[:, None, None] * np.eye(p)
            block[:, :, p:] = np.eye(q)[:, None, :] * mu[:, None]
            row, column = row + p * q, column + p + q
        return found

    def normalise(self) -> "Point":
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
class Core:
    """The bilinear core of a problem: linear unknowns eliminated, the blocks in whitened coordinates.

    Blocks with one row or one column are linear too. Blocks that carry constraints can be kept, and with them w.
    """

    problem: RankOne  # the problem it comes from
    order: NDArray[np.intp]  # columns of the problem, eliminated ones first
    triangle: Array  # R factor (n, n) of the reordered root
    rotated: Array  # (n,) target rotated with it
    kept: tuple[int, ...]  # indices of the blocks in the core
    linear: int  # number of linear unknowns kept in the core (all of w, or none)
    whitening: Whitening  # its coordinates

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
        return _solve_upper(self.triangle[self.eliminated:, self.eliminated:], self.target)

    def factors(self, point: Point) -> tuple[Array, list[Array], list[Array]]:
        """Whitened (w, mus, bs) of a point, balanced so that every b has unit length."""
        w = self.whitening.factor_w @ point.w if self.linear else np.empty(0)
        mus, bs = self.whitening.forward(tuple(point.mus[i] for i in self.kept), tuple(point.bs[i] for i in self.kept))
        pairs = [_gauge(mu, b) for mu, b in zip(mus, bs)]
        return w, [mu for mu, _ in pairs], [b for _, b in pairs]

    def point(self, mus: list[Array], bs: list[Array], w: Array | None = None) -> Point:
        """Back substitution: the best point of the problem for these whitened factors (and w, where it is kept)."""
        mus, bs = self.whitening.back(mus, bs)
        kept_w = _solve_upper(self.whitening.factor_w, w) if w is not None else np.empty(0)
        core = np.concatenate([kept_w, *(np.outer(b, mu).ravel() for mu, b in zip(mus, bs))])
        k = self.eliminated
        z = np.empty(len(self.order))
        z[self.order[k:]] = core
        z[self.order[:k]] = _solve_upper(self.triangle[:k, :k], self.rotated[:k] - self.triangle[:k, k:] @ core)
        all_mus, all_bs = [], []
        for i, (columns, (_, nb)) in enumerate(zip(self.problem.slices, self.problem.blocks)):
            if i in self.kept:
                mu, b = mus[self.kept.index(i)], bs[self.kept.index(i)]
            else:
                mu, b = (z[columns], np.ones(1)) if nb == 1 else (np.ones(1), z[columns])
            all_mus.append(mu)
            all_bs.append(b)
        return Point(z[:self.problem.linear], tuple(all_mus), tuple(all_bs)).normalise()


def _solve_upper(triangle: Array, right: Array) -> Array:
    if not len(right):
        return right
    solution, info = _trtrs(triangle, right)
    if info:
        raise RankError(f"the data do not determine the parameters: the compressed regressor is singular at column "
                        f"{info - 1}; use fewer basis functions or lags, or a penalty")
    return solution


def reduce(problem: RankOne, keep: tuple[int, ...] = (), keep_linear: bool = False) -> Core:
    """Eliminate what is linear and whiten the rest.

    Blocks with one row or one column stay in the core where they are to be kept, and w where constraints act on it. The
    Schur complement of leading columns is the trailing triangle of the root itself, so nothing is squared.
    """
    slices = problem.slices
    kept = tuple(i for i, shape in enumerate(problem.blocks) if min(shape) > 1 or i in keep)
    chunks = [slices[i] for i in range(len(slices)) if i not in kept]
    w = slice(0, problem.linear)
    chunks = [*chunks, w] if keep_linear else [w, *chunks]
    columns = np.arange(len(problem.target))
    order = np.concatenate([*(columns[c] for c in chunks), *(columns[slices[i]] for i in kept), np.empty(0, np.intp)])
    triangle, rotated = problem.root, problem.target
    if (np.diff(order) != 1).any():
        stacked = np.asarray(np.linalg.qr(np.column_stack([triangle[:, order], rotated]), mode="r"))
        triangle, rotated = stacked[:, :-1], stacked[:, -1]
    shapes = tuple(problem.blocks[i] for i in kept)
    linear = problem.linear if keep_linear else 0
    size = linear + sum(p * nb for p, nb in shapes)
    whitening = whiten(triangle[len(order) - size:, len(order) - size:], shapes, linear)
    return Core(problem, order, triangle, rotated, kept, linear, whitening)


def matrices(theta: Array, shapes: tuple[tuple[int, int], ...]) -> list[Array]:
    """Split a vector into its matrices (P_i, nb_i)."""
    return [theta[where].reshape(nb, p).T for where, (p, nb) in zip(block_slices(shapes), shapes)]
