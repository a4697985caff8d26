"""Covariances of the noises of a state-space model."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError

ROUNDING = -1e-4
"""Smallest eigenvalue of a correlation matrix that may be a rounding error of an estimate."""


@dataclass(frozen=True, eq=False)
class NoiseCovariances:
    """E[w; v][w; v]^T = [Q S; S^T R] of x+ = A x + ... + w, y = C x + ... + v.

    Attributes:
        Q: (n, n) covariance of the process noise, in units of the state squared.
        R: (l, l) covariance of the measurement noise, in units of the outputs squared.
        S: (n, l) their cross-covariance.
        innovation: (l, l) covariance of the innovations, the errors of the best one-step prediction.

    Raises:
        StructureError: shapes that do not agree, values that are not finite, or a covariance that is not symmetric or
            has a negative variance along some direction.
    """

    Q: Array
    R: Array
    S: Array
    innovation: Array

    def __post_init__(self) -> None:
        for name in ("Q", "R", "S", "innovation"):
            matrix = np.array(getattr(self, name), dtype=float)
            if matrix.ndim != 2 or not np.all(np.isfinite(matrix)):
                raise StructureError(f"{name} has shape {matrix.shape}: a finite matrix is needed.")
            matrix.flags.writeable = False
            object.__setattr__(self, name, matrix)
        n, outputs = self.S.shape
        for name, size in (("Q", n), ("R", outputs), ("innovation", outputs)):
            matrix = getattr(self, name)
            if matrix.shape != (size, size):
                raise StructureError(f"{name} has shape {matrix.shape}; S, {self.S.shape}, needs {(size, size)}.")
            if np.abs(matrix - matrix.T).max(initial=0.0) > 1e-8 * np.abs(matrix).max(initial=0.0):
                raise StructureError(f"{name} is not symmetric.")
        _check_positive("[Q S; S' R]", np.block([[self.Q, self.S], [self.S.T, self.R]]))
        _check_positive("innovation", self.innovation)

    @classmethod
    def of_innovations(cls, gain: Array, covariance: Array) -> "NoiseCovariances":
        """Return those of ``w = K e, v = e``.

        Args:
            gain: K, (n, l).
            covariance: (l, l) of the innovations e.
        """
        return cls(_congruent(gain, covariance), covariance, gain @ covariance, covariance)

    def mapped(self, states: Array, outputs: Array) -> "NoiseCovariances":
        """Return the covariances of T x and G y.

        Args:
            states: T, (n, n).
            outputs: G, (l, l).
        """
        return NoiseCovariances(
            _congruent(states, self.Q), _congruent(outputs, self.R), states @ self.S @ outputs.T,
            _congruent(outputs, self.innovation),
        )

    def to_dict(self) -> dict[str, Any]:
        """Describe the matrices in JSON types."""
        return {name: getattr(self, name).tolist() for name in ("Q", "R", "S", "innovation")}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "NoiseCovariances":
        """Build what `to_dict` described."""
        outputs = np.array(content["R"], dtype=float)
        n = len(content["Q"])
        return cls(
            np.array(content["Q"], dtype=float).reshape(n, n), outputs,
            np.array(content["S"], dtype=float).reshape(n, len(outputs)), np.array(content["innovation"], dtype=float),
        )


def _check_positive(name: str, matrix: Array) -> None:
    """Refuse a negative variance along any direction, rounding aside.

    Raises:
        StructureError: naming the matrix.
    """
    variances = np.diag(matrix)
    size = np.sqrt(np.where(variances > 0, variances, 1.0))
    if variances.size and np.linalg.eigvalsh(matrix / np.outer(size, size))[0] < ROUNDING:
        raise StructureError(f"{name} is no covariance: it has a negative variance along some direction.")


def _congruent(turn: Array, matrix: Array) -> Array:
    product = turn @ matrix @ turn.T
    return (product + product.T) / 2
