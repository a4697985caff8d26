"""Multipliers of linear constraints by non-negative least squares."""

import numpy as np
from scipy.optimize import nnls

from optid.arrays import Array


def fit_multipliers(rows: Array, target: Array, equality: np.ndarray) -> tuple[Array, float]:
    """Return the w (r,) that minimises ``‖rowsᵀ w - target‖``, rows (r, n), and the norm that is left.

    It may have either sign where ``equality``, and is >= 0 elsewhere.

    Raises:
        RuntimeError: the iterations did not suffice.
    """
    if not len(rows):  # which SciPy's solver does not accept
        return np.zeros(0), float(np.linalg.norm(target))
    both = np.vstack([rows, -rows[equality]])
    weights, rest = nnls(both.T, target, maxiter=30 * len(both))
    found = weights[: len(rows)].copy()
    found[equality] -= weights[len(rows) :]
    return found, float(rest)


def least_distance(rows: Array, need: Array, equality: np.ndarray) -> Array | None:
    """Return the w with which ``x = -rowsᵀ w`` is the shortest x with ``rows x + need <= 0``, None without such an x.

    Rows (r, n) are of about one length, needs (r,) of about the size one; where ``equality``, ``rows x + need = 0``.
    Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23.

    Raises:
        RuntimeError: the iterations did not suffice.
    """
    system, target = np.column_stack([-rows, need]), np.append(np.zeros(rows.shape[1]), 1.0)
    weights, _ = fit_multipliers(system, target, equality)
    rest = 1.0 - float(need @ weights)
    return weights / rest if rest > 1e-12 else None  # empty as far as the rounding tells
