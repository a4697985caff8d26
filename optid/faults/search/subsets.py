"""Exact search for several faults at once.

The energy that all faults of a subset explain together, less their thresholds, is maximised over all subsets up to a
size: the best subset of the columns of a regression. One fault is searched by the sweep, two by a compiled recursion
over all pairs and onsets (`optid.faults.search.pair_kernels`). Faults that are chosen already are projected out of the
window and of the other signatures, like a nuisance of infinite variance; so the same two searches serve any number of
faults, and the exchange of one fault beside the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import comb
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optid.arrays import Array, check_integer
from optid.errors import StructureError
from optid.faults.search.scanning import ALIKE, Magnitude, Scan
from optid.faults.search.sweeps import Sweep

if TYPE_CHECKING:
    from optid.faults.false_alarms import Thresholds
    from optid.faults.search.pair_kernels import Grams

MOST = 1_250_000_000  # largest number of subsets searched
EXCHANGED = 3  # number of subsets improved by exchanges
ROUNDS = 20  # largest number of rounds of exchanges
Member = tuple[int, int]  # number of a candidate and its onset


class Subset(NamedTuple):
    """A few faults."""

    labels: tuple[str, ...]  # of the candidates, in the order of the dictionary and of the onsets
    onsets: tuple[int, ...]  # of each
    gain: float  # energy explained less all thresholds
    energy: float  # energy explained

    def __str__(self) -> str:
        """State candidates and onsets."""
        return " and ".join(f"{label} from sample {onset}" for label, onset in zip(self.labels, self.onsets))


@dataclass(frozen=True, eq=False)
class SubsetSearch:
    """A search for several faults at once; `best_subsets` makes it.

    Attributes:
        scan: the search for one fault.
        ranked: the best subset of every choice of candidates, each at its best onsets; largest gain first.
        searched: (N,) which onsets were searched.
        subsets: number of subsets compared.
        alike: number of pairs that the window does not distinguish.
    """

    scan: Scan
    ranked: tuple[Subset, ...] = field(repr=False)
    searched: np.ndarray = field(repr=False)
    subsets: int
    alike: int

    @property
    def best(self) -> Subset | None:
        """The subset with the largest gain: the exact optimum over the onsets searched; None where nothing gains."""
        return self.ranked[0] if self.ranked and self.ranked[0].gain > 0 else None

    def best_of(self, count: int) -> Subset | None:
        """Return the subset of so many faults with the largest gain; None where there is none."""
        return next((s for s in self.ranked if len(s.labels) == count), None)

    @property
    def runner_up(self) -> Subset | None:
        """The best one of other candidates."""
        return self.ranked[1] if self.best is not None and len(self.ranked) > 1 else None

    @property
    def gain(self) -> float:
        """Gain of the best subset; -inf where there is none."""
        return -np.inf if self.best is None else self.best.gain

    @property
    def margin(self) -> float:
        """Gain of the best subset less that of the best one of other candidates: the certificate of the search."""
        return np.inf if self.runner_up is None else self.gain - self.runner_up.gain

    def estimate(self, subset: Subset) -> Magnitude:
        """Return the magnitudes of all faults of a subset, one after the other, and their covariance."""
        return self.scan.together(subset.labels, subset.onsets)

    def __str__(self) -> str:
        """Print the best subset and what the search covered."""
        if self.best is None:
            lines = ["no fault gains more than its threshold"]
        else:
            lines = [f"{label[:50]:<52}from sample {onset}" for label, onset in zip(self.best.labels, self.best.onsets)]
            single, after = (f"{s.gain:.2f}" if s else "none" for s in (self.best_of(1), self.runner_up))
            lines.append(f"gain {self.gain:.2f}, best single fault {single}, next choice {after}")
        lines.append(f"{self.subsets} subsets at {int(self.searched.sum())} of {self.searched.size} onsets")
        lines += [f"{self.alike} pairs of onsets are indistinguishable in this window"] * bool(self.alike)
        return "\n".join(lines)


def best_subsets(scan: Scan, thresholds: "Thresholds", *, max_faults: int = 2,
                 near: np.ndarray | None = None) -> SubsetSearch:
    """Search a window for up to `max_faults` faults, exactly: all subsets of candidates and onsets (F3, F4).

    Both of two faults may be of one candidate, as a fault that comes and goes.

    Args:
        scan: the search for one fault.
        thresholds: of the same candidates.
        max_faults: faults in a subset at most.
        near: (N,) the onsets that are searched, such as those near the active ones of a programme; the best subsets are
            then improved by exchanges over all onsets. All by default.

    Raises:
        StructureError: thresholds of other candidates or without some that are tested, too many subsets for an exact
            search, an impossible number of faults.
    """
    check_integer(max_faults, "max_faults")
    q = np.nan_to_num(thresholds.of(scan.labels, scan.tested_anywhere))
    tested = scan.tested if near is None else scan.tested & near
    number = int(tested.sum())
    subsets = sum(comb(number, k) for k in range(1, max_faults + 1))
    if subsets > MOST:
        raise StructureError(f"{number} candidates and onsets make {subsets:.2g} subsets of up to {max_faults} faults: "
                             "too many for an exact search. Use fewer faults, a shorter window, or scan fewer onsets "
                             "(scan(..., onsets=...)), such as those near the active ones of the sparse method.")
    columns, best, alike = _Columns.of(scan, q), _Best(), 0
    for size in range(1, min(max_faults, number) + 1):
        found = columns.best(size, tested)
        best.add(found)
        alike = found.alike if size == 2 else alike
    if near is not None and not near.all():
        for gain, members in best.ranked[:EXCHANGED]:
            best.offer(*exchange_search(members, gain, columns.best_beside))
    ranked = [Subset(tuple(scan.labels[c] for c, _ in members), tuple(k for _, k in members), gain,
                     gain + float(sum(q[c] for c, _ in members))) for gain, members in best.ranked]
    searched = np.asarray(tested.any(axis=0)) if near is None else near
    return SubsetSearch(scan, tuple(ranked), searched, subsets, alike)


def exchange_search(members: Sequence[Member], gain: float,
                    best_beside: Callable[[Sequence[Member]], tuple[float, Member]]) -> tuple[float, list[Member]]:
    """Return the gain and the members that no single exchange improves, from members of some gain.

    `best_beside` returns the best member beside some others, and the gain of all of them.
    """
    found, best = list(members), gain
    for _ in range(ROUNDS):
        before = best
        for i in range(len(found)):
            gain, member = best_beside(found[:i] + found[i + 1 :])
            if gain > best + 1e-9 * (1 + abs(best)):
                best, found[i] = gain, member
        if best == before:
            break
    return best, found


class _Best:
    """The best subset of every choice of candidates: {candidates: (gain, members)}."""

    def __init__(self, alike: int = 0) -> None:
        self.of: dict[tuple[int, ...], tuple[float, list[Member]]] = {}
        self.alike = alike  # pairs that the window does not distinguish

    def offer(self, gain: float, members: Sequence[Member]) -> None:
        """Keep a subset that is better than those of the same candidates."""
        ordered = sorted(members)
        chosen = tuple(c for c, _ in ordered)
        if chosen not in self.of or gain > self.of[chosen][0]:
            self.of[chosen] = gain, ordered

    def add(self, other: "_Best") -> None:
        """Offer all subsets of another search."""
        for gain, members in other.of.values():
            self.offer(gain, members)

    @property
    def ranked(self) -> list[tuple[float, list[Member]]]:
        """Gains and members, the largest gain first."""
        return sorted(self.of.values(), key=lambda found: -found[0])


@dataclass(frozen=True, eq=False)
class _Columns:
    """The signatures of all candidates and onsets; those of faults that are chosen are projected out of the others."""

    scan: Scan
    q: Array  # (C,) thresholds
    grams: "Grams"
    sweep: Sweep
    correlations: Array  # (N, D)
    chosen: tuple[Member, ...] = ()
    gain: float = 0.0  # of those that are chosen

    @classmethod
    def of(cls, scan: Scan, q: Array) -> "_Columns":
        """Take the signatures of a search as they are."""
        from optid.faults.search.pair_kernels import Grams
        from optid.faults.search.sweep_kernels import grams

        tables, window = scan.sweep.tables, scan.sweep.window
        n, D = tables.F.shape[1], tables.group.size
        products, states = np.zeros((window, D**2)), np.empty((window, n, D))
        grams(tables, np.arange(D**2).reshape(D, D), products, states)
        known = Grams(products.reshape(-1, D, D), states, scan.sweep.along, scan.sweep.roots)
        return cls(scan, q, known, scan.sweep, scan.correlations)

    def beside(self, members: Sequence[Member]) -> "_Columns":
        """Choose faults, these only: project them out of the window and of all signatures."""
        whole, r = self.scan.sweep, self.scan.whitened.r
        parts = [whole.signature(c, k).reshape(r.size, -1) @ whole.roots_of(c)[k].T for c, k in members]
        left, sizes, _ = np.linalg.svd(np.hstack([np.zeros((r.size, 0)), *parts]), full_matrices=False)
        axes = left[:, sizes > np.sqrt(ALIKE)]
        along = axes.T @ r.ravel()
        sweep = whole.without(axes, ALIKE)
        gain = float(along @ along) - float(sum(self.q[c] for c, _ in members))
        grams = self.grams._replace(along=sweep.along, roots=sweep.roots)
        correlations = sweep.correlations(r - (axes @ along).reshape(r.shape))
        return replace(self, grams=grams, sweep=sweep, correlations=correlations, chosen=tuple(members), gain=gain)

    def best_beside(self, others: Sequence[Member]) -> tuple[float, Member]:
        """Return the gain of some faults and of the best one beside them, and this one."""
        rest = self.beside(others)
        gains = rest.singles(self.scan.tested)
        c, k = np.unravel_index(int(np.argmax(gains)), gains.shape)
        return float(gains[c, k]), (int(c), int(k))

    def singles(self, tested: np.ndarray) -> Array:
        """Return the gains (C, N) of one more fault, -inf where it is not tested, or explained by those chosen."""
        gains = self.gain + self.sweep.statistic(self.correlations) - self.q[:, None]
        return np.where(tested & self.sweep.tested, gains, -np.inf)

    def best(self, size: int, tested: np.ndarray) -> _Best:
        """Search all subsets of so many more faults, among those tested (C, N), and the chosen ones."""
        if size == 2:
            return self._pairs(tested)
        found = _Best()
        if size == 1:
            gains = self.singles(tested)
            for c, k in enumerate(np.argmax(gains, axis=1).tolist()):
                if np.isfinite(gains[c, k]):
                    found.offer(float(gains[c, k]), [*self.chosen, (c, k)])
            return found
        for k, c in np.argwhere((tested & self.sweep.tested).T).tolist():  # the first of them; the others come later
            later = tested.copy()
            later[:, :k] = later[: c + 1, k] = False
            found.add(self.beside([*self.chosen, (c, k)]).best(size - 1, later))
        return found

    def _pairs(self, tested: np.ndarray) -> _Best:
        from optid.faults.search.pair_kernels import search

        sweep, z = self.sweep, np.zeros_like(self.correlations)
        for c in np.flatnonzero(sweep.tables.sizes).tolist():
            z[:, sweep.columns(c)] = sweep.coordinates(self.correlations, c)
        gains, onsets, alike = search(sweep.tables, self.grams, tested & sweep.tested, z, self.q, ALIKE)
        found = _Best(int(alike))
        for i, j in np.argwhere(np.isfinite(gains)).tolist():
            first, second = onsets[i, j].tolist()
            found.offer(self.gain + float(gains[i, j]), [*self.chosen, (i, first), (j, second)])
        return found
