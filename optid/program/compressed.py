"""How far an estimate scatters that is least squares in z, of a record at a size that does not grow with its length.

Such a compressed record, `optid.core.problem.Problem.compressed`, has the ``problem``, ``‖root z - target‖² +
remainder``; its ``statistics``, the factor ``root`` of [regressor | outputs] with its number of ``rows``,
``candidates``, and ``constants`` eliminated, its ``condition`` and ``method``; and the ``energy`` (l,) of the outputs
in units of the objective; and ``outward``, what leads from the units of the programme's models to those of the record,
or None. Its methods are ``lift(values)``, z; ``one_step_fit(values)`` (l,) in %, or None; and
``spread(z, moves)``, moves (n, k) the derivatives of z by coordinates in which the information is the identity.
"""

from dataclasses import dataclass
from typing import Any

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


def white_spread(statistics: Any, columns: Any, z: Array, moves: Array) -> Spread:
    """Return the scatter for rows whose errors are white; columns (n_columns, l) are the places in z of coefficients.

    Multi-output noise is estimated as a full covariance matrix, although the outputs were fitted with equal weights
    (sandwich form).

    Raises:
        RankError: no rows are left to estimate the noise from.
    """
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
