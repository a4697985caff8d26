"""The statistics from which orders are found: windows of the expanded signals, and their instruments."""

from collections.abc import Sequence

import numpy as np

from optid.arrays import Array, check_integer
from optid.errors import RankError, StructureError
from optid.identify.order.ranks import RankTest, rank_test
from optid.statistics.expansion import Expansion
from optid.statistics.hankel import HankelStatistics, hankel_statistics

FEWEST, PER_ROW = 2, 1.5
"""Block rows at least; windows per row of the longest windows that are wanted."""


def block_rows_for(records: Sequence[Array], expansion: Expansion, given: int | None, nx: int | None = None) -> int:
    """Return the future block rows: as given, or 10, or more for a large order, or fewer on a short record.

    Raises:
        StructureError: fewer than 2, or not more than the order asked for per output.
        RankError: an experiment shorter than three times the block rows, which is named.
    """
    if given is None:
        alpha = expansion.block_rows(records, nx, spans=3, per_row=PER_ROW, least=FEWEST)
    else:
        alpha = check_integer(given, "block_rows", FEWEST)
    if nx is not None and (alpha - 1) * expansion.l < nx:
        raise StructureError(
            f"{alpha} block rows of {expansion.l} outputs show orders up to {(alpha - 1) * expansion.l}, not {nx}: use "
            f"block_rows={-(-nx // expansion.l) + 1} or more."
        )
    for i, record in enumerate(records):
        if len(record) < 3 * alpha:
            raise RankError(
                f"Experiment {i + 1} has {len(record)} samples, fewer than three times the {alpha} block rows: leave "
                "it out or use fewer block rows."
            )
    return alpha


def order_test(records: Sequence[Array], expansion: Expansion, alpha: int, *, instruments: str = "simulated",
               offset: bool = True, level: float | None = None, statistics: HankelStatistics | None = None) -> RankTest:
    """Test the ranks of the projected outputs; several outputs count relative to their sizes.

    Args:
        records: raw channels [u | y], or [u | y | simulated y] where the expansion reads simulated outputs.
        expansion: the signals.
        alpha: future block rows; the past has as many, and so has the reach of the serial correlation.
        instruments: as in `Expansion.positions`; noise of any colour leaves past and future inputs valid, and functions
            of outputs simulated from them.
        offset: whether a constant is among instruments and regressors.
        level: as in `rank_test`.
        statistics: of windows of 3 alpha samples, where they exist already.

    Raises:
        RankError: too short a record, or instruments that do not reach the regressors.
    """
    if statistics is None:
        statistics = hankel_statistics(records, 3 * alpha, expansion, names=expansion.names,
                                       centre="mean" if offset else None)
    z, phi, y = expansion.positions(statistics.at, instruments, alpha, offset)
    scale = np.tile(statistics.sizes(expansion.y, offset), alpha) if expansion.l > 1 else None
    return rank_test(statistics, z, phi, y, rows=2 * alpha, level=level, largest=(alpha - 1) * expansion.l, scale=scale)


def with_simulated_outputs(records: Sequence[Array], expansion: Expansion, alpha: int) -> tuple[list[Array], Expansion]:
    """Append outputs simulated from the inputs alone: least squares on the functions of the last 2 alpha samples.

    They are free of noise, so that functions of them are valid instruments for functions of measured outputs. The
    first 2 alpha - 1 samples of an experiment, and those after a missing input, are missing.
    """
    rows = 2 * alpha
    open_loop = expansion.without_feedback()
    statistics = hankel_statistics(records, rows, open_loop, names=open_loop.names, centre="mean")
    statistics.check()
    past = np.concatenate([[0], statistics.at(open_loop.eta)])
    now = statistics.at(open_loop.y, [rows - 1])
    theta = np.linalg.lstsq(statistics.gram[np.ix_(past, past)], statistics.gram[np.ix_(past, now)], rcond=1e-12)[0]
    weights = theta[1:].reshape(rows, open_loop.p, expansion.l)
    m, centre = expansion.m, statistics.centre
    extended = []
    for record in records:
        eta = open_loop(record)[:, : open_loop.p] - centre[: open_loop.p]
        count = len(record) - rows + 1
        simulated = np.full((len(record), expansion.l), np.nan)
        simulated[rows - 1 :] = theta[0] + centre[open_loop.p :]
        for i in range(rows):
            simulated[rows - 1 :] += eta[i : i + count] @ weights[i]
        extended.append(np.hstack([record[:, : m + expansion.l], simulated]))
    return extended, expansion.with_simulated()
