"""A sensor that lost a share of its reading, (1.11): y = (1 - gamma) times the true output.

The loss is another row of C (of D and of the offset) from the onset on, so that the exact likelihood is that of a
Kalman filter with this row, started from the state of the healthy one at the onset. The noise of the sensor stays as it
is where the gain is lost before it, and is multiplied by 1 - gamma, too, where it is lost behind it: both are tried.

The likelihood is computed for many shares and onsets at once, over a grid that is refined about the most probable onset
and, once this is known to the sample, about the share. The uncertainty of an identified model is that about the damaged
plant, not about a healthy one with these readings: its effect on the innovations is computed for the outputs that the
filter estimates. A dead sensor, gamma = 1, reads its noise and is the end of the range.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from optid.arrays import Array
from optid.data.record import Experiment
from optid.errors import StructureError
from optid.faults.diagnosis.posterior import Explained, Explanation
from optid.faults.nuisance import ModelUncertainty, Nuisance
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Predictor, Whitened, predictor

SHARES, ONSETS = 17, 15  # shares and onsets of a grid
ROUNDS = 20  # largest number of grids, each about the best point of the one before
CLOSER = 0.35  # range of a grid, as a share of that of the one before
FINE = 0.6  # largest distance of the shares of the last grid, in standard deviations
LEAST = 5  # samples that must follow the onset
LOWEST, MOST = 1e-6, 0.98  # smallest share, and the largest lost together with the noise: beyond it nothing is read

REPEATED = 3
"""Largest number of searches, each with the effect of uncertain parameters at the best point of the one before."""

AROUND = 12.0  # standard deviations of the share that are searched with the effect of uncertain parameters


def sensor_gains(found: Dictionary, white: Whitened, part: Experiment,
                 uncertainty: ModelUncertainty | None) -> list[Explanation]:
    """Return the explanations of a window by sensors of a dictionary that lost a share of their reading."""
    if white.states is None or found.model.feedback or np.any(found.model.L):
        return []
    explanations = []
    for candidate in found.candidates:
        if not candidate.is_sensor_gain:
            continue
        gain = SensorGain(found, int(np.flatnonzero(candidate.into_output[:, 0])[0]), white, part)
        if gain.last < 1:
            continue
        try:
            laws = [gain.searched()]
            if uncertainty is not None:
                laws = _with_parameters(laws[0], uncertainty)
        except StructureError:  # without this sensor some mode is not observable
            continue
        which = np.repeat(np.arange(len(laws)), [law.onsets.size for law in laws])
        onsets, logs, most, mean, variance = (np.concatenate([getattr(law, name) for law in laws])
                                              for name in ("onsets", "logs", "most", "mean", "variance"))
        logs = logs - np.log(len(laws))
        best = int(np.argmax(logs))

        def rest(onset: int, gain: "SensorGain" = laws[which[best]].gain, share: float = mean[best]) -> Explained:
            left = gain.rests(np.array([onset]), np.array([share]))[0][0]
            return Explained(white.r - left, left, 1)

        explanations.append(Explanation((candidate,), onsets[:, None], logs, mean[:, None], variance[:, None, None],
                                        2 * most, course=rest).without_negligible_onsets())
    return explanations


def _with_parameters(law: "Law", uncertainty: ModelUncertainty) -> "list[Law]":
    """Return the laws of both noises with the effect of uncertain parameters, which depends on the fault."""
    for _ in range(REPEATED):
        before, law = law, law.gain.at(law, uncertainty).searched()
        if abs(law.onset - before.onset) <= 1:
            break
    return [replace(law.gain, scaled=scaled).at(law, uncertainty).around(law) for scaled in (False, True)]


@dataclass(frozen=True, eq=False)
class Law:
    """Likelihood and share at every onset of a grid."""

    gain: "SensorGain"  # the fault
    onsets: np.ndarray  # (K,)
    logs: Array  # (K,) marginal likelihoods, uniform over shares and onsets
    most: Array  # (K,) the largest likelihoods
    mean: Array  # (K,) of the share
    variance: Array  # (K,) of the share

    @property
    def best(self) -> int:
        """The row of the most probable onset."""
        return int(np.argmax(self.logs))

    @property
    def onset(self) -> int:
        """The most probable onset."""
        return int(self.onsets[self.best])


@dataclass(frozen=True, eq=False)
class SensorGain:
    """A share of the reading of output `o` lost in a window."""

    found: Dictionary  # the dictionary
    o: int  # the output
    white: Whitened  # the healthy innovations of the window
    part: Experiment  # the window
    scaled: bool = False  # whether the noise is multiplied by what is left of the reading
    nuisance: Nuisance | None = None  # the effect of uncertain parameters; that on the healthy innovations by default

    @cached_property
    def last(self) -> int:
        """The last onset possible; 0 where the sensor has too few readings."""
        there = np.flatnonzero(self.white.present[:, self.o])
        return int(there[-LEAST]) if len(there) >= 2 * LEAST else 0

    def searched(self) -> Law:
        """Search all onsets and shares."""
        sudden = np.argsort(-np.abs(np.nan_to_num(self.white.innovations[: self.last + 1, self.o])))[:ONSETS]
        onsets: np.ndarray = np.unique(np.append(np.linspace(0, self.last, ONSETS).astype(int), sudden))
        return self._refined(onsets, float(self.last), self._shares(0.5, 1.0))

    def at(self, law: Law, uncertainty: ModelUncertainty) -> "SensorGain":
        """Return the same with the effect of uncertain parameters at the best point of a law."""
        return replace(self, nuisance=self._nuisance(uncertainty, law.onset, float(law.mean[law.best])))

    def around(self, law: Law) -> Law:
        """Search around the best point of another law."""
        k = law.onset
        onsets = np.unique(np.linspace(max(k - ONSETS, 0), min(k + ONSETS, self.last), ONSETS).astype(int))
        width = AROUND * float(np.sqrt(law.variance[law.best]))
        return self._refined(onsets, 2.0 * ONSETS, self._shares(float(law.mean[law.best]), width))

    def _shares(self, middle: float, width: float) -> Array:
        """Equally spaced shares about a middle, as far as it is possible."""
        top = MOST if self.scaled else 1.0
        width = min(width, top - LOWEST)
        middle = float(np.clip(middle, LOWEST + width / 2, top - width / 2))
        return middle + width * np.linspace(-0.5, 0.5, SHARES)

    def _refined(self, onsets: np.ndarray, wide: float, shares: Array) -> Law:
        for _ in range(ROUNDS):
            tried, gammas = onsets, shares
            logs = self.likelihoods(tried, gammas)
            k, g = np.unravel_index(int(np.argmax(logs)), logs.shape)
            weights = np.exp(logs[k] - logs[k, g])
            weights /= weights.sum()
            std = float(np.sqrt(max(weights @ shares**2 - (weights @ shares) ** 2, 0.0)))
            if np.max(np.diff(onsets), initial=1) > 1:  # at a wrong onset another share is the best one
                wide *= CLOSER
                reach = max(int(wide / 2), ONSETS // 2)
                near = np.linspace(max(onsets[k] - reach, 0), min(onsets[k] + reach, self.last), ONSETS)
                onsets = np.unique(np.append(near.astype(int), onsets[k]))
            elif shares[1] - shares[0] < FINE * std:
                break
            else:
                shares = self._shares(float(shares[g]), CLOSER * float(np.ptp(shares)))
        most = logs.max(axis=1)
        weights = np.exp(logs - most[:, None])
        total = weights.sum(axis=1)
        mean = weights @ gammas / total
        variance = np.maximum(weights @ gammas**2 / total - mean**2, 1e-12)
        evidence = most + np.log(total * (gammas[1] - gammas[0])) - np.log(len(self.white.r))
        return Law(self, tried, evidence, most, mean, variance)

    def likelihoods(self, onsets: np.ndarray, shares: Array) -> Array:
        """Return the log-likelihood ratios (K, G) to the healthy plant of onsets (K,) and shares (G,)."""
        rests, sizes = self.rests(np.repeat(onsets, len(shares)), np.tile(shares, len(onsets)))
        logs = 0.5 * float(np.sum(self.white.r**2)) - 0.5 * np.einsum("jno,jno->j", rests, rests) - sizes
        if self.nuisance is not None and self.white.nuisance is not None:
            logs += self.white.nuisance.log_scale - self.nuisance.log_scale
        return np.asarray(logs.reshape(len(onsets), len(shares)))

    def rests(self, onsets: np.ndarray, shares: Array) -> tuple[Array, Array]:
        """Whitened innovations (J, N, l) with a share lost from an onset on, and the logarithms (J,) of their scale."""
        steady, present = self.white.predictor, self.white.present
        different, which = np.unique(shares, return_inverse=True)
        filters = [self._filter(float(share)) for share in different]
        innovations = self._innovations(onsets, [filters[i] for i in which], shares)
        result = np.empty_like(innovations)
        before = steady.whiten(np.where(present, self.white.innovations, 0.0), present)
        costs = np.zeros(len(shares))
        log_healthy = _scales(steady, present)
        tails = [np.concatenate([np.cumsum((_scales(f, present) - log_healthy)[::-1])[::-1], [0.0]]) for f in filters]
        for j, onset in enumerate(onsets):
            result[j, :onset] = before[:onset]
            result[j, onset:] = filters[which[j]].whiten(innovations[j, onset:], present[onset:])
            costs[j] = tails[which[j]][onset]
        nuisance = self.nuisance or self.white.nuisance
        if nuisance is not None:
            result = np.moveaxis(nuisance(np.moveaxis(result, 0, 2)), 2, 0)
        return result, costs

    def _innovations(self, onsets: np.ndarray, filters: list[Predictor], shares: Array) -> Array:
        """Innovations (J, N, l) of the filters; those before the onset of each are not meant to be used."""
        model, present = self.found.model, self.white.present
        gain, rows = np.stack([f.K for f in filters]), np.stack([f.C for f in filters])
        left = np.ones((len(shares), model.l))
        left[:, self.o] = 1 - shares
        driven = model.expand_inputs(self.part.u)
        direct, into = driven @ model.D.T + model.offset_y, driven @ model.B.T + model.offset_x
        assert self.white.states is not None
        x, innovations = np.zeros((len(shares), model.nx)), np.zeros((len(shares), *self.part.y.shape))
        for k in range(int(onsets.min()), len(self.part.y)):
            begins = onsets == k
            if begins.any():
                x[begins] = self.white.states[k]
            e = np.nan_to_num(self.part.y[k]) - left * direct[k] - np.einsum("jli,ji->jl", rows, x)
            innovations[:, k] = np.where(present[k], e, 0.0)
            x = x @ model.A.T + into[k] + np.einsum("jil,jl->ji", gain, innovations[:, k])
        return innovations

    @cached_property
    def _filter(self) -> Callable[[float], Predictor]:
        """The predictor of a share lost."""
        model, healthy = self.found.model, predictor(self.found.model)
        scale = float(np.trace(self.white.predictor.covariance) / np.trace(healthy.covariance))

        @cache
        def damaged(share: float) -> Predictor:
            factors = np.ones(model.l)
            factors[self.o] = 1 - share
            C = factors[:, None] * model.C
            own = replace(
                healthy, C=C, K=healthy.K / factors, covariance=np.outer(factors, factors) * healthy.covariance,
                root=healthy.root / factors) if self.scaled else predictor(replace(model, C=C))
            return replace(own, covariance=scale * own.covariance, root=own.root / np.sqrt(scale))

        return damaged

    def _nuisance(self, uncertainty: ModelUncertainty, onset: int, share: float) -> Nuisance:
        """Return the effect of uncertain parameters with a share lost from an onset on.

        A change e of the healthy innovations of the true outputs is one of a filter with another gain, which sees e as
        an addition to the outputs and K e as one to the next state.
        """
        steady, present, after = self.white.predictor, self.white.present, slice(onset, None)
        share = min(share, 1 - LOWEST)
        own = self._filter(share)
        left = np.ones(len(own.C))
        left[self.o] = 1 - share
        rest = self._innovations(np.array([onset]), [own], np.array([share]))[0, after, self.o]
        y = np.array(self.part.y)
        y[after, self.o] = (y[after, self.o] - rest) / left[self.o]

        def seen(changes: Array) -> Array:
            e = changes[after]
            drive = np.zeros((len(e), model.nx, e.shape[2]))
            drive[1:] = steady.K @ e[:-1]
            filtered = replace(own, C=model.C, K=own.K * left).respond(drive, e, present[after])
            return np.concatenate([steady.whiten(changes[:onset], present[:onset]),
                                   own.whiten(left[:, None] * filtered, present[after])])

        model = self.found.model
        assert self.white.states is not None
        return uncertainty.nuisance(replace(self.part, y=y), self.white.states[0], present, seen=seen)


def _scales(steady: Predictor, present: np.ndarray) -> Array:
    """Logarithm (N,) of the standard deviations of the readings that are there, together."""
    patterns, of = np.unique(present, axis=0, return_inverse=True)
    blocks = [steady.covariance[np.ix_(there, there)] for there in map(np.flatnonzero, patterns)]
    return np.array([0.5 * np.linalg.slogdet(block)[1] if block.size else 0.0 for block in blocks])[of.ravel()]
