"""The exact search for one fault (GLR): every candidate at every onset, the best magnitude by least squares.

Its thresholds are those of simulated healthy windows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataError, LookupFailed, StructureError, nearest
from optid.faults.false_alarms import Thresholds, check_draws, family_thresholds
from optid.faults.search.sweeps import Sweep, sweep
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened, check_window
from optid.models.experiments import samples_of
from optid.phrases import short

ALIKE = 2e-6  # one less the squared cosine of two signatures below which they are indistinguishable
STRETCHES = 100  # number of sections drawn from a longer input


class Magnitude(NamedTuple):
    """The magnitudes of a fault by least squares."""

    nu: Array  # (d,) magnitudes; zero along directions without effect
    covariance: Array  # (d, d) for this candidate and onset, without the search for the onset


@dataclass(frozen=True, eq=False)
class Scan:
    """The energy that every candidate explains of a window, at every onset; `scan` makes it.

    Attributes:
        dictionary: the candidates.
        whitened: the window.
        u: (N, m) inputs, None where they were not given.
        statistic: (C, N) energy explained, NaN where a candidate is not tested: it has no signature (frozen sensor,
            noise, a loss without u), it has no effect, or too few readings follow the onset.
        sweep: the prepared search.
        correlations: (N, D) of the window with the columns of the signatures.
    """

    dictionary: Dictionary
    whitened: Whitened
    u: Array | None
    statistic: Array
    sweep: Sweep = field(repr=False)
    correlations: Array = field(repr=False)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the candidates."""
        return self.dictionary.labels

    @property
    def tested(self) -> np.ndarray:
        """(C, N) whether a candidate is tested at an onset."""
        return np.asarray(~np.isnan(self.statistic))

    @property
    def tested_anywhere(self) -> np.ndarray:
        """(C,) whether a candidate is tested at some onset."""
        return np.asarray(self.tested.any(axis=1))

    @property
    def energy(self) -> float:
        """Energy of the window; its expected value for a healthy plant is the number of readings."""
        return float(np.sum(self.whitened.r**2))

    def index(self, candidate: Candidate | str) -> int:
        """Return the row of a candidate; `LookupFailed`: no such candidate."""
        c = self.dictionary[candidate] if isinstance(candidate, str) else candidate
        if here := [i for i, other in enumerate(self.dictionary.candidates) if other is c]:
            return here[0]
        raise LookupFailed(f"{c.label!r} is not in the dictionary. {nearest(c.label, self.labels)}")

    def peak(self, candidate: Candidate | str) -> int:
        """Return the onset at which a candidate explains most; `StructureError`: a candidate that is tested nowhere."""
        c = self.index(candidate)
        if np.isnan(self.statistic[c]).all():
            raise StructureError(f"{self.labels[c]} is tested at no onset of this window: it has no peak.")
        return int(np.nanargmax(self.statistic[c]))

    def estimate(self, candidate: Candidate | str, onset: int) -> Magnitude:
        """Return the magnitudes of a candidate at an onset; `StructureError`: an onset at which it is not tested."""
        c = self.index(candidate)
        if not 0 <= onset < self.statistic.shape[1] or np.isnan(self.statistic[c, onset]):
            raise StructureError(f"{self.labels[c]} is not tested at onset {onset} of this window.")
        root = self.sweep.roots_of(c)[onset]
        inverse = root.T @ root
        return Magnitude(inverse @ self.correlations[onset, self.sweep.columns(c)], inverse)

    def signature(self, candidate: Candidate | str, onset: int) -> Array:
        """Return the signature (N, l, d) of one unit of each magnitude in the window.

        Raises:
            StructureError: a candidate without a signature.
        """
        c, count = self.index(candidate), len(self.whitened.r)
        if not self.sweep.tables.sizes[c]:
            self.dictionary.additions(self.dictionary.candidates[c], count, 0, self.u)  # refuses with the reason
            raise StructureError(f"{self.labels[c]} has no signature in this window.")
        if not 0 <= onset < count:
            raise StructureError(f"onset={onset} lies outside the window of {count} samples.")
        return self.sweep.signature(c, onset)

    def again(self, r: Array) -> "Scan":
        """Return the search of other innovations (N, l) of the same window."""
        correlations = self.sweep.correlations(r)
        statistic = np.where(self.tested, self.sweep.statistic(correlations), np.nan)
        return replace(self, whitened=replace(self.whitened, r=r), statistic=statistic, correlations=correlations)

    def together(self, labels: Sequence[Candidate | str], onsets: Sequence[int]) -> Magnitude:
        """Return the magnitudes of several candidates, one after the other, and their covariance."""
        traces = [self.signature(label, onset) for label, onset in zip(labels, onsets)]
        flat = np.concatenate(traces, axis=2).reshape(self.whitened.r.size, -1)
        sizes = np.linalg.norm(flat, axis=0)
        sizes[sizes == 0] = 1.0
        inverse = np.linalg.pinv((flat / sizes).T @ (flat / sizes), rcond=ALIKE, hermitian=True)
        inverse /= np.outer(sizes, sizes)
        return Magnitude(inverse @ (flat.T @ self.whitened.r.ravel()), inverse)

    def gains(self, thresholds: Thresholds) -> Array:
        """Return the statistics less their thresholds, (C, N): the fault at the largest is the exact optimum.

        Raises:
            StructureError: thresholds of another dictionary.
        """
        return self.statistic - thresholds.of(self.labels)[:, None]

    def __str__(self) -> str:
        """Print the peak of every candidate."""
        lines = [f"window of {len(self.whitened.r)} samples, energy {self.energy:.1f}",
                 f"  {'candidate':<40}{'energy':>9}{'onset':>7}  magnitude"]
        for candidate, row in zip(self.dictionary.candidates, self.statistic):
            label = short(candidate.label, 39)
            if np.isnan(row).all():
                lines.append(f"  {label:<40}{'not tested':>16}")
                continue
            onset = self.peak(candidate)
            sizes = " ".join(f"{v:.3g}" for v in self.estimate(candidate, onset).nu)
            lines.append(f"  {label:<40}{row[onset]:>9.1f}{onset:>7}  {short(sizes, 20)}")
        return "\n".join(lines)


def scan(found: Dictionary, whitened: Whitened, u: ArrayLike | None = None, *, onsets: Any = None) -> Scan:
    """Search a window for one fault, exactly: all candidates, all onsets, the magnitudes by least squares.

    The sweep backwards in time is that of Willsky and Jones (1976) written for all candidates at once (F1).

    Args:
        found: the candidates.
        whitened: the window; one experiment.
        u: (N, m) inputs of the window in raw units, for losses, stuck actuators and scheduled changes.
        onsets: the onsets that are searched, nonnegative integers; all by default.

    Raises:
        DataError: inputs of another length or with a missing sample, innovations that are not finite.
        StructureError: several experiments at once, onsets outside the window, a window that is too short, no candidate
            with a signature.
    """
    check_window(found.model, whitened, "scan")
    prepared = sweep(found, whitened, u)
    correlations = prepared.correlations(whitened.r)
    statistic = prepared.statistic(correlations)
    if onsets is not None:
        count = len(whitened.r)
        chosen = np.atleast_1d(np.arange(count)[onsets] if isinstance(onsets, slice) else np.asarray(onsets))
        if not (np.issubdtype(chosen.dtype, np.integer) and chosen.size and 0 <= chosen.min() <= chosen.max() < count):
            raise StructureError(f"onsets: they must be integers from 0 to {count - 1}, at least one.")
        statistic[:, np.setdiff1d(np.arange(count), chosen)] = np.nan
    inputs = None if u is None else np.asarray(u, dtype=float).reshape(len(whitened.r), -1)
    return Scan(found, whitened, inputs, statistic, prepared, correlations)


def thresholds(found: Dictionary, window: int | Whitened, false_alarm: float = 0.01, *, u: ArrayLike | None = None,
               draws: int = 20_000, seed: int | None = 0) -> Thresholds:
    """Calibrate the search on simulated healthy windows.

    The thresholds are quantiles of the largest energy over the onsets, at one level for all candidates, such that the
    family of all candidates and onsets has the given false-alarm probability.

    Args:
        found: the candidates.
        window: number of samples N; or a window, whose missing readings and uncertain model are simulated, too.
        false_alarm: probability that a healthy window exceeds any threshold.
        u: inputs for losses and stuck actuators: those of the window (N, m), or a longer typical record of them, of
            which sections are drawn. Without it these candidates are not tested.
        draws: simulated windows.
        seed: of the simulation.

    Raises:
        DataError: too few draws for so rare an alarm, an input that is too short or has a missing sample.
        StructureError: a probability outside (0, 1), a window that is too short, no candidate with a signature.
    """
    check_draws(false_alarm, draws)
    count = len(window.r) if isinstance(window, Whitened) else int(window)
    rng, inputs = np.random.default_rng(seed), None if u is None else samples_of(u, "u", found.model.m)
    if inputs is None or len(inputs) == count:
        starts: np.ndarray = np.zeros(1, dtype=int)
    elif len(inputs) < count:
        raise DataError(f"u has {len(inputs)} samples; it must have at least those of the window, {count}.")
    else:
        starts = rng.integers(0, len(inputs) - count + 1, min(STRETCHES, draws))
    shares = np.diff(draws * np.arange(starts.size + 1) // starts.size)
    largest: list[Array] = []
    for start, share in zip(starts, shares):
        prepared = sweep(found, window, None if inputs is None else inputs[start : start + count])
        largest += [prepared.largest(windows) for windows in prepared.simulated(int(share), rng)]
    return Thresholds(found.labels, family_thresholds(np.vstack(largest), false_alarm), false_alarm, count, draws, seed)
