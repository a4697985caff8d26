"""From an estimate of the extended observability matrix to (A, C)."""

from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.statistics.rq import RQ

WEIGHTINGS = ("moesp", "cva", "plain")


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

    Raises:
        StructureError: an unknown weighting.
    """
    if weighting not in WEIGHTINGS:
        raise StructureError(f"weighting={weighting!r}: use one of {', '.join(WEIGHTINGS)}.")
    sizes = np.tile(np.ones(l) if scale is None or weighting == "plain" else scale, len(blocks.r22) // l)
    r22, unweighted = blocks.r22 / sizes[:, None], np.diag(sizes)
    if weighting == "cva":
        whole = np.concatenate([r22, blocks.residual / sizes[:, None]], axis=1)
        left, values, _ = np.linalg.svd(whole, full_matrices=False)
        values = np.maximum(values, 1e-8 * values[0])  # directions without noise weigh much, not infinitely much
        r22, unweighted = (left / values) @ left.T @ r22, unweighted @ (left * values) @ left.T
    vectors, values, _ = np.linalg.svd(r22)
    return Range(vectors, values, unweighted, l)


def shift_pair(gamma: Array, l: int) -> tuple[Array, Array]:  # noqa: E741
    """Return the blocks of Gamma without its last and without its first block row: (upper, lower), upper A = lower."""
    return gamma[:-l], gamma[l:]


def realise(gamma: Array, l: int) -> tuple[Array, Array]:  # noqa: E741
    """Return (A, C) from Gamma (rows l, n) by least squares on its shift invariance."""
    upper, lower = shift_pair(gamma, l)
    return np.asarray(np.linalg.lstsq(upper, lower, rcond=None)[0], dtype=float), gamma[:l].copy()


def scaled_pair(gamma: Array, scale: Array) -> tuple[Array, Array, Array]:
    """Return (A, C) by least squares that weighs all outputs alike, and Gamma of the outputs divided by their sizes.

    Args:
        gamma: (rows l, n) in units of the outputs.
        scale: (l,) sizes of the outputs.
    """
    scaled = gamma / np.tile(scale, len(gamma) // len(scale))[:, None]
    a, _ = realise(scaled, len(scale))
    return a, gamma[: len(scale)].copy(), scaled


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
