"""Ascent of the dual bound: search for minors that make H + M positive definite while M keeps its value at the point.

Alternating projections with memory (Dykstra; equivalently ADMM) between the positive semidefinite matrices and the
affine set H + M_tangent + span(free minors), in coordinates where the point is the first unit vector of every block.
Entries of different minors never overlap there, so projection onto their span is one transposition.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from optid.certificate.minors import Block, basis_from, cholesky, project_minors
from optid.structures.rank_one import Array


def rotation(linear: int, mus: Sequence[Array], bs: Sequence[Array]) -> Any:
    """Orthogonal matrix whose columns turn every block so that mu_i and b_i become first unit vectors."""
    parts = [np.kron(basis_from(b), basis_from(mu / np.linalg.norm(mu)) if mu.any() else np.eye(len(mu)))
             for mu, b in zip(mus, bs)]
    return block_diag(np.eye(linear), *parts) if parts else np.eye(linear)


def ascend(matrix: Array, blocks: Sequence[Block], masks: Sequence[np.ndarray],
           steps: int) -> tuple[Array | None, int]:
    """Return free minors N with ``matrix + N > 0`` (or None) and the steps taken.

    Args:
        matrix: (k, k) H + M_tangent (- cuts) in rotated coordinates.
        blocks: position and shape of every block.
        masks: entries, as (P nb, P nb), of the minors that are free.
        steps: eigenvalue decompositions at most.
    """
    current, memory = matrix, np.zeros_like(matrix)
    aim = 0.1 * float(np.trace(matrix)) / len(matrix)  # inside the cone: its boundary is reached only in the limit
    for step in range(1, steps + 1):
        values, vectors = np.linalg.eigh(current + memory)
        positive = (vectors * np.maximum(values, aim)) @ vectors.T
        memory = memory + current - positive
        aim *= 0.95
        wanted = positive - memory - matrix
        current = matrix.copy()
        for (where, shape), mask in zip(blocks, masks):
            current[where, where] += project_minors(wanted[where, where], shape) * mask
        if cholesky(current) is not None:
            return current - matrix, step
    return None, steps
