"""Exact search for several faults at once.

The energy that all faults of a subset explain together, less their thresholds, is maximised over all subsets up to a
size. It follows from the products of the atoms: once a fault is chosen, it is projected out of the others (a Schur
complement), down to the last two, whose pairs are evaluated in one table. All pairs over all onsets are searched by a
compiled recursion (`optid.faults.search.pair_kernels`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import comb
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optid.arrays import Array, check_integer
from optid.errors import StructureError
from optid.faults.search.atoms import Atoms, atoms_of, exchanged
from optid.faults.search.scanning import ALIKE, Magnitude, Scan
from optid.faults.search.sparse import REACH, SparseResult
from optid.faults.search.sweeps import inverse_roots

if TYPE_CHECKING:
    from optid.faults.search.calibration import Thresholds

MOST = 400_000_000
"""Largest number of subsets searched."""

MOST_PAIRED = 50_000
"""Largest number of atoms (candidates times onsets) whose pairs are searched."""

TABLE = 4_000_000
"""Numbers in a table of pairs."""

EXCHANGED = 3
"""Number of subsets improved by exchanges."""

COLUMNS = 6000
"""Largest number of columns of the atoms of a search."""


class Subset(NamedTuple):
    """A few faults.

    Attributes:
        labels: of the candidates, in the order of the dictionary and of the onsets.
        onsets: of each.
        gain: energy explained less all thresholds.
        energy: energy explained.
    """

    labels: tuple[str, ...]
    onsets: tuple[int, ...]
    gain: float
    energy: float

    def __str__(self) -> str:
        """State candidates and onsets."""
        return " and ".join(f"{label} from sample {onset}" for label, onset in zip(self.labels, self.onsets))


@dataclass(frozen=True, eq=False)
class SubsetSearch:
    """A search for several faults at once; `pairs` and `polish` make it.

    Attributes:
        scan: the search for one fault.
        ranked: the best subset of every choice of candidates, each at its best onsets; largest gain first.
        single: gain of the best single fault.
        searched: (N,) which onsets were searched.
        subsets: number of subsets compared.
        max_faults: faults in a subset at most.
        sparse: the programme that chose the onsets; None where all were searched.
        alike: number of pairs that the window does not distinguish, where all pairs were searched.
        indistinguishable: the first of them.
    """

    scan: Scan
    ranked: tuple[Subset, ...] = field(repr=False)
    single: float
    searched: np.ndarray = field(repr=False)
    subsets: int = 0
    max_faults: int = 2
    sparse: SparseResult | None = None
    alike: int = 0
    indistinguishable: tuple[Subset, ...] = field(default=(), repr=False)

    @property
    def best(self) -> Subset | None:
        """The subset with the largest gain: the exact optimum over the onsets searched; None where nothing gains."""
        return self.ranked[0] if self.ranked and self.ranked[0].gain > 0 else None

    @property
    def runner_up(self) -> Subset | None:
        """The best one of other candidates."""
        others = (s for s in self.ranked[1:] if sorted(s.labels) != sorted(self.ranked[0].labels))
        return next(others, None) if self.best is not None else None

    @property
    def gain(self) -> float:
        """Gain of the best subset; -inf where there is none."""
        return -np.inf if self.best is None else self.best.gain

    @property
    def margin(self) -> float:
        """Gain of the best subset less that of the best one of other candidates: the certificate of the search."""
        return np.inf if self.runner_up is None else self.gain - self.runner_up.gain

    @property
    def two(self) -> bool:
        """Whether several faults are preferred to one, and to none."""
        return self.gain > max(self.single, 0.0)

    @property
    def certified(self) -> bool:
        """Whether the onsets were chosen by a programme with a proof, or all were searched."""
        return self.sparse is None or self.sparse.certified

    def estimate(self, subset: Subset) -> Magnitude:
        """Return the magnitudes of all faults of a subset, one after the other, and their covariance."""
        return self.scan.together(subset.labels, subset.onsets)

    def __str__(self) -> str:
        """Print the best subset and what the search covered."""
        if self.best is None:
            lines = ["no fault gains more than its threshold"]
        else:
            lines = [f"{label[:50]:<52}from sample {onset}" for label, onset in zip(self.best.labels, self.best.onsets)]
            after = "none" if self.runner_up is None else format(self.runner_up.gain, ".2f")
            lines.append(f"gain {self.gain:.2f}, best single fault {self.single:.2f}, next choice {after}")
        share = f"{int(self.searched.sum())} of {self.searched.size} onsets"
        how = "" if self.sparse is None else f", chosen by a programme (gap {self.sparse.gap:.1e})"
        lines.append(f"{self.subsets} subsets at {share}{how}")
        lines += [f"{self.alike} pairs of onsets are indistinguishable in this window"] * bool(self.alike)
        return "\n".join(lines)


def pairs(scan: Scan, thresholds: "Thresholds", *, same: bool = True) -> SubsetSearch:
    """Search a window for two faults, exactly: all pairs of candidates and onsets, magnitudes by least squares (F4).

    Args:
        scan: the search for one fault.
        thresholds: of the same candidates.
        same: whether both faults may be of one candidate, as a fault that comes and goes.

    Raises:
        StructureError: thresholds of other candidates or without some that are tested, too many pairs.
    """
    from optid.faults.search.pair_kernels import Grams, search
    from optid.faults.search.sweep_kernels import grams

    prepared, tested = scan.sweep, scan.tested
    q = thresholds.of(scan.labels, scan.tested_anywhere)
    number = int(tested.sum())
    if number > MOST_PAIRED:
        raise StructureError(
            f"{number} candidates and onsets are too many for all pairs ({MOST_PAIRED}): scan a shorter window or "
            "fewer onsets (scan(..., onsets=)), or use the sparse method."
        )
    n, columns = prepared.tables.F.shape[1], prepared.tables.group.size
    products, states = np.zeros((prepared.window, columns**2)), np.empty((prepared.window, n, columns))
    grams(prepared.tables, np.arange(columns**2).reshape(columns, columns), products, states)
    z = np.zeros_like(scan.correlations)
    for c in np.flatnonzero(prepared.tables.sizes).tolist():
        z[:, prepared.columns(c)] = prepared.coordinates(scan.correlations, c)
    known = Grams(products.reshape(-1, columns, columns), states, prepared.along, prepared.roots)
    best, onsets, alike, same_trace = search(prepared.tables, known, tested, z, np.nan_to_num(q), same, ALIKE)

    def pair(i: int, j: int, gain: float, first: int, second: int) -> Subset:
        return Subset((scan.labels[i], scan.labels[j]), (int(first), int(second)), gain, float(gain + q[i] + q[j]))

    found = [pair(i, j, float(best[i, j]), *onsets[i, j]) for i, j in np.argwhere(np.isfinite(best))]
    single = float(np.max(scan.gains(thresholds)[tested], initial=-np.inf))
    return SubsetSearch(
        scan, tuple(sorted(found, key=lambda s: -s.gain)), single,
        np.asarray(tested.any(axis=0)), number * (number - 1) // 2, 2, alike=int(same_trace),
        indistinguishable=tuple(pair(a, b, np.nan, i, j) for a, i, b, j in alike),
    )


def polish(
    found: Scan, limits: "Thresholds", sparse: SparseResult | None = None, *, max_faults: int = 2, reach: int = REACH,
    exchange: bool = True,
) -> SubsetSearch:
    """Search exactly for up to `max_faults` faults at the onsets near the active ones of a programme (F3).

    All candidates are tried at all these onsets, because the programme confuses those with similar signatures.

    Args:
        found: the search for one fault.
        limits: its thresholds.
        sparse: the programme's result; None searches all onsets.
        max_faults: faults in a subset at most.
        reach: onsets on either side of an active one.
        exchange: whether the best subsets are improved by exchanges over all onsets afterwards.

    Raises:
        StructureError: too many subsets for an exact search, or an impossible number of faults.
    """
    check_integer(max_faults, "max_faults")
    count = found.statistic.shape[1]
    mask = np.ones(count, dtype=bool) if sparse is None else sparse.near(reach)
    atoms = atoms_of(found, limits, mask) if mask.any() else tuple[Atoms, ...]()
    number = sum(a.onsets.size for a in atoms)
    subsets = sum(comb(number, k) for k in range(1, max_faults + 1))
    if subsets > MOST or sum(a.onsets.size * a.dimension for a in atoms) > COLUMNS:
        raise StructureError(
            f"{number} candidates and onsets make {subsets:.2g} subsets of up to {max_faults} faults: too many for an "
            "exact search. Use fewer faults, a smaller reach, or scan fewer onsets."
        )
    r = found.whitened.r.ravel()
    columns = np.hstack([np.zeros((r.size, 0)), *(np.moveaxis(a.axes, 1, 0).reshape(r.size, -1) for a in atoms)])
    kinds = np.repeat(np.arange(len(atoms)), [a.onsets.size for a in atoms]).astype(int)
    edges = np.cumsum([0, *(atoms[kind].dimension for kind in kinds)])
    q = np.array([atoms[kind].threshold for kind in kinds])
    pool = _Pool(columns.T @ columns, columns.T @ r, edges, q, kinds, np.arange(kinds.size))
    names = [(a.label, int(onset)) for a in atoms for onset in a.onsets]
    best: dict[tuple[int, ...], tuple[float, tuple[int, ...]]] = {}
    for size in range(1, min(max_faults, number) + 1):
        for gain, members in _search(pool, size):
            chosen = tuple(sorted(kinds[list(members)]))
            if chosen not in best or gain > best[chosen][0]:
                best[chosen] = gain, tuple(sorted(members))
    ranked = []
    for gain, members in best.values():
        labels, onsets = zip(*(names[i] for i in members))
        ranked.append(Subset(labels, onsets, gain, gain + float(np.sum(q[list(members)]))))
    ranked.sort(key=lambda s: -s.gain)
    if exchange and sparse is not None and ranked and not mask.all():
        ranked = _improved(found, limits, ranked)
    single = max((s.gain for s in ranked if len(s.labels) == 1), default=-np.inf)
    return SubsetSearch(found, tuple(ranked), single, mask, subsets, max_faults, sparse)


def _improved(found: Scan, limits: "Thresholds", ranked: list[Subset]) -> list[Subset]:
    """Exchange the members of the best subsets over all onsets."""
    atoms = atoms_of(found, limits)
    best = {tuple(sorted(s.labels)): s for s in reversed(ranked)}
    for subset in ranked[:EXCHANGED]:
        gain, members = exchanged(atoms, found.whitened.r.ravel(), zip(subset.labels, subset.onsets), subset.gain)
        members.sort(key=lambda member: (found.labels.index(member[0]), member[1]))
        names, onsets = zip(*members)
        if gain > best.get(tuple(sorted(names)), subset._replace(gain=-np.inf)).gain:
            energy = gain + sum(limits.q[found.labels.index(name)] for name in names)
            best[tuple(sorted(names))] = Subset(names, onsets, gain, float(energy))
    return sorted(best.values(), key=lambda s: -s.gain)


class _Pool(NamedTuple):
    """Atoms by their products (P, P) and the coordinates `along` (P,) of the window; the axes of each are orthonormal.

    For each of the G atoms: edges (G + 1,) of its columns, threshold q, candidate, and its number `places` in the
    whole pool.
    """

    products: Array
    along: Array
    edges: np.ndarray
    q: Array
    kinds: np.ndarray
    places: np.ndarray


def _search(pool: _Pool, size: int) -> Iterator[tuple[float, tuple[int, ...]]]:
    """Gains and atoms of subsets: the best of every choice of candidates is among them."""
    if size == 1:
        gains = np.add.reduceat(pool.along**2, pool.edges[:-1]) - pool.q if pool.q.size else pool.q
        for kind in np.unique(pool.kinds):
            own = np.flatnonzero(pool.kinds == kind)
            at = own[int(np.argmax(gains[own]))]
            yield float(gains[at]), (int(pool.places[at]),)
    elif size == 2:
        yield from _pairs(pool)
    else:
        for i in range(pool.q.size - size + 1):  # the first of the subset; the others come after it
            own = slice(pool.edges[i], pool.edges[i + 1])
            energy = float(np.sum(pool.along[own] ** 2) - pool.q[i])
            for gain, members in _search(_without(pool, i), size - 1):
                yield energy + gain, (int(pool.places[i]), *members)


def _without(pool: _Pool, i: int) -> _Pool:
    """Project an atom out of those after it, orthonormalise these, and drop those that vanish."""
    own, after = slice(pool.edges[i], pool.edges[i + 1]), slice(pool.edges[i + 1], None)
    shared = pool.products[own, after]
    products = pool.products[after, after] - shared.T @ shared
    along = pool.along[after] - shared.T @ pool.along[own]
    edges = pool.edges[i + 1 :] - pool.edges[i + 1]
    scale = np.zeros_like(products)
    for lo, hi in zip(edges, edges[1:]):
        scale[lo:hi, lo:hi] = inverse_roots(products[None, lo:hi, lo:hi], np.ones(1), ALIKE)[0].T
    sizes = np.diff(edges)
    kept = np.add.reduceat(np.any(scale, axis=0), edges[:-1]) > 0 if sizes.size else np.zeros(0, dtype=bool)
    scale = scale[:, np.repeat(kept, sizes)]
    return _Pool(scale.T @ products @ scale, scale.T @ along, np.concatenate([[0], np.cumsum(sizes[kept])]),
                 *(values[i + 1 :][kept] for values in (pool.q, pool.kinds, pool.places)))


def _pairs(pool: _Pool) -> Iterator[tuple[float, tuple[int, ...]]]:
    """Gains of pairs of atoms, the smaller one beside the larger; none where they are alike."""
    sizes = np.diff(pool.edges)
    for large in np.unique(sizes):
        for small in np.unique(sizes[sizes <= large]):
            every, second = np.flatnonzero(sizes == large), np.flatnonzero(sizes == small)
            for first in np.array_split(every, -(-every.size * second.size * int(large * small) // TABLE)):
                gains = _pair_gains(pool, first, second, int(large), int(small))
                for a in np.unique(pool.kinds[first]):
                    for b in np.unique(pool.kinds[second]):
                        rows, columns = np.flatnonzero(pool.kinds[first] == a), np.flatnonzero(pool.kinds[second] == b)
                        part = gains[np.ix_(rows, columns)]
                        i, j = np.unravel_index(int(np.argmax(part)), part.shape)
                        if np.isfinite(part[i, j]):
                            pair = int(pool.places[first[rows[i]]]), int(pool.places[second[columns[j]]])
                            yield float(part[i, j]), pair


def _pair_gains(pool: _Pool, first: np.ndarray, second: np.ndarray, large: int, small: int) -> Array:
    """Gains (F, S) of every pair, -inf where they are one atom or alike; those of equal size once."""
    rows = (pool.edges[first][:, None] + np.arange(large)).ravel()
    columns = (pool.edges[second][:, None] + np.arange(small)).ravel()
    shared = pool.products[np.ix_(rows, columns)].reshape(first.size, large, second.size, small)
    b, c = pool.along[rows].reshape(-1, large), pool.along[columns].reshape(-1, small)
    rest = c[None] - np.einsum("iajc,ia->ijc", shared, b)
    own = np.diag(pool.products)[columns].reshape(-1, small)  # one, or zero for a direction without effect
    left = own[:, :, None] * np.eye(small) - np.einsum("iajc,iajd->ijcd", shared, shared)
    roots = inverse_roots(left.reshape(-1, small, small), np.ones(left.shape[0] * left.shape[1]), ALIKE)
    roots = roots.reshape(left.shape)
    gains = np.sum(b**2, axis=1)[:, None] - pool.q[first][:, None] - pool.q[second][None, :]
    gains = gains + np.sum(np.einsum("ijcd,ijd->ijc", roots, rest) ** 2, axis=2)
    once = first[:, None] < second[None, :] if small == large else np.ones(gains.shape, dtype=bool)
    return np.where(once & roots.any(axis=(2, 3)), gains, -np.inf)
