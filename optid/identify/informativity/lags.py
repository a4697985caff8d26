"""Lagged columns of a record, and the F test of further columns."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from optid.arrays import Array
from optid.identify.informativity.signals import RecordSignals

DISTINCT = 1e-4  # smallest singular value of further columns, of norm one, beside the others that is a direction
ROUNDING = 1e-26  # share of the energy of an output below which the rest of a regression is rounding
POWERS = 5  # levels of an input beyond which its square and cube are columns too


@dataclass(frozen=True)
class Added:
    """The F test of further columns: p value, the share of the residual energy that they save, their number."""

    p_value: float
    share: float
    columns: int


def test_addition(target: Array, base: Array, more: Array, repeats: float = 1.0) -> Added:
    """Test whether further columns (N, k) explain what a base (N, n) leaves of a target (N,).

    Where the rows say the same several times, what they save counts once.
    """
    q = _span(base)
    rest = target - q @ (q.T @ target)
    more = more / np.maximum(np.linalg.norm(more, axis=0), 1e-300)
    new = more - q @ (q.T @ more)
    size, turned = np.linalg.eigh(new.T @ new)  # squares of singular values, of which small ones do not count
    distinct = size > DISTINCT**2
    columns = int(distinct.sum())
    spare = len(target) - q.shape[1] - columns
    if not columns or spare < 1:
        return Added(1.0, 0.0, 0)
    along = turned[:, distinct].T @ (new.T @ rest)
    saved, energy = float(np.sum(along**2 / size[distinct])), float(rest @ rest)
    kept = max(energy - saved, ROUNDING * float(target @ target), 1e-300)
    ratio = saved / columns / (kept / spare) / repeats
    return Added(float(fdtrc(columns, spare, ratio)), saved / (saved + kept), columns)


def _span(columns: Array) -> Array:
    """Orthonormal basis of columns; directions that others contain are left out."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    left, size, _ = np.linalg.svd(scaled, full_matrices=False)
    return left[:, size > 1e-8 * size[0]] if size.size else left


def lag_columns(x: Array, lags: Iterable[int], first: int, last: int) -> Array:
    """Return x(k - lag) for k = first ... last - 1, one column per lag; negative lags are leads."""
    return np.column_stack([x[first - lag : last - lag] for lag in lags] or [np.zeros((last - first, 0))])


def stack_experiments(signals: RecordSignals, before: int, after: int, build: Callable[[int, int, int], Sequence[Array]]
            ) -> list[Array]:
    """Stack what `build(experiment, first, last)` returns over all experiments that are longer than both margins."""
    found = [build(i, before, len(y) - after) for i, y in enumerate(signals.y) if len(y) > before + after + 1]
    return [np.concatenate(several) for several in zip(*found)]


def powers(x: Array, levels: int, most: int = 3) -> list[Array]:
    """Return an input (T,) and, where it takes many levels, its square and cube."""
    return [x**p for p in range(1, (most if levels > POWERS else 1) + 1)]


def memory(signals: RecordSignals, o: int, most: int = 12) -> int:
    """Return the order of an autoregression of an output by Akaike's criterion, over common rows."""
    most = max(min(most, signals.longest // 12), 1)
    columns = stack_experiments(signals, most, 0, lambda i, first, last: (
        lag_columns(signals.y[i][:, o], range(1, most + 1), first, last), signals.y[i][first:last, o]))
    if not columns:
        return 1
    past, now = columns
    count = len(now)
    whole = np.column_stack([np.ones(count), past, now])
    best, least = 1, np.inf
    triangle = np.asarray(np.linalg.qr(whole, mode="r"), dtype=float)
    for order in range(1, most + 1):  # columns of [1 | past] in order: the rest of the last column below a row
        energy = float(np.sum(triangle[order + 1 :, -1] ** 2))
        criterion = count * np.log(max(energy / count, 1e-300)) + 2 * (order + 1)
        if criterion < least:
            best, least = order, criterion
    return best
