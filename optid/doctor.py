"""Examine a record before solving: what makes the answer meaningless is an error, what weakens it a warning."""

import warnings
from collections.abc import Sequence

import numpy as np

from optid.bases.basis import Basis
from optid.channels import count_levels
from optid.data import Data
from optid.errors import DataError, DataWarning

FEW_LEVELS = 20  # below this many distinct values a curve between them is interpolation, not identification
OUTLIER = 10.0  # robust standard deviations
LEAST_KEPT = 0.5
WORST_CONDITION = 1e7


def examine(data: Data, bases: Sequence[Basis]) -> list[str]:
    """Examine inputs and outputs against the bases that are to be identified from them.

    Args:
        data: the record.
        bases: one fitted basis per input.

    Returns:
        What weakens the answer, one sentence each; every sentence is also issued as a `DataWarning`.

    Raises:
        DataError: a constant or missing input, or too few levels to determine the basis.
    """
    found: list[str] = []
    for c, (name, basis) in enumerate(zip(data.inputs, bases)):
        u = np.concatenate([e.u[:, c] for e in data.experiments])
        u = u[~np.isnan(u)]
        found += _levels(name, u, basis)
        found += _range(name, u, basis)
        found += _outliers("input", name, u)
    for o, name in enumerate(data.outputs):
        y = np.concatenate([e.y[:, o] for e in data.experiments])
        y = y[~np.isnan(y)]
        if y.size == 0:
            raise DataError(f"output {name!r} has no sample at all; choose another column or drop the output")
        if np.ptp(y) == 0:
            raise DataError(f"output {name!r} is constant ({y[0]:g}): there is nothing to explain; check the column")
        found += _outliers("output", name, y)
        found += _units(name, y)
    for sentence in found:
        warnings.warn(sentence, DataWarning, stacklevel=4)
    return found


def _levels(name: str, u: np.ndarray, basis: Basis) -> list[str]:
    if u.size == 0:
        raise DataError(f"input {name!r} has no sample at all; choose another column or drop the input")
    if np.ptp(u) == 0:
        raise DataError(f"input {name!r} is constant ({u[0]:g}): nothing can be identified from it; "
                        "excite the input or drop the channel")
    if count_levels(u[:4096]) > 4 * FEW_LEVELS or basis.size == 1:
        return []
    levels = count_levels(u)
    if levels == 2:
        raise DataError(f"input {name!r} is binary: a static nonlinearity cannot be identified from two levels "
                        "(any function is a straight line there); use the formulation 'arx' or a basis 'linear'")
    if levels - 1 < basis.size:
        raise DataError(f"input {name!r} takes {levels} levels, which determine at most {levels - 1} functions besides "
                        f"the constant; the basis has {basis.size}. Use a smaller basis or excite more levels")
    if levels < FEW_LEVELS:
        return [f"too few levels: input {name!r} takes {levels} distinct values for {basis.size} basis functions; "
                "the nonlinearity between them is interpolation"]
    return []


def _range(name: str, u: np.ndarray, basis: Basis) -> list[str]:
    outside = basis.n_outside(u)
    if not outside or basis.interval is None:
        return []
    low, high = basis.interval
    return [f"{100 * outside / u.size:.2g} % of input {name!r} lies outside the interval [{low:g}, {high:g}] of its "
            f"basis; there the basis is set to {basis.outside!r}"]


def _outliers(role: str, name: str, x: np.ndarray) -> list[str]:
    if x.size < 50:
        return []
    step = max(1, x.size // 20_000)  # the quartiles of a long record need no more samples
    low, middle, high = np.percentile(x[::step], [25, 50, 75])
    spread = (high - low) / 1.349
    if spread <= 0:
        return []
    count = int(np.count_nonzero(np.abs(x - middle) > OUTLIER * spread))
    if not 0 < count <= 0.01 * x.size:
        return []  # heavy tails are the signal itself, not outliers
    advice = "consider loss='huber'" if role == "output" else "check the record"
    return [f"{count} samples of {role} {name!r} lie more than {OUTLIER:g} robust standard deviations from the median; "
            f"{advice}"]


def _units(name: str, y: np.ndarray) -> list[str]:
    size, offset = float(np.std(y)), abs(float(np.mean(y)))
    if offset > 1e5 * size:
        return [f"output {name!r} varies by {size:.1e} around {offset:.1e}: its digits are spent on the mean; "
                "use data.detrend()"]
    if not 1e-9 < size < 1e9:
        return [f"output {name!r} has a standard deviation of {size:.1e}; state it in a more suitable unit "
                "or use data.scale()"]
    return []


def examine_rows(rows: int, candidates: int, condition: float) -> list[str]:
    """Say how the compressed problem stands: rows kept and conditioning of the expanded regressor.

    Args:
        rows: rows used.
        candidates: rows there would be without missing samples.
        condition: estimated condition number of the column-scaled expanded regressor.
    """
    found = []
    if condition > WORST_CONDITION:
        found.append(f"the expanded regressor is poorly excited: condition number {condition:.1e}; "
                     "use fewer functions or lags, or a richer input")
    for sentence in found:
        warnings.warn(sentence, DataWarning, stacklevel=4)
    if rows < LEAST_KEPT * candidates:  # the statistics have already issued this warning
        found.append(f"only {100 * rows / candidates:.0f} % of the rows are free of missing samples")
    return found
