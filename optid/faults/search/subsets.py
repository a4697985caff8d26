"""The exact search for a few faults among the candidates and onsets that are left of a window.

Maximised is the energy that all faults of a subset explain together less their thresholds, over every subset up to a
size. The products of the atoms carry all that is needed: once a fault is chosen, the others lose what they share with
it (a Schur complement), down to the last two, for which all pairs stand in one table.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import comb
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optid.arrays import Array, check_integer
from optid.errors import StructureError
from optid.faults.search.atoms import Atoms, atoms_of
from optid.faults.search.exchange import exchanged
from optid.faults.search.scanning import Magnitude, Scan
from optid.faults.search.sparse import REACH, SparseResult

if TYPE_CHECKING:
    from optid.faults.search.calibration import Thresholds

SAME = 2e-6
"""One less the squared cosine below which two atoms cannot be told apart."""

MOST = 400_000_000
"""Subsets that are searched at most."""

EXCHANGED = 3
"""Subsets that are improved by exchanges."""

COLUMNS = 6000
"""Columns that the atoms of a search may have."""


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
        """Say what and where."""
        return " and ".join(f"{label} from sample {onset}" for label, onset in zip(self.labels, self.onsets))


@dataclass(frozen=True, eq=False)
class SubsetSearch:
    """Every subset of candidates, each at its best onsets, over the onsets that were searched.

    Attributes:
        scan: the search for one fault.
        best: the subset with the largest gain: the exact optimum over the onsets searched, which no exchange of one
            fault for another at any onset improves; None where nothing gains.
        runner_up: the best one of other candidates.
        ranked: the best subset of every choice of candidates, largest gain first.
        searched: (N,) which onsets were searched.
        subsets: number of subsets compared.
        max_faults: faults in a subset at most.
        sparse: the programme that chose the onsets; None where all were searched.
        alike: pairs of atoms that were left out, because the window cannot tell them apart.
    """

    scan: Scan
    best: Subset | None
    runner_up: Subset | None
    ranked: tuple[Subset, ...] = field(repr=False)
    searched: np.ndarray = field(repr=False)
    subsets: int = 0
    max_faults: int = 2
    sparse: SparseResult | None = None
    alike: int = 0

    @property
    def gain(self) -> float:
        """Gain of the best subset; -inf where there is none."""
        return -np.inf if self.best is None else self.best.gain

    @property
    def margin(self) -> float:
        """Gain of the best subset less that of the best one of other candidates."""
        return np.inf if self.runner_up is None else self.gain - self.runner_up.gain

    @property
    def certified(self) -> bool:
        """Whether the onsets were chosen by a programme with a proof, or all were searched."""
        return self.sparse is None or self.sparse.certified

    def estimate(self, subset: Subset) -> Magnitude:
        """Return the magnitudes of all faults of a subset, one after the other, and their covariance."""
        flat = np.concatenate([self.scan.signature(label, onset).reshape(self.scan.whitened.r.size, -1)
                               for label, onset in zip(subset.labels, subset.onsets)], axis=1)
        sizes = np.linalg.norm(flat, axis=0)
        sizes[sizes == 0] = 1.0
        inverse = np.linalg.pinv((flat / sizes).T @ (flat / sizes), rcond=SAME, hermitian=True) / np.outer(sizes, sizes)
        return Magnitude(inverse @ (flat.T @ self.scan.whitened.r.ravel()), inverse)

    def __str__(self) -> str:
        """Print the best subsets and what the search covered."""
        if self.best is None:
            return "no fault gains more than its threshold"
        lines = [f"{label[:50]:<52}from sample {onset}" for label, onset in zip(self.best.labels, self.best.onsets)]
        after = "none" if self.runner_up is None else format(self.runner_up.gain, ".2f")
        lines.append(f"gain {self.gain:.2f}, next choice of candidates {after}")
        share = f"{int(self.searched.sum())} of {self.searched.size} onsets"
        how = "" if self.sparse is None else f", chosen by a programme (gap {self.sparse.gap:.1e})"
        return "\n".join([*lines, f"{self.subsets} subsets at {share}{how}"])


def polish(
    found: Scan, limits: "Thresholds", sparse: SparseResult | None = None, *, max_faults: int = 2, reach: int = REACH,
    exchange: bool = True,
) -> SubsetSearch:
    """Search exactly for up to `max_faults` faults at the onsets near those a programme made use of (F3).

    All candidates are tried at all these onsets: which of them the programme had there does not matter, because it
    confuses those that look alike.

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
    atoms = atoms_of(found, limits, mask) if mask.any() else ()
    number = sum(a.onsets.size for a in atoms)
    subsets = sum(comb(number, k) for k in range(1, max_faults + 1))
    if subsets > MOST or sum(a.onsets.size * a.dimension for a in atoms) > COLUMNS:
        raise StructureError(
            f"{number} candidates and onsets make {subsets:.2g} subsets of up to {max_faults} faults: too many for an "
            "exact search. Use fewer faults, a smaller reach, or scan fewer onsets."
        )
    pool, names = _pool(atoms, found.whitened.r.ravel())
    ranked: list[Subset] = []
    alike = 0
    for size in range(1, min(max_faults, number) + 1):
        best: dict[tuple[int, ...], tuple[float, tuple[int, ...]]] = {}
        alike += _search(pool, size, (), 0.0, best)
        ranked += [_subset(names, members, gain, pool.q) for gain, members in best.values()]
    ranked.sort(key=lambda s: -s.gain)
    if exchange and sparse is not None and ranked and not mask.all():
        ranked = _improved(found, limits, ranked)
    gaining = [s for s in ranked if s.gain > 0]
    runner = next((s for s in ranked[1:] if sorted(s.labels) != sorted(gaining[0].labels)), None) if gaining else None
    return SubsetSearch(
        found, gaining[0] if gaining else None, runner, tuple(ranked), mask, subsets, max_faults, sparse, alike)


def _improved(found: Scan, limits: "Thresholds", ranked: list[Subset]) -> list[Subset]:
    """Exchange the members of the best subsets over all onsets."""
    atoms = atoms_of(found, limits)
    labels, q = found.labels, {a.label: a.threshold for a in atoms}
    best = {tuple(sorted(s.labels)): s for s in reversed(ranked)}
    for subset in ranked[:EXCHANGED]:
        gain, members = exchanged(atoms, found.whitened.r.ravel(), list(zip(subset.labels, subset.onsets)))
        members.sort(key=lambda member: (labels.index(member[0]), member[1]))
        names = tuple(label for label, _ in members)
        if gain > best.get(tuple(sorted(names)), subset._replace(gain=-np.inf)).gain:
            best[tuple(sorted(names))] = Subset(names, tuple(k for _, k in members), gain,
                                                gain + sum(q[label] for label in names))
    return sorted(best.values(), key=lambda s: -s.gain)


class _Pool(NamedTuple):
    """Atoms by their products; the axes of every atom are orthonormal in what is left.

    Attributes:
        products: (P, P).
        along: (P,) coordinates of the window.
        edges: (G + 1,) columns of every atom.
        q: (G,) thresholds.
        kinds: (G,) candidate of every atom.
        places: (G,) what the atoms were called before some were taken away.
    """

    products: Array
    along: Array
    edges: np.ndarray
    q: Array
    kinds: np.ndarray
    places: np.ndarray


def _pool(atoms: Sequence[Atoms], r: Array) -> tuple[_Pool, list[tuple[str, int]]]:
    if not atoms:
        return _Pool(np.zeros((0, 0)), np.zeros(0), np.zeros(1, dtype=int), *(np.zeros(0, dtype=int),) * 3), []
    columns = np.hstack([np.moveaxis(a.axes, 1, 0).reshape(r.size, -1) for a in atoms])
    sizes = np.concatenate([np.full(a.onsets.size, a.dimension) for a in atoms])
    kinds = np.repeat(np.arange(len(atoms)), [a.onsets.size for a in atoms])
    q = np.array([a.threshold for a in atoms])[kinds]
    names = [(a.label, int(onset)) for a in atoms for onset in a.onsets]
    return _Pool(columns.T @ columns, columns.T @ r, np.concatenate([[0], np.cumsum(sizes)]), q, kinds,
                 np.arange(sizes.size)), names


def _subset(names: list[tuple[str, int]], members: tuple[int, ...], gain: float, q: Array) -> Subset:
    chosen = sorted(members)
    return Subset(tuple(names[i][0] for i in chosen), tuple(names[i][1] for i in chosen), gain,
                  gain + float(np.sum(q[chosen])))


def _search(pool: _Pool, size: int, taken: tuple[int, ...], gained: float,
            best: dict[tuple[int, ...], tuple[float, tuple[int, ...]]], kinds: tuple[int, ...] = ()) -> int:
    """Record the best subset of every choice of candidates; return the pairs left out as alike."""
    if size == 1:
        gains = np.add.reduceat(pool.along**2, pool.edges[:-1]) - pool.q if pool.q.size else pool.q
        for kind in np.unique(pool.kinds):
            own = np.flatnonzero(pool.kinds == kind)
            at = own[int(np.argmax(gains[own]))]
            _record(best, (*kinds, int(kind)), gained + float(gains[at]), (*taken, int(pool.places[at])))
        return 0
    if size == 2:
        return _pairs(pool, taken, gained, best, kinds)
    alike = 0
    for i in range(pool.q.size - size + 1):  # the first of the subset; the others come after it
        own = slice(pool.edges[i], pool.edges[i + 1])
        energy = float(np.sum(pool.along[own] ** 2) - pool.q[i])
        rest, lost = _without(pool, i)
        alike += lost
        if rest.q.size >= size - 1:
            alike += _search(rest, size - 1, (*taken, int(pool.places[i])), gained + energy, best,
                             (*kinds, int(pool.kinds[i])))
    return alike


def _record(best: dict[tuple[int, ...], tuple[float, tuple[int, ...]]], kinds: tuple[int, ...], gain: float,
            members: tuple[int, ...]) -> None:
    key = tuple(sorted(kinds))
    if key not in best or gain > best[key][0]:
        best[key] = (gain, members)


def _without(pool: _Pool, i: int) -> tuple[_Pool, int]:
    """Take an atom out of those after it, orthonormalise what is left of them, and drop those of which nothing is."""
    own, after = slice(pool.edges[i], pool.edges[i + 1]), slice(pool.edges[i + 1], None)
    shared = pool.products[own, after]
    products = pool.products[after, after] - shared.T @ shared
    along = pool.along[after] - shared.T @ pool.along[own]
    edges, sizes = pool.edges[i + 1 :] - pool.edges[i + 1], np.diff(pool.edges[i + 1 :])
    scale = np.zeros_like(products)
    kept = np.ones(sizes.size, dtype=bool)
    for g, (lo, hi) in enumerate(zip(edges, edges[1:])):
        values, axes = np.linalg.eigh(products[lo:hi, lo:hi])
        seen = np.diag(pool.products)[pool.edges[i + 1] + lo : pool.edges[i + 1] + hi].sum() > 0
        kept[g] = seen and values[-1] > SAME  # something of it is its own
        there = values > SAME
        scale[lo:hi, lo:hi] = axes / np.where(there, np.sqrt(np.where(there, values, 1.0)), np.inf)
    columns = np.repeat(kept, sizes)
    scale = scale[:, columns]
    return _Pool(scale.T @ products @ scale, scale.T @ along, np.concatenate([[0], np.cumsum(sizes[kept])]),
                 pool.q[i + 1 :][kept], pool.kinds[i + 1 :][kept], pool.places[i + 1 :][kept]), int(np.sum(~kept))


def _pairs(pool: _Pool, taken: tuple[int, ...], gained: float,
           best: dict[tuple[int, ...], tuple[float, tuple[int, ...]]], kinds: tuple[int, ...]) -> int:
    sizes = np.diff(pool.edges)
    alike = 0
    for small in np.unique(sizes):
        for large in np.unique(sizes[sizes >= small]):
            first, second = np.flatnonzero(sizes == small), np.flatnonzero(sizes == large)
            for rows in _blocks(first, second.size * small * large):
                gains, same = _pair_gains(pool, rows, second)
                alike += same
                for a in np.unique(pool.kinds[rows]):
                    for b in np.unique(pool.kinds[second]):
                        part = gains[np.ix_(pool.kinds[rows] == a, pool.kinds[second] == b)]
                        i, j = np.unravel_index(int(np.argmax(part)), part.shape)
                        if np.isfinite(part[i, j]):
                            pair = rows[pool.kinds[rows] == a][i], second[pool.kinds[second] == b][j]
                            _record(best, (*kinds, int(a), int(b)), gained + float(part[i, j]),
                                    (*taken, *(int(pool.places[p]) for p in pair)))
    return alike


def _blocks(rows: np.ndarray, width: int) -> Iterator[np.ndarray]:
    step = max(1, 4_000_000 // max(width, 1))
    for start in range(0, rows.size, step):
        yield rows[start : start + step]


def _pair_gains(pool: _Pool, first: np.ndarray, second: np.ndarray) -> tuple[Array, int]:
    """Gains (F, S) of every pair, -inf where they are one atom or alike; those of equal size once."""
    small, large = (int(np.diff(pool.edges)[g[0]]) for g in (first, second))
    rows = (pool.edges[first][:, None] + np.arange(small)).ravel()
    columns = (pool.edges[second][:, None] + np.arange(large)).ravel()
    shared = pool.products[np.ix_(rows, columns)].reshape(first.size, small, second.size, large)
    b, c = pool.along[rows].reshape(-1, small), pool.along[columns].reshape(-1, large)
    base = np.sum(c**2, axis=1)[None, :] - pool.q[first][:, None] - pool.q[second][None, :]
    rest = b[:, :, None] - np.einsum("iajc,jc->iaj", shared, c)
    if small == 1:
        own = np.diag(pool.products)[rows]  # one, or zero for an atom of which nothing is seen
        left = own[:, None] - np.sum(shared[:, 0] ** 2, axis=2)
        there = left > SAME
        gains = np.where(there, base + rest[:, 0] ** 2 / np.where(there, left, 1.0), -np.inf)
    else:
        products = np.eye(small) - np.einsum("iajc,ibjc->ijab", shared, shared)
        values, axes = np.linalg.eigh(products)
        kept = values > SAME
        there = kept.any(axis=2)
        z = np.einsum("ijab,iaj->ijb", axes, rest) ** 2
        gains = np.where(there, base + np.sum(np.where(kept, z / np.where(kept, values, 1.0), 0.0), axis=2), -np.inf)
    once = first[:, None] < second[None, :] if small == large else np.ones(gains.shape, dtype=bool)
    return np.where(once, gains, -np.inf), int(np.sum(once & ~there))
