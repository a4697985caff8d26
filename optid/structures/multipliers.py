"""Multipliers of linear constraints: by non-negative least squares, and the least of many by a linear programme."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.optimize import nnls

from optid.arrays import Array

DEPENDENT = 1e-7  # singular value, of rows of length one, below which they say the same
STATIONARY = 1e-5  # relative residual up to which multipliers make a point stationary


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


def exchange_multipliers(columns: Array, equality: np.ndarray, places: Sequence[tuple[str, slice, Array]],
                         target: Array, duals: Mapping[str, Array]) -> Callable[[str, Array], Array] | None:
    """Return, for an effect of the multipliers of a named constraint, those of all that have the least of it.

    None where the multipliers are unique, or do not make the point stationary.

    Args:
        columns: (k, n) what a unit multiplier of each adds to the gradient, scaled.
        equality: (k,) those that may have either sign.
        places: of each, the constraint, its place there, and the multipliers that one unit stands for.
        target: (n,) minus the gradient, scaled.
        duals: multipliers by constraint.
    """
    lengths = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
    if np.linalg.matrix_rank(columns / lengths[:, None], tol=DEPENDENT) == len(columns):
        return None
    known = np.array([float(duals[key][span] @ direction) if key in duals else 0.0 for key, span, direction in places])
    reached = columns.T @ known  # what they reach, they may be exchanged for
    if np.linalg.norm(reached - target) > STATIONARY * max(1.0, float(np.linalg.norm(columns.T * known))):
        return None

    def least(name: str, effect: Array) -> Array:
        from scipy.optimize import linprog

        cost = np.array([float(effect[span] @ direction) if key == name else 0.0 for key, span, direction in places])
        found = linprog(cost / lengths, A_eq=(columns / lengths[:, None]).T, b_eq=reached,
                        bounds=[(None, None) if free else (0, None) for free in equality])
        there = known if found.status else found.x / lengths
        chosen = np.zeros_like(duals[name])
        for weight, (key, span, direction) in zip(there, places):
            if key == name:
                chosen[span] += weight * direction
        return chosen

    return least
