"""Searches that wild readings do not lead astray.

Two things are done. A single reading that a spike explains better than any other candidate is taken out, and the
predictor run without it, so that it leaves no trace in later innovations. What remains is bounded: with the best answer
so far, what it leaves of an innovation beyond `BOUND` is cut to it, and the search is repeated on the sum. That is the
algorithm of pseudo-values for the M-estimate of Huber (Huber, Robust Statistics, 1981, section 7.8).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from optid.arrays import Array
from optid.data.record import Experiment
from optid.faults.diagnosis.posterior import marginal
from optid.faults.search.scanning import Scan, scan
from optid.faults.signatures import Dictionary, candidate_of
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


def cleaned(
    found: Dictionary, part: Experiment, whitened_of: Callable[[Experiment], Whitened]
) -> tuple[Scan, Experiment, tuple[tuple[int, int], ...]]:
    """Search a record without the influence of wild readings.

    Returned are the search of the bounded innovations, the record without the readings that were taken out, and these
    (sample, output).
    """
    wide, taken, whitened = with_spikes(found), [], whitened_of(part)
    while len(taken) < MOST * whitened.present.sum():
        search = scan(wide, whitened, part.u)
        reading = _wildest(search)
        if reading is None:  # behind a fault, perhaps
            reading = _wildest(scan(wide, replace(whitened, r=whitened.r - _fitted(search)), part.u))
        if reading is None:
            break
        taken.append(reading)
        y = np.array(part.y)
        y[reading] = np.nan
        part = replace(part, y=y)
        whitened = whitened_of(part)
    return _bounded(found, whitened, part.u), part, tuple(sorted(taken))


def _likeliest(search: Scan) -> tuple[int, int, float]:
    """The likeliest candidate, its onset, and the logarithm of its likelihood beside health."""
    statistic = np.nan_to_num(search.statistic, nan=-np.inf)
    logs = [float(marginal(row.max(), c.dimension)) for row, c in zip(statistic, search.dictionary.candidates)]
    c = int(np.argmax(logs))
    return c, int(np.argmax(statistic[c])), logs[c]


def _wildest(search: Scan) -> tuple[int, int] | None:
    """The reading that a spike explains better than any candidate of another kind explains anything."""
    c, onset, _ = _likeliest(search)
    candidate = search.dictionary.candidates[c]
    if candidate.kind != "spike" or not search.statistic[c, onset] >= WILD**2:
        return None
    return onset, int(np.flatnonzero(candidate.into_output[:, 0])[0])


def _fitted(search: Scan) -> Array:
    """What the likeliest candidate leaves in the innovations."""
    c, onset, _ = _likeliest(search)
    candidate = search.dictionary.candidates[c]
    return np.asarray(search.signature(candidate, onset) @ search.estimate(candidate, onset).nu)


def with_spikes(found: Dictionary) -> Dictionary:
    """Return a dictionary that has the outliers of all sensors, behind its own candidates."""
    known = {c.name for c in found.candidates if c.kind == "spike"}
    more = [replace(candidate_of(found.model, f"sensor:{name}", "spike"), bounded_deflection=True)
            for name in found.model.outputs if f"sensor:{name}" not in known]
    return found.with_candidates(more)


def _bounded(found: Dictionary, whitened: Whitened, u: Array) -> Scan:
    search, before = scan(found, whitened, u), None
    for _ in range(ROUNDS):
        fitted = np.zeros_like(whitened.r)  # the likeliest candidates, one after the other, are not bounded
        rest = search
        for _ in range(AT_ONCE):
            if _likeliest(rest)[2] < LIKELY:
                break
            fitted = fitted + _fitted(rest)
            rest = scan(found, replace(search.whitened, r=search.whitened.r - fitted), u)
        search = scan(found, replace(whitened, r=fitted + np.clip(whitened.r - fitted, -BOUND, BOUND)), u)
        if before is not None and np.allclose(fitted, before, atol=1e-3):
            break
        before = fitted
    return search
