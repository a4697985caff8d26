"""The structured problem: ``min ‖left H(v) right - T(theta) Phi‖_* + weight ‖v - y‖²``.

H(v) is the block Hankel matrix of output sequences v (all windows of the record that can be used, experiments side by
side), T(theta) the block Toeplitz and constant part that known signals explain. Everything an iteration needs is an
operation on matrices of the size of H; what it solves has a Gram matrix of the size of one output sequence, which is
decomposed once for all weights and step sizes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import pinvh

from optid.arrays import Array

RANK = 1e-11  # eigenvalues below this part of the largest are none


@dataclass(frozen=True, eq=False)
class KnownSignals:
    """Known signals that enter through lower block Toeplitz matrices, and a constant for every block row.

    ``(T Phi)_i = sum_k t_k phi(i - k) + c_i``, k from 0 for the direct signals, from 1 for the others.
    """

    windows: Array  # (alpha, d, j): signal c at sample i of window w
    direct: np.ndarray  # (d,) whether a signal acts at once
    constant: bool  # whether every block row has its own constant

    @cached_property
    def places(self) -> np.ndarray:
        """(count, 2) lag k and signal c of every Toeplitz coefficient."""
        alpha, d, _ = self.windows.shape
        found = [(k, c) for k in range(alpha) for c in range(d) if k or self.direct[c]]
        return np.array(found, dtype=int).reshape(-1, 2)

    @property
    def size(self) -> int:
        """Number of coefficients for one output: those of `places`, then the constants."""
        return len(self.places) + self.constant * len(self.windows)

    @cached_property
    def stacked(self) -> Array:
        """(alpha d + 1, j) the signals, and a row of ones for the constants."""
        alpha, d, j = self.windows.shape
        return np.vstack([self.windows.reshape(alpha * d, j), np.ones(j)])

    @cached_property
    def entries(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For every block row the rows of `stacked` that enter it, and the coefficients they are multiplied by."""
        alpha, d, _ = self.windows.shape
        k, c = self.places.T
        found = []
        for i in range(alpha):
            inside = np.flatnonzero(k <= i)
            rows = (i - k[inside]) * d + c[inside]
            found.append((np.append(rows, alpha * d), np.append(inside, len(k) + i)) if self.constant
                         else (rows, inside))
        return found

    @cached_property
    def inverse(self) -> Array:
        """Pseudo-inverse of the Gram matrix of the coefficients of one output."""
        return np.asarray(pinvh(self.gram, rtol=RANK))

    @cached_property
    def gram(self) -> Array:
        """(size, size) inner products of the matrices the coefficients multiply."""
        products, whole = self.stacked @ self.stacked.T, np.zeros((self.size, self.size))
        for rows, inside in self.entries:
            whole[np.ix_(inside, inside)] += products[np.ix_(rows, rows)]
        return whole

    def toeplitz(self, theta: Array) -> Array:
        """Return T (alpha l, alpha d + 1) of coefficients theta (size, l), the constants in the last column."""
        whole = np.zeros((len(self.windows), theta.shape[1], len(self.stacked)))
        for block, (rows, inside) in zip(whole, self.entries):
            block[:, rows] = theta[inside].T
        return whole.reshape(-1, len(self.stacked))

    def apply(self, theta: Array) -> Array:
        """Return ``T(theta) Phi`` plus constants, (alpha l, j)."""
        return self.toeplitz(theta) @ self.stacked

    def adjoint(self, z: Array, outputs: int) -> Array:
        """Return (size, l): inner products of z with the matrices the coefficients multiply."""
        products = (z @ self.stacked.T).reshape(len(self.windows), outputs, -1)
        found = np.zeros((self.size, outputs))
        for block, (rows, inside) in zip(products, self.entries):
            found[inside] += block[:, rows].T
        return found

    def coupling(self, starts: np.ndarray, samples: int) -> Array:
        """Return (samples, size): adjoint of the Hankel operator of one output on every coefficient's matrix."""
        found = np.zeros((samples, self.size))
        for i, (rows, inside) in enumerate(self.entries):
            found[np.ix_(starts + i, inside)] += self.stacked[rows].T
        return found


@dataclass(frozen=True, eq=False)
class NuclearProblem:
    """The numbers of one structured problem."""

    y: Array  # (T, l) measured outputs of all experiments, stacked; NaN where missing: these are free
    starts: np.ndarray  # (j,) first sample of every window
    rows: int  # number alpha of block rows
    left: Array | None = None  # (r, alpha l) weight on the left, or None for none
    right: Array | None = None  # (j, q) weight on the right, or None for none
    predictor: KnownSignals | None = None  # known signals, only without weights; None for none

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs."""
        return self.y.shape[1]

    @cached_property
    def known(self) -> np.ndarray:
        """(T, l) which outputs are measured."""
        return ~np.isnan(self.y)

    @cached_property
    def data(self) -> Array:
        """(T, l) measured outputs with zeros where missing."""
        return np.nan_to_num(self.y)

    @cached_property
    def index(self) -> np.ndarray:
        """(alpha l, j) positions in the flattened outputs of the entries of the Hankel matrix."""
        samples = self.starts[None, :] + np.arange(self.rows)[:, None]
        return (samples[:, None, :] * self.l + np.arange(self.l)[None, :, None]).reshape(-1, len(self.starts))

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the matrix whose nuclear norm is taken."""
        return (self.rows * self.l if self.left is None else self.left.shape[0],
                len(self.starts) if self.right is None else self.right.shape[1])

    @property
    def parameters(self) -> int:
        """Number of coefficients of the predictor for one output."""
        return 0 if self.predictor is None else self.predictor.size

    def hankel(self, v: Array) -> Array:
        """Return the weighted Hankel matrix of outputs v (T, l)."""
        found = np.ravel(v)[self.index]
        found = found if self.left is None else self.left @ found
        return found if self.right is None else found @ self.right

    def hankel_adjoint(self, z: Array) -> Array:
        """Return the adjoint of `hankel` at z, (T, l)."""
        z = z if self.right is None else z @ self.right.T
        z = z if self.left is None else self.left.T @ z
        return np.asarray(np.bincount(self.index.ravel(), z.ravel(), self.y.size), dtype=float).reshape(self.y.shape)

    def matrix(self, v: Array, theta: Array) -> Array:
        """Return the matrix whose nuclear norm is taken."""
        found = self.hankel(v)
        return found if self.predictor is None else found - self.predictor.apply(theta)

    def predictor_coefficients(self, z: Array) -> Array:
        """Return (parameters, l): the coefficients that bring ``T(theta) Phi`` nearest to z."""
        if self.predictor is None:
            return np.zeros((0, self.l))
        return self.predictor.inverse @ self.predictor.adjoint(z, self.l)

    def remove_predictor(self, z: Array) -> Array:
        """Return z without what the predictor can explain."""
        return z if self.predictor is None else z - self.predictor.apply(self.predictor_coefficients(z))

    @cached_property
    def gram(self) -> tuple[Array, bool]:
        """Gram matrix of the projected Hankel operator, and whether it is that of one output, equal for all.

        (T, T) where outputs do not mix, else (T l, T l).
        """
        samples, j, first = len(self.y), len(self.starts), self.starts[0]
        outputs = 1 if self.left is None else self.l
        inner = np.eye(self.rows) if self.left is None else self.left.T @ self.left
        inner = inner.reshape(self.rows, outputs, self.rows, outputs)
        outer = 1.0 if self.right is None else self.right @ self.right.T
        whole = np.zeros((outputs, outputs, samples, samples))
        for i, o, ii, oo in zip(*np.nonzero(inner)):
            where: Any = np.ix_(self.starts + i, self.starts + ii)
            if self.right is None:
                where = self.starts + i, self.starts + ii
            elif self.starts[-1] - first == j - 1:  # without gaps: slices instead of copies
                where = slice(first + i, first + i + j), slice(first + ii, first + ii + j)
            whole[o, oo][where] += inner[i, o, ii, oo] * outer
        whole = whole.transpose(2, 0, 3, 1).reshape(samples * outputs, samples * outputs)
        if self.predictor is not None:
            coupling = self.predictor.coupling(self.starts, samples)
            whole -= coupling @ self.predictor.inverse @ coupling.T
        return whole, self.left is None

    @cached_property
    def groups(self) -> tuple["Group", ...]:
        """Outputs that are solved for together, with their Gram matrices decomposed."""
        gram, separate = self.gram
        if not separate:
            return (Group.of(np.arange(self.y.size), gram, self.known.ravel()),)
        found: list[Group] = []
        for o in range(self.l):
            known, where = self.known[:, o], np.arange(len(self.y)) * self.l + o
            same = [found[g] for g in range(o) if np.array_equal(self.known[:, g], known)]
            found.append(replace(same[0], measured=where[known], free=where[~known]) if same
                         else Group.of(where, gram, known))
        return tuple(found)

    def update(self, target: Array, weight: float, step: float) -> tuple[Array, Array]:
        """Return (v, theta) that minimise ``weight ‖v - y‖² + step/2 ‖matrix(v, theta) - target‖²``."""
        pull = self.hankel_adjoint(self.remove_predictor(target)).ravel()
        v = np.zeros(self.y.size)
        for group in self.groups:
            group.solve(v, self.data.ravel(), pull, weight, step)
        v = v.reshape(self.y.shape)
        return v, self.predictor_coefficients(self.hankel(v) - target)

    def value(self, v: Array, theta: Array, weight: float) -> float:
        """Return the objective."""
        misfit = np.where(self.known, v - self.data, 0.0)
        return float(np.linalg.norm(self.matrix(v, theta), "nuc")) + weight * float(np.sum(misfit**2))

    def dual(self, multipliers: Array, weight: float) -> tuple[float, Array]:
        """Return a lower bound on the objective in closed form, and the dual point it is taken at.

        The multipliers (r, q) are projected so that the free variables are stationary, then scaled into the unit ball
        of the spectral norm: the point is always feasible. Multipliers of ``X = matrix(v, theta)`` give a tight bound.
        """
        point = self.remove_predictor(multipliers)
        for group in self.groups:
            if group.free.size:
                step = np.zeros(self.y.size)
                step[group.free] = group.free_inverse @ self.hankel_adjoint(point).ravel()[group.free]
                point = point - self.remove_predictor(self.hankel(step.reshape(self.y.shape)))
        size = float(np.linalg.norm(point, 2))
        if size == 0.0:
            return 0.0, point
        pull = np.where(self.known, self.hankel_adjoint(point), 0.0)
        linear, square = float(np.sum(pull * self.data)), float(np.sum(pull**2))
        best = 2.0 * weight * linear / square if square > 0 else np.inf
        scale = float(np.clip(best, 0.0, 1.0 / size))
        return scale * linear - scale**2 * square / (4.0 * weight), scale * point


@dataclass(frozen=True, eq=False)
class Group:
    """Outputs solved for together, measured ones in eigenvectors of their Gram matrix with the free ones removed."""

    measured: np.ndarray  # positions of the measured outputs in the flattened array
    free: np.ndarray  # and of the missing ones
    values: Array
    vectors: Array  # as columns
    cross: Array  # (measured, free) part of the Gram matrix
    free_inverse: Array  # pseudo-inverse of the free part

    @classmethod
    def of(cls, where: np.ndarray, gram: Array, known: np.ndarray) -> "Group":
        """Decompose the Gram matrix of the outputs at some positions."""
        cross, inner = gram[np.ix_(known, ~known)], gram[np.ix_(~known, ~known)]
        sizes, directions = np.linalg.eigh(inner)
        kept = sizes > RANK * float(np.max(np.diag(gram), initial=0.0))
        inverse = (directions[:, kept] / sizes[kept]) @ directions[:, kept].T
        reduced = gram[np.ix_(known, known)] - cross @ inverse @ cross.T
        values, vectors = np.linalg.eigh((reduced + reduced.T) / 2)
        return cls(where[known], where[~known], np.maximum(values, 0.0), vectors, cross, inverse)

    def solve(self, v: Array, y: Array, pull: Array, weight: float, step: float) -> None:
        """Write the minimiser for given pulls into v."""
        rest = pull[self.measured] - self.cross @ (self.free_inverse @ pull[self.free])
        inner = self.vectors.T @ (2.0 * weight * y[self.measured] + step * rest)
        v[self.measured] = self.vectors @ (inner / (2.0 * weight + step * self.values))
        v[self.free] = self.free_inverse @ (pull[self.free] - self.cross.T @ v[self.measured])


def window_starts(lengths: Sequence[int], rows: int, usable: Sequence[np.ndarray]) -> np.ndarray:
    """Return the first samples of the windows of some rows whose samples are all usable, in the stacked record.

    Lengths are those of the experiments; usable is (N,) for each.
    """
    if sum(lengths) < rows:
        return np.zeros(0, dtype=int)
    whole = np.lib.stride_tricks.sliding_window_view(np.concatenate(usable), rows).all(axis=1)
    experiment = np.repeat(np.arange(len(lengths)), lengths)
    return np.flatnonzero(whole & (experiment[: whole.size] == experiment[rows - 1 :]))
