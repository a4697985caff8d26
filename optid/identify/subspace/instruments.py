"""Outputs simulated from the inputs alone, functions of which are instruments."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optid.arrays import Array, compact
from optid.identify.subspace.imputation import clipping_range
from optid.identify.subspace.realisation import StepMatrices
from optid.kernel_cache import cached_njit
from optid.statistics.expansion import Expansion

# points at which feedback functions are tabulated, which need not be exact, and samples expanded at a time
GRID, CHUNK = 2001, 8192


class ClippedFeedback(NamedTuple):
    """What outputs, clipped to [low, high], add to the next state: sum_o table_o(y_o) + injection y."""

    tables: Array  # (l, G, n) at G points spread evenly over [low, high], interpolated linearly
    injection: Array  # (n, l)
    low: Array  # (l,)
    high: Array  # (l,)


def simulate_clipped(records: Sequence[Array], expansion: Expansion, a: Array, c: Array, step: StepMatrices
                     ) -> list[Array]:
    """Simulate the outputs (N, l) of every experiment from the inputs alone, clipped to `clipping_range`.

    The functions of a missing input count as zero, and so does the first state. The records are raw channels [u | y];
    A (n, n), C (l, n) and the matrices belong to the signals, with or without feedback functions.
    """
    m, l, n, (bu, du, ez, d, _) = expansion.m, expansion.l, len(a), step  # noqa: E741
    low, high = clipping_range(np.vstack(records)[:, m : m + l])
    tables, (injection, constant) = np.zeros((l, GRID, n)), expansion.injection(ez)
    feedback = ClippedFeedback(tables, injection, low, high)
    start = 0
    for family in expansion.feedback:
        e = ez[:, start : start + family.size]
        grid = np.linspace(low[family.output], high[family.output], GRID)
        tables[family.output] += family.basis.values(grid) @ family.vectors @ e.T
        start += family.size
    simulated = []
    open_loop = expansion.without_feedback()
    a, c = compact(a), compact(c)
    for record in records:
        out, x = np.empty((len(record), l)), np.zeros(n)
        for first in range(0, len(record), CHUNK):
            eta = open_loop(record[first : first + CHUNK])[:, : expansion.p]
            eta = np.where(np.isnan(eta), 0.0, eta)
            out[first : first + CHUNK] = clipped_run(a, c, eta @ bu.T + constant, eta @ du.T + d, feedback, x)
        simulated.append(out)
    return simulated


@cached_njit
def clipped_run(a: Array, c: Array, drive: Array, direct: Array, feedback: ClippedFeedback, x: Array) -> Array:
    """Return the clipped outputs y (T, l) of x+ = A x + drive + feedback(y), y = C x + direct.

    The state x (n,) after the last sample is written.
    """
    tables, injection, low, high = feedback
    n, l, last = x.size, low.size, tables.shape[1] - 1  # noqa: E741
    following, out = np.empty(n), np.empty(direct.shape)
    for t in range(drive.shape[0]):
        for i in range(n):
            following[i] = drive[t, i]
            for h in range(n):
                following[i] += a[i, h] * x[h]
        for o in range(l):
            y = direct[t, o]
            for i in range(n):
                y += c[o, i] * x[i]
            y = min(max(y, low[o]), high[o])
            out[t, o] = y
            place = (y - low[o]) / (high[o] - low[o]) * last
            cell = min(int(place), last - 1)
            share = place - cell
            for i in range(n):
                following[i] += (1 - share) * tables[o, cell, i] + share * tables[o, cell + 1, i] + injection[i, o] * y
        size = 0.0
        for i in range(n):
            size = max(size, abs(following[i]))
        scale = 1.0 if size < 1e12 else 1e12 / size  # a diverging run stays finite; its outputs sit at the limits
        for i in range(n):
            x[i] = following[i] * scale
    return out
