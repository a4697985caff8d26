"""Validation on a record: errors, residual tests, structure test, prediction horizon."""

from optid.validation.checks import Validation, validate
from optid.validation.horizons import HorizonCurve, fit_by_horizon
from optid.validation.measures import Measures, fit_percent

__all__ = ["HorizonCurve", "Measures", "Validation", "fit_by_horizon", "fit_percent", "validate"]
