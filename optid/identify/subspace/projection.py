"""The (A, C) step of the subspace methods: instruments, projection, range of the observability matrix, order."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optid.arrays import Array
from optid.errors import DataWarning, StructureError
from optid.statistics.expansion import Expansion
from optid.statistics.hankel import HankelStatistics, hankel_statistics
from optid.statistics.rq import RQ, rq

INSTRUMENTS = ("past", "inputs", "inputs+past", "simulated", "simulated+past")
WEIGHTINGS = ("moesp", "cva", "plain")

KEPT = 0.5
"""Share of the windows left by missing samples below which the user is told."""


@dataclass(frozen=True, eq=False)
class Range:
    """The weighted singular value decomposition behind an estimate of Gamma.

    Attributes:
        vectors: (rows l, rows l) left singular vectors of W r22.
        values: singular values, largest first.
        unweighted: W^-1, (rows l, rows l).
        l: number of outputs.
    """

    vectors: Array
    values: Array
    unweighted: Array
    l: int  # noqa: E741 - the field's letter

    @property
    def rows(self) -> int:
        """Number of block rows."""
        return len(self.vectors) // self.l

    def gamma(self, n: int) -> Array:
        """Return Gamma (rows l, n) in balanced coordinates: columns scaled by the roots of the singular values."""
        return self.unweighted @ (self.vectors[:, :n] * np.sqrt(self.values[:n]))


def estimate_range(blocks: RQ, l: int, weighting: str = "moesp", scale: Array | None = None) -> Range:  # noqa: E741
    """Decompose the projected outputs.

    Args:
        blocks: the RQ decomposition.
        l: number of outputs.
        weighting: "moesp" (outputs divided by their sizes), "cva" (the inverse root of the covariance of the future
            outputs with the regressors removed, so that singular values are canonical correlations: Larimore 1990) or
            "plain" (outputs in their units: at an order too low the larger ones come first).
        scale: (l,) size of every output, by which its rows are divided: outputs in small units are not lost.
    """
    sizes = np.tile(np.ones(l) if scale is None or weighting == "plain" else scale, len(blocks.r22) // l)
    r22, unweighted = blocks.r22 / sizes[:, None], np.diag(sizes)
    if weighting == "cva":
        whole = np.concatenate([r22, blocks.residual / sizes[:, None]], axis=1)
        left, values, _ = np.linalg.svd(whole, full_matrices=False)
        values = np.maximum(values, 1e-8 * values[0])  # directions without noise weigh much, not infinitely much
        r22, unweighted = (left / values) @ left.T @ r22, unweighted @ (left * values) @ left.T
    vectors, values, _ = np.linalg.svd(r22)
    return Range(vectors, values, unweighted, l)


@dataclass(frozen=True, eq=False)
class Projection:
    """What the projection step leaves.

    Attributes:
        statistics: moments of the windows of 2 block_rows samples.
        blocks: the RQ decomposition.
        range: its weighted singular value decomposition.
        instruments: word of the instruments.
        scale: (l,) standard deviations of the outputs, by which the rows of r22 were divided.
    """

    statistics: HankelStatistics
    blocks: RQ
    range: Range
    instruments: str
    scale: Array

    @property
    def block_rows(self) -> int:
        """Number of block rows of the future."""
        return self.statistics.rows // 2

    def gamma(self, n: int) -> Array:
        """Return Gamma (block_rows l, n) in balanced coordinates in which the states have about unit size."""
        return self.range.gamma(n) / self.statistics.windows**0.25

    def weighted(self, weighting: str, l: int) -> "Projection":  # noqa: E741
        """Return the same decomposition in another weighting, as in `estimate_range`, of l outputs."""
        return replace(self, range=estimate_range(self.blocks, l, weighting, self.scale))


def project(
    records: Sequence[Array],
    expansion: Expansion,
    block_rows: int,
    *,
    instruments: str,
    offset: bool = True,
    form: str = "projection",
    tolerance: float | None = None,
    weighting: str = "moesp",
) -> Projection:
    """Take the statistics and decompose.

    Args:
        records: raw channels [u | y] or [u | y | simulated y] per experiment.
        expansion: the signals.
        block_rows: of the future; the past has as many.
        instruments: as in `Expansion.positions`.
        offset: whether the system has a constant.
        form: "projection" or "correlation".
        tolerance: of the pseudo-inverse; None asks for regular regressors.
        weighting: as in `estimate_range`.

    Raises:
        StructureError: unknown words.
        RankError: records that are too short, or do not excite the regressors.
    """
    if instruments not in INSTRUMENTS:
        raise StructureError(f"instruments={instruments!r}: use one of {', '.join(INSTRUMENTS)}.")
    statistics = hankel_statistics(records, 2 * block_rows, expansion, names=expansion.names,
                                   centre="mean" if offset else None)
    statistics.check()
    if statistics.windows < KEPT * statistics.candidates:
        warnings.warn(f"missing samples leave {statistics.windows} of {statistics.candidates} windows of "
                      f"{2 * block_rows} samples: fewer block rows keep more.", DataWarning, stacklevel=2)
    z, phi, y = expansion.positions(statistics.at, instruments, block_rows, offset)
    blocks = rq(statistics, z, phi, y, form=form, tolerance=tolerance)
    scale = statistics.sizes(expansion.y, offset) if expansion.l > 1 else np.ones(1)
    return Projection(statistics, blocks, estimate_range(blocks, expansion.l, weighting, scale), instruments, scale)


def realise(gamma: Array, l: int) -> tuple[Array, Array]:  # noqa: E741
    """Return (A, C) from Gamma (rows l, n) by least squares on its shift invariance."""
    return np.asarray(np.linalg.lstsq(gamma[:-l], gamma[l:], rcond=None)[0], dtype=float), gamma[:l].copy()


def scaled_pair(gamma: Array, scale: Array) -> tuple[Array, Array, Array]:
    """Return (A, C) by least squares that weighs all outputs alike, and Gamma of the outputs divided by their sizes.

    Args:
        gamma: (rows l, n) in units of the outputs.
        scale: (l,) sizes of the outputs.
    """
    scaled = gamma / np.tile(scale, len(gamma) // len(scale))[:, None]
    return realise(scaled, len(scale))[0], gamma[: len(scale)].copy(), scaled


def largest_gap(values: Array, largest: int) -> int:
    """Return the order at the largest ratio s_i / s_(i+1), i = 1 .. largest (SLICOT IB01OD with its default tolerance).

    Values below the rounding of the decomposition count as that rounding.

    Args:
        values: singular values, largest first.
        largest: highest order to consider.
    """
    floor = np.maximum(values, 10 * values.size * np.finfo(float).eps * values[0])
    ratios = floor[:-1] / floor[1:]
    return int(np.argmax(ratios[: max(1, min(largest, ratios.size))])) + 1


def check_order(nx: int, block_rows: int, outputs: int) -> None:
    """Refuse an order that the block rows cannot carry.

    Raises:
        StructureError: with the largest order possible.
    """
    if block_rows <= nx:
        raise StructureError(f"{block_rows} block rows for order {nx}: more block rows than states are needed; use "
                             f"block_rows={nx + 1} or more, or nx={block_rows - 1} or less.")
    if nx > (block_rows - 1) * outputs:
        raise StructureError(f"order {nx} with {block_rows} block rows and {outputs} outputs: at most "
                             f"{(block_rows - 1) * outputs}.")


def signal_rank(projection: Projection) -> int:
    """Return how many singular values are more than rounding, noise included."""
    values = projection.range.values
    return int(np.sum(values > 10 * len(projection.statistics.gram) * np.finfo(float).eps * values[0]))


def weakest_feedback(projection: Projection, expansion: Expansion) -> tuple[float, str]:
    """Return the smallest share of an output's feedback functions that the simulated ones explain, and the output.

    Args:
        projection: with simulated feedback functions among its signals.
        expansion: the signals.
    """
    statistics, shares, start = projection.statistics, [], 0
    simulated = np.concatenate([[0], statistics.at(expansion.zeta_simulated, [0])])
    for family in expansion.feedback:
        own = statistics.at(expansion.zeta[start : start + family.size], [0])
        triangle = statistics.triangle(np.concatenate([simulated, own]))
        part, whole = triangle[1 : simulated.size, simulated.size :], triangle[1:, simulated.size :]
        shares.append((float(np.sum(part**2) / np.sum(whole**2)), expansion.output_names[family.output]))
        start += family.size
    return min(shares)
