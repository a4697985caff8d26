"""Searches that wild readings do not lead astray.

Two things are done. A single reading that a spike explains better than any other candidate is taken out, and the
predictor run without it, so that it leaves no trace in later innovations. What remains is bounded: with the best answer
so far, what it leaves of an innovation beyond `BOUND` is cut to it, and the search is repeated on the sum. That is the
algorithm of pseudo-values for the M-estimate of Huber (Huber, Robust Statistics, 1981, section 7.8).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.data.record import Experiment
from optid.faults.diagnosis.posterior import marginal
from optid.faults.diagnosis.records import without
from optid.faults.search.scanning import Scan, scan
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened

BOUND = 2.5
"""Standard deviations beyond which an innovation counts no more than that."""

WILD = 4.5
"""Standard deviations that a spike must have to be taken out."""

MOST = 0.05
"""Share of the readings that may be taken out."""

ROUNDS = 20
"""Repetitions of the search on bounded innovations at most."""

AT_ONCE = 4
"""Faults whose signatures are kept from being bounded."""

LIKELY = 5.0
"""Logarithm of the likelihood beside health that such a fault has at least."""


class Cleaned(NamedTuple):
    """A search without the influence of wild readings.

    Attributes:
        search: of the bounded innovations.
        part: the record without the readings that were taken out.
        readings: (sample, output) that were taken out.
    """

    search: Scan
    part: Experiment
    readings: tuple[tuple[int, int], ...]


def cleaned(found: Dictionary, part: Experiment, whitened_of: Callable[[Experiment], Whitened]) -> Cleaned:
    """Search a record without the influence of wild readings.

    Args:
        found: the candidates.
        part: the record.
        whitened_of: its whitened innovations.
    """
    wide = with_spikes(found)
    taken: list[tuple[int, int]] = []
    whitened = whitened_of(part)
    while len(taken) < MOST * whitened.present.sum():
        search = scan(wide, whitened, part.u)
        reading = _wildest(search)
        if reading is None:  # behind a fault, perhaps
            reading = _wildest(scan(wide, replace(whitened, r=whitened.r - _fitted(search)), part.u))
        if reading is None:
            break
        taken.append(reading)
        part = without(part, [reading])
        whitened = whitened_of(part)
    return Cleaned(_bounded(found, whitened, part.u), part, tuple(sorted(taken)))


def _wildest(search: Scan) -> tuple[int, int] | None:
    """The reading that a spike explains better than any candidate of another kind explains anything."""
    statistic = np.nan_to_num(search.statistic, nan=-np.inf)
    c = _likeliest(search.dictionary, statistic)
    candidate = search.dictionary.candidates[c]
    if candidate.kind != "spike" or statistic[c].max() < WILD**2:
        return None
    o = int(np.flatnonzero(candidate.into_output[:, 0])[0])
    return int(np.argmax(statistic[c])), o


def _fitted(search: Scan) -> Array:
    """What the likeliest candidate leaves in the innovations."""
    statistic = np.nan_to_num(search.statistic, nan=-np.inf)
    c = _likeliest(search.dictionary, statistic)
    candidate, onset = search.dictionary.candidates[c], int(np.argmax(statistic[c]))
    return np.asarray(search.signature(candidate, onset) @ search.estimate(candidate, onset).nu)


def _likeliest(found: Dictionary, statistic: Array) -> int:
    return int(np.argmax([marginal(row.max(), c.dimension) for row, c in zip(statistic, found.candidates)]))


def with_spikes(found: Dictionary) -> Dictionary:
    """Return a dictionary that has the outliers of all sensors, behind its own candidates."""
    n, l = found.model.nx, found.model.l  # noqa: E741
    known = {c.name for c in found.candidates if c.kind == "spike"}
    more = []
    for name, column in zip(found.model.outputs, np.eye(l)):
        place = f"sensor:{name}"
        if place not in known:
            more.append(Candidate(place, "spike", np.zeros((n, 1)), column[:, None], (), (f"{place} spike",), (place,),
                                  True))
    count = len(found.candidates) + len(more)
    sines = np.full((count, count), np.nan)
    sines[: len(found.candidates), : len(found.candidates)] = found.sines
    return replace(found, candidates=(*found.candidates, *more), sines=sines)


def _bounded(found: Dictionary, whitened: Whitened, u: Array) -> Scan:
    search, before = scan(found, whitened, u), None
    for _ in range(ROUNDS):
        fitted = _several(found, search, u)
        rest = np.clip(whitened.r - fitted, -BOUND, BOUND)
        search = scan(found, replace(whitened, r=fitted + rest), u)
        if before is not None and np.allclose(fitted, before, atol=1e-3):
            break
        before = fitted
    return search


def _several(found: Dictionary, search: Scan, u: Array) -> Array:
    """What the likeliest candidates leave, one after the other: what a fault explains is not bounded."""
    fitted = np.zeros_like(search.whitened.r)
    rest = search
    for _ in range(AT_ONCE):
        statistic = np.nan_to_num(rest.statistic, nan=-np.inf)
        c = _likeliest(found, statistic)
        if marginal(statistic[c].max(keepdims=True), found.candidates[c].dimension)[0] < LIKELY:
            break
        fitted = fitted + _fitted(rest)
        rest = scan(found, replace(search.whitened, r=search.whitened.r - fitted), u)
    return fitted
