"""Residual tests: whiteness, and independence of the inputs (Ljung, System Identification, section 16.6)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz
from scipy.special import chdtrc

from optid.arrays import Array

LEVEL = 0.01
QUANTILE_99 = 2.5758293035489004  # two-sided 99 % quantile of the standard normal distribution


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlations of the residuals of one output with their own past or with an input.

    Attributes:
        output: name of the output.
        input: name of the input, or of the other output; None for the autocorrelation.
        lags: (L,) lags; positive ones correlate the residual with the past.
        values: (L,) correlation coefficients, from the pairs of samples that are present.
        band: (L,) half width of the 99 % band of an ideal model.
        p_value: of the hypothesis that all correlations from lag 1 (auto) or 0 (cross) on are zero; NaN where a signal
            is constant. On the record that the model was estimated from the test is optimistic.
        first: lag from which on correlations are tested.
        slight: correlations up to this size are negligible, however significant.
        claimed: whether the model says that there is no correlation: without a noise model it says nothing about
            whiteness.
    """

    output: str
    input: str | None
    lags: NDArray[np.int64]
    values: Array
    band: Array
    p_value: float
    first: int = 1
    slight: float = 0.0
    claimed: bool = True

    @property
    def significant(self) -> bool:
        """Whether the hypothesis is rejected at the 1 % level, by more than what is negligible."""
        tested = self.values[self.lags >= self.first]
        return bool(self.p_value < LEVEL) and float(np.nanmax(np.abs(tested), initial=0.0)) > self.slight

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against what the model says."""
        return not (self.claimed and self.significant)

    @property
    def outcome(self) -> str:
        """The outcome in a word."""
        if np.isnan(self.p_value):
            return "not available"
        return "FAIL" if not self.passed else "coloured" if self.significant else "PASS"

    @property
    def outside(self) -> int:
        """Number of lags outside the band; lag 0 of an autocorrelation does not count."""
        counts = np.abs(self.values) > self.band
        return int(np.sum(counts[self.lags != 0] if self.input is None else counts))


def autocorrelation(residuals: Sequence[Array], output: str, lags: int = 25, *, past: Sequence[Array] | None = None,
                    other: str | None = None) -> Correlation:
    """Test whether residuals depend on their own past (Ljung and Box), or on that of another output's residuals.

    The other residuals are taken to be white; samples of the same instant may be correlated.

    Args:
        residuals: (N,) per experiment, NaN = missing.
        output: name of the output.
        lags: largest lag.
        past: (N,) residuals of the other output per experiment; its own when not given.
        other: name of the other output.
    """
    first, own = int(past is not None), _standardised(residuals)
    values, counts = lagged_products(own, own if past is None else _standardised(past), range(first, lags + 1))
    inflation = 1.0 if first else 1 + 2 / max(counts[0], 1)
    return Correlation(output, other, np.arange(first, lags + 1), values, _band(counts),
                       _portmanteau(values[1 - first :], counts[1 - first :] * inflation))


def cross_correlation(residuals: Sequence[Array], inputs: Sequence[Array], output: str, channel: str, lags: int = 25,
                      first: int = 0) -> Correlation:
    """Test whether the residuals depend on the input at lags `first` .. lags; negative lags show feedback.

    The statistic takes the autocorrelation of the input into account. Arguments as in `autocorrelation`, with the
    samples (N,) per experiment and the name of an input.
    """
    e, u = _standardised(residuals), _standardised(inputs)
    around = np.arange(-lags, lags + 1)
    values, counts = lagged_products(e, u, around)
    own, _ = lagged_products(u, u, range(lags + 1 - first))
    p_value = float("nan")
    if np.isfinite(values).all() and np.isfinite(own).all():
        scale, axes = np.linalg.eigh(toeplitz(own))
        # a slowly varying input excites few directions only: the others carry no evidence
        informed = scale > 1e-3 * scale[-1]
        score = axes.T[informed] @ (np.sqrt(counts[lags + first :]) * values[lags + first :])
        p_value = _portmanteau(score, 1 / scale[informed])
    return Correlation(output, channel, around, values, _band(counts), p_value, first)


def _portmanteau(values: Array, weights: Array) -> float:
    """Probability that a chi-square variable exceeds the weighted sum of squares of so many values."""
    return float(chdtrc(values.size, float(np.sum(weights * values**2))))


def _band(counts: Array) -> Array:
    return QUANTILE_99 / np.sqrt(np.where(counts > 0, counts, np.nan))


def _standardised(signals: Sequence[Array]) -> list[Array]:
    """Subtract the mean and divide by the standard deviation over all experiments."""
    every = np.concatenate([np.asarray(s, dtype=float) for s in signals])
    every = every[~np.isnan(every)]
    mean, size = (every.mean(), every.std()) if every.size else (np.nan, np.nan)
    return [(s - mean) / (size if size > 1e-14 * abs(mean) else np.nan) for s in signals]


def lagged_products(first: Sequence[Array], second: Sequence[Array], lags: Sequence[int] | NDArray[np.int64]
                    ) -> tuple[Array, Array]:
    """Return the mean of first(k) second(k - lag) over the pairs present, NaN where there are none, and their number.

    Both have one array (N,) per experiment; NaN = missing.
    """
    sums, counts = np.zeros((2, len(lags)))
    for a, b in zip(first, second):
        pairs = [(np.nan_to_num(a), np.nan_to_num(b)), tuple((~np.isnan(x)).astype(float) for x in (a, b))]
        for i, lag in enumerate(lags):
            now, past = slice(max(lag, 0), len(a) + min(lag, 0)), slice(max(-lag, 0), len(b) + min(-lag, 0))
            if now.stop > now.start:
                for total, (x, y) in zip((sums, counts), pairs):
                    total[i] += x[now] @ y[past]
    with np.errstate(invalid="ignore", divide="ignore"):
        return sums / counts, counts
