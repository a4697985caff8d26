"""Detect isolated outliers, in a record before it is fitted and by the residuals of a model.

A sample is an outlier when it deviates from the running median of its channel by far more than the channel varies, for
at most `LONGEST` samples in a row; more in a row are a step. Samples within the scatter of the others, and those of a
heavy tail without a gap, are no outliers. Pulses of one to three samples count as outliers on a noisy channel, as the
signal on a constant one.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.special import fdtrc, ndtri

from optid.arrays import Array

LONGEST = 3  # outliers in a row that still count as isolated
WINDOW = 15  # samples of the running median
SHORT = 10_000  # samples up to which sorting every window takes less time than the import of scipy.ndimage
SAMPLED, GOLDEN = (100, 2000), 0.6180339887  # fewest and most for a first estimate of the scale, and their spacing
CAREFUL = 4.5  # over the root of their number: the share of this estimate that the scale may be below it
MOST = 0.12  # largest share of outliers that is considered
LEAST_SAMPLES = 50  # samples of a channel below which there is no test
FAR = 6.0  # smallest deviation of an outlier, in robust standard deviations
GAP = 1.2  # smallest ratio of the smallest outlier to the largest other deviation: levels of a quantiser are no gap
STEP = 1.5  # ratio by which an outlier is larger than a step between other samples
SWITCHING = 0.25  # larger steps, relative to the number of runs of outliers, from which on the channel switches
GAP_RISK, TAIL_RISK = 2e-3, 1e-4  # probability of as wide a gap, and of as heavy a tail, where the tail continues
FLATTEST = 0.1  # least steepness of a tail: that of a Gaussian one at 3 standard deviations, for bounded signals
TRIED = 20  # splits that are tried, those at the widest gaps
TAIL = 0.05  # share of the deviations that is the tail of any distribution
NORMAL_MEDIAN = 0.6745  # median of the absolute value of a standard normal variable
CHANCE = 1e-3  # probability that residuals of Gaussian noise show an outlier anywhere in the record
TIE = 1e-9  # where a single row decides, a past output in it counts as the outlier, for its leverage, not the output


def find_outliers(records: Sequence[Array]) -> list[np.ndarray]:
    """Return the sample numbers of the isolated outliers of one channel, one array per experiment.

    The deviations from a running median are sorted by size. With k of them split off, the logarithm of the gap there
    times k is exponential in a Pareto tail (Renyi 1953), and the sum of the logarithms beyond it a gamma variable, both
    with the steepness of the tail as scale, by Hill's estimate (1975) from the deviations below. A gap too wide or a
    tail too heavy for that separates outliers. Scale and running median are robust (Hampel 1974).

    Args:
        records: (N,) samples of every experiment; NaN = missing, and its neighbours count as adjacent.
    """
    arrays = [np.asarray(x, dtype=float) for x in records]
    present = [~np.isnan(x) for x in arrays]
    masks = _outlying([x if kept.all() else x[kept] for x, kept in zip(arrays, present)])
    return [np.flatnonzero(kept)[mask] if mask.any() else np.flatnonzero(mask) for kept, mask in zip(present, masks)]


def find_additive_outliers(residuals: Sequence[Array], past: Array, spread: Array) -> list[np.ndarray]:
    """Return which outputs (N, l) of every experiment are outliers by the one-step residuals of an ARX model.

    An error h of an output leaves h in its own residual and h times the coefficients of A in the following ones; a
    disturbance of the plant leaves a single one. An output is an outlier where the first explains the residuals
    significantly, and better than a disturbance at any of these samples (Fox 1972; Chang, Tiao and Chen 1988). Of
    neighbours within the lags only the most likely is returned, so the search is to be repeated without it.

    Residuals are NaN where a row is not used; ``past[i - 1, o, p]`` of (na, l, l) is the coefficient of A of output o,
    lag i, in equation p; the spread (l,) are robust standard deviations of the residuals.
    """
    signature = np.concatenate([np.eye(spread.size)[None], past]) / spread  # (na + 1, l outputs, l equations)
    critical = -ndtri(CHANCE / (2 * max(sum(r.size for r in residuals), 1)))
    return [_additive(r / spread, signature, critical) for r in residuals]


def _additive(r: Array, signature: Array, critical: float) -> np.ndarray:
    from scipy.ndimage import maximum_filter1d

    n, lags = len(r), len(signature)
    used = ~np.isnan(r[:, 0])
    padded = np.concatenate([np.where(used[:, None], r, 0.0), np.zeros((lags - 1, r.shape[1]))])
    weight = np.concatenate([used, np.zeros(lags - 1, dtype=bool)])
    drawn = sum(padded[i : i + n] @ part.T for i, part in enumerate(signature))
    power = sum(np.outer(weight[i : i + n], np.sum(part**2, axis=1)) for i, part in enumerate(signature))
    size = np.abs(drawn) / np.sqrt(np.where(power > 0, power, np.inf))
    peak = size >= maximum_filter1d(np.max(size, axis=1), 2 * lags - 1)[:, None]
    rival = np.max(np.abs(padded), axis=1)  # what a disturbance explains
    later = np.max([rival[i : i + n] * (1 - TIE) for i in range(1, lags)] + [np.zeros(n)], axis=0)
    return peak & (size > np.maximum(critical, np.maximum(rival[:n] * (1 + TIE), later))[:, None])


def _may_hold(parts: Sequence[Array]) -> bool:
    """Whether a record may have outliers, by its jumps and every eighth of its deviations: 8 times as fast.

    An outlier is `FAR` robust standard deviations off the running median, and over `FAR` / `STEP` off a neighbour.
    """
    half, around = WINDOW // 2, np.arange(WINDOW) - WINDOW // 2
    if min(x.size for x in parts) < 8 * SAMPLED[0]:
        return True

    def deviations(x: Array, at: np.ndarray) -> Array:
        return np.abs(x[at] - np.partition(x[at[:, None] + around], half, axis=1)[:, half])

    some = np.concatenate([deviations(x, _places(x.size)) for x in parts])
    middle = float(np.partition(some, some.size // 2)[some.size // 2])
    least = (1 - CAREFUL / np.sqrt(some.size)) * FAR * middle / NORMAL_MEDIAN
    for x in parts:
        jumps = np.flatnonzero(np.abs(np.diff(x)) > least / STEP)
        if not jumps.size:
            continue
        edges = (jumps < half) | (jumps >= x.size - half - LONGEST)
        runs = jumps[:-1][np.diff(jumps) <= LONGEST]  # there and back
        near = runs[:, None] + np.arange(1, 1 + LONGEST)
        near = near[(near >= half) & (near < x.size - half)]
        if near.size > min(SHORT, x.size // 2) or near.size and np.max(deviations(x, near)) > least:
            return True
        ends = (x[: 3 * WINDOW], x[: -3 * WINDOW - 1 : -1]) if edges.any() else ()
        if any(np.max(_deviations(end)[: half + LONGEST]) > least for end in ends):
            return True
    return False


@lru_cache(maxsize=8)
def _places(size: int) -> np.ndarray:
    """Return a sample in eight, up to a limit, of so many: even, and in step with no period of the record."""
    half, count = WINDOW // 2, min(size // 8, SAMPLED[1])
    return half + ((size - 2 * half) * ((np.arange(count) * GOLDEN) % 1)).astype(int)


def _deviations(x: Array) -> Array:
    """Distance of every sample from the running median, extrapolated linearly at the ends."""
    if x.size < WINDOW:
        return np.abs(x - np.median(x)) if x.size else x
    half, course = WINDOW // 2, x.copy()
    if x.size <= SHORT:
        windows = np.lib.stride_tricks.sliding_window_view(x, WINDOW)
        course[half:-half] = np.partition(windows, half, axis=1)[:, half]
    else:
        from scipy.ndimage import median_filter

        course[half:-half] = median_filter(x, WINDOW)[half:-half]
    for line in (course, course[::-1]):  # views of its two ends
        slope = (line[2 * half] - line[half]) / half if x.size > 3 * half else 0.0
        line[:half] = line[half] - slope * np.arange(half, 0, -1)
    return np.abs(x - course)


def _outlying(parts: Sequence[Array]) -> list[np.ndarray]:
    """Mark the outliers of every experiment, by the deviations of all experiments together."""
    none = [np.zeros(x.size, dtype=bool) for x in parts]
    if not _may_hold(parts):
        return none
    d = np.concatenate([_deviations(x) for x in parts])
    edges = np.cumsum([x.size for x in parts])[:-1]
    if d.size < LEAST_SAMPLES:
        return none
    below = min(max(d.size // 12, 20), 1000)  # deviations from which the steepness of the tail is estimated
    count = int(MOST * d.size) + below + 1
    middle, fifth = d.size // 2, int(0.8 * d.size)
    ordered = np.partition(d, np.unique([middle, fifth, d.size - count]))
    scale = max(float(ordered[middle]) / NORMAL_MEDIAN, float(ordered[fifth]) / 1.2816)
    top = ordered[d.size - count :]
    if scale <= 8 * np.finfo(float).eps * max(float(np.max(np.abs(x), initial=0.0)) for x in parts):
        return none  # constant but for pulses: they are the signal
    if not np.max(top) > FAR * scale:
        return none
    top = np.sort(top)[::-1]
    for k in _splits(top / scale, d.size, below):
        size = float(top[k - 1]) / STEP
        found = [_isolated(x, mask, size) for x, mask in zip(parts, np.split(d >= top[k - 1], edges))]
        steps = sum(int(np.count_nonzero(np.abs(np.diff(x[~mask])) > size)) for x, mask in zip(parts, found))
        runs = sum(int(np.count_nonzero(np.diff(mask.astype(np.int8), prepend=0) > 0)) for mask in found)
        if runs and steps <= SWITCHING * runs:
            return found
    return none


def _splits(top: Array, n: int, below: int) -> np.ndarray:
    """Return how many of the largest of n deviations, in robust standard deviations, may be outliers, most first."""
    logs = np.log(np.maximum(top, NORMAL_MEDIAN))
    k = np.arange(1, top.size - below)
    sums = np.concatenate([[0.0], np.cumsum(logs)])
    near = (sums[k + below] - sums[k]) / below - logs[k + below]
    whole = (logs[k] - np.log(NORMAL_MEDIAN)) / np.log(0.5 * n / k)  # where the tail has not begun, near is too flat
    steepness = np.maximum(np.where(k > TAIL * n, np.maximum(near, whole), near), FLATTEST)
    gap, excess = logs[k - 1] - logs[k], sums[k] - k * logs[k]
    far = top[k - 1] > FAR
    k, gap, excess, steepness = k[far], gap[far], excess[far], steepness[far]
    tries = k * (k + 1.0)  # the inverses of which add up to one
    wide = (fdtrc(2, 2 * below, k * gap / steepness) < GAP_RISK / tries) & (gap > np.log(GAP))
    heavy = fdtrc(2 * k, 2 * below, excess / (k * steepness)) < TAIL_RISK / tries
    likely = np.flatnonzero(wide | heavy)
    widest = likely[np.argsort(-gap[likely])[:TRIED]]
    return k[np.unique(np.concatenate([widest, likely[-1:]]))[::-1]]


def _isolated(x: Array, mask: np.ndarray, size: float) -> np.ndarray:
    """Keep the runs of at most `LONGEST` samples that all differ from the other samples before and behind."""
    found, sound, at = np.zeros_like(mask), np.flatnonzero(~mask), np.flatnonzero(mask)
    if not sound.size:
        return found
    place = np.searchsorted(sound, at)
    start = np.where(place > 0, sound[place - 1] + 1, 0)
    stop = np.where(place < sound.size, sound[np.minimum(place, sound.size - 1)], x.size)
    before, behind = np.where(start > 0, start - 1, stop), np.where(stop < x.size, stop, start - 1)
    jumps = [(start, before), (stop - 1, behind), (at, before), (at, behind)]
    found[at] = (stop - start <= LONGEST) & np.all([np.abs(x[i] - x[j]) > size for i, j in jumps], axis=0)
    return found
