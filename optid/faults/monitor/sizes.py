"""Sizes of carried faults, from the samples about their onsets by the formula of a diagnosis.

The running filter compensates a fault as though the model were exact: its estimate becomes ever more certain, and the
errors of the model pass for parts of the fault. What is reported is the estimate of a diagnosis of the last samples, in
which these errors count. It is final once the samples before the onset are no longer kept.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError
from optid.faults.diagnosis.alternatives import split_by_kind
from optid.faults.diagnosis.answers import Estimate
from optid.faults.diagnosis.counting import with_model_uncertainty
from optid.faults.diagnosis.posterior import Explanation, estimates, several, single
from optid.faults.monitor.events import Carried
from optid.faults.nuisance import ModelUncertainty
from optid.faults.ranges import usable_samples
from optid.faults.search.scanning import scan
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import whiten

WINDOWS, BEFORE = 5, 1
"""Windows of samples that are kept, and those of them before an onset that an estimate needs."""

NEAR, MOST = 20, 3
"""Samples on both sides of an onset that are tried, and the most faults that are estimated together."""

COVERAGE = 0.95
"""Of the intervals."""


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

    def discard(self, before: int) -> None:
        """Discard the samples before one, which show a fault that is over."""
        self.u, self.y = self.u[before - self.first :], self.y[before - self.first :]
        self.first = before

    def last(self, onset: int) -> int:
        """Return the sample before which an estimate of a fault is final."""
        return onset + (WINDOWS - BEFORE) * self.window

    def estimate(self, faults: dict[str, int], listed: Sequence[Candidate], now: int) -> dict[str, Carried]:
        """Return {label: the fault} for {label: onset}, from the samples before `now`; empty where these are unusable.

        Args:
            faults: that are carried.
            listed: the candidates of the dictionary.
            now: number of samples.
        """
        first = max(now - WINDOWS * self.window, self.first)
        u, y = (rows[first - self.first : now - self.first] for rows in (self.u, self.y))
        gaps = np.flatnonzero(np.isnan(u).any(axis=1))
        start = int(gaps[-1]) + 1 if gaps.size else 0
        model = self.known.model
        onsets = [max(onset - first - start, 0) for onset in faults.values()]
        try:
            count, _ = usable_samples(model, u[start:])
            if not faults or len(faults) > MOST or max(onsets) + 2 * model.nx + 2 > count:
                return {}
            part = Data(u[start : start + count], y[start : start + count], model.dt, model.inputs, model.outputs)
            found = self._explanation(part, list(faults), onsets, listed)
        except DataError:
            return {}
        if found is None:
            return {}
        return {one.label: _carried(one) for one in estimates(found, COVERAGE, count, 2 * model.nx)}

    def _explanation(self, part: Data, labels: list[str], onsets: list[int], listed: Sequence[Candidate]
                     ) -> Explanation | None:
        known = self.known
        white: Any = whiten(known.model, part, uncertainty=known)
        chosen = tuple(_family(next(c for c in listed if c.label == label), known.model.nx) for label in labels)
        search = scan(Dictionary(known.model, known.predictor, chosen, {}, np.full((len(chosen),) * 2, np.nan)), white,
                      part.u)
        if len(chosen) == 1:
            far = np.abs(np.arange(len(white.r)) - onsets[0]) > NEAR
            search.statistic[:, far] = np.nan
            found = single(search, chosen[0])
            found = None if found is None else with_model_uncertainty(found, known)
        else:
            found = several(search, chosen, onsets, 1)
        kinds = [] if found is None else split_by_kind(found, listed)
        return next((one for one in kinds if [c.label for c in one.candidates] == labels), None)


def _carried(one: Estimate) -> Carried:
    size = np.where(np.isnan(one.size), one.size_interval.mean(axis=1), one.size)
    return Carried(one.label, tuple(size.tolist()), tuple(np.sqrt(np.diag(one.covariance)).tolist()),
                   tuple((float(low), float(high)) for low, high in one.size_interval))


def _family(candidate: Candidate, states: int) -> Candidate:
    """Return a candidate of the model without the states that shape its noise; of a broken actuator the whole family.

    A loss may add any constant, unless its zero is stated.
    """
    own = replace(candidate, into_state=candidate.into_state[:states])
    is_family = own.kind == "loss" and own.columns and own.zero is None
    return replace(own, kind="stuck", members=(f"{own.name} stuck",)) if is_family else own
