"""Validation on a record: errors, residual tests, structure test, prediction horizon."""

from optid.identify.validation.checks import Validation, validate
from optid.identify.validation.comparison import Comparison, compare_models
from optid.identify.validation.predictions import HorizonCurve, Measures, fit_by_horizon, fit_percent

__all__ = ["Comparison", "HorizonCurve", "Measures", "Validation", "compare_models", "fit_by_horizon", "fit_percent",
           "validate"]
