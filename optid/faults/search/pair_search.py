"""The exact search for two faults: all pairs of candidates and onsets, in closed form."""

import numpy as np

from optid.errors import StructureError
from optid.faults.search.calibration import Thresholds
from optid.faults.search.scanning import ALIKE, Scan
from optid.faults.search.subsets import Subset, SubsetSearch

MOST = 50_000
"""Atoms (candidates times onsets) beyond which all pairs take too long."""

LISTED = 1000
"""Pairs that cannot be told apart and are listed."""


def pairs(scan: Scan, thresholds: Thresholds, *, same: bool = True) -> SubsetSearch:
    """Search a window for two faults, exactly: all pairs of candidates and onsets, magnitudes by least squares (F4).

    Maximised is the energy that both explain together less both thresholds.

    Args:
        scan: the search for one fault.
        thresholds: of the same candidates.
        same: whether both faults may be of one candidate, as a fault that comes and goes.

    Raises:
        StructureError: thresholds of other candidates or without some that are tested, too many pairs.
    """
    from optid.faults.search.pair_kernels import search
    from optid.faults.search.sweep_kernels import grams

    q, prepared, tested = thresholds.of(scan.labels), scan.sweep, ~np.isnan(scan.statistic)
    without = [label for label, value, row in zip(scan.labels, q, tested) if row.any() and np.isnan(value)]
    if without:
        raise StructureError(
            f"There is no threshold for {', '.join(without)}: calibrate with the inputs, thresholds(..., u=u)."
        )
    number = int(tested.sum())
    if number > MOST:
        raise StructureError(
            f"{number} candidates and onsets are too many for all pairs ({MOST}): scan a shorter window or fewer "
            "onsets (scan(..., onsets=)), or use the sparse method."
        )
    n, columns, size = prepared.tables.F.shape[1], prepared.tables.group.size, len(tested)
    products, states = np.zeros((prepared.window, columns**2)), np.empty((prepared.window, n, columns))
    grams(prepared.tables, np.arange(columns**2).reshape(columns, columns), products, states)
    z = np.zeros_like(scan.correlations)
    for c in np.flatnonzero(prepared.tables.sizes).tolist():
        z[:, prepared.columns(c)] = prepared.coordinates(scan.correlations, c)
    best, alike = np.full((size, size), -np.inf), np.zeros((LISTED, 4), dtype=np.int64)
    onsets = np.full((size, size, 2), -1, dtype=np.int64)
    same_trace = search(
        prepared.tables, products.reshape(-1, columns, columns), states, prepared.along, prepared.roots,
        tested, z, np.nan_to_num(q), same, ALIKE, best, onsets, alike,
    )

    def pair(i: int, j: int, gain: float, first: int, second: int) -> Subset:
        return Subset((scan.labels[i], scan.labels[j]), (int(first), int(second)), gain, float(gain + q[i] + q[j]))

    found = [pair(i, j, float(best[i, j]), *onsets[i, j]) for i, j in np.argwhere(np.isfinite(best))]
    single = float(np.max(scan.gains(thresholds)[tested], initial=-np.inf))
    return SubsetSearch(
        scan, tuple(sorted(found, key=lambda s: -s.gain)), single,
        np.asarray(tested.any(axis=0)), number * (number - 1) // 2, 2, alike=int(same_trace),
        indistinguishable=tuple(pair(a, b, np.nan, i, j) for a, i, b, j in alike[:same_trace]),
    )
