"""The search for one fault over all candidates and onsets, run on many windows at once.

For every candidate c and onset theta the statistic is the energy of the part of the window r that the signature
explains, l = b' G^-1 b with b the correlation of r with the signature and G its Gram matrix. Signatures of additive
faults are shifts of one another, so that all correlations are one convolution. A candidate is accused when l exceeds
its threshold q_c by most. The thresholds are quantiles of the maximum over the onsets, at a level common to all
candidates, such that a healthy window raises an alarm with the probability asked for.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_probability
from optid.errors import DataError, StructureError
from optid.faults.signatures import Candidate, Dictionary, response
from optid.models.experiments import samples_of

SHARE = 1e-9
"""Directions of a Gram matrix below this share of its largest eigenvalue explain nothing."""

BATCH = 2_000_000
"""Numbers of a batch of windows."""


class Ruler(NamedTuple):
    """One candidate over all onsets of a window.

    Attributes:
        candidate: the candidate.
        trace: (N, l, d) its signature from the onset on.
        onsets: (T,) onsets that are searched.
        roots: (T, d, d) inverse roots of the Gram matrices; zero rows where a direction is not seen.
        spectrum: (F, l, d) Fourier transform of the trace, conjugate.
    """

    candidate: Candidate
    trace: Array
    onsets: np.ndarray
    roots: Array
    spectrum: Array

    def scores(self, windows: Array) -> Array:
        """Return (M, T, d) of windows (M, N, l); the squared norm over the last axis is the statistic."""
        count = windows.shape[1]
        transform = np.fft.rfft(windows, 2 * count, axis=1)
        correlation = np.fft.irfft(np.einsum("mfo,fop->mfp", transform, self.spectrum), 2 * count, axis=1)
        return np.einsum("tqp,mtp->mtq", self.roots, correlation[:, self.onsets])

    def signature(self, onset: int) -> Array:
        """Return the signature (N, l, d) of an onset."""
        shifted = np.zeros_like(self.trace)
        shifted[onset:] = self.trace[: len(self.trace) - onset]
        return shifted


class InputRuler(NamedTuple):
    """One candidate whose signature depends on the input, over all onsets of a window.

    Attributes:
        candidate: the candidate.
        onsets: (T,) onsets that are searched.
        bank: (N, N, l, d) its signatures by onset.
        roots: (T, d, d) inverse roots of the Gram matrices.
    """

    candidate: Candidate
    onsets: np.ndarray
    bank: Array
    roots: Array

    def scores(self, windows: Array) -> Array:
        """Return (M, T, d) of windows (M, N, l); the squared norm over the last axis is the statistic."""
        bank = self.bank[self.onsets]
        correlation = np.tensordot(windows, bank, ([1, 2], [1, 2]))
        return np.einsum("tqp,mtp->mtq", self.roots, correlation)

    def signature(self, onset: int) -> Array:
        """Return the signature (N, l, d) of an onset."""
        return self.bank[onset]


@dataclass(frozen=True, eq=False)
class SignatureSpace:
    """All candidates of a dictionary with a signature of their own, over the onsets of a window.

    Attributes:
        rulers: one per candidate.
        window: samples N of a window.
        outputs: number of outputs l.
        skipped: labels of the candidates without a signature of their own.
    """

    rulers: tuple[Ruler | InputRuler, ...]
    window: int
    outputs: int
    skipped: tuple[str, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """What the candidates are called."""
        return tuple(ruler.candidate.label for ruler in self.rulers)

    def healthy(self, count: int, seed: int | None) -> Iterator[Array]:
        """Yield windows (M, N, l) of a healthy plant, `count` in all."""
        rng = np.random.default_rng(seed)
        size = max(1, min(count, BATCH // (self.window * self.outputs)))
        for start in range(0, count, size):
            yield rng.standard_normal((min(size, count - start), self.window, self.outputs))

    def statistics(self, windows: Array) -> Array:
        """Return the largest statistic of every candidate over the onsets, (M, C), of windows (M, N, l)."""
        return np.stack([np.sum(ruler.scores(windows) ** 2, axis=2).max(axis=1) for ruler in self.rulers], axis=1)

    def thresholds(self, false_alarm: float, draws: int, seed: int | None) -> Array:
        """Return the thresholds (C,) at which a healthy window alarms with the probability asked for.

        Args:
            false_alarm: probability that any candidate exceeds its threshold at any onset.
            draws: simulated healthy windows.
            seed: of the simulation.

        Raises:
            DataError: too few draws for so rare an alarm: 50 of them must exceed.
        """
        check_probability(false_alarm, "false_alarm")
        if false_alarm * draws < 50:
            raise DataError(
                f"{draws} simulated windows cannot support a false alarm in {1 / false_alarm:.3g}: use at least "
                f"{int(np.ceil(50 / false_alarm))} draws, or a higher probability."
            )
        return family_thresholds(np.vstack([self.statistics(part) for part in self.healthy(draws, seed)]), false_alarm)


def family_thresholds(statistics: Array, false_alarm: float) -> Array:
    """Return the quantiles (C,) at one level such that a share `false_alarm` of the rows exceeds any of them.

    Args:
        statistics: (M, C) of healthy windows.
        false_alarm: that share.
    """
    count = len(statistics)
    # a row's rank is how rare its rarest statistic is; the rows with the best ranks are the alarms
    above = count - np.argsort(np.argsort(statistics, axis=0, kind="stable"), axis=0, kind="stable")
    level = np.sort(above.min(axis=1))[max(int(np.floor(false_alarm * count)) - 1, 0)] / count
    return np.quantile(statistics, 1 - level, axis=0)


def signature_space(
    found: Dictionary, window: int, onset: int | None = None, u: ArrayLike | None = None
) -> SignatureSpace:
    """Return the signatures of a dictionary over a window.

    Args:
        found: the dictionary.
        window: samples N.
        onset: the only onset that is searched; None for all.
        u: (N, m) inputs over the window, for losses and stuck actuators; without it these are skipped.

    Raises:
        DataError: an input of another length.
        StructureError: a window that is too short, an onset outside it, no candidate with a signature.
    """
    least = 2 * found.model.nx + 2
    if window < least:
        raise StructureError(f"window={window}: at least {least} samples are needed for {found.model.nx} states.")
    if onset is not None and not 0 <= onset < window:
        raise StructureError(f"onset={onset} lies outside the window of {window} samples.")
    inputs = None if u is None else samples_of(u, "u", found.model.m)
    if inputs is not None and (len(inputs) != window or not np.isfinite(inputs).all()):
        raise DataError(f"u has {len(inputs)} samples: {window}, none missing, are needed, those of the window.")
    able = [c for c in found.candidates if c.additive or (c.columns and inputs is not None)]
    if not able:
        raise StructureError(
            "No candidate has a signature that is known without data: add the kind 'bias', 'drift' or a state jump, or "
            "pass the input u of a window for losses and stuck actuators."
        )
    rulers = [
        _ruler(found, c, window, onset) if c.additive else _input_ruler(found, c, window, onset, inputs) for c in able
    ]
    skipped = [c.label for c in found.candidates if c not in able]
    return SignatureSpace(tuple(rulers), window, found.model.l, tuple(skipped))


def _ruler(found: Dictionary, candidate: Candidate, window: int, onset: int | None) -> Ruler:
    trace = response(found.predictor, candidate, window)
    onsets = _onsets(found, trace.shape[2], window, onset)
    grams = np.cumsum(np.einsum("kop,koq->kpq", trace, trace), axis=0)[window - onsets - 1]
    spectrum = np.conj(np.fft.rfft(trace, 2 * window, axis=0))
    return Ruler(candidate, trace, onsets, _inverse_roots(grams), spectrum)


def _input_ruler(
    found: Dictionary, candidate: Candidate, window: int, onset: int | None, u: Array | None
) -> InputRuler:
    bank = np.stack([found.signature(candidate, window, k, u=u) for k in range(window)])
    onsets = _onsets(found, bank.shape[3], window, onset)
    grams = np.einsum("tkop,tkoq->tpq", bank[onsets], bank[onsets])
    return InputRuler(candidate, onsets, bank, _inverse_roots(grams))


def _onsets(found: Dictionary, dimension: int, window: int, onset: int | None) -> np.ndarray:
    """Onsets that leave enough readings for the magnitudes."""
    needed = -(-dimension // found.model.l)
    return np.arange(window - needed + 1) if onset is None else np.array([onset])


def _inverse_roots(grams: Array) -> Array:
    values, axes = np.linalg.eigh(grams)
    there = values > SHARE * np.maximum(values[:, -1:], 1e-300)
    inverse = np.where(there, 1 / np.sqrt(np.where(there, values, 1.0)), 0.0)
    return np.asarray(inverse[:, :, None] * np.swapaxes(axes, 1, 2))
