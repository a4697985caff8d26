"""Better members for a few faults: exchange one at a time for the best of all candidates and onsets.

What the others explain is taken out of the window and out of every atom; the best of what is left replaces the one in
question. Every exchange raises the gain, and the end is a subset that no single exchange improves.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from optid.arrays import Array
from optid.faults.search.atoms import Atoms
from optid.faults.search.scanning import ALIKE
from optid.faults.search.sweeps import inverse_roots

ROUNDS = 20

Member = tuple[str, int]
"""Label of a candidate and its onset."""


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
    """Gain of the others with the best atom beside them, and which it is."""
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
