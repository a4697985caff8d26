"""The interface of compressed data that prices, fits and intervals use."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from optid.arrays import Array
from optid.errors import RankError


@dataclass(frozen=True, eq=False)
class Spread:
    """How far an estimate scatters."""

    covariance: Array  # (k, k) of its coordinates
    noise: Array  # (l, l) covariance of the errors, in units of the objective
    dof: float  # degrees of freedom that are left to estimate it
    penalised: bool = False  # whether a penalty is part of the objective
    words: tuple[str, ...] = ()  # what the errors are found to be that white ones of one level are not


class Compressed(Protocol):
    """A record reduced to least squares in z, at a size that does not grow with its length.

    Attributes:
        problem: the numbers of ``‖root z - target‖² + remainder``: root (k, n), target (k,), remainder.
        statistics: the rows behind it: ``root``, the triangular factor of [regressor | outputs]; ``rows`` used and
            ``candidates`` in the record; number of ``constants`` eliminated; ``condition`` of the factor and the
            ``method`` that made it.
        columns: (n_columns, l) positions in z of the coefficients of the columns of the factor.
        energy: (l,) sum of squares of every output about its mean, in units of the objective.
    """

    @property
    def problem(self) -> Any: ...  # noqa: D102
    @property
    def statistics(self) -> Any: ...  # noqa: D102
    @property
    def columns(self) -> Any: ...  # noqa: D102
    @property
    def energy(self) -> Array: ...  # noqa: D102

    def lifted(self, values: Mapping[str, np.ndarray]) -> Array:
        """Return z (n,) of named values."""
        ...

    def one_step_fit(self, values: Mapping[str, np.ndarray]) -> Array | None:
        """Return the one-step fit (l,) in %; None where only a run of the model tells it."""
        ...

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter of an estimate in k coordinates in which its information is the identity.

        Args:
            z: (n,) at the minimum.
            moves: (n, k) its derivatives with respect to the coordinates.
        """
        ...


def white_spread(compressed: Compressed, z: Array, moves: Array) -> Spread:
    """Return `Compressed.spread` for rows whose errors are white.

    Multi-output noise is estimated as a full covariance matrix, although the outputs were fitted with equal weights
    (sandwich form).

    Raises:
        RankError: no rows are left to estimate the noise from.
    """
    statistics, columns = compressed.statistics, compressed.columns
    (n, l), root = columns.shape, statistics.root  # noqa: E741
    sensitivity = np.einsum("ij,jok->oik", root[:n, :n], moves[columns])
    parameters = float(np.sum(sensitivity**2))
    dof = degrees_of_freedom(statistics.rows, parameters / l + statistics.constants)
    residual = root @ np.vstack([z[columns], -np.eye(l)])
    noise = residual.T @ residual / dof
    covariance = np.einsum("oij,op,pik->jk", sensitivity, noise, sensitivity)
    penalised = parameters < len(covariance) * (1 - 1e-9)
    if penalised:
        prior = np.eye(len(covariance)) - np.einsum("oij,oik->jk", sensitivity, sensitivity)
        covariance = covariance + float(np.trace(noise)) / l * prior
    return Spread(covariance, noise, dof, penalised)


def degrees_of_freedom(rows: float, parameters: float) -> float:
    """Return what so many rows leave beside the parameters (`RankError`: nothing)."""
    if not rows > parameters:
        raise RankError(f"{rows:.0f} rows for {parameters:.0f} parameters: none are left to estimate the noise")
    return rows - parameters
