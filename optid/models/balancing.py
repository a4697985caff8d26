"""Balanced states of a linear system."""

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.roots import spectral_radius


def balancing(A: Array, B: Array, C: Array) -> Array:
    """Return the change of states T (n, n) that makes both Gramians of (A, B, C) diagonal and equal.

    Raises:
        StructureError: A is unstable, or the triple is not minimal.
    """
    largest = spectral_radius(A)
    if largest >= 1:
        raise StructureError(f"The model is unstable (largest pole {largest:.6g}): it has no Gramians.")
    reach = _factor(solve_discrete_lyapunov(A, B @ B.T))
    see = _factor(solve_discrete_lyapunov(A.T, C.T @ C))
    left, values, right = np.linalg.svd(see.T @ reach)
    if values[-1] <= 1e-13 * values[0]:
        raise StructureError(
            f"The model is not minimal: its Hankel singular values fall from {values[0]:.3g} to {values[-1]:.3g}. "
            "Identify it with fewer states."
        )
    return (left / np.sqrt(values)).T @ see.T


def _factor(gramian: Array) -> Array:
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
