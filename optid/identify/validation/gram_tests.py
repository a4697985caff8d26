"""F tests on Gram matrices: of further columns, and of rank one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc, ncfdtr

from optid.arrays import Array
from optid.errors import RankError
from optid.identify.validation.structure_design import EXPLAINED
from optid.statistics.factors import dependent_column, root_of_gram
from optid.structures.bilinear import minimise
from optid.structures.rank_one import RankOne, matrices

DISTINCT = 1e-4  # smallest eigenvalue of the correlations of alternatives that counts as a further direction


@dataclass(frozen=True)
class FTest:
    """One F test: its p value, and the share of the residual variance that an alternative saves."""

    p_value: float = 1.0
    saving: float = 0.0

    @classmethod
    def of(cls, more: float, extra: int, rest: float, spare: int, negligible: float) -> "FTest":
        """Compare the reduction `more` by `extra` parameters with the rest at `spare` degrees of freedom.

        Under the hypothesis the true reduction is at most a share `negligible` of the variance: the statistic follows a
        noncentral F distribution at that share. The saving discounts the degrees of freedom.
        """
        if extra <= 0 or rest <= 0:
            return cls()
        free, restricted = rest / spare, (rest + max(more, 0.0)) / (spare + extra)
        ratio = max(more, 0.0) / extra / free
        p = 1 - ncfdtr(extra, spare, negligible * (spare + extra), ratio) if negligible else fdtrc(extra, spare, ratio)
        return cls(float(max(p, 0.0)), float(1 - free / restricted))


def tested(gram: Array, edges: list[int], rows: int, words: Sequence[str], negligible: float) -> dict[str, FTest]:
    """Test every block but the first and the last, the residual, beside the first; those that the rows allow."""
    tests = {}
    for name, first, last in zip(words, edges[1:], edges[2:-1]):
        keep = np.r_[: edges[1], first:last, edges[-1] - 1]
        if rows >= 1.5 * keep.size:
            tests[name] = _added(gram[np.ix_(keep, keep)], edges[1], rows, negligible)
    return tests


def regressed(gram: Array) -> Array:
    """Return the coefficients of the last column on the others; nearly dependent directions are left out."""
    scaled, scale = _scaled(gram)
    return np.linalg.pinv(scaled[:-1, :-1], rcond=1e-10, hermitian=True) @ scaled[:-1, -1] * scale[-1] / scale[:-1]


def _scaled(gram: Array) -> tuple[Array, Array]:
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return gram / np.outer(scale, scale), scale


def _distinct(gram: Array, least: float) -> Array:
    """Combinations (n, k) of columns in which their Gram matrix is the identity; small eigenvalues are left out."""
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    return vectors[:, values > least] / np.sqrt(values[values > least])


def _added(gram: Array, n: int, rows: int, negligible: float) -> FTest:
    """Test whether columns n ... of the Gram matrix [additive | alternatives | residual] reduce the residuals."""
    scaled, _ = _scaled(gram)
    sound = _distinct(scaled[:n, :n], 1e-10)
    half = sound.T @ scaled[:n, n:]
    left = scaled[n:, n:] - half.T @ half
    size = np.sqrt(np.maximum(np.diag(left)[:-1], 1e-300))
    new = np.flatnonzero(size > 1e-3)  # what is left of an alternative of norm one
    distinct = _distinct((left[:-1, :-1] / np.outer(size, size))[np.ix_(new, new)], DISTINCT)
    more = float(np.sum((distinct.T @ (left[:-1, -1] / size)[new]) ** 2))
    extra = distinct.shape[1]
    rest = max(float(left[-1, -1]) - more, EXPLAINED)
    return FTest.of(more, extra, rest, rows - sound.shape[1] - extra, negligible)


def rank_one(gram: Array, blocks: tuple[tuple[int, int], ...], linear: int) -> RankOne:
    """Write least squares with the Gram matrix [linear | blocks | y] as a rank-one problem."""
    n = len(gram) - 1
    root = root_of_gram(gram, n)
    if dependent_column(root, n, "gram") is not None:
        raise RankError(
            "Filters of functions of the inputs depend on each other: the inputs have too few levels or frequencies.")
    return RankOne(root[:n, :n], root[:n, n], float(root[n, n] ** 2), blocks, linear)


def rank_one_test(gram: Array, theta: Array, bs: Sequence[Array], blocks: tuple[tuple[int, int], ...], rows: int,
                  negligible: float) -> tuple[FTest, list[float]]:
    """Test rank one of every block of [1 | blocks | fine | missed | residual]; also second over first singular values.

    The fine functions through the leading filter and the missed parts stay free: they are no second nonlinearity.
    """
    size, n = 1 + sum(p * j for p, j in blocks), theta.size
    leading = [np.kron(b[:, None], np.eye(p)) for (p, _), b in zip(blocks, bs)]
    filtered = np.asarray(block_diag(1.0, *leading))
    unit = np.eye(len(gram))
    finer = _beside(gram, np.pad(filtered, ((0, len(gram) - size), (0, 0))), unit[:, size:n])
    finer = np.hstack([finer, _beside(gram, unit[:, :n], unit[:, n:-1], whole=True)])
    linear = 1 + finer.shape[1]
    change = np.hstack([unit[:, :1], finer, unit[:, 1:size], unit[:, -1:]])
    problem = rank_one(change.T @ gram @ change, blocks, linear)
    coarse = np.concatenate([theta[:1], np.zeros(linear - 1), theta[1:size]])
    fine = np.concatenate([np.zeros(size), theta[size:], np.zeros(len(gram) - n)])
    output = problem.target + problem.root @ coarse
    if fine.any():
        output = output + np.linalg.solve(problem.root.T, change[:, :-1].T @ (gram @ fine))
    problem = replace(problem, target=output, scale=float("nan"))
    free = matrices(np.linalg.solve(problem.root, problem.target)[linear:], blocks)
    singular = [np.linalg.svd(one, compute_uv=False) for one in free]
    ratios = [float(v[1] / v[0]) if v.size > 1 and v[0] > 0 else 0.0 for v in singular]
    extra, rest = sum((p - 1) * (j - 1) for p, j in blocks), max(problem.remainder, EXPLAINED * gram[-1, -1])
    more = minimise(problem, count=3).value - rest if extra else 0.0
    return FTest.of(more, extra, rest, rows - len(problem.target), negligible), ratios


def _beside(gram: Array, coarse: Array, fine: Array, whole: bool = False) -> Array:
    """Combinations of fine columns that coarse ones do not contain: what they add, or as a whole."""
    fine = fine / np.sqrt(np.maximum(np.einsum("ij,ij->j", fine, gram @ fine), 1e-300))
    inner = np.linalg.pinv(coarse.T @ gram @ coarse, rcond=1e-12, hermitian=True)
    added = fine - coarse @ (inner @ (coarse.T @ gram @ fine))
    return (fine if whole else added) @ _distinct(added.T @ gram @ added, DISTINCT)
