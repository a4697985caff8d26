"""Triangular factors of Gram matrices and of stacked rows, with the digits of badly scaled columns kept."""

import numpy as np

from optid.arrays import Array

# part of a column outside the span of those before it, relative to the column, that is rounding, not information
ROUNDING = {"qr": 1e-12, "gram": 1e-7}
# condition number of rows with scaled columns beyond which their Gram matrix, which squares it, is replaced by a QR
# decomposition: small singular values would be lost in its rounding, about 1e-16 times the square of it
CONDITION_LIMIT = 1e5


def _nonnegative_diagonal(root: Array) -> Array:
    return root * np.where(root.diagonal() < 0, -1.0, 1.0)[:, None]


def add_to_root(root: Array, rows: Array) -> Array:
    """Return the upper triangular R (n, n), diagonal >= 0, with R^T R = root^T root + rows^T rows, for rows (K, n)."""
    return _nonnegative_diagonal(np.asarray(np.linalg.qr(np.concatenate([root, rows]), mode="r")))


def root_of_gram(gram: Array, n: int) -> Array:
    """Return an upper triangular R, diagonal >= 0, with R^T R = gram (n + l, n + l), positive semidefinite.

    The first n columns are scaled to norm one before they are factorised (Cholesky). From the first column on that
    depends on those before it, rows of R are zero. What remains of the last columns may be singular, as for data
    without noise.
    """
    from scipy.linalg.lapack import dpotrf, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

    scale = np.sqrt(np.maximum(gram.diagonal(), 0.0))
    scale[scale == 0] = 1.0
    scaled = gram / np.outer(scale, scale)
    root = np.zeros_like(gram)
    inner, info = dpotrf(scaled[:n, :n], lower=0, clean=1)
    sound = n if info == 0 else int(info) - 1
    root[:sound, :sound] = inner[:sound, :sound]
    if 0 < sound < len(gram):
        root[:sound, sound:] = dtrtrs(inner[:sound, :sound], scaled[:sound, sound:], trans=1)[0]
    if n < len(gram):
        remainder = scaled[n:, n:] - root[:n, n:].T @ root[:n, n:]
        if len(remainder) == 1:  # the usual case, for which two decompositions take as long as all the rest
            root[n, n] = np.sqrt(np.maximum(remainder[0, 0], 0.0))
        else:
            values, vectors = np.linalg.eigh(remainder)
            root[n:, n:] = np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T, mode="r")
    return _nonnegative_diagonal(root) * scale


def any_root_of_gram(gram: Array) -> Array:
    """Return an upper triangular R, diagonal >= 0, with R^T R = gram, also where columns depend on others."""
    root = root_of_gram(gram, len(gram))
    return root if np.all(root.diagonal() > 0) else root_of_gram(gram, 0)


def root_of_rows(rows: Array) -> Array:
    """Return an upper triangular R, diagonal >= 0, with R^T R = rows^T rows, for rows (K, n).

    The Gram matrix is several times faster than a QR decomposition, which keeps the digits of dependent columns.
    """
    root = root_of_gram(rows.T @ rows, rows.shape[1])
    return root if conditioning(root) <= CONDITION_LIMIT else add_to_root(np.zeros_like(root), rows)


def dependent_column(root: Array, n: int, method: str) -> int | None:
    """Return the first of n columns that depends on those before it to the rounding of the method, or None."""
    norms = np.linalg.norm(root[:, :n], axis=0)
    dependent = root.diagonal()[:n] <= ROUNDING[method] * norms
    return int(np.argmax(dependent)) if dependent.any() else None


def conditioning(root: Array) -> float:
    """Estimate the condition number, 1-norm, of an upper triangular matrix with its columns scaled to norm one."""
    from scipy.linalg.lapack import dtrcon  # pyright: ignore[reportAttributeAccessIssue]

    norms = np.linalg.norm(root, axis=0)
    if not np.all(root.diagonal() > 0):
        return float("inf")
    reciprocal, _ = dtrcon(np.asfortranarray(root / norms))
    return 1 / reciprocal if reciprocal > 0 else float("inf")
