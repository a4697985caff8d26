"""Robust search in the presence of outliers.

A single reading that a spike explains better than any other candidate is removed, and the predictor is run without it,
so that later innovations are not affected. The residuals of the best candidates are then clipped at `BOUND`, and the
search is repeated on fit plus clipped residuals: the algorithm of pseudo-values for the M-estimate of Huber (Robust
Statistics, 1981, section 7.8).
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

BOUND = 2.5  # standard deviations at which residuals are clipped
WILD = 4.5  # standard deviations from which on a spike is removed
MOST = 0.05  # largest share of the readings removed
ROUNDS = 20  # largest number of searches on clipped innovations
AT_ONCE = 4  # largest number of faults whose signatures are not clipped
LIKELY = 5.0  # least log-likelihood ratio of such a fault against the healthy plant


def cleaned(found: Dictionary, part: Experiment,
            whitened_of: Callable[[Experiment], Whitened]) -> tuple[Scan, Experiment, tuple[tuple[int, int], ...]]:
    """Return the search of the clipped innovations, the record without outliers, and these as (sample, output)."""
    wide, taken, whitened = with_spikes(found), [], whitened_of(part)
    while len(taken) < MOST * whitened.present.sum():
        search = scan(wide, whitened, part.u)
        reading = _wildest(search)
        if reading is None:  # perhaps hidden by a fault
            reading = _wildest(search.again(whitened.r - _fitted(search)))
        if reading is None:
            break
        taken.append(reading)
        y = np.array(part.y)
        y[reading] = np.nan
        part = replace(part, y=y)
        whitened = whitened_of(part)
    return _bounded(found, whitened, part.u), part, tuple(sorted(taken))


def _likeliest(search: Scan) -> tuple[int, int, float]:
    """The likeliest candidate, its onset, and its log-likelihood ratio against the healthy plant."""
    statistic = np.nan_to_num(search.statistic, nan=-np.inf)
    logs = [float(marginal(row.max(), c.dimension)) for row, c in zip(statistic, search.dictionary.candidates)]
    c = int(np.argmax(logs))
    return c, int(np.argmax(statistic[c])), logs[c]


def _wildest(search: Scan) -> tuple[int, int] | None:
    """The reading whose spike is likelier than any candidate of another kind."""
    c, onset, _ = _likeliest(search)
    candidate = search.dictionary.candidates[c]
    if not candidate.fault_kind.outlier or not search.statistic[c, onset] >= WILD**2:
        return None
    return onset, int(np.flatnonzero(candidate.into_output[:, 0])[0])


def _fitted(search: Scan) -> Array:
    """Fit of the likeliest candidate to the innovations."""
    c, onset, _ = _likeliest(search)
    candidate = search.dictionary.candidates[c]
    return np.asarray(search.signature(candidate, onset) @ search.estimate(candidate, onset).nu)


def with_spikes(found: Dictionary) -> Dictionary:
    """Return the dictionary with the outliers of all sensors appended."""
    known = {c.name for c in found.candidates if c.fault_kind.outlier}
    more = [replace(candidate_of(found.model, f"sensor:{name}", "spike"), bounded_deflection=True)
            for name in found.model.outputs if f"sensor:{name}" not in known]
    return found.with_candidates(more)


def _bounded(found: Dictionary, whitened: Whitened, u: Array) -> Scan:
    search, before = scan(found, whitened, u), None
    for _ in range(ROUNDS):
        fitted = np.zeros_like(whitened.r)  # of the likeliest candidates, which is not clipped
        rest = search
        for _ in range(AT_ONCE):
            if _likeliest(rest)[2] < LIKELY:
                break
            fitted = fitted + _fitted(rest)
            rest = search.again(search.whitened.r - fitted)
        search = search.again(fitted + np.clip(whitened.r - fitted, -BOUND, BOUND))
        if before is not None and np.allclose(fitted, before, atol=1e-3):
            break
        before = fitted
    return search
