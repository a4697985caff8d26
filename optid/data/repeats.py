"""What comes again in a record: equal experiments, and periods within one.

What a model misses of a plant is a function of the moves of its inputs and comes again with them. In a test it counts
once, and cross-validation leaves all copies out together: of three equal experiments the third tells nothing of what a
model of the other two is worth.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.fft import next_fast_len

from optid.arrays import Array

ALIKE = 0.95  # correlation of moves that are the same
APART = 0.5  # correlation of moves with themselves that must have been passed before a period can have gone by
SHARED = 0.25  # of the energy of moves that must lie in what is compared


class RepeatedPart(NamedTuple):
    """Samples first to last - 1 of one experiment."""

    experiment: int
    first: int
    last: int


def copies(inputs: Sequence[Array]) -> list[list[RepeatedPart]]:
    """Return the parts of experiments in which inputs (T, m), one array each, make the same moves.

    One list for every sequence of moves, the longest part of it first; together they are the whole record.
    """
    with np.errstate(invalid="ignore"):
        moves = [np.nan_to_num(np.diff(u, axis=0)) for u in inputs]
    spread = np.sqrt(sum((np.sum(one**2, axis=0) for one in moves), np.zeros(inputs[0].shape[1])))
    moves = [one / np.where(spread > 0, spread, 1.0) for one in moves]
    found: list[list[RepeatedPart]] = []
    for i in sorted(range(len(moves)), key=lambda i: -len(moves[i])):
        n, period = len(inputs[i]), _period(moves[i])
        parts = [RepeatedPart(i, first, min(first + period, n)) for first in range(0, n, period)]
        same = next((group for group in found if _alike(moves[i][: period - 1], moves[group[0].experiment])), None)
        if same is None:
            found.append(parts)
        else:
            same += parts
    return found


def _alike(moves: Array, others: Array) -> bool:
    others = others[: len(moves)]
    size = float(np.linalg.norm(moves) * np.linalg.norm(others))
    return len(others) == len(moves) and size > 0 and abs(float(np.sum(moves * others))) > ALIKE * size


def _period(moves: Array) -> int:
    """Return the samples after which moves (N - 1, m) come again; N where they do not."""
    n = len(moves)
    energy = np.concatenate([[0.0], np.cumsum(np.sum(moves**2, axis=1))])
    total = energy[-1]
    lags = np.arange(1, (n + 1) // 2 + 1)
    if not total or not lags.size:
        return n + 1
    before, after = energy[n - lags], total - energy[lags]
    padded = next_fast_len(2 * n, real=True)
    spectra = np.abs(np.fft.rfft(moves, padded, axis=0)) ** 2
    products = np.sum(np.fft.irfft(spectra, padded, axis=0), axis=1)[lags]
    alike = products / np.sqrt(np.maximum(before * after, 1e-300))
    passed = np.maximum.accumulate(alike < APART)
    found = passed & (alike > ALIKE) & (np.minimum(before, after) > SHARED * total)
    return int(lags[np.argmax(found)]) if found.any() else n + 1
