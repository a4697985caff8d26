"""Errors of predicted outputs: fit, variance accounted for, root mean square, signal to noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.data.record import Data


@dataclass(frozen=True)
class Measures:
    """Errors of one output over the samples that are present and predicted.

    Attributes:
        fit: 100 (1 - |y - yhat| / |y - mean y|), in %; 100 is perfect, the mean scores 0.
        vaf: variance accounted for, 100 (1 - var(y - yhat) / var y), in %.
        rmse: root of the mean squared error, in output units.
        e_n: mean squared error (1/N) sum (y - yhat)^2, as the source prints it; perhaps its root was lost: rmse.
        snr: sum y^2 / sum (y - yhat)^2 as the source prints it, a ratio of energies.
        snr_amplitude: the root of that, a ratio of amplitudes.
        samples: number of samples N.
    """

    fit: float
    vaf: float
    rmse: float
    e_n: float
    snr: float
    snr_amplitude: float
    samples: int

    @classmethod
    def of(cls, y: Array, predicted: Array) -> "Measures":
        """Compare y (N,) with predicted (N,); NaN in either leaves the sample out."""
        here = ~(np.isnan(y) | np.isnan(predicted))
        if not here.any():
            nan = float("nan")
            return cls(nan, nan, nan, nan, nan, nan, 0)
        y, error = y[here], (y - predicted)[here]
        mean_square, energy = float(np.mean(error**2)), float(np.mean(y**2))
        snr = energy / mean_square if mean_square > 0 else float("inf")
        return cls(
            fit=float(fit_percent(y[:, None], (y - error)[:, None])[0]),
            vaf=100 * (1 - float(np.var(error) / np.var(y))) if np.ptp(y) > 0 else float("nan"),
            rmse=float(np.sqrt(mean_square)),
            e_n=mean_square,
            snr=snr,
            snr_amplitude=float(np.sqrt(snr)),
            samples=int(here.sum()),
        )

    @property
    def relative_error(self) -> float:
        """100 |y - yhat| / |y| in %, the error measure of the dissertation's tables 5.1 and 5.2."""
        return 100 / self.snr_amplitude if self.snr_amplitude > 0 else float("nan")


def fit_percent(y: Array, predicted: Array) -> Array:
    """Return 100 (1 - |y - yhat| / |y - mean y|) of every output, (l,), over the samples present in both.

    Args:
        y: (N, l) measured.
        predicted: (N, l) predicted or simulated.
    """
    fits = np.full(y.shape[1], np.nan)
    for o in range(y.shape[1]):
        here = ~(np.isnan(y[:, o]) | np.isnan(predicted[:, o]))
        if here.any() and np.ptp(y[here, o]) > 0:
            spread = np.linalg.norm(y[here, o] - y[here, o].mean())
            fits[o] = 100 * (1 - np.linalg.norm(y[here, o] - predicted[here, o]) / spread)
    return fits


def common_fits(data: Data, several: Sequence[Sequence[Array]]) -> Array:
    """Return the fits in % of several predictions of a record, (k, l), over the samples that all of them predict.

    Args:
        data: the record.
        several: predicted outputs, one (N, l) per experiment each. One that predicts nothing does not count for the
            others; its fit is NaN.
    """
    y = np.vstack([e.y for e in data.experiments])
    stacked = [np.vstack(list(arrays)) for arrays in several]
    lost = [np.isnan(predicted) for predicted in stacked if not np.isnan(predicted).all()]
    y = np.where(np.any(lost, axis=0), np.nan, y) if lost else y
    return np.array([fit_percent(y, predicted) for predicted in stacked])
