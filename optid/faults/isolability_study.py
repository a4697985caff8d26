"""Smallest detectable and isolable sizes of faults, without any data.

They are simulated in signature space: the whitened innovations of a window are white noise plus the signature of the
fault, and the search over all candidates and onsets is run on many such windows. The formula for two candidates at a
known onset is optimistic, because the onset is searched, too.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from optid.arrays import Array, check_integer
from optid.errors import DataError, LookupFailed, StructureError, nearest
from optid.faults.false_alarms import check_draws, family_thresholds
from optid.faults.search.sweeps import Sweep, sweep
from optid.faults.signatures import Dictionary
from optid.registry import Rendered

GRID = np.concatenate([[0.0], np.geomspace(0.5, 600.0, 72)])  # deflections at which the probabilities are computed

NUMBERS = 200_000_000
"""Numbers in the simulated windows of one fault above which a study is refused, because of the memory."""

MIDDLE = 0.3, 0.7  # range of a random onset, as shares of the window


class Forecast(NamedTuple):
    """Probabilities of detection and isolation of a fault of a given size."""

    detected: float  # probability of an alarm
    isolated: float  # probability of an alarm with the right candidate


@dataclass(frozen=True, eq=False, repr=False)
class Isolability(Rendered):
    """Smallest detectable and isolable size of every fault; `print` it, or `plot` it.

    Attributes:
        labels: the C candidates.
        window: samples of a window.
        onset: "unknown", or the onset that is known.
        prob: required probability.
        false_alarm: probability of an alarm in a healthy window.
        detectable: (C,) smallest size detected with that probability; inf where none is. For a fault with several
            magnitudes the median norm over its directions.
        isolable: (C,) smallest size detected and isolated.
        matrix: (C, C) smallest size at which fault i is detected and preferred to j; on the diagonal: detected.
        sines: (C, C) sine of the smallest angle between the signature of i in mid-window and that of j at any onset.
        unit: (C,) deflection of a size of one in mid-window.
        rivals: the candidate with most of the wrong answers at the isolable size, "" where there are none.
        bounded: (C,) whether the signature decays, so that a longer window does not help.
        excluded: {label: why} of faults that affect no output.
        skipped: labels of the candidates whose signature needs data.
        thresholds: (C,) of the statistics.
        detected: (C, G) probability of an alarm at the deflections of `GRID`.
        isolated: (C, G) probability of an alarm with the right candidate.
        draws: simulated windows per fault.
    """

    labels: tuple[str, ...]
    window: int
    onset: int | str
    prob: float
    false_alarm: float
    detectable: Array
    isolable: Array
    matrix: Array
    sines: Array
    unit: Array
    rivals: tuple[str, ...]
    bounded: np.ndarray
    excluded: dict[str, str]
    skipped: tuple[str, ...]
    thresholds: Array
    detected: Array = field(repr=False)
    isolated: Array = field(repr=False)
    draws: int = 0

    def deflection(self, label: str, size: float) -> float:
        """Return the deflection of a fault of this size in mid-window: norm of its whitened signature."""
        return float(abs(size) * self.unit[self._index(label)])

    def forecast(self, label: str, size: float) -> Forecast:
        """Return the probabilities of detection and isolation of a fault of a given size.

        Raises:
            LookupFailed: no such candidate.
        """
        c, d = self._index(label), self.deflection(label, size)
        curves = (_probits(curve[c], self.draws) for curve in (self.detected, self.isolated))
        return Forecast(*(float(ndtr(np.interp(d, GRID, curve))) for curve in curves))

    def _index(self, label: str) -> int:
        if label not in self.labels:
            raise LookupFailed(f"{label!r} is not among the candidates. {nearest(label, self.labels)}")
        return self.labels.index(label)

    @property
    def ambiguity_groups(self) -> list[tuple[str, ...]]:
        """Faults that no record isolates from each other."""
        return [tuple(label.split(" | ")) for label in self.labels if " | " in label]


def isolability(found: Dictionary, window: int = 100, *, onset: int | str = "unknown", prob: float = 0.95,
                false_alarm: float = 0.01, draws: int = 1000, calibration: int = 20_000, seed: int | None = 0,
                u: ArrayLike | None = None) -> Isolability:
    """Return the smallest detectable and isolable size of every fault, by simulating the search for it at all sizes.

    Args:
        found: the dictionary.
        window: samples of a window.
        onset: "unknown" (drawn from the middle of the window and searched everywhere), or the known sample.
        prob: required probability of detection, and of isolation.
        false_alarm: probability of an alarm in a healthy window, over all candidates and onsets.
        draws: simulated windows per fault.
        calibration: simulated healthy windows for the thresholds.
        seed: of the simulation.
        u: (N, m) a typical input over the window, for losses and stuck actuators.

    Raises:
        DataError: too few calibration windows for the false-alarm rate, an input of another length or without
            excitation of a candidate.
        StructureError: a window that is too short or too long, impossible probabilities or numbers of draws, no
            candidate with a signature.
    """
    for word, value in (("draws", draws), ("calibration", calibration)):
        check_integer(value, word)
    check_integer(seed, "seed", 0, 2**63)
    if window * found.model.l * draws > NUMBERS:
        raise StructureError(f"window={window}: {draws} simulated windows of this length do not fit in memory: use at "
                             f"most {NUMBERS // (found.model.l * draws)} samples, or fewer draws.")
    if not 0.5 <= prob < 1:
        raise StructureError(f"prob={prob!r}; it must be a probability from 0.5 to below 1.")
    if isinstance(onset, str) and onset != "unknown":
        raise StructureError(f"onset={onset!r}: use 'unknown' or the number of a sample.")
    check_draws(false_alarm, calibration)
    known = None if isinstance(onset, str) else int(onset)
    if known is not None and not 0 <= known < window:
        raise StructureError(f"onset={known} lies outside the window of {window} samples.")
    space = sweep(found, window, u)
    if known is not None:
        space = replace(space, tested=(space.tables.sizes > 0)[:, None] & (np.arange(window) == known))
    named = np.flatnonzero(space.tables.sizes)
    candidates = [found.candidates[c] for c in named]
    first, second = np.random.SeedSequence(seed).generate_state(2)
    windows = space.simulated(calibration, np.random.default_rng(int(first)))
    energies = np.vstack([space.largest(part) for part in windows])[:, named]
    thresholds = family_thresholds(np.nan_to_num(energies), false_alarm)
    rng = np.random.default_rng(int(second))
    healthy = np.concatenate(list(space.simulated(draws, np.random.default_rng(int(second) + 1))))
    noise = _scores(space, healthy)
    curves = [_curves(space, place, noise, thresholds, known, rng) for place in range(named.size)]
    detected, isolated, preferred, accused, unit = map(np.array, zip(*curves))
    matrix = np.array([[_crossing(p, prob, draws) for p in row] for row in preferred]) / unit[:, None]
    isolable = np.array([_crossing(p, prob, draws) for p in isolated])
    detectable = np.array([_crossing(p, prob, draws) for p in detected])
    whole = np.array([c.fault_kind.largest for c in candidates])  # largest possible size
    sizes = [np.where(d / unit > whole, np.inf, d / unit) for d in (detectable, isolable)]
    labels = tuple(c.label for c in candidates)
    rivals = []
    for shares, at in zip(accused, isolable):  # at the isolable deflection or the one before it
        wrong = shares[:, max(int(np.searchsorted(GRID, at)) - 1, 0)].copy()
        wrong[int(np.argmax(shares[:, -1]))] = 0.0
        rivals.append(labels[int(np.argmax(wrong))] if wrong.max() > 0 else "")
    return Isolability(
        labels=labels, window=window, onset=onset, prob=prob, false_alarm=false_alarm, detectable=sizes[0],
        isolable=sizes[1], matrix=np.where(matrix > whole[:, None], np.inf, matrix),
        sines=np.array([_sines(space, int(c), known) for c in named]), unit=unit,
        rivals=tuple(rivals),
        bounded=np.array([c.bounded_deflection for c in candidates]), excluded=dict(found.excluded),
        skipped=tuple(c.label for c in found.candidates if c not in candidates), thresholds=thresholds,
        detected=detected, isolated=isolated, draws=draws,
    )


def _scores(space: Sweep, windows: Array) -> list[Array]:
    """Coordinates (M, T, d) of windows along every candidate at the onsets that are searched."""
    found = np.stack([space.correlations(window) for window in windows])
    return [space.coordinates(found, int(c))[:, space.tested[c]] for c in np.flatnonzero(space.tables.sizes)]


def _curves(space: Sweep, place: int, noise: list[Array], thresholds: Array, known: int | None,
            rng: np.random.Generator) -> tuple[Array, Array, Array, Array, float]:
    """Probabilities of one fault over the grid of deflections, and the deflection of a size of one.

    They are those of detection (G,), of isolation (G,), of detection and preference to each other candidate (C, G), in
    its own row of detection, and of an alarm for each candidate (C, G).
    """
    c, draws, window = int(np.flatnonzero(space.tables.sizes)[place]), len(noise[0]), space.window
    low, high = (int(share * window) for share in MIDDLE)
    onsets = np.full(draws, known) if known is not None else rng.integers(low, max(high, low + 1), draws)
    sizes, unit = _directions(space, c, known, draws, rng)
    faults = np.zeros((draws, window, space.found.model.l))
    for onset in np.unique(onsets):
        rows = onsets == onset
        faults[rows] = np.einsum("kop,mp->mko", space.signature(c, int(onset)), sizes[rows])
    # statistic at deflection d: |z + d s|^2 = |z|^2 + 2 d z's + d^2 |s|^2
    parts = [[np.sum(pair, axis=2) for pair in (z**2, z * s, s**2)] for z, s in zip(noise, _scores(space, faults))]
    count = len(noise)
    detected, isolated = np.zeros(GRID.size), np.zeros(GRID.size)
    preferred, accused = np.zeros((count, GRID.size)), np.zeros((count, GRID.size))
    for g, d in enumerate(GRID):
        excess = np.stack([(a + 2 * d * b + d**2 * e).max(axis=1) for a, b, e in parts], axis=1) - thresholds
        alarm, answer = excess.max(axis=1) > 0, excess.argmax(axis=1)
        detected[g], isolated[g] = np.mean(alarm), np.mean(alarm & (answer == place))
        own = excess[:, [place]]
        preferred[:, g] = np.mean((own > 0) & (own >= excess), axis=0)
        preferred[place, g] = detected[g]
        accused[:, g] = np.bincount(answer[alarm], minlength=count) / draws
    return detected, isolated, preferred, accused, unit


def _directions(space: Sweep, c: int, known: int | None, draws: int, rng: np.random.Generator) -> tuple[Array, float]:
    """Return sizes (M, d) of deflection one in mid-window, in random directions, and the deflection of a unit size."""
    onset = space.window // 2 if known is None else known
    trace = space.signature(c, onset)
    values, axes = np.linalg.eigh(np.einsum("kop,koq->pq", trace, trace))
    if not values[-1] > 0:
        raise DataError(f"{space.found.labels[c]}: untestable, the input does not excite it after sample {onset}. Use "
                        "a window in which it moves.")
    d = values.size
    if d == 1:
        unit = float(np.sqrt(values[0]))
        return np.full((draws, 1), 1 / unit), unit
    drawn = rng.standard_normal((draws, d))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    sizes = drawn / np.sqrt(np.maximum(values, 1e-9 * values[-1])) @ axes.T
    return sizes, 1 / float(np.median(np.linalg.norm(sizes, axis=1)))


def _probits(probabilities: Array, draws: int) -> Array:
    """Quantiles of the normal law, in which these curves are nearly straight lines."""
    return np.asarray(ndtri(np.clip(probabilities, 0.5 / draws, 1 - 0.5 / draws)))


def _crossing(probabilities: Array, prob: float, draws: int) -> float:
    """Deflection from which on the probability is at least prob; inf where there is none."""
    below = np.flatnonzero(probabilities < prob)
    last = int(below[-1]) if below.size else 0
    if not below.size or last + 1 >= GRID.size:
        return float("inf") if below.size else 0.0
    first, second = _probits(probabilities[last : last + 2], draws)
    rise = (float(ndtri(prob)) - first) / (second - first)
    return float(GRID[last] + min(max(rise, 0.0), 1.0) * (GRID[last + 1] - GRID[last]))


def _sines(space: Sweep, c: int, known: int | None) -> Array:
    """Smallest sine (C,) between the signature in mid-window and the others at any onset."""
    trace = space.signature(c, space.window // 2 if known is None else known)
    axes = np.linalg.svd(trace.reshape(-1, trace.shape[2]), full_matrices=False)[0]
    own = axes.T.reshape(-1, *trace.shape[:2])
    cosines = [np.linalg.svd(other.swapaxes(0, 1), compute_uv=False)[:, 0].max() for other in _scores(space, own)]
    return np.sqrt(np.maximum(0.0, 1 - np.minimum(cosines, 1.0) ** 2))
