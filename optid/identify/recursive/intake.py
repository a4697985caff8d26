"""Intake of a recursion: prior, forgetting factor and samples become arrays or a named error."""

from typing import Any

import numpy as np

from optid.arrays import Array, check_finite
from optid.errors import DataError, StructureError
from optid.models.layout import Layout
from optid.statistics.factors import add_to_root
from optid.structures.whitening import invert_triangular


def prior_factor(theta0: Any, P0: Any, layout: Layout) -> Array:
    """Return the factor [R | R theta_0; 0 | 0] with R^T R = P_0^-1.

    Args:
        theta0: a number, (n,) or (n, l).
        P0: a positive number, (n,) variances, infinity allowed, or (n, n) positive definite.
        layout: the columns.

    Raises:
        StructureError: wrong shape, a covariance that is not positive.
    """
    n, l = layout.n_columns, layout.l  # noqa: E741
    theta, covariance = np.asarray(theta0, dtype=float), np.asarray(P0, dtype=float)
    if theta.shape not in ((), (n,), (n, l)) or not np.all(np.isfinite(theta)):
        raise StructureError(f"theta0 has shape {theta.shape}: it must be a number, ({n},) or ({n}, {l}), all finite.")
    if covariance.shape not in ((), (n,), (n, n)):
        raise StructureError(f"P0 has shape {covariance.shape}: it must be a number, ({n},) or ({n}, {n}).")
    if covariance.ndim < 2:
        if not np.all(covariance > 0):
            raise StructureError("P0 must be positive: it is a covariance. Infinity means no prior.")
        factor = np.diag(np.broadcast_to(1 / np.sqrt(covariance), n))
    else:
        symmetric = np.abs(covariance - covariance.T).max() <= 1e-10 * np.abs(covariance).max()
        if not symmetric or not np.linalg.eigvalsh(covariance)[0] > 0:
            raise StructureError("P0 is not a symmetric positive definite matrix; give (n,) variances to use infinity.")
        factor = add_to_root(np.zeros((n, n)), invert_triangular(np.linalg.cholesky(covariance)))
    root = np.zeros((n + l, n + l))
    root[:n, :n] = factor
    root[:n, n:] = factor @ np.broadcast_to(theta[:, None] if theta.ndim == 1 else theta, (n, l))
    return root


def as_block(values: Any, names: tuple[str, ...], what: str, seen: int) -> Array:
    """Return samples as (N, channels), finite or NaN.

    Args:
        values: a block (N, channels), (N,) for one channel, or one sample.
        names: the channels.
        what: "u" or "y", for messages.
        seen: samples seen before, for messages.

    Raises:
        DataError: wrong shape or an infinite sample.
    """
    samples, width = np.asarray(values, dtype=float), len(names)
    if samples.ndim == 0 and width == 1 or samples.ndim == 1 and width > 1 and samples.size == width:
        samples = samples.reshape(1, width)
    elif samples.ndim == 1 and width == 1:
        samples = samples[:, None]
    if samples.ndim != 2 or samples.shape[1] != width:
        raise DataError(f"{what} has shape {np.shape(values)}: it must be a block (N, {width}) or one sample of "
                        f"{width} channel{'s' if width > 1 else ''} ({', '.join(names)}).")
    if samples.size:
        check_finite(samples, [f"{what}, channel {name!r}" for name in names], seen)
    return samples


def forgetting_factor(value: float) -> float:
    """Return a forgetting factor, or refuse one outside (0, 1] (`StructureError`)."""
    if not 0 < value <= 1:
        raise StructureError(f"forgetting={value!r}: a factor above 0 and at most 1, such as 0.995.")
    return float(value)
