"""Thresholds of a monitor from a healthy record, for plants whose innovations are not white.

As in `optid.faults.search.empirical` all thresholds get one factor, the smallest with which the record keeps the rate
of false alarms. A record is rarely long enough to show alarms as rare as a monitor wants them. Then the factor is that
of more frequent ones, which the record does show: how much larger the energies are that a few of its blocks reach than
those that as many blocks of white innovations reach.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError
from optid.faults.monitor.arl import Calibration
from optid.faults.search.empirical import COMMON, LEAST, SURE, sliding_scan
from optid.faults.whitening import Whitened, whiten
from optid.models.experiments import in_units_of

if TYPE_CHECKING:
    from optid.faults.monitor.monitoring import Monitor

FEWEST = 20
"""Blocks of a window that a healthy record has at least."""

SIMULATED = 2000
"""Simulated blocks of white innovations."""

STEPS = 10
"""Windows per block along inputs, whose signatures are computed anew for each of them."""


def empirical_calibration(monitor: "Monitor", healthy: Data, *, seed: int | None = 0) -> Calibration:
    """Return thresholds for a monitor of the same dictionary and window, at the ARL0 of this one.

        Monitor(model, faults, thresholds=empirical_calibration(Monitor(model, faults), healthy))

    Args:
        monitor: with thresholds for white innovations.
        healthy: a record without faults, better not the one the model was identified from.
        seed: of the simulation of white innovations.

    Raises:
        DataError: a record of fewer than 20 windows, or another's channels.
    """
    found, window, base = monitor.dictionary, monitor.window, monitor.calibration
    raw = in_units_of(found.model, healthy)
    white = whiten(found.model, raw, scale=found.predictor)
    parts = [white] if isinstance(white, Whitened) else list(white)
    columns = [found.labels.index(label) for label in base.labels]
    moving = any(c.columns for c in found.candidates)
    inputs = [part.u if moving else None for part in raw.experiments]
    hop = max(window // STEPS, 1) if moving else 1

    def maxima(part: Whitened, u: Array | None) -> Array:
        """Largest energy over its threshold in every block of a window's length."""
        if len(part.r) < window:
            return np.zeros(0)
        course = sliding_scan(found, part, window, u=u, hop=hop).statistic[:, columns]
        ratios, size = np.nanmax(course / base.q, axis=1), max(window // hop, 1)
        return np.array([ratios[i : i + size].max() for i in range(0, len(ratios) - size + 1, size)])

    largest = np.concatenate([maxima(part, u) for part, u in zip(parts, inputs)])
    if largest.size < FEWEST:
        raise DataError(
            f"The healthy record has {largest.size} stretches of {window} samples: {FEWEST} are needed for thresholds."
        )
    level = window / base.arl0
    extrapolated = level * largest.size < LEAST
    if extrapolated:
        often = min(SURE / largest.size, COMMON)
        rng = np.random.default_rng(seed)
        usual = np.concatenate([maxima(_noise(part, rng), u) for part, u in _repeated(parts, inputs, window)])
        factor = float(np.quantile(largest, 1 - often) / np.quantile(usual, 1 - often))
        factor = max(factor, float(largest.max()))  # an alarm that is rarer than the record is not in it
    else:
        factor = float(np.quantile(largest, 1 - level, method="higher"))
    return Calibration(base.labels, factor * base.q, base.arl0, window, sum(len(part.r) for part in parts),
                       _runs(largest > factor), seed, extrapolated)


def _repeated(parts: list[Whitened], inputs: list[Array | None], window: int) -> list[tuple[Whitened, Array | None]]:
    """The experiments, as often as the simulation needs them."""
    once = list(zip(parts, inputs))
    return once * max(1, -(-SIMULATED * window // sum(len(part.r) for part in parts)))


def _noise(part: Whitened, rng: np.random.Generator) -> Whitened:
    """White innovations with the readings of an experiment."""
    return replace(part, r=np.where(part.present, rng.standard_normal(part.r.shape), 0.0))


def _runs(above: np.ndarray) -> int:
    """Count runs of blocks with an alarm."""
    return int(above[0]) + int(np.sum(above[1:] & ~above[:-1]))
