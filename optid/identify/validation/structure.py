"""Does a record look Hammerstein? Then samples at different lags never multiply, and every lag sees the same f.

A Hammerstein system with additive output noise of any colour obeys

    y(k) = c + sum_c sum_i h_c(i) f_c(u_c(k - i)) + v(k).

Two consequences are tested, and neither needs an order or a noise model: (1) functions of single input samples explain
all of y that the input explains, so that products of samples at different lags and functions of a filtered input, the
mark of a Wiener system, save nothing; (2) the matrix of coefficients, lags times functions, has rank one.

Lags are compressed by a few filters (`structure_design`). An autoregression fitted to the residuals makes the noise
white, and since filtering in time leaves (1) and (2) as they are, F tests on the filtered columns hold for noise of
any colour. What is regressed on them are the residuals of the best Hammerstein model rather than y: the statistics are
the same, and keep their digits where hardly any noise is left. All columns exist chunk by chunk only.
Sources: Lagrange-multiplier tests of nonlinear regressions (Engle 1984); higher-order correlations as structure tests
(Billings and Voon 1986); rank one (Bai 1998).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.validation.correlations import lagged_products
from optid.identify.validation.structure_design import EXPLAINED, Design
from optid.statistics.factors import conditioning, dependent_column, root_of_gram
from optid.structures.bilinear import minimise
from optid.structures.rank_one import RankOne, matrices

SIGNIFICANT = 1e-3
NOTICEABLE = 0.015
"""Share of the residual variance that another structure must save before a record is said not to look Hammerstein."""

NOISE_ORDER, KEPT = 12, 0.4
"""Largest order of the autoregression, and the share of the rows that it must leave where samples are missing."""

DISTINCT = 1e-4  # smallest eigenvalue of the correlations of alternatives that counts as a direction of its own
SAMPLES = 30_000
"""The test reads the beginning of every experiment, so many samples in all: what they do not show is not noticeable."""


@dataclass(frozen=True)
class Structure:
    """The structure test of a record.

    Attributes:
        ratios: second over first singular value of lags times functions by input, the largest over the outputs.
        p_value: of the hypothesis that the record is Hammerstein, all tests together (Bonferroni); 1 when nothing is
            to be tested.
        saving: share of the residual variance that the more telling alternative saves.
        products: by output, p value of the test that samples at different lags do not multiply.
        rank: by output, p value of the test that all lags see the same nonlinearity.
    """

    ratios: dict[str, float]
    p_value: float
    saving: float
    products: dict[str, float]
    rank: dict[str, float]

    @property
    def passed(self) -> bool:
        """Whether the record looks Hammerstein; a difference must be significant and noticeable to count."""
        return not (self.p_value < SIGNIFICANT and self.saving > NOTICEABLE)

    @property
    def finding(self) -> str:
        """What the tests say, in words."""
        if self.passed:
            return "looks Hammerstein"
        if min(self.products.values()) <= min(self.rank.values()):
            return "does not look Hammerstein: inputs at different lags act together, as in a Wiener system"
        return "does not look Hammerstein: different lags see different nonlinearities"


def f_test(more: float, extra: int, rest: float, spare: int) -> tuple[float, float]:
    """Compare what `extra` parameters save, `more`, with the rest at `spare` degrees of freedom.

    Returns:
        p value of the hypothesis that they are zero, 1 when nothing is to be tested, and the share of the residual
        variance that they save, degrees of freedom discounted.
    """
    if extra <= 0 or rest <= 0:
        return 1.0, 0.0
    free, restricted = rest / spare, (rest + max(more, 0.0)) / (spare + extra)
    return float(fdtrc(extra, spare, max(more, 0.0) / extra / free)), float(1 - free / restricted)


def structure_test(data: Data) -> Structure:
    """Test whether a record comes from static nonlinearities of the inputs followed by linear dynamics.

    The inputs must not depend on the noise: in closed loop the test says nothing. Of a long record, the first 30,000
    samples are read, spread over the experiments in proportion.

    Args:
        data: the record; NaN = missing, several experiments as they are.

    Raises:
        RankError: the record does not determine the free model, because it is short or its inputs have few levels or
            frequencies.
    """
    if data.n_samples > 1.1 * SAMPLES:
        data = data.split(SAMPLES / data.n_samples)[0]
    design = Design.of(data)
    found = {name: _test_output(design, o) for o, name in enumerate(data.outputs)}
    tests = [test for products, rank, _ in found.values() for test in (products, rank)]
    # what is significant but too small to notice must not hide what is both
    p_value, saving = min(tests, key=lambda test: (test[0] if test[1] > NOTICEABLE else 1.0, test[0]))
    ratios = np.max([each for _, _, each in found.values()], axis=0)
    return Structure(dict(zip(data.inputs, ratios.tolist())), min(1.0, len(tests) * p_value), saving,
                     {name: products[0] for name, (products, _, _) in found.items()},
                     {name: rank[0] for name, (_, rank, _) in found.items()})


def _test_output(design: Design, o: int) -> tuple[tuple[float, float], tuple[float, float], list[float]]:
    """Return the F tests of products and rank on one output, and the second over first singular value by input."""
    additive = _additive_gram(design, o)
    problem = _rank_one(additive, design.blocks, 1)
    free = matrices(np.linalg.solve(problem.root, problem.target)[1:], design.blocks)
    # the residuals of the hypothesis: the free model would explain part of a slow noise and hide its colour
    hypothesis = minimise(problem, count=3).point
    leading = [np.asarray(np.linalg.svd(theta)[2][:2], dtype=float) for theta in free]
    responses = _responses(design, leading, _linear_coefficients(additive, design.blocks))
    bs = [np.asarray(b, dtype=float) for b in hypothesis.bs]
    lines = [design.filters @ b for b in bs]
    theta = np.asarray(hypothesis.lift(), dtype=float)
    residuals, mean, spread, size = _residuals(design, o, theta, responses)
    # in units of eps: one for every term of the sum, and the condition number for theta, found from a Gram matrix
    rounding = np.finfo(float).eps * (theta.size + conditioning(problem.root)) * size
    if np.nanstd(np.concatenate(residuals)) <= rounding:
        return (1.0, 0.0), (1.0, 0.0), [0.0] * design.data.m
    noise = _autoregression(residuals)
    past = noise.size - 1
    gram, sizes, rows = np.zeros((1, 1)), [0], 0
    for _, u, output, valid in design.stretches(o, past):
        carriers = 2 * np.tanh((design.filtered(u, responses) - mean) / spread / 2)
        additive = design.additive(u)
        blocks = [additive, design.finer(u, lines), _alternatives(carriers), (output - additive @ theta)[:, None]]
        sizes, columns = [block.shape[1] for block in blocks], np.hstack(blocks)
        complete = np.convolve(~valid, np.ones(past + 1))[past : valid.size] < 0.5
        white = np.sum([a * columns[past - i : len(columns) - i] for i, a in enumerate(noise)], axis=0)[complete]
        gram = gram + white.T @ white
        rows += len(white)
    edges = np.cumsum([0, *sizes])
    if rows < 1.5 * edges[-1]:
        raise RankError(f"{rows} complete rows for {edges[-1]} columns of the structure test: use a longer record.")
    keep = np.r_[: edges[2], edges[-1] - 1]
    return (_products_test(gram, int(edges[2]), rows),
            *_rank_test(gram[np.ix_(keep, keep)], theta, bs, design.blocks, rows))


def _additive_gram(design: Design, o: int) -> Array:
    """Gram matrix [1 | filters of functions by input | y] of the additive regression."""
    size = 2 + sum(p * j for p, j in design.blocks)
    gram, rows = np.zeros((size, size)), 0
    for _, u, output, valid in design.stretches(o):
        used = np.column_stack([design.additive(u), output])[valid]
        gram += used.T @ used
        rows += len(used)
    if rows < 2 * size:
        raise RankError(f"{rows} complete rows for {size} columns of the structure test: use a longer record.")
    return gram


def _linear_coefficients(gram: Array, blocks: tuple[tuple[int, int], ...]) -> Array:
    """Coefficients of the filters of every input itself, its first function, in a regression on these alone."""
    starts = 1 + np.cumsum([0, *(p * j for p, j in blocks)])
    chosen = np.concatenate([[0], *(start + p * np.arange(j) for start, (p, j) in zip(starts, blocks))])
    scale = np.sqrt(np.maximum(np.diag(gram)[chosen], 1e-300))
    inner, outer = gram[np.ix_(chosen, chosen)] / np.outer(scale, scale), gram[chosen, -1] / scale
    return (np.linalg.lstsq(inner, outer, rcond=1e-12)[0] / scale)[1:]


def _responses(design: Design, leading: list[Array], linear: Array) -> Array:
    """Impulse responses (L, q, m) along which alternatives are looked for.

    The best linear approximation; per input the two leading filters of lags times functions, which also see what is
    even, and the input itself at its strongest lag and at the next. Of several inputs one of each, since pairs of
    inputs make products enough.
    """
    m, size = design.data.m, len(design.filters)
    responses = [design.filters @ linear.reshape(m, -1).T]
    for c, coefficients in enumerate(leading):
        lines = design.filters @ coefficients.T
        strongest = int(np.argmax(np.abs(lines[:, 0])))
        pulses = np.eye(size)[:, strongest : strongest + 2]
        each = 2 if m == 1 else 1
        for line in np.hstack([lines[:, :each], pulses[:, :each]]).T:
            responses.append(np.outer(line, np.arange(m) == c))
    return np.stack(responses, axis=1)


def _residuals(design: Design, o: int, theta: Array, responses: Array) -> tuple[list[Array], Array, Array, float]:
    """Residuals of the additive regression, NaN where a row is incomplete; mean and spread of the filtered inputs.

    The last figure is the sum of the moduli of the terms of a row, root mean square over the rows.
    """
    residuals: list[Array] = [np.zeros(0)] * len(design.u)
    sums, count, moduli = np.zeros((2, responses.shape[1])), 0, 0.0
    for i, u, output, valid in design.stretches(o):
        columns = design.additive(u)
        residuals[i] = np.append(residuals[i], np.where(valid, output - columns @ theta, np.nan))
        moduli += float(np.sum((np.abs(columns) @ np.abs(theta)) ** 2))
        carriers = design.filtered(u, responses)
        sums += np.stack([carriers.sum(axis=0), (carriers**2).sum(axis=0)])
        count += len(carriers)
    mean = sums[0] / count
    return residuals, mean, np.sqrt(np.maximum(sums[1] / count - mean**2, 1e-300)), float(np.sqrt(moduli / count))


def _alternatives(carriers: Array) -> Array:
    """Products of two of all and of three of the first three carriers, and further functions of the first two."""
    first, second = np.triu_indices(carriers.shape[1])
    cubes = [a * b * c for a, b, c in combinations_with_replacement(carriers.T[:3], 3)]
    x = carriers[:, 0]
    return np.column_stack([carriers[:, first] * carriers[:, second], *cubes, x**4, x**5, np.abs(carriers[:, :2])])


def _autoregression(residuals: list[Array]) -> Array:
    """Fit an autoregression [1, a1, ...] with its order by Akaike's criterion; NaN = missing."""
    from scipy.linalg import solve_toeplitz

    total = sum(int(np.sum(~np.isnan(r))) for r in residuals)
    complete = total / sum(len(r) for r in residuals)
    most = min(NOISE_ORDER, total // 50, max(len(r) for r in residuals) - 1)
    while most > 1 and complete ** (most + 1) < KEPT:  # a row is lost with any of its samples
        most -= 1
    covariance = np.nan_to_num(lagged_products(residuals, residuals, range(most + 1))[0])
    covariance *= 1 - np.arange(most + 1) / total
    best, least = np.ones(1), total * np.log(covariance[0])
    for order in range(1, most + 1):
        a = np.concatenate([[1.0], -solve_toeplitz(covariance[:order], covariance[1 : order + 1])])
        variance = float(a @ covariance[: order + 1])
        if variance <= 0:
            break
        if (criterion := total * np.log(variance) + 2 * order) < least:
            best, least = a, criterion
    return best


def _distinct(gram: Array, least: float) -> Array:
    """Combinations (n, k) of columns in which their Gram matrix is the identity; small eigenvalues are left out."""
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    return vectors[:, values > least] / np.sqrt(values[values > least])


def _products_test(gram: Array, n: int, rows: int) -> tuple[float, float]:
    """Test whether columns n ... of the Gram matrix [additive | alternatives | residual] save anything."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = gram / np.outer(scale, scale)
    sound = _distinct(scaled[:n, :n], 1e-10)
    half = sound.T @ scaled[:n, n:]
    left = scaled[n:, n:] - half.T @ half
    size = np.sqrt(np.maximum(np.diag(left)[:-1], 1e-300))
    new = np.flatnonzero(size > 1e-3)  # what is left of an alternative of norm one
    distinct = _distinct((left[:-1, :-1] / np.outer(size, size))[np.ix_(new, new)], DISTINCT)
    more = float(np.sum((distinct.T @ (left[:-1, -1] / size)[new]) ** 2))
    extra = distinct.shape[1]
    rest = max(float(left[-1, -1]) - more, EXPLAINED)
    return f_test(more, extra, rest, rows - sound.shape[1] - extra)


def _rank_one(gram: Array, blocks: tuple[tuple[int, int], ...], linear: int) -> RankOne:
    """Write least squares with the Gram matrix [linear | blocks | y] as a rank-one problem."""
    n = len(gram) - 1
    root = root_of_gram(gram, n)
    if dependent_column(root, n, "gram") is not None:
        raise RankError(
            "Filters of functions of the inputs depend on each other: the inputs have too few levels or frequencies.")
    return RankOne(root[:n, :n], root[:n, n], float(root[n, n] ** 2), blocks, linear)


def _rank_test(gram: Array, theta: Array, leading: Sequence[Array], blocks: tuple[tuple[int, int], ...], rows: int
               ) -> tuple[tuple[float, float], list[float]]:
    """Test rank one of every block of [1 | blocks | fine | residual]; also second over first singular values.

    The fine functions through the leading filter stay free: what the functions of the blocks miss of f must not pass
    for a second nonlinearity.
    """
    size = 1 + sum(p * j for p, j in blocks)
    finer = _finer_directions(gram, leading, blocks)
    linear = 1 + finer.shape[1]
    unit = np.eye(len(gram))
    change = np.hstack([unit[:, :1], finer, unit[:, 1:size], unit[:, -1:]])
    problem = _rank_one(change.T @ gram @ change, blocks, linear)
    output = problem.target + problem.root @ np.concatenate([theta[:1], np.zeros(linear - 1), theta[1:]])
    problem = replace(problem, target=output, scale=float("nan"))
    free = matrices(np.linalg.solve(problem.root, problem.target)[linear:], blocks)
    singular = [np.linalg.svd(theta, compute_uv=False) for theta in free]
    ratios = [float(v[1] / v[0]) if v.size > 1 and v[0] > 0 else 0.0 for v in singular]
    extra, rest = sum((p - 1) * (j - 1) for p, j in blocks), max(problem.remainder, EXPLAINED * gram[-1, -1])
    more = minimise(problem, count=3).value - rest if extra else 0.0
    return f_test(more, extra, rest, rows - len(problem.target)), ratios


def _finer_directions(gram: Array, leading: Sequence[Array], blocks: tuple[tuple[int, int], ...]) -> Array:
    """Combinations (columns of `gram`) of the fine functions that the blocks' functions, so filtered, do not give."""
    filtered = np.asarray(block_diag(1.0, *(np.kron(b[:, None], np.eye(p)) for (p, _), b in zip(blocks, leading))))
    size = len(filtered)
    coarse, fine = np.pad(filtered, ((0, len(gram) - size), (0, 0))), np.eye(len(gram))[:, size:-1]
    fine = fine / np.sqrt(np.maximum(np.einsum("ij,ij->j", fine, gram @ fine), 1e-300))
    inner = np.linalg.pinv(coarse.T @ gram @ coarse, rcond=1e-12, hermitian=True)
    fine = fine - coarse @ (inner @ (coarse.T @ gram @ fine))
    return fine @ _distinct(fine.T @ gram @ fine, DISTINCT)
