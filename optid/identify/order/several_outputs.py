"""The regression of several outputs as one rank-one problem."""

import numpy as np

from optid.arrays import Array
from optid.statistics import Statistics
from optid.structures.rank_one import RankOne


def weighted_problem(statistics: Statistics) -> RankOne:
    """Write the regression of all outputs as one rank-one problem, each output in units of its residual.

    Unknowns: the linear coefficients of each output (past outputs, constant), then Theta_c (P_c, nb_c l), outputs
    outermost.
    """
    layout, root = statistics.layout, statistics.root
    n, outputs = layout.n_columns, layout.l
    past = np.arange(layout.na * outputs)
    linear = past.size + 1
    sizes = [nb * basis.size for nb, basis in zip(layout.nb, layout.bases)]
    total = outputs * (linear + sum(sizes))
    system = np.zeros((outputs * n, total + 1))
    remainder = 0.0
    for o in range(outputs):
        rest = float(np.sum(root[n:, n + o] ** 2))
        energy = float(np.sum(root[:, n + o] ** 2))
        weight = 1.0 if outputs == 1 else 1 / np.sqrt(max(rest / statistics.rows, 1e-24 * energy, 1e-300))
        where = np.empty(n, dtype=int)
        where[past], where[layout.offset] = o * linear + past, (o + 1) * linear - 1
        start = outputs * linear
        for c, size in enumerate(sizes):
            where[layout.block(c)] = start + o * size + np.arange(size)
            start += outputs * size
        rows = slice(o * n, (o + 1) * n)
        system[rows, where] = weight * root[:n, :n]
        system[rows, -1] = weight * root[:n, n + o]
        remainder += weight**2 * rest
    triangle: Array = np.asarray(np.linalg.qr(system, mode="r"))
    blocks = tuple((basis.size, nb * outputs) for nb, basis in zip(layout.nb, layout.bases))
    if len(triangle) > total:
        remainder += float(triangle[total, total] ** 2)
    return RankOne(triangle[:total, :total], triangle[:total, total], remainder, blocks, outputs * linear)
