"""What was estimated, as rows: coefficients and nonlinearities with their errors."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from optid.bases.splines import Triangular
from optid.identify.fitting import Fit
from optid.identify.parameters import Parameter, Parameters, coefficient_parameters, function_parameters
from optid.identify.parameters import uncertainty_or_reason as uncertainty
from optid.models.functions import static_functions
from optid.show.wording import Table, number, with_unit

MOST_NODES, EVEN = 20, 11
"""A piecewise linear f with fewer cells than the first is listed at its nodes, any other at so many points."""

MOST_ROWS, ABREAST = 12, 3
"""More coefficients than the first, without errors to show, are set in so many columns."""


def parameter_tables(fit: Fit) -> list[Table]:
    """Estimates with their standard errors and 95 % intervals if available, then matrices without."""
    known, reason = uncertainty(fit)
    found = []
    if known is not None:
        state_space = fit.model.structure == "ss"
        found.append(_parameter_table("Poles and static gain" if state_space else "Parameters",
                                      coefficient_parameters(fit.model, known), False, note=_remark(known)))
        if not state_space:
            return found
    rows = coefficient_parameters(fit.model, None)
    title, note = ("Parameters", f"No standard errors: {reason.rstrip('.')}.") if known is None else (
        "Matrices", "They depend on the choice of state coordinates, which no record determines.")
    if len(rows) <= MOST_ROWS:
        return [*found, _parameter_table(title, rows, True, note=note)]
    cells = _abreast([(row.name, number(row.estimate)) for row in rows])
    return [*found, Table(title, ("parameter", "estimate") * ABREAST, cells, note)]


def _remark(known: Any) -> str:
    words = getattr(known.source, "words", ())
    return f"The errors are {' and '.join(words)}; the standard errors account for it." if words else ""


def nonlinearity_tables(fit: Fit, inputs: bool) -> list[Table]:
    """Values of nonlinearities at a few points, with their pointwise bands where there are some.

    Those of the inputs, in the gauge of the model, or those of outputs that are fed back and of latent signals.
    """
    found = []
    known, _ = uncertainty(fit)
    for function in static_functions(fit.model):
        if function.is_linear or inputs != (function.family == "nonlinearities"):
            continue
        f = function.nonlinearity
        basis: Any = f.basis
        points = basis.grid(basis.p + 1 if isinstance(basis, Triangular) and basis.p < MOST_NODES else EVEN)
        if known is None:
            rows, head = [(number(u, 4), number(value)) for u, value in zip(points, f(points))], ()
        else:
            band = known.band(function.index, points, family=function.family)
            numeric = zip(points, band.value, band.error, band.lower, band.upper)
            size = float(np.max(np.abs(band.value)))
            rows = [interval_row(number(u, 4), *row, size=size) for u, *row in numeric]
            head = ("std. error", "95 % low", "95 % high")
        title = f"{function.what} {function.word}, basis {_basis(f.basis)}"
        found.append(Table(title, (with_unit(function.name, function.unit), function.word, *head), rows))
    return found


def coefficient_table(fit: Fit) -> Table | None:
    """Coefficients mu of the bases; None where every channel is linear."""
    known, _ = uncertainty(fit)
    functions = [function for function in static_functions(fit.model) if not function.is_linear]
    rows = [row for function in functions for row in function_parameters(function, known)]
    return _parameter_table("Coefficients of the basis", rows, known is None) if rows else None


def parameters_table(found: Parameters) -> Table:
    """Every parameter with its interval, and its unit where one is known."""
    reason = [f"No standard errors: {found.reason.rstrip('.')}."] if found.reason else []
    return _parameter_table(found.title, found, bool(found.reason), found.level, " ".join([*reason, *found.notes]))


def _parameter_table(title: str, rows: Iterable[Parameter], bare: bool, level: float = 0.95, note: str = "") -> Table:
    listed, ends = list(rows), (f"{100 * level:g} % low", f"{100 * level:g} % high")
    head = ("parameter", "estimate") if bare else ("parameter", "estimate", "std. error", *ends)
    cells = [(row.name, number(row.estimate)) if bare else interval_row(*row[:5]) for row in listed]
    if any(row.unit for row in listed):
        head, cells = (*head, "unit"), [(*line, row.unit) for line, row in zip(cells, listed)]
    return Table(title, head, cells, note)


def interval_row(
    name: str, value: float, error: float, lower: float, upper: float, size: float = 0.0
) -> tuple[str, ...]:
    """Write an estimate to the second digit of its standard error, as one reads it in a paper.

    Errors far below `size` are roundoff: the gauge or the basis fixes the value. An error that is not known is a dash,
    an end that does not exist "none".
    """
    size = max(size, abs(value))
    if np.isnan(error):
        return name, number(value), "-", "-", "-"
    if not error > 1e-9 * size:
        return name, number(value if abs(value) > 1e-9 * size else 0.0), "fixed", "-", "-"
    decimals, cells = 1 - int(np.floor(np.log10(error))), (value, error, lower, upper)
    if decimals > 7 or max(abs(x) for x in cells if np.isfinite(x)) >= 1e7:
        written = [f"{x:.{1 if x is error else 4}e}" for x in cells]
    else:
        written = [f"{x:.{max(decimals, 0)}f}" for x in cells]
    return name, *("none" if np.isinf(x) else word for x, word in zip(cells, written))


def _basis(basis: Any) -> str:
    """Write a basis with its size and interval."""
    low, high = basis.interval
    return f"{type(basis).__name__.lower()} with {basis.size} functions on [{low:.4g}, {high:.4g}]"


def _abreast(rows: list[tuple[str, str]]) -> list[tuple[str, ...]]:
    """Set many short rows in `ABREAST` columns, read downwards."""
    height = -(-len(rows) // ABREAST)
    blank = [("", "")] * (height * ABREAST - len(rows))
    columns = [(rows + blank)[c * height : (c + 1) * height] for c in range(ABREAST)]
    return [tuple(cell for pair in line for cell in pair) for line in zip(*columns)]
