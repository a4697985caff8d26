"""Test of the Hammerstein structure of a record: no products of samples at different lags, one f at all lags.

A Hammerstein system with additive output noise of any colour obeys

    y(k) = c + sum_c sum_i h_c(i) f_c(u_c(k - i)) + v(k).

Two consequences are tested without an order or a noise model: (1) alternatives (`structure_alternatives`) reduce no
residuals: products of samples at different lags, as in a Wiener system, functions of an output, fed back or not,
functions behind some of the poles, a gain that changes; (2) the matrix of coefficients, lags times functions, has rank
one. Finer functions and further lags complete the model; a negligible share of the variance is allowed in every test.

Lags are compressed by a few filters (`structure_design`). An autoregression fitted to the residuals whitens the noise;
filtering in time changes neither (1) nor (2), so that F tests on the filtered columns hold for noise of any colour. The
residuals of the best Hammerstein model are regressed instead of y, which keeps the digits where there is little noise.
Sources: Lagrange-multiplier tests of nonlinear regressions (Engle 1984); higher-order correlations as structure tests
(Billings and Voon 1986); rank one (Bai 1998).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.validation.correlations import lagged_products
from optid.identify.validation.gram_tests import FTest, rank_one, rank_one_test, regressed, tested
from optid.identify.validation.structure_alternatives import alternatives, wider
from optid.identify.validation.structure_design import Design, Family, convolved
from optid.statistics.factors import conditioning
from optid.structures.bilinear import minimise
from optid.structures.rank_one import matrices

WHITE = np.ones(1)
SIGNIFICANT = 5e-3
NEGLIGIBLE = 0.003  # share of the residual variance within which functions and filters follow any Hammerstein system
PRODUCTS = "products of inputs at different lags, as in a Wiener system"
RANK = "different nonlinearities at different lags"
FUNCTIONS = "functions of the inputs explain a part of the residuals"
# largest order of the autoregression, and the share of the rows that it must leave where samples are missing
NOISE_ORDER, KEPT = 12, 0.4
# regressions on fine functions, one on the filters between them; share of the variance they must leave to be used
TURNS, SHARPER = 3, 0.99
SAMPLES = 30_000  # samples read, from the beginning of every experiment


@dataclass(frozen=True)
class Structure:
    """The structure test of a record.

    Attributes:
        ratios: second over first singular value of lags times functions by input, the largest over the outputs.
        p_value: of the hypothesis that the record has Hammerstein structure, up to a negligible share of the variance,
            all tests together (Bonferroni); 1 when nothing is to be tested.
        saving: share of the residual variance by which the most significant alternative reduces it.
        alternative: its name.
        p_values: of every alternative by output.
    """

    ratios: dict[str, float]
    p_value: float
    saving: float
    alternative: str
    p_values: dict[str, dict[str, float]]

    @property
    def passed(self) -> bool:
        """Whether the hypothesis is kept."""
        return self.p_value >= SIGNIFICANT

    @property
    def finding(self) -> str:
        """The outcome in words."""
        kind = "a Hammerstein system" if any(RANK in each for each in self.p_values.values()) else "the model"
        return f"consistent with {kind}" if self.passed else f"not consistent with {kind}: {self.alternative}"


def structure_test(data: Data, simulated: Sequence[Array] | None = None) -> Structure:
    """Test whether a record comes from static nonlinearities of the inputs followed by linear dynamics.

    The inputs must not depend on the noise: in closed loop the test is not valid. Of a long record, the first 30,000
    samples are read, spread over the experiments in proportion.

    Args:
        data: the record; NaN = missing.
        simulated: outputs of another model, (N, l) by experiment: the test is then whether functions of the inputs, of
            these outputs, or of time explain its residuals.

    Raises:
        RankError: the record does not determine the free model: it is short, or its inputs have few levels or
            frequencies.
    """
    if data.n_samples > 1.1 * SAMPLES:
        data = data.split(SAMPLES / data.n_samples)[0]
    design = Design.of(data)
    if simulated is None:
        found = {name: _test_output(design, o) for o, name in enumerate(data.outputs)}
    else:
        runs = [simulated[i][: e.n_samples] for i, e in zip(design.kept, design.data.experiments)]
        found = {name: _test_residuals(design, o, runs) for o, name in enumerate(data.outputs)}
    tests = [(test, words) for each, _ in found.values() for words, test in each.items()]
    best, words = min(tests, key=lambda pair: (pair[0].p_value, -pair[0].saving))
    ratios = np.max([each for _, each in found.values()], axis=0)
    return Structure(dict(zip(data.inputs, ratios.tolist())), min(1.0, len(tests) * best.p_value), best.saving, words,
                     {name: {words: test.p_value for words, test in each.items()}
                      for name, (each, _) in found.items()})


@dataclass(frozen=True)
class _Hypothesis:
    """A Hammerstein model of an output."""

    bs: list[Array]  # (J,) by input, coefficients of the filters
    functions: list[tuple[Family, Array]]  # by input, (family, coefficients) of f
    theta: Array  # coefficients of the columns

    def columns(self, design: Design, u: Array) -> Array:
        """Return [1 | additive | fine through the filters `bs`]."""
        return np.hstack([design.additive(u), design.finer(u, [design.filters @ b for b in self.bs])])


def _test_output(design: Design, o: int) -> tuple[dict[str, FTest], list[float]]:
    """Return the tests on one output by words, and the second over first singular value by input."""
    additive, _, rows = _gram(design, o, lambda i, part, u, y: [design.additive(u), y[:, None]])
    _refuse_few(rows, len(additive))
    problem = rank_one(additive, design.blocks, 1)
    free = matrices(np.linalg.solve(problem.root, problem.target)[1:], design.blocks)
    # the residuals of the hypothesis: the free model would explain part of a slow noise and hide its colour
    found = minimise(problem, count=3).point
    theta = np.asarray(found.lift(), dtype=float)
    hypothesis = _Hypothesis([np.asarray(b, dtype=float) for b in found.bs],
                             [(f, np.asarray(mu, dtype=float)) for f, mu in zip(design.families, found.mus)],
                             np.concatenate([theta, np.zeros(sum(f.size for f in design.fine))]))
    leading = [np.asarray(np.linalg.svd(theta)[2][:2], dtype=float) for theta in free]
    responses = _responses(design, leading, additive)
    residuals, predicted, mean, spread, size = _residuals(design, o, hypothesis, responses)
    # in units of eps: one for every term of the sum, and the condition number for theta, found from a Gram matrix
    rounding = np.finfo(float).eps * (theta.size + conditioning(problem.root)) * size
    if np.nanstd(np.concatenate(residuals)) <= rounding:
        return {RANK: FTest()}, [0.0] * design.data.m
    finer = _sharpened(design, o, hypothesis)
    again = _residuals(design, o, finer, responses)
    if np.nanvar(np.concatenate(again[0])) < SHARPER * np.nanvar(np.concatenate(residuals)):
        hypothesis, (residuals, predicted, *_) = finer, again
    groups, missed = alternatives(design, predicted), wider(design, hypothesis.functions)

    def columns(i: int, part: slice, u: Array, output: Array) -> list[Array]:
        carriers = 2 * np.tanh((design.filtered(u, responses) - mean) / spread / 2)
        own = hypothesis.columns(design, u)
        return [np.hstack([own, missed[i][part]]), _products(carriers),
                *(group[i][part] for group in groups.values()), (output - own @ hypothesis.theta)[:, None]]

    gram, edges, rows = _gram(design, o, columns, _autoregression(residuals))
    # what was cut off the responses acts on all of the output, however small the residuals are
    cut = design.cut * float(np.var(np.concatenate(predicted))) / float(np.nanvar(np.concatenate(residuals)))
    tests = tested(gram, edges, rows, (PRODUCTS, *groups), NEGLIGIBLE + cut)
    if PRODUCTS not in tests:
        _refuse_few(rows, edges[2])
    keep = np.r_[: edges[1], edges[-1] - 1]
    tests[RANK], ratios = rank_one_test(gram[np.ix_(keep, keep)], hypothesis.theta, hypothesis.bs, design.blocks, rows,
                                        NEGLIGIBLE + cut)
    return tests, ratios


def _refuse_few(rows: int, columns: int) -> None:
    if rows < 2 * columns:
        raise RankError(f"{rows} complete rows for {columns} columns of the structure test: use a longer record.")


def _test_residuals(design: Design, o: int, simulated: Sequence[Array]) -> tuple[dict[str, FTest], list[float]]:
    """Return the tests on the residuals of a given model, for one output."""
    reach = len(design.filters) - 1
    predicted = [y[reach:, o] for y in simulated]
    groups = alternatives(design, predicted)
    residuals = [e.y[reach:, o] - p for e, p in zip(design.data.experiments, predicted)]

    def columns(i: int, part: slice, u: Array, output: Array) -> list[Array]:
        one, rest = np.split(design.additive(u), [1], axis=1)
        return [one, rest, *(group[i][part] for group in groups.values()), (output - predicted[i][part])[:, None]]

    gram, edges, rows = _gram(design, o, columns, _autoregression(residuals))
    return tested(gram, edges, rows, (FUNCTIONS, *groups), NEGLIGIBLE), [0.0] * design.data.m


def _gram(design: Design, o: int, columns: Callable[[int, slice, Array, Array], list[Array]], noise: Array = WHITE
          ) -> tuple[Array, list[int], int]:
    """Return the Gram matrix of blocks of columns, filtered by the noise model; where they begin, and its rows."""
    past = noise.size - 1
    gram, sizes, rows = np.zeros((1, 1)), [0], 0
    for i, part, u, output, valid in design.stretches(o, past):
        blocks = columns(i, part, u, output)
        sizes, side_by_side = [block.shape[1] for block in blocks], np.hstack(blocks)
        complete = np.convolve(~valid, np.ones(past + 1))[past : valid.size] < 0.5
        white = np.sum([a * side_by_side[past - k : len(side_by_side) - k] for k, a in enumerate(noise)],
                       axis=0)[complete]
        gram = gram + white.T @ white
        rows += len(white)
    return gram, np.cumsum([0, *sizes]).tolist(), rows


def _sharpened(design: Design, o: int, hypothesis: _Hypothesis) -> _Hypothesis:
    """Fit the fine functions and the filters in turn, beginning with the filters of a hypothesis."""
    def fitted(columns: Callable[[Array], Array]) -> Array:
        return regressed(_gram(design, o, lambda i, part, u, y: [np.ones((len(y), 1)), columns(u), y[:, None]])[0])

    def filtered(u: Array) -> Array:
        return np.hstack([convolved(f.values(u[:, c]) @ part[:, None], design.filters)[:, :, 0]
                          for c, (f, part) in enumerate(zip(design.fine, parts))])

    bs, theta, parts = hypothesis.bs, np.zeros(1), []
    for turn in range(TURNS):
        if turn:
            found = fitted(filtered)[1:].reshape(design.data.m, -1)
            bs = [b / max(float(np.linalg.norm(b)), 1e-300) for b in found]
        lines: list[Array] = [design.filters @ b for b in bs]
        theta = fitted(lambda u, lines=lines: design.finer(u, lines))
        parts = np.split(theta[1:], np.cumsum([f.size for f in design.fine])[:-1])
    coarse = np.zeros(sum(p * j for p, j in design.blocks))
    return _Hypothesis(bs, list(zip(design.fine, parts)), np.concatenate([theta[:1], coarse, theta[1:]]))


def _responses(design: Design, leading: list[Array], additive: Array) -> Array:
    """Impulse responses (L, q, m) of the signals whose products are tested.

    The best linear approximation; per input the two leading filters of lags times functions, which include even
    functions, and the input itself at its strongest lag and at the next; of several inputs one of each.
    """
    m, size, starts = design.data.m, len(design.filters), 1 + np.cumsum([0, *(p * j for p, j in design.blocks)])
    chosen = [0, *(start + p * k for start, (p, j) in zip(starts, design.blocks) for k in range(j)), -1]
    responses = [design.filters @ regressed(additive[np.ix_(chosen, chosen)])[1:].reshape(m, -1).T]
    for c, coefficients in enumerate(leading):
        lines = design.filters @ coefficients.T
        strongest = int(np.argmax(np.abs(lines[:, 0])))
        pulses = np.eye(size)[:, strongest : strongest + 2]
        each = 2 if m == 1 else 1
        for line in np.hstack([lines[:, :each], pulses[:, :each]]).T:
            responses.append(np.outer(line, np.arange(m) == c))
    return np.stack(responses, axis=1)


def _residuals(design: Design, o: int, hypothesis: _Hypothesis, responses: Array
               ) -> tuple[list[Array], list[Array], Array, Array, float]:
    """Residuals of the hypothesis, NaN where a row is incomplete; its outputs; mean and spread of the filtered inputs.

    The last value is the sum of the moduli of the terms of a row, root mean square over the rows.
    """
    residuals: list[Array] = [np.zeros(0)] * len(design.u)
    predicted = list(residuals)
    sums, count, moduli = np.zeros((2, responses.shape[1])), 0, 0.0
    for i, _, u, output, valid in design.stretches(o):
        columns = hypothesis.columns(design, u)
        y = columns @ hypothesis.theta
        predicted[i] = np.append(predicted[i], y)
        residuals[i] = np.append(residuals[i], np.where(valid, output - y, np.nan))
        moduli += float(np.sum((np.abs(columns) @ np.abs(hypothesis.theta)) ** 2))
        carriers = design.filtered(u, responses)
        sums += np.stack([carriers.sum(axis=0), (carriers**2).sum(axis=0)])
        count += len(carriers)
    mean = sums[0] / count
    spread = np.sqrt(np.maximum(sums[1] / count - mean**2, 1e-300))
    return residuals, predicted, mean, spread, float(np.sqrt(moduli / count))


def _products(carriers: Array) -> Array:
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
