"""The verdict on a model: whether it is any good on a record, whatever has been proved about its structure.

A proof says that no model of a structure fits better, nothing about the structure. The verdict looks at what the model
does: how well its free run follows the outputs, in the worst part of the record, too; how much the one-step prediction
gains over it; whether the residuals still depend on the inputs; and whether delay, stability and the ranges of its
functions suit the record. It speaks of this record only.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import OptidError
from optid.identify.blocks import Blocks, pooled_fit
from optid.identify.informativity import Informativity, informativity
from optid.identify.validation.checks import NOT_TESTED, record_structure, shares_outside, tested_residuals
from optid.identify.validation.predictions import fit_percent, one_step_or_nan, simulated_or_nan
from optid.identify.validation.structure_design import MOVES, count_moves
from optid.identify.validation.systematic import systematic
from optid.models.functions import has_feedback, step_length
from optid.phrases import p_equals
from optid.registry import render
from optid.threads import one_thread

GOOD, FAIR, POOR, USELESS = "good", "fair", "poor", "useless"
UNKNOWN = "not available"  # how a value begins that is not
FEW_MOVES = "coloured, by noise or by a response of another kind: inputs that move so seldom do not tell"
GOOD_FIT, GOOD_BLOCK, POOR_FIT, USELESS_FIT = 85.0, 75.0, 65.0, 20.0
"""Fits in % from which on, and below which, a model is called so; the second is that of its worst block."""
OVERFIT = 12.0  # points that the cross-validated fit may be below that on the record itself
GAP = 15.0  # points that the one-step prediction may be better than the free run
# errors of the response that inputs explain, over the spread of the simulated output: of a model that is not good, and
NOTED, WRONG = 0.07, 0.10  # of one that is poor
UNCERTAIN = 0.07  # standard error of the step response, over its size
POINTS = 20  # of a step response, at which it is looked at
APART = 0.12  # difference of the response from that of the low-order model, in a loop
STRUCTURE = 0.1  # share of the residual variance that another structure may save in a model that is called good
OUTSIDE = 0.01  # share of the samples that may lie outside the interval of a function
MISFIT = ("independence of the inputs", "error that the inputs explain", "delay", "structure",
          "direct feedthrough in a loop", "difference from a low-order model with noise model")
"""Parts of a verdict that speak of errors of the response, which more samples would not make smaller."""


@dataclass(frozen=True)
class Finding:
    """One part of a verdict: what was looked at, what was found, and whether it passes; some do not decide the word."""

    name: str
    value: str
    passed: bool
    counts: bool = True

    @property
    def outcome(self) -> str:
        """PASS, FAIL, or "-" where there was nothing to test."""
        return "-" if self.value.startswith(UNKNOWN) else "PASS" if self.passed else "FAIL"


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

    @property
    def misfits(self) -> tuple[Finding, ...]:
        """The parts that find an error of the response beyond that of the parameters."""
        return tuple(part for part in self.failed if part.name in MISFIT and part.counts)

    def _repr_html_(self) -> str:
        return render(self, "html")

    def __str__(self) -> str:
        return f"{self.word}: " + "; ".join(
            f"{part.name} {part.value}: {part.outcome}" for part in self.parts)


@one_thread
def verdict(model: Any, data: Data, cross_validated: Sequence[float] | None = None, pooled: float | None = None,
            known: Any = None) -> Verdict:
    """Judge a model on a record.

    Args:
        model: the model.
        data: the record that it was estimated from.
        cross_validated: fits in % of the blocks that were left out one after another, where there are some.
        pooled: the same over all blocks.
        known: the `Uncertainty` of the model, where there is one.
    """
    raw, told = data.raw(), informativity(data)
    y = np.vstack([e.y for e in raw.experiments])
    runs, predicted = simulated_or_nan(model, raw), one_step_or_nan(model, raw)
    own, ahead = (float(np.mean(fit_percent(y, np.vstack(found)))) for found in (runs, predicted))
    closed = told.loop.word != "open"
    if pooled is not None and closed:
        own = ahead  # blocks were compared one sample ahead
    score, lost = (own, 0.0) if pooled is None else (pooled, own - pooled)
    said = re.split(r"[:;(]", told.reason)[0].strip() or (
        f"{UNKNOWN}: {told.untested}" if told.untested else "informative")
    parts = [Finding("record", said, not told.reason, counts=not told.untested)]
    parts.append(Finding("simulation fit" if pooled is None else "cross-validated fit", _points(score),
                         score >= POOR_FIT))
    by_block = _by_block(raw, runs) if cross_validated is None else np.asarray(cross_validated)
    worst = float(np.min(by_block, initial=np.inf))
    if by_block.size:
        parts.append(Finding("worst block", f"{_points(worst)} (median {_points(float(np.median(by_block)))})",
                             worst >= GOOD_BLOCK - (GOOD_FIT - POOR_FIT)))
    if pooled is not None and np.isfinite(lost):
        parts.append(Finding("estimation minus cross-validated fit", _points(lost, " points"), lost <= OVERFIT))
    if np.isfinite(ahead) and np.isfinite(own) and not closed:
        parts.append(Finding("one-step minus simulation fit", _points(ahead - own, " points"), ahead - own <= GAP))
    parts += _residuals(model, raw, predicted)
    wrong = [*_response(model, raw, runs, told, closed), *_uncertain(model, raw, known, told)]
    wrong += _lags(model, told, all(part.passed for part in wrong))
    # a pole nearer to 1 than the record is long grows by less than e over it: the record does not tell it from 1
    ramps = model.integrates or (not model.is_stable and model.integrates_within(
        1 / max(e.n_samples for e in raw.experiments)))
    steady = bool(model.is_stable) or (has_feedback(model) and np.isfinite(own))
    parts += [*wrong, Finding("stability", "integrates" if ramps else "stable" if steady else "unstable",
                              steady or ramps), *_ranges(model, raw), *_structure(model, raw)]
    if told.reason or not score >= USELESS_FIT:
        word = USELESS
    elif score < POOR_FIT or lost > OVERFIT or any(part.counts and not part.passed for part in wrong):
        word = POOR
    else:
        failed = any(not part.passed for part in wrong) or any(part.counts and not part.passed for part in parts)
        word = GOOD if score >= GOOD_FIT and not worst < GOOD_BLOCK and not failed else FAIR
    return Verdict(word, tuple(parts), score)


def _residuals(model: Any, data: Data, predicted: Sequence[Array]) -> list[Finding]:
    """Say what the residual tests find, those of a page too."""
    if all(np.isnan(p).all() for p in predicted):
        return [Finding("residuals", f"{UNKNOWN}: no one-step prediction", True, counts=False)]
    tests = tested_residuals(model, data, predicted)
    found = []
    for name, kind in (("independence of the inputs", "cross_correlations"), ("whiteness", "autocorrelations")):
        failed = [test for test in tests[kind].values() if not test.passed]
        known = any(np.isfinite(test.p_value) for test in tests[kind].values())
        words = ", ".join(f"{test.output} {f'on {test.input}' if kind[0] == 'c' else 'on its past'}" for test in failed)
        coloured = any(test.significant for test in tests[kind].values())  # of which a model without noise says nothing
        if coloured and kind == "autocorrelations" and max(count_moves([e.u for e in data.experiments])) < MOVES:
            words = words or FEW_MOVES
        found.append(Finding(name, words or (("coloured" if coloured else "kept") if known else UNKNOWN), not words,
                             known))
    return found


def _response(model: Any, data: Data, runs: Sequence[Array], told: Informativity, closed: bool) -> list[Finding]:
    """Say how much of the response is wrong: what inputs explain of the residuals, or a difference in a loop."""
    if told.reason:
        return []
    if closed:
        return _beside_low_order(model, data, runs, told)
    found = systematic(data, runs, told)
    if found is None:
        return [Finding("error that the inputs explain", f"{UNKNOWN}: too few samples", True, counts=False)]
    where = f" ({found.output})" if data.l > 1 else ""
    size = f"{100 * found.share:.2g} % of the response{where}" if found.found else f"none visible{where}"
    return [Finding("error that the inputs explain", f"{size} ({p_equals(found.p_value)})",
                    not (found.found and found.share > NOTED), found.found and found.share > WRONG)]


def _beside_low_order(model: Any, data: Data, runs: Sequence[Array], told: Informativity) -> list[Finding]:
    """Compare the response with that of the low-order model with a noise model: in a loop residuals say nothing."""
    parts = []
    direct = _acts_at_once(model)
    if direct:
        parts.append(Finding("direct feedthrough in a loop", f"input {direct!r} acts at once, as the controller's "
                             "answer does", False))
    for o, process in enumerate(told.processes):
        own = np.concatenate([run[:, o] - np.nanmean(run[:, o]) for run in runs][: len(process.residuals)])
        other = np.concatenate([(e.y[: len(r), o] - r) - np.nanmean(e.y[: len(r), o] - r)
                                for e, r in zip(data.experiments, process.residuals)])
        own = own[: other.size]
        share = float(np.sqrt(np.nanmean((own - other) ** 2) / max(float(np.nanvar(other)), 1e-300)))
        value = "none" if not np.isfinite(share) else f"{100 * share:.2g} % of the response"
        parts.append(Finding("difference from a low-order model with noise model", value, share <= APART))
    return parts


def _uncertain(model: Any, data: Data, known: Any, told: Informativity) -> list[Finding]:
    """Say how well the record determines the response to a step over the range of every input.

    It is the root mean square over the response, relative to its largest value; for an input without visible effect
    to that of the output.
    """
    if known is None or has_feedback(model) or getattr(model, "latent", ()) or len(model.nonlinearities) != data.m:
        return []
    length = max(min(step_length(model), max(e.n_samples for e in data.experiments) // 3), 2)
    points = np.unique(np.linspace(1, length, POINTS).astype(int)) - 1
    spans = []
    for c, f in enumerate(model.nonlinearities):
        u = np.concatenate([e.u[:, c] for e in data.experiments])
        spans.append(np.array([np.nanmin(u), np.nanmax(u)]) if f.basis.interval is None else np.array(f.basis.interval))

    def response(one: Any) -> Array:
        moves = np.array([np.ptp(f(span)) for f, span in zip(one.nonlinearities, spans)])
        return (one.step_response(length)[points] * moves).ravel()

    try:
        found = known.of(response)
    except (OptidError, np.linalg.LinAlgError, ValueError):
        return []
    shape = (points.size, data.l, data.m)
    size = np.abs(found.value).reshape(shape).max(axis=0)
    idle = [told.without_effect(c) for c in range(data.m)]
    size = np.where(idle, size.max(axis=1, keepdims=True), size)

    def share_of(errors: Array) -> float:
        with np.errstate(all="ignore"):  # squares of shares: those of errors of an unstable response may overflow
            shares = np.sqrt(np.mean((errors.reshape(shape) / size) ** 2, axis=0))
            return float(np.nanmax(np.where(size > 0, shares, np.nan), initial=0.0))

    share = share_of(found.error)
    if share > UNCERTAIN and hasattr(known.source, "error_within_reach"):  # the linear model may not hold so far
        reached = known.source.error_within_reach(response)
        share = share if reached is None else min(share, share_of(reached))
    return [Finding("standard error of the step response", f"{100 * share:.2g} %", share <= UNCERTAIN)]


def _acts_at_once(model: Any) -> str:
    """Return an input that acts on an output without delay; "" where none does."""
    if hasattr(model, "nk"):
        return next((name for name, delay, b in zip(model.inputs, model.nk, model.b)
                     if delay == 0 and np.any(b[0])), "")
    first = np.abs(model.impulse_response(1))[0]
    return next((name for c, name in enumerate(model.inputs) if np.any(first[:, c])), "")


def _lags(model: Any, told: Informativity, harmless: bool) -> list[Finding]:
    """Say where inputs act later, or earlier, than the lags that the model has.

    Poles cover a delay as well: it is harmless where nothing else is wrong with the response.
    """
    if not hasattr(model, "nk") or not told.processes or told.reason:
        return []
    wrong = []
    for c, (name, first, b) in enumerate(zip(model.inputs, model.nk, model.b)):
        lows, highs = zip(*(p.responses[c].lag_interval for p in told.processes))
        if told.without_effect(c):
            continue
        if min(lows) >= first + len(b):
            wrong.append(f"{name} acts from lag {min(p.responses[c].nk for p in told.processes)} on, the model has "
                         f"lags {first} to {first + len(b) - 1}")
        elif max(highs) < first and all(p.responses[c].poles.size <= 2 for p in told.processes):
            wrong.append(f"{name} acts from lag {min(p.responses[c].nk for p in told.processes)} on, the model from "
                         f"lag {first} on")
    if wrong and harmless:
        return [Finding("delay", "covered by the dynamics", True)]
    return [Finding("delay", ", ".join(wrong) or "covered by the lags", not wrong)]


def _ranges(model: Any, data: Data) -> list[Finding]:
    # a function of a latent signal was fitted on all its samples, wherever they lie
    found = [(share, f.name) for f, _, share in shares_outside(model, data)
             if not f.is_linear and f.family != "latent"]
    if not found:
        return []
    share, name = max(found)
    return [Finding("samples outside the range of a function", f"{100 * share:.2g} %" + (
        f" ({name})" if share and len(found) > 1 else ""), share <= OUTSIDE)]


def _structure(model: Any, data: Data) -> list[Finding]:
    """Say whether the record has the structure of the model; what saves hardly anything leaves a model good."""
    notes: list[str] = []
    with np.errstate(all="ignore"):
        found = record_structure(model, data, notes)
    if found is None:
        why = [note.removeprefix(NOT_TESTED).partition(":")[0].rstrip(".") for note in notes]
        return [Finding("structure", f"{UNKNOWN}: {why[0]}", True, counts=False)] if why else []
    saved = "" if found.passed else f", which saves {100 * found.saving:.2g} % of the residual variance"
    word = "not rejected" if found.passed else found.finding
    return [Finding("structure", f"{word}{saved} ({p_equals(found.p_value)})", found.passed,
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
