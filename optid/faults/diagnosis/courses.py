"""Explanations without a signature: a sensor that stands still, noise that has grown.

A frozen sensor adds to its reading whatever makes it constant. Impulses of that sensor at all samples from the onset
on span what that can be, so that one orthogonal factorisation, from the last sample backwards, has the energy explained
for every onset. As many magnitudes are paid for by the marginal likelihood. The readings themselves must stand still
within the noise of the sensor.

More noise of variance rho at a place adds rho H H' to the covariance of the innovations. Its likelihood is averaged
over rho on a logarithmic scale.
"""

import numpy as np

from optid.arrays import Array
from optid.data.record import Experiment
from optid.faults.consistency.noise_changes import noise_search
from optid.faults.consistency.waveforms import waveform_matrix
from optid.faults.diagnosis.posterior import NEGLIGIBLE, Explained, Explanation, marginal
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened

LONGEST = 3000
"""Readings of a record above which these candidates are not tested."""

STILL = 1.5
"""Standard deviations of the sensor noise within which a frozen reading stays."""

SHORTEST = 5
"""Samples that must stand still."""

VARIANCES = np.geomspace(1e-2, 1e4, 61)
"""Variances of an added noise, over the inverse mean eigenvalue of H H'."""

ONSETS = 12
"""Onsets of an added noise that are tried over the record, and again around the best of them."""


def without_signature(found: Dictionary) -> tuple[list[Candidate], list[Candidate]]:
    """Return the frozen sensors and the noises of a dictionary."""
    frozen = [c for c in found.candidates if c.kind == "frozen"]
    return frozen if found.model.l > 1 else [], [c for c in found.candidates if c.kind == "noise"]


def courses(found: Dictionary, white: Whitened, part: Experiment) -> list[Explanation]:
    """Return the frozen sensors and the noises of a dictionary that may explain a window, and the record behind it."""
    if white.r.size > LONGEST:
        return []
    frozen, noises = without_signature(found)
    explanations = [_frozen(found, candidate, white, part) for candidate in frozen]
    if noises:
        explanations += _noises(found, noises, white)
    return [explanation for explanation in explanations if explanation is not None]


def _frozen(found: Dictionary, candidate: Candidate, white: Whitened, part: Experiment) -> Explanation | None:
    o = int(np.flatnonzero(candidate.into_output[:, 0])[0])
    count, r = len(white.r), white.r.ravel()
    readings, there = part.y[:, o], white.present[:, o].astype(bool)
    noise = found.model.noise
    assert noise is not None
    still = _still(readings, there, STILL * float(np.sqrt(max(noise.R[o, o], 1e-300))))
    if not still.any():
        return None
    shown = np.flatnonzero(there)[::-1]  # the latest first
    axes, triangle = np.linalg.qr(waveform_matrix(found, candidate, white)[:, shown])
    seen_there = np.abs(np.diag(triangle)) > 1e-10 * np.abs(np.diag(triangle)).max()
    along = np.where(seen_there, axes.T @ r, 0.0)
    order = np.searchsorted(-shown, -np.arange(count), side="right")  # columns that an onset at k has
    energies = np.concatenate([[0.0], np.cumsum(along**2)])[order]
    dimensions = np.concatenate([[0], np.cumsum(seen_there)])[order]
    logs = np.where(still, marginal(energies, dimensions), -np.inf) - np.log(count)
    kept = np.flatnonzero(logs > logs.max() - NEGLIGIBLE)
    values = [readings[int(k) :][there[int(k) :]] for k in kept]
    sizes = np.array([[float(np.mean(v))] for v in values])
    covariances = np.array([[[float(np.var(v, ddof=1)) / v.size]] for v in values])

    def rest(onset: int) -> Explained:
        columns = order[onset]
        fitted = (axes[:, :columns] @ along[:columns]).reshape(white.r.shape)
        return Explained(fitted, white.r - fitted, int(dimensions[onset]))

    return Explanation((candidate,), kept[:, None], logs[kept], sizes, covariances, energies[kept], course=rest)


def _still(readings: Array, there: np.ndarray, limit: float) -> np.ndarray:
    """Whether (N,) the readings from a sample on stay within so many units of their mean (standard deviation)."""
    values = np.where(there, readings - np.nanmean(readings), 0.0)
    counts = np.cumsum(there[::-1])[::-1]
    sums, squares = (np.cumsum(part[::-1])[::-1] for part in (values, values**2))
    spread = squares / np.maximum(counts, 1) - (sums / np.maximum(counts, 1)) ** 2
    return (counts >= SHORTEST) & (np.sqrt(np.maximum(spread, 0.0)) <= limit)


def _noises(found: Dictionary, noises: list[Candidate], white: Whitened) -> list[Explanation]:
    """Added noise at every place, over a grid of onsets."""
    from scipy.special import logsumexp

    count = len(white.r)
    last = int(np.flatnonzero(white.present.any(axis=1))[-1])  # later readings are taken out or missing
    onsets = np.unique(np.linspace(0, max(last + 1 - 2 * SHORTEST, 0), ONSETS).astype(int))
    rows: dict[str, list[tuple[float, ...]]] = {}
    prepared = {}

    def attempt(onset: int) -> None:
        search = noise_search(found, white, onset=onset, free_start=False)
        for place in search.places:
            z2 = ((place.axes.T @ white.r.ravel()) ** 2)[None]
            grid = VARIANCES / float(np.mean(place.s))
            values = place.likelihood(grid, z2)[0]
            total = float(np.asarray(logsumexp(values))) - np.log(grid.size)
            weights = np.exp(values - values.max())
            weights /= weights.sum()
            mean = float(weights @ np.sqrt(grid))
            spread = float(weights @ (np.sqrt(grid) - mean) ** 2)
            rows.setdefault(place.label, []).append((onset, total, mean, spread, float(values.max())))
            prepared[place.label, onset] = place, float(grid[values.argmax()])

    for onset in onsets.tolist():
        attempt(onset)
    labels = {c.label for c in noises} & set(rows)
    if not labels:
        return []
    best = max((row for label in labels for row in rows[label]), key=lambda row: row[1])[0]
    at = int(np.searchsorted(onsets, best))
    around = np.linspace(onsets[max(at - 1, 0)], onsets[min(at + 1, onsets.size - 1)], ONSETS + 1).astype(int)
    for onset in sorted(set(around.tolist()) - set(onsets.tolist())):
        attempt(onset)
    explanations = []
    for candidate in noises:
        found_here = rows.get(candidate.label)
        if not found_here:
            continue
        k, logs, means, spreads, highest = (np.array(column) for column in zip(*found_here))
        every = np.arange(count)  # an onset that was not tried counts as the nearest that was
        near = np.argmin(np.abs(every[:, None] - k), axis=1)
        logs = logs[near] - np.log(count)
        logs[k.astype(int)] += 1e-9  # of equals the one that was tried is reported

        def rest(onset: int, label: str = candidate.label, tried: np.ndarray = k, of: np.ndarray = near) -> Explained:
            place, rho = prepared[label, int(tried[of[onset]])]
            along = place.axes.T @ white.r.ravel()
            shrunk = place.axes @ ((1 - 1 / np.sqrt(1 + rho * place.s)) * along)
            return Explained(np.zeros_like(white.r), white.r - shrunk.reshape(white.r.shape), 1)

        explanations.append(Explanation(
            (candidate,), every[:, None], logs, means[near][:, None], spreads[near][:, None, None], 2 * highest[near],
            course=rest,
        ).likely())
    return explanations
