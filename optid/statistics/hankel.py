"""Gram matrices of block Hankel matrices that are never formed.

A column of a block Hankel matrix is a window: the samples s(k), ..., s(k + rows - 1) of d signals, a row of lagged
signals in `optid.statistics.sums`. Windows that touch a missing sample are left out.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array, check_integer, one_of
from optid.data.stretches import runs_of
from optid.errors import DataError, RankError, StructureError
from optid.statistics.blocks import Block, BlockSignals, Frame, rows_present, stretches
from optid.statistics.factors import CONDITION_LIMIT, add_to_root, conditioning, dependent_column, root_of_gram
from optid.statistics.sums import Factor, Sums

Expand = Callable[[Array], Array]  # from raw channels (T, c) to signals (T, d), sample by sample
# samples expanded at a time: they stay in the processor's cache. Eight of these chunks are summed up at a time
CHUNK = 4096


class RegressionRows(NamedTuple):
    """Positions of the rows of a regression with instruments (`HankelStatistics.at`; 0 is the constant)."""

    instruments: NDArray[np.intp]
    regressors: NDArray[np.intp]
    outputs: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class HankelStatistics:
    """Second moments of [1; s(k) - centre; ...; s(k + rows - 1) - centre] over all complete windows k.

    Position 0 is the constant; signal c at block row i has position 1 + i d + c (`at`).
    """

    rows: int  # number of block rows
    names: tuple[str, ...]  # names of the d signals
    centre: Array  # (d,) subtracted from the signals beforehand
    gram: Array  # (1 + rows d, 1 + rows d) sum over the windows, in squared units of the signals
    candidates: int  # number of windows there would be, were no sample missing
    # upper triangular R with R^T R = gram from a streamed QR decomposition; None when there was none
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
        """Refuse fewer windows than `per_row` times the rows of the Hankel matrix (`RankError`)."""
        needed = int(np.ceil(per_row * self.rows * self.d)) + 1
        if self.windows < needed:
            lost = self.candidates - self.windows
            missing = f" (missing samples cost {lost} of {self.candidates})" if lost else ""
            raise RankError(f"{self.windows} complete windows of {self.rows} samples{missing} for {self.rows} block "
                            f"rows of {self.d} signals: at least {needed} are needed. Use a longer record, fewer block "
                            "rows or fewer basis functions.")


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
    rows = check_integer(rows, "block rows")
    one_of("method", method, ("auto", "gram", "qr"))
    records = [np.asarray(record, dtype=float) for record in records]
    for i, record in enumerate(records):
        if record.ndim != 2:
            raise DataError(f"experiment {i + 1} must be an array (N, channels); got shape {record.shape}.")
        if len(record) < rows:
            raise RankError(f"experiment {i + 1} has {len(record)} samples, fewer than a window of {rows}: leave it "
                            "out or use fewer block rows.")
    runs = [run for record in records for run in complete_runs(record, rows)]
    if not runs:
        raise RankError(f"no window of {rows} samples is complete: every one touches a missing sample. Use fewer block "
                        "rows or data with fewer gaps.")
    expand = expand or np.asarray
    if isinstance(centre, str):  # a centre has to be near, no more
        centre = np.concatenate([expand(run[:: 1 + len(run) // chunk]) for run in runs]).mean(axis=0)
    middle = np.zeros(expand(runs[0][:1]).shape[1]) if centre is None else np.asarray(centre, dtype=float)
    d = middle.size
    names = tuple(names) if names is not None else tuple(f"s{c + 1}" for c in range(d))
    if len(names) != d:
        raise StructureError(f"{len(names)} names for {d} signals.")
    columns = np.arange(1, 1 + rows * d, dtype=np.int32).reshape(rows, d)
    frame = Frame((range(rows),), (columns[::-1],), 0)  # row i of a window lies rows - 1 - i samples before its last

    def total(sums: Any) -> Any:
        for record in records:
            for (raw,) in stretches([(record,)], frame.reach, max(8 * chunk, 32 * frame.reach)):
                sums.add(_block(raw, frame, expand, middle, chunk))
        return sums

    candidates = sum(len(record) - rows + 1 for record in records)
    if method != "qr":
        found = HankelStatistics(rows, names, middle, total(Sums(frame)).complete(), candidates)
        if method == "gram" or found.condition <= CONDITION_LIMIT:
            return found
    root = total(Factor(frame.n)).root
    return HankelStatistics(rows, names, middle, root.T @ root, candidates, root)


def _block(raw: Array, frame: Frame, expand: Expand, centre: Array, chunk: int) -> Block:
    """Evaluate the signals of one stretch (T, c)."""
    missing = np.isnan(raw @ np.ones(raw.shape[1]))  # sums of rows, by far the fastest in this form
    padded = np.zeros((len(raw) + 2 * frame.reach, centre.size))
    inner = padded[frame.reach : frame.reach + len(raw)]
    for start in range(0, len(raw), chunk):
        part = slice(start, start + chunk)
        if not missing[part].any():
            np.subtract(expand(raw[part]), centre, out=inner[part])
        elif not missing[part].all():
            inner[part][~missing[part]] = expand(raw[part][~missing[part]]) - centre
    valid = np.zeros(len(raw) + frame.reach, dtype=bool)
    valid[frame.reach : len(raw)] = rows_present([missing], frame.lags, frame.reach)
    return Block(frame, (BlockSignals.dense(padded),), valid, None, 0)


def complete_runs(record: Array, rows: int) -> Iterator[Array]:
    """Yield the stretches of at least `rows` samples of a record (N, c) in which nothing is missing."""
    if not np.isnan(record.sum()):  # the usual case, ten times faster
        yield record
        return
    for start, stop in runs_of(~np.isnan(record).any(axis=1)):
        if stop - start >= rows:
            yield record[start:stop]


def dependent_signal(statistics: HankelStatistics, order: Sequence[int] | NDArray[np.intp]) -> str | None:
    """Name the first of some positions whose row of the Hankel matrix depends on those before it, or None."""
    order = np.asarray(order, dtype=np.intp)
    column = dependent_column(statistics.triangle(order), order.size, statistics.method)
    return None if column is None else statistics.name(int(order[column]))
