"""The (A, C) step of the subspace methods: instruments, projection, range of the observability matrix, order."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optid.arrays import Array
from optid.bases import Linear
from optid.errors import DataWarning
from optid.statistics.expansion import Expansion, check_channels
from optid.statistics.hankel import HankelStatistics, hankel_statistics
from optid.statistics.rq import RQ, rq

WEIGHTINGS = ("moesp", "cva", "plain")

KEPT = 0.5  # share of the windows left by missing samples below which a warning is given


@dataclass(frozen=True, eq=False)
class Projection:
    """The result of the projection step."""

    statistics: HankelStatistics  # moments of the windows of 2 block_rows samples
    blocks: RQ  # the RQ decomposition
    scale: Array  # (l,) standard deviations of the outputs; one for a single output
    # of the projected outputs: "moesp" (outputs divided by their sizes), "cva" (the inverse root of the covariance of
    # the future outputs with the regressors removed, so that singular values are canonical correlations: Larimore 1990)
    # or "plain" (outputs in their units)
    weighting: str = WEIGHTINGS[0]

    @cached_property
    def decomposition(self) -> tuple[Array, Array]:
        """Left singular vectors of the weighted outputs, without the weights, and the singular values, descending."""
        scale = self.scale if self.weighting != "plain" else np.ones(len(self.scale))
        sizes = np.tile(scale, self.statistics.rows // 2)  # the future is the second half of a window
        r22, unweighted = self.blocks.r22 / sizes[:, None], np.diag(sizes)
        if self.weighting == "cva":
            whole = np.concatenate([r22, self.blocks.residual / sizes[:, None]], axis=1)
            left, values, _ = np.linalg.svd(whole, full_matrices=False)
            values = np.maximum(values, 1e-8 * values[0])  # directions without noise weigh much, not infinitely much
            r22, unweighted = (left / values) @ left.T @ r22, unweighted @ (left * values) @ left.T
        vectors, values, _ = np.linalg.svd(r22)
        return unweighted @ vectors, values

    @property
    def values(self) -> Array:
        """Singular values, largest first."""
        return self.decomposition[1]

    @property
    def rank(self) -> int:
        """Number of singular values that are more than rounding, noise included."""
        floor = 10 * len(self.statistics.gram) * np.finfo(float).eps * self.values[0]
        return int(np.sum(self.values > floor))

    def gamma(self, n: int) -> Array:
        """Return Gamma (block_rows l, n) in balanced coordinates in which the states have about unit size."""
        vectors, values = self.decomposition
        return vectors[:, :n] * np.sqrt(values[:n]) / self.statistics.windows**0.25


def project(records: Sequence[Array], expansion: Expansion, block_rows: int, *, instruments: str, offset: bool = True,
            form: str = "projection", tolerance: float | None = None) -> Projection:
    """Take the statistics of raw channels [u | y] or [u | y | simulated y] per experiment, and decompose.

    Instruments are words as in `Expansion.positions`, ``form`` and ``tolerance`` as in `optid.statistics.rq.rq`, as are
    the errors; the past has as many block rows as the future.
    """
    statistics = hankel_statistics(records, 2 * block_rows, expansion, names=expansion.names,
                                   centre="mean" if offset else None)
    # where all signals are channels, one that depends on others makes the windows all but singular
    if statistics.method == "qr" or not all(isinstance(basis, Linear) for basis in expansion.inputs):
        channels = [record[:, : expansion.m + expansion.l] for record in records]
        check_channels(channels, expansion.input_names, expansion.output_names)
    statistics.check()
    if statistics.windows < KEPT * statistics.candidates:
        warnings.warn(f"missing samples leave {statistics.windows} of {statistics.candidates} windows of "
                      f"{2 * block_rows} samples: fewer block rows keep more.", DataWarning, stacklevel=2)
    z, phi, y = expansion.positions(statistics.at, instruments, block_rows, offset)
    blocks = rq(statistics, z, phi, y, form=form, tolerance=tolerance)
    scale = statistics.sizes(expansion.y, offset) if expansion.l > 1 else np.ones(1)
    return Projection(statistics, blocks, scale)


def realise(gamma: Array, l: int) -> tuple[Array, Array]:  # noqa: E741
    """Return (A, C) from Gamma (rows l, n) by least squares on its shift invariance."""
    return np.asarray(np.linalg.lstsq(gamma[:-l], gamma[l:], rcond=None)[0], dtype=float), gamma[:l].copy()


def weakest_feedback(projection: Projection, expansion: Expansion) -> tuple[float, str]:
    """Return the smallest share of an output's feedback functions that the simulated ones explain, and the output."""
    statistics, shares, start = projection.statistics, [], 0
    simulated = np.concatenate([[0], statistics.at(expansion.zeta_simulated, [0])])
    for family in expansion.feedback:
        own = statistics.at(expansion.zeta[start : start + family.size], [0])
        triangle = statistics.triangle(np.concatenate([simulated, own]))
        part, whole = triangle[1 : simulated.size, simulated.size :], triangle[1:, simulated.size :]
        shares.append((float(np.sum(part**2) / np.sum(whole**2)), expansion.output_names[family.output]))
        start += family.size
    return min(shares)
