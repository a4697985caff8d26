"""Checks of a record before solving: a property that invalidates the result is an error, a weakness a warning."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.arrays import LARGEST
from optid.bases.basis import Basis
from optid.data.record import Data
from optid.errors import DataError, DataWarning
from optid.identify.design.rules import Check, check_condition, check_instruments, check_levels, check_lines
from optid.identify.informativity.excitation import check_numbers
from optid.identify.outliers import find_outliers
from optid.phrases import plural

LEAST_KEPT = 0.5
FEW_DIGITS = 8.0  # beside the level of an output
NAMED = 5  # samples that a finding names
EXAMINED = "outliers"  # of the figures of a fit with a robust loss
BY_RESIDUALS = "outliers by the residuals"
BLOCK_ROWS = 10  # of a subspace method that chooses them itself


@dataclass(frozen=True)
class LeftOut:
    """The samples of an output, per experiment, that a robust loss left out as outliers; a figure of its fit."""

    output: str
    samples: tuple[np.ndarray, ...]

    def __str__(self) -> str:
        return list_samples(self.samples)


def without_outliers(data: Data, figures: Mapping[str, Any]) -> Data:
    """Return a record whose outputs are missing where the fit of these figures left them out as outliers."""
    found = [value for value in figures.values() if isinstance(value, LeftOut)]
    if not found:
        return data
    columns = [e.y.copy() for e in data.experiments]
    for one in found:
        for y, samples in zip(columns, one.samples):
            y[samples, data.outputs.index(one.output)] = np.nan
    kept = iter(columns)
    return data.map_signals(lambda u: u, lambda y: next(kept))


def examine(data: Data, bases: Sequence[Basis], arguments: Mapping[str, Any] | None = None) -> list[str]:
    """Return the weaknesses of a record, one sentence each, and issue every sentence as a `DataWarning`.

    There is one fitted basis per input. The lags among the arguments of the formulation (nb, or block_rows of a
    subspace method) are compared with the spectral lines of the inputs; with a tolerance among them a singular
    regressor is only a warning. `DataError`: a constant or missing channel, too few levels to determine the basis, or
    too few spectral lines to determine its coefficients at every lag.
    """
    arguments = arguments or {}
    forced = arguments.get("tolerance") is not None
    found: list[str] = []
    for c, (name, basis) in enumerate(zip(data.inputs, bases)):
        records = [e.u[:, c] for e in data.experiments]
        u = _present("input", name, records)
        if basis.size > 1:
            found += _sentences(check_levels(name, u, basis))
        if (lags := _lags(arguments, c)) is not None:
            check = check_lines(name, records, basis, lags)
            found += _sentences(replace(check, severity="warning") if forced and check.severity == "error" else check)
        if basis.interval is not None:
            found += list_outside("input", name, float(np.mean(basis.is_outside(u))), basis)
        found += _outliers("input", name, records, arguments)
    if (check := check_numbers(data, arguments)) is not None:
        found += _sentences(replace(check, severity="warning") if forced and check.severity == "error" else check)
    for o, name in enumerate(data.outputs):
        records = [e.y[:, o] for e in data.experiments]
        y = _present("output", name, records)
        found += _outliers("output", name, records, arguments)
        mean = float(np.mean(y))
        size, level = float(np.linalg.norm(y - mean)) / np.sqrt(y.size), abs(mean)
        digits = -np.log10(np.finfo(float).eps * max(level / size, 1.0))
        if digits < FEW_DIGITS:
            found.append(f"output {name!r} varies by {size:.1e} around {level:.1e}, which leaves {digits:.1f} decimal "
                         "digits of its variation: record it relative to its level")
    return _warned(found)


def examine_figures(figures: Mapping[str, Any]) -> list[str]:
    """Return findings about the figures of a fit: conditioning, rows lost, and outliers left out by a robust loss.

    The figures, where present, are the rows used, the `candidates` without missing samples, the condition number of the
    column-scaled expanded regressor, and that of R11, the regressors of a subspace method projected on its instruments.
    """
    checks = {"condition": check_condition, "condition of R11": check_instruments}
    found = [sentence for key in checks if key in figures for sentence in _sentences(checks[key](figures[key]))]
    found += [f"{key}, {samples}, were left out with every row that contains one"
              for key, samples in figures.items() if key.startswith(BY_RESIDUALS)]
    found = _warned(found)
    rows, candidates = figures.get("rows", 0), figures.get("candidates", 0)
    if rows < LEAST_KEPT * candidates:  # the statistics have already issued this warning
        found.append(f"only {100 * rows / candidates:.0f} % of the rows are free of missing samples")
    return found


def list_outside(role: str, name: str, share: float, basis: Basis) -> list[str]:
    """Return a finding about the share of the samples of a channel outside the interval of its basis, if any."""
    if not share or basis.interval is None:
        return []
    low, high = basis.interval
    return [f"{100 * share:.2g} % of {role} {name!r} lies outside the interval [{low:g}, {high:g}] of its basis, where "
            f"outside={basis.outside!r} applies"]


def list_samples(found: Sequence[np.ndarray]) -> str:
    """Name the first samples of every experiment, as in "samples 3, 17, 40 and 5 more"."""
    places = [f"{k} of experiment {e + 1}" if len(found) > 1 else str(k) for e, part in enumerate(found) for k in part]
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    return f"{'sample' if len(places) == 1 else 'samples'} {', '.join(places[:NAMED])}{more}"


def _sentences(check: Check) -> list[str]:
    """Return the sentence of a warning; raise an error."""
    if check.severity == "error":
        raise DataError(check.sentence)
    return [check.sentence] if check.severity == "warning" else []


def _warned(found: list[str]) -> list[str]:
    for sentence in found:
        warnings.warn(sentence, DataWarning, stacklevel=6)
    return found


def _present(role: str, name: str, records: Sequence[np.ndarray]) -> np.ndarray:
    """Return the samples of a channel that are present, at least two different ones."""
    x = np.concatenate(records)
    missing = np.isnan(x)
    x = x[~missing] if missing.any() else x
    if x.size == 0:
        raise DataError(f"{role} {name!r} has no samples; choose another column or drop the {role}")
    width = np.ptp(x)
    if width == 0:
        raise DataError(f"{role} {name!r} is constant ({x[0]:g}): check the column, or drop the channel")
    if width < 1 / LARGEST:
        raise DataError(f"{role} {name!r} varies by {width:.1e}, whose square is zero in floating point: change its "
                        "unit")
    return x


def _lags(arguments: Mapping[str, Any], c: int) -> int | None:
    """Number of lags at which the functions of input c are regressors, None where the arguments do not contain it."""
    given, nx = arguments.get("block_rows", arguments.get("nb")), arguments.get("nx")
    if "block_rows" in arguments and given is None:
        given = max(BLOCK_ROWS, 2 * nx if isinstance(nx, int) else 0)
    if isinstance(given, list | tuple):
        given = given[c] if c < len(given) else None
    return int(given) if isinstance(given, int | np.integer) and given > 0 else None


def _outliers(role: str, name: str, records: Sequence[np.ndarray], arguments: Mapping[str, Any]) -> list[str]:
    found = find_outliers(records)
    count = sum(part.size for part in found)
    if not count:
        return []
    loss = str(arguments.get("loss", "")).partition(":")[0]
    advice = f"mark {'it' if count == 1 else 'them'} as missing (NaN)"
    if role == "output" and loss in ("huber", "l1"):
        advice = f"loss={loss!r} leaves out every row that contains one, as output or as past output"
    elif role == "output" and loss:
        advice += ", or use loss='huber', which leaves out every row that contains one"
    else:
        advice = f"check the record and {advice}"
    return [f"{plural(count, 'outlier')} in {role} {name!r} ({list_samples(found)}): {advice}"]
