"""Covariances of the noises of a state-space model, and the steady Kalman gain that belongs to them."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import LARGEST, Array, finite
from optid.errors import StructureError

ROUNDING = -1e-4  # smallest eigenvalue of a correlation matrix that may be a rounding error of an estimate


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
            object.__setattr__(self, name, finite(getattr(self, name), name, LARGEST**2))
        if self.S.ndim != 2:
            raise StructureError(f"S has shape {self.S.shape}; it must be a matrix.")
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
        """Return those of ``w = K e, v = e`` for the gain K (n, l) and the covariance (l, l) of the innovations e."""
        return cls(_congruent(gain, covariance), covariance, gain @ covariance, covariance)

    def transform(self, states: Array, outputs: Array) -> "NoiseCovariances":
        """Return the covariances of T x and G y for ``states`` T (n, n) and ``outputs`` G (l, l)."""
        return NoiseCovariances(_congruent(states, self.Q), _congruent(outputs, self.R), states @ self.S @ outputs.T,
                                _congruent(outputs, self.innovation))

    def to_dict(self) -> dict[str, Any]:
        """Describe the matrices in JSON types."""
        return {name: getattr(self, name).tolist() for name in ("Q", "R", "S", "innovation")}


def _check_positive(name: str, matrix: Array) -> None:
    """Refuse a negative variance along any direction, rounding aside (`StructureError`)."""
    variances = np.diag(matrix)
    size = np.sqrt(np.where(variances > 0, variances, 1.0))
    if variances.size and np.linalg.eigvalsh(matrix / np.outer(size, size))[0] < ROUNDING:
        raise StructureError(f"{name} is no covariance: it has a negative variance along some direction.")


def _congruent(turn: Array, matrix: Array) -> Array:
    product = turn @ matrix @ turn.T
    return (product + product.T) / 2


class Kalman(NamedTuple):
    """The steady predictor x+ = A x + ... + K (y - C x - ...)."""

    K: Array  # (n, l) gain
    innovation: Array  # (l, l) covariance of y - C x - ....
    error: Array  # (n, n) covariance of the error of the predicted state


def kalman_gain(A: Array, C: Array, Q: Array, R: Array, S: Array | None = None) -> Kalman:
    """Solve the Riccati equation of the one-step predictor.

    P = A P A^T + Q - (A P C^T + S) (C P C^T + R)^-1 (A P C^T + S)^T, K = (A P C^T + S) (C P C^T + R)^-1, with the
    covariances of `NoiseCovariances`; S is zero by default.

    Raises:
        StructureError: shapes that do not agree, R not positive definite, or no stabilising solution: a mode on or
            outside the unit circle that the outputs do not see, or one on it that the noise does not drive.
    """
    from scipy.linalg import solve_discrete_are

    A, C, Q, R = (np.atleast_2d(np.asarray(matrix, dtype=float)) for matrix in (A, C, Q, R))
    n, outputs = A.shape[0], C.shape[0]
    S = np.zeros((n, outputs)) if S is None else np.asarray(S, dtype=float)
    for name, matrix, shape in (
        ("A", A, (n, n)), ("C", C, (outputs, n)), ("Q", Q, (n, n)), ("R", R, (outputs, outputs)), ("S", S, (n, outputs))
    ):
        if matrix.shape != shape:
            raise StructureError(f"{name} has shape {matrix.shape}; it must be {shape}.")
    if np.linalg.eigvalsh((R + R.T) / 2)[0] <= 0:
        raise StructureError("R is not positive definite: give every output some measurement noise.")
    if n == 0:
        return Kalman(np.zeros((0, outputs)), R, np.zeros((0, 0)))
    try:
        with np.errstate(invalid="ignore"):  # its balancing meets numbers beyond the range of integers
            error = solve_discrete_are(A.T, C.T, (Q + Q.T) / 2, (R + R.T) / 2, s=S)
    except np.linalg.LinAlgError as cause:
        raise StructureError(
            f"The Riccati equation has no stabilising solution ({cause}): a mode of A on or outside the unit circle is "
            "not seen by the outputs, or one on it is not driven by the process noise."
        ) from cause
    cross = A @ error @ C.T + S
    innovation = C @ error @ C.T + R
    return Kalman(np.linalg.solve(innovation, cross.T).T, (innovation + innovation.T) / 2, (error + error.T) / 2)
