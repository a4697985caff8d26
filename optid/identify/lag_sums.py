"""Lags of autoregressions by the errors of blocks left out, from one pass over the record.

The sums of products of a record without a block are those of the whole less those of the rows that touch the block:
its own samples and as many after it as there are lags. All structures are columns of the largest one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases import Linear
from optid.bases.basis import Basis
from optid.data.record import Data
from optid.data.repeats import RepeatedPart
from optid.errors import RankError
from optid.identify.blocks import Blocks, join_parts
from optid.statistics import Layout, Statistics, accumulate

Places = NDArray[np.intp]

ROWS_PER_COLUMN = 4
RIDGE = 1e-12


@dataclass(frozen=True)
class Autoregression:
    """Orders of an autoregression, and the mean squared one-step error of the blocks left out over the variance."""

    na: int
    nb: int
    nk: tuple[int, ...]
    error: float


class LagSums:
    """Sums of products of lagged samples: of the `whole` record, and of the rows of every block (`blocks`)."""

    def __init__(self, blocks: Blocks, bases: tuple[Basis, ...], na: int = 8, lags: int = 16) -> None:
        data = blocks.data
        width, rows = sum(basis.size for basis in bases), data.n_samples
        while na * data.l + lags * width + 1 > rows / ROWS_PER_COLUMN and na + lags > 3:
            na, lags = max(na - 1, 1), max(lags - 2, 2)
        self.data, self.layout = data, Layout(na, (lags,) * data.m, (0,) * data.m, bases, data.outputs, data.inputs)
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
        found, lags = list(range(na * self.data.l)), self.layout.nb[0]
        for c, (basis, delay) in enumerate(zip(self.layout.bases, nk)):
            block = self.layout.block(c)
            first = block.start + min(delay, lags) * basis.size
            found += range(first, min(first + nb * basis.size, block.stop))
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
    found = [Autoregression(na, nb, nk, sums.error(na, nb, nk)) for nk in delays for na in range(1, layout.na + 1)
             for nb in range(1, min(layout.nb[0] - max(nk), 8) + 1)]
    return sorted(found, key=lambda one: one.error)


def linear(data: Data) -> tuple[Basis, ...]:
    """Return the basis of a linear model for every input."""
    return (Linear(),) * data.m


def _solved(gram: Array, columns: Places, y: Places) -> Array:
    """Solve the normal equations of some columns, scaled; directions without energy are left out."""
    sizes = np.sqrt(np.maximum(np.diag(gram)[columns], 1e-300))
    inverse = np.linalg.pinv(gram[np.ix_(columns, columns)] / np.outer(sizes, sizes), rcond=RIDGE, hermitian=True)
    return inverse @ (gram[np.ix_(columns, y)] / sizes[:, None]) / sizes[:, None]
