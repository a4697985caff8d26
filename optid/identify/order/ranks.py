"""Test of the number of significant singular values: largest ratio, and a threshold from their distribution.

With the instruments orthonormal and the regressors removed, R22 = Gamma X + noise / sqrt(j). If the order is n0, the
trailing singular vectors U2, V2 of R22 belong to noise alone:

    T(n0) = sum_{i > n0} s_i^2 = |(1/j) sum_t e_t z_t^T|_F^2 + higher terms,

e_t the outputs of window t along U2 that instruments and regressors do not explain, z_t the instruments along V2.
Windows overlap, so that both are correlated from window to window even where the noise is white; their covariances
at lag tau are read off the moments of longer windows. Then T is nearly g chi2_h with the same mean and variance
(Satterthwaite 1946, Box 1954). Neither a noise model nor a second pass over the record is needed.
Sources: perturbation of singular values, Stewart and Sun 1990; largest ratio, Wellstead 1978.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optid.arrays import Array, check_probability
from optid.errors import RankError, StructureError
from optid.phrases import p_equals
from optid.statistics.expansion import Expansion
from optid.statistics.hankel import HankelStatistics, RegressionRows, hankel_statistics
from optid.statistics.rq import rq

LEVEL = 0.01
SPAN = 10.0  # the level of the test is min(0.01, 10 / N): wrong decisions become rarer as the record grows
FLOOR = 10.0  # singular values below this many roundings of the outputs, times the size of R22, are zero


@dataclass(frozen=True, eq=False)
class RankTest:
    """Tests of the hypotheses n0 = 0, 1, ..., r - 1 about the singular values (r,) of R22 / sqrt(j).

    These are in units of the output, or without unit where the outputs are scaled.

    Attributes:
        statistics: (r,) T(n0), the sum of the squares of the singular values after the first n0.
        expected, thresholds, p_values: (r,) expectation of T(n0) if the order is n0; its quantile at the level; the
            probability of a larger one.
        floor: singular values up to here are rounding.
        level: probability of rejecting a true order.
        windows: number j of windows.
        largest: largest order that the shift of the block rows can show.
    """

    singular_values: Array
    statistics: Array
    expected: Array
    thresholds: Array
    p_values: Array
    floor: float
    level: float
    windows: int
    largest: int

    @property
    def order(self) -> int:
        """The smallest order that is not rejected; the largest possible one where all are."""
        accepted = np.flatnonzero((self.statistics <= self.thresholds) | (self.singular_values <= self.floor))
        return min(int(accepted[0]) if accepted.size else self.singular_values.size, self.largest)

    @property
    def choice(self) -> tuple[int, str]:
        """The order for nx="auto", at least 1, and the reason."""
        if self.order == 0:
            return 1, "1: no singular value is significant; the outputs may not depend on the inputs"
        return self.order, self.reason

    @property
    def exact(self) -> bool:
        """Whether the singular values after the order are rounding: a record without noise."""
        return self.order < self.singular_values.size and bool(self.singular_values[self.order] <= self.floor)

    @property
    def exhausted(self) -> bool:
        """Whether every order that the block rows can show was rejected."""
        n = self.largest
        return self.order == n and not (n < self.singular_values.size and self.statistics[n] <= self.thresholds[n])

    @property
    def ratios(self) -> Array:
        """s_i / s_{i+1} for i = 1 ... r - 1, singular values below the floor raised to it."""
        return ratios_of(self.singular_values, self.floor)

    @property
    def ratio_order(self) -> int:
        """The i with the largest s_i / s_{i+1}, at most half of the singular values; 0 when all are rounding."""
        size = self.singular_values.size
        rounding = self.singular_values[0] <= self.floor or size < 2
        return 0 if rounding else largest_gap(self.singular_values, min(size - 2, size // 2), self.floor)

    @property
    def reason(self) -> str:
        """The reason of the decision."""
        n = self.order
        if self.exact:
            return f"{n}: singular value {n + 1} is rounding ({self.singular_values[n]:.1e})"
        if self.exhausted:
            return f"{n}: every smaller order is rejected and the block rows show no larger one; use more block rows"
        before = f", order {n - 1} is rejected ({p_equals(self.p_values[n - 1], 1)})" if n else ""
        return f"{n}: the following singular values are noise ({p_equals(self.p_values[n])}){before}"


def ratios_of(values: Array, floor: float) -> Array:
    """Return s_i / s_(i+1) of singular values (r,), largest first, those below the floor raised to it: (r - 1,)."""
    raised = np.maximum(values, max(floor, np.finfo(float).tiny))
    return raised[:-1] / raised[1:]


def largest_gap(values: Array, most: int, floor: float) -> int:
    """Return the order at the largest ratio s_i / s_(i+1), i = 1 .. most (SLICOT IB01OD with its default tolerance)."""
    return int(np.argmax(ratios_of(values, floor)[: max(1, most)])) + 1


def order_test(records: Sequence[Array], expansion: Expansion, alpha: int, *, instruments: str = "simulated",
               offset: bool = True, level: float | None = None) -> RankTest:
    """Test the ranks of the projected outputs; several outputs count relative to their sizes.

    The records are raw channels [u | y], or [u | y | simulated y] where the expansion reads simulated outputs. Past,
    future and serial correlation span alpha block rows each. Instruments are as in `Expansion.positions`, level and
    errors as in `rank_test`.
    """
    statistics = hankel_statistics(records, 3 * alpha, expansion, names=expansion.names,
                                   centre="mean" if offset else None)
    regression = expansion.positions(statistics.at, instruments, alpha, offset)
    scale = np.tile(statistics.sizes(expansion.y, offset), alpha) if expansion.l > 1 else None
    return rank_test(statistics, regression, rows=2 * alpha, level=level, largest=(alpha - 1) * expansion.l,
                     scale=scale)


def rank_test(statistics: HankelStatistics, regression: RegressionRows, *, rows: int, level: float | None = None,
              largest: int | None = None, scale: Array | None = None) -> RankTest:
    """Test the ranks of R22.

    Args:
        statistics: moments of windows of `rows` + reach samples; the reach is the largest lag between windows whose
            correlation counts, at most the number of future block rows.
        regression: where Z, Phi and Y lie in the first `rows` block rows.
        rows: block rows of the instruments, regressors and outputs together.
        level: probability of rejecting the true order; min(0.01, 10 / j) when not given.
        largest: order to be chosen, (alpha - 1) l for alpha future block rows of l outputs.
        scale: (y,) size of every row of Y, by which it is divided: several outputs in different units; None for ones.

    Raises:
        StructureError: windows no longer than `rows`, positions beyond them, a level not between 0 and 1.
        RankError: too few windows, or instruments that do not reach the regressors.
    """
    if statistics.rows <= rows:
        raise StructureError(f"The windows have {statistics.rows} block rows and {rows} are used: take windows that "
                             "are longer by the number of future block rows.")
    z, phi, y = regression
    width = 1 + rows * statistics.d
    if max(z.max(), phi.max(), y.max()) >= width:
        raise StructureError(f"Instruments, regressors and outputs must lie within the first {rows} block rows.")
    j = statistics.windows
    level = min(LEVEL, SPAN / j) if level is None else level
    check_probability(level, "level")
    if j <= 1.1 * z.size + y.size:
        raise RankError(f"{j} complete windows for {z.size} instruments and {y.size} outputs in the block rows: use a "
                        "longer record, fewer block rows or fewer basis functions.")
    sizes = np.ones(y.size) if scale is None else np.asarray(scale, dtype=float)
    if sizes.shape != (y.size,) or not (sizes > 0).all():
        raise StructureError(f"scale must be {y.size} positive numbers, one per row of the outputs.")
    r22, noise, shocks, floor = _projections(statistics, regression, width, sizes)
    left, values, right = np.linalg.svd(r22)
    covariance_e, covariance_z = lagged_covariances(statistics, rows, noise @ left, shocks @ right.T, z.size)
    tails = np.cumsum((values**2)[::-1])[::-1]
    # in a power of two near the size of the errors, whose fourth powers would leave the range of numbers
    unit = float(np.ldexp(1.0, np.frexp(np.trace(covariance_e[0]))[1]))
    covariance_e = [e / unit for e in covariance_e]
    expected, thresholds, p_values = np.zeros((3, values.size))
    for n0 in range(values.size):
        mean, variance = moments_of_sum([e[n0:, n0:] for e in covariance_e], [s[n0:, n0:] for s in covariance_z])
        expected[n0] = unit * mean / j
        if mean <= 0 or variance <= 0:
            p_values[n0] = 1.0 if values[n0] <= floor else 0.0
            continue
        quantile, p_values[n0] = quantile_of_sum(mean, variance, level, tails[n0] / unit * j)
        thresholds[n0] = unit * quantile / j
    return RankTest(values, tails, expected, thresholds, p_values, floor, level, j,
                    values.size if largest is None else largest)


def _projections(statistics: HankelStatistics, regression: RegressionRows, width: int, sizes: Array
                 ) -> tuple[Array, Array, Array, float]:
    """R22, the windows' weights (width, .) that give e_t and orthonormal z_t, and the floor, per window."""
    from scipy.linalg import solve_triangular

    z, phi, y = regression
    blocks, j = rq(statistics, z, phi, y), statistics.windows
    regressors, outputs = (part / np.sqrt(j) for part in blocks.projected)
    q, r11 = np.linalg.qr(regressors.T, mode="complete")
    q1, q2 = q[:, : phi.size], q[:, phi.size :]
    r22 = outputs @ q2
    orthonormal = np.sqrt(j) * solve_triangular(blocks.triangle, np.eye(z.size))
    shocks, noise = np.zeros((width, q2.shape[1])), np.zeros((width, y.size))
    shocks[z] = orthonormal @ q2
    noise[y, np.arange(y.size)] = 1
    noise[phi] -= solve_triangular(r11[: phi.size], (outputs @ q1).T)
    noise[z] -= orthonormal @ (r22 @ q2.T).T
    size = float(np.sqrt(np.sum(np.diag(statistics.gram)[y] / sizes**2) / j))
    return r22 / sizes[:, None], noise / sizes, shocks, FLOOR * max(r22.shape) * np.finfo(float).eps * size


def lagged_covariances(statistics: HankelStatistics, rows: int, noise: Array, shocks: Array, count: int
                       ) -> tuple[list[Array], list[Array]]:
    """Covariances at lags 0 ... reach of e = noise^T s and z = shocks^T s over windows s = [1; rows block rows].

    The e are residuals of a regression on `count` instruments, whose degrees of freedom are given back.
    """
    width, lags = len(noise), range(statistics.rows - rows + 1)
    later = [np.concatenate([[0], np.arange(1 + lag * statistics.d, width + lag * statistics.d)]) for lag in lags]
    grams = [statistics.gram[:width][:, columns] / statistics.windows for columns in later]
    unbiased = statistics.windows / max(statistics.windows - count, 1)
    return [unbiased * noise.T @ gram @ noise for gram in grams], [shocks.T @ gram @ shocks for gram in grams]


def moments_of_sum(covariance_e: Sequence[Array], covariance_z: Sequence[Array]) -> tuple[float, float]:
    """Mean and variance of |(1/sqrt j) sum_t e_t z_t^T|^2, the sum Gaussian with Omega = sum_tau R_z(tau) x R_e(tau).

    All lags have weight one, or Bartlett's weights where the estimate is not a covariance.
    """
    reach = len(covariance_e) - 1
    e = np.array([m.ravel() for m in [*covariance_e, *(m.T for m in covariance_e[1:])]])
    z = np.array([m.ravel() for m in [*covariance_z, *(m.T for m in covariance_z[1:])]])
    traces = np.array([np.trace(a) * np.trace(b) for a, b in zip(covariance_e, covariance_z)])
    products = (e @ e.T) * (z @ z.T)
    for weights in (np.ones(reach + 1), 1 - np.arange(reach + 1) / (reach + 1)):
        mean = float(weights @ traces + weights[1:] @ traces[1:])
        both = np.concatenate([weights, weights[1:]])
        variance = 2 * float(both @ products @ both)
        if mean > 0.1 * traces[0] and variance > 0.01 * products[0, 0]:
            break
    return mean, variance


def quantile_of_sum(mean: float, variance: float, level: float, statistic: float) -> tuple[float, float]:
    """Return what a sum of squares of these moments exceeds with the probability `level`, and how often a statistic.

    It is nearly g times chi-square with h degrees of freedom, which have the same moments.
    """
    from scipy.special import chdtrc, chdtri

    g, h = variance / (2 * mean), 2 * mean**2 / variance
    return float(g * chdtri(h, level)), float(chdtrc(h, statistic / g))
