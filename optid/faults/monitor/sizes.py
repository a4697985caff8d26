"""Sizes of carried faults, from the samples about their onsets by the formula of a diagnosis.

The running filter compensates a fault as though the model were exact: its estimate becomes ever more certain, and the
errors of the model pass for parts of the fault. What is reported is the estimate of a diagnosis of the last samples, in
which these errors count. It is final once the samples before the onset are no longer kept.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.faults.diagnosis.alternatives import UNKNOWN_DIRECTION, family_of, split_by_kind
from optid.faults.diagnosis.answers import Estimate, FaultAnswer
from optid.faults.diagnosis.counting import with_model_uncertainty
from optid.faults.diagnosis.diagnosing import diagnose
from optid.faults.diagnosis.posterior import Explanation, estimates, several, single
from optid.faults.monitor.events import Carried
from optid.faults.nuisance import ModelUncertainty
from optid.faults.ranges import usable_samples
from optid.faults.search.scanning import scan
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import whiten

WINDOWS, BEFORE = 5, 1  # windows of samples that are kept, and those of them before an onset that an estimate needs
NEAR, MOST = 20, 3  # samples on both sides of an onset that are tried, and the most faults that are estimated together
COVERAGE = 0.95  # of the intervals


class Recent:
    """The last samples of a stream, as the monitor has screened them.

    Attributes:
        known: the model and its uncertainty.
        window: samples of the window of the monitor.
        u, y: (T, m) and (T, l) the samples.
        first: number of the first one.
        final: {number of the candidate: the fault} of those whose onset is no longer kept.
    """

    def __init__(self, known: ModelUncertainty, window: int) -> None:
        """Begin a stream."""
        self.known, self.window, self.first = known, window, 0
        self.final: dict[int, Carried] = {}
        self.u, self.y = np.empty((0, known.model.m)), np.empty((0, known.model.l))

    def append(self, u: Array, y: Array, start: int) -> None:
        """Append a block that begins at a sample, and discard samples that are too old."""
        if start != self.first + len(self.u):  # samples were skipped
            self.u, self.y, self.first = self.u[:0], self.y[:0], start
        drop = max(len(self.u) - WINDOWS * self.window, 0)
        self.u, self.y = (np.vstack([kept[drop:], new]) for kept, new in ((self.u, u), (self.y, y)))
        self.first += drop

    def discard(self, before: int, carried: Mapping[int, int] = MappingProxyType({})) -> None:
        """Discard the samples before one, which show faults that are over, and the sizes of those that are."""
        self.u, self.y = self.u[before - self.first :], self.y[before - self.first :]
        self.first = before
        self.final = {number: one for number, one in self.final.items() if number in carried}

    def next_final(self, onsets: Mapping[int, int], now: int) -> float:
        """Return the sample after `now` at which the size of a carried fault, {number: onset}, becomes final next."""
        last = (self.last(onset) for number, onset in onsets.items() if number not in self.final)
        return min((sample for sample in last if sample > now), default=np.inf)

    def keep(self, onsets: Mapping[int, int], found: Mapping[int, Carried], now: int) -> None:
        """Keep the estimates that are final."""
        self.final |= {number: one for number, one in found.items() if self.last(onsets[number]) <= now}

    def last(self, onset: int) -> int:
        """Return the sample before which an estimate of a fault is final."""
        return onset + (WINDOWS - BEFORE) * self.window

    def estimate(self, faults: dict[str, int], listed: Sequence[Candidate], now: int) -> dict[str, Carried]:
        """Return {label: the fault} for {label: onset}, from the samples before `now`; empty if unusable."""
        labels = list(faults)
        for found in self._explanations(faults, listed, now):
            if [c.label for c in found.candidates] == labels:
                count = len(found.search.whitened.r) if found.search is not None else 0
                return {one.label: _carried(one) for one in estimates(found, COVERAGE, count, 2 * self.known.model.nx)}
        return {}

    def evidence(self, labels: Sequence[str], onset: int, listed: Sequence[Candidate], now: int) -> dict[str, float]:
        """Return {label: logarithm of the likelihood} of what broke at an actuator since about an onset."""
        families = dict.fromkeys(family_of(one).label for one in listed if one.label in labels)
        found = [one for label in families for one in self._explanations({label: onset}, listed, now)]
        return {one.candidates[0].label: one.log_evidence for one in found if one.candidates[0].label in labels}

    def answers(self, listed: Sequence[Candidate], now: int) -> tuple[FaultAnswer, ...] | None:
        """Return the answers of a diagnosis of the samples before `now`, by two faults where no single one fits.

        Onsets are samples of the stream. It is empty where nothing that is listed explains the samples (most pairs of
        faults look like a disturbance of unknown direction at first), None where they are unusable.
        """
        part, first = self._part(now)
        try:
            if part is None:
                return None
            found = diagnose(self.known.model, part, self._dictionary([self._own(one) for one in listed]),
                             model_uncertainty=self.known)
        except (DataError, StructureError):  # too few samples, or channels that are no channels of the model any more
            return None
        if all(fault.name == UNKNOWN_DIRECTION for one in found.candidates for fault in one.faults):
            return ()
        return tuple(replace(one, faults=tuple(replace(fault, onset=fault.onset + first) for fault in one.faults))
                     for one in found.candidates)

    def _part(self, now: int) -> tuple[Data | None, int]:
        """Return the last samples before `now` with all inputs, and the number of the first one."""
        first = max(now - WINDOWS * self.window, self.first)
        u, y = (rows[first - self.first : now - self.first] for rows in (self.u, self.y))
        gaps = np.flatnonzero(np.isnan(u).any(axis=1))
        start, model = int(gaps[-1]) + 1 if gaps.size else 0, self.known.model
        if len(u) - start < 2 * model.nx + 2:
            return None, first + start
        return Data(u[start:], y[start:], model.dt, model.inputs, model.outputs), first + start

    def _own(self, one: Candidate) -> Candidate:
        """Return a candidate without the states that shape the noise of the monitor."""
        return replace(one, into_state=one.into_state[: self.known.model.nx])

    def _dictionary(self, candidates: Sequence[Candidate]) -> Dictionary:
        sines = np.full((len(candidates), len(candidates)), np.nan)
        return Dictionary(self.known.model, self.known.predictor, tuple(candidates), {}, sines)

    def _explanations(self, faults: dict[str, int], listed: Sequence[Candidate], now: int) -> list[Explanation]:
        """Return the explanations of the samples before `now` by faults, in all kinds of broken actuators."""
        model, (part, first) = self.known.model, self._part(now)
        if part is None or not 0 < len(faults) <= MOST:
            return []
        onsets = [max(onset - first, 0) for onset in faults.values()]
        families = {label: family_of(one) for one in listed for label in (one.label, family_of(one).label)}
        chosen = [self._own(families[label]) for label in faults]
        try:
            count, _ = usable_samples(model, part.u)
            if max(*onsets, model.nx) + model.nx + 2 > count:
                return []
            part = part.window(0, count)
            white: Any = whiten(model, part, uncertainty=self.known)
        except DataError:
            return []
        search = scan(self._dictionary(chosen), white, part.u)
        if len(chosen) > 1:
            return split_by_kind(several(search, chosen, onsets, 1), listed)
        search.statistic[:, np.abs(np.arange(count) - onsets[0]) > NEAR] = np.nan
        found = single(search, chosen[0])
        return [] if found is None else split_by_kind(with_model_uncertainty(found, self.known), listed)


def _carried(one: Estimate) -> Carried:
    size = np.where(np.isnan(one.size), one.size_interval.mean(axis=1), one.size)
    return Carried(one.label, tuple(size.tolist()), tuple(np.sqrt(np.diag(one.covariance)).tolist()),
                   tuple((float(low), float(high)) for low, high in one.size_interval))
