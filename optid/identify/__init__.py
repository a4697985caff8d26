"""Identification: fit, order, validation, uncertainty, experiment design."""
