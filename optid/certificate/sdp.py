"""The semidefinite relaxation behind a certificate: all 2 x 2 minors, and all products of constraints.

    maximise D   subject to   [[F - D + terms, q^T], [q, S]] >= 0,
    S = H + sum lambda_s L_s - sum_{j<k} sym(W_jk kron c_j c_k^T),   q = S z - g + E^T lambda / 2,   W_jk >= 0

is the Lagrangian dual written around a point z; its own dual is the moment relaxation, whose moment matrix proposes
where a better point may be. It is stated in CVXPY and solved by Clarabel; both are imported on first use.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from optid.certificate.minors import Block, Quadratic
from optid.certificate.shape_duals import LinearRows
from optid.structures.rank_one import Array


def relaxation_size(blocks: Sequence[Block], cones: Mapping[int, Array]) -> int:
    """Number of multipliers: minors, and entries of the matrices W_jk."""
    minors = sum(p * (p - 1) // 2 * (nb * (nb - 1) // 2) for _, (p, nb) in blocks)
    lags = {i: blocks[i][1][1] for i in cones}
    return minors + sum(len(cone) * (len(cone) - 1) // 2 * (lags[i] * (lags[i] + 1) // 2) for i, cone in cones.items())


def minor_operator(block: Block, size: int) -> Any:
    """Sparse (size^2, minors): each column is the symmetric form of one 2 x 2 minor of the block."""
    from scipy.sparse import csc_array

    where, (p, nb) = block
    i, k = (rows[:, None] for rows in np.triu_indices(p, 1))
    j, m = np.triu_indices(nb, 1)
    a, b, c, d = (where.start + entry.ravel() for entry in (j * p + i, m * p + k, m * p + i, j * p + k))
    rows = np.concatenate([a * size + b, b * size + a, c * size + d, d * size + c])
    values = np.repeat([1.0, 1.0, -1.0, -1.0], len(a))
    return csc_array((values, (rows, np.tile(np.arange(len(a)), 4))), shape=(size**2, len(a)))


def cut_operator(block: Block, cone: Array, size: int) -> Any:
    """Sparse (size^2, pairs nb^2): maps the stacked matrices W_jk, j < k, to their form."""
    from scipy.sparse import csc_array

    where, (p, nb) = block
    first, second = np.triu_indices(len(cone), 1)
    products = np.einsum("sp,sq->spq", cone[first], cone[second])
    products = (products + products.transpose(0, 2, 1)) / 2
    pair, a, b, left, right = np.ogrid[:len(first), :nb, :nb, :p, :p]
    rows = (where.start + a * p + left) * size + where.start + b * p + right
    columns = (pair * nb + a) * nb + b
    shape = (len(first), nb, nb, p, p)
    parts = [np.broadcast_to(part, shape).ravel() for part in (products[:, None, None], rows, columns)]
    keep = parts[0] != 0
    values, rows, columns = (part[keep] for part in parts)
    return csc_array((values, (rows, columns)), shape=(size**2, len(first) * nb**2))


def relax(objective: Quadratic, blocks: Sequence[Block], cones: Mapping[int, Array],
          linear: LinearRows) -> tuple[Array, dict[int, Array], Array, Array] | None:
    """Solve the relaxation around a point, in whitened coordinates; None where the solver returns no multipliers.

    Returns:
        What the solver found, before any check: the combination (k, k) of minors; by block the weights (r, r, nb, nb),
        positive semidefinite for each pair of rows up to its accuracy; the multipliers (r,) of the linear constraints;
        and (k, 4) candidates for z, the mean and the leading directions of the moment matrix.
    """
    import cvxpy as cp
    from scipy.sparse import csc_array, hstack

    from optid.program.expressions import solve_quietly

    z = objective.z
    k = len(z)
    unit = float(np.linalg.norm(objective.slope)) or 1.0
    operator: Any = hstack([csc_array((k * k, 0)), *(minor_operator(block, k) for block in blocks)], format="csc")
    weights = cp.Variable(operator.shape[1])
    extra, cut_value, constraints = operator @ weights, 0.0, []
    pairs: dict[int, Any] = {}
    for i, cone in cones.items():
        form = cut_operator(blocks[i], cone, k)
        nb = blocks[i][1][1]
        pairs[i] = [cp.Variable((nb, nb), PSD=True) for _ in range(form.shape[1] // nb**2)]
        if pairs[i]:
            stacked = cp.hstack([cp.vec(w, order="C") for w in pairs[i]])
            extra = extra - form @ stacked
            cut_value = cut_value + (form.T @ np.kron(z, z)) @ stacked
    square = cp.reshape(extra, (k, k), order="C")
    slope = objective.slope / unit + square @ (z / unit)
    multipliers = None
    if len(linear.right):
        multipliers = cp.Variable(len(linear.right))
        slope = slope + linear.rows.T @ multipliers / (2 * unit)
        cut_value = cut_value + linear.slack(z)[0] @ multipliers
        if not linear.equality.all():
            constraints.append(multipliers[~linear.equality] >= 0)
    level = cp.Variable()
    column = cp.reshape(slope, (k, 1), order="C")
    corner = cp.reshape(-level - cut_value / unit**2, (1, 1), order="C")
    lifted = cp.bmat([[corner, column.T], [column, objective.gram + square]]) >> 0
    problem = cp.Problem(cp.Maximize(level), [lifted, *constraints])
    try:
        solve_quietly(problem)  # the result is checked and repaired
    except cp.SolverError:
        return None
    if weights.value is None or lifted.dual_value is None:
        return None
    minors = (operator @ np.asarray(weights.value)).reshape(k, k)
    cuts = {i: _pair_weights([np.asarray(w.value) for w in found], len(cones[i]), blocks[i][1][1])
            for i, found in pairs.items()}
    prices = np.zeros(0)
    if multipliers is not None:
        prices = np.asarray(multipliers.value, float)
        prices = np.where(linear.equality, prices, np.maximum(prices, 0.0))
    return minors, cuts, prices, _moments(np.asarray(lifted.dual_value), z, unit)


def _pair_weights(values: list[Array], rows: int, nb: int) -> Array:
    """Weights (r, r, nb, nb) from the matrices of the pairs j < k, with negative roundoff removed."""
    weights = np.zeros((rows, rows, nb, nb))
    for j, k, value in zip(*np.triu_indices(rows, 1), values):
        sizes, vectors = np.linalg.eigh((value + value.T) / 2)
        weights[j, k] = (vectors * np.maximum(sizes, 0.0)) @ vectors.T
    return weights


def _moments(dual: Array, z: Array, unit: float) -> Array:
    """Mean and leading directions of z under the moment matrix of (1, (z' - z) / unit)."""
    total = max(float(dual[0, 0]), np.finfo(float).tiny)
    shift, spread = dual[1:, 0] * unit / total, dual[1:, 1:] * unit**2 / total
    second = np.outer(z, z) + np.outer(z, shift) + np.outer(shift, z) + spread
    vectors = np.linalg.eigh(second)[1][:, ::-1][:, :3]
    return np.column_stack([z + shift, vectors])
