"""The verdict on a model: whether it is any good on a record, whatever has been proved about its structure.

A proof says that no model of a structure fits better, nothing about the structure. The verdict looks at what the model
does: how well its free run follows the outputs, in the worst part of the record, too; how much the one-step prediction
gains over it; whether the residuals still depend on the inputs; and whether delay, stability and the ranges of its
functions suit the record. It speaks of this record only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import OptidError
from optid.identify.blocks import Blocks, pooled_fit
from optid.identify.delays import shown_delays
from optid.identify.validation.checks import record_structure, shares_outside
from optid.identify.validation.correlations import cross_correlation
from optid.identify.validation.predictions import fit_percent, one_step_or_nan, simulated_or_nan
from optid.models.functions import has_feedback

GOOD, FAIR, POOR, USELESS = "good", "fair", "poor", "useless"
GOOD_FIT, GOOD_BLOCK, POOR_FIT, USELESS_FIT = 85.0, 75.0, 65.0, 20.0
"""Fits in % from which on, and below which, a model is called so; the second is that of its worst block."""
OVERFIT = 12.0  # points that the cross-validated fit may be below that on the record itself
GAP = 15.0  # points that the one-step prediction may be better than the free run
CORRELATED = 0.25  # largest correlation of residuals and past inputs; their p-values say nothing on long records
STRUCTURE = 0.1  # share of the residual variance that another structure may save in a model that is called good
OUTSIDE = 0.01  # share of the samples that may lie outside the interval of a function
LAGS = 25


@dataclass(frozen=True)
class Finding:
    """One part of a verdict: what was looked at, what was found, and whether it passes; some do not decide the word."""

    name: str
    value: str
    passed: bool
    counts: bool = True


@dataclass(frozen=True)
class Verdict:
    """What a model is worth on a record.

    Attributes:
        word: "good", "fair", "poor" or "useless".
        parts: what it rests on.
        score: fit in % of the free run, cross-validated where the structure was found by a search.
    """

    word: str
    parts: tuple[Finding, ...] = field(repr=False)
    score: float

    @property
    def failed(self) -> tuple[Finding, ...]:
        """The parts that do not pass."""
        return tuple(part for part in self.parts if not part.passed)

    def __str__(self) -> str:
        return f"{self.word}: " + "; ".join(
            f"{part.name} {part.value}: {'PASS' if part.passed else 'FAIL'}" for part in self.parts)


def verdict(model: Any, data: Data, cross_validated: Sequence[float] | None = None, pooled: float | None = None
            ) -> Verdict:
    """Judge a model on a record.

    Args:
        model: the model.
        data: the record that it was estimated from.
        cross_validated: fits in % of the blocks that were left out one after another, where there are some.
        pooled: the same over all blocks.
    """
    raw = data.raw()
    y = np.vstack([e.y for e in raw.experiments])
    runs, predicted = simulated_or_nan(model, raw), one_step_or_nan(model, raw)
    own, ahead = (float(np.mean(fit_percent(y, np.vstack(found)))) for found in (runs, predicted))
    score, lost = (own, 0.0) if pooled is None else (pooled, own - pooled)
    parts = [Finding("simulation fit" if pooled is None else "cross-validated fit", _points(score), score >= POOR_FIT)]
    by_block = _by_block(raw, runs) if cross_validated is None else np.asarray(cross_validated)
    worst = float(np.min(by_block, initial=np.inf))
    if by_block.size:
        parts.append(Finding("worst block", f"{_points(worst)} (median {_points(float(np.median(by_block)))})",
                             worst >= GOOD_BLOCK - (GOOD_FIT - POOR_FIT)))
    if pooled is not None:
        parts.append(Finding("estimation minus cross-validated fit", _points(lost, " points"), lost <= OVERFIT))
    if np.isfinite(ahead) and np.isfinite(own):
        parts.append(Finding("one-step minus simulation fit", _points(ahead - own, " points"), ahead - own <= GAP))
    # a pole nearer to 1 than the record is long grows by less than e over it: the record does not tell it from 1
    ramps = model.integrates or (not model.is_stable and model.integrates_within(
        1 / max(e.n_samples for e in raw.experiments)))
    steady = bool(model.is_stable) or (has_feedback(model) and np.isfinite(own))
    parts += [_residuals(raw, predicted), *_delays(model, raw),
              Finding("stability", "integrates" if ramps else "stable" if steady else "unstable", steady or ramps),
              *_ranges(model, raw), *_structure(model, raw)]
    if not score >= USELESS_FIT:
        word = USELESS
    elif score < POOR_FIT or lost > OVERFIT:
        word = POOR
    else:
        failed = any(part.counts and not part.passed for part in parts)
        word = GOOD if score >= GOOD_FIT and not worst < GOOD_BLOCK and not failed else FAIR
    return Verdict(word, tuple(parts), score)


def _residuals(data: Data, predicted: Sequence[Array]) -> Finding:
    residuals = [e.y - p for e, p in zip(data.experiments, predicted)]
    lags = min(LAGS, max(e.n_samples for e in data.experiments) // 4)
    largest, place, name = 0.0, "", "largest correlation of residuals and inputs"
    if all(np.isnan(r).all() for r in residuals):
        return Finding(name, "none: no one-step prediction", False)
    for (o, output), (c, channel) in product(enumerate(data.outputs), enumerate(data.inputs)):
        found = cross_correlation([r[:, o] for r in residuals], [e.u[:, c] for e in data.experiments], output, channel,
                                  lags)
        size = float(np.nanmax(np.abs(found.values[found.lags >= 0]), initial=0.0))
        if size > largest:
            largest, place = size, f" ({output} on {channel})" if data.m * data.l > 1 else ""
    return Finding(name, f"{largest:.2f}{place}", largest <= CORRELATED)


def _delays(model: Any, data: Data) -> list[Finding]:
    """Say where inputs act later than the lags that the model has."""
    if not hasattr(model, "nk"):
        return []
    delays = [delay for delay in shown_delays(model, data) if delay is not None]
    if len(delays) < 2:
        return []
    late = [f"{name} acts after {k} samples" for name, k, first, b in zip(
        data.inputs, np.max(delays, axis=0), model.nk, model.b) if k >= first + len(b)]
    return [Finding("delay", ", ".join(late) or "covered by the lags", not late)]


def _ranges(model: Any, data: Data) -> list[Finding]:
    found = [(share, f.name) for f, _, share in shares_outside(model, data) if not f.is_linear]
    if not found:
        return []
    share, name = max(found)
    return [Finding("samples outside the range of a function", f"{100 * share:.2g} %" + (
        f" ({name})" if share and len(found) > 1 else ""), share <= OUTSIDE)]


def _structure(model: Any, data: Data) -> list[Finding]:
    """Say whether the record has the structure of the model; what saves hardly anything leaves a model good."""
    with np.errstate(all="ignore"):
        found = record_structure(model, data)
    if found is None:
        return []
    saved = "" if found.passed else f", which saves {100 * found.saving:.2g} % of the residual variance"
    word = "not rejected" if found.passed else found.finding
    return [Finding("structure", f"{word}{saved} (p = {found.p_value:.2g})", found.passed,
                    found.saving > STRUCTURE)]


def _by_block(data: Data, runs: Sequence[Array]) -> Array:
    """Return the fit in % of every block of the record itself, by the variance of the whole."""
    try:
        blocks = Blocks.of(data)
    except OptidError:
        return np.zeros(0)
    variance, found = blocks.outputs[0], []
    for parts in blocks.parts:
        error = np.vstack([(runs[p.experiment] - data.experiments[p.experiment].y)[p.first : p.last] for p in parts])
        here = np.isfinite(error)
        energy, measure = np.sum(np.where(here, error, 0.0) ** 2, axis=0), variance * here.sum(axis=0)
        found.append(pooled_fit(energy[None], measure[None]) if here.any() else -np.inf)
    return np.array(found)


def _points(value: float, unit: str = " %") -> str:
    return f"{value:.1f}{unit}" if np.isfinite(value) else "none"
