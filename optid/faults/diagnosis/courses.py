"""Explanations without a signature: frozen sensors and increased noise.

The additions of a frozen sensor are spanned by impulses of that sensor at all samples from the onset on, so that one
orthogonal factorisation, from the last sample backwards, gives the energy explained for every onset. The marginal
likelihood penalises as many magnitudes. The readings must be constant within the noise of the sensor.

Additional noise of variance rho at a place adds rho H H' to the covariance of the innovations. Its likelihood is
averaged over rho on a logarithmic scale.
"""

import numpy as np

from optid.data.record import Experiment
from optid.faults.consistency.noise_changes import noise_search
from optid.faults.consistency.waveforms import waveform_matrix
from optid.faults.diagnosis.posterior import NEGLIGIBLE, Explained, Explanation, marginal
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened

LONGEST = 3000  # number of readings above which these candidates are not tested
STILL = 1.5  # largest deviation of a frozen reading, in standard deviations of the sensor noise
SHORTEST = 5  # least number of constant samples
VARIANCES = np.geomspace(1e-2, 1e4, 61)  # variances of an added noise, relative to the inverse mean eigenvalue of H H'
ONSETS = 12  # onsets of an added noise tried over the record, and again around the best of them


def without_signature(found: Dictionary) -> tuple[list[Candidate], list[Candidate]]:
    """Return the frozen sensors and the noises of a dictionary."""
    frozen = [c for c in found.candidates if c.fault_kind.waveform]
    return frozen if found.model.l > 1 else [], [c for c in found.candidates if c.fault_kind.noise]


def courses(found: Dictionary, white: Whitened, part: Experiment) -> list[Explanation]:
    """Return the explanations of a window by frozen sensors and by noise."""
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
    values = np.where(there, readings - np.nanmean(readings), 0.0)
    counts, sums, squares = (np.cumsum(part[::-1])[::-1] for part in (there, values, values**2))
    spread = squares / np.maximum(counts, 1) - (sums / np.maximum(counts, 1)) ** 2  # of the readings from a sample on
    still = (counts >= SHORTEST) & (spread <= STILL**2 * max(noise.R[o, o], 1e-300))
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
    tails = [readings[int(k) :][there[int(k) :]] for k in kept]
    sizes = np.array([[float(np.mean(v))] for v in tails])
    covariances = np.array([[[float(np.var(v, ddof=1)) / v.size]] for v in tails])

    def rest(onset: int) -> Explained:
        columns = order[onset]
        fitted = (axes[:, :columns] @ along[:columns]).reshape(white.r.shape)
        return Explained(fitted, white.r - fitted, int(dimensions[onset]))

    return Explanation((candidate,), kept[:, None], logs[kept], sizes, covariances, energies[kept], course=rest)


def _noises(found: Dictionary, noises: list[Candidate], white: Whitened) -> list[Explanation]:
    """Added noise at every place, over a grid of onsets."""
    from scipy.special import logsumexp

    count = len(white.r)
    last = int(np.flatnonzero(white.present.any(axis=1))[-1])  # later readings are missing
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
        logs[k.astype(int)] += 1e-9  # so that an onset that was tried is reported

        def rest(onset: int, label: str = candidate.label, tried: np.ndarray = k, of: np.ndarray = near) -> Explained:
            place, rho = prepared[label, int(tried[of[onset]])]
            along = place.axes.T @ white.r.ravel()
            shrunk = place.axes @ ((1 - 1 / np.sqrt(1 + rho * place.s)) * along)
            return Explained(np.zeros_like(white.r), white.r - shrunk.reshape(white.r.shape), 1)

        explanations.append(Explanation(
            (candidate,), every[:, None], logs, means[near][:, None], spreads[near][:, None, None], 2 * highest[near],
            course=rest,
        ).without_negligible_onsets())
    return explanations
