"""The regression y = Phi theta + e behind an ARX model with static nonlinearities, and its sufficient statistics.

Nothing of size samples x parameters is formed: one pass over the record gives the Gram matrix of [Phi | Y], which is
all that a least-squares objective needs. Statistics add up, over chunks, experiments and workers.
"""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optid.bases.basis import Array, Basis
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.regressors.factors import add_to_root, conditioning, dependent_column, root_of_gram
from optid.regressors.layout import Layout
from optid.regressors.sums import FORMED, Block, Sums, dense_rows, make_block, rows_present, stretches
from optid.regressors.workers import available_threads, mapped

if TYPE_CHECKING:
    from optid.data import Data
    from optid.streams import Stream

CHUNK = 32768
"""Samples evaluated at a time: their basis functions stay in the processor's cache."""

CONDITION_LIMIT = 1e7
"""Condition number of the scaled regressor beyond which the Gram matrix, which squares it, has too few digits left."""

BLOCKS = 4
"""Chunks, at least, that one thread takes at a time: longer ones do not occupy all threads in a common record."""

RETAINED = 1 << 23
"""Bytes allocated and freed once before a pass. From then on the C library of Linux keeps freed memory up to twice as
long for the next chunk; to take every page of it from the system again costs as much as half of the arithmetic."""

ROWS_PER_COLUMN = 1.1
KEPT = 0.5


@dataclass(frozen=True, eq=False)
class Statistics:
    """Sufficient statistics of the regression: all that least squares needs to know of a record.

    Statistics of one layout add up exactly: `a + b` are those of both records.

    Attributes:
        layout: the columns.
        gram: (n + l, n + l) Gram matrix of [Phi | Y], in squared data units.
        rows: rows used.
        candidates: rows that would have been used, had no sample been missing.
        factor: upper triangular R with R^T R = gram, from a streamed QR decomposition; None when there was none.
    """

    layout: Layout
    gram: Array
    rows: int
    candidates: int
    factor: Array | None = None

    def __add__(self, other: "Statistics") -> "Statistics":
        if self.layout != other.layout:
            raise StructureError("Statistics to be added must have the same layout: na, nb, nk, bases and names.")
        factor = None  # digits that one Gram matrix has lost do not come back
        if self.factor is not None and other.factor is not None:
            factor = add_to_root(self.factor, other.factor)
        return Statistics(
            self.layout, self.gram + other.gram, self.rows + other.rows, self.candidates + other.candidates, factor
        )

    @property
    def method(self) -> Literal["gram", "qr"]:
        """How the statistics were taken."""
        return "gram" if self.factor is None else "qr"

    @cached_property
    def _triangle(self) -> Array:
        return root_of_gram(self.gram, self.layout.n_columns) if self.factor is None else self.factor

    @cached_property
    def root(self) -> Array:
        """Upper triangular R (n + l, n + l), diagonal >= 0, with R^T R = gram.

        Raises:
            RankError: a column of Phi depends on the columns before it; named.
        """
        column = dependent_column(self._triangle, self.layout.n_columns, self.method)
        if column is not None:
            raise RankError(_explain_dependence(self.layout, self._triangle, column))
        return self._triangle

    @cached_property
    def condition(self) -> float:
        """Estimate of the condition number of Phi with its columns scaled to norm one; inf when it is singular."""
        n = self.layout.n_columns
        return conditioning(self._triangle[:n, :n])

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
            raise RankError(
                f"{self.rows} rows for {n} parameters: at least {needed} are needed. {missing}"
                "Use a longer record, fewer lags or fewer basis functions."
            )
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
            warnings.warn(
                f"Missing samples leave {self.rows} of {self.candidates} rows ({100 * (1 - lost):.0f} %): a row is "
                f"lost with any sample among its {self.layout.first_row} lags. Fewer lags keep more.",
                DataWarning,
                stacklevel=3,
            )


def collect(
    data: "Data | Stream",
    layout: Layout,
    weights: Sequence[Array] | None = None,
    method: Literal["auto", "gram", "qr"] = "auto",
    chunk: int = CHUNK,
    threads: int | None = None,
) -> Statistics:
    """Take the statistics of a record that determines the parameters.

    A row is used when every sample it touches is present, in all inputs and outputs.

    Args:
        data: experiments in memory, or a stream that can be read twice.
        layout: the columns.
        weights: one array (N,) per experiment, weight >= 0 of the row of each sample; None for ones. Not for streams.
        method: "gram" in one pass; "qr" by QR decomposition of the factor so far stacked on the next rows, slower and
            with twice the digits; "auto" takes the Gram matrix first and "qr" when `condition` exceeds 1e7.
            `Statistics.method` says which it was.
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
    if method not in ("auto", "gram", "qr"):
        raise StructureError(f"method={method!r}: use 'auto', 'gram' or 'qr'.")
    if method == "qr":
        statistics = factorise(data, layout, weights, chunk)
        statistics.check()
        return statistics
    statistics = accumulate(data, layout, weights, chunk, threads)
    statistics.check()
    if method == "auto" and statistics.condition > CONDITION_LIMIT:
        statistics = factorise(data, layout, weights, chunk)
        _ = statistics.root  # refuses dependent columns by name
    return statistics


def accumulate(
    data: "Data | Stream",
    layout: Layout,
    weights: Sequence[Array] | None = None,
    chunk: int = CHUNK,
    threads: int | None = None,
) -> Statistics:
    """Take the Gram matrix in one pass, without asking whether the record determines the parameters.

    This is for parts of a record that are to be added; arguments and errors as `collect`.
    """
    threads = available_threads(threads)
    sums = _sum(data, layout, weights, chunk, threads, direct=False)
    complete = sums.complete()
    if sums.cancelled(complete):
        sums = _sum(data, layout, weights, chunk, threads, direct=True)
        complete = sums.complete()
    gram = layout.contrasted(layout.contrasted(complete).T)
    return Statistics(layout, (gram + gram.T) / 2, sums.rows, sums.candidates)


def factorise(
    data: "Data | Stream", layout: Layout, weights: Sequence[Array] | None = None, chunk: int = CHUNK
) -> Statistics:
    """Take the triangular factor in one pass, by tall and skinny QR decomposition.

    Arguments and errors as `collect`, without its checks of rank.
    """
    n = layout.n_columns + layout.l
    root, rows, candidates = np.zeros((n, n)), 0, 0
    for block in chain.from_iterable(_blocks(part, layout, chunk) for part in _parts(data, layout, weights, chunk)):
        used = np.flatnonzero(block.valid)
        rows, candidates = rows + used.size, candidates + block.candidates
        for start in range(0, used.size, FORMED):
            part = used[start : start + FORMED]
            formed = layout.contrasted(dense_rows(block, part, layout.n_complete))
            if block.weights is not None:
                formed *= np.sqrt(block.weights[part])[:, None]
            root = add_to_root(root, formed)
    return Statistics(layout, root.T @ root, rows, candidates, root)


def residuals(data: "Data", layout: Layout, theta: Array, chunk: int = CHUNK) -> list[Array]:
    """Compute the one-step residuals Y - Phi theta without forming Phi.

    Args:
        data: the experiments.
        layout: the columns of Phi.
        theta: (n_columns, l) coefficients.
        chunk: samples evaluated at a time.

    Returns:
        One array (N, l) per experiment, in output units; NaN where a sample of the row is missing or before the record.
    """
    theta = np.asarray(theta, dtype=float)
    if theta.shape != (layout.n_columns, layout.l):
        raise StructureError(f"theta has shape {theta.shape}; this layout needs ({layout.n_columns}, {layout.l}).")
    _check_channels(data, layout)
    return [_residuals_of(e.u, e.y, layout, theta, chunk) for e in data.experiments]


def _residuals_of(u: Array, y: Array, layout: Layout, theta: Array, chunk: int) -> Array:
    reach, outs = layout.first_row, layout.l
    result = np.full(y.shape, np.nan)
    tables = [
        np.tensordot(basis.contrast, theta[layout.block(c)].reshape(b, basis.size, outs), axes=(1, 1))
        for c, (b, basis) in enumerate(zip(layout.nb, layout.bases))
    ]  # (full size, lags, l)
    start = reach
    for part_u, part_y in stretches([(u, y)], reach, max(chunk, reach)):
        count = len(part_y) - reach
        error = part_y[reach:] - theta[layout.offset]
        for i in range(1, layout.na + 1):
            error += part_y[reach - i : reach - i + count] @ theta[(i - 1) * outs : i * outs]
        for c, (basis, table) in enumerate(zip(layout.bases, tables)):
            first, values = basis.local(part_u[:, c])
            for lag, column in zip(layout.lags[c], table.transpose(1, 0, 2)):
                at = slice(reach - lag, reach - lag + count)
                for i, weight in enumerate(values[at].T):
                    error -= weight[:, None] * column[first[at] + i]
        error[~rows_present(part_u, part_y, layout)] = np.nan
        result[start : start + count] = error
        start += count
    return result


@dataclass(frozen=True)
class _Part:
    """Part of a record: [u, y] or [u, y, weights] with the samples before its rows, and where it begins."""

    arrays: list[Array]
    record: str
    position: int


def _sum(
    data: Any, layout: Layout, weights: Sequence[Array] | None, chunk: int, threads: int, direct: bool
) -> Sums:
    def sum_part(part: _Part) -> Sums:
        sums = Sums(layout, direct)
        for block in _blocks(part, layout, chunk):
            sums.add(block)
        return sums

    np.empty(RETAINED, dtype=np.uint8)  # freed at once
    total = Sums(layout, direct)
    for sums in mapped(sum_part, _parts(data, layout, weights, chunk), threads):
        total.merge(sums)
    return total


def _parts(data: Any, layout: Layout, weights: Sequence[Array] | None, chunk: int) -> Iterator[_Part]:
    size = _block_size(layout, chunk)
    length = size * max(BLOCKS, layout.n_complete**2 // (4 * size))  # merging the sums must not cost much
    for name, chunks in _records(data, layout, weights):
        for i, arrays in enumerate(stretches(chunks, layout.first_row, length)):
            yield _Part(arrays, name, i * length)


def _blocks(part: _Part, layout: Layout, chunk: int) -> Iterator[Block]:
    size = _block_size(layout, chunk)
    for i, (u, y, *weights) in enumerate(stretches([part.arrays], layout.first_row, size)):
        _check_inside(u, layout, part.record, part.position + i * size)
        yield make_block(u, y, weights[0] if weights else None, layout)


def _block_size(layout: Layout, chunk: int) -> int:
    """New samples of a block; with those before them they are a chunk, so that chunks of a file are cut evenly."""
    return max(chunk - layout.first_row, 32 * layout.first_row, 1)


def _records(
    data: Any, layout: Layout, weights: Sequence[Array] | None
) -> Iterator[tuple[str, Iterable[Sequence[Array]]]]:
    """Yield the name and the chunks (u, y) or (u, y, weights) of every experiment."""
    _check_channels(data, layout)
    if not hasattr(data, "experiments"):
        if weights is not None:
            raise DataError("weights are for records in memory; a stream has none.")
        yield "", data
        return
    if weights is not None and len(weights) != len(data.experiments):
        raise DataError(f"{len(weights)} arrays of weights for {len(data.experiments)} experiments: give one each.")
    for i, experiment in enumerate(data.experiments):
        name = f"experiment {i + 1}: " if len(data.experiments) > 1 else ""
        count = len(experiment.y)
        if count <= layout.first_row:
            raise RankError(
                f"{name}{count} samples, but the lags reach back {layout.first_row}: no row is complete. Leave it out, "
                "or use fewer lags."
            )
        if weights is None:
            yield name, [(experiment.u, experiment.y)]
        else:
            yield name, [(experiment.u, experiment.y, _checked_weights(weights[i], count, name))]


def _checked_weights(weights: Any, count: int, name: str) -> Array:
    weights = np.asarray(weights, dtype=float)
    if weights.shape != (count,):
        raise DataError(f"{name}weights have shape {weights.shape}; one per sample is needed, ({count},).")
    bad = ~(np.isfinite(weights) & (weights >= 0))
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(f"{name}weight of sample {k} is {weights[k]}: weights are finite and not negative.")
    return weights


def _check_channels(data: Any, layout: Layout) -> None:
    for kind, given, wanted in (("inputs", data.inputs, layout.inputs), ("outputs", data.outputs, layout.outputs)):
        if len(given) != len(wanted):
            raise DataError(
                f"The data have {len(given)} {kind} ({', '.join(given)}), the model {len(wanted)} "
                f"({', '.join(wanted)})."
            )


def _check_inside(u: Array, layout: Layout, name: str, position: int) -> None:
    for c, basis in enumerate(layout.bases):
        if basis.outside == "error" and basis.n_outside(u[:, c]):
            k = next(k for k in range(len(u)) if basis.n_outside(u[k : k + 1, c]))
            raise DataError(
                f"{name}input {layout.inputs[c]!r}, sample {position + k}: {u[k, c]:g} is outside the interval "
                f"{basis.interval} of the basis. Use data inside it, or outside='clamp' or 'extrapolate'."
            )


def _explain_silence(basis: Basis, channel: str, function: int, lag: int) -> str:
    points = basis.grid(2001)
    alive = points[basis.values(points)[:, function] != 0]
    where = f", which lives on [{alive[0]:.4g}, {alive[-1]:.4g}]," if alive.size else ""
    whole = "[{:.4g}, {:.4g}]".format(*basis.interval) if basis.interval else "the real line"
    return (
        f"Function {function + 1} of {basis.size} of {type(basis).__name__} on {whole}, input {channel!r}{where} is "
        f"never excited at lag {lag}: no sample of a used row reaches it. Use fewer functions, a narrower interval, "
        "or data that cover it."
    )


def _explain_dependence(layout: Layout, root: Array, column: int) -> str:
    names = layout.names()
    scale = np.linalg.norm(root[:, : column + 1], axis=0)
    combination = np.linalg.lstsq(root[:column, :column] / scale[:column], root[:column, column] / scale[column])[0]
    partners = [names[j] for j in np.argsort(-np.abs(combination))[:3] if abs(combination[j]) > 1e-3]
    return (
        f"Column {names[column]} of the regressor depends on {', '.join(partners) or 'the columns before it'}: "
        "the record does not tell them apart. Use fewer lags or basis functions, or an input with more levels and "
        "frequencies."
    )
