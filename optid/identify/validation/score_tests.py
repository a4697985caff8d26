"""Score tests: do further columns reduce what a hypothesis leaves of an output?

The errors are whitened by an autoregression, which is as valid for noise of any colour: filtering in time changes
neither the hypothesis nor the alternative. Every experiment has its own level and decays, which are projected out.
Source: Lagrange-multiplier tests of nonlinear regressions (Engle 1984).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lstsq, qr
from scipy.special import fdtrc, ncfdtr

from optid.arrays import Array
from optid.identify.informativity.signals import whiten_rows
from optid.statistics.factors import ROUNDING

DEPENDENT = 1e-8  # share of its length that a column must keep beside the others not to be a combination of them
LEAST = 1e-2  # share of its length that a column must keep beside the tangent space, to be more than its own error
DISTINCT = 1e-4  # eigenvalue of the correlations of such columns that counts as a further direction


@dataclass(frozen=True)
class FTest:
    """One F test: its p value, and the share of the residual variance that an alternative saves."""

    p_value: float = 1.0
    saving: float = 0.0

    @classmethod
    def of(cls, more: float, extra: int, rest: float, spare: int, negligible: float) -> "FTest":
        """Compare the reduction `more` by `extra` parameters with the rest at `spare` degrees of freedom.

        Under the hypothesis the true reduction is at most a share `negligible` of the variance: the statistic follows a
        noncentral F distribution at that share. The saving discounts the degrees of freedom.
        """
        if extra <= 0 or rest <= 0:
            return cls()
        free, restricted = rest / spare, (rest + max(more, 0.0)) / (spare + extra)
        ratio = max(more, 0.0) / extra / free
        p = 1 - ncfdtr(extra, spare, negligible * (spare + extra), ratio) if negligible else fdtrc(extra, spare, ratio)
        return cls(float(max(p, 0.0)), float(1 - free / restricted))


@dataclass(frozen=True, eq=False)
class Regression:
    """The rows of a regression, one array per experiment."""

    present: tuple[NDArray[np.bool_], ...]  # rows that count, (N,)
    nuisance: tuple[Array, ...]  # columns (N, q) that are projected out of every experiment by itself
    noise: Array  # polynomial [1, a1, ...] that whitens the errors

    @cached_property
    def _parts(self) -> list[tuple[NDArray[np.bool_], Array]]:
        """Rows whose past is complete, and an orthonormal basis of the nuisance in them."""
        past = self.noise.size - 1
        found = []
        for here, columns in zip(self.present, self.nuisance):
            complete = np.convolve(~here, np.ones(past + 1))[past : len(here)] < 0.5
            found.append((complete, orthonormal(whiten_rows(self.noise, columns)[complete])))
        return found

    @property
    def spare(self) -> int:
        """Rows less the directions that are projected out."""
        return sum(int(complete.sum()) - basis.shape[1] for complete, basis in self._parts)

    def reduce(self, columns: Sequence[Array]) -> Array:
        """Whiten columns, (N, ...) per experiment, and project the nuisance out: (R, ...)."""
        found, before = [], 0.0
        for one, (complete, basis) in zip(columns, self._parts):
            white = whiten_rows(self.noise, one)[complete].reshape(int(complete.sum()), -1)
            before = before + np.sum(white**2, axis=0)
            found.append(white - basis @ (basis.T @ white))
        rows = np.vstack(found)
        rows[:, np.sum(rows**2, axis=0) <= DEPENDENT**2 * before] = 0.0  # what is left of a level is rounding
        return rows.reshape(len(rows), *columns[0].shape[1:])


def orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis of the columns, whatever their lengths."""
    sizes = np.linalg.norm(columns, axis=0)
    if not sizes.any():
        return np.zeros((len(columns), 0))
    found: Any = qr(columns[:, sizes > 0] / sizes[sizes > 0], mode="economic", pivoting=True)
    basis, diagonal = np.asarray(found[0]), np.abs(np.diag(np.asarray(found[1])))
    return basis[:, diagonal > DEPENDENT * diagonal[0]]


def solve(columns: Array, target: Array, dependent: float = DEPENDENT) -> Array:
    """Return the least-squares coefficients of columns of any length, however dependent they are, of each target."""
    sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    found: Any = lstsq(columns / sizes, target, cond=dependent, lapack_driver="gelsy")
    return (np.asarray(found[0]).T / sizes).T


def score_test(error: Array, tangent: Array, columns: Array, spare: int, negligible: float) -> FTest | None:
    """Test whether columns reduce the error beside the tangent space of the hypothesis; None if they add nothing to it.

    The error (R,) is what the hypothesis leaves, the tangent (R, n) an orthonormal basis of the directions in which it
    can still move, the columns (R, k) those of the alternative; `spare` counts the rows less what was projected out of
    them.
    """
    error = error - tangent @ (tangent.T @ error)
    sizes = np.linalg.norm(columns, axis=0)
    unit = columns[:, sizes > 0] / sizes[sizes > 0]
    left = unit - tangent @ (tangent.T @ unit)
    lengths = np.linalg.norm(left, axis=0)
    left = left[:, lengths > LEAST] / lengths[lengths > LEAST]
    if not left.size:
        return None
    values, vectors = np.linalg.eigh(left.T @ left)
    basis = left @ vectors[:, values > DISTINCT] / np.sqrt(values[values > DISTINCT])
    extra = basis.shape[1]
    if spare < tangent.shape[1] + 2 * extra:
        return None
    more, whole = float(np.sum((basis.T @ error) ** 2)), float(error @ error)
    rest = max(whole - more, ROUNDING["qr"] ** 2 * whole)
    return FTest.of(more, extra, rest, spare - tangent.shape[1] - extra, negligible)
