"""Atoms of a window: orthonormal axes of the signature of every candidate at every tested onset.

They serve programmes that choose several faults at once, and the exchange of one fault at a time for the best of all
candidates and onsets beside the others, which ends at a subset that no single exchange improves.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.search.scanning import ALIKE, Scan
from optid.faults.search.sweeps import inverse_roots

if TYPE_CHECKING:
    from optid.faults.search.calibration import Thresholds

ROUNDS = 20
"""Largest number of rounds of exchanges."""

Member = tuple[str, int]
"""Label of a candidate and its onset."""

MOST = 40_000_000
"""Largest number of values of the atoms of a window."""


@dataclass(frozen=True, eq=False)
class Atoms:
    """The atoms of one candidate.

    Attributes:
        label: of the candidate.
        onsets: (T,) those that are tested.
        axes: (T, N l, d) orthonormal columns; zero ones for directions without effect.
        back: (T, d, d) magnitudes = back @ coefficients of the axes.
        threshold: energy q above which the search raises an alarm for the candidate.
    """

    label: str
    onsets: np.ndarray
    axes: Array
    back: Array
    threshold: float

    @property
    def dimension(self) -> int:
        """Number of magnitudes."""
        return self.axes.shape[2]


def atoms_of(found: Scan, limits: "Thresholds", onsets: np.ndarray | None = None) -> tuple[Atoms, ...]:
    """Return the atoms of every tested candidate.

    Args:
        found: the search of the window.
        limits: its thresholds.
        onsets: a mask (N,) of the onsets; all by default.

    Raises:
        StructureError: thresholds of other candidates or missing for one that is tested; a window that is too long.
    """
    q = limits.of(found.labels, found.tested_anywhere)
    wanted = np.ones(found.statistic.shape[1], dtype=bool) if onsets is None else onsets
    places = [np.flatnonzero(~np.isnan(row) & wanted) for row in found.statistic]
    columns = sum(where.size * c.dimension for where, c in zip(places, found.dictionary.candidates))
    if columns * found.whitened.r.size > MOST:
        raise StructureError(
            f"{columns} columns of {found.whitened.r.size} readings are too many for a programme over all onsets: use "
            "a shorter window, or scan fewer onsets (scan(..., onsets=...)).")
    made = []
    for candidate, where, threshold in zip(found.dictionary.candidates, places, q):
        if not where.size:
            continue
        traces = np.stack([found.signature(candidate, int(onset)) for onset in where])
        flat = traces.reshape(where.size, found.whitened.r.size, -1)
        products = np.einsum("tkp,tkq->tpq", flat, flat)
        largest = np.asarray(np.linalg.eigvalsh(products)[:, -1], dtype=float)
        back = np.swapaxes(inverse_roots(products, largest), 1, 2)
        made.append(Atoms(candidate.label, where, flat @ back, back, float(threshold)))
    return tuple(made)


def exchanged(atoms: Sequence[Atoms], r: Array, members: Iterable[Member], gain: float) -> tuple[float, list[Member]]:
    """Return the gain and the members that no single exchange improves, from members of some gain; window r (N l,)."""
    found, best = list(members), gain
    for _ in range(ROUNDS):
        before = best
        for i in range(len(found)):
            gain, member = _best_beside(atoms, r, found[:i] + found[i + 1 :])
            if gain > best + 1e-9 * (1 + abs(best)):
                best, found[i] = gain, member
        if best == before:
            break
    return best, found


def _best_beside(atoms: Sequence[Atoms], r: Array, others: Sequence[Member]) -> tuple[float, Member]:
    """Gain of the others with the best atom added, and this atom."""
    named = {own.label: own for own in atoms}
    parts = [named[label].axes[int(np.searchsorted(named[label].onsets, onset))] for label, onset in others]
    left, sizes, _ = np.linalg.svd(np.hstack([np.zeros((r.size, 0)), *parts]), full_matrices=False)
    basis = left[:, sizes > np.sqrt(ALIKE)]
    along = basis.T @ r
    rest, before = r - basis @ along, float(along @ along) - sum(named[label].threshold for label, _ in others)
    best, member = -np.inf, ("", -1)
    for own in atoms:
        score = np.einsum("tkd,k->td", own.axes, rest)
        shared = np.einsum("tkd,kq->tdq", own.axes, basis)
        left = np.eye(own.dimension) - np.einsum("tdq,teq->tde", shared, shared)
        roots = inverse_roots(left, np.ones(len(left)), ALIKE)
        energy = np.sum(np.einsum("tde,te->td", roots, score) ** 2, axis=1)
        energy[~roots.any(axis=(1, 2))] = -np.inf
        t = int(np.argmax(energy))
        gain = before + float(energy[t]) - own.threshold
        if gain > best:
            best, member = gain, (own.label, int(own.onsets[t]))
    return best, member
