"""Better members for a few faults: exchange one at a time for the best of all candidates and onsets.

What the others explain is taken out of the window and out of every atom; the best of what is left replaces the one in
question. Every exchange raises the gain, and the end is a subset that no single exchange improves.
"""

from collections.abc import Sequence

import numpy as np

from optid.arrays import Array
from optid.faults.search.atoms import Atoms

ALIKE = 2e-6
"""Energy of its own, of a unit atom, below which the others explain it."""

ROUNDS = 20


def exchanged(atoms: Sequence[Atoms], r: Array, members: Sequence[tuple[str, int]]
              ) -> tuple[float, list[tuple[str, int]]]:
    """Return the gain and the members that no single exchange improves.

    Args:
        atoms: of all candidates and onsets.
        r: (N l,) the window.
        members: label and onset of each fault to begin with.
    """
    found = list(members)
    best = _gain(atoms, r, found)
    for _ in range(ROUNDS):
        before = best
        for i in range(len(found)):
            others = found[:i] + found[i + 1 :]
            gain, member = _best_beside(atoms, r, others)
            if gain > best + 1e-9 * (1 + abs(best)):
                best, found[i] = gain, member
        if best == before:
            break
    return best, found


def _basis(atoms: Sequence[Atoms], members: Sequence[tuple[str, int]], size: int) -> tuple[Array, float]:
    """Return orthonormal axes of what members span, and the sum of their thresholds."""
    parts, paid = [np.zeros((size, 0))], 0.0
    for label, onset in members:
        own = next(a for a in atoms if a.label == label)
        parts.append(own.axes[int(np.searchsorted(own.onsets, onset))])
        paid += own.threshold
    left, values, _ = np.linalg.svd(np.hstack(parts), full_matrices=False)
    return left[:, values > np.sqrt(ALIKE)], paid


def _gain(atoms: Sequence[Atoms], r: Array, members: Sequence[tuple[str, int]]) -> float:
    basis, paid = _basis(atoms, members, r.size)
    return float(np.sum((basis.T @ r) ** 2)) - paid


def _best_beside(atoms: Sequence[Atoms], r: Array, others: Sequence[tuple[str, int]]) -> tuple[float, tuple[str, int]]:
    basis, paid = _basis(atoms, others, r.size)
    along = basis.T @ r
    rest, explained = r - basis @ along, float(along @ along)
    best, member = -np.inf, ("", -1)
    for own in atoms:
        score = np.einsum("tkd,k->td", own.axes, rest)
        shared = np.einsum("tkd,kq->tdq", own.axes, basis)
        products = np.eye(own.dimension) - np.einsum("tdq,teq->tde", shared, shared)
        values, axes = np.linalg.eigh(products)
        kept = values > ALIKE
        parts = np.einsum("tde,td->te", axes, score) ** 2 / np.where(kept, values, 1.0)
        energy = np.sum(np.where(kept, parts, 0.0), axis=1)
        energy[~kept.any(axis=1)] = -np.inf
        t = int(np.argmax(energy))
        gain = explained + float(energy[t]) - paid - own.threshold
        if gain > best:
            best, member = gain, (own.label, int(own.onsets[t]))
    return best, member
