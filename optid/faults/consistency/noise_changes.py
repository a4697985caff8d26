"""Tests for increased noise: the exact likelihood of more white noise at one place, for every place (F8).

White noise of variance rho at a place adds rho H H' to the covariance of the whitened innovations, H being the
responses to impulses there at all samples of the window. With the eigenvalues s of H H' and the coordinates z of the
window along its eigenvectors the log-likelihood is a function of one number,

    l(rho) = -1/2 sum( log(1 + rho s_i) + z_i² / (1 + rho s_i) ),

which is maximised for every place; the largest gain is the estimate, and places within three nats of it are the set.
"""

from dataclasses import dataclass, field

import numpy as np

from optid.arrays import Array, check_probability
from optid.errors import DataError, LookupFailed, StructureError, nearest
from optid.faults.consistency.waveforms import LONGEST, RANK, by_place, start_matrix, waveform_matrix
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened, check_window
from optid.phrases import p_value

NATS = 3.0
"""Places whose log-likelihood is at most this much below the best are in the set."""

GRID = np.concatenate([[0.0], np.geomspace(1e-3, 1e6, 91)])
"""Variances of the first search of the likelihood, over the inverse mean eigenvalue."""

STEPS = 25

WIDE = 1.9207
"""Half the 95 % quantile of chi-square with one degree of freedom: decrease of the likelihood over an interval."""


@dataclass(frozen=True, eq=False)
class NoisePlace:
    """One place where noise may have increased, prepared for windows of one length."""

    label: str
    name: str  # of the place, as in `Fault`
    axes: Array  # (N l, q) eigenvectors of H H'
    s: Array  # (q,) its eigenvalues
    present: float  # variance of the noise that the model has there; zero where it has none

    def likelihood(self, rho: Array, z2: Array) -> Array:
        """Return l(rho) - l(0), (M, K) or (M,), for squared coordinates z2 (M, q).

        The variances rho are (K,), tried in all windows, or (M, 1), one for each.
        """
        grown = 1 + rho.reshape(-1, 1) * self.s
        energy = z2 @ (1 / grown - 1).T if rho.ndim == 1 else np.einsum("mq,mq->m", z2, 1 / grown - 1)
        return np.asarray(-0.5 * (np.sum(np.log(grown), axis=1) + energy))

    def maximise(self, windows: Array) -> tuple[Array, Array]:
        """Return the variance (M,) and the gain in log-likelihood (M,) of windows (M, N l)."""
        z2 = (windows @ self.axes) ** 2
        grid = GRID / float(np.mean(self.s))
        values = self.likelihood(grid, z2)
        at = values.argmax(axis=1)
        low, high = grid[np.maximum(at - 1, 0)], grid[np.minimum(at + 1, grid.size - 1)]
        ratio = (np.sqrt(5) - 1) / 2  # golden section between the neighbours on the grid
        for _ in range(STEPS):
            first, second = high - ratio * (high - low), low + ratio * (high - low)
            a, b = (self.likelihood(rho[:, None], z2) for rho in (first, second))
            high, low = np.where(a >= b, second, high), np.where(a >= b, low, first)
        rho = (low + high) / 2
        gain = self.likelihood(rho[:, None], z2)
        return np.where(gain > 0, rho, 0.0), np.maximum(gain, 0.0)

    def interval(self, window: Array, rho: float, gain: float) -> tuple[float, float]:
        """Return the 95 % profile interval of the variance, given the estimate and its gain."""
        from scipy.optimize import root_scalar

        z2 = (window[None] @ self.axes) ** 2

        def above(value: float) -> float:
            return float(self.likelihood(np.array([[value]]), z2)[0]) - gain + WIDE

        low = 0.0 if rho == 0 or above(0.0) >= 0 else float(root_scalar(above, bracket=(0.0, rho)).root)
        high = max(rho, 1e-3 / float(np.mean(self.s)))
        while above(high) > 0:
            high *= 2
        return low, float(root_scalar(above, bracket=(rho, high)).root) if above(rho) > 0 else high


@dataclass(frozen=True, eq=False)
class NoiseSearch:
    """All places where noise may have increased, prepared for windows of one length; `noise_search` makes it."""

    places: tuple[NoisePlace, ...]
    start: Array = field(repr=False)  # (N l, n') orthonormal responses to the initial state, projected out of windows
    count: int  # readings of a window

    def without_initial_state(self, windows: Array) -> Array:
        """Return windows (M, N l) without their responses to the initial state."""
        return windows - (windows @ self.start) @ self.start.T

    def gains(self, windows: Array) -> tuple[Array, Array]:
        """Return variances (M, C) and gains in log-likelihood (M, C) of windows (M, N l)."""
        clean = self.without_initial_state(windows)
        found = [place.maximise(clean) for place in self.places]
        return np.stack([rho for rho, _ in found], axis=1), np.stack([gain for _, gain in found], axis=1)

    def healthy(self, draws: int, seed: int | None) -> Array:
        """Return the largest gain (draws,) of simulated healthy windows, in order."""
        rng = np.random.default_rng(seed)
        size = max(1, 4_000_000 // len(self.start))
        parts = [self.gains(rng.standard_normal((min(size, draws - first), len(self.start))))[1].max(axis=1)
                 for first in range(0, draws, size)]
        return np.sort(np.concatenate(parts))


@dataclass(frozen=True, eq=False)
class NoiseChange:
    """More noise at one place."""

    label: str  # of the place and the noise
    name: str  # of the place, as in `Fault`
    variance: float  # of the added noise, in the units of the place
    interval: tuple[float, float]  # its 95 % interval by the likelihood ratio
    gain: float  # log-likelihood above that of a healthy plant
    scale: float  # factor of the standard deviation of the noise that was there; NaN where the model has none

    @property
    def std(self) -> float:
        """Standard deviation of the added noise."""
        return float(np.sqrt(self.variance))


@dataclass(frozen=True, eq=False)
class NoiseTest:
    """Every place, tested for more noise.

    Attributes:
        changes: the results, most probable first.
        p_value: probability of so large a gain when healthy, by simulation; NaN without one.
        false_alarm: probability of an alarm of a healthy plant.
        draws: simulated healthy windows.
        onset: sample from which the noise has increased.
    """

    changes: tuple[NoiseChange, ...]
    p_value: float
    false_alarm: float
    draws: int
    onset: int = 0

    @property
    def detected(self) -> bool:
        """Whether the noise has increased somewhere."""
        return self.p_value <= self.false_alarm

    @property
    def best(self) -> NoiseChange:
        """The most probable place."""
        return self.changes[0]

    @property
    def consistent(self) -> tuple[str, ...]:
        """Places within three nats of the best."""
        return tuple(change.label for change in self.changes if change.gain >= self.changes[0].gain - NATS)

    def __getitem__(self, name: str) -> NoiseChange:
        """Return the result of a place; `LookupFailed` where it was not tested."""
        for change in self.changes:
            if name in (change.label, change.name):
                return change
        raise LookupFailed(f"{name!r} was not tested. {nearest(name, [c.label for c in self.changes])}")

    def __str__(self) -> str:
        lines = [f"more noise from sample {self.onset} on: p-value {p_value(self.p_value, 3)} "
                 f"({self.draws} simulated windows)",
                 f"  {'place':<36}{'std added':>11}{'scale':>8}{'nats':>9}"]
        for change in self.changes:
            scale = "" if np.isnan(change.scale) else f"{change.scale:.2f}"
            mark = "  in the set" if change.label in self.consistent else ""
            lines.append(f"  {change.label[:35]:<36}{change.std:>11.3g}{scale:>8}{change.gain:>9.2f}{mark}")
        return "\n".join(lines)


def noise_search(found: Dictionary, whitened: Whitened, *, onset: int = 0, free_start: bool = True) -> NoiseSearch:
    """Prepare the test for windows like one: its length, missing readings and uncertain model.

    Args:
        found: the noise candidates; if there are none, one for each place in the dictionary.
        whitened: the window; one experiment.
        onset: sample from which the noise has increased.
        free_start: whether the initial state of the window is unknown (as when it was fitted to the window).

    Raises:
        DataError, StructureError: as `check_window`; noise in none of the places reaches a reading.
    """
    check_window(found.model, whitened, "The noise test", onset, LONGEST)
    from scipy.linalg import orth

    start = orth(start_matrix(whitened), rcond=1e-8) if free_start else np.zeros((whitened.r.size, 0))
    places = []
    for label, candidate in noise_places(found):
        matrix = waveform_matrix(found, candidate, whitened, onset)
        matrix = matrix - start @ (start.T @ matrix)
        axes, values, _ = np.linalg.svd(matrix, full_matrices=False)
        kept = values > RANK * max(float(values.max(initial=0.0)), 1e-300)
        if kept.any() and values[0] > 0:
            places.append(NoisePlace(label, " | ".join(candidate.places), axes[:, kept], values[kept] ** 2,
                                     _variance(found, candidate)))
    if not places:
        raise StructureError("Noise in none of the places reaches a reading of the window.")
    return NoiseSearch(tuple(places), start, int(whitened.present.sum()))


def noise_test(
    found: Dictionary, whitened: Whitened, *, onset: int = 0, false_alarm: float = 0.01, draws: int = 2000,
    search: NoiseSearch | None = None, healthy: Array | None = None,
) -> NoiseTest:
    """Test every place for more noise by the exact likelihood.

    Args:
        found: the candidates, as in `noise_search`.
        whitened: the window; one experiment.
        onset: sample from which the noise has increased.
        false_alarm: probability of an alarm of a healthy plant.
        draws: simulated healthy windows behind the p-value.
        search: from `noise_search` for a window like this one; by default for an unknown initial state.
        healthy: from its `healthy`, instead of a simulation from the seed 0.

    Raises:
        DataError: innovations that are not finite, or too few draws for so rare an alarm.
        StructureError: as `noise_search`.
    """
    check_probability(false_alarm, "false_alarm")
    if false_alarm * (draws if healthy is None else healthy.size) < 10:
        raise DataError(
            f"{draws} simulated windows cannot support a false alarm in {1 / false_alarm:.3g}: use at least "
            f"{int(np.ceil(10 / false_alarm))}, or a higher probability.")
    check_window(found.model, whitened, "The noise test", onset, LONGEST)
    prepared = noise_search(found, whitened, onset=onset) if search is None else search
    levels = prepared.healthy(draws, 0) if healthy is None else healthy
    window = whitened.r.reshape(1, -1)
    rho, gains = prepared.gains(window)
    clean = prepared.without_initial_state(window)[0]
    changes = [
        NoiseChange(place.label, place.name, float(variance), place.interval(clean, float(variance), float(gain)),
                    float(gain), float(np.sqrt(1 + variance / place.present)) if place.present > 0 else float("nan"))
        for place, variance, gain in zip(prepared.places, rho[0], gains[0])]
    changes.sort(key=lambda change: -change.gain)
    above = levels.size - int(np.searchsorted(levels, gains.max(), side="left"))
    return NoiseTest(tuple(changes), (1 + above) / (1 + levels.size), false_alarm, levels.size, onset)


def noise_places(found: Dictionary) -> list[tuple[str, Candidate]]:
    """Return the label and the candidate of every place where noise may increase."""
    named = [c for c in found.candidates if c.fault_kind.noise]
    places = by_place(named or [c for c in found.candidates if not c.name.startswith("state")])
    chosen = [candidates[0] for candidates in places.values()]
    return [(c.label if c.fault_kind.noise else " | ".join(f"{place} noise" for place in c.places), c) for c in chosen]


def _variance(found: Dictionary, candidate: Candidate) -> float:
    """Variance of the noise of the model at a place, mean over its directions; zero where it has none there."""
    noise = found.model.noise
    assert noise is not None
    state, output = np.any(candidate.into_state), np.any(candidate.into_output)
    if state and output:
        return 0.0  # an actuator: no noise of the model enters like it
    where, present = (candidate.into_state, noise.Q) if state else (candidate.into_output, noise.R)
    along = np.linalg.pinv(where)
    return max(float(np.trace(along @ present @ along.T)) / where.shape[1], 0.0)
