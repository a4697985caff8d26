"""Outputs simulated from the inputs alone: noise-free instruments for functions of the measured outputs."""

from collections.abc import Sequence

import numpy as np

from optid.arrays import Array
from optid.statistics.expansion import Expansion

GRID = 2001
"""Points at which the feedback functions are tabulated for simulated instruments, which need not be exact."""

CHUNK = 8192
"""Samples expanded at a time."""

BEYOND = 0.2
"""Simulated outputs are clipped to the range of the record, wider by this share of it on either side."""


def clipping_range(outputs: Sequence[Array]) -> tuple[Array, Array]:
    """Return the limits (l,) of simulated outputs: those of outputs (N, l) on record, and `BEYOND`."""
    low = np.nanmin([np.nanmin(y, axis=0) for y in outputs], axis=0)
    high = np.nanmax([np.nanmax(y, axis=0) for y in outputs], axis=0)
    return low - BEYOND * (high - low), high + BEYOND * (high - low)


def simulate_clipped(records: Sequence[Array], expansion: Expansion, a: Array, c: Array, bu: Array, du: Array,
                     ez: Array, d: Array) -> list[Array]:
    """Simulate the outputs from the inputs alone, as instruments: noise free, clipped to the range of the record.

    The functions of a missing input count as zero.

    Args:
        records: raw channels [u | y], one per experiment.
        expansion: the signals; its feedback functions may be empty.
        a: (n, n).
        c: (l, n).
        bu: (n, p).
        du: (l, p).
        ez: (n, q).
        d: (l,) offset.

    Returns:
        (N, l) per experiment.
    """
    from optid.statistics.subspace_kernels import clipped_run

    m, l, n = expansion.m, expansion.l, len(a)  # noqa: E741
    low, high = clipping_range([record[:, m : m + l] for record in records])
    tables, (injection, constant) = np.zeros((l, GRID, n)), expansion.injection(ez)
    start = 0
    for family in expansion.feedback:
        e = ez[:, start : start + family.size]
        grid = np.linspace(low[family.output], high[family.output], GRID)
        tables[family.output] += family.basis.values(grid) @ family.vectors @ e.T
        start += family.size
    simulated = []
    open_loop = expansion.without_feedback()
    a, c = np.ascontiguousarray(a), np.ascontiguousarray(c)
    for record in records:
        out, x = np.empty((len(record), l)), np.zeros(n)
        for first in range(0, len(record), CHUNK):
            eta = open_loop(record[first : first + CHUNK])[:, : expansion.p]
            eta = np.where(np.isnan(eta), 0.0, eta)
            clipped_run(a, c, eta @ bu.T + constant, eta @ du.T + d, tables, injection, low, high, x,
                        out[first : first + CHUNK])
        simulated.append(out)
    return simulated
