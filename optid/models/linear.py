"""Linear state equations x+ = A x + B w, y = C x + D w: their responses, what solves them at rest, balanced states."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_discrete_lyapunov

from optid.arrays import Array
from optid.errors import StructureError
from optid.models import roots


def impulse_response(A: Array, B: Array, C: Array, D: Array, n: int) -> Array:
    """Return D, C B, C A B, ..., (n, l, r)."""
    response, x = np.zeros((n, len(C), B.shape[1])), B
    response[:1] = D
    with np.errstate(all="ignore"):
        for k in range(1, n):
            response[k] = C @ x
            x = A @ x
    return response


def frequency_response(A: Array, B: Array, C: Array, D: Array, w: ArrayLike, dt: float) -> Array:
    """Return C (zI - A)^-1 B + D at the frequencies w (radians per unit of time), complex (len(w), l, r)."""
    z = np.exp(1j * np.atleast_1d(np.asarray(w, dtype=float)) * dt)
    resolvent = np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B.astype(complex))
    return np.asarray(C @ resolvent + D)


def static_solution(matrix: Array, right: Array) -> Array:
    """Solve the equations of a steady state; refuse those of an integrator, which are singular (`StructureError`)."""
    if matrix.size and np.linalg.svd(matrix, compute_uv=False)[-1] <= 1e-12 * (1 + np.abs(matrix).max()):
        raise StructureError("The model has a pole at 1 (an integrator): it has no static gain.")
    return np.asarray(np.linalg.solve(matrix, right), dtype=float)


def balancing(A: Array, B: Array, C: Array) -> Array:
    """Return the change of states T (n, n) that makes both Gramians of (A, B, C) diagonal and equal.

    Raises:
        StructureError: A is unstable, or the triple is not minimal.
    """
    largest = roots.spectral_radius(A)
    if largest >= 1:
        raise StructureError(f"The model is unstable (largest pole {largest:.6g}): it has no Gramians.")
    reach = _root(solve_discrete_lyapunov(A, B @ B.T))
    see = _root(solve_discrete_lyapunov(A.T, C.T @ C))
    left, values, right = np.linalg.svd(see.T @ reach)
    if values[-1] <= 1e-13 * values[0]:
        raise StructureError(
            f"The model is not minimal: its Hankel singular values fall from {values[0]:.3g} to {values[-1]:.3g}. "
            "Identify it with fewer states.")
    return (left / np.sqrt(values)).T @ see.T


def _root(gramian: Array) -> Array:
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
