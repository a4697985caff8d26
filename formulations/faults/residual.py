"""Half the squares of whitened innovations or covariances: the objective of the fault programmes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from optid.core.terms import Squares


def half_squares(target: np.ndarray, parts: Mapping[str, np.ndarray], numbers: Any = None) -> Squares:
    """Return the term ``1/2 ‖target - sum parts[name] vec(name)‖²``, target (M,), parts (M, size) column by column.

    The numbers are those that special methods know of it.
    """
    half = np.sqrt(0.5)
    return Squares(half * np.hstack(list(parts.values())), half * target, 0.0, tuple(parts), numbers)
