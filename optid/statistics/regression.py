"""The regression y = Phi theta + e behind an ARX model with static nonlinearities, and its sufficient statistics.

Nothing of size samples x parameters is formed: one pass over the record gives the Gram matrix of [Phi | Y], which is
all that a least-squares objective needs. Sums of parts add up, over chunks, experiments and workers.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optid.arrays import Array
from optid.bases.basis import Basis
from optid.data.reduction import available_cores, map_parts
from optid.errors import DataError, DataWarning, RankError
from optid.models.layout import Layout
from optid.statistics.blocks import CHUNK, Frame, blocks_of, check_channels, cut, records, stretches, used_rows
from optid.statistics.factors import conditioning, dependent_column, root_of_gram
from optid.statistics.sums import Factor, Sums, Total, total_of_parts

if TYPE_CHECKING:
    from optid.data.record import Data
    from optid.data.streams import Stream

# condition number of the scaled regressor beyond which the Gram matrix, which squares it, has too few digits left
CONDITION_LIMIT = 1e7
# share of an output that least squares leaves, below which its difference of sums has too few digits left
LEAST_REMAINDER = 1e-6
# bytes allocated and freed once before a pass. From then on the C library of Linux keeps freed memory up to twice as
# long for the next chunk; to take every page of it from the system again costs as much as half of the arithmetic
RETAINED = 1 << 24
ROWS_PER_COLUMN = 1.1
KEPT = 0.5


@dataclass(frozen=True, eq=False)
class Statistics:
    """Sufficient statistics of the regression: all that least squares needs to know of a record."""

    layout: Layout  # the columns
    gram: Array  # (n + l, n + l) Gram matrix of [Phi | Y], in squared data units
    rows: int  # rows used
    candidates: int  # rows that would have been used, had no sample been missing
    # upper triangular R with R^T R = gram, from a streamed QR decomposition; None when there was none
    factor: Array | None = None
    constants: int = 0  # of experiments that are eliminated, beside the one of the column of ones

    @property
    def method(self) -> Literal["gram", "qr"]:
        """How the statistics were taken."""
        return "gram" if self.factor is None else "qr"

    @cached_property
    def _triangle(self) -> Array:
        return root_of_gram(self.gram, self.layout.n_columns) if self.factor is None else self.factor

    @cached_property
    def root(self) -> Array:
        """Upper triangular R (n + l, n + l), diagonal >= 0, R^T R = gram; dependent columns raise a `RankError`."""
        column = dependent_column(self._triangle, self.layout.n_columns, self.method)
        if column is not None:
            raise RankError(_explain_dependence(self.layout, self._triangle, column))
        return self._triangle

    @cached_property
    def condition(self) -> float:
        """Estimate of the condition number of Phi with its columns scaled to norm one; inf when it is singular."""
        n = self.layout.n_columns
        return conditioning(self._triangle[:n, :n])

    @cached_property
    def remainder(self) -> float:
        """Sum of squares that least squares leaves of an output, as a share of the output; the smallest of them."""
        n = self.layout.n_columns
        energy = np.sum(self._triangle[:, n:] ** 2, axis=0)
        rest = np.sum(self._triangle[n:, n:] ** 2, axis=0)
        return float(np.min(np.where(energy > 0, rest / np.maximum(energy, np.finfo(float).tiny), 1.0)))

    def check(self) -> None:
        """Refuse a record that does not determine the parameters.

        Raises:
            RankError: fewer than 1.1 rows per column, or a column without energy.

        Warns:
            DataWarning: less than half of the rows are left by missing samples.
        """
        n, lost = self.layout.n_columns, 1 - self.rows / max(self.candidates, 1)
        if self.rows < ROWS_PER_COLUMN * n:
            needed = int(np.ceil(ROWS_PER_COLUMN * n))
            missing = f"Missing samples cost {100 * lost:.0f} % of {self.candidates} rows. " if lost > 0 else ""
            raise RankError(f"{self.rows} rows for {n} parameters: at least {needed} are needed. {missing}"
                            "Use a longer record, fewer lags or fewer basis functions.")
        energy = np.diag(self.gram)[:n]
        silent = np.flatnonzero(energy[: self.layout.na * self.layout.l] == 0)
        if silent.size:
            raise RankError(f"Output {self.layout.outputs[silent[0] % self.layout.l]!r} is zero in every used row.")
        for c, (channel, basis) in enumerate(zip(self.layout.inputs, self.layout.bases)):
            block = energy[self.layout.block(c)].reshape(-1, basis.size)
            lags, functions = np.nonzero(block <= 1e-14 * block.mean())
            if functions.size:
                raise RankError(_explain_silence(basis, channel, int(functions[0]), self.layout.lags[c][lags[0]]))
        if lost > KEPT:
            warnings.warn(f"Missing samples leave {self.rows} of {self.candidates} rows ({100 * (1 - lost):.0f} %): a "
                          f"row is lost with any sample among its {self.layout.first_row} lags. Fewer lags keep more.",
                          DataWarning, stacklevel=3)


def collect(data: "Data | Stream", layout: Layout, weights: Sequence[Array] | None = None, chunk: int = CHUNK,
            threads: int | None = None) -> Statistics:
    """Take the statistics of a record that determines the parameters.

    A row is used when every sample it touches is present, in all inputs and outputs. The Gram matrix is replaced by a
    streamed QR decomposition, slower and with twice the digits, when `condition` exceeds 1e7 or the unexplained share
    of an output is so small that rounding reaches it; `Statistics.method` says which it was.

    Args:
        data: experiments in memory, or a stream that can be read twice.
        layout: the columns.
        weights: one array (N,) per experiment, weight >= 0 of the row of each sample; None for ones. Not for streams.
        chunk: samples evaluated at a time.
        threads: threads that sum up Gram matrices while the record is read; None for one per core. The result is the
            same to the last digit whatever their number, and a short record takes one.

    Raises:
        RankError: an experiment shorter than the lags, too few rows, a silent basis function, dependent columns.
        DataError: other channels than in the layout, weights that do not fit, samples outside a basis with
            outside="error".

    Warns:
        DataWarning: less than half of the rows are left by missing samples.
    """
    statistics = accumulate(data, layout, weights, chunk, threads)
    statistics.check()
    if statistics.condition > CONDITION_LIMIT or statistics.remainder < LEAST_REMAINDER:
        statistics = factorise(data, layout, weights, chunk)
        _ = statistics.root  # refuses dependent columns by name
    return statistics


def accumulate(data: "Data | Stream", layout: Layout, weights: Sequence[Array] | None = None, chunk: int = CHUNK,
               threads: int | None = None) -> Statistics:
    """Take the Gram matrix in one pass, without asking whether the record determines the parameters.

    Arguments and errors as `collect`.
    """
    threads = available_cores(threads)
    sums = _total(data, layout, weights, chunk, threads, partial(Sums, Frame.of(layout)))
    gram = layout.reduce_rows(layout.reduce_rows(sums.complete()).T)
    return Statistics(layout, (gram + gram.T) / 2, sums.rows, sums.candidates)


def factorise(data: "Data | Stream", layout: Layout, weights: Sequence[Array] | None = None, chunk: int = CHUNK
              ) -> Statistics:
    """Take the triangular factor in one pass, by tall and skinny QR decomposition.

    Arguments and errors as `collect`, without its checks of rank.
    """
    total = _total(data, layout, weights, chunk, 1, partial(Factor, layout.n_columns + layout.l, layout.reduce_rows))
    return Statistics(layout, total.root.T @ total.root, total.rows, total.candidates, total.root)


def residuals(data: "Data", layout: Layout, theta: Array, chunk: int = CHUNK) -> list[Array]:
    """Compute the one-step residuals Y - Phi theta of coefficients (n_columns, l) without forming Phi.

    Return one array (N, l) per experiment, NaN where a sample of the row is missing or before the record.
    """
    check_channels(data, layout)
    reach, found = layout.first_row, []
    for e in data.experiments:
        parts = [_residuals_of(u, y, layout, theta) for u, y in stretches([(e.u, e.y)], reach, max(chunk, reach))]
        found.append(np.concatenate([np.full(e.y[:reach].shape, np.nan), *parts]))
    return found


def _residuals_of(u: Array, y: Array, layout: Layout, theta: Array) -> Array:
    """Return the residuals (R, l) of a stretch: u (reach + R, m), y (reach + R, l)."""
    reach, end, outs = layout.first_row, len(y), layout.l
    error = y[reach:] - theta[layout.offset]
    for i in range(1, layout.na + 1):
        error += y[reach - i : end - i] @ theta[(i - 1) * outs : i * outs]
    for c, (basis, lags) in enumerate(zip(layout.bases, layout.lags)):
        by_lag = theta[layout.block(c)].reshape(len(lags), basis.size, outs)
        first, weights = basis.local(u[:, c])
        for lag, column in zip(lags, basis.contrast @ by_lag):
            at = slice(reach - lag, end - lag)
            for i, weight in enumerate(weights[at].T):
                error -= weight[:, None] * column[first[at] + i]
    error[~used_rows(u, y, layout)] = np.nan
    return error


def _total(
    data: Any, layout: Layout, weights: Sequence[Array] | None, chunk: int, threads: int, start: Callable[[], Total]
) -> Any:
    """Return the sums over all rows of a record; `start` returns empty ones."""
    np.empty(RETAINED, dtype=np.uint8)  # freed at once
    check_channels(data, layout)
    if weights is not None and not hasattr(data, "experiments"):
        raise DataError("weights are for records in memory; a stream has none.")
    if getattr(data, "parts", ()):
        return total_of_parts(data, layout, start, chunk, threads)

    parts = (part for name, chunks in records(data, layout, weights) for part in cut(chunks, name, layout, chunk))
    total = start()
    for sums in map_parts(lambda stretch: start().add_all(blocks_of(stretch, layout, chunk)), parts, threads):
        total.merge(sums)
    return total


def _explain_silence(basis: Basis, channel: str, function: int, lag: int) -> str:
    points = basis.grid(2001)
    alive = points[basis.values(points)[:, function] != 0]
    where = f", which lives on [{alive[0]:.4g}, {alive[-1]:.4g}]," if alive.size else ""
    whole = "[{:.4g}, {:.4g}]".format(*basis.interval) if basis.interval else "the real line"
    return (f"Function {function + 1} of {basis.size} of {type(basis).__name__} on {whole}, input {channel!r}{where} "
            f"is never excited at lag {lag}: no sample of a used row reaches it. Use fewer functions, a narrower "
            "interval, or data that cover it.")


def _explain_dependence(layout: Layout, root: Array, column: int) -> str:
    names = layout.names()
    scale = np.linalg.norm(root[:, : column + 1], axis=0)
    combination = np.linalg.lstsq(root[:column, :column] / scale[:column], root[:column, column] / scale[column])[0]
    partners = [names[j] for j in np.argsort(-np.abs(combination))[:3] if abs(combination[j]) > 1e-3]
    return (f"Column {names[column]} of the regressor depends on {', '.join(partners) or 'the columns before it'}: "
            "the record does not distinguish them. Use fewer lags or basis functions, or an input with more levels and "
            "frequencies.")
