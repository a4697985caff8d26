"""A sensor that lost a share of its reading, (1.11): y = (1 - gamma) times the true output, with the same noise.

The loss is another row of C (of D and of the offset) from the onset on, so that the exact likelihood is that of a
Kalman filter with this row, started from the state of the healthy one at the onset. It is computed for many shares and
onsets at once, over a grid that is refined about the most probable onset and, once this is known to the sample, about
the share. A dead sensor, gamma = 1, reads its noise and is the end of the range.
"""

from dataclasses import replace

import numpy as np

from optid.arrays import Array
from optid.data.record import Experiment
from optid.errors import StructureError
from optid.faults.diagnosis.posterior import Explained, Explanation
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Predictor, Whitened, predictor

SHARES, ONSETS = 17, 15
"""Shares and onsets of a grid."""

ROUNDS = 20
"""Largest number of grids, each about the best point of the one before."""

CLOSER = 0.35
"""Range of a grid, as a share of that of the one before."""

FINE = 0.6
"""Largest distance of the shares of the last grid, in standard deviations."""

LEAST = 5
"""Samples that must follow the onset."""


def sensor_gains(found: Dictionary, white: Whitened, part: Experiment) -> list[Explanation]:
    """Return the explanations of a window by sensors of a dictionary that lost a share of their reading."""
    if white.states is None or found.model.feedback or np.any(found.model.L):
        return []
    candidates = [c for c in found.candidates if c.kind == "loss" and not c.columns]
    judged = [_judged(found, candidate, white, part) for candidate in candidates]
    return [explanation for explanation in judged if explanation is not None]


def _judged(found: Dictionary, candidate: Candidate, white: Whitened, part: Experiment) -> Explanation | None:
    o = int(np.flatnonzero(candidate.into_output[:, 0])[0])
    there = np.flatnonzero(white.present[:, o])
    last = int(there[-LEAST]) if len(there) >= 2 * LEAST else 0
    if last < 1:
        return None
    onsets: np.ndarray = np.unique(np.linspace(0, last, ONSETS).astype(int))
    shares = np.linspace(0.0, 1.0, SHARES + 1)[1:]
    wide, high = float(last), 1.0
    for _ in range(ROUNDS):
        tried, gammas = onsets, shares
        try:
            logs = likelihoods(found, o, white, part, tried, gammas)
        except StructureError:  # without this sensor some mode is not observable
            return None
        k, g = np.unravel_index(int(np.argmax(logs)), logs.shape)
        weights = np.exp(logs[k] - logs[k, g])
        weights /= weights.sum()
        std = float(np.sqrt(max(weights @ shares**2 - (weights @ shares) ** 2, 0.0)))
        if np.max(np.diff(onsets), initial=1) > 1:  # at a wrong onset another share is the best one
            wide *= CLOSER
            reach = max(int(wide / 2), ONSETS // 2)
            near = np.linspace(max(onsets[k] - reach, 0), min(onsets[k] + reach, last), ONSETS)
            onsets = np.unique(near.astype(int))
        elif shares[1] - shares[0] < FINE * std:
            break
        else:
            high *= CLOSER
            middle = float(np.clip(shares[g], high / 2, 1 - high / 2))
            shares = np.linspace(max(middle - high / 2, 1e-6), middle + high / 2, SHARES)
    most = logs.max(axis=1)
    weights = np.exp(logs - most[:, None])
    total = weights.sum(axis=1)
    mean = weights @ gammas / total
    variance = np.maximum(weights @ gammas**2 / total - mean**2, 1e-12)
    evidence = most + np.log(total * (gammas[1] - gammas[0])) - np.log(len(white.r))  # uniform over shares and onsets

    def rest(onset: int) -> Explained:
        left = _rests(found, o, white, part, np.array([onset]), mean[tried == onset])[0][0]
        return Explained(white.r - left, left, 1)

    return Explanation(
        (candidate,), tried[:, None], evidence, mean[:, None], variance[:, None, None], 2 * most, course=rest
    ).likely()


def likelihoods(
    found: Dictionary, o: int, white: Whitened, part: Experiment, onsets: np.ndarray, shares: Array
) -> Array:
    """Return the log-likelihood ratios (K, G) to the healthy plant of onsets (K,) and shares (G,) of output `o`."""
    rests, sizes = _rests(found, o, white, part, np.repeat(onsets, len(shares)), np.tile(shares, len(onsets)))
    logs = 0.5 * float(np.sum(white.r**2)) - 0.5 * np.einsum("jno,jno->j", rests, rests) - sizes
    return logs.reshape(len(onsets), len(shares))


def _rests(found: Dictionary, o: int, white: Whitened, part: Experiment, onsets: np.ndarray, shares: Array
           ) -> tuple[Array, Array]:
    """Whitened innovations (J, N, l) with a share lost from an onset on, and the logarithms (J,) of their scale."""
    model, steady, present = found.model, white.predictor, white.present
    different, which = np.unique(shares, return_inverse=True)
    scale = float(np.trace(steady.covariance) / np.trace(predictor(model).covariance))
    filters = [_filter(found, o, float(share), scale) for share in different]
    gain = np.stack([f.K for f in filters])[which]
    rows, root = np.stack([f.C for f in filters])[which], np.stack([f.root for f in filters])[which]
    left = np.ones((len(shares), model.l))
    left[:, o] = 1 - shares
    driven = model.expanded(part.u)
    direct = driven @ model.D.T + model.offset_y
    into = driven @ model.B.T + model.offset_x
    assert white.states is not None
    x, innovations = np.zeros((len(shares), model.nx)), np.empty((len(shares), *part.y.shape))
    healthy = np.where(present, white.innovations, 0.0)
    for k in range(len(part.y)):
        begins = onsets == k
        if begins.any():
            x[begins] = white.states[k]
        e = np.where(present[k], np.nan_to_num(part.y[k]) - left * direct[k] - np.einsum("jli,ji->jl", rows, x), 0.0)
        innovations[:, k] = e
        x = x @ model.A.T + into[k] + np.einsum("jil,jl->ji", gain, e)
    result = np.empty_like(innovations)
    before = steady.whitened(healthy, present)
    costs = np.zeros(len(shares))
    log_healthy = _scales(steady, present)
    tails = [np.concatenate([np.cumsum((_scales(f, present) - log_healthy)[::-1])[::-1], [0.0]]) for f in filters]
    for j, onset in enumerate(onsets):
        result[j, :onset] = before[:onset]
        own = replace(steady, covariance=filters[which[j]].covariance, root=root[j])
        result[j, onset:] = own.whitened(innovations[j, onset:], present[onset:])
        costs[j] = tails[which[j]][onset]
    if white.nuisance is not None:
        result = np.moveaxis(white.nuisance(np.moveaxis(result, 0, 2)), 2, 0)
    return result, costs


def _filter(found: Dictionary, o: int, share: float, scale: float) -> Predictor:
    model = found.model
    factors = np.ones(model.l)
    factors[o] = 1 - share
    damaged = replace(model, C=factors[:, None] * model.C, D=factors[:, None] * model.D,
                      offset_y=factors * model.offset_y)
    steady = predictor(damaged)
    return replace(steady, covariance=scale * steady.covariance, root=steady.root / np.sqrt(scale))


def _scales(steady: Predictor, present: np.ndarray) -> Array:
    """Logarithm (N,) of the standard deviations of the readings that are there, together."""
    patterns, of = np.unique(present, axis=0, return_inverse=True)
    blocks = [steady.covariance[np.ix_(there, there)] for there in map(np.flatnonzero, patterns)]
    return np.array([0.5 * np.linalg.slogdet(block)[1] if block.size else 0.0 for block in blocks])[of.ravel()]
