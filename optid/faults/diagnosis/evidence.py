"""The record behind a diagnosis, for pictures and for the course of a fault."""

from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.faults.search.scanning import Scan


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the search saw.

    Attributes:
        r: (N, l) whitened innovations.
        present: (N, l) whether a reading is there.
        fitted: (N, l) what the best answer leaves in them; zero where there is none.
        gains: (C, N) energy explained less the threshold, NaN where a candidate is not tested.
        labels: the C candidates.
        y: (N, l) readings.
        predicted: (N, l) one step ahead.
        search: the scan; None where no candidate has a signature.
    """

    r: Array
    present: np.ndarray
    fitted: Array
    gains: Array
    labels: tuple[str, ...]
    y: Array
    predicted: Array
    search: Scan | None
