"""Validation on a record: errors, residual tests, structure test, prediction horizon."""

from optid.identify.validation.checks import Comparison, Validation, compare_models, validate
from optid.identify.validation.predictions import HorizonCurve, Measures, fit_by_horizon, fit_percent

__all__ = ["Comparison", "HorizonCurve", "Measures", "Validation", "compare_models", "fit_by_horizon", "fit_percent",
           "validate"]
