"""Errors that are not white: their long autoregression, and how far they scatter an estimate of least squares."""

from collections.abc import Iterable, Sequence

import numpy as np

from optid.arrays import Array
from optid.statistics.hankel import hankel_statistics

FADED = 1e-3  # share of its largest coefficient below which the response of a noise filter has ended
LONGEST = 4096  # samples of such a response at most


def long_autoregression(errors: Sequence[Array], lags: int) -> tuple[Array, Array]:
    """Fit e(k) = A_1 e(k-1) + ... + A_lags e(k-lags) + w(k), (N, l) per experiment, over complete runs.

    Return A (lags, l, l) by least squares, and the triangular root (l, l) of the sum of squares of w over the rows.
    """
    outputs = errors[0].shape[1]
    statistics = hankel_statistics([e for e in errors if len(e) > lags], lags + 1)
    root, past = statistics.triangle(statistics.at(range(outputs))), lags * outputs
    found = np.linalg.lstsq(root[:past, :past], root[:past, past:], rcond=None)[0]
    return (found.reshape(lags, outputs, outputs)[::-1].transpose(0, 2, 1),
            root[past:, past:] / np.sqrt(statistics.windows))


def response_of(autoregression: Array, length: int = LONGEST, *, fade: bool = True) -> Array:
    """Return the response (M + 1, l, l) of e to w, from one at M = 0, so long or to where it has faded."""
    lags, outputs = autoregression.shape[:2]
    found = [np.eye(outputs)]
    while len(found) < length:
        found.append(sum((a @ h for a, h in zip(autoregression, reversed(found))), np.zeros((outputs, outputs))))
        if fade and len(found) > lags and max(np.abs(h).max() for h in found[-lags:]) < FADED:
            return np.array(found[:-lags])
    return np.array(found)


def scattered(blocks: Iterable[tuple[Array, int]], response: Array, root: Array) -> Array:
    """Return the covariance (q, q) of sum_k J(k)' e(k), e(k) = sum_i H_i w(k-i), of w with the covariance root' root.

    With the response H (M + 1, l, l) the sum is that of G(k)' w(k), G(k) = sum_i H_i' J(k+i): the rows [J | error]
    (T l, q + 1) of blocks in order, as for `optid.statistics.linearised.linearised`, are filtered against time.
    """
    ahead, outputs = len(response) - 1, len(root)
    held: Array | None = None
    total: Array = np.zeros((0, 0))
    for rows, _ in blocks:
        now = rows[:, :-1].reshape(-1, outputs, rows.shape[1] - 1)
        held = np.concatenate([np.zeros((ahead, *now.shape[1:])) if held is None else held, now])
        total = _added(total, _filtered(held, response), root)
        held = held[len(held) - ahead :]
    if held is None or not ahead:
        return total
    return _added(total, _filtered(np.concatenate([held, np.zeros_like(held)]), response), root)


def _filtered(rows: Array, response: Array) -> Array:
    """Return sum_i H_i' rows(k+i), (T - M, l, q), for the first T - M of T samples."""
    ahead, samples = len(response) - 1, len(rows)
    if not ahead:
        return np.einsum("oc,kop->kcp", response[0], rows)
    spectrum = np.conj(np.fft.rfft(response, samples + ahead, axis=0))
    filtered = np.einsum("foc,fop->fcp", spectrum, np.fft.rfft(rows, samples + ahead, axis=0))
    return np.fft.irfft(filtered, samples + ahead, axis=0)[: samples - ahead]


def _added(total: Array, filtered: Array, root: Array) -> Array:
    rows = np.einsum("co,kop->kcp", root, filtered).reshape(-1, filtered.shape[2])
    return rows.T @ rows + (total if total.size else 0.0)


def short_autoregression(errors: Sequence[Array], most: int) -> Array:
    """Fit [1, a_1, ...] to errors (N,) per experiment, NaN = missing, by Yule and Walker; its order by Akaike."""
    from scipy.linalg import solve_toeplitz

    present = [np.isfinite(e) for e in errors]
    filled = [np.where(here, e, 0.0) for e, here in zip(errors, present)]
    total = sum(int(here.sum()) for here in present)
    most = min(most, total - 1)
    sums, counts = np.zeros((2, max(most, 0) + 1))
    for e, here in zip(filled, present):
        for lag in range(min(most, len(e) - 1) + 1):
            sums[lag] += e[lag:] @ e[: len(e) - lag]
            counts[lag] += np.count_nonzero(here[lag:] & here[: len(e) - lag])
    covariance = sums / np.maximum(counts, 1) * (1 - np.arange(sums.size) / max(total, 1))
    best, least = np.ones(1), total * np.log(max(covariance[0], 1e-300))
    for order in range(1, most + 1 if covariance[0] > 0 else 0):
        a = np.concatenate([[1.0], -solve_toeplitz(covariance[:order], covariance[1 : order + 1])])
        variance = float(a @ covariance[: order + 1])
        if variance <= 0:
            break
        if (criterion := total * np.log(variance) + 2 * order) < least:
            best, least = a, criterion
    return best
