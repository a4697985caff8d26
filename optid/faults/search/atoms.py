"""Atoms of a window: orthonormal axes of the signature of every candidate at every tested onset, for programmes."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.search.scanning import Scan
from optid.faults.search.sweeps import inverse_roots

if TYPE_CHECKING:
    from optid.faults.false_alarms import Thresholds

MOST = 40_000_000  # largest number of values of the atoms of a window


@dataclass(frozen=True, eq=False)
class Atoms:
    """The atoms of one candidate."""

    label: str  # of the candidate
    onsets: np.ndarray  # (T,) those that are tested
    axes: Array  # (T, N l, d) orthonormal columns; zero ones for directions without effect
    back: Array  # (T, d, d) magnitudes = back @ coefficients of the axes
    threshold: float  # energy q above which the search raises an alarm for the candidate

    @property
    def dimension(self) -> int:
        """Number of magnitudes."""
        return self.axes.shape[2]


def atoms_of(found: Scan, limits: "Thresholds") -> tuple[Atoms, ...]:
    """Return the atoms of every tested candidate, from the search of a window and its thresholds.

    Raises:
        StructureError: thresholds of other candidates or missing for one that is tested; a window that is too long.
    """
    q = limits.of(found.labels, found.tested_anywhere)
    places = [np.flatnonzero(row) for row in found.tested]
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
