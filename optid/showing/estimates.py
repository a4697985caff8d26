"""What was estimated, as rows: coefficients and nonlinearities with their errors."""

from typing import TYPE_CHECKING, Any

import numpy as np

from optid.bases.expansions import Linear
from optid.bases.splines import Triangular
from optid.errors import OptidError
from optid.showing.wording import Table, number

if TYPE_CHECKING:
    from optid.fitting import Fit
    from optid.uncertainty import Uncertainty

MOST_NODES, EVEN = 20, 11
"""A piecewise linear f with fewer cells than the first is listed at its nodes, any other at so many points."""


def uncertainty(fit: "Fit") -> tuple["Uncertainty | None", str]:
    """Return the uncertainty of a fit, or None and the reason why there is none."""
    try:
        return fit.uncertainty, ""
    except OptidError as error:
        return None, str(error)


def parameter_table(fit: "Fit") -> Table:
    """Coefficients of A, B and the offset with standard errors and 95 % intervals where there are some."""
    known, reason = uncertainty(fit)
    if known is None:
        rows = [(name, number(value)) for name, value in _coefficients(fit.model)]
        return Table("Parameters", ("parameter", "estimate"), rows, f"No standard errors: {reason.rstrip('.')}.")
    rows = [_interval_row(name, *row) for name, *row in known.table()]
    return Table("Parameters", ("parameter", "estimate", "std. error", "95 % low", "95 % high"), rows)


def nonlinearity_tables(fit: "Fit") -> list[Table]:
    """Values of every nonlinearity at a few points, with their pointwise bands where there are some."""
    model, found = fit.model, []
    known, _ = uncertainty(fit)
    functions = (model.f,) if model.m == 1 else model.nonlinearities
    for c, (name, unit, f) in enumerate(zip(model.inputs, model.input_units, functions)):
        if isinstance(f.basis, Linear):
            continue
        points = _points(f.basis)
        label = f"{name} ({unit})" if unit else name
        word = "f" if model.m == 1 else f"f_{name}"
        if known is None:
            rows, head = [(number(u, 4), number(value)) for u, value in zip(points, f(points))], ()
        else:
            band = known.band(c, points)
            numeric = zip(points, band.value, band.error, band.lower, band.upper)
            size = float(np.max(np.abs(band.value)))
            rows = [_interval_row(number(u, 4), *row, size=size) for u, *row in numeric]
            head = ("std. error", "95 % low", "95 % high")
        found.append(Table(f"Nonlinearity {word}, basis {_basis(f.basis)}", (label, word, *head), rows))
    return found


def coefficient_table(fit: "Fit") -> Table | None:
    """Coefficients mu of the bases; None where every channel is linear."""
    known, _ = uncertainty(fit)
    rows = []
    for c, (name, f) in enumerate(zip(fit.model.inputs, fit.model.nonlinearities)):
        if isinstance(f.basis, Linear):
            continue
        for j, value in enumerate(f.mu):
            label = f"mu{j + 1}" + (f"[{name}]" if fit.model.m > 1 else "")
            rows.append(
                (label, number(value))
                if known is None
                else _interval_row(
                    label, value, *(getattr(known.mu[c], part)[j] for part in ("error", "lower", "upper"))
                )
            )
    head = () if known is None else ("std. error", "95 % low", "95 % high")
    return Table("Coefficients of the basis", ("coefficient", "estimate", *head), rows) if rows else None


def _interval_row(
    name: str, value: float, error: float, lower: float, upper: float, size: float = 0.0
) -> tuple[str, ...]:
    """Write an estimate to the second digit of its standard error, as one reads it in a paper.

    Errors far below `size` are roundoff: the gauge or the basis fixes the value.
    """
    size = max(size, abs(value))
    if not error > 1e-9 * size:
        return name, number(value if abs(value) > 1e-9 * size else 0.0), "fixed", "-", "-"
    decimals = 1 - int(np.floor(np.log10(error)))
    if decimals > 7 or max(abs(value), abs(lower), abs(upper)) >= 1e7:
        return name, f"{value:.4e}", f"{error:.1e}", f"{lower:.4e}", f"{upper:.4e}"
    return name, *(f"{x:.{max(decimals, 0)}f}" for x in (value, error, lower, upper))


def _points(basis: Any) -> np.ndarray:
    """Points at which f is listed: the nodes of a piecewise linear f when they are few, an even grid otherwise."""
    return basis.grid(basis.p + 1 if isinstance(basis, Triangular) and basis.p < MOST_NODES else EVEN)


def _basis(basis: Any) -> str:
    """Write a basis with its size and interval."""
    low, high = basis.interval
    return f"{type(basis).__name__.lower()} with {basis.size} functions on [{low:.4g}, {high:.4g}]"


def _coefficients(model: Any) -> list[tuple[str, float]]:
    """Names and values of A, B and the offset, where no uncertainty names them."""
    several, found = model.l > 1, []
    for (i, *pair), value in np.ndenumerate(model.a):
        found.append((f"a{i + 1}" + (f"[{','.join(model.outputs[o] for o in pair)}]" if several else ""), float(value)))
    for channel, b in zip(model.inputs, model.b):
        for (j, *output), value in np.ndenumerate(b):
            words = ([channel] if model.m > 1 else []) + [model.outputs[o] for o in output]
            found.append((f"b{j}" + (f"[{','.join(words)}]" if words else ""), float(value)))
    return found + [
        ("offset" + (f"[{name}]" if several else ""), float(value)) for name, value in zip(model.outputs, model.offset)
    ]
