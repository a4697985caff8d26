"""The innovation form from the prediction errors of an observer, by two linear regressions.

With F = A - L C the errors of the observer with gain L obey r = C (qI - F)^-1 (K - L) e + e, linear in K once the
innovations e are known; these are the residuals of a long autoregression of r (Hannan and Rissanen 1982). The Riccati
equation then gives the stabilising gain of the same spectrum.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.kalman import NoiseCovariances, kalman_gain
from optid.statistics.factors import add_to_root
from optid.statistics.responses import adjoint_responses

LONGEST = 40
"""Lags of the autoregression at most."""

CHUNK = 4096
"""Samples whose regressors are formed at once."""


def regression_lags(lengths: Sequence[int], n: int, l: int) -> int:  # noqa: E741
    """Return the lags of the autoregression of the errors of l outputs, in complete runs of some lengths, order n.

    Raises:
        StructureError: too few for a noise model.
    """
    total = sum(lengths)
    lags = int(min(LONGEST, max(4, 2 * n), max(1, total // (20 * l))))
    if max(lengths, default=0) <= 2 * lags or total < 10 * (lags + n) * l:
        raise StructureError(f"{total} prediction errors are too few for a noise model.")
    return lags


def innovation_form(a: Array, c: Array, gain: Array, errors: Sequence[Array]) -> tuple[Array, NoiseCovariances]:
    """Return K (n, l) and the covariances of the noises from the errors of an observer.

    Args:
        a: (n, n).
        c: (l, n).
        gain: (n, l) gain L of the observer.
        errors: (T, l) its prediction errors, one array per complete run of samples.

    Raises:
        StructureError: errors that determine no gain: too few, zero, or on the stability limit.
    """
    n, l = gain.shape  # noqa: E741
    lags = regression_lags([len(part) for part in errors], n, l)
    errors = [part for part in errors if len(part) > 2 * lags]
    root = np.zeros((lags * l + l, lags * l + l))
    for part in errors:
        for rows in _lagged(part, lags):
            root = add_to_root(root, rows)
    regressive = np.linalg.lstsq(root[: lags * l, : lags * l], root[: lags * l, lags * l :], rcond=None)[0]
    innovations = [np.concatenate([part[:lags], *(rows[:, lags * l :] - rows[:, : lags * l] @ regressive
                                                  for rows in _lagged(part, lags))]) for part in errors]
    spread = np.sqrt(np.mean(np.concatenate([part[lags:] for part in innovations]) ** 2, axis=0))
    if not np.all(spread > 0):
        raise StructureError("an output is predicted exactly: the covariance of the innovations is singular.")
    size, inner = n * l, a - gain @ c
    normal = np.zeros((size + 1, size + 1))
    for out, e, r in _responses(inner, c, innovations, errors, lags):
        for o in range(l):
            normal = add_to_root(normal, np.column_stack([out[:, o], r[:, o] - e[:, o]]) / spread[o])
    change = np.linalg.lstsq(normal[:size, :size], normal[:size, size], rcond=None)[0]
    rest, count = np.zeros((l, l)), 0
    for out, _, r in _responses(inner, c, innovations, errors, lags):
        final = r - out @ change
        rest += final.T @ final
        count += len(final)
    k, covariance = gain + change.reshape(l, n).T, rest / count
    found = kalman_gain(a, c, k @ covariance @ k.T, covariance, k @ covariance)
    return found.K, NoiseCovariances(k @ covariance @ k.T, covariance, k @ covariance, found.innovation)


def _lagged(errors: Array, lags: int) -> Iterator[Array]:
    """Yield rows [r(k-1) .. r(k-lags) | r(k)], some at a time."""
    windows = np.lib.stride_tricks.sliding_window_view(errors, lags + 1, axis=0)  # (T - lags, l, lags + 1)
    for start in range(0, len(windows), CHUNK):
        part = windows[start : start + CHUNK]
        past = part[:, :, -2::-1].transpose(0, 2, 1).reshape(len(part), -1)
        yield np.concatenate([past, part[:, :, -1]], axis=1)


def _responses(inner: Array, c: Array, innovations: Sequence[Array], errors: Sequence[Array], first: int
               ) -> Iterator[tuple[Array, Array, Array]]:
    """Yield, from the sample `first` of every run on, what the entries of M do to C (qI - F)^-1 M e, and e and r.

    Yields:
        (T, l, l n), M column by column, (T, l) and (T, l).
    """
    l, n = c.shape  # noqa: E741
    for e, r in zip(innovations, errors):
        starts = range(0, len(e), CHUNK)
        parts = (e[start : start + CHUNK] for start in starts)
        for start, (part, out) in zip(starts, adjoint_responses(inner, c, np.zeros((l, l, n)), parts)):
            here = slice(max(first - start, 0), len(part))  # the first samples have no innovations
            yield out[here].reshape(-1, l, l * n), part[here], r[start : start + CHUNK][here]
