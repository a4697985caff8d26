"""The innovation form: the steady Kalman gain of given noise covariances."""

from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError


class Kalman(NamedTuple):
    """The steady predictor x+ = A x + ... + K (y - C x - ...).

    Attributes:
        K: (n, l) gain.
        innovation: (l, l) covariance of y - C x - ....
        error: (n, n) covariance of the error of the predicted state.
    """

    K: Array
    innovation: Array
    error: Array


def kalman_gain(A: Array, C: Array, Q: Array, R: Array, S: Array | None = None) -> Kalman:
    """Solve the Riccati equation of the one-step predictor.

    P = A P A^T + Q - (A P C^T + S) (C P C^T + R)^-1 (A P C^T + S)^T, K = (A P C^T + S) (C P C^T + R)^-1.

    Args:
        A: (n, n).
        C: (l, n).
        Q: (n, n) covariance of the process noise.
        R: (l, l) covariance of the measurement noise, positive definite.
        S: (n, l) cross-covariance, zero by default.

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
            raise StructureError(f"{name} has shape {matrix.shape}; {shape} is needed.")
    if np.linalg.eigvalsh((R + R.T) / 2)[0] <= 0:
        raise StructureError("R is not positive definite: give every output some measurement noise.")
    if n == 0:
        return Kalman(np.zeros((0, outputs)), R, np.zeros((0, 0)))
    try:
        error = solve_discrete_are(A.T, C.T, (Q + Q.T) / 2, (R + R.T) / 2, s=S)
    except np.linalg.LinAlgError as cause:
        raise StructureError(
            f"The Riccati equation has no stabilising solution ({cause}): a mode of A on or outside the unit circle is "
            "not seen by the outputs, or one on it is not driven by the process noise."
        ) from cause
    cross = A @ error @ C.T + S
    innovation = C @ error @ C.T + R
    return Kalman(np.linalg.solve(innovation, cross.T).T, (innovation + innovation.T) / 2, (error + error.T) / 2)
