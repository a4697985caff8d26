"""Does a record look Hammerstein? Then Theta = mu b^T has rank one, and a free Theta fits hardly better."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optid.bases.basis import Array
from optid.regressors import Statistics

if TYPE_CHECKING:
    from optid.rank_one import RankOne

SIGNIFICANT = 1e-3
NOTICEABLE = 0.05
"""Share of the squared error that giving up rank one must save before a record is said not to look Hammerstein."""


@dataclass(frozen=True)
class Structure:
    """The structure test of a record.

    Attributes:
        ratios: second over first singular value of the unrestricted Theta, one per input.
        p_value: of the hypothesis that every Theta has rank one (F test); 1 when nothing is to be tested.
        saving: share of the squared one-step error that giving up rank one saves.
    """

    ratios: dict[str, float]
    p_value: float
    saving: float

    @property
    def passed(self) -> bool:
        """Whether the record looks Hammerstein; a difference must be significant and noticeable to count."""
        return not (self.p_value < SIGNIFICANT and self.saving > NOTICEABLE)


def structure_test(statistics: Statistics) -> Structure:
    """Compare the least-squares fit with free matrices Theta_c to the best fit of rank one.

    With several outputs each counts in units of its residual, and Theta_c (P, nb l) joins them.

    Args:
        statistics: of the record to be tested.

    Raises:
        RankError: the record does not determine the parameters.
    """
    from scipy.special import fdtrc

    from optid.rank_one import block_slices, matrices
    from optid.rank_one.bilinear import minimise

    layout = statistics.layout
    problem = weighted_problem(statistics)
    free = np.linalg.solve(problem.root, problem.target)
    thetas = matrices(np.concatenate([free[part] for part in block_slices(problem)]), problem.blocks)
    singular = [np.linalg.svd(theta, compute_uv=False) for theta in thetas]
    ratios = {
        name: float(values[1] / values[0]) if values.size > 1 and values[0] > 0 else 0.0
        for name, values in zip(layout.inputs, singular)
    }
    extra = sum((p - 1) * (columns - 1) for p, columns in problem.blocks)
    spare = statistics.rows * layout.l - free.size
    if extra == 0 or spare <= 0:
        return Structure(ratios, 1.0, 0.0)
    restricted = max(minimise(problem).value, problem.remainder)
    if restricted <= 1e-18 * problem.scale:
        return Structure(ratios, 1.0, 0.0)
    more = restricted - problem.remainder
    least = max(problem.remainder, np.finfo(float).eps * restricted)
    return Structure(ratios, float(fdtrc(extra, spare, (more / extra) / (least / spare))), more / restricted)


def weighted_problem(statistics: Statistics) -> "RankOne":
    """Write the regression of all outputs as one rank-one problem, each output in units of its residual.

    Unknowns: the linear coefficients of each output (past outputs, constant), then Theta_c (P_c, nb_c l), outputs
    outermost.
    """
    from optid.rank_one import RankOne

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
