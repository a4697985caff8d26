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


def score_covariance(blocks: Iterable[tuple[Array, int]], response: Array, root: Array) -> Array:
    """Return the covariance (q, q) of sum_k J(k)' e(k), e(k) = sum_i H_i w(k-i), of w with the covariance root' root.

    With the response H (M + 1, l, l) the sum is that of G(k)' w(k), G(k) = sum_i H_i' J(k+i): the rows [J | error]
    (T l, q + 1) of blocks in order, as for `optid.statistics.linearised.linearise_errors`, are filtered against time.
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
    """Fit [1, a_1, ...] to errors (N,) per experiment by `autoregression`."""
    found, _ = autoregression([e[:, None] for e in errors], most)
    return np.concatenate([[1.0], -found[:, 0, 0]])


def autoregression(errors: Sequence[Array], most: int) -> tuple[Array, Array]:
    """Fit e(k) = A_1 e(k-1) + ... + w(k) to errors (N, l) per experiment, NaN = missing, by Yule and Walker.

    Return A (lags, l, l), stable, of the order that Akaike's criterion chooses, and the covariance (l, l) of w. Pairs
    of samples count that are both present.
    """
    outputs = errors[0].shape[1]
    present = [np.isfinite(e) for e in errors]
    filled = [np.where(here, e, 0.0) for e, here in zip(errors, present)]
    total = int(np.sum([here.sum(axis=0) for here in present], axis=0).min())
    most = max(min(most, total - 1), 0)
    sums, counts = np.zeros((2, most + 1, outputs, outputs))
    for e, here in zip(filled, present):
        for lag in range(min(most, len(e) - 1) + 1):
            sums[lag] += e[lag:].T @ e[: len(e) - lag]
            counts[lag] += here[lag:].astype(float).T @ here[: len(e) - lag]
    taper = 1 - np.arange(most + 1) / max(total, 1)
    r = sums / np.maximum(counts, 1) * taper[:, None, None]
    best, noise = np.zeros((0, outputs, outputs)), r[0]
    if not np.linalg.slogdet(noise)[0] > 0:
        return best, noise
    least = total * np.linalg.slogdet(noise)[1]
    for order in range(1, most + 1):
        lags = np.arange(order)
        whole = np.block([[r[j - i] if j >= i else r[i - j].T for j in lags] for i in lags])
        right = np.concatenate(r[1 : order + 1], axis=1)
        found = np.linalg.solve(whole.T, right.T).T.reshape(outputs, order, outputs)
        left = r[0] - np.einsum("oip,iqp->oq", found, r[1 : order + 1])
        sign, size = np.linalg.slogdet(left)
        if sign <= 0 or left.diagonal().min() <= 0:
            break
        if (criterion := total * size + 2 * order * outputs**2) < least and _stable(found):
            best, noise, least = found.transpose(1, 0, 2), (left + left.T) / 2, criterion
    return best, noise


def _stable(found: Array) -> bool:
    outputs, order = found.shape[:2]
    companion = np.eye(order * outputs, k=-outputs)
    companion[:outputs] = found.reshape(outputs, -1)
    return float(np.abs(np.linalg.eigvals(companion)).max()) < 1
