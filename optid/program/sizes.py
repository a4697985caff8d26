"""What residuals are relative to: sizes of unknowns, and of the terms of a gradient."""

import numpy as np

from optid.arrays import Array

GAUGE = "gauge"  # of the constraints that fix the scale between the factors of products, which no objective sees
ZERO = 1e-9  # a variable without a start that is smaller than this has no size to measure by


def relative_gradient(gradient: Array, terms: Array, yardstick: float, size: float) -> float:
    """Return the largest component relative to its terms plus the objective's size per size of the variable."""
    floor = yardstick / size + terms
    return float(np.max(gradient / np.where(floor > 0, floor, 1.0), initial=0.0))


def variable_size(value: Array, usual: float | None) -> float:
    """Return the largest entry of a value or of its start; one where there is no start and nothing but rounding."""
    size = float(np.max(np.abs(value), initial=0.0))
    if usual is not None:
        return max(size, usual)
    return size if size > ZERO else 1.0
