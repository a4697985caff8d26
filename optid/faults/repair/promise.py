"""What a repaired model is worth: an upper bound of its error, and whether it beats the healthy model.

The error of a later run is promised from three measured parts: that of the healthy model on healthy samples, which no
repair removes, that of the repair on samples after the fault that it did not see, and the spread of the estimates.

    bound^2 = max(healthy, held out)^2 + spread^2

Errors are those of the free run, in units of the outputs; of one-step predictions where a plant is not stable. A mean
square of correlated errors is worth as many independent ones as the squares of their correlations leave (M. S.
Bartlett, J. R. Stat. Soc. 8, 1946). That of a later run as long varies as much: the limit of their ratio, of the F law,
counts.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array, as_list
from optid.data.record import Data
from optid.errors import DataError
from optid.models import HammersteinSS

CONFIDENCE = 0.9
"""Of the bounds of all outputs together, and of the spread of the estimates."""

FEWEST = 6
"""Samples that errors are judged from at least."""


@dataclass(frozen=True, eq=False)
class Promise:
    """What is known of the errors of a repair.

    Attributes:
        outputs: names of the outputs.
        healthy: (l,) limit of the rms error of the healthy model on healthy samples; NaN where it is not known.
        held_out: (l,) of the repair after the fault, on samples that it was not fitted to; NaN where there are none.
        unrepaired: (l,) rms error of the healthy model on the same samples.
        repaired: (l,) rms error of the repair on them.
        spread: (l,) because the estimates are uncertain.
        scale: (l,) standard deviations of the innovations.
        ahead: whether errors are those of one-step predictions.
    """

    outputs: tuple[str, ...]
    healthy: Array
    held_out: Array
    unrepaired: Array
    repaired: Array
    spread: Array
    scale: Array
    ahead: bool = False

    @property
    def bound(self) -> Array:
        """(l,) upper bound of the rms error of the repair in a later run; NaN where nothing was held out."""
        return np.sqrt(np.fmax(self.healthy, self.held_out) ** 2 + self.spread**2) + 0 * self.held_out

    @property
    def refusal(self) -> str:
        """Why the repair is not offered; empty where it is."""
        if self._size(self.repaired) >= self._size(self.unrepaired):
            return "on samples that it was not fitted to it is no better than the healthy model"
        if self._size(self.spread) > self._size(self.healthy):
            return "the spread of its estimates is larger than the error of the healthy model: record more samples"
        return ""

    def _size(self, errors: Array) -> float:
        squares = (errors / self.scale) ** 2
        return float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else float("nan")

    def __str__(self) -> str:
        if np.isnan(self.bound).all():
            return "no error is promised: too few samples after the fault to try the repair on"
        told = ", ".join(f"{name} {value:.3g}" for name, value in zip(self.outputs, self.bound))
        return f"rms error of {'one-step predictions' if self.ahead else 'the simulation'} at most: {told}"


def errors(model: HammersteinSS, data: Data) -> Array:
    """Return the errors (N, l) of a model on a record, its initial states fitted; NaN where a reading is missing.

    They are infinite where its run leaves all bounds.
    """
    try:
        with np.errstate(all="ignore"):
            word = "simulate" if model.is_stable else "predict"
            runs: Any = as_list(getattr(model, word)(data, x0="fit"))
    except DataError:
        return np.full((data.n_samples, model.l), np.inf)
    found = [part.y - run for part, run in zip(data.experiments, runs)]
    return np.vstack(found)


def rms(values: Array) -> Array:
    """Return the root mean squares (l,) of errors (N, l); NaN for fewer than `FEWEST` readings."""
    known = np.sum(~np.isnan(values), axis=0)
    mean = np.nansum(values**2, axis=0) / np.maximum(known, 1)
    return np.where(known >= FEWEST, np.sqrt(mean), np.nan)


def upper_rms(values: Array) -> Array:
    """Return the upper limits (l,) of the root mean squares of a later run, from correlated errors (N, l)."""
    from scipy.special import fdtri

    found, limits = rms(values), np.full(values.shape[1], np.nan)
    for o, size in enumerate(found):
        e = values[~np.isnan(values[:, o]), o]
        if not np.isfinite(size) or not size:
            limits[o] = size
            continue
        lags = np.correlate(e, e, "full")[e.size - 1 :][: max(e.size // 4, 1)] / (e @ e)
        count = max(e.size / (1 + 2 * np.sum(lags[1:] ** 2)), 2.0)
        limits[o] = size * np.sqrt(float(fdtri(count, count, 1 - (1 - CONFIDENCE) / values.shape[1])))
    return limits
