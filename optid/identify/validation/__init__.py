"""Validation on a record: errors, residual tests, structure test, prediction horizon."""

from optid.identify.validation.checks import Validation, validate
from optid.identify.validation.comparison import Comparison, compare_models
from optid.identify.validation.horizons import HorizonCurve, fit_by_horizon
from optid.identify.validation.measures import Measures, fit_percent

__all__ = [
    "Comparison",
    "HorizonCurve",
    "Measures",
    "Validation",
    "compare_models",
    "fit_by_horizon",
    "fit_percent",
    "validate",
]
