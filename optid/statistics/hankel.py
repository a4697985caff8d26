"""Gram matrices of block Hankel matrices that are never formed.

A column of a block Hankel matrix is a window: the samples s(k), ..., s(k + rows - 1) of d signals. Block (i, j) of the
Gram matrix over all windows of a run of samples depends on j - i only, up to the two ends of the run, so that one
product of the signals per lag replaces one per pair of block rows. Ends are added, never subtracted: no digit is lost.

Windows that touch a missing sample are left out, which cuts a record into runs; experiments are further runs.
Statistics add up over runs, experiments, chunks and workers.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array, check_integer
from optid.data.stretches import runs_of
from optid.errors import DataError, RankError, StructureError
from optid.statistics.factors import add_to_root, conditioning, dependent_column, root_of_gram

Expand = Callable[[Array], Array]
"""From raw channels (T, c) to signals (T, d), sample by sample."""

CHUNK = 8192
"""Samples expanded at a time."""

WIDE = 128
"""Signals times samples of the blocks whose products are taken at once."""

FORMED = 2048
"""Windows formed at once where that is the cheapest way."""

CONDITION_LIMIT = 1e5
"""Condition number of the scaled windows beyond which their Gram matrix, which squares it, is replaced by a streamed QR
decomposition: small singular values would drown in its rounding, about 1e-16 times the square of it."""


@dataclass(frozen=True, eq=False)
class HankelStatistics:
    """Second moments of [1; s(k) - centre; ...; s(k + rows - 1) - centre] over all complete windows k.

    Position 0 is the constant; signal c at block row i has position 1 + i d + c (`at`).

    Attributes:
        rows: number of block rows.
        names: names of the d signals.
        centre: (d,) subtracted from the signals beforehand.
        gram: (1 + rows d, 1 + rows d) sum over the windows, in squared units of the signals.
        candidates: number of windows there would be, were no sample missing.
        factor: upper triangular R with R^T R = gram from a streamed QR decomposition; None when there was none.
    """

    rows: int
    names: tuple[str, ...]
    centre: Array
    gram: Array
    candidates: int
    factor: Array | None = None

    @property
    def d(self) -> int:
        """Number of signals."""
        return len(self.names)

    @property
    def windows(self) -> int:
        """Number of windows, the columns of the Hankel matrix."""
        return round(float(self.gram[0, 0]))

    @property
    def method(self) -> Literal["gram", "qr"]:
        """How the statistics were taken."""
        return "gram" if self.factor is None else "qr"

    def __add__(self, other: "HankelStatistics") -> "HankelStatistics":
        if (self.rows, self.names) != (other.rows, other.names) or not np.array_equal(self.centre, other.centre):
            raise StructureError("Hankel statistics to be added must have the same block rows, signals and centre.")
        factor = None  # digits that one Gram matrix has lost do not come back
        if self.factor is not None and other.factor is not None:
            factor = add_to_root(self.factor, other.factor)
        return HankelStatistics(self.rows, self.names, self.centre, self.gram + other.gram,
                                self.candidates + other.candidates, factor)

    def at(self, signals: Sequence[int] | range, rows: Sequence[int] | range | None = None) -> NDArray[np.intp]:
        """Return the positions of some signals at some block rows (all by default), block rows outermost."""
        block_rows = np.asarray(range(self.rows) if rows is None else rows, dtype=np.intp)
        return (1 + block_rows[:, None] * self.d + np.asarray(signals, dtype=np.intp)[None, :]).ravel()

    def name(self, position: int) -> str:
        """Name what stands at a position."""
        if position == 0:
            return "the constant"
        row, signal = divmod(position - 1, self.d)
        return f"{self.names[signal]} at block row {row + 1}"

    def triangle(self, order: Sequence[int] | NDArray[np.intp]) -> Array:
        """Return the upper triangular R, diagonal >= 0, with R^T R = gram[order][:, order]."""
        order = np.asarray(order, dtype=np.intp)
        if self.factor is not None:
            return add_to_root(np.zeros((order.size, order.size)), self.factor[:, order])
        return root_of_gram(self.gram[np.ix_(order, order)], order.size)

    @cached_property
    def root(self) -> Array:
        """Upper triangular R, diagonal >= 0, with R^T R = gram."""
        return self.triangle(np.arange(len(self.gram)))

    @cached_property
    def condition(self) -> float:
        """Estimate of the condition number of the windows with their rows scaled to norm one; inf when singular."""
        return conditioning(self.root)

    def sizes(self, signals: Sequence[int] | range, centred: bool = True) -> Array:
        """Standard deviation of some signals over windows and block rows; root mean square where not centred."""
        at = self.at(signals).reshape(self.rows, -1)
        energy = np.diag(self.gram)[at].mean(axis=0) / self.windows
        if centred:
            energy -= self.gram[0, at].mean(axis=0) ** 2 / self.windows**2
        return np.sqrt(np.maximum(energy, 1e-300))

    def check(self, per_row: float = 1.0) -> None:
        """Refuse fewer windows than `per_row` times the rows of the Hankel matrix.

        Raises:
            RankError: with both numbers.
        """
        needed = int(np.ceil(per_row * self.rows * self.d)) + 1
        if self.windows < needed:
            lost = self.candidates - self.windows
            missing = f" (missing samples cost {lost} of {self.candidates})" if lost else ""
            raise RankError(
                f"{self.windows} complete windows of {self.rows} samples{missing} for {self.rows} block rows of "
                f"{self.d} signals: at least {needed} are needed. Use a longer record, fewer block rows or fewer basis "
                "functions."
            )


def hankel_statistics(records: Sequence[Array], rows: int, expand: Expand | None = None, *,
                      names: Sequence[str] | None = None, centre: Array | Literal["mean"] | None = None,
                      method: Literal["auto", "gram", "qr"] = "auto", chunk: int = CHUNK) -> HankelStatistics:
    """Take the statistics of all windows of some records.

    Args:
        records: one array (N, c) per experiment; NaN = missing.
        rows: block rows, the samples of a window.
        expand: turns raw channels (T, c) into signals (T, d), for instance the functions of a basis; chunk by chunk, so
            that the signals of a whole record never exist. None for the channels themselves.
        names: one name per signal.
        centre: (d,) to be subtracted from the signals, or "mean" for about their means; it keeps the digits of signals
            far from zero and changes nothing where the constant is an instrument and a regressor.
        method: "gram" in one pass; "qr" by QR decomposition of the factor so far stacked on the next windows, slower
            and with twice the digits; "auto" takes the Gram matrix and goes over to "qr" when `condition` is above 1e5.
        chunk: samples expanded at a time.

    Raises:
        StructureError: rows < 1, an unknown method.
        RankError: an experiment shorter than the block rows, or no complete window at all.
    """
    check_integer(rows, "rows")
    if method not in ("auto", "gram", "qr"):
        raise StructureError(f"method={method!r}: use 'auto', 'gram' or 'qr'.")
    records = [np.asarray(record, dtype=float) for record in records]
    for i, record in enumerate(records):
        if record.ndim != 2:
            raise DataError(f"experiment {i + 1}: an array (N, channels) is needed; got shape {record.shape}.")
        if len(record) < rows:
            raise RankError(
                f"experiment {i + 1} has {len(record)} samples, fewer than a window of {rows}: leave it out or use "
                "fewer block rows."
            )
    runs = [run for record in records for run in complete_runs(record, rows)]
    candidates = sum(len(record) - rows + 1 for record in records)
    if not runs:
        raise RankError(f"no window of {rows} samples is complete: every one touches a missing sample. Use fewer block "
                        "rows or data with fewer gaps.")
    d = runs[0].shape[1] if expand is None else expand(runs[0][:1]).shape[1]
    sums = _Sums(rows, expand, d, chunk)
    names = tuple(names) if names is not None else tuple(f"s{c + 1}" for c in range(sums.d))
    if len(names) != sums.d:
        raise StructureError(f"{len(names)} names for {sums.d} signals.")
    if isinstance(centre, str):
        spread = [sums.evaluated(run[:: 1 + len(run) // chunk]) for run in runs]  # a centre has to be near, no more
        sums.centre = np.concatenate(spread).mean(axis=0)
    elif centre is not None:
        sums.centre = np.asarray(centre, dtype=float)
    if method != "qr":
        for run in runs:
            sums.add(run)
        found = HankelStatistics(rows, names, sums.centre, sums.gram(), candidates)
        if method == "gram" or found.condition <= CONDITION_LIMIT:
            return found
    root = sums.factorised(runs)
    return HankelStatistics(rows, names, sums.centre, root.T @ root, candidates, root)


def complete_runs(record: Array, rows: int) -> Iterator[Array]:
    """Yield the stretches of at least `rows` samples of a record (N, c) in which nothing is missing."""
    if not np.isnan(record.sum()):  # the usual case, ten times faster
        yield record
        return
    for start, stop in runs_of(~np.isnan(record).any(axis=1)):
        if stop - start >= rows:
            yield record[start:stop]


def windows_of(signals: Array, rows: int) -> Array:
    """View the windows of signals (T, d) as (T - rows + 1, rows, d), nothing copied."""
    return np.lib.stride_tricks.sliding_window_view(signals, rows, axis=0).transpose(0, 2, 1)


def dependent_signal(statistics: HankelStatistics, order: Sequence[int] | NDArray[np.intp]) -> str | None:
    """Name the first of some positions whose row of the Hankel matrix depends on those before it, or None."""
    order = np.asarray(order, dtype=np.intp)
    column = dependent_column(statistics.triangle(order), order.size, statistics.method)
    if column is None:
        return None
    return statistics.name(int(order[column]))


class _Sums:
    """Running sums over runs: per lag in the middle of a run, of windows that are formed at its ends."""

    def __init__(self, rows: int, expand: Expand | None, d: int, chunk: int) -> None:
        self.rows, self.d = rows, d
        self.centre: Array = np.zeros(d)
        self._expand, self._chunk = expand, max(chunk, 4 * rows)
        self._middle = np.zeros((rows, d, d))  # sum of s(k) s(k + lag)^T
        self._total = np.zeros(d)
        self._ends = np.zeros((rows * d, 1 + rows * d))  # those of block rows not above the diagonal do not count
        self._windows = 0

    def evaluated(self, raw: Array) -> Array:
        """Return the signals of some samples, less the centre."""
        signals = raw if self._expand is None else self._expand(raw)
        return signals - self.centre if np.any(self.centre) else np.ascontiguousarray(signals)

    def add(self, run: Array) -> None:
        """Add the windows of a run of complete samples."""
        rows, count = self.rows, len(run) - self.rows + 1
        self._windows += count
        if count < rows:
            self._add_formed(self.evaluated(run), np.ones((count, rows)))
            return
        signals = self.evaluated(run[rows - 1 : rows - 1 + self._chunk])
        start = rows - 1  # of the signals at hand; the middle is rows - 1 <= k < count
        while start < count:
            stop = min(start + len(signals) - (rows - 1), count)
            self._add_lags(signals, stop - start)
            following = run[start + len(signals) : start + len(signals) + self._chunk]
            signals, start = signals[stop - start :], stop
            if len(following):
                signals = np.concatenate([signals, self.evaluated(following)])
        if rows > 1:  # windows k < rows - 1 with k + i < rows - 1, and k > count - rows with k + i >= count
            early = np.add.outer(np.arange(rows - 1), np.arange(rows)) < rows - 1
            self._add_formed(self.evaluated(run[: 2 * rows - 2]), early)
            self._add_formed(self.evaluated(run[count - rows + 1 :]), ~early)

    def _add_formed(self, signals: Array, counted: NDArray) -> None:
        """Add the products of the samples that count, by window and block row, with the samples after them."""
        windows = windows_of(signals, self.rows)
        whole = windows.reshape(len(windows), -1)
        part = (windows * counted[:, :, None]).reshape(whole.shape)
        self._ends[:, 0] += part.sum(axis=0)
        self._ends[:, 1:] += part.T @ whole

    def _add_lags(self, signals: Array, count: int) -> None:
        """Add the products of the first `count` samples with those up to rows - 1 samples later."""
        rows, d = self.rows, self.d
        step = min(rows, max(1, WIDE // d))  # samples of a block: large products are fast, the diagonals are added up
        following = -(-(rows - 1) // step)  # blocks that the largest lag reaches
        blocks = max((count + rows - 1) // step - following, 0)
        views = [signals[i * step : (i + blocks) * step].reshape(blocks, step * d) for i in range(following + 1)]
        products = np.concatenate([(views[0].T @ view).reshape(step, d, step, d) for view in views], axis=2)
        found = sum((products[i, :, i : i + rows] for i in range(step)), np.zeros((d, rows, d)))
        if blocks * step < count:
            rest = windows_of(signals[blocks * step : count + rows - 1], rows).reshape(-1, rows * d)
            found += (signals[blocks * step : count].T @ rest).reshape(d, rows, d)
        self._middle += found.transpose(1, 0, 2)
        self._total += np.ones(count) @ signals[:count]

    def gram(self) -> Array:
        """Return the Gram matrix of [1; window], symmetric."""
        rows, d = self.rows, self.d
        upper = np.zeros((1 + rows * d, 1 + rows * d))
        upper[1:] = self._ends
        for i in range(rows):
            start = 1 + i * d
            upper[start : start + d, start:] += self._middle[: rows - i].transpose(1, 0, 2).reshape(d, -1)
        upper[0] = np.concatenate([[self._windows], upper[1:, 0] + np.tile(self._total, rows)])
        return np.triu(upper) + np.triu(upper, 1).T

    def factorised(self, runs: Sequence[Array]) -> Array:
        """Return the triangular factor of [1; window] over all runs by stacked QR decompositions."""
        n = 1 + self.rows * self.d
        root, waiting, size = np.zeros((n, n)), [], max(FORMED, 2 * n)
        for run in runs:
            for start in range(0, len(run) - self.rows + 1, size):
                waiting.append(run[start : start + size + self.rows - 1])
                if sum(map(len, waiting)) >= size:
                    root, waiting = add_to_root(root, self._formed(waiting)), []
        return add_to_root(root, self._formed(waiting)) if waiting else root

    def _formed(self, runs: Sequence[Array]) -> Array:
        parts = [windows_of(self.evaluated(run), self.rows).reshape(len(run) - self.rows + 1, -1) for run in runs]
        stacked = np.concatenate(parts)
        return np.concatenate([np.ones((len(stacked), 1)), stacked], axis=1)
