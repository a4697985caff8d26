"""The rank-one factors of an over-parametrised estimate (Luo, Algorithm 3.1; Bai, Automatica 34, 1998)."""

import numpy as np

from optid.arrays import Array
from optid.models.layout import Layout
from optid.structures import whitening


def theta_matrices(theta: Array, layout: Layout) -> tuple[Array, ...]:
    """Return Theta_c (P_c, nb_c l) from the coefficients (n, l)."""
    found = []
    for c, (b, basis) in enumerate(zip(layout.nb, layout.bases)):
        block = theta[layout.block(c)].reshape(b, basis.size, layout.l)
        found.append(block.transpose(1, 2, 0).reshape(basis.size, layout.l * b))
    return tuple(found)


def block_grams(root: Array, layout: Layout) -> list[Array]:
    """Gram matrices (P_c nb_c square) of the inputs' columns, what A and the constant explain removed."""
    n, past = layout.n_columns, layout.na * layout.l
    order = np.concatenate([np.arange(past), [layout.offset], np.arange(past, layout.offset)])
    rest = np.asarray(np.linalg.qr(root[:n, order], mode="r"))[past + 1 :, past + 1 :]
    parts = [rest[:, layout.block(c).start - past : layout.block(c).stop - past] for c in range(layout.m)]
    return [part.T @ part for part in parts]


def leading_pair(matrix: Array, gram: Array | None, lags: int, outputs: int) -> tuple[Array, Array]:
    """Return (mu, b) with mu b^T nearest to Theta, in the Frobenius norm or in the Kronecker metric of its Gram matrix.

    Args:
        matrix: (P, nb l) Theta, lags inner, outputs outer.
        gram: (P nb, P nb) Gram matrix of the columns of Phi, or None for the Frobenius norm.
        lags: nb.
        outputs: l.
    """
    if gram is None:
        left, size, right = np.linalg.svd(matrix, full_matrices=False)
        return size[0] * left[:, 0], right[0]
    factor_mu, factor_b = whitening.kronecker_factors(gram, (len(matrix), lags))
    factor_b = np.kron(np.eye(outputs), factor_b)  # every output has the same regressor
    mu, b = whitening.leading_pair(matrix, factor_mu, factor_b)
    return np.asarray(mu, dtype=float), np.asarray(b, dtype=float)
