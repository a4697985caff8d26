"""Tests on windows of a record with the serial correlation of the windows: zero coefficients, and missing orders.

With [o; t; y] the rows of a Hankel matrix, regress y on o and t. Let z_t be the part of the tested rows t that the
others o do not explain, normalised, and e_t the residuals of y, normalised. If the coefficients of t are zero,

    T = |(1/j) sum_t e_t z_t^T|_F^2

is nearly g chi2_h / j, with g and h from the covariances of e and z at every lag at which windows overlap
(`optid.identify.order.ranks`). If they are Theta instead, T grows by |C_z^(1/2) Theta C_e^(-1/2)|^2: with Theta of a
healthy record this says whether a test on another record can tell anything at all.

The order test accepts an order k when the sum T(k) of the squared singular values of R22 = L31 Q2 after the first k is
no more than noise. On a healthy plant the outputs are Pi times the instruments and noise, with Pi the same on every
record. With L11 and Q2 of a window, Pi L11 Q2 is what its R22 would be without noise. Where the squares after the first
k fall short of the threshold, the window is too short or too quiet to reject the order k, and no failure is to blame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.identify.order.ranks import RankTest, lagged_covariances, moments_of_sum
from optid.statistics.hankel import HankelStatistics

Positions = Sequence[int] | NDArray[np.intp]

DROPPED = 1e-8
"""Eigenvalue of the scaled tested rows below which a direction is not excited and not tested."""

QUIET = 1e-7
"""Residuals relative to the spread of the healthy output that count as rounding."""

MARGIN = 3.0
"""A test counts, and an order is rejected, only where a healthy plant would exceed the threshold this many times."""


@dataclass(frozen=True, eq=False)
class ZeroTest:
    """One group of coefficients on one window.

    Attributes:
        name: the channel, for instance "sensor:y1".
        statistic: T, without unit.
        threshold: quantile of T if the coefficients are zero.
        p_value: probability of a larger T if they are zero.
        healthy: T to be expected of a healthy channel on this window; inf where no healthy record was given.
        flat: whether the tested output does not move at all.
    """

    name: str
    statistic: float
    threshold: float
    p_value: float
    healthy: float = float("inf")
    flat: bool = False

    @property
    def testable(self) -> bool:
        """Whether a healthy channel would be told from a dead one."""
        return self.healthy > MARGIN * self.threshold

    @property
    def zero(self) -> bool:
        """Whether the coefficients are zero as far as this window tells, and it would tell."""
        return self.testable and self.statistic <= self.threshold

    @property
    def ratio(self) -> float:
        """T over its threshold."""
        return self.statistic / self.threshold if self.threshold > 0 else 0.0 if self.statistic == 0 else float("inf")


def zero_test(
    statistics: HankelStatistics, tested: Positions, others: Positions, outputs: Positions, *, rows: int, level: float,
    name: str = "", scale: Array | None = None, coefficients: Array | None = None,
) -> tuple[ZeroTest, Array]:
    """Test whether the coefficients of some rows are zero.

    Args:
        statistics: moments of windows of `rows` + reach samples; correlation counts up to the reach.
        tested: positions of t within the first `rows` block rows.
        others: positions of o, the constant (0) among them.
        outputs: positions of y.
        rows: block rows in use.
        level: probability of calling a true zero not zero.
        name: of the channel.
        scale: (y,) sizes of the outputs when healthy; their own spread when not given.
        coefficients: (t, y) of a healthy record, in units of the signals.

    Returns:
        The test, and the coefficients (t, y) on this record.
    """
    from scipy.special import chdtrc, chdtri

    t, o, y = (np.asarray(part, dtype=np.intp) for part in (tested, others, outputs))
    j, width = statistics.windows, 1 + rows * statistics.d
    gram = statistics.gram / j
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    past, on_t = _regressed(gram, o, np.concatenate([t, y]), size), np.arange(t.size)
    weights = np.zeros((width, t.size + y.size))  # what is left of t and y after o
    weights[t, on_t] = 1
    weights[y, t.size + np.arange(y.size)] = 1
    weights[o] -= past
    left = weights.T @ gram[:width, :width] @ weights
    spread = np.sqrt(np.maximum(np.diag(left)[t.size :], 0)) if scale is None else np.asarray(scale, dtype=float)
    spread = np.maximum(spread, 1e-150)
    unit = size[t]
    values, vectors = np.linalg.eigh(left[: t.size, : t.size] / np.outer(unit, unit))
    kept = values > DROPPED * t.size
    normal = vectors[:, kept] / np.sqrt(values[kept]) / unit[:, None]  # z = normal^T t
    gains = normal.T @ left[: t.size, t.size :]
    theta = normal @ gains
    covariance = (left[t.size :, t.size :] - gains.T @ gains) / np.outer(spread, spread) + QUIET**2 * np.eye(y.size)
    whitener = np.linalg.inv(np.linalg.cholesky((covariance + covariance.T) / 2)).T / spread[:, None]
    energy = float(np.max(np.diag(left)[t.size :] / spread**2))
    shocks, noise = weights[:, on_t] @ normal, (weights[:, t.size :] - weights[:, on_t] @ theta) @ whitener
    statistic = float(np.sum((gains @ whitener) ** 2))
    e, z = lagged_covariances(statistics, rows, noise, shocks, o.size + t.size)
    flat = energy <= QUIET**2
    if not kept.any() or flat:
        healthy = 0.0 if not kept.any() else float("inf")
        return ZeroTest(name, 0.0, 0.0, 1.0, healthy, flat), theta
    mean, variance = moments_of_sum(e, z)
    healthy = float("inf")
    if coefficients is not None:
        root = np.sqrt(values[kept])[:, None] * (vectors[:, kept] * unit[:, None]).T
        healthy = mean / j + float(np.sum((root @ coefficients @ whitener) ** 2))
    if mean <= 0 or variance <= 0:  # residuals are rounding: any coefficient counts
        return ZeroTest(name, statistic, 0.0, float(statistic == 0), healthy), theta
    g, h = variance / (2 * mean), 2 * mean**2 / variance
    threshold, p_value = float(g / j * chdtri(h, level)), float(chdtrc(h, statistic * j / g))
    return ZeroTest(name, statistic, threshold, p_value, healthy), theta


def smallest_excitation(statistics: HankelStatistics, positions: Positions, scale: Array) -> float:
    """Return the smallest eigenvalue of the covariance of some rows, each divided by its healthy size."""
    at = np.asarray(positions, dtype=np.intp)
    mean = statistics.gram[0, at] / statistics.windows
    covariance = statistics.gram[np.ix_(at, at)] / statistics.windows - np.outer(mean, mean)
    return max(float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0]), 0.0)


def _regressed(gram: Array, on: NDArray[np.intp], of: NDArray[np.intp], size: Array) -> Array:
    """Least squares (on, of) from moments; directions that are not excited get no coefficient."""
    scaled = gram[np.ix_(on, on)] / np.outer(size[on], size[on])
    inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True)
    return inverse @ (gram[np.ix_(on, of)] / size[on][:, None]) / size[on][:, None]


def coefficients(statistics: HankelStatistics, instruments: Positions, outputs: Positions) -> Array:
    """Return Pi (y, z), the regression of the outputs on the instruments."""
    z = np.asarray(instruments, dtype=np.intp)
    triangle = statistics.triangle(np.concatenate([z, np.asarray(outputs, dtype=np.intp)]))
    scale = np.maximum(np.linalg.norm(triangle[: z.size, : z.size], axis=0), 1e-300)
    return np.linalg.lstsq(triangle[: z.size, : z.size] / scale, triangle[: z.size, z.size :], rcond=1e-13)[0].T / scale


def least_order(
    statistics: HankelStatistics, instruments: Positions, regressors: Positions, healthy: Array, test: RankTest,
    order: int, scale: Array,
) -> int:
    """Return the order that a healthy plant would show at least on a window.

    Args:
        statistics: moments of the window.
        instruments: positions of z, the regressors among them.
        regressors: positions of phi.
        healthy: Pi (y, z) of a healthy record.
        test: the test of the window.
        order: of the healthy plant.
        scale: (y,) sizes of the outputs.
    """
    z, phi = (np.asarray(part, dtype=np.intp) for part in (instruments, regressors))
    triangle = statistics.triangle(z) / np.sqrt(statistics.windows)
    place = {int(position): c for c, position in enumerate(z)}
    basis = np.linalg.qr(triangle[:, [place[int(p)] for p in phi]], mode="complete")[0]
    expected = (healthy @ triangle.T @ basis[:, phi.size :]) / scale[:, None]
    squares = np.linalg.svd(expected, compute_uv=False)[:order] ** 2
    tails = np.cumsum(squares[::-1])[::-1]
    count = min(order, tails.size, test.thresholds.size)
    sure = tails[:count] > np.maximum(MARGIN * test.thresholds[:count], test.floor**2)
    return count if sure.all() else int(np.argmin(sure))
