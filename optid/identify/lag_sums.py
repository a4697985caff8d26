"""Lags of autoregressions by the errors of blocks left out, from one pass over the record.

The sums of products of a record without a block are those of the whole less those of the rows that touch the block:
its own samples and as many after it as there are lags. All structures are columns of the largest one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases import Linear
from optid.data.repeats import RepeatedPart
from optid.errors import RankError
from optid.identify.blocks import Blocks, join_parts
from optid.statistics import Layout, Statistics, accumulate

Places = NDArray[np.intp]

ROWS_PER_COLUMN = 4
RIDGE = 1e-12


class Autoregression(NamedTuple):
    """Orders of an autoregression, and the mean squared one-step error of the blocks left out over the variance."""

    error: float
    na: int
    nb: int
    nk: tuple[int, ...]


class LagSums:
    """Sums of products of lagged samples: of the `whole` record, and of the rows of every block (`blocks`)."""

    def __init__(self, blocks: Blocks, na: int = 8, lags: int = 16) -> None:
        data = blocks.data
        while na * data.l + lags * data.m + 1 > data.n_samples / ROWS_PER_COLUMN and na + lags > 3:
            na, lags = max(na - 1, 1), max(lags - 2, 2)
        self.data = data
        self.layout = Layout(na, (lags,) * data.m, (0,) * data.m, (Linear(),) * data.m, data.outputs, data.inputs)
        lengths, reach = [e.n_samples for e in data.experiments], self.layout.first_row
        self.whole = self._of([RepeatedPart(i, 0, n) for i, n in enumerate(lengths)])
        self.blocks = [self._of([RepeatedPart(i, max(first - reach, 0), min(last + reach, lengths[i]))
                                 for i, first, last in parts]) for parts in blocks.parts]
        self._y = self.layout.n_columns + np.arange(data.l, dtype=np.intp)
        gram, count = self.whole.gram, max(self.whole.rows, 1)
        variance = gram[self._y, self._y] / count - (gram[self.layout.offset, self._y] / count) ** 2
        self._variance = np.maximum(variance, 1e-300)

    def _of(self, parts: list[RepeatedPart]) -> Statistics:
        long = [p for p in parts if p.last - p.first > self.layout.first_row]
        if not long:
            raise RankError(f"no block is longer than {self.layout.first_row} lags")
        return accumulate(join_parts(self.data, long), self.layout)

    def columns(self, na: int, nb: int, nk: tuple[int, ...]) -> Places:
        """Return the columns of a smaller structure."""
        found = list(range(na * self.data.l))
        for c, delay in enumerate(nk):
            block = self.layout.block(c)
            first = min(block.start + delay, block.stop)
            found += range(first, min(first + nb, block.stop))
        return np.array([*found, self.layout.offset], dtype=np.intp)

    def error(self, na: int, nb: int, nk: tuple[int, ...]) -> float:
        """Return the mean squared one-step error of the blocks that were left out of the fit, over the variances."""
        columns = self.columns(na, nb, nk)
        both, energy, rows = np.concatenate([columns, self._y]), np.zeros(self.data.l), 0
        for block in self.blocks:
            theta = _solved(self.whole.gram - block.gram, columns, self._y)
            weights = np.vstack([-theta, np.eye(self.data.l)])
            energy += np.einsum("ij,ik,kj->j", weights, block.gram[np.ix_(both, both)], weights)
            rows += block.rows
        return float(np.mean(energy / np.maximum(rows, 1) / self._variance))

    def remainder(self, columns: Places) -> float:
        """Return what least squares on some columns leaves of the outputs of the whole record, over the variances."""
        gram, y = self.whole.gram, self._y
        theta = _solved(gram, columns, y)
        rest = gram[y, y] - np.einsum("ij,ij->j", theta, gram[np.ix_(columns, y)])
        return float(np.mean(np.maximum(rest, 0.0) / max(self.whole.rows, 1) / self._variance))


def scan(sums: LagSums, delays: list[tuple[int, ...]]) -> list[Autoregression]:
    """Compare autoregressions of all orders with some delays; the best first."""
    layout = sums.layout
    return sorted(Autoregression(sums.error(na, nb, nk), na, nb, nk) for nk in delays for na in range(1, layout.na + 1)
                  for nb in range(1, min(layout.nb[0] - max(nk), 8) + 1))


def _solved(gram: Array, columns: Places, y: Places) -> Array:
    """Solve the normal equations of some columns, scaled; directions without energy are left out."""
    sizes = np.sqrt(np.maximum(np.diag(gram)[columns], 1e-300))
    inverse = np.linalg.pinv(gram[np.ix_(columns, columns)] / np.outer(sizes, sizes), rcond=RIDGE, hermitian=True)
    return inverse @ (gram[np.ix_(columns, y)] / sizes[:, None]) / sizes[:, None]
