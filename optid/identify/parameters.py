"""Estimated parameters as a table, with standard errors and intervals, and information criteria."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array, check_probability, import_pandas
from optid.errors import DataError, LookupFailed, OptidError, nearest
from optid.models.functions import StaticFunction, free_parameters, static_functions
from optid.registry import Rendered


class Parameter(NamedTuple):
    """An estimate; an unknown error or interval is NaN, an unknown unit "".

    Coefficients whose units follow from those of the channels are listed without.
    """

    name: str
    estimate: float
    error: float = np.nan
    lower: float = np.nan
    upper: float = np.nan
    unit: str = ""


@dataclass(frozen=True, repr=False)
class Parameters(Rendered, Sequence):
    """Estimated parameters in their order, by position or by name: ``fit.params["a1"].estimate``.

    Attributes:
        rows: the parameters.
        level: probability that an interval contains the truth.
        reason: why there are no standard errors, "" where there are.
        title: what the table is called.
        notes: what they mean, and why some have no error, one sentence each.
    """

    rows: tuple[Parameter, ...]
    level: float = 0.95
    reason: str = ""
    title: str = "Parameters"
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.rows)

    def __getitem__(self, key: Any) -> Any:
        """Return the parameter of a name, position or slice; an unknown name is a `LookupFailed`."""
        if not isinstance(key, str):
            return self.rows[key]
        for row in self.rows:
            if row.name == key:
                return row
        raise LookupFailed(f"no parameter is called {key!r}. {nearest(key, self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(row.name for row in self.rows)

    @property
    def estimates(self) -> Array:
        """Estimates (n,)."""
        return np.array([row.estimate for row in self.rows])

    def to_pandas(self) -> Any:
        """Return a pandas frame, one row a parameter, with the columns estimate, error, lower, upper and unit.

        Raises:
            DataError: pandas is not installed.
        """
        return import_pandas().DataFrame(self.rows, columns=Parameter._fields).set_index("name")


def parameters(fit: Any, level: float = 0.95) -> Parameters:
    """Return the parameters of a fit with intervals of a level: coefficients, then those of its static functions.

    Of a state-space model, whose matrices depend on the choice of the states, these are poles and static gain.
    """
    check_probability(level, "level")
    known, reason = uncertainty_or_reason(fit)
    known = None if known is None else known.at_level(level)
    rows = coefficient_parameters(fit.model, known)
    for function in static_functions(fit.model):
        if not function.is_linear:
            rows += function_parameters(function, known)
    return Parameters(tuple(rows), level, reason)


def coefficient_parameters(model: Any, known: Any) -> list[Parameter]:
    """Return the coefficients of a model with their units, and with errors where the uncertainty is known."""
    rows = [Parameter(*row) for row in (model.coefficients() if known is None else known.table())]
    units = model.coefficient_units() if hasattr(model, "coefficient_units") else {}
    return [row._replace(unit=units.get(row.name, "")) for row in rows]


def uncertainty_or_reason(fit: Any) -> tuple[Any, str]:
    """Return the uncertainty of a fit, or None and the reason why there is none."""
    try:
        return fit.uncertainty, ""
    except OptidError as error:
        return None, str(error)


def function_parameters(function: StaticFunction, known: Any) -> list[Parameter]:
    """Return the coefficients of a static function, with errors where the uncertainty is known."""
    letter = {"feedback": "nu", "latent": "c"}.get(function.family, "mu")
    where = "" if function.word in "fgh" else function.word if function.word[1] != "_" else function.name
    names = [f"{letter}{j + 1}" + (f"[{where}]" if where else "") for j in range(function.nonlinearity.mu.size)]
    if known is None:
        return [Parameter(name, float(value)) for name, value in zip(names, function.nonlinearity.mu)]
    found = known.coefficients(function.index, function.family)
    columns = np.column_stack([found.value, found.error, found.lower, found.upper]).tolist()
    return [Parameter(name, *row) for name, row in zip(names, columns)]


def criteria(fit: Any) -> tuple[float, float]:
    """Return AIC and BIC of a fit, from the Gaussian likelihood of its one-step errors.

    Samples with a missing output are left out. A stream, or no more errors than outputs, is a `DataError`.
    """
    errors = np.vstack(fit.residuals if isinstance(fit.residuals, tuple) else (fit.residuals,))
    errors = errors[np.isfinite(errors).all(axis=1)]
    samples, outputs = errors.shape
    if samples <= outputs:
        raise DataError(f"{samples} samples have one-step errors of every output: too few for a likelihood")
    sign, size = np.linalg.slogdet(errors.T @ errors / samples)
    likelihood = samples * ((size if sign > 0 else -np.inf) + outputs * (1 + np.log(2 * np.pi)))
    count = free_parameters(fit.model)
    return float(likelihood + 2 * count), float(likelihood + np.log(samples) * count)
