"""Validation on a record: errors, residual tests, structure test."""

from optid.validation.checks import Measures, Validation, fit_percent, validate

__all__ = ["Measures", "Validation", "fit_percent", "validate"]
