"""The exact search for two faults: all pairs of candidates and onsets, in closed form."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.search.calibration import Thresholds
from optid.faults.search.scanning import Magnitude, Scan
from optid.faults.search.sweeps import Sweep

SAME = 1e-6
"""Two signatures whose cosine is closer to one than this cannot be told apart in the window."""

MOST = 50_000
"""Atoms (candidates times onsets) beyond which all pairs take too long."""

LISTED = 1000
"""Pairs that cannot be told apart and are listed."""


class Pair(NamedTuple):
    """Two faults.

    Attributes:
        labels: of both candidates.
        onsets: of both.
        gain: energy explained less both thresholds.
        energy: energy explained.
    """

    labels: tuple[str, str]
    onsets: tuple[int, int]
    gain: float
    energy: float

    def __str__(self) -> str:
        """Say what and where."""
        (a, b), (first, second) = self.labels, self.onsets
        return f"{a} from sample {first} and {b} from sample {second}"


class Alike(NamedTuple):
    """Two faults of which the window sees only one.

    Attributes:
        labels: of both candidates.
        onsets: of both.
    """

    labels: tuple[str, str]
    onsets: tuple[int, int]


@dataclass(frozen=True, eq=False)
class PairSearch:
    """All pairs of faults in a window; `pairs` makes it.

    Attributes:
        scan: the search for one fault.
        thresholds: the penalties of both faults.
        best: the pair with the largest gain: the exact optimum. None where no pair is tested.
        runner_up: the best pair of other candidates, None where there is none.
        single: gain of the best single fault.
        gains: (C, C) largest gain over the onsets for candidate i <= j; NaN elsewhere.
        onsets: (C, C, 2) onsets of candidates i and j there; -1 elsewhere.
        indistinguishable: pairs that the window cannot tell apart, `LISTED` of them at most.
        alike: their number.
    """

    scan: Scan
    thresholds: Thresholds
    best: Pair | None
    runner_up: Pair | None
    single: float
    gains: Array
    onsets: np.ndarray = field(repr=False)
    indistinguishable: tuple[Alike, ...] = field(repr=False)
    alike: int = 0

    @property
    def gain(self) -> float:
        """Gain of the best pair; -inf where there is none."""
        return -np.inf if self.best is None else self.best.gain

    @property
    def margin(self) -> float:
        """Gain of the best pair less that of the best pair of other candidates: the certificate of the search."""
        return np.inf if self.runner_up is None else self.gain - self.runner_up.gain

    @property
    def two(self) -> bool:
        """Whether two faults are preferred to one, and to none."""
        return self.gain > max(self.single, 0.0)

    def pair(self, first: str, second: str) -> Pair | None:
        """Return the best pair of two candidates; None where it is not tested."""
        i, j = sorted((self.scan.index(first), self.scan.index(second)))
        return _pair(self.scan.labels, self.gains, self.onsets, self.thresholds.q, i, j)

    def estimate(self, pair: Pair) -> Magnitude:
        """Return the magnitudes of both faults, one after the other, (d1 + d2,), and their covariance."""
        signatures = [self.scan.signature(label, onset) for label, onset in zip(pair.labels, pair.onsets)]
        flat = np.concatenate(signatures, axis=2).reshape(self.scan.whitened.r.size, -1)
        sizes = np.linalg.norm(flat, axis=0)
        sizes[sizes == 0] = 1.0
        inverse = np.linalg.pinv((flat / sizes).T @ (flat / sizes), rcond=SAME, hermitian=True)
        inverse /= np.outer(sizes, sizes)
        return Magnitude(inverse @ (flat.T @ self.scan.whitened.r.ravel()), inverse)

    def __str__(self) -> str:
        """Say what was found, and how sure."""
        if self.best is None:
            return "no two faults are tested in this window"
        lines = [f"{self.best.labels[0]} from sample {self.best.onsets[0]}",
                 f"and {self.best.labels[1]} from sample {self.best.onsets[1]}",
                 f"gain {self.gain:.2f}, best single fault {self.single:.2f}, next pair "
                 f"{'none' if self.runner_up is None else format(self.runner_up.gain, '.2f')}"]
        if self.alike:
            lines.append(f"{self.alike} pairs of onsets cannot be told apart in this window")
        return "\n".join(lines)


def pairs(scan: Scan, thresholds: Thresholds, *, same: bool = True) -> PairSearch:
    """Search a window for two faults, exactly: all pairs of candidates and onsets, magnitudes by least squares (F4).

    Maximised is the energy that both explain together less both thresholds.

    Args:
        scan: the search for one fault.
        thresholds: of the same candidates.
        same: whether both faults may be of one candidate, as a fault that comes and goes.

    Raises:
        StructureError: thresholds of other candidates or without some that are tested, too many pairs.
    """
    q, prepared = thresholds.of(scan.labels), scan.sweep
    tested = ~np.isnan(scan.statistic)
    without = [label for label, value, row in zip(scan.labels, q, tested) if row.any() and np.isnan(value)]
    if without:
        raise StructureError(
            f"There is no threshold for {', '.join(without)}: calibrate with the inputs, thresholds(..., u=u)."
        )
    if tested.sum() > MOST:
        raise StructureError(
            f"{tested.sum()} candidates and onsets are too many for all pairs ({MOST}): scan a shorter window or fewer "
            "onsets (scan(..., onsets=)), or use the sparse method."
        )
    size, count = tested.shape
    best, energies = np.full((size, size), -np.inf), np.full((size, size), np.nan)
    onsets, alike = np.full((size, size, 2), -1, dtype=np.int64), np.zeros((LISTED, 4), dtype=np.int64)
    from optid.faults.search.pair_kernels import search

    number = search(
        prepared.tables, *_products(prepared), prepared.blocks, prepared.roots, tested, coordinates(scan),
        np.nan_to_num(q), same, 2 * SAME, best, energies, onsets, alike,
    )
    gains = np.where(np.isfinite(best), best, np.nan)
    order = [(i, j) for i, j in np.argwhere(np.isfinite(best))]
    order.sort(key=lambda at: -gains[at])
    ranked = [_pair(scan.labels, gains, onsets, q, i, j) for i, j in order[:2]] + [None, None]
    single = scan.gains(thresholds)
    return PairSearch(
        scan, thresholds, ranked[0], ranked[1], float(np.nanmax(single)) if tested.any() else -np.inf, gains, onsets,
        tuple(Alike((scan.labels[a], scan.labels[b]), (int(i), int(j))) for a, i, b, j in alike[:number]), int(number),
    )


def coordinates(scan: Scan) -> Array:
    """Return the coordinates (N, D) of the window along the orthonormal axes of every candidate and onset."""
    prepared = scan.sweep
    z = np.zeros_like(scan.correlations)
    for c, d in enumerate(prepared.blocks.sizes):
        if d:
            own, place = prepared.columns(c), int(prepared.blocks.places[c])
            root = prepared.roots[:, place : place + d * d].reshape(-1, d, d)
            z[:, own] = np.einsum("kqp,kp->kq", root, scan.correlations[:, own])
    return z


def _products(prepared: Sweep) -> tuple[Array, Array, Array]:
    """Products of all columns with the same onset, with a state, and what an uncertain model takes off them."""
    from optid.faults.search.sweep_kernels import grams

    n, columns = prepared.tables.F.shape[1], prepared.blocks.group.size
    products, states = np.zeros((prepared.window, columns**2)), np.empty((prepared.window, n, columns))
    grams(prepared.tables, prepared.blocks.group, np.arange(columns**2).reshape(columns, columns), products, states)
    return products.reshape(-1, columns, columns), states, prepared.along()


def _pair(labels: tuple[str, ...], gains: Array, onsets: np.ndarray, q: Array, i: int, j: int) -> Pair | None:
    if np.isnan(gains[i, j]):
        return None
    first, second = (int(k) for k in onsets[i, j])
    gain = float(gains[i, j])
    return Pair((labels[i], labels[j]), (first, second), gain, float(gain + q[i] + q[j]))
