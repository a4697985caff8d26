"""The regression of a Hammerstein-ARX model as least squares in rank-one blocks.

The unknowns are ``z = [vec a; offset; vec Theta_1; ...]``, ``Theta_c = mu_c vec(b_c)ᵀ``, of all outputs together.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from optid.arrays import Array
from optid.models.layout import Layout
from optid.statistics import Statistics
from optid.structures.rank_one import Core, RankOne
from optid.structures.whitening import invert_triangular, symmetric_root


def positions(layout: Layout) -> NDArray[np.intp]:
    """Return the position (n_columns, l) in z of the coefficient of every column of the regressor in every output."""
    ny, past = layout.l, layout.na * layout.l
    found = np.empty((layout.n_columns, ny), dtype=np.intp)
    found[:past] = np.arange(past * ny).reshape(past, ny)
    found[-1] = past * ny + np.arange(ny)
    for c in range(layout.m):
        block = layout.block(c)
        start, count = (block.start + 1) * ny, block.stop - block.start
        found[block] = start + np.arange(count * ny).reshape(ny, count).T
    return found


def lifted_problem(statistics: Statistics, columns: NDArray[np.intp], ridge: float = 0.0, curvature: float = 0.0,
                   scales: Sequence[float] = (), weights: Array | float = 1.0,
                   prior: Array | None = None) -> RankOne:
    """Order the triangular system of the statistics by z, by the `positions` of its columns, and penalise Theta.

    The penalties are ridge times ``‖Theta‖²``, and curvature times the integral of ``f''²``; Theta in the units of the
    record is Theta / scale, with one scale an input. The weights (l,) are those of the residuals of every output; the
    rows (k, n l) of a prior act on z.
    """
    layout, (n, ny), root = statistics.layout, columns.shape, statistics.root.copy()
    root[:, n:] *= weights
    blocks = tuple((basis.size, q * ny) for basis, q in zip(layout.bases, layout.nb))
    linear, total = (layout.na * ny + 1) * ny, columns.size
    system = np.zeros((total, total + 1))
    for o, (rows, weight) in enumerate(zip(np.split(system, ny), np.broadcast_to(weights, ny))):
        rows[:, columns[:, o]] = weight * root[:n, :n]
        rows[:, -1] = root[:n, n + o]
    remainder = float(np.sum(root[n:, n:] ** 2))
    if ridge or curvature:
        penalties = [ridge / scale**2 * np.eye(basis.size) + curvature * np.asarray(basis.penalty(2))
                     for basis, scale in zip(layout.bases, scales)]
        roots = [np.kron(np.eye(q), symmetric_root(penalty)) for penalty, (_, q) in zip(penalties, blocks)]
        system = np.vstack([system, np.pad(np.asarray(block_diag(*roots)), ((0, 0), (linear, 1)))])
    if prior is not None:
        system = np.vstack([system, np.pad(prior, ((0, 0), (0, 1)))])
    triangle = np.triu(np.linalg.qr(system, mode="r"))
    triangle = triangle * np.where(np.diag(triangle[:, : len(triangle)]) < 0, -1.0, 1.0)[:, None]  # one of many signs
    remainder += float(triangle[total, total] ** 2) if triangle.shape[0] > total else 0.0
    return RankOne(root=triangle[:total, :total], target=triangle[:total, total], remainder=remainder, linear=linear,
                   blocks=blocks, scale=float(np.sum(root[:, n:] ** 2)))


def leading_pairs(core: Core, thetas: Sequence[Array], whitened: bool = True) -> list[tuple[Array, Array]]:
    """Return the (mu, vec b) nearest to every Theta_c (P_c, nb_c l) (Luo, Algorithm 3.1; Bai, Automatica 34, 1998).

    Nearest is meant in the Kronecker metric of the core's Gram matrix, or in the Frobenius norm.
    """
    pairs = []
    for c, theta in enumerate(thetas):
        of_mu, of_b = np.eye(theta.shape[0]), np.eye(theta.shape[1])
        if whitened and c in core.kept:
            position = core.kept.index(c)
            of_mu, of_b = core.whitening.factors_mu[position], core.whitening.factors_b[position]
        left, sizes, right = np.linalg.svd(of_mu.T @ theta @ of_b, full_matrices=False)
        pairs.append((invert_triangular(of_mu).T @ (sizes[0] * left[:, 0]), invert_triangular(of_b).T @ right[0]))
    return pairs
